"""The trackers of the papers by name, as one table of choices.

`make_tracker(name, body_name)` builds one. The number of modes is the papers': 3 for an arm, 7 for
a body. More trackers (the baselines) join the table with their samplers.
"""

from __future__ import annotations

from dataclasses import dataclass

from torchcss.errors import ConfigurationError
from torchcss.inference.dynamics import Diffusion
from torchcss.inference.proposals import CovarianceScaled, Proposal
from torchcss.inference.tracker import Tracker
from torchcss.inference.trust_region import TrustRegionNewton


@dataclass(frozen=True, kw_only=True)
class Preset:
    """One row of the table.

    Attributes:
        what: The tracker in a line.
        proposal: Where samples go.
        samples_arm: Samples per frame for an arm.
        samples_body: Samples per frame for a body.
        modes_arm: Modes kept for an arm.
        modes_body: Modes kept for a body.
        memory: See `Tracker`.
    """

    what: str
    proposal: Proposal
    samples_arm: int
    samples_body: int
    modes_arm: int = 3
    modes_body: int = 7
    memory: float = 1.0


PRESETS: dict[str, Preset] = {
    "css": Preset(
        what="covariance scaled sampling, [IJRR] Fig. 6 with s = 8",
        proposal=CovarianceScaled(covariance_scale=8.0, max_deviation=1.0),
        samples_arm=40,
        samples_body=60,
        memory=0.5,
    ),
    "single": Preset(
        what="one robust mode with joint limits, no search ([IJRR] section 6)",
        proposal=CovarianceScaled(covariance_scale=1.0),
        samples_arm=1,
        samples_body=1,
        modes_arm=1,
        modes_body=1,
    ),
}


def make_tracker(
    preset: str,
    body_name: str,
    *,
    num_samples: int | None = None,
    num_modes: int | None = None,
    motion: tuple[float, ...] | float = 0.0,
) -> Tracker:
    """Build a tracker from the table.

    Args:
        preset: A name in `PRESETS`.
        body_name: The body; arms and bodies differ in numbers.
        num_samples: Samples per frame instead of the table's.
        num_modes: Modes kept instead of the table's.
        motion: Standard deviation of every parameter's motion per frame.

    Raises:
        ConfigurationError: If there is no such tracker.
    """
    if preset not in PRESETS:
        raise ConfigurationError(f"no tracker {preset!r}; there are {', '.join(PRESETS)}")
    row = PRESETS[preset]
    arm = body_name.startswith("arm")
    return Tracker(
        proposal=row.proposal,
        num_samples=num_samples or (row.samples_arm if arm else row.samples_body),
        num_modes=num_modes or (row.modes_arm if arm else row.modes_body),
        optimiser=TrustRegionNewton(max_steps=20, tolerance=1e-2),
        memory=row.memory,
        dynamics=Diffusion(deviation=motion),
    )

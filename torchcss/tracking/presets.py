"""The trackers by name, as one table of choices: the papers' and ours.

`torchcss.tracking.settings.make_tracker` builds one. A row says everything: search, cost, dynamics,
optimiser, what keypoints are used for and where the track starts. An option that the user
gives beside it wins (`Settings.changed`).

| name | tracker | from |
|---|---|---|
| css | covariance scaled sampling, modes kept apart, soft matching, jumps | ours |
| ijrr_css | covariance scaled sampling as printed | [IJRR] Fig. 6 |
| ijrr_css_heavy_tailed | the same with Student t tails | [IJRR] Fig. 8d (3) |
| ijrr_css_spherical | the same from balls of the same volume | [IJRR] section 7 |
| ijrr_css_limits, ijrr_css_constrained | without and with non-self-intersection | [IJRR] 6.2 |
| ijrr_gaussian_single, ijrr_robust_single | one mode: Gaussian errors, robust errors | [IJRR] 6 |
| ijrr_single_limits | one robust mode with limits, without non-self-intersection | [IJRR] 6.1 |
| ijrr_cham_rehg, ijrr_cham_rehg_ssd | Cham and Rehg (1999) in 3D, robust and not | [IJRR] 6.1 |
| ijrr_condensation | the particle filter | [IJRR] 1.1 |
| rr_multiple_hypothesis | hypotheses descend, patterns about them are scored | [RR] Fig. 4 |
| condensation_modes | ijrr_css, sampled by dynamical noise | ours, after [IJRR] 6 |
| heap_hogg, heap_hogg_ssd | Heap and Hogg (1998) in 3D, robust and not | ours, after [IJRR] 6.1 |
| condensation_inflated | with inflated posterior and noise, weighed back | ours, after [IJRR] 9 |
| annealed | the annealed particle filter | ours, after [IJRR] 1.2 |

Modes are the papers': 3 for an arm, 7 for a body, 10 for Cham and Rehg's. What the papers leave
open is ours: the numbers of samples and particles, the search noise of the rows that search by it
(a multiple of the everyday motion of one frame), the step limit and the tolerance of descents, the
degrees of freedom of the t, that modes of which no joint centre is 3 cm apart are confounded
minima, and `torchcss.linalg.LEAST_CURVATURE`. A filter gets as many evaluations of the cost as a
descending tracker may take, 20 per sample that descends to the end.

The papers' rows (decision "papers' presets") have the papers' terms (`Preset.terms`), no flips, no
descents on a coarser cost, driftless diffusion where that is printed, keypoints in the first frame
alone, and they start from the covariance of one fit, which has the papers' priors (section 5 of
both). Where several modes are kept nothing but what was drawn descends. Cham and Rehg's "ssd" row
has Gaussian errors, Gauss-Newton Hessians, no joint limits and no repulsion;
[IJRR] names only the metric and the optimiser, the rest is our reading.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, replace
from types import MappingProxyType
from typing import Literal

from torchcss.errors import ConfigurationError
from torchcss.inference.particle import AnnealedParticleFilter, ParticleFilter
from torchcss.inference.proposals import (
    ChamRehg,
    Condensation,
    CovarianceScaled,
    EigenDirectionGrid,
    HeavyTailed,
    Proposal,
    Spherical,
    unbounded,
)
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.types import Bounds, Curvature, frozen


@frozen
class Preset:
    """One row of the table.

    Attributes:
        what: The tracker in a line.
        proposal: Where samples go, for trackers that descend from them; one that searches by
            dynamical noise gets its `deviation` from `noise`. An `EigenDirectionGrid` makes a
            `GridTracker`.
        particles: The particle filter instead; its numbers and dynamics are filled in.
        samples_arm: Samples per frame for an arm (`scripts/failure_modes.py` measures it).
        samples_body: Samples per frame for a body.
        modes_arm: Modes kept for an arm.
        modes_body: Modes kept for a body.
        power_of_part: `Tracker.likelihood_power` for each part of the body, since costs are means
            over all nodes: what one part shows weighs less, the more parts there are. A body of
            more parts than a person counts as a person does, for want of measurements, and so does
            one without parts: it has keypoints alone, which are a sum. Of two poses that look
            alike, the one that was right so far stays the best (`scripts/evaluate_posterior.py`
            measures it). None: a power of 1, as in the papers.
        survivors_arm: `Tracker.survivors` for an arm.
        survivors_body: The same for a body.
        proposal_arm: Where samples go for an arm, if elsewhere than for a body.
        persistence: Share of its last motion that a mode goes on with: 0 is driftless diffusion, 1
            constant velocity. The papers' own trackers have 0, Cham and Rehg's 1. With some, a mode
            does not lag behind a limb whose flow is underestimated.
        noise: Dynamical noise that the tracker searches by, in multiples of the motion of one
            frame. Ours that descend from scaled covariances have 1, realistic noise; the papers' 0.
        robust: Whether the cost's potentials are robust (False: `Quadratic`).
        limits: Whether joint limits hold, see `bounds`.
        interpenetration: Whether the row's terms let parts repel each other.
        curvature: Which Hessian the cost gives.
        separation: Distance of some joint centre, metres, from which two modes count as two
            explanations, see `Tracker`. The papers have none; their modes are distinct minima. By
            the mean distance of all joints an arm that is flipped would hardly count.
        soft_matching: See `Tracker`.
        surprise: See `Tracker`; 0.15 of the n = 34 nats of a person, as of a frame's likelihood.
        jumps_every: Every how many frames the flips of the best mode join the search, see
            `torchcss.tracking.flip_moves`; 0, as in the papers: never, nor do limbs that are put
            at keypoints that they miss (`torchcss.tracking.keypoint_moves`).
        keep_alike: See `Tracker`.
        coarse_every: See `Tracker`.
        optimiser: How samples descend.
        converged_only: See `Tracker`.
        capped: See `Tracker`.
        terms: Name of a set of terms, see `torchcss.tracking.settings.named_terms`.
        cost: Whose cost it is: "ours"; "ijrr" or "rr": as printed, see
            `torchcss.tracking.settings.make_choice`.
        keypoints_use: See `Settings`.
        start: Which fits of the first frame the track starts from: all, or the likeliest with its
            covariance (section 5 of both papers).
    """

    what: str
    proposal: Proposal | None = None
    particles: ParticleFilter | AnnealedParticleFilter | None = None
    samples_arm: int
    samples_body: int
    modes_arm: int = 3
    modes_body: int = 7
    power_of_part: float | None = None
    survivors_arm: int = 0
    survivors_body: int = 0
    proposal_arm: Proposal | None = None
    persistence: float = 0.0
    noise: float = 1.0
    robust: bool = True
    limits: bool = True
    interpenetration: bool = True
    curvature: Curvature = Curvature.EXACT
    separation: float = 0.0
    soft_matching: bool = False
    surprise: float = math.inf
    jumps_every: int = 0
    keep_alike: bool = True
    coarse_every: int = 3
    optimiser: TrustRegionNewton = field(default_factory=lambda: _OURS)
    converged_only: bool = False
    capped: bool = True
    terms: str = "default"
    cost: Literal["ours", "ijrr", "rr"] = "ours"
    keypoints_use: Literal["first", "all"] = "all"
    start: Literal["fits", "one fit"] = "fits"

    def __post_init__(self) -> None:
        if (self.proposal is None) == (self.particles is None):
            raise ConfigurationError(
                f"Preset: expected either a proposal or a particle filter, got {self.proposal} and "
                f"{self.particles}; give one of the two"
            )

    @property
    def descends_from_samples(self) -> bool:
        """Whether it makes a `Tracker`, not a filter of particles or a `GridTracker`."""
        return self.particles is None and not isinstance(self.proposal, EigenDirectionGrid)

    def bounds(self, limits: Bounds) -> Bounds:
        """Bounds that the tracker obeys: the joint limits, or none.

        Args:
            limits: Those of the body.
        """
        if self.limits:
            return limits
        return unbounded(limits.lower)


PARTS_OF_A_PERSON = 18
"""Of the bodies that ship."""

_OURS = TrustRegionNewton(max_steps=60, tolerance=1e-2, initial_radius=1 / 16)
"""Of our rows. The radius is in metres and radians: the edges are searched for some 20 pixels to
either side, and most first steps of a quarter of a radian and more are rejected."""

_TO_CONVERGENCE = TrustRegionNewton(max_steps=200, tolerance=1e-6, initial_radius=1.0)
"""Of the papers' rows (note 8 [IJRR]); the numbers are ours."""

_CONFOUNDED = 0.03
"""Metres that some joint centre of two minima is apart, for them to count as two. Ours."""

_CSS = Preset(
    what="covariance scaled sampling, [IJRR] Fig. 6 with s = 8, modes kept apart, and jumps",
    converged_only=True,
    proposal=CovarianceScaled(covariance_scale=8.0, max_deviation=1.0),
    samples_arm=160,
    samples_body=60,
    power_of_part=0.15 / PARTS_OF_A_PERSON,
    survivors_arm=20,
    survivors_body=15,
    persistence=0.8,
    separation=0.12,
    soft_matching=True,
    surprise=5.1,
    jumps_every=3,
)


def _printed(row: Preset, *, paper: Literal["ijrr", "rr"] = "ijrr") -> Preset:
    """The row with nothing of ours in what is around its search."""
    return replace(
        row,
        optimiser=_TO_CONVERGENCE,
        converged_only=True,
        capped=False,
        coarse_every=0,
        terms="papers",
        cost=paper,
        keypoints_use="first",
        start="one fit",
    )


_IJRR_CSS = _printed(
    Preset(
        what="covariance scaled sampling as printed ([IJRR] Fig. 6, s = 8)",
        proposal=CovarianceScaled(covariance_scale=8.0, include_modes=False),
        samples_arm=40,
        samples_body=60,
        noise=0.0,
        separation=_CONFOUNDED,
        keep_alike=False,
    )
)
_SINGLE = _printed(
    Preset(
        what="one robust mode with joint limits, without non-self-intersection ([IJRR] 6.1)",
        proposal=CovarianceScaled(covariance_scale=1.0),
        samples_arm=1,
        samples_body=1,
        modes_arm=1,
        modes_body=1,
        noise=0.0,
        interpenetration=False,
    )
)
_HEAP_HOGG = Preset(
    what="Heap and Hogg's multiple-hypothesis tracker in 3D, robust",
    proposal=Condensation(deviation=0.0),
    samples_arm=40,
    samples_body=60,
    modes_arm=10,
    modes_body=10,
    noise=3.0,
)
_CHAM_REHG = replace(
    _printed(_HEAP_HOGG),
    what="Cham and Rehg's multiple-hypothesis tracker in 3D, robust ([IJRR] section 6.1)",
    proposal=ChamRehg(deviation=0.0, piecewise=False, include_modes=False),
    persistence=1.0,
)
_CONDENSATION = Preset(
    what="CONDENSATION: particles weighed by the likelihood ([IJRR] section 1.1)",
    particles=ParticleFilter(num_samples=1, num_modes=1),
    samples_arm=800,
    samples_body=1200,
    noise=1.5,
)


def _least_squares(row: Preset, what: str) -> Preset:
    """The row with Gaussian errors, Gauss-Newton Hessians and no physical constraints."""
    return replace(
        row,
        what=what,
        robust=False,
        limits=False,
        interpenetration=False,
        curvature=Curvature.GAUSS_NEWTON,
    )


PRESETS: dict[str, Preset] = {
    "css": _CSS,
    "ijrr_css": _IJRR_CSS,
    "ijrr_css_heavy_tailed": replace(
        _IJRR_CSS,
        what="covariance scaled sampling with Student t tails ([IJRR] Fig. 8d)",
        proposal=HeavyTailed(covariance_scale=4.0, degrees_of_freedom=3, include_modes=False),
    ),
    "ijrr_css_spherical": replace(
        _IJRR_CSS,
        what="the control: balls of the volume of the scaled covariances ([IJRR] section 7)",
        proposal=Spherical(covariance_scale=8.0, include_modes=False),
    ),
    "ijrr_css_limits": replace(
        _IJRR_CSS,
        what="as printed with joint limits, without non-self-intersection ([IJRR] section 6.2)",
        interpenetration=False,
    ),
    "ijrr_css_constrained": replace(
        _IJRR_CSS,
        what="as printed with joint limits and non-self-intersection ([IJRR] section 6.2)",
    ),
    "rr_multiple_hypothesis": _printed(
        Preset(
            what="hypotheses descend; patterns about their minima are scored ([RR] Fig. 4)",
            proposal=EigenDirectionGrid(num_directions=3, num_steps=1),
            proposal_arm=EigenDirectionGrid(num_directions=1, num_steps=1),
            samples_arm=9,  # 3 minima and 2 steps from each
            samples_body=49,  # 7 minima and 6 steps from each
            interpenetration=False,
            curvature=Curvature.GAUSS_NEWTON,
        ),
        paper="rr",
    ),
    "ijrr_single_limits": _SINGLE,
    "ijrr_robust_single": replace(
        _SINGLE,
        what="one robust mode without physical constraints ([IJRR] section 6)",
        limits=False,
    ),
    "ijrr_gaussian_single": replace(
        _SINGLE,
        what="one mode, Gaussian errors, without physical constraints ([IJRR] section 6)",
        robust=False,
        limits=False,
    ),
    "condensation_modes": replace(
        _IJRR_CSS,
        what="ijrr_css, but sampled by dynamical noise instead of scaled covariances",
        proposal=Condensation(deviation=0.0),
        noise=3.0,
    ),
    "ijrr_cham_rehg": _CHAM_REHG,
    "ijrr_cham_rehg_ssd": _least_squares(
        _CHAM_REHG, "Cham and Rehg's multiple-hypothesis tracker in 3D, least squares"
    ),
    "heap_hogg": _HEAP_HOGG,
    "heap_hogg_ssd": _least_squares(
        _HEAP_HOGG, "Heap and Hogg's multiple-hypothesis tracker in 3D, least squares"
    ),
    "ijrr_condensation": _printed(_CONDENSATION),
    "condensation_inflated": replace(
        _printed(_CONDENSATION),
        what="CONDENSATION: posterior to the power 1/8, noise 8 times as wide ([IJRR] section 9)",
        particles=ParticleFilter(num_samples=1, num_modes=1, dilution=1 / 8, noise_scale=8.0),
        noise=1.0,
    ),
    "annealed": replace(
        _CONDENSATION,
        what="the annealed particle filter ([IJRR] section 1.2)",
        particles=AnnealedParticleFilter(num_samples=1, num_modes=1, num_layers=10),
        samples_arm=80,
        samples_body=120,
    ),
}

OLD_NAMES: Mapping[str, str] = MappingProxyType(
    {
        "css_figure_6": "ijrr_css",
        "css_heavy_tailed": "ijrr_css_heavy_tailed",
        "css_limits": "ijrr_css_limits",
        "css_constrained": "ijrr_css_constrained",
        "gaussian_single": "ijrr_gaussian_single",
        "robust_single": "ijrr_robust_single",
        "single": "ijrr_single_limits",
        "cham_rehg": "ijrr_cham_rehg",
        "cham_rehg_ssd": "ijrr_cham_rehg_ssd",
        "condensation": "ijrr_condensation",
        "multiple_hypothesis": "rr_multiple_hypothesis",
    }
)
"""Names of version 0.1, which hold for one version more."""


def preset_name(name: str) -> str:
    """The present name of a row.

    Args:
        name: A name in `PRESETS`, or one of `OLD_NAMES`.

    Raises:
        ConfigurationError: If there is no such tracker.
    """
    known = OLD_NAMES.get(name, name)
    if known not in PRESETS:
        raise ConfigurationError(f"no tracker {name!r}; there are {', '.join(PRESETS)}")
    return known

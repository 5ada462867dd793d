"""When trackers failed in section 6 of [IJRR] and of [RR], on the papers' own sequences.

The sequences are lost; ours of the same names stand for them, other motions in front of other
rooms. Figures that can be compared are therefore the order of the trackers and what becomes of
them, not the times.
"""

from __future__ import annotations

from typing import NamedTuple


class Published(NamedTuple):
    """What a paper says of a tracker on one of its sequences.

    Attributes:
        sequence: Ours that stands for the paper's.
        preset: The tracker.
        times_s: When it fails; none if it does not, or if no time is given.
        section: Where it stands.
        words: What happens.
        fails: Whether it fails at all.
    """

    sequence: str
    preset: str
    times_s: tuple[float, ...]
    section: str
    words: str
    fails: bool = True

    @property
    def told(self) -> str:
        """The times in a few letters, for a table."""
        times = " and ".join(f"{time:g} s" for time in self.times_s)
        return times or ("fails" if self.fails else "never")


_PILLAR = "slips gradually out of registration, passing the strong edges of the pillar"
_ELBOW = (
    "shoulder motion towards the camera is taken for elbow motion, until the elbow's bound is hit. "
    "The paper says robust single mode tracker, which by its definition has no limits; a bound can "
    "only be hit where there is one"
)
_FIST = "the turn is underestimated; without non-self-intersection the fist ends up in the body"
_DEPTH = "follows slightly longer, misestimates the depth, loses track during the turn"

PUBLISHED: tuple[Published, ...] = (
    Published("arm", "ijrr_gaussian_single", (0.5, 2.2), "[IJRR] 6.1", _PILLAR),
    Published("arm", "ijrr_robust_single", (2.6,), "[IJRR] 6.1", _ELBOW),
    Published("arm", "ijrr_single_limits", (2.6,), "[IJRR] 6.1", _ELBOW),
    Published("arm", "ijrr_css", (), "[IJRR] 6.1", "8 s without failure, three modes", False),
    Published("body-clutter", "ijrr_gaussian_single", (0.3,), "[IJRR] 6.1", _PILLAR),
    Published("body-clutter", "ijrr_single_limits", (), "[IJRR] 6.1", _FIST),
    Published("body-clutter", "ijrr_cham_rehg_ssd", (0.5,), "[IJRR] 6.1", "lost early in the turn"),
    Published("body-clutter", "ijrr_cham_rehg", (0.7,), "[IJRR] 6.1", "lost further into the turn"),
    Published(
        "body-clutter", "ijrr_css", (), "[IJRR] 6.1", "3.5 s without failure, seven modes", False
    ),
    Published("arm", "rr_multiple_hypothesis", (), "[RR] 6", "8 s, three hypotheses", False),
    Published(
        "body-clutter", "rr_multiple_hypothesis", (), "[RR] 6", "1.2 s, seven hypotheses", False
    ),
    Published("body-dark", "ijrr_gaussian_single", (0.5,), "[IJRR] 6.2", "loses track"),
    Published("body-dark", "ijrr_robust_single", (1.0,), "[IJRR] 6.2", _DEPTH),
    Published(
        "body-dark", "ijrr_css_limits", (), "[IJRR] 6.2",
        "modes occasionally in impossible poses, with terminal consequences; no time is given",
    ),
    Published("body-dark", "ijrr_css_constrained", (), "[IJRR] 6.2", "4 s without failure", False),
)  # fmt: skip

"""Motions for rendered sequences: key poses as tables, joined by splines.

A `KeyPoses` is a table: times in seconds, and under each joint's name its degrees (metres for
root_x, root_y and root_z) at these times. Between them runs the cubic spline with continuous first
and second derivatives that starts and ends at rest. Where the feet are planted, the legs follow
from the pelvis, as they do in a person (`plant_feet`).

`MOTIONS` has those of the papers' section 6 [IJRR]: an arm that bends, rotates and moves towards
the camera (Fig. 9), a pivoting turn before clutter (Fig. 10), and turning and reaching before a
dark background (Fig. 11). `KeyPoses.states` evaluates one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.errors import ConfigurationError
from torchcss.types import Curvature, PointCost

_METRES = ("root_x", "root_y", "root_z")


@dataclass(frozen=True, kw_only=True)
class KeyPoses:
    """A motion as a table.

    Attributes:
        body: Name of the body that moves.
        times: Seconds of the key poses, ascending from 0.
        degrees: Degrees (metres for the root's place) of a joint at every time; a joint that is
            not listed rests.
        planted: Whether the feet stay where they are at first, and the legs follow.
    """

    body: str
    times: tuple[float, ...]
    degrees: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    planted: bool = False

    def __post_init__(self) -> None:
        if len(self.times) < 2 or self.times[0] != 0 or (np.diff(self.times) <= 0).any():
            raise ConfigurationError(
                f"KeyPoses.times: expected at least two ascending times from 0, got {self.times}"
            )
        for name, row in self.degrees.items():
            if len(row) != len(self.times):
                raise ConfigurationError(
                    f"KeyPoses: {name} has {len(row)} values for {len(self.times)} times"
                )

    @property
    def duration(self) -> float:
        """Seconds from the first to the last key pose."""
        return self.times[-1]

    def states(self, body: BodyModel, times: Float[Tensor, " t"]) -> Float[Tensor, "t n"]:
        """The motion at given times.

        Args:
            body: The body, of any lengths.
            times: Seconds.
        """
        states = body.rest.repeat(len(times), 1)
        for name, row in self.degrees.items():
            value = clamped_spline(self.times, row, times)
            states[:, body.state_index(name)] = value if name in _METRES else value.deg2rad()
        return plant_feet(body, states) if self.planted else states


class Motion(NamedTuple):
    """How a body moves: what a sequence is rendered from, or the truth of a recorded one.

    Attributes:
        body: The body, on its base.
        states: Its states.
        frame_rate: States per second.
        description: One line about it.
    """

    body: BodyModel
    states: Float[Tensor, "t n"]
    frame_rate: float
    description: str = ""


def clamped_spline(
    knots: Sequence[float], values: Sequence[float], at: Float[Tensor, " t"]
) -> Float[Tensor, " t"]:
    """The cubic spline with continuous second derivatives that starts and ends at rest.

    With slopes s at the knots and h the intervals, the second derivatives agree where
    `s_(i-1)/h_(i-1) + 2 (1/h_(i-1) + 1/h_i) s_i + s_(i+1)/h_i = 3 (d_(i-1)/h_(i-1) + d_i/h_i)`,
    d the slopes of the chords.

    Args:
        knots: Ascending places.
        values: Values there.
        at: Where to evaluate; beyond the ends the end values hold.
    """
    x, y = (torch.as_tensor(v, dtype=at.dtype, device=at.device) for v in (knots, values))
    step = x.diff()
    chord = y.diff() / step
    size = len(x)
    matrix, right = torch.eye(size).to(x), torch.zeros_like(x)
    for i in range(1, size - 1):
        before, after = 1 / step[i - 1], 1 / step[i]
        matrix[i, i - 1], matrix[i, i], matrix[i, i + 1] = before, 2 * (before + after), after
        right[i] = 3 * (chord[i - 1] * before + chord[i] * after)
    slope = torch.linalg.solve(matrix, right)
    at = at.clamp(x[0], x[-1])
    i = torch.searchsorted(x, at, right=True).sub(1).clamp(0, size - 2)
    h, t = step[i], (at - x[i]) / step[i]
    a = y[i] * (1 + 2 * t) * (1 - t) ** 2 + y[i + 1] * t * t * (3 - 2 * t)
    return a + h * (slope[i] * t * (1 - t) ** 2 - slope[i + 1] * t * t * (1 - t))


def plant_feet(body: BodyModel, states: Float[Tensor, "t n"]) -> Float[Tensor, "t n"]:
    """Turn the legs so that the feet stay where they are in the first state.

    Heel, midtarsal and toe are held by least squares over the five angles of a leg (Gauss-Newton,
    all states at once). A foot may still roll a little about its long axis, for which the bodies
    have no joint.

    Args:
        body: A body with legs.
        states: The motion; hip, knee and ankle angles are taken from its first state only.
    """
    names = [f"{side}_{place}" for side in "lr" for place in ("heel", "midtarsal", "toe")]
    marks = torch.tensor([body.joint_index(name) for name in names])
    columns = torch.tensor([
        body.state_index(f"{side}_{angle}")
        for side in "lr"
        for angle in ("hip_flexion", "hip_abduction", "hip_twist", "knee_flexion", "ankle_flexion")
    ])  # fmt: skip
    link = body.marker_link[marks]
    goal = body.pose(states[0]).joints[marks]
    planted = states.clone()
    planted[:, columns] = states[0, columns]
    identity = torch.eye(3).to(states).expand(len(names), 3, 3)
    damping = 1e-5 * torch.eye(len(columns)).to(states)
    for _ in range(20):
        pose = body.pose(planted)
        points = pose.joints[:, marks]
        apart = points - goal
        cost = PointCost(
            0.5 * apart.square().sum(-1), apart, identity.expand(len(states), -1, 3, 3)
        )
        model = body.lift(pose, points, link, cost, curvature=Curvature.GAUSS_NEWTON)
        hessian = model.hessian[:, columns][:, :, columns] + damping
        planted[:, columns] -= torch.linalg.solve(hessian, model.gradient[:, columns])
        planted = body.bounds.project(planted)
    return planted


def _stance(times: int) -> dict[str, tuple[float, ...]]:
    """Legs a little apart with soft knees, soles flat."""
    angles = {"hip_flexion": 9, "hip_abduction": 6, "knee_flexion": 18, "ankle_flexion": -9}
    return {f"{side}_{name}": (value,) * times for side in "lr" for name, value in angles.items()}


ARM = KeyPoses(
    body="arm8",
    times=(0.0, 0.5, 1.2, 1.7, 2.2, 2.9, 3.6, 4.3, 5.0, 5.7, 6.4, 7.2, 8.0),
    degrees={
        "r_clavicle_protraction": (0, 0, 4, 8, 10, 24, 26, 12, 4, -8, -4, 10, 4),
        "r_shoulder_swing": (-50, -58, -45, -52, -66, -92, -96, -74, -60, -48, -62, -84, -70),
        "r_shoulder_raising": (52, 48, 36, 44, 50, 24, 4, 26, 46, 54, 38, 22, 40),
        "r_shoulder_twist": (0, -10, -20, -6, 12, 20, 4, -14, -22, -4, 14, 8, 0),
        "r_elbow_flexion": (30, 48, 78, 62, 30, 42, 66, 92, 70, 36, 62, 40, 34),
        "r_forearm_twist": (0, 6, 20, 10, -18, -28, 6, 34, 18, -10, -24, 4, 0),
        "r_wrist_flexion": (0, 6, 14, 0, -16, -8, 10, 18, 4, -12, -4, 8, 0),
        "r_wrist_deviation": (0, 2, 6, 2, -6, -4, 4, 6, 0, -6, 0, 4, 0),
    },
)
"""An arm beside a person: it bends and rotates, and from 2.2 to 4 s the shoulder moves towards the
camera."""

BODY_CLUTTER = KeyPoses(
    body="body30",
    times=(0.0, 0.4, 0.9, 1.4, 1.9, 2.4, 2.9, 3.5),
    degrees={
        "root_x": (0, 0.005, 0.02, 0.03, 0.01, -0.01, -0.03, -0.02),
        "root_y": (0, -0.005, -0.02, -0.03, -0.015, -0.01, -0.03, -0.015),
        "root_yaw": (0, 6, 26, 34, 16, -12, -30, -22),
        "lumbar_flexion": (0, 2, 6, 8, 4, 6, 10, 4),
        "lumbar_twist": (0, 6, 26, 32, 12, -16, -32, -22),
        "neck_twist": (0, -4, -18, -24, -8, 10, 22, 12),
        "l_shoulder_swing": (-37, -34, -42, -22, -50, -83, -97, -54),
        "l_shoulder_raising": (35, 22, 12, 24, 12, 2, -8, 8),
        "l_shoulder_twist": (13, 15, 10, 11, 12, 18, 17, 20),
        "l_elbow_flexion": (42, 62, 80, 92, 66, 38, 22, 58),
        "r_shoulder_swing": (-37, -44, -79, -96, -54, -28, -20, -35),
        "r_shoulder_raising": (35, 18, 0, -8, 6, 21, 27, 24),
        "r_shoulder_twist": (13, 18, 18, 8, 22, 16, 18, 18),
        "r_elbow_flexion": (42, 70, 40, 22, 55, 84, 98, 60),
        **_stance(8),
    },
    planted=True,
)
"""Somebody pivots on the spot, to the left and back to the right, and the arm that comes to the
front reaches out each time, fist before the body when it returns."""

BODY_DARK = KeyPoses(
    body="body34",
    times=(0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0),
    degrees={
        "root_x": (0, -0.01, -0.03, -0.04, -0.01, 0.02, 0.04, 0.04, 0.02),
        "root_y": (0, -0.01, -0.035, -0.045, -0.02, -0.02, -0.035, -0.04, -0.02),
        "root_yaw": (0, -10, -28, -34, -16, 14, 32, 34, 22),
        "lumbar_flexion": (0, 4, 14, 18, 8, 4, 10, 12, 6),
        "lumbar_bending": (0, 3, 8, 5, 0, -4, -8, -6, -3),
        "lumbar_twist": (0, -8, -28, -34, -14, 16, 34, 34, 22),
        "neck_flexion": (0, 0, -8, -14, -4, 0, -8, -16, -8),
        "neck_twist": (0, 4, 14, 16, 4, -8, -16, -10, 0),
        "l_clavicle_elevation": (0, 3, 15, 28, 8, 0, 0, 0, 0),
        "l_clavicle_protraction": (0, 8, 20, 27, 10, 0, -8, 0, 0),
        "l_shoulder_swing": (-37, -70, -101, -115, -76, -34, -16, -30, -30),
        "l_shoulder_raising": (35, 18, 10, 16, 6, 10, 24, 12, 17),
        "l_shoulder_twist": (13, 20, 14, 22, 20, 4, -4, -2, 10),
        "l_elbow_flexion": (42, 36, 18, 14, 46, 80, 90, 104, 74),
        "r_clavicle_elevation": (0, 0, 0, 0, 3, 10, 26, 32, 14),
        "r_clavicle_protraction": (0, -5, -10, 0, 8, 16, 26, 10, 6),
        "r_shoulder_swing": (-37, -27, -14, -16, -50, -86, -109, -116, -100),
        "r_shoulder_raising": (35, 22, 26, 22, 8, 10, 20, 40, 26),
        "r_shoulder_twist": (13, 9, -2, 2, 12, 22, 26, 54, 32),
        "r_elbow_flexion": (42, 74, 94, 112, 74, 34, 18, 22, 30),
        **_stance(9),
    },
    planted=True,
)
"""Somebody turns to the right and reaches across with the left arm, then to the left and up with
the right one; the shoulders rise and come forward with the reaching arm."""

MOTIONS: dict[str, tuple[KeyPoses, str]] = {
    "arm": (ARM, "an arm bends, rotates and reaches towards the camera before clutter"),
    "body-clutter": (BODY_CLUTTER, "a person pivots with reaching arms before clutter"),
    "body-dark": (BODY_DARK, "a person turns and reaches before a dark background"),
}
"""The built-in motions and a line about each."""


def sample_times(duration: float, frame_rate: float, num_frames: int | None) -> Tensor:
    """Times of the frames: `num_frames`, or as many as begin before the motion's end."""
    count = round(duration * frame_rate) if num_frames is None else num_frames
    return torch.arange(count, dtype=torch.float64) / frame_rate

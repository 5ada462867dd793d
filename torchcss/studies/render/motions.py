"""Motions for rendered sequences: key poses as tables, joined by splines.

A `KeyPoses` is a table: times in seconds, and under each joint's name its degrees (metres for
root_x, root_y and root_z) at these times. Between them runs the cubic spline with continuous first
and second derivatives that starts and ends at rest. Where the feet are planted, the legs follow
from the pelvis, as they do in a person (`plant_feet`).

`MOTIONS`, tables in `motions.toml`, has those of the papers' section 6 [IJRR]: an arm that bends,
rotates and moves towards the camera (Fig. 9), a pivoting turn before clutter (Fig. 10), and turning
and reaching before a dark background (Fig. 11). `KeyPoses.states` evaluates one.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.errors import ConfigurationError
from torchcss.types import Curvature, PointCost, Trajectory, frozen

_METRES = ("root_x", "root_y", "root_z")


@frozen
class KeyPoses:
    """A motion as a table.

    Attributes:
        body: Name of the body that moves.
        times: Seconds of the key poses, ascending from 0.
        degrees: Degrees (metres for the root's place) of a joint at every time; a joint that is
            not listed rests.
        planted: Whether the feet stay where they are at first, and the legs follow.
        description: A line about it.
    """

    body: str
    times: Sequence[float]
    degrees: Mapping[str, Sequence[float]] = field(default_factory=dict)
    planted: bool = False
    description: str = ""

    @property
    def duration(self) -> float:
        """Seconds from the first to the last key pose."""
        return self.times[-1]

    def states(self, body: BodyModel, times: Float[Tensor, " t"]) -> Trajectory:
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
    states: Trajectory
    frame_rate: float
    description: str = ""


def clamped_spline(
    knots: Sequence[float], values: Sequence[float], at: Float[Tensor, " t"]
) -> Float[Tensor, " t"]:
    """The cubic spline with continuous second derivatives that starts and ends at rest.

    Args:
        knots: Ascending places.
        values: Values there.
        at: Where to evaluate; beyond the ends the end values hold.
    """
    from scipy.interpolate import CubicSpline  # takes a second to import

    inside = at.clamp(knots[0], knots[-1]).numpy(force=True)
    return torch.from_numpy(CubicSpline(knots, values, bc_type="clamped")(inside)).to(at)


def plant_feet(body: BodyModel, states: Trajectory) -> Trajectory:
    """Turn the legs so that the feet stay where they are in the first state.

    Heel, midtarsal and toe are held by least squares over the five angles of a leg (Gauss-Newton,
    all states at once). A foot may still roll a little about its long axis, for which the bodies
    have no joint.

    Args:
        body: A body with legs.
        states: The motion; hip, knee and ankle angles are taken from its first state only.
    """
    names = [f"{side}_{place}" for side in "lr" for place in ("heel", "midtarsal", "toe")]
    soles = torch.tensor(body.joint_columns(names))
    columns = torch.tensor([
        body.state_index(f"{side}_{angle}")
        for side in "lr"
        for angle in ("hip_flexion", "hip_abduction", "hip_twist", "knee_flexion", "ankle_flexion")
    ])  # fmt: skip
    link = body.marker_link[soles]
    goal = body.pose(states[0]).joints[soles]
    planted = states.clone()
    planted[:, columns] = states[0, columns]
    identity = torch.eye(3).to(states).expand(len(names), 3, 3)
    damping = 1e-5 * torch.eye(len(columns)).to(states)
    for _ in range(20):
        pose = body.pose(planted)
        points = pose.joints[:, soles]
        apart = points - goal
        cost = PointCost(
            0.5 * apart.square().sum(-1), apart, identity.expand(len(states), -1, 3, 3)
        )
        model = body.lift(pose, points, link, cost, curvature=Curvature.GAUSS_NEWTON)
        hessian = model.hessian[:, columns][:, :, columns] + damping
        planted[:, columns] -= torch.linalg.solve(hessian, model.gradient[:, columns])
        planted = body.bounds.project(planted)
    return planted


MOTIONS = {
    name: KeyPoses(**table)
    for name, table in tomllib.loads(
        Path(__file__).with_name("motions.toml").read_text(encoding="utf-8")
    ).items()
}
"""The built-in motions."""


def sample_times(num_frames: int, frame_rate: float) -> Float[Tensor, " t"]:
    """Times of frames, seconds.

    Args:
        num_frames: How many.
        frame_rate: Frames per second.

    Raises:
        ConfigurationError: If there is to be no frame.
    """
    if num_frames < 1:
        raise ConfigurationError(f"num_frames must be at least 1, got {num_frames}")
    return torch.arange(num_frames, dtype=torch.float64) / frame_rate

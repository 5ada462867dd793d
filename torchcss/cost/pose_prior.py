"""Pose prior: which poses people take, learnt from motion capture.

One camera often leaves several poses that look alike, and people take some of them far more often
than others. The prior is a density of directions, which mean the same on every skeleton that has
the limbs: of trunk and shoulders and of both legs' segments, in a frame whose axes are the line of
the hips, up along the trunk, and to the front; and of each arm's segments, in a frame with the line
of the shoulders instead. Where it is known which way is up (`Camera.up`), that is a direction of
the legs' group, so that tilts of the body count. Its size, place and heading, twists of limbs,
hands, feet and head do not matter. Trunk, legs and each arm are independent of one another (on
people who were held out that is worth five nats a pose), each group u of directions a mixture

    p(u) = e c + (1 - e) sum_k w_k N(u; m_k, S_k) / Z_k

of Gaussians and a uniform density c, so that no pose of a limb is impossible. `Z_k` is the integral
of a Gaussian over the unit spheres on which directions lie, to the first order: its marginal
density where they have length one. A pose and its mirror image are equally dense. Segments that a
body lacks are left out: the density is then the marginal one. A body without hips and shoulders
gets no prior.

Every frame costs `-log p` (decision "pose prior").

`scripts/learn_pose_prior.py` makes `pose_prior.npz` from motion capture. The data used in this
project was obtained from mocap.cs.cmu.edu; the database was created with funding from NSF
EIA-0196217.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.catalog import without_side
from torchcss.body.model import BodyModel, BodyPose
from torchcss.body.uncertainty import point_jacobian
from torchcss.cost.context import FrameContext
from torchcss.cost.term import OnStates, Term
from torchcss.types import LocalModel, Numbers, frozen
from torchcss.vision.camera import Upright

Each = Float[Tensor, " k"]
"""A number for each Gaussian, and"""
Square = Float[Tensor, "k d d"]
"""a matrix."""

LimbDirections = Float[Tensor, "*batch d"]
"""Directions of a group, three numbers each."""

FILE = Path(__file__).with_name("pose_prior.npz")

_CORNERS = ("l_hip", "r_hip", "l_shoulder", "r_shoulder")

GROUPS: dict[str, tuple[tuple[str, str], ...]] = {
    "trunk": (("hips", "shoulders"), ("r_shoulder", "l_shoulder")),
    "legs": (
        *(("l_hip", "l_knee"), ("r_hip", "r_knee")),
        *(("l_knee", "l_ankle"), ("r_knee", "r_ankle"), ("ground", "sky")),
    ),
    "l_arm": (("l_shoulder", "l_elbow"), ("l_elbow", "l_wrist")),
    "r_arm": (("r_shoulder", "r_elbow"), ("r_elbow", "r_wrist")),
}
"""The ends of the directions of each group; `hips` and `shoulders` are the middles of the two.
From ground to sky is up."""

UP = ("ground", "sky")

UNIFORM_SHARE = 0.05
"""Share e of the uniform density."""

TRUNK = 2
"""Row of the trunk in `Directions.difference`."""

_SHORT = 1e-9
"""Metres of a segment that is too short to have a direction: it gets a shorter vector."""


class Group(NamedTuple):
    """The directions of a group that a body has.

    Attributes:
        name: Of the group.
        known: Which of its directions they are.
        row: Their rows in `Directions.difference`.
        line: The row of the line that their frame lies along: hips or shoulders.
    """

    name: str
    known: tuple[int, ...]
    row: slice
    line: int


class Directions(NamedTuple):
    """The directions that a body has.

    Attributes:
        joint: The joint centres at their ends.
        difference: What takes these points to segments: the lines of hips and shoulders, the trunk,
            and then those of the groups.
        fixed: Those segments that no joint moves, up; zero for the others.
        groups: The groups.
    """

    joint: Int[Tensor, " p"]
    difference: Float[Tensor, "m p"]
    fixed: Float[Tensor, "m 3"]
    groups: tuple[Group, ...]


def directions_of(
    names: tuple[str, ...], like: Tensor, up: tuple[float, float, float] | None = None
) -> Directions | None:
    """The directions among named joint centres; None without hips and shoulders.

    Args:
        names: The joint centres.
        like: Gives type and device.
        up: Which way is up in the world; None: not known.
    """
    if not set(_CORNERS) <= set(names):
        return None
    middle = {place: {f"{s}_{place[:-1]}": 0.5 for s in "lr"} for place in ("hips", "shoulders")}
    known_names = {*names, *middle, *(UP if up is not None else ())}
    ends = [("r_hip", "l_hip"), ("r_shoulder", "l_shoulder"), ("hips", "shoulders")]
    groups = []
    for name, segments in GROUPS.items():
        known = tuple(i for i, pair in enumerate(segments) if set(pair) <= known_names)
        row = slice(len(ends), len(ends) + len(known))
        if known:
            groups.append(Group(name, known, row, int("arm" in name)))
        ends += [segments[i] for i in known]
    moving = [pair for pair in ends if pair != UP]
    points = list(
        dict.fromkeys((*_CORNERS, *(p for pair in moving for p in pair if p not in middle)))
    )
    rows, fixed = like.new_zeros(len(ends), len(points)), like.new_zeros(len(ends), 3)
    for row, still, pair in zip(rows, fixed, ends, strict=True):
        if pair == UP:
            still[:] = still.new_tensor(up)
            continue
        for end, sign in zip(pair, (-1.0, 1.0), strict=True):
            for point, share in middle.get(end, {end: 1.0}).items():
                row[points.index(point)] += sign * share
    joint = torch.tensor([names.index(name) for name in points], device=like.device)
    return Directions(joint, rows, fixed, tuple(groups))


class _Axes(NamedTuple):
    """A frame that the body carries: rows left, up, front, and how long left x trunk is."""

    axes: Float[Tensor, "*batch 3 3"]
    normal: Float[Tensor, "*batch 1"]


def _units(apart: Float[Tensor, "*batch m 3"]) -> tuple[Tensor, Tensor]:
    length = apart.norm(dim=-1, keepdim=True).clamp(min=_SHORT)
    return apart / length, length


def _axes(unit: Float[Tensor, "*batch m 3"], line: int) -> _Axes:
    left = unit[..., line, :]
    front, normal = _units(torch.linalg.cross(left, unit[..., TRUNK, :], dim=-1))
    up = torch.linalg.cross(front, left, dim=-1)
    return _Axes(torch.stack([left, up, front], dim=-2), normal)


def limb_directions(
    joints: Float[Tensor, "*batch j 3"], which: Directions
) -> dict[str, LimbDirections]:
    """The directions of each group of posed bodies in its frame, three numbers each.

    Those of a right arm are mirrored, so that arms are alike.

    Args:
        joints: Joint centres.
        which: The directions that there are.
    """
    unit, _ = _units(which.difference @ joints[..., which.joint, :] + which.fixed)
    frames = [_axes(unit, line).axes for line in (0, 1)]
    return {
        group.name: (
            unit[..., group.row, :] @ frames[group.line].mT * side_of(group.name, unit)
        ).flatten(-2)
        for group in which.groups
    }


def side_of(group: str, like: Tensor) -> Float[Tensor, "3"]:
    """Factors on the axes of a group's frame: a right arm is mirrored."""
    return like.new_tensor([-1.0 if group == "r_arm" else 1.0, 1.0, 1.0])


def direction_slopes(
    body: BodyModel, pose: BodyPose, which: Directions
) -> Iterator[Float[Tensor, "*batch d n"]]:
    """The derivatives of `limb_directions` in the state, group by group.

    Args:
        body: The body.
        pose: Its poses.
        which: The directions that there are.
    """
    points = pose.joints[..., which.joint, :]
    unit, length = _units(which.difference @ points + which.fixed)
    moved = point_jacobian(body, pose.tree, points, body.marker_link[which.joint])
    slope = which.difference @ moved.movedim(-1, -3)
    across = unit[..., None, :, :]
    slope = (slope - (slope * across).sum(-1, keepdim=True) * across) / length[..., None, :, :]
    turns = [_turned(unit, slope, line) for line in (0, 1)]
    for group in which.groups:
        axes, spin = turns[group.line]
        own = across[..., group.row, :].expand_as(slope[..., group.row, :])
        moved = slope[..., group.row, :] - torch.linalg.cross(
            spin[..., None, :].expand_as(own), own, dim=-1
        )
        yield (moved @ axes[..., None, :, :].mT * side_of(group.name, unit)).flatten(-2).mT


def _turned(
    unit: Float[Tensor, "*batch m 3"], slope: Float[Tensor, "*batch n m 3"], line: int
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch n 3"]]:
    """A frame, and how it turns with each parameter."""
    axes, normal = _axes(unit, line)
    moved, trunk = slope[..., line, :], slope[..., TRUNK, :]
    left, up, _ = (axis[..., None, :].expand_as(moved) for axis in axes.unbind(-2))
    # The frame turns about its left by how its front moves against its up.
    front = torch.linalg.cross(moved, unit[..., TRUNK, None, :].expand_as(moved), dim=-1)
    front = front + torch.linalg.cross(left, trunk, dim=-1)
    about = -(up * front).sum(-1, keepdim=True) / normal[..., None, :]
    return axes, torch.linalg.cross(left, moved, dim=-1) + about * left


class PoseMixture(NamedTuple):
    """Gaussians over a group of directions.

    Attributes:
        weight: Their weights.
        mean: Their means m_k.
        covariance: Their covariances S_k.
    """

    weight: Each
    mean: Float[Tensor, "k d"]
    covariance: Square

    def with_mirrored(self, group: str) -> PoseMixture:
        """With their mirror images, at half the weight each; arms have theirs on the other side."""
        if group not in ("trunk", "legs"):
            return self
        covariance = mirrored(mirrored(self.covariance, group).mT, group).mT
        pairs = zip(self, (self.weight, mirrored(self.mean, group), covariance), strict=True)
        both = PoseMixture(*(torch.cat(pair) for pair in pairs))
        return both._replace(weight=0.5 * both.weight)

    def density(self, group: str, known: tuple[int, ...], *, tilt: float = 0.0) -> Density:
        """The density of some of the directions of a group.

        Args:
            group: The group.
            known: Which of its directions.
            tilt: How far off the direction of up may be, radians.
        """
        rows = [3 * direction + axis for direction in known for axis in range(3)]
        mean, covariance = self.mean[:, rows], self.covariance[:, rows][:, :, rows]
        unsure = [tilt**2 * (GROUPS[group][direction] == UP) for direction in known]
        covariance = covariance + covariance.new_tensor(unsure).repeat_interleave(3).diag()
        flat = group == "trunk" and 0 in known
        root = torch.linalg.cholesky(covariance)
        on_spheres = _log_on_spheres(mean, covariance, flat=flat)
        height = _log_peak(root) + self.weight.log() + math.log1p(-UNIFORM_SHARE) - on_spheres
        uniform = math.log(UNIFORM_SHARE) - len(known) * math.log(4 * math.pi)
        uniform += math.log(2) if flat else 0.0  # a circle is half as long as a sphere is large
        return Density(mean, torch.cholesky_inverse(root), height, uniform)


def _log_peak(root: Square) -> Each:
    """Log density of Gaussians at their means, from the roots of their covariances."""
    volume = root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return -volume - 0.5 * root.shape[-1] * math.log(2 * math.pi)


def _log_on_spheres(mean: Float[Tensor, "k d"], covariance: Square, *, flat: bool) -> Each:
    """Log of Z_k: the density of lengths one; if flat, of a first direction without front, too."""
    directions = torch.nn.functional.normalize(mean.unflatten(-1, (-1, 3)), dim=-1)
    across = torch.diag_embed(directions.mT).permute(0, 2, 1, 3).flatten(1, 2)
    wanted = torch.ones_like(across[:, 0])
    if flat:
        front = torch.zeros_like(across[:, :, :1])
        front[:, 2] = 1.0
        across = torch.cat([across, front], dim=-1)
        wanted = torch.cat([wanted, torch.zeros_like(wanted[:, :1])], dim=-1)
    root = torch.linalg.cholesky(across.mT @ covariance @ across)
    away = wanted - (mean[:, None] @ across)[:, 0]
    square = (
        torch.linalg.solve_triangular(root, away[..., None], upper=False).square().sum((-2, -1))
    )
    return _log_peak(root) - 0.5 * square


class Density(NamedTuple):
    """The density of a body's directions of one group, ready to be evaluated many times.

    Attributes:
        mean: Means of the Gaussians.
        precision: Their inverse covariances.
        height: Logarithms of their densities at their means, weights included.
        uniform: Logarithm of the uniform part.
    """

    mean: Float[Tensor, "k d"]
    precision: Square
    height: Each
    uniform: float

    def parts(
        self, directions: LimbDirections
    ) -> tuple[Float[Tensor, "*batch k+1"], Float[Tensor, "*batch k d"]]:
        """Log densities of all parts, the uniform one last, and the pulls of the Gaussians."""
        offset = directions[..., None, :] - self.mean
        pull = torch.einsum("kde,...ke->...kd", self.precision, offset)
        exponent = self.height - 0.5 * (offset * pull).sum(-1)
        tail = exponent.new_full((*exponent.shape[:-1], 1), self.uniform)
        return torch.cat([exponent, tail], dim=-1), pull

    def cost(self, directions: LimbDirections) -> Numbers:
        """`-log p`, nats."""
        return -self.parts(directions)[0].logsumexp(-1)

    def local_model(self, directions: LimbDirections) -> LocalModel:
        """`-log p`, its gradient, and a Hessian without negative directions.

        The Hessian is that of the bound from above that expectation maximisation uses: the mean
        precision of the Gaussians by their shares. The true one is that less the spread of their
        pulls.
        """
        parts, pull = self.parts(directions)
        share = parts.softmax(-1)[..., :-1]
        gradient = (share[..., None] * pull).sum(-2)
        hessian = (share @ self.precision.flatten(1)).unflatten(-1, self.precision.shape[1:])
        return LocalModel(-parts.logsumexp(-1), gradient, hessian)


def mirrored(directions: LimbDirections, group: str) -> LimbDirections:
    """The directions of the mirror image of a pose; of trunk or legs, all of them."""
    each = directions.unflatten(-1, (-1, 3)) * directions.new_tensor([-1.0, 1.0, 1.0])
    if group == "trunk":
        # The line of the shoulders goes from right to left in the image too.
        return torch.cat([each[..., :1, :], -each[..., 1:, :]], dim=-2).flatten(-2)
    return each[..., [1, 0, 3, 2, 4], :].flatten(-2)


@cache
def learnt_mixtures() -> dict[str, PoseMixture]:
    """The mixtures that the package holds by group, mirror images included."""
    found = {}
    with np.load(FILE) as held:
        for group in GROUPS:
            kind = without_side(group)
            numbers = (held[f"{kind}_{field}"].astype(np.float64) for field in PoseMixture._fields)
            found[group] = PoseMixture(*map(torch.from_numpy, numbers)).with_mirrored(group)
    return found


class BodyDensity(NamedTuple):
    """The density of a body's poses.

    Attributes:
        which: Its directions.
        densities: The density of each group of them.
    """

    which: Directions
    densities: dict[str, Density]

    def cost(self, joints: Float[Tensor, "*batch j 3"]) -> Numbers:
        """`-log p` of posed bodies, nats, from their joint centres."""
        directions = limb_directions(joints, self.which)
        costs = [self.densities[group].cost(own) for group, own in directions.items()]
        return torch.stack(costs).sum(0)

    def local_model(self, body: BodyModel, pose: BodyPose) -> LocalModel:
        """`-log p` of posed bodies, and its derivatives in the state; see `Density`."""
        value, gradient, hessian = 0.0, 0.0, 0.0
        directions = limb_directions(pose.joints, self.which).items()
        slopes = direction_slopes(body, pose, self.which)
        for (group, own), slope in zip(directions, slopes, strict=True):
            model = self.densities[group].local_model(own)
            value = value + model.value
            gradient = gradient + (model.gradient[..., None, :] @ slope)[..., 0, :]
            hessian = hessian + slope.mT @ model.hessian @ slope
        return LocalModel(value, gradient, hessian)  # type: ignore[arg-type]


def body_density(body: BodyModel, up: Upright | None = None) -> BodyDensity | None:
    """The density of a body's poses that was learnt; None if it lacks the limbs of a person.

    Args:
        body: The body.
        up: Which way is up; None: not known.
    """
    which = directions_of(body.joint_names, body.tie, up and up.direction)
    if which is None or len(which.joint) == len(_CORNERS):
        return None
    learnt = learnt_mixtures()
    densities = {}
    for group in which.groups:
        mixture = PoseMixture(*(numbers.to(body.tie) for numbers in learnt[group.name]))
        tilt = 0.0 if up is None else up.deviation
        densities[group.name] = mixture.density(group.name, group.known, tilt=tilt)
    return BodyDensity(which, densities)


@cache
def density_where(up: Upright | None) -> Callable[[BodyModel], BodyDensity | None]:
    """`body_density` as what makes a table of a body; the same function for the same up."""
    return partial(body_density, up=up)


@frozen
class PosePrior(Term):
    """The prior on poses that is learnt from motion capture; see the module."""

    name = "pose_prior"
    kind = "prior"
    of_several = True

    def prepare(self, context: FrameContext) -> OnStates | None:
        """Bind the prior to a body; None if it lacks the limbs of a person."""
        density = context.tables.of(density_where(context.camera.up))
        if density is None:
            return None
        return OnStates(
            lambda posed, _: density.local_model(posed.body, posed.pose),
            lambda posed: density.cost(posed.pose.joints),
        )

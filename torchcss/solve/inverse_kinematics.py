"""All joint angles that put a link where it should be: inverse kinematics by covariance scaling.

A pose of a hand seldom has one explanation in the joints, as an image seldom has one in the pose of
a body; so the search is the tracker's (Fig. 6 [IJRR]). The cost is `pose_targets`: zero where the
link is in place. Round after round, samples descend to its minima by the bounded second-order
optimiser; half of the samples are drawn uniformly within the joint limits, half about the solutions
known so far, in their covariances scaled up, that is along the directions which the pose leaves
uncertain; and every new solution is tried with single joints turned by half or whole turns or
mirrored. What descends to the pose is polished by Gauss-Newton steps to machine precision and kept
if it is new. The search ends when several rounds in a row bring nothing new.

**What a solution is.** Six numbers (a place: three) are asked for, so that m joints leave a
redundancy of m less their rank.

* Redundancy 0 (a 6-joint arm, or a 7-joint arm with one joint `fixed`): solutions are isolated
  points, and every one is returned.
* Redundancy 1 (a 7-joint arm): solutions are curves, the self-motion manifolds (Burdick 1989). Each
  is followed along the null vector of the Jacobian until it closes or ends at a joint limit, and
  returned as points along it; `Solutions.branch` numbers the connected pieces within the limits.
* More: fix joints until one at most is redundant.

    body = load_body("panda.urdf")
    found = inverse_kinematics(
        body, "panda_hand", pose, fixed={"panda_joint7": 0.8}, generator=torch.Generator()
    )
    found.x            # all states, within the limits
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import compress
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.body.rotations import check_rotation
from torchcss.cost.targets import pose_targets
from torchcss.errors import ConfigurationError, check_positive, check_shape
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.proposals import CovarianceScaled
from torchcss.inference.trust_region import TrustRegionNewton, default_prior_variance
from torchcss.linalg import inverse_on_free
from torchcss.solve.self_motion import Curve, SolutionSet, States, distance_from
from torchcss.types import Bounds, Numbers, Vectors, frozen

_NEAR = 0.02
"""Metres by which a descent may miss the pose to be worth polishing."""

_DESCENT = TrustRegionNewton(max_steps=20, tolerance=1e-4)
"""What reaches the pose is near it after ten steps; polishing goes on from there."""

_SAME = 1e-3
"""Radians or metres within which two isolated solutions are one."""

_PARENTS = 64
"""Known solutions about which a round samples, at most."""

_STRIDE = 10
"""Spacings between the solutions from which curves are followed together."""


class Solutions(NamedTuple):
    """What was found.

    Attributes:
        x: States of the body within its limits, branch by branch; points of a curve in order.
        branch: Number of the connected set of solutions that each belongs to.
        closed: Of every branch, whether it is a closed curve. Others end at joint limits, or are
            isolated points.
        position_error: How far the link's origin is from its place, metres.
        angle_error: Angle between the link's orientation and that asked for, radians; zero where a
            place alone was asked for.
        num_descents: Samples that descended.
        num_rounds: Rounds of the search.
    """

    x: Float[Tensor, "s n"]
    branch: Int[Tensor, " s"]
    closed: Bool[Tensor, " c"]
    position_error: Float[Tensor, " s"]
    angle_error: Float[Tensor, " s"]
    num_descents: int
    num_rounds: int

    @property
    def num_branches(self) -> int:
        """How many connected sets there are; of isolated solutions, how many solutions."""
        return len(self.closed)


@frozen
class Search:
    """How widely solutions are looked for.

    Attributes:
        num_samples: Descents per round, beside those from turned solutions.
        patience: Rounds without anything new after which the search ends.
        max_rounds: Rounds at most.
        deviation_scale: Factor on the standard deviations of the solutions that are sampled about.
        sigma: Error in metres that counts as one standard deviation there.
        share: Share of the samples that are drawn about known solutions.
        spacing: Distance between the points that a curve is returned as, radians.
        tolerance: Distance from the pose, metres, that a solution must reach; a radian counts as a
            quarter of a metre. In single precision, its rounding.
    """

    num_samples: int = 512
    patience: int = 2
    max_rounds: int = 100
    deviation_scale: float = 8.0
    sigma: float = 0.1
    share: float = 0.5
    spacing: float = 0.1
    tolerance: float = 1e-11

    def __post_init__(self) -> None:
        check_positive(
            self, "num_samples", "patience", "max_rounds", "sigma", "spacing", "tolerance"
        )
        if not 0 <= self.share <= 1:
            raise ConfigurationError(f"Search.share: expected 0 to 1, got {self.share}")


def inverse_kinematics(
    body: BodyModel,
    link: str,
    pose: Float[Tensor, "4 4"] | Float[Tensor, "3"],
    *,
    generator: torch.Generator,
    fixed: Mapping[str, float] | None = None,
    search: Search | None = None,
) -> Solutions:
    """Find all states that give a link its pose.

    Args:
        body: The body on its base; float64 for errors of 1e-11, float32 has some 1e-6.
        link: The link.
        pose: Its frame in the world, or the place of its origin alone, metres. Fewer than six free
            joints reach few frames, and those to `Search.tolerance` alone: give it in float64.
        generator: Source of the samples, on the CPU.
        fixed: Parameters that keep a value. Those that do not move the link rest.
        search: How widely to look.

    Returns:
        The solutions within the joint limits; none if none was found.

    Raises:
        BodyError: If there is no such link or parameter.
        ShapeError: If the pose is neither a frame nor a place.
        ConfigurationError: If the pose is not finite or its orientation no rotation, a fixed value
            is outside its limits, no free joint moves the link, more than one is redundant, or a
            free length has no limits.
    """
    search, pose = search or Search(), _checked_pose(body, pose)
    problem = _Problem.of(body, link, pose, dict(fixed or {}), search)
    found = _Found(problem, isolated=problem.redundancy(generator) == 0)
    quiet = rounds = descents = 0
    known = new = found.points()
    while quiet < search.patience and rounds < search.max_rounds:
        # About points evenly along all that is known.
        parents = known[:: max(1, math.ceil(len(known) / _PARENTS))]
        starts = torch.cat([problem.samples(parents, generator), problem.turned(new)])
        new = found.add(problem.solve(starts))
        known = found.points()
        quiet = 0 if len(new) else quiet + 1
        rounds, descents = rounds + 1, descents + len(starts)
    x = problem.states.cost.whole(problem.states.wrapped(known))
    position, angle = pose_errors(body, link, pose, x)
    return Solutions(x, *found.branches(), position, angle, descents, rounds)


def link_pose(body: BodyModel, link: str, x: Vectors) -> Float[Tensor, "*batch 4 4"]:
    """Frame of a link in the world."""
    return body.forward_kinematics(x)[..., body.tree.link_index(link), :, :]


def pose_errors(
    body: BodyModel,
    link: str,
    pose: Float[Tensor, "4 4"] | Float[Tensor, "3"],
    x: Vectors,
) -> tuple[Numbers, Numbers]:
    """Distance of a link from its place, metres, and angle from its orientation, radians."""
    index, pose = body.tree.link_index(link), pose.to(x)
    tree = body.pose(x).tree
    place = pose[:3, 3] if pose.dim() == 2 else pose
    position = (tree.translation[..., index, :] - place).norm(dim=-1)
    if pose.dim() == 1:
        return position, torch.zeros_like(position)
    # |R - R'| = 2 sqrt(2) sin(angle / 2), exact for small angles too.
    apart = (tree.rotation[..., index, :, :] - pose[:3, :3]).flatten(-2).norm(dim=-1)
    return position, 2 * (apart / 8**0.5).clamp(max=1).asin()


def _checked_pose(body: BodyModel, pose: Tensor) -> Tensor:
    """A pose in the body's type, its orientation freed of the rounding that it came with."""
    check_shape("pose", pose)
    if not bool(pose.isfinite().all()):
        raise ConfigurationError("pose: expected finite numbers")
    pose = pose.to(body.tie, copy=True)
    if pose.shape == (4, 4):
        check_rotation("pose", pose[:3, :3])
        left, _, right = torch.linalg.svd(pose[:3, :3])
        pose[:3, :3] = left @ right
    return pose


class _Problem(NamedTuple):
    """The cost over the free parameters, their limits, and where samples start."""

    states: SolutionSet
    names: list[str]
    lower: Float[Tensor, " m"]
    upper: Float[Tensor, " m"]
    search: Search

    @staticmethod
    def of(
        body: BodyModel, link: str, pose: Tensor, fixed: dict[str, float], search: Search
    ) -> _Problem:
        """Sort out what is free."""
        held = body.rest.clone()
        moves = (body.tree.ancestors[:, body.tree.link_index(link)].to(body.tie) @ body.tie) != 0
        for name, value in fixed.items():
            index = body.state_index(name)
            low, high = float(body.lower[index]), float(body.upper[index])
            if not low <= value <= high:
                raise ConfigurationError(
                    f"fixed {name!r}: expected a value within its limits, {low:g} to {high:g}, "
                    f"got {value:g}"
                )
            held[index], moves[index] = value, False
        columns = torch.nonzero(moves)[:, 0]
        if not len(columns):
            raise ConfigurationError(f"no free parameter of the body moves {link!r}")
        cost = pose_targets(body, link, pose, columns=columns, held=held, sigma=search.sigma)
        bounds = Bounds(body.lower[columns], body.upper[columns])
        endless = ~(bounds.lower.isfinite() & bounds.upper.isfinite())
        names = [body.state_names[int(i)] for i in columns]
        if bool((free := endless & ~body.is_angle[columns]).any()):
            lengths = ", ".join(compress(names, free.tolist()))
            raise ConfigurationError(f"{lengths}: a length without limits; fix it")
        period = 2 * math.pi * endless.to(bounds.lower)
        rounding = 64 * torch.finfo(body.dtype).eps
        return _Problem(
            SolutionSet(cost, bounds, period, max(search.tolerance, rounding)),
            names,
            torch.where(endless, -math.pi, bounds.lower),
            torch.where(endless, math.pi, bounds.upper),
            search,
        )

    def uniform(self, num: int, generator: torch.Generator) -> Float[Tensor, "s m"]:
        """Samples within the limits."""
        share = torch.rand(num, len(self.lower), generator=generator, dtype=torch.float64)
        return self.lower + share.to(self.lower) * (self.upper - self.lower)

    def redundancy(self, generator: torch.Generator) -> int:
        """Free parameters less the rank of the pose in them, at states in general position."""
        _, jacobian = self.states.cost.errors(self.uniform(8, generator))
        rank = int(torch.linalg.matrix_rank(jacobian.flatten(1, 2), rtol=1e-6).max())
        redundancy = len(self.lower) - rank
        if redundancy > 1:
            raise ConfigurationError(
                f"{len(self.lower)} free parameters for a pose of {rank}: expected one more at "
                f"most; fix {redundancy - 1} or more of "
                f"{self.names}"
            )
        return redundancy

    def samples(self, known: States, generator: torch.Generator) -> Tensor:
        """Starts of a round: uniform ones, and some about what is known."""
        num = self.search.num_samples
        about = round(self.search.share * num) if len(known) else 0
        uniform = self.uniform(num - about, generator)
        if not about:
            return uniform
        hessian = self.states.cost.local_model(known).hessian
        free = torch.ones_like(known, dtype=torch.bool)
        covariance = inverse_on_free(
            hessian, free, default_prior_variance(Bounds(self.lower, self.upper))
        )
        proposal = CovarianceScaled(
            deviation_scale=self.search.deviation_scale, include_modes=False, stratified=True
        )
        mixture = GaussianMixture(known, covariance, torch.zeros_like(known[:, 0]))
        drawn = proposal.sample(mixture, about, self.states.bounds, generator=generator).x
        return torch.cat([uniform, drawn])

    def turned(self, x: States) -> Float[Tensor, "s m"]:
        """Solutions with one joint turned by half or whole turns, or mirrored in its range."""
        eye = torch.eye(len(self.lower), dtype=x.dtype, device=x.device)
        steps = torch.cat([k * math.pi * eye for k in (-2, -1, 1, 2)])
        turned = (x[:, None] + steps).flatten(0, 1)
        inside = ((turned >= self.lower) & (turned <= self.upper)).all(-1)
        mirrored = x[:, None] + eye * (self.lower + self.upper - 2 * x)[:, None]
        return torch.cat([turned[inside], mirrored.flatten(0, 1)])

    def solve(self, starts: Float[Tensor, "s m"]) -> States:
        """Descend and polish; what reaches the pose."""
        modes = _DESCENT.minimise(self.states.cost, starts, self.states.bounds)
        near = modes.cost <= 0.5 * (_NEAR / self.search.sigma) ** 2
        x, exact = self.states.polish(modes.mean[near])
        return self.states.wrapped(x[exact])


class _Found:
    """Connected sets of solutions found so far: curves, or isolated points as curves of one point.

    Args:
        problem: What is solved.
        isolated: Whether all solutions are isolated.
    """

    def __init__(self, problem: _Problem, *, isolated: bool) -> None:
        self.states, self.spacing, self.isolated = problem.states, problem.search.spacing, isolated
        self.curves: list[Curve] = []

    def add(self, x: States) -> Float[Tensor, "a m"]:
        """Take in solutions; returns one of each new set."""
        for curve in self.curves:
            x = x[~self._on(curve, x)]
        fresh = []
        while len(x):
            # Widely spaced ones first: most of them are of a few curves.
            some = x[:1] if self.isolated else _thinned(self.states, x, _STRIDE * self.spacing)
            curves = [Curve(some, False)]
            if not self.isolated:
                curves = self.states.follow(some, self.spacing)
            for start, curve in zip(some, curves, strict=True):
                same = (x == start).all(-1)
                if bool(same.any()):  # else another curve of this round passes there
                    self.curves.append(curve)
                    fresh.append(start)
                    x = x[~(same | self._on(curve, x))]
        return torch.stack(fresh) if fresh else x

    def _on(self, curve: Curve, x: States) -> Bool[Tensor, " k"]:
        """Which states are one with an isolated solution, or lie on a curve."""
        near = _SAME if self.isolated else 0.25 * self.spacing
        return distance_from(curve, x, self.states.period) <= near

    def points(self) -> Float[Tensor, "s m"]:
        """Points along all sets, one after the other."""
        none = self.states.period.new_zeros(0, len(self.states.period))
        return torch.cat([none, *(curve.x for curve in self.curves)])

    def branches(self) -> tuple[Int[Tensor, " s"], Bool[Tensor, " c"]]:
        """The set that each point belongs to, and which sets are closed curves."""
        device = self.states.period.device
        sizes = torch.tensor([len(curve.x) for curve in self.curves], device=device).long()
        closed = torch.tensor([curve.closed for curve in self.curves], device=device).bool()
        return torch.arange(len(sizes), device=device).repeat_interleave(sizes), closed


def _thinned(states: SolutionSet, x: States, distance: float) -> Float[Tensor, "a m"]:
    """A choice of states, none nearer to another than a distance."""
    chosen = []
    while len(x):
        chosen.append(x[0])
        x = x[states.apart(x, x[0]).norm(dim=-1) > distance]
    return torch.stack(chosen)

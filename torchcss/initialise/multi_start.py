"""All the poses that explain the joints of one image: the many starts of the first stage.

Thousands of poses explain one image of joint centres (section 1 [IJRR]). They are found from many
starts in three batches, every descent bound by the joint limits:

1. *Around the vertical.* Poses about the stabilisers' rest, turned through the full circle, descend
   with the scale of the keypoints widened 16 times and then 4 times: nearly every start arrives,
   where at the true scale most of them would treat half of the joints as outliers and stay.
2. *Flips.* For the best few trunks, the trunk, the line of the hips and that of the shoulders lean
   the other way in all combinations, and the segments of every limb do in theirs (Lee and Chen
   1985; `torchcss.body.flips`). The angles that put the joints there are solved for in 3D. Limbs
   hang on the trunk separately, so that their costs add: 4 descents per trunk tell the cost of all
   4^4 combinations of limbs, of which the best are kept.
3. *Covariance-scaled samples* of the best fits so far, as the tracker draws them.

A detector's joints in space, where there are any, are one more start
(`torchcss.initialise.from_points`). All of these descend once more, at four times and at the true
scale of the keypoints.

Call `multi_start_fits`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcss.body.catalog import PLACES, PROPORTIONS, Proportions, without_side
from torchcss.body.flips import Segments
from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES, has_root, unwound
from torchcss.body.rotations import within_half_turn
from torchcss.cost.anthropometric import proportion_columns
from torchcss.cost.joints import JointTerm
from torchcss.cost.targets import PointTargets
from torchcss.cost.total import TrackingCost
from torchcss.errors import ConfigurationError, KeypointError, check_positive, check_range
from torchcss.inference.mixture import GaussianMixture, cheapest_first, distinct_modes
from torchcss.inference.proposals import CovarianceScaled
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.initialise.from_points import start_from_points
from torchcss.types import Bounds, Modes, Numbers, Vectors, frozen

_WIDE, _MIDDLE = 16.0, 4.0
"""Factors on the keypoints' scale: a random start is off by some hundred pixels, of which the
robust potential pulls those within three scales."""

_SAME_TRUNK = 0.06
"""Mean distance of the trunk's joints, metres, below which two trunks count as one."""

_ON_PLACE = 0.01
"""Standard deviation of a joint's place after a flip, metres."""

_SAME_ANGLE = 0.05
"""Radians within which two flips of a limb count as one: a joint limit, or a line of sight that
passes beside the limb's reach, left no other."""


@frozen
class StartSearch:
    """How widely poses are looked for.

    Attributes:
        num_starts: Starting poses around the vertical.
        num_trunks: Distinct trunks whose flips are enumerated.
        num_flips: Most combinations of flips to descend from; 0 for none.
        num_samples: Covariance-scaled samples to descend from.
        covariance_scale: Factor on their covariance.
        limits: Hold the joint limits (False only for comparison).
        anneal: Widen the keypoints' scale at first (False only for comparison).
        leave_out: Leave keypoints out that fit no pose (False only for comparison); see
            `torchcss.initialise.outliers`.
        max_steps: Iterations of the last descent.
        proportions: Which lengths and places are fitted, all lengths by default; the others stay
            the standard humanoid's.
        coarse_pose: The first start, radians by parameter; the others are at rest (`sticky_mean`).
        turn: Turn the first start about the vertical to where the keypoints cost least, unless it
            says `root_yaw`.
    """

    num_starts: int = 64
    num_trunks: int = 6
    num_flips: int = 192
    num_samples: int = 64
    covariance_scale: float = 8.0
    limits: bool = True
    anneal: bool = True
    leave_out: bool = True
    max_steps: int = 40
    proportions: tuple[str, ...] = PROPORTIONS
    coarse_pose: Mapping[str, float] = field(default_factory=dict)
    turn: bool = False

    def __post_init__(self) -> None:
        check_range(self, "num_starts", "num_trunks", "max_steps", least=1)
        check_range(self, "num_flips", "num_samples")
        check_positive(self, "covariance_scale", finite=True)
        known = (*PROPORTIONS, *PLACES)
        if unknown := sorted(set(self.proportions) - set(known)):
            raise ConfigurationError(
                f"StartSearch.proportions: unknown {', '.join(unknown)}; there are "
                f"{', '.join(known)}"
            )

    @property
    def parameters(self) -> Proportions:
        """What the body that is fitted has as parameters: no places if none are fitted."""
        return self.proportions if set(self.proportions) & set(PLACES) else True

    def bounds(self, body: BodyModel) -> Bounds:
        """The joint limits; only the lengths' without `limits`."""
        columns = proportion_columns(body)
        lower, upper = body.lower.clone(), body.upper.clone()
        if not self.limits:
            angle = torch.ones_like(lower, dtype=torch.bool)
            angle[list(columns.values())] = False
            lower[angle], upper[angle] = -math.inf, math.inf
        held = [k for name, k in columns.items() if without_side(name) not in self.proportions]
        lower[held] = upper[held] = 0.0
        return Bounds(lower, upper)


PAPER_PROPORTIONS = ("hip_width", "head", *PLACES)
"""The papers' eight internal proportions, x_i of section 2 [IJRR]: three of the hip joint, three of
the clavicle and two of the skull's tip, which is on the midline; left and right are one."""

PAPER_LENGTHS = (*PAPER_PROPORTIONS, "trunk", "upper_arm", "forearm", "thigh", "shank")
"""What the first stage of section 5 [IJRR] fits: x_i, and the sizes of parts as lengths of bones.
Shoulder width and neck stay the standard humanoid's."""

SINGLE_START = StartSearch(
    num_starts=1, num_flips=0, num_samples=0, anneal=False, leave_out=False, max_steps=100
)
"""One descent from the rest pose: what a local fit without search does."""

PAPERS = replace(SINGLE_START, turn=True, proportions=PAPER_LENGTHS)
"""Section 5 [IJRR]: one descent from a coarse pose, else from rest, turned as the joints say."""

_TURNS = 8
"""Directions that a turned start is looked for in."""


def multi_start_fits(
    cost: TrackingCost, *, search: StartSearch, generator: torch.Generator
) -> Modes:
    """Descend from many starts to the minima of a cost of keypoints.

    Args:
        cost: Keypoints and priors of one image; its body hangs before the camera.
        search: How widely to look.
        generator: Source of the starts.

    Returns:
        The ends of all descents, in no order and with duplicates (see `distinct_modes`).

    Raises:
        KeypointError: If no pose has a finite cost.
    """
    body = cost.body
    bounds = search.bounds(body)
    first = starts_about(body, search.num_starts, generator)
    first[:1] = _coarse_start(cost, first[:1], search)
    fits = descend_widened(
        cost, first, bounds,
        ((_WIDE, 12), (_MIDDLE, 12)) if search.anneal else (),
    )  # fmt: skip
    starts = [fits]
    if (keypoints := cost.views[0].keypoints) is not None:
        turned = first[:: max(1, len(first) // _TURNS)]
        starts.append(start_from_points(body, cost.camera, keypoints, turned, bounds))
    if search.num_flips and (segments := Segments(body)).limbs:
        trunks = _distinct_trunks(cost, segments, torch.cat(starts), search.num_trunks)
        starts.append(flips(cost, segments, trunks, bounds, search.num_flips))
    if search.num_samples or search.anneal:
        modes = optimise(widened(cost, _MIDDLE), fits, bounds, 2)
        keep = distinct_modes(modes.mean, modes.covariance, modes.cost)[:16]
        starts[0] = modes.mean[keep]
        if search.num_samples and len(keep):
            # Weights flattened, so that samples do not all go to one of many near-equal fits.
            mixture = GaussianMixture(
                modes.mean[keep], modes.covariance[keep], -0.25 * modes.cost[keep]
            )
            proposal = CovarianceScaled(covariance_scale=search.covariance_scale)
            samples = proposal.sample(mixture, search.num_samples, bounds, generator=generator)
            starts.append(samples.x)
    x = descend_widened(cost, torch.cat(starts), bounds, ((_MIDDLE, 10),) if search.anneal else ())
    fits = optimise(cost, x, bounds, search.max_steps)
    if not bool(fits.cost.isfinite().any()):
        raise KeypointError(
            "no pose has a finite cost: expected keypoints, their noise and the camera's focal "
            "length in pixels of this picture"
        )
    return fits


def optimise(
    cost: TrackingCost, x: Vectors, bounds: Bounds, steps: int, *, tolerance: float = 1e-2
) -> Modes:
    """Descend to a hundredth of a nat, which tells fits apart, in so many steps at the most."""
    fits = TrustRegionNewton(max_steps=steps, tolerance=tolerance).minimise(cost, x, bounds)
    return fits._replace(mean=unwound(cost.body, fits.mean))


def descend_widened(
    cost: TrackingCost, x: Tensor, bounds: Bounds, schedule: tuple[tuple[float, int], ...]
) -> Tensor:
    """Descend with the keypoints' scale widened by each factor in turn.

    Args:
        cost: The joints' cost.
        x: Where to start.
        bounds: Box limits.
        schedule: Factors on the scale, and the most steps with each.
    """
    for factor, steps in schedule:
        x = optimise(widened(cost, factor), x, bounds, steps).mean
    return x


def widened(cost: TrackingCost, factor: float) -> TrackingCost:
    """A cost with the scale of its keypoints multiplied by a factor."""
    joints = cost.choice.find(JointTerm)
    wide = replace(joints, sigma=factor * joints.sigma)
    return replace(cost, choice=cost.choice.having(wide))


def starts_about(body: BodyModel, num: int, generator: torch.Generator) -> Vectors:
    """Poses all around the vertical, spread about the stabilisers' rest; the first at rest."""
    size = (num, body.num_parameters)
    noise = torch.randn(size, generator=generator, dtype=torch.float64).to(body.tie)
    noise[0] = 0.0
    spread = torch.where(body.sticky_deviation.isfinite(), body.sticky_deviation, 0.3)
    x = body.sticky_mean + 0.6 * spread * noise
    if has_root(body):
        columns = body.state_columns(ROOT_NAMES)
        x[:, columns] = 0.1 * noise[:, columns]
        x[:, body.state_index("root_yaw")] = _all_round(x)
    return body.bounds.project(x)


def _all_round(x: Vectors) -> Numbers:
    """As many angles as there are states, evenly round the circle from zero."""
    turn = torch.arange(len(x), device=x.device).to(x) * (2 * math.pi / len(x))
    return within_half_turn(turn)


def _coarse_start(cost: TrackingCost, x: Vectors, search: StartSearch) -> Vectors:
    """A start with the parameters of the coarse pose, turned as the keypoints say."""
    body, x = cost.body, x.clone()
    for name, value in search.coarse_pose.items():
        x[:, body.state_index(name)] = value
    if search.turn and has_root(body) and "root_yaw" not in search.coarse_pose:
        x = x.repeat(_TURNS, 1)
        x[:, body.state_index("root_yaw")] = _all_round(x)
        x = x[widened(cost, _WIDE).value(x).argmin()][None]
    return body.bounds.project(x)


def _distinct_trunks(cost: TrackingCost, segments: Segments, x: Vectors, num: int) -> Vectors:
    """The best fits whose trunks differ."""
    value = widened(cost, _MIDDLE).value(x).nan_to_num(math.inf)
    order = value.argsort(stable=True)
    limb = {group for each in segments.limbs for group in each.groups}
    trunk = [j for j, name in enumerate(cost.body.joint_names) if name not in limb]
    joints = cost.body.pose(x).joints[:, trunk]
    kept: list[int] = []
    for item in order.tolist():
        apart = (joints[kept] - joints[item]).norm(dim=-1).mean(-1)
        if bool((apart > _SAME_TRUNK).all()):
            kept.append(item)
        if len(kept) == num:
            break
    return x[kept]


def flips(
    cost: TrackingCost, segments: Segments, x: Vectors, bounds: Bounds, num: int, steps: int = 15
) -> Vectors:
    """The best combinations of forward-backward flips of some poses, their angles solved for.

    Args:
        cost: The joints' cost.
        segments: The limbs and the trunk's parts that lean one way or the other.
        x: The poses.
        bounds: Box limits.
        num: How many states to return, at the most.
        steps: How long each is looked for.
    """
    body, device = cost.body, x.device
    ways = [all_ways(len(segments.trunk), device), all_ways(segments.depth, device)]
    flipped = torch.zeros(
        len(ways[0]), len(ways[1]), len(segments.groups), dtype=torch.bool, device=device
    )
    for bit, group in enumerate(segments.trunk):
        flipped[:, :, segments.groups.index(group)] = ways[0][:, None, bit]
    for limb in segments.limbs:
        for bit, group in enumerate(limb.groups[: segments.depth]):
            flipped[:, :, segments.groups.index(group)] = ways[1][None, :, bit]
    shape = (len(x), *flipped.shape[:2])
    joints = body.pose(x).joints[:, None, None].expand(*shape, -1, 3)
    target = segments.flip(joints, flipped.expand(*shape, -1), cost.camera.centre_world)
    start = x[:, None, None].expand(*shape, -1).flatten(0, 2)
    solved = place_joints(body, segments, target.flatten(0, 2), start, bounds, steps=steps)
    return _best_combinations(
        widened(cost, 1.5 * _MIDDLE), segments, solved.unflatten(0, (-1, len(ways[1]))), num
    )


def place_joints(
    body: BodyModel,
    segments: Segments,
    target: Float[Tensor, "s m 3"],
    start: Float[Tensor, "s n"],
    bounds: Bounds,
    *,
    steps: int,
) -> Float[Tensor, "s n"]:
    """The states that put the joints of the segments at given places, as far as bounds allow.

    Args:
        body: The body.
        segments: Its segments.
        target: Where their joints shall be, metres.
        start: Where to start from.
        bounds: Box limits.
        steps: How long each is looked for.
    """
    cost = PointTargets(
        body=body,
        link=body.marker_link[segments.joint],
        offset=body.marker_offset[segments.joint],
        target=target,
        sigma=target.new_full(target.shape[1:2], _ON_PLACE),
    ).compiled()
    return TrustRegionNewton(max_steps=steps, tolerance=0.1).ends(cost, start, bounds)


def all_ways(bits: int, device: torch.device) -> Bool[Tensor, "w b"]:
    """Every combination of so many truths, none of them first."""
    rows = list(itertools.product((False, True), repeat=bits))
    return torch.tensor(rows, dtype=torch.bool, device=device).reshape(len(rows), bits)


def _best_combinations(
    cost: TrackingCost, segments: Segments, x: Float[Tensor, "t w n"], num: int
) -> Float[Tensor, "s n"]:
    """Combine the ways of all limbs, each limb's cost added to its trunk's; keep the best.

    Args:
        cost: By which poses are judged.
        segments: The segments of its body.
        x: Poses: `t` trunks, each with its limbs in `w` ways.
        num: How many combinations to keep.
    """
    num_ways, limbs = x.shape[1], segments.limbs
    # Each limb in each of its ways on the trunk with all other limbs in their first.
    mixed = x[:, None, :1].repeat(1, len(limbs), num_ways, 1)
    again = torch.zeros(mixed.shape[:-1], dtype=torch.bool, device=x.device)
    for number, limb in enumerate(limbs):
        angles = x[:, :, limb.columns]
        mixed[:, number, :, limb.columns] = angles
        apart = (angles[:, :, None] - angles[:, None]).abs().amax(-1) < _SAME_ANGLE
        again[:, number] = apart.tril(-1).any(-1)
    value = cost.value(mixed)
    base = value[:, 0, 0]
    extra = torch.where(again, math.inf, value - base[:, None, None])
    combinations = torch.tensor(
        list(itertools.product(range(num_ways), repeat=len(limbs))), device=x.device
    )
    total = base[:, None].expand(-1, len(combinations))
    for number in range(len(limbs)):
        total = total + extra[:, number, combinations[:, number]]
    flat = total.flatten().nan_to_num(math.inf)
    best = cheapest_first(flat)[:num]
    trunk, chosen = best // len(combinations), combinations[best % len(combinations)]
    poses = x[trunk, 0].clone()
    for number, limb in enumerate(limbs):
        poses[:, limb.columns] = x[trunk, chosen[:, number]][:, limb.columns]
    return poses

"""An arm for which the picture does not speak is looked for elsewhere.

An arm that moves faster than flow and edges follow is left behind, on clutter that has edges too.
What tells is colour: with the arm where it is, the body looks no more like itself than without an
arm. But `segmentation`, which knows, has no derivatives, and samples about the mode, in all
directions at once, do not reach what one limb has done meanwhile. So before a frame is searched,
each arm of the best mode is asked whether its colours speak for it where it is expected
(`astray_limbs`). One for which they do not is put into other poses, all else as expected, and those
that cost least, and in which it explains something, are proposed (`LostLimbs`). The image decides
what remains: it is a move as in `torchcss.tracking.flip_moves`, for another reason.

An arm that is hidden, or out of the picture, explains nothing either; it is found when it comes out
elsewhere than expected. Legs are left alone. Arms swing, but legs stand: where one is astray, the
body has turned or gone, and a leg put elsewhere explains what the trunk has left uncovered.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from torchcss.body.flips import Limb, Segments
from torchcss.body.model import BodyModel
from torchcss.body.shape import with_shape
from torchcss.cost.total import TrackingCost
from torchcss.inference.mixture import GaussianMixture, Prior, separated
from torchcss.inference.proposals import Move
from torchcss.tracking.flip_moves import POSES_APART
from torchcss.types import Bounds, Vector, Vectors, frozen

REACH = 0.2
"""Seconds of everyday motion within which, as a standard deviation, an arm is looked for."""

DRAWN = 128
"""Poses of an arm that are looked at."""

GAIN = 5.0
"""What an arm's colours have to be worth, against the same body without the arm, and by how much
less a pose has to cost to join the search; nats."""

_SWINGING = ("arm",)
"""Which limbs are looked for."""


@frozen
class LostLimbs(Move):
    """Other poses of the arms of the best mode that are astray; see `Move` for their samples.

    Attributes:
        search: How samples of each pose are drawn.
        log_odds: Weight of a pose against that of the best mode, nats.
        body: The body on this frame's base.
        cost: The cost of the frame, of any modes. Without `segmentation` nothing is found.
        num: Most poses wanted of each arm.
    """

    body: BodyModel
    cost: TrackingCost
    num: int

    def states(self, best: GaussianMixture, bounds: Bounds) -> Vectors:
        """The best mode as it is expected, but for one arm."""
        expected, found = bounds.project(best.mean[0]), [best.mean[:0]]
        for limb in astray_limbs(self.cost, self.body, expected):
            poses = other_poses(
                self.cost, self.body, expected, limb, bounds, prior=best, num=self.num
            )
            moved = best.mean.repeat(len(poses), 1)
            moved[:, limb.columns] = poses[:, limb.columns]
            found.append(moved)
        return torch.cat(found)


def astray_limbs(cost: TrackingCost, body: BodyModel, x: Vector) -> list[Limb]:
    """The arms with which the body looks hardly more like itself than without: by less than `GAIN`.

    Args:
        cost: The cost of a frame; none are astray where it does not know `segmentation`.
        body: The body on this frame's base.
        x: A pose.
    """
    if not cost.weighs:
        return []
    arms = (limb for limb in Segments(body).limbs if limb.name.endswith(_SWINGING))
    looks = float(cost.weight_only(x))
    return [arm for arm in arms if looks > _without(cost, body, arm, x) - GAIN]


def other_poses(
    cost: TrackingCost,
    body: BodyModel,
    x: Vector,
    limb: Limb,
    bounds: Bounds,
    *,
    prior: GaussianMixture,
    num: int,
) -> Vectors:
    """Poses with one limb elsewhere that cost less, the best first.

    They are of a low-discrepancy sequence (Sobol), so that nothing is random. What they cost is all
    that the frame knows but flow and the past, which were wrong about this limb, and half the
    squared distance in units of `REACH`. It has to be less by `GAIN` than that of the pose given;
    and the colours have to speak for the limb, by `GAIN` as well: one that is put before a shirt of
    its own colour, or out of the picture, is out of the way, and not found.

    Args:
        cost: The cost of the frame, of any modes.
        body: The body on this frame's base.
        x: The pose from which to look.
        limb: The limb.
        bounds: Limits of the state.
        prior: The mode that x is the mean of.
        num: Most poses wanted.
    """
    columns = limb.columns
    # The first point is the corner of the cube.
    share = torch.quasirandom.SobolEngine(len(columns)).draw(DRAWN + 1, dtype=x.dtype)[1:]
    deviation = REACH * body.motion_rate[columns]
    drawn = x.repeat(DRAWN, 1)
    drawn[:, columns] += torch.special.ndtri(share.to(x)) * deviation
    drawn = bounds.project(drawn)
    every = torch.cat([x[None], drawn])
    choice = cost.choice.without("flow", "temporal", "temporal_mixture")
    of_mode = replace(cost, choice=choice).of_children(
        every.new_zeros(len(every)).long(), Prior.of(prior)
    )
    colours = cost.weight_only(every)
    apart = (every - x)[:, columns] / deviation
    value = of_mode.value(every) + colours + 0.5 * apart.square().sum(-1)
    speak = colours < _without(cost, body, limb, x) - GAIN
    better = (value < value[0] - GAIN) & speak
    order = value.argsort(stable=True)
    order = order[better[order]]
    joints = body.pose(every).joints[order]
    return every[order[separated(joints, POSES_APART, num, fill=False)]]


def _without(cost: TrackingCost, body: BodyModel, limb: Limb, x: Vector) -> float:
    """What the colours cost with a limb so thin that it covers nothing, nats."""
    ancestors = body.tree.ancestors
    hung = ancestors[:, body.marker_link[body.joint_index(limb.joint)]]
    beyond = (ancestors[:, body.part_link] >= hung[:, None]).all(0)
    shape = body.part_shape.clone()
    shape[beyond, :3] = 1e-3
    return float(cost.weight_only(x, body=with_shape(body, shape)))

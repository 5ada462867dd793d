"""Motion capture onto a body of the catalogue, by its joint centres.

Two skeletons that stand alike have different angles, but the same places for hips, knees, ankles,
shoulders, elbows and wrists. A body is therefore fitted to where these are, frame by frame:

1. *Lengths*, from the median distances between neighbouring joints, left and right alike, within 10
   % of the standard humanoid (section 3.2.3 [IJRR]). Where that holds a length, the joints keep
   their directions and take the body's: else narrow shoulders, which many skeletons of recordings
   have, would be clavicles bent back to their limits.
2. *States*, from several starting poses per frame, all in one batch of the bound-constrained
   search of section 4.1 [IJRR]: squared distances in space and the sticky prior of section 3.2.2
   on what the joints do not tell (the twist of a straight arm).
3. *One path* through the poses found in every frame, that of least cost and motion, and
4. *all frames together*: states, limits and accelerations, parts kept apart (section 3.2.4
   [IJRR]); both by `torchcss.inference.smoothing`. What the joints tell stays, to less than one
   millimetre on a known motion (tested); what they do not tell, the frames before and after do.

Joint limits hold exactly throughout; only the turns of the root, which have no anatomical limit,
may exceed the body's while fitting, so that many turns in a row are one continuous path.

Limbs alone leave the tilt of pelvis and feet and the head open. If the zero pose of the source is
upright and faces +Z, as ours does, then other joints of its tree (the root, the base of the neck,
those of head and feet) have known places in our pelvis, chest, head and feet, and are fitted too,
less strictly.

Call `retarget`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, replace
from itertools import compress
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from torchcss.body.catalog import ARM_NAMES, BODY_NAMES, LENGTHS, PROPORTION_RANGE
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES, free_turns
from torchcss.body.rotations import root_angles, root_rotation
from torchcss.cost.interpenetration import Interpenetration, InterpenetrationPairs
from torchcss.cost.penetration import Penetration, PenetrationDepth
from torchcss.cost.targets import PointTargets
from torchcss.errors import ConfigurationError, check_positive
from torchcss.inference.smoothing import Refinement, Transition, best_path, refine
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.io.motion.positions import MotionCapture, limb_positions
from torchcss.types import Trajectory, frozen

_STERNOCLAVICULAR = 0.03
"""Metres from the midline to where the body's shoulder width begins."""
_TOE_DEPTH = 0.05
"""Metres from the height of the ankle down to the toe, at rest."""
_ABOVE = {
    "elbow": ("shoulder", "upper_arm"),
    "wrist": ("elbow", "forearm"),
    "knee": ("hip", "thigh"),
    "ankle": ("knee", "shank"),
}
"""The joint above each of a limb's, and the length between them."""
_UPRIGHT = math.cos(math.radians(30))
_STEEP = math.radians(75)
"""Pitch of the root from which yaw and roll begin to be the same turn."""
_NEAR = 0.25
"""Metres between the middle of hips or shoulders and the joint that carries them, at most."""
_ON_FLOOR = 0.05
"""Share of frames in which the lowest foot may be below the floor: in most others one stands."""
_LEAST_PATH = 1.0
"""Metres of a path that tell the slope of its floor."""
_LEAST_TILT, _MOST_TILT = 0.2, 4.0
"""Degrees of a floor that is not level by mistake."""
_SLACK = 1e-6
"""Radians or metres from a limit at which it holds an angle."""
_DEEP = 0.01
"""Metres that a surface must be inside another part to count as a collision."""

LimbPlaces = Float[Tensor, "t limbs 3"]
"""Joint centres of the limbs, frame by frame, metres."""


@frozen
class Retargeting:
    """How a body is fitted to joint centres.

    Attributes:
        sigma: Standard deviation of a limb's joint, metres: what two skeletons differ by.
        sigma_others: The same for the other joints that are used.
        num_starts: Starting poses per frame.
        settling_s: Seconds in which everyday speed (`BodyModel.motion_rate`) is reached or lost:
            the scale of accelerations; larger is smoother.
        repulsion: What keeps parts apart, or None: a source of other proportions has its
            arms where our trunk is. `scripts/retarget.py` tells how deep parts end up in others.
        max_steps: Iterations of a descent.
    """

    sigma: float = 0.005
    sigma_others: float = 0.03
    num_starts: int = 4
    settling_s: float = 0.06
    repulsion: Interpenetration | None = field(
        default_factory=lambda: Interpenetration(weight=100, sharpness=5)
    )
    max_steps: int = 60

    def __post_init__(self) -> None:
        names = ("sigma", "sigma_others", "num_starts", "settling_s", "max_steps")
        check_positive(self, *names, finite=True)


class Retargeted(NamedTuple):
    """A body in motion, and how well it follows.

    Attributes:
        body: The body, its base upright on the floor, facing the middle of its turns.
        states: Its states, within its limits unless the report says otherwise.
        joints: Its joint centres, `BodyModel.joint_names`, metres.
        target_names: The limbs' joints that were followed.
        targets: Where they shall be: where the source has them, with the body's lengths.
        source: All joints of the source, in the same world.
        error: Distances between body and targets, metres.
        at_limit: Angles that a limit holds.
        depth: How deep one part is inside another, metres; 0 if nowhere.
        report: What was found, one line each.
    """

    body: BodyModel
    states: Trajectory
    joints: Float[Tensor, "t j 3"]
    target_names: tuple[str, ...]
    targets: LimbPlaces
    source: Float[Tensor, "t k 3"]
    error: Float[Tensor, "t limbs"]
    at_limit: Bool[Tensor, "t n"]
    depth: Float[Tensor, " t"]
    report: tuple[str, ...]


def retarget(
    motion: MotionCapture,
    *,
    body: str = "body34",
    generator: torch.Generator,
    choice: Retargeting | None = None,
    centred: bool = True,
) -> Retargeted:
    """Fit a body to a motion.

    Args:
        motion: The motion, Y up, at the rate that the result is to have.
        body: Name of a body with a root.
        generator: Source of the starting poses.
        choice: How; the defaults suit everyday motion of adults.
        centred: Move the middle of the path over the origin and the floor to height zero, and level
            it where the recording has it tilted by a degree or two.

    Raises:
        ConfigurationError: If the body has no root.
        MotionCaptureError: If the motion lacks hips or shoulders.
    """
    choice = choice or Retargeting()
    names, index, _ = limb_positions(motion)
    limb = list(index)
    whole = [name for name in BODY_NAMES if name not in ARM_NAMES]
    if body not in whole:
        raise ConfigurationError(f"body: expected one of {', '.join(whole)}, got {body!r}")
    source, level = torch.from_numpy(motion.joints).clone(), []
    if centred:
        hips = _places(names, source[:, limb])["hips"]
        # The middle of their path comes to stand over the origin.
        source -= 0.5 * (hips.amax(0) + hips.amin(0)) * hips.new_tensor([1, 0, 1])
        source, level = levelled(source, source[:, limb].mean(1))
    lengths, report = fit_lengths(names, source[:, limb], foot=_foot_length(motion, names, index))
    model = load_body(body, lengths=lengths)
    others, line = _anchored(motion, model, names, index)
    report += [*level, line]
    limbs = limbs_with_lengths(names, source[:, limb], lengths)
    followed = [*limbs.unbind(1), *(source[:, other.joint] for other in others)]
    cost = _cost(model, names, torch.stack(followed, 1), others, choice)
    root = _root_by_trunk(names, source[:, limb])
    states = _fit(cost, root, motion.frame_rate, choice, generator)
    model, states = _face_middle(model, states)
    if centred:
        feet = [model.joint_index(f"{side}_{end}") for side in "lr" for end in ("heel", "toe")]
        floor = model.pose(states).joints[:, feet, 1].amin(-1).quantile(_ON_FLOOR)
        drop = -floor * floor.new_tensor([0.0, 1.0, 0.0])
        model = model.with_base(model.base_rotation, drop)
        source, limbs = source + drop, limbs + drop
    joints = model.pose(states).joints
    columns = model.joint_columns(names)
    at_limit = (states <= model.lower + _SLACK) | (states >= model.upper - _SLACK)
    inside = PenetrationDepth(model)(model, states)
    report += _findings(model, states, at_limit, inside)
    error = (joints[:, columns] - limbs).norm(dim=-1)
    return Retargeted(
        model, states, joints, names, limbs, source, error, at_limit, inside.depth, tuple(report)
    )


def fit_lengths(
    names: tuple[str, ...], limbs: LimbPlaces, *, foot: float | None = None
) -> tuple[dict[str, float], list[str]]:
    """Lengths of the catalogue from joint centres.

    Args:
        names: Names of the limbs' joints.
        limbs: Their positions, metres.
        foot: Metres from ankle to toe, where known.

    Returns:
        Lengths in metres, and a line about those that the range of proportions holds. What no joint
        tells grows with the rest: neck, head and hand.
    """
    known = _measured(names, limbs)
    if foot is not None:
        known["foot"] = max(foot**2 - _TOE_DEPTH**2, 0.0) ** 0.5
    factor = sum(known.values()) / sum(LENGTHS[name] for name in known)
    lengths, held = {}, []
    for name, standard in LENGTHS.items():
        wanted = known.get(name, factor * standard)
        margin = PROPORTION_RANGE * standard
        lengths[name] = min(max(wanted, standard - margin), standard + margin)
        if name in known and abs(wanted - lengths[name]) > 1e-6:
            held.append(f"{name} {1000 * wanted:.0f} -> {1000 * lengths[name]:.0f}")
    if not held:
        return lengths, ["lengths: all within 10 % of the standard humanoid's"]
    return lengths, [f"lengths held within 10 % of the standard humanoid's, mm: {', '.join(held)}"]


def limbs_with_lengths(
    names: tuple[str, ...], limbs: LimbPlaces, lengths: Mapping[str, float]
) -> LimbPlaces:
    """Joint centres that keep their directions from each other, and take other lengths.

    Args:
        names: Names of the limbs' joints.
        limbs: Their positions, metres.
        lengths: Lengths of the catalogue, metres.
    """
    place = _places(names, limbs)
    factor = {name: lengths[name] / value for name, value in _measured(names, limbs).items()}
    width = lengths["shoulder_width"] + _STERNOCLAVICULAR
    factor["shoulder_width"] = 2 * width / _distance(place["l_shoulder"], place["r_shoulder"])
    hips, trunk = place["hips"], place["shoulders"] - place["hips"]
    moved = {}
    for name in names:  # each after the one above
        at, (side, joint) = place[name], name.split("_")
        if joint == "hip":
            moved[name] = hips + factor["hip_width"] * (at - hips)
        elif joint == "shoulder":
            across = at - hips - trunk
            moved[name] = hips + factor["trunk"] * trunk + factor["shoulder_width"] * across
        else:
            above, length = _ABOVE[joint]
            if f"{side}_{above}" not in place:
                above, length = _ABOVE[above][0], ""
            above = f"{side}_{above}"
            moved[name] = moved[above] + factor.get(length, 1.0) * (at - place[above])
    return torch.stack([moved[name] for name in names], dim=1)


def _measured(names: tuple[str, ...], limbs: LimbPlaces) -> dict[str, float]:
    """Those lengths of the catalogue that the limbs' joints tell: medians, of both sides alike."""
    place = _places(names, limbs)
    width = _distance(place["l_shoulder"], place["r_shoulder"])
    found = {
        "hip_width": _distance(place["l_hip"], place["r_hip"]) / 2,
        "trunk": _distance(place["shoulders"], place["hips"]),
        "shoulder_width": width / 2 - _STERNOCLAVICULAR,
    }
    for joint, (above, length) in _ABOVE.items():
        both = [
            _distance(place[f"{side}_{joint}"], place[f"{side}_{above}"])
            for side in "lr"
            if {f"{side}_{joint}", f"{side}_{above}"} <= set(place)
        ]
        if both:
            found[length] = sum(both) / len(both)
    return found


def _places(names: tuple[str, ...], limbs: LimbPlaces) -> dict[str, Float[Tensor, "t 3"]]:
    """Where the limbs' joints are, and the middles of "hips" and "shoulders"."""
    place = dict(zip(names, limbs.unbind(1), strict=True))
    for joint in ("hip", "shoulder"):
        place[f"{joint}s"] = 0.5 * (place[f"l_{joint}"] + place[f"r_{joint}"])
    return place


def _distance(one: Float[Tensor, "t 3"], other: Float[Tensor, "t 3"]) -> float:
    """Median distance of two joints, metres."""
    return float((one - other).norm(dim=-1).median())


def levelled(
    joints: Float[Tensor, "t j 3"], path: Float[Tensor, "t 3"]
) -> tuple[Float[Tensor, "t j 3"], list[str]]:
    """Turn a motion so that its lowest joints stay at one height all along its path.

    The slope along the path's main direction is the median over pairs of frames that are far apart
    there (Theil 1950, Sen 1968), which jumps do not disturb. A short path tells no slope, and a
    steep one is stairs or a ramp: both stay as they are.

    Args:
        joints: All joints, metres, Y up.
        path: Where the body is.

    Returns:
        The joints, turned about a horizontal axis through the origin, and a line if they were.
    """
    flat = path - path.mean(0)
    flat = flat * flat.new_tensor([1, 0, 1])
    direction = torch.linalg.svd(flat, full_matrices=False).Vh[0]
    along, lowest = flat @ direction, joints[..., 1].amin(1)
    apart = along[:, None] - along
    far = apart > max(0.5 * float(apart.max()), _LEAST_PATH)
    if not bool(far.any()):
        return joints, []
    slope = ((lowest[:, None] - lowest)[far] / apart[far]).median()
    degrees = math.degrees(math.atan(slope))
    if not _LEAST_TILT < abs(degrees) < _MOST_TILT:
        return joints, []
    up = joints.new_tensor([0.0, 1.0, 0.0])
    # The rotation that takes the rising direction to the horizontal one.
    rising = (direction + slope * up) / (1 + slope**2).sqrt()
    skew = torch.outer(direction, rising) - torch.outer(rising, direction)
    turn = torch.linalg.matrix_exp(skew * (slope.atan() / slope.atan().sin()))
    return joints @ turn.T, [f"floor: tilted by {abs(degrees):.1f} degrees in the source, levelled"]


def _face_middle(body: BodyModel, states: Trajectory) -> tuple[BodyModel, Trajectory]:
    """The same motion on a base that faces the middle of all turns: most room to both limits."""
    place = body.state_columns(ROOT_NAMES[:3])
    yaw = body.state_index("root_yaw")
    heading = 0.5 * (states[:, yaw].max() + states[:, yaw].min())
    facing = root_rotation(torch.stack([heading, 0 * heading, 0 * heading]))
    states = states.clone()
    states[:, place] = states[:, place] @ facing
    states[:, yaw] -= heading
    return body.with_base(facing, torch.zeros(3)), states


def _root_by_trunk(names: tuple[str, ...], limbs: LimbPlaces) -> Float[Tensor, "t 6"]:
    """Place and turns of the root as hips and shoulders show them, turns without jumps."""
    place = _places(names, limbs)
    up = place["shoulders"] - place["hips"]
    left = functional.normalize(place["l_hip"] - place["r_hip"], dim=-1)
    forward = functional.normalize(torch.linalg.cross(left, up), dim=-1)
    turned = root_angles(torch.stack([left, torch.linalg.cross(forward, left), forward], dim=-1))
    unwrapped = torch.from_numpy(np.unwrap(turned.numpy(), axis=0))
    return torch.cat([place["hips"], unwrapped], dim=-1)


def _foot_length(
    motion: MotionCapture, names: tuple[str, ...], index: tuple[int, ...]
) -> float | None:
    """Metres from ankle to the farthest joint of the foot, in the zero pose."""
    found = []
    for name, ankle in zip(names, index, strict=True):
        below = _below(motion.parents, ankle)
        if name.endswith("ankle") and below:
            apart = np.linalg.norm(motion.rest[below] - motion.rest[ankle], axis=-1)
            found.append(float(apart.max()))
    return sum(found) / len(found) if found and min(found) > _TOE_DEPTH else None


class _Anchored(NamedTuple):
    """A joint beside the limbs' with a place of its own in the body."""

    joint: int
    link: int
    offset: Float[Tensor, "3"]


def _anchored(
    motion: MotionCapture, body: BodyModel, names: tuple[str, ...], index: tuple[int, ...]
) -> tuple[list[_Anchored], str]:
    """Joints beside the limbs' whose places in the body the zero pose tells, and a line."""
    at = dict(zip(names, index, strict=True))
    rest, parents = motion.rest, motion.parents

    def middle(place: str) -> np.ndarray:
        return 0.5 * (rest[at[f"l_{place}"]] + rest[at[f"r_{place}"]])

    hips, shoulders = middle("hip"), middle("shoulder")
    left, up = rest[at["l_hip"]] - hips, shoulders - hips
    if left[0] <= _UPRIGHT * np.linalg.norm(left) or up[1] <= _UPRIGHT * np.linalg.norm(up):
        return [], "zero pose not upright facing +Z: pelvis, feet and head follow the limbs alone"
    pelvis = _meeting(parents, at["l_hip"], at["r_hip"])
    chest = _meeting(parents, at["l_shoulder"], at["r_shoulder"])
    # Where a joint is, from a point that source and body share, and the landmark that it moves with
    found: list[tuple[int, np.ndarray, str, str]] = []
    if np.linalg.norm(rest[pelvis] - hips) < _NEAR:
        found.append((pelvis, hips, "HumanoidRoot", "HumanoidRoot"))
    if chest != pelvis and np.linalg.norm(rest[chest] - shoulders) < _NEAR:
        found.append((chest, shoulders, "vt1", "vt1"))
        limbs = {joint for limb in index for joint in (*_above(parents, limb), limb)}
        # The neck bends twice; the body's head turns in one place, and has what is farther up.
        level = len(_above(parents, chest)) + 2
        for joint in _below(parents, chest):
            above = _above(parents, joint)
            beside = not limbs & {joint, *above[: above.index(chest)]}
            if beside and len(above) >= level and rest[joint, 1] > shoulders[1]:
                found.append((joint, shoulders, "vt1", "skullbase"))
    for name in ("l_ankle", "r_ankle"):
        if name in at:
            found += [(j, rest[at[name]], name, name) for j in _below(parents, at[name])]

    zero = body.with_base(torch.eye(3), torch.zeros(3)).pose(torch.zeros_like(body.lower))
    anchored = []
    for joint, shared, here, carrier in found:
        link = int(body.marker_link[body.joint_index(carrier)])
        place = zero.joints[body.joint_index(here)] + torch.from_numpy(rest[joint] - shared)
        offset = zero.tree.rotation[link].T @ (place - zero.tree.translation[link])
        anchored.append(_Anchored(joint, link, offset))
    listed = ", ".join(motion.joint_names[joint.joint] for joint in anchored)
    return anchored, f"followed beside the limbs: {listed or 'nothing'}"


def _above(parents: tuple[int, ...], joint: int) -> list[int]:
    """All joints above a joint, the nearest first."""
    chain: list[int] = []
    while (joint := parents[joint]) >= 0:
        chain.append(joint)
    return chain


def _below(parents: tuple[int, ...], joint: int) -> list[int]:
    """All joints below a joint."""
    return [other for other in range(len(parents)) if joint in _above(parents, other)]


def _meeting(parents: tuple[int, ...], one: int, other: int) -> int:
    """The joint nearest to two joints on different branches that is above both."""
    shared = set(_above(parents, one))
    return next((joint for joint in _above(parents, other) if joint in shared), 0)


def _cost(
    body: BodyModel,
    names: tuple[str, ...],
    target: Float[Tensor, "t limbs+others 3"],
    others: list[_Anchored],
    choice: Retargeting,
) -> PointTargets:
    """Limbs and other joints where they shall be, frame by frame."""
    columns = body.joint_columns(names)
    sigma = [choice.sigma] * len(names) + [choice.sigma_others] * len(others)
    return PointTargets(
        body=body,
        link=torch.cat([body.marker_link[columns], torch.tensor([o.link for o in others]).long()]),
        offset=torch.cat([body.marker_offset[columns], *(o.offset[None] for o in others)]),
        target=target,
        sigma=torch.tensor(sigma).to(target),
    )


def _fit(
    cost: PointTargets,
    root: Float[Tensor, "t 6"],
    rate: float,
    choice: Retargeting,
    generator: torch.Generator,
) -> Trajectory:
    """States of all frames: several descents each, the best path through them, smoothing."""
    body, frames, k = cost.body, len(root), choice.num_starts
    bounds = free_turns(body)
    noise = torch.randn(k, body.num_parameters, generator=generator, dtype=body.dtype)
    noise[0] = 0.0
    spread = torch.where(body.sticky_deviation.isfinite(), body.sticky_deviation, 0.0)
    starts = (body.sticky_mean + 0.7 * spread * noise).expand(frames, *noise.shape).clone()
    starts[..., body.state_columns(ROOT_NAMES)] = root[:, None]
    every = torch.arange(frames).repeat_interleave(k)
    optimiser = TrustRegionNewton(max_steps=choice.max_steps, tolerance=1e-3)
    found = optimiser.minimise(cost.take(every), starts.flatten(0, 1), bounds)
    times = torch.arange(frames).to(root) / rate
    speed = tuple(body.motion_rate.tolist())
    states, costs = found.mean.unflatten(0, (frames, k)), found.cost.unflatten(0, (frames, k))
    path = best_path(states, None, costs, times, Transition(velocity=speed))
    states = states[torch.arange(frames), path.mode]
    smooth = Transition(acceleration=tuple(rate / choice.settling_s for rate in speed))
    end = Refinement(max_steps=choice.max_steps, tolerance=1e-2)
    states = refine(cost, states, times, smooth, bounds, choice=end).mean
    if choice.repulsion is None:
        return states
    apart = replace(cost, repulsion=choice.repulsion, pairs=InterpenetrationPairs(body))
    return refine(apart, states, times, smooth, bounds, choice=end).mean


def _findings(
    body: BodyModel, states: Tensor, at_limit: Tensor, collisions: Penetration
) -> list[str]:
    """Lines about turns, limits and collisions."""
    lines = []
    yaw, pitch, _ = (states[:, body.state_index(name)] for name in ROOT_NAMES[3:])
    steepest = float(pitch.abs().max())
    lines.append(
        f"root: yaw turns through {math.degrees(yaw.max() - yaw.min()):.0f} degrees without a "
        f"jump; steepest pitch {math.degrees(steepest):.0f} degrees"
    )
    if steepest > _STEEP:
        lines.append(
            "WARNING: the root's pitch nears a right angle, where yaw and roll are one turn and "
            "the pitch is limited: this clip needs several bases; cut it there"
        )
    outside = ((states < body.lower) | (states > body.upper)).any(0)
    beyond = [name for name in ("root_yaw", "root_roll") if outside[body.state_index(name)]]
    if beyond:
        lines.append(
            f"WARNING: beyond the body's limits: {', '.join(beyond)}; a tracker cannot go there, "
            "choose a shorter part"
        )
    share = at_limit.double().mean(0)
    share[body.state_columns(ROOT_NAMES)] = 0.0
    worst = share.argsort(descending=True)[:6].tolist()
    held = [f"{body.state_names[i]} {100 * share[i]:.0f} %" for i in worst if share[i] > 0.005]
    lines.append(f"angles at a limit, share of frames: {', '.join(held) or 'none'}")
    lines.append(_colliding(body, collisions))
    return lines


def _colliding(body: BodyModel, collisions: Penetration) -> str:
    """Which parts are inside others, how deep and how often."""
    depth = collisions.depth
    deep = depth > _DEEP
    if not bool(deep.any()):
        return f"no part more than {1000 * _DEEP:.0f} mm inside another"
    parts = collisions.parts.sort(-1).values.tolist()
    pairs = [" and ".join(body.part_names[part] for part in pair) for pair in parts]
    named = list(compress(pairs, deep.tolist()))
    common = max(set(named), key=named.count)
    return (
        f"parts more than {1000 * _DEEP:.0f} mm inside others in "
        f"{100 * float(deep.double().mean()):.0f} % of frames, {1000 * float(depth.max()):.0f} "
        f"mm at most ({pairs[int(depth.argmax())]}), most often {common}"
    )

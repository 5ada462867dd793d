"""The default shape of a bare skeleton: superquadric parts along its bones, and from simple solids.

A bone runs from one place where joints sit to the next, and is carried by the link between them.
Its part is a rounded, capsule-like superquadric. How thick: a share of its length, that of the
standard humanoid where both ends are joints of a person (`GIRTHS`); a short bone that carries one
longer one, such as a collar bone, is as thick as that; and where limbs branch off at both ends of
a chain of bones, the chain is a trunk, as wide as the limbs stand apart. This is a guess for
tracking, which the fit of cross-sections to an image (`torchcss.initialise.shape`) can better.

Solids of robot files become superquadrics: sphere and ellipsoid exactly; capsule, cylinder and box
with the right length and girth, and edges as sharp as the visibility of parts can follow.

Call `rest_poses`, `bone_parts`, `solid_shape`, and `touching_parts` for the pairs that touch.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, count

import numpy as np
import torch
from jaxtyping import Float

from torchcss.body.catalog import PartSpecification, without_side
from torchcss.body.chain import JointSpecification
from torchcss.body.rotations import as_rows, as_vector, frame_along, frame_at
from torchcss.body.surface import angular_grid, implicit, surface_points

GIRTHS: dict[tuple[str, str], tuple[str, float]] = {
    ("hip", "knee"): ("thigh", 0.185),
    ("knee", "ankle"): ("shank", 0.128),
    ("ankle", "midtarsal"): ("foot", 0.30),
    ("ankle", "toe"): ("foot", 0.22),
    ("shoulder", "elbow"): ("upper_arm", 0.165),
    ("elbow", "wrist"): ("forearm", 0.152),
    ("skullbase", "skull_tip"): ("head", 0.55),
    ("vt1", "skull_tip"): ("head", 0.30),
}
"""Bones of a person by the joints at their ends: the part's name, and its radius by its length, of
the standard humanoid (`torchcss.body.catalog`)."""

_GIRTH = 0.16
"""Radius of any other bone by its length: between a forearm and a thigh."""

_SLIM, _STOUT = 0.012, 0.15
"""Least and greatest radius of a bone by the reach of the body."""

_WIDTH, _DEPTH = 1.3, 0.62
"""Half-width of a trunk by the distance of the nearer limbs from it; its depth by its width."""

_SAME_PLACE = 0.01
"""Joints nearer to each other than this share of the body's reach are at one place."""

_SHARP = 0.3
"""Exponent of an edge; a tenth is the least that visibility follows, at more cost."""


@dataclass(eq=False)
class _Place:
    """Where joints sit together, and the bone that leads there."""

    position: Float[np.ndarray, "3"]
    above: _Place | None
    carrier: str
    """The link that carries the bone from the place above."""
    below: list[_Place] = field(default_factory=list)
    names: set[str] = field(default_factory=set)

    @property
    def bone(self) -> Float[np.ndarray, "3"]:
        """From the place above to this one."""
        return self.position - (self.position if self.above is None else self.above.position)

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.bone))


def rest_poses(joints: Sequence[JointSpecification]) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Pose of every link with all joints at zero, in the root link's frame."""
    poses: dict[str, np.ndarray] = {}
    for joint in joints:
        local = frame_at(joint.rotation, joint.translation)
        poses[joint.link] = local if joint.parent is None else poses[joint.parent] @ local
    return poses


def bone_parts(
    joints: Sequence[JointSpecification],
    landmarks: Mapping[str, str],
    *,
    skip: frozenset[str] = frozenset(),
) -> tuple[PartSpecification, ...]:
    """Parts along all bones.

    Args:
        joints: The tree, parents first.
        landmarks: Joint of a person (`torchcss.joint_names`) that stands at the origin of a link,
            for the links where one does.
        skip: Links that have parts of their own: the bones that they carry get none.
    """
    places, _, reach = _places(joints, landmarks)
    bones = [place for place in places if place.above is not None]
    kinds = {bone: _bone_kind(bone) for bone in bones}
    radius = {
        bone: min(max(girth * bone.length, _SLIM * reach), _STOUT * reach)
        for bone, (_, girth) in kinds.items()
    }
    for bone in reversed(bones):
        if len(bone.below) == 1 and bone.below[0].length > bone.length:
            radius[bone] = max(radius[bone], 0.9 * radius[bone.below[0]])
    trunk = _trunk(places)
    poses = rest_poses(joints)
    parts: list[PartSpecification] = []
    for bone in bones:
        assert bone.above is not None
        if bone.carrier in skip:
            continue
        side, r = trunk.get(bone, (None, radius[bone]))
        axes = (r, r, 0.5 * bone.length + 0.35 * radius[bone])
        if side is not None:
            width = max(_WIDTH * r, radius[bone])
            axes = (width, max(_DEPTH * width, radius[bone]), 0.5 * bone.length + 0.25 * width)
        turn = poses[bone.carrier][:3, :3]
        middle = 0.5 * (bone.above.position + bone.position) - poses[bone.carrier][:3, 3]
        parts.append(
            PartSpecification(
                name=unused(kinds[bone][0], [part.name for part in parts]),
                link=bone.carrier,
                translation=as_vector(turn.T @ middle),
                rotation=as_rows(turn.T @ frame_along(bone.bone, side)),
                shape=(*axes, 0.7, 0.9 if side is not None else 1.0, 0.0, 0.0, 0.0, 0.0),
            )
        )
    return tuple(parts)


def solid_shape(kind: str, size: Sequence[float]) -> tuple[float, ...]:
    """The nine shape numbers of a simple solid whose axis is z.

    Args:
        kind: "sphere" (radius), "ellipsoid" and "box" (three half sides), "capsule" and "cylinder"
            (radius, half of the length of its axis).
        size: Its numbers, metres.
    """
    if kind == "sphere":
        axes, e1, e2 = (size[0],) * 3, 1.0, 1.0
    elif kind in ("ellipsoid", "box"):
        e1 = e2 = _SHARP if kind == "box" else 1.0
        axes = tuple(size[:3])
    elif kind == "cylinder":
        axes, e1, e2 = (size[0], size[0], size[1]), _SHARP, 1.0
    else:
        axes, e1, e2 = (size[0], size[0], size[0] + size[1]), _capsule_exponent(*size[:2]), 1.0
    return (*(float(a) for a in axes), e1, e2, 0.0, 0.0, 0.0, 0.0)


def unopened_meshes(links: Sequence[str], where: str) -> str:
    """What to say of links whose meshes are not opened.

    Args:
        links: Their names.
        where: Where the file may give them a simple solid.
    """
    return (
        f"meshes are not opened, {', '.join(links)}: their shape is a guess along the bones; "
        f"boxes, cylinders or spheres as {where} are taken instead"
    )


def touching_parts(
    joints: Sequence[JointSpecification], parts: Sequence[PartSpecification]
) -> tuple[tuple[str, str], ...]:
    """Pairs of parts that touch in every pose: of one link or the next, or that overlap at rest."""
    _, place_of, _ = _places(joints, {})
    poses = rest_poses(joints)
    shapes = torch.tensor([part.shape for part in parts], dtype=torch.float64).reshape(-1, 9)
    frames = torch.from_numpy(
        np.array([poses[part.link] @ frame_at(part.rotation, part.translation) for part in parts])
    ).reshape(-1, 4, 4)
    turn, centre = frames[:, :3, :3], frames[:, :3, 3]
    eta, omega = (
        grid.flatten().expand(len(parts), -1) for grid in angular_grid(6, 8, dtype=torch.float64)
    )
    surface = surface_points(shapes[:, None].expand(-1, eta.shape[1], -1), eta, omega).points
    surface = surface @ turn.mT + centre[:, None]
    # Points of part i in the frame of part j.
    local = (surface[:, None] - centre[None, :, None]) @ turn
    inside = (implicit(shapes[None, :, None].expand(*local.shape[:3], 9), local) < 0).any(-1)
    overlap = (inside | inside.T).tolist()
    pairs = []
    for (i, first), (j, second) in combinations(enumerate(parts), 2):
        a, b = place_of[first.link], place_of[second.link]
        if a is b or a.above is b or b.above is a or overlap[i][j]:
            pairs.append((first.name, second.name))
    return tuple(pairs)


def _places(
    joints: Sequence[JointSpecification], landmarks: Mapping[str, str]
) -> tuple[list[_Place], dict[str, _Place], float]:
    """The places of a tree, the root's first, that of every link, and how far the body reaches."""
    poses = rest_poses(joints)
    reach = max(1e-9, max(float(np.linalg.norm(pose[:3, 3])) for pose in poses.values()))
    places: list[_Place] = []
    place_of: dict[str, _Place] = {}
    for joint in joints:
        position = poses[joint.link][:3, 3]
        above = None if joint.parent is None else place_of[joint.parent]
        if above is not None and np.linalg.norm(position - above.position) < _SAME_PLACE * reach:
            place = above
        else:
            place = _Place(position, above, joint.parent or "")
            places.append(place)
            if above is not None:
                above.below.append(place)
        place_of[joint.link] = place
        if joint.link in landmarks:
            place.names.add(landmarks[joint.link])
    return places, place_of, reach


def _bone_kind(bone: _Place) -> tuple[str, float]:
    """Name of a bone, and its radius by its length."""
    assert bone.above is not None
    for start in bone.above.names:
        for end in bone.names:
            if (known := GIRTHS.get((without_side(start), without_side(end)))) is not None:
                side = end[:2] if end.startswith(("l_", "r_")) else ""
                return side + known[0], known[1]
    return bone.carrier, _GIRTH


def _trunk(places: Sequence[_Place]) -> dict[_Place, tuple[np.ndarray, float]]:
    """Bones between two places where limbs branch off: direction and distance of the limbs."""
    found: dict[_Place, tuple[np.ndarray, float]] = {}
    for end in places:
        if len(end.below) < 2:
            continue
        chain, start = [end], end.above
        while start is not None and len(start.below) < 2:
            chain.append(start)
            start = start.above
        if start is None:
            continue
        axis = end.position - start.position
        axis = axis / np.linalg.norm(axis)
        spreads = []
        for place in (start, end):
            limbs = [limb.bone for limb in place.below if limb is not chain[-1]]
            across = [limb - axis * (limb @ axis) for limb in limbs]
            spreads.append(max(across, key=lambda v: float(np.linalg.norm(v)), default=axis * 0))
        widths = [float(np.linalg.norm(spread)) for spread in spreads]
        if min(widths) > 0:
            side = spreads[int(np.argmax(widths))]
            found |= {bone: (side, min(widths)) for bone in chain}
    return found


def _capsule_exponent(radius: float, half: float) -> float:
    """The exponent with which a superquadric of a capsule's length and girth has its volume.

    V = 2 a1 a2 a3 e1 e2 B(e1/2 + 1, e1) B(e2/2, e2/2), for a round section (e2 = 1)
    2 pi a1 a2 a3 e1 B(e1/2 + 1, e1).
    """
    wanted = 2 * half + 4 / 3 * radius

    def volume(e: float) -> float:  # over pi radius^2
        beta = math.lgamma(e / 2 + 1) + math.lgamma(e) - math.lgamma(1.5 * e + 1)
        return 2 * (radius + half) * e * math.exp(beta)

    low, high = _SHARP, 1.0  # the volume falls with the exponent
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if volume(middle) > wanted else (low, middle)
    return 0.5 * (low + high)


def unused(name: str, used: Container[str]) -> str:
    """A name, or the first of that name with a number that is not used."""
    names = (name if n == 1 else f"{name}_{n}" for n in count(1))
    return next(each for each in names if each not in used)

"""Bodies that are not in the catalogue: any URDF, MJCF or BVH file, with flesh and a root.

| file | tree and limits | flesh |
|---|---|---|
| `.urdf` | the file's | its boxes, cylinders, spheres; along the bones where a link has none |
| `.xml` | MJCF's, or URDF's if the file is one | its solids; along the bones likewise |
| `.bvh` | the file's; limits from its motion (`torchcss.body.bvh`) | along the bones |

A free root is Y up and faces +Z, as in the catalogue; robot files, Z up and facing +X, hang on it
turned accordingly, by their root link. A fixed body stands in the frame of its file.

Joints that have a name of ours (`torchcss.joint_names.skeleton_joint_names`) are landmarks under
that name, the others under the file's; the middle of the hips is one if one link carries both.

Call `read_skeleton`; `torchcss.load_body` does.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from torchcss.body.bvh import Skeleton, read_bvh_skeleton
from torchcss.body.catalog import (
    BodySpecification,
    MarkerSpecification,
    PartSpecification,
    root_joints,
    scaled,
)
from torchcss.body.flesh import as_vector, bone_parts, rest_poses, touching_parts
from torchcss.body.kinematics import JointSpecification, KinematicTree
from torchcss.body.mjcf import read_mjcf
from torchcss.body.urdf_solids import read_urdf_solids
from torchcss.errors import BodyError, MotionCaptureError
from torchcss.joint_names import skeleton_joint_names
from torchcss.reading import read_bytes

Flesh = Literal["file", "bones", "none"]
"""Flesh of a body from a file: the file's solids and the bones of links without; the bones of all
links; none."""

BODY_SUFFIXES = (".urdf", ".xml", ".mjcf", ".bvh")

_AS_IT_IS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_Y_UP = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
"""Robots are Z up and face +X: to Y up, facing +Z."""


def read_skeleton(
    path: Path,
    *,
    flesh: Flesh = "file",
    free_root: bool | None = None,
    scale: float = 1.0,
    units: str | float | None = None,
) -> BodySpecification:
    """Read a body from a file.

    Args:
        path: A URDF, MJCF or BVH file.
        flesh: Where its parts come from.
        free_root: Give the body six root parameters; None: if the file lets it move freely (BVH,
            MJCF with a free joint).
        scale: Factor on all lengths.
        units: Metres per unit of a BVH, or a name of `torchcss.body.bvh.UNITS`; None: guessed.

    Raises:
        BodyError: If the file is missing, damaged or of another format, or its tree cannot be used.
    """
    if flesh not in ("file", "bones", "none"):
        raise BodyError(f"flesh: expected file, bones or none, got {flesh!r}")
    if not 0 < scale < np.inf:
        raise BodyError(f"scale must be positive and finite, got {scale}")
    skeleton, solids, turn = _read(path, units)
    rooted = skeleton.has_root if free_root is None else free_root
    if rooted:
        root, base = root_joints(), skeleton.joints[0]
        # The root moves the first body that the file names, wherever the file puts that.
        start = rest_poses(skeleton.joints)[skeleton.places[0]][:3, 3]
        base = replace(
            base,
            parent=root[-1].link,
            rotation=turn,
            translation=as_vector(-np.array(turn) @ start),
        )
        skeleton = skeleton._replace(joints=(*root, base, *skeleton.joints[1:]))
    joints = skeleton.joints
    known = skeleton_joint_names(skeleton.places)
    landmarks = {
        link: name for link, name in zip(skeleton.places, known, strict=True) if name is not None
    }
    parts = solids if flesh == "file" else ()
    if flesh != "none":
        # The world is no bone, nor is what carries the body in it or lies between its joints.
        bare = {joint.link for joint in joints} - set(skeleton.places)
        fleshy = frozenset(part.link for part in parts) | bare
        for part in bone_parts(joints, landmarks, skip=fleshy):
            name, taken = part.name, {other.name for other in parts}
            while name in taken:
                name += "_bone"
            parts += (replace(part, name=name),)
    markers = [
        MarkerSpecification(name=landmarks.get(link, link), link=link) for link in skeleton.places
    ]
    return scaled(
        BodySpecification(
            name=str(path),
            joints=joints,
            parts=parts,
            markers=(*_middle_of_hips(joints, landmarks), *markers),
            ties={},
            sticky=skeleton.sticky,
            neighbours=touching_parts(joints, parts),
            lengths={},
            notes=tuple(f"{path.name}: {note}" for note in skeleton.notes),
        ),
        scale,
    )


def _read(
    path: Path, units: str | float | None
) -> tuple[Skeleton, tuple[PartSpecification, ...], tuple[tuple[float, ...], ...]]:
    """Tree, solids, and how the file's frame hangs on a root that is Y up."""
    if path.suffix.lower() == ".bvh":
        try:
            skeleton = read_bvh_skeleton(path, units=units)
        except MotionCaptureError as error:
            raise BodyError(str(error)) from error
        return skeleton, (), _AS_IT_IS
    if units is not None:
        raise BodyError(f"{path}: units are for BVH files; this format is in metres (see scale)")
    data = read_bytes(path, BodyError)
    if path.suffix.lower() != ".urdf" and _root_tag(data) in ("mujoco", "mujocoinclude"):
        return *read_mjcf(path), _Y_UP
    tree = KinematicTree.from_urdf(path)
    skeleton = Skeleton(
        tree.specifications, {}, ("limits, axes and solids: as the URDF says",), tree.link_names,
        False,
    )  # fmt: skip
    return skeleton, read_urdf_solids(path, data), _Y_UP


def _root_tag(data: bytes) -> str:
    try:
        return ElementTree.fromstring(data).tag
    except (ElementTree.ParseError, ValueError, LookupError):
        return ""  # reading it as a URDF says what is wrong


def _middle_of_hips(
    joints: tuple[JointSpecification, ...], landmarks: dict[str, str]
) -> list[MarkerSpecification]:
    """The landmark `HumanoidRoot`, if both hips sit at fixed places of one link."""
    link_of = {name: link for link, name in landmarks.items()}
    if not {"l_hip", "r_hip"} <= set(link_of) or "HumanoidRoot" in link_of:
        return []
    by_link = {joint.link: joint for joint in joints}

    def carriers(link: str) -> list[str]:
        """Links that the hip joint's place is fixed in, the nearest first."""
        place, found = poses[link][:3, 3], []
        while (parent := by_link[link].parent) is not None:
            found.append(parent)
            joint = by_link[parent]
            if joint.kind != "fixed" and np.linalg.norm(poses[parent][:3, 3] - place) > 1e-6:
                break  # it moves the place
            link = parent
        return found

    poses = rest_poses(joints)
    right = carriers(link_of["r_hip"])
    common = next((link for link in carriers(link_of["l_hip"]) if link in right), None)
    if common is None:
        return []
    middle = 0.5 * (poses[link_of["l_hip"]] + poses[link_of["r_hip"]])[:3, 3] - poses[common][:3, 3]
    x, y, z = (poses[common][:3, :3].T @ middle).tolist()
    return [MarkerSpecification(name="HumanoidRoot", link=common, translation=(x, y, z))]

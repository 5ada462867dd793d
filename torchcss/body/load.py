"""Make a body: one of the catalogue, or one from a URDF, MJCF or BVH file.

| file | tree and limits | shape |
|---|---|---|
| `.urdf` | the file's | its boxes, cylinders, spheres; along the bones where a link has none |
| `.xml` | MJCF's, or URDF's if the file is one | its solids; along the bones likewise |
| `.bvh` | the file's; limits from its motion (`torchcss.body.files.bvh`) | along the bones |

A free root is Y up and faces +Z, as in the catalogue; robot files, Z up and facing +X, hang on it
turned accordingly, by their root link. A fixed body stands in the frame of its file.

Joints that have a name of ours (`torchcss.joint_names.skeleton_joint_names`) are landmarks under
that name, the others under the file's, with a number where that is another's name; the middle of
the hips is one if one link carries both.

Call `load_body`; `has_free_root` tells bodies that move about from arms.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from torchcss.body.catalog import (
    ARM_NAMES,
    BODY_NAMES,
    BodySpecification,
    MarkerSpecification,
    Proportions,
    root_joints,
    scaled,
    specification,
)
from torchcss.body.chain import JointSpecification
from torchcss.body.files.bvh import HungTree, read_bvh_skeleton
from torchcss.body.files.bvh_parser import MOST_LINKS
from torchcss.body.files.default_shape import bone_parts, rest_poses, touching_parts, unused
from torchcss.body.files.mjcf import read_mjcf
from torchcss.body.files.urdf import read_urdf
from torchcss.body.files.xml import parse_xml
from torchcss.body.model import BodyModel
from torchcss.body.root import has_root
from torchcss.body.rotations import as_vector
from torchcss.errors import BodyError, ConfigurationError, MotionCaptureError, check_device
from torchcss.files import naming
from torchcss.joint_names import skeleton_joint_names
from torchcss.types import frozen

BODY_SUFFIXES = (".urdf", ".xml", ".mjcf", ".bvh", ".xacro")

_LARGEST = 50.0
"""Metres that a body reaches from its root: more are another unit."""

_AS_IT_IS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_BVH_Y_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
"""Z up to Y up, what faced -Y facing +Z."""
_Y_UP = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
"""Robots are Z up and face +X: to Y up, facing +Z."""


@frozen
class FileOptions:
    """What is made of a body's file beyond its tree.

    Attributes:
        shape: "file" for the solids that it describes, and along the bones of links without;
            "bones" for all bones; "none".
        units: Metres per unit of a BVH, or "m", "cm", "mm", "inch", "cmu"; None: guessed.
    """

    shape: Literal["file", "bones", "none"] = "file"
    units: str | float | None = None

    def __post_init__(self) -> None:
        if self.shape not in ("file", "bones", "none"):
            raise BodyError(f"shape: expected file, bones or none, got {self.shape!r}")


def load_body(
    name_or_path: str | Path,
    *,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
    lengths: Mapping[str, float] | None = None,
    scale: float = 1.0,
    free_proportions: Proportions = False,
    free_root: bool | None = None,
    file: FileOptions | None = None,
) -> BodyModel:
    """Make a body: one that ships, or that of a URDF, MJCF or BVH file.

    Args:
        name_or_path: "arm7", "arm8", "body30", "body32", "body34", or the path of a file.
        dtype: torch.float64 or torch.float32.
        device: Where its tensors live.
        lengths: Lengths that differ from the standard humanoid's, metres; not for files.
        scale: Overall scale of the standard humanoid (stature 1.75 m), or of the file.
        free_proportions: Make the lengths parameters too, or the lengths and places that are named
            (for fitting). The lengths of a file stay as they are.
        free_root: Six root parameters or none; by default bodies have them and arms do not, and
            bodies from files if the file lets them move freely.
        file: How a file is read.

    Raises:
        BodyError: If there is no such body, or the file cannot be used.
        ConfigurationError: If there is no such type or device.
        MissingExtraError: If the file is an MJCF and MuJoCo is not installed.
    """
    if dtype not in (torch.float32, torch.float64):
        raise ConfigurationError(f"dtype: expected torch.float32 or torch.float64, got {dtype!r}")
    check_device(device)
    if str(name_or_path) in BODY_NAMES:
        body = specification(
            str(name_or_path),
            lengths=lengths,
            scale=scale,
            free_proportions=free_proportions,
            free_root=free_root,
        )
        return BodyModel(body).to(dtype=dtype, device=device)
    path = Path(name_or_path)
    if path.suffix.lower() not in BODY_SUFFIXES:
        raise BodyError(
            f"no body {str(name_or_path)!r}; expected one of {', '.join(BODY_NAMES)} or the "
            f"path of a file that ends in {', '.join(BODY_SUFFIXES)}"
        )
    if lengths:
        raise BodyError(f"{path}: a body from a file has its own lengths; use scale")
    if not 0 < scale < np.inf:
        raise BodyError(f"scale must be positive and finite, got {scale}")
    try:
        with naming(path, BodyError):
            body = scaled(_from_file(path, file or FileOptions(), free_root), scale)
            return BodyModel(body).to(dtype=dtype, device=device)
    except RecursionError as error:
        raise BodyError(f"{path}: links hundreds deep; expected a body or a robot") from error


def has_free_root(name_or_path: str | Path) -> bool:
    """Whether a body moves about in the world, as people do, or stands in one place, as an arm.

    Args:
        name_or_path: As for `load_body`, with its defaults.

    Raises:
        BodyError: As `load_body`.
    """
    if str(name_or_path) in BODY_NAMES:
        return str(name_or_path) not in ARM_NAMES
    return has_root(load_body(name_or_path))


def _from_file(path: Path, options: FileOptions, free_root: bool | None) -> BodySpecification:
    """Joints, parts and landmarks of a file, hung on a root if it has or shall have one."""
    skeleton, turn = _read(path, options.units)
    if (number := len(skeleton.joints)) > MOST_LINKS:  # of an MJCF, which may repeat its bodies
        raise BodyError(f"{number:,} links; expected a robot of {MOST_LINKS:,} at most")
    if skeleton.has_root if free_root is None else free_root:
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
    parts = skeleton.solids if options.shape == "file" else ()
    if options.shape != "none":
        # The world is no bone, nor is what carries the body in it or lies between its joints.
        bare = {joint.link for joint in joints} - set(skeleton.places)
        shaped = frozenset(part.link for part in parts) | bare
        for part in bone_parts(joints, landmarks, skip=shaped):
            name, taken = part.name, {other.name for other in parts}
            while name in taken:
                name += "_bone"
            parts += (replace(part, name=name),)
    notes, poses = skeleton.notes, rest_poses(joints)
    reach = max(float(np.linalg.norm(poses[link][:3, 3])) for link in skeleton.places)
    if reach > _LARGEST:
        notes += (
            f"it reaches {reach:.0f} m, as its lengths count as metres: write those of a file in "
            "millimetres as metres, or load it in Python by load_body(..., scale=0.001)",
        )
    return BodySpecification(
        name=str(path),
        joints=joints,
        parts=parts,
        markers=_markers(joints, skeleton.places, landmarks),
        ties={},
        sticky=skeleton.sticky,
        neighbours=touching_parts(joints, parts),
        lengths={},
        notes=tuple(f"{path.name}: {note}" for note in notes),
    )


def _read(path: Path, units: str | float | None) -> tuple[HungTree, tuple[tuple[float, ...], ...]]:
    """What a file has, and how the file's frame hangs on a root that is Y up."""
    if path.suffix.lower() == ".bvh":
        try:
            skeleton = read_bvh_skeleton(path, units=units)
        except (MotionCaptureError, ConfigurationError) as error:
            raise BodyError(str(error)) from error
        return skeleton, _BVH_Y_UP if skeleton.is_z_up else _AS_IT_IS
    if units is not None:
        raise BodyError(f"{path}: units are for BVH files; this format is in metres (see scale)")
    root = parse_xml(path, "a URDF")
    if path.suffix.lower() != ".urdf" and root.tag in ("mujoco", "mujocoinclude"):
        return read_mjcf(path), _Y_UP
    return read_urdf(root, path.parent), _Y_UP


def _markers(
    joints: tuple[JointSpecification, ...], places: tuple[str, ...], landmarks: dict[str, str]
) -> tuple[MarkerSpecification, ...]:
    """A joint centre at the origin of every link that the file names, and between the hips."""
    middle: list[MarkerSpecification] = []
    if {"l_hip", "r_hip"} <= {*landmarks.values()} and "HumanoidRoot" not in places:
        # Detectors mark it between the hips: a pelvis may start far above.
        landmarks = {link: name for link, name in landmarks.items() if name != "HumanoidRoot"}
        middle = _middle_of_hips(joints, landmarks)
    taken = [*landmarks.values(), *(marker.name for marker in middle)]
    named = {link: landmarks.get(link) or unused(link, taken) for link in places}
    return (*middle, *(MarkerSpecification(name=named[link], link=link) for link in places))


def _middle_of_hips(
    joints: tuple[JointSpecification, ...], landmarks: dict[str, str]
) -> list[MarkerSpecification]:
    """The landmark `HumanoidRoot`, if both hips sit at fixed places of one link."""
    link_of = {name: link for link, name in landmarks.items()}
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

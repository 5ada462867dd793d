"""BVH: the skeleton and its turns, for Blender, MotionBuilder and everything that animates.

The dialect is that of the motion-capture libraries: a `ROOT` of six channels (position first),
`JOINT`s of three rotations, degrees, the axes turning with the body in the order of the channels
(intrinsic), an `End Site` at every tip, tabs, one line per frame. Y is up and the zero pose faces
+Z, left is +X, as in our bodies and in Blender's reader.

Landmarks are joints of zero turns, so that every joint of ours is in the file under its name.
Blanks in names become underscores: some readers end a name at the first one.

Call `bvh_text`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from torchcss.body.model import BodyModel
from torchcss.body.rotations import ROTATION_ORDERS, euler_angles
from torchcss.errors import ConfigurationError
from torchcss.io.export.selection import Selection
from torchcss.io.export.skeleton import Skeleton, make_skeleton, node_poses, t_pose
from torchcss.types import frozen


@frozen
class BvhStyle:
    """How a BVH is written.

    Attributes:
        rotation_order: Order of the rotation channels of a BVH.
        scale: Units of a BVH per metre: 1 for metres, 100 for centimetres.
        t_pose: Begin a BVH with a frame of the T-pose, which the motion then follows.
        rest_pose: The pose of a BVH in which all channels are zero: "hanging" (arms at the sides,
            H-Anim) or "t-pose".
    """

    rotation_order: Literal["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"] = "ZXY"
    scale: float = 1.0
    t_pose: bool = False
    rest_pose: Literal["hanging", "t-pose"] = "hanging"


def bvh_text(
    selection: Selection, mode: int, body: BodyModel, style: BvhStyle
) -> tuple[str, list[str]]:
    """Write one mode as BVH; the text, and what a reader should know, one line each.

    Args:
        selection: The frames.
        mode: Which of its modes.
        body: The body, on the origin.
        style: How.

    Raises:
        ConfigurationError: If the style makes no sense, or a T-pose is wanted of a body without
            shoulders.
    """
    if style.rotation_order not in ROTATION_ORDERS:
        raise ConfigurationError(
            f"rotation order: expected {', '.join(ROTATION_ORDERS)}, got {style.rotation_order!r}"
        )
    if style.rest_pose not in ("hanging", "t-pose"):
        raise ConfigurationError(f"rest pose: expected hanging, t-pose, got {style.rest_pose!r}")
    if not 0 < style.scale < np.inf:
        raise ConfigurationError(f"scale: expected a positive number, got {style.scale}")
    scale, hung = style.scale, style.rest_pose == "hanging"
    skeleton = make_skeleton(body)
    shoulders = {"l_shoulder", "r_shoulder"} & set(skeleton.names)
    if (style.t_pose or not hung) and not shoulders:
        raise ConfigurationError(f"{body.name} has no shoulders, and no T-pose; leave it out")
    rotation, place = node_poses(skeleton, body, selection.state[:, mode], selection.base[:, mode])
    lifted = t_pose(skeleton)
    rest = np.tile(np.eye(3), (len(lifted), 1, 1)) if hung else lifted
    rotation = rotation @ rest.swapaxes(-1, -2)
    offsets, report = _offsets(skeleton, rotation, place)
    root = place[:, 0]
    if style.t_pose:
        standing = selection.upright @ lifted @ rest.swapaxes(-1, -2)
        rotation = np.concatenate([standing[None], rotation])
        root = np.concatenate([root[:1], root])
        report.append("frame 1 is the T-pose; the motion begins with frame 2")
    angles = np.degrees(euler_angles(_local(skeleton, rotation), style.rotation_order))
    channels = np.concatenate([scale * root, angles.reshape(len(angles), -1)], axis=1)

    # Lengths to a micrometre whatever the unit, angles to a millionth of a degree.
    decimals = max(0, round(6 - np.log10(scale)))
    lines = [
        "HIERARCHY",
        *_hierarchy(skeleton, scale * offsets, decimals, style.rotation_order),
        "MOTION",
        f"Frames: {len(channels)}",
        f"Frame Time: {1 / selection.rate:.8f}",
    ]
    formats = [decimals] * 3 + [6] * (channels.shape[1] - 3)
    lines += [
        " ".join(_number(value, digits) for value, digits in zip(row, formats, strict=True))
        for row in channels
    ]
    return "\n".join(lines) + "\n", report


def _local(skeleton: Skeleton, rotation: Float[np.ndarray, "t nodes 3 3"]) -> np.ndarray:
    """Orientations in the parents' frames; the root's in the file's."""
    parents = np.array(skeleton.parents)
    above = rotation[:, np.maximum(parents, 0)].swapaxes(-1, -2)
    return np.where((parents < 0)[:, None, None], rotation, above @ rotation)


def _offsets(
    skeleton: Skeleton, rotation: np.ndarray, place: np.ndarray
) -> tuple[Float[np.ndarray, "nodes 3"], list[str]]:
    """Places in the parents' frames, of the first frame; the root's is zero."""
    parents = np.array(skeleton.parents)
    above = np.maximum(parents, 0)
    step = (place - place[:, above])[..., None]
    offsets = (rotation[:, above].swapaxes(-1, -2) @ step)[..., 0]
    change = np.abs(offsets - offsets[:1]).max()
    report = []
    if change > 1e-6:
        report.append(
            f"lengths change by up to {1000 * change:.1f} mm during the track, which BVH cannot "
            "say; those of the first frame are written"
        )
    return offsets[0], report


def _hierarchy(
    skeleton: Skeleton, offsets: Float[np.ndarray, "nodes 3"], decimals: int, order: str
) -> list[str]:
    turns = " ".join(f"{letter}rotation" for letter in order)
    lines: list[str] = []

    def visit(index: int, depth: int) -> None:
        tabs = "\t" * depth
        kind, channels = "JOINT", f"3 {turns}"
        if index == 0:
            kind, channels = "ROOT", f"6 Xposition Yposition Zposition {turns}"
        name = skeleton.names[index].replace(" ", "_")
        lines.extend([f"{tabs}{kind} {name}", f"{tabs}{{"])
        offset = " ".join(_number(value, decimals) for value in offsets[index])
        lines.extend([f"{tabs}\tOFFSET {offset}", f"{tabs}\tCHANNELS {channels}"])
        children = [child for child, parent in enumerate(skeleton.parents) if parent == index]
        for child in children:
            visit(child, depth + 1)
        if not children:
            zero = " ".join([_number(0.0, decimals)] * 3)
            end = [f"{tabs}\tEnd Site", f"{tabs}\t{{", f"{tabs}\t\tOFFSET {zero}", f"{tabs}\t}}"]
            lines.extend(end)
        lines.append(f"{tabs}}}")

    visit(0, 0)
    return lines


def _number(value: float, decimals: int) -> str:
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if float(text) == 0 else text

"""The body of a track, from the track alone.

A track holds states and joint centres, not the body. But the names of its parameters tell which
body of the catalogue it is, and the joint centres of a posed body are linear in the lengths and in
the scale of what is not a length. Least squares over some frames therefore gives them back, to the
digits of the file.

Call `body_of_track`, then `pose_track` for the poses of any of its modes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.catalog import BODY_NAMES, LENGTHS, BodySpecification, specification
from torchcss.body.kinematics import TreePose
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel, BodyPose
from torchcss.body.root import ROOT_NAMES
from torchcss.errors import TrackFileError
from torchcss.io.tracks import Track

TOLERANCE = 1e-4
"""Metres by which a rebuilt body may miss the joints of the track: far above float32's rounding."""

_FRAMES = 16  # for the fit; each has dozens of joints for a dozen unknowns


def body_of_track(track: Track, body: BodyModel | None = None) -> BodyModel:
    """Rebuild the body that was tracked; its flesh is the standard humanoid's.

    Args:
        track: The track.
        body: The body, if it is none of the catalogue's; it is only checked.

    Returns:
        The body, float64 on the processor, hung on the world's origin.

    Raises:
        TrackFileError: If no body of the catalogue has these parameters and joints, or none with
            any lengths has its joints where the track has them.
    """
    chosen = _some_frames(track)
    if not chosen.size:
        raise TrackFileError("the track has no frames, from which its body could be told")
    state = torch.from_numpy(track.state[chosen, 0])
    base = torch.from_numpy(track.base_transform[chosen])
    target = torch.from_numpy(track.joints_world[chosen, 0])
    if body is None:
        body = _fitted(track, state, base, target)
    else:
        # The copy on another base is converted, the caller's body stays as it is.
        body = body.with_base(torch.eye(3), torch.zeros(3)).to(dtype=torch.float64, device="cpu")
        if (body.state_names, body.joint_names) != (track.state_names, track.joint_names):
            raise TrackFileError(
                f"the body {body.name} has other parameters or joints than the track; "
                f"expected the parameters {', '.join(track.state_names)}"
            )
    miss = float((pose_track(body, state, base).joints - target).abs().max())
    if miss > TOLERANCE:
        raise TrackFileError(
            f"the body {body.name} misses the joints of the track by {1000 * miss:.1f} mm; "
            "give the body that was tracked"
        )
    return body


def pose_track(
    body: BodyModel, state: Float[Tensor, "*batch n"], base: Float[Tensor, "*batch 4 4"]
) -> BodyPose:
    """Pose a body on a base of its own in every item.

    Args:
        body: A body on the origin, as `body_of_track` gives it.
        state: States.
        base: Base transforms, in any frame.

    Returns:
        The poses in the frame of the base transforms.
    """
    pose = body.pose(state)
    turn, shift = base[..., None, :3, :3], base[..., None, :3, 3]
    omega = (turn @ pose.tree.omega[..., None])[..., 0]
    velocity = (turn @ pose.tree.velocity[..., None])[..., 0]
    tree = TreePose(
        turn @ pose.tree.rotation,
        (turn @ pose.tree.translation[..., None])[..., 0] + shift,
        omega,
        # The twist is taken at the origin, which moved away from the base by -shift.
        velocity + torch.linalg.cross(shift.expand_as(omega), omega),
    )
    return BodyPose(state, tree, (turn @ pose.joints[..., None])[..., 0] + shift)


def _some_frames(track: Track) -> np.ndarray:
    present = np.flatnonzero(track.num_modes > 0)
    return present[np.linspace(0, len(present) - 1, min(_FRAMES, len(present))).astype(int)]


def _fitted(track: Track, state: Tensor, base: Tensor, target: Tensor) -> BodyModel:
    """The catalogue's body of these names, with the lengths that the joints show."""
    options: dict[str, Any] = {
        "free_root": set(ROOT_NAMES) <= set(track.state_names),
        "free_proportions": any(name.endswith("_length") for name in track.state_names),
    }
    for name in BODY_NAMES:
        start = specification(name, **options)
        moving = {joint.name for joint in start.joints if joint.kind != "fixed"}
        parameters = {start.ties.get(joint, (joint, 1.0))[0] for joint in moving}
        markers = tuple(marker.name for marker in start.markers)
        if (parameters, markers) == (set(track.state_names), track.joint_names):
            break
    else:
        raise TrackFileError(
            "no body that ships has the parameters and joints of this track: "
            f"{', '.join(track.state_names)}; call torchcss.export_track with the body"
        )

    body = load_body(name, **options)
    if body.state_names != track.state_names:
        raise TrackFileError(
            f"the parameters of the track are those of {name} in another order; expected "
            f"{', '.join(body.state_names)}"
        )
    standard = pose_track(body, state, base)
    trials = [
        *(specification(name, lengths={key: 2 * LENGTHS[key]}, **options) for key in LENGTHS),
        specification(name, lengths={k: v / 2 for k, v in LENGTHS.items()}, scale=2.0, **options),
    ]
    columns = [_moved(body, standard, start, trial).flatten() for trial in trials]
    # What the joints do not show (an arm has no scale beside its lengths) stays the standard's.
    step = torch.linalg.lstsq(
        torch.stack(columns, dim=1), (target - standard.joints).flatten(), driver="gelsd"
    ).solution.tolist()
    scale = 1.0 + step.pop()
    lengths = {
        key: length * (1 + part) for (key, length), part in zip(LENGTHS.items(), step, strict=True)
    }
    if not min(scale, *lengths.values()) > 0:
        raise TrackFileError(
            f"the joints of the track are not those of a {name}; give the body that was tracked"
        )
    bare = {key: length / scale for key, length in lengths.items()}
    return load_body(name, lengths=bare, scale=scale, **options)


def _moved(
    body: BodyModel, pose: BodyPose, start: BodySpecification, other: BodySpecification
) -> Float[Tensor, "b j 3"]:
    """How far the joint centres of the other body lie from the first's in the same pose.

    Lengths turn no link, so that every joint above a joint centre moves it by the difference of
    its own offset, in the orientation of the link that it hangs on.
    """
    place = {joint.link: row for row, joint in enumerate(start.joints)}
    offsets = [[joint.translation for joint in spec.joints] for spec in (start, other)]
    marks = [[mark.translation for mark in spec.markers] for spec in (start, other)]
    offset = torch.tensor(offsets[1], dtype=torch.float64) - torch.tensor(
        offsets[0], dtype=torch.float64
    )
    mark = torch.tensor(marks[1], dtype=torch.float64) - torch.tensor(marks[0], dtype=torch.float64)
    # The root has no link above and no offset.
    above = [body.tree.link_index(joint.parent or joint.link) for joint in start.joints]
    steps = (pose.tree.rotation[:, above] @ offset[:, :, None])[..., 0]
    carried = torch.zeros(len(start.markers), len(start.joints), dtype=torch.float64)
    for row, marker in enumerate(start.markers):
        link: str | None = marker.link
        while link is not None:
            carried[row, place[link]] = 1.0
            link = start.joints[place[link]].parent
    own = (pose.tree.rotation[:, body.marker_link] @ mark[:, :, None])[..., 0]
    return carried @ steps + own

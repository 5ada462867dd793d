"""SMPL pose parameters: axis-angle per joint, in SMPL's order, measured from the T-pose.

Nothing of SMPL is shipped or needed: its 24 joints, their tree and its zero pose (standing, Y up,
facing +Z, arms to the sides, palms down) are public convention. What our bodies do not turn stays
zero: spine2, spine3, head, feet, hands. Our lumbar joint is SMPL's spine1, our neck joint its neck,
our clavicle its collar.

SMPL's own T-pose is a few degrees off the ideal one (its legs stand apart, its arms sink), and its
bones have other lengths: the limbs point where ours do to that accuracy, the joints lie where its
shape puts them.

The arrays are those that AMASS's readers and smplx take (t frames, m modes; a single mode has no
axis m): `poses` [t m 72], its parts `global_orient` [t m 3] and `body_pose` [t m 69], `trans`
[t m 3], `betas` (zero), `gender`, `mocap_framerate`. `trans` is the middle of our hips; SMPL adds
the pelvis of its shape, which is not ours to know: subtract `J[0]` of your model.

Call `smpl_arrays`.
"""

from __future__ import annotations

import numpy as np

from torchcss.body.model import BodyModel
from torchcss.body.rotations import axis_angle
from torchcss.errors import ConfigurationError
from torchcss.io.export.selection import Selection
from torchcss.io.export.skeleton import make_skeleton, node_poses, t_pose

_TABLE = """
pelvis         -1  HumanoidRoot
left_hip        0  l_hip
right_hip       0  r_hip
spine1          0  vl5
left_knee       1  l_knee
right_knee      2  r_knee
spine2          3  -
left_ankle      4  l_ankle
right_ankle     5  r_ankle
spine3          6  -
left_foot       7  -
right_foot      8  -
neck            9  vc7
left_collar     9  l_sternoclavicular
right_collar    9  r_sternoclavicular
head           12  -
left_shoulder  13  l_shoulder
right_shoulder 14  r_shoulder
left_elbow     16  l_elbow
right_elbow    17  r_elbow
left_wrist     18  l_wrist
right_wrist    19  r_wrist
left_hand      20  -
right_hand     21  -
"""
SMPL_JOINTS: tuple[tuple[str, int, str | None], ...] = tuple(
    (name, int(parent), None if ours == "-" else ours)
    for name, parent, ours in map(str.split, _TABLE.strip().splitlines())
)
"""SMPL's name, its parent, and the joint of ours that turns there."""


def smpl_arrays(selection: Selection, body: BodyModel) -> dict[str, np.ndarray]:
    """SMPL's parameters of all chosen modes.

    Args:
        selection: The modes.
        body: The body, on the origin.

    Raises:
        ConfigurationError: If the body has none of SMPL's joints.
    """
    skeleton = make_skeleton(body)
    if not {ours for _, _, ours in SMPL_JOINTS} & set(skeleton.names):
        raise ConfigurationError(f"{body.name} has none of SMPL's joints; choose another format")
    lifted = t_pose(skeleton)
    poses, places = [], []
    for mode in range(len(selection.labels)):
        state, base = selection.state[:, mode], selection.base[:, mode]
        rotation, place = node_poses(skeleton, body, state, base)
        rotation = rotation @ lifted.swapaxes(-1, -2)
        # A bare arm hangs on a torso that stands as its base does.
        world = [base[:, :3, :3]]
        if "HumanoidRoot" in skeleton.names:
            world = [rotation[:, skeleton.names.index("HumanoidRoot")]]
        local = [world[0]]
        for _, parent, ours in SMPL_JOINTS[1:]:
            turns = ours in skeleton.names
            world.append(rotation[:, skeleton.names.index(ours)] if turns else world[parent])
            local.append(world[parent].swapaxes(-1, -2) @ world[-1])
        poses.append(axis_angle(np.stack(local, axis=1)).reshape(len(state), -1))
        places.append(place[:, 0])
    vectors, trans = np.stack(poses, axis=1), np.stack(places, axis=1)
    if len(selection.labels) == 1:
        vectors, trans = vectors[:, 0], trans[:, 0]
    return {
        "poses": vectors,
        "global_orient": vectors[..., :3],
        "body_pose": vectors[..., 3:],
        "trans": trans,
        "betas": np.zeros(10),
        "gender": np.array("neutral"),
        "mocap_framerate": np.array(selection.rate),
        "smpl_joint_names": np.array([name for name, _, _ in SMPL_JOINTS], dtype=np.str_),
    }

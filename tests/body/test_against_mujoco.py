"""MJCF bodies against MuJoCo itself: the same poses, solids and limits from the same file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import has_root

mujoco = pytest.importorskip("mujoco", reason="comes with the extra [mjcf]")

TOLERANCE = 1e-9
"""Metres and radians."""

MADE = """<mujoco>
  <compiler angle="{angle}" eulerseq="{sequence}"/>
  <default>
    <joint range="-.5 1.5"/>
    <geom mass="1"/>
    <default class="big"><geom type="capsule" size=".05 .1"/><joint axis="0 1 0"/></default>
  </default>
  <worldbody>
    <body name="base" pos=".3 -.2 1" quat=".8 .2 -.4 .1" childclass="big">
      <joint name="lean" axis="1 2 3" pos=".1 .2 .3"/>
      <geom name="trunk" fromto=".1 0 0 0 .2 .4"/>
      <body name="arm" pos=".1 .2 .3" euler=".3 -.4 .5">
        <joint name="turn" pos="0 0 .1" ref=".4"/>
        <joint name="bend" axis="1 0 1" pos=".1 0 -.1"/>
        <joint name="slide" type="slide" axis="1 1 0" ref="-.2"/>
        <geom name="board" type="box" size=".1 .05 .02" quat="1 0 0 1" pos="0 .1 0"/>
        <geom name="plank" type="box" fromto="0 .1 0 .3 .2 .1" size=".01 .02"/>
        <frame pos="0 0 .2" axisangle="0 .3 1 1.2" childclass="main">
          <body name="hand" pos=".1 0 0" xyaxes="0 1 0 -1 0 .2">
            <joint name="ball" type="ball" pos="0 .1 .2" range="0 1.2"/>
            <geom name="palm" type="ellipsoid" size=".04 .05 .02" zaxis="1 1 .3"/>
            <frame euler=".1 .2 .3">
              <geom name="thumb" type="cylinder" fromto="0 0 0 .1 .1 0" size=".02"/>
              <body name="tip" pos="0 0 .15"><geom name="nail" size=".01" pos="0 0 .02"/></body>
            </frame>
          </body>
        </frame>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def check_against_mujoco(path: Path, generator: torch.Generator) -> None:
    """Random poses within the limits put every body and every solid where MuJoCo does."""
    body = load_body(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    lower, upper = body.lower.clamp(min=-3), body.upper.clamp(max=3)
    share = torch.rand(4, body.num_parameters, generator=generator, dtype=torch.float64)
    states = lower + share * (upper - lower)
    if has_root(body):
        # The two have other parameters of the root; links are compared in its own frame.
        states[:, :6] = 0
    for x in torch.cat([torch.zeros_like(states[:1]), states]):
        data.qpos[:] = generalised_position(model, body, x)
        mujoco.mj_kinematics(model, data)
        tree = body.pose(x).tree
        names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, i) for i in range(model.nbody)]
        root = next(i for i in range(1, model.nbody) if names[i] in body.tree.link_names)
        link = body.tree.link_index(names[root])
        ours = (tree.rotation[link].numpy(), tree.translation[link].numpy())
        theirs = (data.xmat[root].reshape(3, 3), data.xpos[root])
        if not has_root(body):
            np.testing.assert_allclose(ours[0], theirs[0], rtol=0, atol=TOLERANCE)
            np.testing.assert_allclose(ours[1], theirs[1], rtol=0, atol=TOLERANCE)
        compared = 0
        for index, name in enumerate(names):
            if name not in body.tree.link_names or name == "world":
                continue
            link, compared = body.tree.link_index(name), compared + 1
            found = relative(ours, tree.rotation[link].numpy(), tree.translation[link].numpy())
            wanted = relative(theirs, data.xmat[index].reshape(3, 3), data.xpos[index])
            for one, other in zip(found, wanted, strict=True):
                np.testing.assert_allclose(one, other, rtol=0, atol=TOLERANCE, err_msg=name)
        assert compared == model.nbody - 1
        rotation, centre = body.part_poses(body.pose(x))
        for part, name in enumerate(body.part_names):
            index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
            if index < 0:
                continue
            found = relative(ours, rotation[part].numpy(), centre[part].numpy())
            wanted = relative(theirs, data.geom_xmat[index].reshape(3, 3), data.geom_xpos[index])
            np.testing.assert_allclose(found[1], wanted[1], rtol=0, atol=TOLERANCE, err_msg=name)
            np.testing.assert_allclose(found[0], wanted[0], rtol=0, atol=TOLERANCE, err_msg=name)


def relative(
    frame: tuple[np.ndarray, np.ndarray], rotation: np.ndarray, place: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    return frame[0].T @ rotation, frame[0].T @ (place - frame[1])


def generalised_position(model: Any, body: BodyModel, x: torch.Tensor) -> np.ndarray:
    """MuJoCo's coordinates of a state; also checks the limits, joint by joint."""
    position = model.qpos0.copy()
    for joint in range(model.njnt):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
        at, kind = model.jnt_qposadr[joint], model.jnt_type[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            continue
        if kind == mujoco.mjtJoint.mjJNT_BALL:
            turn = np.array([1.0, 0.0, 0.0, 0.0])
            for axis in range(3):
                one, product = np.zeros(4), np.zeros(4)
                angle = float(x[body.state_index(f"{name}_{'xyz'[axis]}")])
                mujoco.mju_axisAngle2Quat(one, np.eye(3)[axis], angle)
                mujoco.mju_mulQuat(product, turn, one)
                turn = product
            position[at : at + 4] = turn
            continue
        index = body.state_index(name)
        position[at] += float(x[index])
        if model.jnt_limited[joint]:
            limits = model.jnt_range[joint] - model.qpos0[at]
            found = [float(body.lower[index]), float(body.upper[index])]
            np.testing.assert_allclose(found, limits, rtol=0, atol=1e-9, err_msg=name)
    return position


@pytest.mark.parametrize("sequence", ["xyz", "zyx", "XYZ", "zXy"])
@pytest.mark.parametrize("angle", ["radian", "degree"])
def test_made_file(tmp_path: Path, angle: str, sequence: str, generator: torch.Generator) -> None:
    path = tmp_path / "made.xml"
    path.write_text(MADE.format(angle=angle, sequence=sequence))
    check_against_mujoco(path, generator)


@pytest.mark.parametrize("name", ["humanoid_CMU.xml", "humanoid_CMU_V2019.xml", "humanoid_gym.xml"])
def test_files_of_others(shared_data: Path, name: str, generator: torch.Generator) -> None:
    check_against_mujoco(shared_data / "robot_models" / name, generator)

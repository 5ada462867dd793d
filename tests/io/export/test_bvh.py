"""BVH: a reader that knows the text alone gives our joints back."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
import torch
from made_tracks import BEAM_UP, export_as, make_track
from reference.bvh import BvhFile, read_bvh

from torchcss import Track, load_body
from torchcss.body.catalog import BODY_NAMES
from torchcss.body.model import BodyModel
from torchcss.body.rotations import ROTATION_ORDERS, about, axis_angle, euler_angles
from torchcss.errors import ConfigurationError
from torchcss.io.tracks import load_track, save_track

LENGTHS = {"thigh": 0.44, "upper_arm": 0.29, "trunk": 0.51, "foot": 0.18}
UP_OF_FILE = np.array(((0, 1, 0), (0, 0, 1), (1, 0, 0)), dtype=np.float64)


def export(track: Track, folder: Path, **options) -> BvhFile:
    done = export_as(track, "bvh", folder, **options)
    return read_bvh(done.paths[0].read_text())


def joints_of(file: BvhFile, names: tuple[str, ...]) -> np.ndarray:
    return file.positions()[:, [file.names.index(name) for name in names]]


@functools.cache
def body_named(name: str) -> BodyModel:
    return load_body(name)


@pytest.mark.parametrize("name", BODY_NAMES)
def test_the_joints_come_back(name: str, tmp_path: Path):
    body = load_body(name, lengths=LENGTHS)
    track = make_track(body, spread=2.0)
    for order in ROTATION_ORDERS:
        for rest in ("hanging", "t-pose"):
            options = {"rotation_order": order, "rest_pose": rest}
            file = export(track, tmp_path, frame="world", **options)
            found = joints_of(file, track.joint_names)
            np.testing.assert_allclose(found, track.joints_world[:, 0], atol=1e-5)
            turns = [[c for c in j.channels if c.endswith("rotation")] for j in file.joints]
            assert all(channels == [f"{letter}rotation" for letter in order] for channels in turns)
            assert file.joints[0].channels[:3] == ("Xposition", "Yposition", "Zposition")
            assert all(len(joint.channels) == 3 for joint in file.joints[1:])
            assert file.frame_time == pytest.approx(1 / 60, abs=1e-8)


def test_h_anim_names_and_parents(tmp_path: Path):
    file = export(make_track(body_named("body34")), tmp_path)
    parent = {j.name: file.names[j.parent] if j.parent >= 0 else None for j in file.joints}
    assert parent["HumanoidRoot"] is None
    chain = ["l_hand_tip", "l_wrist", "l_elbow", "l_shoulder", "l_sternoclavicular", "vt1", "vl5"]
    for below, above in zip(chain, [*chain[1:], "HumanoidRoot"], strict=True):
        assert parent[below] == above
    assert parent["r_toe"] == "r_midtarsal"
    assert parent["skull_tip"] == "skullbase"
    # A joint of ours of three axes is one joint of the file: only landmarks and turns are there.
    assert len(file.joints) == len(body_named("body34").joint_names) + 2
    assert all(bool(j.ends) == (j.name not in parent.values()) for j in file.joints)


def test_zero_channels_are_the_rest_pose(tmp_path: Path):
    track = make_track(body_named("body32"))
    for rest, height in (("hanging", -0.5), ("t-pose", 0.0)):
        file = export(track, tmp_path, rest_pose=rest)
        still = file._replace(motion=np.zeros_like(file.motion[:1])).positions()[0]
        at = dict(zip(file.names, still, strict=True))
        assert at["skull_tip"][1] > 0.7
        assert at["l_toe"][1] < -0.7
        assert at["nose"][2] > 0.05
        assert at["l_shoulder"][0] > 0.1 > -0.1 > at["r_shoulder"][0]
        for side, sign in (("l", 1), ("r", -1)):
            reach = at[f"{side}_wrist"] - at[f"{side}_shoulder"]
            assert reach[1] == pytest.approx(height, abs=0.1)
            assert abs(sign * reach[0] - (0.571 if rest == "t-pose" else 0)) < 1e-5


@pytest.mark.parametrize("rest", ["hanging", "t-pose"])
@pytest.mark.parametrize("frame", ["y-up", "world"])
@pytest.mark.parametrize("name", ["body34", "arm8"])
def test_first_frame_in_t_pose(name: str, rest: str, frame: str, tmp_path: Path):
    track = make_track(body_named(name), up=BEAM_UP)
    options = {"rest_pose": rest, "frame": frame, "world_up": "z"}
    plain = export(track, tmp_path, **options)
    file = export(track, tmp_path, t_pose=True, **options)
    assert len(file.motion) == 4
    np.testing.assert_allclose(file.positions()[1:], plain.positions(), atol=1e-7)
    first = file.positions()[0] @ (np.eye(3) if frame == "y-up" else UP_OF_FILE.T)
    at = dict(zip(file.names, first, strict=True))
    arm = at["r_wrist"] - at["r_shoulder"]
    np.testing.assert_allclose(arm / np.linalg.norm(arm), [-1, 0, 0], atol=1e-5)
    if name == "body34":
        body = at["vt1"] - at["HumanoidRoot"]
        assert body[1] > 0.5
        assert at["nose"][2] > at["skull_tip"][2]
    np.testing.assert_allclose(file.positions()[0, 0], file.positions()[1, 0], atol=1e-7)


@pytest.mark.parametrize("scale", [100.0, 39.37, 0.001])
def test_scale(scale: float, tmp_path: Path):
    track = make_track(body_named("body30"))
    file = export(track, tmp_path, frame="world", scale=scale)
    found = joints_of(file, track.joint_names) / scale
    np.testing.assert_allclose(found, track.joints_world[:, 0], atol=1e-4)


def test_y_up(tmp_path: Path):
    track = make_track(body_named("body34"), up=BEAM_UP)
    done = export_as(track, to="bvh", out=tmp_path)
    assert any("z axis is taken for up" in line for line in done.report)
    file = read_bvh(done.paths[0].read_text())
    found = joints_of(file, track.joint_names)
    np.testing.assert_allclose(found, track.joints_world[:, 0] @ UP_OF_FILE.T, atol=1e-5)


def test_other_scales_and_free_lengths(tmp_path: Path):
    track = make_track(load_body("body34", lengths=LENGTHS, scale=1.08))
    found = joints_of(export(track, tmp_path, frame="world"), track.joint_names)
    np.testing.assert_allclose(found, track.joints_world[:, 0], atol=1e-5)
    # Lengths that change cannot be said: those of the first frame stand, and the report says so.
    loose = make_track(load_body("body30", free_proportions=True, lengths=LENGTHS))
    done = export_as(loose, to="bvh", out=tmp_path, frame="world")
    assert any("lengths change by up to" in line for line in done.report)
    found = joints_of(read_bvh(done.paths[0].read_text()), loose.joint_names)
    np.testing.assert_allclose(found[0], loose.joints_world[0, 0], atol=1e-5)


def test_a_robot(tmp_path: Path):
    urdf = tmp_path / "robot.urdf"
    joints = [("a", "base", "one", "0 0 0", "0 0 1"), ("b", "one", "two", "0 0 0.5", "0 1 0"),
              ("c", "two", "three", "0 0 0", "1 0 0")]  # fmt: skip
    urdf.write_text(
        "<robot name='r'><link name='base'/><link name='one'/><link name='two'/>"
        "<link name='three'/><link name='tip'/>"
        + "".join(
            f"<joint name='{n}' type='continuous'><parent link='{p}'/><child link='{c}'/>"
            f"<origin xyz='{o}' rpy='0.3 0.2 0.1'/><axis xyz='{x}'/></joint>"
            for n, p, c, o, x in joints
        )
        + "<joint name='d' type='fixed'><parent link='three'/><child link='tip'/>"
        "<origin xyz='0.1 0 0.4'/></joint></robot>"
    )
    body = load_body(urdf)
    track = make_track(body)
    file = export(track, tmp_path, frame="world")
    found = joints_of(file, track.joint_names)
    np.testing.assert_allclose(found, track.joints_world[:, 0], atol=1e-5)
    with pytest.raises(ConfigurationError, match="no T-pose"):
        export(track, tmp_path, t_pose=True)


def test_bad_options(tmp_path: Path):
    track = make_track(body_named("body30"))
    for options in ({"rotation_order": "XYX"}, {"scale": 0.0}, {"rest_pose": "sitting"}):
        with pytest.raises(ConfigurationError):
            export_as(track, to="bvh", out=tmp_path, **options)
    assert not list(tmp_path.iterdir())


def test_the_reference_reads_files_of_others(shared_data: Path):
    """The reader that judges ours makes upright people of the motion library's files."""
    for name in ("01_01.bvh", "14_08.bvh"):
        file = read_bvh((shared_data / "mocap_cmu" / name).read_text())
        file = file._replace(motion=file.motion[1:200:50])
        at = dict(zip(file.names, file.positions().swapaxes(0, 1), strict=True))
        height = at["Head"][:, 1] - at["LeftFoot"][:, 1]
        assert (height * 0.056444 > 1.1).all(), name
        assert (height * 0.056444 < 1.6).all(), name


def test_our_words_are_those_of_others(shared_data: Path, tmp_path: Path):
    """Every kind of line of our file stands in the library's, apart from names and numbers."""

    def kinds(text: str) -> set[str]:
        words = (line.split() for line in text.splitlines())
        return {" ".join(w for w in ws[:2] if not w.strip("-").replace(".", "").isdigit()
                         and ws[0] not in ("ROOT", "JOINT", "OFFSET")) for ws in words}  # fmt: skip

    theirs = kinds((shared_data / "mocap_cmu" / "01_01.bvh").read_text())
    done = export_as(make_track(body_named("body34")), to="bvh", out=tmp_path)
    assert kinds(done.paths[0].read_text()) <= theirs | {""}


def test_turns_go_on_without_jumps(tmp_path: Path):
    body = body_named("body30")
    track = make_track(body, counts=(1,) * 40)
    state = np.zeros_like(track.state)
    # Two whole turns about the vertical while the arm goes through a right angle.
    state[:, 0, body.state_index("root_yaw")] = np.linspace(0, 4 * np.pi, 40)
    state[:, 0, body.state_index("l_shoulder_swing")] = np.linspace(-3, 0.5, 40)
    track = track._replace(state=state, base_transform=np.tile(np.eye(4), (40, 1, 1)))
    joints = body.pose(torch.from_numpy(state[:, 0])).joints.numpy()[:, None]
    file = export(track._replace(joints_world=joints), tmp_path, frame="world")
    np.testing.assert_allclose(joints_of(file, track.joint_names), joints[:, 0], atol=1e-5)
    assert np.abs(np.diff(file.motion[:, 3:6], axis=0)).max() < 30
    assert file.motion[-1, 3:6].max() == pytest.approx(720, abs=1e-3)


@pytest.mark.parametrize("order", ROTATION_ORDERS)
def test_euler_angles_at_the_right_angle(order: str):
    i, j, k = ("XYZ".index(letter) for letter in order)
    generator = np.random.default_rng(0)
    angles = generator.uniform(-3, 3, (200, 3))
    angles[:50, 1] = np.pi / 2
    angles[50:100, 1] = -np.pi / 2 + generator.normal(size=50) * 1e-9
    wanted = about(i, angles[:, 0]) @ about(j, angles[:, 1]) @ about(k, angles[:, 2])
    found = euler_angles(wanted, order)
    again = about(i, found[:, 0]) @ about(j, found[:, 1]) @ about(k, found[:, 2])
    np.testing.assert_allclose(again, wanted, atol=3e-9)


def test_axis_angle():
    generator = np.random.default_rng(0)
    axis = generator.normal(size=(300, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    angle = generator.uniform(0, np.pi, 300)
    angle[:30], angle[30:60], angle[60:90] = 0.0, 1e-9, np.pi - 1e-9
    x, y, z = axis.T
    zero = np.zeros(300)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    rotation = np.eye(3) + sine * cross + (1 - cosine) * (cross @ cross)
    np.testing.assert_allclose(axis_angle(rotation), angle[:, None] * axis, atol=1e-7)


def test_written_and_loaded(tmp_path: Path):
    """The same file from a track on disk as from one in memory."""
    track = make_track(body_named("body30"))
    save_track(tmp_path / "track.npz", track)
    assert load_track(tmp_path).frames.tolist() == [0, 1, 2]
    done = export_as(tmp_path, to="bvh")
    assert done.paths == (tmp_path / "track.bvh",)
    other = export_as(track, to="bvh", out=tmp_path / "memory.bvh")
    assert done.paths[0].read_bytes() == other.paths[0].read_bytes()


def test_blanks_in_names_become_underscores(tmp_path: Path):
    """Biped's names have them; some readers end a name there, so that two joints have one name."""
    source = tmp_path / "biped.bvh"
    channels = "CHANNELS 3 Zrotation Xrotation Yrotation\nEnd Site\n{\nOFFSET 0 80 0\n}\n"
    source.write_text(
        "HIERARCHY\nROOT Bip01\n{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition "
        "Zrotation Xrotation Yrotation\nJOINT Bip01 Tail\n{\nOFFSET 0 80 0\n"
        f"{channels}}}\n}}\nMOTION\nFrames: 1\nFrame Time: 0.1\n" + "0 " * 9 + "\n"
    )
    done = export_as(make_track(load_body(source)), "bvh", tmp_path / "out")
    assert "JOINT Bip01_Tail\n" in done.paths[0].read_text()

"""TRC, MOT, C3D, CSV, NPZ and SMPL: headers as others write them, numbers that come back."""

from __future__ import annotations

import csv
import functools
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from made_tracks import BEAM_UP, export_as, make_track
from reference.bvh import rotation
from reference.c3d import read_c3d
from reference.kinematics import rotation as turned_about

from torchcss import load_body
from torchcss.body.model import BodyModel
from torchcss.body.rotations import root_rotation
from torchcss.body.uncertainty import joint_covariance
from torchcss.errors import ConfigurationError, MissingExtraError
from torchcss.io.export.mot import mot_header
from torchcss.io.export.smpl import SMPL_JOINTS
from torchcss.io.export.trc import trc_header
from torchcss.joint_names import ALIASES

UP_OF_FILE = np.array(((0, 1, 0), (0, 0, 1), (1, 0, 0)), dtype=np.float64)


@functools.cache
def body_named(name: str) -> BodyModel:
    return load_body(name)


def test_trc_header_is_upstream_s(shared_data: Path):
    theirs = (shared_data / "balance_beam_4cam" / "upstream_markers.trc").read_bytes()
    lines = theirs.split(b"\n")
    names = [cell for cell in lines[3].decode().split("\t")[2:] if cell]
    ours = trc_header("Demo_0-100.trc", names, 100, 60.0, 0).encode()
    assert theirs.startswith(ours)
    assert theirs[len(ours) :].startswith(b"1\t0.01666")


def test_mot_header_is_upstream_s(shared_data: Path):
    path = shared_data / "balance_beam_4cam" / "upstream_joint_angles_body25b.mot"
    theirs = path.read_bytes()
    head, _, table = theirs.partition(b"endheader\n")
    columns = table.split(b"\n")[0].decode().split("\t")
    ours = mot_header(columns, 100).encode()
    assert theirs.startswith(ours)
    rows = theirs[len(ours) :].split(b"\n")
    # The data, too: sixteen characters a cell.
    cells = rows[0].decode().split("\t")
    assert [f"{float(cell):16.8f}" for cell in cells] == cells
    assert head.startswith(b"Coordinates\n")


def test_trc(tmp_path: Path):
    track = make_track(body_named("body34"), first_frame=7, up=BEAM_UP)
    done = export_as(track, to="trc", out=tmp_path / "walk.trc")
    data = done.paths[0].read_bytes()
    assert b"\r" not in data
    lines = data.decode().split("\n")
    assert lines[0] == "PathFileType\t4\t(X/Y/Z)\twalk.trc"
    assert lines[2] == f"60\t60\t3\t{len(track.joint_names)}\tm\t60\t7\t3"
    assert tuple(cell for cell in lines[3].split("\t")[2:] if cell) == track.joint_names
    table = np.array([[float(cell) for cell in line.split("\t")] for line in lines[5:-1]])
    assert table[:, 0].tolist() == [1, 2, 3]
    np.testing.assert_array_equal(table[:, 1], track.times)
    found = table[:, 2:].reshape(3, -1, 3)
    np.testing.assert_allclose(found, track.joints_world[:, 0] @ UP_OF_FILE.T, atol=1e-12)


def test_angles(tmp_path: Path):
    body = body_named("body30")
    track = make_track(body)
    path = export_as(track, to="angles", out=tmp_path).paths[0]
    assert path.name == "track_angles.csv"
    rows = list(csv.DictReader(path.read_text().splitlines()))
    assert len(rows[0]) == 2 + 2 * (len(body.state_names) - 6)
    knee = body.state_index("l_knee_flexion")
    for t, row in enumerate(rows):
        assert int(row["frame"]) == track.frames[t]
        expected = track.state[t, 0, knee], math.sqrt(track.covariance[t, 0, knee, knee])
        found = float(row["l_knee_flexion_deg"]), float(row["l_knee_flexion_deg_sd"])
        np.testing.assert_allclose(found, np.degrees(expected), atol=1e-6)
    path = export_as(track, to="angles", out=tmp_path / "a.csv", mode=2).paths[0]
    cells = [line.split(",")[2] for line in path.read_text().splitlines()[1:]]
    assert cells.count("") == 2


def test_angles_of_joints_whose_names_have_commas(tmp_path: Path):
    (tmp_path / "a.urdf").write_text(
        "<robot name='a'><link name='b'/><link name='c'/><joint name='turn, first' "
        "type='continuous'><parent link='b'/><child link='c'/></joint></robot>"
    )
    track = make_track(load_body(tmp_path / "a.urdf"))
    text = export_as(track, to="angles", out=tmp_path).paths[0].read_text()
    heads = ["frame", "time", "turn, first_deg", "turn, first_deg_sd"]
    assert next(csv.reader(text.splitlines())) == heads


def test_missing_modes_are_empty_cells(tmp_path: Path):
    track = make_track(body_named("body30"))
    done = export_as(track, to="trc", out=tmp_path, mode=2, frame="world")
    assert done.paths[0].name == "track_mode2.trc"
    assert "mode2: absent in 2 of 3 frames" in done.report
    rows = [line.split("\t") for line in done.paths[0].read_text().split("\n")[5:-1]]
    assert all(len(row) == 2 + 3 * len(track.joint_names) for row in rows)
    assert not any(rows[0][2:] + rows[2][2:])
    assert [float(cell) for cell in rows[1][2:]] == track.joints_world[1, 2].flatten().tolist()


@pytest.mark.parametrize("name", ["body34", "arm7"])
def test_mot(name: str, tmp_path: Path):
    body = body_named(name)
    track = make_track(body, up=BEAM_UP)
    done = export_as(track, to="mot", out=tmp_path)
    lines = done.paths[0].read_text().split("\n")
    assert lines[2:5] == ["nRows=3", f"nColumns={1 + body.num_parameters}", "inDegrees=yes"]
    assert lines[10].split("\t") == ["time", *body.state_names]
    table = np.array([[float(cell) for cell in line.split("\t")] for line in lines[11:-1]])
    np.testing.assert_allclose(table[:, 0], track.times, atol=1e-8)
    ours = table[:, 1:].copy()
    angles = [not n.startswith("root_") for n in body.state_names]
    np.testing.assert_allclose(np.radians(ours[:, angles]), track.state[:, 0][:, angles], atol=1e-8)
    if name == "arm7":
        return
    # The root, in a world whose Y is up, poses the body where the track has it.
    root = torch.from_numpy(ours[:, :6].copy())
    turn = root_rotation(root[:, 3:].deg2rad()).numpy()
    pelvis = track.joint_names.index("HumanoidRoot"), track.joint_names.index("vl5")
    joints = track.joints_world[:, 0] @ UP_OF_FILE.T
    np.testing.assert_allclose(ours[:, :3], joints[:, pelvis[0]], atol=1e-7)
    above = turn @ np.array([0.0, 0.12, -0.03])
    np.testing.assert_allclose(joints[:, pelvis[1]] - joints[:, pelvis[0]], above, atol=1e-7)


@pytest.mark.parametrize(
    ("frame", "screen", "turn"),
    [("world", ("+X", "+Y"), np.eye(3)), ("y-up", ("+X", "+Y"), np.eye(3)),
     (None, ("+Y", "+Z"), UP_OF_FILE.T)],
)  # fmt: skip
def test_c3d(tmp_path: Path, frame: str | None, screen: tuple[str, str], turn: np.ndarray):
    """By default Z is up, as in laboratories; the file says its axes."""
    pytest.importorskip("ezc3d")
    track = make_track(body_named("body34"), first_frame=3)
    for mode in (0, 2):
        done = export_as(track, to="c3d", out=tmp_path, mode=mode, frame=frame, world_up="y")
        file = read_c3d(done.paths[0].read_bytes())
        assert file.labels == track.joint_names
        assert (file.units, file.rate, file.screen) == ("m", 60.0, screen)
        assert (file.first - 1) / file.rate == track.times[0]
        present = track.num_modes > mode
        places = track.joints_world[present, mode] @ turn.T
        np.testing.assert_allclose(file.points[present], places, rtol=1e-6, atol=1e-7)
        assert np.isnan(file.points[~present]).all()


def test_blanks_in_names_part_no_columns():
    """Some readers of TRC and OpenSim's of MOT part columns at blanks, which Biped's names have."""
    names = ("Bip01 L Hand", "Bip01 Spine")
    assert trc_header("a.trc", names, 1, 30.0, 0).split("\n")[3].split()[2:] == [
        "Bip01_L_Hand",
        "Bip01_Spine",
    ]
    assert mot_header(("time", *names), 1).split("\n")[-2].split() == [
        "time",
        "Bip01_L_Hand",
        "Bip01_Spine",
    ]


def test_c3d_refuses_places_that_its_numbers_cannot_tell_apart(tmp_path: Path):
    """At 4200 km from the origin, as in UTM coordinates, single precision has steps of 0.5 m."""
    track = make_track(body_named("arm7"))
    far = track._replace(joints_world=track.joints_world + np.array([5e5, 4.2e6, 0.0]))
    with pytest.raises(ConfigurationError, match=r"4\d{6} m from .* 0\.5 m apart; .* trc or csv"):
        export_as(far, to="c3d", out=tmp_path)
    assert not list(tmp_path.iterdir())


def test_c3d_without_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[c3d\]"):
        export_as(make_track(body_named("arm7")), to="c3d", out=tmp_path)
    assert not list(tmp_path.iterdir())


def test_tables(tmp_path: Path):
    body = body_named("body32")
    track = make_track(body, first_frame=10)
    npz = export_as(track, to="npz", mode="all", out=tmp_path).paths
    table = export_as(track, to="csv", mode="all", out=tmp_path).paths
    assert [path.name for path in (*npz, *table)] == ["track_joints.npz", "track_joints.csv"]
    with np.load(npz[0]) as archive:
        arrays = dict(archive)
    present = track.log_weight > -np.inf
    assert (arrays["mode"] >= 0).tolist() == present.tolist()
    np.testing.assert_array_equal(arrays["joints"][present], track.joints_world[present])
    assert np.isnan(arrays["joints"][~present]).all()
    assert np.isnan(arrays["joint_covariance"][~present]).all()
    for t, m in np.argwhere(present):
        base = torch.from_numpy(track.base_transform[t])
        pose = body.with_base(base[:3, :3], base[:3, 3]).pose(torch.from_numpy(track.state[t, m]))
        expected = joint_covariance(
            body.with_base(base[:3, :3], base[:3, 3]),
            pose,
            torch.from_numpy(track.covariance[t, m]),
        )
        np.testing.assert_allclose(arrays["joint_covariance"][t, m], expected.numpy(), atol=1e-12)
    with table[0].open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == present.sum() * len(track.joint_names)
    row = next(r for r in rows if (r["frame"], r["mode"], r["joint"]) == ("11", "2", "l_wrist"))
    j = track.joint_names.index("l_wrist")
    assert [float(row[axis]) for axis in "xyz"] == track.joints_world[1, 2, j].tolist()
    covariance = arrays["joint_covariance"][1, 2, j]
    for key, a, b in (("cov_xx", 0, 0), ("cov_xz", 0, 2), ("cov_yz", 1, 2)):
        assert float(row[key]) == covariance[a, b]
    assert float(row["weight"]) == pytest.approx(math.exp(track.log_weight[1, 2]))
    assert int(row["parent"]) == track.parent[1, 2]


def test_covariances_turn_with_the_frame(tmp_path: Path):
    body = body_named("arm8")
    track = make_track(body, up=BEAM_UP)
    found = []
    for frame in ("world", "y-up"):
        options = {"frame": frame, "world_up": "z"}
        path = export_as(track, to="npz", out=tmp_path, **options).paths[0]
        with np.load(path) as archive:
            found.append((archive["joint_covariance"], archive["frame_from_world"]))
    turn = found[1][1]
    np.testing.assert_array_equal(turn, UP_OF_FILE)
    np.testing.assert_allclose(found[1][0], turn @ found[0][0] @ turn.T, atol=1e-15)


def test_smpl_joints_are_smpl_s():
    assert len(SMPL_JOINTS) == 24
    for (_, _, ours), alias in zip(SMPL_JOINTS, ALIASES["SMPL-24"], strict=True):
        # vc7 is where our neck turns; the collar is no landmark of ours.
        assert ours in (alias, None, "vc7", "l_sternoclavicular", "r_sternoclavicular")


def posed_smpl(vectors: np.ndarray) -> list[np.ndarray]:
    """World orientations of SMPL's joints, by the exponential map."""
    world: list[np.ndarray] = []
    for vector, (_, parent, _) in zip(vectors.reshape(24, 3), SMPL_JOINTS, strict=True):
        local = turned_about(*vector).numpy()
        world.append(local if parent < 0 else world[parent] @ local)
    return world


T_POSE_BONES = {
    # SMPL's joint, ours at both ends of a bone, its direction in SMPL's T-pose.
    "pelvis": ("HumanoidRoot", "vl5", (0, 0.12, -0.03)),
    "spine1": ("vl5", "vt1", (0, 1, 0)),
    "neck": ("skullbase", "skull_tip", (0, 1, 0)),
    "left_hip": ("l_hip", "l_knee", (0, -1, 0)),
    "right_knee": ("r_knee", "r_ankle", (0, -1, 0)),
    "left_ankle": ("l_midtarsal", "l_heel", (0, -0.02, -0.123)),
    "left_collar": ("vt1", "l_shoulder", None),
    "left_shoulder": ("l_shoulder", "l_elbow", (1, 0, 0)),
    "left_elbow": ("l_elbow", "l_wrist", (1, 0, 0)),
    "left_wrist": ("l_wrist", "l_hand_tip", (1, 0, 0)),
    "right_shoulder": ("r_shoulder", "r_elbow", (-1, 0, 0)),
    "right_elbow": ("r_elbow", "r_wrist", (-1, 0, 0)),
    "right_wrist": ("r_wrist", "r_hand_tip", (-1, 0, 0)),
}


@pytest.mark.parametrize("name", ["body34", "body30", "arm7", "arm8"])
def test_smpl_limbs_point_where_ours_do(name: str, tmp_path: Path):
    body = body_named(name)
    track = make_track(body, spread=2.0)
    path = export_as(track, to="npz-smpl", mode="all", out=tmp_path).paths[0]
    with np.load(path) as archive:
        poses, trans = archive["poses"], archive["trans"]
        assert archive["smpl_joint_names"].tolist() == [joint for joint, _, _ in SMPL_JOINTS]
        np.testing.assert_array_equal(archive["body_pose"], poses[..., 3:])
        np.testing.assert_array_equal(archive["global_orient"], poses[..., :3])
    assert poses.shape == (3, 3, 72)
    place = {joint: index for index, joint in enumerate(track.joint_names)}
    checked = 0
    for t, m in np.argwhere(track.log_weight > -np.inf):
        world = posed_smpl(poses[t, m])
        joints = track.joints_world[t, m]
        for index, (smpl, _, _) in enumerate(SMPL_JOINTS):
            start, end, direction = T_POSE_BONES.get(smpl, ("", "", None))
            if direction is None or not {start, end} <= set(place):
                continue
            bone = joints[place[end]] - joints[place[start]]
            wanted = world[index] @ (np.array(direction) / np.linalg.norm(direction))
            np.testing.assert_allclose(bone / np.linalg.norm(bone), wanted, atol=1e-6)
            checked += 1
        if "HumanoidRoot" in place:
            np.testing.assert_allclose(trans[t, m], joints[place["HumanoidRoot"]], atol=1e-9)
    assert checked >= 3 * 7


def test_smpl_of_the_t_pose_is_zero(tmp_path: Path):
    """And palms face down there: turning the arms back in by a right angle is our zero pose."""
    body = body_named("body34")
    track = make_track(body, counts=(1,))
    state = np.zeros_like(track.state)
    joints = body.pose(torch.from_numpy(state[0])).joints.numpy()[None]
    track = track._replace(state=state, joints_world=joints, base_transform=np.eye(4)[None])
    path = export_as(track, to="npz-smpl", out=tmp_path).paths[0]
    with np.load(path) as archive:
        poses = archive["poses"].reshape(24, 3)
        assert archive["poses"].shape == (1, 72)
        assert archive["betas"].tolist() == [0.0] * 10
    names = [joint for joint, _, _ in SMPL_JOINTS]
    for side, sign in (("left", -1), ("right", 1)):
        vector = poses[names.index(f"{side}_shoulder")]
        np.testing.assert_allclose(vector, [0, 0, sign * np.pi / 2], atol=1e-9)
        palm = rotation(2, sign * np.pi / 2) @ [0, -1, 0]
        np.testing.assert_allclose(palm, [sign, 0, 0], atol=1e-12)  # to the thigh
    others = [i for i, n in enumerate(names) if "shoulder" not in n]
    np.testing.assert_allclose(poses[others], 0, atol=1e-9)


def test_options_of_one_format_only(tmp_path: Path):
    track = make_track(body_named("arm7"))
    with pytest.raises(ConfigurationError, match="scale: only for bvh, not for trc"):
        export_as(track, to="trc", out=tmp_path, scale=100.0)

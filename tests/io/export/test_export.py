"""What goes into a file and where it goes: modes, frames, up axis, names, errors, the verb."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from made_tracks import export_as, make_track

from torchcss import Track, load_body
from torchcss.cli import main as cli
from torchcss.errors import ConfigurationError, OutputError, TrackFileError
from torchcss.io.cameras import camera_entry
from torchcss.io.export import FORMATS
from torchcss.io.export.selection import DEFAULT_FRAME_RATE, UP_AXES, SelectionChoice, select
from torchcss.io.tracks import save_track, write_summary
from torchcss.io.video import VideoWriter
from torchcss.io.view_files import RecordedCamera, ViewFiles
from torchcss.vision.camera import Camera

BODY = load_body("arm8")
PERSON = load_body("body30")


@pytest.fixture
def track() -> Track:
    return make_track(BODY, counts=(2, 3, 2, 3), first_frame=4)


@pytest.fixture
def folder(track: Track, tmp_path: Path) -> Path:
    save_track(tmp_path / "track.npz", track)
    return tmp_path


def test_frames(track: Track):
    assert select(track).frames.tolist() == [4, 5, 6, 7]
    assert select(track, SelectionChoice(start=5, stop=7)).frames.tolist() == [5, 6]
    chosen = select(track, SelectionChoice(start=5, stride=2))
    assert chosen.frames.tolist() == [5, 7]
    assert chosen.rate == 30.0
    for options in ({"start": 8}, {"stop": 4}, {"stride": 0}):
        with pytest.raises(ConfigurationError, match=r"frames|stride"):
            select(track, SelectionChoice(**options))


def test_modes(track: Track):
    assert select(track).rank.tolist() == [[0]] * 4
    every = select(track, SelectionChoice(mode="all"))
    assert every.labels == ("mode0", "mode1", "mode2")
    assert every.rank.tolist() == [[0, 1, -1], [0, 1, 2], [0, 1, -1], [0, 1, 2]]
    # Where a frame lacks the mode, the nearest pose stands: that before, at the start that after.
    state = every.state[:, 2]
    np.testing.assert_array_equal(state[[0, 1, 2]], track.state[[1, 1, 1], 2])
    np.testing.assert_array_equal(state[3], track.state[3, 2])
    np.testing.assert_array_equal(every.base[2, 2], track.base_transform[1])
    assert np.isnan(every.joints[2, 2]).all()
    for mode in (3, -1, 1.5, "worst", True):
        with pytest.raises(ConfigurationError, match="mode"):
            select(track, SelectionChoice(mode=mode))  # type: ignore[arg-type]


def test_following_the_parents(track: Track):
    for k in range(3):
        found = select(track, SelectionChoice(mode=k, follow=True)).rank[:, 0].tolist()
        expected = [k]
        for t in (3, 2, 1):
            expected.insert(0, int(track.parent[t, expected[0]]))
        assert found == expected
    alone = select(track, SelectionChoice(mode=1, follow=True, stride=2)).rank[:, 0].tolist()
    assert alone == select(track, SelectionChoice(mode=1, follow=True)).rank[::2, 0].tolist()
    orphan = track._replace(parent=np.full_like(track.parent, -1))
    alone = select(orphan, SelectionChoice(mode=1, follow=True)).rank[:, 0].tolist()
    assert alone == [-1, -1, -1, 1]
    with pytest.raises(ConfigurationError, match="the last chosen frame lacks it"):
        select(track, SelectionChoice(mode=2, follow=True, stop=7))
    few = select(track, SelectionChoice(mode="all", follow=True, stop=7))
    assert few.rank.shape[1] == track.num_modes[track.frames < 7][-1]


def test_an_arm_stands_as_the_pictures_do(tmp_path: Path):
    """Its base may lie as it likes; the camera of the summary tells what is up."""
    track = make_track(BODY, counts=(1, 1))
    assert select(track, frame="y-up").report[-1].startswith("the world's y axis")  # the base's
    save_track(tmp_path / "track.npz", track)
    # Right, down and forward of a camera that looks along the world's y axis, z up.
    camera = Camera(
        [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], (640, 480),
        R_camera_world=[[1.0, 0, 0], [0, 0, -1], [0, 1, 0]],
    )  # fmt: skip
    entry = {"units": "metre, pixel", "cameras": {"one": camera_entry(camera)}}
    write_summary(tmp_path, entry)
    done = export_as(tmp_path, to="trc")
    assert any("z axis is taken for up (the picture's upward" in line for line in done.report)


@pytest.mark.parametrize("axis", UP_AXES)
def test_the_up_axis_is_found(axis: str):
    upright = make_track(PERSON, counts=(1, 1))
    turn = np.eye(4)
    chosen = select(upright, SelectionChoice(world_up=axis), frame="y-up")
    # The body stands along Y; a world whose axis is `axis` has it turned back.
    turn[:3, :3] = chosen.turn.T
    assert np.linalg.det(chosen.turn) == pytest.approx(1)
    turned = upright._replace(
        base_transform=turn @ upright.base_transform,
        joints_world=upright.joints_world @ chosen.turn,
    )
    found = select(turned, frame="y-up")
    np.testing.assert_array_equal(found.turn, chosen.turn)
    assert any(f"the world's {axis} axis is taken for up" in line for line in found.report)
    np.testing.assert_allclose(found.joints, upright.joints_world[:, :1], atol=1e-12)
    with pytest.raises(ConfigurationError, match="world_up"):
        select(upright, SelectionChoice(world_up="up"))


def test_who_bends_over_stands_as_the_pictures_do():
    track = make_track(PERSON, counts=(1, 1))
    hips, head = (track.joint_names.index(name) for name in ("HumanoidRoot", "skull_tip"))
    track.joints_world[:, 0, hips] = 0.0
    track.joints_world[:, 0, head] = [[0, 1, 0], [0, 0.1, 0.9]]

    def up(track: Track, **choice: int) -> str:
        return select(track, SelectionChoice(**choice), frame="y-up").report[0]

    assert "the world's y axis" in up(track)
    assert "the world's y axis" in up(track, start=1)  # a part stands as the whole
    track.joints_world[0, 0, head] = [0, 0.8, 0.9]
    assert "the world's z axis" in up(track)
    camera = Camera(
        [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], (640, 480),
        R_camera_world=np.diag([1.0, -1, -1]),
    )  # fmt: skip
    assert "the world's y axis" in up(track._replace(cameras=(RecordedCamera(camera),)))


def test_rates(track: Track):
    assert select(track).rate == 60.0
    assert select(track._replace(times=np.arange(4) * 1001 / 30000)).rate == pytest.approx(29.97003)
    rough = select(track._replace(times=np.array([0.0, 0.04, 0.08, 0.2])))
    assert rough.rate == pytest.approx(25.0)
    assert any("not evenly spaced" in line for line in rough.report)
    rounded = track._replace(times=np.array([0.0, 0.033, 0.067, 0.1]))  # milliseconds
    assert select(rounded).rate == pytest.approx(30.0)
    assert not any("evenly" in line for line in select(rounded).report)
    assert select(track, SelectionChoice(stop=5)).rate == 60.0


@pytest.mark.parametrize("to", ["trc", "mot", "csv", "angles"])
def test_columns_of_times_have_each_frames_own(track: Track, tmp_path: Path, to: str):
    times = np.array([0.0, 0.04, 0.12, 0.2])
    save_track(tmp_path / "track.npz", track._replace(times=times))
    paths, report = export_as(tmp_path, to=to)
    rows = [re.split(r"[,\t]", line.strip()) for line in paths[0].read_text().splitlines()]
    (head,) = [row for row in rows if "time" in (name.lower() for name in row)]
    column = [name.lower() for name in head].index("time")
    found = {float(row[column]) for row in rows[rows.index(head) + 1 :] if row[0][:1].isdigit()}
    assert sorted(found) == pytest.approx(times)
    assert any("not evenly spaced in time (40.0 to 80.0 ms)" in line for line in report)


def test_the_rate_of_a_track_of_one_frame(tmp_path: Path):
    single = make_track(BODY, counts=(2,))
    alone = select(single)
    assert alone.rate == DEFAULT_FRAME_RATE
    assert any("25 is written: neither the track nor a video" in line for line in alone.report)
    camera = Camera([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], (640, 480))
    with VideoWriter(tmp_path / "film.mp4", 50) as writer:
        writer.write(np.zeros((16, 16, 3), np.uint8))
    for name, rate in (("film.mp4", 50.0), ("gone.mp4", DEFAULT_FRAME_RATE)):
        files = ViewFiles(video=tmp_path / name, keypoints=None)
        found = select(single._replace(cameras=(RecordedCamera(camera, files),)))
        assert found.rate == rate
        assert any(f"a frame rate of {rate:g} is written" in line for line in found.report)


def test_a_folder_with_a_smoothed_track_alone(track: Track, tmp_path: Path):
    save_track(tmp_path / "smooth.npz", track)
    with pytest.raises(TrackFileError, match=r"track\.npz: is missing, .*smooth\.npz: give that"):
        export_as(tmp_path, to="trc")


@pytest.mark.parametrize("to", [to for to in FORMATS if to != "c3d"])
def test_every_format_by_the_verb(to: str, folder: Path, capsys: pytest.CaptureFixture[str]):
    before = (folder / "track.npz").read_bytes()
    assert cli.main(["export", str(folder), "--to", to, "--mode", "all"]) == 0
    out = capsys.readouterr().out
    written = sorted(path.name for path in folder.iterdir() if path.name != "track.npz")
    assert len(written) == (1 if to in ("csv", "npz", "npz-smpl") else 3)
    assert all(f"wrote {folder / name}" in out for name in written)
    assert (folder / "track.npz").read_bytes() == before


def test_names(folder: Path, track: Track):
    def names(**options) -> list[str]:
        return [path.name for path in export_as(folder / "track.npz", **options).paths]

    assert names(to="trc") == ["track.trc"]
    assert names(to="trc", mode=1) == ["track_mode1.trc"]
    assert names(to="trc", mode=1, out=folder / "walk.TRC") == ["walk.TRC"]
    assert names(to="trc", mode="all", out=folder / "walk.trc") == [
        "walk_mode0.trc", "walk_mode1.trc", "walk_mode2.trc",
    ]  # fmt: skip
    assert names(to="csv", mode="all", out=folder / "new" / "folder") == ["track_joints.csv"]
    assert (folder / "new" / "folder" / "track_joints.csv").is_file()
    with pytest.raises(ConfigurationError, match="give a file or a folder"):
        export_as(track, to="trc")
    # What is made of a smoothed track does not replace what was made of the track.
    save_track(folder / "smooth.npz", track)
    found = [export_as(folder / "smooth.npz", to=to).paths[0].name for to in ("trc", "csv")]
    assert found == ["smooth.trc", "smooth_joints.csv"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--to", "npz", "--out", "{folder}/track.npz"], "is the track itself"),
        (["--to", "bvh", "--out", "{folder}/a.trc"], "no name for bvh"),
        (["--to", "mot", "--mode", "9"], "no chosen frame has it"),
        (["--to", "csv", "--start", "100"], "no frames to export"),
        (["--to", "trc", "--t-pose"], "only for bvh"),
        (["--to", "bvh", "--scale", "-1"], "scale"),
        (["--to", "bvh", "--out", "{folder}/track.npz/x"], "cannot be written"),
    ],
)
def test_one_clear_line(
    arguments: list[str], complaint: str, folder: Path, capsys: pytest.CaptureFixture[str]
):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    filled = [argument.format(folder=folder) for argument in arguments]
    assert cli.main(["export", str(folder), *filled]) == 2
    errors = capsys.readouterr().err
    assert complaint in errors
    assert errors.count("\n") == 1
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_file_that_is_there_survives_a_full_disk(folder: Path, monkeypatch: pytest.MonkeyPatch):
    export_as(folder, to="trc")
    before = (folder / "track.trc").read_bytes()

    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OutputError, match="disk is full"):
        export_as(folder, to="trc", stride=2)
    assert (folder / "track.trc").read_bytes() == before
    assert sorted(path.name for path in folder.iterdir()) == ["track.npz", "track.trc"]


def test_no_track(tmp_path: Path):
    with pytest.raises(TrackFileError):
        export_as(tmp_path, to="trc")
    with pytest.raises(ConfigurationError, match="to: expected"):
        export_as(tmp_path, to="fbx")
    with pytest.raises(ConfigurationError, match="frame: expected"):
        export_as(tmp_path, to="trc", frame="x-up")  # type: ignore[arg-type]

"""A run on disk: what it knows survives, and what a folder of version 0.1 lacks is asked for."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from made_robots import write_arm
from made_tracks import make_track, save_v01_track

import torchcss
from torchcss import Run, load_body
from torchcss.app.track import TrackOptions
from torchcss.body.bases import pose_track
from torchcss.body.model import BodyModel
from torchcss.body.shape import with_shape
from torchcss.cli import main as cli
from torchcss.errors import ConfigurationError, TrackFileError
from torchcss.inference.mixture import GaussianMixture
from torchcss.initialise.result import Initialisation
from torchcss.io.cameras import calibration
from torchcss.io.fitted_body import write_fitted_body
from torchcss.io.run import Given, GivenKeypoints
from torchcss.io.tracks import Track, save_track, write_summary
from torchcss.io.view_files import (
    RecordedCamera,
    ViewFiles,
    camera_from_plain,
    camera_to_plain,
)
from torchcss.show.posterior_plots import plot_track
from torchcss.show.viewer import view_track
from torchcss.vision.camera import Camera

needs_viewer = pytest.mark.skipif(
    find_spec("rerun") is None, reason='the viewer needs pip install ".[viewer]"'
)


def camera(name: str, shift: float) -> Camera:
    return Camera(
        [[500.0, 0, 320], [0, 510, 240], [0, 0, 1]], (640, 480),
        distortion=[0.1, -0.05, 0, 0.01, 0],
        R_camera_world=[[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], t_camera_world=[shift, 0.5, 4.0],
        name=name,
    )  # fmt: skip


@pytest.fixture
def robot(tmp_path: Path) -> BodyModel:
    """An arm from a file that is gone, with another shape, limits and priors than the file's."""
    path = write_arm(tmp_path / "arm.urdf")
    body = load_body(path, free_root=True)
    path.unlink()
    body.lower[-1], body.upper[-1] = -0.7, 0.9
    body.sticky_mean[-1], body.sticky_deviation[-1] = 0.1, 0.3
    body.motion_rate[-1] = 1.25
    body.neighbours = (body.part_names[:2],)
    return with_shape(body, 1.2 * body.part_shape)


@pytest.fixture
def track(robot: BodyModel, tmp_path: Path) -> Track:
    views = [
        ViewFiles(video=tmp_path / f"{name}.mp4", keypoints=tmp_path / f"{name}.npz", offset=offset)
        for name, offset in (("left", 0), ("right", 3))
    ]
    cameras = (
        RecordedCamera(camera("left", 0.1), views[0]),
        RecordedCamera(camera("right", -0.3), views[1]),
    )
    settings = {"body": robot.name, "samples": 7, "terms": ["joints"], "stature": None}
    return make_track(robot, (2, 3, 2, 2), rate=25)._replace(cameras=cameras, settings=settings)


def test_a_robot_with_its_shape_and_two_cameras_survives(track: Track, tmp_path: Path) -> None:
    body = track.body
    assert body is not None
    save_track(tmp_path / "track.npz", track)
    write_summary(tmp_path, {"ended": "complete"})
    run = Run.open(tmp_path)
    assert (run.folder, run.path.name) == (tmp_path, "track.npz")
    assert run.settings == track.settings
    assert run.checkpoint is None
    assert run.summary["ended"] == "complete"
    for known, given in zip(run.cameras, track.cameras, strict=True):
        assert known.files == given.files
        for name, tensor in given.camera.state_dict().items():
            torch.testing.assert_close(known.camera.state_dict()[name], tensor, rtol=0, atol=1e-12)
        assert (known.camera.name, known.camera.image_size_wh) == (given.camera.name, (640, 480))

    smoothed = torchcss.smooth(run)
    again = Run.open(tmp_path / "smooth.npz")
    for one in (run, smoothed, again):
        assert_same_body(one.body, body)
        assert len(one.cameras) == 2
        state, base = torch.from_numpy(one.track.state), torch.from_numpy(one.track.base_transform)
        joints = pose_track(one.body, state, base[:, None]).joints.numpy()
        there = one.track.log_weight > -np.inf
        np.testing.assert_allclose(joints[there], one.track.joints_world[there], atol=1e-12)
    for to in ("bvh", "mot", "trc", "csv", "npz"):
        for one in (run, again):
            assert torchcss.export(one, tmp_path / to, to=to).paths[0].stat().st_size > 100
    assert torchcss.export(tmp_path, tmp_path / "own.bvh").paths == (tmp_path / "own.bvh",)
    drawn = plot_track(again)
    assert {path.stem for path in drawn} >= {"modes", "joints", "side_view"}
    assert drawn[0].parent.name == "smooth_plots"


@needs_viewer
def test_a_robot_with_its_shape_and_two_cameras_is_viewed(track: Track, tmp_path: Path) -> None:
    save_track(tmp_path / "track.npz", track)
    write_summary(tmp_path, {"ended": "complete"})
    view_track(Run.open(tmp_path), save=tmp_path / "track.rrd")
    assert (tmp_path / "track.rrd").stat().st_size > 1000


def test_a_camera_is_read_back_bit_for_bit(tmp_path: Path) -> None:
    """A resumed run goes on with it: a last bit is another track after a second."""
    draw = np.random.default_rng(0)
    for _ in range(20):
        turn, _ = np.linalg.qr(draw.normal(size=(3, 3)))
        turn *= np.linalg.det(turn)
        turned = Camera(
            [[900.0, 0, 320], [0, 900, 240], [0, 0, 1]], (640, 480), R_camera_world=turn.round(9)
        )
        entry = json.loads(json.dumps(camera_to_plain(RecordedCamera(turned))))
        found = camera_from_plain(entry, tmp_path).camera.state_dict()
        assert all(torch.equal(found[name], value) for name, value in turned.state_dict().items())


def assert_same_body(one: BodyModel, other: BodyModel) -> None:
    assert (one.name, one.state_names, one.part_names) == (
        other.name, other.state_names, other.part_names,
    )  # fmt: skip
    assert one.neighbours == other.neighbours
    for name, tensor in one.state_dict().items():
        assert torch.equal(tensor, other.state_dict()[name]), name
    x = (
        0.3
        * torch.randn(5, one.num_parameters, generator=torch.Generator().manual_seed(0)).double()
    )
    for name in ("joints", "surface"):
        left, right = (
            body.pose(x).joints if name == "joints" else body.surface(body.pose(x)).points
            for body in (one, other)
        )
        torch.testing.assert_close(left, right, rtol=0, atol=1e-12)


def test_files_that_moved_with_the_run_are_found(track: Track, tmp_path: Path) -> None:
    save_track(tmp_path / "track.npz", track)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (tmp_path / "track.npz").rename(elsewhere / "track.npz")
    (elsewhere / "left.mp4").touch()
    files = Run.open(elsewhere).cameras[0].files
    assert files is not None
    assert files.video == elsewhere / "left.mp4"
    assert files.keypoints == tmp_path / "left.npz"


def test_what_is_given_counts_first(track: Track, tmp_path: Path) -> None:
    save_track(tmp_path / "track.npz", track)
    other = Run.open(tmp_path, Given(camera_name="right"))
    assert [each.camera.name for each in other.cameras] == ["right", "left"]
    by_video = Run.open(tmp_path, Given(video=tmp_path / "moved" / "right.mp4"))
    assert by_video.camera.name == "right"
    files = (
        Run.open(tmp_path, Given(video=Path("new.mp4")), GivenKeypoints(keypoints=Path("new.npz")))
        .cameras[0]
        .files
    )
    assert files == ViewFiles(video=Path("new.mp4"), keypoints=Path("new.npz"))
    by_name = Given(video="new.mp4"), GivenKeypoints(keypoints="new.npz")  # type: ignore[arg-type]
    assert Run.open(tmp_path, *by_name).cameras[0].files == files
    assert TrackOptions(masks="new.mp4").masks == Path("new.mp4")  # type: ignore[arg-type]
    assert len(repr(other)) < 200
    with pytest.raises(TrackFileError, match="no camera 'up'; it has left, right"):
        Run.open(tmp_path, Given(camera_name="up"))


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A folder of version 0.1 that holds nothing but the track."""
    folder = tmp_path / "old"
    folder.mkdir()
    save_v01_track(folder / "track.npz", make_track(load_body("body30"), (2, 2, 2, 2)))
    return folder


def test_an_old_folder_opens_with_what_it_holds(old: Path) -> None:
    body = load_body("body30", lengths={"forearm": 0.27})
    body = with_shape(body, 1.1 * body.part_shape)
    save_v01_track(old / "track.npz", make_track(body, (2, 2)))
    spread = torch.eye(body.num_parameters).double()[None]
    mixture = GaussianMixture(body.rest[None], spread, torch.zeros(1).double())
    found = Initialisation(body, mixture, torch.zeros(1).double(), (), dict(body.lengths))
    write_fitted_body(old / "body.npz", found, camera("a", 0.0))
    views = ((camera("a", 0.0), "a.mp4"), (camera("b", 1.0), "b.mp4"))
    write_summary(
        old,
        {
            "settings": {"body": "body30"}, "video": "x/a.mp4", "camera": "a",
            "other_views": [{"video": "x/b.mp4", "camera": "b"}], **calibration(*views),
        },
    )  # fmt: skip
    run = Run.open(old)
    assert torch.equal(run.body.part_shape, body.part_shape)
    assert [each.camera.name for each in run.cameras] == ["a", "b"]
    assert run.cameras[1].files == ViewFiles(video=Path("x/b.mp4"), keypoints=None)
    assert run.settings == {"body": "body30"}
    assert torchcss.smooth(run).body.lengths["forearm"] == pytest.approx(0.27)
    with pytest.raises(ConfigurationError, match=r"give --keypoints$"):
        torchcss.smooth(run, images=True)


@pytest.mark.parametrize(
    ("verb", "option"),
    [
        (["smooth"], "--body"),
        (["export", "--to", "bvh"], "--body"),
        (["export", "--to", "csv"], "--body"),
        (["plot"], "--body"),
        pytest.param(["view", "--save", "a.rrd"], "--body", marks=needs_viewer),
        (["smooth", "--images", "--body", "body30"], "--camera, --video, --keypoints"),
        (["smooth", "--body", "body32"], "other parameters"),
    ],
)
def test_what_an_old_folder_lacks_is_asked_for_in_one_line(
    old: Path,
    verb: list[str],
    option: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(old)
    name, *options = verb
    assert cli.main([name, str(old), *options]) == 2
    told = capsys.readouterr().err
    assert option in told
    assert told.count("\n") == 1


def test_what_needs_nothing_more_works_and_what_is_given_is_enough(old: Path) -> None:
    assert cli.main(["export", str(old), "--to", "trc"]) == 0
    assert cli.main(["smooth", str(old), "--body", "body30"]) == 0
    assert cli.main(["export", str(old / "smooth.npz"), "--to", "bvh"]) == 0
    assert cli.main(["plot", str(old), "--body", "body30"]) == 0


def test_names_of_version_0_1_say_what_to_call_now(old: Path) -> None:
    body = load_body("body30")
    track = torchcss.load_track(old)
    with pytest.warns(DeprecationWarning, match=r"torchcss\.smooth"):
        done = torchcss.smooth_track(track, body)
    with pytest.warns(DeprecationWarning, match=r"torchcss\.smooth"):
        assert torchcss.smooth_file(old, body=body)["file"] == old / "smooth.npz"
    with pytest.warns(DeprecationWarning, match=r"torchcss\.export"):
        assert torchcss.export_track(done.track, to="trc", out=old / "a.trc").paths[0].is_file()
    nothing = Path("nothing")
    with pytest.warns(DeprecationWarning, match="torchcss"), pytest.raises(TrackFileError):
        torchcss.smooth_video(nothing, video=nothing, camera=nothing, keypoints=nothing)

"""What belongs to a track is found, and its modes are drawn where they are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_clip import grey_film
from made_tracks import make_track

from torchcss.body.model import BodyModel
from torchcss.cli import main as cli
from torchcss.errors import CameraError, TrackFileError, VideoError
from torchcss.io.cameras import camera_entry
from torchcss.io.run import Given, Run
from torchcss.io.tracks import TRACK_NAME, Track, save_track, write_summary
from torchcss.io.video import VideoReader
from torchcss.io.view_files import RecordedCamera, ViewFiles
from torchcss.show.posterior_plots import plot_track
from torchcss.show.track_pictures import has_pictures, pictures_of, write_overlays
from torchcss.show.viewer import shown_frames
from torchcss.studies.render.scene import look_at
from torchcss.vision.camera import Camera


@pytest.fixture(scope="module")
def track(body: BodyModel) -> Track:
    return make_track(body, (2, 3, 1), first_frame=1)


@pytest.fixture(scope="module")
def camera() -> Camera:
    return look_at((0.3, -1.4, 4.0), (0.3, -1.4, 0.0), focal_px=160, image_size_wh=(192, 144))


@pytest.fixture
def folder(tmp_path: Path, track: Track, camera: Camera) -> Path:
    """A run: the track, the summary with the camera, the overlay, and the grey video."""
    save_track(tmp_path / TRACK_NAME, track)
    save_track(tmp_path / "smooth.npz", track)
    calibration = {"units": "metre, pixel", "cameras": {camera.name: camera_entry(camera)}}
    write_summary(tmp_path, {"events": [], **calibration})
    for name, levels in (("overlay.mp4", (40, 120, 200)), ("video.mp4", (90, 90, 90, 90, 90))):
        grey_film(tmp_path / name, levels, camera.image_size_wh)
    return tmp_path


def test_the_overlay_of_a_run_is_counted_as_the_track(folder: Path) -> None:
    run = Run.open(folder)
    assert has_pictures(run)
    found = {row: image.mean() for row, image in pictures_of(run, [0, 2])}
    assert found == {0: pytest.approx(40, abs=4), 2: pytest.approx(200, abs=4)}


def test_the_summary_of_an_old_run_holds_the_camera(folder: Path, camera: Camera) -> None:
    found = Run.open(folder).camera
    torch.testing.assert_close(found.K, camera.K)
    torch.testing.assert_close(found.R_camera_world, camera.R_camera_world)
    torch.testing.assert_close(found.t_camera_world, camera.t_camera_world)
    assert found.image_size_wh == camera.image_size_wh


def test_modes_are_drawn_over_the_video_where_they_are(
    folder: Path, track: Track, camera: Camera
) -> None:
    run = Run.open(folder, Given(video=folder / "video.mp4"))
    pictures = dict(pictures_of(run, range(3), anew=True))
    assert list(pictures) == [0, 1, 2]
    for row, image in pictures.items():
        # The line of text stands in the lower left corner.
        changed = (np.abs(image.astype(int) - 90).max(-1) > 12)[:115]
        assert 30 < changed.sum() < 0.5 * changed.size
        wrist = track.joints_world[row, 0, track.joint_names.index("r_wrist")]
        u, v = camera.project(torch.from_numpy(wrist)).uv.round().int().tolist()
        assert 10 < u < 182
        assert 10 < v < 105
        assert changed[v - 2 : v + 3, u - 2 : u + 3].any()


def test_a_smoothed_track_is_drawn_over_the_video_that_the_run_knows(
    folder: Path, track: Track, camera: Camera
) -> None:
    run = Run.open(folder / "smooth.npz")
    assert not has_pictures(run)
    assert list(pictures_of(run, range(3))) == []
    files = ViewFiles(video=folder / "video.mp4", keypoints=None)
    known = track._replace(cameras=(RecordedCamera(camera, files),))
    save_track(folder / "smooth.npz", known)
    assert len(list(pictures_of(Run.open(folder / "smooth.npz"), range(3)))) == 3
    (folder / "video.mp4").unlink()
    assert not has_pictures(Run.open(folder / "smooth.npz"))


def test_where_the_video_is_gone_what_the_overlay_has_is_shown(
    folder: Path, track: Track, camera: Camera, capsys: pytest.CaptureFixture[str]
) -> None:
    files = ViewFiles(video=folder / "gone.mp4", keypoints=None)
    save_track(folder / TRACK_NAME, track._replace(cameras=(RecordedCamera(camera, files),)))
    grey_film(folder / "overlay.mp4", (40, 120), camera.image_size_wh)
    assert cli.main(["plot", str(folder)]) == 0
    told = capsys.readouterr().out
    assert "frames.png" in told
    assert "overlay.mp4: 1 frames of the track are missing; give the video" in told
    shown = [frame.picture is not None for frame in shown_frames(Run.open(folder))]
    assert shown == [True, True, False]


def test_a_damaged_overlay_is_as_none(
    folder: Path, track: Track, camera: Camera, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "overlay.mp4").write_bytes(b"no film")
    for verb in ("plot", "report"):
        assert cli.main([verb, str(folder)]) == 0
        assert "overlay.mp4: damaged, without pictures: give --video" in capsys.readouterr().out
    files = ViewFiles(video=folder / "video.mp4", keypoints=None)
    save_track(folder / TRACK_NAME, track._replace(cameras=(RecordedCamera(camera, files),)))
    for verb in ("plot", "report"):
        assert cli.main([verb, str(folder)]) == 0
        assert "overlay.mp4: damaged, drawn anew from the video" in capsys.readouterr().out
    assert [row for row, _ in pictures_of(Run.open(folder), range(3))] == [0, 1, 2]


def test_a_video_outside_the_run_is_told(
    folder: Path, track: Track, camera: Camera, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run may come from a stranger, and name any file."""
    out, video = folder / "out", folder / "video.mp4"
    out.mkdir()
    files = ViewFiles(video=video, keypoints=None)
    save_track(out / TRACK_NAME, track._replace(cameras=(RecordedCamera(camera, files),)))
    for more, is_told in ([], True), (["--video", str(video)], False):
        assert cli.main(["report", str(out), *more]) == 0
        assert (f"reading {video}, which the run names" in capsys.readouterr().err) == is_told
    (out / video.name).write_bytes(video.read_bytes())
    video.unlink()
    assert cli.main(["report", str(out)]) == 0
    assert not capsys.readouterr().err


def test_a_film_shows_its_frames_when_the_camera_took_them(folder: Path, track: Track) -> None:
    save_track(folder / TRACK_NAME, track._replace(times=np.array([0.5, 0.54, 0.7])))
    run = Run.open(folder, Given(video=folder / "video.mp4"))
    (overlay,) = write_overlays(run, 10.0)
    assert VideoReader(overlay).frame_times() == pytest.approx([0.0, 0.04, 0.2], abs=1e-4)


def test_a_track_alone_is_enough(folder: Path) -> None:
    for name in ("summary.json", "overlay.mp4"):
        (folder / name).unlink()
    run = Run.open(folder)
    assert (run.cameras, run.summary, has_pictures(run)) == ((), {}, False)
    with pytest.raises(TrackFileError, match="--camera"):
        Run.open(folder, Given(video=folder / "video.mp4"))


def test_what_does_not_belong_together(folder: Path, body: BodyModel, camera: Camera) -> None:
    short = Run.open(folder, Given(video=folder / "overlay.mp4"))
    with pytest.raises(VideoError, match="1 frames of the track are missing"):
        list(pictures_of(short, range(3), anew=True))
    small = RecordedCamera(camera.resized(96, 72), short.cameras[0].files)
    other = replace(short, track=short.track._replace(cameras=(small,)))
    with pytest.raises(CameraError, match="96 x 72"):
        list(pictures_of(other, range(3), anew=True))
    save_track(folder / TRACK_NAME, make_track(body, ()))
    with pytest.raises(TrackFileError, match="no frames"):
        plot_track(Run.open(folder))

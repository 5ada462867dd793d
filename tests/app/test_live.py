"""Watching a tracker while it runs: sinks see every frame, and are closed whatever happens."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from made_clip import track
from PIL import Image

from torchcss.app import recorder
from torchcss.app.recorder import Picture
from torchcss.app.track import TrackOptions, track_video
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.io.cameras import load_camera, read_camera
from torchcss.io.tracks import FrameModes, load_track, read_summary
from torchcss.io.video import VideoReader
from torchcss.show.track_plots import bones_of
from torchcss.tracking.session import Posterior
from torchcss.tracking.settings import Settings
from torchcss.vision.camera import Camera

SETTINGS = Settings(body="arm7", samples=3, modes=2, terms=("joints",))


@pytest.fixture
def files(files: Path) -> Path:
    """The clip without content, and marks that move."""
    with np.load(files / "keypoints.npz") as archive:
        arrays = dict(archive)
    arrays["keypoints"] += np.arange(3.0)[:, None, None]
    np.savez(files / "keypoints.npz", **arrays)
    return files


def test_a_live_recording_is_the_track(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    drawn, draw = [], recorder.draw_modes

    def count(image: np.ndarray, body: BodyModel, modes: FrameModes, camera: Camera) -> np.ndarray:
        drawn.append(modes.frame)
        return draw(image, body, modes, camera)

    monkeypatch.setattr(recorder, "draw_modes", count)
    saved = files / "live.rrd"
    assert track(files, "--live-save", str(saved)) == 0
    assert drawn == [0, 1, 2]
    result = load_track(files / "out")
    strips, pictures = {}, {}
    for piece in chunk.RrdReader(saved).stream():
        batch = piece.to_record_batch()
        for name, component, found in (
            ("/world/modes/0/skeleton", "LineStrips3D:strips", strips),
            ("/world/camera/picture", "EncodedImage:blob", pictures),
        ):
            if piece.entity_path == name:
                keys = batch.column("frame").to_pylist()
                found.update(zip(keys, batch.column(component).to_pylist(), strict=True))
    bones = np.array(bones_of(load_body("arm7")))
    assert sorted(strips) == sorted(pictures) == [0, 1, 2]
    for row in range(3):
        np.testing.assert_allclose(strips[row], result.joints_world[row, 0][bones], atol=1e-6)
    film = [frame.image for frame in VideoReader(files / "out" / "overlay.mp4")]
    assert (files / "out" / "report.html").is_file()
    shown = Image.open(io.BytesIO(bytes(pictures[2][0])))
    # Both are compressed, each in its own way.
    assert np.abs(np.asarray(shown).astype(float) - film[2]).mean() < 6


def test_what_was_recorded_before_is_kept(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved = files / "live.rrd"
    saved.write_bytes(b"frames")
    assert track(files, "--resume", "--live-save", str(saved)) == 2
    assert "live.rrd: holds what was recorded before" in capsys.readouterr().err
    assert saved.read_bytes() == b"frames"


class Watcher:
    """A sink that remembers, and may fail."""

    def __init__(self, fail_at: int | None = None, error: BaseException | None = None) -> None:
        self.seen: list[int] = []
        self.closed = 0
        self._fail_at, self._error = fail_at, error

    def add(self, frame: Posterior, picture: Picture) -> None:
        if frame.frame.index == self._fail_at and self._error is not None:
            raise self._error
        assert picture.image is picture.image
        assert picture.image.shape == (48, 64, 3)
        assert picture.camera.image_size_wh == (64, 48)
        self.seen.append(frame.frame.index)

    def close(self) -> None:
        self.closed += 1


def run(files: Path, live: Watcher) -> None:
    track_video(
        files / "video.mp4",
        camera=files / "cameras.json",
        keypoints=files / "keypoints.npz",
        out=files / "out",
        settings=SETTINGS,
        options=TrackOptions(live=live),
    )


def test_a_sink_sees_every_frame(files: Path) -> None:
    watcher = Watcher()
    run(files, watcher)
    assert watcher.seen == [0, 1, 2]
    assert watcher.closed == 1


def test_a_stopped_run_closes_its_sinks_and_keeps_what_it_has(files: Path) -> None:
    watcher = Watcher(2, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run(files, watcher)
    assert watcher.closed == 1
    assert len(load_track(files / "out").frames) == 3
    assert not (files / "out" / "overlay.mp4").exists()
    assert read_summary(files / "out")["ended"] == "interrupted"


def test_the_summary_is_a_camera_file(files: Path) -> None:
    assert track(files, "--no-overlay") == 0
    ours = load_camera(files / "out" / "summary.json")
    theirs = read_camera(files / "cameras.json")
    assert ours.metric
    assert ours.camera.K.tolist() == theirs.K.tolist()
    assert ours.camera.name == "one"
    assert not (files / "out" / "overlay.mp4").exists()


@pytest.mark.parametrize("option", ["--live", "--live-save"])
def test_without_rerun_nothing_is_tracked(
    files: Path, option: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    value = [str(files / "live.rrd")] if option == "--live-save" else []
    assert track(files, option, *value) == 2
    assert "torchcss[viewer]" in capsys.readouterr().err
    assert not (files / "out").exists()

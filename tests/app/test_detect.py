"""From a video to its keypoints, with a detector made for the purpose; and on to a track."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

import torchcss
from torchcss.app.detect import detect_video, is_detected
from torchcss.app.view_files import FrameSelection, open_view
from torchcss.errors import KeypointError, OutputError, TorchcssError
from torchcss.io.detect import Detected
from torchcss.io.keypoints.frames import Film
from torchcss.io.keypoints.masks import masks_of
from torchcss.io.keypoints.one_person import Whom
from torchcss.io.keypoints.read import read_person
from torchcss.io.video import VideoReader, VideoWriter
from torchcss.io.view_files import ViewFiles
from torchcss.types import Frame, Keypoints
from torchcss.vision.camera import Camera

SIZE = (64, 48)


class Crowd:
    """Sees these people, in an order that changes from frame to frame."""

    layout = "COCO-17"
    relative_noise = 1.5

    def __init__(self, places: list[list[tuple[float, float, float]]]) -> None:
        self.places, self.closed, self.asked = places, False, []

    def detect(self, frame: Frame) -> Detected:
        self.asked.append(frame.index)
        spread = np.random.default_rng(0).uniform(-1, 1, (17, 2))
        people = [
            np.column_stack([(x, y) + size * spread, np.full(17, 0.9)])
            for x, y, size in self.places[frame.index]
        ]
        order = slice(None, None, (-1) ** frame.index)
        points = [np.full((17, 3), x) for x, _, _ in self.places[frame.index]]
        masks = np.zeros((len(people), *frame.image.shape[:2]), dtype=np.uint8)
        for mask, (x, y, _) in zip(masks, self.places[frame.index], strict=True):
            mask[int(y) - 6 : int(y) + 6, int(x) - 8 : int(x) + 8] = 255
        return Detected(
            np.array(people[order]).reshape(-1, 17, 3),
            np.array(points[order]).reshape(-1, 17, 3),
            masks[order],
        )

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def crowd() -> Crowd:
    small, large, middle = (8.0, 10.0, 4.0), (48.0, 24.0, 9.0), (30.0, 24.0, 6.0)
    return Crowd([[small, large, middle], [small, large], [small, middle, large]])


def read(path: Path, person: str, frame: int = 0) -> Keypoints:
    return read_person(path, film=Film(3), whom=Whom(frame, person, SIZE))


@pytest.mark.parametrize(
    ("person", "u", "known"),
    [("largest", 48, 3), ("leftmost", 8, 3), ("centre", 30, 2), ("0", 8, 3), ("1", 48, 3),
     ("prominent", 48, 3)],
)  # fmt: skip
def test_everybody_is_found_and_known_again(
    files: Path,
    crowd: Crowd,
    person: str,
    u: float,
    known: int,
) -> None:
    path = detect_video(files / "video.mp4", files / "found.npz", detector=crowd)
    assert crowd.closed
    keypoints = read(path, person)
    seen = keypoints.confidence.amax(-1) > 0
    assert int(seen.sum()) == known
    assert keypoints.positions[seen].mean((0, 1))[0] == pytest.approx(u, abs=3)
    assert keypoints.relative_noise == 1.5
    assert any("--person" in line for line in keypoints.report)


def test_points_and_masks_are_those_of_the_person(files: Path, crowd: Crowd) -> None:
    path = detect_video(files / "video.mp4", files / "found.npz", detector=crowd)
    camera = Camera.pinhole(*SIZE, focal_px=60.0)
    for person, x, frames in (("largest", 48.0, (0, 1, 2)), ("centre", 30.0, (0, 2))):
        given = ViewFiles(
            video=files / "video.mp4", keypoints=path, masks=masks_of(path), person=person
        )
        view = open_view(given, camera)
        assert view.keypoints is not None
        assert view.keypoints.points is not None
        assert (view.keypoints.points[list(frames)] == x).all()
        for frame in view.images():
            assert frame.mask is not None
            if frame.index not in frames:
                assert frame.mask.min() == 255  # who is not seen may be anywhere
                continue
            at = {u: frame.mask[v, u].mean() for u, v in ((8, 10), (30, 24), (48, 24), (20, 40))}
            assert at.pop(int(x)) > 200
            assert max(at.values()) < 50


def test_masks_of_one_person_are_as_they_were_found(files: Path, crowd: Crowd) -> None:
    crowd.places = [[], [(30.0, 24.0, 6.0)], [(30.0, 24.0, 6.0)]]
    path = detect_video(files / "video.mp4", files / "found.npz", detector=crowd)
    assert "mask_owner" not in np.load(path)
    given = ViewFiles(video=files / "video.mp4", keypoints=path, masks=masks_of(path))
    view = open_view(given, Camera.pinhole(*SIZE, focal_px=60.0), FrameSelection(start=1))
    assert view.own_masks is None
    assert next(iter(VideoReader(masks_of(path)))).image.min() > 250
    for frame in view.images():
        assert frame.mask is not None
        assert frame.mask[24, 30].mean() > 200 > frame.mask[40].mean()


def test_who_is_not_there_is_told(files: Path, crowd: Crowd) -> None:
    path = detect_video(files / "video.mp4", files / "found.npz", detector=crowd)
    with pytest.raises(KeypointError, match=r"person '2' is not in frame 1.*there are '0', '1'"):
        read(path, "2", frame=1)
    with pytest.raises(KeypointError, match="largest, leftmost or centre"):
        read(path, "7")


def test_nobody_is_one_line(files: Path) -> None:
    with pytest.raises(KeypointError, match=r"nobody found in 3 frames.*--keypoints"):
        detect_video(files / "video.mp4", files / "found.npz", detector=Crowd([[], [], []]))
    assert not (files / "found.npz").exists()


@pytest.mark.parametrize("name", ["found", "found.json", "folder.npz"])
def test_a_file_that_cannot_be_written_is_told_before_the_work(
    files: Path, crowd: Crowd, name: str
) -> None:
    (files / "folder.npz").mkdir()
    with pytest.raises(OutputError, match=r"ends in \.npz"):
        detect_video(files / "video.mp4", files / name, detector=crowd)
    assert not crowd.asked


def test_a_video_alone_is_tracked(
    files: Path,
    crowd: Crowd,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("torchcss.app.detect.open_detector", lambda *_: crowd)
    settings = torchcss.Settings(body="arm7", samples=3, modes=2, overlay=False)
    options = torchcss.TrackOptions(person="leftmost", fov=60.0)
    out = files / "out"
    run = torchcss.track_video(files / "video.mp4", out=out, settings=settings, options=options)
    assert len(run.track.frames) == 3
    camera, given, _ = run.cameras[0]
    assert float(camera.K[0, 0]) == pytest.approx(32 / np.tan(np.radians(30)))
    assert given is not None
    assert given.keypoints == out / "keypoints.npz"
    assert given.person == "leftmost"
    assert given.masks == out / "keypoints_masks.mp4"
    notes = "\n".join(run.summary["notes"])
    assert "followed the leftmost one of frame 0" in notes
    assert "as given" in notes


@pytest.mark.parametrize("at_first", [[], [(-99.0, 24.0, 9.0)]], ids=["nobody", "out of sight"])
def test_a_video_is_tracked_from_where_somebody_is_seen(
    files: Path,
    crowd: Crowd,
    monkeypatch: pytest.MonkeyPatch,
    at_first: list[tuple[float, float, float]],
) -> None:
    crowd.places[0] = at_first
    monkeypatch.setattr("torchcss.app.detect.open_detector", lambda *_: crowd)
    settings = torchcss.Settings(body="arm7", samples=3, modes=2, overlay=False)
    options = torchcss.TrackOptions(person="leftmost", fov=60.0)
    video, out = files / "video.mp4", files / "out"
    run = torchcss.track_video(video, out=out, settings=settings, options=options, stop=2)
    assert run.track.frames.tolist() == [1]
    assert "nobody is seen in frame 0: tracked from frame 1 on" in run.summary["notes"]
    again = replace(options, resume=True)
    run = torchcss.track_video(video, out=out, settings=settings, options=again)
    assert run.track.frames.tolist() == [1, 2]


def test_somebody_who_is_not_there_for_long_is_no_start(
    files: Path, crowd: Crowd, monkeypatch: pytest.MonkeyPatch
) -> None:
    crowd.places = [[], [(8.0, 10.0, 6.0)], [(48.0, 24.0, 9.0)], [(48.0, 24.0, 9.0)]]
    with VideoWriter(files / "longer.mp4", 25) as film:
        for _ in range(4):
            film.write(np.zeros((*SIZE[::-1], 3), np.uint8))
    monkeypatch.setattr("torchcss.app.detect.open_detector", lambda *_: crowd)
    settings = torchcss.Settings(body="arm7", samples=3, modes=2, overlay=False)
    options = torchcss.TrackOptions(fov=60.0)
    video, out = files / "longer.mp4", files / "out"
    run = torchcss.track_video(video, out=out, settings=settings, options=options)
    assert run.track.frames.tolist() == [2, 3]


@pytest.mark.parametrize(
    ("options", "settings", "words"),
    [({"fov": 200.0}, {}, "--fov"), ({"masks": Path("none.mp4")}, {}, "none.mp4"),
     ({}, {"stature": 180.0}, "stature")],
)  # fmt: skip
def test_what_is_wrong_is_told_before_the_detector_runs(
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: dict[str, Any],
    settings: dict[str, Any],
    words: str,
) -> None:
    monkeypatch.setattr("torchcss.app.detect.open_detector", None)
    with pytest.raises(TorchcssError, match=words):
        torchcss.track_video(
            files / "video.mp4", out=files / "out", settings=torchcss.Settings(**settings),
            options=torchcss.TrackOptions(**options),
        )  # fmt: skip


def test_frames_that_nobody_asks_for_are_not_detected(files: Path, crowd: Crowd) -> None:
    path = detect_video(files / "video.mp4", files / "found.npz", detector=crowd, start=1, stop=2)
    assert crowd.asked == [1]
    assert is_detected(path, 2)
    assert not is_detected(path, 3)
    assert not is_detected(path, None)
    seen = read(path, "largest", frame=1).confidence.amax(-1) > 0
    assert seen.tolist() == [False, True, False]
    given = ViewFiles(video=files / "video.mp4", keypoints=path, masks=masks_of(path))
    view = open_view(given, Camera.pinhole(*SIZE, focal_px=60.0), FrameSelection(start=1, stop=2))
    (mask,) = [frame.mask for frame in view.images()]
    assert mask is not None
    assert mask[24, 48].mean() > 200 > mask[40].mean()
    assert is_detected(files / "nowhere.npz", 9)
    (files / "broken.npz").write_bytes(b"PK\x03\x04 half of a file")
    assert is_detected(files / "broken.npz", 9)
    for stop in (None, 9):  # beyond the end
        path = detect_video(files / "video.mp4", files / "all.npz", detector=crowd, stop=stop)
        assert is_detected(path, None)


def test_a_rate_that_a_film_does_not_need_is_told(files: Path) -> None:
    given = ViewFiles(video=files / "video.mp4", keypoints=None, frame_rate=120)
    view = open_view(given, Camera.pinhole(*SIZE, focal_px=60.0))
    assert any("as the video says: --frame-rate is of pictures" in note for note in view.notes)


@pytest.mark.parametrize(("codec", "suffix"), [("libx264", "h264"), ("mjpeg", "mjpeg")])
def test_the_guessed_rate_of_a_bare_stream_is_told(tmp_path: Path, codec: str, suffix: str) -> None:
    """Cameras of single-board computers write such files; FFmpeg takes 25 frames a second then."""
    path = tmp_path / f"a.{suffix}"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=50)
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        picture = av.VideoFrame.from_ndarray(np.zeros((*SIZE[::-1], 3), np.uint8), "rgb24")
        for frame in (picture, picture, None):
            container.mux(stream.encode(frame))
    view = open_view(ViewFiles(video=path, keypoints=None), Camera.pinhole(*SIZE, focal_px=60.0))
    rate = 25 if codec == "mjpeg" else 50  # H.264 may say its own
    (note,) = [note for note in view.notes if "images a second" in note]
    assert note.startswith(f"{rate} images a second, assumed")
    assert f"-i a.{suffix} -c" in note


def test_who_goes_on_further_looks_further(
    files: Path, crowd: Crowd, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchcss.app.detect.open_detector", lambda *_: crowd)
    settings = torchcss.Settings(body="arm7", samples=3, modes=2, overlay=False)
    options = torchcss.TrackOptions(person="leftmost", fov=60.0)
    video, out = files / "video.mp4", files / "out"
    run = torchcss.track_video(video, out=out, settings=settings, options=options, stop=2)
    assert crowd.asked == [0, 1]
    assert len(run.track.frames) == 2
    crowd.asked.clear()
    again = replace(options, resume=True)
    run = torchcss.track_video(video, out=out, settings=settings, options=again, stop=2)
    assert crowd.asked == []
    run = torchcss.track_video(video, out=out, settings=settings, options=again)
    assert crowd.asked == [0, 1, 2]
    assert len(run.track.frames) == 3

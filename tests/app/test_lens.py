"""What is known of a lens: told, in the file, or fitted."""

from __future__ import annotations

import math
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from made_clip import grey_film
from PIL import ExifTags, Image

import torchcss
from torchcss.app.lens import KnownLens
from torchcss.app.track import TrackOptions, _camera_of
from torchcss.app.view_files import FrameSelection, open_view
from torchcss.body.bases import pose_track
from torchcss.body.uncertainty import joint_covariance
from torchcss.errors import CameraError
from torchcss.io.cameras import LoadedCamera
from torchcss.io.video import focal_length_35mm
from torchcss.io.view_files import ViewFiles
from torchcss.studies.sequence_writer import write_camera

KEY = "com.apple.quicktime.camera.focal_length.35mm_equivalent"

SIZE = (64, 48)


def video(path: Path, **metadata: str) -> Path:
    """A short film whose container says more."""
    with av.open(path, "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata.update(metadata)
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        picture = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")
        container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    return path


def focal(lens: KnownLens, path: Path) -> float:
    return float(lens.of(path).camera(*SIZE).camera.K[0, 0])


def test_the_file_says_it(tmp_path: Path) -> None:
    path = video(tmp_path / "a.mov", **{KEY: "26"})
    assert focal_length_35mm(path) == 26
    assert focal(KnownLens(), path) == pytest.approx(26 * 80 / math.hypot(36, 24))
    assert "26 mm" in (KnownLens().of(path).camera(*SIZE).units_note or "")
    assert focal(KnownLens(focal=99.0), path) == 99  # the user knows better
    doubts = [
        lens.of(path).camera(*SIZE).focal_deviation for lens in (KnownLens(focal=99.0), KnownLens())
    ]
    assert doubts[0] == 0 < doubts[1] < KnownLens().camera(*SIZE).focal_deviation


@pytest.mark.parametrize("said", ["", "none", "0", "nan", "1e9", "-26"])
def test_nonsense_in_the_file_is_no_answer(tmp_path: Path, said: str) -> None:
    path = video(tmp_path / "a.mov", **{KEY: said})
    assert focal_length_35mm(path) is None
    assert not KnownLens().of(path).is_known


def test_pictures_say_it_by_exif(tmp_path: Path) -> None:
    picture = Image.new("RGB", (64, 48))
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 28
    picture.save(tmp_path / "0.jpg", exif=exif)
    assert focal_length_35mm(tmp_path) == 28
    Image.new("RGB", (64, 48)).save(tmp_path / "0.jpg")
    assert focal_length_35mm(tmp_path) is None


def test_pictures_before_the_first_may_be_of_another_size(tmp_path: Path) -> None:
    for number, size in enumerate(((64, 48), (32, 24), (32, 24))):
        Image.new("RGB", size).save(tmp_path / f"{number}.png")
    camera, _ = _camera_of(tmp_path, None, TrackOptions(), 1)
    assert isinstance(camera, LoadedCamera)
    given = ViewFiles(video=tmp_path, keypoints=None)
    seen = open_view(given, camera, FrameSelection(start=1)).camera.camera
    assert seen.image_size_wh == (32, 24)


def test_a_camera_is_said_once() -> None:
    with pytest.raises(CameraError, match="not several"):
        KnownLens(fov=60.0).unless(Path("cameras.json"))
    with pytest.raises(CameraError, match="not both"):
        KnownLens(fov=60.0, focal=900.0)
    for bad in (0.0, -5.0, math.nan):
        with pytest.raises(CameraError, match="--focal: expected"):
            KnownLens(focal=bad)
    with pytest.raises(CameraError, match=r"--fov: expected .* got 400"):
        KnownLens(fov=400.0)
    assert KnownLens().unless(Path("cameras.json")) == Path("cameras.json")
    with pytest.raises(CameraError):
        torchcss.Camera.pinhole(64, 48, focal_px=10.0, field_of_view_degrees=20.0)


@pytest.mark.parametrize("stature", [1.9, None])
def test_what_is_unknown_is_fitted_and_said(tmp_path: Path, stature: float | None) -> None:
    grey_film(tmp_path / "video.mp4", (10, 20, 30, 40, 50), (128, 96))
    places = {
        "l_shoulder": (70, 30), "r_shoulder": (56, 30), "l_elbow": (76, 40), "r_elbow": (50, 40),
        "l_wrist": (74, 50), "r_wrist": (52, 50), "l_hip": (67, 52), "r_hip": (59, 52),
        "l_knee": (68, 68), "r_knee": (58, 68), "l_ankle": (68, 84), "r_ankle": (58, 84),
    }  # fmt: skip
    np.savez(
        tmp_path / "keypoints.npz",
        keypoints=np.tile(np.array(list(places.values()), dtype=float), (5, 1, 1)),
        confidence=np.ones((5, len(places))),
        joint_names=list(places),
    )
    run = torchcss.track_video(
        tmp_path / "video.mp4",
        keypoints=tmp_path / "keypoints.npz",
        out=tmp_path / "out",
        settings=torchcss.Settings(samples=3, modes=2, overlay=False, stature=stature),
        stop=1,
    )
    notes = "\n".join(run.summary["notes"])
    assert "fitted to 5 frames" in notes
    assert "--focal or --fov" in notes
    camera = run.cameras[0].camera
    assert camera.name == "fitted"
    assert 0.5 < float(camera.K[0, 0]) / 128 < 1.6
    assert ("1.9" in notes) == (stature is not None)  # it sets the size
    for track in (run.track, torchcss.Run.open(tmp_path / "out").track):
        held = track.held
        assert held is not None
        assert (held.size > 0) == (stature is None)
        assert 0.05 < held.focal < 0.3
        assert track.body is not None
        base = torch.from_numpy(track.base_transform[:1])
        pose = pose_track(track.body, torch.from_numpy(track.state[:1, 0]), base)
        spread = torch.from_numpy(track.covariance[:1, 0])
        wider = joint_covariance(track.body, pose, spread, held=held)
        added = wider - joint_covariance(track.body, pose, spread)
        # Along the axis, by as much as the distance is uncertain.
        distance = track.joints_world[0, 0].mean(0)[2]
        deviation = distance * math.hypot(held.size, held.focal)
        assert added[0].mean(0)[2, 2].sqrt() == pytest.approx(deviation, rel=0.05)
    write_camera(tmp_path / "cameras.json", camera)
    # The body that was found knows whether its size is known.
    again = torchcss.track_video(
        tmp_path / "video.mp4",
        camera=tmp_path / "cameras.json",
        keypoints=tmp_path / "keypoints.npz",
        out=tmp_path / "again",
        settings=torchcss.Settings(samples=3, modes=2, overlay=False),
        options=torchcss.TrackOptions(init=run.folder / "body.npz"),
        stop=1,
    )
    assert (again.track.size_deviation > 0) == (stature is None)

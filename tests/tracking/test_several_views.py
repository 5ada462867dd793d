"""Two cameras from files to a track: other sizes, a view that drops out, views that end."""

from __future__ import annotations

import json
from itertools import zip_longest
from pathlib import Path

import numpy as np
import pytest
import torch
from made_clip import write_film
from made_sequences import rendered_arm
from made_sessions import seen_by, session_at

from torchcss.app.track import TrackOptions, track_video
from torchcss.body.uncertainty import joint_covariance
from torchcss.errors import CameraError, VideoError
from torchcss.io.cameras import camera_entry, read_camera
from torchcss.io.run import Given, Run
from torchcss.io.tracks import load_track
from torchcss.io.view_files import ViewFiles
from torchcss.studies.render.sequences import SyntheticSequence
from torchcss.tracking.session import Posterior
from torchcss.tracking.settings import Settings
from torchcss.types import Frame
from torchcss.vision.camera import Camera

FRAMES = 5
SMALL = (160, 120)


def beside_it(camera: Camera, target: torch.Tensor) -> Camera:
    """A small camera that looks at a point from the side, at a right angle to another."""
    about = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]).double()
    turn = about @ camera.R_camera_world.double()
    away = camera.to_camera_frame(target[None])[0, 2]
    shift = torch.stack([away * 0, away * 0, away]) - turn @ target
    own = camera.resized(*SMALL)
    return Camera(own.K, SMALL, R_camera_world=turn, t_camera_world=shift, name="side")


@pytest.fixture(scope="module")
def sequence() -> SyntheticSequence:
    return rendered_arm(3, FRAMES)


@pytest.fixture(scope="module")
def side(sequence: SyntheticSequence) -> Camera:
    return beside_it(sequence.camera, sequence.joints_world[0].mean(0))


def follow(
    sequence: SyntheticSequence,
    images: list[np.ndarray],
    others: list[tuple[Camera, list[np.ndarray]]],
) -> list[Posterior]:
    """Track from keypoints in all frames, exact in every view, with few samples."""
    joints, names = sequence.joints_world, sequence.body.joint_names
    cameras = [sequence.camera, *(camera for camera, _ in others)]
    views = [seen_by(camera, joints, names, sigma=1.0) for camera in cameras]
    # The first pose is wrong in depth, which the first camera hardly sees.
    start = sequence.states[:1] + 0.1
    settings = Settings(
        body="arm8", terms=("joints", "stabiliser"), working_size=640, samples=6, modes=2,
    )  # fmt: skip
    session = session_at(settings, sequence.body, start, *views)
    moments = zip_longest(images, *(beside for _, beside in others))
    return list(
        session.track(
            [None if image is None else Frame(i, i / 25, image) for image in moment]
            for i, moment in enumerate(moments)
            if moment[0] is not None
        )
    )


def errors_mm(tracked: list[Posterior], sequence: SyntheticSequence) -> list[float]:
    return [
        1000 * float((each.joints_world[0] - sequence.joints_world[i]).norm(dim=-1).mean())
        for i, each in enumerate(tracked)
    ]


def flat(size_wh: tuple[int, int]) -> np.ndarray:
    return np.full((size_wh[1], size_wh[0], 3), 40, np.uint8)


def test_a_second_view_shows_depth(sequence: SyntheticSequence, side: Camera):
    images = sequence.frames
    one = follow(sequence, images, [])
    two = follow(sequence, images, [(side, [flat(SMALL)] * FRAMES)])
    # The second frame still goes on with the velocity of the wrong start.
    assert max(errors_mm(two, sequence)[2:]) < 3
    assert np.mean(errors_mm(two, sequence)) < 0.5 * np.mean(errors_mm(one, sequence))
    assert [each.others[0].index for each in two if each.others[0]] == list(range(FRAMES))

    def depth_variance(tracked: Posterior) -> float:
        mode = tracked.body.pose(tracked.state.mixture.mean[:1])
        spread = joint_covariance(tracked.body, mode, tracked.covariance[:1])
        line = sequence.camera.R_camera_world[2].double()
        return float(torch.einsum("i,jik,k->j", line, spread[0], line).max())

    assert depth_variance(two[-1]) < 0.5 * depth_variance(one[-1])


@pytest.mark.parametrize("out", ["first", "second", "both"])
def test_a_view_may_drop_out_for_a_while(sequence: SyntheticSequence, side: Camera, out: str):
    black = flat(sequence.camera.image_size_wh)
    images = list(sequence.frames)
    if out in ("first", "both"):
        images[1:3] = [black, black]
    beside = [flat(SMALL)] * (2 if out in ("second", "both") else FRAMES)
    tracked = follow(sequence, images, [(side, beside)])
    assert len(tracked) == FRAMES
    assert all(bool(each.state.mixture.mean.isfinite().all()) for each in tracked)
    if out in ("second", "both"):
        assert [each.others[0] is None for each in tracked] == [False, False, True, True, True]
    # What is left still holds the arm.
    assert max(errors_mm(tracked, sequence)) < 60


@pytest.fixture(scope="module")
def folder(
    sequence: SyntheticSequence, side: Camera, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Two videos of different sizes and lengths, the second two frames ahead, with keypoints."""
    path = tmp_path_factory.mktemp("views")
    cameras = {}
    for name, camera, ahead in (("front", sequence.camera, 0), ("side", side, 2)):
        front = list(sequence.frames)
        images = front if name == "front" else [flat(camera.image_size_wh)] * (FRAMES + 1)
        write_film(path / f"{name}.mp4", images, sequence.frame_rate)
        uv = camera.project(sequence.joints_world).uv.numpy()
        uv = np.concatenate([uv[:1]] * ahead + [uv])[: FRAMES + (1 if ahead else 0)]
        np.savez(
            path / f"{name}.npz", keypoints=uv, confidence=np.ones(uv.shape[:2]),
            joint_names=np.array(sequence.body.joint_names),
        )  # fmt: skip
        cameras[name] = {"video": f"{name}.mp4", **camera_entry(camera)}
    text = {"units": "metre, pixel", "cameras": cameras}
    (path / "cameras.json").write_text(json.dumps(text))
    for entry in cameras.values():
        del entry["t"]
        del entry["R"]
    (path / "apart.json").write_text(json.dumps(text))
    return path


def test_from_files(folder: Path, tmp_path: Path, sequence: SyntheticSequence):
    settings = Settings(
        body="arm8", samples=6, modes=2, overlay=False, terms=("joints", "temporal", "stabiliser")
    )
    other = ViewFiles(video=folder / "side.mp4", keypoints=folder / "side.npz", offset=2)
    summary = track_video(
        folder / "front.mp4", camera=folder / "cameras.json", keypoints=folder / "front.npz",
        out=tmp_path, settings=settings, options=TrackOptions(others=[other]),
    ).summary  # fmt: skip
    assert summary["other_views"] == [{"video": str(folder / "side.mp4"), "camera": "side"}]
    # The summary is a camera file of both.
    for name in ("front", "side"):
        known = read_camera(tmp_path / "summary.json", video=folder / f"{name}.mp4")
        given = read_camera(folder / "cameras.json", name=name)
        for part in ("K", "R_camera_world", "t_camera_world"):
            torch.testing.assert_close(getattr(known, part), getattr(given, part))
    shown = Run.open(tmp_path).camera
    assert shown is not None
    assert shown.name == "front"
    over = Run.open(tmp_path, Given(video=folder / "side.mp4")).camera
    assert over is not None
    assert over.name == "side"
    assert any("2 views set the scale" in note for note in summary["notes"])
    assert {"front: format: NPZ", "side: format: NPZ"} <= set(summary["notes"])
    track = load_track(tmp_path)
    away = track.joints_world[:, 0] - sequence.joints_world.numpy()
    assert 1000 * float(np.linalg.norm(away, axis=-1).mean()) < 15


def test_bad_views_are_refused(folder: Path, tmp_path: Path):
    def attempt(camera: str, **files: object) -> None:
        track_video(
            folder / "front.mp4", camera=folder / camera, keypoints=folder / "front.npz",
            out=tmp_path, settings=Settings(body="arm8"),
            options=TrackOptions(
                others=[ViewFiles(**{"video": folder / "side.mp4", "keypoints": None, **files})],  # type: ignore[arg-type]
            ),
        )  # fmt: skip

    with pytest.raises(CameraError, match=r"front\.mp4: several cameras .* one world, in metres"):
        attempt("apart.json")
    with pytest.raises(VideoError, match="starts 3 frames after"):
        attempt("cameras.json", offset=-3)
    with pytest.raises(CameraError):
        attempt("cameras.json", camera_name="front")

"""The loop from files to a track: determinism, interruption, the base transform."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import torchcss
from torchcss.body.model import load_body
from torchcss.demo import run_demo
from torchcss.errors import ConfigurationError, OutputError, VideoError
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.tracker import Tracker, TrackerState
from torchcss.io import tracks
from torchcss.io.video import VideoWriter
from torchcss.pipeline import ALL_TERMS, Settings, follow_with_base, scale_keypoints, track_video
from torchcss.synthetic import arm_sequence

FRAMES = 4


@pytest.fixture(scope="session")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short rendered clip of an arm with camera and keypoints, as files."""
    folder = tmp_path_factory.mktemp("clip")
    generator = torch.Generator().manual_seed(3)
    sequence = arm_sequence(generator=generator, num_frames=FRAMES)
    with VideoWriter(folder / "video.mp4", sequence.frame_rate) as film:
        for frame in sequence.frames:
            film.write(frame)
    camera = sequence.camera
    (folder / "cameras.json").write_text(
        json.dumps(
            {
                "units": "metre, pixel",
                "cameras": {
                    "one": {
                        "video": "video.mp4",
                        "image_size_wh": list(camera.image_size_wh),
                        "K": camera.K.tolist(),
                        "R": camera.R_camera_world.tolist(),
                        "t": camera.t_camera_world.tolist(),
                    }
                },
            }
        )
    )
    uv = camera.project(sequence.joints_world).uv.numpy()
    names = np.array(sequence.body.joint_names)
    np.savez(
        folder / "keypoints.npz", keypoints=uv, confidence=np.ones(uv.shape[:2]), joint_names=names
    )
    return folder


def run(clip: Path, out: Path, **settings) -> dict:
    return track_video(
        clip / "video.mp4",
        camera=clip / "cameras.json",
        keypoints=clip / "keypoints.npz",
        out=out,
        settings=Settings(body="arm7", samples=6, modes=2, overlay=False, **settings),
    )


def test_writes_what_the_design_says(clip: Path, tmp_path: Path):
    summary = track_video(
        clip / "video.mp4",
        camera=clip / "cameras.json",
        keypoints=clip / "keypoints.npz",
        out=tmp_path,
        settings=Settings(body="arm7", samples=6, modes=2),
    )
    assert {p.name for p in tmp_path.iterdir()} == {"track.npz", "summary.json", "overlay.mp4"}
    track = torchcss.load_track(tmp_path)
    assert track.frames.tolist() == list(range(FRAMES))
    assert track.state_names == load_body("arm7").state_names
    k = track.state.shape[1]
    assert track.covariance.shape == (FRAMES, k, 7, 7)
    assert track.joints_world.shape == (FRAMES, k, 4, 3)
    weights = np.exp(track.log_weight)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-9)
    assert (np.diff(weights, axis=1) <= 0).all()
    on_disk = tracks.read_summary(tmp_path)
    assert on_disk["ended"] == summary["ended"] == "complete"
    assert (on_disk["samples"], on_disk["modes"], on_disk["body"]) == (6, 2, "arm7")
    assert on_disk["samples_optimised"] == 6 * FRAMES
    for key in (
        "preset",
        "seed",
        "iterations",
        "settings",
        "versions",
        "seconds_per_frame",
        "best_mode_cost_by_term",
    ):
        assert key in on_disk
    assert (track.parent[0] == -1).all()


def test_same_seed_same_track(clip: Path, tmp_path: Path):
    for name in ("a", "b"):
        run(clip, tmp_path / name)
    run(clip, tmp_path / "c", seed=1)
    a, b, c = (torchcss.load_track(tmp_path / name) for name in "abc")
    np.testing.assert_array_equal(a.state, b.state)
    np.testing.assert_array_equal(a.covariance, b.covariance)
    assert not np.array_equal(a.state, c.state)


def test_all_terms_track(clip: Path, tmp_path: Path):
    summary = run(clip, tmp_path, terms=ALL_TERMS)
    assert {"contour", "flow", "interpenetration"} <= set(summary["best_mode_cost_by_term"])
    assert np.isfinite(torchcss.load_track(tmp_path).joints_world).all()


def test_float32_tracks_too(clip: Path, tmp_path: Path):
    run(clip, tmp_path, dtype="float32")
    assert np.isfinite(torchcss.load_track(tmp_path).joints_world).all()


@pytest.mark.parametrize("trouble", [KeyboardInterrupt(), OutputError("disk full")])
def test_interruption_keeps_the_frames(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trouble: BaseException
):
    step, calls = Tracker.step, []

    def stumbling(self: Tracker, *args, **kwargs):
        calls.append(None)
        if len(calls) == 3:
            raise trouble
        return step(self, *args, **kwargs)

    monkeypatch.setattr(Tracker, "step", stumbling)
    with pytest.raises(type(trouble)):
        run(clip, tmp_path)
    assert len(torchcss.load_track(tmp_path).frames) == 2
    assert tracks.read_summary(tmp_path)["ended"] == "interrupted"


def test_truncated_video_keeps_the_frames(clip: Path, tmp_path: Path):
    whole = (clip / "video.mp4").read_bytes()
    for name in ("cameras.json", "keypoints.npz"):
        (tmp_path / name).write_bytes((clip / name).read_bytes())
    (tmp_path / "video.mp4").write_bytes(whole[: int(0.8 * len(whole))])
    with pytest.raises(VideoError, match=r"video\.mp4"):
        run(tmp_path, tmp_path / "out")


@pytest.mark.parametrize(
    "bad",
    [{"terms": ("contour", "magic")}, {"samples": 0}, {"working_size": 0}, {"device": "cuda:99"}],
)
def test_bad_settings(bad: dict):
    with pytest.raises(ConfigurationError):
        Settings(**bad)


def test_scale_keypoints_maps_pixel_centres():
    corners = torch.tensor([[-0.5, -0.5], [1079.5, 1919.5]])
    mapped = scale_keypoints(corners, (1080, 1920), (360, 640))
    torch.testing.assert_close(mapped, torch.tensor([[-0.5, -0.5], [359.5, 639.5]]))


def test_base_follows_a_body_that_leans_over(generator: torch.Generator):
    body = load_body("body30")
    x = body.rest.clone()
    x[body.state_index("root_pitch")] = 1.2
    x = x + 0.05 * torch.randn(3, 30, generator=generator, dtype=torch.float64)
    x = body.bounds.project(x)
    mixture = GaussianMixture(
        x, 0.01 * torch.eye(30, dtype=torch.float64).expand(3, 30, 30), torch.zeros(3).double()
    )
    state = TrackerState(
        mixture, torch.zeros_like(x), generator.get_state(), torch.zeros((), dtype=torch.long)
    )
    moved, after = follow_with_base(body, state)
    angles = after.mixture.mean[0, [moved.state_index(f"root_{a}") for a in ("yaw", "pitch")]]
    torch.testing.assert_close(angles, torch.zeros(2, dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close(moved.pose(after.mixture.mean).joints, body.pose(x).joints)
    upright = replace_pitch(state, body, 0.3)
    assert follow_with_base(body, upright)[0] is body


def replace_pitch(state: TrackerState, body, pitch: float) -> TrackerState:
    mean = state.mixture.mean.clone()
    mean[:, body.state_index("root_pitch")] = pitch
    return state._replace(mixture=state.mixture._replace(mean=mean))


def test_demo_in_small(tmp_path: Path):
    settings = Settings(body="arm8", keypoints_use="first", samples=6, modes=2)
    summary = run_demo(tmp_path, settings=settings, num_frames=3)
    assert summary["mpjpe_mm"] < 60
    assert summary["mpjpe_best_of_modes_mm"] <= summary["mpjpe_mm"]
    assert tracks.read_summary(tmp_path)["mpjpe_mm"] == pytest.approx(summary["mpjpe_mm"])
    assert (tmp_path / "overlay.mp4").stat().st_size > 0
    assert replace(settings, seed=1).seed == 1

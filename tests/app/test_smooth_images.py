"""Smoothing with the images in view: what it gains, what it refuses, and the command."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from made_clip import track
from made_sequences import rendered_arm
from made_tracks import modes_at, writer_of

from torchcss import load_track
from torchcss.app.smooth import run_settings, smooth_frames, smooth_track
from torchcss.cli import main as cli
from torchcss.errors import ConfigurationError, VideoError
from torchcss.initialise.view import CameraView
from torchcss.io.run import Run
from torchcss.io.tracks import Track, read_summary
from torchcss.studies.render.sequences import SyntheticSequence
from torchcss.tracking.settings import Settings
from torchcss.tracking.smooth import Smoothing
from torchcss.types import Frame, Keypoints

NUM_FRAMES = 8
NOISE_PX = 1.0
SETTINGS = Settings(
    body="arm8", terms=("contour", "joints", "stabiliser", "temporal"), working_size=320
)


@pytest.fixture(scope="module")
def sequence() -> SyntheticSequence:
    return rendered_arm(0, NUM_FRAMES)


class Setup(NamedTuple):
    """A track about the truth, and what it takes to look at its images."""

    track: Track
    truth: np.ndarray
    arguments: dict[str, Any]


@pytest.fixture
def setup(sequence: SyntheticSequence) -> Setup:
    body, camera, source = sequence.body, sequence.camera, torch.Generator().manual_seed(1)
    writer, n = writer_of(body), body.num_parameters
    for index, state in enumerate(sequence.states):
        noisy = state + 0.08 * torch.randn(1, n, generator=source, dtype=torch.float64)
        noisy = body.bounds.project(noisy)
        spread = 0.08**2 * torch.eye(n)
        writer.append(modes_at(body, index, noisy, spread, rate=sequence.frame_rate))
    exact = camera.project(sequence.joints_world).uv
    seen = exact + NOISE_PX * torch.randn(exact.shape, generator=source, dtype=torch.float64)
    keypoints = Keypoints(seen, torch.ones_like(seen[..., 0]), body.joint_names)
    arguments = {
        "settings": SETTINGS,
        "views": [CameraView(camera, keypoints, NOISE_PX)],
    }
    return Setup(writer.track(), sequence.joints_world.numpy(), arguments)


def images(sequence: SyntheticSequence) -> Iterator[Frame]:
    for index, image in enumerate(sequence.frames):
        yield Frame(index, index / sequence.frame_rate, image)


def error_mm(track: Track, truth: np.ndarray) -> np.ndarray:
    """By frame."""
    return 1000 * np.linalg.norm(track.joints_world[:, 0] - truth, axis=-1).mean(-1)


def test_images_correct_what_the_modes_say(setup: Setup, sequence: SyntheticSequence):
    modes = smooth_track(setup.track)
    done = smooth_frames(setup.track, images(sequence), **setup.arguments)
    before, after = error_mm(modes.track, setup.truth), error_mm(done.track, setup.truth)
    assert after.mean() < 0.6 * before.mean()
    assert done.effect["evidence_of"] == "images"
    assert done.effect["mean_cost_after_images"] < done.effect["mean_cost_before_images"] - 1
    assert done.effect["jitter_after_m_per_s2"] < done.effect["jitter_before_m_per_s2"]
    bounds = sequence.body.bounds
    state = torch.from_numpy(done.track.state)
    assert torch.equal(bounds.project(state), state)
    assert np.linalg.eigvalsh(done.track.covariance[:, 0]).min() > 0


def test_colours_are_learnt_for_the_region_term(setup: Setup, sequence: SyntheticSequence):
    settings = replace(SETTINGS, terms=("region", "temporal"))
    arguments = setup.arguments | {"settings": settings}
    done = smooth_frames(setup.track, images(sequence), **arguments)
    before = done.effect["mean_cost_before_images"]
    assert before > 1
    assert done.effect["mean_cost_after_images"] < before


def test_lost_frames_get_their_evidence_back(setup: Setup, sequence: SyntheticSequence):
    lost = slice(3, 6)
    track = setup.track
    track.cost[lost] = np.inf
    track.state[lost], track.joints_world[lost] = track.state[:1], track.joints_world[:1]
    # The same motion for both, so that they differ by the images alone.
    done = smooth_frames(track, images(sequence), choice=Smoothing(), **setup.arguments)
    assert done.effect["frames_without_evidence"].tolist() == [3, 4, 5]
    assert np.isfinite(done.track.cost).all()
    between = error_mm(smooth_track(track).track, setup.truth)[lost].mean()
    assert error_mm(done.track, setup.truth)[lost].mean() < 0.7 * between


def test_other_videos_are_refused(setup: Setup, sequence: SyntheticSequence):
    short = list(images(sequence))[:-1]
    with pytest.raises(VideoError, match="no frame 7"):
        smooth_frames(setup.track, short, **setup.arguments)
    with pytest.raises(VideoError, match="no frame 0"):
        smooth_frames(setup.track, list(images(sequence))[1:], **setup.arguments)


def test_track_and_smooth_on_files(files: Path, capsys: pytest.CaptureFixture[str]):
    assert track(files, "--smooth-images", "--no-overlay") == 0
    assert "mean cost of a frame" in capsys.readouterr().out
    out = files / "out"
    first = (out / "smooth.npz").read_bytes()
    assert read_summary(out)["smoothed"]["evidence_of"] == "images"
    assert load_track(out / "smooth.npz").state.shape[:2] == (3, 1)
    inputs = (
        "--video", str(files / "video.mp4"), "--camera", str(files / "cameras.json"),
        "--keypoints", str(files / "keypoints.npz"),
    )  # fmt: skip
    assert cli.main(["smooth", str(out), *inputs, "--out", str(files / "again")]) == 0
    assert (files / "again" / "smooth.npz").read_bytes() == first
    # The run knows them all.
    assert cli.main(["smooth", str(out), "--images", "--out", str(files / "third")]) == 0
    assert (files / "third" / "smooth.npz").read_bytes() == first


def test_settings_come_from_the_run(setup: Setup):
    def told(settings: dict[str, Any]) -> Settings:
        return run_settings(Run(path=Path("a"), track=setup.track._replace(settings=settings)))

    assert told({}).body == "arm8"
    settings = told({"body": "arm8", "terms": ["joints"], "dtype": "float32", "new": 3})
    assert settings.terms == ("joints",)
    assert settings.dtype == "float64"
    with pytest.raises(ConfigurationError, match="not those of torchcss"):
        told({"terms": 3})

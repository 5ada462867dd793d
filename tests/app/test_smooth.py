"""Smoothing of tracks: bodies, bases, lost frames, files and the command."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_clip import track
from made_tracks import make_track, modes_at, writer_of
from reference.kinematics import rotation

from torchcss import load_body, load_track
from torchcss.app.smooth import report, smooth, smooth_track
from torchcss.body.model import BodyModel
from torchcss.body.root import move_base
from torchcss.cli import main as cli
from torchcss.errors import ConfigurationError, TrackFileError
from torchcss.inference.mixture import GaussianMixture
from torchcss.initialise.result import Initialisation
from torchcss.io.fitted_body import write_fitted_body
from torchcss.io.tracks import (
    Track,
    TrackWriter,
    read_summary,
    save_track,
    write_summary,
)
from torchcss.tracking.smooth import Smoothing
from torchcss.vision.camera import Camera

RATE = 30.0
DEVIATION = 0.05


def true_motion(body: BodyModel, t: int) -> torch.Tensor:
    """A slow swing of all parameters inside the limits."""
    lower, upper = body.lower.clamp(min=-0.8), body.upper.clamp(max=0.8)
    phase = torch.arange(body.num_parameters).double()
    swing = 0.5 + 0.3 * (3.0 * torch.arange(t)[:, None].double() / RATE + phase).sin()
    return lower + swing * (upper - lower)


def noisy_track(
    body: BodyModel,
    t: int = 30,
    *,
    others: int = 1,
    moved_at: int | None = None,
    turn: torch.Tensor | None = None,
    frames: list[int] | None = None,
) -> tuple[Track, torch.Tensor]:
    """A track whose best mode is the truth and noise, or in every fifth frame the second best.

    Returns it with the true states on the bases that it has.
    """
    source = torch.Generator().manual_seed(0)
    n, frames = body.num_parameters, frames or list(range(t))
    truth = true_motion(body, t)
    writer = writer_of(body)
    for index in frames:
        noise = DEVIATION * torch.randn(1 + others, n, generator=source, dtype=torch.float64)
        state = truth[index] + noise
        # Other poses altogether, and other ones in every frame.
        state[1:] += 0.6 * torch.rand(others, n, generator=source).double() + 0.2
        placed = body
        if turn is not None and moved_at is not None and index >= moved_at:
            placed, moved, _ = move_base(
                body,
                turn,
                torch.tensor([0.3, 0.2, -0.1]).double(),
                torch.cat([state, truth[[index]]]),
            )
            state, truth[index] = moved[:-1], moved[-1]
        state = placed.bounds.project(state)
        cost = torch.zeros(1 + others).double()
        cost[0] = 0.5 if index % 5 == 2 else -0.5
        told = {"log_weight": (-cost).log_softmax(0), "cost": cost}
        spread = DEVIATION**2 * torch.eye(n)
        writer.append(modes_at(placed, index, state, spread, rate=RATE, **told))
    return writer.track(), truth[frames]


def error(track: Track, truth: torch.Tensor) -> float:
    """Of the best mode."""
    return float(np.abs(track.state[:, 0] - truth.numpy()).mean())


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body("arm8")


def test_smoothing_takes_the_other_mode_and_the_noise_away(body: BodyModel):
    track, truth = noisy_track(body)
    done = smooth_track(track, Smoothing(likelihood_power=0.5, persistence=2.0))
    # Every fifth frame's best mode was the other pose.
    right = [1 if index % 5 == 2 else 0 for index in range(30)]
    assert done.modes.tolist() == right
    assert done.effect["frames_not_the_trackers_best"] == sum(right)
    assert error(done.track, truth) < 0.6 * DEVIATION * math.sqrt(2 / math.pi)
    assert done.effect["jitter_after_m_per_s2"] < 0.2 * done.effect["jitter_of_the_path_m_per_s2"]
    assert done.effect["jitter_before_m_per_s2"] > done.effect["jitter_of_the_path_m_per_s2"]

    assert done.track.state.shape == (30, 1, body.num_parameters)
    assert np.array_equal(done.track.frames, track.frames)
    assert np.array_equal(done.track.log_weight, np.zeros((30, 1)))
    assert (done.track.state[:, 0] >= body.lower.numpy()).all()
    assert (done.track.state[:, 0] <= body.upper.numpy()).all()
    joints = body.pose(torch.from_numpy(done.track.state[:, 0])).joints.numpy()
    assert done.track.joints_world[:, 0] == pytest.approx(joints, abs=1e-9)
    # All frames tell more than one, even counted by half; never anything negative.
    values = np.linalg.eigvalsh(done.track.covariance[:, 0])
    assert values.min() > 0
    assert np.median(values) < DEVIATION**2


def test_the_report_of_two_frames_has_no_jitter(body: BodyModel):
    track, _ = noisy_track(body)
    for num_frames, told in ((30, True), (2, False)):
        done = smooth_track(track.first(num_frames), Smoothing())
        effect = {**done.effect, "file": "smooth.npz"}
        assert ("jitter" in report(effect)) is told
        assert "nan" not in report(effect)


def test_the_acceleration_ratio_and_the_persistence_do_what_they_say(body: BodyModel):
    track, _ = noisy_track(body)
    jitters = [
        smooth_track(track, choice).effect["jitter_after_m_per_s2"]
        for choice in (Smoothing(acceleration_ratio=ratio) for ratio in (2.0, 10.0, 50.0))
    ]
    assert jitters == sorted(jitters)
    # The persistence scales covariances and moves nothing.
    some, all_ = (smooth_track(track, Smoothing(persistence=p)) for p in (2.0, 1.0))
    assert some.track.state == pytest.approx(all_.track.state, abs=1e-8)
    # (A variable at its limit has the prior's variance, whatever the persistence.)
    sizes = [np.diagonal(one.track.covariance[:, 0], axis1=-2, axis2=-1) for one in (some, all_)]
    free = sizes[0] < 1e-2
    assert free.mean() > 0.9
    assert sizes[0][free] == pytest.approx(2 * sizes[1][free], rel=0.1)


def test_a_frame_keeps_the_covariance_of_its_mode(body: BodyModel):
    """What is wrong in all frames is not known better for their number."""
    track, _ = noisy_track(body)
    done = smooth_track(track, Smoothing(likelihood_power=0.5))
    own = track.covariance[np.arange(len(track.frames)), done.modes]
    assert np.array_equal(done.track.covariance[:, 0], own)
    assert done.track.likelihood_power == track.likelihood_power


def test_with_a_lag_no_frame_knows_more_than_so_many_after_it(body: BodyModel):
    track, truth = noisy_track(body)
    choice = Smoothing(likelihood_power=0.5, persistence=2.0, lag=4)
    done = smooth_track(track, choice)
    # What comes later than the lag changes nothing, what comes within it does.
    first = track.first(20)
    early = smooth_track(first, choice)
    assert np.array_equal(early.track.state[:16], done.track.state[:16])
    assert np.array_equal(early.modes[:16], done.modes[:16])
    assert not np.allclose(early.track.state[16:], done.track.state[16:20], atol=1e-9)
    # As many as there are: the same as all.
    every = smooth_track(first, replace(choice, lag=20))
    all_ = smooth_track(first, replace(choice, lag=None))
    assert every.track.state == pytest.approx(all_.track.state, abs=1e-6)
    assert every.track.covariance == pytest.approx(all_.track.covariance, abs=1e-9)
    # None: only what came before.
    filtered = smooth_track(track, replace(choice, lag=0))
    errors = [error(one.track, truth) for one in (filtered, done, smooth_track(track, choice))]
    assert errors[0] > errors[1] >= errors[2]
    assert done.effect["lag"] == 4


@pytest.mark.parametrize(
    ("axis", "tolerance_m"), [((0.0, 1.2, 0.0), 1e-6), ((0.3, 0.4, -0.2), 0.02)]
)
def test_a_base_that_moves_changes_nothing(axis: tuple[float, ...], tolerance_m: float):
    # About the upright axis the coordinates differ by a constant; else the angles, and what is
    # expected of their motion, are others. The noise of the joints is 100 mm.
    body = load_body("body30")
    still, _ = noisy_track(body, 12)
    moving, truth = noisy_track(body, 12, moved_at=6, turn=rotation(*axis))
    one, other = smooth_track(still), smooth_track(moving)
    assert one.modes.tolist() == other.modes.tolist()
    assert other.track.joints_world == pytest.approx(one.track.joints_world, abs=tolerance_m)
    assert error(other.track, truth) < DEVIATION


def test_a_root_that_turns_beyond_half_a_turn():
    body = load_body("body30")
    track, _ = noisy_track(body, 20, others=0)
    yaw = body.state_index("root_yaw")
    wrapped = np.linspace(2.0, 2.0 + 2.0, 20)
    track.state[:, 0, yaw] = np.where(wrapped > math.pi, wrapped - 2 * math.pi, wrapped)
    placed = body.pose(torch.from_numpy(track.state[:, 0])).joints.numpy()
    track.joints_world[:, 0] = placed
    done = smooth_track(track)
    assert np.diff(done.track.state[:, 0, yaw]).max() < 0.3
    assert done.track.state[:, 0, yaw] == pytest.approx(wrapped, abs=0.1)


def test_a_root_may_wind_up_beyond_its_limits():
    """In a track its angles are wrapped; a smooth one turns on, past the limits of the body."""
    body = load_body("body30")
    track, _ = noisy_track(body, 40, others=0)
    yaw = body.state_index("root_yaw")
    wound = np.linspace(2.0, 2.0 + 6.0, 40)
    assert wound.max() > float(body.upper[yaw])
    track.state[:, 0, yaw] = np.remainder(wound + math.pi, 2 * math.pi) - math.pi
    track.joints_world[:, 0] = body.pose(torch.from_numpy(track.state[:, 0])).joints.numpy()
    done = smooth_track(track)
    assert done.track.state[:, 0, yaw] == pytest.approx(wound, abs=0.1)


def test_costs_are_nats_whatever_the_power_of_the_covariances(body: BodyModel):
    """The same evidence, written with covariances that count it in full and by a tenth."""
    full, _ = noisy_track(body)
    tenth = full._replace(covariance=10 * full.covariance, likelihood_power=0.1)
    one, other = smooth_track(full), smooth_track(tenth)
    assert other.track.state == pytest.approx(one.track.state, abs=1e-6)
    assert other.track.cost == pytest.approx(one.track.cost, abs=1e-4)
    assert (one.track.cost > full.cost[np.arange(len(one.modes)), one.modes][:, None]).all()


def test_frames_without_evidence_follow_from_their_neighbours(body: BodyModel, tmp_path: Path):
    track, truth = noisy_track(body)
    lost = slice(10, 14)
    track.cost[lost] = np.inf
    track.state[lost], track.joints_world[lost] = track.state[9:10], track.joints_world[9:10]
    done = smooth_track(track)
    save_track(tmp_path / "track.npz", done.track)
    assert np.isinf(load_track(tmp_path).cost[lost]).all()
    assert done.effect["frames_without_evidence"].tolist() == [10, 11, 12, 13]
    carried = np.abs(track.state[lost, 0] - truth[lost].numpy()).mean()
    assert np.abs(done.track.state[lost, 0] - truth[lost].numpy()).mean() < 0.6 * carried
    assert np.isinf(done.track.cost[lost]).all()
    assert np.isfinite(np.delete(done.track.cost, np.r_[lost])).all()
    wide = np.trace(done.track.covariance[:, 0], axis1=-2, axis2=-1)
    assert wide[12] > 1.5 * wide[5]


def test_missing_frames_make_longer_steps(body: BodyModel):
    frames = [index for index in range(40) if index % 4 != 1 and not 20 <= index < 26]
    track, truth = noisy_track(body, 40, frames=frames)
    done = smooth_track(track)
    assert done.track.frames.tolist() == frames
    assert error(done.track, truth) < 0.8 * DEVIATION * math.sqrt(2 / math.pi)


@pytest.mark.parametrize("t", [1, 2, 3])
def test_short_tracks(body: BodyModel, t: int):
    track, truth = noisy_track(body, t)
    done = smooth_track(track)
    assert error(done.track, truth) < 2 * DEVIATION
    if t == 1:
        assert done.track.state == pytest.approx(track.state[:, :1], abs=1e-9)
        assert math.isnan(done.effect["jitter_after_m_per_s2"])


def test_padded_modes_do_not_count(body: BodyModel):
    track, _ = noisy_track(body)

    def pad(array: np.ndarray, value: float) -> np.ndarray:
        more = np.full((30, 2, *array.shape[2:]), value, dtype=array.dtype)
        return np.concatenate([array, more], axis=1)

    padded = track._replace(
        state=pad(track.state, 0),
        covariance=pad(track.covariance, 0),
        log_weight=pad(track.log_weight, -np.inf),
        cost=pad(track.cost, np.inf),
        parent=pad(track.parent, -1),
        joints_world=pad(track.joints_world, 0),
    )
    assert np.array_equal(smooth_track(padded).track.state, smooth_track(track).track.state)


def test_random_modes_of_every_base(tmp_path: Path):
    # Poses that have nothing to do with each other, on bases that move: only sound, not smooth.
    track = make_track(load_body("body34"), (2, 3, 2, 3))
    done = smooth_track(track)
    assert np.isfinite(done.track.state).all()
    save_track(tmp_path / "smooth.npz", done.track)
    again = load_track(tmp_path / "smooth.npz")
    assert again.body is not None
    for name in Track._fields[:11]:
        assert np.array_equal(getattr(again, name), getattr(done.track, name)), name


def test_bad_choices_and_tracks_are_refused(body: BodyModel):
    track, _ = noisy_track(body, 4)
    with pytest.raises(ConfigurationError, match="acceleration_ratio"):
        Smoothing(acceleration_ratio=0.0)
    with pytest.raises(ConfigurationError, match="likelihood_power"):
        Smoothing(likelihood_power=math.inf)
    with pytest.raises(ConfigurationError, match="persistence"):
        Smoothing(persistence=-1.0)
    with pytest.raises(ConfigurationError, match="lag"):
        Smoothing(lag=-1)
    with pytest.raises(TrackFileError, match="times"):
        smooth_track(track._replace(times=track.times[::-1].copy()))
    with pytest.raises(TrackFileError, match="a covariance of the track is none"):
        smooth_track(track._replace(covariance=-track.covariance))
    empty = TrackWriter("unused", Track.empty(body.state_names, body.joint_names, body=body))
    with pytest.raises(TrackFileError, match="no frames"):
        smooth_track(empty.track())


def test_files_stay_and_the_summary_says_what_was_done(tmp_path: Path, body: BodyModel):
    track, _ = noisy_track(body)
    save_track(tmp_path / "track.npz", track)
    write_summary(tmp_path, {"seed": 3})
    before = (tmp_path / "track.npz").read_bytes()
    assert cli.main(["smooth", str(tmp_path), "--acceleration-ratio", "8"]) == 0
    assert (tmp_path / "track.npz").read_bytes() == before
    summary = read_summary(tmp_path)
    assert summary["seed"] == 3
    assert summary["smoothed"]["acceleration_ratio"] == 8
    assert len(summary["smoothed"]["modes"]) == 30
    assert load_track(tmp_path / "smooth.npz").state.shape[1] == 1
    with pytest.raises(ConfigurationError, match="would replace it"):
        smooth(tmp_path / "smooth.npz")
    # Elsewhere, from the file itself, without a summary; again is the same.
    (tmp_path / "summary.json").unlink()
    elsewhere = tmp_path / "other"
    smooth(tmp_path / "track.npz", Smoothing(acceleration_ratio=8.0), out=elsewhere)
    assert (elsewhere / "smooth.npz").read_bytes() == (tmp_path / "smooth.npz").read_bytes()
    assert not (tmp_path / "summary.json").exists()
    assert json.loads((elsewhere / "summary.json").read_text())["smoothed"]["path_switches"] == 0


def test_the_summary_of_another_run_stays(tmp_path: Path, body: BodyModel) -> None:
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        save_track(tmp_path / name / "track.npz", noisy_track(body)[0])
        write_summary(tmp_path / name, {"seed": name})
    with pytest.raises(ConfigurationError, match="holds another run"):
        smooth(tmp_path / "one", out=tmp_path / "other")
    assert read_summary(tmp_path / "other") == {"seed": "other"}


def test_one_line_for_a_missing_track(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert cli.main(["smooth", str(tmp_path / "nothing")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_body_is_used_without_a_video_too(
    tmp_path: Path, body: BodyModel, capsys: pytest.CaptureFixture[str]
):
    found, truth = noisy_track(body)
    save_track(tmp_path / "track.npz", found)
    n = body.num_parameters
    mixture = GaussianMixture(truth[:1], torch.eye(n)[None].double(), torch.zeros(1).double())
    eye = Camera([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], (640, 480))
    longer = load_body(body.name, lengths={"forearm": 1.1 * body.lengths["forearm"]})
    for name, one in (("own", body), ("longer", longer)):
        lengths = dict(one.lengths)
        fitted = Initialisation(one, mixture, torch.zeros(1).double(), (), lengths)
        write_fitted_body(tmp_path / f"{name}.npz", fitted, eye)
    given = ["smooth", str(tmp_path), "--body"]
    assert cli.main([*given, str(tmp_path / "own.npz")]) == 0
    assert cli.main([*given, str(tmp_path / "longer.npz")]) == 2
    assert "misses the joints of the track" in capsys.readouterr().err


def test_options_of_keypoints_need_the_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    options = {
        "--keypoints": "b",
        "--layout": "BODY_25",
        "--normalised": "zero-one",
        "--masks": "d",
    }
    words = [word for pair in options.items() for word in pair]
    assert cli.main(["smooth", str(tmp_path), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert all(option in line for option in (*options, "--images"))


def test_track_smooths_when_it_is_done(files: Path, capsys: pytest.CaptureFixture[str]):
    assert track(files, "--smooth") == 0
    assert "jitter" in capsys.readouterr().out
    found = load_track(files / "out" / "smooth.npz")
    assert found.state.shape[:2] == (3, 1)
    assert "smoothed" in read_summary(files / "out")

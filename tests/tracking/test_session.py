"""The loop from files to a track: determinism, interruption, the base transform."""

from __future__ import annotations

import json
import math
import pickle
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from made_clip import grey_film
from made_sequences import rendered_arm, write_clip
from made_sessions import INTERVAL, moving_arm, seen_by, session_at, start_at
from torch import Tensor

import torchcss
from torchcss.app.track import TrackOptions, first_pose_from_file, track_video
from torchcss.app.view_files import FrameSelection
from torchcss.body.load import load_body
from torchcss.cost.joints import JointTerm
from torchcss.cost.temporal import MixturePrior, TemporalPrior
from torchcss.cost.total import TrackingCost
from torchcss.errors import ConfigurationError, OutputError, TorchcssError, VideoError
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.proposals import CovarianceScaled
from torchcss.inference.tracker import Particles, Tracker, TrackerState
from torchcss.initialise.result import Initialisation
from torchcss.initialise.view import CameraView
from torchcss.io import tracks
from torchcss.io.fitted_body import read_fitted_body, write_fitted_body
from torchcss.io.run import Run, body_of_track
from torchcss.io.tracks import Track
from torchcss.io.video import VideoWriter
from torchcss.robust import Quadratic
from torchcss.studies.demo import run_demo
from torchcss.studies.render.sequences import SyntheticSequence
from torchcss.tracking.limb_moves import LostLimbs
from torchcss.tracking.presets import PRESETS
from torchcss.tracking.session import Posterior, TrackingSession, follow_with_base
from torchcss.tracking.settings import (
    TERMS,
    Settings,
    all_terms,
    make_choice,
    make_plan,
    make_tracker,
    named_terms,
    settings_from_plain,
)
from torchcss.types import Bounds, Frame
from torchcss.vision.camera import Camera

FRAMES = 4


@pytest.fixture(scope="session")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short rendered clip of an arm with camera and keypoints, as files."""
    folder = write_clip(tmp_path_factory.mktemp("clip"), rendered_arm(3, FRAMES))
    few = Settings(body="arm7", samples=2, modes=1, overlay=False, terms=("joints",))
    track_video(
        folder / "video.mp4",
        camera=folder / "cameras.json",
        keypoints=folder / "keypoints.npz",
        out=folder / "first",
        stop=1,
        settings=few,
    )
    return folder


def run(clip: Path, out: Path, **settings) -> Mapping[str, Any]:
    """Track the clip from a first pose that is found once, in small images."""
    settings = {"working_size": 160, **settings}
    return track_video(
        clip / "video.mp4",
        camera=clip / "cameras.json",
        keypoints=clip / "keypoints.npz",
        out=out,
        settings=Settings(body="arm7", samples=6, modes=2, overlay=False, **settings),
        options=TrackOptions(init=clip / "first" / "body.npz"),
    ).summary


@pytest.fixture(scope="module")
def tracked(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Mapping[str, Any]]:
    """A folder that the clip was tracked into, with all defaults, and the summary."""
    folder = tmp_path_factory.mktemp("tracked")
    return folder, track_video(
        clip / "video.mp4",
        camera=clip / "cameras.json",
        keypoints=clip / "keypoints.npz",
        out=folder,
        settings=Settings(body="arm7", samples=6, modes=2),
    ).summary


def test_writes_what_the_design_says(tracked: tuple[Path, Mapping[str, Any]]):
    folder, summary = tracked
    names = "track.npz summary.json checkpoint.npz overlay.mp4 body.npz report.html"
    assert {p.name for p in folder.iterdir()} == set(names.split())
    track = torchcss.load_track(folder)
    assert track.frames.tolist() == list(range(FRAMES))
    assert track.state_names == load_body("arm7").state_names
    k = track.state.shape[1]
    assert track.covariance.shape == (FRAMES, k, 7, 7)
    assert track.joints_world.shape == (FRAMES, k, 4, 3)
    weights = np.exp(track.log_weight)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-9)
    assert (np.diff(weights, axis=1) <= 0).all()
    on_disk = tracks.read_summary(folder)
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


def test_the_body_lies_beside_the_track(
    clip: Path, tracked: tuple[Path, Mapping[str, Any]], tmp_path: Path
):
    """What was fitted, and again where it was given; the user's own file stays as it is."""
    fitted = read_fitted_body(tracked[0])
    body = body_of_track(torchcss.load_track(tracked[0]), fitted.body)
    # Flesh that was fitted, on the lengths of the track.
    assert not torch.equal(body.part_shape, load_body("arm7", lengths=body.lengths).part_shape)
    own = tmp_path / "own" / "body.npz"
    own.parent.mkdir()
    shutil.copy(tracked[0] / "body.npz", own)
    before = own.read_bytes()
    for init, out in ((own, tmp_path / "out"), (own.parent, own.parent), (own, own.parent)):
        track_video(
            clip / "video.mp4",
            camera=clip / "cameras.json",
            keypoints=clip / "keypoints.npz",
            out=out,
            options=TrackOptions(init=init),
            settings=Settings(body="arm7", samples=2, modes=1, overlay=False, terms=("joints",)),
            stop=1,
        )
        again = read_fitted_body(out)
        torch.testing.assert_close(again.body.part_shape, body.part_shape)
        assert again.body.lengths == pytest.approx(fitted.body.lengths)
        torch.testing.assert_close(again.mixture.mean, fitted.mixture.mean)
    assert own.read_bytes() == before


def test_same_seed_same_track(clip: Path, tmp_path: Path):
    for name in ("a", "b"):
        run(clip, tmp_path / name)
    run(clip, tmp_path / "c", seed=1)
    a, b, c = (torchcss.load_track(tmp_path / name) for name in "abc")
    np.testing.assert_array_equal(a.state, b.state)
    np.testing.assert_array_equal(a.covariance, b.covariance)
    assert not np.array_equal(a.state, c.state)


def test_all_terms_track(clip: Path, tmp_path: Path):
    summary = run(clip, tmp_path, terms=all_terms(), engine="eager")
    # Weights of edges and the background are no terms; lengths are not free while tracking; an arm
    # is not segmented, and has neither silhouette nor a person's poses.
    without = {"motion_boundaries", "foreground", "background", "anthropometric"}
    names = set(all_terms()) - without - {"segmentation", "silhouette", "pose_prior"}
    assert set(summary["best_mode_cost_by_term"]) == set(summary["share_of_cost_by_term"]) == names
    times = summary["share_of_search_time_by_term"]
    assert set(times) == names | {"pose", "visibility", "lift", "optimiser"}
    assert sum(times.values()) == pytest.approx(1)
    assert sum(summary["share_of_cost_by_term"].values()) == pytest.approx(1)
    assert np.isfinite(torchcss.load_track(tmp_path).joints_world).all()


def test_float32_tracks_too(clip: Path, tmp_path: Path):
    """And the file tells the power that counts in its weights and in its covariances."""
    run(clip, tmp_path, dtype="float32", likelihood_power=0.7)
    track = torchcss.load_track(tmp_path)
    assert np.isfinite(track.joints_world).all()
    assert track.likelihood_power == 0.7


def test_a_new_run_replaces_what_belongs_to_the_last_one(clip: Path, tmp_path: Path):
    """And what fails before its first frame replaces nothing."""
    out = tmp_path / "out"
    run(clip, out)
    made = ("smooth.npz", "overlay.mp4", "overlay_2.mp4", "report.html", "smooth_report.html")
    for other in (*made, "overlay_of_mine.mp4"):
        (out / other).write_bytes(b"old")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(ConfigurationError, match="descend"):
        run(clip, out, preset="ijrr_condensation", oversampling=2)
    with pytest.raises(ConfigurationError, match="likelihood_power"):
        run(clip, out, preset="ijrr_condensation", likelihood_power=0.5)
    with pytest.raises(ConfigurationError, match="limb_jumps"):
        run(clip, out, preset="ijrr_condensation", limb_jumps=4)
    (tmp_path / "empty.mp4").write_bytes(b"")
    with pytest.raises(VideoError):
        track_video(
            tmp_path / "empty.mp4", camera=clip / "cameras.json", keypoints=clip / "keypoints.npz",
            out=out, settings=Settings(body="arm7"),
        )  # fmt: skip
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    run(clip, out, seed=3)
    assert sorted(path.name for path in out.iterdir()) == [
        "body.npz", "checkpoint.npz", "overlay_of_mine.mp4", "summary.json", "track.npz",
    ]  # fmt: skip
    assert (out / "track.npz").read_bytes() != before["track.npz"]


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
    shutil.copytree(clip / "first", tmp_path / "first")
    (tmp_path / "video.mp4").write_bytes(whole[: int(0.8 * len(whole))])
    with pytest.raises(VideoError, match=r"video\.mp4"):
        run(tmp_path, tmp_path / "out")


@pytest.mark.parametrize(
    "bad",
    [
        {"terms": ("contour", "magic")}, {"samples": 0}, {"working_size": 63},
        {"device": "cuda:99"}, {"keypoints_use": "frist"}, {"engine": "none"},
        {"dtype": "float16"}, {"dtype": None},
        {"curvature": "some"}, {"prediction": "none"}, {"modes": 2.5}, {"samples": "6"},
    ],
)  # fmt: skip
def test_bad_settings(bad: dict):
    with pytest.raises(ConfigurationError):
        Settings(**bad)


@pytest.mark.parametrize(
    ("name", "bad", "good"),
    [
        ("contour_weight", (-1.0, float("nan"), float("inf")), (0.0, 300.0)),
        ("boundary_emphasis", (-0.1, 1.1, float("nan")), (0.0, 1.0)),
        ("seed", (-1, 2**63), (0, 2**63 - 1)),
        ("limb_jumps", (-1,), (0, 2)),
        ("terms", ((), ("motion_boundaries",), ("temporal", "stabiliser")), (("joints",),)),
    ],
)
def test_settings_out_of_range_are_refused_by_name(name: str, bad: tuple, good: tuple):
    for value in bad:
        with pytest.raises(ConfigurationError, match=name):
            Settings(**{name: value})
    for value in good:
        assert getattr(Settings(**{name: value}), name) == value


def test_settings_of_other_types_are_those_of_a_file(tmp_path: Path):
    given = {"samples": np.int64(6), "likelihood_power": np.float32(0.25), "seed": np.int64(3)}
    more = {"overlay": np.bool_(False), "weights": {"flow": np.float32(2)}, "terms": "still"}
    others = {"body": Path("arm8"), "device": torch.device("cpu")}
    made = Settings(**given, **more, **others)
    track = Track.empty((), ())._replace(settings=asdict(made))
    tracks.save_track(tmp_path / "track.npz", track)
    held = tracks.load_track(tmp_path / "track.npz").settings
    assert settings_from_plain(held) == made
    assert {name: type(held[name]) for name in ("samples", "likelihood_power", "overlay")} == {
        "samples": int, "likelihood_power": float, "overlay": bool,
    }  # fmt: skip
    torch.Generator().manual_seed(made.seed)
    selection = FrameSelection(start=np.int64(1), stop=np.int64(3))
    assert json.dumps(asdict(selection)) == '{"start": 1, "stop": 3, "stride": 1}'


def test_a_body_from_a_file_is_the_same_by_any_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "robots").mkdir()
    robot = tmp_path / "robots" / "robot.urdf"
    robot.write_text(
        "<robot name='r'><link name='a'/><link name='b'/><joint name='j' type='continuous'>"
        "<parent link='a'/><child link='b'/></joint></robot>"
    )
    body = load_body(robot, free_root=True)
    mixture = GaussianMixture(
        body.rest[None], torch.eye(7, dtype=torch.float64)[None], torch.zeros(1).double()
    )
    eye = Camera([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], (640, 480))
    found = Initialisation(body, mixture, torch.zeros(1).double(), ())
    write_fitted_body(tmp_path / "body.npz", found, eye)
    monkeypatch.chdir(tmp_path / "robots")
    for name in (str(robot), "robot.urdf", "../robots/robot.urdf"):
        first = first_pose_from_file(tmp_path, eye, Settings(body=name))
        assert first.body.state_names == body.state_names
    with pytest.raises(ConfigurationError, match=r"give the body .*robot\.urdf"):
        first_pose_from_file(tmp_path, eye, Settings(body="other.urdf"))


def test_the_papers_start_from_one_fit_whose_covariance_nothing_caps():
    body = load_body("arm8")
    camera = Camera.pinhole(640, 480, focal_px=500.0)
    first = start_at(body, body.rest)
    wide = 4 * first.mixture.covariance[0]
    first = first._replace(uncapped=wide)
    for preset, variance in {"css": 0.01, "ijrr_css": 0.04}.items():
        session = TrackingSession(Settings(preset=preset, body="arm8"), first, camera)
        covariance = session.state.tracker.mixture.covariance[0]
        free = covariance.diagonal() > 0
        assert bool(free.any())
        torch.testing.assert_close(
            covariance.diagonal()[free], torch.full_like(covariance.diagonal()[free], variance)
        )


@pytest.mark.parametrize(("preset", "more"), [("ijrr_single_limits", 1), ("css", 0)])
def test_a_first_covariance_that_was_floored_is_counted(preset: str, more: int):
    """In the first frame, where a track starts from it."""
    arm = moving_arm(2)
    first = start_at(arm.body, arm.states[0])
    first = first._replace(uncapped=first.mixture.covariance[0])
    settings = Settings(preset=preset, body=arm.body.name, samples=1, engine="eager")

    def counts(floored: bool) -> list[int]:
        start = first._replace(uncapped_floored=floored)
        session = TrackingSession(settings, start, seen_by(arm.camera), frame_interval=INTERVAL)
        return [int(frame.info.num_floored) for frame in session.track(arm.frames)]

    plain, floored = counts(floored=False), counts(floored=True)
    assert floored == [plain[0] + more, plain[1]]


@pytest.mark.parametrize("preset", ["ijrr_css", "ijrr_css_spherical", "ijrr_cham_rehg"])
def test_the_papers_first_hypotheses_are_drawn_from_the_fit_as_it_is(preset: str):
    """Section 5 [IJRR]; from then on the proposal is the preset's."""
    body, nothing = load_body("arm8"), cast("Any", None)
    camera = Camera.pinhole(64, 48, focal_px=50.0)
    settings = Settings(preset=preset, body="arm8")
    session = TrackingSession(settings, start_at(body, body.rest), camera)
    own = session.plan.tracker
    assert isinstance(own, Tracker)
    first = session._tracker(nothing, nothing, 1.0)
    assert first == replace(own, proposal=CovarianceScaled(covariance_scale=1.0))
    state = session.state.tracker._replace(frame=torch.tensor(1))
    session.state = session.state._replace(tracker=state)
    assert session._tracker(nothing, nothing, 1.0) == own


def test_base_follows_a_body_that_leans_over(generator: torch.Generator):
    body = load_body("body30")
    x = body.rest.clone()
    x[body.state_index("root_pitch")] = 1.2
    x = x + 0.05 * torch.randn(3, 30, generator=generator, dtype=torch.float64)
    x = body.bounds.project(x)
    mixture = GaussianMixture(
        x, 0.01 * torch.eye(30, dtype=torch.float64).expand(3, 30, 30), torch.zeros(3).double()
    )
    step = 0.05 * torch.randn(3, 30, generator=generator, dtype=torch.float64)
    state = TrackerState(mixture, step, generator.get_state(), torch.zeros((), dtype=torch.long))
    # What a filter weighs, and where the descents of Fig. 4 [RR] begin.
    state = state._replace(particles=Particles(x, step, torch.zeros(3), torch.arange(3)))
    moved, after = follow_with_base(body, state)
    assert after.particles is not None
    assert torch.equal(after.particles.x, after.mixture.mean)
    assert torch.equal(after.particles.velocity, after.velocity)
    angles = after.mixture.mean[0, [moved.state_index(f"root_{a}") for a in ("yaw", "pitch")]]
    torch.testing.assert_close(angles, torch.zeros(2, dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close(moved.pose(after.mixture.mean).joints, body.pose(x).joints)
    last = x - state.velocity
    torch.testing.assert_close(
        moved.pose(after.mixture.mean - after.velocity).joints, body.pose(last).joints
    )
    upright = replace_pitch(state, body, 0.3)
    assert follow_with_base(body, upright)[0] is body


def test_base_keeps_the_motion_of_a_body_that_turns(generator: torch.Generator):
    body = load_body("body30")
    yaw = body.state_index("root_yaw")
    x = body.rest.expand(2, 30).clone()
    # One mode turns as well, but is seen from the new base half a turn away.
    x[:, yaw] = x.new_tensor([4.75, 4.75 - math.pi + 0.1])
    step = torch.zeros_like(x)
    step[:, yaw] = 0.3
    mixture = GaussianMixture(
        x, 0.01 * torch.eye(30, dtype=torch.float64).expand(2, 30, 30), torch.zeros(2).double()
    )
    state = TrackerState(mixture, step, generator.get_state(), torch.zeros((), dtype=torch.long))
    moved, after = follow_with_base(body, state)
    assert moved is not body
    torch.testing.assert_close(after.velocity, step)


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


@pytest.mark.parametrize("number", [0, -3])
def test_a_demo_without_frames_is_refused(tmp_path: Path, number: int):
    with pytest.raises(ConfigurationError, match="num_frames must be at least 1"):
        run_demo(tmp_path, num_frames=number)


def write_masks(path: Path, width: int, height: int, num_frames: int = FRAMES) -> Path:
    return grey_film(path, [255] * num_frames, (width, height))


def test_masks_are_read_along_with_the_video(clip: Path, tmp_path: Path):
    settings = Settings(
        body="arm7", samples=4, modes=1, overlay=False, terms=("contour",), working_size=160
    )
    for masks, message in (
        (write_masks(tmp_path / "small.mp4", 64, 48), "video's size 640 x 480, these have 64 x 48"),
        (
            write_masks(tmp_path / "short.mp4", 640, 480, 2),
            r"short.mp4: the masks end before frame 2",
        ),
    ):
        with pytest.raises(VideoError, match=message):
            track_video(
                clip / "video.mp4",
                camera=clip / "cameras.json",
                keypoints=clip / "keypoints.npz",
                out=tmp_path / "track",
                settings=settings,
                options=TrackOptions(masks=masks, init=clip / "first" / "body.npz"),
            )
    assert torchcss.load_track(tmp_path / "track").frames.tolist() == [0, 1]


def test_masks_weigh_the_edges():
    """A white mask takes two per cent of the weight, a black one most of it."""
    sequence = rendered_arm(3, 1)
    settings = Settings(body="arm8", terms=("contour",), working_size=160)
    costs = []
    for masks in (None, [np.full((480, 640), 255, np.uint8)], [np.zeros((480, 640), np.uint8)]):
        (tracked,) = track(sequence.frames, sequence, settings, masks=masks)
        costs.append(tracked.terms["contour"])
    assert costs[0] == pytest.approx(costs[1], rel=0.02)
    assert costs[2] > costs[0] + 10


def track(
    images: Iterable[np.ndarray],
    sequence: SyntheticSequence,
    settings: Settings,
    view: CameraView | None = None,
    masks: list[np.ndarray] | None = None,
) -> list[Posterior]:
    """Track from the true first pose, by default without keypoints, with few samples."""
    few = replace(settings, samples=4, modes=2)
    view = view or seen_by(sequence.camera)
    session = session_at(few, sequence.body, sequence.states[0], view)
    session.plan = session.plan._replace(jumps_every=0)
    frames = (
        Frame(i, i / 25, image, None if masks is None else masks[i])
        for i, image in enumerate(images)
    )
    return list(session.track(frames))


def test_poses_of_limbs_join_the_search(monkeypatch: pytest.MonkeyPatch):
    """What descends from them is the best mode's."""
    sequence = rendered_arm(0, 3)
    settings = Settings(body="arm8", keypoints_use="first", working_size=160)
    asked, column = [], sequence.body.state_index("r_elbow_flexion")

    def aside(move: LostLimbs, best: GaussianMixture, bounds: Bounds) -> Tensor:
        asked.append(move.num)
        elsewhere = best.mean.clone()
        elsewhere[:, column] += 0.1
        return elsewhere

    monkeypatch.setattr(LostLimbs, "states", aside)
    plain = track(sequence.frames, sequence, settings)
    assert asked == []
    jumping = track(sequence.frames, sequence, replace(settings, limb_jumps=4))
    assert asked == [4, 4, 4]
    assert int(jumping[0].info.origin.max()) == 1, "the pose was descended from"
    known = 1
    for with_jump, without in zip(jumping, plain, strict=True):
        assert int(with_jump.info.parent.max()) < known
        assert not torch.equal(with_jump.state.mixture.mean, without.state.mixture.mean)
        known = len(with_jump.state.mixture.mean)


def test_between_steps_only_the_base_touches_the_state(monkeypatch: pytest.MonkeyPatch):
    """A tracker starts from what it returned, but for a base that moves along."""
    sequence = rendered_arm(0, 4)
    given, returned = [], []
    step = Tracker.step

    def spy(tracker: Tracker, state: TrackerState, *args: Any) -> Any:
        given.append(state)
        done = step(tracker, state, *args)
        returned.append(done[0])
        return done

    monkeypatch.setattr(Tracker, "step", spy)
    settings = Settings(
        body="arm8", keypoints_use="first", working_size=160, limb_jumps=2, samples=6, modes=2
    )
    session = session_at(settings, sequence.body, sequence.states[0], seen_by(sequence.camera))
    session.plan = session.plan._replace(jumps_every=1)
    for posterior in session.track(sequence.frames):
        assert int(posterior.info.parent.max()) < len(given[-1].mixture.mean)
    for before, after in zip(returned, given[1:], strict=False):
        assert before is after


def test_the_next_frame_may_be_seen_while_this_one_is_searched():
    """Where it is looked at is known a frame ago, so that the bits are the same."""
    sequence = rendered_arm(0, 4)
    settings = Settings(body="arm8", working_size=160, samples=4, modes=2)
    view = seen_by(sequence.camera)
    one, ahead = (session_at(settings, sequence.body, sequence.states[0], view) for _ in range(2))
    expected = list(one.track(sequence.frames))
    observation = ahead.observe(sequence.frames[0])
    for index, posterior in enumerate(expected):
        coming = ahead.observe(sequence.frames[index + 1]) if index < 3 else observation
        got = ahead.step(observation)
        for part, same in zip(got.state.mixture, posterior.state.mixture, strict=True):
            assert torch.equal(part, same)
        observation = coming
    features = observation.views[0].features
    assert features is not None
    assert features.window is not None, "an arm does not fill the picture"


@pytest.mark.parametrize("num_frames", [0, 1, 4])
def test_two_threads_give_the_same_bits(num_frames: int):
    sequence = rendered_arm(0, 4)
    settings = Settings(body="arm8", working_size=160, samples=4, modes=2)
    view, frames = seen_by(sequence.camera), sequence.frames[:num_frames]
    tracks = [
        list(session_at(each, sequence.body, sequence.states[0], view).track(frames))
        for each in (settings, replace(settings, threads=2))
    ]
    assert [len(track) for track in tracks] == [num_frames] * 2
    for one, two in zip(*tracks, strict=True):
        for part, same in zip(one.state.mixture, two.state.mixture, strict=True):
            assert torch.equal(part, same)


@pytest.mark.parametrize("threads", [1, 2])
def test_who_stops_on_the_way_goes_on_from_there(threads: int):
    sequence = rendered_arm(0, 4)
    settings = Settings(body="arm8", working_size=160, samples=4, modes=2, threads=threads)
    view = seen_by(sequence.camera, sequence.joints_world, sequence.body.joint_names)
    whole, parts = (session_at(settings, sequence.body, sequence.states[0], view) for _ in range(2))
    expected = list(whole.track(sequence.frames))
    (first,) = islice(parts.track(sequence.frames), 1)
    with pytest.raises(TorchcssError):
        parts.observe(np.arange(2 * 480 * 640, dtype=np.uint8).reshape(480, 640, 2))
    got = [first, *parts.track(sequence.frames[1:])]
    for one, other in zip(got, expected, strict=True):
        assert one.frame.index == other.frame.index
        assert torch.equal(one.state.mixture.mean, other.state.mixture.mean)


def test_torch_works_in_one_thread_beside_the_kernels():
    """Else what is found would depend on how many cores there are."""
    sequence = rendered_arm(0, 3)
    settings = Settings(body="arm8", working_size=160, samples=4, modes=2)
    session = session_at(settings, sequence.body, sequence.states[0], seen_by(sequence.camera))
    numbers, before = [], torch.get_num_threads()

    def frames():
        for image in sequence.frames:
            numbers.append(torch.get_num_threads())
            yield image

    def noted(cost: TrackingCost) -> TrackingCost:
        numbers.append(torch.get_num_threads())
        return cost

    try:
        torch.set_num_threads(2)
        for image in frames():
            session.step(session.observe(image), noted)
            assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert numbers == [2, 1 if session.plan.engine is not None else 2] * 3


def test_what_is_wrong_with_an_image_is_told_by_two_threads_too():
    sequence = rendered_arm(0, 2)
    settings = Settings(body="arm8", working_size=160, samples=4, modes=2, threads=2)
    session = session_at(settings, sequence.body, sequence.states[0], seen_by(sequence.camera))
    images = [sequence.frames[0], np.zeros((4, 4, 2), np.uint8) + np.arange(2, dtype=np.uint8)]
    tracked = session.track(images)
    next(tracked)
    with pytest.raises(TorchcssError):
        next(tracked)


def test_terms_of_the_best_mode_add_up_to_its_cost():
    """In every frame; what the frame before makes likely is a term, and no cost of this one's."""
    sequence = rendered_arm(0, 4)
    settings = Settings(body="arm8", keypoints_use="first", working_size=160, engine="eager")
    for tracked in track(sequence.frames, sequence, settings):
        terms = dict(tracked.terms)
        terms.pop("temporal_mixture")
        assert sum(terms.values()) == pytest.approx(float(tracked.info.cost[0]), rel=1e-9)


def test_frames_without_detections_have_no_term_of_joints():
    """Detectors write such frames as zeros; they cost nothing, and are not what is usual."""
    sequence = rendered_arm(0, 2)
    settings = Settings(body="arm8", working_size=160, terms=("joints", "temporal"))
    view = seen_by(sequence.camera, sequence.joints_world, sequence.body.joint_names)
    assert view.keypoints is not None
    view.keypoints.confidence[1] = 0
    frames = track(sequence.frames, sequence, settings, view)
    assert ["joints" in tracked.terms for tracked in frames] == [True, False]


def awkward_frames(sequence: SyntheticSequence) -> dict[str, np.ndarray]:
    """What a decoder, a cable or a film editor may put between two frames of a video."""
    first, *others, last = sequence.frames
    grey = first.mean(axis=-1).astype(np.uint8)
    return {
        "first": first,
        "grey": grey,
        "grey, 16 bits": grey.astype(np.uint16) * 257,
        "with alpha": np.dstack([others[0], np.zeros_like(grey)]),
        "repeated": others[0],
        "after dropped ones": last,
        "black": np.zeros_like(first),
        "white": np.full_like(first, 255),
        "one colour": np.full_like(first, 90),
        "saturated": np.where(first > 90, 255, 0).astype(np.uint8),
        "scene cut": np.ascontiguousarray(first[::-1, ::-1].transpose(1, 0, 2)[:480, :480])
        .repeat(2, axis=1)[:, :640]
        .copy(),
        "back": last,
    }


def test_awkward_frames_leave_no_nan_and_lose_nothing():
    sequence = rendered_arm(3, 8)
    frames = awkward_frames(sequence)
    assert all(frame.shape[:2] == (480, 640) for frame in frames.values())
    settings = Settings(body="arm8", terms=all_terms(), working_size=160)
    tracked = track(frames.values(), sequence, settings)
    for name, frame in zip(frames, tracked, strict=True):
        assert torch.isfinite(frame.info.cost).all(), name
        assert torch.isfinite(frame.joints_world).all(), name
        for part in frame.state.mixture:
            assert torch.isfinite(part).all(), name
        assert all(np.isfinite(value) for value in frame.terms.values()), name


@pytest.mark.parametrize(
    ("asked", "power"),
    [
        ({}, 0.15),
        ({"keypoints_use": "first"}, 0.15),
        ({"terms": ("contour", "temporal")}, 0.15),
        ({"body": "arm8"}, 0.15 * 4 / 18),
        ({"likelihood_power": 0.7}, 0.7),
        ({"keypoints_use": "first", "likelihood_power": 0.7}, 0.7),
        ({"preset": "ijrr_css_heavy_tailed"}, 1.0),
        ({"preset": "ijrr_css"}, 1.0),
        ({"preset": "ijrr_single_limits"}, 1.0),
        ({"preset": "annealed"}, 1.0),
    ],
)
def test_how_much_a_frame_counts(asked: dict[str, Any], power: float) -> None:
    settings = Settings(**asked)
    tracker = make_tracker(settings, motion=0.1)
    assert tracker.stated_power == pytest.approx(power)
    if isinstance(tracker, Tracker):
        assert tracker.likelihood_power == pytest.approx(power)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_row_of_the_table_can_be_run_by_its_name(preset: str):
    settings, row = Settings(body="arm7", preset=preset, terms=all_terms()), PRESETS[preset]
    tracker = make_tracker(settings, motion=0.1)
    assert (tracker.num_samples, tracker.num_modes) == (row.samples_arm, row.modes_arm)
    choice = make_choice(settings, 2.0)
    assert isinstance(choice.find(JointTerm).potential, Quadratic) != row.robust
    assert choice.curvature is row.curvature
    names = {term.name for term in choice.terms}
    assert "interpenetration" in names, "terms that are given win"
    printed = make_choice(Settings(body="arm7", preset=preset), 2.0).terms
    assert ("interpenetration" in {term.name for term in printed}) == row.interpenetration
    # The dynamics of particles are the temporal prior, and count once.
    for prior in (TemporalPrior, MixturePrior):
        assert (prior.name in names) == (row.particles is None)


def test_a_body_is_segmented_and_an_arm_alone_is_not():
    def names(**settings: Any) -> set[str]:
        return {term.name for term in make_choice(Settings(**settings), 2.0).terms}

    assert "segmentation" in names(body="body34")
    assert "segmentation" not in names(body="body34", preset="ijrr_condensation")
    assert "segmentation" not in names(body="arm8")
    assert "background" not in make_choice(Settings(body="body34"), 2.0).needs
    assert named_terms(["default", "background", "contour"]) == (*TERMS, "background")
    assert named_terms(["joints"]) == ("joints",)
    still = {*TERMS, "background", "silhouette"} - {"flow"}
    assert set(named_terms(["still"])) == still
    assert named_terms(["still", "flow"])[-1] == "flow"
    assert not {"region", "segmentation", "joints"} & set(named_terms(["papers"]))
    assert "background" in make_choice(Settings(body="body34", terms=all_terms()), 2.0).needs
    assert "background" not in make_choice(Settings(body="arm8", terms=all_terms()), 2.0).needs
    assert "silhouette" not in names(body="body34")
    assert "silhouette" in names(body="body34", terms=all_terms())
    assert "silhouette" not in names(body="arm8", terms=all_terms())
    terms = tuple(name for name in all_terms() if name != "segmentation")
    assert "segmentation" not in names(body="body34", terms=terms)


def test_a_particle_filter_weighs_by_the_observation_alone(clip: Path, tmp_path: Path):
    terms = ("joints", "stabiliser", "temporal", "temporal_mixture")
    summary = run(clip, tmp_path, preset="ijrr_condensation", terms=terms)
    assert set(summary["best_mode_cost_by_term"]) == {"joints", "stabiliser"}
    assert np.isfinite(torchcss.load_track(tmp_path).joints_world).all()


@pytest.mark.parametrize("size", [(1, 48), (48, 1), (1, 1), (37, 53)])
def test_images_one_pixel_wide_and_of_odd_sizes(size: tuple[int, int]):
    width, height = size
    sequence = rendered_arm(0, 1)
    small = Camera(
        [[50.0, 0.0, (width - 1) / 2], [0.0, 50.0, (height - 1) / 2], [0.0, 0.0, 1.0]],
        size,
        R_camera_world=np.diag([1.0, -1.0, -1.0]),
    )
    noise = np.random.default_rng(0).integers(0, 255, (3, height, width, 3), dtype=np.uint8)
    tracked = track(noise, sequence, Settings(body="arm8", terms=all_terms()), seen_by(small))
    for frame in tracked:
        assert torch.isfinite(frame.info.cost).all()
        assert torch.isfinite(frame.state.mixture.covariance).all()


def test_pixels_alone_are_the_next_frame():
    """And a camera alone is a view without keypoints."""
    sequence = rendered_arm(0, 3)
    settings = Settings(body="arm8", working_size=160, samples=4, modes=2, terms=("contour",))
    first = start_at(sequence.body, sequence.states[0])
    placed = TrackingSession(settings, first, [seen_by(sequence.camera)])
    plain = TrackingSession(settings, first, [sequence.camera])
    frames = [Frame(i, i / 25, image) for i, image in enumerate(sequence.frames)]
    for one, other in zip(placed.track(frames), plain.track(sequence.frames), strict=True):
        assert torch.equal(one.state.mixture.mean, other.state.mixture.mean)
        assert (one.frame.index, one.frame.time_s) == (other.frame.index, other.frame.time_s)
    with pytest.raises(ConfigurationError, match="one of each of the 1 views"):
        plain.observe([sequence.frames[0], sequence.frames[1]])


TIMED = {
    preset: Settings(body="arm8", preset=preset, working_size=160, samples=4, modes=2)
    for preset in ("css", "cham_rehg", "condensation", "rr_multiple_hypothesis")
} | {"surface": Settings(body="arm8", working_size=160, samples=4, modes=2, prediction="surface")}


@pytest.mark.parametrize("name", TIMED)
def test_even_times_are_as_if_there_were_none(name: str):
    """To the bit, also where a container has rounded them to milliseconds, or they do not rise."""
    sequence = rendered_arm(0, 5)
    rounded = [round(1000 * i / 25.3) / 1000 for i in range(5)]
    first, view = start_at(sequence.body, sequence.states[0]), seen_by(sequence.camera)

    def tracked(frames: Iterable[Any]) -> list[Posterior]:
        session = TrackingSession(TIMED[name], first, view, frame_interval=1 / 25.3)
        return list(session.track(frames))

    plain = tracked(sequence.frames)
    for times in (rounded, [0.0] * 5):
        timed = tracked(Frame(i, times[i], image) for i, image in enumerate(sequence.frames))
        for one, other in zip(plain, timed, strict=True):
            assert torch.equal(one.state.mixture.mean, other.state.mixture.mean)
            assert torch.equal(one.covariance, other.covariance)
            assert torch.equal(one.state.velocity, other.state.velocity)


@pytest.mark.parametrize("name", TIMED)
def test_a_frame_that_comes_late_may_have_moved_more(name: str):
    """The frame before it was dropped: noise, prior and motion are of two steps."""
    sequence = rendered_arm(0, 5)
    first, view = start_at(sequence.body, sequence.states[0]), seen_by(sequence.camera)
    session = TrackingSession(TIMED[name], first, view)
    costs = []

    def seen(cost: TrackingCost) -> TrackingCost:
        costs.append(cost)
        return cost

    *before, late = [Frame(i, i / 25, sequence.frames[i]) for i in (0, 1, 2, 4)]
    for frame in before:
        last = session.step(session.observe(frame), seen)
    assert session.state.times == (1 / 25, 2 / 25)
    now = session.step(session.observe(late), seen)
    deviation = [cost.views[0].deviation for cost in costs]
    torch.testing.assert_close(deviation[-1], math.sqrt(2) * deviation[-2])
    if name == "rr_multiple_hypothesis":
        return  # has no dynamics
    velocity = now.state.mixture.mean - last.state.mixture.mean[now.info.parent]
    matched = (now.info.parent >= 0) & (now.state.velocity != 0).any(-1)
    kept_velocity = session.state.tracker.velocity
    torch.testing.assert_close(2 * kept_velocity[matched], velocity[matched])
    plan, noise = session.plan.tracker, PRESETS[TIMED[name].preset].noise
    moved = now.info.prior.mixture.mean[: len(last.state.velocity)] - last.state.mixture.mean
    kept = PRESETS[TIMED[name].preset].persistence
    if name != "surface":
        expected = (kept + kept**2) * last.state.velocity
        torch.testing.assert_close(moved, expected)
    wider = now.info.prior.mixture.covariance[: len(moved)] - last.state.mixture.covariance
    if name in ("css", "condensation", "surface"):
        motion = 2 * (noise * sequence.body.motion_rate / 25).square()
        torch.testing.assert_close(wider, torch.diag(motion).expand_as(wider))
    assert plan is session.plan.tracker  # that of the next frame is the usual one


def test_a_film_that_drops_frames_is_tracked_at_its_own_times(clip: Path, tmp_path: Path):
    """And goes on so: what is known of a frame that came late is in the checkpoint."""
    made = rendered_arm(3, 6)
    times = [0, 1, 2, 4, 6]
    with VideoWriter(tmp_path / "video.mp4", made.frame_rate) as film:
        for place in times:
            film.write(made.frames[place % 6], place / made.frame_rate)
    uv = made.camera.project(made.joints_world).uv.numpy()[[0, 1, 2, 4, 5]]
    np.savez(
        tmp_path / "keypoints.npz", keypoints=uv, confidence=np.ones(uv.shape[:2]),
        joint_names=np.array(made.body.joint_names),
    )  # fmt: skip

    def tracked(out: str, stop: int | None, resume: bool = False) -> Run:
        return track_video(
            tmp_path / "video.mp4", camera=clip / "cameras.json",
            keypoints=tmp_path / "keypoints.npz", out=tmp_path / out, stop=stop,
            settings=Settings(body="arm7", samples=6, modes=2, overlay=False, working_size=160),
            options=TrackOptions(init=clip / "first" / "body.npz", resume=resume),
        )  # fmt: skip

    whole = tracked("whole", None)
    assert whole.summary["frame_interval_s"] == pytest.approx(1 / made.frame_rate, rel=1e-3)
    np.testing.assert_allclose(whole.track.times, np.array(times) / made.frame_rate, atol=1e-4)
    assert any("variable frame rate" in note for note in whole.summary["notes"])
    tracked("parts", 3)
    resumed = tracked("parts", None, resume=True)
    np.testing.assert_array_equal(resumed.track.state, whole.track.state)


def test_a_session_with_parts_of_its_own_is_resumed_with_them():
    sequence = rendered_arm(0, 3)
    settings = Settings(body="arm8", working_size=160, samples=4, modes=2, terms=("contour",))
    first, view = start_at(sequence.body, sequence.states[0]), seen_by(sequence.camera)
    plan = make_plan(settings, sequence.body, view, 1 / 25)
    assert isinstance(plan.tracker, Tracker)
    plan = plan._replace(tracker=replace(plan.tracker, num_modes=1))
    session = TrackingSession(settings, first, [view], plan=plan)
    next(session.track(sequence.frames))
    state = session.checkpoint()
    resumed, other = (
        TrackingSession.resume(state, settings, view, plan=parts) for parts in (plan, None)
    )
    ends = [list(each.track(sequence.frames[1:]))[-1] for each in (session, resumed, other)]
    means = [end.state.mixture.mean for end in ends]
    assert torch.equal(means[0], means[1])
    assert [len(mean) for mean in means] == [1, 1, 2]


def test_a_pickled_session_goes_on_as_itself():
    sequence = rendered_arm(0, 3)
    view = seen_by(sequence.camera, sequence.joints_world, sequence.body.joint_names)
    settings = Settings(body="arm8", working_size=160, samples=4, modes=2)
    session = session_at(settings, sequence.body, sequence.states[0], view)
    list(session.track(sequence.frames[:1]))
    other = pickle.loads(pickle.dumps(session))
    one, same = (
        list(each.track(sequence.frames[1:]))[-1].state.mixture for each in (session, other)
    )
    assert torch.equal(one.mean, same.mean)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((5, 7, 3), np.uint8), r"belongs to images of \(640, 480\).* has \(7, 5\)"),
        (torch.zeros(480, 640, 3), "as a NumPy array, or a Frame of them, got a Tensor"),
        ("frame.png", "got a str"),
        (Path("frame.png"), "got a PosixPath"),
        (None, "the first view has none"),
        ([None], "the first view has none"),
        ([], "the first view has none"),
    ],
)
def test_images_that_are_none_are_told(image: Any, message: str):
    sequence = rendered_arm(0, 1)
    settings = Settings(body="arm8", working_size=160, samples=4, modes=2)
    session = session_at(settings, sequence.body, sequence.states[0], seen_by(sequence.camera))
    with pytest.raises(TorchcssError, match=message):
        session.observe(image)


def test_views_that_say_nothing_of_the_body_are_told():
    sequence = rendered_arm(0, 2)
    first = start_at(sequence.body, sequence.states[0])
    view = seen_by(sequence.camera, sequence.joints_world, sequence.body.joint_names)
    known = view.keypoints
    assert known is not None
    names = tuple(f"{name}_" for name in known.names)
    for keypoints, message in (
        (known._replace(names=names), r"arm8 has none of the joints .* its own are"),
        (known.at(0), "expected those of all frames"),
        (known._replace(positions=known.positions[:, :2]), "keypoints.positions: expected a shape"),
        (known._replace(confidence=known.confidence[0]), "expected one of each"),
        (known._replace(positions=known.positions.long()), "positions: expected float32 or"),
        (known._replace(points=known.positions), "keypoints.points: expected a shape"),
        ({"l_wrist": (1, 2)}, "expected of each its Camera and Keypoints, if any, got .* and dict"),
    ):
        with pytest.raises(TorchcssError, match=message):
            TrackingSession(Settings(body="arm8"), first, view._replace(keypoints=keypoints))
    by_file = known._replace(names=np.array(known.names))
    TrackingSession(Settings(body="arm8"), first, view._replace(keypoints=by_file))
    pair: Any = [(view.camera, known)]
    with pytest.raises(ConfigurationError, match="its Camera and Keypoints, if any, got tuple"):
        TrackingSession(Settings(body="arm8"), first, pair)
    with pytest.raises(ConfigurationError, match="sigma: expected a number of pixels"):
        TrackingSession(Settings(body="arm8"), first, view._replace(sigma=0.0))
    for interval in (0.0, -1.0, math.nan):
        with pytest.raises(ConfigurationError, match="frame_interval: expected seconds"):
            TrackingSession(Settings(body="arm8"), first, view, frame_interval=interval)
    lost = first.mixture._replace(mean=first.mixture.mean * math.nan)
    with pytest.raises(ConfigurationError, match="mixture: expected finite means"):
        TrackingSession(Settings(body="arm8"), first._replace(mixture=lost), view)

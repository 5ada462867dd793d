"""Trackers side by side: as if alone, features once, and stopped when they are lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from made_sequences import NOISE_PX, write_arm

from torchcss.body.load import load_body
from torchcss.studies.comparison import Start, TrackerRun, find_start, told_arm, track_together
from torchcss.studies.evaluation import Thresholds
from torchcss.studies.sequences import RecordedSequence, read_sequence
from torchcss.tracking.session import Observation, Posterior, TrackingSession
from torchcss.tracking.settings import Settings
from torchcss.vision.features import FeatureExtractor, FrameFeatures, Window

T = 3


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> RecordedSequence:
    folder = tmp_path_factory.mktemp("side") / "arm"
    write_arm(folder, T)
    return read_sequence(folder)


def choose(preset: str, **changes: object) -> Settings:
    options: dict = {"body": "arm8", "keypoints_use": "first", "working_size": 160, "samples": 4}
    return Settings(preset=preset, **{**options, **changes})


@pytest.fixture(scope="module")
def begin(sequence: RecordedSequence) -> Start:
    return find_start(sequence, choose("css"))


def together(
    sequence: RecordedSequence, begin: Start, *presets: str, stop: int = 2, **options: Any
) -> list[TrackerRun]:
    runs = [(choose(preset), begin) for preset in presets]
    thresholds = options.pop("thresholds", Thresholds.of(sequence))
    return list(track_together(sequence, runs, thresholds, stop=stop, **options))


def test_together_is_as_alone(sequence: RecordedSequence, begin: Start) -> None:
    counts: list[tuple[int, int]] = []
    presets = ("css", "ijrr_condensation")
    both = together(sequence, begin, *presets, progress=lambda *count: counts.append(count))
    assert counts == [(index, 2) for index in range(2)]
    for preset, run in zip(presets, both, strict=True):
        (alone,) = together(sequence, begin, preset)
        assert run.settings.preset == preset
        assert run.ended == alone.ended == "complete"
        assert [m.frame for m in run.measures] == [0, 1]
        for one, two in zip(run.measures, alone.measures, strict=True):
            assert (one.absolute_mm == two.absolute_mm).all()
            assert all(seconds > 0 for seconds in one.seconds.values())
    assert both[0].measures[-1].absolute_mm[0].mean() < 40
    assert both[0].measures[-1].overlap > 0.8


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> list[Window | None]:
    """Where features are looked for from now on."""
    found = []
    forward = FeatureExtractor.forward

    def spy(self: FeatureExtractor, *arguments: Any, window: Window | None) -> FrameFeatures:
        found.append(window)
        return forward(self, *arguments, window=window)

    monkeypatch.setattr(FeatureExtractor, "forward", spy)
    return found


def test_each_tracker_looks_where_its_own_body_can_be(
    sequence: RecordedSequence, begin: Start, windows: list[Window | None]
) -> None:
    together(sequence, begin, "css", "rr_multiple_hypothesis", stop=T)
    assert len(windows) == 2 * T
    assert None not in windows
    assert windows[-2] != windows[-1]


def test_trackers_that_look_everywhere_share_what_they_see(
    sequence: RecordedSequence, begin: Start, windows: list[Window | None]
) -> None:
    presets = ("ijrr_single_limits", "ijrr_gaussian_single")
    alone = [together(sequence, begin, preset, stop=T)[0] for preset in presets]
    windows.clear()
    both = together(sequence, begin, *presets, stop=T)
    assert windows == [None] * T
    for one, two in zip(both, alone, strict=True):
        assert one.settings.preset == two.settings.preset
        for here, there in zip(one.measures, two.measures, strict=True):
            assert (here.absolute_mm == there.absolute_mm).all()


def test_a_lost_run_ends_early(sequence: RecordedSequence, begin: Start) -> None:
    never = Thresholds(lost_mm=-1.0, regain_s=0.04)
    options: dict = {"thresholds": never, "stop": T}
    (run,) = together(sequence, begin, "ijrr_condensation", stop_when_lost=True, **options)
    assert run.ended == "lost"
    assert len(run.measures) == 2
    (run,) = together(sequence, begin, "ijrr_condensation", **options)
    assert run.ended == "complete"
    assert len(run.measures) == T
    assert all(m.failed for m in run.measures)


def test_an_error_ends_one_run_only(
    sequence: RecordedSequence, begin: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = TrackingSession.step

    def breaking(self: TrackingSession, observation: Observation) -> Posterior:
        if self.settings.preset == "ijrr_gaussian_single":
            raise torch.linalg.LinAlgError("singular")
        return step(self, observation)

    monkeypatch.setattr(TrackingSession, "step", breaking)
    broken, sound = together(sequence, begin, "ijrr_gaussian_single", "ijrr_condensation")
    assert broken.settings.preset == "ijrr_gaussian_single"
    assert broken.ended == f"error: {torch.linalg.LinAlgError.__name__}: singular"
    assert not broken.measures
    assert sound.ended == "complete"
    assert len(sound.measures) == 2


def test_the_start_is_the_sequences(sequence: RecordedSequence) -> None:
    begin = find_start(sequence, choose("css"), start=2)
    assert begin.sigma == NOISE_PX
    truth = sequence.truth
    assert truth is not None
    assert torch.equal(begin.first.body.base_translation, truth.body.base_translation)
    joints = begin.first.body.pose(begin.first.mixture.mean).joints
    away = joints - torch.from_numpy(sequence.joints_world[2])
    assert float(away.norm(dim=-1).mean(-1).min()) < 0.1
    # Every run of a seed starts with the same numbers.
    state = begin.generator.get_state()
    begins = [(choose(preset), begin) for preset in ("ijrr_condensation", "annealed")]
    list(track_together(sequence, begins, Thresholds(), stop=1))
    assert torch.equal(begin.generator.get_state(), state)


def test_an_arm_with_fewer_joints_hangs_where_its_first_one_is(sequence: RecordedSequence) -> None:
    truth = sequence.truth
    assert truth is not None
    assert told_arm(truth, "arm8", 0) is truth.body
    assert told_arm(truth, "body34", 0) is None
    assert told_arm(truth._replace(body=load_body("arm7")), "arm8", 0) is None
    frame = 2
    x = truth.states[frame].clone()
    x[0] = 0.3
    turned = truth._replace(states=truth.states.index_copy(0, torch.tensor([frame]), x[None]))
    arm = told_arm(turned, "arm7", frame)
    assert arm is not None
    assert arm.lengths == truth.body.lengths
    ours, theirs = arm.pose(x[1:]), truth.body.pose(x)
    for name in ("r_shoulder", "r_elbow", "r_wrist", "r_hand_tip"):
        torch.testing.assert_close(
            ours.joints[arm.joint_index(name)], theirs.joints[truth.body.joint_index(name)]
        )
    begin = find_start(sequence, choose("rr_multiple_hypothesis", body="arm7"))
    assert begin.first.body.num_parameters == 7
    (run,) = track_together(
        sequence, [(choose("rr_multiple_hypothesis", body="arm7"), begin)], Thresholds(), stop=2
    )
    assert run.ended == "complete"
    assert run.measures[-1].absolute_mm[0].mean() < 60


def test_a_recorded_person_is_initialised(shared_data: Path) -> None:
    sequence = read_sequence(shared_data / "rendered_turn")
    settings = Settings(
        preset="ijrr_single_limits",
        keypoints_use="first",
        working_size=160,
        terms=("joints", "stabiliser"),
    )
    begin = find_start(sequence, settings, start=20)
    (run,) = track_together(sequence, [(settings, begin)], Thresholds(), start=20, stop=21)
    (measures,) = run.measures
    assert measures.frame == 20
    assert measures.time_s == 0
    assert measures.absolute_mm.shape == (1, 12)
    assert measures.root_aligned_mm.mean() < 100
    assert measures.overlap > 0.5

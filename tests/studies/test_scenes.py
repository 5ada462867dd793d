"""Scenes: the same cost as a tracker's, and a truth that the cost agrees with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from made_sequences import write_arm
from made_sessions import seen_by, session_at

from torchcss.cost.contour import ContourTerm
from torchcss.cost.region import RegionTerm
from torchcss.cost.total import TrackingCost
from torchcss.errors import ConfigurationError
from torchcss.inference.mixture import GaussianMixture, Prior
from torchcss.studies.render.sequences import arm_sequence
from torchcss.studies.scenes import Scene, arm_scenes, sequence_scenes
from torchcss.studies.sequences import read_sequence
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import (
    Settings,
    all_terms,
)
from torchcss.types import Frame

TERMS = tuple(term for term in all_terms() if term not in ("temporal_mixture", "region"))
SETTINGS = Settings(body="arm8", terms=TERMS)


@pytest.fixture(scope="module")
def scene() -> Scene:
    generator = torch.Generator().manual_seed(0)
    return next(arm_scenes([2], generator=generator, settings=SETTINGS))


class Spy:
    """Stands where the tracker does: stays at the truth, and keeps the costs that it is given."""

    def __init__(self, truth: torch.Tensor) -> None:
        self.truth, self.costs = truth, []

    def init(self, mixture: GaussianMixture, *, generator: torch.Generator) -> SimpleNamespace:
        return self._state(mixture)

    def _state(self, mixture: GaussianMixture) -> SimpleNamespace:
        state = SimpleNamespace(mixture=mixture, frame=len(self.costs))
        state.per_interval = lambda _: state
        return state

    @property
    def stated_power(self) -> float:
        return 1.0

    def step(self, state: SimpleNamespace, problem, bounds):
        prior = Prior.of(state.mixture)
        child = problem.children(torch.zeros(1, dtype=torch.long), prior)
        self.costs.append(child.cost)
        mean = self.truth[len(self.costs) - 1][None]
        mixture = state.mixture._replace(mean=mean)
        first = torch.tensor([0])
        info = SimpleNamespace(origin=first, parent=first, prior=prior, num_floored=0)
        info._replace = lambda **_: info
        return self._state(mixture), info


def costs_of_a_tracker_at_the_truth(settings: Settings, num_frames: int) -> list[TrackingCost]:
    generator = torch.Generator().manual_seed(0)
    sequence = arm_sequence(generator=generator, num_frames=num_frames)
    spy, view = Spy(sequence.states), seen_by(sequence.camera, sigma=1.0)
    session = session_at(
        settings,
        sequence.body,
        sequence.states[0],
        view,
        variance=1.0,
    )
    session.plan = session.plan._replace(tracker=spy, jumps_every=0)  # type: ignore[arg-type]
    # Scenes are looked at everywhere.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrackingSession, "_windows", lambda self, *_: (None,))
        session._ahead.clear()
        for _ in session.track(Frame(i, i / 25, image) for i, image in enumerate(sequence.frames)):
            pass
    return spy.costs


def test_the_cost_is_the_trackers(scene: Scene) -> None:
    """Term by term that of a tracker whose only mode was at the truth one frame before."""
    cost = costs_of_a_tracker_at_the_truth(SETTINGS, 3)[2]
    x = scene.truth + 0.02
    expected, found = cost.terms(x[None]), scene.cost.terms(x[None])
    assert set(found) == set(expected) >= {"contour", "edge_energy", "flow", "temporal"}
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, msg=name)


def test_colours_are_those_of_the_frame_before() -> None:
    settings = Settings(body="arm8", terms=("region",))
    scene = next(arm_scenes([1], generator=torch.Generator().manual_seed(0), settings=settings))
    first, second = costs_of_a_tracker_at_the_truth(settings, 2)
    x = scene.truth[None]
    assert not first.terms(x).get("region", torch.zeros(1)).any(), "nothing is known at first"
    torch.testing.assert_close(scene.cost.terms(x)["region"], second.terms(x)["region"])
    # A fitted outline costs less than half, which is what colours that say nothing cost.
    share = float(scene.cost.terms(x)["region"]) / RegionTerm().weight
    assert 0 < share < 0.4


def test_the_mode_is_near_the_truth(scene: Scene) -> None:
    assert scene.slug == "arm_frame_2"
    assert scene.image.shape == (480, 640, 3)
    joints = scene.cost.body.pose(torch.stack([scene.truth, scene.mode.mean])).joints
    assert float((joints[0] - joints[1]).norm(dim=-1).mean()) < 0.02
    assert float(scene.mode.cost) <= float(scene.cost.value(scene.truth))


def test_lines_and_limits(scene: Scene) -> None:
    body, n = scene.cost.body, len(scene.truth)
    lines = scene.lines(scene.truth)
    names = [*body.state_names, *(f"eigen {i}" for i in range(n))]
    assert [line.name for line in lines] == names
    limits = scene.limits(scene.truth)
    for line in lines:
        low, high = line.interval(limits)
        assert low < 0 < high
        states = line.states([low, high])
        assert bool((states >= body.bounds.lower - 1e-9).all())
        assert bool((states <= body.bounds.upper + 1e-9).all())


def test_a_line_between_two_limits_is_left_out(scene: Scene) -> None:
    """At two limits at once, a direction that leaves one of them either way goes nowhere."""
    body = scene.cost.body
    corner = scene.truth.clone()
    first, second = (body.state_index(f"r_{name}") for name in ("elbow_flexion", "wrist_flexion"))
    corner[first], corner[second] = body.bounds.upper[first], body.bounds.upper[second]
    covariance = torch.eye(len(corner), dtype=torch.float64)
    covariance[first, second] = covariance[second, first] = -0.5
    lines = scene._replace(mode=scene.mode._replace(covariance=covariance)).lines(corner)
    # The two rise and fall together on one eigenvector, and against each other on another.
    assert len(lines) == 2 * len(corner) - 1


def test_single_precision_and_the_generator_decide_all() -> None:
    settings = replace(SETTINGS, terms=("contour", "stabiliser"), dtype="float32")
    values = []
    for seed in (1, 1, 2):
        generator = torch.Generator().manual_seed(seed)
        one = next(arm_scenes([1], generator=generator, settings=settings, name="another"))
        assert one.name == "another, frame 1"
        assert one.truth.dtype == one.mode.mean.dtype == torch.float32
        values.append(float(one.mode.cost))
    assert values[0] == values[1] != values[2]


@pytest.mark.parametrize("frames", [[], [0], [3, 0]])
def test_a_frame_needs_one_before_it(frames: list[int], generator: torch.Generator) -> None:
    with pytest.raises(ConfigurationError, match="frame before it"):
        next(arm_scenes(frames, generator=generator))


def test_a_real_frame(shared_data: Path, generator: torch.Generator) -> None:
    clip = read_sequence(shared_data / "balance_beam_4cam", view="cam01")
    settings = Settings(terms=("contour", "flow", "joints", "stabiliser"))
    real = next(sequence_scenes(clip, [3], generator=generator, settings=settings))
    assert real.name == "balance_beam_4cam:cam01, frame 3"
    assert set(real.cost.terms(real.truth)) == {"contour", "flow", "joints", "stabiliser"}
    assert real.cost.body.name == "body34"
    height, width = real.features.grey.shape
    assert real.cost.camera.image_size_wh == (width, height) == (360, 640)
    assert len(real.lines(real.mode.mean)) == 2 * 34
    # No limit ends the way in depth; the reach of a slice does.
    low, high = real.lines(real.truth)[2].interval(real.limits(real.truth))
    assert (low, high) == pytest.approx((-0.5, 0.5))


def test_a_sequences_states_are_the_truth(tmp_path: Path, generator: torch.Generator) -> None:
    write_arm(tmp_path, 3)
    sequence = read_sequence(tmp_path)
    assert sequence.truth is not None
    settings = replace(SETTINGS, preset="ijrr_css", terms=None)
    (one,) = sequence_scenes(sequence, [2], generator=generator, settings=settings)
    assert one.name == f"{tmp_path.name}, frame 2"
    torch.testing.assert_close(one.truth, sequence.truth.states[2].to(one.truth))
    assert float(one.mode.cost) <= float(one.cost.value(one.truth[None])[0])
    assert one.cost.choice.find(ContourTerm).assignment == "sum"
    with pytest.raises(ConfigurationError, match="frame before it"):
        next(sequence_scenes(sequence, [0], generator=generator, settings=settings))

from dataclasses import replace

import problems
import pytest
import torch

from torchcss.errors import ConfigurationError
from torchcss.inference.dynamics import ConstantVelocity
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.particle import AnnealedParticleFilter, ParticleFilter
from torchcss.inference.problem import SearchProblem
from torchcss.inference.proposals import ChamRehg, Condensation, CovarianceScaled, Samples
from torchcss.inference.tracker import Tracker
from torchcss.tracking.presets import PRESETS, Preset, make_tracker
from torchcss.types import Bounds, Curvature

MOTION = (0.3, 0.2)
START = GaussianMixture(
    torch.tensor([[2.0, 1.0]]).double(), 0.04 * torch.eye(2).double()[None], torch.zeros(1).double()
)


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("body", ["arm8", "body34"])
def test_every_tracker_follows_a_minimum(name, body, generator):
    tracker = make_tracker(name, body, motion=MOTION)
    bounds = PRESETS[name].bounds(problems.box(2, -6, 6))
    state = tracker.init(START, generator=generator)
    wells = [problems.DoubleWell(width=0.3, tilt=-0.02 * t) for t in range(4)]
    for state, info in tracker.track(state, map(SearchProblem, wells), bounds):  # noqa: B020
        assert 1 <= len(state.mixture.mean) <= tracker.num_modes
        assert float(state.mixture.weight.sum()) == pytest.approx(1)
        assert state.mixture.log_weight.argmax() == 0
        assert 0 <= float(info.survival.survival_rate) <= 1
    apart = state.mixture.mean - START.mean
    assert float(apart.norm(dim=-1).min()) < 0.5, "whatever other modes there are"


@pytest.mark.parametrize("name", ["css", "single"])
def test_the_first_rows_are_what_they_were(name):
    tracker = make_tracker(name, "body34", motion=MOTION)
    assert isinstance(tracker, Tracker)
    assert isinstance(tracker.proposal, CovarianceScaled)
    assert tracker.dynamics.deviation == MOTION
    assert (tracker.num_samples, tracker.num_modes) == {"css": (60, 7), "single": (1, 1)}[name]
    row = PRESETS[name]
    assert (row.robust, row.limits, row.interpenetration) == (True, True, None)


def test_numbers_and_noise_reach_the_tracker():
    row = PRESETS["cham_rehg"]
    tracker = make_tracker("cham_rehg", "arm8", num_samples=5, num_modes=4, motion=MOTION)
    assert isinstance(tracker, Tracker)
    assert isinstance(tracker.proposal, ChamRehg)
    assert isinstance(tracker.dynamics, ConstantVelocity)
    assert tracker.proposal.deviation == tuple(row.noise * m for m in MOTION)
    assert tracker.dynamics.deviation == 0.0
    assert (tracker.num_samples, tracker.num_modes) == (5, 4)
    particles = make_tracker("condensation_inflated", "body34", motion=0.1)
    assert isinstance(particles, ParticleFilter)
    assert particles.dilution == 1 / 8
    assert particles.dynamics.deviation == pytest.approx(
        PRESETS["condensation_inflated"].noise * 0.1
    )
    assert isinstance(make_tracker("annealed", "arm8"), AnnealedParticleFilter)
    heap_hogg = make_tracker("heap_hogg", "arm8", motion=0.1)
    assert isinstance(heap_hogg, Tracker)
    assert isinstance(heap_hogg.proposal, Condensation)


def test_weights_of_css_and_of_figure_6():
    """An arm may count evidence otherwise than a body; as printed there is no such choice."""
    arm, body = (make_tracker("css", name) for name in ("arm8", "body34"))
    assert isinstance(arm, Tracker)
    assert isinstance(body, Tracker)
    assert (arm.likelihood_power, body.likelihood_power) == (0.05, 0.1)
    assert arm.soft_matching
    assert body.soft_matching
    for name in ("arm8", "body34"):
        printed = make_tracker("css_figure_6", name)
        assert isinstance(printed, Tracker)
        assert (printed.likelihood_power, printed.forgetting) == (1.0, 1.0)
        assert not printed.soft_matching


def test_the_reports_numbers_of_hypotheses():
    """Section 6 [RR]: three for the arm, seven for the body, from one mode."""
    for body, expected in [("arm7", 3), ("body30", 7)]:
        tracker = make_tracker("multiple_hypothesis", body)
        assert isinstance(tracker, Tracker)
        one = GaussianMixture(
            torch.zeros(1, 9), torch.eye(9)[None] * torch.arange(1.0, 10), torch.zeros(1)
        )
        samples = tracker.proposal.sample(
            one, tracker.num_samples, problems.unbounded(9), generator=torch.Generator()
        )
        assert isinstance(samples, Samples)
        assert len(samples.x) == expected == tracker.num_modes


def test_limits_can_be_lifted():
    bounds = problems.box(3, -1, 1)
    assert PRESETS["single"].bounds(bounds) is bounds
    free = PRESETS["gaussian_single"].bounds(bounds)
    assert isinstance(free, Bounds)
    assert bool(free.lower.isneginf().all())
    assert bool(free.upper.isposinf().all())


def test_least_squares_rows_are_the_papers():
    for name in ("cham_rehg_ssd", "heap_hogg_ssd"):
        row = PRESETS[name]
        assert (row.robust, row.limits, row.curvature) == (False, False, Curvature.GAUSS_NEWTON)
        robust = PRESETS[name.removesuffix("_ssd")]
        assert (robust.robust, robust.limits) == (True, True)
        assert row.proposal == robust.proposal


def test_bad_rows_and_names():
    with pytest.raises(ConfigurationError, match=r"no tracker 'x'; there are css"):
        make_tracker("x", "arm8")
    with pytest.raises(ConfigurationError, match="either a proposal or a particle filter"):
        replace(PRESETS["css"], particles=PRESETS["condensation"].particles)
    with pytest.raises(ConfigurationError, match="either"):
        Preset(what="nothing", samples_arm=1, samples_body=1)

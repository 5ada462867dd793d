from dataclasses import replace

import problems
import pytest
import torch
from made_costs import make_full_cost, printed_cost

from torchcss.cost.contour import ContourTerm
from torchcss.cost.flow import FlowTerm
from torchcss.cost.interior import InteriorNodes
from torchcss.cost.joints import JointTerm
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.term import OnPoints
from torchcss.cost.visibility import ContourPredictor
from torchcss.errors import ConfigurationError
from torchcss.inference.dynamics import ConstantVelocity
from torchcss.inference.grid_tracker import GridTracker
from torchcss.inference.importance import fair_samples
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.particle import AnnealedParticleFilter, ParticleFilter
from torchcss.inference.problem import SearchProblem
from torchcss.inference.proposals import (
    ChamRehg,
    Condensation,
    CovarianceScaled,
    EigenDirectionGrid,
    HeavyTailed,
    Spherical,
)
from torchcss.inference.tracker import Tracker
from torchcss.robust import Leclerc, Lorentzian
from torchcss.tracking.presets import OLD_NAMES, PRESETS, Preset
from torchcss.tracking.settings import (
    PAPER_TERMS,
    TERMS,
    Settings,
    make_choice,
    make_extractor,
    make_tracker,
    settings_from_plain,
)
from torchcss.types import Bounds, Curvature, Status

MOTION = (0.3, 0.2)
START = GaussianMixture(
    torch.tensor([[2.0, 1.0]]).double(), 0.04 * torch.eye(2).double()[None], torch.zeros(1).double()
)


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("body", ["arm8", "body34"])
def test_every_tracker_follows_a_minimum(name, body, generator):
    tracker = make_tracker(Settings(preset=name, body=body), motion=MOTION)
    bounds = PRESETS[name].bounds(problems.box(2, -6, 6))
    state = tracker.init(START, generator=generator)
    wells = [problems.DoubleWell(width=0.3, tilt=-0.02 * t) for t in range(4)]
    for state, info in problems.follow(tracker, state, map(SearchProblem, wells), bounds):  # noqa: B020
        assert 1 <= len(state.mixture.mean) <= tracker.num_modes
        assert float(state.mixture.weight.sum()) == pytest.approx(1)
        assert state.mixture.log_weight.argmax() == 0
        assert 0 <= float(info.survival.survival_rate) <= 1
    apart = state.mixture.mean - START.mean
    assert float(apart.norm(dim=-1).min()) < 0.5, "whatever other modes there are"


@pytest.mark.parametrize("name", ["css", "ijrr_single_limits"])
def test_the_first_rows_are_what_they_were(name):
    tracker = make_tracker(Settings(preset=name, body="body34"), motion=MOTION)
    assert isinstance(tracker, Tracker)
    assert isinstance(tracker.proposal, CovarianceScaled)
    assert tracker.dynamics.deviation == (MOTION if name == "css" else (0.0, 0.0))
    assert (tracker.num_samples, tracker.num_modes) == {
        "css": (60, 7),
        "ijrr_single_limits": (1, 1),
    }[name]
    row = PRESETS[name]
    assert (row.robust, row.limits) == (True, True)


def test_numbers_and_noise_reach_the_tracker():
    row = PRESETS["ijrr_cham_rehg"]
    tracker = make_tracker(
        Settings(preset="ijrr_cham_rehg", body="arm8", samples=5, modes=4), motion=MOTION
    )
    assert isinstance(tracker, Tracker)
    assert isinstance(tracker.proposal, ChamRehg)
    assert isinstance(tracker.dynamics, ConstantVelocity)
    assert tracker.proposal.deviation == tuple(row.noise * m for m in MOTION)
    assert tracker.dynamics.deviation == 0.0
    assert (tracker.num_samples, tracker.num_modes) == (5, 4)
    particles = make_tracker(Settings(preset="condensation_inflated", body="body34"), motion=0.1)
    assert isinstance(particles, ParticleFilter)
    assert particles.dilution == 1 / 8
    assert particles.dynamics.deviation == pytest.approx(
        PRESETS["condensation_inflated"].noise * 0.1
    )
    assert isinstance(
        make_tracker(Settings(preset="annealed", body="arm8")), AnnealedParticleFilter
    )
    heap_hogg = make_tracker(Settings(preset="heap_hogg", body="arm8"), motion=0.1)
    assert isinstance(heap_hogg, Tracker)
    assert isinstance(heap_hogg.proposal, Condensation)


def test_weights_of_css_and_of_figure_6():
    """Evidence counts by parts, that of an arm and that of a body; as printed it counts whole."""
    arm, body = (make_tracker(Settings(preset="css", body=name)) for name in ("arm8", "body34"))
    assert arm.surprise == body.surprise == 5.1
    assert isinstance(arm, Tracker)
    assert isinstance(body, Tracker)
    assert body.likelihood_power == 0.15
    assert arm.likelihood_power == pytest.approx(0.15 * 4 / 18)
    assert arm.soft_matching
    assert body.soft_matching
    for name in ("arm8", "body34"):
        printed = make_tracker(Settings(preset="ijrr_css", body=name))
        assert isinstance(printed, Tracker)
        assert printed.likelihood_power == 1.0
        assert not printed.soft_matching


@pytest.mark.parametrize(
    ("body", "k", "directions"), [("arm7", 3, 1), ("arm8", 3, 1), ("body30", 7, 3)]
)
def test_the_reports_numbers_of_hypotheses(body, k, directions):
    """Section 6 [RR]: three for the arm along one direction, seven for the body along three."""
    tracker = make_tracker(Settings(preset="rr_multiple_hypothesis", body=body), motion=0.1)
    assert isinstance(tracker, GridTracker)
    assert tracker.num_modes == k
    assert tracker.pattern == EigenDirectionGrid(num_directions=directions, num_steps=1)
    # One fit gives as many hypotheses, and k of them a pool of k times as many.
    assert tracker.num_samples == k * k
    assert k == 1 + 2 * directions


def test_limits_can_be_lifted():
    bounds = problems.box(3, -1, 1)
    assert PRESETS["ijrr_single_limits"].bounds(bounds) is bounds
    free = PRESETS["ijrr_gaussian_single"].bounds(bounds)
    assert isinstance(free, Bounds)
    assert bool(free.lower.isneginf().all())
    assert bool(free.upper.isposinf().all())


def test_least_squares_rows_are_the_papers():
    for name in ("ijrr_cham_rehg_ssd", "heap_hogg_ssd"):
        row = PRESETS[name]
        assert (row.robust, row.limits, row.curvature) == (False, False, Curvature.GAUSS_NEWTON)
        robust = PRESETS[name.removesuffix("_ssd")]
        assert (robust.robust, robust.limits) == (True, True)
        assert row.proposal == robust.proposal


def test_bad_rows_and_names():
    with pytest.raises(ConfigurationError, match=r"no tracker 'x'; there are css"):
        make_tracker(Settings(preset="x", body="arm8"))
    with pytest.raises(ConfigurationError, match="either a proposal or a particle filter"):
        replace(PRESETS["css"], particles=PRESETS["ijrr_condensation"].particles)
    with pytest.raises(ConfigurationError, match="either"):
        Preset(what="nothing", samples_arm=1, samples_body=1)


PAPERS = [name for name in PRESETS if name.startswith(("ijrr_", "rr_"))]
CSS_ROWS = [name for name in PAPERS if name.startswith("ijrr_css")]


@pytest.mark.parametrize("name", PAPERS)
@pytest.mark.parametrize("body", ["arm8", "body34"])
def test_nothing_of_ours_is_in_the_papers_rows(name, body):
    settings, row = Settings(preset=name, body=body), PRESETS[name]
    assert not settings.changed()
    assert settings.keypoints_first_only
    assert row.start == "one fit"
    assert row.jumps_every == 0
    assert row.persistence == (1.0 if "cham_rehg" in name else 0.0)
    choice = make_choice(settings, 2.0)
    expected = set(PAPER_TERMS) - {"motion_boundaries", "foreground"}
    if not row.interpenetration:
        expected.discard("interpenetration")
    assert {term.name for term in choice.terms} == expected
    contour, flow = choice.find(ContourTerm), choice.find(FlowTerm)
    for term in (contour, flow):
        assert (term.fitted_level, term.weight) == (1.0, settings.contour_weight)
        assert (term.occlusion_factor > 1) == name.startswith("ijrr_")
    assert flow.printed
    assert contour.assignment == ("sum" if row.robust else "nearest")
    assert contour.strength == name.startswith("rr_")
    assert contour.foreground == name.startswith("ijrr_")
    stabiliser = choice.find(Stabiliser)
    assert stabiliser.hidden_only
    assert (stabiliser.nu == 9.0) == row.robust
    extractor = make_extractor(settings)
    assert (extractor.edges.window is None) == name.startswith("rr_")
    assert extractor.colour == contour.foreground
    tracker = make_tracker(Settings(preset=name, body=body), motion=0.1)
    if isinstance(tracker, (Tracker, GridTracker)):
        optimiser = tracker.optimiser
        assert optimiser.max_steps >= 100
        assert (optimiser.tolerance, optimiser.initial_radius) == (1e-6, 1.0)
    if isinstance(tracker, Tracker):
        # Of one mode alone the descent starts at the mode; the others draw all their samples.
        assert tracker.proposal.include_modes == (tracker.num_samples == 1)
        assert tracker.converged_only
        assert not tracker.capped
        assert (tracker.coarse_every, tracker.survivors, tracker.soft_matching) == (0, 0, False)
        if "single" not in name:
            modes = {"ijrr_cham_rehg": 10, "ijrr_cham_rehg_ssd": 10}
            assert tracker.num_modes == modes.get(name, 3 if body == "arm8" else 7)


@pytest.mark.parametrize("name", CSS_ROWS)
def test_figure_6_draws_from_scaled_covariances_and_nothing_else(name):
    tracker = make_tracker(Settings(preset=name, body="arm8"), motion=0.1)
    assert isinstance(tracker, Tracker)
    proposal = tracker.proposal
    assert isinstance(proposal, (CovarianceScaled, HeavyTailed, Spherical))
    assert proposal.covariance_scale == (4 if isinstance(proposal, HeavyTailed) else 8)
    assert 4 <= proposal.covariance_scale <= 14, "Fig. 6 step 1"
    if not isinstance(proposal, Spherical):
        assert proposal.max_deviation is None
    assert (proposal.stratified, proposal.correlated_projection) == (False, False)
    assert not proposal.include_modes
    assert tracker.dynamics.deviation == 0
    assert tracker.likelihood_power == 1
    assert not tracker.keep_alike
    assert (tracker.separation, tracker.oversampling) == (0.03, 1)
    assert PRESETS[name].optimiser == PRESETS["ijrr_css"].optimiser


@pytest.mark.parametrize("name", ["ijrr_css", "ijrr_css_heavy_tailed", "ijrr_css_spherical"])
def test_samples_of_every_tail_lead_back_to_the_prior(name, generator):
    """Section 8 [IJRR]: weighed, they are fair samples of what they were drawn about."""
    tracker = make_tracker(Settings(preset=name, body="arm8"))
    assert isinstance(tracker, Tracker)
    prior = START._replace(covariance=torch.diag(torch.tensor([0.04, 0.01])).double()[None])
    samples = tracker.proposal.sample(prior, 20_000, problems.unbounded(2), generator=generator)
    fair = fair_samples(samples, samples.log_weight, 20_000, generator=generator).x
    # An effective sample size of some thousands: four standard errors.
    torch.testing.assert_close(fair.mean(0), prior.mean[0], rtol=0, atol=0.02)
    torch.testing.assert_close(fair.T.cov(), prior.covariance[0], rtol=0.1, atol=2e-3)


def test_condensation_is_inflated_in_posterior_and_dynamics():
    """Section 9 [IJRR]; both are weighed back."""
    row = PRESETS["condensation_inflated"]
    tracker = make_tracker(Settings(preset="condensation_inflated", body="body34"), motion=0.1)
    assert isinstance(tracker, ParticleFilter)
    assert (tracker.dilution, tracker.noise_scale) == (1 / 8, 8.0)
    assert (row.noise, row.terms) == (1.0, "papers")


@pytest.mark.parametrize(
    "given", [{"oversampling": 2}, {"prediction": "surface"}, {"limb_jumps": 1},
              {"likelihood_power": 0.5}],
)  # fmt: skip
@pytest.mark.parametrize("preset", ["rr_multiple_hypothesis", "ijrr_condensation"])
def test_what_is_for_samples_that_descend_is_refused_elsewhere(preset, given):
    with pytest.raises(ConfigurationError, match="does not descend from samples"):
        Settings(preset=preset, **given)


@pytest.mark.parametrize("name", ["ijrr_css", "ijrr_gaussian_single"])
def test_both_terms_are_divided_by_one_number_of_nodes(name):
    """N of eq. 5."""
    cost = printed_cost(make_full_cost("arm8"), name)
    view = cost.views[0]
    count = sum(view.tables.of(kind).num_nodes for kind in (ContourPredictor, InteriorNodes))
    for kind in (ContourTerm, FlowTerm):
        bound = cost.bound[cost.choice.find(kind), view]
        assert isinstance(bound, OnPoints)
        assert bound.scale == pytest.approx(Settings().contour_weight / count)


def test_which_rows_have_physical_constraints():
    said = {name: (PRESETS[name].limits, PRESETS[name].interpenetration) for name in PAPERS}
    assert said["ijrr_gaussian_single"] == said["ijrr_robust_single"] == (False, False)
    assert said["ijrr_cham_rehg_ssd"] == (False, False)
    assert said["ijrr_single_limits"] == said["ijrr_css_limits"] == (True, False)
    assert said["ijrr_css"] == said["ijrr_css_constrained"] == (True, True)
    assert said["rr_multiple_hypothesis"] == (True, False)
    assert PRESETS["rr_multiple_hypothesis"].curvature is Curvature.GAUSS_NEWTON
    assert PRESETS["ijrr_css"].curvature is Curvature.EXACT


def test_what_is_given_beside_a_preset_wins_and_is_recorded():
    settings = Settings(preset="ijrr_css", terms=("default",), keypoints_use="all", samples=9)
    assert set(settings.changed()) == {"terms", "keypoints_use", "samples"}
    assert "region" in settings.used_terms
    assert not settings.keypoints_first_only
    assert not Settings(keypoints_use="all", terms=("default",)).changed()
    repelling = Settings(preset="ijrr_gaussian_single", terms=("papers",))
    assert repelling.changed() == ("terms",)
    assert "interpenetration" in repelling.used_terms
    assert "interpenetration" not in Settings(preset="ijrr_gaussian_single").used_terms
    cost = {"contour_weight": 100.0, "boundary_emphasis": 0.2, "potential": "leclerc"}
    assert set(Settings(preset="ijrr_css", **cost).changed()) == set(cost)


def test_either_potential_of_the_papers_can_be_chosen():
    """Section 3.1.1 [IJRR], eq. 2 and 3 [RR]."""
    for name, kind in (("lorentzian", Lorentzian), ("leclerc", Leclerc)):
        choice = make_choice(Settings(preset="rr_multiple_hypothesis", potential=name), 2.0)
        for term in (choice.find(ContourTerm), choice.find(FlowTerm)):
            assert term.potential_kind is kind
            # Nothing that is matched costs more than what is hidden or faces away.
            worst = float(term.potential(torch.tensor(1e9)).rho) / 2
            assert kind is Lorentzian or worst < term.occlusion_factor * term.fitted_level
    ours = make_choice(Settings(potential="leclerc"), 2.0)
    contour, joints = ours.find(ContourTerm), ours.find(JointTerm)
    assert joints.potential_kind is Lorentzian
    hidden = contour.occlusion_factor * contour.fitted_level
    assert contour.fitted_level < hidden < contour.unmatched < 0.5
    with pytest.raises(ConfigurationError, match="ijrr_gaussian_single has Gaussian errors"):
        Settings(preset="ijrr_gaussian_single", potential="leclerc")
    with pytest.raises(ConfigurationError, match="potential must be one of lorentzian, leclerc"):
        Settings(preset="ijrr_css", potential="huber")  # type: ignore[arg-type]


def test_old_names_and_old_runs_still_open():
    for old, new in OLD_NAMES.items():
        assert Settings(preset=old).preset == new
        assert old not in PRESETS
        assert Settings(preset=old) == Settings(preset=new)
    old = {"preset": "css_figure_6", "terms": ["contour", "region"], "recovery": True}
    opened = settings_from_plain(old)
    assert (opened.preset, opened.used_terms) == ("ijrr_css", ("contour", "region"))


def test_css_has_what_was_measured_to_help():
    plain = Settings()
    assert (plain.keypoints_first_only, plain.used_terms) == (False, TERMS)
    tracker = make_tracker(Settings(preset="css", body="arm8"), motion=0.1)
    assert isinstance(tracker, Tracker)
    optimiser = tracker.optimiser
    assert (optimiser.max_steps, optimiser.tolerance) == (60, 1e-2)
    assert optimiser.initial_radius == 1 / 16
    assert (tracker.num_samples, tracker.survivors) == (160, 20)
    body = make_tracker(Settings(preset="css", body="body34"), motion=0.1)
    assert isinstance(body, Tracker)
    assert (body.num_samples, body.survivors, body.num_modes) == (60, 15, 7)
    assert (tracker.coarse_every, tracker.keep_alike, tracker.converged_only) == (3, True, True)
    assert tracker.dynamics == ConstantVelocity(deviation=0.1, persistence=0.8)
    assert tracker.separation == 0.12
    contour, flow = (make_choice(plain, 2.0).find(kind) for kind in (ContourTerm, FlowTerm))
    assert contour.fitted_level == pytest.approx(0.983, abs=1e-3)
    assert (flow.fitted_level, flow.occlusion_factor) == (0.7, 1.1)


@pytest.mark.parametrize("preset", ["css", "ijrr_css"])
def test_what_stopped_at_the_step_limit_is_not_kept(preset, generator):
    tracker = make_tracker(Settings(preset=preset, body="arm8", samples=6, modes=3))
    assert isinstance(tracker, Tracker)
    hurried = replace(tracker, optimiser=replace(tracker.optimiser, max_steps=1))
    problem, bounds = SearchProblem(problems.DoubleWell(width=0.3)), problems.box(2, -6, 6)
    start = START._replace(mean=START.mean - 0.5)  # no minimum: its own descent takes steps, too
    for each, ends in ((hurried, False), (tracker, True)):
        _, info = each.step(each.init(start, generator=generator), problem, bounds)
        assert (int(info.num_distinct) > 0) == ends
        assert (int(info.status_counts[Status.STEP_LIMIT]) == 0) == ends

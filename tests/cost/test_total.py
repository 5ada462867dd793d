"""The whole cost: sums, chunks, items, curvatures, and no NaN from any state."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from made_costs import (
    EVERYTHING,
    JOINTS_ONLY,
    WIDTH,
    changed,
    make_cost,
    make_full_cost,
    random_states,
)
from reference.contour import cost_of_fixed_matches
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.cost import total
from torchcss.cost.anthropometric import Anthropometric, proportion_columns
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import BodyTables
from torchcss.cost.contour import ContourTerm
from torchcss.cost.frame import FrameCosts
from torchcss.cost.fused import engine_for
from torchcss.cost.joints import JointTerm
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.term import differentiate_twice
from torchcss.cost.total import TrackingCost
from torchcss.cost.visibility import ContourPredictor
from torchcss.errors import ShapeError
from torchcss.inference.mixture import GaussianMixture, Prior
from torchcss.kernels import compiler
from torchcss.stopwatch import Stopwatch
from torchcss.types import Curvature, LocalModel
from torchcss.vision.camera import Camera

CONTOUR_ONLY = CostChoice(terms=(ContourTerm(),))
NOTHING = CostChoice(terms=())
ENGINES = (
    "eager",
    pytest.param("fused", marks=pytest.mark.skipif(not compiler.AVAILABLE, reason="needs numba")),
)
FULL_NAMES = {
    *("contour", "edge_energy", "flow", "joints"),
    *("stabiliser", "temporal", "temporal_mixture", "interpenetration"),
}


def assert_same(got: LocalModel, expected: LocalModel, tolerance: float) -> None:
    for ours, theirs in zip(got, expected, strict=True):
        scale = max(float(theirs.abs().max()), 1e-30) if theirs.numel() else 1.0
        torch.testing.assert_close(ours, theirs, rtol=0, atol=tolerance * scale)


@pytest.mark.parametrize("choice", [EVERYTHING, JOINTS_ONLY, CONTOUR_ONLY, NOTHING])
@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_value_is_that_of_the_model_and_the_sum_of_terms(
    name: str, choice: CostChoice, generator: torch.Generator
) -> None:
    cost = make_cost(name, choice)
    x = random_states(cost.body, 6, generator=generator)
    value, model, terms = cost.value(x), cost.local_model(x), cost.terms(x)
    torch.testing.assert_close(value, model.value, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(value, sum(terms.values(), torch.zeros_like(value)))
    expected = {term.name for term in choice.terms} - {"anthropometric"}
    assert set(terms) == expected
    assert torch.isfinite(model.hessian).all()
    if choice is NOTHING:
        assert not value.any()
        assert not model.gradient.any()
        assert not model.hessian.any()


@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,), (2, 0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_leading_shapes_and_types(
    batch: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator
) -> None:
    double, cost = make_cost(), make_cost(dtype=dtype)
    n = cost.body.num_parameters
    x = random_states(double.body, *batch, generator=generator)
    model = cost.local_model(x.to(dtype))
    assert model.value.shape == cost.value(x.to(dtype)).shape == batch
    assert model.gradient.shape == (*batch, n)
    assert model.hessian.shape == (*batch, n, n)
    assert all(part.dtype == dtype for part in model)
    terms = cost.terms(x.to(dtype))
    assert all(term.shape == batch for term in terms.values())
    if x.numel():
        expected = double.value(x)
        torch.testing.assert_close(model.value.double(), expected, rtol=2e-2, atol=0.5)


def test_the_camera_may_be_more_precise_than_the_body(generator: torch.Generator) -> None:
    cost, double = make_cost(dtype=torch.float32), make_cost()
    x = random_states(double.body, 3, generator=generator).float()
    mixed = changed(cost, camera=double.camera)
    assert mixed.value(x).dtype == torch.float32
    assert_same(mixed.local_model(x), cost.local_model(x), 1e-3)


def test_chunks_are_invisible(monkeypatch: pytest.MonkeyPatch, generator: torch.Generator) -> None:
    """To 1e-12 for the joints; the search for edges is in single precision."""
    for choice, tolerance in ((JOINTS_ONLY, 1e-12), (EVERYTHING, 1e-6)):
        cost = make_cost(choice=choice, own_parents=11)
        x = random_states(cost.body, 11, generator=generator)
        whole, value = cost.local_model(x), cost.value(x)
        for chunk in (1, 4, 11):
            monkeypatch.setattr(total, "CHUNK", chunk)
            assert_same(cost.local_model(x), whole, tolerance)
            torch.testing.assert_close(cost.value(x), value, rtol=tolerance, atol=tolerance)
        monkeypatch.undo()


def test_each_item_keeps_its_own_parent(generator: torch.Generator) -> None:
    cost = make_cost(own_parents=7)
    x = random_states(cost.body, 7, generator=generator)
    items = torch.tensor([5, 0, 3])
    assert_same(
        cost.take(items).local_model(x[items]),
        LocalModel(*(part[items] for part in cost.local_model(x))),
        1e-6,
    )
    prior = cost.past[0].prior
    assert prior is not None
    for item in range(7):
        alone = cost.of_mode(prior.mean[item])
        torch.testing.assert_close(alone.value(x[item]), cost.value(x)[item], rtol=1e-6, atol=1e-6)
        assert alone.take(items).parent is None
    assert "temporal" not in replace(cost, past=(), parent=None).terms(x)


def test_items_of_a_batch_do_not_meet(generator: torch.Generator) -> None:
    cost = make_cost("body34")
    x = random_states(cost.body, 4, generator=generator)
    spoilt = x.clone()
    spoilt[1] = math.nan
    whole, other = cost.local_model(x), cost.local_model(spoilt)
    kept = torch.tensor([0, 2, 3])
    for ours, theirs in zip(whole, other, strict=True):
        torch.testing.assert_close(ours[kept], theirs[kept], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_without_image_search_the_model_is_that_of_differences(
    name: str, generator: torch.Generator
) -> None:
    cost = make_cost(name, EVERYTHING.without("contour"))
    x = random_states(cost.body, generator=generator)
    model, step = cost.local_model(x), 1e-6
    moves = step * torch.eye(len(x)).to(x)
    after, before = cost.local_model(x + moves), cost.local_model(x - moves)
    slope, bend = ((a - b) / (2 * step) for a, b in zip(after[:2], before[:2], strict=True))
    assert_same(model, LocalModel(cost.value(x), slope, bend), 1e-6)


@pytest.mark.parametrize("engine", ENGINES)
def test_autograd_gets_the_derivatives_of_the_model(
    engine: Literal["eager", "fused"], generator: torch.Generator
) -> None:
    """All of them, whatever evaluates the cost: also where a term has no compiled twin."""
    cost = replace(make_full_cost(), engine=engine_for(engine, "cpu"))
    x = random_states(cost.body, 2, 3, generator=generator).requires_grad_()
    model = cost.local_model(x)
    assert not any(part.requires_grad for part in model)
    assert not any(term.requires_grad for term in cost.terms(x).values())
    assert_same(differentiate_twice(cost.value(x), x), model, 1e-12)
    with torch.no_grad():
        assert not cost.value(x).requires_grad


@pytest.mark.parametrize("engine", ENGINES)
def test_states_of_another_size_or_type_are_refused(engine: Literal["eager", "fused"]) -> None:
    """Before compiled code reads beyond their end."""
    cost = replace(make_cost(), engine=engine_for(engine, "cpu"))
    rest = cost.body.rest.expand(5, -1)
    bad = (rest[:, :-1], torch.cat([rest, rest], -1), rest[0, 0], rest.float(), rest.long())
    for x in (*bad, rest.numpy(), rest.tolist()):
        for evaluate in (cost.value, cost.local_model):
            with pytest.raises(ShapeError, match=r"^x: "):
                evaluate(x)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_contours_are_differentiated_with_visibility_and_matches_held_fixed(
    name: str, generator: torch.Generator
) -> None:
    cost = make_cost(name, CONTOUR_ONLY)
    body, term, field = cost.body, cost.choice.find(ContourTerm), cost.views[0].edge_field
    predictor = ContourPredictor(body)
    assert term is not None
    assert field is not None
    x = random_states(body, 2, generator=generator)
    pose = body.pose(x)
    nodes = predictor(body, pose, cost.camera.centre_world)
    model = cost.camera.project_with_derivatives(nodes.points)
    normal = cost.camera.image_normals(model, nodes.normals)
    found = term.search(model.uv, normal, field)
    link = predictor.node_link
    away = nodes.points - pose.tree.translation[..., link, :]
    local = (pose.tree.rotation[..., link, :, :] * away[..., :, None]).sum(-2)
    leaf = x.clone().requires_grad_()
    tree = body.pose(leaf).tree
    points = (tree.rotation[..., link, :, :] * local[..., None, :]).sum(-1)
    points = points + tree.translation[..., link, :]
    value = cost_of_fixed_matches(term, nodes, cost.camera, found, model.uv, normal, points)
    scale = term.weight / (predictor.num_nodes * term.nu)
    expected = differentiate_twice(scale * value.sum(-1), leaf)
    assert expected.gradient.any()
    assert_same(cost.local_model(x), expected, 1e-9)


@pytest.mark.parametrize("choice", [JOINTS_ONLY, CONTOUR_ONLY, EVERYTHING])
@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_autograd_curvature_is_the_exact_one(
    name: str, choice: CostChoice, generator: torch.Generator
) -> None:
    exact = make_cost(name, choice)
    autograd = replace(exact, choice=replace(choice, curvature=Curvature.AUTOGRAD))
    newton = replace(exact, choice=replace(choice, curvature=Curvature.GAUSS_NEWTON))
    x = random_states(exact.body, 3, generator=generator)
    model = exact.local_model(x)
    assert_same(autograd.local_model(x), model, 1e-9)
    approximate = newton.local_model(x)
    torch.testing.assert_close(approximate.value, model.value)
    torch.testing.assert_close(approximate.gradient, model.gradient)
    assert not torch.allclose(approximate.hessian, model.hessian)


def test_weights_scale_their_terms(generator: torch.Generator) -> None:
    cost = make_cost()
    terms = (ContourTerm(weight=300.0), JointTerm(sigma=2.0, weight=3.0))
    heavy = replace(cost, choice=EVERYTHING.having(*terms))
    x = random_states(cost.body, 4, generator=generator)
    light, terms = cost.terms(x), heavy.terms(x)
    torch.testing.assert_close(terms["contour"], 2 * light["contour"])
    torch.testing.assert_close(terms["joints"], 3 * light["joints"])
    torch.testing.assert_close(terms["temporal"], light["temporal"])


def test_terms_are_silent_without_their_data(generator: torch.Generator) -> None:
    cost = make_cost()
    x = random_states(cost.body, 2, generator=generator)
    assert set(changed(cost, keypoints=None).terms(x)) == {"contour", "stabiliser", "temporal"}
    assert set(changed(cost, edge_field=None).terms(x)) == {"joints", "stabiliser", "temporal"}
    bare = changed(cost, keypoints=None, edge_field=None, prior=None)
    assert bare.views[0].is_out
    assert set(bare.terms(x)) == {"stabiliser"}
    assert torch.isfinite(bare.local_model(x).hessian).all()


def test_frames_of_unknown_interval_have_no_temporal_prior() -> None:
    """By default, of how far a state may move in no time: not NaN."""
    body = load_body("arm8")
    n = body.num_parameters
    unit = torch.eye(n).double()[None]
    prior = Prior.of(GaussianMixture(body.rest[None], unit, torch.zeros(1, dtype=torch.float64)))
    for options, is_known in (({}, False), ({"frame_interval": 1 / 25}, True)):
        costs = FrameCosts(body, Camera.pinhole(64, 48, focal_px=60.0), CostChoice(), **options)
        cost = costs(None, body=body).of_children(torch.tensor([0, 0]), prior)
        x = torch.stack([body.rest, body.rest + 0.01])
        assert ("temporal" in cost.terms(x)) == is_known
        for part in (cost.value(x), *cost.local_model(x)):
            assert torch.isfinite(part).all()


def test_the_coarse_cost_is_the_keypoints_without_outliers(generator: torch.Generator) -> None:
    cost = make_cost()
    x = random_states(cost.body, 3, generator=generator)
    coarse = cost.coarse()
    assert coarse is not None
    assert set(coarse.terms(x)) == {"joints", "stabiliser", "temporal"}
    # Well placed joints are judged alike, and what is far off is pulled as by the noise.
    own, trusted = (each.choice.find(JointTerm) for each in (cost, coarse))
    assert own is not None
    assert trusted is not None
    sigma = own.sigma
    squared = (sigma * torch.tensor([0.01, 10.0], dtype=torch.float64)).square()
    fine = own.potential(squared).first * sigma**2
    trusting = trusted.potential(squared).first * sigma**2
    assert fine.tolist() == pytest.approx([1, 0.074], abs=1e-3)
    assert trusting.tolist() == pytest.approx([1, 0.742], abs=1e-3)
    assert (coarse.terms(x)["joints"] >= cost.terms(x)["joints"]).all()
    assert changed(cost, keypoints=None).coarse() is None
    assert replace(cost, choice=EVERYTHING.without("joints")).coarse() is None


def test_a_body_without_flesh_has_no_contour(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(
        "<robot name='r'><link name='a'/><link name='b'/><joint name='j' type='continuous'>"
        "<parent link='a'/><child link='b'/></joint></robot>"
    )
    body = load_body(path)
    given = {"tables": BodyTables(body), "keypoints": None, "prior": None, "deviation": None}
    cost = changed(make_cost(), body=body, **given)
    x = torch.zeros(3, 1, dtype=torch.float64)
    assert not cost.value(x).any()
    assert not cost.local_model(x).hessian.any()


# No NaN ever leaves.

COSTS = {
    (name, dtype): make_cost(name, dtype=dtype)
    for name in ("arm8", "body30")
    for dtype in (torch.float32, torch.float64)
}


def assert_no_nan(cost: TrackingCost, x: Tensor) -> None:
    value, model = cost.value(x), cost.local_model(x)
    for part in (value, *model):
        assert torch.isfinite(part).all()


@settings(max_examples=60, deadline=None)
@given(
    name=st.sampled_from(["arm8", "body30"]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    size=st.sampled_from([1e-30, 1e-3, 1.0, 10.0, 1e3, 1e4, 1e5, 1e6, 1e12, 1e18]),
    seed=st.integers(0, 2**20),
    few=st.booleans(),
)
def test_no_state_gives_nan(
    name: str, dtype: torch.dtype, size: float, seed: int, few: bool
) -> None:
    """Far away, behind the camera, wound up a million times, or exactly at zero."""
    cost = COSTS[name, dtype]
    generator = torch.Generator().manual_seed(seed)
    x = size * torch.randn(3, cost.body.num_parameters, generator=generator, dtype=torch.float64)
    if few:
        x = x * (torch.rand(x.shape, generator=generator) < 0.1)
    assert_no_nan(cost, x.to(dtype))


@settings(max_examples=40, deadline=None)
@given(
    place=st.tuples(*[st.floats(-6, 6) for _ in range(3)]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    yaw=st.floats(-7, 7),
)
def test_no_place_around_the_camera_gives_nan(
    place: tuple[float, float, float], dtype: torch.dtype, yaw: float
) -> None:
    cost = COSTS["body30", dtype]
    body = cost.body.with_base(cost.body.base_rotation, torch.tensor(place).to(dtype))
    x = cost.body.rest.clone()
    x[body.state_index("root_yaw")] = yaw
    assert_no_nan(cost.with_body(body), x)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_huge_distances_give_no_nan(dtype: torch.dtype) -> None:
    cost = COSTS["body30", dtype]
    for far in (1e9, 1e15, 1e18) + ((1e30,) if dtype == torch.float64 else ()):
        for column in range(3):
            for sign in (1.0, -1.0):
                x = cost.body.rest.clone()
                x[column] = sign * far
                assert_no_nan(cost, x)
        x = cost.body.rest.clone()
        x[:3] = far
        assert_no_nan(cost, x)


FULL_COSTS = {dtype: make_full_cost(dtype=dtype) for dtype in (torch.float32, torch.float64)}


@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_every_term_together(name: str, generator: torch.Generator) -> None:
    cost = make_full_cost(name, own_parents=5)
    x = random_states(cost.body, 5, generator=generator)
    terms, model = cost.terms(x), cost.local_model(x)
    assert set(terms) == FULL_NAMES
    torch.testing.assert_close(torch.stack(list(terms.values())).sum(0), model.value)
    torch.testing.assert_close(cost.value(x), model.value)
    items = torch.tensor([4, 1])
    part = LocalModel(*(part[items] for part in model))
    assert_same(cost.take(items).local_model(x[items]), part, 1e-6)


@given(
    scale=st.sampled_from([0.0, 1.0, 1e3, 1e8, 1e30, math.inf]),
    shift=st.sampled_from([0.0, -3.5, 5.0, 1e6]),
    seed=st.integers(0, 2**31),
    kind=st.sampled_from(["noise", "black", "white", "one line"]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
@settings(max_examples=40, deadline=None)
def test_no_nan_leaves_a_term(
    scale: float, shift: float, seed: int, kind: str, dtype: torch.dtype
) -> None:
    """Bodies at bounds, behind the camera, out of the image; images without any edge."""
    cost = FULL_COSTS[dtype]
    generator = torch.Generator().manual_seed(seed)
    body = cost.body
    edges = cost.views[0].edge_field
    assert edges is not None
    noise = torch.randn(3, body.num_parameters, generator=generator, dtype=torch.float64)
    wild = (scale * noise).nan_to_num(0.0, math.inf, -math.inf).to(dtype)
    x = body.bounds.project(wild).clamp(-1e30, 1e30)
    base = body.base_translation + torch.tensor([0.0, 0.0, shift]).to(dtype)
    field = {
        "noise": edges,
        "black": torch.zeros_like(edges),
        "white": torch.full_like(edges, 0.7),
        "one line": edges * (torch.arange(WIDTH) == 80),
    }[kind]
    cost = changed(cost, body=body.with_base(body.base_rotation, base), edge_field=field)
    for name, value in cost.terms(x).items():
        assert torch.isfinite(value).all(), name
    for part in cost.local_model(x):
        assert torch.isfinite(part).all()


def test_screening_is_the_edges_alone(generator: torch.Generator) -> None:
    """[RR] section 4.2."""
    cost = make_full_cost()
    x = random_states(cost.body, 3, generator=generator)
    edges, whole = cost.screening(), cost.terms(x)
    assert edges is not None
    screened = edges.terms(x)
    assert set(screened) == {"contour", "edge_energy"}
    for name, value in screened.items():
        torch.testing.assert_close(value, whole[name])


def test_without_edges_the_cost_itself_screens(generator: torch.Generator) -> None:
    """Where nothing tells hypotheses apart, which are kept would be a matter of their order."""
    cost = make_full_cost()
    assert replace(cost, choice=JOINTS_ONLY).problem().screening is None
    blind = changed(cost, edge_field=None, features=None)
    assert blind.problem().screening is None


def test_a_cost_without_terms_is_zero() -> None:
    cost = make_cost(choice=NOTHING)
    x = cost.body.rest.expand(3, -1)
    assert torch.equal(cost.value(x), torch.zeros(3).double())
    assert cost.terms(x) == cost.gradients(x) == {}


def test_lengths_belong_to_the_anthropometric_prior(generator: torch.Generator) -> None:
    """It takes the stabiliser's place there, which would otherwise count them twice."""
    body = load_body("body34", free_proportions=True)
    given = {"tables": BodyTables(body), "deviation": None, "prior": None}
    cost = changed(make_cost(choice=NOTHING), body=body, **given)
    both = replace(cost, choice=CostChoice(terms=(Stabiliser(), Anthropometric())))
    x = random_states(body, 4, generator=generator)
    terms = both.terms(x)
    assert set(terms) == {"stabiliser", "anthropometric"}
    moved = x.clone()
    columns = list(proportion_columns(body).values())
    moved[:, columns] = body.bounds.project(moved + 0.01)[:, columns]
    after = both.terms(moved)
    torch.testing.assert_close(after["stabiliser"], terms["stabiliser"])
    assert (after["anthropometric"] != terms["anthropometric"]).all()
    without = replace(both, choice=CostChoice(terms=(Stabiliser(lengths=True),)))
    assert (without.terms(moved)["stabiliser"] != without.terms(x)["stabiliser"]).all()


def test_the_stopwatch_knows_every_term(generator: torch.Generator) -> None:
    stopwatch = Stopwatch()
    cost = replace(make_full_cost(), stopwatch=stopwatch)
    x = random_states(cost.body, 3, generator=generator)
    cost.value(x)
    assert set(stopwatch.seconds) == {*FULL_NAMES, "pose", "visibility"}
    before = dict(stopwatch.seconds)
    cost.local_model(x)
    assert set(stopwatch.seconds) == {*before, "lift"}
    assert all(stopwatch.seconds[name] > spent > 0 for name, spent in before.items())


@pytest.mark.parametrize("engine", ENGINES)
def test_what_the_cost_says_of_the_past(engine: str, generator: torch.Generator) -> None:
    cost = replace(make_full_cost("arm8"), engine=engine_for(engine, "cpu", "float64"))
    x = random_states(cost.body, 4, generator=generator)
    past, terms = cost.problem().past, cost.terms(x)
    assert past is not None
    torch.testing.assert_close(past.value(x), terms["temporal"] + terms["temporal_mixture"])
    motion = cost.problem().motion
    assert motion is not None
    torch.testing.assert_close(motion.value(x), terms["flow"])
    choice = cost.choice.without("temporal", "temporal_mixture", "flow")
    assert replace(cost, choice=choice).problem()[4:6] == (None, None)

"""The prior on proportions: against a library's Gaussian, correlations, symmetry and limits."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from reference import anthropometric as reference
from torch import Tensor

from torchcss.body.catalog import BODY_NAMES, LENGTHS, PLACES, PROPORTIONS, specification
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.cost.anthropometric import INDIVIDUAL, Anthropometric, proportion_columns
from torchcss.cost.term import differentiate_twice
from torchcss.initialise.multi_start import PAPER_PROPORTIONS, StartSearch
from torchcss.types import LocalModel

PRIOR = Anthropometric()


def state_of(body: BodyModel, lengths: dict[str, float]) -> Tensor:
    """The state in which the body has these lengths."""
    x = body.rest.clone()
    for name, column in proportion_columns(body).items():
        x[column] = lengths[name] - body.lengths[name]
    return x


def standard(body: BodyModel, factor: float = 1.0, **others: float) -> Tensor:
    lengths = {name: factor * length for name, length in LENGTHS.items()}
    for name, own in others.items():
        lengths[name] *= own
    return state_of(body, lengths)


@pytest.mark.parametrize("name", BODY_NAMES)
@pytest.mark.parametrize(
    ("lengths", "scale"), [(None, 1.0), ({"forearm": 0.25, "thigh": 0.45}, 1.0), (None, 0.92)]
)
def test_it_is_the_gaussian_of_its_docstring(
    name: str, lengths: dict[str, float] | None, scale: float, generator: torch.Generator
) -> None:
    body = load_body(name, free_proportions=True, lengths=lengths, scale=scale)
    x = 0.1 * torch.randn(3, body.num_parameters, generator=generator, dtype=torch.float64)
    models = []
    for item in x:
        leaf = item.clone().requires_grad_()
        value = reference.negative_log_density(body, leaf, PRIOR.stature, INDIVIDUAL, scale)
        models.append(differentiate_twice(value, leaf))
    expected = LocalModel(*(torch.stack(parts) for parts in zip(*models, strict=True)))
    got = PRIOR.local_model(x, body)
    for ours, theirs in zip(got, expected, strict=True):
        most = float(theirs.abs().max())
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-11 * most)


@pytest.mark.parametrize("scale", [1.0, 1.1])
def test_places_vary_by_themselves(scale: float) -> None:
    """By 5 % of their lengths, half of the papers' interval, and not with stature."""
    body = load_body("body34", free_proportions=PAPER_PROPORTIONS, scale=scale)
    columns, covariance = proportion_columns(body), PRIOR.covariance(body)
    for row, name in enumerate(columns):
        if name in PLACES:
            deviation = 0.05 * scale * LENGTHS[PLACES[name]]
            assert float(covariance[row, row].sqrt()) == pytest.approx(deviation)
            assert float(covariance[row].abs().sum()) == pytest.approx(deviation**2)
    assert set(columns) == set(PAPER_PROPORTIONS)
    x = body.rest.clone()[None]
    x[0, columns["hip_depth"]] += 0.05 * scale * LENGTHS["hip_width"]
    torch.testing.assert_close(PRIOR.local_model(x, body).value, torch.tensor([0.5]).to(x))


@pytest.mark.parametrize("free", [True, PAPER_PROPORTIONS])
def test_covariance_is_the_inverse_of_the_hessian(free: bool | tuple[str, ...]) -> None:
    body = load_body("body34", free_proportions=free)
    columns = list(proportion_columns(body).values())
    assert len(columns) == (9 if free is True else 8)
    hessian = PRIOR.local_model(body.rest, body).hessian[columns][:, columns]
    covariance = PRIOR.covariance(body)
    identity = torch.eye(len(columns), dtype=torch.float64)
    torch.testing.assert_close(covariance @ hessian, identity, rtol=0, atol=1e-9)
    assert float(torch.linalg.eigvalsh(covariance).min()) > 0


def test_sides_that_are_not_tied_share_their_stature_alone() -> None:
    rows = specification("body34", free_proportions=True)
    ties = {joint: row for joint, row in rows.ties.items() if not joint.endswith("_length")}
    body = BodyModel(replace(rows, ties=ties)).double()
    names = list(proportion_columns(body))
    assert {"l_thigh", "r_thigh", "trunk"} < set(names)
    left, right = names.index("l_thigh"), names.index("r_thigh")
    covariance = PRIOR.covariance(body)
    length = LENGTHS["thigh"]
    assert float(covariance[left, right]) == pytest.approx((PRIOR.stature * length) ** 2)
    own = float(covariance[left, left] - covariance[left, right])
    assert own == pytest.approx((INDIVIDUAL["thigh"] * length) ** 2)
    held = StartSearch(proportions=("trunk",)).bounds(body)
    columns = [body.state_index(f"{side}_thigh_length") for side in "lr"]
    assert bool((held.upper[columns] == 0).all())


def test_the_numbers_of_the_survey() -> None:
    """Total relative deviations of ANSUR II, and correlations with stature that follow."""
    body = load_body("body34", free_proportions=True)
    names = list(proportion_columns(body))
    spread = PRIOR.covariance(body).diagonal().sqrt()
    relative = {n: float(s) / LENGTHS[n] for n, s in zip(names, spread, strict=True)}
    survey = {
        "upper_arm": 1.75 / 33.52,
        "forearm": 1.54 / 26.79,
        "shoulder_width": 1.92 / 41.57,
        "hip_width": 1.75 / 27.54,
        "shank": 2.66 / 49.17,
    }
    for name, expected in survey.items():
        assert relative[name] == pytest.approx(expected, abs=0.001)
    assert PRIOR.stature == pytest.approx(6.86 / 175.62, abs=1e-4)


def test_a_tall_person_is_likelier_than_one_long_limb() -> None:
    body = load_body("body34", free_proportions=True)
    tall = float(PRIOR.local_model(standard(body, 1.039), body).value)
    odd = float(PRIOR.local_model(standard(body, upper_arm=1.08, thigh=0.92), body).value)
    assert float(PRIOR.local_model(standard(body), body).value) == pytest.approx(0.0, abs=1e-20)
    # One deviation of stature costs a little less than 1/2: the lengths by themselves may help.
    assert 0.3 < tall < 0.5
    assert odd > 6 * tall
    single = Anthropometric(stature=0.0)
    assert float(single.local_model(standard(body, 1.039), body).value) > 5 * tall


def test_left_and_right_share_their_lengths() -> None:
    """The paper's symmetry is a matter of ties: the sides cannot differ, and count once."""
    body = load_body("body34", free_proportions=True)
    x = standard(body, upper_arm=1.07, forearm=0.95, hip_width=1.05, shank=0.96)
    joints = body.pose(x).joints

    def distance(first: str, second: str) -> float:
        return float((joints[body.joint_index(first)] - joints[body.joint_index(second)]).norm())

    for limb in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")):
        left, right = (distance(*(f"{side}_{end}" for end in limb)) for side in "lr")
        assert left == pytest.approx(right, rel=1e-12)
    assert distance("l_shoulder", "l_elbow") == pytest.approx(1.07 * LENGTHS["upper_arm"])
    for name in proportion_columns(body):
        assert f"{name}_length" in body.state_names
        assert not any(f"{side}_{name}_length" in body.state_names for side in "lr")


def test_every_length_has_a_deviation() -> None:
    assert set(INDIVIDUAL) == set(PROPORTIONS)


def test_only_lengths_are_touched_and_fixed_bodies_cost_nothing(
    generator: torch.Generator,
) -> None:
    body = load_body("body34", free_proportions=True)
    x = torch.randn(4, body.num_parameters, generator=generator, dtype=torch.float64)
    model = PRIOR.local_model(x, body)
    others = [i for i in range(body.num_parameters) if i not in proportion_columns(body).values()]
    assert not model.gradient[:, others].any()
    assert not model.hessian[:, others].any()
    body = load_body("body34")
    for part in PRIOR.local_model(torch.zeros(3, 34, dtype=torch.float64), body):
        assert not part.any()


@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_leading_shapes_and_types(batch: tuple[int, ...], dtype: torch.dtype) -> None:
    body = load_body("arm8", free_proportions=True, dtype=dtype)
    n = body.num_parameters
    model = PRIOR.local_model(torch.full((*batch, n), 0.01, dtype=dtype), body)
    assert model.value.shape == batch
    assert model.gradient.shape == (*batch, n)
    assert model.hessian.shape == (*batch, n, n)
    assert all(part.dtype == dtype for part in model)


@pytest.mark.parametrize(("dtype", "far"), [(torch.float32, 1e30), (torch.float64, 1e300)])
def test_far_out_it_stays_finite(dtype: torch.dtype, far: float) -> None:
    body = load_body("body34", free_proportions=True, dtype=dtype)
    x = torch.stack([body.rest + far, body.rest - far, far * body.rest.sin().sign()])
    for part in PRIOR.local_model(x, body):
        assert bool(part.isfinite().all())

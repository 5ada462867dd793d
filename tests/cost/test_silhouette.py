"""The silhouette: what is before the background is covered, and the body is nowhere else."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from made_costs import Ready
from painted import a_body_before_a_camera, moved
from torch import Tensor
from torch.func import hessian, jacrev, vmap

from torchcss.body.model import BodyModel
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.frame import NOTHING_KNOWN, FrameCosts, Learnt
from torchcss.cost.interior import InteriorNodes
from torchcss.cost.part_map import part_map
from torchcss.cost.silhouette import SilhouetteImages, SilhouetteTerm
from torchcss.cost.total import TrackingCost, beside
from torchcss.types import Curvature
from torchcss.vision.appearance import Appearance
from torchcss.vision.background import Background
from torchcss.vision.camera import Camera
from torchcss.vision.features import FeatureExtractor, FrameFeatures


def nodes(body: BodyModel, x: Tensor) -> Tensor:
    return InteriorNodes(body)(body, body.pose(x)).points


def the_silhouette_of(
    body: BodyModel, camera: Camera, truth: Tensor, before: Tensor, term: SilhouetteTerm
) -> SilhouetteImages:
    drawn = part_map(body, truth, camera) >= 0
    return term.images(2 * drawn.to(truth) - 1, camera, nodes(body, before), float(drawn.sum()))


def plain_twin(term: SilhouetteTerm, points: Tensor, images: SilhouetteImages) -> float:
    """The formula of the module, point by point and node by node."""
    uv, _, valid = images.camera.project(points)
    full = math.log((1 + term.epsilon) / term.epsilon)
    total = 0.0
    for point, weight in zip(images.points, images.weight, strict=True):
        covered = 0.0
        for node, seen in zip(uv, valid, strict=True):
            if seen:
                covered += math.exp(-float((node - point).square().sum()) / (2 * images.sigma**2))
        phi = math.log((1 + term.epsilon) / (1 + term.epsilon - math.exp(-covered))) / full
        total += float(weight) * phi
    out = images.bare.value(uv) * valid
    return total + term.beta * float(out.mean())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (2,), (2, 1), (0,)])
def test_it_is_the_sum_over_points_and_nodes(batch: tuple[int, ...], dtype: torch.dtype) -> None:
    body, camera = a_body_before_a_camera(dtype)
    term = SilhouetteTerm(spacing=1.5)
    images = the_silhouette_of(body, camera, moved(body, 0.9), body.rest, term)
    assert len(images.points) > 20
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(*batch, len(body.rest), generator=generator, dtype=torch.float64)
    points = nodes(body, body.rest + 0.3 * noise.to(dtype))
    got = term.value(points, images.camera, images)
    assert got.shape == points.shape[:-1]
    assert got.dtype == dtype
    assert term.point_cost(points, images.camera, images).hessian.dtype == dtype
    every = points.reshape(-1, *points.shape[-2:])
    for value, some in zip(got.sum(-1).reshape(-1), every, strict=True):
        assert float(value) == pytest.approx(plain_twin(term, some, images), abs=2e-5)


def places(body: BodyModel) -> dict[str, Tensor]:
    """Where the nodes of a body may be, as they may be to a cost."""
    points = nodes(body, moved(body, 0.3))
    apart = torch.tensor([9.0, 0.0, 0.0], dtype=points.dtype)
    generator = torch.Generator().manual_seed(1)
    anywhere = torch.randn(points.shape, generator=generator, dtype=points.dtype)
    return {
        "a pose": points,
        "out of the image": points + apart,
        "half out of it": points + 0.1 * apart,
        "some behind the camera": points * torch.where(anywhere[:, :1] > 1, -1.0, 1.0),
        "all in one place": points[:1].expand_as(points),
        "anywhere": points + 0.3 * anywhere,
    }


@pytest.mark.parametrize("place", places(a_body_before_a_camera()[0]))
def test_derivatives_are_those_of_autograd(place: str) -> None:
    body, camera = a_body_before_a_camera()
    term = SilhouetteTerm(spacing=1.0)
    images = the_silhouette_of(body, camera, moved(body, 0.9), body.rest, term)
    points = places(body)[place]
    cost = term.point_cost(points, images.camera, images)
    torch.testing.assert_close(cost.value, term.value(points, images.camera, images))
    gradient = jacrev(lambda p: term.value(p, images.camera, images).sum())(points)
    torch.testing.assert_close(cost.gradient, gradient, rtol=1e-8, atol=1e-10)

    # With the shares held fixed every node is on springs of its own.
    uv, _, valid = images.camera.project(points)
    share, _, slope = term._cover(uv, valid, images)

    def held(point: Tensor, share: Tensor) -> Tensor:
        seen, _, valid = images.camera.project(point[None])
        springs = 0.5 * (share * slope * (seen - images.points).square().sum(-1)).sum()
        outside = term.beta / len(points) * images.bare.value(seen)[0]
        return torch.where(valid[0], springs + outside, 0.0)

    expected = vmap(hessian(held))(points, share)
    torch.testing.assert_close(cost.hessian, expected, rtol=1e-7, atol=1e-8)
    flat = (
        replace(term, beta=0.0).point_cost(points, images.camera, images, gauss_newton=True).hessian
    )
    assert float(torch.linalg.eigvalsh(flat).min()) > -1e-9


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_empty_picture_pushes_the_body_nowhere(dtype: torch.dtype) -> None:
    body, camera = a_body_before_a_camera(dtype)
    points = nodes(body, body.rest)
    for ratio, level in ((math.nan, 0.0), (0.2, 0.5), (-1.0, 0.5)):
        everywhere = torch.full((600, 480), ratio, dtype=dtype)
        images = SilhouetteTerm().images(everywhere, camera, points, 0.0)
        assert len(images.points) == 0
        cost = SilhouetteTerm().point_cost(points, images.camera, images)
        assert float(cost.value.sum()) == pytest.approx(level, abs=1e-5)
        assert float(cost.gradient.abs().max()) < 1e-5


@pytest.mark.parametrize("size", [(161, 203), (3, 2)])
def test_pictures_of_odd_and_of_very_small_sizes(size: tuple[int, int]) -> None:
    body, camera = a_body_before_a_camera()
    odd, full = camera.resized(*size), torch.ones(size[1], size[0], dtype=torch.float64)
    points = nodes(body, body.rest)
    images = SilhouetteTerm().images(full, odd, points, 100.0)
    cost = SilhouetteTerm().point_cost(points, images.camera, images)
    assert all(bool(part.isfinite().all()) for part in cost)


def test_the_true_pose_is_the_cheapest_and_a_far_limb_is_pulled_there() -> None:
    body, camera = a_body_before_a_camera()
    term = SilhouetteTerm()
    truth = moved(body, 0.9)
    images = the_silhouette_of(body, camera, truth, moved(body, 0.3), term)
    angles = torch.tensor([0.3, 0.5, 0.7, 0.9, 1.1, 1.3])
    states = torch.stack([moved(body, float(angle)) for angle in angles])
    values = term.value(nodes(body, states), images.camera, images).sum(-1)
    assert 0.0 < float(values[3]) < 0.05
    assert float(values.diff()[:3].max()) < 0 < float(values.diff()[3:].min())
    # From the first of them the hand is 50 pixels off, where no contour feels anything.
    hand = body.joint_names.index("r_wrist")
    uv = camera.project(body.pose(states).joints).uv[:, hand]
    assert float((uv[0] - uv[3]).norm()) > 45
    uncovered = replace(term, beta=0.0)
    assert raising_force(body, camera, uncovered, images, states[0]) > 10.0
    # Between trunk and arm there is bare ground, which it has to pass.
    assert raising_force(body, camera, term, images, states[0]) < 0.0
    assert raising_force(body, camera, term, images, states[1]) > 10.0


def raising_force(
    body: BodyModel, camera: Camera, term: SilhouetteTerm, images: SilhouetteImages, x: Tensor
) -> float:
    """Nats per radian by which the cost raises the right arm."""
    bound = Ready(term, term.bind(InteriorNodes(body), images))
    view = FrameContext(body=body, camera=camera)
    cost = TrackingCost(choice=CostChoice(terms=(bound,)), views=(view,))
    return -float(cost.gradients(x)["silhouette"][body.state_index("r_shoulder_raising")])


def test_it_costs_the_same_however_large_the_body_is_seen() -> None:
    """The same scene by a lens three times as long, and a body just before the camera or behind."""
    body, camera = a_body_before_a_camera()
    K = camera.K * torch.tensor([[3.0], [3.0], [1.0]])
    K[:2, 2] = torch.tensor([719.5, 899.5], dtype=K.dtype)
    long = Camera(K.tolist(), (1440, 1800)).to(torch.float64)
    term, truth = SilhouetteTerm(), moved(body, 0.9)
    x = torch.stack([truth, moved(body, 0.2), moved(body, 1.5)])
    near, far = (
        term.value(nodes(body, x), images.camera, images).sum(-1)
        for images in (the_silhouette_of(body, seen, truth, truth, term) for seen in (long, camera))
    )
    torch.testing.assert_close(near, far, rtol=0.15, atol=0.01)
    drawn = torch.ones(600, 480, dtype=torch.float64)
    points = nodes(body, body.rest)
    for shift in (-3.0, -2.0, -30.0):
        moved_to = points + points.new_tensor([0.0, 0.0, shift])
        images = term.images(drawn, camera, moved_to, 1000.0)
        cost = term.point_cost(moved_to, images.camera, images)
        assert all(bool(part.isfinite().all()) for part in cost)


def test_what_is_near_no_pose_does_not_count() -> None:
    body, camera = a_body_before_a_camera()
    drawn = part_map(body, body.rest, camera) >= 0
    points, area = nodes(body, body.rest), float(drawn.sum())
    alone = SilhouetteTerm().images(2.0 * drawn.double() - 1, camera, points, area)
    other = drawn.clone()
    other[:60, :40] = True
    beside = SilhouetteTerm().images(2.0 * other.double() - 1, camera, points, area)
    torch.testing.assert_close(alone.points, beside.points)
    torch.testing.assert_close(alone.weight, beside.weight)


def test_the_whole_cost_has_its_derivatives_and_chunks() -> None:
    body, camera = a_body_before_a_camera()
    term = SilhouetteTerm()
    images = the_silhouette_of(body, camera, moved(body, 0.9), body.rest, term)
    bound = term.bind(InteriorNodes(body), images)
    view = FrameContext(body=body, camera=camera)
    cost = TrackingCost(choice=CostChoice(terms=(Ready(term, bound),)), views=(view,))
    x = torch.stack([moved(body, 0.1), moved(body, 1.4), body.rest])
    model = cost.local_model(x)
    by_autograd = replace(cost.choice, curvature=Curvature.AUTOGRAD)
    gradient = replace(cost, choice=by_autograd).local_model(x).gradient
    torch.testing.assert_close(model.gradient, gradient, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(model.value, cost.value(x))
    torch.testing.assert_close(cost.take(torch.arange(3)).value(x), model.value)
    halved = cost.with_weights({"silhouette": 0.5})
    torch.testing.assert_close(halved.value(x), 0.5 * model.value)
    twice = beside([cost, cost])
    torch.testing.assert_close(twice.value(x), 2 * model.value)
    # Of a large silhouette fewer samples are looked at together.
    large = images._replace(points=images.points.repeat(9, 1), weight=images.weight.repeat(9) / 9)
    ready = Ready(term, term.bind(InteriorNodes(body), large))
    larger = replace(cost, choice=CostChoice(terms=(ready,)))
    assert larger._chunk < cost._chunk
    torch.testing.assert_close(larger.value(x), model.value)
    assert cost.screening() is None


def test_a_frame_needs_a_background_or_a_mask_and_a_pose_before() -> None:
    body, camera = a_body_before_a_camera()
    truth = body.rest
    drawn = part_map(body, truth, camera) >= 0
    picture = torch.full((600, 480, 3), 40, dtype=torch.uint8)
    before = torch.where(drawn[..., None], torch.tensor([200, 30, 30], dtype=torch.uint8), picture)
    extract = FeatureExtractor(working_size=600, flow=None, colour=True).to(torch.float64)
    features = extract(before.numpy())
    assert features.colour is not None
    term = SilhouetteTerm()
    choice = CostChoice(terms=(term,))
    costs = FrameCosts(body, camera, choice)
    inside = torch.stack([drawn] * costs.num_layers)
    seen = Appearance.unknown(costs.num_layers, like=features.colour)
    seen = seen.learn(features.colour, inside, ~inside)
    wall = torch.full_like(features.colour, 40 / 255)
    known = Background.unknown(wall).learn(wall, torch.ones_like(drawn))
    args = {"body": body, "before": truth[None], "known": Learnt(seen, known)}

    def found(costs: FrameCosts, features: FrameFeatures | None, **args: Any) -> Any:
        cost = costs(features, **args)
        return cost.bound[term, cost.views[0]]

    images = found(costs, features, **args).image
    assert len(images.points) > 50
    value = SilhouetteTerm().value(nodes(body, truth), images.camera, images).sum()
    assert float(value) < 0.1
    for missing in (
        *({"before": None}, {"known": NOTHING_KNOWN}),
        *({"known": Learnt(seen)}, {"known": Learnt(background=known)}),
    ):
        assert found(costs, features, **{**args, **missing}) is None
    assert found(costs, None, **args) is None
    masked = extract(before.numpy(), mask=drawn.numpy())
    images = found(costs, masked, body=body, before=truth[None]).image
    assert float(SilhouetteTerm().value(nodes(body, truth), images.camera, images).sum()) < 0.1

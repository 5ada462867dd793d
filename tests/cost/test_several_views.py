"""Several cameras: observations add up, priors count once, a view that is out says nothing."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from made_costs import (
    EVERYTHING,
    JOINTS_ONLY,
    changed,
    make_cost,
    make_full_cost,
    prior_at,
    random_states,
)
from torch import Tensor

from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.joints import JointTerm, match_joints
from torchcss.cost.term import differentiate_twice
from torchcss.cost.total import TrackingCost, beside
from torchcss.initialise.view import CameraView
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera


def from_the_side(camera: Camera, centre: Tensor, size_wh: tuple[int, int]) -> Camera:
    """A camera of another size that looks at a point from the right, at a right angle."""
    turn = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]).double()
    away = torch.tensor([0.0, 0.0, float(centre.norm())]).double()
    camera = camera.resized(*size_wh)
    return Camera(
        camera.K, size_wh, R_camera_world=turn, t_camera_world=away - turn @ centre, name="side"
    )


def two_views(choice: CostChoice = EVERYTHING, name: str = "arm8") -> tuple[TrackingCost, ...]:
    """The cost of each of two cameras, and of both."""
    first = make_cost(name, choice)
    camera = from_the_side(first.camera, first.body.base_translation, (128, 128))
    generator = torch.Generator().manual_seed(5)
    truth = random_states(first.body, generator=generator)
    uv = camera.project(first.body.pose(truth).joints).uv
    seen = torch.ones(len(uv)).double()
    edges, names = first.views[0].edge_field, first.body.joint_names
    assert edges is not None
    second = changed(
        first,
        camera=camera,
        edge_field=edges.flip(-1)[:, :100, :128].contiguous(),
        keypoints=Keypoints(uv, seen, names, relative_noise=0.7),
    )
    return first, second, beside([first, second])


@pytest.mark.parametrize("choice", [EVERYTHING, JOINTS_ONLY, EVERYTHING.without("contour")])
def test_what_cameras_see_adds_up(choice: CostChoice, generator: torch.Generator) -> None:
    first, second, both = two_views(choice)
    x = random_states(first.body, 5, generator=generator)
    priors = choice.without("contour", "joints")
    alone = replace(first, choice=priors)
    for method in ("value", "local_model"):
        sums = [getattr(cost, method)(x) for cost in (first, second, alone, both)]
        parts = zip(*([each] if isinstance(each, Tensor) else each for each in sums), strict=True)
        for a, b, prior, together in parts:
            torch.testing.assert_close(a + b - prior, together, rtol=1e-10, atol=1e-9)
    terms = both.terms(x)
    torch.testing.assert_close(torch.stack(list(terms.values())).sum(0), both.value(x))


def test_derivatives_over_both_views(generator: torch.Generator) -> None:
    """The lift of both views' points at once, against autograd through both projections."""
    first, _, both = two_views(JOINTS_ONLY)
    x = random_states(first.body, 3, generator=generator)
    term = JOINTS_ONLY.find(JointTerm)
    assert term is not None

    def value(x: Tensor) -> Tensor:
        joints, total = first.body.pose(x).joints, 0.0
        for view in both.views:
            assert view.keypoints is not None
            targets = match_joints(view.keypoints, first.body.joint_names)
            there = joints[..., targets.joint, :]
            total = total + term.value(there, view.camera, targets).sum(-1)
        return torch.as_tensor(total)

    leaf = x.clone().requires_grad_()
    expected = differentiate_twice(value(leaf), leaf)
    model = both.local_model(x)
    torch.testing.assert_close(model.gradient, expected.gradient, rtol=1e-9, atol=1e-8)
    torch.testing.assert_close(model.hessian, expected.hessian, rtol=1e-8, atol=1e-6)


def test_a_second_view_narrows_depth() -> None:
    """The variance along the first camera's line of sight falls, by far more than across it."""
    first, second, _ = two_views(JOINTS_ONLY.having(JointTerm(sigma=1.0)), "body34")
    assert first.keypoints is not None
    # At the pose that both see, so that no potential is past its bend.
    x = random_states(first.body, generator=torch.Generator().manual_seed(5))
    exact = first.camera.project(first.body.pose(x).joints).uv
    first = first.with_keypoints(first.keypoints._replace(positions=exact))
    both = beside([first, second])
    depth, across = (first.body.state_index(name) for name in ("root_z", "root_x"))
    deviations = [
        (cost.local_model(x).hessian + torch.eye(len(x))).inverse().diagonal().sqrt()
        for cost in (first, both)
    ]
    one, two = deviations
    assert float(two[depth]) < 0.3 * float(one[depth])
    assert float(two[across]) < 1.01 * float(one[across])


def test_a_view_without_pictures_and_marks_says_nothing(generator: torch.Generator) -> None:
    first, second, _ = two_views()
    out = FrameContext(body=second.body, camera=second.camera)
    x = random_states(first.body, 4, generator=generator)
    with_it = replace(first, views=(*first.views, out))
    torch.testing.assert_close(with_it.value(x), first.value(x), rtol=0, atol=0)
    # The first camera may be the one that is out.
    other_first = beside([changed(first, edge_field=None, keypoints=None), second])
    expected = second.value(x)
    torch.testing.assert_close(other_first.value(x), expected, rtol=1e-12, atol=1e-12)
    assert other_first.coarse() is not None
    assert changed(with_it, keypoints=None).coarse() is None


def test_samples_keep_their_own_targets_in_every_view(generator: torch.Generator) -> None:
    first = make_full_cost()
    modes = random_states(first.body, 3, generator=generator)
    first = changed(first, modes=modes)
    aside = from_the_side(first.camera, first.body.base_translation, (160, 120))
    second, prior = changed(first, camera=aside), prior_at(modes)
    parent = torch.tensor([2, 0, 1, 1])
    x = random_states(first.body, 4, generator=generator)
    both = beside([first, second]).of_children(parent, prior)
    apart = [cost.of_children(parent, prior) for cost in (first, second)]
    flows = [cost.terms(x)["flow"] for cost in (*apart, both)]
    torch.testing.assert_close(flows[0] + flows[1], flows[2], rtol=1e-10, atol=1e-10)
    items = torch.tensor([3, 0])
    torch.testing.assert_close(both.take(items).value(x[items]), both.value(x)[items])


def test_keypoints_of_a_view_in_a_picture_of_another_size() -> None:
    first, _, _ = two_views()
    small = CameraView(first.camera, first.keypoints).scaled(0.6)
    assert small.camera.image_size_wh == (96, 72)
    assert small.keypoints is not None
    assert first.keypoints is not None
    known = first.keypoints.confidence > 0
    place = first.camera.undistort(first.keypoints.positions[known])
    torch.testing.assert_close(small.camera.undistort(small.keypoints.positions[known]), place)

"""The region term: derivatives per point, levels, and masks of a posed body."""

from __future__ import annotations

import pytest
import torch
from reference.autograd import differentiated
from torch import Tensor
from torch.nn import functional

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.cost import region
from torchcss.cost.part_map import part_map
from torchcss.cost.region import (
    _CORE,
    _CORE_PIXELS,
    RegionImages,
    RegionTerm,
    part_layers,
    region_field,
    region_masks,
)
from torchcss.cost.visibility import SeenNodes
from torchcss.types import PointCost
from torchcss.vision.camera import Camera

WIDTH, HEIGHT = 80, 60
DISTORTION = [-0.33, 0.046, -0.0043, 0.0041, 0.067]


def make_camera(distortion: list[float] | None = None) -> Camera:
    K = [[70.0, 0.0, 39.5], [0.0, 72.0, 29.5], [0.0, 0.0, 1.0]]
    camera = Camera(K, (WIDTH, HEIGHT), distortion=distortion)
    return camera.to(torch.float64)


def masks_of(body, state, camera, **choice) -> tuple[torch.Tensor, torch.Tensor]:
    """`region_masks` of the whole image."""
    found = region_masks(body, state, camera, **choice)
    width, height = camera.image_size_wh
    inside = torch.zeros(len(found.inside), height, width, dtype=torch.bool)
    outside = inside.clone()
    inside[found.pixels], outside[found.pixels] = found.inside, found.outside
    return inside, outside


def some_nodes(*batch: int, count: int = 30, generator: torch.Generator) -> SeenNodes:
    """Nodes in the image, outside it, behind the camera, hidden, and absent."""
    points = torch.randn(*batch, count, 3, generator=generator, dtype=torch.float64)
    points = points * torch.tensor([0.6, 0.5, 0.3]) + torch.tensor([0.0, 0.0, 2.0])
    points[..., 0, :] = torch.tensor([5.0, 0.0, 2.0], dtype=torch.float64)
    points[..., 1, 2] = -1.0
    normals = torch.randn(*batch, count, 3, generator=generator, dtype=torch.float64)
    normals = normals / normals.norm(dim=-1, keepdim=True)
    exists = torch.ones(*batch, count, dtype=torch.float64)
    exists[..., 2], exists[..., 3] = 0.0, 0.4
    visible = torch.ones_like(exists)
    visible[..., 4], visible[..., 5] = 0.0, 0.7
    return SeenNodes(points, normals, exists, visible)


def some_images(count: int, generator: torch.Generator) -> RegionImages:
    ratio = 2 * torch.rand(3, HEIGHT, WIDTH, generator=generator, dtype=torch.float64) - 1
    field = region_field(ratio)
    field = field._replace(coefficients=field.coefficients.double())
    return RegionImages(field, torch.arange(count) % 3)


def frozen_value(
    term: RegionTerm, nodes: SeenNodes, camera: Camera, images: RegionImages, points: Tensor
) -> Tensor:
    """The plain twin: the module's formula, normals fixed, differentiable in the points."""
    with torch.no_grad():
        model = camera.project_with_derivatives(nodes.points)
        normal = camera.image_normals(model, nodes.normals)
    uv = camera.project(points).uv
    inside = images.field.value(uv - term.offset * normal, images.layer)
    outside = images.field.value(uv + term.offset * normal, images.layer)
    contrast = torch.where(model.valid, inside - outside, 0.0)
    found = 0.5 * term.nu * (1 - 0.5 * contrast)
    level = term.fitted_level * term.nu
    seen = nodes.visible * found + (1 - nodes.visible) * term.occlusion_factor * level
    return nodes.exists * seen + (1 - nodes.exists) * level


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("distortion", [None, DISTORTION])
def test_derivatives_per_point_are_those_of_autograd(
    batch: tuple[int, ...], distortion: list[float] | None, generator: torch.Generator
) -> None:
    camera, term = make_camera(distortion), RegionTerm(nu=1.3)
    nodes = some_nodes(*batch, generator=generator)
    images = some_images(nodes.exists.shape[-1], generator)
    got = term.point_cost(nodes, camera, images)
    points = nodes.points.clone().requires_grad_()
    value = frozen_value(term, nodes, camera, images, points)
    valid = camera.project(nodes.points).valid[..., None]
    value, gradient, hessian = differentiated(value, points)
    expected = PointCost(
        value, torch.where(valid, gradient, 0.0), torch.where(valid[..., None], hessian, 0.0)
    )
    for ours, theirs in zip(got, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(term.value(nodes, camera, images), got.value)


def test_a_perfect_outline_costs_nothing_and_an_inverted_one_everything() -> None:
    camera, term = make_camera(), RegionTerm()
    ratio = torch.full((1, HEIGHT, WIDTH), -1.0, dtype=torch.float64)
    ratio[:, :, :40] = 1.0
    edge = torch.tensor([[39.5, 30.0]])
    points = torch.cat([(edge - torch.tensor([39.5, 29.5])) / torch.tensor([70.0, 72.0]) * 2.0,
                        torch.full((1, 1), 2.0)], dim=-1).double()  # fmt: skip
    one = torch.ones(1, dtype=torch.float64)
    outward = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    layer = torch.zeros(1, dtype=torch.long)
    for normals, cost in ((outward, 0.0), (-outward, 1.0)):
        nodes = SeenNodes(points, normals, one, one)
        value = term.value(nodes, camera, RegionImages(region_field(ratio), layer))
        assert float(value) == pytest.approx(cost, abs=0.1)
        nothing = RegionImages(region_field(0 * ratio), layer)
        assert float(term.value(nodes, camera, nothing)) == 0.5


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_single_precision_and_no_nodes(dtype: torch.dtype, generator: torch.Generator) -> None:
    camera, term = make_camera().to(dtype), RegionTerm()
    nodes = SeenNodes(*(part.to(dtype) for part in some_nodes(4, generator=generator)))
    images = some_images(30, generator)
    for part in term.point_cost(nodes, camera, images):
        assert part.dtype == dtype
        assert part.isfinite().all()
    none = SeenNodes(*(part[..., :0, :] if part.ndim == 3 else part[..., :0] for part in nodes))
    empty = images._replace(layer=images.layer[:0])
    assert term.value(none, camera, empty).shape == (4, 0)


def someone_at_three_metres(focal_px: float) -> tuple[BodyModel, Camera]:
    """A body at rest, filling a picture whose size goes with the focal length."""
    body = load_body("body34").with_base(
        torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64)
    )
    width, height = round(16 / 15 * focal_px), round(4 / 3 * focal_px)
    K = [[focal_px, 0.0, (width - 1) / 2], [0.0, focal_px, (height - 1) / 2], [0.0, 0.0, 1.0]]
    return body, Camera(K, (width, height)).to(torch.float64)


def test_masks_of_a_posed_body_are_inside_and_around_its_parts() -> None:
    body, camera = someone_at_three_metres(150.0)
    names, layer_of = part_layers(body)
    assert len(names) < body.num_parts
    left, right = (body.part_names.index(f"{side}_forearm") for side in "lr")
    assert layer_of[left] == layer_of[right]
    parts = part_map(body, body.rest, camera)
    inside, around = masks_of(body, body.rest, camera)
    assert inside.shape == around.shape == (len(names), 200, 160)
    assert not (inside & around).any()
    layer_map = torch.tensor((*layer_of, -1))[parts]
    for layer, name in enumerate(names):
        own = layer_map == layer
        assert not (inside[layer] & ~own).any(), name
        assert not (around[layer] & own).any(), name
        if own.any():
            assert around[layer].any(), name
    thigh, shank = names.index("thigh"), names.index("shank")
    assert not (around[thigh] & (layer_map == shank)).any(), "the limb goes on there"


def test_colours_are_taken_from_the_core_of_a_part_and_not_beside_it() -> None:
    """A limb that is drawn some pixels off its place still learns its own colour."""
    body, camera = someone_at_three_metres(450.0)
    names, layer_of = part_layers(body)
    inside, around = masks_of(body, body.rest, camera)
    moved = body.rest.clone()
    # Two pixels to the side.
    moved[body.state_index("root_x")] += 2 * 3.0 / 450.0
    there = torch.tensor((*layer_of, -1))[part_map(body, moved, camera)]
    for name in ("thigh", "shank", "upper_arm", "forearm"):
        layer = names.index(name)
        strays = inside[layer] & (there == -1)
        assert int(inside[layer].sum()) > 100, name
        # Of all pixels but the outline's it would be 3 % or more.
        assert int(strays.sum()) < 0.02 * int(inside[layer].sum()), name
        assert not (around[layer] & (there == layer)).any(), name


def test_of_a_part_too_small_for_a_core_all_but_the_outline_is_learned() -> None:
    body, camera = someone_at_three_metres(150.0)
    names, layer_of = part_layers(body)
    layers = torch.tensor((*layer_of, -1))
    inside, _ = masks_of(body, body.rest, camera)
    thin, whole = (layers[part_map(body, body.rest, camera, girth=girth)] for girth in (_CORE, 1.0))
    core = {name: (thin == i) & (whole == i) for i, name in enumerate(names)}
    small = [name for name in names if 0 < int(core[name].sum()) < _CORE_PIXELS]
    assert "hand" in small
    assert "thigh" not in small
    for layer, name in enumerate(names):
        own = whole == layer
        # Off the outline: the eight pixels around are the part's own too.
        ring = functional.pad(own[None].float(), (1, 1, 1, 1), value=1.0)
        within = own & (functional.avg_pool2d(ring, 3, 1)[0] > 0.99)
        assert torch.equal(inside[layer], within if name in small else core[name]), name


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.9, 0.3), (-0.5, -0.9), (0.3, 1.2), (9.0, 0.0)])
def test_masks_are_those_of_the_whole_picture(
    shift: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are found in a window about the body, be it at the border or out of the picture."""
    body, camera = someone_at_three_metres(230.0)
    state = body.rest.clone()
    for name, metres in zip(("root_x", "root_y"), shift, strict=True):
        state[body.state_index(name)] += metres
    found = masks_of(body, state, camera)
    assert found[0].any() == found[1].any() == (shift[0] < 5)
    monkeypatch.setattr(region, "_window", lambda *_: (..., slice(None), slice(None)))
    for one, other in zip(found, masks_of(body, state, camera), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize(("name", "margin"), [("arm8", 2), ("body34", 12)])
def test_what_is_off_the_outline_is_own(name: str, margin: int) -> None:
    """By two pixels on an arm, whose base is told, by twelve on a body."""
    body = load_body(name)
    if name == "arm8":
        K = [[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]]
        turn = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
        away = turn @ -body.pose(body.rest).joints.mean(0) + torch.tensor([0.0, 0.0, 1.5])
        camera = Camera(K, (320, 240), R_camera_world=turn, t_camera_world=away)
    else:
        body, camera = someone_at_three_metres(900.0)
    names, layer_of = part_layers(body)
    inside, _ = masks_of(body, body.rest, camera.to(torch.float64))
    own = torch.tensor((*layer_of, -1))[part_map(body, body.rest, camera.to(torch.float64))]
    core, _ = masks_of(body, body.rest, camera.to(torch.float64), fitted=False)
    assert not (core & ~inside).any()
    wide = 0
    for layer, part in enumerate(names):
        whole = own == layer
        border = (~whole)[None].float()
        for side in ((margin, 0), (0, margin)):
            border = functional.max_pool2d(border, [2 * by + 1 for by in side], 1, side)
        border = border[0] > 0
        assert not (whole & ~border & ~inside[layer]).any(), part
        assert not (inside[layer] & ~whole).any(), part
        assert int(whole.sum()) > int(inside[layer].sum()), part
        wide += bool((whole & ~border).any())
    assert wide >= 2

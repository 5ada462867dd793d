"""What weighs the edges of a frame as printed: motion boundaries, a mask, what is learnt."""

from __future__ import annotations

import torch
from made_costs import make_full_cost
from torch import Tensor

from torchcss.cost.context import FrameContext
from torchcss.cost.region import part_layers
from torchcss.vision.appearance import Appearance
from torchcss.vision.background import Background
from torchcss.vision.edges import foreground_weight


def view_of(figure: Tensor) -> FrameContext:
    """A red figure before grey, learnt from the same picture."""
    view = make_full_cost("arm8").views[0]
    features = view.features
    assert features is not None
    size = features.grey.shape
    inside = torch.zeros(size, dtype=torch.bool)
    inside[40:80, 60:100] = True
    colour = torch.full((3, *size), 0.5, dtype=torch.float64)
    colour[:, inside] = figure[:, None]
    layers = len(part_layers(view.body)[0])
    masks = inside.expand(layers, *size)
    return FrameContext(
        body=view.body,
        camera=view.camera,
        features=features._replace(colour=colour, motion_boundary=torch.full(size, 0.5).double()),
        edge_field=features.edge_field(),
        boundary_emphasis=0.4,
        appearance=Appearance.unknown(layers, like=colour).learn(colour, masks, ~masks),
        background=Background.unknown(colour).learn(colour, ~inside),
    )


def test_what_is_learnt_weighs_edges_far_from_the_body_down() -> None:
    view = view_of(torch.tensor([0.8, 0.1, 0.1]).double())
    plain, weighed = (view.weighed_edges(foreground=given) for given in (False, True))
    assert plain is not None
    assert weighed is not None
    assert view.features is not None
    field = view.features.edge_energy * view.features.edge_direction
    torch.testing.assert_close(plain[:2], field)
    torch.testing.assert_close(weighed[:2], field)
    torch.testing.assert_close(plain[2], torch.full_like(plain[2], 0.8))
    assert float(weighed[2, 40:80, 60:100].min()) > 0.75
    assert float(weighed[2, :, :20].max()) < 0.3


def test_a_mask_comes_first_and_without_a_picture_all_count() -> None:
    view = view_of(torch.tensor([0.8, 0.1, 0.1]).double())
    features = view.features
    assert features is not None
    mask = torch.zeros_like(features.grey)
    mask[:60] = 1.0
    masked = FrameContext(
        body=view.body,
        camera=view.camera,
        features=features._replace(mask=mask),
        edge_field=view.edge_field,
        appearance=view.appearance,
        background=view.background,
    ).weighed_edges(foreground=True)
    assert masked is not None
    torch.testing.assert_close(masked[2], foreground_weight(mask))
    alone = FrameContext(body=view.body, camera=view.camera, edge_field=view.edge_field)
    bare = alone.weighed_edges(foreground=True)
    assert bare is not None
    assert bool((bare[2] == 1).all())
    none = FrameContext(body=view.body, camera=view.camera)
    assert none.weighed_edges(foreground=True) is None

"""A person before a camera, and pictures whose colours tell the parts of a pose perfectly."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.cost.part_map import part_map
from torchcss.cost.region import part_layers
from torchcss.vision.camera import Camera


def a_body_before_a_camera(dtype: torch.dtype = torch.float64) -> tuple[BodyModel, Camera]:
    body = load_body("body34").with_base(
        torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64)
    )
    K = [[450.0, 0.0, 239.5], [0.0, 450.0, 299.5], [0.0, 0.0, 1.0]]
    return body.to(dtype), Camera(K, (480, 600)).to(dtype)


def layers(body: BodyModel) -> tuple[int, Tensor]:
    names, layer = part_layers(body)
    return len(names), torch.tensor(layer)


def painted(
    body: BodyModel, camera: Camera, state: Tensor, missing: tuple[str, ...] = ()
) -> Tensor:
    """Likenesses of a picture whose colours tell the parts of a pose perfectly.

    Args:
        body: The body.
        camera: The camera.
        state: The pose.
        missing: Parts that the person lacks; what is behind them is bare.
    """
    count, layer = layers(body)
    part = part_map(body, state, camera)
    part[torch.isin(part, torch.tensor([body.part_names.index(name) for name in missing]))] = -1
    seen = torch.cat([layer, torch.tensor([-1])])[part]
    return torch.stack([2.0 * (seen == index).to(state) - 1 for index in range(count)])


def moved(body: BodyModel, angle: float, side: str = "r") -> Tensor:
    """Standing, one arm raised sideways."""
    x = body.rest.clone()
    x[body.state_index(f"{side}_shoulder_raising")] += angle
    return x

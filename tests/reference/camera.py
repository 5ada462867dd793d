"""The Jacobian of the projection, from what `Camera.pull_back` makes of one coordinate's slope."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcss.vision.camera import Camera, ProjectionModel


def jacobian_of(camera: Camera, model: ProjectionModel) -> Tensor:
    """Derivatives of image points in the 3D points, pixels per metre, `[*batch p 2 3]`."""
    hessian = torch.zeros(*model.uv.shape, 2).to(model.uv)
    slopes = torch.eye(2).to(model.uv).expand(*model.uv.shape[:-1], 2, 2).unbind(-2)
    rows = [camera.pull_back(model, model.depth, slope, hessian).gradient for slope in slopes]
    return torch.stack(rows, dim=-2)

"""The Jacobian of the projection, from what `Camera.pull_back` makes of one coordinate's slope."""

from __future__ import annotations

import torch
from reference.kinematics import rotation
from torch import Tensor

from torchcss.vision.camera import Camera, ProjectionModel


def jacobian_of(camera: Camera, model: ProjectionModel) -> Tensor:
    """Derivatives of image points in the 3D points, pixels per metre, `[*batch p 2 3]`."""
    hessian = torch.zeros(*model.uv.shape, 2).to(model.uv)
    slopes = torch.eye(2).to(model.uv).expand(*model.uv.shape[:-1], 2, 2).unbind(-2)
    rows = [camera.pull_back(model, model.depth, slope, hessian).gradient for slope in slopes]
    return torch.stack(rows, dim=-2)


def skew_camera(
    focal: tuple[float, float],
    centre: tuple[float, float],
    image_size_wh: tuple[int, int],
    *,
    away: float = 3.0,
    distortion: list[float] | None = None,
) -> Camera:
    """A camera that stands askew, the world's origin some metres before it."""
    return Camera(
        [[focal[0], 0.0, centre[0]], [0.0, focal[1], centre[1]], [0.0, 0.0, 1.0]],
        image_size_wh,
        distortion=distortion,
        R_camera_world=rotation(0.8, 0.3, 0.4),
        t_camera_world=[0.1, -0.2, away],
        name="test",
    )

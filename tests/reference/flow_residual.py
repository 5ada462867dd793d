"""Twin of the flow term: one node at a time, in plain numbers."""

from __future__ import annotations

import math

from torch import Tensor

from torchcss.vision.camera import Camera


def facing(point: Tensor, normal: Tensor, camera: Camera) -> float:
    towards = camera.centre_world - point
    sine = float(normal @ towards) / float(towards.norm())
    return min(max(sine / 0.15, 0.0), 1.0)


def bilinear(image: Tensor, u: float, v: float) -> float:
    """Value of `[h, w]`, the border continued."""
    height, width = image.shape
    u, v = min(max(u, 0.0), width - 1.0), min(max(v, 0.0), height - 1.0)
    column, row = math.floor(u), math.floor(v)
    total = 0.0
    for i in (row, row + 1):
        for j in (column, column + 1):
            share = max(0.0, 1 - abs(u - j)) * max(0.0, 1 - abs(v - i))
            if share:
                total += share * float(image[i, j])
    return total


def target(
    point: Tensor, normal: Tensor, visible: float, camera: Camera, flow: Tensor, outlier: Tensor
) -> tuple[float, float, float]:
    """Where the flow takes a node of the previous pose, and with what weight: u, v, W."""
    uv, _, valid = camera.project(point[None])
    u, v = uv[0].tolist()
    width, height = camera.image_size_wh
    inside = -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5
    weight = (1 - bilinear(outlier, u, v)) * facing(point, normal, camera) * visible
    weight = weight if inside and bool(valid[0]) else 0.0
    return u + bilinear(flow[0], u, v), v + bilinear(flow[1], u, v), weight


def cost(
    point: Tensor,
    normal: Tensor,
    visible: float,
    camera: Camera,
    aim: tuple[float, float, float],
    *,
    nu: float,
    sigma: float,
    level: float,
    factor: float,
) -> float:
    """Cost of a node of the present pose under the Lorentzian."""
    target_u, target_v, weight = aim
    uv, depth, valid = camera.project(point[None])
    u, v = uv[0].tolist()

    def half_rho(squared: float) -> float:
        return 0.5 * nu * math.log(1 + weight * squared / sigma**2)

    width, height = camera.image_size_wh
    near = min(max((float(depth[0]) - camera.near) / 0.1, 0.0), 1.0) * float(valid[0])
    untold = (1 - weight) * level * nu
    followed = half_rho((u - target_u) ** 2 + (v - target_v) ** 2) + untold
    seen = visible * followed + (1 - visible) * factor * level * nu
    turned = facing(point, normal, camera)
    in_front = turned * seen + (1 - turned) * level * nu
    return near * in_front + (1 - near) * (half_rho(width**2 + height**2) + untold)

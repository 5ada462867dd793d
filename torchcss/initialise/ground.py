"""The size of a person from the floor that they stand on.

One camera shows a person up to a common factor about its centre: size and distance go together.
Where it is known how high the camera is above the floor, the soles tell the factor: they are as far
below the camera as the floor is. How well, depends on how far away they are and on how well it is
known which way is up; what people's sizes are counts beside it.

Call `stature_on_floor`.
"""

from __future__ import annotations

import math

from torchcss.cost.anthropometric import Anthropometric
from torchcss.errors import BodyError, CameraError
from torchcss.files import naming
from torchcss.initialise.result import Initialisation, scale_of, stature_of
from torchcss.vision.camera import Camera

_SOLES = 0.03
"""Metres by which soles are off the floor: shoes, a heel that is lifted, the fit's own error."""


def stature_on_floor(found: Initialisation, camera: Camera, floor: float) -> tuple[float, float]:
    """Height of a person who stands on a floor, metres, and the deviation of its logarithm.

    Args:
        found: The fit of a person of unknown size.
        camera: The camera.
        floor: Height of the floor, metres along the axis of the camera's world that points up.

    Raises:
        BodyError: If the body is no person's, whose size is open, or would be of no person's size.
        CameraError: If it is not known which way is up, or the floor or the soles are not below
            the camera.
    """
    if "shank" not in found.lengths:
        raise BodyError("ground: it tells the size of a person; this body's size is known")
    up = camera.up
    if up is None:
        raise CameraError(
            "ground: it is not known which way is up; expected a camera that is held about level, "
            "in a world with an axis along gravity"
        )
    body = found.body
    direction = body.tie.new_tensor(up.direction)
    away = body.surface(body.pose(found.mixture.mean[0])).points.flatten(0, -2)
    away = away - camera.centre_world.to(away)
    sole = away[(away @ direction).argmin()]
    below = -float(sole @ direction)
    floor_below = float(camera.centre_world.to(direction) @ direction) - floor
    if not (below > 0 and 0 < floor_below < math.inf):
        raise CameraError(
            f"ground: the floor is {floor_below:.2f} m below the camera and the soles {below:.2f} "
            "m; expected both below it (heights are along the axis of the camera's world that "
            "points up)"
        )
    across = float((sole + below * direction).norm())
    doubt = math.hypot(_SOLES, up.deviation * across) / below
    usual = Anthropometric().stature
    share = usual**2 / (usual**2 + doubt**2)
    factor = (floor_below / below) ** share
    stature = factor * stature_of(found.lengths, found.scale)
    with naming("ground", BodyError):
        scale_of(stature)
    return stature, doubt * math.sqrt(share)

"""How the rerun viewer is laid out: the picture, the modes in space, and the plots below.

`layout` is the blueprint that a recording of `torchcss.show.viewer` opens with.
"""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from torchcss.errors import optional_package
from torchcss.types import as_array
from torchcss.vision.camera import Camera

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

_AXES = {"x": "X_UP", "y": "Y_UP", "z": "Z_UP", "-x": "X_DOWN", "-y": "Y_DOWN", "-z": "Z_DOWN"}

_ASIDE, _ABOVE = np.radians(55.0), np.radians(15.0)
"""The eye's place about the body: so far to the camera's right, and so far up."""


def rerun() -> ModuleType:
    """Import rerun.

    Raises:
        MissingExtraError: If it is not installed.
    """
    message = 'the viewer needs the package rerun-sdk: pip install "torchcss[viewer]"'
    optional_package("rerun.blueprint", message)
    return optional_package("rerun", message)


def world_axes(up: str) -> rr.ViewCoordinates:
    """Which axis of the world is up: x, y, z, -x, -y or -z."""
    return getattr(rerun().ViewCoordinates, f"RIGHT_HAND_{_AXES[up]}")


def layout(
    joints: Float[np.ndarray, "j 3"], camera: Camera | None, up: str, *, events: bool
) -> rrb.Blueprint:
    """Return the blueprint.

    Args:
        joints: Where the body is in the first frame, metres, world frame.
        camera: The camera; None: not known, and pictures have no place in space.
        up: Axis of the world that is up.
        events: Whether to list when the track was lost and found.
    """
    blueprint = rerun().blueprint
    position, target, vertical = viewpoint(joints, camera, up)
    space = blueprint.Spatial3DView(
        origin="world",
        contents=["$origin/**", *([] if camera is not None else ["- /world/camera/**"])],
        name="the modes in space",
        eye_controls=blueprint.EyeControls3D(
            kind=blueprint.Eye3DKind.Orbital, position=position, look_target=target, eye_up=vertical
        ),
    )
    picture = blueprint.Spatial2DView(
        origin="world/camera/picture", name="the picture that they explain"
    )
    below = [
        blueprint.TimeSeriesView(
            origin=origin,
            name=name,
            plot_legend=blueprint.PlotLegend(corner=blueprint.Corner2D.RightTop, visible=legend),
        )
        for origin, name, legend in (
            ("cost", "cost of the modes (nats)", False),
            ("weight", "weight of the modes", False),
            ("modes", "how many modes", True),
        )
    ]
    if events:
        below.append(blueprint.TextLogView(origin="events", name="lost and found"))
    return blueprint.Blueprint(
        blueprint.Vertical(
            blueprint.Horizontal(picture, space, column_shares=[2, 3]),
            blueprint.Horizontal(*below, column_shares=[3, 3, 3, 2][: len(below)]),
            row_shares=[5, 2],
        ),
        blueprint.BlueprintPanel(state="collapsed"),
        blueprint.SelectionPanel(state="collapsed"),
        blueprint.TimePanel(state="collapsed", timeline="frame"),
    )


def viewpoint(
    joints: Float[np.ndarray, "j 3"], camera: Camera | None, up: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where to look from, at what, and what is up there: aside of the camera, where depth shows.

    Args:
        joints: Joint positions of the first pose, metres.
        camera: The camera that it is seen by; None: none is known.
        up: The axis of the world that is up, such as "y" or "-z".
    """
    middle = joints.mean(0)
    radius = float(np.linalg.norm(joints - middle, axis=-1).max())
    vertical = np.zeros(3)
    vertical["xyz".index(up[-1])] = -1.0 if up[0] == "-" else 1.0
    if camera is None:
        towards = np.roll(vertical, 1)
    else:
        towards = as_array(camera.centre_world) - middle
        towards -= (towards @ vertical) * vertical
    length = np.linalg.norm(towards)
    towards = towards / length if length > 0 else np.roll(vertical, 1)
    right = np.cross(vertical, towards)
    level = np.cos(_ASIDE) * towards + np.sin(_ASIDE) * right
    direction = np.cos(_ABOVE) * level + np.sin(_ABOVE) * vertical
    return middle + 2.6 * max(radius, 0.3) * direction, middle, vertical

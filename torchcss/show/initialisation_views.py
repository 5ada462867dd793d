"""Pictures and tables of an initialisation: overlays of the stages, hypotheses from the side.

* `draw_fit`: the posed body, or several poses of it, over the picture.
* `draw_hypotheses`: the best hypotheses as stick figures, as the camera sees them and turned by 45
  and 90 degrees about the vertical: what looks one and the same in front differs in depth.
* `proportion_table`: fitted lengths beside those of the standard humanoid.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from torchcss.body.catalog import LENGTHS
from torchcss.body.model import BodyModel
from torchcss.files import replace_file
from torchcss.show.overlay import PALETTE, draw_overlay, project_body
from torchcss.vision.camera import Camera

_BONES = (
    ("skull_tip", "vc7"), ("vc7", "vt1"), ("vt1", "HumanoidRoot"),
    *((f"{side}_{a}", f"{side}_{b}") for side in "lr" for a, b in (
        ("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "hand_tip"), ("hip", "knee"),
        ("knee", "ankle"), ("ankle", "toe"))),
    ("l_shoulder", "vt1"), ("r_shoulder", "vt1"), ("l_hip", "HumanoidRoot"),
    ("r_hip", "HumanoidRoot"),
)  # fmt: skip
"""Lines of the stick figure; those whose ends a body lacks are left out."""


def draw_fit(
    image: UInt8[np.ndarray, "h w 3"],
    body: BodyModel,
    x: Float[Tensor, "k n"],
    camera: Camera,
    *,
    weights: Float[Tensor, " k"] | None = None,
    keypoints: Float[Tensor, "j 2"] | None = None,
    text: str | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw poses of a body over the picture, the first as a shaded body.

    Args:
        image: The picture.
        body: The body.
        x: Its states, the best first.
        camera: The picture's camera.
        weights: Weight of every state.
        keypoints: The marked joints.
        text: A line for the lower left corner.
    """
    modes = project_body(body, x, camera, rings=20, meridians=24)
    picture = torch.from_numpy(np.ascontiguousarray(image))
    return draw_overlay(picture, modes, weights=weights, keypoints=keypoints, text=text).numpy()


def draw_hypotheses(
    path: Path,
    body: BodyModel,
    x: Float[Tensor, "k n"],
    camera: Camera,
    *,
    cost: Float[Tensor, " k"] | None = None,
) -> None:
    """Write a picture of the hypotheses from three sides.

    Args:
        path: PNG file.
        body: The body.
        x: Hypotheses, the best first; more than seven are not told apart.
        camera: The camera, which gives the first direction.
        cost: Their costs, for the legend.
    """
    joints = camera.to_camera_frame(body.pose(x).joints).detach().cpu().numpy()
    middle = joints[:1].mean(axis=1, keepdims=True)
    seen = middle[..., 2:] * (joints / joints[..., 2:] - middle / middle[..., 2:])
    joints = joints - middle
    bones = [
        (body.joint_names.index(a), body.joint_names.index(b))
        for a, b in _BONES
        if {a, b} <= set(body.joint_names)
    ]
    figure = Figure(figsize=(12, 5), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    views = (("as the camera sees them", 0.0), ("turned by 45 degrees", 45.0),
             ("from the side (camera to the left)", 90.0))  # fmt: skip
    extent = 1.05 * float(max(np.abs(joints).max(), np.abs(seen[..., :2]).max()))
    for axes, (title, degrees) in zip(figure.subplots(1, 3), views, strict=True):
        turn = np.radians(degrees)
        across = np.cos(turn) * joints[..., 0] + np.sin(turn) * joints[..., 2]
        down = joints[..., 1]
        if degrees == 0.0:
            # Perspective, as in the picture: there the hypotheses coincide.
            across, down = seen[..., 0], seen[..., 1]
        for mode in reversed(range(len(joints))):
            red, green, blue = PALETTE[mode % len(PALETTE)]
            line = {"color": (red / 255, green / 255, blue / 255), "lw": 3 if mode == 0 else 1.5}
            for number, (a, b) in enumerate(bones):
                label = None if number or cost is None else f"{mode + 1}: {float(cost[mode]):.1f}"
                axes.plot(across[mode, [a, b]], -down[mode, [a, b]], label=label, **line)
        axes.set(title=title, aspect="equal", xlim=(-extent, extent), ylim=(-extent, extent))
        axes.set_xlabel("m")
    if cost is not None:
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles[::-1], labels[::-1], title="cost, nats", loc="outside right upper")
    with replace_file(path) as partial, partial.open("wb") as file:
        canvas.print_png(file)


def proportion_table(lengths: Mapping[str, float], scale: float = 1.0) -> list[dict[str, object]]:
    """Rows `name`, `fitted_m`, `standard_m`, `difference_percent`.

    Args:
        lengths: Fitted lengths, metres.
        scale: Scale of the standard humanoid.
    """
    return [
        {
            "name": name,
            "fitted_m": length,
            "standard_m": scale * LENGTHS[name],
            "difference_percent": 100 * (length / (scale * LENGTHS[name]) - 1),
        }
        for name, length in lengths.items()
    ]

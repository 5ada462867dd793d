"""Hypotheses of an initialisation from the side, and a table of the fitted lengths.

* `draw_hypotheses`: the best hypotheses as stick figures, as the camera sees them and turned by 45
  and 90 degrees about the vertical: what looks one and the same in front differs in depth.
* `proportion_table`: fitted lengths beside those of the standard humanoid.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from torchcss.body.catalog import LENGTHS, PLACES
from torchcss.body.model import BodyModel
from torchcss.show.style import save_figure
from torchcss.show.track_plots import bones_of, draw_bones, in_perspective, label, mode_colour
from torchcss.vision.camera import Camera

_VIEWS = {
    "as the camera sees them": 0.0,
    "turned by 45 degrees": 45.0,
    "from the side (camera to the left)": 90.0,
}


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
    joints = camera.to_camera_frame(body.pose(x).joints).numpy(force=True)
    middle = joints[:1].mean(axis=1, keepdims=True)
    distance = float(middle[0, 0, 2])
    # In perspective, as in the picture, the hypotheses coincide.
    seen = in_perspective(joints, distance) - in_perspective(middle, distance)
    joints, bones = joints - middle, bones_of(body)
    figure = Figure(figsize=(12, 5), layout="constrained")
    extent = 1.05 * float(np.fmax(np.abs(joints).max(), np.nanmax(np.abs(seen))))
    for axes, (title, degrees) in zip(figure.subplots(1, 3), _VIEWS.items(), strict=True):
        turn = np.radians(degrees)
        across = np.cos(turn) * joints[..., 0] + np.sin(turn) * joints[..., 2]
        places = seen if degrees == 0.0 else np.stack([across, joints[..., 1]], axis=-1)
        for mode in reversed(range(len(joints))):
            text = "" if cost is None else f"{mode + 1}: {float(cost[mode]):.1f}"
            look = {"color": mode_colour(mode), "lw": 3 if mode == 0 else 1.5}
            draw_bones(axes, places[mode], bones, look, label=text)
        label(axes, title, "metres", "metres up")
        axes.set(aspect="equal", xlim=(-extent, extent), ylim=(-extent, extent))
    if cost is not None:
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(
            handles[::-1], labels[::-1], title="cost, nats", loc="outside lower center",
            ncols=len(handles), frameon=False,
        )  # fmt: skip
    save_figure(figure, path, dpi=100)


def proportion_table(lengths: Mapping[str, float], scale: float = 1.0) -> list[dict[str, object]]:
    """Rows `name`, `fitted_m`, `standard_m`, `difference_percent`.

    Args:
        lengths: Fitted lengths and places, metres; the differences of places are in percent of the
            length of each.
        scale: Scale of the standard humanoid.
    """
    rows: list[dict[str, object]] = []
    for name, length in lengths.items():
        standard = scale * LENGTHS.get(name, 0.0)
        whole = scale * LENGTHS[PLACES.get(name, name)]
        difference = 100 * (length - standard) / whole
        rows.append({"name": name, "fitted_m": length, "standard_m": standard,
                     "difference_percent": difference})  # fmt: skip
    return rows

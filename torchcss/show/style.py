"""How our figures look: colours, and saving them whole."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from torchcss.files import prepare_output_folder, replace_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OKABE_ITO: dict[str, str] = {
    "blue": "#0072B2",
    "orange": "#E69F00",
    "green": "#009E73",
    "purple": "#CC79A7",
    "vermilion": "#D55E00",
    "sky": "#56B4E9",
    "yellow": "#F0E442",
    "black": "#000000",
}
"""Okabe and Ito's colours by name."""

DEVIATIONS = 2.0
"""Half-width of bands and half-axes of ellipsoids, standard deviations."""


def save_figure(figure: Figure, path: Path, *, dpi: int = 130) -> Path:
    """Write a figure as PNG.

    Args:
        figure: The figure.
        path: The file; its folder is made.
        dpi: Pixels per inch.

    Raises:
        OutputError: If it cannot be written.
    """
    prepare_output_folder(path.parent)
    with replace_file(path) as partial:
        figure.savefig(partial, dpi=dpi)
    return path

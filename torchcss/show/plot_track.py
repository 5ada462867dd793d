"""All figures of a finished track as PNG files.

Call `plot_track`, which `torchcss plot` does.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchcss.files import prepare_output_folder
from torchcss.show.posterior_plots import angles_figure, joints_figure, spectra_figure
from torchcss.show.style import save_figure
from torchcss.show.track_pictures import TrackFiles, pictures_of
from torchcss.show.track_plots import (
    effective_number,
    modes_figure,
    sheet_of,
    shrunk,
    side_view_figure,
)

_SHEET = 12


def plot_track(files: TrackFiles, out: Path, *, frame: int | None = None) -> list[Path]:
    """Draw everything.

    | file | shows |
    |---|---|
    | `modes.png` | weights, number of explanations, cost, losses |
    | `joints.png`, `angles.png` | joint centres and parameters with their uncertainty |
    | `spectra.png` | spectrum of the covariance, widest directions by parameters |
    | `side_view.png` | all modes of one frame, from the camera and from the side |
    | `frames.png` | frames with the modes over them, where there are pictures |

    Args:
        files: The track with what belongs to it.
        out: Folder for the files.
        frame: Which frame of the video is seen from the side; by default the one whose weight is
            spread over most modes.

    Returns:
        What was written.

    Raises:
        TorchcssError: If the folder cannot be written, or a picture cannot be read.
    """
    prepare_output_folder(out)
    track = files.track
    rows = np.flatnonzero(track.num_modes > 0)
    if frame is None:
        frame = int(track.frames[rows[effective_number(track)[rows].argmax()]])
    figures = {
        "modes": modes_figure(track, files.summary),
        "joints": joints_figure(track, files.body, camera=files.camera),
        "angles": angles_figure(track, files.body),
        "spectra": spectra_figure(track),
        "side_view": side_view_figure(track, frame, files.body, files.camera),
    }
    if files.has_pictures:
        chosen = np.unique(rows[np.linspace(0, len(rows) - 1, _SHEET).round().astype(int)])
        found = [(row, shrunk(image)) for row, image in pictures_of(files, chosen)]
        figures["frames"] = sheet_of(
            [image for _, image in found],
            [f"frame {track.frames[row]}, {track.times[row]:.2f} s" for row, _ in found],
        )
    return [save_figure(figure, out / f"{name}.png") for name, figure in figures.items()]

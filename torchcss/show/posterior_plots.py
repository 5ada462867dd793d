"""What a track says over time, and how sure it is: figures of its states and covariances.

* `plot_track`: all figures of a run, as files.
* `joints_figure`: where joints are, with bands of two standard deviations.
* `angles_figure`: every parameter of the state, with bands and the joint limits.
* `spectra_figure`: along how many directions of the state the image leaves how much uncertain, and
  which parameters those directions mix.

Lines and bands are those of each frame's best mode; the other modes are dots of their colours in
the overlay, fainter the less they weigh. A band is what the covariance says to first order
(`torchcss.body.uncertainty`); it knows nothing of the other modes.

The look and the helpers are those of `torchcss.show.track_plots`.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchcss.body.root import ROOT_NAMES, has_root
from torchcss.files import prepare_output_folder
from torchcss.io.run import Run, body_of_track
from torchcss.io.tracks import TRACK_NAME, Track
from torchcss.show.style import DEVIATIONS, OKABE_ITO, save_figure
from torchcss.show.track_pictures import has_pictures, pictures_of
from torchcss.show.track_plots import (
    check_not_empty,
    label,
    mode_colour,
    modes_figure,
    most_open_frame,
    sheet_of,
    shrunk,
    side_view_figure,
    tidy,
)
from torchcss.types import as_array
from torchcss.vision.camera import Camera

SHOWN_JOINTS = (
    "skull_tip", "l_shoulder", "l_elbow", "l_wrist", "r_shoulder", "r_elbow", "r_wrist",
    "r_hand_tip", "l_hip", "l_knee", "l_ankle", "r_hip", "r_knee", "r_ankle",
)  # fmt: skip
"""Joints that `joints_figure` shows of a body that has any of them."""

_LINE = OKABE_ITO["blue"]
_SHOWN_PARAMETERS = 14
_DIRECTIONS = 3
_BARS = 7
_SHEET = 12


def plot_track(
    run: Run, out: Path | None = None, *, frame: int | None = None, anew: bool = False
) -> list[Path]:
    """Draw all figures of a run as PNG files, which `torchcss plot` does.

    | file | shows |
    |---|---|
    | `modes.png` | weights, number of explanations, cost, losses |
    | `joints.png`, `angles.png` | joint centres and parameters with their uncertainty |
    | `spectra.png` | spectrum of the covariance, widest directions by parameters |
    | `side_view.png` | all modes of one frame, from the camera and from the side |
    | `frames.png` | frames with the modes over them, where there are pictures |

    Args:
        run: The run.
        out: Folder for the files; by default `plots` in the run's, of a smoothed track
            `smooth_plots`.
        frame: Which frame of the video is seen from the side; by default the one whose weight is
            spread over most modes.
        anew: Whether to draw over the video even where the tracker left an overlay.

    Returns:
        What was written.

    Raises:
        TorchcssError: If the body is not known, the folder cannot be written, or a picture cannot
            be read.
    """
    track = run.track._replace(body=run.body)
    check_not_empty(track)
    usual = "plots" if run.path.name == TRACK_NAME else f"{run.path.stem}_plots"
    out = prepare_output_folder(run.folder / usual if out is None else out)
    camera = track.first_camera
    if frame is None:
        frame = most_open_frame(track)
    figures = {
        "modes": modes_figure(track, run.summary),
        "joints": joints_figure(track, camera=camera),
        "angles": angles_figure(track),
        "spectra": spectra_figure(track),
        "side_view": side_view_figure(track, frame, camera=camera),
    }
    if has_pictures(run):
        chosen = np.unique(np.linspace(0, len(track.frames) - 1, _SHEET).round().astype(int))
        found = [(row, shrunk(image)) for row, image in pictures_of(run, chosen, anew=anew)]
        figures["frames"] = sheet_of(
            [image for _, image in found],
            [f"frame {track.frames[row]}, {track.times[row]:.2f} s" for row, _ in found],
        )
    return [save_figure(figure, out / f"{name}.png") for name, figure in figures.items()]


def joints_figure(track: Track, *, camera: Camera | None = None) -> Figure:
    """Places of `SHOWN_JOINTS`, or else of all joints, over time: a row each, a column a direction.

    Args:
        track: The track.
        camera: Its camera: directions are then to the right, up and away as it sees them. None: the
            axes of the track's world.

    Raises:
        TrackFileError: If the track has no frames, or its body cannot be told.
    """
    check_not_empty(track)
    names = [n for n in SHOWN_JOINTS if n in track.joint_names] or list(track.joint_names)
    chosen = [track.joint_names.index(name) for name in names]
    spread = track.best_covariances(body_of_track(track))
    places, labels = track.joints_world, ("world x", "world y", "world z")
    if camera is not None:
        # Up is minus the camera's y.
        turn = as_array(camera.R_camera_world) * [[1], [-1], [1]]
        shift = as_array(camera.t_camera_world) * [1, -1, 1]
        places = places @ turn.T + shift
        spread = turn @ spread @ turn.T
        labels = ("right in the picture", "up in the picture", "away from the camera")
    deviation = np.sqrt(np.diagonal(spread, axis1=-2, axis2=-1).clip(min=0))

    figure = Figure(figsize=(11.0, 1.0 + 1.15 * len(names)), layout="constrained")
    grid = figure.subplots(len(names), 3, sharex=True, squeeze=False)
    for panels, name, joint in zip(grid, names, chosen, strict=True):
        for axis, axes in enumerate(panels):
            _draw(axes, track, places[:, :, joint, axis], deviation[:, joint, axis])
        panels[0].set_ylabel(name.replace("_", " "), fontsize=9, parse_math=False)
    for axes, direction in zip(grid[0], labels, strict=True):
        axes.set_title(f"{direction} (metres)", fontsize=10)
    for axes in grid[-1]:
        axes.set_xlabel("seconds", fontsize=9)
    figure.suptitle(_caption("joint centres"), fontsize=10)
    return figure


def angles_figure(track: Track) -> Figure:
    """Every parameter over time, a panel each, with its limits as dotted lines.

    The root's six are relative to the base, and their lines end where that was moved.

    Args:
        track: The track.

    Raises:
        TrackFileError: If the track has no frames, or its body cannot be told.
    """
    check_not_empty(track)
    body = body_of_track(track)
    lower, upper = body.lower.numpy(), body.upper.numpy()
    deviation = np.sqrt(np.diagonal(track.covariance[:, 0], axis1=-2, axis2=-1).clip(min=0))
    step = np.abs(np.diff(track.base_transform, axis=0))
    moved = np.flatnonzero((step > 1e-9).any((1, 2))) + 1
    columns = min(len(track.state_names), 5)
    count = math.ceil(len(track.state_names) / columns)
    # Margins in inches: measuring the labels of so many panels takes as long as drawing them.
    width, height = 2.6 * columns + 0.6, 1.0 + 1.45 * count
    figure = Figure(figsize=(width, height))
    margins = {
        "left": 0.5 / width, "right": 1 - 0.1 / width, "bottom": 0.5 / height,
        "top": 1 - 0.65 / height, "wspace": 0.27, "hspace": 0.3,
    }  # fmt: skip
    grid = figure.subplots(count, columns, sharex=True, squeeze=False, gridspec_kw=margins)
    for axes in grid.flat[len(track.state_names) :]:
        axes.set_visible(False)
    for index, (axes, name) in enumerate(zip(grid.flat, track.state_names, strict=False)):
        factor, unit = (180 / math.pi, "degrees") if body.is_angle[index] else (1.0, "m")
        values = factor * track.state[:, :, index]
        breaks = moved if name in ROOT_NAMES else moved[:0]
        _draw(axes, track, values, factor * deviation[:, index], breaks=breaks)
        low, high = axes.get_ylim()
        for limit in (factor * lower[index], factor * upper[index]):
            if low - 0.3 * (high - low) <= limit <= high + 0.3 * (high - low):
                axes.axhline(limit, color=OKABE_ITO["vermilion"], lw=1.0, ls=":")
        axes.set_title(f"{name.replace('_', ' ')} ({unit})", fontsize=8, parse_math=False)
    for column in range(columns):
        shown = [axes for axes in grid[:, column] if axes.get_visible()]
        shown[-1].set_xlabel("seconds", fontsize=9)
        shown[-1].tick_params(labelbottom=True)
    root = "; root: from its first place, anew after a gap" if has_root(body) else ""
    figure.suptitle(f"{_caption('parameters')}; dotted: joint limits{root}", fontsize=10)
    return figure


def spectra_figure(track: Track) -> Figure:
    """Spectrum of the best mode's covariance over time, and what its widest directions are.

    Directions are those of the state, in which radians and metres are mixed as the tracker mixes
    them.

    Args:
        track: The track.

    Raises:
        TrackFileError: If the track has no frames.
    """
    check_not_empty(track)
    names = [name.replace("_", " ") for name in track.state_names]
    covariance, times = track.covariance[:, 0], track.times
    values, vectors = np.linalg.eigh(covariance)
    deviation = np.sqrt(values.clip(min=0))
    figure = Figure(figsize=(12.0, 8.2), layout="constrained")
    grid = figure.add_gridspec(2, 5, height_ratios=(1.0, 1.15))
    spectrum, heat = figure.add_subplot(grid[0, :3]), figure.add_subplot(grid[1, :3])
    _draw_widest(heat, times, np.square(vectors[:, :, -1]), names)
    colours = colormaps["cividis"](np.linspace(0, 0.9, deviation.shape[1]))
    for index, colour in enumerate(colours):
        spectrum.plot(times, deviation[:, index], color=colour, lw=1.1)
    spectrum.set_yscale("log")
    ratio = float(np.median(deviation[:, -1] / np.maximum(deviation[:, 0], np.finfo(float).tiny)))
    label(
        spectrum,
        f"standard deviations along all {len(names)} directions; widest over narrowest: "
        f"{ratio:.0f} (median)",
        y="radians and metres",
    )
    spectrum.set_xlim(*heat.get_xlim())
    values, vectors = np.linalg.eigh(covariance.mean(0))
    side = grid[:, 3:].subgridspec(_DIRECTIONS, 1)
    for rank in range(min(_DIRECTIONS, len(names))):
        axes = figure.add_subplot(side[rank])
        _draw_direction(axes, vectors[:, -1 - rank], names)
        width = math.sqrt(values[-1 - rank])
        axes.set_title(f"direction {rank + 1}, standard deviation {width:.2g}", fontsize=9)
    figure.suptitle(
        "covariance of the best mode; right: most uncertain directions of its mean over all frames",
        fontsize=10,
    )
    return figure


def _draw_widest(
    axes: Axes, times: np.ndarray, share: Float[np.ndarray, "t n"], names: list[str]
) -> None:
    """Which parameters the widest direction mixes, over time."""
    order = np.argsort(-share.mean(0))[:_SHOWN_PARAMETERS]
    # Frames need not be evenly spaced: the cells end halfway between them.
    image = axes.pcolormesh(
        times, range(len(order)), share[:, order].T, cmap="cividis", vmin=0, vmax=1,
        shading="nearest",
    )  # fmt: skip
    labels = [names[index] for index in order]
    axes.set_yticks(range(len(order)), labels, fontsize=8, parse_math=False)
    axes.set_ylim(len(order) - 0.5, -0.5)
    axes.set_title("which parameters the widest direction mixes, share of its square", fontsize=10)
    axes.set_xlabel("seconds", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.figure.colorbar(image, ax=axes, pad=0.01).ax.tick_params(labelsize=8)


def _draw_direction(axes: Axes, direction: np.ndarray, names: list[str]) -> None:
    """The largest parts of a direction, which points where the largest is positive."""
    largest = np.argsort(-np.abs(direction))[:_BARS]
    direction = direction * np.sign(direction[largest[0]])
    axes.barh(
        range(len(largest)), direction[largest],
        color=[OKABE_ITO["blue" if part > 0 else "orange"] for part in direction[largest]],
    )  # fmt: skip
    axes.axvline(0, color="0.45", lw=0.8)
    axes.set_yticks(range(len(largest)), [names[index] for index in largest], parse_math=False)
    axes.invert_yaxis()
    axes.set_xlim(-1.05, 1.05)
    tidy(axes)


def _draw(
    axes: Axes,
    track: Track,
    values: Float[np.ndarray, "t k"],
    deviation: Float[np.ndarray, " t"],
    *,
    breaks: np.ndarray | None = None,
) -> None:
    """Draw the best mode's line and band, and the other modes as dots."""
    times, best = track.times, values[:, 0]
    weight = np.exp(track.log_weight)
    for mode in range(1, values.shape[1]):
        there = weight[:, mode] > 0
        share = (weight[there, mode] / weight[there, 0]).clip(max=1.0)
        colour = np.tile(mode_colour(mode), (len(share), 1))
        axes.scatter(
            times[there], values[there, mode], s=6, lw=0, zorder=2,
            c=np.column_stack([colour, 0.15 + 0.85 * share]),
        )  # fmt: skip
    wide = DEVIATIONS * deviation
    for piece in np.split(np.arange(len(times)), [] if breaks is None else breaks):
        axes.fill_between(
            times[piece], (best - wide)[piece], (best + wide)[piece], color=mode_colour(0),
            alpha=0.45, lw=0, zorder=1,
        )  # fmt: skip
        # A line of one frame would not be seen.
        marker = "." if len(piece) == 1 else None
        axes.plot(times[piece], best[piece], color=_LINE, lw=1.3, ms=3, marker=marker, zorder=3)
    # The best mode fills the panel; what lies far from it would make it a line.
    low, high = float((best - wide).min()), float((best + wide).max())
    room = max(0.6 * float(np.ptp(best)), 0.15 * (high - low), 1e-3)
    axes.set_ylim(
        max(low, float(best.min()) - 3 * room) - 0.5 * room,
        min(high, float(best.max()) + 3 * room) + 0.5 * room,
    )
    tidy(axes)
    if len(times) > 1:
        axes.set_xlim(times[0], times[-1])


def _caption(what: str) -> str:
    return (
        f"{what}: the best mode with {DEVIATIONS:g} standard deviations; "
        "dots: the other modes, fainter the less they weigh"
    )

"""Figures of a finished track: the posterior from the side, its modes over time, a contact sheet.

* `side_view_figure`: all modes of one frame as the camera sees them, where they coincide, and from
  the side, where they do not.
* `modes_figure`: weights of the modes, the number of explanations, and the cost over time.
* `contact_sheet`: frames of a video, of an overlay for instance, with their times.

Modes have the colours that they have in the overlay (`torchcss.show.overlay.palette_colour`), which
colour-blind viewers can tell apart. Every function returns a figure that belongs to nobody;
`torchcss.show.style.save_figure` writes it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from PIL import Image

from torchcss.body.bases import pose_track
from torchcss.body.model import BodyModel
from torchcss.body.uncertainty import joint_covariance
from torchcss.errors import ConfigurationError, ShapeError, TrackFileError
from torchcss.files import StrPath
from torchcss.io.run import body_of_track
from torchcss.io.tracks import Track
from torchcss.io.video import VideoReader
from torchcss.joint_names import canonical_joint_name
from torchcss.show.overlay import palette_colour
from torchcss.show.style import OKABE_ITO
from torchcss.types import ColourImage
from torchcss.vision.camera import Camera

EXPLANATION_M = 0.12
"""Distance of some joint centre, metres, from which two modes are two explanations; the preset
`css` keeps modes apart by it (`Tracker.separation`)."""

_TRUNK = (
    ("l_shoulder", "r_shoulder"),
    ("l_hip", "r_hip"),
    ("l_shoulder", "l_hip"),
    ("r_shoulder", "r_hip"),
)
"""Lines of a reference, which has no joints along the spine."""

_FAINTEST = 0.45
"""Opacity of a mode that weighs nothing."""

_SHEET_PX = 360
"""Width of the images of a contact sheet."""

_NEAREST = 0.05
"""Depth below which a point has no place in a perspective image, metres."""

_SPACE = 0.08
_NARROWEST = 0.6
_PANELS_INCHES = 6.8
"""Metres about what a panel shows, metres that it shows at least, and inches of both panels."""


def bones_of(body: BodyModel) -> tuple[tuple[int, int], ...]:
    """Lines of a stick figure of any body, as pairs of rows of its joint centres.

    A joint centre is joined to the nearest, in the body's middle pose, of those before it on its
    own link or else on the nearest link above that has any.

    Args:
        body: The body.
    """
    above = {spec.link: spec.parent for spec in body.tree.specifications}
    place = body.pose(body.rest).joints.double().cpu()
    links = [body.tree.link_names[link] for link in body.marker_link.tolist()]
    bones = []
    for row, own in enumerate(links):
        link: str | None = own
        near = [other for other in range(row) if links[other] == own]
        while not near and (link := above[link]) is not None:  # pyright: ignore[reportArgumentType]
            near = [other for other, name in enumerate(links) if name == link]
        if near:
            distance = torch.linalg.norm(place[near] - place[row], dim=-1)
            bones.append((near[int(distance.argmin())], row))
    return tuple(bones)


_LEAST_WEIGHT = 0.01
"""Weight from which a mode's uncertainty is drawn: one that is hardly believed may be unsure of
everything, and would hide the rest."""


def side_view_figure(
    track: Track,
    frame: int,
    *,
    camera: Camera | None = None,
    reference: Mapping[str, Float[np.ndarray, "3"]] | None = None,
) -> Figure:
    """All modes of a frame, as the camera sees them and from its right side.

    In front they are in perspective, scaled to metres at the distance of the best mode; from the
    side, depth grows to the right. Opacity tells the weight. Ellipses are one standard deviation of
    the joint centres, `J S J^T` to first order (`torchcss.body.uncertainty`), of a body of known
    size: else all would be the same long stroke.

    Args:
        track: The track.
        frame: Index of the frame in the video.
        camera: The camera that the frame was taken with; None: the track is in the camera's own
            frame, as it is where the calibration has no extrinsics.
        reference: Where joints should be, metres in the track's frame, by any detector's names;
            unknown ones NaN.

    Raises:
        ConfigurationError: If the track does not have this frame.
        TrackFileError: If the body cannot be told.
        ShapeError: If a place of the reference is not three numbers.
    """
    row = _row_of(track, frame)
    body = body_of_track(track)
    modes = track.modes(row)
    pose = pose_track(body, modes.state, modes.base_transform)
    # Of a camera at the world's origin only place and axes matter.
    camera = (camera or Camera(torch.eye(3), (1, 1))).to(dtype=torch.float64, device="cpu")
    turn = camera.R_camera_world
    spread = (turn @ joint_covariance(body, pose, modes.covariance) @ turn.T).numpy()
    joints = camera.to_camera_frame(pose.joints).numpy()
    distance = float(joints[0, :, 2].mean())
    weight = modes.log_weight.exp().numpy()
    bones = bones_of(body)

    figure = Figure(figsize=(9.5, 5.0), layout="constrained")
    seen = in_perspective(joints, distance)
    front, side = figure.subplots(1, 2, sharey=True)
    for mode in reversed(range(len(weight))):  # the best on top
        look = {
            "color": mode_colour(mode),
            "alpha": _FAINTEST + (1 - _FAINTEST) * float(weight[mode] / weight.max()),
            "lw": 2.6 if mode == 0 else 1.6,
            "zorder": 3 + (mode == 0),
        }
        text = f"{100 * weight[mode]:.0f} %, cost {track.cost[row, mode]:.1f}"
        draw_bones(front, seen[mode], bones, look, label=text)
        draw_bones(side, joints[mode][:, [2, 1]], bones, look)
        for joint in _first_of_links(body) if weight[mode] >= _LEAST_WEIGHT else ():
            ellipse = _one_deviation(joints[mode, joint, [2, 1]], spread[mode, joint])
            ellipse.set(
                fc=mode_colour(mode),
                ec=[0.5 * part for part in mode_colour(mode)],
                alpha=look["alpha"],
                lw=0.9,
                zorder=5,
            )
            side.add_patch(ellipse)
    if reference is not None:
        _draw_reference(front, side, body, bones, camera, reference, distance)
    _label_side_view(figure, front, side, f"frame {frame}, {track.times[row]:.2f} s")
    return figure


def _label_side_view(figure: Figure, front: Axes, side: Axes, when: str) -> None:
    """Titles, axes of one scale, and the legend."""
    label(front, "as the camera sees it", "metres to the right", "metres up")
    label(side, "from the side; the camera is far to the left", "metres from the camera")
    _same_scale(figure, front, side)
    handles, labels = front.get_legend_handles_labels()
    figure.legend(
        handles[::-1], labels[::-1], title="weight of the modes", loc="outside right upper",
        fontsize=8, title_fontsize=9, frameon=False,
    )  # fmt: skip
    figure.suptitle(
        f"{when}; ellipses: one standard deviation, of the modes of {100 * _LEAST_WEIGHT:.0f} % "
        "or more",
        fontsize=10,
        x=0.01,
        ha="left",  # away from the legend
    )


def num_explanations(track: Track) -> np.ndarray:
    """How many of each frame's modes differ from all better ones, `[T]`."""
    frames = zip(track.joints_world, track.num_modes, strict=True)
    return np.array([count_apart(joints[:num]) for joints, num in frames], np.int64)


def count_apart(joints: Float[np.ndarray, "k j 3"]) -> int:
    """How many of the modes of one frame differ from all better ones by `EXPLANATION_M`.

    Args:
        joints: Joint centres of the modes, the best first.
    """
    kept: list[np.ndarray] = []
    for own in joints:
        if all(np.linalg.norm(own - other, axis=-1).max() >= EXPLANATION_M for other in kept):
            kept.append(own)
    return len(kept)


def check_not_empty(track: Track) -> None:
    """Refuse a track without frames.

    Raises:
        TrackFileError: If it has none.
    """
    if not len(track.frames):
        raise TrackFileError("the track has no frames; there is nothing to show")


def effective_number(track: Track) -> Float[np.ndarray, " t"]:
    """By how many modes of equal weight each frame's belief is spread as far, `1 / sum w^2`.

    Args:
        track: The track.
    """
    weight = np.exp(track.log_weight)
    weight /= weight.sum(axis=1, keepdims=True)
    return 1 / np.square(weight).sum(axis=1)


def most_open_frame(track: Track) -> int:
    """Number of the frame whose belief is spread over most modes."""
    return int(track.frames[effective_number(track).argmax()])


def modes_figure(track: Track, summary: Mapping[str, Any] | None = None) -> Figure:
    """Weights of the modes, number of explanations and cost of the best mode over time.

    The cost is that of the frames after the first.

    Args:
        track: The track.
        summary: Its `summary.json` (`torchcss.io.tracks.read_summary`), for the events: from a
            cross to a circle the track was told lost.

    Raises:
        TrackFileError: If the track has no frames.
    """
    check_not_empty(track)
    events = [] if summary is None else summary.get("events", [])
    times = track.times
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    weights, number, cost = figure.subplots(3, 1, sharex=True, height_ratios=(1.5, 1, 1))

    share = np.exp(track.log_weight)
    weights.stackplot(
        times, share.T, colors=[mode_colour(mode) for mode in range(share.shape[1])], lw=0,
        step="mid" if len(times) > 1 else None,
    )  # fmt: skip
    weights.set_ylim(0, 1)
    for values, look in (
        (track.num_modes, {"color": OKABE_ITO["sky"], "lw": 4, "label": "modes"}),
        (num_explanations(track),
         {"color": OKABE_ITO["black"], "lw": 1.6,
          "label": f"of these {100 * EXPLANATION_M:g} cm apart"}),
    ):  # fmt: skip
        number.step(times, values, where="mid", **look)
    number.plot(
        times, effective_number(track), color=OKABE_ITO["vermilion"], lw=1.3, ls="--",
        label="effective number",
    )  # fmt: skip
    number.set_ylim(0, 1.15 * max(int(track.num_modes.max()), 1))
    number.yaxis.get_major_locator().set_params(integer=True)
    number.legend(**_BESIDE)
    # A frame in which nothing was seen has no cost, and leaves a gap. The first frame, without flow
    # and learnt colours, costs so much less that nothing else would be seen.
    shown = np.where(np.isfinite(track.cost[:, 0]), track.cost[:, 0], np.nan)
    shown[: len(times) > 2] = np.nan
    cost.plot(times, shown, ".-", color=OKABE_ITO["blue"], lw=1.3, ms=4)
    label(weights, y="weight, best\nmode first")
    label(number, y="explanations")
    label(cost, x="seconds", y="cost of the best\nmode (nats)")
    _draw_events((weights, number, cost), events)
    if len(times) > 1:
        weights.set_xlim(times[0], times[-1])
    return figure


_BESIDE: dict[str, Any] = {
    "fontsize": 8, "frameon": False, "loc": "center left", "bbox_to_anchor": (1.0, 0.5),
}  # fmt: skip
"""A legend to the right of its panel."""


def _draw_events(panels: Sequence[Axes], events: Sequence[Mapping[str, Any]]) -> None:
    """Lines where the track was lost and found, and marks on the border of the last panel."""
    for kind, marker, colour in (("lost", "X", "vermilion"), ("found", "o", "green")):
        at = [float(event["time_s"]) for event in events if event["event"] == kind]
        for axes in panels:
            for time in at:
                axes.axvline(time, color=OKABE_ITO[colour], lw=1.1, ls="--", zorder=3)
        if at:
            # On the upper border of the panel, whatever its range.
            panels[-1].plot(
                at, np.ones(len(at)), marker, transform=panels[-1].get_xaxis_transform(),
                clip_on=False, color=OKABE_ITO[colour], ms=7, zorder=4, label=f"told {kind}",
            )  # fmt: skip
    if events:
        panels[-1].legend(**_BESIDE)


def contact_sheet(
    video: StrPath,
    frames: Sequence[int],
    *,
    track: Track | None = None,
    columns: int | None = None,
) -> Figure:
    """Frames of a video in a grid, with their times.

    Args:
        video: The video, or a folder of images.
        frames: Which frames, in the order in which they are shown.
        track: The track, if the video is its `overlay.mp4`. Frames and times are then those of the
            video that was tracked.
        columns: Images in a row; all in one by default, up to six.

    Raises:
        ConfigurationError: If no frames are asked for, or some that the video does not have.
        VideoError: If the video cannot be read.
    """
    if not len(frames):
        raise ConfigurationError("frames: expected at least one, got none")
    known = {} if track is None else {int(frame): row for row, frame in enumerate(track.frames)}
    place = {int(f): int(f) if track is None else known.get(int(f), -1) for f in frames}
    images: dict[int, tuple[float, np.ndarray]] = {}
    for frame in VideoReader(video, stop=max(*place.values(), 0) + 1):
        if frame.index in place.values():
            time = frame.time_s if track is None else float(track.times[frame.index])
            images[frame.index] = time, shrunk(frame.image)
    if missing := [frame for frame, row in place.items() if row not in images]:
        raise ConfigurationError(f"{video}: no frames {missing}; choose others")

    times, shown = zip(*(images[place[int(frame)]] for frame in frames), strict=True)
    titles = [f"frame {frame}, {time:.2f} s" for frame, time in zip(frames, times, strict=True)]
    return sheet_of(shown, titles, columns=columns)


def sheet_of(
    images: Sequence[ColourImage],
    titles: Sequence[str],
    *,
    columns: int | None = None,
) -> Figure:
    """Images of one size in a grid.

    Args:
        images: The images, at least one.
        titles: What stands above each.
        columns: Images in a row; all in one by default, up to six.
    """
    columns = columns or min(len(images), 6)
    rows = math.ceil(len(images) / columns)
    height, width = images[0].shape[:2]
    wide = 12.0 / columns
    figure = Figure(figsize=(12.0, rows * (wide * height / width + 0.3)), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for axes, image, title in zip(grid.flat, images, titles, strict=False):
        axes.imshow(image)
        axes.set_title(title, fontsize=9)
    return figure


def shrunk(image: ColourImage) -> UInt8[np.ndarray, "r s 3"]:
    """An image reduced to a width of `_SHEET_PX`, if it is wider."""
    height, width = image.shape[:2]
    if width <= _SHEET_PX:
        return image
    size = (_SHEET_PX, max(round(height * _SHEET_PX / width), 1))
    return np.asarray(Image.fromarray(image).resize(size))


def _row_of(track: Track, frame: int) -> int:
    """Which row of the track a frame is."""
    check_not_empty(track)
    if frame not in track.frames:
        raise ConfigurationError(
            f"the track has no frame {frame}; it covers frames {track.frames[0]} to "
            f"{track.frames[-1]}"
        )
    return int(np.flatnonzero(track.frames == frame)[0])


def _first_of_links(body: BodyModel) -> list[int]:
    """The first joint centre of every link; the others are rigid with it."""
    links = body.marker_link.tolist()
    return [links.index(link) for link in dict.fromkeys(links)]


def mode_colour(mode: int) -> tuple[float, float, float]:
    """The colour of the mode of a rank, as in the overlay; red, green, blue from 0 to 1."""
    red, green, blue = palette_colour(mode)
    return red / 255, green / 255, blue / 255


def in_perspective(joints: np.ndarray, distance: float) -> np.ndarray:
    """Perspective image of points of the camera's frame, in metres at a distance.

    NaN of points behind the camera or very near it, which it does not see.
    """
    depth = joints[..., 2:]
    return distance * joints[..., :2] / np.where(depth > _NEAREST, depth, np.nan)


def _same_scale(figure: Figure, front: Axes, side: Axes) -> None:
    """Give both panels, which share their heights, the room that they need at one scale."""
    heights = [axes.dataLim.intervaly for axes in (front, side)]
    low, high = min(h[0] for h in heights), max(h[1] for h in heights)
    front.set_ylim(low - _SPACE, high + _SPACE)
    widths = []
    for axes in (front, side):
        left, right = axes.dataLim.intervalx
        space = max(_SPACE, (_NARROWEST - (right - left)) / 2)
        axes.set(aspect="equal", xlim=(left - space, right + space))
        widths.append(right - left + 2 * space)
    front.get_gridspec().set_width_ratios(widths)  # pyright: ignore[reportOptionalMemberAccess]
    tall = _PANELS_INCHES * (high - low + 2 * _SPACE) / sum(widths)
    figure.set_figheight(min(max(tall, 2.0), 6.0) + 1.0)


def _one_deviation(centre: np.ndarray, covariance: np.ndarray) -> Ellipse:
    """Ellipse of one standard deviation in depth and height, from a covariance `[3 3]`."""
    values, vectors = np.linalg.eigh(covariance[np.ix_([2, 1], [2, 1])])
    # Up is minus the camera's y.
    turn = math.degrees(math.atan2(-vectors[1, 1], vectors[0, 1]))
    small, large = 2 * np.sqrt(values.clip(min=0))
    return Ellipse((centre[0], -centre[1]), large, small, angle=turn)


def draw_bones(
    axes: Axes,
    places: np.ndarray,
    bones: Sequence[tuple[int, int]],
    look: Mapping[str, Any],
    *,
    label: str = "",
) -> None:
    """A stick figure in one line with gaps; the second coordinate points down."""
    ends = np.full((len(bones), 3, 2), np.nan)
    ends[:, :2] = places[np.array(bones, int).reshape(-1, 2)] * [1, -1]
    axes.plot(*ends.reshape(-1, 2).T, label=label, solid_capstyle="round", **look)


def _draw_reference(
    front: Axes,
    side: Axes,
    body: BodyModel,
    bones: Sequence[tuple[int, int]],
    camera: Camera,
    reference: Mapping[str, np.ndarray],
    distance: float,
) -> None:
    known = {}
    for name, place in reference.items():
        place = np.asarray(place, np.float64)
        if place.shape != (3,):
            raise ShapeError(f"reference {name}: expected three numbers, got {list(place.shape)}")
        if np.isfinite(place).all():
            seen = camera.to_camera_frame(torch.from_numpy(place)).numpy()
            known[canonical_joint_name(name) or name] = seen
    pairs = [(body.joint_names[a], body.joint_names[b]) for a, b in bones]
    pairs = [pair for pair in (*pairs, *_TRUNK) if set(pair) <= set(known)]
    if not pairs:
        return
    names, places = list(known), np.array(list(known.values()))
    rows = [(names.index(first), names.index(second)) for first, second in pairs]
    look = {"color": "black", "lw": 1.3, "ls": "--", "zorder": 5}
    draw_bones(front, in_perspective(places, distance), rows, look, label="reference")
    draw_bones(side, places[:, [2, 1]], rows, look)


def label(axes: Axes, title: str = "", x: str = "", y: str = "") -> None:
    """Give a panel the look of all figures, and say what it shows."""
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    tidy(axes)


def tidy(axes: Axes) -> None:
    """Give a panel the look of all figures: a faint grid, small numbers, two borders."""
    axes.grid(visible=True, color="0.92", lw=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8)
    for spine in ("top", "right"):
        axes.spines[spine].set_visible(False)

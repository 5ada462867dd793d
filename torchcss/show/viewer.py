"""Tracks in the rerun viewer: the modes in space over the picture that they explain.

`Viewer` takes one `ShownFrame` after the other, whether they come from a run on disk (`view_track`,
which `torchcss view` calls) or from a tracker that runs (`torchcss.app.live`), and logs

| entity | what |
|---|---|
| `world/camera`, `world/camera/picture` | the frustum; the frame with its modes, as JPEG |
| `world/modes/K/skeleton` | lines between the joint centres of the mode of rank K, the best 0 |
| `world/modes/K/uncertainty` | ellipsoids of `DEVIATIONS` standard deviations of the joints |
| `world/modes/K/body/PART` | the shape |
| `cost/K`, `weight/K` | of every mode, nats, and 0 to 1 |
| `modes/number`, `modes/apart` | how many modes, and how many of them are unlike all better ones |
| `modes/effective` | `1 / sum w^2` |
| `events` | when the track was lost and found |

on the timelines `frame` (index in the video) and `time` (seconds). Modes have the colours that they
have in the overlay; opacity tells their weight relative to the best.

`open_recording` says where a recording goes. rerun is an optional package: the extra `viewer`.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float
from PIL import Image
from tqdm import tqdm

from torchcss.body.bases import on_origin, pose_track
from torchcss.body.model import BodyModel
from torchcss.body.rotations import quaternions
from torchcss.body.uncertainty import joint_covariance
from torchcss.errors import ConfigurationError, OutputError
from torchcss.files import one_line, prepare_output_folder, replace_file
from torchcss.io.export.selection import camera_up, up_axis
from torchcss.io.run import Run
from torchcss.io.tracks import FrameModes
from torchcss.show.overlay import PALETTE, palette_colour
from torchcss.show.style import DEVIATIONS
from torchcss.show.track_pictures import pictures_of
from torchcss.show.track_plots import EXPLANATION_M, bones_of, check_not_empty, count_apart
from torchcss.show.viewer_layout import layout, rerun, world_axes
from torchcss.types import ColourImage, as_array
from torchcss.vision.camera import Camera
from torchcss.vision.rasterise import grid_faces

if TYPE_CHECKING:
    import rerun as rr

APPLICATION = "torchcss"

_COUNTS = {
    "number": "modes",
    "apart": f"of these {100 * EXPLANATION_M:g} cm apart",
    "effective": "effective number",
}

_RINGS, _MERIDIANS = 9, 14
_FAINTEST, _SHAPE = 0.25, 0.35
"""Opacity of the lines of a mode that weighs nothing, and, relative to its lines, of the best
mode's parts."""
_BONE_RADIUS, _THREAD_RADIUS = 0.006, 0.0012
_PLANE = 0.3
"""Radius of the best mode's lines and of those of ellipsoids, metres; length of the frustum,
relative to the body's distance."""
_LARGEST_PICTURE = 1280
"""Longer side, pixels, to which larger pictures are reduced."""
_JPEG_QUALITY = 85
_FILE_CHUNKS_S = 5.0


class ShownFrame(NamedTuple):
    """One frame as a viewer shows it.

    Attributes:
        modes: Its modes, best first.
        picture: The frame with its modes drawn over it, or None.
        lost: Whether the track counts as lost.
    """

    modes: FrameModes
    picture: ColourImage | None = None
    lost: bool = False


def view_track(
    run: Run, *, save: Path | None = None, connect: str | None = None, anew: bool = False
) -> None:
    """Show a track, or save a recording of it.

    Args:
        run: The run.
        save: The recording to write; without it a viewer is opened.
        connect: Address of a viewer that runs, instead.
        anew: Whether to draw over the video even where the tracker left an overlay.

    Raises:
        TorchcssError: As `open_recording`; if the body is not known; if a picture cannot be read;
            if the recording cannot be written.
    """
    check_not_empty(run.track)
    track, camera = run.track, run.track.first_camera
    best = track.joints_world[:, 0]
    up, _ = up_axis(track.joint_names, best, track.base_transform, camera_up(camera))
    events = bool(run.summary.get("events"))
    if save is not None:
        prepare_output_folder(save.parent)
    with nullcontext() if save is None else replace_file(save) as partial:
        recording = open_recording(run.folder.resolve().name, save=partial, connect=connect)
        try:
            viewer = Viewer(recording, run.body, camera=camera, up=up, events=events)
            frames = shown_frames(run, anew=anew)
            for frame in tqdm(frames, total=len(track.frames), unit="frame", dynamic_ncols=True):
                viewer.add(frame)
        finally:
            close_recording(recording)


def shown_frames(run: Run, *, anew: bool = False) -> Iterator[ShownFrame]:
    """Yield the frames of a track, with pictures where there are any.

    Args:
        run: The run.
        anew: Whether to draw over the video even where the tracker left an overlay.
    """
    rows, lost = range(len(run.track.frames)), False
    pictures = pictures_of(run, rows, anew=anew)
    changes = {int(event["frame"]): event["event"] for event in run.summary.get("events", [])}
    for row in rows:
        modes = run.track.modes(row)
        lost = changes.get(modes.frame, "lost" if lost else "found") == "lost"
        yield ShownFrame(modes, next(pictures, (row, None))[1], lost)


def has_display() -> bool:
    """Whether a window can be opened here."""
    if sys.platform != "linux":
        return True
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def open_recording(
    name: str, *, save: Path | None = None, connect: str | None = None, spawn: bool | None = None
) -> rr.RecordingStream:
    """Start a recording that goes to a file, to a viewer, or to both.

    Args:
        name: What the viewer calls it.
        save: The file, usually `.rrd`; it grows as the recording does.
        connect: Address of a viewer that runs, such as `rerun+http://127.0.0.1:9876/proxy`; it
            prints its own when it starts.
        spawn: Whether to open a viewer here, or use the one that is open; by default if neither of
            the others is given.

    Raises:
        MissingExtraError: If rerun is not installed.
        ConfigurationError: If a viewer would have to be opened where there is no display, or the
            address is none.
        OutputError: If the file cannot be written.
    """
    package = rerun()
    spawn = spawn if spawn is not None else save is None and connect is None
    if spawn and not has_display():
        raise ConfigurationError(
            "there is no display here to open a viewer on; save a recording (--save FILE.rrd), and "
            "open it elsewhere with: rerun FILE.rrd"
        )
    sinks = []
    if save is not None:
        prepare_output_folder(save.parent)
        sinks.append(package.FileSink(str(save)))
    if connect is not None:
        sinks.append(_viewer_at(connect))
    # A file is read faster when rows come in large chunks; someone who watches wants them at once.
    watched = spawn or connect is not None
    chunks = None if watched else package.ChunkBatcherConfig(flush_tick=_FILE_CHUNKS_S)
    recording = package.RecordingStream(APPLICATION, batcher_config=chunks)
    # What a recording holds depends on the track alone.
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    if spawn:
        recording.spawn(connect=False)
        sinks.append(package.GrpcSink())
    try:
        recording.set_sinks(*sinks)
    except (RuntimeError, OSError) as error:
        raise OutputError(f"{save}: cannot be written: {one_line(error)}") from error
    recording.send_recording_name(name)
    return recording


def close_recording(recording: rr.RecordingStream) -> None:
    """Hand over what was logged, and end a recording.

    Args:
        recording: What `open_recording` gave; it may have been closed already.
    """
    # A viewer that was closed before the end is no reason to fail.
    with suppress(RuntimeError):
        recording.flush(timeout_sec=10.0)  # a viewer may not answer
    recording.disconnect()


def _viewer_at(address: str) -> object:
    try:
        return rerun().GrpcSink(address)
    except (RuntimeError, ValueError) as error:
        raise ConfigurationError(
            f"{address}: not the address of a viewer; expected one such as "
            "rerun+http://127.0.0.1:9876/proxy"
        ) from error


class Viewer:
    """Logs frames into a recording.

    Args:
        recording: Where to, see `open_recording`.
        body: The body, on any base.
        camera: The camera of the pictures; None: not known.
        up: Axis of the world that is up: x, y, z, -x, -y or -z.
        events: Whether to list when the track was lost and found.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        body: BodyModel,
        *,
        camera: Camera | None = None,
        up: str = "y",
        events: bool = True,
    ) -> None:
        self._recording, self._rr, self._log = recording, rerun(), recording.log
        self._body = body = on_origin(body)
        self._bones = np.array(bones_of(body), dtype=np.int64).reshape(-1, 2)
        self._camera = camera
        self._up = up
        self._events = events
        surface = body.mesh(_RINGS, _MERIDIANS)
        self._vertices = as_array(surface.points.flatten(1, 2))
        self._normals = as_array(surface.normals.flatten(1, 2))
        self._faces = grid_faces(_RINGS, _MERIDIANS).numpy()
        self._known = 0
        self._shown = 0
        self._lost = False

    def add(self, frame: ShownFrame) -> None:
        """Log a frame.

        Args:
            frame: The frame, later than the last.
        """
        modes = frame.modes
        pose = pose_track(self._body, modes.state, modes.base_transform)
        weight = modes.log_weight.softmax(0)
        joints, weight, cost = map(as_array, (pose.joints, weight, modes.cost))
        spread = as_array(joint_covariance(self._body, pose, modes.covariance))
        rotation, centre = map(as_array, self._body.part_poses(pose))
        if not self._known:
            self._begin(joints[0])
        self._recording.set_time("frame", sequence=modes.frame)
        self._recording.set_time("time", duration=modes.time_s)
        if frame.picture is not None:
            self._log("world/camera/picture", _jpeg(frame.picture))
        for mode in range(self._known, len(weight)):
            self._introduce(mode)
        self._known = max(self._known, len(weight))
        for mode in range(len(weight)):
            # Of a tracker that runs the first is the cheapest, not always the heaviest.
            share = min(float(weight[mode] / weight[0]), 1.0) if weight[0] > 0 else 1.0
            self._log_mode(mode, share, joints[mode], spread[mode], rotation[mode], centre[mode])
            nats = float(cost[mode]) if np.isfinite(cost[mode]) else np.nan
            self._log(f"cost/{mode}", self._rr.Scalars(nats))
            self._log(f"weight/{mode}", self._rr.Scalars(float(weight[mode])))
        for mode in range(len(weight), self._shown):
            self._hide_mode(mode)
        self._shown = len(weight)
        numbers = (len(weight), count_apart(joints), 1 / np.square(weight).sum())
        for name, number in zip(_COUNTS, numbers, strict=True):
            self._log(f"modes/{name}", self._rr.Scalars(float(number)))
        if frame.lost != self._lost:
            text = f"frame {modes.frame}: told {'lost' if frame.lost else 'found'}"
            level = self._rr.TextLogLevel.WARN if frame.lost else self._rr.TextLogLevel.INFO
            self._log("events", self._rr.TextLog(text, level=level))
        self._lost = frame.lost

    def _begin(self, best: Float[np.ndarray, "j 3"]) -> None:
        """Log what does not change, and how the viewer is to be laid out."""
        self._log("world", world_axes(self._up), static=True)
        if self._camera is not None:
            self._log_camera(self._camera, best)
        for (name, label), colour in zip(_COUNTS.items(), PALETTE, strict=False):
            line = self._rr.SeriesLines(colors=colour, names=label, widths=2.0)
            self._log(f"modes/{name}", line, static=True)
        self._recording.send_blueprint(layout(best, self._camera, self._up, events=self._events))

    def _introduce(self, mode: int) -> None:
        """Log what does not change of a mode."""
        for name, vertices, normals in zip(
            self._body.part_names, self._vertices, self._normals, strict=True
        ):
            mesh = self._rr.Mesh3D(
                vertex_positions=vertices, vertex_normals=normals, triangle_indices=self._faces
            )
            self._log(f"world/modes/{mode}/body/{name}", mesh, static=True)
        line = self._rr.SeriesLines(
            colors=palette_colour(mode),
            names="best mode" if mode == 0 else f"mode {mode + 1}",
            widths=2.5 if mode == 0 else 1.2,
        )
        for series in ("cost", "weight"):
            self._log(f"{series}/{mode}", line, static=True)

    def _log_camera(self, camera: Camera, joints: Float[np.ndarray, "j 3"]) -> None:
        camera = _reduced(camera)
        turn = as_array(camera.R_camera_world).T
        centre = as_array(camera.centre_world)
        K = as_array(camera.K).copy()
        K[:2, 2] += 0.5  # the viewer counts pixels from the picture's corner, we from a centre
        self._log(
            "world/camera", self._rr.Transform3D(translation=centre, mat3x3=turn), static=True
        )
        pinhole = self._rr.Pinhole(
            image_from_camera=K,
            resolution=camera.image_size_wh,
            camera_xyz=self._rr.ViewCoordinates.RDF,
            image_plane_distance=_PLANE * float(np.linalg.norm(joints.mean(0) - centre)),
        )
        self._log("world/camera", pinhole, static=True)

    def _log_mode(
        self,
        mode: int,
        share: float,
        joints: Float[np.ndarray, "j 3"],
        covariance: Float[np.ndarray, "j 3 3"],
        rotation: Float[np.ndarray, "p 3 3"],
        centre: Float[np.ndarray, "p 3"],
    ) -> None:
        """Log the joints and the parts of a mode, which weighs `share` as much as the best."""
        path = f"world/modes/{mode}"
        opacity = _FAINTEST + (1 - _FAINTEST) * share
        colour = _colour(mode, opacity)
        thickness = 1.0 if mode == 0 else 0.7
        strips = self._rr.LineStrips3D(
            joints[self._bones], colors=colour, radii=thickness * _BONE_RADIUS
        )
        self._log(f"{path}/skeleton", strips)
        fill = self._rr.components.FillMode
        half_sizes, quaternions = ellipsoids(covariance)
        shapes = self._rr.Ellipsoids3D(
            centers=joints,
            half_sizes=half_sizes,
            quaternions=quaternions,
            colors=colour,
            line_radii=_THREAD_RADIUS,
            # A mode of little weight may be very uncertain: filled, it would hide all others.
            fill_mode=fill.TransparentFillMajorWireframe if mode == 0 else fill.MajorWireframe,
        )
        self._log(f"{path}/uncertainty", shapes)
        surface = self._rr.Mesh3D.from_fields(albedo_factor=_colour(mode, _SHAPE * share * opacity))
        for name, turn, place in zip(self._body.part_names, rotation, centre, strict=True):
            at = self._rr.Transform3D(translation=place, mat3x3=turn)
            self._log(f"{path}/body/{name}", at, surface)

    def _hide_mode(self, mode: int) -> None:
        """From here on there is no such mode."""
        for name in ("skeleton", "uncertainty"):
            self._log(f"world/modes/{mode}/{name}", self._rr.Clear(recursive=False))
        # Meshes do not change and cannot be cleared: they become invisible.
        for name in self._body.part_names:
            hidden = self._rr.Mesh3D.from_fields(albedo_factor=(0, 0, 0, 0))
            self._log(f"world/modes/{mode}/body/{name}", hidden)
        for series in ("cost", "weight"):
            self._log(f"{series}/{mode}", self._rr.Scalars(np.nan))


def _colour(mode: int, opacity: float) -> tuple[int, ...]:
    return (*palette_colour(mode), round(255 * opacity))


def ellipsoids(
    covariance: Float[np.ndarray, "j 3 3"],
) -> tuple[Float[np.ndarray, "j 3"], Float[np.ndarray, "j 4"]]:
    """Half-axes, metres, and orientations (x y z w) of the ellipsoids of covariances.

    Args:
        covariance: Covariances of points, square metres.
    """
    values, axes = np.linalg.eigh(covariance)
    # Eigenvectors may form a mirrored frame, which no rotation is.
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    return DEVIATIONS * np.sqrt(values.clip(min=0)), np.roll(quaternions(axes), -1, axis=-1)


def _reduced(camera: Camera) -> Camera:
    """The camera of the pictures as they are saved."""
    width, height = camera.image_size_wh
    factor = min(1.0, _LARGEST_PICTURE / max(width, height))
    return camera.resized(max(round(factor * width), 1), max(round(factor * height), 1))


def _jpeg(picture: ColourImage) -> rr.EncodedImage:
    image = Image.fromarray(picture)
    image.thumbnail((_LARGEST_PICTURE, _LARGEST_PICTURE))
    stream = io.BytesIO()
    image.save(stream, "JPEG", quality=_JPEG_QUALITY)
    return rerun().EncodedImage(contents=stream.getvalue(), media_type="image/jpeg")

"""Which modes and frames of a track go into a file, and in which frame of reference.

A mode of the track is its rank in every frame, the best first; or, followed, the ancestors of the
mode of that rank in the last frame. Where a frame has fewer modes, the file's format decides what
stands there: nothing where that can be said, else the pose of the frame before.

The world of a track is that of its camera file, whatever its up axis. Formats of animation and
biomechanics want Y up: the world is then turned by quarter turns, so that the body's mean upward
direction (beside that of the picture), or the axis that the caller names, becomes Y; or Z, for the
laboratories of C3D.

Call `select`.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int

from torchcss.body.uncertainty import Held
from torchcss.errors import ConfigurationError, VideoError
from torchcss.io.tracks import Track
from torchcss.io.video import VideoReader, usual_step
from torchcss.types import TIME_ROUNDING, as_array, frozen
from torchcss.vision.camera import Camera

DEFAULT_FRAME_RATE = 25.0
"""Frames per second where neither times nor a video tell."""

_TO_Y_UP: dict[str, tuple[tuple[int, int, int], ...]] = {
    # Z up: the cyclic exchange, file's (X, Y, Z) = world's (y, z, x), as Pose2Sim writes TRC files.
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "z": ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "x": ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
}
UP_AXES = ("x", "y", "z", "-x", "-y", "-z")

FrameOfFile = Literal["world", "y-up", "z-up"]
"""The track's world as it is, or turned so that this axis is up."""


class Selection(NamedTuple):
    """The chosen modes m of the chosen frames t, in the file's frame of reference.

    Attributes:
        frames: Index in the video.
        times: Seconds since the video's first frame.
        rate: Frames per second.
        labels: What each mode is called in file names.
        rank: Rank of the mode in the frame; -1 where the frame has no such mode.
        log_weight: `-inf` where absent.
        cost: Nats, `inf` where absent.
        parent: Rank in the track's frame before, -1 for none.
        state_names: Names of the parameters.
        state: Means; of the nearest frame (before, else after) where absent.
        covariance: Covariances, zero where absent.
        joint_names: Names of the joints.
        joints: Joint centres, metres, NaN where absent.
        base: Base transforms that the states stand on.
        turn: The file's frame from the world's.
        upright: Orientation, in the file's frame, of a body that stands facing somewhere.
        held: What the covariances hold for known and is not, in the file's frame.
        report: What was decided, one line each.
    """

    frames: Int[np.ndarray, " t"]
    times: Float[np.ndarray, " t"]
    rate: float
    labels: tuple[str, ...]
    rank: Int[np.ndarray, "t m"]
    log_weight: Float[np.ndarray, "t m"]
    cost: Float[np.ndarray, "t m"]
    parent: Int[np.ndarray, "t m"]
    state_names: tuple[str, ...]
    state: Float[np.ndarray, "t m n"]
    covariance: Float[np.ndarray, "t m n n"]
    joint_names: tuple[str, ...]
    joints: Float[np.ndarray, "t m j 3"]
    base: Float[np.ndarray, "t m 4 4"]
    turn: Float[np.ndarray, "3 3"]
    upright: Float[np.ndarray, "3 3"]
    held: Held | None
    report: tuple[str, ...]

    @property
    def present(self) -> np.ndarray:
        """Where the frame has the mode, `[t m]`."""
        return self.rank >= 0


@frozen
class SelectionChoice:
    """Which modes and frames go into a file, and what is up.

    Attributes:
        mode: best, a rank in every frame (0 is the best), or all: one file each, or one table.
        follow: Take the ancestors of the modes of the last frame instead of each frame's ranks.
        start: First frame, counted as in the video.
        stop: Frame before which to end.
        stride: Take every so many of the track's frames.
        world_up: Which axis of the world is up; auto: the one nearest to the mean upward direction
            of the body and the pictures, or, for an arm or a robot, of the pictures.
    """

    mode: Literal["best", "all"] | int = "best"
    follow: bool = False
    start: int | None = None
    stop: int | None = None
    stride: int = 1
    world_up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"


def select(
    track: Track, choice: SelectionChoice | None = None, *, frame: FrameOfFile = "world"
) -> Selection:
    """Choose modes and frames, and turn them into the file's frame of reference.

    Args:
        track: The track.
        choice: Which of its modes and frames.
        frame: The file's frame of reference.

    Raises:
        ConfigurationError: If the choice makes no sense, or no frame or mode is left.
    """
    choice = choice or SelectionChoice()
    _check(choice)
    inside = _frames_inside(track, choice)
    report: list[str] = []
    kept = inside[:: choice.stride]
    wanted, ranks = _ranks(track, choice, inside)
    labels = ("",) if choice.mode == "best" else tuple(f"mode{rank}" for rank in wanted)
    for label, missing in zip(labels, (ranks < 0).sum(axis=0), strict=True):
        if missing:
            report.append(f"{label or 'best mode'}: absent in {missing} of {len(kept)} frames")
    turn, upright = _frame_of_file(track, frame, choice.world_up, report)
    rate = _rate(track, kept, report)

    present = ranks >= 0
    # Where each pose is from: its own frame, or the nearest that has the mode.
    source = _nearest_present(present)
    nearest = (kept[source], ranks[source, np.arange(len(wanted))])
    own = (kept[:, None], np.where(present, ranks, 0))
    change = np.eye(4)
    change[:3, :3] = turn
    joints = np.where(present[..., None, None], track.joints_world[own], np.nan)
    return Selection(
        frames=track.frames[kept],
        times=track.times[kept],
        rate=rate,
        labels=labels,
        rank=ranks,
        log_weight=np.where(present, track.log_weight[own], -np.inf),
        cost=np.where(present, track.cost[own], np.inf),
        parent=np.where(present, track.parent[own], -1),
        state_names=track.state_names,
        state=track.state[nearest],
        covariance=np.where(present[..., None, None], track.covariance[own], 0.0),
        joint_names=track.joint_names,
        joints=joints @ turn.T,
        base=change @ track.base_transform[nearest[0]],
        turn=turn,
        upright=upright,
        held=track.held and track.held.turned(torch.from_numpy(turn)),
        report=tuple(report),
    )


def _frames_inside(track: Track, choice: SelectionChoice) -> np.ndarray:
    """Rows of the track from `start` to `stop`."""
    start, stop, frames = choice.start, choice.stop, track.frames
    after = frames >= (-np.inf if start is None else start)
    inside = after & (frames < (np.inf if stop is None else stop))
    if not inside.any():
        known = f"the frames {frames[0]} to {frames[-1]}" if frames.size else "no frames"
        raise ConfigurationError(
            f"no frames to export: start {start} and stop {stop}, the track has {known}"
        )
    return np.flatnonzero(inside)


def _check(choice: SelectionChoice) -> None:
    if choice.world_up not in ("auto", *UP_AXES):
        raise ConfigurationError(
            f"world_up: expected auto or {', '.join(UP_AXES)}, got {choice.world_up}"
        )
    if choice.stride < 1:
        raise ConfigurationError(f"stride: expected at least 1, got {choice.stride}")
    rank = isinstance(choice.mode, (int, np.integer)) and not isinstance(choice.mode, bool)
    if choice.mode not in ("best", "all") and not (rank and int(choice.mode) >= 0):
        raise ConfigurationError(
            f"mode: expected best, all or a number from 0, got {choice.mode!r}"
        )


def _ranks(
    track: Track, choice: SelectionChoice, inside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The wanted ranks `[m]`, and which of the modes that is in every kept frame `[t m]`."""
    kept = inside[:: choice.stride]
    if choice.mode == "all":
        ends = inside[-1:] if choice.follow else inside  # modes of the last frame are followed
        wanted = np.arange(track.num_modes[ends].max(initial=0))
    else:
        wanted = np.array([0 if choice.mode == "best" else int(choice.mode)])
    if choice.follow:
        ranks = _followed(track, wanted, inside)[:: choice.stride]
    else:
        ranks = np.where(wanted < track.num_modes[kept, None], wanted, -1)
    seen = (ranks >= 0).any(axis=0)
    if not seen.all() or not seen.size:
        where = "the last chosen frame lacks it" if choice.follow else "no chosen frame has it"
        raise ConfigurationError(
            f"mode {wanted[np.argmin(seen)] if seen.size else 0}: {where}; the track has up to "
            f"{track.num_modes[kept].max(initial=0)} modes, counted from 0"
        )
    return wanted, ranks


def _followed(track: Track, wanted: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Ranks of the ancestors of the wanted modes of the last of the frames, `[t m]`."""
    ranks = np.full((len(inside), len(wanted)), -1)
    current = np.where(wanted < track.num_modes[inside[-1]], wanted, -1)
    for row in range(len(inside) - 1, -1, -1):
        ranks[row] = current
        current = np.where(current >= 0, track.parent[inside[row], current], -1)
    return ranks


def _nearest_present(present: np.ndarray) -> np.ndarray:
    """Per frame and mode: the last frame up to it that has the mode, else the first that has."""
    rows = np.where(present, np.arange(len(present))[:, None], -1)
    before = np.maximum.accumulate(rows, axis=0)
    return np.where(before >= 0, before, np.argmax(present, axis=0))


def _frame_of_file(
    track: Track, frame: FrameOfFile, world_up: str, report: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """The file's frame from the world's, and a standing body's orientation in it."""
    axis = world_up
    if world_up == "auto":
        picture_up = camera_up(track.first_camera)
        # Of all frames, also those that are left out: parts of one track stand in one frame.
        axis, agreement = up_axis(
            track.joint_names, track.joints_world[:, 0], track.base_transform, picture_up
        )
        tells = set(_UPRIGHT) <= set(track.joint_names)
        what = "body's mean" if tells else "base's" if picture_up is None else "picture's upward"
        angle = np.degrees(np.arccos(min(agreement, 1.0)))
        if frame != "world":
            report.append(
                f"the world's {axis} axis is taken for up (the {what} direction is "
                f"{angle:.0f} degrees from it); set the axis with --world-up (world_up)"
            )
    to_y_up = np.array(_TO_Y_UP[axis], dtype=np.float64)
    from_y_up = np.array(_TO_Y_UP[{"y-up": "y", "z-up": "z", "world": axis}[frame]]).T
    return from_y_up @ to_y_up, from_y_up


_UPRIGHT = ("HumanoidRoot", "skull_tip")
"""Joints of which the second is above the first in a standing body."""


def up_axis(
    joint_names: Sequence[str],
    joints: Float[np.ndarray, "t j 3"],
    base: Float[np.ndarray, "t 4 4"],
    picture_up: Float[np.ndarray, "3"] | None = None,
) -> tuple[str, float]:
    """Which axis of the world is up, and the cosine of its angle to the body's upward direction.

    That is the mean direction from the hips to the head, or, for a body without, the one given. A
    body that bends over does not tell alone: what is up in the picture counts half as much.

    Args:
        joint_names: Names of the joints.
        joints: Joint centres, world frame.
        base: World from the frame in which the root moves.
        picture_up: What is up in the picture, world frame; None: not known. Where neither body nor
            picture tells, it is up the base.
    """
    names = list(joint_names)
    low, high = _UPRIGHT
    if low in names and high in names:
        up = (joints[:, names.index(high)] - joints[:, names.index(low)]).mean(0)
    else:
        up = base[:, :3, 1].mean(0) if picture_up is None else picture_up
    length = float(np.linalg.norm(up))
    up = up / length if length > 0 else np.array([0.0, 1.0, 0.0])
    both = up if picture_up is None else up + 0.5 * picture_up
    axis = max(UP_AXES, key=lambda name: float(np.array(_TO_Y_UP[name][1]) @ both))
    return axis, float(np.array(_TO_Y_UP[axis][1]) @ up)


def _rate(track: Track, kept: np.ndarray, report: list[str]) -> float:
    """Frames per second, made whole where it is so but for the rounding of the times."""
    times = track.times[kept] if len(kept) > 1 else track.times
    steps = np.diff(times)
    if not steps.size or not (steps > 0).all():
        rate, said = _rate_of_video(track), "that of its video or pictures"
        if rate is None:
            rate, said = DEFAULT_FRAME_RATE, "neither the track nor a video tells one"
        report.append(f"a frame rate of {rate:g} is written: {said}")
        return rate
    step = float(times[-1] - times[0]) / len(steps)
    if (np.abs(steps - step) > max(TIME_ROUNDING, 0.01 * step)).any():
        step = usual_step(steps)
        report.append(
            f"the frames are not evenly spaced in time ({1000 * steps.min():.1f} to "
            f"{1000 * steps.max():.1f} ms): columns of times have each one's own, a single frame "
            f"rate is that of {1000 * step:.1f} ms"
        )
    rate = 1.0 / step
    return float(round(rate)) if abs(rate - round(rate)) < 1e-6 * rate else rate


def _rate_of_video(track: Track) -> float | None:
    """Frames per second of the first camera's video; None where there is none any more."""
    files = track.first_files
    if files is None:
        return None
    with suppress(VideoError):
        return float(VideoReader(files.video, image_frame_rate=files.frame_rate).info.frame_rate)
    return None


def camera_up(camera: Camera | None) -> np.ndarray | None:
    """The direction in the world that is up in the picture; None without a camera."""
    return None if camera is None else -as_array(camera.R_camera_world[1])

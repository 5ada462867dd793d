"""A finished track in the rerun viewer; what is shown is in `torchcss.show.viewer`.

Call `view_track`, which `torchcss view` does.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from torchcss.files import prepare_output_folder, replace_file
from torchcss.io.export.selection import camera_up, up_axis
from torchcss.io.track_body import pose_track
from torchcss.show.track_pictures import TrackFiles, pictures_of
from torchcss.show.viewer import (
    PosedFrame,
    Viewer,
    close_recording,
    open_recording,
    posed_frame,
)


def view_track(files: TrackFiles, *, save: Path | None = None, connect: str | None = None) -> None:
    """Show a track, or save a recording of it.

    Args:
        files: The track with what belongs to it.
        save: The recording to write; without it a viewer is opened.
        connect: Address of a viewer that runs, instead.

    Raises:
        TorchcssError: As `open_recording`; if a picture cannot be read; if the recording cannot be
            written.
    """
    if save is None:
        _replay(files, None, connect)
        return
    prepare_output_folder(save.parent)
    with replace_file(save) as partial:
        _replay(files, partial, connect)


def posed_frames(files: TrackFiles) -> Iterator[PosedFrame]:
    """Yield the frames of a track, with pictures where there are any.

    Args:
        files: The track.
    """
    track = files.track
    rows = np.flatnonzero(track.num_modes > 0)
    pictures = pictures_of(files, rows)
    changes = {int(event["frame"]): event["event"] for event in files.summary.get("events", [])}
    lost = False
    for row in rows:
        count = int(track.num_modes[row])
        pose = pose_track(
            files.body,
            torch.from_numpy(track.state[row, :count]),
            torch.from_numpy(track.base_transform[row]).expand(count, 4, 4),
        )
        index = int(track.frames[row])
        lost = changes[index] == "lost" if index in changes else lost
        _, picture = next(pictures, (row, None))
        yield posed_frame(
            index,
            float(track.times[row]),
            files.body,
            pose,
            covariance=torch.from_numpy(track.covariance[row, :count]),
            weight=torch.from_numpy(track.log_weight[row, :count]).softmax(0),
            cost=torch.from_numpy(track.cost[row, :count]),
            picture=picture,
            lost=lost,
        )


def _replay(files: TrackFiles, save: Path | None, connect: str | None) -> None:
    track = files.track
    best = track.joints_world[:, 0]
    up, _ = up_axis(track.joint_names, best, track.base_transform, camera_up(files.camera))
    name = files.path.resolve().parent.name
    recording = open_recording(name, save=save, connect=connect)
    try:
        viewer = Viewer(
            recording,
            files.body,
            camera=files.camera,
            up=up,
            events=bool(files.summary.get("events")),
        )
        frames = posed_frames(files)
        for frame in tqdm(frames, total=len(track.frames), unit="frame", dynamic_ncols=True):
            viewer.add(frame)
    finally:
        close_recording(recording)

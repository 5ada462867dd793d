"""What MediaPipe's 3D landmarks err by on clips with truth: a peer for `evaluate_posterior.py`.

    python scripts/evaluate_peers.py --data clips --detector-model pose_landmarker_full.task

DIR holds clips as for `scripts/evaluate_posterior.py`; of each the video is all that the peer sees.
Its landmarks are in metres, from the middle of the hips, in the camera's axes: they are turned into
the world with the true camera, and nothing else is told to it. Errors are those of the other
script: PA after Procrustes, root with the hips on each other, millimetres, means over the limbs'
twelve joints and the frames in which somebody was found. With `--runs`, the runs that
`evaluate_posterior.py` has left there are measured on the same frames.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from common import Table, finish, start
from evaluate_posterior import find_clips

from torchcss import Run, read_camera, read_keypoints
from torchcss.app.detect import DetectOptions, detect_video
from torchcss.io.keypoints.arrays import read_points
from torchcss.joint_names import LIMB_JOINTS
from torchcss.studies.metrics import pa_mpjpe_mm, root_aligned_mpjpe_mm
from torchcss.studies.sequences import read_reference
from torchcss.types import frozen

HEADS = ("clip", "frames", "found", "PA", "root", "css PA", "of 7", "css root", "of 7")


@frozen
class Config:
    """Which clips."""

    data: Path
    """Folder of the clips, or of one."""
    detector_model: Path
    """The detector's networks."""
    runs: Path | None = None
    """Folder of the runs of `evaluate_posterior.py`."""
    frames: int | None = None
    """Only the first frames of each clip."""
    out: Path | None = None
    """JSON file to write."""


def landmarks(clip: Path, config: Config) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """The peer's joints in the world's axes `[t j 3]`, where it found somebody, and their names."""
    video, camera = clip / "video.mp4", read_camera(clip / "cameras.json")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "keypoints.npz"
        options = DetectOptions(detector_model=config.detector_model)
        detect_video(video, file, options, stop=config.frames)
        first = int(np.load(file)["confidence"].sum((1, 2)).argmax())
        found = read_keypoints(file, image_size_wh=camera.image_size_wh, first_frame=first)
        found = read_points(file, found)
    assert found.points is not None
    turn = camera.R_camera_world.double().numpy()
    return found.points.double().numpy() @ turn, found.confidence.sum(1).numpy() > 0, found.names


def errors(places: np.ndarray, true: np.ndarray, names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """PA and root-aligned error of every frame (and mode)."""
    true = np.broadcast_to(true, places.shape)
    return pa_mpjpe_mm(places, true), root_aligned_mpjpe_mm(places, true, names)


def measure(config: Config, clip: Path) -> list[Any]:
    """A row of the table."""
    true, all_names = read_reference(clip / "reference3d.npz")
    peer, found, peer_names = landmarks(clip, config)
    names = [name for name in LIMB_JOINTS if name in all_names and name in peer_names]
    known = true[:, [list(all_names).index(name) for name in names]]
    peer = peer[:, [peer_names.index(name) for name in names]]
    num = len(found) if config.frames is None else min(config.frames, len(found))
    frames = np.flatnonzero(found[:num] & np.isfinite(known[:num]).all((1, 2)))
    pa, root = errors(peer[frames], known[frames], names)
    row: list[Any] = [clip.name, num, len(frames), pa.mean(), root.mean()]
    if config.runs is None:
        return [*row, *[None] * 4]
    done = sorted((config.runs / clip.name).glob("*/summary.json"))
    ours = [of_run(Run.open(file.parent), known, frames, names) for file in done]
    return [*row, *np.mean(ours, axis=0).tolist()]


def of_run(run: Run, known: np.ndarray, frames: np.ndarray, names: list[str]) -> list[float]:
    """PA and root of the leading mode and of the best one, on some frames."""
    track = run.track
    rows = np.flatnonzero(np.isin(track.frames, frames))
    places = track.joints_world[rows][:, :, [track.joint_names.index(name) for name in names]]
    there = np.isfinite(track.log_weight[rows])
    both = errors(np.nan_to_num(places), known[track.frames[rows], None], names)
    best = [np.where(there, each, np.inf).min(1).mean() for each in both]
    return [both[0][:, 0].mean(), best[0], both[1][:, 0].mean(), best[1]]


def main(config: Config) -> dict[str, Any]:
    """Detect, measure, print, write; return what is written."""
    rows = [measure(config, clip) for clip in find_clips(config.data)]
    cells = list(rows)
    for name, middle in (("median", np.median), ("mean", np.mean)):
        columns = zip(*(row[3:] for row in rows), strict=True)
        summed = [None if None in column else float(middle(column)) for column in columns]
        cells.append([name, None, None, *summed])
    table = Table("MediaPipe's 3D landmarks", HEADS, cells)
    return finish(config.out, {"frames": config.frames, "rows": rows}, table)


if __name__ == "__main__":
    start(main, Config, __doc__)

"""One camera against several: what a second view does to errors and to the depth that is unsure.

    python scripts/several_views.py --data DIR --out J

DIR is the folder of recordings. Two of them were filmed by synchronised, calibrated cameras:

- `balance_beam_4cam`, a person, 2D joints of a detector in all frames: tracked by `track_video`
  from each camera alone and from both, against triangulated joints.
- `handheld_board`, a printed board with twelve corners, held in the hands before two webcams of six
  frames per second: a rigid body with a free root, tracked from its corners.

For each set of cameras: errors in millimetres, across the first camera's line of sight and along
it, beside the standard deviations that the tracker states there, and how often the truth lies
within the regions of 50 and 90 % that it states. Deviations shrink as they should if the errors
shrink with them, and the shares stay.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from common import Table, finish, start
from jaxtyping import Float
from torch import Tensor

from torchcss.app.track import TrackOptions, track_video
from torchcss.body.catalog import BodySpecification, MarkerSpecification, root_joints
from torchcss.body.model import BodyModel
from torchcss.body.root import move_base, root_pose
from torchcss.body.uncertainty import joint_covariance
from torchcss.cli.options import SettingsOptions
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.joints import JointTerm
from torchcss.cost.total import TrackingCost
from torchcss.errors import TorchcssError
from torchcss.files import load_arrays
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.initialise.outliers import best_distinct
from torchcss.initialise.result import Initialisation
from torchcss.initialise.view import CameraView
from torchcss.io.cameras import read_camera
from torchcss.io.video import VideoReader
from torchcss.io.view_files import ViewFiles
from torchcss.linalg import squared_mahalanobis
from torchcss.studies.evaluation import evaluate
from torchcss.studies.metrics import (
    coverage,
    probability_within,
)
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import Settings
from torchcss.types import Keypoints, frozen
from torchcss.vision.camera import Camera

BEAM, BOARD = "balance_beam_4cam", "handheld_board"
CORNER_NOISE_PX = 1.2
"""Reprojection error of the board's corners (its README), which have no other measure of noise."""
REFERENCE_M = {BEAM: 0.02, BOARD: 0.0027}
"""What the reference itself is good to, standard deviation in metres (the recordings' READMEs)."""
TRACKING = Settings()
"""How this script tracks, where nothing else is said."""


@frozen
class Config:
    """Which recordings, and how long."""

    data: Path
    """Folder of the recordings."""
    what: tuple[Literal["balance_beam_4cam", "handheld_board"], ...] = (BEAM, BOARD)
    """Which of them."""
    frames: int | None = None
    """Frames from the start; all by default."""
    beam_cameras: tuple[str, ...] = ("cam01", "cam03", "cam01+cam03")
    """Cameras of the person, each entry tracked by itself."""
    tracking: SettingsOptions = TRACKING
    """How to track. The board has its own body and terms, 40 samples and 3 modes where no numbers
    are given, and features 1280 pixels wide."""
    tracks: Path = Path("out/several_views")
    """Folder for the person's tracks."""
    out: Path | None = None
    """JSON file to write."""


@dataclass
class Sums:
    """Errors and stated uncertainties, point by point.

    Attributes:
        error: Tracked minus true position, metres, in the axes of the first camera.
        covariance: Stated, in the same axes.
    """

    error: list[Tensor] = field(default_factory=list)
    covariance: list[Tensor] = field(default_factory=list)

    def add(
        self,
        away: Float[Tensor, "j 3"],
        covariance: Float[Tensor, "j 3 3"],
        camera: Camera,
    ) -> None:
        """Take in the points of a frame, in the world's axes; those not known are NaN."""
        turn = camera.R_camera_world.double()
        known = away.isfinite().all(-1)
        self.error.append(away[known] @ turn.T)
        self.covariance.append(turn @ covariance[known] @ turn.T)

    def report(self, reference_m: float) -> dict[str, Any]:
        """The numbers of a row, millimetres."""
        error, covariance = torch.cat(self.error), torch.cat(self.covariance)
        stated = covariance.diagonal(dim1=-2, dim2=-1)
        row = {
            "across_mm": 1000 * float(error[:, :2].square().mean().sqrt()),
            "along_mm": 1000 * float(error[:, 2].square().mean().sqrt()),
            "stated_across_mm": 1000 * float(stated[:, :2].mean().sqrt()),
            "stated_along_mm": 1000 * float(stated[:, 2].mean().sqrt()),
        }
        own = reference_m**2 * torch.eye(3, dtype=covariance.dtype)
        distance = squared_mahalanobis(error, covariance + own)
        shares = coverage(probability_within(distance.numpy(), 3), (0.5, 0.9))
        return row | {f"inside_{round(100 * p)}": share for p, share in shares.items()}


def main(config: Config) -> dict[str, Any]:
    """Track, measure, print, write; return what is written."""
    report: dict[str, Any] = {}
    for name, study in ((BEAM, person), (BOARD, board)):
        if name in config.what:
            report[name] = study(config, config.data / name)
    return finish(config.out, report, table_of(report))


def person(config: Config, folder: Path) -> dict[str, Any]:
    """The person on the beam, from each camera and from both."""
    rows: dict[str, Any] = {}
    for row_name in config.beam_cameras:
        views = row_name.split("+")
        files = [
            ViewFiles(video=folder / f"{v}.mp4", keypoints=folder / f"keypoints2d_{v}.npz")
            for v in views
        ]
        assert files[0].keypoints is not None
        out = config.tracks / "+".join(views)
        run = track_video(
            files[0].video, camera=folder / "cameras.json", keypoints=files[0].keypoints, out=out,
            stop=config.frames, settings=config.tracking, options=TrackOptions(others=files[1:]),
        )  # fmt: skip
        found = evaluate(out, folder / "reference3d.npz")
        errors = found.errors
        assert found.covariance is not None
        # One camera's depth is wrong by the person's size; their shape is what can be compared.
        camera = read_camera(folder / "cameras.json", views[0])
        sums = Sums()
        for away, spread in zip(found.away_m, found.covariance, strict=True):
            sums.add(torch.from_numpy(away), torch.from_numpy(spread), camera)
        rows[" + ".join(views)] = {
            "absolute_mm": errors.absolute.mean_mm,
            "root_aligned_mm": errors.root_aligned.mean_mm,
            "root_aligned_best_of_modes_mm": errors.root_aligned_best_of_modes.mean_mm,
            "pa_mm": errors.procrustes.mean_mm,
            "frames": len(found.frames),
            "frames_lost": int(errors.lost.sum()),
            "seconds_per_frame": run.summary["seconds_per_frame"],
            **sums.report(REFERENCE_M[BEAM]),
        }
    return rows


def board(config: Config, folder: Path) -> dict[str, Any]:
    """The board, from each webcam and from both."""
    reference = load_arrays(folder / "board_reference.npz", TorchcssError)
    truth, corners = torch.from_numpy(reference["corners_world"]), reference["corners_board"]
    body = board_body(corners)
    text = json.loads((folder / "cameras.json").read_text())
    pixels = {
        name: load_arrays(folder / f"corners2d_{name}.npz", TorchcssError)["corners_px"]
        for name in ("cam_0", "cam_2")
    }
    times = text["cameras"]["cam_0"]["frame_times_s"]
    interval = float(np.diff(times).mean())
    start = next(
        i for i in range(len(truth)) if all(np.isfinite(m[i]).all() for m in pixels.values())
    )
    stop = len(truth) if config.frames is None else min(len(truth), start + config.frames)
    # The session tracks the body it is given; the name says that it moves about, as people do.
    settings = replace(
        config.tracking, body="body34", terms=("joints", "temporal"), working_size=1280,
        samples=config.tracking.samples or 40, modes=config.tracking.modes or 3,
    )  # fmt: skip
    rows: dict[str, Any] = {}
    for views in (("cam_0",), ("cam_2",), ("cam_0", "cam_2")):
        cameras = [read_camera(folder / "cameras.json", v) for v in views]
        seen = [
            CameraView(camera, corner_keypoints(body, pixels[view]), CORNER_NOISE_PX)
            for view, camera in zip(views, cameras, strict=True)
        ]
        readers = [VideoReader(folder / f"{view}.mp4", start=start, stop=stop) for view in views]
        generator = torch.Generator().manual_seed(settings.seed)
        placed, mixture = place(body, seen, start, generator)
        session = TrackingSession(
            settings,
            Initialisation(placed, mixture, torch.zeros(len(mixture.mean)).double(), ()),
            seen,
            frame_interval=interval,
            generator=generator,
        )
        sums, errors = Sums(), []
        for tracked in session.track(zip_longest(*readers)):
            joints = tracked.joints_world[0]
            away = joints - truth[tracked.frame.index]
            pose = tracked.body.pose(tracked.state.mixture.mean[:1])
            spread = joint_covariance(tracked.body, pose, tracked.covariance[:1])[0]
            sums.add(away, spread, cameras[0])
            errors.append(float(away.norm(dim=-1).nanmean()))
        rows[" + ".join(views)] = {
            "absolute_mm": 1000 * float(np.nanmean(errors)),
            "worst_frame_mm": 1000 * float(np.nanmax(errors)),
            "frames": len(errors),
            **sums.report(REFERENCE_M[BOARD]),
        }
    return rows


def board_body(corners: Float[np.ndarray, "m 3"]) -> BodyModel:
    """A rigid body whose joint centres are the corners of a board."""
    joints = root_joints()
    return BodyModel(
        BodySpecification(
            name="board",
            joints=joints,
            parts=(),
            markers=tuple(
                MarkerSpecification(
                    name=f"corner_{i}", link=joints[-1].link, translation=tuple(place)
                )
                for i, place in enumerate(corners.tolist())
            ),
            ties={},
            sticky={},
            neighbours=(),
            lengths={},
        )
    )


def corner_keypoints(body: BodyModel, corners: Float[np.ndarray, "t m 2"]) -> Keypoints:
    """Corners of all frames as keypoints."""
    place = torch.from_numpy(corners)
    seen = place.isfinite().all(-1).double()
    return Keypoints(place, seen, body.joint_names)


def place(
    body: BodyModel, views: Sequence[CameraView], start: int, generator: torch.Generator
) -> tuple[BodyModel, GaussianMixture]:
    """Find the board in the first frame, from random turns before the first camera."""
    seen = [view.keypoints.at(start) for view in views if view.keypoints is not None]
    middle = seen[0].positions[seen[0].confidence > 0].mean(0)
    # An arm's length away; how far exactly, the descent finds.
    body = body.with_base(
        torch.eye(3).double(), views[0].camera.unproject(middle, middle.new_tensor(0.8))
    )
    x = torch.zeros(100, body.num_parameters, dtype=torch.float64)
    x[:, 3:] = 3.0 * torch.randn(100, 3, generator=generator, dtype=torch.float64).clamp(-1, 1)
    modes = None
    for scale in (30.0, 6.0, 1.0):
        cost = TrackingCost(
            choice=CostChoice(terms=(JointTerm(sigma=scale * CORNER_NOISE_PX),)),
            views=tuple(
                FrameContext(body=body, camera=view.camera, keypoints=keypoints)
                for view, keypoints in zip(views, seen, strict=True)
            ),
        )
        modes = TrustRegionNewton(max_steps=60, tolerance=1e-6).minimise(cost, x, body.bounds)
        x = modes.mean
    assert modes is not None
    best = best_distinct(modes, 3)
    body, mean, covariance = move_base(
        body, *root_pose(body, best.mean[0]), best.mean, best.covariance
    )
    assert covariance is not None
    return body, GaussianMixture(mean, covariance, torch.log_softmax(-best.cost, 0))


def table_of(report: dict[str, Any]) -> Table:
    """One row per set of cameras."""
    named = {f"{clip}, {views}": row for clip in report for views, row in report[clip].items()}
    columns = list(dict.fromkeys(column for row in named.values() for column in row))
    rows = [[name, *map(row.get, columns)] for name, row in named.items()]
    return Table("Several cameras", ("cameras", *columns), rows)


if __name__ == "__main__":
    start(main, Config, __doc__)

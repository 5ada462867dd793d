"""A trotting quadruped on a free root, filmed and tracked by one camera or by three.

    python scripts/track_quadruped.py --urdf DATA/robot_models/anymal_b.urdf --cameras 3
    python scripts/track_quadruped.py --urdf DATA/robot_models/anymal_b.urdf --cameras 1

ANYmal trots and turns before clutter (`torchcss.studies.render.robots.trot`), as capsules on its
links; its hips, knees and feet are marked in every image with noise. Three cameras stand around it
and tell the places in space, one does not. The first pose is fitted to the keypoints of the first
frame about the standing pose. Errors are those of all links' origins, marked or not, against the
exact truth, and of the base's place, in millimetres.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from common import Table, finish, start
from torch import Tensor

from torchcss.body.load import FileOptions, load_body
from torchcss.body.model import BodyModel
from torchcss.cli.options import SettingsOptions
from torchcss.initialise.fit import initialise
from torchcss.initialise.options import InitialiseOptions
from torchcss.initialise.view import CameraView
from torchcss.studies.render.motions import sample_times
from torchcss.studies.render.robots import film_robot, stand, trot
from torchcss.studies.render.scene import look_at
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import TERMS, Settings
from torchcss.types import Keypoints, frozen

MARKED = ("THIGH", "SHANK", "FOOT")
"""Links whose origins are marked: hip, knee and foot of every leg."""

RATE = 25.0
"""Frames a second."""

EYES = ((1.6, 0.7, 3.2), (-3.0, 0.8, 1.8), (0.9, 1.2, -2.8))
LOOKED_AT = (0.1, -0.2, 0.5)
"""Where the cameras are, and what they look at, metres."""

TRACKING = Settings(
    samples=40,
    modes=3,
    # The links of a leg run into each other as capsules.
    terms=tuple(term for term in TERMS if term != "interpenetration"),
)
"""How this script tracks, where nothing else is said."""


@frozen
class Config:
    """Who trots, and what is seen."""

    urdf: Path
    """The quadruped."""
    cameras: Literal[1, 3] = 3
    """How many cameras film it."""
    noise: float = 1.5
    """Standard deviation of a keypoint's coordinate, pixels."""
    frames: int = 50
    """Frames, 25 a second."""
    tracking: SettingsOptions = TRACKING
    """How to track; the body is that above, the seed that of noise and film as well."""
    out: Path | None = None
    """JSON file to write."""


def load_quadruped(path: Path) -> BodyModel:
    """On a free root, its legs within a turn, standing as its usual pose."""
    body = load_body(path, free_root=True, file=FileOptions(shape="bones"))
    usual = stand(body)
    legs = torch.tensor(["_" in n and not n.startswith("root") for n in body.state_names])
    # Three turns of freedom, as the file has them, are one pose of a leg three times.
    body.lower = torch.where(legs, usual - math.pi / 2, body.lower)
    body.upper = torch.where(legs, usual + math.pi / 2, body.upper)
    body.sticky_mean = usual
    body.sticky_deviation = torch.where(legs, 0.7, math.inf).to(usual)
    return body


def begin(config: Config, body: BodyModel, truth: Tensor) -> tuple[TrackingSession, list[tuple]]:
    """A session at its first pose, and the images of every moment."""
    generator = torch.Generator().manual_seed(config.tracking.seed)
    cameras = [
        look_at(eye, LOOKED_AT, focal_px=900.0, image_size_wh=(960, 540), name=f"cam{number}")
        for number, eye in enumerate(EYES[: config.cameras], 1)
    ]
    films = film_robot(body, truth, generator=generator, cameras=cameras, frame_rate=RATE)
    names = tuple(n for n in body.joint_names if n.rsplit("_", 1)[-1] in MARKED)
    marked = body.pose(truth).joints[:, body.joint_columns(names)]
    seen = []
    for camera in cameras:
        exact = camera.project(marked).uv
        noise = torch.randn(exact.shape, generator=generator, dtype=exact.dtype)
        places = exact + config.noise * noise
        seen.append(Keypoints(places, torch.ones_like(places[..., 0]), names))
    settings = replace(config.tracking, body=body.name)
    dtype, device = settings.torch_dtype, settings.device
    there = [camera.to(dtype=dtype, device=device) for camera in cameras]
    views = [CameraView(*pair, config.noise) for pair in zip(there, seen, strict=True)]
    first = initialise(
        None, seen[0].at(0), there[0], body.to(dtype=dtype, device=device), generator=generator,
        options=InitialiseOptions(sigma=config.noise, dtype=dtype, device=torch.device(device)),
        others=[view.at(0) for view in views[1:]],
    )  # fmt: skip
    session = TrackingSession(settings, first, views, frame_interval=1 / RATE, generator=generator)
    return session, list(zip(*(film.frames for film in films), strict=True))


def main(config: Config) -> dict[str, Any]:
    """Film, track, compare, print, write; return what is written."""
    body = load_quadruped(config.urdf)
    truth = trot(body, sample_times(config.frames, RATE))
    session, moments = begin(config, body, truth)
    best = torch.stack([each.joints_world[0].double().cpu() for each in session.track(moments)])
    links = 1000 * (best - body.pose(truth).joints).norm(dim=-1)
    report = {
        "links_mm": float(links.mean()),
        "links_mm_by_frame": links.mean(-1).tolist(),
        "worst_frame_mm": float(links.mean(-1).max()),
        "base_mm": float(links[:, body.joint_index("base")].mean()),
        "feet_mm": float(links[:, [n.endswith("FOOT") for n in body.joint_names]].mean()),
        "config": config,
    }
    print(
        f"{config.cameras} cameras, {config.frames} frames: links {report['links_mm']:.1f} mm "
        f"(worst frame {report['worst_frame_mm']:.1f}), base {report['base_mm']:.1f} mm, "
        f"feet {report['feet_mm']:.1f} mm; last frames {np.round(links[-3:].mean(-1).numpy(), 1)}"
    )
    columns = ("links mm", "worst frame mm", "base mm", "feet mm")
    cells = [report[c.replace(" ", "_")] for c in columns]
    table = Table("A trotting quadruped", ("cameras", *columns), [[config.cameras, *cells]])
    return finish(config.out, report, table)


if __name__ == "__main__":
    start(main, Config, __doc__)

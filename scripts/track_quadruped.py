"""A trotting quadruped on a free root, tracked from keypoints on its legs, in 3D or in one camera.

    python scripts/track_quadruped.py --urdf DATA/robot_models/anymal_b.urdf --keypoints 3d
    python scripts/track_quadruped.py --urdf DATA/robot_models/anymal_b.urdf --keypoints 2d

ANYmal trots and turns (`torchcss.studies.render.robots.trot`); its hips, knees and feet are
observed with noise, as places in space (`torchcss.cost.targets`) or in the image of one camera. The
first frame is found by descents from about the standing pose, the rest by the tracker `css`. Errors
are those of all links' origins, marked or not, against the exact truth, and of the base's place, in
millimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from common import Table, start, write_report
from torch import Tensor

from torchcss.body.load import FileOptions, load_body
from torchcss.body.model import BodyModel
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.joints import JointTerm
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.targets import PointTargets
from torchcss.cost.temporal import TemporalPrior
from torchcss.cost.total import TrackingCost
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.problem import SearchProblem
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.studies.render.robots import stand, trot
from torchcss.studies.render.scene import look_at
from torchcss.tracking.presets import make_tracker
from torchcss.types import Bounds, CostFunction, Keypoints

MARKED = ("THIGH", "SHANK", "FOOT")
"""Links whose origins are marked: hip, knee and foot of every leg."""

RATE = 25.0
"""Frames a second."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Who trots, and what is seen."""

    urdf: Path
    """The quadruped."""
    keypoints: Literal["2d", "3d"] = "3d"
    """Where the keypoints are: in space, or in the image."""
    noise: float | None = None
    """Standard deviation of a keypoint's coordinate: metres (0.005) or pixels (1.5)."""
    frames: int = 50
    """Frames, 25 a second."""
    samples: int = 40
    """Samples per frame."""
    seed: int = 0
    """Seed of noise and samples."""
    out: Path | None = None
    """JSON file to write."""


def load_quadruped(path: Path) -> BodyModel:
    """On a free root, its legs within a turn, standing as its usual pose."""
    body = load_body(path, free_root=True, file=FileOptions(shape="none"))
    usual = stand(body)
    legs = torch.tensor(["_" in n and not n.startswith("root") for n in body.state_names])
    # Three turns of freedom, as the file has them, are one pose of a leg three times.
    body.lower = torch.where(legs, usual - math.pi / 2, body.lower)
    body.upper = torch.where(legs, usual + math.pi / 2, body.upper)
    body.sticky_mean = usual
    body.sticky_deviation = torch.where(legs, 0.7, math.inf).to(usual)
    return body


def make_costs(
    config: Config, body: BodyModel, truth: Tensor, generator: torch.Generator
) -> tuple[list[SearchProblem], CostFunction]:
    """The cost of every frame, and that of the first frame without a past."""
    names = [n for n in body.joint_names if n.rsplit("_", 1)[-1] in MARKED]
    index = torch.tensor([body.joint_index(name) for name in names])
    exact = body.pose(truth).joints[:, index]
    noise = torch.randn(exact.shape, generator=generator, dtype=exact.dtype)
    if config.keypoints == "3d":
        sigma = config.noise or 0.005
        spatial = [
            PointTargets(
                body=body,
                link=body.marker_link[index],
                offset=body.marker_offset[index],
                target=places,
                weight=torch.ones_like(places[:, 0]),
                sigma=sigma,
                columns=torch.arange(body.num_parameters),
                held=body.rest,
            )
            for places in exact + sigma * noise
        ]
        return [SearchProblem(cost) for cost in spatial], spatial[0]
    sigma = config.noise or 1.5
    camera = look_at((1.6, 0.7, 3.2), (0.1, -0.2, 0.5), focal_px=1300, image_size_wh=(1280, 720))
    uv = camera.project(exact).uv + sigma * noise[..., :2]
    terms = (JointTerm(sigma=sigma), Stabiliser(lengths=True), TemporalPrior())
    costs = [
        TrackingCost(
            choice=CostChoice(terms=terms),
            views=(
                FrameContext(
                    body=body,
                    camera=camera,
                    keypoints=Keypoints(places, torch.ones_like(places[:, 0]), tuple(names)),
                    deviation=body.motion_rate / RATE,
                ),
            ),
        )
        for places in uv
    ]
    return [cost.problem() for cost in costs], costs[0]


def first_mixture(
    body: BodyModel, cost: CostFunction, generator: torch.Generator
) -> GaussianMixture:
    """Descents from about the standing pose; the best of them."""
    usual = stand(body)
    noise = torch.randn(48, len(usual), generator=generator, dtype=usual.dtype)
    bounds = Bounds(body.lower, body.upper)
    modes = TrustRegionNewton().minimise(cost, usual + 0.3 * noise, bounds)
    best = modes.cost.argsort()[:3]
    return GaussianMixture(modes.mean[best], modes.covariance[best], -modes.cost[best])


def main(config: Config) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(config.seed)
    body = load_quadruped(config.urdf)
    times = torch.arange(config.frames, dtype=torch.float64) / RATE
    truth = trot(body, times)
    costs, first = make_costs(config, body, truth, generator)
    tracker = make_tracker(
        "css",
        body.name,
        num_samples=config.samples,
        num_modes=3,
        motion=tuple((body.motion_rate / RATE).tolist()),
    )
    state = tracker.init(first_mixture(body, first, generator), generator=generator)
    best = [state.mixture.mean[0] for state, _ in tracker.track(state, costs, body.bounds)]
    error = body.pose(torch.stack(best)).joints - body.pose(truth).joints
    links = 1000 * error.norm(dim=-1)
    root = links[:, body.joint_index("base")]
    report = {
        "links_mm": float(links.mean()),
        "links_mm_by_frame": links.mean(-1).tolist(),
        "worst_frame_mm": float(links.mean(-1).max()),
        "base_mm": float(root.mean()),
        "feet_mm": float(links[:, [n.endswith("FOOT") for n in body.joint_names]].mean()),
        "config": config,
    }
    print(
        f"{config.keypoints} keypoints, {config.frames} frames: links {report['links_mm']:.1f} mm "
        f"(worst frame {report['worst_frame_mm']:.1f}), base {report['base_mm']:.1f} mm, "
        f"feet {report['feet_mm']:.1f} mm; last frames {np.round(links[-3:].mean(-1).numpy(), 1)}"
    )
    columns = ("links mm", "worst frame mm", "base mm", "feet mm")
    cells = [report[c.replace(" ", "_")] for c in columns]
    table = Table("A trotting quadruped", ("keypoints", *columns), [[config.keypoints, *cells]])
    write_report(config.out, report, table)
    return report


if __name__ == "__main__":
    start(main, Config, __doc__)

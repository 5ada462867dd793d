"""Learn which poses people take from motion capture: the mixtures of `torchcss.cost.pose_prior`.

    python scripts/learn_pose_prior.py --data DIR --out torchcss/cost/pose_prior.npz --report J

DIR holds motions of the CMU database as `SUBJECT_TRIAL.bvh`, of which the first frame is a T-pose
and the second axis up.
Whole subjects are held out, and others left out whose motions drive a clip that trackers are judged
on. Of each clip those poses are used that differ from the one used before. Expectation maximisation
fits the mixtures to them and their mirror images.

The table gives the mean log density of the poses of the held-out subjects, nats, on the spheres of
directions, and how well it is calibrated: the share of them in the regions of highest density that
hold 10, 20, ... 90 % of it, and the mean absolute difference. Beside it are single Gaussians, the
uniform density, and what the tracker had before: poses drawn from the stabilisers within the joint
limits, to which the same mixtures are fitted.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import Table, finish, start
from jaxtyping import Float
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.cost.pose_prior import (
    GROUPS,
    UNIFORM_SHARE,
    PoseMixture,
    directions_of,
    limb_directions,
    mirrored,
)
from torchcss.cost.stabiliser import Stabiliser
from torchcss.errors import ConfigurationError
from torchcss.io.motion.positions import limb_positions, read_motion_capture
from torchcss.types import frozen

Poses = dict[str, Float[Tensor, "t d"]]
"""Directions by group."""

_UP = (0.0, 1.0, 0.0)
"""Which way is up in the motions."""

LEVELS = [0.1 * tenth for tenth in range(1, 10)]


@frozen
class Config:
    """What is learnt from, and what."""

    data: Path
    """Folder of the motions."""
    held_out: tuple[str, ...] = ("14",)
    """Subjects that the density is judged on."""
    left_out: tuple[str, ...] = ("05",)
    """Subjects that are not used at all."""
    components: int = 16
    """Gaussians of each group, beside their mirror images."""
    blur: float = 0.1
    """Deviation by which they are widened: what two skeletons in one pose differ by, radians."""
    spread_poses: float = 100.0
    """For how many poses the covariance of all poses counts in that of each Gaussian."""
    apart: float = 0.2
    """How far some direction has to turn, radians, until another pose of a clip is used."""
    steps: int = 25
    """Steps of expectation maximisation."""
    seed: int = 0
    """Seed of the first means, and of the samples."""
    small: bool = False
    """Few Gaussians and steps, to see that it runs."""
    out: Path | None = None
    """NPZ file of the mixture to write."""
    report: Path | None = None
    """JSON file to write."""


def main(config: Config) -> dict[str, Any]:
    """Learn, judge, print and write; return what is written."""
    generator = torch.Generator().manual_seed(config.seed)
    poses = read_poses(config)
    train = [s for s in poses if s not in (*config.held_out, *config.left_out)]
    if not train or not set(config.held_out) <= set(poses):
        raise ConfigurationError(
            f"{config.data}: expected motions of subjects to learn from and of those held out "
            f"({', '.join(config.held_out)}), found {', '.join(poses) or 'none'}"
        )
    truth = joined([poses[subject] for subject in config.held_out])
    learnt_from = joined([poses[subject] for subject in train])
    before = stabiliser_poses(len(learnt_from["trunk"]), generator)
    fits = {
        "mixtures": fit(learnt_from, config, generator),
        "Gaussians": fit(learnt_from, replace(config, components=1), generator),
        "stabilisers": fit(before, config, generator),
    }
    rows = [[name, *judge(m, learnt_from, truth, generator)] for name, m in fits.items()]
    uniform = -10 * math.log(4 * math.pi) - math.log(2 * math.pi)
    rows.append(["uniform", uniform, uniform, math.nan, math.nan])
    columns = ("density", "train", "held out", "in 90 %", "calibration error")
    table = Table("Log density of poses", columns, rows)
    if config.out is not None:
        write_mixtures(config.out, fits["mixtures"])
    numbers = {"train": len(learnt_from["trunk"]), "held_out": len(truth["trunk"])}
    report = {"setting": config, **numbers, "rows": rows}
    return finish(config.report, report, table)


def read_poses(config: Config) -> dict[str, Poses]:
    """The directions of the poses of each subject."""
    found: dict[str, list[Poses]] = {}
    for path in sorted(config.data.glob("*.bvh")):
        names, _, places = limb_positions(read_motion_capture(path))
        which = directions_of(names, torch.zeros((), dtype=torch.float64), _UP)
        if which is None or sum(len(group.known) for group in which.groups) < 11:
            raise ConfigurationError(f"{path}: expected all limbs among the joints, found {names}")
        every = limb_directions(torch.from_numpy(places[1:]), which)
        kept = thinned(torch.cat([*every.values()], dim=-1), config.apart)
        poses = {group: own[kept] for group, own in every.items()}
        found.setdefault(path.name.split("_")[0], []).append(poses)
    return {subject: joined(parts) for subject, parts in found.items()}


def joined(parts: list[Poses]) -> Poses:
    """The poses of all parts."""
    return {group: torch.cat([part[group] for part in parts]) for group in GROUPS}


def thinned(directions: Float[Tensor, "t d"], apart: float) -> list[int]:
    """Those poses that differ from the one kept before."""
    kept: list[int] = []
    each = directions.unflatten(-1, (-1, 3))
    for index, pose in enumerate(each):
        if not kept or float((pose - each[kept[-1]]).norm(dim=-1).max()) >= apart:
            kept.append(index)
    return kept


def stabiliser_poses(number: int, generator: torch.Generator) -> Poses:
    """The directions of poses drawn from the stabilisers of body34 within its limits."""
    body, nu = load_body("body34"), Stabiliser().nu
    spread = body.sticky_deviation
    lower, upper = (torch.nan_to_num(b, posinf=0.0, neginf=0.0) for b in body.bounds)
    size = (number, body.num_parameters)
    x = lower + (upper - lower) * torch.rand(size, generator=generator, dtype=body.dtype)
    left = spread.isfinite().expand(size).clone()
    while bool(left.any()):
        # A Lorentzian of height nu is Student's t with nu - 1 degrees of freedom.
        normal = torch.randn(int(left.sum()), int(nu), generator=generator).to(x)
        z = math.sqrt(nu) * normal[:, 0] / normal[:, 1:].norm(dim=-1)
        x[left] = (body.sticky_mean + 0 * x)[left] + (spread + 0 * x)[left] * z
        left = left & ((x < body.lower) | (x > body.upper))
    which = directions_of(body.joint_names, body.tie, _UP)
    assert which is not None
    poses = limb_directions(body.pose(x).joints, which)
    # They say nothing of which way is up.
    anywhere = torch.randn(number, 3, generator=generator).to(x)
    poses["legs"][:, -3:] = torch.nn.functional.normalize(anywhere, dim=-1)
    return poses


def fit(poses: Poses, config: Config, generator: torch.Generator) -> dict[str, PoseMixture]:
    """The mixture of each group, arms alike, mirror images not included."""
    sides = torch.cat([poses["l_arm"], poses["r_arm"]])
    found = {"l_arm": fit_group("l_arm", sides, config, generator)}
    for group in ("trunk", "legs"):
        both = torch.cat([poses[group], mirrored(poses[group], group)])
        found[group] = fit_group(group, both, config, generator)
    return {**found, "r_arm": found["l_arm"]}


def fit_group(
    group: str, poses: Float[Tensor, "t d"], config: Config, generator: torch.Generator
) -> PoseMixture:
    """Expectation maximisation, from means that are poses far from one another."""
    count, size = (min(2, config.components) if config.small else config.components), poses.shape[1]
    chosen = [int(torch.randint(len(poses), (), generator=generator))]
    far = torch.full_like(poses[:, 0], math.inf)
    while len(chosen) < count:
        far = torch.minimum(far, (poses - poses[chosen[-1]]).square().sum(-1))
        chosen.append(int(torch.multinomial(far, 1, generator=generator)))
    known = tuple(range(size // 3))
    whole, narrow = torch.cov(poses.T), config.blur**2 * torch.eye(size).to(poses)
    begin = (0.1 * torch.eye(size).to(poses)).expand(count, size, size)
    mixture = PoseMixture(poses.new_ones(count) / count, poses[chosen], begin)
    for _ in range(3 if config.small else config.steps):
        parts, _ = mixture.with_mirrored(group).density(group, known).parts(poses)
        share = parts.softmax(-1)[:, :count]
        total = share.sum(0).clamp(min=1e-6)
        mean = (share.T @ poses) / total[:, None]
        covariance = []
        for k in range(count):
            away = poses - mean[k]
            scatter = (share[:, k, None] * away).T @ away + config.spread_poses * whole
            covariance.append(scatter / (total[k] + config.spread_poses) + narrow)
        mixture = PoseMixture(total / total.sum(), mean, torch.stack(covariance))
    return mixture


def judge(
    mixtures: dict[str, PoseMixture], train: Poses, truth: Poses, generator: torch.Generator
) -> list[float]:
    """Mean log density of both, share of the truth in the region of 90 %, calibration error."""
    own, known, held = torch.zeros(()), torch.zeros(()), torch.zeros(())
    for group in GROUPS:
        mixture = mixtures[group].with_mirrored(group)
        density = mixture.density(group, tuple(range(len(GROUPS[group]))))
        own = own - density.cost(draw(group, mixture, 20_000, generator))
        known, held = known - density.cost(train[group]), held - density.cost(truth[group])
    inside = [float((held >= own.quantile(1 - level)).double().mean()) for level in LEVELS]
    error = float(np.mean([abs(a - b) for a, b in zip(inside, LEVELS, strict=True)]))
    return [float(known.mean()), float(held.mean()), inside[-1], error]


def draw(
    group: str, mixture: PoseMixture, number: int, generator: torch.Generator
) -> Float[Tensor, "t d"]:
    """Directions drawn from the density: of the Gaussians, put on the spheres, and of all."""
    which = torch.multinomial(mixture.weight, number, replacement=True, generator=generator)
    noise = torch.randn(number, mixture.mean.shape[1], 2, generator=generator).to(mixture.mean)
    root = torch.linalg.cholesky(mixture.covariance)[which]
    drawn = mixture.mean[which] + (root @ noise[..., :1])[..., 0]
    anywhere = torch.rand(number, generator=generator) < UNIFORM_SHARE
    drawn = torch.where(anywhere[:, None], noise[..., 1], drawn).unflatten(-1, (-1, 3))
    if group == "trunk":
        drawn[:, 0, 2] = 0.0
    return torch.nn.functional.normalize(drawn, dim=-1).flatten(-2)


def write_mixtures(path: Path, mixtures: dict[str, PoseMixture]) -> None:
    """Write the mixtures as the package holds them."""
    arrays = {
        f"{group.removeprefix('l_')}_{name}": numbers.numpy().astype(np.float32)
        for group, mixture in mixtures.items()
        if group != "r_arm"
        for name, numbers in mixture._asdict().items()
    }
    np.savez_compressed(path, **arrays)


if __name__ == "__main__":
    start(main, Config, __doc__)

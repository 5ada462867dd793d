"""Inverse kinematics: are all solutions found, are they exact, and how fast beside a peer?

    python scripts/inverse_kinematics.py --data DATA/robot_models --out inverse_kinematics.json

Poses of an end effector are made from random states within the limits. For every pose

* `torchcss.inverse_kinematics` finds the solutions: isolated points of an arm with six free joints
  (UR5; Panda and iiwa with one joint fixed), connected curves of one with seven;
* **exact**: pytorch-kinematics, given the URDF itself, computes the pose of every solution. (It
  keeps the file's numbers in single precision, which costs it 1e-8 to 1e-7.)
* **complete**: the same pose is solved by restarts without any cleverness, `--restarts` descents
  from uniform states to the end. Recall is the share of what these find that lies on our
  solutions: of distinct isolated solutions, of single states on curves;
* **fast**: pytorch-kinematics' own solver, `PseudoInverseIK`, gets the same time-out rule: rounds
  of as many retries as ours has samples, until `patience` rounds bring nothing new (isolated
  solutions only). Its solutions count where it says that it converged within the limits, to
  `--tolerance`. Both run one after the other in every repeat, on one thread; ratios of solutions
  found per second are taken within repeats.

Without the redundancy resolved, the peer's states cannot be told to be new, and the ratio is that
of single exact states per second of descents.
"""

from __future__ import annotations

import math
import time
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_kinematics as pk
import torch
from common import Table, start, write_report
from torch import Tensor

from torchcss.body.load import FileOptions, load_body
from torchcss.body.model import BodyModel
from torchcss.cost.targets import pose_targets
from torchcss.errors import ConfigurationError
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.solve.inverse_kinematics import (
    Search,
    Solutions,
    inverse_kinematics,
    link_pose,
)
from torchcss.solve.self_motion import Curve, distance_from
from torchcss.types import Bounds, frozen

CASES: dict[str, tuple[str, str, str | None]] = {
    "ur5": ("ur5.urdf", "tool0", None),
    "panda, joint 7 fixed": ("panda.urdf", "panda_hand", "panda_joint7"),
    "iiwa7, joint 3 fixed": ("iiwa7.urdf", "iiwa_link_ee", "iiwa_joint_3"),
    "panda": ("panda.urdf", "panda_hand", None),
    "iiwa7": ("iiwa7.urdf", "iiwa_link_ee", None),
}
"""File, end effector, and the joint that is fixed at its value in the state that made the pose."""

SAME = 1e-3
"""Radians within which two isolated solutions are one."""


@frozen
class Config:
    """Which arms and poses, and how much work the checks get."""

    data: Path = Path("robot_models")
    """Folder of the robots' files."""
    cases: tuple[str, ...] = tuple(CASES)
    """Which arms."""
    poses: int = 5
    """Poses per arm."""
    restarts: int = 10_000
    """Uniform descents per pose that ours is checked against."""
    repeats: int = 3
    """Timed repeats; 0: no timing."""
    tolerance: float = 1e-6
    """Metres and radians that a solution of the peer may be off."""
    iterations: int = 50
    """Iterations of the peer."""
    seed: int = 0
    """Seed of poses and samples."""
    search: Search = field(default_factory=Search)
    """How ours searches."""
    out: Path | None = None
    """JSON file to write."""


@dataclass(frozen=True)
class Problem:
    """One pose of one arm."""

    body: BodyModel
    urdf: bytes
    link: str
    fixed: dict[str, float]
    pose: Tensor

    @property
    def columns(self) -> Tensor:
        """The free parameters that move the link."""
        above = self.body.tree.ancestors[:, self.body.tree.link_index(self.link)].to(self.body.tie)
        moves = (above @ self.body.tie) != 0
        for name in self.fixed:
            moves[self.body.state_index(name)] = False
        return torch.nonzero(moves)[:, 0]

    @property
    def isolated(self) -> bool:
        """Whether no joint is redundant."""
        return len(self.columns) <= 6

    def chain(self) -> pk.SerialChain:
        """The arm in the other program, of its file what moves it, fixed joints welded."""
        robot = ElementTree.fromstring(self.urdf)
        kinematic = ("parent", "child", "origin", "axis", "limit")
        for link in robot.findall("link"):
            for part in list(link):
                link.remove(part)
        for joint in robot.findall("joint"):
            for part in [part for part in joint if part.tag not in kinematic]:
                joint.remove(part)
        for other in robot.findall("transmission") + robot.findall("gazebo"):
            robot.remove(other)
        for name, value in self.fixed.items():
            weld(robot, name, value)
        data = ElementTree.tostring(robot)
        return pk.build_serial_chain_from_urdf(data, self.link).to(dtype=torch.float64)


def weld(robot: ElementTree.Element, name: str, value: float) -> None:
    """Make a revolute joint about z a fixed one, turned by its value."""
    joint = next(j for j in robot.findall("joint") if j.get("name") == name)
    origin, axis = joint.find("origin"), joint.find("axis")
    assert origin is not None
    assert axis is not None
    assert [float(a) for a in axis.get("xyz", "").split()] == [0, 0, 1]
    roll, pitch, yaw = (float(angle) for angle in origin.get("rpy", "0 0 0").split())
    angles = torch.tensor([yaw, pitch, roll, value], dtype=torch.float64)
    turn = pk.euler_angles_to_matrix(angles[:3], "ZYX")
    turn = turn @ pk.euler_angles_to_matrix(angles.new_tensor([0, 0, value]), "XYZ")
    yaw, pitch, roll = pk.matrix_to_euler_angles(turn, "ZYX").tolist()
    origin.set("rpy", f"{roll!r} {pitch!r} {yaw!r}")
    joint.set("type", "fixed")


def make_problem(config: Config, case: str, number: int) -> Problem:
    """A pose that some state within the limits has."""
    file, link, joint = CASES[case]
    body = load_body(config.data / file, file=FileOptions(shape="none"))
    generator = torch.Generator().manual_seed(1000 * config.seed + number)
    share = torch.rand(body.num_parameters, generator=generator, dtype=torch.float64)
    x = body.lower + share * (body.upper - body.lower)
    fixed = {} if joint is None else {joint: float(x[body.state_index(joint)])}
    urdf = (config.data / file).read_bytes()
    return Problem(body, urdf, link, fixed, link_pose(body, link, x))


def solve(config: Config, problem: Problem, seed: int) -> Solutions:
    return inverse_kinematics(
        problem.body, problem.link, problem.pose, fixed=problem.fixed,
        generator=torch.Generator().manual_seed(seed), search=config.search,
    )  # fmt: skip


def restart(config: Config, problem: Problem) -> Tensor:
    """States of the body that descents from anywhere end at, exactly in place."""
    body, columns = problem.body, problem.columns
    held = body.rest.clone()
    for name, value in problem.fixed.items():
        held[body.state_index(name)] = value
    cost = pose_targets(body, problem.link, problem.pose, columns=columns, held=held)
    low, high = body.lower[columns], body.upper[columns]
    generator = torch.Generator().manual_seed(config.seed + 17)
    share = torch.rand(config.restarts, len(low), generator=generator, dtype=torch.float64)
    newton = TrustRegionNewton(max_steps=200, tolerance=1e-15)
    modes = newton.minimise(cost, low + share * (high - low), Bounds(low, high))
    return cost.whole(modes.mean[modes.cost < 1e-11])


def distinct(x: Tensor) -> Tensor:
    """One of every cluster of states."""
    chosen = []
    while len(x):
        chosen.append(x[0])
        x = x[(x - x[0]).abs().amax(-1) > SAME]
    return torch.stack(chosen) if chosen else x


def errors_elsewhere(problem: Problem, x: Tensor) -> tuple[float, float]:
    """Greatest error of place (metres) and of orientation (radians), by pytorch-kinematics."""
    if not len(x):
        return 0.0, 0.0
    end = problem.chain().forward_kinematics(x[:, problem.columns])
    assert isinstance(end, pk.Transform3d)
    found = end.get_matrix()
    apart = (found[:, :3, :3] - problem.pose[:3, :3]).flatten(1).norm(dim=-1)
    place = (found[:, :3, 3] - problem.pose[:3, 3]).norm(dim=-1)
    return float(place.max()), float((2 * (apart / 8**0.5).clamp(max=1).asin()).max())


def peer(config: Config, problem: Problem, chain: pk.SerialChain, seed: int) -> Tensor:
    """States that pytorch-kinematics' solver finds, round by round."""
    columns = problem.columns
    low, high = problem.body.lower[columns], problem.body.upper[columns]
    target = pk.Transform3d(matrix=problem.pose[None], dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    found, known, quiet, rounds = [], 0, 0, 0
    while quiet < config.search.patience and rounds < config.search.max_rounds:
        share = torch.rand(
            config.search.num_samples, len(low), generator=generator, dtype=torch.float64
        )
        solver = pk.PseudoInverseIK(
            chain, retry_configs=low + share * (high - low), max_iterations=config.iterations,
            pos_tolerance=config.tolerance, rot_tolerance=config.tolerance,
            early_stopping_any_converged=False, early_stopping_no_improvement=None,
            joint_limits=torch.stack([low, high], -1),
        )  # fmt: skip
        result = solver.solve(target)
        x = result.solutions[0][result.converged[0]]
        x = x[((x >= low) & (x <= high)).all(-1)]
        found = [*found, x]
        rounds += 1
        if not problem.isolated:
            break  # Its states cannot be told to be new: a round is enough.
        now = len(distinct(torch.cat(found)))
        quiet, known = (0, now) if now > known else (quiet + 1, known)
    x = torch.cat(found)
    return distinct(x) if problem.isolated else x


def states_per_round(config: Config, problem: Problem, seed: int) -> int:
    """Exact states that one round of uniform descents of ours gives."""
    one = Config(data=config.data, restarts=config.search.num_samples, seed=seed)
    return len(restart(one, problem))


def covered(solutions: Solutions, x: Tensor, distance: float) -> Tensor:
    """Which states lie, to a distance in radians, on isolated solutions or curves that were found.

    Joints without limits are between minus and plus half a turn, as in `solutions`.
    """
    near = torch.full_like(x[:, 0], torch.inf)
    for branch, closed in enumerate(solutions.closed.tolist()):
        curve = Curve(solutions.x[solutions.branch == branch], closed)
        near = torch.minimum(near, distance_from(curve, x))
    return near <= distance


def run_pose(config: Config, case: str, number: int) -> dict[str, Any]:
    """Solve one pose, and check and time it."""
    problem = make_problem(config, case, number)
    found = solve(config, problem, config.seed)
    reference = restart(config, problem)
    if problem.isolated:
        reference = distinct(reference)
    near = 10 * SAME if problem.isolated else 0.5 * config.search.spacing
    hit = covered(found, reference, near)
    place, turn = errors_elsewhere(problem, found.x)
    row: dict[str, Any] = {
        "solutions": found.num_branches,
        "points": len(found.x),
        "descents": found.num_descents,
        "reference": len(reference),
        "recall": float(hit.double().mean()) if len(hit) else math.nan,
        "our_place_error": float(found.position_error.max()),
        "our_angle_error": float(found.angle_error.max()),
        "place_error_elsewhere": place,
        "angle_error_elsewhere": turn,
        "seconds": [],
        "peer_seconds": [],
        "peer_solutions": [],
        "our_rate_over_peers": [],
    }
    chain = problem.chain()
    for repeat in range(config.repeats):
        seed = config.seed + repeat
        start = time.process_time()
        if problem.isolated:
            count = solve(config, problem, seed).num_branches
        else:
            count = states_per_round(config, problem, seed)
        ours = time.process_time() - start
        start = time.process_time()
        others = peer(config, problem, chain, seed)
        theirs = time.process_time() - start
        row["seconds"].append(ours)
        row["peer_seconds"].append(theirs)
        row["peer_solutions"].append(len(others))
        rate = len(others) / theirs
        row["our_rate_over_peers"].append(count / ours / rate if rate else math.inf)
    return row


def main(config: Config) -> dict[str, Any]:
    if unknown := sorted(set(config.cases) - set(CASES)):
        raise ConfigurationError(f"no cases {unknown}; there are {'; '.join(CASES)}")
    torch.set_num_threads(1)
    report: dict[str, Any] = {"config": config, "cases": {}}
    for case in config.cases:
        rows = [run_pose(config, case, number) for number in range(config.poses)]
        report["cases"][case] = {"poses": rows, **summarise(rows)}
        table = table_of(report["cases"])
        table.print()
        write_report(config.out, report, table)
    return report


def table_of(cases: dict[str, Any]) -> Table:
    """What is shown of each arm."""
    columns = ("arm", "solutions", "checked", "recall", "error", "seconds", "peer finds")
    keys = ("solutions", "reference", "recall", "error", "seconds", "peer_solutions")
    rows = [
        [name, *(case[key] for key in keys), case["ratio_quantiles"][1]]
        for name, case in cases.items()
    ]
    return Table("Inverse kinematics", (*columns, "rate over peer"), rows)


def summarise(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Totals over the poses of one arm."""
    checked = sum(row["reference"] for row in rows)
    hits = sum(row["recall"] * row["reference"] for row in rows if row["reference"])
    ratios = [ratio for row in rows for ratio in row["our_rate_over_peers"]]
    return {
        "solutions": sum(row["solutions"] for row in rows),
        "reference": checked,
        "recall": hits / max(checked, 1),
        "error": max(max(r["place_error_elsewhere"], r["angle_error_elsewhere"]) for r in rows),
        "our_error": max(max(r["our_place_error"], r["our_angle_error"]) for r in rows),
        "seconds": float(np.median([s for r in rows for s in r["seconds"]] or [math.nan])),
        "peer_solutions": float(np.mean([n for r in rows for n in r["peer_solutions"]] or [0.0])),
        "ratio_quantiles": np.quantile(ratios or [math.nan], [0.0, 0.5, 1.0]).tolist(),
    }


if __name__ == "__main__":
    start(main, Config, __doc__)

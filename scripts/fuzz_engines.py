"""Random costs at random states by the fused engine and by the eager one, until they differ.

    python scripts/fuzz_engines.py --cases 2000
    python scripts/fuzz_engines.py --bodies ../shared/data/robot_models/panda.urdf

Of each case everything is drawn from its own seed: the body and the girth, taper, bend and
roundness of its parts, one camera or two with distortion, edges, colours, flow, keypoints, the
modes before, the terms and their potentials. Its states are ordinary, folded to their bounds, wild,
behind the camera, across its plane, out of the picture and far away. Value, gradient and Hessian
are compared in both precisions: values in nats, derivatives by the largest entry of the state's;
and values after a small motion with visibility and matches held.

Left out are states with an edge within 1e-3 px of a search window's end, where derivatives jump,
and in single precision derivatives, which have to be numbers there: a threshold that rounding moves
(a crossing of a contour, a maximum on a search line) moves a few of them.

A difference is printed with the seed of its case, which `--first` takes, and the terms that differ.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from common import start, write_report
from torch import Tensor
from torch.nn import functional

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.shape import with_shape
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.contour import ContourTerm
from torchcss.cost.flow import FlowTerm
from torchcss.cost.fused.engine import FusedEngine
from torchcss.cost.interpenetration import Interpenetration
from torchcss.cost.joints import JointTerm
from torchcss.cost.region import RegionImages, RegionTerm, layer_of_part
from torchcss.cost.temporal import MixturePrior
from torchcss.cost.term import Posed
from torchcss.cost.total import TrackingCost, beside
from torchcss.cost.visibility import ContourPredictor, contour_nodes, places
from torchcss.inference.mixture import GaussianMixture, Prior
from torchcss.robust import Leclerc, Lorentzian
from torchcss.types import Curvature, Keypoints, frozen
from torchcss.vision.camera import Camera
from torchcss.vision.features import FrameFeatures
from torchcss.vision.spline import spline_field

NATS = {"float64": 1e-4, "float32": 1e-2}
RELATIVE = {"float64": 1e-9, "float32": 1e-4}
"""By how much values may differ, in nats, and of a value that is larger."""

NEAR_END_PX = 1e-3


@frozen
class Config:
    """What to try."""

    bodies: tuple[str, ...] = ("arm7", "arm8", "body30", "body32", "body34")
    """Bodies, by name or file."""
    cases: int = 200
    """Number of cases."""
    first: int = 0
    """Seed of the first."""
    states: int = 16
    """States of each."""
    out: Path | None = None
    """JSON file to write."""


class Draw:
    """Random numbers of one case."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)

    def normal(self, *size: int) -> Tensor:
        """Standard normal numbers."""
        return torch.randn(size, generator=self.generator, dtype=torch.float64)

    def between(self, lower: float, upper: float, *size: int) -> Tensor:
        """Uniform numbers."""
        unit = torch.rand(size, generator=self.generator, dtype=torch.float64)
        return lower + (upper - lower) * unit

    def one(self, *choices: Any) -> Any:
        """One of several things."""
        return choices[int(torch.randint(len(choices), (), generator=self.generator))]

    def image(self, channels: int, height: int, width: int) -> Tensor:
        """A smooth image."""
        small = self.normal(1, channels, 2 + height // 8, 2 + width // 8)
        return functional.interpolate(small, (height, width), mode="bicubic")[0]


class Difference(NamedTuple):
    """The largest differences of a case, as shares of what is allowed.

    Attributes:
        seed: The case.
        body: Its body.
        dtype: Precision of the kernels.
        value: Of values.
        derivatives: Of gradients and Hessians; zero where they are numbers and not compared.
        terms: Terms whose values differ by more than is allowed.
    """

    seed: int
    body: str
    dtype: str
    value: float
    derivatives: float
    terms: tuple[str, ...]

    @property
    def fails(self) -> bool:
        """Whether it differs by more than is allowed, or is no number."""
        return not (self.value <= 1 and self.derivatives <= 1)


def draw_body(draw: Draw, name: str) -> BodyModel:
    """A body whose parts have any shape."""
    body = load_body(name)
    shape = body.part_shape.clone()
    count = len(shape)
    if draw.one(True, True, False) and count:
        shape[:, :3] *= draw.between(0.7, 1.4, count, 3)
        shape[:, 3:5] = draw.between(*draw.one((0.66, 1.04), (0.2, 1.8)), count, 2)
        shape[:, 5:7] = draw.between(*draw.one((-0.3, 0.3), (-0.9, 0.9)), count, 2)
        bent = draw.between(0, 1, count) < draw.one(0.0, 0.3)
        shape[:, 7] = torch.where(bent, draw.between(-1, 1, count) / shape[:, 2], 0.0)
        shape[:, 8] = draw.between(-3, 3, count)
        body = with_shape(body, shape)
    base = torch.linalg.qr(torch.diag(draw.normal(3).sign()) + 0.3 * draw.normal(3, 3))[0]
    base = base * torch.linalg.det(base)
    # About as far away as the body is large.
    extent = float(body.pose(body.rest).joints.norm(dim=-1).max())
    depth = 0.3 + draw.between(1.0, 3.0) * max(extent, 0.3)
    return body.with_base(base, torch.stack([*(0.2 * draw.normal(2)), depth]))


def draw_camera(draw: Draw) -> Camera:
    """A camera near the origin that looks along z."""
    width, height = draw.one((160, 120), (97, 143), (320, 200))
    focal = width * draw.between(0.6, 1.5)
    aspect = draw.between(0.9, 1.1)
    zero, one = torch.zeros(()).double(), torch.ones(()).double()
    centre = torch.tensor([width, height]) * draw.between(0.4, 0.6, 2)
    rows = [focal, zero, centre[0], zero, aspect * focal, centre[1], zero, zero, one]
    scale = torch.tensor([0.2, 0.1, 0.005, 0.005, 0.05]).double() * draw.one(0.0, 1.0, 1.0)
    turn = torch.linalg.qr(torch.eye(3).double() + 0.1 * draw.normal(3, 3))[0]
    turn = turn * turn.diagonal().sign()
    return Camera(
        torch.stack(rows).reshape(3, 3),
        (width, height),
        distortion=scale * draw.normal(5),
        R_camera_world=turn if torch.linalg.det(turn) > 0 else torch.eye(3).double(),
        t_camera_world=0.1 * draw.normal(3),
    )


def draw_states(draw: Draw, body: BodyModel, count: int) -> Tensor:
    """Ordinary states and awkward ones."""
    bounds, noise = body.bounds, draw.normal(count, body.num_parameters)
    lower, upper = bounds.lower.clamp(min=-3), bounds.upper.clamp(max=3)
    kind = torch.randint(4, (count, 1), generator=draw.generator)
    folded = torch.where(noise > 0, lower, upper)
    x = body.sticky_mean + torch.where(kind == 1, 3.0, 0.3) * noise
    x = torch.where(kind == 2, folded, x)
    x = torch.where(kind == 3, body.rest + 1e-9 * noise, x)
    if "root_x" in body.state_names:
        columns = [body.state_index(f"root_{axis}") for axis in "xyz"]
        away = draw.normal(count, 3) * (10 ** draw.between(-3, 1.5, count, 1))
        x[:, columns] = x[:, columns] + away * (draw.between(0, 1, count, 1) < 0.4)
    return bounds.project(x)


def draw_choice(draw: Draw) -> CostChoice:
    """Terms with kernels, some of them left out, with other numbers."""
    potential = draw.one(Lorentzian, Leclerc)
    terms = (
        ContourTerm(potential_kind=potential, window=draw.one(12.0, 6.5), step=draw.one(1.0, 0.7)),
        FlowTerm(potential_kind=potential),
        JointTerm(sigma=draw.one(2.0, 10.0)),
        MixturePrior(),
        Interpenetration(p=draw.one(1.0, 2.0, 2.5), sharpness=draw.one(1.5, 2.5)),
    )
    choice = CostChoice().without("segmentation").having(*terms)
    names = [term.name for term in terms]
    left_out = [name for name in (*names, "region") if draw.one(True, False, False, False)]
    curvature = draw.one(Curvature.EXACT, Curvature.EXACT, Curvature.GAUSS_NEWTON)
    return replace(choice.without(*left_out), curvature=curvature)


def draw_view(draw: Draw, body: BodyModel, choice: CostChoice, modes: Tensor) -> TrackingCost:
    """The cost of what one camera sees."""
    camera = draw_camera(draw)
    width, height = camera.image_size_wh
    joints = camera.project(body.pose(modes[0]).joints).uv
    keypoints = joints + 5 * draw.normal(*joints.shape)
    confidence = draw.between(0, 1, len(joints))
    unseen = draw.between(0, 1, len(joints)) < 0.2
    keypoints[unseen], confidence[unseen] = torch.nan, 0.0
    field = draw.image(2, height, width)
    field = 0.9 * field / (0.5 + field.norm(dim=0)).clamp(min=1.0)
    features = FrameFeatures(
        field[0], field.norm(dim=0), field, flow=3 * draw.image(2, height, width)
    )
    context = FrameContext(
        body=body,
        camera=camera,
        features=features,
        edge_field=field,
        keypoints=Keypoints(keypoints, confidence, body.joint_names),
        modes=modes,
        deviation=body.motion_rate / 25,
    )
    bound: dict[Any, Any] = {}
    for term in choice.terms:
        if isinstance(term, RegionTerm):  # colours of its own, as there is no appearance
            layer = context.tables.of(layer_of_part)
            nodes = context.tables.of(ContourPredictor)
            ratio = draw.image(1 + max(layer.tolist(), default=0), height, width).tanh()
            images = RegionImages(spline_field(ratio), layer[nodes.node_part])
            bound[term, context] = term.bind(context, images)
    return TrackingCost(choice=choice, views=(context,), bound=bound)


def make_case(seed: int, name: str, states: int) -> tuple[TrackingCost, Tensor]:
    """The cost of a case, and its states."""
    draw = Draw(seed)
    body, choice = draw_body(draw, name), draw_choice(draw)
    modes = draw_states(draw, body, draw.one(1, 3))
    views = [draw_view(draw, body, choice, modes) for _ in range(draw.one(1, 1, 2))]
    spread = draw.between(0.05, 0.5, *modes.shape).square()
    weight = draw.normal(len(modes)).log_softmax(0)
    prior = Prior.of(GaussianMixture(modes, torch.diag_embed(spread), weight))
    parent = torch.randint(len(modes), (states,), generator=draw.generator)
    return beside(views).of_children(parent, prior), draw_states(draw, body, states)


def apart_from_ends(cost: TrackingCost, x: Tensor) -> Tensor:
    """Which states have no edge next to the end of a search window."""
    clear = torch.ones(len(x), dtype=torch.bool)
    pose = cost.body.pose(x)
    for term in cost.choice.terms:
        if not isinstance(term, ContourTerm):
            continue
        for view in cost.views:
            nodes = contour_nodes(Posed(view, cost.body, pose, None))
            index = places(nodes.visible * nodes.exists > 0)
            points, normals = (part.flatten(0, 1)[index] for part in nodes[:2])
            model = view.camera.project_with_derivatives(points)
            normal = view.camera.image_normals(model, normals)
            assert view.edge_field is not None
            node, distance, _ = term.search(model.uv, normal, view.edge_field)
            near = (distance.abs() - term.window).abs() < NEAR_END_PX
            clear[index[node[near]] // nodes.exists.shape[-1]] = False
    return clear


def compare(cost: TrackingCost, x: Tensor, dtype: Any) -> tuple[float, float]:
    """Largest differences of values and derivatives, as shares of what is allowed."""
    eager = replace(cost, engine=None).local_model(x)
    engine = replace(cost, engine=FusedEngine(dtype))
    fused = engine.local_model(x)
    allowed = NATS[dtype] + RELATIVE[dtype] * eager.value.abs()
    moved = x + 0.01 * torch.cos(100 * x)  # some way from where matches are found
    apart = [(found - eager.value).abs() / allowed for found in (fused.value, engine.value(x))]
    held = engine.held_value(moved, x), replace(cost, engine=None).held_value(moved, x)
    apart.append((held[0] - held[1]).abs() / (NATS[dtype] + RELATIVE[dtype] * held[1].abs()))
    value = float(torch.stack(apart).max())  # NaN if any is
    if dtype == "float32":
        return value, 0.0 if all(bool(part.isfinite().all()) for part in fused) else math.nan
    largest = [
        (a - b).abs().flatten(1).amax(1) / (1 + b.abs().flatten(1).amax(1))
        for a, b in zip(fused[1:], eager[1:], strict=True)
    ]
    return value, float(torch.stack(largest).max() / NATS[dtype])


def run_case(seed: int, name: str, states: int) -> tuple[list[Difference], int]:
    """What differs in a case, one row a precision, and how many states were left out."""
    cost, x = make_case(seed, name, states)
    clear = apart_from_ends(cost, x)
    index = clear.nonzero()[:, 0]
    cost, x, found = cost.take(index), x[index], []
    for dtype in NATS:
        value, derivatives = compare(cost, x, dtype) if len(x) else (0.0, 0.0)
        row = Difference(seed, name, dtype, value, derivatives, ())
        if row.fails:
            every = [term.name for term in cost.choice.terms]
            alone = {n: replace(cost, choice=cost.choice.only([n])) for n in every}
            apart = {n: Difference(seed, name, dtype, *compare(alone[n], x, dtype), ())
                     for n in every}  # fmt: skip
            row = row._replace(terms=tuple(n for n in every if apart[n].fails))
        found.append(row)
    return found, states - len(x)


def compare_engines(config: Config) -> dict[str, Any]:
    """Try all cases, print those that differ; return what is written."""
    torch.set_num_threads(1)
    rows: list[Difference] = []
    left_out = 0
    for seed in range(config.first, config.first + config.cases):
        name = config.bodies[seed % len(config.bodies)]
        found, some = run_case(seed, name, config.states)
        rows, left_out = [*rows, *found], left_out + some
        for row in found:
            if row.fails:
                print(f"seed {row.seed}, {row.body}, {row.dtype}: {row.value:.1e} of what values "
                      f"may differ, {row.derivatives:.1e} of derivatives; "
                      f"{', '.join(row.terms) or 'no term alone'}", flush=True)  # fmt: skip
    failed = [row for row in rows if row.fails]
    for dtype in NATS:
        own = [row for row in rows if row.dtype == dtype]
        values, derivatives = np.max([(row.value, row.derivatives) for row in own], 0)
        print(f"{dtype}: values within {values:.1e} of {NATS[dtype]:g} nats, derivatives "
              f"{derivatives:.1e}")  # fmt: skip
    print(f"{config.cases} cases, {len({row.seed for row in failed})} differ, {left_out} states "
          "left out")  # fmt: skip
    report = {"failed": [row._asdict() for row in failed], "left_out": left_out, "config": config}
    write_report(config.out, report)
    return report


def main(config: Config) -> None:
    """Exit with 1 where a case differs."""
    if compare_engines(config)["failed"]:
        sys.exit(1)


if __name__ == "__main__":
    start(main, Config, __doc__)

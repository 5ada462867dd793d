"""From terms that are bound to a frame to the records that kernels read.

A function returns None where the compiled twin does not know a term's numbers, such as another
potential: the eager engine then evaluates it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.cost.anthropometric import Anthropometric, proportion_columns
from torchcss.cost.context import FrameContext
from torchcss.cost.contour import ContourTerm
from torchcss.cost.flow import FlowTerm
from torchcss.cost.fused.edges import ASSIGNMENTS
from torchcss.cost.fused.potentials import KINDS
from torchcss.cost.fused.records import (
    Array,
    Colours,
    Curves,
    Edges,
    Flow,
    Gaussian,
    Lens,
    Limbs,
    LimbScratch,
    Lines,
    LongTails,
    Mixture,
    Nodes,
    PackedKeypoints,
    Parts,
    Peaks,
    Points,
    Potential,
    PriorScratch,
    Rays,
    Repulsion,
    Seen,
    Tree,
    Workspace,
)
from torchcss.cost.interior import InteriorNodes
from torchcss.cost.interpenetration import END, Interpenetration, InterpenetrationPairs
from torchcss.cost.joints import OUTLIER_LENGTHS, JointTerm
from torchcss.cost.pose_prior import TRUNK, BodyDensity, Directions, Group, side_of
from torchcss.cost.region import RegionTerm
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.temporal import MixturePrior, TemporalPrior
from torchcss.cost.term import OnPoints
from torchcss.cost.visibility import BEHIND, ContourPredictor, tabulate_parts
from torchcss.robust import RobustPotential
from torchcss.vision.camera import GRAZING_RADIUS, Camera

Real = Any
"""`np.float32` or `np.float64`."""


def array(tensor: Tensor, real: Real) -> Array:
    """A tensor as contiguous numbers of a type."""
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=real)


def pack_tree(body: BodyModel, camera: Camera) -> Tree:
    """A body's tree before a camera."""
    tree, double = body.tree, np.float64
    above = tree.joint_ancestors.cpu().numpy()
    depth = above.sum(0)
    parent = np.zeros(len(depth), np.int64)
    for joint in range(len(depth)):
        row = np.flatnonzero(above[:, joint] & (depth == depth[joint] - 1))
        parent[joint] = 1 + row[0] if len(row) else 0
    tie = array(body.tie, double)
    column = np.abs(tie).argmax(1)
    turn = array(camera.R_camera_world, double)
    base = np.empty((3, 4))
    base[:, :3] = turn @ array(body.base_rotation, double)
    base[:, 3] = turn @ array(body.base_translation, double) + array(camera.t_camera_world, double)
    return Tree(
        column=column,
        factor=tie[np.arange(len(column)), column],
        offset=array(body.offset, double),
        parent=parent,
        constant=array(tree.joint_constant[tree.joint_place - 1][:, :3], double),
        revolute=tree.is_revolute.cpu().numpy(),
        base=base,
    )


def carried(body: BodyModel, link: Tensor, own: Tensor) -> tuple[Array, Array]:
    """Rows of the frames that carry some links, and what is fixed in the links in these frames."""
    tree = body.tree
    place = tree.link_place[link]
    row = torch.where(place > 0, 1 + tree.joint_order[(place - 1).clamp(min=0)], 0)
    constant = (tree.link_constant[link][:, :3] @ own).double()
    return row.cpu().numpy(), np.ascontiguousarray(constant.cpu().numpy())


def pack_parts(body: BodyModel, predictor: ContourPredictor | None, real: Real) -> Parts:
    """A body's parts, and what they hide."""
    num, like = body.num_parts, body.tie
    own = torch.cat([body.part_rotation, body.part_translation[:, :, None]], dim=2)
    last = like.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(num, 1, 4)
    row, constant = carried(body, body.part_link, torch.cat([own, last], dim=1))
    ramp = 0.010 if predictor is None else predictor.ramp
    clearance = 0.005 if predictor is None else predictor.clearance
    table = tabulate_parts(body.part_shape, ramp)
    touching = np.zeros((num, num), bool)
    for first, second in body.neighbours:
        i, j = body.part_names.index(first), body.part_names.index(second)
        touching[i, j] = touching[j, i] = i != j
    return Parts(
        row=row,
        constant=constant,
        shape=array(table.table, real),
        radius=array(table.radius, real),
        around=array(table.around, real),
        within=array(table.within, real),
        behind=array(BEHIND * body.part_shape[:, :2].mean(-1), real),
        plain=table.plain.cpu().numpy(),
        touching=touching,
        ramp=real(ramp),
        clearance=real(clearance),
    )


def pack_lens(camera: Camera, real: Real) -> Lens:
    """A camera's lens."""
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    k1, k2, p1, p2, k3 = camera.distortion.tolist()
    limit = min(float(camera.maximum_radius), GRAZING_RADIUS)
    numbers = [real(value) for value in (fx, fy, cx, cy, k1, k2, p1, p2, k3)]
    width, height = camera.image_size_wh
    rest = [real(value) for value in (camera.near, limit, width, height)]
    return Lens(*numbers, camera.has_distortion, *rest)  # type: ignore[arg-type]


def pack_curves(predictor: ContourPredictor | None, num_parts: int, real: Real) -> Curves:
    """The curves on which contours are found; none at all without a predictor."""
    if predictor is None:
        return Curves(np.zeros((num_parts, 10, 0), real), 0, 0, 0, 0)
    curves = [predictor.rings, predictor.meridians]
    flat = torch.cat([part.flatten(1, 2) for part in curves], dim=1).double()
    along = (flat[..., :3] * flat[..., 3:6]).sum(-1, keepdim=True)
    table = torch.cat([flat, along], dim=-1).mT
    sizes = [size for part in curves for size in part.shape[1:3]]
    return Curves(array(table, real), *sizes)


def pack_potential(potential: RobustPotential, real: Real) -> Potential | None:
    """A potential, None: kernels do not know it."""
    if type(potential) not in KINDS:
        return None
    kind = KINDS.index(type(potential))
    return Potential(kind, real(potential.nu), real(potential.sigma**2))


def no_potential(real: Real) -> Potential:
    """What stands where nothing is compared."""
    return Potential(0, real(1), real(1))


def pack_edges(
    term: ContourTerm, bound: OnPoints, weight: float, context: FrameContext, real: Real
) -> Edges | None:
    """The contour term of a frame."""
    field, potential = bound.image, pack_potential(term.potential, real)
    height, width = field.shape[1:]
    if potential is None or min(height, width) < 2:
        return None
    reach = math.ceil(term.window / term.step) + 2
    back_facing = term.fitted_level * term.nu
    return Edges(
        scale=real(weight * bound.scale),
        field=array(field.movedim(0, -1), real),
        corner=np.array([width - 1, height - 1], real),
        steps=(term.step * np.arange(-reach, reach + 1)).astype(real),
        step=real(term.step),
        window=real(term.window),
        unmatched=real(term.unmatched),
        back_facing=real(back_facing),
        hidden=real(term.occlusion_factor * back_facing),
        potential=potential,
        assignment=ASSIGNMENTS.index(term.assignment),
        strength=term.strength,
        least=real(term.least_edge),
    )


def no_edges(real: Real) -> Edges:
    """Without the contour term."""
    zero = real(0)
    steps, field = np.zeros(5, real), np.zeros((2, 2, 2), real)
    corner, potential = np.ones(2, real), no_potential(real)
    return Edges(
        zero, field, corner, steps, zero, zero, zero, zero, zero, potential, 0, False, zero
    )


def pack_colours(
    term: RegionTerm, bound: OnPoints, weight: float, context: FrameContext, real: Real
) -> Colours:
    """The region term of a frame."""
    images, back_facing = bound.image, term.fitted_level * term.nu
    coefficients = images.field.coefficients
    height, width = coefficients.shape[1:]
    layer = images.layer[:: max(1, len(images.layer) // max(1, context.body.num_parts))]
    return Colours(
        scale=real(weight * bound.scale),
        field=array(coefficients, real),
        corner=np.array([width - 6.5, height - 6.5], real),
        layer=np.ascontiguousarray(layer.cpu().numpy()),
        offset=real(term.offset),
        nu=real(term.nu),
        back_facing=real(back_facing),
        hidden=real(term.occlusion_factor * back_facing),
    )


def no_colours(num_parts: int, real: Real) -> Colours:
    """Without the region term."""
    zero, layer = real(0), np.zeros(num_parts, np.int64)
    return Colours(zero, np.zeros((1, 8, 8), real), np.ones(2, real), layer, *(zero,) * 4)


def pack_flow(
    term: FlowTerm, bound: OnPoints, weight: float, context: FrameContext, real: Real
) -> Flow | None:
    """The flow term of a frame."""
    nodes, targets = context.tables.of(InteriorNodes), bound.image
    potential = pack_potential(term.potential, real)
    if potential is None:
        return None
    table = torch.cat([nodes.points_part, nodes.normals_part], dim=-1).mT
    rows = torch.cat([targets.uv, targets.weight[..., None]], dim=-1).mT
    back_facing = term.fitted_level * term.nu
    return Flow(
        scale=real(weight * bound.scale),
        nodes=array(table, real),
        target=array(rows.reshape(len(rows), 3, *table.shape[::2]), real),
        back_facing=real(back_facing),
        untold=real(term.untold),
        hidden=real(term.occlusion_factor * back_facing),
        far=real(math.hypot(*context.camera.image_size_wh) ** 2),
        potential=potential,
    )


def no_flow(num_parts: int, real: Real) -> Flow:
    """Without the flow term."""
    nodes, target = np.zeros((num_parts, 6, 0), real), np.zeros((1, 3, num_parts, 0), real)
    zero, potential = real(0), no_potential(real)
    return Flow(zero, nodes, target, zero, zero, zero, zero, potential)


def pack_keypoints(
    term: JointTerm, bound: OnPoints, weight: float, context: FrameContext, _: Real
) -> PackedKeypoints | None:
    """The keypoints of a frame."""
    real, body, (joint, position, precision) = np.float64, context.body, bound.image
    potential = pack_potential(term.potential, real)
    if potential is None:
        return None
    offset = body.marker_offset[joint]
    homogeneous = torch.cat([offset, torch.ones_like(offset[:, :1])], dim=1)[:, :, None]
    row, place = carried(body, bound.link, homogeneous)
    target = torch.cat([position, precision[..., None]], dim=-1).mT
    return PackedKeypoints(
        scale=real(weight * bound.scale),
        row=row,
        place=place[:, :, 0].copy(),
        target=array(target.reshape(-1, *target.shape[-2:]), real),
        far=real((OUTLIER_LENGTHS * term.sigma) ** 2),
        potential=potential,
    )


def no_keypoints() -> PackedKeypoints:
    """Without keypoints."""
    real = np.float64
    row, place = np.zeros(0, np.int64), np.zeros((0, 3))
    return PackedKeypoints(
        real(0), row, place, np.zeros((1, 3, 0), real), real(0), no_potential(real)
    )


def pack_repulsion(
    term: Interpenetration, pairs: InterpenetrationPairs, weight: float, real: Real
) -> Repulsion:
    """The repulsion between the parts of a body."""
    num = len(pairs.nodes)
    pair = np.full((num, num), -1)
    pair[pairs.first.cpu().numpy(), pairs.second.cpu().numpy()] = np.arange(pairs.num_pairs)
    inner = array(pairs.nodes.abs().amax(dim=1), real)
    outer = array(term.reach * pairs.extent, real)
    size = pairs.nodes.shape[1]
    spheres = np.linalg.norm(inner, axis=1)[:, None] + np.linalg.norm(outer, axis=1)
    numbers = (
        *(weight * term.weight / size, term.p, term.sharpness),
        *(END ** (1 / term.p), term.reach**2, END, math.exp(-END)),
    )
    return Repulsion(
        *(real(number) for number in numbers),  # type: ignore[arg-type]
        spheres=spheres,
        nodes=array(pairs.nodes.mT, real),
        shape=array(pairs.table, real),
        inner=inner,
        outer=outer,
        pair=pair,
        chain=pairs.chain.cpu().numpy(),
        sign=array(pairs.sign, np.float64),
    )


def make_workspace(
    tree: Tree, curves: Curves, interior: int, chain: int, samples: tuple[int, Any]
) -> Workspace:
    """Memory for one state.

    Args:
        tree: The body's tree.
        curves: The curves on its parts.
        interior: Number of nodes all over the surface of a part.
        chain: Longest chain of joints between two parts.
        samples: Number of samples on a search line, and the precision.
    """
    steps, real = samples
    num_parts, num_joints = len(curves.table), len(tree.parent)
    outline = 2 * num_parts * (curves.rings + curves.meridians)
    nodes = max(outline, num_parts * interior, 1)

    def fields(kind: Any, size: int, whole: Sequence[str] = (), first: int = 0) -> Any:
        made = {name: np.zeros(size, np.int64 if name in whole else real) for name in kind._fields}
        if first:
            made["first"] = np.zeros(first, np.int64)
        return kind(**made)

    # Every node may be before or behind every part, or inside; one more, to be overwritten.
    pairs = nodes * max(num_parts, 1) + 1
    return Workspace(
        frames=np.zeros((1 + num_joints, 3, 4)),
        frame=np.zeros((3, 4)),
        posed=np.zeros((num_parts, 3, 4), real),
        reference=np.zeros(3),
        twists=np.zeros((num_joints, 6)),
        moved=np.zeros((max(chain, 1), 6)),
        sums=np.zeros((1 + num_joints, 33)),
        facing=np.zeros(curves.table.shape[2], real),
        outline=fields(Nodes, nodes, first=num_parts + 1),
        interior=fields(Nodes, nodes, first=num_parts + 1),
        rays=fields(Rays, nodes),
        near=fields(Lines, nodes, whole=("ray", "part")),
        lines=fields(Lines, pairs, whole=("ray", "part")),
        points=fields(Points, max(pairs, 64), first=num_parts + 1),
        seen=fields(Seen, nodes, whole=("node", "part"), first=nodes + 1),
        peaks=fields(Peaks, nodes * (steps // 2)),
        response=np.zeros(steps, real),
        maxima=np.zeros(steps, np.int64),
    )


def pack_limbs(body: BodyModel, density: BodyDensity, scale: float, camera: Camera) -> Limbs:
    """The prior on poses, its directions in the camera's frame."""
    double, which = np.float64, density.which
    link, offset = body.marker_link[which.joint], body.marker_offset[which.joint]
    homogeneous = torch.cat([offset, torch.ones_like(offset[:, :1])], dim=1)[:, :, None]
    row, place = carried(body, link, homogeneous)
    above = array(body.tree.ancestors[:, link], double)
    difference = array(which.difference, double)
    parts = [density.densities[group.name] for group in which.groups]
    number, size = (max(part.mean.shape[axis] for part in parts) for axis in (0, 1))
    mean, height = (np.zeros((len(parts), number, *more)) for more in ((size,), ()))
    precision = np.zeros((len(parts), number, size, size))
    for g, part in enumerate(parts):
        k, d = part.mean.shape
        mean[g, :k, :d], height[g, :k] = array(part.mean, double), array(part.height, double)
        precision[g, :k, :d, :d] = array(part.precision, double)
    return Limbs(
        scale=scale,
        row=row,
        place=place[:, :, 0].copy(),
        above=above,
        difference=difference,
        fixed=array(which.fixed, double) @ array(camera.R_camera_world, double).T,
        first=np.array([group.row.start for group in which.groups]),
        segments=np.array([len(group.known) for group in which.groups]),
        line=np.array([group.line for group in which.groups]),
        side=np.stack([array(side_of(group.name, body.tie), double) for group in which.groups]),
        bends=np.stack([_bends(group, which, above) for group in which.groups]),
        number=np.array([len(part.mean) for part in parts]),
        mean=mean,
        precision=precision,
        height=height,
        uniform=np.array([part.uniform for part in parts]),
    )


def _bends(group: Group, which: Directions, above: Array) -> Array:
    """The joints that move some but not all of what a group's directions are made from."""
    segments = [group.line, TRUNK, *range(group.row.start, group.row.stop)]
    ends = array((which.difference[segments] != 0).any(0), bool)
    share = above[:, ends].mean(axis=1)
    return (share > 0) & ((share < 1) | bool(which.fixed[segments].any()))


def make_limb_scratch(tree: Tree, limbs: Limbs, num_parameters: int) -> LimbScratch:
    """Memory for the prior on poses of one state."""
    joints, (segments, points) = len(tree.parent), limbs.difference.shape
    number, size = limbs.mean.shape[1:]
    shapes = dict(
        frames=(1 + joints, 3, 4), reference=(3,), twists=(joints, 6), point=(points, 3),
        velocity=(points, 3), unit=(segments, 3), length=(segments,), moved=(joints, segments, 3),
        axes=(2, 3, 3), normal=(2,), spin=(joints, 2, 3), turned=(3,), direction=(size,),
        slope=(num_parameters, size), share=(number,), pulls=(number, size), pull=(size,),
        bend=(size, size), bent=(size,),
    )  # fmt: skip
    return LimbScratch(
        **{name: np.zeros(shape) for name, shape in shapes.items()},
        touched=np.zeros(num_parameters, bool),
    )


def make_prior_scratch(mixture: Mixture) -> PriorScratch:
    """Memory for the priors on the state."""
    modes, size = mixture.mean.shape
    return PriorScratch(np.zeros(size), np.zeros(modes), np.zeros((modes, size)))


def pack_priors(
    priors: Sequence[tuple[Any, float]], context: FrameContext
) -> tuple[LongTails, Gaussian, Mixture]:
    """The priors on the state of a frame, with their weights."""
    body, size = context.body, context.body.num_parameters
    tails: list[tuple[float, float, Array, Array]] = []
    gaussian = Gaussian(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 0)))
    mixture = Mixture(0.0, 1.0, 1.0, np.zeros((0, size)), np.zeros((0, size, size)), np.zeros(0))
    for term, weight in priors:
        if isinstance(term, Stabiliser):
            mean = array(body.sticky_mean[None], np.float64)
            tails.append((weight, term.nu, mean, _sharpness(term.deviation(body))))
        elif isinstance(term, TemporalPrior):
            assert context.prior is not None
            assert context.deviation is not None
            mean = array(context.prior.mean, np.float64)
            tails.append((weight, term.nu, mean, _sharpness(context.deviation)))
        elif isinstance(term, Anthropometric):
            columns = list(proportion_columns(body).values())
            mean = body.sticky_mean
            precision = term.local_model(mean, body).hessian[columns][:, columns]
            gaussian = Gaussian(
                np.array(columns),
                array(mean[columns], np.float64),
                weight * array(precision, np.float64),
            )
        elif isinstance(term, MixturePrior):
            assert context.prior is not None
            density = term.density(context.prior)
            most = float(density.precision.amax())
            far = 1e-4 * (torch.finfo(body.dtype).max / most) ** 0.5
            fields = (array(field, np.float64) for field in density)
            mixture = Mixture(weight, term.height(size), far, *fields)
    modes = max((len(centre) for _, _, centre, _ in tails), default=1)
    centre = np.zeros((len(tails), modes, size))
    for row, (_, _, mean, _) in enumerate(tails):
        centre[row] = mean
    sharpness = np.array([row for *_, row in tails]).reshape(-1, size)
    weight, nu = (np.array([tail[k] for tail in tails]) for k in (0, 1))
    return LongTails(weight, nu, centre, sharpness), gaussian, mixture


def _sharpness(deviation: Tensor) -> Array:
    return 1 / array(deviation, np.float64)

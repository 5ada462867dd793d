"""From terms that are bound to a frame to the records that kernels read.

A function returns None where the compiled twin does not know a term's numbers, such as another
potential: the eager engine then evaluates it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from torchcss.body.kinematics import KinematicTree
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
    PairScratch,
    Parts,
    Peaks,
    Points,
    Potential,
    PriorScratch,
    Rays,
    Repulsion,
    Seen,
    Targets,
    TargetScratch,
    Tree,
    Workspace,
)
from torchcss.cost.interior import InteriorNodes
from torchcss.cost.interpenetration import END, Interpenetration, InterpenetrationPairs
from torchcss.cost.joints import OUTLIER_LENGTHS, JointTerm
from torchcss.cost.pose_prior import TRUNK, BodyDensity, Directions, Group, side_of
from torchcss.cost.region import RegionTerm
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.targets import PointTargets
from torchcss.cost.temporal import MixturePrior, TemporalPrior
from torchcss.cost.term import OnPoints
from torchcss.cost.visibility import BEHIND, CLEARANCE, RAMP, ContourPredictor, tabulate_parts
from torchcss.robust import RobustPotential
from torchcss.vision.camera import GRAZING_RADIUS, Camera

Real = Any
"""`np.float32` or `np.float64`."""

_Record = TypeVar("_Record", bound=tuple[Any, ...])


def array(tensor: Tensor, real: Real = np.float64) -> Array:
    """A tensor as contiguous numbers of a type."""
    return np.ascontiguousarray(tensor.numpy(force=True), dtype=real)


def in_precision(record: _Record, real: Real) -> _Record:
    """A record with its tensors and plain numbers in a precision; what NumPy has made stays."""

    def converted(value: Any) -> Any:
        if isinstance(value, Tensor):
            return array(value, real)
        if isinstance(value, tuple):
            return in_precision(value, real)
        return real(value) if type(value) in (int, float) else value

    fields: Any = record
    return fields._make(map(converted, record))


def pack_tree(body: BodyModel, camera: Camera | None) -> Tree:
    """A body's tree before a camera; None: in the world."""
    tree = body.tree
    tie = array(body.tie)
    column = np.abs(tie).argmax(1)
    turn, shift = np.eye(3), np.zeros(3)
    if camera is not None:
        turn, shift = array(camera.R_camera_world), array(camera.t_camera_world)
    base = np.empty((3, 4))
    base[:, :3] = turn @ array(body.base_rotation)
    base[:, 3] = turn @ array(body.base_translation) + shift
    return Tree(
        column=column,
        factor=tie[np.arange(len(column)), column],
        offset=array(body.offset),
        parent=_row(tree, tree.joint_above[tree.joint_place - 1]),
        constant=array(tree.joint_constant[tree.joint_place - 1][:, :3]),
        revolute=tree.is_revolute.cpu().numpy(),
        base=base,
    )


def carried(body: BodyModel, link: Tensor, own: Tensor) -> tuple[Array, Array]:
    """Rows of the frames that carry some links, and what is fixed in the links in these frames."""
    tree = body.tree
    return _row(tree, tree.link_place[link]), array(tree.link_constant[link][:, :3] @ own)


def _row(tree: KinematicTree, place: Tensor) -> Array:
    """Row of the kernels' frames, which are in the order of the state, of frames by depth."""
    row = torch.where(place > 0, 1 + tree.joint_order[(place - 1).clamp(min=0)], 0)
    return row.cpu().numpy()


def carried_markers(body: BodyModel, marker: Tensor) -> tuple[Array, Array]:
    """Rows of the frames that carry some joint centres, and their places in these frames."""
    return _carried_points(body, body.marker_link[marker], body.marker_offset[marker])


def _carried_points(body: BodyModel, link: Tensor, offset: Tensor) -> tuple[Array, Array]:
    homogeneous = torch.cat([offset, torch.ones_like(offset[:, :1])], dim=1)[:, :, None]
    row, place = carried(body, link, homogeneous)
    return row, place[:, :, 0].copy()


def pack_parts(body: BodyModel, real: Real) -> Parts:
    """A body's parts, and what they hide."""
    num, like = body.num_parts, body.tie
    own = torch.cat([body.part_rotation, body.part_translation[:, :, None]], dim=2)
    last = like.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(num, 1, 4)
    row, constant = carried(body, body.part_link, torch.cat([own, last], dim=1))
    table = tabulate_parts(body.part_shape)
    parts = Parts(
        row=row,
        constant=constant,
        shape=table.table,
        radius=table.radius,
        around=table.around,
        within=table.within,
        behind=BEHIND * body.part_shape[:, :2].mean(-1),
        plain=table.plain.cpu().numpy(),
        touching=body.touching.cpu().numpy(),
        ramp=RAMP,
        clearance=CLEARANCE,
    )
    return in_precision(parts, real)


def pack_lens(camera: Camera) -> Lens:
    """A camera's lens."""
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    limit = min(float(camera.maximum_radius), GRAZING_RADIUS)
    width, height = camera.image_size_wh
    return Lens(
        *(fx, fy, cx, cy),
        *camera.distortion.tolist(),
        distorts=camera.has_distortion,
        near=camera.near,
        limit=limit,
        width=float(width),
        height=float(height),
    )


def pack_curves(predictor: ContourPredictor | None, parts: Parts, real: Real) -> Curves:
    """The curves on which contours are found; none at all without a predictor."""
    if predictor is None:
        return Curves(np.zeros((len(parts.row), 10, 0), real), 0, 0, 0, 0)
    curves = [predictor.rings, predictor.meridians]
    flat = torch.cat([part.flatten(1, 2) for part in curves], dim=1).double()
    along = (flat[..., :3] * flat[..., 3:6]).sum(-1, keepdim=True)
    table = torch.cat([flat, along], dim=-1).mT
    sizes = [size for part in curves for size in part.shape[1:3]]
    return Curves(array(table, real), *sizes)


def pack_potential(potential: RobustPotential) -> Potential | None:
    """A potential, None: kernels do not know it."""
    if type(potential) not in KINDS:
        return None
    kind = np.int64(KINDS.index(type(potential)))
    return Potential(kind, float(potential.nu), float(potential.sigma**2))


def absent(parts: Parts, real: Real) -> dict[str, Any]:
    """Records of image terms that are not there, by their fields in `View`; their scale is zero."""
    num_parts, zeros, kind = len(parts.row), torch.zeros, np.int64(0)
    whole = np.zeros(num_parts, np.int64)
    image, compared = {"field": zeros(2, 8, 8), "corner": torch.ones(2)}, Potential(kind, 1.0, 1.0)
    keypoints = _zero(PackedKeypoints)._replace(
        row=whole[:0], place=np.zeros((0, 3)), target=zeros(1, 3, 0), potential=compared
    )
    records = {
        "edges": _zero(Edges)._replace(
            **image, steps=zeros(5), assignment=kind, strength=False, potential=compared
        ),
        "colours": _zero(Colours)._replace(**image, origin=zeros(2), layer=whole),
        "flow": _zero(Flow)._replace(
            nodes=zeros(num_parts, 6, 0), target=zeros(1, 3, num_parts, 0), potential=compared
        ),
        "keypoints": in_precision(keypoints, np.float64),
    }
    return {name: in_precision(record, real) for name, record in records.items()}


def _zero(record: Any) -> Any:
    return record._make([0.0] * len(record._fields))


def pack_edges(term: ContourTerm, bound: OnPoints, context: FrameContext) -> Edges | None:
    """The contour term of a frame."""
    field, potential = bound.image, pack_potential(term.potential)
    height, width = field.shape[1:]
    if potential is None or min(height, width) < 2:
        return None
    reach = math.ceil(term.window / term.step) + 2
    # In whole eights, which are sampled at once; edges beyond the window count nothing.
    count = 8 * math.ceil((2 * reach + 1) / 8)
    back_facing = term.fitted_level * term.nu
    return Edges(
        scale=bound.scale,
        field=field.movedim(0, -1),
        corner=torch.tensor([width - 1.0, height - 1.0]),
        steps=term.step * torch.arange(-reach, count - reach).double(),
        step=term.step,
        window=term.window,
        unmatched=term.unmatched,
        back_facing=back_facing,
        hidden=term.occlusion_factor * back_facing,
        potential=potential,
        assignment=np.int64(ASSIGNMENTS.index(term.assignment)),
        strength=term.strength,
        least=term.least_edge,
    )


def pack_colours(term: RegionTerm, bound: OnPoints, context: FrameContext) -> Colours:
    """The region term of a frame."""
    images, back_facing = bound.image, term.fitted_level * term.nu
    coefficients = images.field.coefficients
    height, width = coefficients.shape[1:]
    layer = images.layer[:: max(1, len(images.layer) // max(1, context.body.num_parts))]
    return Colours(
        scale=bound.scale,
        field=coefficients,
        origin=torch.tensor(images.origin).to(coefficients),
        corner=torch.tensor([width - 6.5, height - 6.5]),
        layer=np.ascontiguousarray(layer.cpu().numpy()),
        offset=term.offset,
        nu=term.nu,
        back_facing=back_facing,
        hidden=term.occlusion_factor * back_facing,
    )


def pack_flow(term: FlowTerm, bound: OnPoints, context: FrameContext) -> Flow | None:
    """The flow term of a frame."""
    nodes, targets = context.tables.of(InteriorNodes), bound.image
    potential = pack_potential(term.potential)
    if potential is None:
        return None
    table = torch.cat([nodes.points_part, nodes.normals_part], dim=-1).mT
    rows = torch.cat([targets.uv, targets.weight[..., None]], dim=-1).mT
    back_facing = term.fitted_level * term.nu
    return Flow(
        scale=bound.scale,
        nodes=table,
        target=rows.reshape(len(rows), 3, *table.shape[::2]),
        back_facing=back_facing,
        untold=term.untold,
        hidden=term.occlusion_factor * back_facing,
        far=math.hypot(*context.camera.image_size_wh) ** 2,
        potential=potential,
    )


def pack_keypoints(
    term: JointTerm, bound: OnPoints, context: FrameContext
) -> PackedKeypoints | None:
    """The keypoints of a frame, in double precision for all engines."""
    joint, position, precision = bound.image
    potential = pack_potential(term.potential)
    if potential is None:
        return None
    row, place = carried_markers(context.body, joint)
    target = torch.cat([position, precision[..., None]], dim=-1).mT
    record = PackedKeypoints(
        scale=bound.scale,
        row=row,
        place=place,
        target=target.reshape(-1, *target.shape[-2:]),
        far=(OUTLIER_LENGTHS * term.sigma) ** 2,
        potential=potential,
    )
    return in_precision(record, np.float64)


def pack_repulsion(term: Interpenetration, pairs: InterpenetrationPairs, real: Real) -> Repulsion:
    """The repulsion between the parts of a body; the caller sets its scale."""
    num = len(pairs.nodes)
    pair = np.full((num, num), -1)
    pair[pairs.first.cpu().numpy(), pairs.second.cpu().numpy()] = np.arange(pairs.num_pairs)
    inner = array(pairs.nodes.abs().amax(dim=1), real)
    outer = array(term.reach * pairs.extent, real)
    repulsion = Repulsion(
        scale=1.0,
        p=term.p,
        sharpness=term.sharpness,
        end=END ** (1 / term.p),
        reach=term.reach**2,
        exponent=END,
        last=math.exp(-END),
        spheres=np.linalg.norm(inner, axis=1)[:, None] + np.linalg.norm(outer, axis=1),
        nodes=pairs.nodes.mT,
        shape=pairs.table,
        inner=inner,
        outer=outer,
        pair=pair,
        chain=pairs.chain.cpu().numpy(),
        sign=array(pairs.sign),
    )
    return in_precision(repulsion, real)


def make_workspace(tree: Tree, curves: Curves, sizes: tuple[int, ...], real: Real) -> Workspace:
    """Memory for one state.

    Args:
        tree: The body's tree.
        curves: The curves on its parts.
        sizes: Number of nodes all over the surface of a part, longest chain of joints between two
            parts, number of samples on a search line, and of keypoints.
        real: The precision.
    """
    interior, chain, steps, keypoints = sizes
    num_parts, num_joints = len(curves.table), len(tree.parent)
    outline = 2 * num_parts * (curves.rings + curves.meridians)
    nodes = max(outline, num_parts * interior, 1)

    def fields(kind: Any, size: int, first: int = 0) -> Any:
        # Short numbers: a processor looks up eight at a time by them, of the long ones four.
        types = {**dict.fromkeys(("ray", "part", "node", "sample"), np.int32), "first": np.int64}
        return kind(
            *(
                np.zeros(first if name == "first" else size, types.get(name, real))
                for name in kind._fields
            )
        )

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
        near=fields(Lines, nodes),
        lines=fields(Lines, pairs),
        points=fields(Points, max(pairs, keypoints), first=num_parts + 1),
        seen=fields(Seen, nodes, first=nodes + 1),
        peaks=fields(Peaks, nodes * (steps // 2)),
        response=np.zeros(nodes * steps, real),
    )


def make_pair_scratch(
    tree: Tree, curves: Curves, sizes: tuple[int, ...], real: Real
) -> PairScratch:
    """Memory for the repulsion of one state; see `make_workspace`."""
    whole = make_workspace(tree, curves, sizes, real)._asdict()
    return PairScratch(*(whole[name] for name in PairScratch._fields))


def pack_limbs(body: BodyModel, density: BodyDensity) -> Limbs:
    """The prior on poses, with its fixed directions in the world's frame."""
    which = density.which
    row, place = carried_markers(body, which.joint)
    above = array(body.tree.ancestors[:, body.marker_link[which.joint]], bool)
    parts = [density.densities[group.name] for group in which.groups]
    number, size = (max(part.mean.shape[axis] for part in parts) for axis in (0, 1))
    mean, precision = (np.zeros((len(parts), *shape, number)) for shape in ((size,), (size, size)))
    height = np.zeros((len(parts), number))
    for g, part in enumerate(parts):
        k, d = part.mean.shape
        mean[g, :d, :k], height[g, :k] = array(part.mean.T), array(part.height)
        precision[g, :d, :d, :k] = array(part.precision.movedim(0, -1))
    difference = array(which.difference)
    # Those that it is made from come first, in their order.
    end = np.argsort(difference == 0, axis=1, kind="stable")[:, : (difference != 0).sum(1).max()]
    return Limbs(
        scale=1.0,
        row=row,
        place=place,
        above=above,
        end=np.ascontiguousarray(end),
        difference=np.take_along_axis(difference, end, 1),
        moves=above @ (difference != 0).T,
        fixed=array(which.fixed),
        first=np.array([group.row.start for group in which.groups]),
        segments=np.array([len(group.known) for group in which.groups]),
        line=np.array([group.line for group in which.groups]),
        side=np.stack([array(side_of(group.name, body.tie)) for group in which.groups]),
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
    joints, segments, points = len(tree.parent), len(limbs.end), len(limbs.row)
    size, number = limbs.mean.shape[1:]
    shapes = dict(
        frames=(1 + joints, 3, 4), reference=(3,), twists=(joints, 6), point=(points, 3),
        velocity=(points, 3), unit=(segments, 3), length=(segments,), moved=(joints, segments, 3),
        axes=(2, 3, 3), normal=(2,), spin=(joints, 2, 3), turned=(3,), direction=(size,),
        slope=(size, num_parameters), share=(number,), offset=(size, number),
        pulls=(size, number), pull=(size,), bend=(size, size), bent=(size, num_parameters),
    )  # fmt: skip
    return LimbScratch(
        **{name: np.zeros(shape) for name, shape in shapes.items()},
        touched=np.zeros(num_parameters, bool),
    )


def make_prior_scratch(mixture: Mixture) -> PriorScratch:
    """Memory for the priors on the state."""
    modes, size = mixture.mean.shape
    return PriorScratch(np.zeros(size), np.zeros(modes), np.zeros((modes, size)), np.zeros(size))


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
            mean = array(body.sticky_mean[None])
            tails.append((weight, term.nu, mean, _sharpness(term.deviation(body))))
        elif isinstance(term, TemporalPrior):
            assert context.prior is not None
            assert context.deviation is not None
            mean = array(context.prior.mean)
            tails.append((weight, term.nu, mean, _sharpness(context.deviation)))
        elif isinstance(term, Anthropometric):
            columns = list(proportion_columns(body).values())
            mean = body.sticky_mean
            precision = term.local_model(mean, body).hessian[columns][:, columns]
            gaussian = Gaussian(np.array(columns), array(mean[columns]), weight * array(precision))
        elif isinstance(term, MixturePrior):
            density = context.of(term.density_in)
            most = float(density.precision.amax())
            far = 1e-4 * (torch.finfo(body.dtype).max / most) ** 0.5
            fields = (array(field) for field in density)
            mixture = Mixture(weight, term.height(size), far, *fields)
    return _long_tails(tails, size), gaussian, mixture


def pack_targets(targets: PointTargets) -> tuple[Tree, Targets, LongTails, TargetScratch]:
    """Points against known places, with the stabilisers."""
    body, tree = targets.body, pack_tree(targets.body, None)
    row, own = _carried_points(body, targets.link, targets.offset)
    place = array(targets.target.reshape(-1, *own.shape))
    joints, rest, deviation = len(tree.parent), body.sticky_mean, body.sticky_deviation
    tails = [(1.0, Stabiliser.nu, array(rest[None]), _sharpness(deviation))][: targets.sticky]
    numbers = np.zeros((len(Points._fields) - 1, len(row)))
    points = Points._make([*numbers, np.zeros(0, np.int64)])
    frames, twists, sums = np.zeros((1 + joints, 3, 4)), np.zeros((joints, 6)), (1 + joints, 33)
    scratch = TargetScratch(frames, np.zeros(3), twists, np.zeros(sums), points)
    stiffness = array(targets.sigma.pow(-2))
    return tree, Targets(row, own, place, stiffness), _long_tails(tails, len(rest)), scratch


def _long_tails(tails: Sequence[tuple[float, float, Array, Array]], size: int) -> LongTails:
    """Priors of weight, height, centres and sharpness, one after the other."""
    modes = max((len(centre) for _, _, centre, _ in tails), default=1)
    centres = [np.broadcast_to(centre, (modes, size)) for _, _, centre, _ in tails]
    weight, nu, sharpness = (np.array([tail[k] for tail in tails]) for k in (0, 1, 3))
    centre, sharpness = np.reshape(centres, (-1, modes, size)), sharpness.reshape(-1, size)
    return LongTails(weight, nu, centre, sharpness)


def _sharpness(deviation: Tensor) -> Array:
    return 1 / array(deviation)

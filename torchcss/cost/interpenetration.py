"""Interpenetration: repulsive potentials between parts, section 3.2.4 [IJRR].

Every part B repels the surface nodes of every other part A that it may collide with:

    f_pa = weight * sum_(A, B) 1/N sum_(N nodes of A) phi(u),    u = f |f|^(p-1)

with the inside-outside function f of B, negative inside. The paper's `phi(u) = exp(-u)` decays
outside the surface; here its tangent at `u = c` is taken off,

    phi(u) = exp(-u) - exp(-c) (1 + c - u)    for u < c, else 0,

so that value and gradient vanish where the potential ends and far parts can be left out without a
jump (at c = 6 this takes 0.02 from the 1 at the surface).

The inside-outside function is `f = sharpness (R^2 - 1)` with the radial function R of
`torchcss.body.superquadric`: its slope does not depend on the exponents, and it is bounded inside
by `-sharpness`, so that the potential never exceeds `exp(sharpness^p)`, however deep. With p = 1
the push is strong from just outside the surface to deep inside and fades only at the very centre;
any p > 1 makes f |f|^(p-1) flat at the surface, so that nodes are not pushed all the way out.

Pairs that touch in every pose (`BodyModel.neighbours`) are left out, and so are pairs between which
no joint lies but those of lengths: they cannot move against each other in time.

The cost of a pair depends on where the nodes are in B's frame, `y = R_B^T (p - c_B)`. Joints above
both parts do not matter. The others form a chain that starts at B, climbs to the link where the
branches meet and descends to A; seen from B, a joint of B's own branch acts with the opposite sign,
and the order along the chain takes the place of that along the tree. With signed twists `t_j =
s_j (omega_j, v_j)` about the centre of B, the sums over the nodes of the pair and what they make of
the twists are those of `torchcss.body.lift`,

    gradient_j  = t_j . (tau, f)
    hessian_ij = t_i^T W t_j  for i before j or j itself,  W = K + [[P - tr(P) I, -[f]x], [0, 0]],

exact, the cross terms between the two branches included. The work over nodes does not depend on the
number of joints, and only pairs that are near each other are looked at.

Make `InterpenetrationPairs(body)` once and call `Interpenetration().local_model(body, pose, pairs)`
on a few hundred poses at a time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchcss.body.lift import point_moments, reactions
from torchcss.body.model import BodyModel, BodyPose
from torchcss.body.superquadric import EXPONENTS, Superquadrics, radial_hessian
from torchcss.body.surface import surface_points
from torchcss.cost.anthropometric import proportion_columns
from torchcss.cost.context import FrameContext
from torchcss.cost.term import OnStates, Term
from torchcss.errors import ConfigurationError
from torchcss.types import Curvature, LocalModel, Numbers, PointCost, frozen

END = 6.0
"""The `c` above: the potential ends where that of the paper has fallen to `exp(-c)`."""


class NearNodes(NamedTuple):
    """The nodes of a batch of poses that may feel a potential.

    Attributes:
        item: Pose of every near pair (the batch is flattened).
        pair: Which ordered pair of `InterpenetrationPairs` it is; of several bodies counted on.
        rotation: Orientation of its part B in the world.
        centre: Centre of its part B, metres.
        owner: Near pair of every node.
        points: Position of every node in the frame of B, metres.
    """

    item: Int[Tensor, " m"]
    pair: Int[Tensor, " m"]
    rotation: Float[Tensor, "m 3 3"]
    centre: Float[Tensor, "m 3"]
    owner: Int[Tensor, " p"]
    points: Float[Tensor, "p 3"]

    def select(
        self, keep: Bool[Tensor, " p"], *along: Float[Tensor, "p *rest"]
    ) -> tuple[NearNodes, list[Float[Tensor, "k *rest"]]]:
        """Some of the nodes, the pairs that they belong to, and the same rows of `along`."""
        index = keep.nonzero()[:, 0]
        pairs, owner = torch.unique_consecutive(self.owner[index], return_inverse=True)
        item, pair, rotation, centre = (part[pairs] for part in self[:4])
        chosen = NearNodes(item, pair, rotation, centre, owner, self.points[index])
        return chosen, [part[index] for part in along]


class InterpenetrationPairs(nn.Module):
    """Which parts may collide, the nodes that are tested, and the joints between them.

    Exponents above 1 count as 1, the ellipsoid: beyond it a second derivative is infinite.

    Args:
        body: The body; its base may move afterwards, its shape may not.
        rings: Latitudes of nodes per part; the two poles come on top.
        meridians: Longitudes of nodes per part.

    Attributes:
        first: Part A of every ordered pair, whose nodes are tested.
        second: Part B, whose potential they feel.
        chain: Joints between B and A in the order in which they are met from B, `[pairs length]`.
        sign: -1 for joints that move B, +1 for joints that move A, 0 for padding.
        nodes: Nodes of every part in the part's frame, metres, `[parts nodes 3]`.
        table: The fields of `Superquadrics`, one column per part.
        bent: Whether any part is bent.
        extent: Half sides of a box that holds R = 1 of every part, scaled by R for others, metres.
    """

    first: Tensor
    second: Tensor
    chain: Tensor
    sign: Tensor
    nodes: Tensor
    table: Tensor
    extent: Tensor

    def __init__(self, body: BodyModel, *, rings: int = 4, meridians: int = 6) -> None:
        super().__init__()
        pairs = _pairs(body)
        length = max((len(joints) for _, _, joints, _ in pairs), default=0)
        chain = torch.zeros(len(pairs), length, dtype=torch.long)
        sign = torch.zeros(len(pairs), length, dtype=body.dtype)
        for row, (_, _, joints, signs) in enumerate(pairs):
            chain[row, : len(joints)] = torch.tensor(joints)
            sign[row, : len(joints)] = torch.tensor(signs).to(sign)
        rows = Superquadrics.of(body.part_shape, exponents=(EXPONENTS[0], 1.0))
        self.bent = bool((rows.bend != 0).any())
        for name, value in (
            ("first", torch.tensor([pair[0] for pair in pairs], dtype=torch.long)),
            ("second", torch.tensor([pair[1] for pair in pairs], dtype=torch.long)),
            ("chain", chain),
            ("sign", sign),
            ("nodes", _nodes(body, rings, meridians)),
            ("table", torch.stack(rows)),
            ("extent", _extent(body)),
        ):
            self.register_buffer(name, value.to(body.tie.device), persistent=False)

    @property
    def num_pairs(self) -> int:
        """Number of ordered pairs."""
        return len(self.first)

    def near(self, body: BodyModel, pose: BodyPose, reach: float) -> NearNodes:
        """Find the nodes that may lie in the potential of another part.

        Boxes around the parts are tested for separation along the axes of both, then the nodes of
        the pairs that are left against the box of B.

        Args:
            body: The body.
            pose: Any number of posed bodies.
            reach: The R at which the potential of a part ends.
        """
        parts, num_nodes = self.nodes.shape[-3:-1]
        rotation, centre = body.part_poses(pose)
        items, bodies = pose.x.shape[:-1].numel(), self.nodes.shape[:-3].numel()
        rotation, centre = rotation.reshape(items, parts, 3, 3), centre.reshape(items, parts, 3)
        # The parts of several bodies are rows one after the other, and each has as many items.
        nodes, outer = self.nodes.reshape(-1, num_nodes, 3), reach * self.extent.reshape(-1, 3)
        inner = nodes.abs().amax(dim=1)
        axes = rotation.transpose(-1, -2).flatten(1, 2)  # three rows for every part
        own = (rotation * centre[..., None]).sum(-2).flatten(1)
        distance = (axes @ centre.transpose(-1, -2) - own[..., None]).abs()
        cosines = (axes @ axes.transpose(-1, -2)).abs()

        own_axes = torch.eye(parts, dtype=axes.dtype, device=axes.device).repeat_interleave(
            3, dim=0
        )

        def overlap(half: Tensor, other: Tensor) -> Tensor:
            """Whether boxes overlap along the axes of the part in the row."""
            half, other = half.flatten()[:, None], other.flatten()[:, None]
            if bodies > 1:
                boxes = (box.reshape(bodies, -1, 1) for box in (half, other))
                half, other = (box.repeat_interleave(items // bodies, 0) for box in boxes)
            gap = distance - half - cosines @ (own_axes * other)
            first, second, third = (gap <= 0).unflatten(1, (parts, 3)).unbind(2)
            return first & second & third

        close = overlap(outer, inner) & overlap(inner, outer).transpose(-1, -2)
        item, pair = close[:, self.second, self.first].nonzero(as_tuple=True)
        a, b = self.first[pair], self.second[pair]
        frame, origin = rotation[item, b], centre[item, b]
        turn = rotation[item, a].transpose(-1, -2) @ frame
        shift = (centre[item, a] - origin)[:, None, :] @ frame
        if bodies > 1:
            number = item // (items // bodies)
            pair, a, b = pair + self.num_pairs * number, a + parts * number, b + parts * number
        # In units of the box of B, so that the test is against 1.
        scale = 1 / outer[b][:, None, :]
        turn, shift = turn * scale, shift * scale
        # Component by component: on a CPU many times faster than small matrix products.
        nodes = nodes.movedim(-1, 0).contiguous().index_select(1, a)
        scaled = []
        for axis in range(3):
            along = shift[:, :, axis]
            for own, factor in zip(nodes, turn[:, :, axis].unbind(1), strict=True):
                along = torch.addcmul(along, own, factor[:, None])
            scaled.append(along)
        inside = (scaled[0].abs() < 1) & (scaled[1].abs() < 1) & (scaled[2].abs() < 1)
        index = inside.flatten().nonzero()[:, 0]
        owner = index // max(num_nodes, 1)
        points = torch.stack([part.flatten().index_select(0, index) for part in scaled]).mT
        return NearNodes(item, pair, frame, origin, owner, points * outer[b[owner]])

    def radial_square(
        self, near: NearNodes
    ) -> tuple[Float[Tensor, " p"], Float[Tensor, "p 3"], Float[Tensor, "p 3 3"]]:
        """`R^2` of nodes with its first and second derivatives in their position in B's frame."""
        table, part = self.table, self.second[self._pair(near)]
        if table.dim() > 2:
            part = part + table.shape[-1] * (near.pair // self.num_pairs)
            table = table.movedim(-2, 0).flatten(1)
        shape = Superquadrics._make(table.index_select(1, part[near.owner]).unbind(0))
        return radial_hessian(shape, *near.points.unbind(-1), bent=self.bent)

    def _pair(self, near: NearNodes) -> Int[Tensor, " m"]:
        """Which pair each is, whatever the body."""
        return near.pair if self.table.dim() == 2 else near.pair % self.num_pairs

    def lift(
        self,
        body: BodyModel,
        pose: BodyPose,
        near: NearNodes,
        cost: PointCost,
        *,
        curvature: Curvature = Curvature.EXACT,
    ) -> LocalModel:
        """Sum a cost over nodes and differentiate it with respect to the state.

        Args:
            body: The body.
            pose: The posed bodies.
            near: Their nodes.
            cost: Cost of every node, with its derivatives in the node's position in B's frame.
            curvature: Gauss-Newton leaves the second-order kinematics out; anything else is exact.
        """
        batch, joints = pose.x.shape[:-1], len(body.tree.joint_names)
        fields = (near.points, cost.gradient, cost.hessian.flatten(-2))
        rows = torch.stack(point_moments(*(field.unbind(-1) for field in fields)), dim=-1)
        sums = rows.new_zeros(len(near.item), rows.shape[-1]).index_add(0, near.owner, rows)
        # Twists of the chain about the centre of B, in B's frame.
        pair = self._pair(near)
        chain, sign = self.chain[pair], self.sign[pair][..., None]
        row = near.item[:, None] * joints + chain
        omega = sign * pose.tree.omega.reshape(-1, 3)[row]
        velocity = sign * pose.tree.velocity.reshape(-1, 3)[row]
        velocity = velocity + torch.linalg.cross(omega, near.centre[:, None, :], dim=-1)
        twist = torch.cat([omega @ near.rotation, velocity @ near.rotation], dim=-1)
        slope, reaction = reactions(
            sums[:, None].unbind(-1), twist.unbind(-1), curvature is not Curvature.GAUSS_NEWTON
        )
        upper = (twist @ torch.stack(reaction, dim=-2)).triu()

        def collect(index: Tensor, values: Tensor, *size: int) -> Tensor:
            total = values.new_zeros(math.prod((*batch, *size)))
            return total.index_add(0, index.flatten(), values.flatten()).reshape((*batch, *size))

        total = collect(near.item[near.owner], cost.value)
        first = collect(row, slope, joints)
        second = collect(row[:, :, None] * joints + chain[:, None, :], upper, joints, joints)
        second = second + second.transpose(-1, -2)
        second = second - 0.5 * torch.diag_embed(second.diagonal(dim1=-2, dim2=-1))
        return body.tied(LocalModel(total, first, second))


def _pairs(body: BodyModel) -> list[tuple[int, int, list[int], list[int]]]:
    """Part A, part B, the joints from B to A and their signs, for all pairs that may collide."""
    tree, links = body.tree, body.part_link.tolist()
    above = tree.ancestors.cpu()
    lengths = list(proportion_columns(body).values())
    moving = ~(body.tie[:, lengths] != 0).any(1).cpu()
    depth = tree.joint_ancestors.sum(0).tolist()
    touching = {frozenset(pair) for pair in body.neighbours}
    found = []
    for a, name_a in enumerate(body.part_names):
        for b, name_b in enumerate(body.part_names):
            moves_a, moves_b = above[:, links[a]], above[:, links[b]]
            between = moves_a ^ moves_b
            if {name_a, name_b} in touching or not bool((between & moving).any()):
                continue
            up = sorted((moves_b & between).nonzero()[:, 0].tolist(), key=lambda j: -depth[j])
            down = sorted((moves_a & between).nonzero()[:, 0].tolist(), key=lambda j: depth[j])
            found.append((a, b, up + down, [-1] * len(up) + [1] * len(down)))
    return found


def _nodes(body: BodyModel, rings: int, meridians: int) -> Float[Tensor, "parts nodes 3"]:
    """Rings of nodes, equally spaced along the axis, and the two poles of every part."""
    mesh = body.mesh(rings, meridians).points.flatten(1, 2)
    end = mesh.new_tensor([-torch.pi / 2, torch.pi / 2]).expand(body.num_parts, 2)
    poles = surface_points(body.part_shape[:, None, :], end, torch.zeros_like(end)).points
    return torch.cat([mesh, poles], dim=1)


def _extent(body: BodyModel) -> Float[Tensor, "parts 3"]:
    """Half sides of boxes around the parts, metres; R times as large ones hold what is below R."""
    axes, rows = body.part_shape[:, :3], Superquadrics.of(body.part_shape)
    taper = torch.stack([rows.taper_x, rows.taper_y], dim=-1).abs()
    section = axes[:, :2] * (1 + taper * (1 + rows.overhang[:, None]))
    # What is bent stays as far from the centre as it was along the axis.
    anywhere = section.norm(dim=-1) + axes[:, 2]
    straight = torch.cat([section, axes[:, 2:]], dim=-1)
    return torch.where((rows.bend != 0)[:, None], anywhere[:, None], straight)


@frozen
class Interpenetration(Term):
    """The repulsive potential between parts.

    Attributes:
        weight: Nats that a part costs whose nodes all lie on the surface of another one. The
            papers give no number.
        p: Exponent of [IJRR]: 1, or at least 2 (between them the second derivative is infinite at
            the surface).
        sharpness: Scale of the inside-outside function: the potential falls to `1/e` about
            `1/(2 sharpness)` of a part's radius outside its surface.
    """

    name = "interpenetration"
    kind = "prior"
    of_several = True

    weight: float = 5.0
    p: float = 1.0
    sharpness: float = 3.0

    def __post_init__(self) -> None:
        if not (self.p == 1 or 2 <= self.p < math.inf):
            raise ConfigurationError(
                f"Interpenetration.p: expected 1 or at least 2, got {self.p}; leave it out for 1"
            )
        if not (0 < self.weight < math.inf and self.sharpness > 0 and self.sharpness**self.p <= 20):
            raise ConfigurationError(
                "Interpenetration: expected a positive weight and a positive sharpness with "
                f"sharpness^p at most 20, got {self.weight}, {self.sharpness} and p = {self.p}; "
                "leave them out for the defaults"
            )

    def prepare(self, context: FrameContext) -> OnStates:
        """Bind the repulsion to the pairs of a body."""
        pairs = context.tables.of(InterpenetrationPairs)
        return OnStates(
            lambda posed, curvature: self.local_model(
                posed.body, posed.pose, pairs, curvature=curvature
            ),
            cost=lambda posed: self.value(posed.body, posed.pose, pairs),
        )

    @property
    def reach(self) -> float:
        """The R at which the potential ends."""
        return (1 + END ** (1 / self.p) / self.sharpness) ** 0.5

    def value(self, body: BodyModel, pose: BodyPose, pairs: InterpenetrationPairs) -> Numbers:
        """Cost in nats.

        Args:
            body: The body.
            pose: Any number of posed bodies.
            pairs: The tables of that body.
        """
        near = pairs.near(body, pose, self.reach)
        value, _, _ = self._potential(pairs.radial_square(near)[0], pairs)
        batch = pose.x.shape[:-1]
        total = value.new_zeros(batch.numel())
        return total.index_add(0, near.item[near.owner], value).reshape(batch)

    def local_model(
        self,
        body: BodyModel,
        pose: BodyPose,
        pairs: InterpenetrationPairs,
        *,
        curvature: Curvature = Curvature.EXACT,
    ) -> LocalModel:
        """Cost, gradient and Hessian in x.

        Args:
            body: The body.
            pose: Any number of posed bodies.
            pairs: The tables of that body.
            curvature: Gauss-Newton leaves the second-order kinematics out; anything else is exact.
        """
        near = pairs.near(body, pose, self.reach)
        if not len(near.owner):  # as of most poses of an arm
            zero = torch.zeros_like(pose.x)
            return LocalModel(zero[..., 0], zero, torch.diag_embed(zero))
        square, slope, bowl = pairs.radial_square(near)
        near, (square, slope, bowl) = near.select(square < self.reach**2, square, slope, bowl)
        value, first, second = self._potential(square, pairs)
        outer = slope[:, :, None] * slope[:, None, :]
        hessian = first[:, None, None] * bowl + second[:, None, None] * outer
        cost = PointCost(value, first[:, None] * slope, hessian)
        return pairs.lift(body, pose, near, cost, curvature=curvature)

    def _potential(
        self, square: Float[Tensor, " p"], pairs: InterpenetrationPairs
    ) -> Iterator[Tensor]:
        """Cost of nodes and its first and second derivatives in `R^2`."""
        scale, end = self.weight / pairs.nodes.shape[-2], END ** (1 / self.p)
        f = (self.sharpness * (square - 1)).clamp(max=end)
        power = f.abs() ** (self.p - 1)
        u, du = f * power, self.p * self.sharpness * power
        paper, last = torch.exp(-u), math.exp(-END)
        first, second = (last - paper) * du, paper * du.square()
        if self.p > 1:
            ddu = self.p * (self.p - 1) * f.sign() * f.abs() ** (self.p - 2)
            second = second + (last - paper) * ddu * self.sharpness**2
        value = paper - last * (1 + END - u)
        inside = f < end
        return (torch.where(inside, scale * part, 0.0) for part in (value, first, second))

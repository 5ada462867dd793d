"""A dressed character for rendered sequences: a skin over a body's parts, like cloth.

The tracker's body is a set of superquadrics; what it is shown must be something else, or it would
only be asked to find itself. A `Character` covers a body's parts with one closed mesh that

* is the smooth union of the parts (of other girths, drawn at random), made once in a spread pose,
  as the surface `-k log sum_i exp(-d_i / k) = 0` over the distances `d_i` to the parts, k = 8 mm;
* follows the parts by dual quaternion skinning (Kavan et al., *Geometric Skinning with Approximate
  Dual Quaternion Blending*, 2008), so that joints bend and twist without gaps and without collapse;
* is displaced along its normals by smooth random fields that move on with the bend of the joints,
  by creases at bent joints, and by a muscle of the upper arm that swells as the elbow bends.

All of it is a function of the state alone: the same vertices in every frame, so that a point of the
surface can be carried from frame to frame exactly. Colours belong to vertices too.

Call `Character(body, clothing, generator=...)`, then `character.pose(state)`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcss.body.catalog import without_side
from torchcss.body.model import BodyModel, BodyPose
from torchcss.body.rotations import quaternions
from torchcss.body.surface import straighten
from torchcss.linalg import multiply
from torchcss.studies.render.renderer import Colour, Mesh, random_waves
from torchcss.types import Vector, frozen
from torchcss.vision.rasterise import vertex_normals

_BLEND = 0.008
"""Metres: the k of the smooth union."""

_SHARING = 0.015
"""Metres from a part at which its share in a vertex has fallen to 1/e."""

_SPREAD_POSE = {
    "shoulder_swing": -30.0,
    "shoulder_raising": 35.0,
    "elbow_flexion": 20.0,
    "hip_abduction": 14.0,
    "hip_flexion": 8.0,
    "knee_flexion": 12.0,
}
"""Degrees: the pose in which the skin is made. No two limbs touch in it, and everyday poses are not
far from it."""

_PADDING = {
    "vt1": ("neck", (0.165, 0.044, 0.058)),
    "shoulder": ("upper_arm", (0.053, 0.053, 0.053)),
    "elbow": ("forearm", (0.041, 0.041, 0.041)),
    "wrist": ("hand", (0.027, 0.030, 0.027)),
    "vl5": ("chest", (0.142, 0.130, 0.102)),
    "hip": ("thigh", (0.082, 0.120, 0.088)),
    "knee": ("shank", (0.056, 0.056, 0.059)),
    "ankle": ("foot", (0.044, 0.060, 0.046)),
}
"""Ellipsoids about joints that fill the waists between parts: a part that must be there, and the
semi-axes right, up and forwards, metres."""

_FEATURES = {
    "head": (
        ((0.0, -0.092, -0.012), (0.015, 0.022, 0.026)),
        ((0.0, -0.052, -0.086), (0.036, 0.036, 0.030)),
        ((0.073, 0.010, -0.006), (0.010, 0.018, 0.031)),
        ((-0.073, 0.010, -0.006), (0.010, 0.018, 0.031)),
    ),
    "hand": (((0.0, 0.040, -0.015), (0.013, 0.016, 0.042)),),
}
"""Nose, chin, ears and thumb: centre and semi-axes in the part's frame, metres."""

_THUMB_TILT = 0.55
"""Radians between thumb and hand."""

_INFLUENCES = 4
"""Parts that may share a vertex."""

Vertices = Float[Tensor, "v 3"]
"""Three numbers of every vertex: place (metres) or colour."""


@frozen
class Clothing:
    """What a character wears and how much it differs from its body.

    Attributes:
        sleeve: End of the sleeves, in limbs from the shoulder: 1 is the elbow, 2 the wrist.
        hem: End of the shirt, in half heights of the pelvis above its middle.
        trouser_leg: End of the trousers, in limbs from the hip: 1 is the knee, 2 the ankle.
        pattern: Pattern of the shirt: "plaid", "stripes" or "plain".
        shirt: Display colour of the shirt, 0 to 1.
        accent: Second colour of the pattern.
        trousers: Colour of the trousers.
        skin: Colour of the skin.
        hair: Colour of the hair.
        shoes: Colour of the shoes.
        texture: Standard deviation of the relative lightness of cloth.
        girth: Standard deviation of a part's relative girth; at most twice that.
        looseness: Standard deviation of cloth's displacement, relative to the limb's radius; skin
            moves by a third of that.
        creases: Height of the folds at a joint bent by 90 degrees, metres.
        muscle: Height of the biceps at a bent elbow, metres.
    """

    sleeve: float = 0.6
    hem: float = -0.2
    trouser_leg: float = 2.1
    pattern: str = "plaid"
    shirt: Colour = (0.62, 0.16, 0.17)
    accent: Colour = (0.80, 0.78, 0.74)
    trousers: Colour = (0.46, 0.42, 0.33)
    skin: Colour = (0.82, 0.60, 0.49)
    hair: Colour = (0.20, 0.14, 0.10)
    shoes: Colour = (0.16, 0.15, 0.16)
    texture: float = 0.10
    girth: float = 0.04
    looseness: float = 0.05
    creases: float = 0.006
    muscle: float = 0.008


class _OnBody(NamedTuple):
    """Where the vertices of a skin are on a body.

    Attributes:
        body: The body.
        shape: Shapes of its parts, with the character's girths.
        nearest: The part that moves a vertex most.
        local: Place in that part's frame, metres.
    """

    body: BodyModel
    shape: Float[Tensor, "parts 9"]
    nearest: Int[Tensor, " v"]
    local: Vertices

    @property
    def in_semi_axes(self) -> Vertices:
        """Place in the part's frame, in units of its semi-axes."""
        return self.local / self.shape[self.nearest, :3]

    def on(self, *endings: str) -> Bool[Tensor, " v"]:
        """Which vertices are on parts whose names end in one of these."""
        names = self.body.part_names
        return torch.tensor([name.endswith(endings) for name in names])[self.nearest]


class Character:
    """A body covered with a skin.

    Args:
        body: The body, on its base. One state of it poses the character.
        clothing: Clothes and deformations.
        generator: Source of girths, displacements and textures.
        spacing: Edge of the mesh's cells, metres.
        without: Parts that are left bare, such as an arm that is another character.

    Attributes:
        faces: Corner indices of the triangles.
        part: Which part of the body every triangle belongs to.
        colour: Display colour of every vertex, 0 to 1.

    """

    def __init__(
        self,
        body: BodyModel,
        clothing: Clothing | None = None,
        *,
        generator: torch.Generator,
        spacing: float = 0.009,
        without: Sequence[str] = (),
    ) -> None:
        self.body, self.clothing = body, clothing or Clothing()
        self.shape = _other_girths(body, self.clothing.girth, generator)
        bare = torch.tensor([name in without for name in body.part_names])
        spread = body.pose(_spread_state(body))
        bind_rotation, bind_centre = body.part_poses(spread)
        kept = [part[~bare] for part in (self.shape, bind_rotation, bind_centre)]
        padding = _padding(body, spread, without)
        shapes, rotations, centres = map(torch.cat, zip(kept, padding, strict=True))
        vertices, self.faces = _smooth_union(shapes, rotations, centres, spacing)
        # Where every vertex is for every part, and how near.
        local = (vertices[None] - bind_centre[:, None]) @ bind_rotation
        distance = distance_to_parts(self.shape, local)
        distance[bare] = math.inf
        shares = _shares(body, distance.T, self.faces)
        weight, owner = shares.topk(min(_INFLUENCES, body.num_parts), dim=-1)
        self._weight, self._owner = weight / weight.sum(-1, keepdim=True), owner
        self._bind_rotation, self._bind_centre = bind_rotation, bind_centre
        self._vertices, self._normals = vertices, vertex_normals(vertices, self.faces)
        nearest = owner[:, 0]
        corner = nearest[self.faces]
        agree = corner[:, 1] == corner[:, 2]
        self.part: Int[Tensor, " f"] = torch.where(agree, corner[:, 1], corner[:, 0])
        at = torch.arange(len(vertices))
        self._dress(_OnBody(body, self.shape, nearest, local[nearest, at]), generator)

    def _dress(self, place: _OnBody, generator: torch.Generator) -> None:
        """Fix colours, looseness and the random fields of all vertices."""
        clothing, vertices = self.clothing, self._vertices
        colour, cloth = _colours(place, clothing, vertices, generator)
        # Borders of patterns and clothes run through the middle of triangles.
        self.colour: Vertices = _smooth(colour, self.faces, 1)
        radius = (self.shape[:, 0] * self.shape[:, 1]).sqrt()
        radius = (self._weight * radius[self._owner]).sum(-1)
        still = place.on("head", "hand", "foot", "neck")
        loose = torch.where(cloth, 1.0, 1 / 3) * torch.where(still, 0.3, 1.0)
        loose = _smooth(loose[:, None].to(vertices), self.faces, 2)[:, 0]
        self._amplitude = clothing.looseness * radius * loose
        # Cloth stands off the body a little.
        self._offset = 0.03 * radius * _smooth(cloth[:, None].to(vertices), self.faces, 1)[:, 0]
        waves = random_waves(10, 0.07, 0.28, generator=generator, dtype=vertices.dtype)
        self._phase = waves.angles(vertices)
        # Folds run across the limb, and are not quite regular.
        self._fold = 2 * math.pi * place.local[:, 2] / 0.035 + 1.5 * self._phase[:, -1].sin()
        self._crease = clothing.creases * loose
        self._muscle = clothing.muscle * _muscle(place)

    @property
    def num_vertices(self) -> int:
        """Number of vertices."""
        return len(self._vertices)

    def pose(self, state: Vector) -> Mesh:
        """The skin in a pose, with unit normals.

        Args:
            state: A state of the body.
        """
        rotation, centre = self.body.part_poses(self.body.pose(state))
        # Motion of every part since the skin was made: turn about the origin, then shift.
        turn = rotation @ self._bind_rotation.mT
        shift = centre - multiply(turn, self._bind_centre)
        real = torch.from_numpy(quaternions(turn.numpy()))
        dual = 0.5 * _times(torch.cat([torch.zeros_like(shift[:, :1]), shift], -1), real)
        first, second = real[self._owner[:, 0]], real[self._owner[:, 1]]
        bend = 2 * (first * second).sum(-1).abs().clamp(max=1).acos()
        between = 4 * self._weight[:, 0] * self._weight[:, 1]
        height = self._offset + self._muscle * self._elbow_swell(state)
        waves = (self._phase + (1.2 * bend * between)[:, None]).sin()
        height = height + self._amplitude * waves.mean(-1) * math.sqrt(2 * waves.shape[-1])
        height = height + self._crease * between * (bend / (0.5 * math.pi)) * self._fold.sin()
        vertices = self._vertices + height[:, None] * self._normals
        # Blend with all signs as the nearest part's, then normalise.
        q, d = real[self._owner], dual[self._owner]
        sign = torch.where((q * q[:, :1]).sum(-1) < 0, -1.0, 1.0).to(q) * self._weight
        q, d = (sign[..., None] * q).sum(1), (sign[..., None] * d).sum(1)
        length = q.norm(dim=-1, keepdim=True)
        q, d = q / length, d / length
        conjugate = torch.cat([q[:, :1], -q[:, 1:]], -1)
        moved = 2 * _times(d, conjugate)[:, 1:]
        axis, scalar = q[:, 1:], q[:, :1]
        spin = torch.linalg.cross(axis, vertices) + scalar * vertices
        turned = vertices + 2 * torch.linalg.cross(axis, spin)
        vertices = turned + moved
        normals = vertex_normals(vertices, self.faces)
        return Mesh(vertices, normals, self.faces, self.colour)

    def _elbow_swell(self, state: Tensor) -> Tensor:
        """How much the muscle of every vertex's arm is swollen, 0 to 1."""
        swell = state.new_zeros(self.body.num_parts)
        for index, name in enumerate(self.body.part_names):
            if name.endswith("upper_arm"):
                flexion = state[self.body.state_index(f"{name[0]}_elbow_flexion")]
                swell[index] = (0.5 * flexion).sin().square() * 1.2
        return swell[self._owner[:, 0]]


def distance_to_part(
    shape: Float[Tensor, "9"], points: Float[Tensor, "p 3"]
) -> Float[Tensor, " p"]:
    """Distance of points to a superquadric, to first order; negative inside, metres.

    With `R = F^(e1/2)`, which is 1 on the surface and grows linearly along rays, it is
    `(R - 1) / |grad R|` (Taubin 1991).

    Args:
        shape: The nine shape numbers.
        points: Points in the part's frame.
    """
    with torch.enable_grad():
        place = points.detach().requires_grad_()
        x, y, z = (straighten(shape, place) / shape[:3]).abs().clamp(min=1e-6).unbind(-1)
        e1, e2 = shape[3], shape[4]
        section = (x ** (2 / e2) + y ** (2 / e2)) ** (e2 / 2)
        radial = (section ** (2 / e1) + z ** (2 / e1)) ** (e1 / 2)
        (slope,) = torch.autograd.grad(radial.sum(), place)
    least = 0.2 / shape[:3].max()
    return (radial.detach() - 1) / slope.norm(dim=-1).clamp(min=least)


def distance_to_parts(
    shape: Float[Tensor, "parts 9"], points: Float[Tensor, "parts p 3"]
) -> Float[Tensor, "parts p"]:
    """Distance of points to several parts, in whose frames they are given."""
    return torch.stack([distance_to_part(s, p) for s, p in zip(shape, points, strict=True)])


def _other_girths(body: BodyModel, deviation: float, generator: torch.Generator) -> Tensor:
    """The body's shapes with girths of their own, left and right alike."""
    shape, factors = body.part_shape.clone(), {}
    for index, name in enumerate(body.part_names):
        bare = without_side(name)
        if bare not in factors:
            drawn = torch.randn(2, generator=generator, dtype=shape.dtype)
            factors[bare] = 1 + deviation * drawn.clamp(-2, 2)
        shape[index, :2] *= factors[bare]
    return shape


def _spread_state(body: BodyModel) -> Tensor:
    state = body.rest.clone()
    for column, name in enumerate(body.state_names):
        degrees = _SPREAD_POSE.get(without_side(name), 0.0)
        state[column] += math.radians(degrees)
    return body.bounds.project(state)


def _padding(
    body: BodyModel, pose: BodyPose, without: Sequence[str]
) -> tuple[Float[Tensor, "k 9"], Float[Tensor, "k 3 3"], Float[Tensor, "k 3"]]:
    """What is there besides the parts in a pose: fillings about joints, features."""
    rotation, centre = body.part_poses(pose)
    # Without any they are empty.
    shapes, rotations, centres = [rotation.new_zeros(0, 9)], [rotation[:0]], [centre[:0]]

    def add(axes: Sequence[float], turn: Tensor, place: Tensor) -> None:
        shapes.append(place.new_tensor([[*axes, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]]))
        rotations.append(turn[None])
        centres.append(place[None])

    for index, name in enumerate(body.joint_names):
        bare = without_side(name)
        side = name.removesuffix(bare)
        owner, axes = _PADDING.get(bare, ("", ()))
        if side + owner in body.part_names and side + owner not in without:
            add(axes, body.base_rotation, pose.joints[index])
    for index, name in enumerate(body.part_names):
        bare = without_side(name)
        for place, axes in _FEATURES.get(bare, ()) if name not in without else ():
            turn = rotation[index]
            if bare == "hand":
                c, s = math.cos(_THUMB_TILT), math.sin(_THUMB_TILT)
                turn = turn @ turn.new_tensor([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
            add(axes, turn, centre[index] + rotation[index] @ rotation.new_tensor(place))
    return torch.cat(shapes), torch.cat(rotations), torch.cat(centres)


def _smooth_union(
    shape: Float[Tensor, "parts 9"],
    rotation: Float[Tensor, "parts 3 3"],
    centre: Float[Tensor, "parts 3"],
    spacing: float,
) -> tuple[Vertices, Int[Tensor, "f 3"]]:
    """Mesh of the smooth union of posed parts; its triangles run anticlockwise from outside."""
    margin = 6 * _BLEND
    # A part's box in the world, with room for its taper and for the blend.
    reach = shape[:, :3] * (
        1 + torch.cat([shape[:, 5:7].abs(), shape.new_zeros(len(shape), 1)], -1)
    )
    half = (rotation.abs() * reach[:, None]).sum(-1) + margin
    low = ((centre - half) / spacing).floor().long()
    high = ((centre + half) / spacing).ceil().long() + 1
    origin = low.amin(0)
    total = torch.zeros((high.amax(0) - origin).tolist(), dtype=torch.float64)
    for part, start, stop in zip(
        range(len(shape)), (low - origin).tolist(), (high - origin).tolist(), strict=True
    ):
        box = tuple(map(slice, start, stop))
        cells = torch.cartesian_prod(*map(torch.arange, start, stop)) + origin
        points = (cells * spacing - centre[part]) @ rotation[part]
        distance = distance_to_part(shape[part], points).clamp(-margin, 2 * margin)
        total[box] += torch.exp(-distance / _BLEND).reshape(total[box].shape)
    field = -_BLEND * (total + math.exp(-12)).log()
    vertices, faces = _level_set(field)
    vertices = (vertices + origin) * spacing
    # Slivers, whose normals mean nothing, become ordinary triangles.
    return _smooth(vertices, faces, 2), faces


def _level_set(field: Float[Tensor, "x y z"]) -> tuple[Vertices, Int[Tensor, "f 3"]]:
    """Mesh of where a field is 0, in cells: surface nets (Gibson 1998).

    Every cell with a change of sign has one vertex, in the middle of the crossings on its edges;
    every edge with a change of sign has one quadrilateral, between the four cells around it.
    The field is positive on the border; triangles run anticlockwise where it grows.
    """
    strides = field.new_tensor(field.stride()).long()
    total, count = field.new_zeros(field.numel(), 3), field.new_zeros(field.numel())
    quads = []
    for axis in range(3):
        size = field.shape[axis] - 1
        near, far = field.narrow(axis, 0, size), field.narrow(axis, 1, size)
        node = ((near < 0) != (far < 0)).nonzero()
        a, b = near[tuple(node.T)], far[tuple(node.T)]
        crossing = node.to(field)
        crossing[:, axis] += a / (a - b)
        u, v = strides[(axis + 1) % 3], strides[(axis + 2) % 3]
        here = node @ strides
        cells = torch.stack([here - u - v, here - v, here, here - u], 1)
        for cell in cells.T:
            total.index_add_(0, cell, crossing)
            count.index_add_(0, cell, torch.ones_like(a))
        quads.append(torch.where((a < 0)[:, None], cells, cells.flip(-1)))
    quad = torch.cat(quads)
    used = count > 0
    number = used.cumsum(0) - 1
    faces = torch.cat([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    return total[used] / count[used, None], number[faces]


def _shares(body: BodyModel, distance: Tensor, faces: Tensor) -> Float[Tensor, "v parts"]:
    """How much every part moves a vertex: the nearest one and its neighbours, by their distance."""
    names = body.part_names
    related = torch.eye(len(names), dtype=torch.bool)
    for first, second in body.neighbours:
        a, b = names.index(first), names.index(second)
        related[a, b] = related[b, a] = True
    nearest = distance.argmin(-1)
    share = torch.where(related[nearest], torch.exp(-distance.clamp(min=0) / _SHARING), 0.0)
    return _smooth(share / share.sum(-1, keepdim=True), faces, 6)


def _smooth(values: Float[Tensor, "v c"], faces: Tensor, times: int) -> Float[Tensor, "v c"]:
    """Average with the neighbours on a mesh."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = torch.cat([edges, edges.flip(-1)])
    degree = torch.zeros_like(values[:, 0]).index_add(
        0, edges[:, 0], torch.ones(len(edges)).to(values)
    )
    for _ in range(times):
        total = torch.zeros_like(values).index_add(0, edges[:, 0], values[edges[:, 1]])
        values = 0.5 * values + 0.5 * total / degree[:, None]
    return values


def _along_limb(place: _OnBody) -> Float[Tensor, " v"]:
    """Place along arm or leg in limbs: 0 at shoulder or hip, 1 at elbow or knee, 2 at the end.

    On other parts it is the place along the part's axis from -1 to 1.
    """
    along = place.in_semi_axes[:, 2]
    for start, limbs in enumerate((("upper_arm", "thigh"), ("forearm", "shank"), ("hand", "foot"))):
        # A part is about 1.1 limbs long, centred on the limb.
        along = torch.where(place.on(*limbs), start + 0.5 + 0.55 * along, along)
    return along


def _muscle(place: _OnBody) -> Float[Tensor, " v"]:
    """Shape of the biceps on the upper arms, 0 to 1: on the flexing side, above the elbow."""
    x, y, z = place.in_semi_axes.unbind(-1)
    # The elbow bends forwards, and a part that hangs has its y axis along the link's z.
    side = torch.atan2(x, y)
    bump = torch.exp(-((side / 0.9) ** 2) - ((z - 0.1) / 0.35) ** 2)
    return torch.where(place.on("upper_arm"), bump, 0.0)


def _colours(
    place: _OnBody, clothing: Clothing, vertices: Tensor, generator: torch.Generator
) -> tuple[Vertices, Tensor]:
    """Display colours of all vertices, and which of them are covered by loose cloth."""
    on, along = place.on, _along_limb(place)
    shirt = on("chest", "clavicle") | (on("upper_arm", "forearm") & (along < clothing.sleeve))
    shirt |= on("pelvis") & (along > clothing.hem)
    shirt |= on("neck") & (along < -0.35)
    trousers = (on("pelvis") & ~shirt) | (on("thigh", "shank") & (along < clothing.trouser_leg))
    shoes = on("foot") | (on("shank") & (along > 2.1))
    x, _, z = place.local.unbind(-1)
    mix = torch.zeros_like(x)
    if clothing.pattern == "plaid":
        # Bands along and around the part, which the eye takes for threads.
        bands = [(t / 0.055).remainder(1.0) for t in (x, z)]
        mix = 0.5 * sum(((b < 0.38).to(x) for b in bands), mix)
        mix = mix + 0.5 * sum((((b > 0.62) & (b < 0.70)).to(x) for b in bands), 0 * mix)
    elif clothing.pattern == "stripes":
        mix = ((z / 0.06).remainder(1.0) < 0.4).to(x)
    base, accent = vertices.new_tensor(clothing.shirt), vertices.new_tensor(clothing.accent)
    mix = mix.clamp(0, 1)[:, None]
    colour = vertices.new_tensor(clothing.skin).expand(len(vertices), 3)
    colour = torch.where(shirt[:, None], base * (1 - mix) + accent * mix, colour)
    colour = _painted(colour, trousers, clothing.trousers)
    colour = _painted(colour, shoes, clothing.shoes)
    cloth = shirt | trousers
    waves = random_waves(12, 0.02, 0.15, generator=generator, dtype=x.dtype)
    weave = waves.angles(vertices).sin().mean(-1)
    strength = torch.where(cloth, clothing.texture, 0.3 * clothing.texture)
    colour = colour * (1 + strength * math.sqrt(2 * len(waves.phases)) * weave)[:, None]
    return _head(place, clothing, colour).clamp(0, 1), cloth


def _painted(colour: Vertices, where: Bool[Tensor, " v"], paint: Colour) -> Tensor:
    return torch.where(where[:, None], colour.new_tensor(paint), colour)


def _head(place: _OnBody, clothing: Clothing, colour: Vertices) -> Tensor:
    """Hair, eyes and mouth."""
    # The head's z axis points up, its y axis backwards.
    x, y, z = place.in_semi_axes.unbind(-1)
    head = place.on("head")
    hair = (z > 0.5 + 0.1 * (6 * x).sin()) | ((y > -0.15) & (z > -0.5 + 0.3 * (y < 0.2)))
    colour = _painted(colour, head & hair, clothing.hair)
    front = head & (y < 0)
    for side in (-1, 1):
        eye = ((x - 0.42 * side) / 0.17) ** 2 + ((z - 0.12) / 0.06) ** 2 < 1
        brow = ((x - 0.42 * side) / 0.24) ** 2 + ((z - 0.29) / 0.05) ** 2 < 1
        colour = _painted(colour, front & eye, (0.12, 0.1, 0.1))
        colour = _painted(colour, front & brow, clothing.hair)
    mouth = (x / 0.3) ** 2 + ((z + 0.45) / 0.05) ** 2 < 1
    return _painted(colour, front & mouth, (0.62, 0.30, 0.28))


def _times(p: Float[Tensor, "*b 4"], q: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 4"]:
    """Product of quaternions, scalar first."""
    scalar = p[..., :1] * q[..., :1] - (p[..., 1:] * q[..., 1:]).sum(-1, keepdim=True)
    vector = p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:]
    return torch.cat([scalar, vector + torch.linalg.cross(p[..., 1:], q[..., 1:])], -1)

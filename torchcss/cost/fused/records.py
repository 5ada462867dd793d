"""The records that kernels read and write: flat arrays, packed once per body or frame.

`real` numbers have the engine's precision; states, frames of joints and sums are in double
precision. All positions are in the camera's frame, metres, so that no point is turned twice.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]


Tree = namedtuple("Tree", "column factor offset parent constant revolute base")
"""The kinematic tree before a camera; frames are rows `[base, joint 0, joint 1, ...]`.

Attributes:
    column: State parameter that drives each joint, `q = factor x[column] + offset`.
    factor: Its factor.
    offset: The value of the joint where the parameter is zero.
    parent: Row of the frame that each joint hangs on.
    constant: Its own frame in that one, before it moves, `[joint 3 4]`.
    revolute: Whether it turns about its z axis or slides along it.
    base: Frame of the base, `[3 4]`.
"""


Parts = namedtuple(
    "Parts", "row constant shape radius around within behind plain touching ramp clearance"
)
"""Frames of the parts, and what tells whether they hide.

Attributes:
    row: Row of the frame that carries each part.
    constant: The part's frame in that one, `[parts 3 4]`, double precision.
    shape: The fields of `Superquadrics`, `[14 parts]`.
    radius: Of the sphere outside which a part hides nothing, metres.
    around: Reciprocal semi-axes of an ellipsoid outside which it hides nothing, `[3 parts]`.
    within: Squared radius of a plain part's own ellipsoid inside which it hides for sure.
    behind: How far behind a contour it suppresses it where it is a neighbour, metres.
    plain: Whether a line of sight has one nearest point, which a few steps find.
    touching: Which parts touch, `[parts parts]`.
    ramp: Width of the transition between visible and hidden, metres.
    clearance: How far outside a surface neighbours are looked for, metres.
"""


Curves = namedtuple("Curves", "table rings ring_nodes meridians meridian_nodes")
"""Curves on the parts, on which contours are found.

Attributes:
    table: Point, normal, bulge of the next step and `n . p`, `[parts 10 nodes]`: rings first.
    rings: Closed curves per part.
    ring_nodes: Nodes on each, the first and the last the same.
    meridians: Curves from pole to pole.
    meridian_nodes: Nodes on each.
"""


Lens = namedtuple("Lens", "fx fy cx cy k1 k2 p1 p2 k3 distorts near limit width height")
"""A camera; see `torchcss.vision.camera`.

Attributes:
    fx, fy, cx, cy: Intrinsics, pixels.
    k1, k2, p1, p2, k3: Distortion.
    distorts: Whether there is any.
    near: Depth of the near plane, metres.
    limit: Largest radius at unit depth.
    width, height: Size of the image, pixels.
"""


Potential = namedtuple("Potential", "kind nu variance")
"""A robust potential of `torchcss.robust`.

Attributes:
    kind: Its place in `potentials.KINDS`.
    nu: Spread of the outliers.
    variance: Square of the scale of the peak.
"""


Edges = namedtuple(
    "Edges",
    "scale field corner steps step window unmatched back_facing hidden potential assignment "
    "strength least",
)
"""The contour term of a frame; see `torchcss.cost.contour`.

Attributes:
    scale: Nats per unit of a node's cost; zero: there is no such term.
    field: Edge energy times direction, `[h w 2]`; as printed with the weights, `[h w 3]`.
    corner: Last column and last row, as `real` numbers.
    steps: Places of the samples along a normal, pixels.
    step: Distance between them.
    window: Half length of the search.
    unmatched: Cost of a node without an edge.
    back_facing: Cost of a node without a contour.
    hidden: Cost of a hidden node.
    potential: Kind, nu and sigma of the potential.
    assignment: Place of the term's in `edges.ASSIGNMENTS`.
    strength: Whether an edge's weight is in proportion to its response.
    least: Least response of an edge as printed.
"""


Colours = namedtuple("Colours", "scale field origin corner layer offset nu back_facing hidden")
"""The region term of a frame; see `torchcss.cost.region`.

Attributes:
    scale: Nats per unit of a node's cost; zero: there is no such term.
    field: Coefficients of the splines, `[layers y x]`.
    origin: Column and row of the picture where the field begins.
    corner: See `sample_spline`.
    layer: Layer of each part.
    offset: Distance of the two places from the contour, pixels.
    nu: Cost of a node whose sides are exchanged.
    back_facing: Cost of a node without a contour.
    hidden: Cost of a hidden node.
"""


Flow = namedtuple("Flow", "scale nodes target back_facing untold hidden far potential")
"""The flow term of a frame; see `torchcss.cost.flow`.

Attributes:
    scale: Nats per unit of a node's cost; zero: there is no such term.
    nodes: Points and normals in the parts' frames, `[parts 6 nodes]`.
    target: Target of each node of each mode before, and its weight, `[modes 3 parts nodes]`.
    back_facing: Cost of a node that faces away.
    untold: Cost of a node without measurement.
    hidden: Cost of a hidden node.
    far: Squared distance that a node behind the camera counts as, square pixels.
    potential: Kind, nu and sigma of the potential.
"""


PackedKeypoints = namedtuple("PackedKeypoints", "scale row place target far potential")
"""The keypoints of a frame, in double precision; see `torchcss.cost.joints`.

Attributes:
    scale: Factor on the nats of a joint; zero: there is no such term.
    row: Row of the frame that carries each joint.
    place: The joint in that frame, metres.
    target: Position and weight of each keypoint, for each mode or for all, `[modes 3 joints]`.
    far: Squared distance that an unseen joint counts as, square pixels of weight one.
    potential: Kind, nu and sigma of the potential.
"""


View = namedtuple("View", "lens precise curves edges colours flow keypoints nothing exact")
"""A camera and what it sees.

Attributes:
    lens: The camera.
    precise: The same in double precision, for the keypoints.
    curves: The curves on the parts where contours are found.
    edges: The contour term.
    colours: The region term.
    flow: The flow term.
    keypoints: The keypoints.
    nothing: Cost of all contour nodes where no part has a contour.
    exact: Whether the curvature of projection and kinematics counts.
"""


LongTails = namedtuple("LongTails", "weight nu centre sharpness")
"""Lorentzian priors of single parameters; see `torchcss.cost.stabiliser.long_tailed`.

Attributes:
    weight: Factor on each prior.
    nu: Height of its tails, nats.
    centre: Where it pulls to, for each mode before, `[priors modes n]`.
    sharpness: Reciprocal deviations; zero: there is no prior, `[priors n]`.
"""


Gaussian = namedtuple("Gaussian", "columns mean precision")
"""A Gaussian prior of some parameters.

Attributes:
    columns: Which parameters.
    mean: Their means.
    precision: The inverse covariance, times the prior's weight.
"""


Mixture = namedtuple("Mixture", "weight nu far mean precision height")
"""The mixture before, one frame ahead; see `torchcss.cost.temporal.MixturePrior`.

Attributes:
    weight: Factor on the prior; zero: there is none.
    nu: Height of the tails, nats.
    far: Where offsets end.
    mean: Means of the modes, `[k n]`.
    precision: Inverse covariances.
    height: Logarithm of each mode's density at its mean.
"""


PriorScratch = namedtuple("PriorScratch", "pull share pulls row")
"""Memory for `add_priors`.

Attributes:
    pull: An offset, or a gradient, `[n]`.
    share: Each mode's share in the mixture before, `[k]`.
    pulls: The gradient about each mode, `[k n]`.
    row: A row of a Hessian, `[n]`.
"""


Limbs = namedtuple(
    "Limbs",
    "scale row place above end difference moves fixed first segments line side bends number "
    "mean precision height uniform",
)
"""Directions of limbs and their density, by groups; see `torchcss.cost.pose_prior`.

Attributes:
    scale: Factor on the prior.
    row: Row of the frame that carries each end of a segment.
    place: Its place in that frame.
    above: Which joints move it, `[joint point]`.
    end: The ends that each segment is made from, and
    difference: their shares in it.
    moves: Which joints move one of these, `[joint segment]`.
    fixed: Segments that no joint moves; zero for the others.
    first: First segment of each group.
    segments: Number of its segments.
    line: The line that its frame lies along: hips or shoulders.
    side: Factors on its axes: a right arm is mirrored.
    bends: Which joints move its directions, `[group joint]`.
    number: Number of its Gaussians.
    mean: Their means, `[group d k]`.
    precision: Their inverse covariances, `[group d d k]`.
    height: Logarithms of their densities at their means.
    uniform: Logarithm of the uniform part of each group.
"""


LimbScratch = namedtuple(
    "LimbScratch",
    "frames reference twists point velocity unit length moved axes normal spin turned "
    "direction slope touched share offset pulls pull bend bent",
)
"""What is found of one state on the way to `Limbs`' density.

Attributes:
    frames: Frames of base and joints.
    reference: Point of reference of the twists, zero.
    twists: How joints move what hangs on them.
    point: Ends of the segments.
    velocity: How they move with one joint.
    unit: Directions of the segments.
    length: Their lengths.
    moved: How the directions move with each joint.
    axes: Frames along hips and shoulders, by rows.
    normal: Length of left x trunk of each.
    spin: How they turn with each joint.
    turned: What a frame's turning adds.
    direction: Directions of one group in its frame.
    slope: How they move with each parameter, `[d n]`.
    touched: Whether they do.
    share: Shares of the Gaussians.
    offset: Distances from their means, `[d k]`.
    pulls: Their pulls.
    pull: All of them together.
    bend: Mean precision.
    bent: Its product with the slopes.
"""


Repulsion = namedtuple(
    "Repulsion",
    "scale p sharpness end reach exponent last spheres nodes shape inner outer pair chain sign",
)
"""What keeps parts apart; see `torchcss.cost.interpenetration`.

Attributes:
    scale: Nats of a node on the surface of another part; zero: there is no such term.
    p: Exponent of the inside-outside function.
    sharpness: Scale of the inside-outside function.
    end: The inside-outside function where the potential ends.
    reach: R^2 there.
    exponent: The exponent at the end of the potential, and
    last: the exponential there.
    spheres: Distance of the centres of each two parts beyond which they are apart, metres.
    nodes: Nodes of each part in its frame, metres, `[parts 3 nodes]`.
    shape: The fields of `Superquadrics`, `[14 parts]`.
    inner: Half sides of a box that holds the nodes, `[parts 3]`.
    outer: Half sides of a box that holds the potential.
    pair: Number of the ordered pair of a part and one that repels it; -1: they may touch.
    chain: Joints between the two parts of each pair, from the one that repels.
    sign: -1 where the joint moves that one, +1 where it moves the other, 0 for padding.
"""


Nodes = namedtuple("Nodes", "x y z nx ny nz exists visible near first")
"""Nodes on the surface, part after part.

Attributes:
    x, y, z: Position.
    nx, ny, nz: Unit outward normal.
    exists: Share with which the node is there, or with which it faces the camera.
    visible: 1 where no other part hides it, 0 where one does.
    near: 1 where it is in front of the camera, of the nodes all over the surface.
    first: Where the nodes of each part begin, and the end of all.
"""


Rays = namedtuple("Rays", "u v w length gap")
"""Lines of sight, part after part.

Attributes:
    u, v, w: Unit directions.
    length: To the node, metres; minus infinity where nobody asks.
    gap: Signed distance to the nearest part in the way, metres.
"""


Lines = namedtuple("Lines", "ray part x y z u v w begin end s curvature value slope last before")
"""Stretches of lines of sight in the frames of parts that they may meet.

Attributes:
    ray: The line.
    part: The part.
    x, y, z: The line's point next to the part's centre, metres.
    u, v, w: Its direction.
    begin: Where the stretch begins, metres from that point.
    end: Where it ends; before its beginning: it passes.
    s: Where it is nearest to the part.
    curvature: Curvature of R^2/2 there.
    value: R^2 there, or the gap.
    slope: Slope of R^2/2 there.
    last: Where it was before.
    before: The slope there.
"""


Seen = namedtuple("Seen", "node part u v a b w aa ab bb mu mv gain gu gv uu uv vv first")
"""Contour nodes that the image is compared with.

Attributes:
    node: Its place among the contour nodes.
    part: Its part.
    u, v: Its place in the image, pixels.
    a, b, w, aa, ab, bb: See `torchcss.cost.fused.projection.Pixel`.
    mu, mv: Its unit normal in the image.
    gain: By how much it costs less than a node without a match.
    gu, gv, uu, uv, vv: First and second derivatives of its cost in the image.
    first: Where the edges of each begin.
"""


Peaks = namedtuple("Peaks", "sample place height weight share well slope curvature")
"""Maxima of the edge response along the normals of nodes.

Attributes:
    sample: The highest sample, among those of all lines.
    place: Its distance from the node, pixels; then that of the maximum.
    height: The response there, where edges are added up as printed.
    weight: Weight of the edge.
    share: What it takes of the sum of one.
    well, slope, curvature: Its cost below that of no edge, and derivatives along the normal.
"""


Points = namedtuple("Points", "x y z gx gy gz xx xy xz yy yz zz first")
"""Points with the derivatives of their cost.

Attributes:
    x, y, z: Position.
    gx, gy, gz: Gradient, nats per metre.
    xx, xy, xz, yy, yz, zz: Hessian, nats per square metre.
    first: Where the points of each part begin, and the end of all.
"""


Targets = namedtuple("Targets", "row own place stiffness")
"""Points of the body and where they should be; see `torchcss.cost.targets.PointTargets`.

Attributes:
    row: Row of the frame that carries each point.
    own: Its place in that frame.
    place: Where it should be, `[b points 3]`, or the same for all states, `[1 points 3]`.
    stiffness: Reciprocal variance of each, per square metre.
"""


TargetScratch = namedtuple("TargetScratch", "frames reference twists sums points")
"""The part of a `Workspace` that `Targets` need."""


Result = namedtuple("Result", "value gradient hessian")
"""Cost and derivatives of a pool, double precision; a call adds to it.

Attributes:
    value: Cost, nats.
    gradient: Its gradient in the state; empty: not wanted.
    hessian: Its Hessian.
"""


Workspace = namedtuple(
    "Workspace",
    "frames frame posed reference twists moved sums facing outline interior rays near lines "
    "points seen peaks response",
)
"""Memory for what is found of one state on the way; nothing in it is kept.

Attributes:
    frames: Frames of base and joints, `[1 + q 3 4]`, double precision.
    frame: One frame, double precision.
    posed: Frames of the parts, `[parts 3 4]`.
    reference: A place near the body, double precision.
    twists: Velocities of the joints, `[q 6]`, double precision.
    moved: The same of a chain of joints.
    sums: Sums over the points that each frame carries, `[1 + q 33]`, double precision.
    facing: How nodes of curves face the camera.
    outline: The nodes of the contours.
    interior: The nodes all over the surface.
    rays: Lines of sight.
    near: Stretches of them near one part.
    lines: Stretches of them that may be hidden.
    points: Points with derivatives.
    seen: Contour nodes in the image.
    peaks: Edges beside them.
    response: Responses along the search lines of all nodes.
"""


PairScratch = namedtuple(
    "PairScratch", "frames frame posed reference twists moved sums lines points"
)
"""The part of a `Workspace` that pairs of parts need: what is passed to a kernel takes its time."""

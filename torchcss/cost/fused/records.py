"""The records that kernels read and write: flat arrays, packed once per body or frame.

`real` numbers have the engine's precision; states, frames of joints and sums are in double
precision. All positions are in the camera's frame, metres, so that no point is turned twice.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray[Any, Any]
Real = float


class Tree(NamedTuple):
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

    column: Array
    factor: Array
    offset: Array
    parent: Array
    constant: Array
    revolute: Array
    base: Array


class Parts(NamedTuple):
    """Frames of the parts, and what tells whether they hide.

    Attributes:
        row: Row of the frame that carries each part.
        constant: The part's frame in that one, `[parts 3 4]`, double precision.
        shape: The fields of `Superquadrics`, `[13 parts]`.
        radius: Of the sphere outside which a part hides nothing, metres.
        around: Reciprocal semi-axes of an ellipsoid outside which it hides nothing, `[3 parts]`.
        within: Squared radius of a plain part's own ellipsoid inside which it hides for sure.
        behind: How far behind a contour it suppresses it where it is a neighbour, metres.
        plain: Whether a line of sight has one nearest point, which a few steps find.
        touching: Which parts touch, `[parts parts]`.
        ramp: Width of the transition between visible and hidden, metres.
        clearance: How far outside a surface neighbours are looked for, metres.
    """

    row: Array
    constant: Array
    shape: Array
    radius: Array
    around: Array
    within: Array
    behind: Array
    plain: Array
    touching: Array
    ramp: Real
    clearance: Real


class Curves(NamedTuple):
    """Curves on the parts, on which contours are found.

    Attributes:
        table: Point, normal, bulge of the next step and `n . p`, `[parts 10 nodes]`: rings first.
        rings: Closed curves per part.
        ring_nodes: Nodes on each, the first and the last the same.
        meridians: Curves from pole to pole.
        meridian_nodes: Nodes on each.
    """

    table: Array
    rings: int
    ring_nodes: int
    meridians: int
    meridian_nodes: int


class Lens(NamedTuple):
    """A camera; see `torchcss.vision.camera`.

    Attributes:
        fx, fy, cx, cy: Intrinsics, pixels.
        k1, k2, p1, p2, k3: Distortion.
        distorts: Whether there is any.
        near: Depth of the near plane, metres.
        limit: Largest radius at unit depth.
        width, height: Size of the image, pixels.
    """

    fx: Real
    fy: Real
    cx: Real
    cy: Real
    k1: Real
    k2: Real
    p1: Real
    p2: Real
    k3: Real
    distorts: bool
    near: Real
    limit: Real
    width: Real
    height: Real


class Potential(NamedTuple):
    """A robust potential of `torchcss.robust`.

    Attributes:
        kind: Its place in `potentials.KINDS`.
        nu: Spread of the outliers.
        variance: Square of the scale of the peak.
    """

    kind: int
    nu: Real
    variance: Real


class Edges(NamedTuple):
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

    scale: Real
    field: Array
    corner: Array
    steps: Array
    step: Real
    window: Real
    unmatched: Real
    back_facing: Real
    hidden: Real
    potential: Potential
    assignment: int
    strength: bool
    least: Real


class Colours(NamedTuple):
    """The region term of a frame; see `torchcss.cost.region`.

    Attributes:
        scale: Nats per unit of a node's cost; zero: there is no such term.
        field: Coefficients of the splines, `[layers y x]`.
        corner: See `sample_spline`.
        layer: Layer of each part.
        offset: Distance of the two places from the contour, pixels.
        nu: Cost of a node whose sides are exchanged.
        back_facing: Cost of a node without a contour.
        hidden: Cost of a hidden node.
    """

    scale: Real
    field: Array
    corner: Array
    layer: Array
    offset: Real
    nu: Real
    back_facing: Real
    hidden: Real


class Flow(NamedTuple):
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

    scale: Real
    nodes: Array
    target: Array
    back_facing: Real
    untold: Real
    hidden: Real
    far: Real
    potential: Potential


class PackedKeypoints(NamedTuple):
    """The keypoints of a frame, in double precision; see `torchcss.cost.joints`.

    Attributes:
        scale: Factor on the nats of a joint; zero: there is no such term.
        row: Row of the frame that carries each joint.
        place: The joint in that frame, metres.
        target: Position and weight of each keypoint, for each mode or for all, `[modes 3 joints]`.
        far: Squared distance that an unseen joint counts as, square pixels of weight one.
        potential: Kind, nu and sigma of the potential.
    """

    scale: Real
    row: Array
    place: Array
    target: Array
    far: Real
    potential: Potential


class View(NamedTuple):
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

    lens: Lens
    precise: Lens
    curves: Curves
    edges: Edges
    colours: Colours
    flow: Flow
    keypoints: PackedKeypoints
    nothing: float
    exact: bool


class LongTails(NamedTuple):
    """Lorentzian priors of single parameters; see `torchcss.cost.stabiliser.long_tailed`.

    Attributes:
        weight: Factor on each prior.
        nu: Height of its tails, nats.
        centre: Where it pulls to, for each mode before, `[priors modes n]`.
        sharpness: Reciprocal deviations; zero: there is no prior, `[priors n]`.
    """

    weight: Array
    nu: Array
    centre: Array
    sharpness: Array


class Gaussian(NamedTuple):
    """A Gaussian prior of some parameters.

    Attributes:
        columns: Which parameters.
        mean: Their means.
        precision: The inverse covariance, times the prior's weight.
    """

    columns: Array
    mean: Array
    precision: Array


class Mixture(NamedTuple):
    """The mixture before, one frame ahead; see `torchcss.cost.temporal.MixturePrior`.

    Attributes:
        weight: Factor on the prior; zero: there is none.
        nu: Height of the tails, nats.
        far: Where offsets end.
        mean: Means of the modes, `[k n]`.
        precision: Inverse covariances.
        height: Logarithm of each mode's density at its mean.
    """

    weight: float
    nu: float
    far: float
    mean: Array
    precision: Array
    height: Array


class PriorScratch(NamedTuple):
    """Memory for `add_priors`.

    Attributes:
        pull: A gradient, `[n]`.
        share: Each mode's share in the mixture before, `[k]`.
        pulls: The gradient about each mode, `[k n]`.
    """

    pull: Array
    share: Array
    pulls: Array


class Limbs(NamedTuple):
    """Directions of limbs and their density, by groups; see `torchcss.cost.pose_prior`.

    Attributes:
        scale: Factor on the prior.
        row: Row of the frame that carries each end of a segment.
        place: Its place in that frame.
        above: Which joints move it, `[joint point]`, zero or one.
        difference: What takes the ends to segments.
        fixed: Segments that no joint moves; zero for the others.
        first: First segment of each group.
        segments: Number of its segments.
        line: The line that its frame lies along: hips or shoulders.
        side: Factors on its axes: a right arm is mirrored.
        bends: Which joints move its directions, `[group joint]`.
        number: Number of its Gaussians.
        mean: Their means, `[group k d]`.
        precision: Their inverse covariances.
        height: Logarithms of their densities at their means.
        uniform: Logarithm of the uniform part of each group.
    """

    scale: float
    row: Array
    place: Array
    above: Array
    difference: Array
    fixed: Array
    first: Array
    segments: Array
    line: Array
    side: Array
    bends: Array
    number: Array
    mean: Array
    precision: Array
    height: Array
    uniform: Array


class LimbScratch(NamedTuple):
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
        slope: How they move with each parameter.
        touched: Whether they do.
        share: Shares of the Gaussians.
        pulls: Their pulls.
        pull: All of them together.
        bend: Mean precision.
        bent: Its product with one slope.
    """

    frames: Array
    reference: Array
    twists: Array
    point: Array
    velocity: Array
    unit: Array
    length: Array
    moved: Array
    axes: Array
    normal: Array
    spin: Array
    turned: Array
    direction: Array
    slope: Array
    touched: Array
    share: Array
    pulls: Array
    pull: Array
    bend: Array
    bent: Array


class Repulsion(NamedTuple):
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
        shape: The fields of `Superquadrics`, `[13 parts]`.
        inner: Half sides of a box that holds the nodes, `[parts 3]`.
        outer: Half sides of a box that holds the potential.
        pair: Number of the ordered pair of a part and one that repels it; -1: they may touch.
        chain: Joints between the two parts of each pair, from the one that repels.
        sign: -1 where the joint moves that one, +1 where it moves the other, 0 for padding.
    """

    scale: Real
    p: Real
    sharpness: Real
    end: Real
    reach: Real
    exponent: Real
    last: Real
    spheres: Array
    nodes: Array
    shape: Array
    inner: Array
    outer: Array
    pair: Array
    chain: Array
    sign: Array


class Nodes(NamedTuple):
    """Nodes on the surface, part after part.

    Attributes:
        x, y, z: Position.
        nx, ny, nz: Unit outward normal.
        exists: Share with which the node is there, or with which it faces the camera.
        visible: 1 where no other part hides it, 0 where one does.
        first: Where the nodes of each part begin, and the end of all.
    """

    x: Array
    y: Array
    z: Array
    nx: Array
    ny: Array
    nz: Array
    exists: Array
    visible: Array
    first: Array


class Rays(NamedTuple):
    """Lines of sight, part after part.

    Attributes:
        u, v, w: Unit directions.
        length: To the node, metres; minus infinity where nobody asks.
        gap: Signed distance to the nearest part in the way, metres.
    """

    u: Array
    v: Array
    w: Array
    length: Array
    gap: Array


class Lines(NamedTuple):
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

    ray: Array
    part: Array
    x: Array
    y: Array
    z: Array
    u: Array
    v: Array
    w: Array
    begin: Array
    end: Array
    s: Array
    curvature: Array
    value: Array
    slope: Array
    last: Array
    before: Array


class Seen(NamedTuple):
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

    node: Array
    part: Array
    u: Array
    v: Array
    a: Array
    b: Array
    w: Array
    aa: Array
    ab: Array
    bb: Array
    mu: Array
    mv: Array
    gain: Array
    gu: Array
    gv: Array
    uu: Array
    uv: Array
    vv: Array
    first: Array


class Peaks(NamedTuple):
    """Maxima of the edge response along the normals of nodes.

    Attributes:
        place: Distance of the highest sample from the node, pixels.
        before, left, middle, right, after: That sample's response and those beside it.
        weight: Weight of the edge.
        share: What it takes of the sum of one.
        well, slope, curvature: Its cost below that of no edge, and derivatives along the normal.
    """

    place: Array
    before: Array
    left: Array
    middle: Array
    right: Array
    after: Array
    weight: Array
    share: Array
    well: Array
    slope: Array
    curvature: Array


class Points(NamedTuple):
    """Points with the derivatives of their cost.

    Attributes:
        x, y, z: Position.
        gx, gy, gz: Gradient, nats per metre.
        xx, xy, xz, yy, yz, zz: Hessian, nats per square metre.
        first: Where the points of each part begin, and the end of all.
    """

    x: Array
    y: Array
    z: Array
    gx: Array
    gy: Array
    gz: Array
    xx: Array
    xy: Array
    xz: Array
    yy: Array
    yz: Array
    zz: Array
    first: Array


class Result(NamedTuple):
    """Cost and derivatives of a pool, double precision; a call adds to it.

    Attributes:
        value: Cost, nats.
        gradient: Its gradient in the state; empty: not wanted.
        hessian: Its Hessian.
    """

    value: Array
    gradient: Array
    hessian: Array


class Workspace(NamedTuple):
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
        response: Responses along a search line.
        maxima: Places of its maxima.
    """

    frames: Array
    frame: Array
    posed: Array
    reference: Array
    twists: Array
    moved: Array
    sums: Array
    facing: Array
    outline: Nodes
    interior: Nodes
    rays: Rays
    near: Lines
    lines: Lines
    points: Points
    seen: Seen
    peaks: Peaks
    response: Array
    maxima: Array

"""TrackingCost: the negative log posterior of one frame, eq. 3 to 7, 11 and 12 [IJRR].

    f(x) = sum_terms  weight_t / (N_t nu_t) sum_i e_i(x)  +  sum_priors f_p(x)

Every term sees posed points, never x; its derivatives at the points are collected and lifted once,
over all views where several cameras look on.
`value` and `local_model` find visibility and edge assignments fresh at x; the derivatives hold them
fixed. Large batches are worked off in chunks, so memory does not grow with the number of samples.

The factor 1/(N nu) of eq. 5 alone would make the posterior far too flat; `weight_t` sets its
temperature: the nats that a term contributes per nu of mean cost per node (design decision 8).

| name | term or prior | section of [IJRR] |
|---|---|---|
| `contour` | edges along the normals of occluding contours | 3.1.2, eq. 8 |
| `edge_energy` | the edge energy itself at the same nodes | 2 |
| `region` | colours on either side of the same nodes | 8 |
| `segmentation` | colours of all covered pixels; in the weights of modes only | 8 |
| `background` | what is behind the body, for these two; no cost of its own | 8 |
| `silhouette` | what is before the background is covered, and nothing else | 8 |
| `flow` | displacement of interior nodes against the optical flow | 3.1.2, eq. 9 |
| `joints` | 2D joint correspondences | 5 |
| `anthropometric` | lengths of the limbs, where they are free | 3.2.1 |
| `stabiliser` | long-tailed priors on what is hard to see | 3.2.2 |
| `interpenetration` | repulsion between parts | 3.2.4 |
| `temporal` | near the sample's parent mode | 3.4, eq. 10 |
| `temporal_mixture` | near any mode of the previous frame | 3.4, eq. 10 |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.model import BodyModel, BodyPose
from torchcss.cost.anthropometric import Anthropometric, proportion_columns
from torchcss.cost.contour import ContourTerm
from torchcss.cost.edge_energy import EdgeEnergyTerm
from torchcss.cost.flow import FlowTerm, InteriorNodes
from torchcss.cost.interpenetration import Interpenetration, InterpenetrationPairs
from torchcss.cost.joints import JointTerm, match_joints
from torchcss.cost.region import RegionTerm
from torchcss.cost.segmentation import SegmentationTerm
from torchcss.cost.silhouette import SilhouetteTerm
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.temporal import MixtureDensity, MixturePrior, TemporalPrior
from torchcss.cost.view import View
from torchcss.cost.visibility import ContourPredictor, front_facing, visible_nodes
from torchcss.inference.mixture import GaussianMixture
from torchcss.stopwatch import Stopwatch
from torchcss.types import Curvature, LocalModel, PointCost

CHUNK = 512
"""Most samples evaluated at a time: enough to hide the overhead of calls."""

CHUNK_NODES = 65_536
"""Most nodes evaluated at a time. With arrays of more than these the allocator keeps handing memory
back to the system, and fetching it again costs as much as half of the arithmetic (measured)."""

_PAIRS = 64
"""Pairs of a node and a point of the silhouette that take as much memory as one node."""

COARSE_SCALE = 6.0
"""How much farther off a keypoint may be in the coarse cost before it counts as an outlier. Their
noise stays what it is: were it so much wider, the temporal prior would hold every limb back."""


@dataclass(frozen=True, kw_only=True)
class CostChoice:
    """Which terms and priors make up the cost, and how they weigh.

    A term that lacks what it compares with (a frame without keypoints or flow, a body without free
    lengths) is silent.

    Attributes:
        contour: The edge term, or None.
        edge_energy: The direct edge-energy potential, or None.
        region: The term of the colours on either side of the contour, or None.
        segmentation: The likeness of all covered pixels, for the weights of modes, or None.
        background: Whether `region` and `segmentation` know what is behind the body, see
            `torchcss.vision.background`.
        silhouette: The silhouette term, or None. It needs a background or masks.
        flow: The flow term, or None.
        joints: The keypoint term, or None.
        stabiliser: The sticky prior, or None.
        anthropometric: The prior on free lengths, or None; it takes the stabiliser's place there.
        temporal: The prior about each sample's parent mode, or None.
        temporal_mixture: The prior of the whole previous mixture, or None.
        interpenetration: The repulsion between parts, or None.
        contour_weight: Nats per nu of the contour's mean cost per node.
        edge_energy_weight: Nats per nu of the edge energy's mean cost per node.
        region_weight: Nats per nu of the region term's mean cost per node.
        segmentation_weight: Nats per share of the body's area, see `SegmentationTerm`.
        silhouette_weight: Nats per nu, for a body of which nothing is covered.
        flow_weight: Nats per nu of the flow's mean cost per node. At 50 it holds real limbs a
            little better, but where the flow misses a fast hand, as on the demo, it holds that
            back; at 20 the edges win.
        joint_weight: Factor on the joints' cost, whose nu is in nats already.
        weights: Further factors by the name of a term or prior, one where none is given: what
            `torchcss.inference.implicit` learns.
        curvature: Which Hessian the optimiser gets.
    """

    contour: ContourTerm | None = field(default_factory=ContourTerm)
    edge_energy: EdgeEnergyTerm | None = None
    region: RegionTerm | None = None
    segmentation: SegmentationTerm | None = None
    background: bool = False
    silhouette: SilhouetteTerm | None = None
    flow: FlowTerm | None = None
    joints: JointTerm | None = field(default_factory=JointTerm)
    stabiliser: Stabiliser | None = field(default_factory=Stabiliser)
    anthropometric: Anthropometric | None = field(default_factory=Anthropometric)
    temporal: TemporalPrior | None = field(default_factory=TemporalPrior)
    temporal_mixture: MixturePrior | None = None
    interpenetration: Interpenetration | None = None
    contour_weight: float = 150.0
    edge_energy_weight: float = 150.0
    region_weight: float = 400.0
    segmentation_weight: float = 400.0
    silhouette_weight: float = 800.0
    flow_weight: float = 20.0
    joint_weight: float = 1.0
    weights: Mapping[str, float] = field(default_factory=dict)
    curvature: Curvature = Curvature.EXACT


class _Observed(NamedTuple):
    """One image term at one batch of poses: where its points are, and how to evaluate it there."""

    name: str
    points: Float[Tensor, "*batch p 3"]
    link: Int[Tensor, " p"]
    scale: float
    value: Callable[[], Float[Tensor, "*batch p"]]
    point_cost: Callable[..., PointCost]


class _Prior(NamedTuple):
    """One prior at one batch of states, and how to evaluate it there."""

    name: str
    value: Callable[[], Float[Tensor, "*batch"]]
    local_model: Callable[[], LocalModel]


@dataclass(frozen=True, kw_only=True)
class TrackingCost(View):
    """The cost of one frame; a `CostFunction`.

    It is itself the view of its (first) camera; see `View` for what that sees.

    Attributes:
        others: What further cameras see at the same time; observations add up.
        body: The body, hung on its base.
        choice: Terms and weights.
        predictor: Contour predictor of the body; None switches contour, edge energy and region off.
        interior: Interior nodes of the body, for flow and silhouette; None switches them off.
        pairs: Pairs of parts that may collide; None switches the repulsion off.
        parent: State of each sample's parent mode, `[b n]` or `[n]`; None: no prior about it.
        deviation: Expected motion per frame of every parameter; None: no prior about the parent.
        previous: The previous mixture, one frame ahead; None: no prior about it.
        stopwatch: Where the time of the evaluations is added up by term; None: not at all.
    """

    body: BodyModel
    choice: CostChoice
    others: tuple[View, ...] = ()
    predictor: ContourPredictor | None = None
    interior: InteriorNodes | None = None
    pairs: InterpenetrationPairs | None = None
    parent: Float[Tensor, "*b n"] | None = None
    deviation: Float[Tensor, " n"] | None = None
    previous: MixtureDensity | None = None
    stopwatch: Stopwatch | None = None

    @property
    def views(self) -> tuple[View, ...]:
        """What each camera sees, the first one's view first."""
        return (self, *self.others)

    def with_weights(self, weights: Mapping[str, float]) -> TrackingCost:
        """The same cost with further factors on named terms and priors (`CostChoice.weights`)."""
        return replace(self, choice=replace(self.choice, weights=dict(weights)))

    @property
    def alone(self) -> View:
        """What the first camera sees, without the body."""
        return View(**{part.name: getattr(self, part.name) for part in fields(View)})

    def of_children(self, parent: Int[Tensor, " b"], prior: GaussianMixture) -> TrackingCost:
        """The cost for samples of a prior's modes: each is compared with the mode it came from.

        Args:
            parent: The mode of each sample; `targets` has those of all modes then.
            prior: The modes, one frame ahead.
        """
        mixture = self.choice.temporal_mixture
        return replace(
            self.of_parents(parent),
            others=tuple(view.of_parents(parent) for view in self.others),
            parent=prior.mean[parent],
            previous=None if mixture is None else mixture.density(prior),
        )

    def take(self, items: Int[Tensor, " b"]) -> TrackingCost:
        """The cost restricted to some samples: each keeps its own parent."""
        cost = self.of_samples(items)
        if self.parent is not None and self.parent.dim() > 1:
            cost = replace(cost, parent=self.parent[items])
        if self.others:
            cost = replace(cost, others=tuple(view.of_samples(items) for view in self.others))
        return cost

    def coarse(self) -> TrackingCost | None:
        """The keypoints alone, none an outlier: what finds a limb that moved too fast for edges.

        None in frames without keypoints.
        """
        joints = self.choice.joints
        if joints is None or all(view.keypoints is None for view in self.views):
            return None
        trusting = replace(joints, nu=COARSE_SCALE**2 * joints.nu)
        return replace(self, choice=replace(self._without_images(), joints=trusting))

    def screening(self) -> TrackingCost:
        """The edges alone, by which [RR] section 4.2 scores sampled hypotheses for speed."""
        edges = replace(
            self._without_images(),
            contour=self.choice.contour,
            edge_energy=self.choice.edge_energy,
            region=self.choice.region,
            stabiliser=None,
            anthropometric=None,
            temporal=None,
            temporal_mixture=None,
            interpenetration=None,
        )
        return replace(self, choice=edges)

    def value(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
        """Cost in nats, visibility and assignments found fresh at x."""
        return self._chunked(
            lambda x, part: (torch.stack(list(part._values(x).values())).sum(0),), x
        )[0]

    def landmarks(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch j 3"]:
        """Joint centres, metres: by how far they are apart two states are unlike each other."""
        return self.body.pose(x).joints

    def terms(self, x: Float[Tensor, "*batch n"]) -> dict[str, Float[Tensor, "*batch"]]:
        """Cost of every term and prior by name, nats."""
        names: list[str] = []

        def evaluate(x: Tensor, part: TrackingCost) -> tuple[Tensor, ...]:
            values = part._values(x)
            names[:] = values
            return tuple(values.values())

        return dict(zip(names, self._chunked(evaluate, x), strict=True)) if x.numel() else {}

    @property
    def knows_segmentation(self) -> bool:
        """Whether `unsearched` tells poses apart."""
        seen = any(view.segmentation is not None for view in self.views)
        return seen and self.choice.segmentation is not None

    def unsearched(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
        """Cost of what has no derivatives, nats: it counts in the weights of modes, not in `value`.

        That is the segmentation alone; zero where it is not known.
        """
        term, total = self.choice.segmentation, x.new_zeros(x.shape[:-1])
        weight = self.choice.weights.get("segmentation", 1.0) * self.choice.segmentation_weight
        for view in self.views:
            if term is not None and view.segmentation is not None:
                with self._timed("segmentation"):
                    total = total + weight * term.value(self.body, x, view.segmentation)
        return total

    def gradients(self, x: Float[Tensor, "*batch n"]) -> dict[str, Float[Tensor, "*batch n"]]:
        """Gradient of every term and prior by name, visibility and assignments held fixed."""
        names: list[str] = []

        def evaluate(x: Tensor, part: TrackingCost) -> tuple[Tensor, ...]:
            gradients = part._gradients(x)
            names[:] = gradients
            return tuple(gradients.values())

        return dict(zip(names, self._chunked(evaluate, x), strict=True)) if x.numel() else {}

    def local_model(self, x: Float[Tensor, "*batch n"]) -> LocalModel:
        """Cost, gradient and Hessian, visibility and assignments found at x and held fixed."""
        return LocalModel(*self._chunked(lambda x, part: tuple(part._local_model(x)), x))

    def _without_images(self) -> CostChoice:
        return replace(
            self.choice,
            contour=None,
            edge_energy=None,
            region=None,
            silhouette=None,
            flow=None,
            joints=None,
        )

    @property
    def _chunk(self) -> int:
        """Samples to evaluate at a time."""
        choice, nodes = self.choice, 1
        if self.predictor is not None and (choice.contour or choice.edge_energy or choice.region):
            nodes += self.predictor.num_nodes
        if self.interior is not None and choice.flow:
            nodes += self.interior.num_nodes
        nodes *= len(self.views)
        for view in self.views:
            if self.interior is not None and choice.silhouette and view.silhouette is not None:
                pairs = self.interior.num_nodes * len(view.silhouette.points)
                nodes += math.ceil(pairs / _PAIRS)
        return max(1, min(CHUNK, CHUNK_NODES // nodes))

    def _chunked(
        self, evaluate: Callable[[Tensor, TrackingCost], tuple[Tensor, ...]], x: Tensor
    ) -> tuple[Tensor, ...]:
        flat = x.reshape(-1, x.shape[-1])
        results = []
        for items in torch.arange(max(len(flat), 1), device=x.device).split(self._chunk):
            items = items[: len(flat)]
            results.append(evaluate(flat[items], self.take(items)))
        return tuple(
            torch.cat(parts).reshape((*x.shape[:-1], *parts[0].shape[1:]))
            for parts in zip(*results, strict=True)
        )

    def _timed(self, name: str) -> AbstractContextManager[Any]:
        return nullcontext() if self.stopwatch is None else self.stopwatch(name)

    def _values(self, x: Tensor) -> dict[str, Tensor]:
        with self._timed("pose"):
            pose = self.body.pose(x)
        values = {}
        for prior in self._priors(x, pose):
            with self._timed(prior.name):
                values[prior.name] = prior.value()
        for term in self._observed(pose):
            with self._timed(term.name):
                value = term.scale * term.value().sum(-1)
            values[term.name] = values.get(term.name, 0.0) + value
        return values or {"none": x.new_zeros(x.shape[:-1])}

    def _gradients(self, x: Tensor) -> dict[str, Tensor]:
        pose = self.body.pose(x)
        gradients: dict[str, Tensor] = {
            prior.name: prior.local_model().gradient for prior in self._priors(x, pose)
        }
        for term in self._observed(pose):
            cost = PointCost(*(term.scale * part for part in term.point_cost()))
            lifted = self.body.lift(pose, term.points, term.link, cost)
            gradients[term.name] = gradients.get(term.name, 0.0) + lifted.gradient
        return gradients or {"none": torch.zeros_like(x)}

    def _local_model(self, x: Tensor) -> LocalModel:
        with self._timed("pose"):
            pose = self.body.pose(x)
        gauss_newton = self.choice.curvature is Curvature.GAUSS_NEWTON
        points, links, costs = [], [], []
        for term in self._observed(pose):
            with self._timed(term.name):
                cost = term.point_cost(gauss_newton=gauss_newton)
                points.append(term.points)
                links.append(term.link)
                costs.append(PointCost(*(term.scale * part for part in cost)))
        size = x.shape[-1]
        total = LocalModel(
            x.new_zeros(len(x)), torch.zeros_like(x), x.new_zeros(len(x), size, size)
        )
        if points:
            with self._timed("lift"):
                cost = PointCost(*(torch.cat(parts, dim=1) for parts in zip(*costs, strict=True)))
                total = self.body.lift(
                    pose,
                    torch.cat(points, dim=1),
                    torch.cat(links),
                    cost,
                    curvature=self.choice.curvature,
                )
        for prior in self._priors(x, pose):
            with self._timed(prior.name):
                model = prior.local_model()
                total = LocalModel(*(a + b for a, b in zip(total, model, strict=True)))
        return total

    def _observed(self, pose: BodyPose) -> Iterator[_Observed]:
        """The image terms of all views, at a batch of poses."""
        weights = self.choice.weights
        for view in self.views:
            for term in self._seen_by(view, pose):
                yield term._replace(scale=weights.get(term.name, 1.0) * term.scale)

    def _seen_by(self, view: View, pose: BodyPose) -> Iterator[_Observed]:
        """The image terms that have what they need in a view, at a batch of poses."""
        choice, body, camera, predictor = self.choice, self.body, view.camera, self.predictor
        matches = choice.contour is not None and view.edge_field is not None
        direct = choice.edge_energy is not None and view.energy is not None
        regions = choice.region is not None and view.region is not None
        if predictor is not None and (matches or direct or regions):
            with self._timed("visibility"):
                nodes = predictor(body, pose, camera.centre_world)
            # None on a robot without flesh.
            num_nodes = max(predictor.num_nodes, 1)
            for name, term, image, weight in (
                ("contour", choice.contour, view.edge_field, choice.contour_weight),
                ("edge_energy", choice.edge_energy, view.energy, choice.edge_energy_weight),
                ("region", choice.region, view.region, choice.region_weight),
            ):
                if term is not None and image is not None:
                    yield _Observed(
                        name,
                        nodes.points,
                        predictor.node_link,
                        weight / (num_nodes * term.nu),
                        partial(term.value, nodes, camera, image),  # type: ignore[arg-type]
                        partial(term.point_cost, nodes, camera, image),  # type: ignore[arg-type]
                    )
        if (
            choice.silhouette is not None
            and self.interior is not None
            and view.silhouette is not None
        ):
            term, surface = choice.silhouette, self.interior(body, pose).points
            yield _Observed(
                "silhouette",
                surface,
                self.interior.node_link,
                choice.silhouette_weight / term.nu,
                partial(term.value, surface, view.silhouette),
                partial(term.point_cost, surface, view.silhouette),
            )
        if choice.flow is not None and self.interior is not None and view.targets is not None:
            term, interior = choice.flow, self.interior
            with self._timed("visibility"):
                points, normals = interior(body, pose)
                eye = camera.centre_world
                facing = front_facing(points, normals, eye)
                seen = visible_nodes(body, pose, eye, points, interior.node_part, wanted=facing)
            arguments = (points, normals, seen, camera, view.targets)
            yield _Observed(
                "flow",
                points,
                interior.node_link,
                choice.flow_weight / (max(interior.num_nodes, 1) * term.nu),
                partial(term.value, *arguments),
                partial(term.point_cost, *arguments),
            )
        if choice.joints is not None and view.keypoints is not None:
            term, targets = choice.joints, match_joints(view.keypoints, body.joint_names)
            joints = pose.joints[..., targets.joint, :]
            yield _Observed(
                "joints",
                joints,
                body.marker_link[targets.joint],
                choice.joint_weight,
                lambda: term.value(camera.project(joints), targets),
                partial(term.point_cost, joints, camera, targets),
            )

    def _priors(self, x: Tensor, pose: BodyPose) -> Iterator[_Prior]:
        """The priors that have what they need, at a batch of states."""
        for prior in self._plain_priors(x, pose):
            yield _weighed(prior, self.choice.weights.get(prior.name, 1.0))

    def _plain_priors(self, x: Tensor, pose: BodyPose) -> Iterator[_Prior]:
        choice, body = self.choice, self.body
        lengths = list(proportion_columns(body).values())
        if choice.stabiliser is not None:
            deviation = body.sticky_deviation
            if choice.anthropometric is not None and lengths:
                deviation = deviation.clone()
                deviation[lengths] = math.inf
            yield _on_states(
                "stabiliser",
                partial(choice.stabiliser.local_model, x, body.sticky_mean, deviation),
            )
        if choice.anthropometric is not None and lengths:
            yield _on_states("anthropometric", partial(choice.anthropometric.local_model, x, body))
        if choice.temporal is not None and self.parent is not None and self.deviation is not None:
            yield _on_states(
                "temporal",
                partial(choice.temporal.local_model, x, self.parent, self.deviation),
            )
        if choice.temporal_mixture is not None and self.previous is not None:
            yield _on_states(
                "temporal_mixture",
                partial(choice.temporal_mixture.local_model, x, self.previous),
            )
        if choice.interpenetration is not None and self.pairs is not None:
            term, arguments = choice.interpenetration, (body, pose, self.pairs)
            yield _Prior(
                "interpenetration",
                partial(term.value, *arguments),
                partial(term.local_model, *arguments, curvature=choice.curvature),
            )


def _on_states(name: str, local_model: Callable[[], LocalModel]) -> _Prior:
    """A prior whose derivatives cost next to nothing."""
    return _Prior(name, lambda: local_model().value, local_model)


def _weighed(prior: _Prior, weight: float) -> _Prior:
    if weight == 1.0:
        return prior
    return _Prior(
        prior.name,
        lambda: weight * prior.value(),
        lambda: LocalModel(*(weight * part for part in prior.local_model())),
    )

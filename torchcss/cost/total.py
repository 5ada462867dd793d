"""TrackingCost: the negative log posterior of one frame, eq. 3 to 7, 11 and 12 [IJRR].

    f(x) = sum_terms  weight_t / (N_t nu_t) sum_i e_i(x)  +  f_s(x) + f_temporal(x)

Every term sees posed points, never x; its derivatives at the points are collected and lifted once.
`value` and `local_model` find visibility and edge assignments fresh at x; the derivatives hold them
fixed. Large batches are worked off in chunks, so memory does not grow with the number of samples.

The factor 1/(N nu) of eq. 5 alone would make the posterior far too flat; `weight_t` sets its
temperature: the nats that a term contributes per nu of mean cost per node (design decision 8).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.model import BodyModel, BodyPose
from torchcss.cost.contour import ContourTerm
from torchcss.cost.flow import FlowTargets, FlowTerm, InteriorNodes
from torchcss.cost.interpenetration import Interpenetration, InterpenetrationPairs
from torchcss.cost.joints import JointObservation, JointTerm
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.temporal import TemporalPrior
from torchcss.cost.visibility import ContourNodes, ContourPredictor, visible_nodes
from torchcss.types import Curvature, LocalModel, PointCost
from torchcss.vision.camera import Camera

CHUNK = 256
"""Samples evaluated at a time: small enough for the caches, large enough to hide call overhead."""


COARSE_SCALE = 6.0
"""How much wider the keypoints' scale is in the coarse cost: a missed limb is then no outlier."""


@dataclass(frozen=True, kw_only=True)
class CostChoice:
    """Which terms and priors make up the cost, and how they weigh.

    Attributes:
        contour: The edge term, or None.
        flow: The flow term, or None; it is silent in frames without flow.
        joints: The keypoint term, or None; it is silent in frames without keypoints.
        stabiliser: The sticky prior, or None.
        temporal: The temporal prior, or None.
        interpenetration: The repulsion between parts, or None.
        contour_weight: Nats per nu of the contour's mean cost per node.
        flow_weight: Nats per nu of the flow's mean cost per node.
        joint_weight: Factor on the joints' cost, whose nu is in nats already.
        curvature: Which Hessian the optimiser gets.
    """

    contour: ContourTerm | None = field(default_factory=ContourTerm)
    flow: FlowTerm | None = None
    joints: JointTerm | None = field(default_factory=JointTerm)
    stabiliser: Stabiliser | None = field(default_factory=Stabiliser)
    temporal: TemporalPrior | None = field(default_factory=TemporalPrior)
    interpenetration: Interpenetration | None = None
    contour_weight: float = 150.0
    flow_weight: float = 50.0
    joint_weight: float = 1.0
    curvature: Curvature = Curvature.EXACT


@dataclass(frozen=True, kw_only=True)
class TrackingCost:
    """The cost of one frame; a `CostFunction`.

    Attributes:
        body: The body, hung on its base.
        camera: The camera of the image that the features were computed on.
        choice: Terms and weights.
        predictor: Contour predictor of the body; None switches the contour term off.
        edge_field: Edge energy times gradient direction; None switches the contour term off.
        interior: Interior nodes of the body, for the flow term; None switches it off.
        targets: Where the flow carried the nodes of each sample's parent mode, `[b p 2]`.
        observation: Keypoints of the frame, in that image's pixels; None if there are none.
        pairs: Pairs of parts that may collide; None switches the repulsion off.
        parent: State of each sample's parent mode, `[b n]` or `[n]`; None: no temporal prior.
        deviation: Expected motion per frame of every parameter, for the temporal prior.
    """

    body: BodyModel
    camera: Camera
    choice: CostChoice
    predictor: ContourPredictor | None = None
    edge_field: Float[Tensor, "2 h w"] | None = None
    interior: InteriorNodes | None = None
    targets: FlowTargets | None = None
    observation: JointObservation | None = None
    pairs: InterpenetrationPairs | None = None
    parent: Float[Tensor, "*b n"] | None = None
    deviation: Float[Tensor, " n"] | None = None

    def take(self, items: Int[Tensor, " b"]) -> TrackingCost:
        """The cost restricted to some samples: each keeps its own parent."""
        cost = self
        if cost.parent is not None and cost.parent.dim() > 1:
            cost = replace(cost, parent=cost.parent[items])
        if cost.targets is not None and cost.targets.uv.dim() > 2:
            cost = replace(cost, targets=cost.targets.take(items))
        return cost

    def coarse(self) -> TrackingCost | None:
        """The keypoints alone with a wide scale: what finds a limb that moved too fast for edges.

        None in frames without keypoints.
        """
        if not self._uses_joints:
            return None
        assert self.choice.joints is not None
        wide = replace(self.choice.joints, sigma=COARSE_SCALE * self.choice.joints.sigma)
        return replace(self, choice=replace(self.choice, contour=None, flow=None, joints=wide))

    def value(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
        """Cost in nats, visibility and assignments found fresh at x."""
        return self._chunked(
            lambda x, part: (torch.stack(list(part._values(x).values())).sum(0),), x
        )[0]

    def terms(self, x: Float[Tensor, "*batch n"]) -> dict[str, Float[Tensor, "*batch"]]:
        """Cost of every term and prior by name, nats."""
        names: list[str] = []

        def evaluate(x: Tensor, part: TrackingCost) -> tuple[Tensor, ...]:
            values = part._values(x)
            names[:] = values
            return tuple(values.values())

        return dict(zip(names, self._chunked(evaluate, x), strict=True)) if x.numel() else {}

    def local_model(self, x: Float[Tensor, "*batch n"]) -> LocalModel:
        """Cost, gradient and Hessian, visibility and assignments found at x and held fixed."""
        return LocalModel(*self._chunked(lambda x, part: tuple(part._local_model(x)), x))

    def _chunked(
        self, evaluate: Callable[[Tensor, TrackingCost], tuple[Tensor, ...]], x: Tensor
    ) -> tuple[Tensor, ...]:
        flat = x.reshape(-1, x.shape[-1])
        results = []
        for items in torch.arange(max(len(flat), 1), device=x.device).split(CHUNK):
            items = items[: len(flat)]
            results.append(evaluate(flat[items], self.take(items)))
        return tuple(
            torch.cat(parts).reshape((*x.shape[:-1], *parts[0].shape[1:]))
            for parts in zip(*results, strict=True)
        )

    @property
    def _uses_contour(self) -> bool:
        return None not in (self.choice.contour, self.predictor, self.edge_field)

    @property
    def _uses_flow(self) -> bool:
        return None not in (self.choice.flow, self.interior, self.targets)

    @property
    def _uses_joints(self) -> bool:
        return self.choice.joints is not None and self.observation is not None

    def _values(self, x: Tensor) -> dict[str, Tensor]:
        pose = self.body.pose(x)
        values = {name: model.value for name, model in self._priors(x, pose).items()}
        if self._uses_contour:
            term, nodes = self.choice.contour, self._contour_nodes(pose)
            assert term is not None
            assert self.edge_field is not None
            cost = term.value(nodes, self.camera, self.edge_field)
            values["contour"] = self._contour_scale * cost.sum(-1)
        if self._uses_flow:
            term = self.choice.flow
            assert term is not None
            cost = term.value(*self._interior_nodes(pose), self.camera, self._targets)
            values["flow"] = self._flow_scale * cost.sum(-1)
        if self._uses_joints:
            assert self.choice.joints is not None
            assert self.observation is not None
            projection = self.camera.project(pose.joints[..., self.observation.index, :])
            cost = self.choice.joints.value(projection, self.observation)
            values["joints"] = self.choice.joint_weight * cost.sum(-1)
        return values or {"none": x.new_zeros(x.shape[:-1])}

    def _local_model(self, x: Tensor) -> LocalModel:
        pose = self.body.pose(x)
        gauss_newton = self.choice.curvature is Curvature.GAUSS_NEWTON
        points, links, costs = [], [], []
        if self._uses_contour:
            term, nodes = self.choice.contour, self._contour_nodes(pose)
            assert term is not None
            assert self.predictor is not None
            assert self.edge_field is not None
            cost = term.point_cost(nodes, self.camera, self.edge_field, gauss_newton=gauss_newton)
            points.append(nodes.points)
            links.append(self.predictor.node_link)
            costs.append(PointCost(*(self._contour_scale * part for part in cost)))
        if self._uses_flow:
            term, interior = self.choice.flow, self._interior_nodes(pose)
            assert term is not None
            assert self.interior is not None
            cost = term.point_cost(*interior, self.camera, self._targets, gauss_newton=gauss_newton)
            points.append(interior[0])
            links.append(self.interior.node_link)
            costs.append(PointCost(*(self._flow_scale * part for part in cost)))
        if self._uses_joints:
            term, observation = self.choice.joints, self.observation
            assert term is not None
            assert observation is not None
            joints = pose.joints[..., observation.index, :]
            cost = term.point_cost(joints, self.camera, observation, gauss_newton=gauss_newton)
            points.append(joints)
            links.append(self.body.marker_link[observation.index])
            costs.append(PointCost(*(self.choice.joint_weight * part for part in cost)))
        size = x.shape[-1]
        total = LocalModel(
            x.new_zeros(len(x)), torch.zeros_like(x), x.new_zeros(len(x), size, size)
        )
        if points:
            cost = PointCost(*(torch.cat(parts, dim=1) for parts in zip(*costs, strict=True)))
            total = self.body.lift(
                pose,
                torch.cat(points, dim=1),
                torch.cat(links),
                cost,
                curvature=self.choice.curvature,
            )
        for prior in self._priors(x, pose).values():
            total = LocalModel(*(a + b for a, b in zip(total, prior, strict=True)))
        return total

    def _priors(self, x: Tensor, pose: BodyPose) -> dict[str, LocalModel]:
        body, priors = self.body, {}
        if self.choice.stabiliser is not None:
            priors["stabiliser"] = self.choice.stabiliser.local_model(
                x, body.sticky_mean, body.sticky_deviation
            )
        if self.choice.temporal is not None and self.parent is not None:
            assert self.deviation is not None
            priors["temporal"] = self.choice.temporal.local_model(x, self.parent, self.deviation)
        if self.choice.interpenetration is not None and self.pairs is not None:
            priors["interpenetration"] = self.choice.interpenetration.local_model(
                body, pose, self.pairs, curvature=self.choice.curvature
            )
        return priors

    def _contour_nodes(self, pose: BodyPose) -> ContourNodes:
        assert self.predictor is not None
        return self.predictor(self.body, pose, self.camera.centre_world)

    def _interior_nodes(self, pose: BodyPose) -> tuple[Tensor, Tensor, Tensor]:
        """Points, normals and visibility of the interior nodes."""
        assert self.interior is not None
        points, normals = self.interior(self.body, pose)
        centre, part = self.camera.centre_world, self.interior.node_part
        return points, normals, visible_nodes(self.body, pose, centre, points, part)

    @property
    def _targets(self) -> FlowTargets:
        assert self.targets is not None
        return self.targets

    @property
    def _flow_scale(self) -> float:
        assert self.choice.flow is not None
        assert self.interior is not None
        num_nodes = max(self.interior.num_nodes, 1)
        return self.choice.flow_weight / (num_nodes * self.choice.flow.nu)

    @property
    def _contour_scale(self) -> float:
        assert self.choice.contour is not None
        assert self.predictor is not None
        num_nodes = max(self.predictor.num_nodes, 1)  # none on a robot without flesh
        return self.choice.contour_weight / (num_nodes * self.choice.contour.nu)

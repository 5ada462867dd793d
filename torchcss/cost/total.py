"""TrackingCost: the negative log posterior of one frame, eq. 3 to 7, 11 and 12 [IJRR].

    f(x) = sum_terms  weight_t / (N_t nu_t) sum_i e_i(x)  +  sum_priors f_p(x)

Every image term sees posed points, never x; its derivatives at the points are collected and lifted
once, over all views where several cameras look on. `torchcss.cost.choice` lists the terms, and
`torchcss.cost.term` says what a term is: this module names none of them.
`value` and `local_model` find visibility and edge assignments fresh at x; the derivatives hold them
fixed. Large batches are worked off in chunks, so memory does not grow with the number of samples.

The factor 1/(N nu) of eq. 5 alone would make the posterior far too flat; `weight_t` sets its
temperature: the nats that a term contributes per nu of mean cost per node (decision "term
weights").

Samples of several sequences (other bodies, cameras, pictures) may be evaluated together: each
sample has the index of its sequence, and of its parent among the modes of that sequence. One
sequence is the case of one. `torchcss.cost.batched` makes one evaluation of those that are alike.

| name | term or prior | section of [IJRR] |
|---|---|---|
| `contour` | edges along the normals of occluding contours | 3.1.2, eq. 8 |
| `edge_energy` | the edge energy itself at the same nodes | 2 |
| `region` | colours on either side of the same nodes | 8 |
| `segmentation` | colours of all covered pixels; in the weights of modes only | 8 |
| `silhouette` | what is before the background is covered, and nothing else | 8 |
| `flow` | displacement of interior nodes against the optical flow | 3.1.2, eq. 9 |
| `joints` | 2D joint correspondences | 5 |
| `anthropometric` | lengths of the limbs, where they are free | 3.2.1 |
| `stabiliser` | long-tailed priors on what is hard to see | 3.2.2 |
| `pose_prior` | poses that people take, learnt from motion capture | ours |
| `interpenetration` | repulsion between parts | 3.2.4 |
| `temporal` | near the sample's parent mode | 3.4, eq. 10 |
| `temporal_mixture` | near any mode of the previous frame | 3.4, eq. 10 |
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from torchcss.body.model import BodyModel, BodyPose
from torchcss.cost.batched import Merged, merged, rows_of
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import BodyTables, FrameContext
from torchcss.cost.term import BoundImage, Kind, Posed, Term, differentiate_twice
from torchcss.errors import ShapeError
from torchcss.inference.mixture import GaussianMixture, Prior
from torchcss.inference.problem import SearchProblem
from torchcss.stopwatch import Stopwatch
from torchcss.types import Curvature, Keypoints, LocalModel, PointCost
from torchcss.vision.camera import Camera

States = Float[Tensor, "*batch n"]
Costs = Float[Tensor, "*batch"]
Indices = Int[Tensor, " b"]

CHUNK = 512
"""Most samples evaluated at a time: enough to hide the overhead of calls."""

CHUNK_NODES = 65_536
"""Most nodes evaluated at a time. With arrays of more than these the allocator keeps handing memory
back to the system, and fetching it again costs as much as half of the arithmetic (measured)."""

ON_DEVICE = 64
"""How many times as much is evaluated at a time on another device than a CPU: there a call costs
the same for one sample and for thousands. 2000 samples of body34 take 1 GB so."""


class Engine(Protocol):
    """Another way to evaluate a cost, with the same results to a tolerance."""

    def value(self, cost: TrackingCost, x: States) -> Costs:
        """See `TrackingCost.value`."""
        ...

    def held_value(self, cost: TrackingCost, x: States, found_at: States) -> Costs:
        """See `TrackingCost.held_value`."""
        ...

    def local_model(self, cost: TrackingCost, x: States) -> LocalModel:
        """See `TrackingCost.local_model`."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackingCost:
    """The cost of one frame; a `CostFunction`.

    Attributes:
        choice: Terms and weights.
        views: What each camera sees; observations add up, priors count once.
        past: Where priors are taken from, one for each sequence; by default its first view.
        parent: The mode before that each sample descends from; None: the first one.
        component: The component of the prior that each sample descends from; None: its parent.
        sequence: The sequence of each sample (`FrameContext.sequence`); None: there is one.
        stopwatch: Where the time of the evaluations is added up by term; None: not at all.
        engine: What evaluates it; None: the terms as they are written.
        bound: The terms bound to the views; what is not among them is bound now.
        merged: Where what stands for several sequences is kept for the next call; None: nowhere.
    """

    choice: CostChoice
    views: tuple[FrameContext, ...]
    past: tuple[FrameContext, ...] = ()
    parent: Indices | None = None
    component: Indices | None = None
    sequence: Indices | None = None
    stopwatch: Stopwatch | None = None
    engine: Engine | None = None
    bound: Mapping[tuple[Term, FrameContext], Any] = field(default_factory=dict, repr=False)
    merged: Merged | None = None

    def __post_init__(self) -> None:
        if not self.past:
            first = {view.sequence: view for view in reversed(self.views)}
            object.__setattr__(self, "past", tuple(first[number] for number in sorted(first)))
        bound = {}
        for term in self.choice.terms:
            for context in self.past if term.kind == "prior" else self.views:
                key = (term, context)
                bound[key] = self.bound[key] if key in self.bound else term.prepare(context)
        object.__setattr__(self, "bound", bound)

    @property
    def body(self) -> BodyModel:
        """The body of the first view."""
        return self.views[0].body

    @property
    def camera(self) -> Camera:
        """The camera of the first view."""
        return self.views[0].camera

    @property
    def keypoints(self) -> Keypoints:
        """The keypoints of the first view, which has some."""
        keypoints = self.views[0].keypoints
        assert keypoints is not None
        return keypoints

    def with_weights(self, weights: Mapping[str, float]) -> TrackingCost:
        """The same cost with other factors on named terms and priors (`CostChoice.weights`)."""
        return replace(
            self, choice=replace(self.choice, weights={**self.choice.weights, **weights})
        )

    def with_body(self, body: BodyModel) -> TrackingCost:
        """The cost of another body before the same cameras."""
        tables = BodyTables(body)
        views, past = (
            tuple(replace(context, body=body, tables=tables) for context in contexts)
            for contexts in (self.views, self.past)
        )
        return replace(self, views=views, past=past)

    def with_keypoints(self, keypoints: Keypoints | None) -> TrackingCost:
        """The cost with other keypoints in the first view."""
        first, *others = self.views
        return replace(self, views=(replace(first, keypoints=keypoints), *others))

    def of_children(self, component: Indices, *prior: Prior) -> TrackingCost:
        """The cost for samples of a prior: each is compared with what it came from.

        Args:
            component: The component of each sample, in the prior of its sequence.
            prior: The modes before, one frame ahead, and where moves lead, for each sequence.
        """
        seen = {view.sequence: view for view in reversed(self.views)}
        past, parent = [], torch.zeros_like(component)
        for number, own in zip(sorted(seen), prior, strict=True):
            past.append(seen[number].expecting(own.mixture))
            some = slice(None) if self.sequence is None else self.sequence == number
            parent[some] = own.parent[component[some]]
        return replace(self, parent=parent, component=component, past=tuple(past))

    def of_mode(self, x: Float[Tensor, " n"]) -> TrackingCost:
        """The cost for samples that all descend from one pose."""
        single = GaussianMixture(x[None], torch.eye(len(x)).to(x)[None], x.new_zeros(1))
        every = self.of_children(x.new_zeros(0).long(), Prior.of(single))
        return replace(every, parent=None, component=None)

    def take(self, items: Indices) -> TrackingCost:
        """The cost restricted to some samples: each keeps its own parent and sequence."""
        parent, component, sequence = (
            None if index is None else index[items]
            for index in (self.parent, self.component, self.sequence)
        )
        # A copy: terms are bound already, and finding that out anew takes longer.
        taken = copy(self)
        vars(taken).update(parent=parent, component=component, sequence=sequence)
        return taken

    def problem(self) -> SearchProblem:
        """What a tracker searches: the cost, its coarse and its cheap relative, and the rest."""
        past = self._of_those([term.name for term in self.choice.terms if term.of_past])
        motion = self._of_those([term.name for term in self.choice.terms if term.of_motion])
        return self._problem(self.coarse(), self.screening(), past, motion)

    def _problem(self, *relatives: TrackingCost | None) -> SearchProblem:
        coarse, screening, past, motion = relatives

        def restrict(items: Indices) -> SearchProblem:
            some = (None if cost is None else cost.take(items) for cost in relatives)
            return self.take(items)._problem(*some)

        return SearchProblem(
            cost=self,
            coarse=coarse,
            screening=screening,
            weight_only=self.weight_only,
            past=past,
            motion=motion,
            landmarks=self.landmarks,
            restrict=restrict,
            of_children=lambda *given: self.of_children(*given).problem(),
        )

    def coarse(self) -> TrackingCost | None:
        """What finds a limb that moved too fast for edges: keypoints, none of them an outlier.

        None in frames without them.
        """
        terms = tuple(kept for term in self.choice.terms if (kept := term.coarse()) is not None)
        cost = replace(self, choice=replace(self.choice, terms=terms))
        return cost if cost._says("image") else None

    def screening(self) -> TrackingCost | None:
        """The edges alone, by which [RR] section 4.2 scores sampled hypotheses for speed.

        None where they say nothing: all would score alike.
        """
        edges = self.choice.only([term.name for term in self.choice.terms if term.screens])
        cost = replace(self, choice=edges)
        return cost if cost._says("image") else None

    def _of_those(self, names: list[str]) -> TrackingCost | None:
        """The part of the cost that some terms make; None: there are none."""
        return replace(self, choice=self.choice.only(names)) if names else None

    def landmarks(self, x: States) -> Float[Tensor, "*batch j 3"]:
        """Joint centres, metres: by how far they are apart two states are unlike each other."""
        return self.body.pose(x).joints

    def value(self, x: States) -> Costs:
        """Cost in nats, visibility and assignments found fresh at x.

        Where x requires it, autograd and the transforms of `torch.func` get the derivatives of
        `local_model`, first and second.
        """
        self.body.check_state(x)
        at = x.detach()
        if (x.requires_grad and torch.is_grad_enabled()) or unpack_dual(x).tangent is not None:
            return LocalModel(*_Opaque.apply(self.local_model, at)).at(x - at)
        return _Opaque.apply(self._value, at)

    def _value(self, x: States) -> Costs:
        self._check(x)
        if self.engine is not None:
            return self.engine.value(self, x)
        return self._evaluated(lambda part: {"": part.value()}, x)[""]

    def held_value(self, x: States, found_at: States) -> Costs:
        """Cost in nats with the visibility and the assignments that other states have.

        It is the function of x whose derivatives at x = `found_at` are those of `local_model`. It
        has none for autograd.

        Args:
            x: States.
            found_at: The states, as many, at which visibility and assignments are found. Those that
                follow one another and are the same share what is found.
        """
        self._check(x)
        self._check(found_at)
        if x.shape != found_at.shape:
            raise ShapeError(f"found_at: expected {list(x.shape)}, got {list(found_at.shape)}")
        if self.engine is not None:
            return self.engine.held_value(self, x.detach(), found_at.detach())
        return self._evaluated(lambda part: {"": part.held_value()}, found_at, x)[""]

    def terms(self, x: States) -> dict[str, Costs]:
        """Cost of every term and prior by name, nats."""
        if self.engine is None or not x.numel():
            return self._evaluated(_Part.values, x) if x.numel() else {}
        kinds: tuple[tuple[Kind, tuple[FrameContext, ...]], ...]
        kinds = ("prior", self.past), ("image", self.views)
        bound = (self._bound(kind, view) for kind, views in kinds for view in views)
        names = dict.fromkeys(name for terms in bound for name, _ in terms)
        at, only = x.detach(), self.choice.only
        return {name: replace(self, choice=only([name]))._value(at) for name in names}

    def gradients(self, x: States) -> dict[str, States]:
        """Gradient of every term and prior by name, visibility and assignments held fixed."""
        return self._evaluated(_Part.gradients, x) if x.numel() else {}

    def local_model(self, x: States) -> LocalModel:
        """Cost, gradient and Hessian, visibility and assignments found at x and held fixed."""
        self._check(x)
        if self.engine is not None and self.choice.curvature is not Curvature.AUTOGRAD:
            return self.engine.local_model(self, x)
        return LocalModel(**self._evaluated(lambda part: part.local_model()._asdict(), x))

    def _check(self, x: States) -> None:
        self.body.check_state(x)
        each = (self.parent, self.component, self.sequence)
        number, own = x.shape[:-1].numel(), [len(index) for index in each if index is not None]
        if any(count != number for count in own):
            raise ShapeError(
                f"x: {number} states, and the cost is that of {own[0]} samples with parents of "
                "their own: give all of them, or take those (TrackingCost.take)"
            )

    @property
    def weighs(self) -> bool:
        """Whether `weight_only` tells poses apart."""
        return self._says("weight-only")

    def weight_only(self, x: States, *, body: BodyModel | None = None) -> Costs:
        """Cost of what has no derivatives, nats: it counts in the weights of modes, not in `value`.

        Args:
            x: States.
            body: The body to pose, for a shape other than that which was tracked.
        """
        return sum(self.weight_only_terms(x, body=body).values(), x.new_zeros(x.shape[:-1]))

    def weight_only_terms(self, x: States, *, body: BodyModel | None = None) -> dict[str, Costs]:
        """The same by the name of the term; zero for a term that knows nothing of the frame."""
        names = [term.name for term in self.choice.terms if term.kind == "weight-only"]

        def values(part: _Part) -> dict[str, Tensor]:
            return {**dict.fromkeys(names, part.x.new_zeros(len(part.x))), **part.weights(body)}

        return self._evaluated(values, x, apart=True) if names and x.numel() else {}

    @property
    def _chunk(self) -> int:
        """Samples to evaluate at a time, by what each has to do in the views of its sequence."""
        nodes, number = 1, self.views[0].sequence
        for view in (view for view in self.views if view.sequence == number):
            links: list[Tensor] = []
            for _, bound in self._bound("image", view):
                # Terms on the same nodes share them.
                if all(bound.link is not link for link in links):
                    links.append(bound.link)
                    nodes += bound.size
        more = 1 if self.body.tie.device.type == "cpu" else ON_DEVICE
        return max(1, min(CHUNK, CHUNK_NODES // nodes) * more)

    def _evaluated(
        self,
        evaluate: Callable[[_Part], dict[str, Tensor]],
        x: States,
        at: States | None = None,
        *,
        apart: bool = False,
    ) -> dict[str, Tensor]:
        """Evaluate what can be at a time, and put the results together; see `_shares`."""
        flat, found, order = x.detach().reshape(-1, x.shape[-1]), [], []
        moved = flat if at is None else at.detach().reshape(flat.shape)
        component = self.parent if self.component is None else self.component
        for cost, past, views, some in self._shares(len(flat), x.device, apart=apart):
            of = (None if each is None else each[some] for each in (self.parent, component))
            states = flat[some], moved[some]
            part = evaluate(_Part(cost, past.body, past, views, *states, *of))
            if some.dim() > 1:
                part = {name: result.flatten(0, 1) for name, result in part.items()}
            found.append(part)
            order.append(some.flatten())
        names = dict.fromkeys(name for part in found for name in part)
        results = {name: _joined(name, found, order) for name in names}
        if len(self.past) > 1:
            places = torch.cat(order)
            results = {
                name: result.new_empty(len(flat), *result.shape[1:]).index_copy(0, places, result)
                for name, result in results.items()
            }
        shape = x.shape[:-1]
        return {n: result.reshape((*shape, *result.shape[1:])) for n, result in results.items()}

    def _shares(
        self, count: int, device: torch.device, *, apart: bool
    ) -> Iterator[tuple[TrackingCost, FrameContext, Sequence[FrameContext], Tensor]]:
        """Which of so many samples are evaluated at once, with which cost, past and views.

        Few samples of sequences that are alike are all evaluated at once: `[S b]`, those of some
        repeated. Others, or all if they are to be taken `apart`, are sequence by sequence and a
        chunk at a time: many samples hide the overhead of calls anyway.
        """
        if self.sequence is not None and len(self.past) > 1 and not apart:
            rows = rows_of(self.sequence, [past.sequence for past in self.past], self._chunk)
            merge = merged if self.merged is None else self.merged.of
            if rows is not None and (whole := merge(self)) is not None:
                yield whole, whole.past[0], whole.views, rows
                return
        any_yet = False
        for past in self.past:
            items = torch.arange(count, device=device)
            if self.sequence is not None:
                items = items[self.sequence == past.sequence]
            if not len(items) and (any_yet or count):
                continue
            any_yet = True
            views = [view for view in self.views if view.sequence == past.sequence]
            for some in items.split(self._chunk):
                yield self, past, views, some

    def _says(self, kind: Kind) -> bool:
        """Whether a view says something to a term of a kind."""
        return any(True for view in self.views for _ in self._bound(kind, view))

    def timed(self, name: str) -> AbstractContextManager[Any]:
        """Adds up the time that a term takes, if that is wanted."""
        return nullcontext() if self.stopwatch is None else self.stopwatch(name)

    def _bound(self, kind: Kind, context: FrameContext) -> Iterator[tuple[str, Any]]:
        """The terms of a kind that the frame says something to."""
        for term in self.choice.terms:
            if term.kind == kind and (bound := self.bound[term, context]) is not None:
                yield term.name, bound


class _Opaque(torch.autograd.Function):
    """A function of states that no transform looks into: it is constant for all of them."""

    @staticmethod
    def forward(evaluate: Callable[[Tensor], Any], x: States) -> Any:
        return evaluate(x)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.mark_non_differentiable(*((output,) if isinstance(output, Tensor) else output))

    @staticmethod
    def vmap(info: Any, in_dims: Any, *args: Any) -> Any:
        """Evaluate a batch as one."""
        (evaluate, x), (_, dim) = args, in_dims
        result = _Opaque.apply(evaluate, x.movedim(dim, 0))
        return result, 0 if isinstance(result, Tensor) else (0,) * len(result)


@dataclass(frozen=True, eq=False)
class _Part:
    """Some samples of one sequence, few enough to be evaluated at once.

    What is held is found at the states `x`; the samples have `moved` since.
    """

    cost: TrackingCost
    body: BodyModel
    past: FrameContext
    views: Sequence[FrameContext]
    x: Float[Tensor, "b n"]
    moved: Float[Tensor, "b n"]
    parent: Indices | None
    component: Indices | None

    def values(self) -> dict[str, Tensor]:
        """Cost of every prior and term."""
        pose, values = self._pose(), {}
        for name, weight, prior, posed in self._bound("prior", pose):
            with self.cost.timed(name):
                values[name] = weight * prior.value(posed)
        for name, scale, term, posed in self._terms(pose):
            with self.cost.timed(name):
                value = scale * term.value(posed).sum(-1)
            values[name] = values.get(name, 0.0) + value
        return values

    def value(self) -> Float[Tensor, " b"]:
        """Cost of the samples."""
        values = list(self.values().values())
        return torch.stack(values).sum(0) if values else self.x.new_zeros(self.x.shape[:-1])

    def gradients(self) -> dict[str, Tensor]:
        """Gradient of every prior and term."""
        cost, pose = self.cost, self._pose()
        bound = (self._bound(kind, pose) for kind in ("prior", "image"))
        names = dict.fromkeys(name for every in bound for name, *_ in every)
        alone = {
            name: replace(cost, choice=replace(cost.choice.only([name]), curvature=Curvature.EXACT))
            for name in names
        }
        return {name: replace(self, cost=c).local_model().gradient for name, c in alone.items()}

    def weights(self, body: BodyModel | None) -> dict[str, Tensor]:
        """Cost of every weight-only term."""
        if body is not None:
            return replace(self, body=body).weights(None)
        total: dict[str, Tensor] = {}
        for name, weight, term, posed in self._bound("weight-only", self.body.pose(self.x)):
            with self.cost.timed(name):
                value = weight * term.scale * term.value(posed)
            total[name] = total.get(name, 0.0) + value
        return total

    def local_model(self) -> LocalModel:
        """Sum, gradient and Hessian."""
        cost, x, curvature = self.cost, self.x, self.cost.choice.curvature
        if curvature is Curvature.AUTOGRAD:
            return self._by_autograd()
        pose, points, links, costs, axis = self._pose(), [], [], [], x.dim() - 1
        for name, scale, term, posed in self._terms(pose):
            with cost.timed(name):
                part = term.point_cost(posed, gauss_newton=curvature is Curvature.GAUSS_NEWTON)
                points.append(term.points(posed))
                links.append(term.link)
                costs.append([scale * field for field in part])
        size = x.shape[-1]
        total = LocalModel(
            x.new_zeros(x.shape[:-1]), torch.zeros_like(x), x.new_zeros(*x.shape, size)
        )
        if points:
            with cost.timed("lift"):
                every = PointCost(*(torch.cat(parts, axis) for parts in zip(*costs, strict=True)))
                where, link = torch.cat(points, axis), torch.cat(links)
                total = self.body.lift(pose, where, link, every, curvature=curvature)
        for name, weight, prior, posed in self._bound("prior", pose):
            with cost.timed(name):
                model = prior.local_model(posed, curvature)
                total = total.plus(model, weight)
        return total

    def _by_autograd(self) -> LocalModel:
        """The same by differentiating the cost as a function of x, with what was found held."""
        with torch.enable_grad():
            leaf = self.x.detach().requires_grad_()
            return differentiate_twice(replace(self, moved=leaf).held_value(), leaf)

    def held_value(self) -> Float[Tensor, " b"]:
        """Cost of the samples that have moved, with what was found before."""
        found = self._pose()
        pose = self.body.pose(self.moved)
        total = 0.0 * self.moved.sum(-1)
        for name, scale, term, posed in self._terms(found):
            link, points = term.link, term.points(posed)
            away = points - found.tree.translation[..., link, :]
            local = (found.tree.rotation[..., link, :, :] * away[..., :, None]).sum(-2)
            at = self.body.points_on_links(pose.tree, link, local)
            with self.cost.timed(name):
                total = total + scale * term.value(posed, at).sum(-1)
        for _, weight, prior, posed in self._bound("prior", pose):
            total = total + weight * prior.value(posed)
        return total

    def _pose(self) -> BodyPose:
        with self.cost.timed("pose"):
            return self.body.pose(self.x)

    def _terms(self, pose: BodyPose) -> Iterator[tuple[str, float, BoundImage, Posed]]:
        """The image terms of all views with their weights, what they need of the poses found."""
        for name, weight, term, posed in self._bound("image", pose):
            with self.cost.timed("visibility"):
                term.points(posed)
            yield name, weight * term.scale, term, posed

    def _bound(self, kind: Kind, pose: BodyPose) -> Iterator[tuple[str, float, Any, Posed]]:
        """The terms of a kind with their weights, and the poses before each camera."""
        prior = kind == "prior"
        for view in (self.past,) if prior else self.views:
            posed = Posed(view, self.body, pose, self.component if prior else self.parent)
            for name, bound in self.cost._bound(kind, view):
                yield name, self.cost.choice.weight(name), bound, posed


def _joined(name: str, parts: Sequence[Mapping[str, Tensor]], rows: Sequence[Indices]) -> Tensor:
    """A result of all parts; zero where a part does not have it."""
    like = next(part[name] for part in parts if name in part)
    none = (like.new_zeros(len(some), *like.shape[1:]) for some in rows)
    return torch.cat([part.get(name, zero) for part, zero in zip(parts, none, strict=True)])


def beside(costs: Iterable[TrackingCost]) -> TrackingCost:
    """The cost of a frame that several cameras see: the sum of what each sees, priors once.

    Args:
        costs: The cost of each camera's view, of the same body with the same choice of terms.
    """
    costs = list(costs)
    views = tuple(view for cost in costs for view in cost.views)
    bound = {key: term for cost in costs for key, term in cost.bound.items()}
    return replace(costs[0], views=views, bound=bound)


def together(
    costs: Sequence[TrackingCost], sequence: Indices, merged: Merged | None = None
) -> TrackingCost:
    """The cost of samples of several sequences, with bodies, cameras and pictures of their own.

    Args:
        costs: The cost of each sequence, numbered (`numbered`) in rising order, with the same
            choice of terms; of their samples, those of each keep their order.
        sequence: The number of the sequence that each sample belongs to.
        merged: See `TrackingCost.merged`.
    """
    parent, component = torch.zeros_like(sequence), torch.zeros_like(sequence)
    for cost in costs:
        if cost.parent is not None:
            own = sequence == cost.views[0].sequence
            parent[own] = cost.parent
            component[own] = cost.parent if cost.component is None else cost.component
    past = tuple(past for cost in costs for past in cost.past)
    known = {"parent": parent, "component": component, "sequence": sequence, "merged": merged}
    return replace(beside(costs), past=past, **known)


def numbered(cost: TrackingCost, number: int) -> TrackingCost:
    """The same cost as that of the sequence of a number.

    Args:
        cost: The cost of one sequence.
        number: Its number among those that are evaluated together.
    """
    contexts = {c: replace(c, sequence=number) for c in (*cost.views, *cost.past)}
    return replace(
        cost,
        views=tuple(contexts[view] for view in cost.views),
        past=tuple(contexts[past] for past in cost.past),
        bound={(term, contexts[context]): b for (term, context), b in cost.bound.items()},
    )

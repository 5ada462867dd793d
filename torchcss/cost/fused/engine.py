"""The fused engine: value, gradient and Hessian of a pool of states in three compiled calls.

It gives what `TrackingCost` gives by its terms as they are written (the eager engine): in double
precision to rounding, in single precision to 1e-2 nats (`scripts/benchmark_engines.py` measures
both). Terms with a compiled twin are packed once a frame; what the other terms say is added. Each
kernel stands in a file with the name of its twin.
"""

from __future__ import annotations

import math
import os
import warnings
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.cost.anthropometric import Anthropometric
from torchcss.cost.context import BodyTables, FrameContext
from torchcss.cost.contour import ContourTerm
from torchcss.cost.flow import FlowTerm
from torchcss.cost.fused import pack
from torchcss.cost.fused.held import add_held_view
from torchcss.cost.fused.pose_prior import add_pose_prior
from torchcss.cost.fused.priors import add_priors
from torchcss.cost.fused.records import Array, Curves, Limbs, Parts, Result, Tree, View
from torchcss.cost.fused.repulsion import add_repulsion
from torchcss.cost.fused.view import add_view
from torchcss.cost.interpenetration import Interpenetration, InterpenetrationPairs
from torchcss.cost.joints import JointTerm
from torchcss.cost.pose_prior import PosePrior, density_where
from torchcss.cost.region import RegionTerm
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.temporal import MixturePrior, TemporalPrior
from torchcss.cost.term import OnPoints
from torchcss.cost.visibility import ContourPredictor
from torchcss.kernels import compiler
from torchcss.kernels.versions import version_of
from torchcss.types import Curvature, LocalModel, Numbers, Vectors

if TYPE_CHECKING:
    from torchcss.cost.total import TrackingCost

_IMAGES: dict[type[Any], tuple[str, Callable[..., Any]]] = {
    ContourTerm: ("edges", pack.pack_edges),
    RegionTerm: ("colours", pack.pack_colours),
    FlowTerm: ("flow", pack.pack_flow),
    JointTerm: ("keypoints", pack.pack_keypoints),
}
"""Image terms that have a compiled twin: their field in `View`, and what packs them."""

_PRIORS = (Stabiliser, Anthropometric, TemporalPrior, MixturePrior)
_KEPT = 24
"""What is kept packed of a frame, with other terms and weights, or of a body, as long as these
live."""


class _Packs:
    """What has been packed of frames or bodies that are still there, the latest few of each."""

    def __init__(self) -> None:
        self._of: WeakKeyDictionary[Any, OrderedDict[Any, tuple[Any, Any]]] = WeakKeyDictionary()

    def made(self, owner: BodyTables, make: Callable[..., Any], *what: Any) -> Any:
        """What a function makes of some objects, made now if it is not known of a body."""
        return self.of(owner, (make, *what), partial(make, *what))

    def of(
        self, owner: FrameContext | BodyTables, what: tuple[object, ...], make: Callable[[], Any]
    ) -> Any:
        """What is packed of a frame or body and other objects, packed now if it is not known."""
        known = self._of.setdefault(owner, OrderedDict())
        # The objects are kept, so that no other one gets their numbers.
        key = tuple(map(id, what))
        if key not in known:
            known[key] = (what, make())
            if len(known) > _KEPT:
                known.popitem(last=False)
        return known[key][1]


class Workspaces:
    """Memory for the kernels, one for each thread that needs it at a time.

    Args:
        make: Makes one.
    """

    def __init__(self, make: Callable[[], Any]) -> None:
        self._make, self._idle = make, deque[Any]()

    def take(self) -> Any:
        """A workspace that nobody else has, to be given back."""
        try:
            return self._idle.pop()
        except IndexError:
            return self._make()

    def give_back(self, workspace: Any) -> None:
        """Let others have a workspace."""
        self._idle.append(workspace)


@dataclass(frozen=True)
class _Packed:
    """What a kernel is called with, besides states and results.

    Attributes:
        kernel: The kernel.
        held: The kernel for states with what is held; None: nothing is.
        modes: How many modes before samples are compared with; zero: with none.
        records: What it reads.
        workspaces: Memory for what it finds on the way.
        versions: The kernels for the types of all this, by what they are called with.
    """

    kernel: Callable[..., None]
    held: Callable[..., None] | None
    modes: int
    records: tuple[Any, ...]
    workspaces: Workspaces
    versions: dict[int, Callable[..., None]] = field(default_factory=dict)

    def add(self, states: Sequence[Array], mode: Array, result: Result) -> None:
        """Add the kernel's costs of some samples, each compared with a mode.

        Args:
            states: The samples, and, if that is held, where visibility and matches are found.
            mode: The mode of each.
            result: What the costs are added to.
        """
        kernel = self.kernel
        if len(states) > 1 and self.held is not None:
            kernel = self.held
        else:
            states = states[:1]
        rows = (_rows(mode, self.modes),) if self.modes else ()
        workspace = self.workspaces.take()
        arguments = *states, *rows, *self.records, workspace, result
        if len(states) not in self.versions:
            self.versions[len(states)] = version_of(kernel, *arguments)
        self.versions[len(states)](*arguments)
        self.workspaces.give_back(workspace)


class _Samples(NamedTuple):
    """What the kernels are to evaluate, sequence by sequence.

    Attributes:
        states: The samples, and maybe where visibility and matches are found.
        parent: The mode before that what the views saw is taken from, for each.
        component: The component of the prior that it is compared with.
        result: What the costs are added to.
    """

    states: Sequence[Array]
    parent: Array
    component: Array
    result: Result

    def take(self, rows: slice) -> _Samples:
        """Some of them, in the same memory."""
        states = [x[rows] for x in self.states]
        result = Result(*(each[rows] for each in self.result))
        return _Samples(states, self.parent[rows], self.component[rows], result)


class _Job(NamedTuple):
    """What is to be done for the samples of one sequence.

    Attributes:
        begin: The first of them.
        end: One beyond the last.
        priors: Kernels of priors.
        views: Kernels of views.
    """

    begin: int
    end: int
    priors: Sequence[_Packed]
    views: Sequence[_Packed]

    def add(self, samples: _Samples, begin: int, end: int) -> None:
        """Add the costs of those that are among some of all samples."""
        begin, end = max(self.begin, begin), min(self.end, end)
        if begin < end:
            some = samples.take(slice(begin, end))
            for packed in self.priors:
                packed.add(some.states, some.component, some.result)
            for packed in self.views:
                packed.add(some.states, some.parent, some.result)


_Found = tuple[list[_Packed], frozenset[str]]
"""What is packed, and the names of the terms that are not."""


@cache
def fused_engine(dtype: Literal["float32", "float64"], threads: int = 1) -> FusedEngine | None:
    """The engine of a precision; None, with a warning, where numba cannot be imported."""
    if compiler.AVAILABLE:
        return FusedEngine(dtype, threads)
    warnings.warn(
        "numba is not installed, so that costs are evaluated ten times more slowly; "
        "install it with: pip install numba",
        stacklevel=2,
    )
    return None


class FusedEngine:
    """Evaluates costs by compiled kernels; an `Engine` of `torchcss.cost.total`.

    Args:
        dtype: Precision of the kernels; sums, priors and results are in double precision.
        threads: Among how many threads states are shared out. Each state is evaluated by itself,
            so that results are the same for any number.
    """

    def __init__(self, dtype: Literal["float32", "float64"] = "float32", threads: int = 1) -> None:
        self._made_of = dtype, threads
        self.real: Any = np.float32 if dtype == "float32" else np.float64
        self._packs = _Packs()
        self._workspaces: dict[tuple[Any, ...], Workspaces] = {}
        self._threads = threads
        self._helpers: dict[int, ThreadPoolExecutor] = {}  # by process: a fork has no threads

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied and pickled as what made it: what it has packed stays in its process."""
        return fused_engine, self._made_of

    def value(self, cost: TrackingCost, x: Vectors) -> Numbers:
        """Cost in nats; see `TrackingCost.value`."""
        value, others = self._values(cost, x)
        return value if others is None else value + others.value(x)

    def held_value(self, cost: TrackingCost, x: Vectors, found_at: Vectors) -> Numbers:
        """Cost in nats with what is found at other states; see `TrackingCost.held_value`."""
        value, others = self._values(cost, x, found_at)
        return value if others is None else value + others.held_value(x, found_at)

    def local_model(self, cost: TrackingCost, x: Vectors) -> LocalModel:
        """Cost, gradient and Hessian; see `TrackingCost.local_model`."""
        with cost.timed("fused"):
            result, others = self._evaluate(cost, x, slopes=True)
        shapes = (x.shape[:-1], x.shape, (*x.shape, x.shape[-1]))
        model = LocalModel(
            *(torch.from_numpy(p.reshape(s)).to(x) for p, s in zip(result, shapes, strict=True))
        )
        if others is None:
            return model
        return model.plus(others.local_model(x))

    def _values(
        self, cost: TrackingCost, x: Vectors, *found_at: Vectors
    ) -> tuple[Numbers, TrackingCost | None]:
        """Values, and the cost of what is not in them; None: nothing."""
        with cost.timed("fused"):
            result, others = self._evaluate(cost, x, *found_at, slopes=False)
        return torch.from_numpy(result.value).to(x).reshape(x.shape[:-1]), others

    def _evaluate(
        self, cost: TrackingCost, *states: Tensor, slopes: bool
    ) -> tuple[Result, TrackingCost | None]:
        """What the kernels give, and the cost of what they leave out; None: nothing.

        Args:
            cost: The cost.
            states: The samples, and, if that is held, where visibility and matches are found.
            slopes: Whether to find derivatives.
        """
        each = [pack.array(x.reshape(-1, x.shape[-1])) for x in states]
        shape, (order, ends) = each[0].shape, _by_sequence(cost, each)
        parent = component = np.zeros(len(each[0]), np.int64)
        if cost.parent is not None:
            parent = component = pack.array(cost.parent, np.int64)
        if cost.component is not None:
            component = pack.array(cost.component, np.int64)
        if order is not None:
            each = [x[order] for x in each]
            parent, component = parent[order], component[order]
        result = _zeros(each[0].shape, slopes)
        jobs: list[_Job] = []
        left_out: set[str] = set()
        begin = 0
        for past, end in zip(cost.past, ends, strict=True):
            priors, others = self._prior(cost, past)
            left_out |= others
            views: list[_Packed] = []
            for view in cost.views:
                if view.sequence == past.sequence:
                    packed, others = self._view(cost, past, view)
                    views += packed
                    left_out |= others
            jobs.append(_Job(begin, end, priors, views))
            begin = end
        self._share_out(_Samples(each, parent, component, result), jobs)
        if order is not None:
            whole = _zeros(shape, slopes)
            for numbers, some in zip(whole, result, strict=True):
                numbers.fill(np.nan)
                numbers[order] = some
            result = whole
        if not left_out:
            return result, None
        return result, replace(cost, engine=None, choice=cost.choice.only(left_out))

    def _share_out(self, samples: _Samples, jobs: Sequence[_Job]) -> None:
        """Add what the kernels find for all sequences, shared out among the threads."""
        size = len(samples.states[0])
        share = max(1, math.ceil(size / self._threads))

        def add(begin: int) -> None:
            for job in jobs:
                job.add(samples, begin, begin + share)

        if share < size:
            process = os.getpid()
            if process not in self._helpers:
                self._helpers[process] = ThreadPoolExecutor(self._threads - 1)
            helpers = self._helpers[process]
            helped = [helpers.submit(add, begin) for begin in range(share, size, share)]
            add(0)
            for each in helped:
                each.result()
        else:
            add(0)

    def _prior(self, cost: TrackingCost, past: FrameContext) -> _Found:
        return self._packs.of(past, (cost.choice,), lambda: self._pack_prior(cost, past))

    def _pack_prior(self, cost: TrackingCost, past: FrameContext) -> _Found:
        priors, others, states, repulsion, limbs = [], set(), [], [], []
        for term in cost.choice.terms:
            if term.kind != "prior" or cost.bound[term, past] is None:
                continue
            weight = cost.choice.weight(term.name)
            if type(term) in _PRIORS:
                priors.append((term, weight))
            elif type(term) is Interpenetration:
                if weight * past.tables.of(InterpenetrationPairs).num_pairs:
                    repulsion.append(self._pack_repulsion(cost, term, weight, past))
            elif type(term) is PosePrior:
                limbs = self._pack_limbs(weight, past)
            else:
                others.add(term.name)
        if priors:
            records = pack.pack_priors(priors, past)
            workspaces = Workspaces(partial(pack.make_prior_scratch, records[-1]))
            states = [_Packed(add_priors, None, records[0].centre.shape[1], records, workspaces)]
        return [*states, *repulsion, *limbs], frozenset(others)

    def _pack_limbs(self, weight: float, past: FrameContext) -> list[_Packed]:
        density = past.tables.of(density_where(past.camera.up))
        if density is None:
            return []
        body, camera, tree = past.body, past.camera, self._tree(past.body, past)

        def make() -> tuple[Limbs, Workspaces]:
            limbs = pack.pack_limbs(body, density)
            scratch = partial(pack.make_limb_scratch, tree, limbs, body.num_parameters)
            return limbs, Workspaces(scratch)

        limbs, workspaces = self._packs.of(past.tables, (pack.pack_limbs, density), make)
        turned = limbs.fixed @ pack.array(camera.R_camera_world).T
        limbs = limbs._replace(scale=weight, fixed=turned)
        return [_Packed(add_pose_prior, None, 0, (tree, limbs), workspaces)]

    def _pack_repulsion(
        self, cost: TrackingCost, term: Interpenetration, weight: float, past: FrameContext
    ) -> _Packed:
        tree, parts, real = self._tree(past.body, past), self._parts(past), self.real
        pairs = past.tables.of(InterpenetrationPairs)
        repulsion = self._packs.made(past.tables, pack.pack_repulsion, term, pairs, real)
        interior, chain = repulsion.nodes.shape[2], repulsion.chain.shape[1]
        repulsion = repulsion._replace(scale=real(weight * term.weight / interior))
        curves = pack.pack_curves(None, parts, real)
        records = tree, parts, repulsion, _is_exact(cost)
        memory = self._memory(pack.make_pair_scratch, tree, curves, interior, chain, 5, 0)
        return _Packed(add_repulsion, None, 0, records, memory)

    def _tree(self, body: BodyModel, context: FrameContext) -> Tree:
        """A body before the camera of a frame, packed once."""
        return self._packs.made(context.tables, pack.pack_tree, body, context.camera)

    def _parts(self, past: FrameContext) -> Parts:
        """The parts of a body, packed once: their shape does not change."""
        return self._packs.made(past.tables, pack.pack_parts, past.tables.body, self.real)

    def _memory(
        self, make: Callable[..., Any], tree: Tree, curves: Curves, *sizes: int
    ) -> Workspaces:
        """Memory that all bodies of these sizes share, one after the other."""
        key = (make, len(tree.parent), *curves.table.shape, *curves[1:], *sizes)
        if key not in self._workspaces:
            self._workspaces[key] = Workspaces(partial(make, tree, curves, sizes, self.real))
        return self._workspaces[key]

    def _view(self, cost: TrackingCost, past: FrameContext, context: FrameContext) -> _Found:
        return self._packs.of(
            context, (cost.choice, past.body), lambda: self._pack_view(cost, past, context)
        )

    def _pack_view(self, cost: TrackingCost, past: FrameContext, context: FrameContext) -> _Found:
        body, real, camera = past.body, self.real, context.camera
        made: dict[str, Any] = {}
        others: set[str] = set()
        for term in cost.choice.terms:
            if term.kind != "image" or (bound := cost.bound[term, context]) is None:
                continue
            record, kind = None, type(term)
            if kind in _IMAGES and isinstance(bound, OnPoints) and bound.camera is None:
                make = partial(self._pack_image, term, bound, context)
                record = self._packs.of(context, (term, bound.image), make)
            if record is None:
                others.add(term.name)
            else:
                scale = cost.choice.weight(term.name) * bound.scale
                made[_IMAGES[kind][0]] = record._replace(scale=type(record.scale)(scale))
        if not made:
            return [], frozenset(others)
        predictor = None
        if "edges" in made or "colours" in made:
            predictor = context.tables.of(ContourPredictor)
        tree, parts = self._tree(body, context), self._parts(past)
        lens = pack.pack_lens(camera)
        records = {**self._packs.made(past.tables, pack.absent, parts, real), **made}
        _repeat_for_all_modes(records, "flow", "keypoints")
        edges, colours = records["edges"], records["colours"]
        nothing = edges.scale * edges.back_facing + colours.scale * colours.back_facing
        view = View(
            lens=pack.in_precision(lens, real),
            precise=lens,
            curves=self._packs.made(past.tables, pack.pack_curves, predictor, parts, real),
            nothing=float(nothing) * (0 if predictor is None else predictor.num_nodes),
            exact=_is_exact(cost),
            **records,
        )
        interior = view.flow.nodes.shape[2]
        keypoints = 64 * math.ceil(len(view.keypoints.row) / 64)  # for all of these one memory
        sizes = interior, 1, len(edges.steps), keypoints
        memory = self._memory(pack.make_workspace, tree, view.curves, *sizes)
        modes, packed = len(view.flow.target), (tree, parts, view)
        return [_Packed(add_view, add_held_view, modes, packed, memory)], frozenset(others)

    def _pack_image(self, term: Any, bound: OnPoints, context: FrameContext) -> Any:
        """The record of an image term, without its weight; None: its twin does not know it."""
        record = _IMAGES[type(term)][1](term, bound, context)
        return None if record is None else pack.in_precision(record, self.real)


def _by_sequence(cost: TrackingCost, states: Sequence[Array]) -> tuple[Array | None, list[int]]:
    """The order of samples sequence by sequence, and where each sequence ends in it.

    Samples that are not finite are left out of it. None: they are in that order.
    """
    sane = np.stack([np.isfinite(each).all(1) for each in states]).all(0)
    order = None if sane.all() else np.flatnonzero(sane)
    if cost.sequence is None:
        return order, [int(sane.sum())]
    numbers = cost.sequence.numpy()
    if order is not None or (numbers[1:] < numbers[:-1]).any():
        order = np.flatnonzero(sane)
        order = order[numbers[order].argsort(kind="stable")]
        numbers = numbers[order]
    return order, numbers.searchsorted([past.sequence for past in cost.past], "right").tolist()


def _zeros(shape: tuple[int, ...], slopes: bool) -> Result:
    """Numbers of states of a shape to be added to, with derivatives or without."""
    size, n = shape
    width = n if slopes else 0
    return Result(np.zeros(size), np.zeros((size, width)), np.zeros((size, width, width)))


def _is_exact(cost: TrackingCost) -> bool:
    """Whether the curvature of projection and kinematics counts."""
    return cost.choice.curvature is not Curvature.GAUSS_NEWTON


def _repeat_for_all_modes(records: dict[str, Any], *fields: str) -> None:
    """Give records the targets of as many modes each: what is the same for all is repeated."""
    modes = max(len(records[name].target) for name in fields)
    for name in fields:
        target = records[name].target
        if len(target) < modes:
            records[name] = records[name]._replace(target=np.repeat(target, modes, 0))


def _rows(parent: Array, modes: int) -> Array:
    """The mode that each sample is compared with, where there are several."""
    if modes == 1:
        return np.zeros_like(parent)
    # Without a sign a negative one is larger than any other.
    if len(parent) and not parent.view(np.uint64).max() < modes:
        raise IndexError(f"parent: expected modes 0 to {modes - 1}, got {parent.max()}")
    return parent

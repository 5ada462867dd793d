"""Covariance scaled sampling over a sequence of frames: Fig. 6 of [IJRR], line by line.

For every frame: spread the prior's modes by the proposal, descend from every sample, discard the
minima found twice, weigh the rest by their likelihood, keep the best K, and multiply in the weight
of the prior mode that each came from.

All weights are logarithms. Fig. 6 multiplies weights frame after frame; as plain numbers the lesser
modes reach zero within a few frames (a difference of 20 nats a frame takes 19 frames in float64)
and could never recover.

    tracker = Tracker(
        proposal=CovarianceScaled(covariance_scale=8), num_samples=100, num_modes=7
    )
    state = tracker.init(mixture, generator=generator)
    for cost in costs:
        state, info = tracker.step(state, SearchProblem(cost), bounds)

A frame is a `SearchProblem`: the cost, any `CostFunction`, and what else is known of the frame. The
state is a record of tensors: `step` is a pure function of it, so that a run that was saved and
restored continues exactly as one that was never interrupted.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import field, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchcss.errors import ConfigurationError, check_positive, check_range, check_shape
from torchcss.inference.dynamics import Diffusion, Dynamics
from torchcss.inference.importance import Survival, survival
from torchcss.inference.marginal import information_of_past
from torchcss.inference.mixture import (
    GaussianMixture,
    Past,
    Prior,
    cheapest_first,
    distinct_modes,
    match_to_prior,
    prior_at,
    representatives,
    separated,
)
from torchcss.inference.problem import SearchProblem
from torchcss.inference.proposals import Proposal, Samples
from torchcss.inference.trust_region import (
    TrustRegionNewton,
    TrustRegionState,
    check_bounds,
    default_prior_variance,
)
from torchcss.linalg import constrained_inverse, inverse_on_free
from torchcss.types import (
    Bounds,
    Items,
    LocalModel,
    Matrices,
    Modes,
    Numbers,
    Status,
    Vectors,
    frozen,
)

_ROUNDS = ((0, 6.0), (1, 2.0), (5, 1.0))
"""Rounds of successive halving: steps of descent, and how many samples are left then, in multiples
of `Tracker.survivors`."""

_CROWDED = 0.5
"""Share of `Tracker.separation` within which all but the best go on only if places are left. What
descends from 1000 samples ends in a few minima, the lowest of them again and again: without this,
60 survivors of an arm end in 3 to 5 of the lowest twenty minima, and with it 40 in 9 to 11."""


class Particles(NamedTuple):
    """A posterior as weighted states, for trackers that weigh instead of descend.

    Attributes:
        x: The states.
        velocity: How far each moved in the last frame.
        log_weight: Unnormalised.
        component: The mode of `TrackerState.mixture` that sums each up.
    """

    x: Float[Tensor, "s n"]
    velocity: Float[Tensor, "s n"]
    log_weight: Float[Tensor, " s"]
    component: Int[Tensor, " s"]


class TrackerState(NamedTuple):
    """What the next step needs, and nothing else.

    Attributes:
        mixture: Posterior of the last frame, the best mode first.
        velocity: How far each mode moved in the last frame, a usual interval (`per_interval`); zero
            for a new mode.
        generator_state: State of the random number generator.
        frame: Number of frames seen, a scalar.
        particles: What the mixture sums up, for particle filters; where the next frame's descents
            begin, for `GridTracker`. Both make new ones from the mixture where there are none; so
            whoever maps the mixture to other coordinates maps the particles too, or drops them.
    """

    mixture: GaussianMixture
    velocity: Float[Tensor, "k n"]
    generator_state: UInt8[Tensor, " bytes"]
    frame: Int[Tensor, ""]
    particles: Particles | None = None

    def per_interval(self, intervals: float) -> TrackerState:
        """The same after a frame that came so many intervals late: its velocities are of one."""
        if intervals == 1:
            return self
        particles = self.particles
        if particles is not None:
            particles = particles._replace(velocity=particles.velocity / intervals)
        return self._replace(velocity=self.velocity / intervals, particles=particles)


class TrackerInfo(NamedTuple):
    """What one step did.

    Attributes:
        cost: Cost of each mode kept, weight-only cost included and what the past makes likely left
            out (`SearchProblem.past`), nats; `inf` where a mode was carried over (no sample had a
            finite cost).
        parent: Mode before that is matched with each mode (Fig. 6 step 5), or next to it where
            matching is soft; that from which a move was made, where the jump is; -1 for none.
        origin: Component of the prior whose sample descended to each mode.
        status_counts: How many samples ended with each `Status`, by its number.
        num_steps: Optimiser iterations of every descent, those that were given up
            (`Tracker.survivors`) last.
        num_samples: Samples optimised, or weighed, a scalar.
        num_distinct: Distinct modes found before pruning, a scalar; 0 if modes were carried over.
        effective_sample_size: `1 / sum w^2` over the weights of the distinct modes, a scalar: how
            many modes share the posterior.
        num_floored: Ends of descents whose covariance needed `LEAST_CURVATURE`, see
            `constrained_inverse`, a scalar; 0 for trackers that cap all covariances. In the first
            frame of a track that starts from one fit's covariance it counts that too.
        survival: How evenly the samples' importance weights are spread: those back to the prior
            for samples that descend (section 8 [IJRR]), those of the posterior for particles.
        prior: The prior of the frame: the modes before, one frame ahead, and where moves led.
    """

    cost: Float[Tensor, " k"]
    parent: Int[Tensor, " k"]
    origin: Int[Tensor, " k"]
    status_counts: Int[Tensor, " status"]
    num_steps: Int[Tensor, " s"]
    num_samples: Int[Tensor, ""]
    num_distinct: Int[Tensor, ""]
    effective_sample_size: Float[Tensor, ""]
    num_floored: Int[Tensor, ""]
    survival: Survival
    prior: Prior


@frozen
class SequenceTracker(ABC):
    """Anything that follows a mixture through a sequence of frames.

    Attributes:
        num_samples: Samples per frame.
        num_modes: Modes kept.
    """

    num_samples: int
    num_modes: int

    def __post_init__(self) -> None:
        check_range(self, "num_samples", "num_modes", least=1)

    @property
    def stated_power(self) -> float:
        """Power of a frame's likelihood in the covariances that are stated, see `tempered`."""
        return 1.0

    def init(self, mixture: GaussianMixture, *, generator: torch.Generator) -> TrackerState:
        """Start from a mixture.

        Args:
            mixture: Prior of the first frame.
            generator: On the CPU, so that every device sees the same samples. Its state is copied.

        Raises:
            ConfigurationError: If the generator is on another device, or means or covariances are
                not finite.
            ShapeError: If the mixture's tensors do not agree.
        """
        if generator.device.type != "cpu":
            raise ConfigurationError(
                f"Tracker.init: expected a generator on the CPU, got one on {generator.device}; "
                "use torch.Generator()"
            )
        check_shape("mixture.mean", mixture.mean, None, None)
        k, n = mixture.mean.shape
        check_shape("mixture.covariance", mixture.covariance, k, n, n)
        check_shape("mixture.log_weight", mixture.log_weight, k)
        if not all(bool(part.isfinite().all()) for part in mixture[:2]):
            raise ConfigurationError("mixture: expected finite means and covariances")
        return TrackerState(
            mixture=mixture.prune(k),
            velocity=torch.zeros_like(mixture.mean),
            generator_state=generator.get_state(),
            frame=torch.zeros((), dtype=torch.long),
        )

    def over(self, intervals: float) -> SequenceTracker:
        """The tracker of a frame that comes so many intervals after the one before it."""
        return self

    @abstractmethod
    def step(
        self, state: TrackerState, problem: SearchProblem, bounds: Bounds
    ) -> tuple[TrackerState, TrackerInfo]:
        """Process one frame.

        Args:
            state: Where the last frame left off.
            problem: The frame.
            bounds: Box limits on the state.

        Returns:
            The next state, and what was done.
        """


def _unperturbed(samples: Samples, prior: Prior, bounds: Bounds) -> Bool[Tensor, " s"]:
    """The samples that are a component's centre, and were not drawn at random."""
    centre = bounds.project(prior.mixture.mean)[samples.parent]
    return (samples.x == centre).all(-1) & (samples.log_weight == -torch.inf)


class _Search(NamedTuple):
    """Samples on their way down.

    Attributes:
        problem: The problem of these samples.
        samples: Where they came from.
        descents: Where they have got to.
        is_mode: Which of them are centres of the prior's components, unperturbed.
        given_up: Steps of those that were given up.
    """

    problem: SearchProblem
    samples: Samples
    descents: TrustRegionState
    is_mode: Bool[Tensor, " s"]
    given_up: Int[Tensor, " r"]

    def take(self, items: Items) -> _Search:
        """Go on with some of the samples."""
        others = torch.ones_like(self.is_mode).index_fill(0, items, False)
        return _Search(
            self.problem.take(items),
            self.samples.take(items),
            self.descents.take(items),
            self.is_mode[items],
            torch.cat([self.given_up, self.descents.num_steps[others]]),
        )


class _Minima(NamedTuple):
    """Ends of descents.

    Attributes:
        problem: The problem of these samples.
        modes: The ends.
        model: Cost and derivatives there.
        origin: Component of the prior that each came from.
    """

    problem: SearchProblem
    modes: Modes
    model: LocalModel
    origin: Items

    def take(self, items: Items) -> _Minima:
        """Some of them."""
        model = LocalModel(*(part[items] for part in self.model))
        return _Minima(self.problem.take(items), self.modes.take(items), model, self.origin[items])


class _Kept(NamedTuple):
    """The posterior of a frame, the best mode first; see `TrackerInfo`."""

    mixture: GaussianMixture
    velocity: Float[Tensor, "k n"]
    cost: Float[Tensor, " k"]
    parent: Int[Tensor, " k"]
    origin: Int[Tensor, " k"]
    effective_sample_size: Float[Tensor, ""]


@frozen
class Tracker(SequenceTracker):
    """The multiple-mode tracker of section 4.2 [IJRR].

    Attributes:
        proposal: Where the samples go.
        num_samples: Samples per frame, the modes themselves included.
        num_modes: Modes kept, `K`; the papers use 3 for an arm and 7 for a body.
        optimiser: How samples descend.
        dynamics: What happens between frames; the papers' driftless diffusion by default.
        likelihood_power: Power of a frame's likelihood in the weights, step 3, and in the
            covariances that are stated. One is Fig. 6, which takes frames as independent evidence.
            They are not: what a body model lacks, clutter and occlusion cost the same modes in
            frame after frame. With a sharp likelihood the first frames then decide for good.
        coarse_every: If the problem has a coarse cost, every so many samples descend on that first,
            so that what moved farther than the cost's own basin reaches is found again; 0 for
            never. As many of them as there are modes begin at the modes: one that is seldom sampled
            would else be left behind by a fast limb.
        oversampling: How many times as many samples are drawn as descend: above one, the best
            `num_samples` are kept, by the problem's screening cost. Section 4.2 [RR] scores sampled
            hypotheses by their edges alone.
        survivors: Of more samples than these, successive halving keeps so many: those whose first
            step promises most take it, twice as many go on to the fifth step, and so many to the
            end, since a sample that starts far up seldom overtakes. Of those within half the
            `separation` of each other the best goes first. Zero: all descend to the end, as in
            Fig. 6.
        soft_matching: In step 5, multiply in the prior's weight at the place of each mode, see
            `prior_at`, instead of that of the closest prior mode, which Fig. 6 gives to one mode
            only: a mode far from all of the prior may then be handed the best past there is, and
            the pose that had it goes on with another's. Step 4 then keeps the mode that weighs most
            after step 5, however many are cheaper in this frame, if there is a `separation`.
        surprise: What it costs a mode then to be where no motion leads, nats, see `prior_at`.
        separation: Modes of which no landmark is this far apart are one explanation, of which one
            alone is kept as long as there are others. Zero: the K best modes are kept however
            alike they are, as in Fig. 6. Clutter makes many minima within a hand's breadth, which
            crowd out all that differ. In the unit of the problem's landmarks; problems without
            them are not concerned.
        keep_alike: Whether places that `separation` leaves go to modes alike; False: fewer than K
            are kept.
        converged_only: Keep nothing that stopped at the optimiser's step limit.
        capped: Whether no covariance is wider than the prior (`inverse_on_free`); False: they are
            as printed (`constrained_inverse`), and what a bound holds is not sampled.
    """

    proposal: Proposal
    optimiser: TrustRegionNewton = field(default_factory=TrustRegionNewton)
    dynamics: Dynamics = field(default_factory=Diffusion)
    likelihood_power: float = 1.0
    coarse_every: int = 3
    oversampling: int = 1
    survivors: int = 0
    soft_matching: bool = False
    surprise: float = math.inf
    separation: float = 0.0
    keep_alike: bool = True
    converged_only: bool = False
    capped: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, "surprise")
        check_range(self, "oversampling", least=1)
        check_range(self, "coarse_every", "survivors", "separation")
        check_positive(self, "likelihood_power", finite=True)

    @property
    def stated_power(self) -> float:
        """The power that the weights have."""
        return self.likelihood_power

    def over(self, intervals: float) -> Tracker:
        """See `SequenceTracker.over`."""
        dynamics, proposal = self.dynamics.over(intervals), self.proposal.over(intervals)
        return replace(self, dynamics=dynamics, proposal=proposal)

    def step(
        self, state: TrackerState, problem: SearchProblem, bounds: Bounds
    ) -> tuple[TrackerState, TrackerInfo]:
        """Process one frame.

        Args:
            state: Where the last frame left off.
            problem: The frame.
            bounds: Box limits on the state.

        Returns:
            The next state and what was done. If no sample has a finite cost, the best of the prior
            are carried over, inside the bounds.
        """
        check_bounds(bounds, state.mixture.mean.shape[-1])
        generator = torch.Generator()
        generator.set_state(state.generator_state)

        # 1: the prior, one frame ahead; the proposal inflates it.
        ahead = self.dynamics.predict(state.mixture, state.velocity)

        # 2.1, 2.2: choose components and sample them, inside the bounds.
        drawn = self.num_samples * self.oversampling
        samples = self.proposal.sample(ahead, drawn, bounds, generator=generator)
        prior = Prior.of(ahead).joined(samples.jumps)
        spread = survival(samples.log_weight)
        samples = self._screen(problem, samples, prior, bounds)
        samples, problem = self._descend_coarsely(problem, samples, prior, bounds)
        started = len(samples.x)

        # 2.3: descend from every sample, and discard minima found before.
        search = _Search(
            problem,
            samples,
            self.optimiser.start(samples.x),
            _unperturbed(samples, prior, bounds),
            samples.parent[:0],
        )
        search = self._halve(search, bounds)
        modes, found, floored = self._minima(search, bounds)
        if len(found.origin):
            # 3: weights by the likelihood at the modes. 4 to 6: the best K, with their pasts.
            kept = self._posterior(state, prior, found, bounds)
        else:
            kept = self._carry_over(state, ahead, bounds)

        info = TrackerInfo(
            cost=kept.cost,
            parent=kept.parent,
            origin=kept.origin,
            status_counts=torch.bincount(modes.status, minlength=len(Status)),
            num_steps=torch.cat([modes.num_steps, search.given_up]),
            num_samples=torch.tensor(started, device="cpu"),
            num_distinct=torch.tensor(len(found.origin), device="cpu"),
            effective_sample_size=kept.effective_sample_size,
            num_floored=floored,
            survival=spread,
            prior=prior,
        )
        frame = state.frame + 1
        return TrackerState(kept.mixture, kept.velocity, generator.get_state(), frame), info

    def _screen(
        self, problem: SearchProblem, samples: Samples, prior: Prior, bounds: Bounds
    ) -> Samples:
        """Of more samples than are wanted, keep the best by the screening cost."""
        if self.oversampling == 1:
            return samples
        problem = problem.children(samples.parent, prior)
        score = (problem.screening or problem.cost).value(samples.x).nan_to_num(torch.inf)
        score[_unperturbed(samples, prior, bounds)] = -torch.inf
        return samples.take(score.argsort(stable=True)[: self.num_samples].sort().values)

    def _descend_coarsely(
        self, problem: SearchProblem, samples: Samples, prior: Prior, bounds: Bounds
    ) -> tuple[Samples, SearchProblem]:
        """Let every so many samples descend on the coarse cost, if there is one; their problem."""
        if not self.coarse_every or problem.coarse is None:
            return samples, problem.children(samples.parent, prior)
        samples, some = self._modes_among(samples, prior, bounds)
        problem = problem.children(samples.parent, prior)
        assert problem.coarse is not None
        rough = self.optimiser.ends(problem.coarse.take(some), samples.x[some], bounds)
        return samples._replace(x=samples.x.index_copy(0, some, rough)), problem

    def _modes_among(self, samples: Samples, prior: Prior, bounds: Bounds) -> tuple[Samples, Items]:
        """Choose the samples that descend on the coarse cost, every mode's own copy among them.

        They are taken from those that were drawn, so that the modes descend as they are, too; where
        none was drawn, from the modes.
        """
        drawn = ~_unperturbed(samples, prior, bounds)
        if not bool(drawn.any()):
            return samples, torch.nonzero(~drawn)[:: self.coarse_every, 0]
        some = torch.nonzero(drawn)[:: self.coarse_every, 0]
        centres = prior.mixture.mean
        own = torch.arange(min(len(some), len(centres)), device=some.device)
        first = some[: len(own)]
        return samples._replace(
            x=samples.x.index_copy(0, first, centres[own]),
            parent=samples.parent.index_copy(0, first, own),
            log_weight=samples.log_weight.index_fill(0, first, -torch.inf),
        ), some

    def _halve(self, search: _Search, bounds: Bounds) -> _Search:
        """Successive halving: give up what falls behind in descending, round by round."""
        if not self.survivors or len(search.samples.x) <= self.survivors:
            return search
        optimiser = self.optimiser
        descents, _ = optimiser.step(search.problem.cost, search.descents, bounds)
        search = search._replace(descents=descents)
        for max_steps, multiple in _ROUNDS:
            size = round(multiple * self.survivors)
            if len(search.samples.x) <= size:
                continue
            if max_steps:
                short = replace(optimiser, max_steps=min(max_steps, optimiser.max_steps))
                descents = short.descend(search.problem.cost, search.descents, bounds)
                search = search._replace(descents=descents)
                ends = descents
            else:
                ends = optimiser.promised(search.descents, bounds)
            search = search.take(self._promising(search, ends, bounds, size))
        return search

    def _promising(
        self, search: _Search, ends: TrustRegionState, bounds: Bounds, size: int
    ) -> Items:
        """Which samples go on, in their order; the modes of the last frame are never given up."""
        energy, is_mode = finite_cost(ends.status, ends.model.value), search.is_mode
        lowest = energy.nan_to_num(posinf=0.0).amin()
        energy = torch.where(is_mode, lowest - 1, energy)
        order = cheapest_first(energy)
        if self.separation and search.problem.landmarks is not None:
            points = search.problem.landmarks(ends.x[order])
            order = order[separated(points, _CROWDED * self.separation, size)]
        # Samples in one minimum count as one, or the best would take all places.
        modes = self.optimiser.modes(ends.take(order), bounds)
        distinct = distinct_modes(modes.mean, modes.covariance, energy[order], most=size)
        own, best = is_mode.nonzero()[:, 0], order[distinct]
        best = torch.cat([own, best[~is_mode[best]]])
        return best[: max(size, len(own))].sort().values

    def _minima(self, search: _Search, bounds: Bounds) -> tuple[Modes, _Minima, Int[Tensor, ""]]:
        """Descend to the end: all ends, the distinct ones by ascending cost, and `num_floored`."""
        descents = self.optimiser.descend(search.problem.cost, search.descents, bounds)
        modes = self.optimiser.modes(descents, bounds)
        floored = modes.status.new_zeros(())
        if not self.capped:
            modes, floored = as_printed(modes, descents, bounds)
        energy = finite_cost(modes.status, modes.cost, converged_only=self.converged_only)
        distinct = distinct_modes(modes.mean, modes.covariance, energy)
        every = _Minima(search.problem, modes, descents.model, search.samples.parent)
        return modes, every.take(distinct), floored

    def _posterior(
        self, state: TrackerState, prior: Prior, found: _Minima, bounds: Bounds
    ) -> _Kept:
        """Steps 3 to 6: weigh the distinct modes, keep the best, and multiply in their pasts."""
        problem, modes, cost = found.problem, found.modes, found.modes.cost
        if problem.weight_only is not None:
            cost = cost + problem.weight_only(modes.mean)
        told = torch.zeros_like(cost) if problem.past is None else problem.past.value(modes.mean)
        log_weight = -self.likelihood_power * cost
        unpruned = GaussianMixture(modes.mean, modes.covariance, log_weight).normalise()
        before, past = prior.mixture.normalise(), None
        # It takes the place of what the cost says of the past, which else would count twice.
        if self.soft_matching:
            past = prior_at(unpruned, before, self.surprise)
            past = past._replace(log_weight=past.log_weight + self.likelihood_power * told)
        kept = self._explanations(problem, unpruned, -cost, past)
        pruned = unpruned.take(kept).normalise()
        if past is None:
            past = match_to_prior(pruned, before)
            past = past._replace(log_weight=past.log_weight + self.likelihood_power * told[kept])
        else:
            past = Past(*(part[kept] for part in past))
        wide = self._marginal(state.mixture, prior, found, kept, past.parent, bounds)
        pruned = pruned._replace(covariance=wide)
        mixture = pruned._replace(log_weight=pruned.log_weight + past.log_weight).normalise()
        best_first = mixture.best_first
        mixture, match, kept = mixture.take(best_first), past.parent[best_first], kept[best_first]
        moved = mixture.mean - _start(state.mixture, prior)[match.clamp(min=0)]
        velocity = torch.where((match >= 0)[:, None], moved, 0.0)
        parent = torch.where(match >= 0, prior.parent[match.clamp(min=0)], -1)
        effective = (-(2 * unpruned.log_weight).logsumexp(0)).exp()
        return _Kept(mixture, velocity, (cost - told)[kept], parent, found.origin[kept], effective)

    def _marginal(
        self,
        before: GaussianMixture,
        prior: Prior,
        found: _Minima,
        kept: Items,
        parent: Items,
        bounds: Bounds,
    ) -> Matrices:
        """Covariances of modes with what was not known a frame ago (`torchcss.inference.marginal`).

        Those without a parent stay as they are: they say nothing of the modes before.
        """
        modes, model, problem = found.modes.take(kept), found.model, found.problem
        if problem.past is None or problem.motion is None:
            return modes.covariance
        motion, past = (
            part.take(kept).local_model(modes.mean).hessian
            for part in (problem.motion, problem.past)
        )
        own = parent.clamp(min=0)
        known, ahead = before.covariance[prior.parent[own]], prior.mixture.covariance[own]
        variance = default_prior_variance(bounds)
        told = information_of_past(motion, known, ahead - known, variance)
        hessian = model.hessian[kept] - motion - past + told
        wide = inverse_on_free(hessian, modes.active == 0, variance, model.gradient[kept])
        return torch.where((parent >= 0)[:, None, None], wide, modes.covariance)

    def _explanations(
        self,
        problem: SearchProblem,
        modes: GaussianMixture,
        log_likelihood: Float[Tensor, " m"],
        past: Past | None,
    ) -> Items:
        """Choose the modes that are kept.

        First the one that will weigh most after step 5: one frame does not decide what it is worth,
        since clutter may well be the cheaper fit K times, or a hand's breadth away. Then the
        cheapest. Of modes alike, which are one explanation, the cheapest is kept, but for what
        their pasts say: of poses that hardly differ in cost, that of the better past.
        """
        order = modes.best_first
        if not self.separation or problem.landmarks is None:
            return order[: self.num_modes]
        if past is not None:
            heaviest = (modes.log_weight + past.log_weight).argmax()
            order = torch.cat([heaviest[None], order[order != heaviest]])
        points = problem.landmarks(modes.mean[order])
        chosen = separated(points, self.separation, self.num_modes, fill=self.keep_alike)
        if past is None:
            return order[chosen]
        score = (log_likelihood + self.likelihood_power * past.log_weight)[order]
        score[0] = torch.inf
        return order[representatives(points, self.separation, chosen, score)]

    def _carry_over(self, state: TrackerState, prior: GaussianMixture, bounds: Bounds) -> _Kept:
        """The best of the prior, in a frame in which nothing has a finite cost."""
        best = prior.best_first[: self.num_modes]
        mixture = prior.take(best).normalise()
        mixture = mixture._replace(mean=bounds.project(mixture.mean))
        # What they move now they go on with, so that they come to rest.
        velocity = mixture.mean - state.mixture.mean[best]
        cost = torch.full_like(mixture.log_weight, torch.inf)
        return _Kept(mixture, velocity, cost, best, best, torch.zeros_like(prior.log_weight[0]))


def _start(modes: GaussianMixture, prior: Prior) -> Vectors:
    """Where each component of a prior was a frame ago: what a move put elsewhere was there."""
    expected = prior.mixture.mean[prior.parent]
    return torch.where(prior.mixture.mean == expected, modes.mean[prior.parent], prior.mixture.mean)


def finite_cost(
    status: Int[Tensor, " k"], cost: Numbers, *, converged_only: bool = False
) -> Numbers:
    """Costs by which ends of descents are told apart.

    Args:
        status: How the descents ended; those that are not finite cost infinitely much.
        cost: The cost there.
        converged_only: Whether those that stopped at the step limit do so too.
    """
    out = status == Status.NON_FINITE
    if converged_only:
        out = out | (status == Status.STEP_LIMIT)
    return torch.where(out, torch.inf, cost)


def as_printed(
    modes: Modes, descents: TrustRegionState, bounds: Bounds
) -> tuple[Modes, Int[Tensor, ""]]:
    """Modes with the covariances of `constrained_inverse`, and how many of these were floored.

    Args:
        modes: Ends of descents.
        descents: The descents, with the Hessians there.
        bounds: Box limits on the state.
    """
    free = modes.active == 0
    prior_variance = default_prior_variance(bounds)
    covariance, floored = constrained_inverse(descents.model.hessian, free, prior_variance)
    finite = modes.status != Status.NON_FINITE
    return modes._replace(covariance=covariance), (floored & finite).sum()

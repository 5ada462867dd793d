"""Particle filters: the baselines that weigh samples instead of descending from them.

`ParticleFilter` is CONDENSATION (Isard and Blake 1998; sections 1.1 and 4.2 [IJRR]): resample the
particles, move them by the dynamics and its noise, weigh them by the likelihood,

    w_i = exp(-f(x_i)),    x_i ~ N(g(x_a), Q),    a ~ w of the last frame.

With `dilution` and `noise_scale` it is what section 9 [IJRR] proposes for future work: sample from
the posterior raised to a power below one, which for particles means diluted weights, and from
inflated noise, and weigh the results back. Each particle's weight gains the factor

    (w_a / w_a^dilution) N(x_i; g(x_a), Q) / N(x_i; g(x_a), noise_scale Q),

so that what is represented remains the true posterior.

`AnnealedParticleFilter` (Deutscher, Blake and Reid 2000; section 1.2 [IJRR]) weighs, resamples and
diffuses several times per frame, with weights sharpened and noise reduced from layer to layer, so
that the particles drift into minima. After the first layer it searches; its particles no longer
represent a posterior.

Both have the interface of `Tracker`, and evaluate `cost.value` only. The mixture in their state
sums the particles up: the heaviest particle gathers those around it, the heaviest of the rest does,
until `num_modes` clusters are made; the rest join the nearest. Centres found so are not modes
(footnote 11 [IJRR]).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import field, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.errors import ConfigurationError, check_range
from torchcss.inference.dynamics import Diffusion, Dynamics
from torchcss.inference.importance import (
    normalised_log_weight,
    resample,
    survival,
    tempered_log_weight,
)
from torchcss.inference.mixture import GaussianMixture, Prior, standard_normal
from torchcss.inference.problem import SearchProblem
from torchcss.inference.proposals import CovarianceScaled
from torchcss.inference.tracker import (
    Particles,
    SequenceTracker,
    TrackerInfo,
    TrackerState,
)
from torchcss.inference.trust_region import check_bounds
from torchcss.linalg import covariance_factor, multiply, squared_mahalanobis
from torchcss.types import Bounds, Items, Numbers, Status, Vectors, frozen

Energy = Callable[[Vectors, Items], Numbers]
"""Cost of states whose ancestors these modes sum up; infinite where it is not finite."""


class _Weighed(NamedTuple):
    """Particles of one frame.

    Attributes:
        x: Where they are.
        log_weight: Unnormalised; `-inf` where the cost is not finite.
        ancestor: Which particle of the last frame each descends from.
        num_weighed: How many evaluations of the cost it took.
    """

    x: Float[Tensor, "s n"]
    log_weight: Float[Tensor, " s"]
    ancestor: Int[Tensor, " s"]
    num_weighed: int


@frozen
class _Filter(SequenceTracker):
    """What the particle filters share.

    Attributes:
        num_samples: Particles.
        num_modes: Most components of the mixture that sums them up.
        dynamics: How particles move between frames; its noise is all the search that there is.
    """

    dynamics: Dynamics = field(default_factory=Diffusion)

    def over(self, intervals: float) -> SequenceTracker:
        """See `SequenceTracker.over`."""
        return replace(self, dynamics=self.dynamics.over(intervals))

    @abstractmethod
    def _weigh(
        self,
        particles: Particles,
        moved: GaussianMixture,
        energy: Energy,
        bounds: Bounds,
        generator: torch.Generator,
    ) -> _Weighed:
        """Draw this frame's particles from the moved ones of the last, and weigh them."""

    def step(
        self, state: TrackerState, problem: SearchProblem, bounds: Bounds
    ) -> tuple[TrackerState, TrackerInfo]:
        """Process one frame.

        Args:
            state: Where the last frame left off.
            problem: The frame. A particle's parent is the mode that sums up its ancestor.
            bounds: Box limits on the state.

        Returns:
            The next state and what was done. If no particle has a finite cost, they count as
            equal.
        """
        mixture = state.mixture
        check_bounds(bounds, mixture.mean.shape[-1])
        generator = torch.Generator()
        generator.set_state(state.generator_state)
        particles = state.particles or self._drawn(state, bounds, generator)
        points = torch.zeros_like(mixture.covariance[:1]).expand(len(particles.x), -1, -1)
        moved = self.dynamics.predict(
            GaussianMixture(particles.x, points, particles.log_weight), particles.velocity
        )
        prior = Prior.of(self.dynamics.predict(mixture, state.velocity))

        def energy(x: Tensor, component: Tensor) -> Tensor:
            value = problem.children(component, prior).cost.value(x).detach()
            return torch.where(value.isfinite(), value, torch.inf)

        weighed = self._weigh(particles, moved, energy, bounds, generator)
        some = bool((weighed.log_weight > -torch.inf).any())
        log_weight = normalised_log_weight(weighed.log_weight)
        parent = particles.component[weighed.ancestor]
        component, summary, best = self._sum_up(weighed.x, log_weight, moved.covariance[0])
        # Every mode's parent is that of its heaviest particle.
        origin = parent[best]
        status_counts = torch.zeros(len(Status), dtype=torch.long, device=weighed.x.device)
        status_counts[Status.NON_FINITE] = (~(weighed.log_weight > -torch.inf)).sum()
        state = TrackerState(
            summary,
            summary.mean - mixture.mean[origin],
            generator.get_state(),
            state.frame + 1,
            Particles(weighed.x, weighed.x - particles.x[weighed.ancestor], log_weight, component),
        )
        return state, TrackerInfo(
            cost=energy(summary.mean, origin),
            parent=origin,
            origin=origin,
            status_counts=status_counts,
            num_steps=torch.zeros_like(weighed.ancestor),
            num_samples=torch.tensor(weighed.num_weighed),
            num_distinct=torch.tensor(len(summary.mean) if some else 0),
            effective_sample_size=survival(summary.log_weight).effective_sample_size,
            num_floored=torch.tensor(0),
            survival=survival(weighed.log_weight),
            prior=prior,
        )

    def _drawn(self, state: TrackerState, bounds: Bounds, generator: torch.Generator) -> Particles:
        """Particles of a mixture."""
        fair = CovarianceScaled(covariance_scale=1.0, include_modes=False, stratified=True)
        drawn = fair.sample(state.mixture, self.num_samples, bounds, generator=generator)
        velocity = state.velocity[drawn.parent]
        return Particles(drawn.x, velocity, drawn.log_weight, drawn.parent)

    def _sum_up(
        self,
        x: Float[Tensor, "s n"],
        log_weight: Float[Tensor, " s"],
        noise: Float[Tensor, "n n"],
    ) -> tuple[Items, GaussianMixture, Items]:
        """Gather particles into components: whose each is, the mixture, each one's heaviest."""
        # The typical distance of two draws of the dynamics' noise, squared and in its metric.
        reach = 2 * x.shape[-1]
        left = log_weight.argsort(descending=True, stable=True)
        leaders, distances = [], []
        while len(leaders) < self.num_modes and len(left):
            leader, left = left[0], left[1:]
            distances.append(squared_mahalanobis(x - x[leader], noise))
            leaders.append(leader)
            left = left[distances[-1][left] > reach]
        component = torch.stack(distances).argmin(0)
        fields = []
        for index in range(len(leaders)):
            own = component == index
            weight = log_weight[own]
            total = weight.logsumexp(0)
            members = GaussianMixture(x[own], x.new_zeros(1).expand(len(weight), 1, 1), weight)
            fields.append((*members.moments(), total))
        summary = GaussianMixture(*(torch.stack(part) for part in zip(*fields, strict=True)))
        order = summary.best_first
        return (
            order.argsort()[component],
            summary.take(order).normalise(),
            torch.stack(leaders)[order],
        )


@frozen
class ParticleFilter(_Filter):
    """CONDENSATION; with dilution or inflated noise, that of section 9 [IJRR].

    Attributes:
        num_samples: Particles.
        num_modes: As in the module's page.
        dynamics: How particles move between frames; its noise is all the search that there is.
        dilution: Power of the weights by which particles are resampled, from 0 (all alike) to 1
            (CONDENSATION).
        noise_scale: Factor on the noise's covariance when drawing, at least 1.
    """

    dilution: float = 1.0
    noise_scale: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "dilution", most=1)
        check_range(
            self, "noise_scale", least=1,
            hint="; narrower noise than the dynamics' cannot be weighed back",
        )  # fmt: skip

    def _weigh(
        self,
        particles: Particles,
        moved: GaussianMixture,
        energy: Energy,
        bounds: Bounds,
        generator: torch.Generator,
    ) -> _Weighed:
        log_weight = torch.where(
            particles.log_weight > -torch.inf, self.dilution * particles.log_weight, -torch.inf
        )
        ancestor = resample(log_weight, self.num_samples, generator=generator)
        noise = standard_normal(moved.mean[ancestor].shape, moved.mean, generator=generator)
        factor = covariance_factor(moved.covariance)[ancestor]
        # Directions without dynamical noise have no share in the weights.
        noise = torch.where(factor.any(-2), noise, 0.0)
        step = multiply(factor, noise)
        x = bounds.project(moved.mean[ancestor] + self.noise_scale**0.5 * step)
        cost = energy(x, particles.component[ancestor])
        correction = (1 - self.dilution) * particles.log_weight[ancestor]
        # The ratio of the two Gaussians where it was drawn, up to a constant.
        correction = correction - 0.5 * (self.noise_scale - 1) * noise.square().sum(-1)
        return _Weighed(x, correction - cost, ancestor, num_weighed=len(x))


@frozen
class AnnealedParticleFilter(_Filter):
    """The annealed particle filter of Deutscher, Blake and Reid.

    In every layer the weights are raised to the power that lets a given share of the particles
    survive, which sharpens them as the particles close in; then the particles are resampled, and
    diffused by noise whose covariance shrinks by the same share from layer to layer.

    Attributes:
        num_samples: Particles; each is weighed once per layer.
        num_modes: As in the module's page.
        dynamics: How particles move between frames; its noise is that of the first layer.
        num_layers: Layers per frame.
        survival_rate: Share of the particles that survives a layer, by effective sample size.
    """

    num_layers: int = 10
    survival_rate: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "num_layers", least=1)
        if not 0 < self.survival_rate < 1:
            raise ConfigurationError(
                "AnnealedParticleFilter.survival_rate: expected more than 0 and less than 1, "
                f"got {self.survival_rate}"
            )

    def _weigh(
        self,
        particles: Particles,
        moved: GaussianMixture,
        energy: Energy,
        bounds: Bounds,
        generator: torch.Generator,
    ) -> _Weighed:
        factor = covariance_factor(moved.covariance)
        ancestor = resample(particles.log_weight, self.num_samples, generator=generator)
        x, spread, log_weight = moved.mean[ancestor], 1.0, torch.zeros_like(moved.log_weight)
        for layer in range(self.num_layers):
            if layer:
                chosen = resample(log_weight, self.num_samples, generator=generator)
                x, ancestor = x[chosen], ancestor[chosen]
                spread = spread * self.survival_rate**0.5
            noise = standard_normal(x.shape, x, generator=generator)
            x = bounds.project(x + spread * multiply(factor[ancestor], noise))
            cost = energy(x, particles.component[ancestor])
            log_weight, _ = tempered_log_weight(-cost, self.survival_rate)
        return _Weighed(x, log_weight, ancestor, num_weighed=self.num_layers * len(x))

"""Smooth a track after the fact: one trajectory that explains all frames, with its covariances.

A track holds, for every frame, the modes that the frame and those before it leave possible.
`smooth_modes` weighs them with all frames in view (`inference.smoothing.mode_weights`), by the
power that the tracker weighed them with, takes the most probable mode of each frame as what it
says, and moves the states together to where that and the motion prior agree, within the joint
limits (`inference.smoothing.refine`). It needs nothing but the modes.
With a lag no frame is told by more than so many after it, as one that waits for them would see it.

The motion prior is the body's `motion_rate` for velocities, and `Smoothing.acceleration_ratio`
times that for accelerations. A frame in which the tracker had nothing to go by (its modes were kept
from the frame before, their cost is infinite) says nothing; its state follows from its neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES, free_turns, has_root, move_base
from torchcss.errors import TrackFileError, check_positive, check_range
from torchcss.inference.smoothing import (
    GaussianEvidence,
    Refined,
    Refinement,
    Transition,
    mode_weights,
    refine,
    whole_periods,
)
from torchcss.types import Times, Trajectory, Vector, frozen

_SAME_BASE = 1e-9

_PERSISTENCE = 20.0
"""How many frames say as much as one, of a frame that said nothing itself."""


@frozen
class Smoothing:
    """How to smooth.

    Attributes:
        likelihood_power: Power of what frames and motions say when modes are weighed; None: that of
            the likelihood in the track.
        acceleration_ratio: Expected accelerations over expected velocities, 1/s; lower is smoother.
            For the modes of a tracker 10 is good, for images 20.
        persistence: How many frames say as much, in the covariances, as one that is independent;
            None: what is wrong in a frame is wrong in all, so that each keeps the covariance of its
            mode. Smoothing averages the noise of single frames, but not what persists: the person's
            size, their clothes.
        lag: How many frames after each may say something of it; None: all.
    """

    likelihood_power: float | None = None
    acceleration_ratio: float = 10.0
    persistence: float | None = None
    lag: int | None = None

    def __post_init__(self) -> None:
        check_range(self, "lag", hint=" frames")
        check_positive(self, "likelihood_power", "acceleration_ratio", "persistence", finite=True)

    @property
    def frames_as_one(self) -> float:
        """So many frames count as one, at least in those that have no mode of their own."""
        return self.persistence or _PERSISTENCE


class TrackedModes(NamedTuple):
    """The modes of all frames of a track, as float64 tensors.

    Attributes:
        frames: Index of each frame in the video.
        times: Seconds, rising.
        bases: World from the frame in which the root moves.
        state: Means of the modes.
        covariance: Their covariances, in which the likelihood counts with `likelihood_power`.
        log_weight: Logarithm of the weights, `-inf` where there is no mode.
        cost: Nats; infinite for all modes of a frame that said nothing.
        likelihood_power: As above.
    """

    frames: Int[Tensor, " t"]
    times: Times
    bases: Float[Tensor, "t 4 4"]
    state: Float[Tensor, "t k n"]
    covariance: Float[Tensor, "t k n n"]
    log_weight: Float[Tensor, "t k"]
    cost: Float[Tensor, "t k"]
    likelihood_power: float

    def between(self, first: int, stop: int) -> TrackedModes:
        """Some of the frames."""
        fields = (field[first:stop] for field in self[:-1])
        return TrackedModes(*fields, likelihood_power=self.likelihood_power)


class Smoothed(NamedTuple):
    """One trajectory through the modes of a track.

    Attributes:
        refined: Its states and covariances.
        cost: Of each frame, nats.
        modes: Which of the modes of each frame it came from.
        seen: Which frames said anything.
    """

    refined: Refined
    cost: Float[Tensor, " t"]
    modes: Int[Tensor, " t"]
    seen: Bool[Tensor, " t"]

    def at(self, frame: int) -> Smoothed:
        """What was found for one frame."""
        own = (field[frame] if field.ndim else field for field in self.refined)
        return Smoothed(Refined(*own), self.cost[frame], self.modes[frame], self.seen[frame])


def smooth_modes(body: BodyModel, track: TrackedModes, choice: Smoothing) -> Smoothed:
    """Smooth a track.

    Args:
        body: Its body, on the origin.
        track: Its modes, several per frame or one.
        choice: How to smooth.

    Raises:
        TrackFileError: If the track is empty, its times do not rise, or a covariance is none.
    """
    if not len(track.times):
        raise TrackFileError("the track has no frames, of which any could be smoothed")
    if not (track.times.diff() > 0).all():
        raise TrackFileError("the times of the track do not rise; it cannot be smoothed")
    try:
        if choice.lag is None:
            return _all_in_view(body, track, choice)
        return _with_lag(body, track, choice, choice.lag)
    except torch.linalg.LinAlgError as error:  # pyright: ignore[reportPrivateImportUsage]
        raise TrackFileError("a covariance of the track is none; it cannot be smoothed") from error


def _with_lag(body: BodyModel, track: TrackedModes, choice: Smoothing, lag: int) -> Smoothed:
    """Every frame as it is smoothed with `lag` frames after it, and with as many before as matter.

    What is more than twice the lag and a second before hardly moves it.
    """
    whole, parts = len(track.times), []
    for frame in range(whole):
        recent = int(torch.searchsorted(track.times, track.times[frame] - 1.0))
        first = max(0, min(recent, frame - 2 * lag))
        window = track.between(first, min(whole, frame + lag + 1))
        done = _all_in_view(body, window, choice)
        parts.append(done.at(frame - first))
    refined, cost, modes, seen = zip(*parts, strict=True)
    fields = Refined(*(torch.stack(field) for field in zip(*refined, strict=True)))
    changes = base_changes(body, track.bases)
    refined = fields._replace(
        mean=_unwrapped(fields.mean, changes, _periods(body)),
        total=fields.total.sum(),
        status=fields.status.max(),
        num_steps=fields.num_steps.sum(),
    )
    return Smoothed(refined, torch.stack(cost), torch.stack(modes), torch.stack(seen))


def _all_in_view(body: BodyModel, track: TrackedModes, choice: Smoothing) -> Smoothed:
    """Every frame with all before and after it in view."""
    absent = track.log_weight == -math.inf
    cost = track.cost.masked_fill(absent, math.inf)
    seen = cost.isfinite().any(1)
    # Where a frame said nothing, its modes are the prior of the tracker; only those exist.
    node = torch.where(seen[:, None], cost, torch.where(absent, math.inf, 0.0))
    changes, period = base_changes(body, track.bases), _periods(body)
    weights = mode_weights(
        track.state,
        # The power counts for the energy as a whole: in it the modes are as narrow as full costs.
        track.likelihood_power * track.covariance,
        node,
        track.times,
        Transition(velocity=tuple(body.motion_rate.tolist())),
        power=choice.likelihood_power or track.likelihood_power,
        changes=changes,
        period=period,
    )
    mode, everywhere = weights.argmax(1), torch.arange(len(track.times))
    chosen = _unwrapped(track.state[everywhere, mode], changes, period)
    refined = refine(
        GaussianEvidence.of_modes(chosen, track.covariance[everywhere, mode], seen=seen),
        chosen,
        track.times,
        motion_prior(body, choice),
        free_turns(body),
        choice=Refinement(likelihood_power=1 / (choice.frames_as_one * track.likelihood_power)),
        changes=changes,
    )
    if choice.persistence is None:
        own = track.covariance[everywhere, mode]
        refined = refined._replace(
            covariance=torch.where(seen[:, None, None], own, refined.covariance)
        )
    # The modes' covariances have the track's power, their costs are full nats.
    cost = cost[everywhere, mode] + refined.cost / track.likelihood_power
    return Smoothed(refined, cost, mode, seen)


def motion_prior(body: BodyModel, choice: Smoothing) -> Transition:
    """How a body is expected to move when its states are refined.

    Evidence counts by a power, for the covariances; so that this leaves the balance of evidence
    and motion as it is, the motion counts by it, too.
    """
    rate = body.motion_rate * choice.frames_as_one**0.5
    return Transition(
        velocity=tuple(rate.tolist()),
        acceleration=tuple((choice.acceleration_ratio * rate).tolist()),
    )


def base_changes(
    body: BodyModel, bases: Float[Tensor, "t 4 4"]
) -> dict[int, Callable[[Tensor], Tensor]]:
    """Where the base of a track moves: the map of states from each such frame's to the next one's.

    Args:
        body: The body, on any base.
        bases: Base transforms of the frames.
    """
    moved = (bases.diff(dim=0).abs().amax((1, 2)) > _SAME_BASE).nonzero()[:, 0].tolist()
    if moved and not has_root(body):
        raise TrackFileError("the base of the track moves, but its body has no root parameters")

    def change(step: int) -> Callable[[Tensor], Tensor]:
        placed = body.with_base(bases[step, :3, :3], bases[step, :3, 3])
        turn, shift = bases[step + 1, :3, :3], bases[step + 1, :3, 3]
        return lambda x: move_base(placed, turn, shift, x)[1]

    return {step: change(step) for step in moved}


def _periods(body: BodyModel) -> Vector:
    """After how much each parameter comes round; infinite but for joints without limits."""
    endless = body.comes_round & body.lower.isinf() & body.upper.isinf()
    period = torch.where(endless, 2 * math.pi, math.inf).double()
    if has_root(body):
        period[body.state_columns(ROOT_NAMES[3:])] = 2 * math.pi
    return period


def _unwrapped(
    state: Trajectory, changes: dict[int, Callable[[Tensor], Tensor]], period: Vector
) -> Trajectory:
    """The same states with every angle within half a turn of the one before."""
    out = [state[0]]
    for step, own in enumerate(state[1:]):
        before = changes[step](out[-1]) if step in changes else out[-1]
        out.append(own + whole_periods(before - own, period))
    return torch.stack(out)

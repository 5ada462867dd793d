"""Smooth a track after the fact: one trajectory that explains all frames, with its covariances.

A track holds, for every frame, the modes that the frame and those before it leave possible.
`smooth_track` chooses among them with all frames in view (`inference.smoothing.best_path`), takes
each chosen mode as what its frame says, and moves the states together to where that and the motion
prior agree, within the joint limits (`inference.smoothing.refine`). It needs nothing but the track.

The motion prior is the body's `motion_rate` for velocities, and `Smoothing.acceleration_ratio`
times that for accelerations. A frame in which the tracker had nothing to go by (its modes were kept
from the frame before, their cost is infinite) says nothing; its state follows from its neighbours.

The result is a `Track` of one mode per frame, which everything that reads tracks can read; the
alternatives stay in the track that it came from. `torchcss.smooth` does it for a run on disk.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.bases import pose_track
from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES, free_turns, has_root, move_base
from torchcss.errors import ConfigurationError, TrackFileError
from torchcss.inference.smoothing import (
    GaussianEvidence,
    Refined,
    Refinement,
    Transition,
    best_path,
    refine,
)
from torchcss.io.run import body_of_track
from torchcss.io.tracks import (
    Track,
)

_SAME_BASE = 1e-9


@dataclass(frozen=True, kw_only=True)
class Smoothing:
    """How to smooth.

    Attributes:
        likelihood_power: Power of each frame's likelihood when modes of several frames are weighed
            against the motion between them; below 1 because errors of images persist over frames.
        acceleration_ratio: Expected accelerations over expected velocities, 1/s; lower is smoother.
            For the modes of a tracker 10 is good, for images 20.
        persistence: How many frames say as much, in the covariances, as one that is independent.
            Smoothing averages the noise of single frames, but not what persists: the person's size,
            their clothes.
    """

    likelihood_power: float = 0.2
    acceleration_ratio: float = 10.0
    persistence: float = 40.0

    def __post_init__(self) -> None:
        for name in ("likelihood_power", "acceleration_ratio", "persistence"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigurationError(
                    f"{name}: expected a positive number, got {getattr(self, name)}"
                )


class SmoothedTrack(NamedTuple):
    """A smoothed track.

    Attributes:
        track: One mode per frame.
        modes: Which of the modes of the track it came from each frame's was.
        effect: What it changed, for people; numbers and lists.
    """

    track: Track
    modes: Int[np.ndarray, " t"]
    effect: dict[str, Any]


def smooth_track(track: Track, *, choice: Smoothing | None = None) -> SmoothedTrack:
    """Smooth a track.

    Args:
        track: The track, with several modes per frame or one.
        choice: How to smooth.

    Raises:
        TrackFileError: If the track is empty, its times do not rise, or it does not say which body
            it is of.
    """
    choice, began = choice or Smoothing(), time.perf_counter()
    if not len(track.frames):
        raise TrackFileError("the track has no frames, of which any could be smoothed")
    if not (np.diff(track.times) > 0).all():
        raise TrackFileError("the times of the track do not rise; it cannot be smoothed")
    body = body_of_track(track)
    bases = torch.from_numpy(track.base_transform)
    times = torch.from_numpy(track.times)
    state, covariance = torch.from_numpy(track.state), torch.from_numpy(track.covariance)
    cost = torch.from_numpy(np.where(track.log_weight > -np.inf, track.cost, np.inf))
    seen = cost.isfinite().any(1)
    # Where a frame said nothing, its modes are the prior of the tracker; only those exist.
    absent = torch.from_numpy(track.log_weight == -np.inf)
    node = torch.where(seen[:, None], cost, torch.where(absent, math.inf, 0.0))
    changes = base_changes(body, bases)
    period = _periods(body)
    path = best_path(
        state,
        # Between frames the modes count as they are; `choice.likelihood_power` tempers their costs.
        track.likelihood_power * covariance,
        node,
        times,
        Transition(velocity=tuple(body.motion_rate.tolist())),
        evidence=choice.likelihood_power,
        changes=changes,
        period=period,
    )
    everywhere = torch.arange(len(times))
    chosen = _unwrapped(state[everywhere, path.mode], changes, period)
    smooth = refine(
        GaussianEvidence.of_modes(chosen, covariance[everywhere, path.mode], seen=seen),
        chosen,
        times,
        motion_prior(body, choice),
        free_turns(body),
        choice=Refinement(likelihood_power=1 / (choice.persistence * track.likelihood_power)),
        changes=changes,
    )
    # The modes' covariances have the track's power, their costs are full nats.
    cost = cost[everywhere, path.mode] + smooth.cost / track.likelihood_power
    result = track_of(track, body, smooth, cost=cost)
    result = result._replace(likelihood_power=1 / choice.persistence)
    modes = path.mode.numpy()
    effect = {
        **asdict(choice),
        "evidence_of": "modes",
        "seconds": time.perf_counter() - began,
        **effect_of(track, modes, result),
        "frames_without_evidence": track.frames[~seen.numpy()],
        "states_at_a_limit": int(smooth.active.sum()),
    }
    return SmoothedTrack(result, modes, effect)


def motion_prior(body: BodyModel, choice: Smoothing) -> Transition:
    """How a body is expected to move when its states are refined.

    Evidence counts by a power, for the covariances; so that this leaves the balance of evidence
    and motion as it is, the motion counts by it, too.
    """
    rate = body.motion_rate * choice.persistence**0.5
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


def jitter(joints: Float[np.ndarray, "t j 3"], times: Float[np.ndarray, " t"]) -> float:
    """Mean acceleration of the joints, m/s^2; NaN for fewer than three frames."""
    if len(times) < 3:
        return math.nan
    step = np.diff(times)[:, None, None]
    velocity = np.diff(joints, axis=0) / step
    change = np.diff(velocity, axis=0) / (0.5 * (step[1:] + step[:-1]))
    return float(np.linalg.norm(change, axis=-1).mean())


def track_of(track: Track, body: BodyModel, smooth: Refined, *, cost: Float[Tensor, " t"]) -> Track:
    """The refined states as a track of one mode per frame.

    Args:
        track: The track that they come from.
        body: Its body, on the origin.
        smooth: The states.
        cost: Their costs, nats.
    """
    joints = pose_track(body, smooth.mean, torch.from_numpy(track.base_transform)).joints
    parent = np.zeros((len(track.frames), 1), dtype=np.int64)
    parent[:1] = -1
    return track._replace(
        state=smooth.mean[:, None].numpy(),
        covariance=smooth.covariance[:, None].numpy(),
        log_weight=np.zeros((len(track.frames), 1)),
        cost=cost[:, None].numpy(),
        parent=parent,
        joints_world=joints[:, None].numpy(),
    )


def effect_of(track: Track, modes: Int[np.ndarray, " t"], smooth: Track) -> dict[str, Any]:
    """What smoothing changed.

    Args:
        track: The track that was smoothed.
        modes: The path through its modes.
        smooth: What came out.
    """
    everywhere = np.arange(len(modes))
    parent = track.parent[everywhere, modes]
    switched = (parent[1:] != modes[:-1]) & (parent[1:] >= 0)
    best, path, after = (
        track.joints_world[:, 0],
        track.joints_world[everywhere, modes],
        smooth.joints_world[:, 0],
    )
    return {
        "frames_not_the_trackers_best": int((modes != 0).sum()),
        "path_switches": int(switched.sum()),
        "mean_change_mm": 1000 * float(np.linalg.norm(after - best, axis=-1).mean()),
        "greatest_change_mm": 1000 * float(np.linalg.norm(after - best, axis=-1).max()),
        "jitter_before_m_per_s2": jitter(best, track.times),
        "jitter_of_the_path_m_per_s2": jitter(path, track.times),
        "jitter_after_m_per_s2": jitter(after, track.times),
    }


def _periods(body: BodyModel) -> Float[Tensor, " n"]:
    """After how much each parameter comes round; infinite but for the angles of the root."""
    period = torch.full((body.num_parameters,), math.inf, dtype=torch.float64)
    if has_root(body):
        period[[body.state_index(name) for name in ROOT_NAMES[3:]]] = 2 * math.pi
    return period


def _unwrapped(
    state: Float[Tensor, "t n"],
    changes: dict[int, Callable[[Tensor], Tensor]],
    period: Float[Tensor, " n"],
) -> Float[Tensor, "t n"]:
    """The same states with every angle within half a turn of the one before."""
    turns = period.isfinite()
    whole, out = torch.where(turns, period, 1.0), [state[0]]
    for step, own in enumerate(state[1:]):
        before = changes[step](out[-1]) if step in changes else out[-1]
        out.append(own + torch.where(turns, whole * ((before - own) / whole).round(), 0.0))
    return torch.stack(out)

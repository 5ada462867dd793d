"""A session's state as named tensors, and back: what a checkpoint file holds.

Names are paths through the records: `tracker.mixture.mean`, `views.0.appearance.inside`. What is
None is left out. The body's tensors are among them, so that a resumed session poses bit for bit the
same body, wherever its lengths and shape came from.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.cost.frame import Learnt
from torchcss.errors import TrackFileError
from torchcss.inference.loss_monitor import MonitorState
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.tracker import Particles, TrackerState
from torchcss.tracking.session import SessionState
from torchcss.tracking.view import ViewObservation
from torchcss.vision.appearance import Appearance
from torchcss.vision.background import Background
from torchcss.vision.features import Window
from torchcss.vision.spline import SplineField

Record = TypeVar("Record")


def state_tensors(state: SessionState) -> dict[str, Tensor]:
    """A session's state as tensors by name, on the CPU.

    Args:
        state: What `TrackingSession.checkpoint` returned.
    """
    tensors: dict[str, Tensor] = {}
    _put(tensors, "tracker", state.tracker)
    tensors |= {f"body.{name}": value for name, value in state.body.state_dict().items()}
    for index, (seen, memory) in enumerate(zip(state.seen, state.memory, strict=True)):
        if seen.picture is not None:
            tensors[f"views.{index}.picture"] = torch.from_numpy(np.ascontiguousarray(seen.picture))
        _put(tensors, f"views.{index}.contrast", seen.contrast)
        _put(tensors, f"views.{index}.appearance", memory.appearance)
        _put(tensors, f"views.{index}.background", memory.background)
    tensors["num_views"] = torch.tensor(len(state.seen))
    for index, windows in enumerate(state.windows):
        for number, window in enumerate(windows):
            if window is not None:
                tensors[f"windows.{index}.{number}"] = torch.tensor(window)
    tensors["times"] = torch.tensor(state.times, dtype=torch.float64)
    history, excess, total, score = state.monitor
    for name, costs in history.items():
        tensors[f"monitor.history.{name}"] = torch.tensor(costs, dtype=torch.float64)
    tensors["monitor.excess"] = torch.tensor(excess, dtype=torch.float64)
    tensors["monitor.sums"] = torch.tensor([total, score], dtype=torch.float64)
    return {name: tensor.detach().cpu() for name, tensor in tensors.items()}


def state_from_tensors(tensors: Mapping[str, Tensor], body: BodyModel) -> SessionState:
    """The state that `state_tensors` took apart.

    Args:
        tensors: The tensors by name.
        body: The body that was tracked, in the session's type and on its device; its numbers are
            replaced by the state's.

    Raises:
        TrackFileError: If tensors are missing, or are those of another body.
    """
    like = body.tie
    try:
        body = copy.deepcopy(body)
        own = {name: value.to(like.device) for name, value in _under(tensors, "body").items()}
        body.load_state_dict(own, assign=True)
        mixture = _get(GaussianMixture, tensors, "tracker.mixture", like)
        assert mixture is not None
        tracker = TrackerState(
            mixture=mixture,
            velocity=tensors["tracker.velocity"].to(like.device),
            generator_state=tensors["tracker.generator_state"],
            frame=tensors["tracker.frame"],
            particles=_get(Particles, tensors, "tracker.particles", like),
        )
        seen, memory = [], []
        for index in range(int(tensors["num_views"])):
            at = f"views.{index}"
            picture = tensors.get(f"{at}.picture")
            seen.append(
                ViewObservation(
                    frame=None,
                    picture=None if picture is None else picture.numpy(),
                    contrast=_get(SplineField, tensors, f"{at}.contrast", like),
                )
            )
            appearance = _get(Appearance, tensors, f"{at}.appearance", like)
            memory.append(Learnt(appearance, _get(Background, tensors, f"{at}.background", like)))
        return SessionState(
            tracker=tracker,
            body=body,
            seen=tuple(seen),
            memory=tuple(memory),
            monitor=_monitor(tensors),
            windows=tuple(
                tuple(_window(tensors, index, number) for number in range(len(seen)))
                for index in range(2)
            ),
            times=tuple(tensors.get("times", torch.empty(0)).tolist()),
        )
    except (KeyError, RuntimeError, TypeError, AssertionError) as error:
        raise TrackFileError(
            f"the checkpoint does not fit the run: {error}; track again without --resume"
        ) from error


def _put(tensors: dict[str, Tensor], at: str, record: NamedTuple | None) -> None:
    """Add the tensors of a record, and of records in it."""
    for name, value in {} if record is None else record._asdict().items():
        if isinstance(value, Tensor):
            tensors[f"{at}.{name}"] = value
        else:
            _put(tensors, f"{at}.{name}", value)


def _get(kind: type[Record], tensors: Mapping[str, Tensor], at: str, like: Tensor) -> Record | None:
    """A record of tensors alone; None if none of them is there."""
    found = {name: value.to(like.device) for name, value in _under(tensors, at).items()}
    return kind(**found) if found else None


def _under(tensors: Mapping[str, Tensor], at: str) -> dict[str, Tensor]:
    """The tensors of a record by the names in it."""
    paths = (name.removeprefix(f"{at}.") for name in tensors if name.startswith(f"{at}."))
    return {name: tensors[f"{at}.{name}"] for name in paths}


def _window(tensors: Mapping[str, Tensor], index: int, number: int) -> Window | None:
    corners = tensors.get(f"windows.{index}.{number}")
    return None if corners is None else Window(*corners.tolist())


def _monitor(tensors: Mapping[str, Tensor]) -> MonitorState:
    history = _under(tensors, "monitor.history")
    return MonitorState(
        {name: tuple(costs.tolist()) for name, costs in history.items()},
        tuple(tensors["monitor.excess"].tolist()),
        *tensors["monitor.sums"].tolist(),
    )

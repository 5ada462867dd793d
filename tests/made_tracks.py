"""Tracks of random modes of any body, as the tracker would have written them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from reference.kinematics import rotation

from torchcss.body.model import BodyModel
from torchcss.errors import TrackFileError
from torchcss.files import load_arrays
from torchcss.io.export import Exported, ExportOptions, export
from torchcss.io.export.bvh import BvhStyle
from torchcss.io.export.selection import SelectionChoice
from torchcss.io.run import Run
from torchcss.io.tracks import FrameModes, Track, TrackWriter, save_track

BEAM_UP = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
"""Turns Y up into Z up: world (x, y, z) = body (z, x, y)."""


def writer_of(body: BodyModel, path: Path | str = "unused") -> TrackWriter:
    return TrackWriter(path, Track.empty(body.state_names, body.joint_names, body=body))


def modes_at(
    body: BodyModel, frame: int, state: torch.Tensor, covariance: torch.Tensor,
    *, rate: float = 25.0, **changes: Any,
) -> FrameModes:  # fmt: skip
    """Modes of a frame at states `[k n]` of a body on its base; alike unless changed."""
    k, n = state.shape
    alike = {"log_weight": torch.zeros(k), "cost": torch.zeros(k), "parent": torch.full((k,), -1)}
    return FrameModes(
        frame=frame, time_s=frame / rate, state=state, covariance=covariance.expand(k, n, n),
        joints_world=body.pose(state).joints, base_transform=body.base_transform.double(),
        **{**alike, **changes},
    )  # fmt: skip


def make_track(
    body: BodyModel,
    counts: Sequence[int] = (2, 3, 2),
    *,
    first_frame: int = 0,
    rate: float = 60.0,
    spread: float = 0.6,
    up: torch.Tensor | None = None,
) -> Track:
    """Random poses within the joint limits, standing about upright; the base moves in frame 2."""
    source = torch.Generator().manual_seed(0)
    up = torch.eye(3, dtype=torch.float64) if up is None else up
    writer, n = writer_of(body), body.num_parameters
    lower = body.lower.clamp(min=-spread)
    upper = body.upper.clamp(max=spread)
    for index, k in enumerate(counts):
        # Two bases, as when the pitch of the root has come near a right angle.
        lean = (-0.1, -0.3, -0.2) if index < 2 else (-0.2, 0.5, 0.4)
        turn = up @ rotation(*lean)
        shift = torch.tensor([0.3, -1.2, 0.9 + 0.1 * index], dtype=torch.float64)
        placed = body.with_base(turn, shift)
        share = torch.rand(k, n, generator=source, dtype=torch.float64)
        state = lower + share * (upper - lower)
        factor = 0.02 * torch.randn(k, n, n, generator=source, dtype=torch.float64) / math.sqrt(n)
        above = torch.arange(k).flip(0) % counts[index - 1] if index else torch.full((k,), -1)
        writer.append(
            modes_at(
                placed, first_frame + index, state, factor @ factor.mT, rate=rate, parent=above,
                log_weight=torch.linspace(1.0, 0.5, k).softmax(0).log(),
                cost=torch.linspace(1.0, 2.0, k),
            )
        )  # fmt: skip
    return writer.track()


def save_v01_track(path: Path, track: Track) -> None:
    """Save a track as version 0.1 did, which wrote neither body nor cameras nor settings."""
    save_track(path, track)
    arrays = dict(load_arrays(path, TrackFileError))
    for name in ("body", "cameras", "settings"):
        del arrays[name]
    np.savez(path, **(arrays | {"schema_version": np.array(1)}))


def export_as(
    run: Run | Track | Path, to: str, out: Path | None = None, *, frame: Any = None, **options: Any
) -> Exported:
    """Export with the options of all choices side by side."""
    bvh = {name: options.pop(name) for name in list(options) if hasattr(BvhStyle, name)}
    choice = ExportOptions(selection=SelectionChoice(**options), frame=frame, bvh=BvhStyle(**bvh))
    return export(run, out, to=to, options=choice)

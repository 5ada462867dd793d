"""Known optical flow: Middlebury `.flo` files, and where a flow jumps.

Little endian throughout: float32 202021.25 (its four bytes spell PIEH), int32 width, int32 height,
then row by row the float32 pairs (u to the right, v down) in pixels. A component beyond 1e9 in
size marks a pixel whose flow is not known.

By default: `read_flow(path)`, then `flow_discontinuities` of what was read; and `write_flow`.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from torchcss.errors import FlowFileError, check_shape
from torchcss.files import read_bytes
from torchcss.robust import Charbonnier, Leclerc, Lorentzian, Quadratic
from torchcss.vision.flow import FlowConfiguration

_MAGIC = b"PIEH"
_HEADER_BYTES = 12
_UNKNOWN_BEYOND = 1.0e9
UNKNOWN = 1.666666752e9
"""What Middlebury writes where a flow is not known."""


class FlowFile(NamedTuple):
    """What a `.flo` file holds.

    Attributes:
        flow: Displacement in pixels (u to the right, v down), float32; zero where unknown.
        known: Where the flow is known.
    """

    flow: Float[Tensor, "2 h w"]
    known: Bool[Tensor, "h w"]


def read_flow(path: str | os.PathLike[str]) -> FlowFile:
    """Read a `.flo` file.

    Raises:
        FlowFileError: If the file is missing, is no flow file, or is not as long as it says.
    """
    path = Path(path)
    content = read_bytes(path, FlowFileError)
    if len(content) < _HEADER_BYTES or content[:4] != _MAGIC:
        raise FlowFileError(
            f"{path}: expected a .flo file, which starts with the bytes PIEH and a size, "
            f"got {len(content)} bytes starting with {content[:4]!r}"
        )
    width, height = (int(side) for side in np.frombuffer(content, "<i4", count=2, offset=4))
    expected = _HEADER_BYTES + 8 * width * height
    if width < 1 or height < 1 or len(content) != expected:
        raise FlowFileError(
            f"{path}: a flow of {width} x {height} pixels needs {max(expected, 0)} bytes, "
            f"got {len(content)}; the file is truncated or damaged"
        )
    values = np.frombuffer(content, "<f4", offset=_HEADER_BYTES).reshape(height, width, 2)
    flow = torch.from_numpy(values.astype(np.float32)).movedim(-1, 0).contiguous()
    known = (flow.abs() <= _UNKNOWN_BEYOND).all(dim=0)  # false for NaN
    return FlowFile(torch.where(known, flow, 0.0), known)


def write_flow(
    path: Path, flow: Float[Tensor, "2 h w"], known: Bool[Tensor, "h w"] | None = None
) -> None:
    """Write a `.flo` file; what is not known, or not finite, as such."""
    usable = flow.isfinite().all(0) if known is None else known & flow.isfinite().all(0)
    values = torch.where(usable, flow.float(), UNKNOWN).movedim(0, -1).contiguous().numpy()
    header = b"PIEH" + np.array(flow.shape[:0:-1], "<i4").tobytes()
    path.write_bytes(header + values.astype("<f4").tobytes())


def flow_discontinuities(
    flow: Float[Tensor, "*batch 2 h w"],
    known: Bool[Tensor, "*batch h w"] | None = None,
    *,
    jump: float = 0.5,
) -> Bool[Tensor, "*batch h w"]:
    """Mark both pixels of each pair of neighbours whose flows differ by more than `jump`.

    Unknown pixels, which in measured truth lie along occlusions, first take the mean flow of their
    known neighbours, ring by ring, so that a jump across them is found.

    Args:
        flow: Displacement, pixels.
        known: Where the flow is known; None takes it to be known everywhere.
        jump: Least difference of two neighbouring flows, pixels.

    Raises:
        ShapeError: If the flow is not `[..., 2, h, w]`, or `known` has not its image size.
    """
    check_shape("flow", flow, 2, None, None)
    height, width = flow.shape[-2:]
    batch = flow.shape[:-3]
    flow = flow.reshape(-1, 2, height, width)
    if known is not None:
        check_shape("known", known, height, width)
        flow = _filled(flow, known.expand(*batch, height, width).reshape(-1, 1, height, width))
    found = torch.zeros_like(flow[:, 0], dtype=torch.bool)
    right = flow.diff(dim=-1).square().sum(dim=1) > jump**2
    down = flow.diff(dim=-2).square().sum(dim=1) > jump**2
    found[..., :-1] |= right
    found[..., 1:] |= right
    found[..., :-1, :] |= down
    found[..., 1:, :] |= down
    return found.reshape(*batch, height, width)


def _filled(
    flow: Float[Tensor, "b 2 h w"], known: Bool[Tensor, "b 1 h w"]
) -> Float[Tensor, "b 2 h w"]:
    flow = torch.where(known, flow, 0.0)
    for _ in range(sum(flow.shape[-2:])):
        if bool(known.all()):
            break
        share = functional.avg_pool2d(known.to(flow), 3, stride=1, padding=1)
        mean = functional.avg_pool2d(flow, 3, stride=1, padding=1)
        reached = share > 0.0
        mean = mean / share.where(reached, 1.0)
        flow = torch.where(known, flow, mean)
        known = known | reached
    return flow


def with_potentials(
    configuration: FlowConfiguration,
    kind: type[Quadratic] | type[Lorentzian] | type[Leclerc] | type[Charbonnier],
) -> FlowConfiguration:
    """The same choices with both potentials of another kind, nu and sigma kept."""
    data, smoothness = (
        kind(nu=potential.nu, sigma=potential.sigma)
        for potential in (configuration.data, configuration.smoothness)
    )
    return replace(configuration, data=data, smoothness=smoothness)

"""Files of optical flow, written for tests."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

UNKNOWN = 1.666666752e9
"""What Middlebury writes where a flow is not known."""


def write_flow(
    path: Path, flow: Float[Tensor, "2 h w"], known: Bool[Tensor, "h w"] | None = None
) -> None:
    """Write a `.flo` file; what is not known, or not finite, as such."""
    usable = flow.isfinite().all(0) if known is None else known & flow.isfinite().all(0)
    values = torch.where(usable, flow.float(), UNKNOWN).movedim(0, -1).contiguous().numpy()
    header = b"PIEH" + np.array(flow.shape[:0:-1], "<i4").tobytes()
    path.write_bytes(header + values.astype("<f4").tobytes())

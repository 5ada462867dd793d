"""Score the robust flow and its motion boundaries on pairs with known flow, beside two peers.

Every folder below --data that holds `flow10.flo`, `frame10.png` and `frame11.png` (the layout of
the Middlebury training set) is one pair. Per pair and method:

- end-point error: its mean (aepe) and root mean square (rmse), pixels;
- angular error (aae), degrees, between the space-time directions (u, v, 1);
- the same three within `near` pixels of a true motion boundary;
- seconds, the best of `repeats` runs, on the threads that torch has (set OMP_NUM_THREADS);
- precision and recall of the motion boundaries (strength above 1/2) within `tolerance` pixels.

    python scripts/evaluate_flow.py --data DIR --out flow.json
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from common import Table, finish, start
from common.flow_files import flow_discontinuities, read_flow, with_potentials
from torch import Tensor
from torch.nn import functional

from torchcss.errors import FlowFileError
from torchcss.io.pictures import read_image
from torchcss.robust import Quadratic
from torchcss.types import frozen
from torchcss.vision.boundaries import motion_boundaries
from torchcss.vision.flow import ACCURATE, TRACKING_FLOW, OpticalFlow, robust_flow


@frozen
class Config:
    """What to score."""

    data: Path
    """Folder searched for pairs."""
    out: Path | None = None
    """Where to write the table as JSON."""
    repeats: int = 3
    """Runs per method and pair; the best time counts."""
    jump: float = 0.5
    """A true motion boundary is a jump of the true flow beyond this, pixels."""
    near: int = 5
    """How close to a true motion boundary is near, pixels."""
    tolerance: int = 3
    """How far a found boundary may lie from a true one, pixels."""
    small: bool = False
    """Only the central 160 x 120 pixels, once: for tests."""


class Pair(NamedTuple):
    """Two grey frames [h w] and the flow between them."""

    name: str
    first: Tensor
    second: Tensor
    flow: Tensor
    known: Tensor


Method = Callable[[Tensor, Tensor], OpticalFlow | Tensor]
ERRORS = ("aepe", "rmse", "aae", "near_aepe", "near_rmse", "near_aae")
COLUMNS = (*ERRORS, "seconds", "precision", "recall")


def main(config: Config) -> None:
    methods = ours()
    if importlib.util.find_spec("cv2"):
        methods |= peers()
    else:
        print("OpenCV is not installed (extra 'bench'): its rows are left out")
    rows = []
    for pair in read_pairs(config):
        boundary = flow_discontinuities(pair.flow, pair.known, jump=config.jump)
        for name, method in methods.items():
            runs = [timed(method, pair) for _ in range(1 if config.small else config.repeats)]
            result, seconds = min(runs, key=lambda run: run[1])
            row = {"pair": pair.name, "method": name, "seconds": seconds}
            flow = result.flow if isinstance(result, OpticalFlow) else result
            row |= errors(flow, pair, with_margin(boundary, config.near))
            if isinstance(result, OpticalFlow):
                row |= boundary_score(result, boundary, config.tolerance)
            rows.append(row)
    setting = {key: getattr(config, key) for key in ("jump", "near", "tolerance", "small")}
    setting |= {"torch": torch.__version__, "threads": torch.get_num_threads()}
    cells = [[row["pair"], row["method"], *map(row.get, COLUMNS)] for row in rows]
    table = Table("Optical flow", ("pair", "method", *COLUMNS), cells)
    finish(config.out, {"setting": setting, "rows": rows}, table)


def timed(method: Method, pair: Pair) -> tuple[OpticalFlow | Tensor, float]:
    start = time.perf_counter()
    result = method(pair.first, pair.second)
    return result, time.perf_counter() - start


def ours() -> dict[str, Method]:
    choices = {
        "accurate": ACCURATE,
        "tracking": TRACKING_FLOW,
        "accurate-quadratic": with_potentials(ACCURATE, Quadratic),
    }
    return {
        name: lambda first, second, choice=choice: robust_flow(first, second, choice)
        for name, choice in choices.items()
    }


def peers() -> dict[str, Method]:
    import cv2

    cv2.setNumThreads(torch.get_num_threads())
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def levels(frame: Tensor) -> np.ndarray:
        return (255.0 * frame).round().to(torch.uint8).numpy()

    def dis_medium(first: Tensor, second: Tensor) -> Tensor:
        start = np.zeros((*first.shape, 2), np.float32)
        return torch.from_numpy(dis.calc(levels(first), levels(second), start)).movedim(-1, 0)

    def farneback(first: Tensor, second: Tensor) -> Tensor:
        start = np.zeros((*first.shape, 2), np.float32)
        flow = cv2.calcOpticalFlowFarneback(
            levels(first), levels(second), start, 0.5, 5, 15, 3, 5, 1.2, 0
        )
        return torch.from_numpy(flow).movedim(-1, 0)

    return {"opencv-dis-medium": dis_medium, "opencv-farneback": farneback}


def read_pairs(config: Config) -> list[Pair]:
    truths = sorted(config.data.rglob("flow10.flo"))
    if not truths:
        raise FlowFileError(f"{config.data}: no folder in it holds flow10.flo; point --data there")
    pairs = []
    for path in truths:
        first, second = (read_grey(path.with_name(f"frame{number}.png")) for number in (10, 11))
        flow, known = read_flow(path)
        if config.small:
            top, left = max(0, (flow.shape[1] - 120) // 2), max(0, (flow.shape[2] - 160) // 2)
            window = (..., slice(top, top + 120), slice(left, left + 160))
            first, second, flow, known = (x[window] for x in (first, second, flow, known))
        pairs.append(Pair(path.parent.name, first, second, flow, known))
    return pairs


def read_grey(path: Path) -> Tensor:
    image = torch.from_numpy(read_image(path)).float() / 255
    return image @ image.new_tensor([0.299, 0.587, 0.114])


def errors(flow: Tensor, pair: Pair, near: Tensor) -> dict[str, float | None]:
    end_point = (flow - pair.flow).square().sum(dim=0).sqrt()
    found, true = (torch.cat([x, torch.ones_like(x[:1])]).double() for x in (flow, pair.flow))
    sine = torch.linalg.cross(found, true, dim=0).square().sum(dim=0).sqrt()
    angle = torch.rad2deg(torch.atan2(sine, (found * true).sum(dim=0)))
    values = []
    for mask in (pair.known, pair.known & near):
        chosen = end_point[mask].double()
        values += [chosen.mean(), chosen.square().mean().sqrt(), angle[mask].mean()]
    return {
        name: float(value) if value.isfinite() else None  # NaN: no such pixel
        for name, value in zip(ERRORS, values, strict=True)
    }


def boundary_score(result: OpticalFlow, true: Tensor, tolerance: int) -> dict[str, float | None]:
    found = motion_boundaries(result) < 0.5
    hits, caught = found & with_margin(true, tolerance), true & with_margin(found, tolerance)
    return {
        "precision": float(hits.sum() / found.sum()) if found.any() else None,
        "recall": float(caught.sum() / true.sum()) if true.any() else None,
    }


def with_margin(mask: Tensor, radius: int) -> Tensor:
    side = 2 * radius + 1
    return functional.max_pool2d(mask[None].float(), side, stride=1, padding=radius)[0] > 0.0


if __name__ == "__main__":
    start(main, Config, __doc__)

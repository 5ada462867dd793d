"""Where the time of a frame goes, stage by stage: in compiled kernels, and around them.

    python scripts/profile_frame.py --clip CLIP --frames 45

CLIP is a folder with `video.mp4`, `cameras.json` and `keypoints2d.npz`. It is tracked on one thread
with its keypoints in every frame. Of each stage the table has the milliseconds of the processor a
frame, its own without those of other stages, the part of them in compiled kernels, and its share of
the frame. What is not in kernels is torch's operations and Python. The first frames are left out;
of the others the lower part of the times is taken, since others may use the machine: of those with
flips of limbs and of those without them alike.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from common import Table, start, write_report

from torchcss.app.track import track_video
from torchcss.cli.options import SettingsOptions
from torchcss.cost.frame import FrameCosts
from torchcss.cost.fused import engine
from torchcss.cost.fused.engine import FusedEngine
from torchcss.inference import tracker, trust_region
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.kernels import checked
from torchcss.tracking.flip_moves import Flips
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import Settings
from torchcss.types import frozen
from torchcss.vision import features

STAGES: dict[str, tuple[Any, str]] = {
    "optical flow": (features, "robust_flow"),
    "edges": (features, "edge_features"),
    "other features": (TrackingSession, "observe"),
    "preparing the terms": (TrackingSession, "_cost"),
    "evaluations": (FusedEngine, "local_model"),
    "planning steps": (trust_region._Pool, "advance_compiled"),
    "covariances of modes": (TrustRegionNewton, "modes"),
    "flips of limbs": (Flips, "states"),
    "the rest of the search": (tracker.Tracker, "step"),
    "the best mode's terms": (TrackingSession, "_terms_of_best"),
    "learning colours": (FrameCosts, "learn"),
    "the rest": (TrackingSession, "step"),
}
"""Functions that are timed, by the name of their stage; the last one ends a frame."""

REASONS = {
    "optical flow": (
        "Pictures warped by splines are 7 million gathered values, the solver takes 7 million "
        "steps of a pixel in one pass over the picture (0.57 ns each); coefficients, texture "
        "and changes of light are 1, 2 and 2 ms; the rest is copies and allocations. Fewer "
        "steps are worse flow: 0.672 and 0.088 px of error on the two known pairs with 12, "
        "0.665 and 0.088 with 16 (before changes of light were an unknown)."
    ),
    "edges": "Two blurs of 97 pixels' width; the rest is a dozen passes over the window.",
    "other features": "Shrinking the picture, and copies between whole pictures and the window.",
    "preparing the terms": (
        "What the modes before saw, 3.5 ms by torch's operations; pictures of eleven layers, "
        "looked up, blurred and given a margin in the window, 1.2 million numbers each time."
    ),
    "evaluations": (
        "Of 105 µs of image terms a state (60 states again and again, nothing else running on "
        "the core), edges take 32 and lines of sight 36: 47,000 and some 20,000 gathered "
        "values. Gathers take about as long as loads one by one (13 and 15 ns for 48 values "
        "of a warped picture), so that wide registers do not help."
    ),
    "planning steps": (
        "Rows of a factor are 34 numbers and fewer, five registers; what is not in the kernel is "
        "calls."
    ),
    "covariances of modes": (
        "LAPACK's eigenvectors of the modes whose Hessian is less curved than the prior "
        "somewhere, a tenth of a millisecond each."
    ),
    "flips of limbs": (
        "In every third frame three times as much: 32 poses by 8 steps, 0.1 ms each and as much "
        "for planning; lines of sight and combinations of limbs by torch's operations are the rest."
    ),
    "the rest of the search": (
        "Draws, weights and distances of modes: operations of torch on arrays of a few "
        "kilobytes, 3 to 5 µs each, nearly none of it arithmetic."
    ),
    "the best mode's terms": (
        "One state in a call of the engine for each of eight terms, 0.2 ms each, most of it "
        "packing; and a drawing of the body for its colours."
    ),
    "learning colours": "Masks of eleven layers, and a drawing of the body and of its core.",
}
"""Why a stage is not faster: what was counted and tried, on a core with AVX-512."""

TRACKING = Settings(overlay=False)

FIRST = 3
"""Frames that are left out: kernels are loaded in them."""
QUANTILE = 0.6
"""Greater times than this quantile's count as it."""
PERIOD = 3
"""Flips of limbs are searched in every third frame."""


@frozen
class Config:
    """What to track."""

    clip: Path
    """Folder of the clip."""
    frames: int = 45
    """Frames to track."""
    out: Path | None = None
    """JSON file to write."""
    tracking: SettingsOptions = TRACKING


@dataclass
class Clock:
    """Adds up the time of stages, each without those inside it; `frames` has one entry a frame."""

    open: list[list[float]] = field(default_factory=list)
    now: dict[str, np.ndarray] = field(default_factory=lambda: defaultdict(lambda: np.zeros(2)))
    frames: list[dict[str, np.ndarray]] = field(default_factory=list)

    def stage(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, timed."""

        def timed(*arguments: Any, **options: Any) -> Any:
            began = time.process_time()
            self.open.append([0.0, 0.0])
            result = function(*arguments, **options)
            inside, kernels = self.open.pop()
            spent = time.process_time() - began
            self.now[name] += (spent - inside, kernels)
            if self.open:
                self.open[-1][0] += spent
            if name == list(STAGES)[-1]:
                self.frames.append(dict(self.now))
                self.now.clear()
            return result

        return timed

    def kernel(self, run: Callable[..., None]) -> Callable[..., None]:
        """What calls kernels, timed."""

        def timed(*arguments: Any) -> None:
            began = time.process_time()
            run(*arguments)
            if self.open:
                self.open[-1][1] += time.process_time() - began

        return timed


@contextmanager
def timing() -> Iterator[Clock]:
    """Time all stages of this process."""
    clock, run = Clock(), checked.run
    with ExitStack() as stack:
        for name, (owner, attribute) in STAGES.items():
            timed = clock.stage(name, vars(owner)[attribute])
            stack.enter_context(patch.object(owner, attribute, timed))
        for module in list(sys.modules.values()):
            if module.__name__.startswith("torchcss.") and vars(module).get("run") is run:
                stack.enter_context(patch.object(module, "run", clock.kernel(run)))
        terms = clock.kernel(engine._Packed.add)
        stack.enter_context(patch.object(engine._Packed, "add", terms))
        yield clock


def main(config: Config) -> dict[str, Any]:
    """Track, print, write; return what is written."""
    clip = config.clip
    with timing() as clock, tempfile.TemporaryDirectory() as folder:
        track_video(
            clip / "video.mp4",
            camera=clip / "cameras.json",
            keypoints=clip / "keypoints2d.npz",
            out=folder,
            settings=config.tracking,
            stop=config.frames,
        )
    nothing = np.zeros(2)
    times = 1e3 * np.array(
        [[frame.get(name, nothing) for name in STAGES] for frame in clock.frames[FIRST:]]
    )
    alike = [times[first::PERIOD] for first in range(PERIOD)]
    lower = [np.minimum(part, np.quantile(part, QUANTILE, axis=0)).mean(0) for part in alike]
    stages = np.mean(lower, axis=0)
    total = stages[:, 0].sum()
    rows = [
        [name, float(own), float(kernels), f"{own / total:.0%}", REASONS.get(name, "")]
        for name, (own, kernels) in zip(STAGES, stages, strict=True)
    ]
    rows.append(["all", float(total), float(stages[:, 1].sum()), "", ""])
    heads = ("stage", "ms", "in kernels", "of the frame")
    Table("Time of a frame", heads, [row[:-1] for row in rows]).print()
    table = Table("Time of a frame", (*heads, "why it is not faster"), rows)
    report = {"settings": asdict(config.tracking), "rows": rows}
    write_report(config.out, report, table)
    return report


if __name__ == "__main__":
    start(main, Config, __doc__)

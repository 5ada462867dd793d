"""Where the time goes: seconds by name, for summaries, benchmarks and profiles.

    stopwatch = Stopwatch()
    with stopwatch("flow"):
        ...
    stopwatch.seconds  # {"flow": 0.12}

The names are also ranges in a `torch.profiler` trace. Blocks are not nested. On an accelerator the
clock reads when work was queued, not when it was done; use the profiler's trace there.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from torch.profiler import record_function


class Stopwatch:
    """Adds up wall time by name.

    Attributes:
        seconds: Seconds spent in the blocks of each name.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time a block.

        Args:
            name: What the block does.
        """
        with record_function(name):
            start = time.perf_counter()
            try:
                yield
            finally:
                spent = time.perf_counter() - start
                self.seconds[name] = self.seconds.get(name, 0.0) + spent

"""Tells from a tracker's own costs when it has lost what it follows.

A tracker that has lost its target goes on with modes that explain the image worse than before.
`LossMonitor` compares what each observation term costs with its median over the frames that were
tracked well, in units of their own spread, and adds up what exceeds a slack (Page's cumulative sum,
Biometrika 41, 1954):

    s_t = max(0, s_{t-1} + min(z_t, z_max) - slack),     lost if s_t > threshold

so that one bad frame is no loss, and several are. Only terms that the frame has are compared, each
with its own past. While the sum is above half the threshold nothing is learnt.

Nothing is done then but to say so: a wider search did not find more bodies again (`docs/tried.md`).
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from typing import NamedTuple

from torchcss.errors import check_positive, check_range
from torchcss.types import frozen


class MonitorState(NamedTuple):
    """What is remembered of the frames before.

    Attributes:
        history: What each term cost in the frames that were tracked well, the newest last.
        excess: By how much the frames that were tracked well exceeded the medians, nats.
        total: The cumulative sum s, in deviations.
        score: z of the last frame, in deviations; 0 before enough is known.
    """

    history: Mapping[str, tuple[float, ...]]
    excess: tuple[float, ...]
    total: float
    score: float


@frozen
class LossMonitor:
    """Page's cumulative sum over what the observations cost.

    Attributes:
        slack: Deviations by which a frame may exceed the median without being held against it.
        threshold: Sum of deviations from which the track counts as lost.
        most: Most deviations that one frame counts with; two frames at least make a loss then.
        burn_in: Frames whose costs are learnt before any is judged.
        window: Frames remembered.
        floor: Least deviation, as a share of the sum of the medians: good tracks vary that much.
    """

    slack: float = 1.5
    threshold: float = 8.0
    most: float = 6.0
    burn_in: int = 6
    window: int = 50
    floor: float = 0.05

    def __post_init__(self) -> None:
        check_positive(self, "slack", "threshold", "most", "burn_in", "window", "floor")
        check_range(self, "burn_in", most=self.window, hint=", the window: no more is remembered")

    def init(self) -> MonitorState:
        """Know nothing yet."""
        return MonitorState({}, (), 0.0, 0.0)

    def update(self, state: MonitorState, costs: Mapping[str, float]) -> tuple[MonitorState, bool]:
        """Judge one frame.

        Args:
            state: What the frames before left.
            costs: What each observation of the frame costs at the best mode, nats; one that the
                frame does not have is left out.

        Returns:
            The next state, and whether the track is lost.
        """
        known = {
            name: statistics.median(state.history[name])
            for name in costs
            if len(state.history.get(name, ())) >= self.burn_in
        }
        # A frame of which nothing is known leaves the sum as it was.
        score, total, excess = 0.0, state.total, None
        finite = all(math.isfinite(cost) for cost in costs.values())
        if not finite:
            # What costs nothing finite is far off, whatever it is, and teaches nothing.
            score, total = self.most, state.total + self.most - self.slack
        elif known:
            level = sum(known.values())
            excess = sum(costs[name] - median for name, median in known.items())
            spread = 1.4826 * statistics.median(map(abs, state.excess)) if state.excess else 0.0
            score = excess / max(spread, self.floor * abs(level), 1e-9)
            total = max(0.0, state.total + min(score, self.most) - self.slack)
        # A sum that grew without end would take as long to come back.
        total = min(total, 2 * self.threshold)
        if not finite or total > 0.5 * self.threshold:
            return state._replace(total=total, score=score), total > self.threshold
        history = dict(state.history)
        for name, cost in costs.items():
            history[name] = (*history.get(name, ()), cost)[-self.window :]
        past = state.excess if excess is None else (*state.excess, excess)[-self.window :]
        return MonitorState(history, past, total, score), False

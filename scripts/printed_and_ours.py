"""The tracker of [IJRR] as printed against ours, with cost, search and dynamics exchanged.

    python scripts/printed_and_ours.py --sequences ARM DARK --out docs/results/exchange.json

`ijrr_css` and `css` differ in their cost (terms, weights, edges, where keypoints count), in their
search (samples, descents, what is kept, flips, limits, where they start from) and in their
dynamics. From either end one of the three is taken from the other tracker, so that one sees which
of our deviations from the paper earn their place. All start from the same first pose and see
keypoints in the first frame alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from common import Table, finish, start
from common.comparison import Comparison, Entrants, by_sequence, cells_of

from torchcss.inference.tracker import Tracker
from torchcss.studies.comparison import Start, find_start, plan_of
from torchcss.studies.sequences import RecordedSequence
from torchcss.tracking.settings import Plan, Settings
from torchcss.types import frozen

ERRORS = "root_aligned_mm", "root_aligned_best_of_modes_mm", "pa_mpjpe_mm"
"""What the table shows of each tracker."""
ENDS = {"ours": ("css", "ijrr_css"), "printed": ("ijrr_css", "css")}
"""The two ends, and what each of them takes parts from."""


@frozen
class Config(Comparison):
    """What is tracked, and how long; the presets are those of the two ends."""

    frames: int = 60
    """Frames of each run."""


def with_cost(plan: Plan, other: Plan) -> Plan:
    """A plan with another one's cost, and what that needs of the pictures."""
    return plan._replace(
        extractor=other.extractor,
        choice=other.choice,
        keypoints_first_only=other.keypoints_first_only,
        boundary_emphasis=other.boundary_emphasis,
        noise=other.noise,
        engine=other.engine,
    )


def with_search(plan: Plan, other: Plan) -> Plan:
    """A plan with another one's search, which keeps its own dynamics."""
    return with_dynamics(
        plan._replace(
            tracker=other.tracker,
            bounds=other.bounds,
            one_fit=other.one_fit,
            jumps_every=other.jumps_every,
            limb_jumps=other.limb_jumps,
        ),
        plan,
    )


def with_dynamics(plan: Plan, other: Plan) -> Plan:
    """A plan with another one's dynamics."""
    mine, theirs = plan.tracker, other.tracker
    assert isinstance(mine, Tracker)
    assert isinstance(theirs, Tracker)
    return plan._replace(tracker=replace(mine, dynamics=theirs.dynamics))


EXCHANGES: dict[str, Callable[[Plan, Plan], Plan]] = {
    "cost": with_cost, "search": with_search, "dynamics": with_dynamics,
}  # fmt: skip


def entrants(config: Config, sequence: RecordedSequence, seed: int) -> Entrants:
    """All trackers of a seed by name."""
    settings = config.settings_of(sequence, seed)
    found: dict[str, tuple[Settings, Start, Plan]] = {}
    begin = None
    for end, presets in ENDS.items():
        mine, theirs = (replace(settings, preset=preset) for preset in presets)
        begin = begin or find_start(sequence, mine)
        plan, other = (plan_of(sequence, each, begin) for each in (mine, theirs))
        found[end] = mine, begin, plan
        for what, exchange in EXCHANGES.items():
            whose = "printed" if end == "ours" else "our"
            found[f"{end}, {whose} {what}"] = mine, begin, exchange(plan, other)
    return found


def main(config: Config) -> dict[str, Any]:
    """Run, print, write; return what is written."""
    rows = by_sequence(config, partial(entrants, config))
    cells = [
        [f"{sequence}: {name}", *cells_of(row, *ERRORS), row["search_s_per_frame"][0]]
        for sequence, found in rows.items()
        for name, row in found.items()
    ]
    columns = ("sequence: tracker", "lost", "best mode", "best of modes", "PA", "search, s/frame")
    table = Table("As printed against ours, part by part", columns, cells)
    return finish(config.out, config.report(rows), table)


if __name__ == "__main__":
    start(main, Config, __doc__)

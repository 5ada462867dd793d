"""What parts of the model are worth: trackers with one of them changed (sections 6 and 8 [IJRR]).

    python scripts/model_variations.py --sequences ARM CLUTTER DARK --out model_variations.json

| variation | what is changed |
|---|---|
| clavicles at rest | the search holds them there (section 6.2: essential for many motions) |
| no stabilisers | parameters that are hard to estimate are not drawn to rest |
| no motion boundaries | edges are not weighed by them (section 8) |
| long arms, short arms | upper arms and forearms ten per cent longer or shorter than fitted |
| three times | so many samples and modes (section 8: what was lost is found again) |

All of one seed start from the same first pose, except that arms of other lengths reach elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from common import Table, finish, start
from common.comparison import Comparison, Entrants, by_sequence, cells_of

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import has_root
from torchcss.body.shape import SHAPE_NAMES, with_shape
from torchcss.studies.comparison import Start, find_start, plan_of
from torchcss.studies.sequences import RecordedSequence
from torchcss.tracking.settings import Plan, Settings
from torchcss.types import Bounds, frozen

ERRORS = "root_aligned_mm", "root_aligned_best_of_modes_mm", "pa_mpjpe_mm"
"""What the table shows of each tracker."""
AS_IT_IS, THREE_TIMES = "as it is", "three times"
VARIATIONS = (
    *("clavicles at rest", "no stabilisers", "no motion boundaries"),
    *("long arms", "short arms", THREE_TIMES),
)


@frozen
class Config(Comparison):
    """What is tracked, and how long."""

    presets: tuple[str, ...] = ("css", "ijrr_css")
    """Trackers that are varied."""
    variations: tuple[str, ...] = VARIATIONS
    """What is changed, beside the trackers as they are."""
    frames: int = 40
    """Frames of each run."""


def without_clavicles(plan: Plan, body: BodyModel) -> Plan:
    """The clavicles are held at rest."""
    held = torch.tensor(["clavicle" in name for name in body.state_names])
    lower, upper = (torch.where(held, body.rest, bound) for bound in plan.bounds)
    return plan._replace(bounds=Bounds(lower, upper))


def without_stabilisers(plan: Plan, _: BodyModel) -> Plan:
    """The cost has no stabilisers."""
    return plan._replace(choice=plan.choice.without("stabiliser"))


def without_boundaries(plan: Plan, _: BodyModel) -> Plan:
    """Edges count alike wherever the image moves."""
    return plan._replace(boundary_emphasis=0.0)


PLANS: dict[str, Callable[[Plan, BodyModel], Plan]] = {
    "clavicles at rest": without_clavicles,
    "no stabilisers": without_stabilisers,
    "no motion boundaries": without_boundaries,
}
ARMS = {"long arms": 1.1, "short arms": 0.9}
MORE = 3


def with_arms(body: BodyModel, factor: float) -> BodyModel:
    """A body of the catalogue whose arms are longer by a factor, its parts as thick as before."""
    lengths = dict(body.lengths)
    for name in ("upper_arm", "forearm"):
        lengths[name] *= factor
    other = load_body(
        body.name, lengths=lengths, free_root=has_root(body), dtype=body.dtype,
        device=body.tie.device,
    ).with_base(body.base_rotation, body.base_translation)  # fmt: skip
    shape, own = body.part_shape.clone(), SHAPE_NAMES.index("a3")
    shape[:, own] = other.part_shape[:, own]
    return with_shape(other, shape)


def entrants(config: Config, sequence: RecordedSequence, seed: int) -> Entrants:
    """The trackers of a seed by preset and variation."""
    found: dict[str, tuple[Settings, Start, Plan]] = {}
    begin = None
    for preset in config.presets:
        settings = replace(config.settings_of(sequence, seed), preset=preset)
        begin = begin or find_start(sequence, settings)
        plan, model = plan_of(sequence, settings, begin), begin.first.body
        found[f"{preset}: {AS_IT_IS}"] = settings, begin, plan
        for name, vary in PLANS.items():
            found[f"{preset}: {name}"] = settings, begin, vary(plan, model)
        for name, factor in ARMS.items():
            other = begin._replace(first=begin.first._replace(body=with_arms(model, factor)))
            found[f"{preset}: {name}"] = settings, other, plan_of(sequence, settings, other)
        tracker = plan.tracker
        more = replace(settings, samples=MORE * tracker.num_samples, modes=MORE * tracker.num_modes)
        found[f"{preset}: {THREE_TIMES}"] = more, begin, plan_of(sequence, more, begin)
    wanted = (AS_IT_IS, *config.variations)
    return {name: run for name, run in found.items() if name.split(": ")[1] in wanted}


def main(config: Config) -> dict[str, Any]:
    """Run, print, write; return what is written."""
    rows = by_sequence(config, partial(entrants, config))
    cells = [
        [f"{sequence}, {name}", *cells_of(row, *ERRORS)]
        for sequence, found in rows.items()
        for name, row in found.items()
    ]
    columns = ("sequence, tracker: variation", "lost", "best mode", "best of modes", "PA")
    table = Table("Parts of the model, changed one at a time", columns, cells)
    return finish(config.out, config.report(rows), table)


if __name__ == "__main__":
    start(main, Config, __doc__)

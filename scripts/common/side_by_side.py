"""Trackers by name, run side by side on a sequence."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from tqdm import tqdm

from torchcss.studies.comparison import Start, track_together
from torchcss.studies.evaluation import Thresholds, summarise
from torchcss.studies.sequences import RecordedSequence
from torchcss.tracking.settings import Plan, Settings

Entrants = Mapping[str, tuple[Settings, Start, Plan]]
"""What is run: settings, first pose and plan by name."""


def side_by_side(
    sequence: RecordedSequence, entrants: Entrants, frames: int
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Run trackers on the first frames of a sequence, with a progress bar.

    Args:
        sequence: What is tracked.
        entrants: The trackers of one seed.
        frames: How many frames, where the sequence has as many.

    Yields:
        Name and summary (`summarise`) of each that was measured, when it ends.
    """
    names, thresholds = list(entrants), Thresholds.of(sequence)
    stop = min(frames, sequence.num_frames)
    seed = next(iter(entrants.values()))[0].seed
    with tqdm(total=stop, desc=f"{sequence.name}, seed {seed}", dynamic_ncols=True) as bar:

        def progress(*_: int) -> None:
            bar.update()

        together = list(entrants.values())
        for run in track_together(sequence, together, thresholds, stop=stop, progress=progress):
            if run.measures:
                summary = summarise(run.measures, thresholds, 1 / sequence.frame_rate)
                yield names[run.number], {"ended": run.ended, **summary}

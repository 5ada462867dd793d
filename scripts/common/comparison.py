"""Trackers by name, compared on a sequence."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from torchcss.cli.options import SettingsOptions
from torchcss.studies.comparison import Start, track_together
from torchcss.studies.evaluation import Thresholds, over_seeds, summarise
from torchcss.studies.sequences import RecordedSequence, read_sequence
from torchcss.tracking.settings import Plan, Settings
from torchcss.types import frozen

Entrants = Mapping[str, tuple[Settings, Start, Plan]]
"""What is run: settings, first pose and plan by name."""
TRACKING = Settings(keypoints_use="first", overlay=False)
"""How comparisons track, where nothing else is said."""


@frozen
class Comparison:
    """What is tracked, and how long."""

    sequences: tuple[Path, ...]
    """Sequence folders."""
    seeds: int = 3
    """Runs of each tracker."""
    frames: int
    """Frames of each run."""
    tracking: SettingsOptions = TRACKING
    """How to track. The seed is the first of the seeds; the body counts where the sequence does not
    say which one moved; presets that are compared count before its own."""
    out: Path | None = None
    """JSON file to write."""

    @property
    def all_seeds(self) -> range:
        """The seeds of the runs."""
        return range(self.tracking.seed, self.tracking.seed + self.seeds)

    def settings_of(self, sequence: RecordedSequence, seed: int) -> Settings:
        """How a sequence is tracked with a seed."""
        return replace(self.tracking, body=body_of(self.tracking, sequence), seed=seed)

    def report(self, by_sequence: Mapping[str, Any]) -> dict[str, Any]:
        """What is written of what was found by sequence."""
        return {"frames": self.frames, "seeds": self.seeds, "by_sequence": by_sequence}


def summaries(
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


def by_sequence(
    config: Comparison, entrants: Callable[[RecordedSequence, int], Entrants]
) -> dict[str, dict[str, dict[str, Any]]]:
    """Run the trackers of several seeds on several sequences.

    Args:
        config: Which sequences and seeds, and how many frames, where a sequence has as many.
        entrants: The trackers of a sequence and a seed.

    Returns:
        By sequence and tracker that was measured median, least and greatest of its numbers
        (`over_seeds`).
    """
    found = {}
    for folder in config.sequences:
        sequence, runs = read_sequence(folder), {}
        for seed in config.all_seeds:
            named = entrants(sequence, seed)
            runs |= {name: runs.get(name, []) for name in named}
            for name, summary in summaries(sequence, named, config.frames):
                runs[name].append(summary)
        found[sequence.name] = {name: over_seeds(each) for name, each in runs.items() if each}
    return found


def body_of(tracking: Settings, sequence: RecordedSequence) -> str:
    """The body that tracks a sequence: the one that moved, if that is known."""
    return tracking.body if sequence.truth is None else sequence.truth.body.name


def cells_of(row: Mapping[str, Any], *keys: str) -> list[str]:
    """How many seeds were lost, then median, least and greatest of some numbers."""
    spreads = (row[key] for key in keys)
    return [
        f"{row['lost']} of {row['seeds']}",
        *(f"{middle:.0f} ({least:.0f} to {most:.0f})" for middle, least, most in spreads),
    ]

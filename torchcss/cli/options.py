"""Options that several verbs have: all of `Settings`, and what is written to the terminal.

    @frozen
    class Config:
        settings: SettingsOptions = Settings(body="arm8")

gives a script `--body`, `--preset`, `--terms` and all others, with the defaults of that record.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Annotated

import tyro

from torchcss.io.run import Given, Run
from torchcss.io.tracks import TRACK_NAME, read_summary
from torchcss.tracking.settings import Settings
from torchcss.types import frozen

PathArgument = Annotated[Path, tyro.conf.Positional]
"""What a verb works on."""

GivenOptions = Annotated[Given, tyro.conf.OmitArgPrefixes]
"""What a run lacks."""

SettingsOptions = Annotated[Settings, tyro.conf.arg(name="")]
"""How to track; each field is an option of its own name."""


def first_look(folder: Path, settings: Settings) -> Path:
    """The file of a finished run that its user opens first."""
    return folder / ("report.html" if settings.overlay else TRACK_NAME)


def tell_outside(run: Run, paths: Iterable[Path | None], given: Sequence[object]) -> None:
    """Say which files a run names that lie outside its folder: it may be a stranger's.

    Args:
        run: The run.
        paths: Files that it names and that may be read.
        given: Those that were named on the command line.
    """
    for path in dict.fromkeys(paths):
        is_own = path is None or path.resolve().is_relative_to(run.folder.resolve())
        if path is not None and not is_own and path not in given and path.exists():
            print(f"reading {path}, which the run names (outside its folder)", file=sys.stderr)


@frozen
class Terminal:
    """What is written to the terminal."""

    quiet: bool = False
    """Write nothing, errors and what --json asks for excepted."""
    json: bool = False
    """For programs: standard output is one JSON object with the run's folder, its files by name and
    its summary; all else goes to standard error."""

    @contextmanager
    def working(self) -> Iterator[None]:
        """While the work is done, which tells of its progress."""
        with ExitStack() as stack:
            aside = sys.stderr
            if self.quiet:
                aside = stack.enter_context(open(os.devnull, "w"))
                stack.enter_context(redirect_stderr(aside))
            if self.quiet or self.json:
                stack.enter_context(redirect_stdout(aside))
            yield

    def tell(self, folder: Path, text: str) -> None:
        """Say what came out.

        Args:
            folder: The run's folder.
            text: The same for people.
        """
        if self.json:
            files = {path.name: str(path) for path in sorted(folder.iterdir()) if path.is_file()}
            told = {"folder": str(folder), "files": files, "summary": read_summary(folder)}
            print(json.dumps(told))
        elif not self.quiet:
            print(text)


TerminalOptions = Annotated[Terminal, tyro.conf.OmitArgPrefixes]

"""Batches that are disturbed lose nothing: the small mode of `scripts/try_faults.py`."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from subprocess import TimeoutExpired

import pytest
from made_processes import begin
from try_faults import _WORDS, Config, Round, main, summed


class Forked:
    """A process of the batch that need not import the package, as `subprocess.Popen` has it."""

    def __init__(self, program: str, *arguments: str) -> None:
        self._process, _ = begin(program, *arguments, OMP_NUM_THREADS="1")

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float) -> int:
        self._process.join(timeout)
        if (ended := self.poll()) is None:
            raise TimeoutExpired("a process of the batch", timeout)
        return ended

    def send_signal(self, number: signal.Signals) -> None:
        if self.poll() is None:  # else nobody is there
            os.kill(self._process.pid or 0, number)

    def kill(self) -> None:
        self._process.kill()

    def terminate(self) -> None:
        self._process.terminate()


def forked(batch: Round, first: str = "") -> Forked:
    """`Round.begin`."""
    words = [str(batch.folder / "clips.jsonl"), "--out", str(batch.out), *_WORDS]
    words += ["--patience", str(batch.config.patience)]
    to = f"open({str(batch.folder / 'printed.txt')!r}, 'ab')"
    program = (
        f"import os; to = {to}; [os.dup2(to.fileno(), n) for n in (1, 2)]; {first}import sys; "
    )
    return Forked(f"{program}from torchcss.app.batch import main; sys.exit(main())", *words)


def test_nothing_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Round, "begin", forked)
    faults = ("kill", "crash", "sleep", "end", "disk", "folder", "group")
    config = Config(
        rounds=len(faults), clips=1, frames=4, patience=1.0, faults=faults, folder=tmp_path,
        processes=1,
    )  # fmt: skip
    report = main(config)
    assert report["lost"] == 0, report["rows"]
    assert [row[1] for row in report["rows"]] == list(faults)


def test_rounds_are_summed() -> None:
    rows = [[0, "kill", "nothing lost"], [1, "disk", "left out: no disk"], [2, "kill", "lost: all"]]
    assert summed(rows) == [["kill", 2, 1], ["disk", 1, "left out: no disk"], ["all", 2, 1]]

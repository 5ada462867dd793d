"""One process at a time writes into a folder."""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path
from threading import Timer

import pytest
from made_processes import begin

from torchcss.app.claims import Claims
from torchcss.app.lock import LOCK_NAME, locked
from torchcss.app.track import track_video
from torchcss.errors import OutputError

HOLD = """
import sys, time
from pathlib import Path
from torchcss.app.lock import locked
with locked(Path(sys.argv[1])) as claim:
    tell("held")
    time.sleep(60)
"""


def of_another_machine(folder: Path) -> Path:
    """A lock that a machine has left that is not this one."""
    (folder / LOCK_NAME).mkdir()
    path = folder / LOCK_NAME / "1"
    path.write_text("elsewhere process 17\nwriting\n")
    return path


def test_of_three_processes_one_writes_and_two_are_refused_with_one_line(tmp_path: Path) -> None:
    first = begin(HOLD, str(tmp_path))
    assert first.told.recv() == "held"
    second = begin(HOLD, str(tmp_path))
    errors = second.told.recv()
    assert second.end() == 1
    with pytest.raises(OutputError) as refused:
        track_video(tmp_path / "no.mp4", out=tmp_path)
    owner = f"{socket.gethostname()} process {first.process.pid}"
    assert str(refused.value).startswith(f"{tmp_path}: {owner} writes into it")
    assert "\n" not in str(refused.value)
    assert f"{owner} writes into it" in errors
    first.process.kill()
    first.end()
    # What a killed process leaves hinders nobody, and nothing stays.
    with locked(tmp_path) as claim:
        assert claim.generation == 2
        assert claim.holds
    assert not (tmp_path / LOCK_NAME).exists()


def test_another_machine_is_watched_by_its_counter(tmp_path: Path) -> None:
    path = of_another_machine(tmp_path)
    begun = time.monotonic()
    with locked(tmp_path, patience_s=0.4) as claim:
        assert claim.generation == 2
    assert time.monotonic() - begun >= 0.4
    of_another_machine(tmp_path)
    with path.open("a") as file:
        Timer(0.2, lambda: (file.write("writing\n"), file.flush())).start()
        with pytest.raises(OutputError, match="elsewhere process 17 writes"):
            locked(tmp_path, patience_s=20).__enter__()


def test_who_was_taken_over_holds_no_more(tmp_path: Path) -> None:
    with locked(tmp_path) as claim:
        assert Claims(tmp_path).take(LOCK_NAME, gone=True) is not None
        assert not claim.holds
    assert (tmp_path / LOCK_NAME / "2").exists()


def test_a_number_that_another_process_has_now_holds_nothing(tmp_path: Path) -> None:
    (tmp_path / LOCK_NAME).mkdir()
    owner = f"{socket.gethostname()} process {os.getpid()}"
    (tmp_path / LOCK_NAME / "1").write_text(f"{owner}\nwriting\n")
    with locked(tmp_path, patience_s=0.2) as claim:
        assert claim.generation == 2

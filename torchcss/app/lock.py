"""One process at a time writes into the folder of a run.

The lock is a claim (`torchcss.app.claims`) under `FOLDER/.lock`, which tells machine and process of
its owner, and a counter that shows that it lives. A lock whose process has ended is taken over at
once on the same machine, and on another when its counter has stood still for `PATIENCE_S`. Whoever
was taken over and wakes up writes nothing more.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from torchcss.app.claims import Claim, Claims, Sight
from torchcss.errors import OutputError
from torchcss.files import prepare_output_folder

LOCK_NAME = ".lock"
PATIENCE_S = 20.0
"""Seconds without a sign of life after which the lock of another machine is taken over."""

_RUN = "run"


@contextmanager
def locked(folder: Path, *, patience_s: float = PATIENCE_S) -> Iterator[Claim]:
    """Hold the lock of a folder.

    Args:
        folder: The folder, which exists.
        patience_s: See `PATIENCE_S`.

    Yields:
        The claim; before each write, see that it `holds`.

    Raises:
        OutputError: If another process holds it, or the folder cannot be written.
    """
    place = folder / LOCK_NAME
    claim = _claimed(folder, Claims(place, patience_s=patience_s))
    try:
        with claim.alive(lambda: "writing"):
            yield claim
    finally:
        claim.release()
        with suppress(OSError):
            for generation in range(1, claim.generation + 1):
                (place / f"{_RUN}.{generation}").unlink(missing_ok=True)
            place.rmdir()


def _claimed(folder: Path, claims: Claims) -> Claim:
    first: Sight | None = None
    while True:
        seen = claims.sight(_RUN)
        runs = None if seen is None else _runs(seen.owner)
        prepare_output_folder(claims.folder)
        try:
            claim = claims.take(_RUN, gone=runs is False)
        except OutputError:
            if claims.folder.is_dir():
                raise
            continue  # whoever had it has just removed it
        if claim is not None:
            return claim
        seen = claims.sight(_RUN)
        if seen is None:
            continue
        first = first or seen
        if runs or (seen.generation, seen.counter) != (first.generation, first.counter):
            raise OutputError(
                f"{folder}: {seen.owner} writes into it ({seen.counter} signs of life); wait until "
                "it has ended, or give another folder"
            )
        time.sleep(claims.beat_s / 2)


def _runs(owner: str) -> bool | None:
    """Whether the process of a claim runs; None: it is of another machine."""
    machine, _, number = owner.partition(" process ")
    if machine != socket.gethostname() or not number.isdigit() or os.name != "posix":
        return None
    try:
        os.kill(int(number), 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True

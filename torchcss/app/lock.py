"""One process at a time writes into the folder of a run.

The lock is a claim (`torchcss.app.claims`) under `FOLDER/.lock`, which tells machine and process of
its owner, and a counter that shows that it lives. A lock whose process has ended is taken over at
once on the same machine; one of another machine, or whose number belongs to another process by now,
when its counter has stood still for `PATIENCE_S`. Whoever was taken over and wakes up writes
nothing more.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from torchcss.app.claims import Claims, Sight, WorkClaim
from torchcss.errors import OutputError
from torchcss.files import prepare_output_folder

LOCK_NAME = ".lock"
PATIENCE_S = 20.0
"""Seconds without a sign of life after which a lock is taken over."""


@contextmanager
def locked(folder: Path, *, patience_s: float = PATIENCE_S) -> Iterator[WorkClaim]:
    """Hold the lock of a folder.

    Args:
        folder: The folder, which exists.
        patience_s: See `PATIENCE_S`.

    Yields:
        The claim; before each write, see that it `holds`.

    Raises:
        OutputError: If another process holds it, or the folder cannot be written.
    """
    claim = _claimed(Claims(folder, patience_s=patience_s))
    try:
        with claim.alive(lambda: "writing"):
            yield claim
    finally:
        claim.release()
        with suppress(OSError):
            for generation in range(1, claim.generation + 1):
                (folder / LOCK_NAME / str(generation)).unlink(missing_ok=True)
            (folder / LOCK_NAME).rmdir()


def _claimed(claims: Claims) -> WorkClaim:
    first: Sight | None = None
    while True:
        seen = claims.sight(LOCK_NAME)
        gone = seen is not None and _has_ended(seen.owner)
        place = prepare_output_folder(claims.folder / LOCK_NAME)
        try:
            claim = claims.take(LOCK_NAME, gone=gone)
        except OutputError:
            if place.is_dir():
                raise
            continue  # whoever had it has just removed it
        if claim is not None:
            return claim
        seen = claims.sight(LOCK_NAME)
        if seen is None:
            continue
        first = first or seen
        if (seen.generation, seen.counter) != (first.generation, first.counter):
            raise OutputError(
                f"{claims.folder}: {seen.owner} writes into it ({seen.counter} signs of life); "
                "wait until it has ended, or give another folder"
            )
        time.sleep(claims.beat_s / 2)


def _has_ended(owner: str) -> bool:
    """Whether a claim is of this machine, and its process runs no more."""
    machine, _, number = owner.partition(" process ")
    if machine != socket.gethostname() or not number.isdigit() or os.name != "posix":
        return False
    with suppress(PermissionError):
        try:
            os.kill(int(number), 0)
        except ProcessLookupError:
            return True
    return False

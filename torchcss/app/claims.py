"""Who works on what, told by files alone: for processes of many machines that share a folder.

A claim is a file `NAME/GENERATION`, made by one exclusive act (it is created only where there is
none, which network file systems honour): of several that try, one succeeds. Its owner writes its
name into it, and shows that it lives by adding lines; their number is a counter, and the last one
says how far it is. A claim whose counter stands still, as long as another process watches it by a
clock of its own, may be taken over: by a claim of the next generation. Clocks of two machines are
never compared. An owner that wakes up finds the newer generation, and has to write nothing more.
Whoever knows that an owner is dead, because it started that process, says so in its claim, and
nobody has to wait.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from torchcss.files import output_error

_RELEASED, _DIED = "released", "died"


def process_name(number: int) -> str:
    """How a process of this machine is called as an owner."""
    return f"{socket.gethostname()} process {number}"


class Sight(NamedTuple):
    """What is seen of a claim to something.

    Attributes:
        generation: Its number, from 1 on.
        owner: Machine and process.
        counter: How often it has shown that its owner lives.
        progress: What its owner said last.
    """

    generation: int
    owner: str
    counter: int
    progress: str

    @property
    def released(self) -> bool:
        """Whether its owner has let it go."""
        return self.progress == _RELEASED

    @property
    def free(self) -> bool:
        """Whether nobody works under it, as its owner has let it go or is known to be dead."""
        return self.released or self.progress == _DIED


class WorkClaim:
    """One's own claim.

    Attributes:
        name: What is claimed.
        generation: Number of this claim to it, from 1 on.
    """

    def __init__(self, claims: Claims, name: str, generation: int) -> None:
        self.name, self.generation = name, generation
        self._claims, self._path = claims, claims.folder / name / str(generation)

    @property
    def holds(self) -> bool:
        """Whether nobody has taken over."""
        seen = self._claims.sight(self.name)
        return seen is not None and seen.generation == self.generation

    def beat(self, progress: str) -> None:
        """Show that the owner lives, and how far it is; of no use to who was taken over."""
        with suppress(OSError):
            if self.holds:
                with self._path.open("a", encoding="utf-8") as file:
                    file.write(progress + "\n")

    def release(self) -> None:
        """Let it go: the next one may claim at once."""
        self.beat(_RELEASED)

    def alive(self, progress: Callable[[], str]) -> AbstractContextManager[None]:
        """Beat from a thread of its own while the body runs."""
        return repeated(lambda: self.beat(progress()), self._claims.beat_s)


@contextmanager
def repeated(act: Callable[[], None], every_s: float) -> Iterator[None]:
    """Do something every so many seconds, in a thread of its own, while the body runs."""
    over = threading.Event()

    def go_on() -> None:
        while not over.wait(every_s):
            act()

    thread = threading.Thread(target=go_on, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


class Claims:
    """The claims of a folder.

    Args:
        folder: Where their files lie.
        patience_s: How long a counter has to stand still until its claim may be taken over.
        clock: Seconds of this process; need not agree with any other.
    """

    def __init__(
        self, folder: Path, *, patience_s: float = 60.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.folder, self.patience_s, self.beat_s = folder, patience_s, patience_s / 10
        self._clock = clock
        self._watched: dict[str, tuple[tuple[int, int], float]] = {}

    def sight(self, name: str, generation: int | None = None) -> Sight | None:
        """A claim to something, the newest if no other is named; None: there is none."""
        place = self.folder / name
        try:
            if generation is None:
                found = [int(file) for file in os.listdir(place) if file.isdigit()]
                generation = max(found, default=0)
            lines = (place / str(generation)).read_text(encoding="utf-8").splitlines()
        except FileNotFoundError:  # or removed just now, as that of a lock is
            return None
        # It has only just been created, or its machine lost its power then.
        owner = lines[0] if lines else "unknown"
        return Sight(generation, owner, len(lines), lines[-1] if len(lines) > 1 else "")

    def take(self, name: str, *, gone: bool = False) -> WorkClaim | None:
        """Claim something; None where somebody else has it, or was faster.

        Args:
            name: What is claimed.
            gone: Whether the owner of the last claim is known to be gone.

        Raises:
            OutputError: If the folder cannot be written.
        """
        seen = self.sight(name)
        if seen is not None and not (gone or seen.free or self._stands_still(name, seen)):
            return None
        generation = 1 if seen is None else seen.generation + 1
        place, path = self.folder / name, self.folder / name / str(generation)
        try:
            place.mkdir(exist_ok=True)
            # Not by a hard link, which many file systems do not have.
            with path.open("x", encoding="utf-8") as file:
                try:
                    file.write(process_name(os.getpid()) + "\n")
                    file.flush()
                except OSError:  # a full disk; an owner without a name would count as dead
                    path.unlink()
                    raise
        except FileExistsError:
            return None
        except OSError as error:
            raise output_error(place, error) from error
        return WorkClaim(self, name, generation)

    def tell_dead(self, name: str, seen: Sight) -> None:
        """Say of a claim that its owner is dead: the next one may claim at once."""
        WorkClaim(self, name, seen.generation).beat(_DIED)

    def _stands_still(self, name: str, seen: Sight) -> bool:
        now, state = self._clock(), (seen.generation, seen.counter)
        before, since = self._watched.get(name, (state, now))
        if before != state:
            since = now
        self._watched[name] = state, since
        return now - since >= self.patience_s

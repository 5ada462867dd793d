"""Disturb batches in the ways that machines have, and see that nothing is lost.

    python scripts/try_faults.py --rounds 50 --out faults.json

Each round tracks the same clips, parts of the demo's, in a new folder with several processes of
`torchcss.app.batch`, and at a random moment does one thing to one of them, to its disk or to its
clip:

| fault | what happens |
|---|---|
| kill | a process is killed |
| crash | a clip kills whoever tracks it: it is failed, and tried again later |
| sleep | a process is stopped, taken over, and woken up |
| end | a process is asked to end, as schedulers do: within ten seconds, with status 0 |
| group | a process of torchrun is killed, which starts all of them again |
| torchrun | torchrun itself is killed, and the store that it keeps |
| join | a second torchrun joins the first, which starts all processes again |
| clock | the clock of a process jumps by hours with every look at it |
| disk | no file may be larger than a part of the track |
| video | a video is cut off, mostly while it is read, and whole again later |
| folder | the folder cannot be written (left out for who always may, as root) |

When the cause is gone, the same command is given again. A round is lost if a clip is missing, or
differs by a bit from that of an undisturbed batch, or if a half file is left.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import Table, finish, start

from torchcss.app.batch import MOST_DEATHS, Batch
from torchcss.io.tracks import load_track
from torchcss.studies.demo import CLIP
from torchcss.tracking.settings import Settings
from torchcss.types import frozen

SETTINGS = Settings(body="arm8", samples=8, modes=2, keypoints_use="first", overlay=False)
_WORDS = (
    *("--body", "arm8", "--samples", "8", "--modes", "2"),
    *("--keypoints-use", "first", "--no-overlay"),
)
_SOON_S, _LATE_S, _POLL_S = 10.0, 300.0, 0.02
_FRAME_S = 0.05
"""What a frame takes at least, seconds."""
_SMALL = 12_000
"""Bytes of a file that is smaller than a track of some frames."""


@frozen
class Config:
    """How much is tried."""

    rounds: int = 20
    """Rounds."""
    clips: int = 3
    """Clips of a batch."""
    frames: int = 12
    """Frames of a clip."""
    processes: int = 2
    """Processes of a batch."""
    patience: float = 2.0
    """Seconds until a process that shows no life is taken over."""
    faults: tuple[str, ...] = (
        "kill", "crash", "sleep", "end", "disk", "video", "folder", "group", "torchrun", "join",
        "clock",
    )  # fmt: skip
    """What is tried, in turns."""
    folder: Path = Path("faults")
    """Where batches are written; those of rounds that went well are removed."""
    seed: int = 0
    """Seed of the moments."""
    out: Path | None = None
    """JSON file to write."""


class Lost(Exception):
    """What was lost in a round."""


@dataclass(frozen=True)
class Round:
    """One batch in a folder of its own."""

    config: Config
    folder: Path
    moment: random.Random

    @property
    def out(self) -> Path:
        """The batch's folder."""
        return self.folder / "out"

    @property
    def video(self) -> Path:
        """The first clip's video; the others share another."""
        return self.folder / "first.mp4"

    @property
    def printed(self) -> str:
        """What its processes have printed."""
        return (self.folder / "printed.txt").read_text(encoding="utf-8")

    def prepare(self) -> None:
        """Write the manifest."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        shutil.copy(CLIP / "video.mp4", self.video)
        rows = [
            {
                "name": f"clip{number}",
                "video": str(CLIP / "video.mp4" if number else self.video.resolve()),
                "camera": str(CLIP / "cameras.json"),
                "keypoints": str(CLIP / "keypoints.npz"),
                "init": str(CLIP / "body.npz"),
                "stop": self.config.frames,
                "seed": number,
            }
            for number in range(self.config.clips)
        ]
        (self.folder / "clips.jsonl").write_text("\n".join(map(json.dumps, rows)))

    def begin(self, first: str = "") -> subprocess.Popen[bytes]:
        """Start one process of the batch, which runs a line of Python first."""
        code = f"{first}import sys; from torchcss.app.batch import main; sys.exit(main())"
        return self._begin("-c", code)

    def torchrun(self, *how: str) -> subprocess.Popen[bytes]:
        """Start all processes by torchrun."""
        how = (*(how or ("--standalone",)), f"--nproc-per-node={self.config.processes}")
        how = (*how, "--max-restarts=3", "-m", "torchcss.app.batch")
        return self._begin("-m", "torch.distributed.run", *how)

    def _begin(self, *what: str) -> subprocess.Popen[bytes]:
        words = [sys.executable, *what, str(self.folder / "clips.jsonl")]
        words += ["--out", str(self.out), "--patience", str(self.config.patience), *_WORDS]
        path = os.pathsep.join(filter(None, sys.path))
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": path}
        # Else a machine that joins waits in vain for the others' address (seen with torch 2.13).
        environment["TORCH_DISABLE_SHARE_RDZV_TCP_STORE"] = "1"
        with (self.folder / "printed.txt").open("ab") as printed:
            return subprocess.Popen(words, stdout=printed, stderr=printed, env=environment)

    def again(self, *, retry_failed: bool = False) -> None:
        """The same command, here, when the cause is gone."""
        Batch(
            manifest=self.folder / "clips.jsonl", out=self.out, settings=SETTINGS,
            patience=self.config.patience, retry_failed=retry_failed,
        ).run()  # fmt: skip

    def wait_for(self, what: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
        """Until something is so, or the process has ended."""
        until = time.monotonic() + _LATE_S
        while process.poll() is None and not what():
            if time.monotonic() > until:
                raise Lost("nothing happened for five minutes")
            time.sleep(_POLL_S)

    def is_tracking(self) -> bool:
        """Whether some frames of a clip are in a checkpoint."""
        return any((self.out / ".batch" / "work").glob("*/*/checkpoint.npz"))

    def catch(self, process: subprocess.Popen[bytes]) -> None:
        """Wait until it tracks, and a random while longer in which it does not end."""
        self.wait_for(self.is_tracking, process)
        left_s = _FRAME_S * self.config.frames * self.config.clips
        time.sleep(self.moment.uniform(0, left_s))


def kill(batch: Round) -> None:
    """SIGKILL."""
    processes = [batch.begin() for _ in range(batch.config.processes)]
    batch.catch(processes[0])
    processes[0].kill()
    for process in processes:
        process.wait(_LATE_S)


def crash(batch: Round) -> None:
    """SIGKILL in the midst of a clip, whoever tracks it; those that died start again."""
    frames = batch.moment.randrange(batch.config.frames)
    deadly = "import os; from torchcss.app.batch import _Watch as W; add = W.add; "
    deadly += "W.add = lambda w, f, p: os.kill(os.getpid(), 9) if w.claim.name == 'clip0' "
    deadly += f"and f.frame.index >= {frames} else add(w, f, p); "
    for _ in range(MOST_DEATHS + 1):
        processes = [batch.begin(deadly) for _ in range(batch.config.processes)]
        if not any([process.wait(_LATE_S) for process in processes]):
            break
    else:
        raise Lost("a clip that kills its processes was not given up")
    _expect(f"died {MOST_DEATHS} times" in batch.printed, "a deadly clip: not told")
    batch.again(retry_failed=True)


def sleep(batch: Round) -> None:
    """SIGSTOP, and SIGCONT when all is done by others."""
    process = batch.begin()
    batch.catch(process)
    process.send_signal(signal.SIGSTOP)
    batch.again()
    process.send_signal(signal.SIGCONT)
    _expect(process.wait(_LATE_S) == 0, "a process that was taken over ended with an error")


def end(batch: Round) -> None:
    """SIGTERM."""
    process = batch.begin()
    batch.catch(process)
    process.terminate()
    try:
        _expect(process.wait(_SOON_S) == 0, "SIGTERM: not status 0")
    except subprocess.TimeoutExpired as error:
        raise Lost("SIGTERM: did not end within ten seconds") from error


def disk(batch: Round) -> None:
    """RLIMIT_FSIZE."""
    limit = f"import resource as r; r.setrlimit(r.RLIMIT_FSIZE, ({_SMALL}, {_SMALL})); "
    _expect(batch.begin(limit).wait(_LATE_S) == 0, "a full disk ended a process")
    _expect("cannot be written" in batch.printed, "the disk: no clip failed")


def video(batch: Round) -> None:
    """A video is cut off before it is opened, or while it is read."""
    whole = batch.video.read_bytes()
    process = batch.begin()
    batch.wait_for(lambda: any((batch.out / ".batch" / "work").glob("clip0/*")), process)
    time.sleep(batch.moment.uniform(0, 1.0))
    os.truncate(batch.video, int(batch.moment.uniform(0.02, 0.2) * len(whole)))
    _expect(process.wait(_LATE_S) == 0, "a damaged video ended a process")
    batch.video.write_bytes(whole)


def folder(batch: Round) -> None:
    """The folder of the work cannot be written."""
    place = batch.out / ".batch" / "work"
    place.mkdir(parents=True)
    place.chmod(0o500)
    batch.begin().wait(_LATE_S)
    place.chmod(0o700)


def group(batch: Round) -> None:
    """SIGKILL to one of torchrun's processes."""
    process = batch.torchrun()
    batch.catch(process)
    os.kill(batch.moment.choice(_children(process)), signal.SIGKILL)
    _expect(process.wait(_LATE_S) == 0, "torchrun did not start its processes again")


def torchrun(batch: Round) -> None:
    """SIGKILL to torchrun; its processes do not know, and go on beside the next command's."""
    process = batch.torchrun()
    batch.catch(process)
    process.kill()
    process.wait(_LATE_S)


def join(batch: Round) -> None:
    """As when a second machine is admitted."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        place = f"localhost:{free.getsockname()[1]}"
    how = ("--nnodes=1:2", "--rdzv-backend=c10d", f"--rdzv-endpoint={place}", "--rdzv-id=batch")
    processes = [batch.torchrun(*how, "--rdzv-conf=last_call_timeout=2")]
    batch.catch(processes[0])
    processes.append(batch.torchrun(*how))
    _expect(
        all(process.wait(_LATE_S) == 0 for process in processes), "torchrun ended with an error"
    )


def clock(batch: Round) -> None:
    """Other times, forwards and backwards."""
    jump = "import random, time; now = time.time; "
    jump += "time.time = lambda: now() + random.uniform(-1e5, 1e5); "
    process = batch.begin(jump)
    _expect(process.wait(_LATE_S) == 0, "a clock that jumps ended a process")


def _children(process: subprocess.Popen[bytes]) -> list[int]:
    """Numbers of the processes that one has started, on Linux."""
    listed = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text(encoding="ascii")
    return [int(number) for number in listed.split()]


FAULTS = {
    fault.__name__: fault
    for fault in (kill, crash, sleep, end, disk, video, folder, group, torchrun, join, clock)
}


def _may_write_everywhere() -> bool:
    with tempfile.TemporaryDirectory() as place:
        os.chmod(place, 0o500)
        return os.access(place, os.W_OK)


_UNABLE: dict[str, tuple[bool, str]] = {
    "folder": (_may_write_everywhere(), "this user may write everywhere, as root does"),
    "group": (sys.platform != "linux", "it is not told whose process is whose"),
}
"""What cannot be tried here, and why."""


def _expect(so: bool, what: str) -> None:
    if not so:
        raise Lost(what)


def compare(batch: Round, undisturbed: Path) -> None:
    """That every clip is there, whole, once, and the same."""
    batch.again()
    left = [path.name for path in (batch.out / ".batch" / "work").iterdir()]
    _expect(not left, f"left in work: {left}")
    for number in range(batch.config.clips):
        name = f"clip{number}"
        found, expected = (load_track(out / name) for out in (batch.out, undisturbed))
        for field in ("frames", "state", "covariance", "log_weight", "cost", "joints_world"):
            same = np.array_equal(getattr(found, field), getattr(expected, field))
            _expect(same, f"{name}: {field} differs")
        state = json.loads((batch.out / name / "summary.json").read_text())["ended"]
        _expect(state == "complete", f"{name}: {state}")


def main(config: Config) -> dict[str, Any]:
    """Try, print and write; return what is written."""
    calm = Round(config, config.folder / "undisturbed", random.Random())
    calm.prepare()
    calm.again()
    rows = []
    for number in range(config.rounds):
        name = config.faults[number % len(config.faults)]
        unable, why = _UNABLE.get(name, (False, ""))
        if unable:
            rows.append([number, name, f"left out: {why}"])
            continue
        batch = Round(config, config.folder / f"round{number}", random.Random(config.seed + number))
        batch.prepare()
        try:
            FAULTS[name](batch)
            compare(batch, calm.out)
        except (Lost, subprocess.TimeoutExpired) as error:
            rows.append([number, name, f"lost: {error}"])
        else:
            rows.append([number, name, "nothing lost"])
            shutil.rmtree(batch.folder)
        print(*rows[-1], flush=True)
    table = Table("Batches disturbed", ("fault", "rounds", "lost"), summed(rows))
    report = {"rounds": len(rows), "lost": table.rows[-1][2], "rows": rows}
    return finish(config.out, report, table)


def summed(rows: Sequence[Sequence[Any]]) -> list[list[str | float | None]]:
    """Rounds and losses of each fault, and of all that was tried."""
    outcomes: dict[str, list[str]] = {}
    for _, fault, outcome in rows:
        outcomes.setdefault(fault, []).append(outcome)
        if not outcome.startswith("left out"):
            outcomes.setdefault("all", []).append(outcome)
    outcomes["all"] = outcomes.pop("all", [])  # below the others
    return [
        [fault, len(ended), ended[0]]
        if ended and ended[0].startswith("left out")
        else [fault, len(ended), sum(each.startswith("lost") for each in ended)]
        for fault, ended in outcomes.items()
    ]


if __name__ == "__main__":
    start(main, Config, __doc__)

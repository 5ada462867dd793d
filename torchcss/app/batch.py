"""Many clips, by as many processes as there are, on one machine or on several that share a folder.

    torchcss batch clips.csv --out results --workers 4
    torchrun --nproc-per-node 4 -m torchcss.app.batch clips.csv --out results

What is true lies in the folder and nowhere else. A process claims a clip (`torchcss.app.claims`),
tracks it in a folder of that claim, going on from what an earlier claim left, and publishes it by
renaming that folder to the clip's name. Whoever was taken over meanwhile writes into a folder that
nobody looks at, and publishes nothing. The same command goes on with an interrupted batch. A clip
whose owners die one after the other at the same place, by a crash or for want of memory, is failed
before it ends all processes.

    OUT/NAME/                a clip that is done, as `torchcss track` leaves it
    OUT/batch.json, .html    the state of every clip
    OUT/.batch/              the manifest, claims, work/NAME/GENERATION, and what failed why
"""

from __future__ import annotations

import atexit
import csv
import gc
import html
import io
import json
import multiprocessing
import os
import re
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import (
    AbstractContextManager,
    nullcontext,
    redirect_stderr,
    redirect_stdout,
    suppress,
)
from dataclasses import asdict
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args
from urllib.parse import quote

import tyro

from torchcss.app.claims import Claims, WorkClaim, process_name, repeated
from torchcss.app.recorder import Picture, ended_by_sigterm
from torchcss.app.track import TrackOptions, track_video
from torchcss.errors import ConfigurationError, OutputError, TorchcssError
from torchcss.files import (
    load_json,
    one_line,
    prepare_output_folder,
    read_text,
    refusing,
    unexpected,
    write_text,
)
from torchcss.io.checkpoint import CHECKPOINT_NAME, read_checkpoint
from torchcss.io.keypoints.read import Scale
from torchcss.io.tracks import TRACK_NAME, read_summary
from torchcss.io.video import VIDEO_SUFFIXES, VideoReader
from torchcss.joint_names import names_in
from torchcss.tracking.session import Posterior
from torchcss.tracking.settings import Settings, settings_from_plain
from torchcss.types import frozen

FILE_COLUMNS = names_in("video camera keypoints masks init")
"""Columns that are paths, from the manifest's folder on."""

OPTION_COLUMNS = names_in("camera_name layout normalised person frame_rate sigma focal fov stride")
"""Columns that are options of the files, see `TrackOptions`."""

SETTING_COLUMNS = names_in(
    "body stature ground preset seed samples modes keypoints_use working_size"
)
"""Columns that are settings of this clip alone."""


def _number_of_person(text: str) -> str:
    """As it is; in a column with empty cells many programs write 5 as 5.0."""
    return re.sub(r"(?<=[0-9])\.0*$", "", text)


def _whole(text: str) -> int:
    return int(_number_of_person(text))


_NUMBERS = {
    **dict.fromkeys(names_in("start stop stride seed samples modes working_size"), _whole),
    **dict.fromkeys(names_in("frame_rate sigma focal fov stature ground"), float),
}
_KINDS = {**_NUMBERS, "person": _number_of_person}
_COLUMNS = ("name", "start", "stop", *FILE_COLUMNS, *OPTION_COLUMNS, *SETTING_COLUMNS)
_SCALES = " or ".join(get_args(Scale))
_FOLDER = re.compile(r"(?!\.|batch\.(json|html)$)[^\0-\x1f\ud800-\udfff]+")
"""Names of clips: not hidden, not the batch's own files, and of signs that can be written."""

MOST_DEATHS = 3
"""Owners of a clip that may die at the same place of it, one after the other."""

_POLL_S = 0.5

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>torchcss batch</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: #222; padding: 1rem; }}
th, td {{ text-align: left; vertical-align: top; padding: .2rem .8rem .2rem 0;
  overflow-wrap: break-word; }}
td:last-child {{ overflow-wrap: anywhere; }}
th {{ border-bottom: 1px solid #ddd; }}
</style></head><body>
<h1>{summed}</h1>
<table>
<tr><th>clip<th>state<th>frames<th>told lost<th>seconds a frame<th></tr>
{rows}</table>
</body></html>
"""


@frozen
class Batch:
    """Track many clips; the same command goes on with what was interrupted."""

    manifest: Annotated[Path, tyro.conf.Positional]
    """CSV or JSON with a column video, and others for what differs: camera, keypoints, name, start,
    stop, stature, seed and so on; or a folder of folders that hold video.mp4, cameras.json and
    keypoints.npz, or of videos."""
    out: Path = Path("out/batch")
    """Folder of the results, one folder a clip."""
    workers: int = 1
    """Processes on this machine, one thread each."""
    retry_failed: bool = False
    """Try clips again that failed by their own files, too. Failures of the disk, and clips whose
    files have changed, are tried again in any case."""
    patience: float = 60.0
    """Seconds for which a process has to show no sign of life until its clip is taken over."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = Settings()

    def __post_init__(self) -> None:
        if self.workers < 1 or not 0 < self.patience < threading.TIMEOUT_MAX:
            raise ConfigurationError(
                f"expected at least 1 worker and some seconds of patience, got {self.workers} and "
                f"{self.patience}"
            )

    def run(self) -> int:
        """Run the batch; how it ended is in `batch.json` and printed.

        Returns:
            How many clips failed.

        Raises:
            TorchcssError: If the manifest or the folder is of no use. What is wrong with a clip is
                its own failure.
        """
        with ended_by_sigterm():
            job = Job.begin(self)
            with _shown(job):
                if self.workers > 1 and "RANK" not in os.environ:
                    self._with_workers(job)
                else:
                    work(job)
            print(job.report())
        return sum(state.kind == "failed" for state in job.states().values())

    def _with_workers(self, job: Job) -> None:
        """Start processes, and wait for them; for one that died with a clip, another starts."""
        os.environ["OMP_NUM_THREADS"] = "1"  # for those that start now
        workers: list[BaseProcess] = []
        try:
            for _ in range(self.workers):
                workers.append(_started(job))
            while workers:
                wait([worker.sentinel for worker in workers])
                for worker in [each for each in workers if not each.is_alive()]:
                    workers.remove(worker)
                    # One that died before it had a clip would do so again.
                    if worker.pid is not None and job.free_from(worker.pid):
                        print(
                            f"process {worker.pid} died with its clip; another one starts",
                            flush=True,
                        )
                        workers.append(_started(job))
        finally:
            for worker in workers:
                worker.terminate()
            for worker in workers:
                worker.join()


def _started(job: Job) -> BaseProcess:
    process = multiprocessing.get_context("spawn").Process(target=_worker, args=(job,))
    process.start()
    return process


def _worker(job: Job) -> None:
    with ended_by_sigterm(), suppress(KeyboardInterrupt):
        try:
            work(job)
        except TorchcssError as error:
            sys.exit(f"torchcss: {error}")


def _shown(job: Job) -> AbstractContextManager[None]:
    """Print what becomes of the clips while the body runs; of torchrun's processes one does."""
    shown: dict[str, State] = {}
    to = sys.stdout

    def show() -> None:
        for name, state in job.states().items():
            if shown.get(name) != state:
                print(f"{name}: {state.text}", file=to, flush=True)
                shown[name] = state

    return nullcontext() if os.environ.get("RANK", "0") != "0" else repeated(show, _POLL_S)


class Clip(NamedTuple):
    """A row of a manifest.

    Attributes:
        name: Of its output folder.
        row: Its other columns.
    """

    name: str
    row: Mapping[str, Any]

    def fingerprint(self) -> list[list[int]]:
        """What changes when its files do."""
        found = []
        for column in FILE_COLUMNS:
            with suppress(OSError):
                if column in self.row:
                    about = os.stat(self.row[column])
                    found.append([about.st_size, about.st_mtime_ns])
        return found


def read_manifest(path: Path) -> list[Clip]:
    """The clips of a table, of JSON (a list, or an object a line), or of a folder.

    Raises:
        ConfigurationError: If it is none, a column is unknown or there twice, or two clips have one
            name.
    """
    if path.is_dir():
        rows: Mapping[str, Any] = {row["video"]: row for row in _rows_of_folder(path)}
    else:
        text = read_text(path, ConfigurationError)
        read_rows = _rows_of_json if text.lstrip()[:1] in ("[", "{") else _rows_of_table
        rows = read_rows(path, text)
    folder = path if path.is_dir() else path.parent
    clips = [_clip(row, where, folder) for where, row in rows.items()]
    if not clips:
        raise ConfigurationError(f"{path}: no clips in it")
    names = [clip.name for clip in clips]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigurationError(f"{path}: two clips are called {twice[0]}; give a column name")
    return clips


def _rows_of_table(path: Path, text: str) -> dict[str, dict[str | None, Any]]:
    """The rows that hold anything, whatever separates their cells."""
    text = re.sub(r"^\s*(sep=.\r?\n)?", "", text)  # for Excel
    comma = max(",;\t", key=text.partition("\n")[0].count)
    rows: dict[str, dict[str | None, Any]] = {}
    with refusing(ConfigurationError, f"{path}: not a table"):
        source = io.StringIO(text, newline="")
        table = csv.DictReader(source, delimiter=comma, skipinitialspace=True)
        table.fieldnames = columns = [name.strip().lower() for name in table.fieldnames or ()]
        for number, row in enumerate(table, 1):
            # Spreadsheets go on with empty columns and rows.
            cells = {
                n: _stripped(n, cell, comma) for n, cell in row.items() if n or any(cell or ())
            }
            if any(cells.values()):
                rows[f"{path}: row {number}"] = cells
    if twice := [name for name in columns if name and columns.count(name) > 1]:
        raise ConfigurationError(f"{path}: two columns are called {twice[0]}; expected one")
    return rows


def _stripped(column: str | None, cell: Any, comma: str) -> Any:
    """A cell without blanks around it; whoever separates cells otherwise may write 2,5."""
    if not isinstance(cell, str):  # there is none, or there are several
        return cell
    return cell.strip().replace(",", "." if column in _NUMBERS and comma != "," else ",")


def _rows_of_json(path: Path, text: str) -> dict[str, Any]:
    """The entries of a list, or the objects of all lines."""
    with suppress(ValueError, RecursionError):
        if isinstance(entries := json.loads(text), list):
            return {f"{path}: entry {number}": row for number, row in enumerate(entries, 1)}
    rows: dict[str, Any] = {}
    for number, line in enumerate(text.split("\n"), 1):
        with refusing(ConfigurationError, f"{path}: line {number}: no JSON"):
            rows |= {f"{path}: line {number}": json.loads(line)} if line.strip() else {}
    return rows


def _rows_of_folder(folder: Path) -> Iterator[dict[str, str]]:
    """Videos, and folders of a video with its files; of other folders a line is printed."""
    usual = (
        ("camera", "cameras.json"), ("keypoints", "keypoints.npz"), ("keypoints", "keypoints2d.npz")
    )  # fmt: skip
    others: list[str] = []
    # What begins with a dot is the system's.
    for inner in sorted(each for each in folder.iterdir() if not each.name.startswith(".")):
        if inner.is_dir():
            videos = [each for s in VIDEO_SUFFIXES if (each := inner / f"video{s}").is_file()]
            beside = {c: str(inner / n) for c, n in usual if (inner / n).is_file()}
            if videos:
                yield {"name": inner.name, "video": str(videos[0]), **beside}
            else:
                others.append(inner.name)
        elif inner.suffix.lower() in VIDEO_SUFFIXES:
            yield {"video": str(inner)}
    if others and os.environ.get("RANK", "0") == "0":
        print(f"{folder}: without a video.mp4, left out: {', '.join(others)}", file=sys.stderr)


def _clip(row: object, where: str, folder: Path) -> Clip:
    if not isinstance(row, Mapping) or not row.get("video"):
        raise ConfigurationError(f"{where}: expected a column video")
    if None in row:  # as `csv` calls the column of what has none
        raise ConfigurationError(f"{where}: more cells than columns; quote a cell that has a comma")
    if unknown := sorted(str(name) for name in row if name not in _COLUMNS):
        raise ConfigurationError(
            f"{where}: unknown column {unknown[0]!r}; there are {', '.join(_COLUMNS)}"
        )
    given: dict[str, Any] = {}
    for name, value in row.items():
        if value in (None, "") or value != value:  # NaN is how pandas writes an empty cell
            continue
        kind = _KINDS.get(name, str)
        with suppress(ValueError):
            if isinstance(value, str | int | float) and not isinstance(value, bool):
                given[name] = kind(str(value))
        if name not in given:
            what = {_whole: "a whole number", float: "a number"}.get(kind, "a text")
            raise unexpected(ConfigurationError, f"{where}: {name}", what, value)
        if name == "normalised" and given[name] not in get_args(Scale):
            raise unexpected(ConfigurationError, f"{where}: {name}", _SCALES, value)
        if name in FILE_COLUMNS:
            given[name] = os.path.abspath(folder / given[name])
    name = given.pop("name", Path(given["video"]).stem)
    if name != Path(name).name or not _FOLDER.fullmatch(name) or len(name.encode()) > 200:
        raise ConfigurationError(f"{where}: {name!r} cannot be the name of a folder; give another")
    return Clip(name, given)


class State(NamedTuple):
    """How far a clip is: waiting, tracking, done or failed, and what there is to say about it."""

    kind: str
    about: str = ""

    @property
    def text(self) -> str:
        """For people."""
        return f"{self.kind} {self.about}".strip()


class Job(NamedTuple):
    """A batch as every process sees it.

    Attributes:
        clips: What is to be tracked.
        settings: How, where a row does not say otherwise.
        out: The folder.
        claims: Who tracks what.
    """

    clips: tuple[Clip, ...]
    settings: Settings
    out: Path
    claims: Claims

    @classmethod
    def begin(cls, batch: Batch) -> Job:
        """Read the manifest, and write it where there is none of another batch.

        Raises:
            ConfigurationError: If the folder holds another batch.
        """
        clips, out = read_manifest(batch.manifest), prepare_output_folder(batch.out)
        for name in ("claims", "work", "failed"):
            prepare_output_folder(out / ".batch" / name)
        plain = {"clips": [c._asdict() for c in clips], "settings": asdict(batch.settings)}
        about = json.loads(json.dumps(plain))
        path = out / ".batch" / "manifest.json"
        if not path.exists():
            if other := next(
                (out / clip.name for clip in clips if (out / clip.name).exists()), None
            ):
                raise ConfigurationError(
                    f"{other}: is in the way of a clip; move it, or give another --out"
                )
            write_text(path, json.dumps(about, indent=1))
        elif (before := load_json(path, ConfigurationError)) != about:
            what = "settings" if before.get("settings") != about["settings"] else "clips"
            raise ConfigurationError(
                f"{out}: holds a batch of other {what}; give the same command, or another --out"
            )
        claims = Claims(out / ".batch" / "claims", patience_s=batch.patience)
        job = cls(tuple(clips), batch.settings, out, claims)
        for clip in clips:  # let them be tried again
            failure = job.failure(clip)
            if failure is not None and (
                batch.retry_failed or failure["of_disk"] or failure["files"] != clip.fingerprint()
            ):
                job._failed(clip).unlink(missing_ok=True)
        return job

    def _failed(self, clip: Clip) -> Path:
        return self.out / ".batch" / "failed" / f"{clip.name}.json"

    def failure(self, clip: Clip) -> dict[str, Any] | None:
        """Why a clip failed; None if it did not."""
        try:
            return json.loads(self._failed(clip).read_bytes())
        except (OSError, ValueError):  # none, or removed or damaged: the clip is tried again
            return None

    def is_done(self, clip: Clip) -> bool:
        """Whether a clip was published."""
        return (self.out / clip.name / TRACK_NAME).is_file()

    def is_left(self, clip: Clip) -> bool:
        """Whether a clip is to be tracked."""
        return not self.is_done(clip) and self.failure(clip) is None

    def free_from(self, process: int) -> bool:
        """Whether a process of this machine, which is dead, had a clip: others may have it now."""
        for clip in self.clips:
            seen = self.claims.sight(clip.name)
            if seen is not None and not seen.free and seen.owner == process_name(process):
                self.claims.tell_dead(clip.name, seen)
                return True
        return False

    def states(self) -> dict[str, State]:
        """How far every clip is."""
        return {clip.name: self._state(clip) for clip in self.clips}

    def _state(self, clip: Clip) -> State:
        if self.is_done(clip):
            return State("done")
        if (failure := self.failure(clip)) is not None:
            return State("failed", failure["line"])
        seen = self.claims.sight(clip.name)
        if seen is None or seen.free:
            return State("waiting")
        return State("tracking", seen.progress)

    def fail(self, clip: Clip, error: BaseException) -> None:
        """Say why a clip failed."""
        about = {
            "line": str(error) if isinstance(error, TorchcssError) else one_line(error),
            "of_disk": isinstance(error, OSError),
            "files": clip.fingerprint(),
        }
        # A disk that is full takes no note either: then the clip is tried again.
        with suppress(OutputError):
            write_text(self._failed(clip), json.dumps(about))

    def _outcome(self, name: str) -> dict[str, Any]:
        """What there is to know of a clip that is done, as far as its summary tells."""
        summary = {}
        with suppress(TorchcssError):
            summary = read_summary(self.out / name)
        seconds = summary.get("seconds_per_frame")
        return {
            "frames": summary.get("num_frames", ""),
            "told_lost": sum(event["event"] == "lost" for event in summary.get("events", ())),
            "seconds_per_frame": round(seconds, 2) if isinstance(seconds, float) else "",
        }

    def report(self) -> str:
        """Write `batch.json` and `batch.html`; how many clips ended how."""
        states = self.states()
        kinds = [state.kind for state in states.values()]
        counts = {kind: kinds.count(kind) for kind in ("done", "failed", "tracking", "waiting")}
        summed = ", ".join(f"{number} {kind}" for kind, number in counts.items() if number)
        plain, rows = {}, ""
        for name, state in states.items():
            called, told = html.escape(name), {}
            if state.kind == "done":  # of others there is no folder
                told = self._outcome(name)
                called = f"<a href='{quote(name)}/'>{called}</a>"
            plain[name] = {**state._asdict(), **told}
            cells = called, state.kind, *(told.values() or 3 * [""]), html.escape(state.about)
            rows += f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>\n"
        write_text(self.out / "batch.json", json.dumps({**counts, "clips": plain}, indent=1))
        write_text(self.out / "batch.html", _PAGE.format(summed=summed, rows=rows))
        failed = [f"{name}: {s.about}" for name, s in states.items() if s.kind == "failed"]
        return "\n".join([*failed, f"{summed}; see {self.out / 'batch.html'}"])


def work(job: Job) -> None:
    """Track clips until none is left: the loop of one process.

    Raises:
        KeyboardInterrupt: If the process was asked to end; what was tracked is on disk.
    """
    while left := [clip for clip in job.clips if job.is_left(clip)]:
        for clip in left:
            # The pass may take long; others go on meanwhile.
            if job.is_left(clip) and (claim := job.claims.take(clip.name)) is not None:
                track_claimed(job, clip, claim)
        if any(job.is_left(clip) for clip in left):
            time.sleep(_POLL_S)  # others have what is left; one of them may die


class TakenOver(Exception):
    """Somebody else has the clip now."""


class _Watch:
    """A sink that tells how far a clip is, and ends the tracking when somebody took over."""

    def __init__(self, claim: WorkClaim) -> None:
        self.claim, self.first, self.done = claim, 0, 0
        self.total: int | None = None

    def progress(self) -> str:
        """For the table of states."""
        return f"{self.done} frames" if not self.total else f"{100 * self.done // self.total} %"

    def add(self, frame: Posterior, picture: Picture) -> None:
        """Before this frame is in a checkpoint, see that the claim holds."""
        self.done = frame.frame.index + 1 - self.first
        if not self.claim.holds:
            raise TakenOver

    def close(self) -> None:
        """Nothing is open."""


def track_claimed(job: Job, clip: Clip, claim: WorkClaim) -> None:
    """Track a claimed clip and publish it, or say why it failed.

    Args:
        job: The batch.
        clip: A clip of it.
        claim: The claim to it, which is let go at the end.
    """
    place = job.out / ".batch" / "work" / clip.name / str(claim.generation)
    watch = _Watch(claim)
    try:
        if not job.is_left(clip):  # done just before it was claimed
            return
        with claim.alive(watch.progress):
            go_on_from(place)
            _refuse_deadly(place, job.claims, claim)
            with (
                (place / "log.txt").open("a", encoding="utf-8") as log,
                redirect_stdout(log),
                redirect_stderr(log),
            ):
                try:
                    _track_into(place, job, clip, watch)
                except Exception:
                    traceback.print_exc()
                    raise
            if claim.holds:
                if job.settings.overlay:
                    # Drawing figures takes long to import; who has made the page has done so.
                    from torchcss.show.report import tell_new_place

                    tell_new_place(place, job.out / clip.name)
                _publish(place, job.out / clip.name)
    except TakenOver:
        return
    except Exception as error:
        if claim.holds:
            job.fail(clip, error)
    finally:
        if job.is_done(clip):
            shutil.rmtree(place.parent, ignore_errors=True)
        claim.release()


def _track_into(place: Path, job: Job, clip: Clip, watch: _Watch) -> None:
    row = clip.row
    begin, end = row.get("start", 0), row.get("stop")
    watch.first = begin
    watch.total = VideoReader(row["video"], start=begin, stop=end).num_selected
    own = {name: row[name] for name in SETTING_COLUMNS if name in row}
    options = {name: row[name] for name in (*OPTION_COLUMNS, "masks", "init") if name in row}
    track_video(
        row["video"],
        camera=row.get("camera"),
        keypoints=row.get("keypoints"),
        out=place,
        settings=settings_from_plain({**asdict(job.settings), **own}),
        start=begin,
        stop=end,
        options=TrackOptions(live=watch, claim=watch.claim, resume=True, **options),
    )


def go_on_from(place: Path) -> None:
    """Copy what the last claim has left; its owner may still write into its own folder.

    Args:
        place: Folder of this claim, which is made; the others lie beside it.
    """
    draft = place.with_name(f".{place.name}")
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    left = [folder for folder in place.parent.iterdir() if folder.name.isdigit()]
    for before in sorted(left, key=lambda folder: int(folder.name))[-1:]:
        # The checkpoint first: the track may be newer than that, but not older.
        for file in sorted(before.iterdir(), key=lambda file: file.name != CHECKPOINT_NAME):
            if not file.name.startswith("."):  # locks, and what is half written
                with suppress(FileNotFoundError):  # as its owner may remove it
                    shutil.copy2(file, draft / file.name)
    shutil.rmtree(place, ignore_errors=True)
    draft.rename(place)


def _refuse_deadly(place: Path, claims: Claims, claim: WorkClaim) -> None:
    """Raise where owner after owner died, and the checkpoint got no further.

    Whoever is asked to end, or fails the clip, lets it go, and the count begins anew.
    """
    done = _frames_in(place)
    for before in range(1, MOST_DEATHS + 1):
        generation = claim.generation - before
        seen = claims.sight(claim.name, generation)
        if seen is None or seen.released or _frames_in(place.with_name(f"{generation}")) != done:
            return
    raise TorchcssError(
        f"the process that tracked it died {MOST_DEATHS} times with {done} frames done (by a "
        "crash, or for want of memory); these are kept, --retry-failed tries again"
    )


def _frames_in(place: Path) -> int:
    checkpoint = read_checkpoint(place)
    return 0 if checkpoint is None else checkpoint.num_frames


def _publish(place: Path, out: Path) -> None:
    """Give the folder its final name; whoever comes second leaves it."""
    try:
        os.rename(place, out)
    except OSError as error:
        if not (out / TRACK_NAME).is_file():
            raise OutputError(f"{out}: is in the way of the result; move it") from error


def main(arguments: Sequence[str] | None = None) -> int:
    """One process of a batch, for `torchrun` and schedulers."""
    # Once all is written, a request to end changes nothing: the process is about to.
    atexit.register(signal.signal, signal.SIGTERM, signal.SIG_IGN)
    atexit.register(gc.freeze)  # the interpreter's end is five times as fast
    try:
        with ended_by_sigterm():
            tyro.cli(Batch, args=arguments, description=__doc__).run()
    except TorchcssError as error:
        print(f"torchcss: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 0
    return 0


if __name__ == "__main__":
    sys.exit(main())

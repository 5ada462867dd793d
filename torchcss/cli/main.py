"""The `torchcss` command: thin, every verb is a call that a user could write in Python.

| verb | does |
|---|---|
| `torchcss demo` | tracks a film of the package and prints the error against the truth |
| `torchcss init IMAGE` | fits a body to one picture with marked joints |
| `torchcss detect VIDEO` | finds the keypoints of a video |
| `torchcss track VIDEO` | tracks a body through a video |
| `torchcss undistort VIDEO` | makes straight pictures out of those of a fisheye lens |
| `torchcss batch MANIFEST` | tracks many clips, by several processes |
| `torchcss smooth TRACK` | makes one smooth trajectory of a track's modes |
| `torchcss export TRACK` | writes a track for another program |
| `torchcss view TRACK` | shows a track in space over its pictures (rerun) |
| `torchcss plot TRACK` | draws its modes, trajectories and uncertainties as PNG files |
| `torchcss report TRACK` | writes one page about it, `report.html`, as `track` does at its end |

Bad input ends with one line on standard error and exit status 2, a batch of which clips have failed
with 1, Ctrl-C with 130 and SIGTERM with 143, of a batch with 0, as schedulers expect. What was
tracked until then is on disk; `torchcss track ... --resume` goes on.
"""

from __future__ import annotations

import atexit
import gc
import io
import sys
from pathlib import Path

import tyro

from torchcss.app.batch import Batch
from torchcss.app.recorder import Terminated
from torchcss.cli.detect import Detect
from torchcss.cli.export import Export
from torchcss.cli.init import Init
from torchcss.cli.options import SettingsOptions, Terminal, TerminalOptions, first_look
from torchcss.cli.smooth import Smooth
from torchcss.cli.track import Track
from torchcss.cli.undistort import Undistort
from torchcss.cli.view import Plot, Report, View
from torchcss.errors import TorchcssError
from torchcss.files import one_line
from torchcss.studies.demo import DEMO_SETTINGS, run_demo
from torchcss.types import frozen


@frozen
class Demo:
    """Track an arm that moves in depth before clutter, and compare with the truth."""

    out: Path = Path("out/demo")
    """Folder for track.npz, summary.json, overlay.mp4 and report.html."""
    frames: int = 50
    """Frames to track, of 50, 25 per second."""
    settings: SettingsOptions = DEMO_SETTINGS
    terminal: TerminalOptions = Terminal()

    def run(self) -> None:
        """Run the verb."""
        with self.terminal.working():
            summary = run_demo(self.out, settings=self.settings, num_frames=self.frames)
        self.terminal.tell(
            self.out,
            f"{summary['num_frames']} frames, {summary['seconds_per_frame']:.2f} s each\n"
            f"mean error of the best mode   {summary['mpjpe_mm']:6.1f} mm\n"
            f"mean error, best of the modes {summary['mpjpe_best_of_modes_mm']:6.1f} mm\n"
            f"look at {first_look(self.out, self.settings)}",
        )


Verb = Demo | Init | Detect | Undistort | Track | Batch | Smooth | Export | View | Plot | Report

_DESCRIPTION = """Tracks a body with joints through a video, and keeps the poses that explain it.

`torchcss track VIDEO` needs nothing but a video once `torchcss detect --download-model` has fetched
a detector of people; `torchcss track --help` tells what else it takes.
Bad input ends with one line on standard error and exit status 2, a batch of which clips have failed
with 1. What was tracked before an interruption is on disk: `torchcss track ... --resume` goes on.
"""

_LEFT = {
    Demo: "; the frames tracked so far are on disk",
    Track: "; the frames tracked so far are on disk, and --resume goes on with them",
    Batch: "; what was tracked so far is on disk, and the same command goes on with it",
}
"""What an interruption leaves of the verbs that track."""

_OLD_NAMES = {
    "--joints": "--keypoints",
    "--evidence": "--likelihood-power",
    "--focal-px": "--focal",
    "--field-of-view": "--fov",
    "--agility": "--acceleration-ratio",
    "--no-colours": "--colours=False",
}
"""Options of version 0.1 that are written otherwise now; not in the help."""

_OF_NO_USE = ("--no-recovery",)
"""Options of version 0.1 that say what is so anyway."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: What follows `torchcss`; the process's own arguments by default.

    Returns:
        The exit status.
    """
    atexit.register(gc.freeze)  # the interpreter's end is five times as fast
    if isinstance(sys.stdout, io.TextIOWrapper):  # names may have signs that a terminal has not
        sys.stdout.reconfigure(errors="backslashreplace")
    words = sys.argv[1:] if arguments is None else arguments
    options = [word.partition("=") for word in words if word not in _OF_NO_USE]
    words = ["".join((_OLD_NAMES.get(name, name), *value)) for name, *value in options]
    verb = None
    try:
        # Settings check themselves, so that reading them may fail as well.
        verb = tyro.cli(Verb, prog="torchcss", args=words, description=_DESCRIPTION)  # type: ignore[arg-type]
        left = verb.run()
    except (TorchcssError, OSError) as error:  # the latter of a disk that fills up in mid-write
        print(f"torchcss: {error}", file=sys.stderr)
        return 2
    except (MemoryError, RuntimeError) as error:  # the latter is torch's
        if not isinstance(error, MemoryError) and "memory" not in str(error):
            raise
        told = f"memory is short, ask for less ({one_line(error)}){_LEFT.get(type(verb), '')}"
        print(f"torchcss: {told}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interruption:
        print(f"torchcss: interrupted{_LEFT.get(type(verb), '')}", file=sys.stderr)
        if not isinstance(interruption, Terminated):
            return 130
        return 0 if isinstance(verb, Batch) else 143
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())

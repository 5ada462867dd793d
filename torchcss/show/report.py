"""The report of a run: one page, `report.html`, that opens in any browser and needs no network.

It holds the film with the modes drawn over it, the figures of `torchcss.show.track_plots` and
`posterior_plots` that a user wants first, what was known and what was assumed, and the commands
that go on from there. Names and notes come from the files of strangers: all text is escaped.
"""

from __future__ import annotations

import base64
import math
import shlex
from collections.abc import Iterable, Sequence
from html import escape
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from torchcss.errors import VideoError
from torchcss.files import write_text
from torchcss.io.run import Run
from torchcss.io.tracks import SUMMARY_NAME, TRACK_NAME
from torchcss.io.video import VideoWriter
from torchcss.show.posterior_plots import angles_figure
from torchcss.show.track_pictures import has_pictures, known_video, pictures_of, without_pictures
from torchcss.show.track_plots import (
    check_not_empty,
    modes_figure,
    most_open_frame,
    side_view_figure,
)
from torchcss.tracking.presets import OLD_NAMES, PRESETS, Preset
from torchcss.types import Status

REPORT_NAME = "report.html"

MOST_PICTURES = 450
"""Frames of the film in the page; of longer ones every second, third and so on is shown."""

LONGER_SIDE = 640
"""Pixels to which the film's pictures are reduced. With `MOST_PICTURES`: a few megabytes."""

_CRF = 28

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 62rem;
  margin: 0 auto; padding: 1rem; }}
h1 {{ font-size: 1.5rem; margin: 0 0 .3rem; overflow-wrap: anywhere; }}
h2 {{ font-size: 1.15rem; margin: 2rem 0 .4rem; border-bottom: 1px solid #ddd; }}
p {{ margin: .4rem 0; }}
video {{ display: block; max-width: 100%; max-height: 80vh; margin: 0 auto; background: #111; }}
.figure {{ overflow-x: auto; }}
.figure img {{ display: block; width: 100%; min-width: 40rem; }}
table {{ border-collapse: collapse; width: 100%; }}
th, td {{ text-align: left; vertical-align: top; padding: .25rem .8rem .25rem 0;
  overflow-wrap: anywhere; }}
th {{ font-weight: 600; white-space: nowrap; }}
li {{ overflow-wrap: anywhere; }}
pre {{ background: #f4f4f4; padding: .7rem; overflow-x: auto; font-size: .85rem; }}
</style></head><body>
<h1>{title}</h1>
{body}
</body></html>
"""


def write_report_page(run: Run, *, anew: bool = False) -> Path:
    """Write `report.html` into the folder of a run; of a smoothed track, `smooth_report.html`.

    Args:
        run: The run.
        anew: Whether to draw over the video even where the tracker left an overlay.

    Returns:
        The file.

    Raises:
        TorchcssError: If the track has no frames, its body is not known, a picture cannot be read,
            or the file cannot be written.
    """
    track = run.track._replace(body=run.body)
    check_not_empty(track)
    sections = (
        ("Film", _film(run, anew=anew)),
        (
            "The modes from the side",
            "<p>The frame whose weight is spread over most modes. Where the lines part, one camera "
            "cannot tell which pose it was.</p>"
            + _image(
                side_view_figure(track, most_open_frame(track), camera=track.first_camera),
                "the modes from the side",
            ),
        ),
        ("Weights over time", _image(modes_figure(track, run.summary), "weights over time")),
        ("Joint angles", _image(angles_figure(track), "joint angles with bands")),
        ("What was tracked", _table(_facts(run))),
        ("Cameras", _table(_cameras(run))),
        ("What was read, assumed and fitted", _list(run.summary.get("notes", ()))),
        ("How to go on", f"<pre>{escape(_commands(run))}</pre>"),
    )
    body = "\n".join(f"<h2>{name}</h2>\n{content}" for name, content in sections)
    name = REPORT_NAME if run.path.name == TRACK_NAME else f"{run.path.stem}_{REPORT_NAME}"
    write_text(run.folder / name, _PAGE.format(title=_title(run.folder), body=body))
    return run.folder / name


def tell_new_place(folder: Path, place: Path) -> None:
    """Let the page of a run say where its folder will be, before that is moved.

    Args:
        folder: Where it is; it may have no page.
        place: Where it will be.

    Raises:
        OutputError: If the page cannot be written.
    """
    page = folder / REPORT_NAME
    if not page.is_file():
        return
    text = page.read_text(encoding="utf-8")
    for told in (_title, lambda where: escape(_quoted(where)), lambda where: escape(str(where))):
        text = text.replace(told(folder.resolve()), told(place.resolve()))
    write_text(page, text)


def _title(folder: Path) -> str:
    return escape(f"torchcss: {folder.resolve().name}")


def _quoted(path: Path) -> str:
    """A path as a shell takes it."""
    return shlex.quote(str(path.resolve()))


def _film(run: Run, *, anew: bool) -> str:
    """The film, small enough to lie in the page."""
    if not has_pictures(run):
        return "<p>The video is not where it was; say where with <code>--video</code>.</p>"
    count = len(run.track.frames)
    rows = range(0, count, math.ceil(count / MOST_PICTURES))
    times = run.track.times[rows]
    span = float(times[-1] - times[0])
    rate = (len(rows) - 1) / span if span > 0 else 1.0
    still, missing = BytesIO(), None if known_video(run) else without_pictures(run)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        with VideoWriter(path, rate, crf=_CRF) as film:
            try:
                for row, image in pictures_of(run, rows, anew=anew):
                    picture = Image.fromarray(image)
                    picture.thumbnail((LONGER_SIDE, LONGER_SIDE))
                    film.write(np.asarray(picture), run.track.times[row] - times[0])
                    if not still.tell():
                        picture.save(still, "JPEG")
            except VideoError as error:
                # A film that ends before a track that went on is worth showing.
                if anew or not still.tell():
                    raise
                missing = str(error)
        data = _data("video/mp4", path.read_bytes())
    return (
        f'<video controls loop muted playsinline poster="{_data("image/jpeg", still.getvalue())}" '
        f'src="{data}"></video>'
        "<p>Filled: the best mode. Outlines: the other modes, fainter the less they weigh.</p>"
        + (f"<p>It ends before the track: {escape(missing)} (--video).</p>" if missing else "")
    )


def _image(figure: Figure, text: str) -> str:
    """A figure as a picture in the page."""
    stream = BytesIO()
    figure.savefig(stream, dpi=110)
    data = _data("image/png", stream.getvalue())
    return f'<div class="figure"><img alt="{text}" src="{data}"></div>'


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _table(rows: Iterable[tuple[str, str]]) -> str:
    lines = (f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in rows)
    return f"<table>{''.join(lines)}</table>"


def _list(lines: Sequence[Any]) -> str:
    items = "".join(f"<li>{escape(str(line))}</li>" for line in lines)
    return f"<ul>{items}</ul>" if items else "<p>Nothing is noted.</p>"


def _facts(run: Run) -> list[tuple[str, str]]:
    """What was tracked how, as far as the run says."""
    track, summary, settings = run.track, run.summary, run.settings
    span = f"{track.frames[0]} to {track.frames[-1]}, {track.times[-1] - track.times[0]:.2f} s"
    files = track.first_files
    facts = [
        ("Video", str(files.video) if files else "not known"),
        (
            "Frames",
            f"{len(track.frames)} ({span}), {summary.get('ended', 'not known whether all')}"
            + _disagreement(run),
        ),
        ("Told lost", _losses(run)),
        ("Body", f"{settings.get('body', run.body.name)}, {track.state.shape[2]} parameters"),
        ("Keypoints", _keypoints(run)),
        ("Preset", _preset(run)),
    ]
    if descents := _descents(run):
        facts.append(("Descents", descents))
    if "l_knee" in track.joint_names:
        stature, ground = settings.get("stature"), settings.get("ground")
        told = f"{stature:g} m, as given" if stature else "not given; the size is known otherwise"
        if track.size_deviation:
            doubt = f"known to {100 * track.size_deviation:.0f} %"
            told = f"not given; it would set the size ({doubt}): --stature METRES, or --ground"
            if ground is not None:
                told = f"not given; the floor at {ground:g} m tells the size ({doubt})"
        facts.append(("Stature", told))
        facts.append(("Followed", f"--person {files.person}" if files else "not known"))
    return facts


def _disagreement(run: Run) -> str:
    """What to say where the summary is of more or fewer frames than the track."""
    told = run.summary.get("num_frames", len(run.track.frames))
    if told == len(run.track.frames):
        return ""
    return f"; {SUMMARY_NAME} is of another moment of the run, when there were {told}"


def _row(run: Run) -> Preset | None:
    """The preset that was run; None: not known."""
    name = run.settings.get("preset", "")
    return PRESETS.get(OLD_NAMES.get(name, name))


def _preset(run: Run) -> str:
    """Which tracker it was, and with which numbers."""
    row, summary = _row(run), run.summary
    name = str(run.settings.get("preset", "not known"))
    parts = [name if row is None else f"{name}: {row.what}"]
    if "samples" in summary and "modes" in summary:
        parts.append(f"at most {summary['samples']} samples a frame and {summary['modes']} modes")
    if changed := summary.get("changed_beside_preset"):
        parts.append("changed beside it: " + ", ".join(map(str, changed)))
    return "; ".join(parts)


_ENDS = {
    Status.CONVERGED: "converged",
    Status.SMALL_STEP: "ended where no short step led lower",
    Status.STEP_LIMIT: "stopped at the step limit",
    Status.NON_FINITE: "had no finite cost",
}


def _descents(run: Run) -> str:
    """How descents ended, and how many covariances needed a floor; of filters nothing."""
    ended = run.summary.get("optimiser_status", {})
    counts = {words: ended.get(status.name.lower(), 0) for status, words in _ENDS.items()}
    parts = [f"{count} {words}" for words, count in counts.items() if count]
    if not any(list(counts.values())[:-1]):
        return ""
    if floored := run.summary.get("covariances_floored"):
        parts.append(f"{floored} covariances had a least curvature put in")
    return ", ".join(parts)


def _keypoints(run: Run) -> str:
    """Where the keypoints are from, and whether they counted in all frames."""
    files = run.track.first_files
    if not (files and files.keypoints):
        return "not known"
    row, use = _row(run), run.settings.get("keypoints_use")
    use = row.keypoints_use if use is None and row is not None else use
    return f"{files.keypoints}{', in the first frame alone' * (use == 'first')}"


def _losses(run: Run) -> str:
    """How often the track was told lost."""
    lost = sum(event["event"] == "lost" for event in run.summary.get("events", ()))
    return f"{lost} time{'' if lost == 1 else 's'}"


def _cameras(run: Run) -> list[tuple[str, str]]:
    """What the cameras are, a line each."""
    rows = []
    for camera, _, deviation in run.cameras:
        width, height = camera.image_size_wh
        focal = float(camera.K[0, 0])
        side = int(height > width)
        half = 0.5 * camera.image_size_wh[side] / float(camera.K[side, side])
        angle = 2 * math.degrees(math.atan(half))
        doubt = f", known to {100 * deviation:.0f} %" if deviation else ""
        rows.append(
            (
                camera.name,
                f"{width} x {height} pixels, focal length {focal:.0f} pixels ({angle:.0f} degrees "
                f"along the longer side){doubt}",
            )
        )
    if run.summary.get("world_is_metric") is False:
        rows.append(("World", "the first camera's own frame: its axes, not those of the room"))
    return rows


def _commands(run: Run) -> str:
    """The commands that go on from this run."""
    path = run.folder if run.path.name == TRACK_NAME else run.path
    where = _quoted(path)
    lines = (
        ("smooth", "", "one smooth trajectory through the modes"),
        ("export", " --to bvh", "for Blender; trc, mot: OpenSim; csv, npz: with covariances"),
        ("plot", "", "all figures, as files"),
        ("view", "", "in space, over the pictures"),
    )
    lines = lines if run.path.name == TRACK_NAME else lines[1:]
    return "\n".join(f"torchcss {verb} {where}{more}   # {what}" for verb, more, what in lines)

"""Every writer leaves a good file or none: a full disk and a killed process cost no older file."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from made_clip import grey_film
from made_processes import begin
from made_tracks import export_as, make_track
from matplotlib.figure import Figure

import torchcss.files
from torchcss.app.smooth import smooth
from torchcss.body.load import load_body
from torchcss.errors import OutputError, TorchcssError
from torchcss.inference.mixture import GaussianMixture
from torchcss.initialise.result import Initialisation
from torchcss.io.fitted_body import write_fitted_body
from torchcss.io.tracks import FrameModes, Track, TrackWriter, load_track, save_track, write_summary
from torchcss.io.video import VideoReader
from torchcss.show.click import write_clicked
from torchcss.show.style import save_figure
from torchcss.studies.sequence_writer import write_sequence
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera

BODY = load_body("arm7", free_root=True)


def track(path: Path) -> None:
    made = make_track(BODY, (1, 1, 1))
    writer = TrackWriter(path, Track.empty(made.state_names, made.joint_names))
    for t in range(3):
        fields = ("state", "covariance", "log_weight", "cost", "parent", "joints_world")
        values = {name: getattr(made, name)[t] for name in fields}
        writer.append(FrameModes(frame=t, time_s=t / 25, **values))
    writer.save()


def summary(path: Path) -> None:
    write_summary(path, {"a": list(range(100))})


def fitted_body(path: Path) -> None:
    x = BODY.rest[None]
    spread = torch.eye(BODY.num_parameters).double()[None]
    mixture = GaussianMixture(x, spread, torch.zeros(1).double())
    found = Initialisation(BODY, mixture, torch.zeros(1).double(), (), dict(BODY.lengths))
    write_fitted_body(path, found, Camera.pinhole(64, 48, focal_px=60.0))


def film(path: Path) -> None:
    grey_film(path, (0, 100, 200))


def clicked(path: Path) -> None:
    places = torch.tensor([[3.0, 4.0]], dtype=torch.float64)
    write_clicked(path, Keypoints(places, torch.ones(1), ("l_wrist",)), (64, 48))


def figure(path: Path) -> None:
    save_figure(Figure(), path)


def exported(kind: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        export_as(make_track(BODY, (1, 1, 1)), to=kind, out=path)

    write.__name__ = kind
    return write


WRITERS = {
    "track.npz": track,
    "summary.json": summary,
    "body.npz": fitted_body,
    "film.mp4": film,
    "clicked.json": clicked,
    "figure.png": figure,
    **{f"a.{kind}": exported(kind) for kind in ("bvh", "trc", "mot", "csv", "npz")},
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_a_disk_that_refuses_costs_no_file(
    name: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / name
    WRITERS[name](path)
    before = path.read_bytes()
    assert before

    def refuse(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    # Once when the data are to be kept on the disk, once when the file gets its name.
    for module, function in ((torchcss.files.os, "fsync"), (torchcss.files.os, "replace")):
        with monkeypatch.context() as context:
            context.setattr(module, function, refuse)
            if name == "film.mp4" and function == "fsync":
                continue
            with pytest.raises(OutputError) as caught:
                WRITERS[name](path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
        assert path.read_bytes() == before
        assert not list(tmp_path.glob("*.partial*")) + list(tmp_path.glob(".*partial*"))
    (tmp_path / "new").mkdir()
    with monkeypatch.context() as context:
        context.setattr(torchcss.files.os, "replace", refuse)
        with pytest.raises(OutputError):
            WRITERS[name](tmp_path / "new" / name)
    assert not list((tmp_path / "new").iterdir())


ELSEWHERE = """
import resource, signal, sys
sys.path[:0] = sys.argv[2:]
import test_files as tests
from pathlib import Path
from torchcss.errors import OutputError
folder = Path(sys.argv[1])
names = [name for name in tests.WRITERS if name != "film.mp4"]
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
_, most = resource.getrlimit(resource.RLIMIT_FSIZE)
# The system itself refuses after 40 bytes, as a quota does, in whatever writes.
resource.setrlimit(resource.RLIMIT_FSIZE, (40, most))
written = []
for name in names:
    try:
        tests.WRITERS[name](folder / name)
        written.append(name)
    except OutputError:
        pass
resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
tell(written)
hear()
tell("writing")
while True:
    for name in tests.WRITERS:
        tests.WRITERS[name](folder / name)
"""


def test_a_full_disk_and_a_killed_process_cost_no_file(tmp_path: Path) -> None:
    for name, write in WRITERS.items():
        write(tmp_path / name)
    before = {name: (tmp_path / name).read_bytes() for name in WRITERS}
    here = Path(__file__).resolve()
    paths = [str(path) for path in (here.parent, here.parents[1], here.parents[1] / "scripts")]
    begun = begin(ELSEWHERE, str(tmp_path), *paths)
    assert begun.told.recv() == [], "written in spite of the limit"
    assert {name: (tmp_path / name).read_bytes() for name in WRITERS} == before
    begun.told.send("go")
    assert begun.told.recv() == "writing"
    time.sleep(0.3)
    begun.process.kill()
    begun.end()
    # Whatever was under way: every file is whole, the older one or the newer.
    sizes = {name: len(content) for name, content in before.items()}
    assert {name: (tmp_path / name).stat().st_size for name in WRITERS} == sizes
    assert len(load_track(tmp_path / "track.npz").frames) == 3
    assert len(list(VideoReader(tmp_path / "film.mp4"))) == 3


def test_a_sequence_that_stops_leaves_the_older_one(tmp_path: Path) -> None:
    """Frame by frame for minutes: the files of the folder are replaced at the end of each."""

    class Shot:
        """Two frames, then whatever stops it."""

        name, frame_rate, seed, description = "shot", 25.0, 0, ""
        camera = Camera.pinhole(64, 48, focal_px=60.0)
        states = torch.zeros(3, 7)

        def frames(self):
            raise KeyboardInterrupt
            yield

    names = ("flow.npz", "mask.npz", "truth.npz", "video.mp4", "cameras.json")
    for name in names:
        (tmp_path / name).write_text(f"the older {name}")
    with pytest.raises(KeyboardInterrupt):
        write_sequence(tmp_path, Shot())  # type: ignore[arg-type]
    assert {name: (tmp_path / name).read_text() for name in names} == {
        name: f"the older {name}" for name in names
    }
    assert sorted(entry.name for entry in tmp_path.iterdir()) == sorted(names)


def test_smoothing_that_fails_leaves_the_older_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_track(tmp_path / "track.npz", make_track(BODY, (2, 2, 2, 2)))
    smooth(tmp_path)
    before = (tmp_path / "smooth.npz").read_bytes()

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(torchcss.files.os, "replace", refuse)
    with pytest.raises(TorchcssError, match="disk is full"):
        smooth(tmp_path)
    assert (tmp_path / "smooth.npz").read_bytes() == before


def test_arrays_are_written_under_the_name_that_was_asked_for(tmp_path: Path) -> None:
    for name in ("a.npz", "b", "c.d"):
        torchcss.files.save_arrays(tmp_path / name, {"a": torch.ones(2)})
        assert list(torchcss.files.load_arrays(tmp_path / name, OutputError)) == ["a"]
    assert len(list(tmp_path.iterdir())) == 3


def test_names_that_are_not_utf_8_are_written_escaped(tmp_path: Path) -> None:
    torchcss.files.write_text(tmp_path / "a.html", "<p>\udcff.mp4</p>")
    assert (tmp_path / "a.html").read_text(encoding="utf-8") == "<p>\\udcff.mp4</p>"

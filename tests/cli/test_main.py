"""The command: one clear line and a status for every kind of bad input."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path

import numpy as np
import pytest
from made_clip import track
from made_processes import begin

from torchcss.app.recorder import Terminated
from torchcss.cli import main as cli


def spoil_camera(files: Path, **changes) -> None:
    content = json.loads((files / "cameras.json").read_text())
    content["cameras"]["one"].update(changes)
    (files / "cameras.json").write_text(json.dumps(content))


def spoil_keypoints(files: Path, **changes) -> None:
    arrays = dict(np.load(files / "keypoints.npz"))
    np.savez(files / "keypoints.npz", **{**arrays, **changes})


def test_good_files_track(files: Path, capsys: pytest.CaptureFixture[str]):
    assert track(files) == 0
    assert "3 frames" in capsys.readouterr().out
    made = (files / "out" / "track.npz").read_bytes()
    assert track(files) == 2
    assert "holds a run: --resume" in capsys.readouterr().err
    assert (files / "out" / "track.npz").read_bytes() == made
    assert track(files, "--resume", "--no-overlay") == 0
    assert track(files, "--overwrite", "--no-overlay") == 0


def test_for_programs_and_in_silence(files: Path, capfd: pytest.CaptureFixture[str]):
    assert track(files, "--json", "--smooth") == 0
    told = capfd.readouterr()
    found = json.loads(told.out)
    assert found["summary"] == json.loads((files / "out" / "summary.json").read_text())
    assert found["summary"]["num_frames"] == 3
    assert set(found["files"]) >= {"track.npz", "smooth.npz", "overlay.mp4", "report.html"}
    assert all(Path(path).is_file() for path in found["files"].values())
    steps = ("finding the first pose", "tracking", "drawing overlay and report")
    assert sorted(steps, key=told.err.index) == list(steps)
    assert track(files, "--quiet", "--no-overlay", "--overwrite") == 0
    assert capfd.readouterr() == ("", "")
    (files / "video.mp4").unlink()
    assert track(files, "--quiet", "--json", "--overwrite") == 2
    told = capfd.readouterr()
    assert (told.out, told.err.count("\n")) == ("", 1)


SPOILED = {
    "missing video": lambda f: (f / "video.mp4").unlink(),
    "empty video": lambda f: (f / "video.mp4").write_bytes(b""),
    "not a video": lambda f: (f / "video.mp4").write_bytes(b"hello" * 100),
    "truncated video": lambda f: (f / "video.mp4").write_bytes(
        (f / "video.mp4").read_bytes()[:300]
    ),
    "missing camera": lambda f: (f / "cameras.json").unlink(),
    "camera of another size": lambda f: spoil_camera(f, image_size_wh=[128, 96]),
    "camera with NaN": lambda f: spoil_camera(f, t=[0, 0, float("nan")]),
    "missing keypoints": lambda f: (f / "keypoints.npz").unlink(),
    "another number of frames": lambda f: spoil_keypoints(
        f, keypoints=np.ones((7, 4, 2)), confidence=np.ones((7, 4))
    ),
    "unknown layout": lambda f: spoil_keypoints(f, joint_names=np.array(list("abcd"))),
    "nobody in the first frame": lambda f: spoil_keypoints(
        f, confidence=np.array([[0.0] * 4, [1] * 4, [1] * 4])
    ),
    "normalised coordinates": lambda f: spoil_keypoints(
        f, keypoints=np.load(f / "keypoints.npz")["keypoints"] / 64
    ),
    "NaN keypoint": lambda f: spoil_keypoints(f, keypoints=np.full((3, 4, 2), np.nan)),
    "too few joints": lambda f: spoil_keypoints(
        f, confidence=np.tile([1.0, 1.0, 0.0, 0.0], (3, 1))
    ),
    "keypoints of no noise": lambda f: spoil_keypoints(f, relative_noise=1e-300),
    "keypoints of any noise": lambda f: spoil_keypoints(f, relative_noise=1e300),
    "camera of no angle": lambda f: spoil_camera(f, K=[[1e308, 0, 31], [0, 1e308, 23], [0, 0, 1]]),
    "names in Latin-1": lambda f: spoil_keypoints(
        f, joint_names=np.array([b"\xff", b"\xfe", b"a", b"b"])
    ),
    "out is a file": lambda f: (f / "out").write_text("in the way"),
}


@pytest.mark.parametrize("what", SPOILED)
def test_one_clear_line(files: Path, what: str, capsys: pytest.CaptureFixture[str]):
    SPOILED[what](files)
    assert track(files) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    ours = [line for line in lines if line.startswith("torchcss: ")]
    assert len(ours) == 1
    assert lines[-1] == ours[0]
    assert len(ours[0]) > 30


@pytest.mark.parametrize(
    "options",
    [
        ("--start", "9"),
        ("--stride", "0"),
        ("--resume", "--overwrite"),
        ("--body", "octopus"),
        ("--preset", "magic"),
        ("--camera-name", "two"),
        ("--layout", "BODY_99"),
        ("--device", "cuda:99"),
        ("--terms", "contour", "magic"),
    ],
)
def test_bad_options(files: Path, options: tuple[str, ...], capsys: pytest.CaptureFixture[str]):
    assert track(files, *options) == 2
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith("torchcss: ")


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")]
)
def test_memory_that_is_short_is_told(
    files: Path,
    error: Exception,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(cli.Track, "run", fail)
    assert track(files, "--samples", str(10**12)) == 2
    told = capsys.readouterr().err
    assert told.startswith("torchcss: memory is short, ask for less (")
    assert told.endswith(cli._LEFT[cli.Track] + "\n")


def test_start_is_checked_before_the_offset(files: Path, capsys: pytest.CaptureFixture[str]):
    assert track(files, "--start", "-1") == 2
    assert "start must be at least 0, got -1" in capsys.readouterr().err


def test_the_advice_about_fractions_can_be_followed(
    files: Path, capsys: pytest.CaptureFixture[str]
):
    for kind in ("zero-one", "plus-minus-one"):
        assert track(files, "--normalised", kind) == 2
        assert "expected fractions of the image" in capsys.readouterr().err
    points = np.load(files / "keypoints.npz")["keypoints"]
    spoil_keypoints(files, keypoints=points / (63, 47))
    assert track(files) == 2
    assert "say --normalised zero-one" in capsys.readouterr().err


def test_what_is_read_is_not_replaced(files: Path, capsys: pytest.CaptureFixture[str]):
    (files / "out").mkdir()
    film = files / "out" / "overlay.mp4"
    film.write_bytes((files / "video.mp4").read_bytes())
    assert track(files, "--masks", str(film)) == 2
    assert f"{film}: a run in this folder replaces it" in capsys.readouterr().err
    assert film.read_bytes() == (files / "video.mp4").read_bytes()


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write everywhere")
def test_unwritable_folder(files: Path, capsys: pytest.CaptureFixture[str]):
    files.chmod(0o500)
    try:
        assert track(files) == 2
    finally:
        files.chmod(0o700)
    assert "torchcss: " in capsys.readouterr().err


def test_interrupt_has_its_own_status(files: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchcss.cli.track.track_video", interrupted)
    assert track(files) == 130


@pytest.mark.parametrize(("verb", "status"), [("track", 143), ("batch", 0)])
def test_a_request_to_end_has_its_own_status(
    verb: str, status: int, monkeypatch: pytest.MonkeyPatch
):
    def ended(_verb: object) -> None:
        raise Terminated

    monkeypatch.setattr({"track": cli.Track, "batch": cli.Batch}[verb], "run", ended)
    assert cli.main([verb, "a"]) == status


@pytest.mark.parametrize("program", ["torchcss.cli.main", "torchcss.app.batch"])
def test_the_end_of_the_process_counts_no_references(program: str):
    """Which took most of a second of the ten that a scheduler leaves."""
    begun = begin(
        "import atexit, gc, importlib, sys\n"
        "try:\n    importlib.import_module(sys.argv[1]).main(['--help'])\n"
        "except SystemExit:\n    atexit._run_exitfuncs(); tell(gc.get_freeze_count())\n",
        program,
    )
    assert begun.told.recv() > 0
    begun.end()


@pytest.mark.parametrize(
    ("verb", "told"),
    [
        (cli.Track, "; the frames tracked so far are on disk, and --resume goes on with them"),
        (cli.Batch, "; what was tracked so far is on disk, and the same command goes on with it"),
        (cli.Export, ""),
        (cli.Plot, ""),
        (cli.Detect, ""),
        (cli.Undistort, ""),
    ],
)
def test_an_interruption_tells_what_is_left(
    verb: type, told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def interrupted(_verb: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(verb, "run", interrupted)
    more = {cli.Export: ["--to", "bvh"], cli.Undistort: ["--camera", "b"]}.get(verb, [])
    assert cli.main([verb.__name__.lower(), "a", *more]) == 130
    assert capsys.readouterr().err == f"torchcss: interrupted{told}\n"


def test_signs_that_a_terminal_has_not_are_escaped(monkeypatch: pytest.MonkeyPatch):
    stdout = io.TextIOWrapper(io.BytesIO(), encoding="cp1252")
    monkeypatch.setattr(cli.Plot, "run", lambda _: print("\u8996\udcff"))
    monkeypatch.setattr("sys.stdout", stdout)
    assert cli.main(["plot", "a"]) == 0
    stdout.flush()
    assert stdout.buffer.getvalue().strip() == rb"\u8996\udcff"


@pytest.mark.parametrize("verb", ["demo", "track"])
def test_help(verb: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        cli.main([verb, "--help"])
    assert ended.value.code == 0
    assert "--seed" in capsys.readouterr().out


def test_a_demo_tells_of_a_file_that_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    options = ("--frames", "1", "--samples", "4", "--no-overlay")
    assert cli.main(["demo", "--out", str(tmp_path / "out"), *options]) == 0
    told = capsys.readouterr().out.split("look at ")[1].strip()
    assert Path(told).is_file()


@pytest.mark.parametrize("option", [("--evidence", "0.3"), ("--evidence=0.3",)])
def test_options_of_version_0_1_are_understood(files: Path, option: tuple[str, ...]):
    assert track(files, "--no-overlay", "--no-recovery", *option) == 0
    settings = json.loads((files / "out" / "summary.json").read_text())["settings"]
    assert settings["likelihood_power"] == 0.3


def test_a_batch_of_which_a_clip_fails_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "clips.csv").write_text("video\nnone.mp4\n")
    arguments = ["batch", str(tmp_path / "clips.csv"), "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 1
    assert "1 failed; see" in capsys.readouterr().out

"""Interrupted at any moment and gone on with, a run ends as if it had never been interrupted."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_processes import begin
from made_sequences import write_arm
from PIL import Image

from torchcss.app.claims import Claims
from torchcss.app.lock import LOCK_NAME
from torchcss.app.recorder import Picture, Terminated, ended_by_sigterm
from torchcss.app.track import TrackOptions, resume, track_video
from torchcss.cli import main as cli
from torchcss.errors import ConfigurationError, OutputError, TrackFileError
from torchcss.io.run import Run
from torchcss.io.video import VideoReader
from torchcss.io.view_files import ViewFiles
from torchcss.tracking.session import Posterior
from torchcss.tracking.settings import Settings

SETTINGS = Settings(
    body="arm8", samples=4, modes=2, working_size=160, prediction="surface", limb_jumps=1,
    overlay=False,
)  # fmt: skip
FILMED = replace(SETTINGS, overlay=True)
FRAMES = 8
WALL_TIMES = {
    *("seconds_per_frame", "seconds_per_frame_by_stage", "share_of_search_time_by_term"),
}


class Stumbling:
    """A sink that ends the run at a frame."""

    def __init__(self, at: int, trouble: BaseException) -> None:
        self._at, self._trouble = at, trouble

    def add(self, frame: Posterior, picture: Picture) -> None:
        if frame.frame.index == self._at:
            raise self._trouble

    def close(self) -> None:
        pass


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clip, and in `first` a first pose for all who do not ask how one is found."""
    folder = tmp_path_factory.mktemp("clip")
    write_arm(folder, FRAMES)
    few = replace(SETTINGS, samples=1, modes=1, terms=("joints",))
    track_video(
        folder / "video.mp4", camera=folder / "cameras.json",
        keypoints=folder / "keypoints2d.npz", out=folder / "first", settings=few, stop=1,
    )  # fmt: skip
    return folder


def follow(clip: Path, out: Path, settings: Settings = SETTINGS, **options: Any) -> Run:
    return track_video(
        clip / "video.mp4",
        camera=clip / "cameras.json",
        keypoints=clip / "keypoints2d.npz",
        out=out,
        settings=settings,
        options=TrackOptions(**{"init": clip / "first" / "body.npz", **options}),
    )


@pytest.fixture(scope="module")
def whole(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run that nobody interrupted."""
    return follow(clip, tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def filmed(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The same all by itself: with the search for a first pose, film and report."""
    return follow(clip, tmp_path_factory.mktemp("filmed"), FILMED, init=None)


def assert_same_run(one: Path, other: Path) -> None:
    """The same files, wall times apart."""
    assert {p.name for p in one.iterdir()} == {p.name for p in other.iterdir()}
    for film in one.glob("*.mp4"):
        assert film.read_bytes() == (other / film.name).read_bytes()
    for name in ("track.npz", "body.npz", "checkpoint.npz"):
        ours, theirs = (np.load(folder / name) for folder in (one, other))
        assert set(ours.files) == set(theirs.files)
        for key in ours.files:
            if (name, key) != ("checkpoint.npz", "notes"):
                np.testing.assert_array_equal(ours[key], theirs[key], err_msg=f"{name}: {key}")
    summaries = [json.loads((folder / "summary.json").read_text()) for folder in (one, other)]
    for summary in summaries:
        assert summary["ended"] == "complete"
        for name in WALL_TIMES:
            del summary[name]
    assert summaries[0] == summaries[1]


def test_an_interrupted_run_goes_on(clip: Path, whole: Run, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        follow(clip, tmp_path, live=Stumbling(4, KeyboardInterrupt()))
    assert Run.open(tmp_path).summary["ended"] == "interrupted"
    run = follow(clip, tmp_path, resume=True)
    assert len(run.track.frames) == FRAMES
    assert_same_run(whole.folder, tmp_path)


def test_a_run_interrupted_in_its_first_frame_goes_on(
    clip: Path, filmed: Run, tmp_path: Path
) -> None:
    stumbling = Stumbling(0, OutputError("disk full"))
    with pytest.raises(OutputError):
        follow(clip, tmp_path, FILMED, init=None, live=stumbling)
    assert Run.open(tmp_path).summary["ended"] == "interrupted"
    follow(clip, tmp_path, FILMED, init=None, resume=True)
    assert_same_run(filmed.folder, tmp_path)


def test_frames_after_the_last_checkpoint_are_tracked_again(
    clip: Path, whole: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A track may be ahead of its checkpoint, where the disk was full in between."""
    write = torchcss_recorder().write_checkpoint

    def refusing(folder: Path, checkpoint: Any) -> None:
        if checkpoint.num_frames > 3:
            raise OutputError("disk full")
        write(folder, checkpoint)

    monkeypatch.setattr("torchcss.app.recorder.write_checkpoint", refusing)
    with pytest.raises(OutputError):
        follow(clip, tmp_path, checkpoint_every=0)
    monkeypatch.undo()
    left = Run.open(tmp_path)
    assert left.checkpoint is not None
    assert left.checkpoint.num_frames == 3
    assert len(left.track.frames) > 3
    follow(clip, tmp_path, resume=True)
    assert_same_run(whole.folder, tmp_path)


def torchcss_recorder() -> Any:
    return sys.modules["torchcss.app.recorder"]


def command(clip: Path, out: Path, *more: str) -> list[str]:
    return [
        *("track", str(clip / "video.mp4"), "--camera", str(clip / "cameras.json")),
        *("--keypoints", str(clip / "keypoints2d.npz"), "--out", str(out), "--body", "arm8"),
        *("--samples", "4", "--modes", "2", "--working-size", "160", "--prediction", "surface"),
        *("--limb-jumps", "1", *more),
    ]


WAYS = {
    signal.SIGTERM: ("--no-overlay", "--init", "first/body.npz"),
    # All by itself: with the first pose, the film and the report.
    signal.SIGKILL: (),
}


@pytest.mark.parametrize("kill", WAYS)
def test_a_killed_process_loses_nothing(
    clip: Path, whole: Run, filmed: Run, tmp_path: Path, kill: signal.Signals
) -> None:
    same = [str(clip / word) if "/" in word else word for word in WAYS[kill]]
    script = "import sys; from torchcss.cli.main import main; sys.exit(main(sys.argv[1:]))"
    process, _ = begun = begin(script, *command(clip, tmp_path, "--checkpoint-every", "0", *same))
    while not (tmp_path / "checkpoint.npz").exists() and process.is_alive():
        time.sleep(0.01)
    if process.is_alive():
        os.kill(process.pid or 0, kill)
    ended = begun.end()
    assert ended in ({-signal.SIGKILL} if kill is signal.SIGKILL else {143, 0})
    assert cli.main(command(clip, tmp_path, "--resume", *same)) == 0
    assert_same_run((whole if same else filmed).folder, tmp_path)


def test_a_run_that_was_taken_over_writes_nothing_more(clip: Path, tmp_path: Path) -> None:
    class Taking(Stumbling):
        def add(self, frame: Posterior, picture: Picture) -> None:
            if frame.frame.index == 2:
                assert Claims(tmp_path).take(LOCK_NAME, gone=True) is not None

    few = replace(SETTINGS, samples=1, modes=1, terms=("joints",), overlay=False)
    with pytest.raises(OutputError, match="another process has taken over"):
        follow(clip, tmp_path, few, live=Taking(0, KeyboardInterrupt()), checkpoint_every=0)
    assert len(Run.open(tmp_path).track.frames) == 2


def test_a_second_request_to_end_does_not_interrupt_what_the_first_leaves_to_write() -> None:
    written = []

    @ended_by_sigterm()
    def run() -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            signal.raise_signal(signal.SIGTERM)
            written.append("checkpoint")

    with pytest.raises(Terminated):
        run()
    assert written


def test_a_complete_run_stays_as_it_is(clip: Path, whole: Run) -> None:
    before = (whole.folder / "track.npz").read_bytes()
    assert len(resume(whole.folder).track.frames) == FRAMES
    assert (whole.folder / "track.npz").read_bytes() == before


def test_a_run_is_gone_on_with_by_itself(clip: Path, whole: Run, tmp_path: Path) -> None:
    """The folder knows its video, keypoints, cameras and settings."""
    with pytest.raises(KeyboardInterrupt):
        follow(clip, tmp_path, live=Stumbling(5, KeyboardInterrupt()))
    resume(tmp_path)
    assert_same_run(whole.folder, tmp_path)


def test_where_nothing_was_begun_it_begins(clip: Path, tmp_path: Path) -> None:
    few = replace(SETTINGS, samples=1, modes=1, terms=("joints",), overlay=False)
    run = follow(clip, tmp_path / "new", few, resume=True)
    assert run.summary["ended"] == "complete"
    (tmp_path / "new" / "checkpoint.npz").unlink()
    with pytest.raises(TrackFileError, match="no checkpoint to go on from"):
        resume(run.folder)


def test_other_settings_are_refused(clip: Path, whole: Run) -> None:
    with pytest.raises(ConfigurationError, match="samples 4, now 5"):
        follow(clip, whole.folder, replace(SETTINGS, samples=5), resume=True)
    with pytest.raises(ConfigurationError, match="stride 1, now 2"):
        follow(clip, whole.folder, stride=2, resume=True)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sigma": 9.0}, "sigma .*, now 9.0"),
        ({"person": "largest"}, "person prominent, now largest"),
        ({"masks": Path("masks")}, "masks None, now masks"),
        ({"others": [ViewFiles(video=Path("more.mp4"), keypoints=None)]}, "with 1 cameras"),
    ],
)
def test_other_options_of_the_files_are_refused(
    clip: Path, whole: Run, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigurationError, match=words):
        follow(clip, whole.folder, resume=True, **options)


def test_another_camera_is_refused(clip: Path, whole: Run, tmp_path: Path) -> None:
    content = json.loads((clip / "cameras.json").read_text())
    for entry in content["cameras"].values():
        entry["K"][0][0] += 1.0
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    for camera, focal in ((tmp_path / "cameras.json", None), (None, 500.0)):
        with pytest.raises(ConfigurationError, match="begun with the camera"):
            track_video(
                clip / "video.mp4", camera=camera, keypoints=clip / "keypoints2d.npz",
                out=whole.folder, settings=SETTINGS,
                options=TrackOptions(resume=True, focal=focal),
            )  # fmt: skip


def test_another_first_pose_is_refused(clip: Path, whole: Run, filmed: Run, tmp_path: Path) -> None:
    given = (clip / "first" / "body.npz").read_bytes()
    (tmp_path / "body.npz").write_bytes(given)
    assert len(follow(clip, whole.folder, init=tmp_path, resume=True).track.frames) == FRAMES
    (tmp_path / "body.npz").write_bytes(given[:-1] + bytes([given[-1] ^ 1]))
    with pytest.raises(ConfigurationError, match=r"begun with --init .*first.body\.npz, now .* is"):
        follow(clip, whole.folder, init=tmp_path, resume=True)
    with pytest.raises(ConfigurationError, match="begun without --init, now"):
        follow(clip, filmed.folder, FILMED, resume=True)


def test_other_files_are_refused(clip: Path, whole: Run, tmp_path: Path) -> None:
    """Not the old track told as that of another video."""
    files = {"video": clip / "video.mp4", "keypoints": clip / "keypoints2d.npz"}
    for name, path in files.items():
        data = path.read_bytes()
        (tmp_path / path.name).write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        other = {**files, name: tmp_path / path.name}
        with pytest.raises(ConfigurationError, match=f"begun with the {name} .* --out"):
            track_video(
                other["video"], camera=clip / "cameras.json", keypoints=other["keypoints"],
                out=whole.folder, settings=SETTINGS, options=TrackOptions(resume=True),
            )  # fmt: skip


@pytest.mark.parametrize("of_pictures", [False, True])
def test_files_that_were_moved_are_known_again(
    clip: Path, whole: Run, tmp_path: Path, of_pictures: bool
) -> None:
    before, after = tmp_path / "before", tmp_path / "after"
    before.mkdir()
    shutil.copy(clip / "cameras.json", tmp_path)
    shutil.copy(clip / "keypoints2d.npz", before)
    if of_pictures:
        (before / "film").mkdir()
        for frame in VideoReader(clip / "video.mp4"):
            Image.fromarray(frame.image).save(before / "film" / f"{frame.index}.png")
    else:
        shutil.copy(clip / "video.mp4", before / "film")

    def track(folder: Path, **options: Any) -> Run:
        return track_video(
            folder / "film", camera=tmp_path / "cameras.json",
            keypoints=folder / "keypoints2d.npz", out=tmp_path / "out", settings=SETTINGS,
            options=TrackOptions(init=clip / "first" / "body.npz", **options),
        )  # fmt: skip

    with pytest.raises(KeyboardInterrupt):
        track(before, live=Stumbling(5, KeyboardInterrupt()))
    before.rename(after)
    run = track(after, resume=True)
    assert (run.summary["ended"], len(run.track.frames)) == ("complete", FRAMES)
    assert run.summary["video"] == str(after / "film")
    files = run.cameras[0].files
    assert files is not None
    assert (files.video, files.keypoints) == (after / "film", after / "keypoints2d.npz")
    if not of_pictures:
        np.testing.assert_array_equal(run.track.state, whole.track.state)


def test_options_that_make_no_sense_are_refused() -> None:
    for options in ({"sigma": 0.0}, {"sigma": float("nan")}, {"checkpoint_every": -1.0}):
        with pytest.raises(ConfigurationError, match=next(iter(options))):
            TrackOptions(**options)

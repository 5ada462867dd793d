"""Batches: manifests, failures, what another command of the same folder does."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import pytest

from torchcss.app.batch import Batch, Job, _Watch, go_on_from, read_manifest, track_claimed
from torchcss.app.claims import Claims
from torchcss.app.recorder import Picture
from torchcss.errors import ConfigurationError
from torchcss.io.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from torchcss.io.run import Run
from torchcss.studies.demo import CLIP
from torchcss.tracking.session import Posterior
from torchcss.tracking.settings import Settings

SETTINGS = Settings(body="arm8", samples=4, modes=2, keypoints_use="first", overlay=False)


def write_manifest(folder: Path, *rows: dict) -> Path:
    usual = {
        "video": str(CLIP / "video.mp4"), "camera": str(CLIP / "cameras.json"),
        "keypoints": str(CLIP / "keypoints.npz"), "init": str(CLIP / "body.npz"), "stop": 2,
    }  # fmt: skip
    path = folder / "clips.jsonl"
    path.write_text("\n".join(json.dumps({**usual, **row}) for row in rows) + "\n\n")
    return path


def test_a_bad_clip_fails_alone_and_is_tried_again_when_it_has_changed(tmp_path: Path) -> None:
    bad = tmp_path / "bad.mp4"
    bad.write_bytes(b"no video")
    manifest = write_manifest(
        tmp_path, {"name": "good", "seed": 3}, {"name": "bad", "video": str(bad)}
    )
    batch = Batch(manifest=manifest, out=tmp_path / "out", settings=SETTINGS)
    assert batch.run() == 1
    told = json.loads((tmp_path / "out" / "batch.json").read_text())
    assert (told["done"], told["failed"]) == (1, 1)
    assert "bad.mp4" in told["clips"]["bad"]["about"]
    page = (tmp_path / "out" / "batch.html").read_text()
    assert re.findall("href='([^']*)'", page) == ["good/"]  # of the other there is no folder
    run = Run.open(tmp_path / "out" / "good")
    assert run.settings["seed"] == 3
    good = told["clips"]["good"]
    assert (good["frames"], good["told_lost"]) == (len(run.track.frames), 0)
    assert f"<td>{good['frames']}</td><td>0</td>" in page
    failed = tmp_path / "out" / ".batch" / "failed" / "bad.json"
    before = failed.stat().st_mtime_ns
    batch.run()
    assert failed.stat().st_mtime_ns == before, "nothing has changed"
    replace(batch, retry_failed=True).run()
    assert failed.stat().st_mtime_ns > before
    shutil.copy(CLIP / "video.mp4", bad)
    assert batch.run() == 0
    assert json.loads((tmp_path / "out" / "batch.json").read_text())["done"] == 2
    assert "bad" in (tmp_path / "out" / "batch.html").read_text()
    assert not list((tmp_path / "out" / ".batch" / "work").iterdir())


def test_a_folder_holds_one_batch(tmp_path: Path) -> None:
    manifest = write_manifest(tmp_path, {})
    batch = Batch(manifest=manifest, out=tmp_path / "out", settings=SETTINGS)
    Job.begin(batch)
    Job.begin(batch)
    with pytest.raises(ConfigurationError, match="other settings"):
        Job.begin(replace(batch, settings=replace(SETTINGS, seed=5)))
    write_manifest(tmp_path, {"stop": 3})
    with pytest.raises(ConfigurationError, match="other clips"):
        Job.begin(batch)


def test_names_of_any_signs(tmp_path: Path) -> None:
    """They are neither patterns of other files nor parts of the page."""
    names = ["a", "a.1", "clip [1] #?%", "javascript:alert(1)", "<script>'&"]
    manifest = write_manifest(tmp_path, *({"name": name} for name in names))
    out = tmp_path / "out"
    Batch(manifest=manifest, out=out, settings=SETTINGS).run()
    assert {path.name for path in out.iterdir() if path.is_dir()} == {".batch", *names}
    page = (out / "batch.html").read_text()
    links = re.findall("href='([^']*)'", page)
    assert [unquote(link) for link in links] == [f"{name}/" for name in names]
    assert not any(sign in link for link in links for sign in ":#?<")
    assert "<script>" not in page


def test_the_page_tells_where_the_clip_is_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def page(run: Run) -> None:
        where = run.folder.resolve()
        (run.folder / "report.html").write_text(f"<h1>torchcss: {where.name}</h1>smooth {where} #")

    monkeypatch.setattr("torchcss.show.report.write_report_page", page)
    manifest = write_manifest(tmp_path, {"name": "a", "stop": 1})
    out = tmp_path / "out"
    Batch(manifest=manifest, out=out, settings=replace(SETTINGS, overlay=True)).run()
    told = (out / "a" / "report.html").read_text()
    assert told == f"<h1>torchcss: a</h1>smooth {(out / 'a').resolve()} #"


def test_what_is_half_written_is_not_gone_on_from(tmp_path: Path) -> None:
    """A process may be killed while it copies, and a disk may be full then."""
    place = tmp_path / "4"
    for name, files in {
        "1": ["old"],
        "2": ["track.npz", ".track.x.partial.npz"],
        ".3": ["t"],
    }.items():
        (tmp_path / name / ".lock").mkdir(parents=True)
        for file in files:
            (tmp_path / name / file).write_text(name)
    go_on_from(place)
    assert [(file.name, file.read_text()) for file in place.iterdir()] == [("track.npz", "2")]
    (place / "summary.json").mkdir()
    with pytest.raises(OSError, match="directory"):
        go_on_from(tmp_path / "5")
    assert not (tmp_path / "5").exists()


def test_who_was_taken_over_says_nothing_of_the_clip(tmp_path: Path) -> None:
    manifest = write_manifest(tmp_path, {"name": "a", "video": "none.mp4"})
    job = Job.begin(Batch(manifest=manifest, out=tmp_path / "out", settings=SETTINGS))
    claim, (clip,) = job.claims.take("a"), job.clips
    assert claim is not None
    assert job.claims.take("a") is None
    claim.release()
    assert job.claims.take("a") is not None
    track_claimed(job, clip, claim)
    assert job.failure(clip) is None


def test_who_was_taken_over_writes_no_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest, out = write_manifest(tmp_path, {"name": "a", "stop": 3}), tmp_path / "out"
    job = Job.begin(Batch(manifest=manifest, out=out, settings=SETTINGS))
    claim, add = job.claims.take("a"), _Watch.add

    def sleep(watch: _Watch, frame: Posterior, picture: Picture) -> None:
        if frame.frame.index == 1:
            assert job.claims.take("a", gone=True) is not None
        add(watch, frame, picture)

    monkeypatch.setattr(_Watch, "add", sleep)
    assert claim is not None
    track_claimed(job, job.clips[0], claim)
    left = read_checkpoint(out / ".batch" / "work" / "a" / "1")
    assert left is not None
    assert left.num_frames == 1
    assert job.is_left(job.clips[0])


@pytest.mark.parametrize(
    ("ends", "dead"),
    [
        ("0 0 0", True),
        ("0 2 2 2", True),
        ("2 2", False),
        ("0 1 2 3", False),
        ("2 2 2 end", False),
        ("2 2 end 2", False),
    ],
)
def test_a_clip_whose_owners_die_at_one_place_is_failed(
    tmp_path: Path, ends: str, dead: bool
) -> None:
    """An owner has died with some frames done, or was asked to end, as schedulers do."""
    manifest = write_manifest(tmp_path, {"name": "a", "video": "none.mp4"})
    job = Job.begin(Batch(manifest=manifest, out=tmp_path / "out", settings=SETTINGS))
    for end in ends.split():
        claim = job.claims.take("a", gone=True)
        assert claim is not None
        place = tmp_path / "out" / ".batch" / "work" / "a" / str(claim.generation)
        place.mkdir(parents=True)
        write_checkpoint(place, Checkpoint(2 if end == "end" else int(end), {}))
        if end == "end":
            claim.release()
    for fails in (dead, False):
        claim = job.claims.take("a", gone=True)
        assert claim is not None
        track_claimed(job, job.clips[0], claim)
        line = (job.failure(job.clips[0]) or {})["line"]
        assert ("died 3 times" in line) == fails, line
        job = Job.begin(
            Batch(manifest=manifest, out=tmp_path / "out", settings=SETTINGS, retry_failed=True)
        )


DEADLY = """
import multiprocessing, os, signal, sys
from torchcss.app import batch

add = batch._Watch.add

def add_or_die(watch, frame, picture):
    if watch.claim.name == "deadly" and frame.frame.index:
        os.kill(os.getpid(), signal.SIGKILL)
    add(watch, frame, picture)

batch._Watch.add = add_or_die  # in the processes that it starts, too
# A server that has the package already starts them sooner than each would import it.
of_kind = multiprocessing.get_context
multiprocessing.set_forkserver_preload(["torchcss.app.batch"])
multiprocessing.get_context = lambda _: of_kind("forkserver")
if __name__ == "__main__":
    sys.exit(batch.main())
"""


def test_a_clip_that_kills_its_processes_ends_no_batch(tmp_path: Path) -> None:
    names = ("deadly", "a", "b")
    manifest = write_manifest(tmp_path, *({"name": name} for name in names))
    (tmp_path / "deadly.py").write_text(DEADLY)
    words = ["--body=arm8", "--samples=4", "--modes=2", "--keypoints-use=first", "--no-overlay"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    out = tmp_path / "out"
    ended = subprocess.run(
        [sys.executable, str(tmp_path / "deadly.py"), str(manifest), *words, f"--out={out}",
         "--workers=2", "--patience=900"],  # who started a process sees it die
        env=environment, text=True, capture_output=True, timeout=600,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.count("died with its clip; another one starts") == 3
    clips = json.loads((out / "batch.json").read_text())["clips"]
    assert [clips[name]["kind"] for name in names] == ["failed", "done", "done"]
    assert "died 3 times with 1 frames done" in clips["deadly"]["about"]
    assert (out / ".batch" / "work" / "deadly" / "4" / "checkpoint.npz").is_file()
    Batch(manifest=manifest, out=out, settings=SETTINGS, retry_failed=True).run()
    assert json.loads((out / "batch.json").read_text())["done"] == 3


def test_other_results_are_not_taken_for_the_batch_s(tmp_path: Path) -> None:
    manifest = write_manifest(tmp_path, {"name": "a"})
    (tmp_path / "out" / "a").mkdir(parents=True)
    with pytest.raises(ConfigurationError, match="in the way"):
        Job.begin(Batch(manifest=manifest, out=tmp_path / "out", settings=SETTINGS))


def test_states_are_shown_and_a_request_to_end_ends_all_processes(tmp_path: Path) -> None:
    manifest = write_manifest(tmp_path, *({"name": name, "stop": 50} for name in "ab"))
    words = ["--body=arm8", "--keypoints-use=first", "--no-overlay", "--workers=2"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-m", "torchcss.app.batch", str(manifest), *words]
    with subprocess.Popen(
        [*command, f"--out={tmp_path / 'out'}"], env=environment, text=True, stdout=subprocess.PIPE
    ) as process:
        work = tmp_path / "out" / ".batch" / "work"
        while process.poll() is None and not list(work.glob("*/1/checkpoint.npz")):
            time.sleep(0.05)
        process.terminate()
        printed, _ = process.communicate(timeout=30)
    assert process.returncode == 0
    assert "a: tracking" in printed
    claims = Claims(tmp_path / "out" / ".batch" / "claims")
    seen = [claims.sight(name) for name in "ab"]
    assert all(each is None or each.released for each in seen), seen


def test_a_csv_and_folders(tmp_path: Path) -> None:
    table = tmp_path / "clips.csv"
    table.write_text(
        "\ufeffvideo,keypoints,start,fov\na/walk.mp4,k.json,5,\nb.mov,,,60.5\n", "utf-8"
    )
    walk, other = read_manifest(table)
    assert walk.name == "walk"
    assert walk.row["video"] == str(tmp_path / "a" / "walk.mp4")
    assert (walk.row["start"], "fov" in walk.row, other.row["fov"]) == (5, False, 60.5)
    for name in ("one", "two"):
        (tmp_path / "many" / name).mkdir(parents=True)
        (tmp_path / "many" / name / "video.mp4").touch()
    (tmp_path / "many" / "one" / "cameras.json").touch()
    (tmp_path / "many" / "three.MOV").touch()
    one, three, two = read_manifest(tmp_path / "many")
    assert (one.name, three.name, two.name) == ("one", "three", "two")
    assert "camera" in one.row
    assert "camera" not in two.row


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", "video;sigma;stop\n a.mp4;2,5;20\nb.mp4;;\n;;\n"),  # of a spreadsheet
        ("a.csv", "sep=,\r\nVideo, Sigma, Stop,\r\na.mp4, 2.5, 20,\r\nb.mp4\r\n"),
        ("a.csv", "\nvideo,sigma,stop\na.mp4,2.5,20.0\nb.mp4,,\n"),  # pandas: some have none
        (
            "a.jsonl",
            '{"video": "a.mp4", "sigma": 2.5, "stop": 20.0}\n{"video": "b.mp4", "stop": NaN}',
        ),
        ("a.tsv", "video\tsigma\tstop\na.mp4\t2.5\t20\nb.mp4\t\t\n"),
        ("a.json", '[{"video": "a.mp4", "sigma": 2.5,\n "stop": 20.0},\n{"video": "b.mp4"}]'),
        ("a.jsonl", '\ufeff{"video": "a.mp4", "sigma": 2.5, "stop": 20}\r\n{"video": "b.mp4"}\r\n'),
    ],
)
def test_manifests_as_programs_write_them(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text, "utf-8", newline="")
    one, other = read_manifest(tmp_path / name)
    assert (one.name, one.row["sigma"], one.row["stop"]) == ("a", 2.5, 20)
    assert one.row["video"] == str(tmp_path / "a.mp4")
    assert (other.name, {*other.row}) == ("b", {"video"})


def test_a_person_by_number_in_a_column_with_empty_cells(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("video,person\na.mp4,3.0\nb.mp4,\nc.mp4,v1.0x\n")
    assert [clip.row.get("person") for clip in read_manifest(tmp_path / "a.csv")] == [
        "3", None, "v1.0x"
    ]  # fmt: skip


def test_a_folder_tells_what_it_leaves_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in ("pictures", "walk"):
        (tmp_path / folder).mkdir()
    for name in ("a.MTS", "._a.MTS", "notes.txt", "walk/video.mov", "walk/keypoints.npz"):
        (tmp_path / name).touch()
    one, other = read_manifest(tmp_path)
    assert (one.name, other.name) == ("a", "walk")
    assert other.row["keypoints"] == str(tmp_path / "walk" / "keypoints.npz")
    (tmp_path / "walk" / "keypoints2d.npz").touch()
    assert read_manifest(tmp_path)[1].row["keypoints"].endswith("keypoints2d.npz")
    assert "left out: pictures\n" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("{\n", "line 1: no JSON"),
        ('{"camera": "c"}', "column video"),
        ('{"video": "v", "camra": "c"}', "unknown column 'camra'"),
        ('{"video": "v", "start": "soon"}', "start: expected a whole number"),
        ('{"video": "v"}\n{"video": "w/v"}', "two clips are called v"),
        ('{"video": "v", "start": Infinity}', "start: expected a whole number"),
        ('{"video": "v", "seed": 1.5}', "seed: expected a whole number"),
        ('{"video": "v", "focal": "long"}', "focal: expected a number"),
        ('{"video": ["v"]}', "video: expected a text"),
        ('{"video": true}', "video: expected a text"),
        ('{"video": "v", "normalised": "yes"}', "normalised: expected pixels or zero-one"),
        ('{"video": "v"}\n\n{"camera": "c"}', "line 3: expected a column video"),
        ("[" * 100_000, "line 1: no JSON"),
        *(
            (json.dumps({"video": "v", "name": name}), "cannot be the name of a folder")
            for name in ("../v", "batch.json", "a\0b", "\udce9", "x" * 201, ".v")
        ),
    ],
)
def test_bad_manifests(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "clips.jsonl"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=message):
        read_manifest(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("video,name\nv.mp4,a,b\n", "row 1: more cells than columns"),
        ("video,name,video\nv.mp4,a,w.mp4\n", "two columns are called video"),
    ],
)
def test_bad_tables(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "clips.csv"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=message):
        read_manifest(path)


@pytest.mark.parametrize("patience", [0.0, math.nan, math.inf])
def test_patience_is_a_time_that_can_be_waited(patience: float) -> None:
    with pytest.raises(ConfigurationError, match="patience"):
        Batch(manifest=Path("clips.csv"), patience=patience)

"""Batches: manifests, failures, what another command of the same folder does."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from torchcss.app.batch import Batch, Job, read_manifest
from torchcss.errors import ConfigurationError
from torchcss.io.run import Run
from torchcss.studies.demo import CLIP
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
    batch.run()
    told = json.loads((tmp_path / "out" / "batch.json").read_text())
    assert (told["done"], told["failed"]) == (1, 1)
    assert "bad.mp4" in told["clips"]["bad"]["about"]
    assert Run.open(tmp_path / "out" / "good").settings["seed"] == 3
    failed = tmp_path / "out" / ".batch" / "failed" / "bad.json"
    before = failed.stat().st_mtime_ns
    batch.run()
    assert failed.stat().st_mtime_ns == before, "nothing has changed"
    replace(batch, retry_failed=True).run()
    assert failed.stat().st_mtime_ns > before
    shutil.copy(CLIP / "video.mp4", bad)
    batch.run()
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
    ("text", "message"),
    [
        ("", "empty"),
        ("{\n", "line 1: no JSON"),
        ('{"camera": "c"}', "column video"),
        ('{"video": "v", "camra": "c"}', "unknown column 'camra'"),
        ('{"video": "v", "start": "soon"}', "start: expected a number"),
        ('{"video": "v"}\n{"video": "w/v"}', "two clips are called v"),
        ('{"video": "v", "name": "../v"}', "cannot be the name of a folder"),
    ],
)
def test_bad_manifests(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "clips.jsonl"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=message):
        read_manifest(path)

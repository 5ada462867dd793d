"""`torchcss init`: what it writes, that `track --init` takes it, one clear line when it fails."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from made_sequences import rendered_arm, write_clip

from torchcss.app.init import write_png
from torchcss.cli import init as cli_init
from torchcss.cli import main as cli
from torchcss.initialise.multi_start import StartSearch
from torchcss.initialise.options import InitialiseOptions
from torchcss.io.pictures import read_image
from torchcss.io.tracks import load_track
from torchcss.io.video import VideoReader
from torchcss.types import Keypoints


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered arm as picture and as video, with its camera and joints as files."""
    folder = tmp_path_factory.mktemp("scene")
    sequence = rendered_arm(3, 2)
    write_clip(folder, sequence)
    write_png(folder / "picture.png", sequence.frames[0])
    uv = sequence.camera.project(sequence.joints_world[0]).uv
    marks = dict(zip(sequence.body.joint_names, uv.tolist(), strict=True))
    (folder / "joints.json").write_text(json.dumps({"joints": marks}))
    return folder


def init(scene: Path, out: Path, *more: str) -> int:
    given = ["init", str(scene / "picture.png"), "--out", str(out), "--body", "arm8", *more]
    if not {"--click", "--keypoints", "--joints"} & set(more):
        given += ["--keypoints", str(scene / "joints.json")]
    return cli.main(given)


@pytest.fixture(scope="module")
def result(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("init") / "out"
    assert init(scene, out, "--camera", str(scene / "cameras.json"), "--hypotheses", "3") == 0
    return out


def test_writes_what_it_says(scene: Path, result: Path):
    stages = {f"stage{number}.png" for number in (1, 2, 3)}
    assert {path.name for path in result.iterdir()} == stages | {
        "body.npz", "hypotheses.png", "side.png", "proportions.csv", "summary.json"
    }  # fmt: skip
    picture = read_image(scene / "picture.png")
    for name in stages | {"hypotheses.png"}:
        drawn = read_image(result / name)
        assert drawn.shape == picture.shape
        assert (drawn != picture).any()
    with (result / "proportions.csv").open() as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"shoulder_width", "upper_arm", "forearm"}
    ratio = float(rows["forearm"]["fitted_m"]) / float(rows["forearm"]["standard_m"]) - 1
    assert 100 * ratio == pytest.approx(float(rows["forearm"]["difference_percent"]))
    assert abs(ratio) <= 0.1 + 1e-9
    summary = json.loads((result / "summary.json").read_text())
    assert 1 <= summary["num_hypotheses"] <= 3
    assert len(summary["stages"]) == 3
    assert any("sets the scale" in line for line in summary["report"])


def test_with_edges_alone_if_asked(scene: Path, result: Path, tmp_path: Path):
    camera = str(scene / "cameras.json")
    assert init(scene, tmp_path, "--camera", camera, "--hypotheses", "3", "--no-colours") == 0
    both, edges = (json.loads((p / "summary.json").read_text()) for p in (result, tmp_path))
    assert (both["colours"], edges["colours"]) == (True, False)
    for name, cost in both["stages"].items():
        assert (cost == edges["stages"][name]) == (name == "pose and proportions from joints")


def test_track_starts_from_it(scene: Path, result: Path, tmp_path: Path, capsys):
    given = [
        "track", str(scene / "video.mp4"), "--camera", str(scene / "cameras.json"),
        "--keypoints", str(scene / "keypoints.npz"), "--init", str(result), "--samples", "4",
        "--modes", "2", "--no-overlay", "--out", str(tmp_path),
    ]  # fmt: skip
    assert cli.main([*given, "--body", "arm8"]) == 0
    assert len(load_track(tmp_path).frames) == 2
    capsys.readouterr()
    assert cli.main([*given, "--body", "arm7", "--overwrite"]) == 2
    assert "the fitted body is arm8" in capsys.readouterr().err
    assert cli.main([*given, "--body", "arm8", "--stature", "2", "--overwrite"]) == 2
    assert "the stature is said to be 2 m" in capsys.readouterr().err
    for option, there in (("--ground=0", "init --ground"), ("--free-root", "init --free-root")):
        assert cli.main([*given, "--body", "arm8", option, "--overwrite"]) == 2
        assert there in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--keypoints", "nowhere.json"), "nowhere.json"),
        (("--joints", "nowhere.json"), "nowhere.json"),  # its name in version 0.1
        (("--camera", "nowhere.json"), "nowhere.json"),
        (("--focal-px", "500", "--field-of-view", "60"), "--focal or --fov"),
        (("--field-of-view", "200"), "--fov: expected degrees"),
        (("--stature", "175"), "stature"),
        (("--hypotheses", "0"), "at least 1 hypothesis"),
        (("--hypotheses", "-2"), "at least 1 hypothesis"),
        (("--seed", str(2**70)), "seed"),
        (("--normalised", "zero-one"), "expected fractions of the image"),
        (("--body", "octopus"), "octopus"),
        (("--click",), "no window can be opened"),
        (("--coarse-pose", "nowhere.json"), "nowhere.json"),
        (
            ("--initialisation", "papers", "--hypotheses", "3", "--colours=True"),
            "--hypotheses, --colours: not with --initialisation papers",
        ),
        (("--initialisation", "papers", "--proportions", "all"), "--proportions: not with"),
    ],
)
def test_one_clear_line(scene: Path, tmp_path: Path, options: tuple, message: str, capsys):
    assert init(scene, tmp_path / "out", *options) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("torchcss: ")
    assert message in line


def test_the_papers_stages_from_a_coarse_pose(scene: Path, tmp_path: Path, capsys):
    camera = ("--camera", str(scene / "cameras.json"))
    pose = tmp_path / "pose.json"
    pose.write_text(json.dumps({"r_elbow_flexion": 0.5}))
    same = ("--hypotheses", "best", "--no-colours", "--proportions", "papers")
    papers = ("--initialisation", "papers", "--coarse-pose", str(pose), *camera, *same)
    assert init(scene, tmp_path / "out", *papers) == 0
    assert "1 hypotheses" in capsys.readouterr().out
    for text, message in (("[1]", "numbers by parameter"), ('{"tail": 1}', "tail"),
                          ('{"r_elbow_flexion": "far"}', "numbers by parameter")):  # fmt: skip
        pose.write_text(text)
        assert init(scene, tmp_path / "other", *papers) == 2
        assert message in capsys.readouterr().err


def few_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the verb look less widely."""
    plain, small = cli_init.initialise_image, StartSearch(num_starts=8, num_flips=8, num_samples=0)

    def quick(*files, options: InitialiseOptions, **more):
        return plain(*files, options=replace(options, search=small), **more)

    monkeypatch.setattr(cli_init, "initialise_image", quick)


def test_clicked_joints_are_used_and_kept(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    marks = json.loads((scene / "joints.json").read_text())["joints"]
    places = torch.tensor(list(marks.values()), dtype=torch.float64)
    clicked = Keypoints(places, torch.ones(len(places)).double(), tuple(marks))
    monkeypatch.setattr("torchcss.show.click.click_joints", lambda picture, body: clicked)
    few_starts(monkeypatch)
    assert init(scene, tmp_path, "--click", "--no-contours", "--hypotheses", "best") == 0
    kept = json.loads((tmp_path / "joints.json").read_text())["joints"]
    assert kept["r_wrist"] == pytest.approx(marks["r_wrist"], abs=0.01)
    assert not (tmp_path / "stage2.png").exists()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["num_hypotheses"] == 1
    focal = 0.5 * 640 / math.tan(math.radians(27))
    assert f"focal length {focal:.0f} px" in summary["report"][0]


def test_nobody_clicks_for_a_folder_that_cannot_be_written(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    monkeypatch.setattr("torchcss.show.click.click_joints", None)
    (tmp_path / "out").write_text("a file")
    assert init(scene, tmp_path / "out", "--click") == 2
    assert "a file is in the way" in capsys.readouterr().err


def test_from_a_frame_of_a_video(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """What is marked in a later frame is of that frame, for `track --start` too."""
    marks = json.loads((scene / "joints.json").read_text())["joints"]
    places = torch.tensor(list(marks.values()), dtype=torch.float64)
    clicked = Keypoints(places, torch.ones(len(places)).double(), tuple(marks))
    seen = []
    few_starts(monkeypatch)
    monkeypatch.setattr(
        "torchcss.show.click.click_joints", lambda picture, body: seen.append(picture) or clicked
    )
    quick = [
        "--camera", str(scene / "cameras.json"), "--no-contours", "--hypotheses", "best",
        "--body", "arm8",
    ]  # fmt: skip
    video = ["init", str(scene / "video.mp4"), "--frame", "1", *quick]
    assert cli.main([*video, "--click", "--out", str(tmp_path / "a")]) == 0
    second = list(VideoReader(scene / "video.mp4"))[1].image
    assert (seen[0] == second).all()
    made = tmp_path / "a" / "joints.json"
    assert list(json.loads(made.read_text())["frames"]) == ["1"]
    for number, joints in enumerate((made, scene / "keypoints.npz", scene / "joints.json")):
        out = tmp_path / str(number)
        assert cli.main([*video, "--keypoints", str(joints), "--out", str(out)]) == 0
        assert json.loads((out / "summary.json").read_text())["frame"] == 1
    given = ["--keypoints", str(made), "--out", str(tmp_path)]
    assert cli.main([*video[:3], "7", *quick, *given]) == 2
    given = [
        "track", str(scene / "video.mp4"), "--camera", str(scene / "cameras.json"), "--start", "1",
        "--keypoints", str(made), "--init", str(tmp_path / "a"), "--keypoints-use", "first",
        "--samples", "4", "--modes", "2", "--no-overlay", "--out", str(tmp_path / "track"),
    ]  # fmt: skip
    assert cli.main([*given, "--body", "arm8"]) == 0
    assert list(load_track(tmp_path / "track").frames) == [1]

"""The page about a run: everything inside, everything escaped."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html import escape, unescape
from pathlib import Path

import numpy as np
import pytest
import torch
from made_clip import grey_film
from made_tracks import make_track

from torchcss.body.load import load_body
from torchcss.cli import main as cli
from torchcss.io.run import Run
from torchcss.io.tracks import TRACK_NAME, save_track, write_summary
from torchcss.io.video import VideoReader
from torchcss.io.view_files import RecordedCamera, ViewFiles
from torchcss.show import report
from torchcss.vision.camera import Camera


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run in a folder whose name is markup, as are its notes and its video."""
    folder = tmp_path / "a <b> & 'c'"
    folder.mkdir()
    camera = Camera.pinhole(800, 600, focal_px=700.0, name="<i>one</i>")
    files = ViewFiles(video=folder / "gone <u>.mp4", keypoints=None)
    track = make_track(load_body("arm8"), (2, 3, 1))
    track = track._replace(cameras=(RecordedCamera(camera, files),))
    for name in (TRACK_NAME, "smooth.npz"):
        save_track(folder / name, track)
    write_summary(folder, {"notes": ["<script>alert(1)</script>", "focal length assumed"]})
    grey_film(folder / "overlay.mp4", (40, 120, 200), camera.image_size_wh)
    return folder


def test_the_page_needs_nothing_else_and_holds_what_was_noted(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run.open(folder)
    save_track(folder / TRACK_NAME, run.track._replace(times=np.array([0.5, 0.54, 0.7])))
    monkeypatch.setattr(report, "MOST_PICTURES", 2)
    page = report.write_report_page(Run.open(folder)).read_text()
    assert set(re.findall(r'(?:src|href|poster)="(.{11})', page)) == {
        *("data:video/", "data:image/")
    }
    assert not re.search(r"<(script|link|iframe|b>|i>|u>)|https?:|url\(", page)
    text = unescape(page)
    for told in ("<script>alert(1)</script>", "focal length 700 pixels (59 degrees", "<i>one</i>"):
        assert told in text
    # The film is reduced, and every second frame of it is shown.
    found = re.search(r"data:video/mp4;base64,([^\"]+)", page)
    assert found is not None
    (tmp_path / "film.mp4").write_bytes(base64.b64decode(found[1]))
    reader = VideoReader(tmp_path / "film.mp4")
    assert reader.frame_times() == pytest.approx([0.0, 0.2], abs=1e-4)
    film = [frame.image for frame in reader]
    assert [image.shape for image in film] == [(480, 640, 3)] * 2
    assert film[1].mean() == pytest.approx(200, abs=4)


def test_the_verb_for_a_run_that_is_there(folder: Path) -> None:
    assert cli.main(["report", str(folder)]) == 0
    assert f"torchcss smooth '{folder}".replace("'c'", "'\"'\"'c'\"'\"''") in unescape(
        (folder / "report.html").read_text()
    )
    assert cli.main(["report", str(folder / "smooth.npz")]) == 0
    page = unescape((folder / "smooth_report.html").read_text())
    assert "torchcss smooth" not in page
    assert "say where with" in page  # the overlay is the track's, the video is gone


def test_a_run_that_went_on_and_was_interrupted_has_its_page(folder: Path, tmp_path: Path) -> None:
    """The film that was drawn before ends before the track, and the summary is of then."""
    overlay = folder / "overlay.mp4"
    overlay.unlink()
    grey_film(overlay, (40, 120), (800, 600))
    write_summary(folder, {"ended": "complete", "num_frames": 2})
    run = Run.open(folder)
    page = unescape(report.write_report_page(run).read_text())
    assert "It ends before the track" in page
    assert "overlay.mp4: 1 frames of the track are missing" in page
    assert "complete; summary.json is of another moment of the run, when there were 2" in page
    assert "data:video/mp4" in page
    # Where the video is, the rest is drawn over it.
    (camera,) = run.cameras
    grey_film(tmp_path / "video.mp4", (10,) * 3, (800, 600))
    files = replace(camera.files, video=tmp_path / "video.mp4")
    run = replace(run, track=run.track._replace(cameras=(camera._replace(files=files),)))
    page = unescape(report.write_report_page(run).read_text())
    assert "It ends before the track" not in page


def test_a_page_of_a_folder_that_is_moved(folder: Path, tmp_path: Path) -> None:
    place = tmp_path / "an <other> 'place'"
    page = report.write_report_page(Run.open(folder)).name
    report.tell_new_place(folder, place)
    moved = (folder / page).read_text()
    folder.rename(place)
    report.write_report_page(Run.open(place))
    body, anew = (re.sub(r'"data:[^"]*"', "", text) for text in (moved, (place / page).read_text()))
    # The video, which is nowhere, was in it.
    assert body == anew.replace(escape(str(folder)), escape(str(place)))
    report.tell_new_place(tmp_path, place)  # without a page


def test_the_page_says_which_tracker_it_was(folder: Path) -> None:
    settings = {"preset": "ijrr_css", "keypoints_use": None}
    summary = {"settings": settings, "samples": 40, "modes": 3}
    told = facts_of(folder, {**summary, "changed_beside_preset": ["samples"]})
    assert told["Preset"].startswith("ijrr_css: covariance scaled sampling as printed")
    assert told["Preset"].endswith(
        "at most 40 samples a frame and 3 modes; changed beside it: samples"
    )
    assert told["Keypoints"].endswith("joints.npz, in the first frame alone")
    ours = facts_of(
        folder,
        {"settings": {"preset": "css"}, "events": [{"event": "lost", "frame": 0, "time_s": 0.0}]},
    )
    assert ours["Told lost"] == "1 time"
    assert ours["Keypoints"].endswith("joints.npz")
    assert facts_of(folder, {"settings": {"preset": "css_figure_6", "recovery": True}})[
        "Preset"
    ].startswith("css_figure_6: covariance scaled")
    assert facts_of(folder, {})["Preset"] == "not known"


def test_the_page_says_how_descents_ended(folder: Path) -> None:
    ended = {"running": 0, "converged": 3, "small_step": 90, "step_limit": 7, "non_finite": 0}
    told = facts_of(folder, {"optimiser_status": ended, "covariances_floored": 2})["Descents"]
    assert told == (
        "3 converged, 90 ended where no short step led lower, 7 stopped at the step limit, "
        "2 covariances had a least curvature put in"
    )
    filtered = {**dict.fromkeys(ended, 0), "non_finite": 4}
    assert "Descents" not in facts_of(folder, {"optimiser_status": filtered})


def test_the_page_says_what_told_the_size(folder: Path) -> None:
    run = Run.open(folder)
    track = run.track._replace(joint_names=("l_knee",), size_deviation=0.02)
    for ground, told in ((None, "METRES, or --ground"), (0.5, "the floor at 0.5 m tells the size")):
        known = replace(run, track=track._replace(settings={"ground": ground}))
        assert told in dict(report._facts(known))["Stature"]


def facts_of(folder: Path, summary: dict) -> dict[str, str]:
    """What the page tells of a run with keypoints and this summary."""
    write_summary(folder, summary)
    run = Run.open(folder)
    (camera,) = run.cameras
    files = replace(camera.files, keypoints=Path("joints.npz"))
    run = replace(run, track=run.track._replace(cameras=(camera._replace(files=files),)))
    return dict(report._facts(run))


def test_the_angle_is_that_of_the_longer_side(folder: Path) -> None:
    run = Run.open(folder)
    K = torch.tensor([[300.0, 0, 299.5], [0, 400, 399.5], [0, 0, 1]], dtype=torch.float64)
    (camera,) = run.cameras
    upright = camera._replace(camera=Camera(K, (600, 800), name="upright"))
    run = replace(run, track=run.track._replace(cameras=(upright,)))
    page = report.write_report_page(run).read_text()
    assert "600 x 800 pixels, focal length 300 pixels (90 degrees along the longer side)" in page

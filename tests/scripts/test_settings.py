"""Whatever tracks takes all of `Settings`, by one parser, and hands them to the session whole."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import made_robots
import numpy as np
import pytest
import tyro
from made_sequences import write_arm

import torchcss
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import Settings

PACKAGE = Path(torchcss.__file__).parent
SCRIPTS = PACKAGE.parent / "scripts"

CHANGED: dict[str, Any] = {
    "body": "arm7", "free_root": True, "preset": "ijrr_css", "samples": 7, "modes": 2,
    "prediction": "surface", "oversampling": 2, "likelihood_power": 0.3, "limb_jumps": 1,
    "keypoints_use": "first", "terms": ("contour", "region", "segmentation"),
    "curvature": "gauss-newton", "working_size": 160, "contour_weight": 120.0,
    "weights": {"region": 0.5}, "boundary_emphasis": 0.2, "potential": "leclerc", "seed": 3,
    "device": "cpu:0", "dtype": "float32", "engine": "eager", "engine_dtype": "float32",
    "threads": 2, "overlay": False, "stature": 1.6, "ground": -1.2,
}  # fmt: skip
"""Another value than the default for every setting."""

VARIED = {
    "ablation": set(),
    "benchmark_batch": set(),
    "benchmark_engines": set(),
    "evaluate_posterior": set(),
    "failure_modes": {"body", "preset"},
    "hypothesis_scores": {"body"},
    "learn_weights": {"body", "weights"},
    "long_run": {"body"},
    "model_variations": {"body", "preset"},
    "predictive_power": {"likelihood_power"},
    "printed_and_ours": {"body", "preset"},
    "profile_frame": set(),
    "several_views": set(),
    "spectra": {"body"},
    "track_quadruped": {"body", "stature"},
    "track_robot": {"body", "seed", "stature"},
}
"""What a script varies itself, or is told by what it tracks: a robot's size is that of its file,
and a stature is refused."""


class Caught(Exception):
    """The settings of a session that was about to begin."""


def arguments(folder: Path, script: str) -> list[str]:
    """The shortest way to a session."""
    if script == "benchmark_engines":
        write_arm(folder / "arm", 3)
        return ["--sequence", str(folder / "arm")]
    if script == "failure_modes":
        write_arm(folder / "arm", 3)
        return ["--sequence", str(folder / "arm"), "--presets", "css"]
    if script in ("hypothesis_scores", "model_variations", "printed_and_ours", "spectra"):
        write_arm(folder / "arm", 3)
        return ["--sequences", str(folder / "arm")]
    if script in ("ablation", "evaluate_posterior"):
        for name in ("video.mp4", "cameras.json", "keypoints2d.npz", "reference3d.npz"):
            (folder / name).touch()
        return ["--data", str(folder), "--runs", str(folder / "runs")]
    if script == "predictive_power":
        for name in ("video.mp4", "cameras.json", "reference3d.npz"):
            (folder / name).touch()
        arrays = {"confidence": np.ones((1, 1)), "keypoints": np.ones((1, 1, 2))}
        np.savez(folder / "keypoints2d.npz", joint_names=["l_wrist"], **arrays)
        return ["--data", str(folder), "--runs", str(folder / "runs")]
    if script == "track_robot":
        urdf = made_robots.write_arm(folder / "seven.urdf")
        return ["--urdf", str(urdf), "--link", "tip", "--frames", "2", "--out", str(folder / "out")]
    if script == "track_quadruped":
        urdf = made_robots.write_quadruped(folder / "quadruped.urdf")
        return ["--urdf", str(urdf), "--cameras", "1", "--frames", "1"]
    return {
        "benchmark_batch": ["--sequences", "1", "--frames", "1"],
        "long_run": ["--frames", "2", "--opened", "2"],
        "learn_weights": ["--frames", "2", "--epochs", "1", "--starts", "1",
                          "--learnt", "contour", "region"],
        "profile_frame": ["--clip", str(folder)],
        "several_views": ["--data", str(folder), "--what", "balance_beam_4cam"],
    }[script]  # fmt: skip


def options(settings: Mapping[str, Any]) -> list[str]:
    """Settings as they are written on a command line."""
    words: list[str] = []
    for name, value in settings.items():
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        elif isinstance(value, tuple):
            words += [f"--{flag}", *value]
        elif isinstance(value, Mapping):
            words += [f"--{flag}", *(str(word) for pair in value.items() for word in pair)]
        else:
            words += [f"--{flag}", str(value)]
    return words


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Settings]:
    """What the session of every script was given."""
    found = {}

    def catch(self: object, settings: Settings, *rest: object, **more: object) -> None:
        raise Caught(settings)

    def catch_video(*rest: object, settings: Settings, **more: object) -> None:
        raise Caught(settings)

    def catch_plan(sequence: object, settings: Settings, begin: object) -> None:
        raise Caught(settings)

    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SCRIPTS)
        patch.setattr(TrackingSession, "__init__", catch)
        for name in VARIED:
            script = importlib.import_module(name)
            if name in (
                "ablation",
                "several_views",
                "evaluate_posterior",
                "predictive_power",
                "profile_frame",
                "long_run",
            ):  # whose films are none, or whose body has a size that these settings would change
                tracks = script.posterior if name == "ablation" else script
                patch.setattr(tracks, "track_video", catch_video)
            if name == "hypothesis_scores":  # which refuses this preset, later
                patch.setattr(script, "plan_of", catch_plan)
            refused = {"stature"} & VARIED[name]
            given = {key: value for key, value in CHANGED.items() if key not in refused}
            words = [*arguments(tmp_path_factory.mktemp(name), name), *options(given)]
            with pytest.raises(Caught) as caught:
                script.main(tyro.cli(script.Config, args=words))
            found[name] = caught.value.args[0]
    return found


def test_every_setting_is_changed() -> None:
    assert set(CHANGED) == {field.name for field in fields(Settings)}
    usual = Settings()
    assert all(getattr(usual, name) != value for name, value in CHANGED.items())


@pytest.mark.parametrize("name", CHANGED)
@pytest.mark.parametrize("script", VARIED)
def test_a_setting_reaches_the_session(
    sessions: dict[str, Settings], script: str, name: str
) -> None:
    if name in VARIED[script]:
        assert getattr(sessions[script], name) != CHANGED[name]
    else:
        assert getattr(sessions[script], name) == CHANGED[name]


def test_every_script_that_tracks_is_among_them() -> None:
    tracking = (
        *("TrackingSession", "track_video", "track_sequence", "track_together", "run_demo"),
        "session_of",
        *("common.comparison", "evaluate_posterior as posterior"),
    )
    found = {
        path.stem
        for path in SCRIPTS.glob("*.py")
        if any(name in path.read_text(encoding="utf-8") for name in tracking)
    }
    assert found == set(VARIED)


def test_nothing_but_the_session_steps_a_tracker() -> None:
    for path in [*PACKAGE.rglob("*.py"), *SCRIPTS.rglob("*.py")]:
        if "inference" in path.parts or path == PACKAGE / "tracking" / "session.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                # `Tracker.step` takes state, problem and bounds, as an optimiser's step does; a
                # session's takes an observation.
                steps = node.func.attr == "step" and len(node.args) + len(node.keywords) >= 3
                assert not steps or ast.unparse(node.func.value) in ("number", "newton"), (
                    path,
                    node.lineno,
                )

"""The study of failure modes in its small mode."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from made_sequences import write_arm
from peers.published import PUBLISHED

from torchcss.errors import ConfigurationError
from torchcss.studies.evaluation import Thresholds
from torchcss.studies.plots import ErrorCurves, error_curves, failure_figure
from torchcss.studies.sequences import read_sequence
from torchcss.tracking.presets import PRESETS
from torchcss.tracking.settings import TERMS, Settings


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study") / "arm"
    write_arm(folder, 3)
    return folder


def test_small_mode_and_resume(
    script: ModuleType, arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    out, plot = tmp_path / "tables" / "j.json", tmp_path / "p.png"
    options = {"sequence": arm, "small": True, "out": out, "plot": plot}
    presets = ("ijrr_robust_single", "ijrr_condensation")
    script.main(script.Config(presets=presets[:1], seeds=1, **options))
    assert plot.stat().st_size > 10_000

    asked = []
    follow = script.follow

    def spy(config, sequence, together, thresholds):
        asked.append([(each.preset, each.seed) for each, _ in together])
        return follow(config, sequence, together, thresholds)

    monkeypatch.setattr(script, "follow", spy)
    script.main(script.Config(presets=presets, seeds=2, resume=True, together=1, **options))
    assert asked == [
        [("ijrr_condensation", 0)],
        [("ijrr_robust_single", 1)],
        [("ijrr_condensation", 1)],
    ]
    report = json.loads(out.read_text())
    assert [(run["preset"], run["seed"]) for run in report["runs"]] == [
        ("ijrr_robust_single", 0), ("ijrr_condensation", 0),
        ("ijrr_robust_single", 1), ("ijrr_condensation", 1),
    ]  # fmt: skip
    for run in report["runs"]:
        assert run["ended"] == "complete"
        assert run["num_frames"] == len(run["per_frame"]["time_s"]) == 3
        assert run["per_frame"]["frame"] == [0, 1, 2]
        assert np.shape(run["per_frame"]["joints_mm"]) == (3, len(run["joints"]), 3)
    rows = report["by_tracker"]
    assert set(rows) == set(presets)
    row = rows["ijrr_robust_single"]
    assert (row["seeds"], row["lost"], row["errors"]) == (2, 0, 0)
    assert row["lost_s"] == [None] * 3
    middle, least, most = row["root_aligned_mm"]
    errors = sorted(run["root_aligned_mm"] for run in report["runs"][::2])
    assert (least, most) == pytest.approx(tuple(errors))
    assert middle == pytest.approx(sum(errors) / 2)
    assert rows["ijrr_condensation"]["evaluations_per_frame"][0] == 6
    steps = PRESETS["ijrr_robust_single"].optimiser.max_steps
    assert 1 < row["evaluations_per_frame"][0] < steps, "one descent, which converges"
    assert {entry["preset"] for entry in report["published"]} >= {
        "ijrr_gaussian_single",
        "ijrr_css",
    }
    weight = report["apart_weight"]["ijrr_condensation"]
    assert len(weight["by_step"]) == 1, "within the first half second"
    assert weight["by_step"] == weight["whole"]
    text = capsys.readouterr().out
    assert "Weight of other explanations" in text
    assert "2.6 s" in text  # the paper's robust tracker
    assert "0 of 2" in text
    assert "never" in text

    for changed in ({"terms": ("default", "background")}, {"prediction": "surface"}, None):
        tracking = Settings(keypoints_use="first", overlay=False, **(changed or {}))
        change = {"tracking": tracking} if changed else {"start": 1}
        with pytest.raises(ConfigurationError, match="another study"):
            script.main(script.Config(resume=True, **change, **options))
    with pytest.raises(ConfigurationError, match="at least 1, got 0"):
        script.main(script.Config(together=0, **options))

    # Side by side, of several seeds, they do what they do alone.
    asked.clear()
    beside = {**options, "out": tmp_path / "beside.json", "plot": None}
    again = script.main(script.Config(presets=presets, seeds=2, together=3, **beside))
    assert asked == [
        [("ijrr_robust_single", 0), ("ijrr_condensation", 0), ("ijrr_robust_single", 1)],
        [("ijrr_condensation", 1)],
    ]
    found = {(run["preset"], run["seed"]): run["root_aligned_mm"] for run in again["runs"]}
    for run in report["runs"]:
        assert found[run["preset"], run["seed"]] == run["root_aligned_mm"]


def test_how_trackers_are_set_up_can_be_chosen(script: ModuleType, arm: Path) -> None:
    tracking = Settings(
        terms=("default", "silhouette"), likelihood_power=0.3, prediction="surface", limb_jumps=2
    )
    config = script.Config(sequence=arm, tracking=tracking)
    settings = script.settings_of(config, "body34", "css", 1)
    assert settings.terms == (*TERMS, "silhouette")
    assert (settings.likelihood_power, settings.prediction, settings.seed) == (0.3, "surface", 1)
    assert settings.limb_jumps == 2
    assert script.settings_of(script.Config(sequence=arm), "arm8", "css", 0).used_terms == TERMS


def test_weights_of_other_explanations_over_time(script: ModuleType) -> None:
    runs = [
        {"time_s": [0.0, 0.25, 0.5, 1.0], "apart_weight": [0.0, 0.2, 0.4, 0.8]},
        {"time_s": [0.0, 0.25], "apart_weight": [0.2, 0.2]},
    ]
    weight = script.weight_over_time(runs)
    np.testing.assert_allclose(weight["by_step"], [[0.15, 0.1, 0.2], [0.4] * 3, [0.8] * 3])
    np.testing.assert_allclose(weight["whole"], [[0.275, 0.2, 0.35]])
    table = script.weights_table({"css": weight, "one": script.weight_over_time([
        {"time_s": [0.0], "apart_weight": [0.0]}
    ])})  # fmt: skip
    assert table.columns == ("tracker", "all", "from 0 s", "from 0.5 s", "from 1 s")
    (row,) = table.rows
    assert row[0] == "css"
    np.testing.assert_allclose(row[1:], [0.275, 0.15, 0.4, 0.8])


def test_another_arm_can_track(script: ModuleType, arm: Path) -> None:
    sequence = read_sequence(arm)
    limits = Thresholds.of(sequence)
    assert script.study_of(script.Config(sequence=arm), sequence, limits)["body"] == "arm8"
    config = script.Config(sequence=arm, tracked_as="arm7")
    assert script.study_of(config, sequence, limits)["body"] == "arm7"


def test_a_lost_track_in_the_table(
    script: ModuleType, arm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times = [0.0, 0.04, 0.08]
    measured = {"time_s": times, "root_aligned_mm": [10.0, 300.0, None]}
    measured["apart_weight"] = [0.0, 0.0, 0.0]
    measured["root_aligned_best_of_modes_mm"] = [10.0, 200.0, 200.0]
    base = {"preset": "ijrr_single_limits", "ended": "lost", "num_frames": 3, "per_frame": measured}
    entries = {key: 1.0 for key, _ in script.COLUMNS.values()}
    runs = [
        {**base, **entries, "seed": 0, "lost": True, "lost_s": 0.04},
        {**base, **entries, "seed": 1, "lost": False, "lost_s": None, "ended": "complete"},
        {"preset": "ijrr_single_limits", "seed": 2, "ended": "error: LinAlgError: singular"},
    ]
    config = script.Config(sequence=arm, presets=("ijrr_single_limits",))
    report = script.write(config, {"sequence": "arm"}, runs)
    script.trackers_table(report["by_tracker"], "arm").print()
    text = capsys.readouterr().out
    assert "1 of 2" in text
    assert "- (0.0..-)" in text
    assert report["by_tracker"]["ijrr_single_limits"]["errors"] == 1
    shown, (curve,) = error_curves(runs, {"ijrr_single_limits": (2.6,)})
    assert shown.tolist() == times
    np.testing.assert_equal(curve.best_mm, [[10, 300, np.nan]] * 2)
    np.testing.assert_equal(curve.lost_s, [0.04, np.nan])
    assert curve.published_s == (2.6,)
    runs[0]["per_frame"] = {key: values[:2] for key, values in measured.items()}
    _, (curve,) = error_curves(runs, {})
    np.testing.assert_equal(curve.best_mm[0], [10, 300, np.inf])  # it was stopped


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"presets": ("nobody",)}, "no tracker 'nobody'"),
        ({"resume": True, "out": None}, "expected --out"),
    ],
)
def test_bad_options(
    script: ModuleType, arm: Path, change: dict[str, object], message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message):
        script.main(script.Config(sequence=arm, **change))


def test_published_figures_are_of_our_trackers() -> None:
    assert {row.preset for row in PUBLISHED} <= set(PRESETS)
    pairs = [(row.sequence, row.preset) for row in PUBLISHED]
    assert len(set(pairs)) == len(pairs)
    told = {pair: row.told for pair, row in zip(pairs, PUBLISHED, strict=True)}
    assert told["arm", "ijrr_gaussian_single"] == "0.5 s and 2.2 s"
    assert told["arm", "ijrr_css"] == "never"
    assert told["body-dark", "ijrr_css_limits"] == "fails"


def test_the_figure_shows_medians_ranges_and_losses() -> None:
    times = np.array([0.0, 0.1, 0.2])
    lost = np.array([[10.0, 20, 30], [20, 400, np.inf], [30, np.nan, np.inf]])
    curves = [
        ErrorCurves("a", lost, lost - 1, [np.nan, 0.1, 0.1], [0.15, 7.0]),
        *[ErrorCurves(str(i), lost[:1], lost[:1], [np.nan]) for i in range(4)],
    ]
    figure = failure_figure(times, curves, title="t", failed_mm=250.0)
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert len(shown) == 5
    lines = {line.get_label(): line for line in shown[0].get_lines()}
    np.testing.assert_allclose(lines["best mode, median"].get_ydata(), [20, 210, np.nan])
    assert list(lines["body lost"].get_xdata()) == [0.1, 0.1]
    assert list(lines["failure in the paper, on its own sequence"].get_xdata()) == [0.15]
    assert "body lost" not in {line.get_label() for line in shown[1].get_lines()}

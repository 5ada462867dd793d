"""Table 1 in its small mode."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import ModuleType

import pytest
import torch

from torchcss.inference.proposals import CovarianceScaled
from torchcss.studies.reprojection import ReprojectionProblem
from torchcss.studies.sampling_study import (
    SamplerRun,
    StudyChoice,
    run_sampler,
    spectrum,
    study_problem,
)


def test_small_mode(script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, figures = tmp_path / "tables" / "table1.json", tmp_path / "figures"
    config = script.Config(samples=80, scales=(1.0, 8.0), seed=1, out=out, figures=figures)
    script.main(config)
    report = json.loads(out.read_text())
    (run,) = report["runs"]
    rows = {(row["method"], row["scale"]): row for row in run["rows"]}
    assert set(rows) == {("CSS", 1.0), ("CSS", 8.0), ("SS", 1.0), ("SS", 8.0)}
    for scale in (1.0, 8.0):
        assert rows["CSS", scale]["cost_raw"] < rows["SS", scale]["cost_raw"]
    assert rows["CSS", 8.0]["minima"] > max(rows["SS", 8.0]["minima"], rows["CSS", 1.0]["minima"])
    assert report["css_over_ss"]["8"] == pytest.approx(
        rows["CSS", 8.0]["minima"] / rows["SS", 8.0]["minima"]
    )
    for row in rows.values():
        assert row["converged"] > 0.9
        assert row["inside"] == 1
        assert row["upward"] >= row["converged"], "what converged curves upwards"
        assert row["minima_double"] <= row["minima"] <= row["minima_half"]
        assert row["valleys"] <= row["minima"]
        assert 0 < row["back"] <= 1
    assert rows["CSS", 8.0]["back"] < rows["CSS", 1.0]["back"]
    for scale in (1.0, 8.0):
        assert 0 <= rows["SS", scale]["shared"] <= rows["SS", scale]["minima"]
    assert sum(rows["CSS", 8.0]["flips"].values()) > 0
    assert run["spectrum_ratio"]["body32"] > 300
    assert {path.name for path in figures.iterdir()} == {
        "fig1_seed1.png", "fig5_seed1.png", "fig13_seed1.png",
    }  # fmt: skip
    text = capsys.readouterr().out
    assert "paper" in text
    assert "flipped" in text


def test_medians_and_a_given_pose(script: ModuleType, tmp_path: Path) -> None:
    pose = tmp_path / "pose.json"
    pose.write_text(json.dumps({"r_elbow_flexion": 1.2, "r_shoulder_swing": -0.5}))
    config = script.Config(
        body="arm8", samples=40, scales=(4.0,), num_seeds=2, pose=pose, exact_steps=False,
        choice=StudyChoice(robust=True, limits=False), correlated_projection=True,
    )  # fmt: skip
    report = script.main(config)
    assert len(report["runs"]) == 2
    costs = sorted(run["rows"][0]["cost_raw"] for run in report["runs"])
    assert report["median"][0]["cost_raw"] == pytest.approx(sum(costs) / 2)
    problem = script.make_problem(config, 0, "arm8")
    index = problem.cost.body.state_index("r_elbow_flexion")
    assert float(problem.truth[index]) == 1.2
    assert bool(problem.bounds.lower.isinf().all())


@pytest.fixture(scope="module")
def problem() -> ReprojectionProblem:
    return study_problem("arm8", generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def run(problem: ReprojectionProblem) -> SamplerRun:
    proposal = CovarianceScaled(deviation_scale=4, include_modes=False)
    return run_sampler(problem, proposal, 100, generator=torch.Generator().manual_seed(1))


def test_minima_that_two_runs_share(
    script: ModuleType, problem: ReprojectionProblem, run: SamplerRun
) -> None:
    found, count = run.found, len(run.found.minima)
    assert count > 1
    assert script.num_shared(found, found, problem.start) == count
    half = found._replace(minima=found.minima[: count // 2])
    assert script.num_shared(half, found, problem.start) == count // 2
    assert script.num_shared(found, half, problem.start) >= count // 2
    nothing = found._replace(minima=found.minima[:0])
    assert script.num_shared(nothing, found, problem.start) == 0
    assert script.num_shared(found, nothing, problem.start) == 0


def test_figures_of_runs_with_and_without_minima(
    script: ModuleType, problem: ReprojectionProblem, run: SamplerRun
) -> None:
    runs = {"CSS": run, "SS": run}
    assert len(script.samples_and_minima_figure(runs, "title").axes) == 12
    assert len(script.minima_and_costs_figure(runs).axes) == 2
    nothing = run._replace(minima=type(run.minima)(*(part[:0] for part in run.minima)))
    for made in (
        script.samples_and_minima_figure({"SS": nothing}),
        script.minima_and_costs_figure({"SS": nothing}),
    ):
        made.canvas.draw()
    spectra = script.eigenvector_figure({"arm8": spectrum(problem.start.covariance).tolist()})
    shown = spectra.axes[0].lines[0].get_ydata()[0]
    assert math.isclose(shown, float(spectrum(problem.start.covariance)[0]))

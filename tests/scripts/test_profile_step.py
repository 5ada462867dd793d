"""The compiled tracker step: one graph, equal to eager, not compiled again; the script's files.

In a process of its own: what is compiled stays in a process, and so do the compiler's threads. Only
the arm is compiled, once; the kernels come from the compiler's cache where they have been before.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "profile_step.py"
COMPILER = os.environ.get("CXX") or next(filter(shutil.which, ("g++", "clang++")), None)

pytestmark = pytest.mark.skipif(COMPILER is None, reason="compiling needs a C++ compiler")


def test_small_mode(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    out = tmp_path / "tables" / "profile.json"
    options = ("--bodies=arm8", "--samples", "30", "--repeats=1", "--cached")
    where = (f"--out={out}", f"--folder={tmp_path}", "--dtype=float64", "--at-least-s=0.02")
    command = [sys.executable, str(SCRIPT), *options, *where]
    # Kernels without vector instructions are compiled sooner and are the same on every machine. In
    # a cache of their own: the compiler would take vector code for theirs.
    cache = tmp_path_factory.getbasetemp().parent / "scalar_kernels"
    scalar = {
        **os.environ, "ATEN_CPU_CAPABILITY": "default", "TORCHINDUCTOR_CACHE_DIR": str(cache),
    }  # fmt: skip
    run = subprocess.run(command, capture_output=True, text=True, env=scalar)
    # A broken graph, or a second compilation for the second frame, ends the script.
    assert run.returncode == 0, run.stderr
    (row,) = json.loads(out.read_text())["rows"]
    assert row["graphs"] == 1
    apart = row["relative_difference"]
    assert set(apart) == {
        "x", "value", "gradient", "hessian", "step", "predicted", "decided_otherwise",
    }  # fmt: skip
    assert max(apart.values()) < 1e-9
    assert row["times_as_fast"].keys() == {"compiled", "fused"}
    for way in ("eager", "compiled", "fused"):
        assert row[way]["seconds"]["median"] > 0
        assert row[way]["memory_mib"] > 0
        assert 0 <= row[way]["library_share"] < 1
        stages = row[way]["stages"]
        rest, whole = stages.pop("the rest"), stages.pop("all")
        assert set(stages) == {"drawing", "keypoints", "priors", "planning"}
        assert whole["seconds"] == pytest.approx(row[way]["seconds"]["median"])
        own = sum(stage["seconds"] for stage in stages.values())
        assert own + rest["seconds"] == pytest.approx(whole["seconds"])
        for stage in (*stages.values(), whole):
            assert stage["seconds"] > 0
            if way == "compiled" and stage is not whole:
                assert stage["overhead"] is None  # it is the whole graph's
            else:
                assert 0 <= stage["overhead"] <= 1
            assert stage["times_arithmetic"] > 0
        stem = tmp_path / f"arm8_30_{way}"
        assert "cholesky" in stem.with_suffix(".txt").read_text() or way != "compiled"
        assert json.loads(stem.with_suffix(".json").read_text())["traceEvents"]
    needed = row["operations"]
    # A triangular factor times noise, by the scale and to the mean; Cholesky of three dampings.
    assert needed["drawing"] == 2 * 36 + 8 + 8
    assert needed["planning"] > 3 * 8**3 / 3
    assert needed["all"] == pytest.approx(sum(needed[name] for name in stages))
    assert (tmp_path / "profile.png").is_file()
    assert "arm8" in run.stdout
    assert "times as fast" in run.stdout

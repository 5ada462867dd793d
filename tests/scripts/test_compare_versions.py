"""Another version beside this one: here the same, on two frames of the shipped clip.

Environments are made of a package that needs nothing, so that no network is asked.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from torchcss.errors import ConfigurationError
from torchcss.studies.demo import CLIP

PROJECT = """[project]
name = "torchcss"
version = "0.0"
[build-system]
requires = []
build-backend = "backend"
backend-path = ["."]
"""
BACKEND = """
from pathlib import Path
from zipfile import ZipFile

def build_editable(folder, config_settings=None, metadata_directory=None):
    about = "torchcss-0.0.dist-info/"
    with ZipFile(Path(folder) / "torchcss-0.0-py3-none-any.whl", "w") as wheel:
        wheel.writestr("torchcss.pth", str(Path.cwd()))
        wheel.writestr(about + "METADATA", "Metadata-Version: 2.1\\nName: torchcss\\nVersion: 0.0")
        wheel.writestr(about + "WHEEL", "Wheel-Version: 1.0\\nTag: py3-none-any")
        wheel.writestr(about + "RECORD", "")
    return wheel.filename.rpartition("/")[2]
"""
SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "compare_versions.py"


def is_repository() -> bool:
    words = ["git", "-C", str(SCRIPT.parent), "rev-parse", "HEAD"]
    return subprocess.run(words, capture_output=True).returncode == 0


@pytest.fixture
def repository(tmp_path: Path, script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository, in the place of this one, with a version of the package that is empty."""
    folder = tmp_path / "repository"
    (folder / "torchcss").mkdir(parents=True)
    (folder / "torchcss" / "__init__.py").touch()
    (folder / "pyproject.toml").write_text(PROJECT)
    (folder / "backend.py").write_text(BACKEND)
    (folder / "constraints.txt").touch()
    monkeypatch.setattr(script, "REPOSITORY", folder)
    who = ["-c", "user.name=nobody", "-c", "user.email=nobody@localhost"]
    for words in ["init", "--quiet"], ["add", "."], [*who, "commit", "--quiet", "-m", "all"]:
        subprocess.run(["git", "-C", str(folder), *words], check=True)
    return folder


def test_an_environment_of_its_own(
    script: ModuleType, repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(SCRIPT.parents[1]))
    config = script.Config(against="HEAD", environments=tmp_path / "environments")
    (tmp_path / "none").write_text("torchcss==0.1\n")
    with monkeypatch.context() as refused:
        refused.setenv("PIP_CONSTRAINT", str(tmp_path / "none"))
        with pytest.raises(ConfigurationError, match=r"--against HEAD: (.|\n)*ERROR: .*torchcss"):
            script.other_version(config)
    other = script.other_version(config)  # half an environment is none
    assert script.packages(other).endswith("no torch, no numpy, no numba")
    (place,) = config.environments.iterdir()
    assert other.variables()["TORCHCSS_CACHE"] == str(place)
    installed = subprocess.check_output([other.python, "-I", "-m", "pip", "freeze"], text=True)
    assert "torchcss" in installed
    # What is there is not installed again.
    (place / "environment" / "pyvenv.cfg").write_text("")
    assert script.other_version(config) == other
    assert (place / "environment" / "pyvenv.cfg").read_text() == ""


def test_the_package_has_to_be_its_own(script: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="expected its package, got"):
        script.packages(
            script.Version(tmp_path, sys.executable, {"PYTHONPATH": str(SCRIPT.parents[1])})
        )


@pytest.mark.skipif(not is_repository(), reason="this is no git repository")
def test_small_mode(script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "versions.json"
    config = script.Config(
        against="HEAD", environments=tmp_path, same_environment=True, frames=2, repeats=1,
        two=True, out=out,
    )  # fmt: skip
    # Each of five processes would search for a first pose, for seconds.
    arm = [*script.clips(config)["arm"], "--samples", "4"]
    given = {"arm": [*arm, "--init", str(CLIP / "body.npz")]}
    monkeypatch.setattr(script, "clips", lambda config: given)
    report = script.main(config)
    assert list(report["rows"]) == ["arm: other", "arm: this", "arm: two threads"]
    for row in report["rows"].values():
        assert 0 < row["seconds_per_frame"] < row["seconds"]
        assert row["memory_mib"] > 100
    assert report["rows"]["arm: other"]["times_as_fast"] == [1, 1, 1]
    written = json.loads(out.read_text())
    assert len(written["table"]["rows"]) == 3
    other, this = written["note"].split("; ")
    assert other.removeprefix("HEAD: ") == this.removeprefix("this version: ")
    assert f"numpy {np.__version__}" in this


def test_a_version_that_is_none_is_told(script: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="--against v99"):
        script.main(script.Config(against="v99", environments=tmp_path))


def test_what_is_tracked(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert list(script.clips(script.Config(against="v0.1"))) == ["arm"]
    monkeypatch.chdir(tmp_path)  # the versions run in folders of their own
    found = script.clips(script.Config(against="v0.1", data=Path(), frames=7))
    assert list(found) == ["arm", "beam", "beam, first"]
    assert all(words[words.index("--stop") + 1] == "7" for words in found.values())
    assert found["beam"][0] == str(tmp_path / "balance_beam_4cam" / "cam01.mp4")


def test_numbers_of_samples(script: ModuleType, tmp_path: Path) -> None:
    config = script.Config(against="v0.1", data=tmp_path, samples=(10, 60))
    found = script.clips(config)
    assert list(found) == ["10 samples", "60 samples"]
    assert all("cam01" in words for words in found.values())
    rows = {f"{num} samples: this": {"seconds_per_frame": num} for num in config.samples}
    (line,) = script.seconds_figure(config, rows).axes[0].lines
    assert list(line.get_ydata()) == [10, 60]

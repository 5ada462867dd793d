"""The page "From the papers to the code": complete, and every reference on it leads somewhere."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from torchcss.tracking.presets import PRESETS
from torchcss.tracking.settings import Settings

REPOSITORY = Path(__file__).resolve().parents[1]
PAGES = ("from_the_papers_to_the_code.md", "mathematics.md", "decisions.md")
PAPERS = (REPOSITORY / "docs" / PAGES[0]).read_text(encoding="utf-8")

NUMBERS = {
    ("[IJRR]", "eq."): 13,
    ("[IJRR]", "Fig."): 15,
    ("[IJRR]", "Table"): 1,
    ("[RR]", "eq."): 11,
    ("[RR]", "Fig."): 9,
}
"""The last number of each kind in either paper."""


def resolve(reference: str) -> object:
    """The module, or what a module holds, or the field of a record."""
    module_name, names = reference, []
    while True:
        try:
            found: object = importlib.import_module(module_name)
            break
        except ModuleNotFoundError:
            module_name, _, name = module_name.rpartition(".")
            names.insert(0, name)
    for name in names:
        fields = getattr(found, "__annotations__", {})
        found = getattr(found, name) if hasattr(found, name) else fields[name]
    return found


def references(text: str) -> set[str]:
    return set(re.findall(r"`(torchcss(?:\.\w+)+)`", text))


@pytest.mark.parametrize("page", PAGES)
def test_every_name_is_in_the_package(page: str) -> None:
    text = (REPOSITORY / "docs" / page).read_text(encoding="utf-8")
    found = references(text)
    assert found
    for reference in sorted(found):
        resolve(reference)


def test_a_name_that_is_not_there_is_noticed() -> None:
    for wrong in ("torchcss.robust.Lorentz", "torchcss.roboust", "torchcss.types.Modes.meen"):
        with pytest.raises((AttributeError, KeyError)):
            resolve(wrong)


@pytest.mark.parametrize("page", PAGES)
def test_every_file_exists(page: str) -> None:
    text = (REPOSITORY / "docs" / page).read_text(encoding="utf-8")
    files = re.findall(r"\b((?:scripts|notebooks|tests|docs)/[\w/]+\.\w+)", text)
    linked = re.findall(r"\]\((?!https?:)([^)#]+)\)", text)
    for path in files:
        assert (REPOSITORY / path).is_file(), path
    for path in linked:
        assert (REPOSITORY / "docs" / path).is_file(), path


@pytest.mark.parametrize(("paper", "kind"), NUMBERS)
def test_every_number_is_there_once(paper: str, kind: str) -> None:
    sections = re.split(r"^## ", PAPERS, flags=re.MULTILINE)[1:]
    own = "\n".join(section for section in sections if section.startswith(paper))
    cells = rf"^\| {re.escape(kind)} (\d+) \|(.*)\|(.*)\|(.*)\|(.*)\|$"
    rows = re.findall(cells, own, flags=re.MULTILINE)
    assert [int(number) for number, *_ in rows] == list(range(1, NUMBERS[paper, kind] + 1))
    for number, what, where, used, held in rows:
        assert what.strip(), number
        assert used.strip(), number
        assert "::test_" in held, number
        honest = "not reproduced" in where or "the same" in where or "as " in where
        assert honest or "`" in where or "](" in where, number


def test_every_test_preset_and_decision_of_the_page_is_there() -> None:
    tests = set(re.findall(r"`(tests/[\w/]+\.py)::(test_\w+)`", PAPERS))
    assert len(tests) > 60
    for path, name in sorted(tests):
        text = (REPOSITORY / path).read_text(encoding="utf-8")
        assert re.search(rf"^def {name}\(", text, flags=re.MULTILINE), (path, name)
    told = (REPOSITORY / "docs" / "decisions.md").read_text(encoding="utf-8")
    for decision in re.findall(r'decision "([^"]+)"', PAPERS):
        assert f"| **{decision}** |" in told, decision
    presets = set(re.findall(r"`((?:ijrr|rr|heap|condensation)_\w+)`", PAPERS))
    assert presets <= set(PRESETS)
    assert {name for name in PRESETS if name.startswith("rr_")} <= presets


def test_the_page_says_which_of_the_papers_trackers_keep_parts_apart() -> None:
    (used,) = re.findall(r"^\| 3\.2\.4 \|.*\|.*\|(.*)\|.*\|$", PAPERS, flags=re.MULTILINE)
    papers = {name for name in PRESETS if name.startswith(("ijrr_", "rr_"))}
    repel = {name for name in papers if "interpenetration" in Settings(preset=name).used_terms}
    assert set(re.findall(r"`(\w+)`", used)) == repel


def test_every_step_of_both_algorithms_has_a_line() -> None:
    steps = ("1", "2.1", "2.2", "2.3", "3", "4", "5", "6")
    for step in [f"Fig. 6, {step}" for step in steps] + [
        "[RR] Fig. 4, descent", "[RR] Fig. 4, pattern", "[RR] Fig. 4, scores",
        "[RR] Fig. 4, pruning",
    ]:  # fmt: skip
        assert f"{step} |" in PAPERS, step


def test_every_decision_that_is_cited_is_told() -> None:
    page = (REPOSITORY / "docs" / "decisions.md").read_text(encoding="utf-8")
    told = set(re.findall(r"^\| \*\*([a-z' ]+)\*\* \|", page, flags=re.MULTILINE))
    cited: set[str] = set()
    for folder in ("torchcss", "scripts"):
        for path in (REPOSITORY / folder).rglob("*.py"):
            text = " ".join(path.read_text(encoding="utf-8").split())
            assert not re.search(r"[Dd]ecision \d", text), f"{path}: by its name, not a number"
            found = set(re.findall(r'decision "([^"]+)"', text))
            assert found <= told, path
            cited |= found
    assert cited == told

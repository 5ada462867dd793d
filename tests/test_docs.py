"""The site: a part of it is built, with warnings as errors, as the whole is."""

from __future__ import annotations

import html
import importlib.util
import re
import sys
import warnings
from pathlib import Path
from types import ModuleType

import nbformat
import pytest

with warnings.catch_warnings():  # theirs, and none of the build's
    warnings.simplefilter("ignore")
    for needed in ("pdoc", "nbconvert", "latex2mathml"):
        pytest.importorskip(needed, reason='the site needs pip install ".[docs]"')

REPOSITORY = Path(__file__).resolve().parents[1]
BESIDE = ("torchcss.robust", "torchcss.types", "torchcss.vision.camera")
"""Documented with all that is in torchcss.cost, which refers to them."""


@pytest.fixture(scope="module")
def builder() -> ModuleType:
    path = REPOSITORY / "docs" / "build.py"
    specification = importlib.util.spec_from_file_location("docs_build", path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules["docs_build"] = module
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def site(builder: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site") / "site"
    costs = [name for name in builder.public_modules() if name.startswith("torchcss.cost")]
    builder.build(folder, modules=(*BESIDE, *costs), execute=False)
    return folder


def test_pages(site: Path) -> None:
    names = {path.stem for path in site.glob("*.html")}
    notebooks = {path.stem for path in (REPOSITORY / "notebooks").glob("*.ipynb")}
    assert notebooks
    written = {path.stem for path in (REPOSITORY / "docs").glob("*.md")}
    guide = {"index", "scripts", "contributing", "changelog"} | written
    assert names >= guide | notebooks
    assert (site / "search.js").stat().st_size > 0


def test_api_page(site: Path) -> None:
    text = (site / "torchcss" / "cost" / "contour.html").read_text()
    words = html.unescape(re.sub("<[^>]+>", "", text))
    assert "uv: Float[Tensor, '*batch p 2']" in words
    assert 'href="../robust.html#Lorentzian"' in text
    assert "Alias for field number" not in text
    assert 'href="../torchcss/cost/contour.html"' in (site / "torchcss" / "cost.html").read_text()
    # Types that a dataclass has from a base in another module are known, too.
    assert 'href="../vision/camera.html#Camera"' in (site / "torchcss/cost/total.html").read_text()
    # The members of a private base class are explained where its public children point to.
    assert 'id="RobustPotential.sigma"' in (site / "torchcss" / "robust.html").read_text()


def test_guide_pages(site: Path) -> None:
    mathematics = (site / "mathematics.html").read_text()
    assert "<math" in mathematics
    assert "$" not in re.sub("<script>.*?</script>", "", mathematics, flags=re.DOTALL)
    papers = (site / "from_the_papers_to_the_code.html").read_text()
    assert 'href="scripts.html#table1"' in papers
    assert 'href="02_features_and_cost.html"' in papers
    assert 'href="torchcss/cost/contour.html#ContourTerm' in papers
    notebook = (site / "01_first_track.html").read_text()
    assert notebook.count('<img src="pictures/01_first_track') >= 3


def test_every_module_is_on_the_site(builder: ModuleType) -> None:
    below = (REPOSITORY / "torchcss").rglob("*.py")
    names = {".".join(path.relative_to(REPOSITORY).with_suffix("").parts) for path in below}
    assert set(builder.public_modules()) == {name.removesuffix(".__init__") for name in names}


def test_a_link_that_leads_nowhere_is_told(builder: ModuleType, tmp_path: Path) -> None:
    page = '<a href="{}">x</a><h1 id="here">x</h1><a href="https://example.org/none">x</a>'
    (tmp_path / "good.html").write_text(page.format("bad.html#here"))
    (tmp_path / "bad.html").write_text(page.format("good.html#there"))
    assert list(builder.broken_links(tmp_path)) == ["bad.html: good.html#there"]
    (tmp_path / "bad.html").write_text(page.format("no.png"))
    assert list(builder.broken_links(tmp_path)) == ["bad.html: no.png"]


def test_folders_of_others_are_left_alone(builder: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("all of it")
    with pytest.raises(SystemExit, match="something other than a site"):
        builder.build(tmp_path, modules=(), execute=False)
    assert (tmp_path / "thesis.tex").exists()


def test_bare_notebooks_are_executed(
    builder: ModuleType, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    notebook = nbformat.v4.new_notebook(
        cells=[nbformat.v4.new_code_cell("import os; print('in', os.path.basename(os.getcwd()))")]
    )
    nbformat.write(notebook, tmp_path / "small.ipynb")
    text = builder.notebook_text(tmp_path / "small.ipynb", tmp_path, execute=True)
    assert f"in {tmp_path.name}" in text
    assert "WARNING" not in capfd.readouterr().err

"""The guide's code runs as it stands, and does what the page says."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

GUIDE = Path(__file__).resolve().parents[1] / "docs" / "guide.md"


@pytest.fixture
def kept_dtype() -> Iterator[None]:
    """The page sets the default type; other tests keep theirs."""
    before = torch.get_default_dtype()
    yield
    torch.set_default_dtype(before)


@pytest.mark.usefixtures("kept_dtype")
def test_the_search_on_a_cost_of_ones_own() -> None:
    page = GUIDE.read_text(encoding="utf-8")
    section = page.split("## Try the search on a cost of your own")[1].split("\n## ")[0]
    code = re.search(r"```python\n(.*?)```", section, flags=re.DOTALL)
    assert code is not None
    said: dict = {}
    exec(code[1], said)
    css, particles = said["found"]["css"], said["found"]["condensation"]
    for found in (said["minima"].mean, css.mean):
        assert sorted(found[:, 0].round(decimals=2).tolist()) == [-1.5, 1.5]
    torch.testing.assert_close(css.weight, torch.full((2,), 0.5).double(), rtol=0, atol=1e-3)
    assert bool((particles.mean[:, 0] < 0).all())
    # A step of the slice's length along a straight line leaves the valley, and comes to no less.
    assert float(said["slice_nats"].min()) >= -1e-9
    assert said["deviations"].tolist() == sorted(said["deviations"].tolist(), reverse=True)

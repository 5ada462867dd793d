"""The problem of some of the samples."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchcss.inference.problem import SearchProblem
from torchcss.types import LocalModel


class PerItem(NamedTuple):
    """A cost with a number for each item, whatever its state."""

    offset: Tensor

    def value(self, x: Tensor) -> Tensor:
        return self.offset + 0.0 * x[:, 0]

    def local_model(self, x: Tensor) -> LocalModel:
        return LocalModel(self.value(x), torch.zeros_like(x), torch.diag_embed(0.0 * x))

    def take(self, items: Tensor) -> PerItem:
        return PerItem(self.offset[items])


def test_every_cost_of_a_problem_is_taken() -> None:
    """Without a `restrict` of its own; what it does not have stays away."""
    names = ("cost", "coarse", "screening", "past", "motion")
    costs = {name: PerItem(torch.arange(4.0) + 10 * i) for i, name in enumerate(names)}
    items, x = torch.tensor([2, 0]), torch.zeros(2, 3)
    some = SearchProblem(**costs).take(items)._asdict()
    for name in names:
        assert torch.equal(some[name].value(x), costs[name].offset[items]), name
    alone = SearchProblem(costs["cost"]).take(items)
    assert alone[1:] == SearchProblem(costs["cost"])[1:]

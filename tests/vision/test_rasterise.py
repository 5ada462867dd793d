"""The rasteriser: the compiled loops draw what their twin in torch draws."""

from __future__ import annotations

import pytest
import torch

from torchcss.kernels import compiler
from torchcss.vision import rasterise
from torchcss.vision.rasterise import grid_faces, nearest_faces

HEIGHT, WIDTH = 23, 31
needs_kernels = pytest.mark.skipif(not compiler.COMPILED, reason="numba is not installed")


def both(monkeypatch: pytest.MonkeyPatch, *vertices: torch.Tensor, faces: torch.Tensor):
    uv, depth, valid = vertices

    def run() -> torch.Tensor:
        return nearest_faces(uv, depth, faces, HEIGHT, WIDTH, valid=valid)

    compiled = run()
    monkeypatch.setattr(compiler, "COMPILED", False)
    return compiled, run()


@needs_kernels
def test_triangles_of_all_kinds(monkeypatch, generator):
    """Large, small and thin ones, some outside the picture, some behind the camera, in pictures."""
    size = (3, 60)
    uv = torch.rand(*size, 2, generator=generator, dtype=torch.float64)
    uv = uv * torch.tensor([2 * WIDTH, 2 * HEIGHT]) - torch.tensor([0.5 * WIDTH, 0.5 * HEIGHT])
    uv[:, 20:50] = uv[:, 19:20] + 3 * uv[:, 20:50] / WIDTH
    uv[0, 7], uv[1, 8] = 1e8, torch.nan
    depth = 0.5 + torch.rand(*size, generator=generator, dtype=torch.float64)
    depth[:, ::17] = -1.0
    valid = torch.rand(*size, generator=generator) > 0.05
    faces = torch.arange(60).view(-1, 3)
    got, expected = both(monkeypatch, uv, depth, valid, faces=faces)
    assert (got >= 0).any()
    assert (got < 0).any()
    assert torch.equal(got, expected)


@needs_kernels
def test_of_two_at_the_same_depth_the_first_is_seen(monkeypatch):
    corners = torch.tensor([[0.0, 0.0], [20.0, 0.0], [0.0, 20.0]], dtype=torch.float64)
    uv, depth = corners.repeat(2, 1)[None], torch.ones(1, 6, dtype=torch.float64)
    faces = torch.tensor([[3, 4, 5], [0, 2, 1]])
    got, expected = both(monkeypatch, uv, depth, torch.ones(1, 6, dtype=torch.bool), faces=faces)
    assert set(got.unique().tolist()) == {-1, 0}
    assert torch.equal(got, expected)


def test_nothing_to_draw():
    none = torch.zeros(2, 8, 2), torch.ones(2, 8)
    seen = nearest_faces(*none, grid_faces(2, 4), HEIGHT, WIDTH, valid=torch.zeros(2, 8) > 0)
    assert seen.shape == (2, HEIGHT, WIDTH)
    assert (seen == -1).all()
    nothing = rasterise.rasterise(none[0][0], none[1][0], torch.zeros(0, 3).long(), HEIGHT, WIDTH)
    assert (nothing.face == -1).all()

"""The pairs of pictures move as their flow says."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from common.flow_files import read_flow

from torchcss.io.pictures import read_image
from torchcss.vision.sampling import sample_bilinear


def test_the_second_picture_is_where_the_flow_says(script: ModuleType, tmp_path: Path) -> None:
    script.main(script.Config(out=tmp_path / "pairs", width=120, height=90, small=True))
    folders = sorted((tmp_path / "pairs").iterdir())
    assert [folder.name for folder in folders] == ["natural-shift", "natural-two"]
    for folder in folders:
        first, second = (
            torch.from_numpy(read_image(folder / f"frame{number}.png"))[..., 0].float()
            for number in (10, 11)
        )
        flow, known = read_flow(folder / "flow10.flo")
        assert 0.5 < known.float().mean() <= 1
        v, u = torch.meshgrid(*(torch.arange(size).float() for size in first.shape), indexing="ij")
        there, inside = sample_bilinear(second[None], torch.stack([u, v], -1) + flow.movedim(0, -1))
        apart = (there[..., 0] - first).abs()[known & inside]
        assert float(apart.median()) < 1.5
        assert float((second - first).abs().median()) > 2 * float(apart.median())


def test_places_come_from_where_the_motion_took_them(script: ModuleType) -> None:
    rows, columns = np.mgrid[:40, :50]
    places = np.stack([columns, rows], -1).astype(float)
    for motion in script.motions(np.array([24.5, 19.5])).values():
        assert np.allclose(motion(script.came_from(motion, places)), places, atol=1e-6)

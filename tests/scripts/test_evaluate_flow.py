"""The flow evaluation script on a made-up pair, and in its small mode on Middlebury."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import matplotlib.image
import pytest
import torch
from common.flow_files import write_flow

from torchcss.errors import FlowFileError


def test_made_up_pair(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A coarse checkerboard of grey tiles moves by two pixels; the peers are optional."""
    generator = torch.Generator().manual_seed(0)
    tiles = torch.rand(1, 1, 16, 18, generator=generator)
    image = torch.nn.functional.interpolate(tiles, scale_factor=4, mode="bicubic")[0, 0]
    image = image.clamp(0.0, 1.0)
    folder = tmp_path / "data" / "tiles"
    folder.mkdir(parents=True)
    for number, left in ((10, 4), (11, 2)):
        frame = image[:, left : left + 64, None].expand(-1, -1, 3).numpy()
        matplotlib.image.imsave(folder / f"frame{number}.png", frame)
    truth = torch.zeros(2, 64, 64)
    truth[0] = 2.0
    write_flow(folder / "flow10.flo", truth)
    out = tmp_path / "new" / "flow.json"
    script.main(script.Config(data=tmp_path / "data", out=out, repeats=1))
    printed = capsys.readouterr().out
    table = json.loads(out.read_text())
    rows = {row["method"]: row for row in table["rows"]}
    assert all(name in printed for name in (*rows, "near_aepe", "tiles"))
    assert {"accurate", "tracking", "accurate-quadratic"} <= rows.keys()
    for name in ("accurate", "tracking"):
        assert rows[name]["pair"] == "tiles"
        assert rows[name]["aepe"] < 0.3
        assert rows[name]["aepe"] <= rows[name]["rmse"]
        assert rows[name]["near_aepe"] is None  # there is no true boundary
        assert rows[name]["recall"] is None
        assert rows[name]["seconds"] > 0.0


def test_errors_are_what_they_are_called(script: ModuleType) -> None:
    truth = torch.zeros(2, 4, 4)
    known = torch.ones(4, 4, dtype=torch.bool)
    known[0] = False
    near = torch.zeros(4, 4, dtype=torch.bool)
    near[1] = True
    flow = torch.zeros(2, 4, 4)
    flow[:, 0] = 100.0  # not known, so not counted
    flow[0, 1] = 1.0
    pair = script.Pair("made up", truth[0], truth[0], truth, known)
    found = script.errors(flow, pair, near)
    assert found["aepe"] == pytest.approx(1.0 / 3.0)
    assert found["rmse"] == pytest.approx(3.0**-0.5)
    assert found["aae"] == pytest.approx(15.0)
    assert found["near_aepe"] == found["near_rmse"] == pytest.approx(1.0)
    assert found["near_aae"] == pytest.approx(45.0)


def test_a_folder_without_pairs_is_refused(script: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(FlowFileError, match=r"flow10\.flo"):
        script.main(script.Config(data=tmp_path))


def test_small_mode(script: ModuleType, shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "flow_middlebury"
    script.main(script.Config(data=folder, out=tmp_path / "flow.json", small=True))
    table = json.loads((tmp_path / "flow.json").read_text())
    assert table["setting"]["small"]
    assert {row["pair"] for row in table["rows"]} == {"Grove3", "RubberWhale"}
    for pair in ("Grove3", "RubberWhale"):
        rows = {row["method"]: row for row in table["rows"] if row["pair"] == pair}
        assert rows["accurate"]["near_aepe"] < rows["accurate-quadratic"]["near_aepe"]
        assert rows["tracking"]["recall"] > 0.9
        if "opencv-dis-medium" in rows:
            for ours in ("accurate", "tracking"):
                assert rows[ours]["aepe"] < rows["opencv-dis-medium"]["aepe"]
                assert rows[ours]["rmse"] < rows["opencv-dis-medium"]["rmse"]

"""Middlebury `.flo` files: round trip, a foreign file, unknown pixels, damage."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from common.flow_files import flow_discontinuities, read_flow, write_flow

from torchcss.errors import FlowFileError, ShapeError


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (1, 7), (40, 30)])
def test_round_trip(tmp_path: Path, size: tuple[int, int], generator: torch.Generator) -> None:
    flow = 10.0 * torch.randn(2, *size, generator=generator)
    write_flow(tmp_path / "a.flo", flow)
    back, known = read_flow(tmp_path / "a.flo")
    assert torch.equal(back, flow)
    assert known.all()


def test_layout_is_as_published(tmp_path: Path) -> None:
    content = struct.pack("<fii8f", 202021.25, 2, 2, 1, -1, 2, -2, 3, -3, 4, -4)
    (tmp_path / "hand.flo").write_bytes(content)
    flow, known = read_flow(tmp_path / "hand.flo")
    assert flow.tolist() == [[[1, 2], [3, 4]], [[-1, -2], [-3, -4]]]
    assert known.all()


def test_unknown_pixels(tmp_path: Path) -> None:
    flow = torch.ones(2, 3, 4)
    flow[0, 0, 0], flow[1, 1, 1] = float("nan"), float("inf")
    known = torch.ones(3, 4, dtype=torch.bool)
    known[0, 3] = False
    write_flow(tmp_path / "a.flo", flow, known)
    back, back_known = read_flow(tmp_path / "a.flo")
    expected = known.clone()
    expected[0, 0] = expected[1, 1] = False
    assert torch.equal(back_known, expected)
    assert torch.equal(back, expected.float().expand(2, 3, 4))
    values = np.fromfile(tmp_path / "a.flo", "<f4", offset=12).reshape(3, 4, 2)
    assert (values[~expected.numpy()] > 1e9).all()


def test_nan_in_a_file_is_unknown(tmp_path: Path) -> None:
    (tmp_path / "a.flo").write_bytes(struct.pack("<fii2f", 202021.25, 1, 1, float("nan"), 0.0))
    flow, known = read_flow(tmp_path / "a.flo")
    assert not known.any()
    assert (flow == 0.0).all()


def test_published_truth(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "flow_middlebury" / "RubberWhale" / "flow10.flo"
    flow, known = read_flow(path)
    assert flow.shape == (2, 388, 584)
    assert known.float().mean() == pytest.approx(0.984, abs=5e-4)
    assert flow.square().sum(dim=0).sqrt().max() == pytest.approx(4.6, abs=0.1)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PIEH",
        b"JPEG" + bytes(40),
        struct.pack("<fii", 202021.25, 2, 2),
        struct.pack("<fii2f", 202021.25, 1, 2, 0, 0),
        struct.pack("<fii4f", 202021.25, 1, 1, 0, 0, 0, 0),
        struct.pack("<fii2f", 202021.25, -1, -1, 0, 0),
        struct.pack("<fii", 202021.25, 0, 0),
        struct.pack("<fii", 202021.25, 2**31 - 1, 2**31 - 1),
    ],
)
def test_damaged_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "bad.flo").write_bytes(content)
    with pytest.raises(FlowFileError, match=r"bad\.flo"):
        read_flow(tmp_path / "bad.flo")


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(FlowFileError, match="there is no such file"):
        read_flow(tmp_path / "none.flo")
    with pytest.raises(FlowFileError, match="expected a file, found a folder"):
        read_flow(tmp_path)


def test_discontinuities_mark_both_sides() -> None:
    flow = torch.zeros(2, 6, 7)
    flow[0, :, 3:] = 0.6
    expected = torch.zeros(6, 7, dtype=torch.bool)
    expected[:, 2:4] = True
    assert torch.equal(flow_discontinuities(flow), expected)
    assert torch.equal(flow_discontinuities(flow.mT), expected.mT)
    assert not flow_discontinuities(flow, jump=0.7).any()
    assert torch.equal(flow_discontinuities(flow.expand(2, 3, 2, 6, 7))[1, 2], expected)


def test_discontinuities_across_unknown_pixels() -> None:
    flow = torch.zeros(2, 9, 11)
    flow[1, :, 5:] = 2.0
    known = torch.ones(9, 11, dtype=torch.bool)
    known[:, 4:7] = False
    flow[:, ~known] = float("nan")
    found = flow_discontinuities(flow, known)
    assert found[:, 4:7].any(dim=1).all()
    assert not found[:, :3].any()
    assert not found[:, 8:].any()
    nothing_known = torch.zeros(9, 11, dtype=torch.bool)
    assert not flow_discontinuities(flow, nothing_known).any()


@pytest.mark.parametrize("shape", [(9, 11), (3, 9, 11)])
def test_discontinuities_refuse_other_shapes(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match="flow"):
        flow_discontinuities(torch.zeros(shape))
    with pytest.raises(ShapeError, match="known"):
        flow_discontinuities(torch.zeros(2, 9, 11), torch.ones(9, 10, dtype=torch.bool))

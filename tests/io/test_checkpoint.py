"""A checkpoint on disk: bit for bit, whole or not at all, and never of another track."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from made_processes import begin

from torchcss.errors import OutputError, TrackFileError
from torchcss.io.checkpoint import (
    CHECKPOINT_NAME,
    Checkpoint,
    read_checkpoint,
    remove_checkpoint,
    write_checkpoint,
)

TENSORS = {
    "state/mean": torch.randn(3, 4, generator=torch.Generator().manual_seed(0)).double(),
    "state/parent": torch.tensor([2, -1]),
    "single": torch.tensor([0.1, torch.inf, torch.nan, -0.0]),
    "flag": torch.tensor(True),
    "bytes": torch.Generator().manual_seed(3).get_state(),
    "nothing": torch.zeros(0, 5),
}


def test_round_trip(tmp_path: Path):
    assert read_checkpoint(tmp_path) is None
    notes = {"frame": 7, "name": "ä", "list": [1, 0.1, None]}
    write_checkpoint(tmp_path, Checkpoint(7, TENSORS, notes))
    found = read_checkpoint(tmp_path)
    assert found is not None
    assert (found.num_frames, found.notes) == (7, notes)
    assert set(found.tensors) == set(TENSORS)
    for name, tensor in TENSORS.items():
        again = found.tensors[name]
        assert (again.dtype, again.shape) == (tensor.dtype, tensor.shape)
        assert again.numpy().tobytes() == tensor.numpy().tobytes()
    generator = torch.Generator()
    generator.set_state(found.tensors["bytes"])
    remove_checkpoint(tmp_path)
    remove_checkpoint(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_damage_is_told(tmp_path: Path):
    path = tmp_path / CHECKPOINT_NAME
    path.write_bytes(b"PK hello")
    with pytest.raises(TrackFileError, match="cannot be read"):
        read_checkpoint(tmp_path)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(TrackFileError, match="not a checkpoint"):
        read_checkpoint(tmp_path)
    write_checkpoint(tmp_path, Checkpoint(1, TENSORS))
    arrays = dict(np.load(path)) | {"schema_version": np.array(9)}
    np.savez(path, **arrays)
    with pytest.raises(TrackFileError, match="schema version 9"):
        read_checkpoint(tmp_path)


def test_a_disk_that_refuses_keeps_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_checkpoint(tmp_path, Checkpoint(1, TENSORS))
    before = (tmp_path / CHECKPOINT_NAME).read_bytes()

    def refuse(*_: object, **__: object) -> None:
        raise OSError(28, "full")

    monkeypatch.setattr(np, "savez", refuse)
    with pytest.raises(OutputError, match="disk is full"):
        write_checkpoint(tmp_path, Checkpoint(2, TENSORS))
    assert (tmp_path / CHECKPOINT_NAME).read_bytes() == before


PROGRAMME = """
import sys
from pathlib import Path
import torch
from torchcss.io.checkpoint import Checkpoint, write_checkpoint
from torchcss.io.tracks import FrameModes, Track, TrackWriter
folder = Path(sys.argv[1])
writer = TrackWriter(folder / "track.npz", Track.empty(("a",), ("b",)))
one = torch.ones(1, 1)
for n in range(1, 100000):
    writer.append(FrameModes(n, n / 25, n * one, one[None], one[0] - 1, one[0], one[0] - 2,
                             torch.zeros(1, 1, 3)))
    writer.save()
    write_checkpoint(folder, Checkpoint(n, {"a": n * one}))
    tell(n)
"""


def test_killed_at_any_moment_a_complete_pair_is_left(tmp_path: Path):
    from torchcss.io.run import Run

    for trial in range(4):
        begun = begin(PROGRAMME, str(tmp_path))
        for _ in range(3 + 5 * trial):
            begun.told.recv()
        begun.process.kill()
        begun.end()
        run = Run.open(tmp_path)
        assert run.checkpoint is not None
        count = run.checkpoint.num_frames
        assert count >= 3 + 5 * trial
        assert len(run.track.frames) in (count, count + 1)
        kept = run.track.first(count)
        assert kept.frames.tolist() == list(range(1, count + 1))
        assert run.checkpoint.tensors["a"].item() == kept.state[-1, 0, 0] == count

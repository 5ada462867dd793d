"""Parts of the model changed one at a time: the small mode, and what each variation changes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import torch
from made_sequences import write_arm

from torchcss.body.load import load_body
from torchcss.studies.sequences import read_sequence


def small(script: ModuleType, folder: Path, **changes: object):
    write_arm(folder, 3)
    tracking = replace(script.Config.tracking, working_size=160, samples=6, modes=2)
    config = script.Config(sequences=(folder,), seeds=1, frames=3, tracking=tracking)
    return replace(config, **changes)


def test_small_mode(script: ModuleType, tmp_path: Path) -> None:
    out = tmp_path / "variations.json"
    report = script.main(small(script, tmp_path / "arm", presets=("css",), out=out))
    (rows,) = report["by_sequence"].values()
    names = ["as it is", *script.PLANS, *script.ARMS, "three times"]
    assert sorted(rows) == sorted(f"css: {name}" for name in names)
    assert all(row["root_aligned_mm"][0] < 300 for row in rows.values())
    assert rows["css: long arms"]["root_aligned_mm"] != rows["css: as it is"]["root_aligned_mm"]
    assert len(json.loads(out.read_text())["table"]["rows"]) == len(names)


def test_each_changes_one_thing(script: ModuleType, tmp_path: Path) -> None:
    config = small(script, tmp_path / "arm")
    named = script.entrants(config, read_sequence(config.sequences[0]), 0)
    _, begin, plain = named["ijrr_css: as it is"]
    body = begin.first.body
    clavicle = body.state_names.index("r_clavicle_protraction")
    _, _, held = named["ijrr_css: clavicles at rest"]
    assert held.bounds.lower[clavicle] == held.bounds.upper[clavicle] == body.rest[clavicle]
    others = [column for column in range(body.num_parameters) if column != clavicle]
    assert torch.equal(held.bounds.lower[others], plain.bounds.lower[others])
    assert "stabiliser" in [term.name for term in plain.choice.terms]
    _, _, loose = named["ijrr_css: no stabilisers"]
    assert "stabiliser" not in [term.name for term in loose.choice.terms]
    assert plain.boundary_emphasis > 0
    assert named["ijrr_css: no motion boundaries"][2].boundary_emphasis == 0
    more = named["css: three times"][2].tracker
    assert (more.num_samples, more.num_modes) == (18, 6)


def test_longer_arms(script: ModuleType) -> None:
    body = load_body("body34")
    longer = script.with_arms(body, 1.1)
    x = body.rest
    before, after = (each.pose(x).joints for each in (body, longer))
    names = list(body.joint_names)

    def apart(joints: torch.Tensor, one: str, two: str) -> torch.Tensor:
        return (joints[names.index(one)] - joints[names.index(two)]).norm()

    pairs = (("l_shoulder", "l_elbow", 1.1), ("r_elbow", "r_wrist", 1.1), ("l_hip", "l_knee", 1.0))
    for one, two, factor in pairs:
        torch.testing.assert_close(apart(after, one, two), factor * apart(before, one, two))
    assert torch.equal(longer.part_shape[:, :2], body.part_shape[:, :2])

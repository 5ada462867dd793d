"""How deep parts are inside each other."""

from __future__ import annotations

import math

import numpy as np
import torch

from torchcss.body.load import load_body
from torchcss.body.surface import implicit
from torchcss.cost.penetration import PenetrationDepth


def test_penetration_is_the_distance_to_the_surface() -> None:
    """Against the nearest of many surface points, for a fist that goes into the chest."""
    body = load_body("body34")
    measured = PenetrationDepth(body)
    pairs = measured.pairs
    x = body.sticky_mean.clone()
    for name, angle in (
        ("r_shoulder_swing", -38.9), ("r_shoulder_raising", 16.3), ("r_shoulder_twist", -81.8)
    ):  # fmt: skip
        x[body.state_index(name)] = math.radians(angle)
    flexion = torch.tensor([80.0, 95.0, 100.0, 106.0, 138.1]).deg2rad()
    states = x.repeat(5, 1)
    states[:, body.state_index("r_elbow_flexion")] = flexion
    depth, parts = measured(body, states)
    fine = body.mesh(150, 200).points.flatten(1, 2)
    expected = []
    for state in states:
        rotation, centre = body.part_poses(body.pose(state))
        deepest = 0.0
        for a, b in zip(pairs.first.tolist(), pairs.second.tolist(), strict=True):
            nodes = pairs.nodes[a] @ rotation[a].T + centre[a]
            local = (nodes - centre[b]) @ rotation[b]
            local = local[implicit(body.part_shape[b], local) < 0]
            if len(local):
                deepest = max(deepest, float(torch.cdist(local, fine[b]).amin(1).max()))
        expected.append(deepest)
    assert expected[0] == depth[0] == 0.0
    assert expected[2] > 0.02
    assert parts[0].tolist() == [-1, -1]
    assert "chest" in {body.part_names[part] for part in parts[2]}
    assert {"r_hand", "r_forearm"} & {body.part_names[part] for part in parts[2]}
    # The pairs take the parts for slightly rounder than they are.
    np.testing.assert_allclose(depth, expected, atol=0.004)

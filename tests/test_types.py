"""The records that all folders share: keypoints keep together what belongs together."""

from __future__ import annotations

import torch

from torchcss.types import Keypoints


def two_frames() -> Keypoints:
    places = torch.arange(12, dtype=torch.float64).reshape(2, 3, 2)
    confidence = torch.tensor([[1.0, 0.5, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    return Keypoints(places, confidence, ("nose", "tail", "l_wrist"), 2.0, ("read",))


def test_a_frame_of_keypoints() -> None:
    keypoints = two_frames()
    first, second = keypoints.at(0), keypoints.at(1)
    assert first.positions.tolist() == [[0, 1], [2, 3], [4, 5]]
    assert first.names == keypoints.names
    assert (first.relative_noise, first.report) == (2.0, ("read",))
    assert not first.says_nothing
    assert second.says_nothing
    assert keypoints.at(torch.tensor([1, 0])).confidence[1].tolist() == [1.0, 0.5, 0.0]


def test_a_joint_that_is_nowhere_is_not_known() -> None:
    keypoints = two_frames()
    nowhere = keypoints.positions.clone()
    nowhere[0, 0, 1], nowhere[0, 1, 0] = torch.nan, torch.inf
    assert keypoints.known.tolist() == [[True, True, False], [False] * 3]
    assert keypoints._replace(positions=nowhere).says_nothing
    assert not keypoints.says_nothing


def test_keypoints_of_some_joints() -> None:
    kept = two_frames().only(("l_wrist", "nose", "r_wrist"))
    assert kept.names == ("nose", "l_wrist")
    assert kept.positions[0].tolist() == [[0, 1], [4, 5]]
    without = two_frames().without(torch.tensor([True, False, True]))
    assert without.confidence[0].tolist() == [0.0, 0.5, 0.0]
    assert without.positions.equal(two_frames().positions)


def test_scaling_maps_pixel_centres() -> None:
    corners = torch.tensor([[-0.5, -0.5], [1079.5, 1919.5]])
    keypoints = Keypoints(corners, torch.ones(2), ("nose", "vt1"))
    small = keypoints.scaled((1080, 1920), (360, 640))
    torch.testing.assert_close(small.positions, torch.tensor([[-0.5, -0.5], [359.5, 639.5]]))
    single = small.to(torch.zeros(0, dtype=torch.float64))
    assert single.positions.dtype == single.confidence.dtype == torch.float64

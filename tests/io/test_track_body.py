"""The body of a track: as plain data and back, and posed on the track's bases."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from made_robots import write_quadruped
from made_tracks import make_track

from torchcss import load_body
from torchcss.body.bases import pose_track
from torchcss.body.catalog import BODY_NAMES, specification
from torchcss.body.model import BodyModel
from torchcss.body.shape import with_shape
from torchcss.body.uncertainty import point_jacobian
from torchcss.errors import BodyError, TrackFileError
from torchcss.io.run import body_of_track
from torchcss.io.track_body import PARAMETER_NUMBERS, body_from_plain, body_to_plain

LENGTHS = {"thigh": 0.41, "neck": 0.07, "hand": 0.17, "forearm": 0.26, "shoulder_width": 0.16}


def stored(body: BodyModel) -> BodyModel:
    return body_from_plain(json.loads(json.dumps(body_to_plain(body))))


def assert_same(left: BodyModel, right: BodyModel) -> None:
    assert (left.name, left.lengths, left.notes) == (right.name, right.lengths, right.notes)
    assert (left.state_names, left.joint_names) == (right.state_names, right.joint_names)
    assert (left.part_names, left.neighbours) == (right.part_names, right.neighbours)
    ours, theirs = left.state_dict(), right.state_dict()
    assert list(ours) == list(theirs)
    for name, tensor in ours.items():
        assert torch.equal(tensor, theirs[name]), name


@pytest.mark.parametrize("name", BODY_NAMES)
def test_a_body_that_ships_comes_back_to_the_last_digit(name: str):
    built_of = specification(name, lengths=LENGTHS, scale=0.93)
    body = BodyModel(built_of)
    body = with_shape(body, 1.1 * body.part_shape)
    assert_same(stored(body), body)


def test_free_lengths_and_single_precision_come_back():
    body = load_body("body34", free_proportions=True)
    assert_same(stored(body), body)
    single = load_body("arm8", dtype=torch.float32)
    # Shapes, limits and priors are those that it has, rounded; the rest is what it was built of.
    exact = load_body("arm8")
    for name in PARAMETER_NUMBERS:
        exact.register_buffer(name, single.get_buffer(name).double())
    assert_same(stored(single), with_shape(exact, single.part_shape.double()))


def test_a_body_from_a_file_needs_its_file_no_more(tmp_path: Path):
    path = write_quadruped(tmp_path / "quadruped.urdf") or tmp_path / "quadruped.urdf"
    body = load_body(path, free_root=True, scale=1.5)
    plain = body_to_plain(body)
    path.unlink()
    assert_same(body_from_plain(json.loads(json.dumps(plain))), body)


def test_a_file_without_changed_limits_has_those_of_its_body():
    plain = body_to_plain(load_body("arm8"))
    del plain["parameters"]
    assert_same(body_from_plain(plain), load_body("arm8"))
    with pytest.raises(BodyError, match="unknown: expected one of lower"):
        body_from_plain({**plain, "parameters": {"unknown": [1.0]}})


def test_poses_are_those_of_the_track():
    track = make_track(load_body("body34", lengths=LENGTHS))
    pose = pose_track(
        body_of_track(track),
        torch.from_numpy(track.state),
        torch.from_numpy(track.base_transform)[:, None],
    )
    present = track.log_weight > -np.inf
    np.testing.assert_allclose(pose.joints[present], track.joints_world[present], atol=1e-12)


def test_twists_stand_on_the_base():
    body = load_body("arm8")
    track = make_track(body)
    base = track.base_transform[1]
    state = torch.from_numpy(track.state[1, :2])
    placed = body.with_base(torch.from_numpy(base[:3, :3]), torch.from_numpy(base[:3, 3]))
    found = pose_track(body_of_track(track), state, torch.from_numpy(base))
    here, there = (
        point_jacobian(body, pose.tree, pose.joints, body.marker_link)
        for pose in (found, placed.pose(state))
    )
    torch.testing.assert_close(here, there)


def test_a_given_body_is_checked_and_left_alone():
    body = load_body("body30", dtype=torch.float32)
    track = make_track(load_body("body30"))._replace(body=None)
    assert body_of_track(track, body).dtype == torch.float64
    assert body.dtype == torch.float32
    with pytest.raises(TrackFileError, match="misses the joints of the track by"):
        body_of_track(track, load_body("body30", lengths={"thigh": 0.46}))
    with pytest.raises(TrackFileError, match="other parameters"):
        body_of_track(track, load_body("body32"))
    with pytest.raises(TrackFileError, match="does not say which body"):
        body_of_track(track)

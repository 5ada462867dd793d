"""The body of a track, told from its names and joints alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from made_tracks import make_track

from torchcss import load_body
from torchcss.body.catalog import BODY_NAMES
from torchcss.body.uncertainty import joint_jacobian
from torchcss.errors import TrackFileError
from torchcss.io.track_body import body_of_track, pose_track

LENGTHS = {"thigh": 0.41, "neck": 0.07, "hand": 0.17, "forearm": 0.26, "shoulder_width": 0.16}


@pytest.mark.parametrize("name", BODY_NAMES)
def test_lengths_and_scale_come_back(name: str):
    body = load_body(name, lengths=LENGTHS, scale=0.93)
    track = make_track(body)
    found = body_of_track(track)
    assert found.name == name
    for length in ("upper_arm", "forearm", "hand"):
        assert found.lengths[length] == pytest.approx(body.lengths[length], abs=1e-9)
    if name.startswith("body"):
        assert found.lengths == pytest.approx(body.lengths, abs=1e-9)
    pose = pose_track(
        found, torch.from_numpy(track.state), torch.from_numpy(track.base_transform)[:, None]
    )
    present = track.log_weight > -np.inf
    np.testing.assert_allclose(pose.joints[present], track.joints_world[present], atol=1e-9)


def test_twists_stand_on_the_base():
    body = load_body("arm8")
    track = make_track(body)
    base = track.base_transform[1]
    state = torch.from_numpy(track.state[1, :2])
    placed = body.with_base(torch.from_numpy(base[:3, :3]), torch.from_numpy(base[:3, 3]))
    found = pose_track(body_of_track(track), state, torch.from_numpy(base))
    torch.testing.assert_close(
        joint_jacobian(body, found), joint_jacobian(body, placed.pose(state))
    )


def test_a_given_body_is_checked_and_left_alone():
    body = load_body("body30", dtype=torch.float32)
    track = make_track(load_body("body30"))
    assert body_of_track(track, body).dtype == torch.float64
    assert body.dtype == torch.float32
    with pytest.raises(TrackFileError, match="misses the joints of the track by"):
        body_of_track(track, load_body("body30", lengths={"thigh": 0.46}))
    with pytest.raises(TrackFileError, match="other parameters"):
        body_of_track(track, load_body("body32"))


def test_tracks_that_are_of_no_body():
    track = make_track(load_body("arm7"))
    with pytest.raises(TrackFileError, match="no body that ships"):
        body_of_track(track._replace(joint_names=tuple("abcd")))
    with pytest.raises(TrackFileError, match="another order"):
        body_of_track(track._replace(state_names=track.state_names[::-1]))
    noise = np.random.default_rng(0).normal(size=track.joints_world.shape)
    with pytest.raises(TrackFileError, match=r"that was tracked"):
        body_of_track(track._replace(joints_world=track.joints_world + 0.1 * noise))
    with pytest.raises(TrackFileError, match="no frames"):
        body_of_track(track._replace(log_weight=np.full_like(track.log_weight, -np.inf)))

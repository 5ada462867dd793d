"""make_sequence: folders that the package's own reader takes."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from torchcss.body.load import load_body
from torchcss.errors import ConfigurationError
from torchcss.io.video import VideoReader
from torchcss.studies.sequences import read_sequence


def test_a_folder_holds_what_was_rendered(script: ModuleType, tmp_path: Path) -> None:
    config = script.Config(sequence="body-dark", out=tmp_path / "dark", frames=3, small=True)
    summary = script.main(config)
    assert summary["frames"] == 3
    sequence = read_sequence(tmp_path / "dark")
    assert (sequence.num_frames, sequence.frame_rate) == (3, 50.0)
    assert sequence.camera.image_size_wh == (160, 120)
    assert sequence.keypoint_noise_px == 2.0
    assert sequence.mask is not None
    assert 0.01 < sequence.mask.mean() < 0.3
    # The truth is that of the reference, and the camera sees it where the marks are.
    assert sequence.truth is not None
    joints = sequence.truth.body.pose(sequence.truth.states).joints
    np.testing.assert_allclose(joints.numpy(), sequence.joints_world, atol=1e-12)
    marks = np.load(tmp_path / "dark" / "keypoints2d.npz")
    exact = sequence.camera.project(torch.from_numpy(sequence.joints_world)).uv
    np.testing.assert_allclose(marks["keypoints_exact"], exact.numpy(), atol=1e-9)
    noise = marks["keypoints"] - marks["keypoints_exact"]
    assert abs(noise.std() / 2.0 - 1) < 0.2
    assert np.array_equal(marks["confidence"] == 1, marks["visible"])
    # Flow of the character, none of the room.
    motion = np.load(tmp_path / "dark" / "flow.npz")
    assert (motion["flow"].dtype, motion["flow"].shape) == (np.float16, (2, 120, 160, 2))
    assert motion["occluded"].shape == (2, 120, 160)
    assert not motion["flow"][~sequence.mask[:-1]].any()
    assert np.abs(motion["flow"].astype(np.float32)).max() > 0.01
    # The film shows the person where the mask is.
    picture = next(iter(VideoReader(tmp_path / "dark" / "video.mp4"))).image.mean(-1)
    assert picture[sequence.mask[0]].mean() > 3 * picture[~sequence.mask[0]].mean()


def test_a_motion_of_ones_own_is_rendered(script: ModuleType, tmp_path: Path) -> None:
    body = load_body("arm7", lengths={"forearm": 0.25})
    states = body.rest.repeat(2, 1)
    states[1, body.state_index("r_elbow_flexion")] += 0.05
    clip = tmp_path / "bend.npz"
    np.savez(
        clip,
        body=np.array("arm7"),
        lengths=np.array(json.dumps({"forearm": 0.25})),
        state_names=np.array(body.state_names),
        states=states.numpy(),
        frame_rate=np.array(25.0),
    )
    out = tmp_path / "out"
    config = script.Config(sequence="mocap", motion=clip, out=out, small=True, scene="dark")
    assert script.main(config)["name"] == "mocap-bend"
    sequence = read_sequence(out)
    assert sequence.frame_rate == 25.0
    assert sequence.truth is not None
    torch.testing.assert_close(sequence.truth.states, states)
    assert sequence.truth.body.lengths["forearm"] == 0.25


def test_options_that_do_not_fit_are_refused(script: ModuleType, tmp_path: Path) -> None:
    for options in ({"sequence": "mocap"}, {"sequence": "arm", "motion": tmp_path / "x.npz"}):
        with pytest.raises(ConfigurationError, match="go together"):
            script.make_shot(script.Config(out=tmp_path, **options))
    with pytest.raises(ConfigurationError, match="--frames 0"):
        script.make_shot(script.Config(out=tmp_path, sequence="arm", frames=0))

"""Files as other programs write them, each with the values that are right (`shared/data/cases`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchcss
from torchcss.app.view_files import open_view
from torchcss.errors import KeypointError
from torchcss.io.cameras import load_camera
from torchcss.io.keypoints.one_image import read_joints
from torchcss.io.view_files import ViewFiles
from torchcss.joint_names import LIMB_PLACES, skeleton_joint_names

SIZE = (640, 480)
PLACES = {"l_wrist": (388, 255), "r_wrist": (250, 262), "nose": (320, 100), "l_ankle": (348, 420)}
LIMBS = {f"{side}_{place}" for side in "lr" for place in LIMB_PLACES}
Check = Callable[[Path], None]


def read(path: Path | str, **more: Any) -> torchcss.Keypoints:
    return torchcss.read_keypoints(path, **{"image_size_wh": SIZE, "num_frames": 6, **more})


def expect(
    found: torchcss.Keypoints,
    places: dict[str, tuple[float, float]] = PLACES,
    empty: Iterable[int] = (),
    within: float = 0.01,
) -> None:
    """The person who walks through the picture, 3 pixels right and 1 down in every frame."""
    assert found.confidence.shape[0] == 6
    for t in range(6):
        for name, (u, v) in places.items():
            joint = found.names.index(name)
            if t in empty:
                assert found.confidence[t, joint] == 0
                continue
            assert found.confidence[t, joint] > 0
            place = found.positions[t, joint].numpy()
            np.testing.assert_allclose(place, (u + 3 * t, v + t), atol=within)


def confidence(found: torchcss.Keypoints, name: str, frame: int = 0) -> float:
    return float(found.confidence[frame, found.names.index(name)])


def person(file: str, **expected: Any) -> Check:
    return lambda case: expect(read(case / file), **expected)


def says(found: Any, *words: str) -> None:
    text = "\n".join(found).lower()
    assert all(word in text for word in words), text


# Keypoints.


def alphapose_folder(case: Path) -> None:
    files = ViewFiles(video=case / "pictures", keypoints=case / "alphapose-results.json")
    found = open_view(files, case / "cameras.json").keypoints
    assert found is not None
    nose = found.names.index("nose")
    np.testing.assert_allclose(found.positions[0, nose], (80, 25))
    np.testing.assert_allclose(found.positions[3, nose], (82.25, 25.75))
    assert (found.confidence[2] == 0).all()


def alphapose_ids(case: Path) -> None:
    found = read(case / "alphapose-results.json")
    nose = found.names.index("nose")
    assert found.positions[:, nose, 0].tolist() == [120, 200, 280, 360, 440, 520]


def coco_some_pictures(case: Path) -> None:
    files = ViewFiles(video=case / "pictures", keypoints=case / "annotations.json")
    found = open_view(files, case / "cameras.json").keypoints
    assert found is not None
    nose = found.names.index("nose")
    for frame, place in {0: (80, 25), 2: (81.5, 25.5), 4: (83, 26)}.items():
        np.testing.assert_allclose(found.positions[frame, nose], place)
    assert (found.confidence[[1, 3]] == 0).all()


def csv_confidence_c(case: Path) -> None:
    found = read(case / "joints.csv")
    expect(found, {name: place for name, place in PLACES.items() if name != "l_wrist"})
    assert confidence(found, "nose") == 0.84
    assert confidence(found, "l_shoulder") == 0.6
    assert confidence(found, "l_wrist", 2) == confidence(found, "l_wrist", 3) == 0
    assert confidence(found, "l_wrist", 4) > 0


def dlc_human_names(case: Path) -> None:
    found = read(case / "clipDLC.csv")
    expect(found, {"l_wrist": (388, 255), "r_ankle": (293, 424)})
    assert set(found.names) >= LIMBS


def half_outside(case: Path) -> None:
    try:
        found = read(case / "results.json", num_frames=None)
    except KeypointError as error:
        says([str(error)], "640 x 480")
    else:
        says(found.report, "13 of 17", "outside")


def hdf5_message(case: Path) -> None:
    for name in ("clip.analysis.h5", "clip.predictions.slp"):
        with pytest.raises(KeypointError, match=r"SLEAP.*CSV"):
            read(case / name)


def humaneva(case: Path) -> None:
    path = f"{case}/data_2d_humaneva_gt.npz#Validate/P1/Walk 1/0"
    expect(read(path), {"l_wrist": (388, 255), "r_ankle": (293, 424)})


def labelme(case: Path) -> None:
    found = read_joints(case / "p.json", image_size_wh=SIZE)
    assert len(found.names) == 13
    for name, place in {n: PLACES[n] for n in ("l_wrist", "r_wrist", "nose")}.items():
        joint = found.names.index(name)
        assert found.positions[joint].tolist() == list(place)
    assert (found.confidence == 1).all()


def mediapipe_timestamps(case: Path) -> None:
    found = read(case / "pose.json")
    steps = found.positions[1:, :, 0] - found.positions[:-1, :, 0]
    seen = found.confidence > 0
    assert not seen[2].any()
    assert seen[[0, 1, 3, 4, 5]].any(1).all()
    both = seen[1:] & seen[:-1]
    np.testing.assert_allclose(steps[both], 6.4, atol=0.02)
    gap = (found.positions[3] - found.positions[1])[seen[3] & seen[1], 0]
    np.testing.assert_allclose(gap, 12.8, atol=0.02)


def mmpose_video(case: Path) -> None:
    found = read(case / "clip.json")
    expect(found, empty=[3])
    assert confidence(found, "nose") == 0.6
    assert confidence(found, "l_eye") == 0.67


def npy_triples(case: Path) -> None:
    found = read(case / "clip.npy")
    expect(found)
    assert abs(confidence(found, "nose") - 0.6) < 1e-6


def openpose_one_short(case: Path) -> None:
    found = read(case / "json")
    expect(found, empty=[5])
    says(found.report, "5 of 6")


def wholebody133(case: Path) -> None:
    found = read(case / "wholebody.json")
    feet = {"l_toe": (358, 438), "l_heel": (346, 430), "r_toe": (284, 441), "r_heel": (295, 433)}
    expect(found, PLACES)
    for name, place in feet.items():
        np.testing.assert_allclose(found.positions[0, found.names.index(name)], place)


# Cameras.


def easymocap_01(case: Path) -> None:
    cameras = torchcss.read_cameras(case / "intri.yml")
    focal = {name: float(camera.K[0, 0]) for name, camera in cameras.items()}
    assert focal == {"01": 601, "02": 602, "08": 608}
    assert cameras["01"].image_size_wh == SIZE


def one_camera(
    file: str,
    K: tuple[float, float, float, float],
    distortion: tuple[float, ...],
    t: tuple[float, ...] | None = None,
) -> Check:
    def check(case: Path) -> None:
        loaded = load_camera(case / file)
        fx, fy, cx, cy = K
        expected = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
        np.testing.assert_allclose(loaded.camera.K, expected)
        given = loaded.camera.distortion[: len(distortion)]
        np.testing.assert_allclose(given, distortion)
        assert loaded.camera.image_size_wh == SIZE
        assert loaded.metric == (t is not None)
        if t is not None:
            np.testing.assert_allclose(loaded.camera.t_camera_world, t)

    return check


def anipose_mm(case: Path) -> None:
    loaded = load_camera(case / "calibration.toml", "A")
    length = float(torch.linalg.norm(loaded.camera.t_camera_world))
    assert not loaded.metric or abs(length - 2.64) < 0.01
    assert loaded.metric or loaded.units_note


# Bodies.


def limbs(file: str) -> Check:
    def check(case: Path) -> None:
        body = torchcss.load_body(case / file)
        assert set(body.joint_names) >= LIMBS

    return check


def parameters(file: str, *names: str, free: bool = False, says_of: str = "") -> Check:
    def check(case: Path) -> None:
        body = torchcss.load_body(case / file)
        assert body.num_parameters == len(names) + 6 * free
        assert body.state_names[6 * free :] == names
        says(body.notes, says_of)

    return check


def urdf_prefix(case: Path) -> None:
    body = torchcss.load_body(case / "lamp.urdf")
    assert body.state_names == ("yaw", "pitch")
    np.testing.assert_allclose(body.bounds.lower, -1)
    np.testing.assert_allclose(body.bounds.upper, 1.5)
    joints = body.pose(torch.zeros(2, dtype=torch.float64)).joints
    np.testing.assert_allclose(joints[body.joint_index("upper")], (0, 0, 0.6), atol=1e-12)


def bvh_no_motion(case: Path) -> None:
    body = torchcss.load_body(case / "skeleton.bvh")
    assert body.num_parameters == 51
    turns = [index for index, name in enumerate(body.state_names) if not name.startswith("root")]
    widest = torch.maximum(body.bounds.upper.abs(), body.bounds.lower.abs())[turns].max()
    np.testing.assert_allclose(torch.rad2deg(widest), 120)


def bvh_z_up(case: Path) -> None:
    motion = torchcss.read_motion_capture(case / "zup.bvh")
    head, foot = (motion.joint_names.index(name) for name in ("Head", "LeftFoot"))
    np.testing.assert_allclose(
        motion.joints[0, head, 1] - motion.joints[0, foot, 1], 1.46, atol=0.01
    )
    says(motion.report, "z up")
    assert {n for n in skeleton_joint_names(motion.joint_names) if n} >= LIMBS


# Videos.


def edit_list(case: Path) -> None:
    files = ViewFiles(video=case / "trimmed.mp4", keypoints=case / "keypoints.npz")
    view = open_view(files, case / "cameras.json")
    assert view.reader.info.num_frames == 18 == len(list(view.images()))
    assert view.keypoints is not None
    nose = view.keypoints.names.index("nose")
    np.testing.assert_allclose(view.keypoints.positions[0, nose], (80, 25))


def folder_rate(case: Path) -> None:
    files = ViewFiles(video=case / "pictures", keypoints=case / "joints.json", frame_rate=120)
    view = open_view(files, case / "cameras.json")
    assert [frame.time_s for frame in view.images()] == [pytest.approx(t / 120) for t in range(4)]


CASES: dict[str, Check] = {
    "body_bvh_biped": limbs("biped.bvh"),
    "body_bvh_no_motion": bvh_no_motion,
    "body_bvh_poser": limbs("poser.bvh"),
    "body_bvh_unreal": limbs("game.bvh"),
    "body_bvh_z_up": bvh_z_up,
    "body_mjcf_equality": parameters("gripper.xml", "left"),
    "body_side_suffix": limbs("suffix.bvh"),
    "body_urdf_floating": parameters("dog.urdf", "hip", "knee", free=True),
    "body_urdf_mimic_missing": parameters("hand.urdf", "left_one", "left_two", says_of="left_two"),
    "body_urdf_prefix": urdf_prefix,
    "cam_anipose_mm": anipose_mm,
    "cam_caliscope": one_camera(
        "camera_array.toml",
        (640.5, 641.5, 321, 238),
        (0.1, -0.2, 0, 0.001, 0.05),
        (0.25, -0.1, 1.9),
    ),
    "cam_colmap": one_camera(
        "cameras.txt", (605.5, 606.5, 319.5, 239.5), (0.04, -0.08, 0.0005, -0.0003)
    ),
    "cam_easymocap_01": easymocap_01,
    "cam_opencv_yml": one_camera(
        "calibration.yml", (611.25, 612.75, 317.5, 243), (0.11, -0.24, 0.0012, -0.0021, 0.07)
    ),
    "cam_ros_yaml": one_camera(
        "camera_info.yaml", (598.5, 599.75, 322.25, 238.5), (0.05, -0.12, 0.0004, -0.0007, 0)
    ),
    "kp_alphapose_folder": alphapose_folder,
    "kp_alphapose_ids": alphapose_ids,
    "kp_alphapose_open": person("alphapose-results.json"),
    "kp_coco_other_size": person("person_keypoints.json"),
    "kp_coco_some_pictures": coco_some_pictures,
    "kp_csv_confidence_c": csv_confidence_c,
    "kp_cvat_empty_keypoints": person("person_keypoints_default.json", empty=[3]),
    "kp_dlc_human_names": dlc_human_names,
    "kp_dwpose_null": person("json", empty=[3]),
    "kp_easymocap_annots": person("annots"),
    "kp_eks_more_coords": person("eks.csv"),
    "kp_half_outside": half_outside,
    "kp_hdf5_message": hdf5_message,
    "kp_humaneva": humaneva,
    "kp_labelme": labelme,
    "kp_mediapipe_timestamps": mediapipe_timestamps,
    "kp_mmpose_video": mmpose_video,
    "kp_movenet17": person("movenet.json"),
    "kp_npy_triples": npy_triples,
    "kp_openpifpaf_lines": person("clip.openpifpaf.json"),
    "kp_openpose_old_key": person("json"),
    "kp_openpose_one_short": openpose_one_short,
    "kp_pose2sim_nan_person": person("cam01_json", empty=[4]),
    "kp_sleap_frame_idx": person("clip.analysis.csv", empty=[2, 3]),
    "kp_vitpose_yx": person("clip_result.json"),
    "kp_wholebody133": wholebody133,
    "kp_yolo_txt": person("labels", empty=[3], within=1.0),
    "vid_edit_list": edit_list,
    "vid_folder_rate": folder_rate,
}


@pytest.mark.parametrize("name", CASES)
def test_case(shared_data: Path, name: str) -> None:
    case = shared_data / "cases" / name
    if not case.is_dir():
        pytest.skip("the cases are not among the shared data on this machine")
    if name == "body_mjcf_equality":
        pytest.importorskip("mujoco")
    CASES[name](case)


def test_every_case_is_looked_at(shared_data: Path) -> None:
    folder = shared_data / "cases"
    if not folder.is_dir():
        pytest.skip("the cases are not among the shared data on this machine")
    assert {entry.name for entry in folder.iterdir() if entry.is_dir()} == set(CASES)

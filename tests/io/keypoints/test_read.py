"""2D joints from every format, and every way in which a file of them can be wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchcss.errors import KeypointError
from torchcss.io.keypoints.arrays import read_points
from torchcss.io.keypoints.read import read_keypoints
from torchcss.joint_names import ALIASES, JOINT_NAMES
from torchcss.types import Keypoints

SIZE = (640, 480)


def a_person(layout: str = "COCO-17", shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Return `[joints, 3]`: joints at places of their own, the hips' middle where it belongs."""
    names = ALIASES[layout]
    source = np.random.default_rng(len(names))
    place = {name: source.uniform((200, 100), (400, 380)) for name in JOINT_NAMES}
    place["HumanoidRoot"] = 0.5 * (place["l_hip"] + place["r_hip"])
    points = [place[name] if name else source.uniform((200, 100), (400, 380)) for name in names]
    return np.column_stack([np.array(points) + shift, np.full(len(names), 0.9)])


def moving(layout: str = "COCO-17", num_frames: int = 5, step: float = 4.0) -> list[np.ndarray]:
    return [a_person(layout, (step * index, 0.0)) for index in range(num_frames)]


def write_openpose(
    folder: Path, frames: list[list[np.ndarray]], first: int = 0, name: str = "video_{:012d}"
) -> Path:
    folder.mkdir(exist_ok=True)
    for index, people in enumerate(frames):
        content = {
            "version": 1.3,
            "people": [{"pose_keypoints_2d": person.ravel().tolist()} for person in people],
        }
        stem = name.format(index + first)
        (folder / f"{stem}_keypoints.json").write_text(json.dumps(content))
    return folder


def write_json(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


def write_npz(path: Path, frames: list[np.ndarray], **more: Any) -> Path:
    triples = np.stack(frames)
    arrays = {"keypoints": triples[..., :2], "confidence": triples[..., 2], **more}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def detections(frames: list[list[np.ndarray]], image: str | None = None) -> list[dict[str, Any]]:
    return [
        {
            "image_id": index if image is None else image.format(index),
            "category_id": 1,
            "keypoints": person.ravel().tolist(),
            "score": 0.8,
        }
        for index, people in enumerate(frames)
        for person in people
    ]


def read(path: Path, **options: Any) -> Keypoints:
    return read_keypoints(path, **{"image_size_wh": SIZE, **options})


def check(found: Keypoints, frames: list[np.ndarray], layout: str) -> None:
    """Compare what was read with what was written."""
    triples = torch.from_numpy(np.stack(frames))
    torch.testing.assert_close(found.positions, triples[..., :2])
    torch.testing.assert_close(found.confidence, triples[..., 2])
    expected = ALIASES[layout]
    assert [name if name in JOINT_NAMES else None for name in found.names] == list(expected)
    assert len(set(found.names)) == len(expected)
    assert all("\n" not in line for line in found.report)


# The formats, when all is well.


@pytest.mark.parametrize("layout", ["BODY_25", "BODY_25B", "COCO-17", "COCO-18", "MediaPipe-33"])
def test_openpose_folder(tmp_path: Path, layout: str) -> None:
    frames = moving(layout)
    path = write_openpose(tmp_path / "pose", [[person] for person in frames])
    found = read(path, num_frames=5)
    check(found, frames, layout)
    assert any(layout in line for line in found.report)
    check(read(path, layout=layout), frames, layout)


def test_openpose_files_start_anywhere_and_sort_naturally(tmp_path: Path) -> None:
    frames = moving(num_frames=12)
    path = write_openpose(tmp_path / "pose", [[person] for person in frames], 8, "cam2_{}")
    check(read(path, num_frames=12), frames, "COCO-17")


def test_one_openpose_file(tmp_path: Path) -> None:
    folder = write_openpose(tmp_path, [[a_person()]])
    check(read(next(folder.iterdir()), num_frames=1), [a_person()], "COCO-17")


@pytest.mark.parametrize("image", [None, "{}.jpg", "folder/video_{:06d}.png"])
def test_detections(tmp_path: Path, image: str | None) -> None:
    frames = moving()
    path = write_json(tmp_path / "a.json", detections([[person] for person in frames], image))
    check(read(path, num_frames=5), frames, "COCO-17")
    check(read(path), frames, "COCO-17")


@pytest.mark.parametrize("layout", ["Halpe-26", "Halpe-136"])
def test_detections_with_feet(tmp_path: Path, layout: str) -> None:
    """AlphaPose's larger models: COCO's joints, then head top, neck, hips' middle and feet."""
    frames = moving(layout)
    path = write_json(tmp_path / "a.json", detections([[p] for p in frames], "{}.jpg"))
    found = read(path, num_frames=5)
    check(found, frames, layout)
    assert found.names[:17] == ALIASES["COCO-17"]
    assert found.names[17:22] == ("skull_tip", "vc7", "HumanoidRoot", "l_toe", "r_toe")
    assert found.names[24:26] == ("l_heel", "r_heel")


def test_detections_that_count_from_one(tmp_path: Path) -> None:
    frames = moving()
    path = write_json(tmp_path / "a.json", detections([[], *([person] for person in frames)]))
    check(read(path, num_frames=5), frames, "COCO-17")


def test_frames_without_detection_are_missing(tmp_path: Path) -> None:
    frames = moving()
    path = write_json(tmp_path / "a.json", detections([[frames[0]], [], [], [frames[3]], []]))
    found = read(path, num_frames=5)
    assert found.confidence.bool().any(1).tolist() == [True, False, False, True, False]
    assert not found.positions[1].any()


def test_annotations(tmp_path: Path) -> None:
    frames = moving()
    frames[1][3, 2] = 0.0
    seen = [np.where(frame[:, 2:] > 0, 2.0, 0.0) for frame in frames]
    seen[2][4] = 1.0
    labels = [
        np.hstack([frame[:, :2], flags]).ravel().tolist()
        for frame, flags in zip(frames, seen, strict=True)
    ]
    content = {
        "images": [{"id": 90 - index, "file_name": f"im{index}.jpg"} for index in range(5)],
        "categories": [{"keypoints": list(ALIASES["COCO-17"])}],
        "annotations": [
            {"image_id": 90 - index, "keypoints": labels[index]}
            for index in range(5)
        ] + [{"image_id": 90, "bbox": [0, 0, 1, 1]}],
    }  # fmt: skip
    found = read(write_json(tmp_path / "a.json", content), num_frames=5)
    torch.testing.assert_close(found.positions[4], torch.from_numpy(frames[4][:, :2]))
    assert found.confidence[0, 0] == 1.0
    assert found.confidence[1, 3] == 0.0
    assert found.confidence[2, 4] == 0.5
    assert any("visibility" in line for line in found.report)


def test_arrays_by_name_and_by_count(tmp_path: Path) -> None:
    frames = moving("BODY_25B")
    names = np.array([name or f"odd{i}" for i, name in enumerate(ALIASES["BODY_25B"])])
    named = read(write_npz(tmp_path / "a.npz", frames, joint_names=names), num_frames=5)
    check(named, frames, "BODY_25B")
    assert "odd20" in named.names
    assert any("odd20" in line for line in named.report)
    check(read(write_npz(tmp_path / "b.npz", frames)), frames, "BODY_25B")
    no_confidence = write_npz(tmp_path / "c.npz", frames, confidence=None)
    assert (read(no_confidence).confidence == 1.0).all()


@pytest.mark.parametrize("layout", ["SMPL-24", "H36M-17", "H-Anim"])
def test_layout_asked_for(tmp_path: Path, layout: str) -> None:
    frames = moving(layout)
    check(read(write_npz(tmp_path / "a.npz", frames), layout=layout), frames, layout)


def test_clicked_joints(tmp_path: Path) -> None:
    content = {
        "joints": {"r_shoulder": [10, 20], "RElbow": [30, 40, 0.5]},
        "image_size_wh": [640, 480],
    }
    path = write_json(tmp_path / "a.json", content)
    found = read(path, num_frames=3)
    assert found.names == ("r_shoulder", "r_elbow")
    assert found.positions[0].tolist() == [[10, 20], [30, 40]]
    assert found.confidence.tolist() == [[1.0, 0.5], [0, 0], [0, 0]]
    assert read(path).positions.shape == (1, 2, 2)


def test_clicked_joints_of_some_frames(tmp_path: Path) -> None:
    content = {"frames": {"2": {"l_wrist": [7, 8]}, "4": {"joints": {"l_elbow": [9, 10]}}}}
    path = write_json(tmp_path / "a.json", content)
    found = read(path, num_frames=6, first_frame=2)
    assert found.names == ("l_wrist", "l_elbow")
    assert found.confidence.nonzero().tolist() == [[2, 0], [4, 1]]
    with pytest.raises(KeypointError, match=r"nobody in the first frame .0.*is 2"):
        read(path, num_frames=6)
    with pytest.raises(KeypointError, match=r"expected 4 frames.*found 5"):
        read(path, num_frames=4)


# Several people.


def test_follows_the_prominent_person_whatever_the_order(tmp_path: Path) -> None:
    actor = moving(num_frames=8)
    bystander = a_person(shift=(-150.0, 0.0)) * (0.5, 0.5, 0.5)
    frames = [
        [actor[index], bystander] if index % 2 else [bystander, actor[index]] for index in range(8)
    ]
    found = read(write_openpose(tmp_path / "pose", frames))
    check(found, actor, "COCO-17")
    assert any("continuity" in line for line in found.report)


def test_a_bystander_does_not_take_over(tmp_path: Path) -> None:
    actor = moving(num_frames=8)
    bystander = a_person(shift=(-150.0, 0.0)) * (0.5, 0.5, 0.5)
    frames = [[person, bystander] for person in actor]
    frames[3] = frames[4] = [bystander]
    frames[5] = []
    frames += [[], []]  # where nobody was looked for
    found = read(write_openpose(tmp_path / "pose", frames))
    assert (
        found.confidence.bool().any(1).tolist()
        == [True] * 3 + [False] * 3 + [True] * 2 + [False] * 2
    )
    torch.testing.assert_close(found.positions[7], torch.from_numpy(actor[7][:, :2]))
    assert any("3 frames" in line for line in found.report)


def test_starts_in_the_first_frame_asked_for(tmp_path: Path) -> None:
    # In frame 0 the other one is the more prominent; tracking starts in frame 2.
    one, other = moving(num_frames=5), [a_person() * (0.4, 0.4, 1.0)] * 5
    frames = [[one[index] * (1, 1, 0.1), other[index]] for index in range(2)]
    frames += [[other[index], one[index]] for index in range(2, 5)]
    found = read(write_openpose(tmp_path / "pose", frames), first_frame=2)
    np.testing.assert_allclose(found.positions, np.stack(one)[..., :2])
    assert any("frame 2" in line for line in found.report)


def test_joints_seen_in_turns_still_compare(tmp_path: Path) -> None:
    upper, lower = a_person(), a_person()
    upper[9:, 2] = 0.0
    lower[:9, 2] = 0.0
    stranger = a_person() * (0.1, 0.1, 0.4)
    found = read(write_openpose(tmp_path / "pose", [[upper, stranger], [stranger, lower]]))
    assert found.confidence[1].bool().tolist() == [False] * 9 + [True] * 8


# Numbers.


def test_missing_joints_may_be_nan(tmp_path: Path) -> None:
    frames = moving()
    frames[2][5] = (np.nan, np.nan, 0.0)
    found = read(write_npz(tmp_path / "a.npz", frames))
    assert found.confidence[2, 5] == 0.0
    assert found.positions.isfinite().all()


@pytest.mark.parametrize("bad", [(np.nan, 1.0, 0.5), (1.0, np.inf, 1.0), (1.0, 1.0, np.nan)])
def test_nan_names_frame_and_joint(tmp_path: Path, bad: tuple[float, float, float]) -> None:
    frames = moving()
    frames[2][5] = bad
    names = np.array(ALIASES["COCO-17"])
    with pytest.raises(KeypointError, match=r"frame 2: joint 'l_shoulder'"):
        read(write_npz(tmp_path / "a.npz", frames, joint_names=names))
    folder = write_openpose(tmp_path / "pose", [[frame] for frame in frames])
    with pytest.raises(KeypointError, match="frame 2: joint 5"):
        read(folder)


def test_confidences_are_brought_into_range(tmp_path: Path) -> None:
    frames = moving()
    frames[0][0, 2], frames[0][1, 2] = 1.3, -0.1
    found = read(write_npz(tmp_path / "a.npz", frames))
    assert found.confidence[0, :2].tolist() == [1.0, 0.0]
    assert any("2 confidences" in line for line in found.report)
    frames[0][0, 2] = 95.0
    with pytest.raises(KeypointError, match="confidence 95; expected 0 to 1"):
        read(write_npz(tmp_path / "a.npz", frames))


@pytest.mark.parametrize("kind", ["zero-one", "plus-minus-one"])
def test_normalised_coordinates(tmp_path: Path, kind: str) -> None:
    frames = moving()
    largest = (SIZE[0] - 1, SIZE[1] - 1)
    fractions = [frame / (*largest, 1.0) for frame in frames]
    if kind == "plus-minus-one":
        fractions = [fraction * (2, 2, 1) - (1, 1, 0) for fraction in fractions]
    path = write_npz(tmp_path / "a.npz", fractions)
    with pytest.raises(KeypointError, match=r"expected pixels.*--normalised"):
        read(path)
    check(read(path, normalised=kind), frames, "COCO-17")
    if kind == "zero-one":
        check(read(path, normalised=True), frames, "COCO-17")
    else:
        with pytest.raises(KeypointError, match="plus-minus-one"):
            read(path, normalised=True)
    with pytest.raises(KeypointError, match="they seem to be pixels"):
        read(write_npz(tmp_path / "b.npz", frames), normalised=kind)


def test_coordinates_of_another_image(tmp_path: Path) -> None:
    frames = moving()
    frames[3][2, :2] = (9000, 100)
    with pytest.raises(KeypointError, match=r"\(9000, 100\) is far outside .* 640 x 480"):
        read(write_npz(tmp_path / "a.npz", frames))
    with pytest.raises(KeypointError, match="inside the image of 200 x 150"):
        read(write_npz(tmp_path / "b.npz", moving()), image_size_wh=(200, 150))


# Files that are wrong.


def test_wrong_frame_count(tmp_path: Path) -> None:
    frames = moving()
    path = write_npz(tmp_path / "a.npz", frames)
    with pytest.raises(KeypointError, match=r"expected 7 frames.*found 5"):
        read(path, num_frames=7)
    path = write_openpose(tmp_path / "pose", [[frame] for frame in frames])
    with pytest.raises(KeypointError, match=r"expected 3 frames.*found 5"):
        read(path, num_frames=3)
    path = write_json(tmp_path / "a.json", detections([[frame] for frame in frames]))
    with pytest.raises(KeypointError, match=r"expected 3 frames.*found 5"):
        read(path, num_frames=3)
    with pytest.raises(KeypointError, match="first frame 5 is beyond"):
        read(path, first_frame=5)


def test_gap_in_the_folder(tmp_path: Path) -> None:
    folder = write_openpose(tmp_path / "pose", [[frame] for frame in moving()])
    (folder / "video_000000000002_keypoints.json").unlink()
    found = read(folder, num_frames=5)
    assert found.confidence.bool().any(1).tolist() == [True, True, False, True, True]
    assert any("4 of 5 frames" in line for line in found.report)


def test_nobody_in_the_first_frame(tmp_path: Path) -> None:
    folder = write_openpose(tmp_path / "pose", [[], [], [a_person()]])
    with pytest.raises(KeypointError, match=r"nobody in the first frame \(0\).* is 2"):
        read(folder)
    assert read(folder, first_frame=2).confidence[2].all()
    nobody = write_openpose(tmp_path / "nobody", [[], []])
    with pytest.raises(KeypointError, match=r"nobody.*none later"):
        read(nobody)
    with pytest.raises(KeypointError, match="nobody"):
        read(write_json(tmp_path / "a.json", []), num_frames=4)
    with pytest.raises(KeypointError):
        read(write_json(tmp_path / "a.json", []))
    blank = [np.zeros((17, 3))] * 2
    with pytest.raises(KeypointError, match="nobody"):
        read(write_npz(tmp_path / "a.npz", blank))


def test_unknown_layouts_list_the_known(tmp_path: Path) -> None:
    person = np.column_stack([np.full((9, 2), 50.0), np.ones(9)])
    path = write_npz(tmp_path / "a.npz", [person])
    with pytest.raises(KeypointError, match=r"unknown layout: found 9 joints.*BODY_25 .*COCO-17"):
        read(path)
    with pytest.raises(KeypointError, match=r"unknown layout 'BODY_26'.*BODY_25"):
        read(path, layout="BODY_26")
    with pytest.raises(KeypointError, match="COCO-17 has 17 joints, the file has 9"):
        read(path, layout="COCO-17")
    names = np.array([f"tentacle{index}" for index in range(9)])
    named = write_npz(tmp_path / "b.npz", [person], joint_names=names)
    with pytest.raises(
        KeypointError, match=r"unknown layout: found 9 names.*give its file as the body"
    ):
        read(named)
    assert read(named, layout="own").names == tuple(names.tolist())
    with pytest.raises(KeypointError, match="layout own: the file does not name"):
        read(path, layout="own")
    with pytest.raises(KeypointError, match="twice"):
        read(write_npz(tmp_path / "c.npz", [person], joint_names=np.array(["l_hip"] * 9)))


def test_ambiguous_layouts_are_reported(tmp_path: Path) -> None:
    found = read(write_npz(tmp_path / "a.npz", moving()))
    assert any("H36M-17" in line and "set layout" in line for line in found.report)
    hidden = moving("BODY_25")
    for frame in hidden:
        frame[8, 2] = 0.0
    found = read(write_npz(tmp_path / "b.npz", hidden))
    assert any("BODY_25B" in line and "set layout" in line for line in found.report)
    upper = write_npz(tmp_path / "c.npz", moving("MediaPipe-25"))
    told = "(MediaPipe-25 has as many: set layout, --layout)"
    assert any("BODY_25B" in line and told in line for line in read(upper).report)
    check(read(upper, layout="MediaPipe-25"), moving("MediaPipe-25"), "MediaPipe-25")
    necks = moving("DWPose-24")
    for frame in necks:
        frame[1, :2] = 0.5 * (frame[2, :2] + frame[5, :2])
    check(read(write_npz(tmp_path / "d.npz", necks)), necks, "DWPose-24")
    told = "layout: SMPL-24, by its 24 joints (DWPose-24 has as many: set layout, --layout)"
    assert told in read(write_npz(tmp_path / "e.npz", moving("SMPL-24"))).report


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('{"people": [', "not a JSON file"),
        ("hello", "not a JSON file"),
        ("[" * 100_000, "not a JSON file"),
        ("", "empty"),
        ("3", "not a keypoint file"),
        ('{"a": 1}', "not a keypoint file"),
        ('{"people": 3}', "people"),
        ('{"people": [3]}', "numbers"),
        ('{"people": [{"pose_keypoints_2d": [1, 2]}]}', "2 numbers"),
        ('{"people": [{"pose_keypoints_2d": ["1", 2, 3]}]}', "numbers"),
        ('{"people": [{"pose_keypoints_2d": [true, 2, 3]}]}', "expected numbers"),
        ('{"people": [{"pose_keypoints_2d": []}]}', "nobody"),
        ('{"people": [{"pose_keypoints_2d": [1e999, 2, 3]}]}', "not a number"),
        ('{"people": [{"pose_keypoints_2d": [1' + "0" * 400 + ", 2, 3]}]}", "numbers"),
        ("[3]", "expected people"),
        ('[{"image_id": 0}]', "expected keypoints"),
        ('[{"image_id": null, "keypoints": [1, 2, 3]}]', "image_id"),
        ('[{"image_id": -4, "keypoints": [1, 2, 3]}]', "frame number"),
        ('[{"image_id": "a", "keypoints": [1, 2, 3]}]', "frame number"),
        ('[{"image_id": 999999999, "keypoints": [1, 2, 3]}]', "frame number"),
        (f'[{{"image_id": 1{400 * "0"}, "keypoints": {17 * [1, 2, 3]}}}, {{"image_id": 1, '
         '"keypoints": []}]', "entry 0: expected a frame number"),
        ('{"annotations": 3}', "list of detections"),
        ('{"annotations": [], "images": 3}', "images"),
        ('{"annotations": [{"image_id": 1, "keypoints": [1,2,3]}], "images": []}', "image 1"),
        ('{"joints": 3}', "joints"),
        ('{"joints": {"l_wrist": 3}}', "x and y of every joint"),
        ('{"joints": {"l_wrist": [1, "b"]}}', "numbers"),
        ('{"joints": {"l_wrist": [1, 2, 3, 4, 5]}}', "expected x, y"),
        ('{"joints": {"tail": [20, 30]}}', "unknown joint 'tail'"),
        ('{"joints": {"l_wrist": [100, 100]}, "image_size_wh": [64, 48]}', "clicked in images"),
        ('{"joints": {}}', "nobody"),
        ('{"frames": {}}', "frames"),
        ('{"frames": {"x": {}}}', "frame number"),
        ('{"frames": {"0": [1]}}', "joints by name"),
    ],
)  # fmt: skip
def test_malformed_json(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(content)
    with pytest.raises(KeypointError, match=words) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_mixed_layouts(tmp_path: Path) -> None:
    people = [[a_person("COCO-17")], [a_person("COCO-18")]]
    with pytest.raises(KeypointError, match="17 and 18 joints"):
        read(write_openpose(tmp_path / "pose", people))
    with pytest.raises(KeypointError, match="17 and 18 joints"):
        read(write_json(tmp_path / "a.json", detections([people[0] + people[1]])))


def test_category_names_must_fit(tmp_path: Path) -> None:
    content = {
        "categories": [{"keypoints": ["nose", "tail"]}],
        "annotations": detections([[a_person()]]),
    }
    with pytest.raises(KeypointError, match="2 joint names for 17 joints"):
        read(write_json(tmp_path / "a.json", content))


def test_missing_and_foreign_files(tmp_path: Path) -> None:
    with pytest.raises(KeypointError, match="no such file"):
        read(tmp_path / "none.npz")
    (tmp_path / "folder").mkdir()
    with pytest.raises(KeypointError, match="no keypoints in this folder"):
        read(tmp_path / "folder")
    (tmp_path / "a.npz").write_text("{}")
    with pytest.raises(KeypointError, match="not an NPZ file"):
        read(tmp_path / "a.npz")
    write_npz(tmp_path / "b.npz", moving())
    (tmp_path / "b.json").write_bytes((tmp_path / "b.npz").read_bytes())
    with pytest.raises(KeypointError, match="not a JSON file"):
        read(tmp_path / "b.json")


def test_points_that_mean_something_else_are_left(tmp_path: Path) -> None:
    keypoints = read(path := write_npz(tmp_path / "a.npz", moving(), points=np.zeros((2, 2))))
    assert read_points(path, keypoints) is keypoints


@pytest.mark.parametrize(
    "arrays",
    [
        {"joints": np.zeros((3, 17))},
        {"keypoints": np.zeros((3, 17))},
        {"keypoints": np.zeros((3, 17, 5))},
        {"keypoints": np.zeros((0, 17, 2))},
        {"keypoints": np.full((3, 17, 2), "a")},
        {"keypoints": np.zeros((3, 17, 2), complex)},
        {"keypoints": np.full((3, 17, 2), 99, np.uint8)},
        {"keypoints": np.full((3, 17, 2), 99.0), "relative_noise": np.ones((2, 17, 2))},
        {"keypoints": np.zeros((3, 17, 2)), "confidence": np.zeros((3, 16))},
        {"keypoints": np.zeros((3, 17, 2)), "confidence": np.full((3, 17), "a")},
        {"keypoints": np.zeros((3, 17, 2)), "joint_names": np.array(["a"])},
        {"keypoints": np.zeros((3, 17, 2)), "joint_names": np.arange(17)},
    ],
)
def test_arrays_of_wrong_shape(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(KeypointError, match="expected") as caught:
        read(tmp_path / "a.npz")
    assert "\n" not in str(caught.value)


def test_pickled_objects_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", keypoints=np.array([{}], dtype=object))
    with pytest.raises(KeypointError, match="pickled"):
        read(tmp_path / "a.npz")


# Anything at all.


@pytest.fixture(scope="module")
def good_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("good")
    frames = moving("BODY_25", 2)
    write_npz(folder / "a.npz", frames)
    write_json(folder / "a.json", detections([[frame] for frame in frames]))
    write_json(folder / "b.json", {"joints": {"l_wrist": [3, 4], "l_elbow": [50, 60, 0.5]}})
    return {entry.name: entry.read_bytes() for entry in folder.iterdir()}


def only_keypoint_errors(path: Path, **options: Any) -> None:
    try:
        found = read(path, **options)
    except KeypointError as error:
        message = str(error)
    else:
        assert found.positions.isfinite().all()
        message = ""
    assert "\n" not in message


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_only_keypoint_errors_come_from_bad_bytes(
    good_files: dict[str, bytes], tmp_path: Path, data: st.DataObject
) -> None:
    name = data.draw(st.sampled_from(sorted(good_files)))
    content = bytearray(good_files[name])
    kind = data.draw(st.sampled_from(["random", "cut", "changed"]))
    if kind == "random":
        content = bytearray(data.draw(st.binary(max_size=200)))
        if data.draw(st.booleans()):
            content = bytearray(b"PK\x03\x04") + content
    elif kind == "cut":
        del content[data.draw(st.integers(0, len(content))) :]
    else:
        for _ in range(data.draw(st.integers(1, 10))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / name
    path.write_bytes(content)
    only_keypoint_errors(path, num_frames=data.draw(st.sampled_from([None, 2])))


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.sampled_from(["0", "l_wrist", "a.jpg", ""]),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(
                [
                    "people", "pose_keypoints_2d", "annotations", "images", "id", "image_id",
                    "keypoints", "categories", "joints", "frames", "l_wrist", "0",
                ]
            ),
            inner,
            max_size=4,
        )
    ),
    max_leaves=20,
)  # fmt: skip


@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(content=VALUES)
def test_only_keypoint_errors_come_from_any_json(tmp_path: Path, content: Any) -> None:
    only_keypoint_errors(write_json(tmp_path / "a.json", content))
    folder = tmp_path / "folder"
    folder.mkdir(exist_ok=True)
    write_json(folder / "0.json", content)
    only_keypoint_errors(folder)


@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    numbers=st.lists(st.floats(allow_nan=True), min_size=51, max_size=51),
    confidence=st.lists(st.floats(-0.5, 1.5) | st.just(0.0), min_size=17, max_size=17),
)
def test_any_numbers(tmp_path: Path, numbers: list[float], confidence: list[float]) -> None:
    person = np.array(numbers).reshape(17, 3)
    person[:, 2] = confidence
    only_keypoint_errors(write_npz(tmp_path / "a.npz", [person]))


# Files of others.


@pytest.mark.parametrize(
    ("name", "size_wh", "num_frames", "known"),
    [
        ("balance_beam_4cam/keypoints2d_cam01.npz", (1080, 1920), 100, 23),
        ("balance_beam_4cam/keypoints2d_cam03.npz", (1088, 1920), 100, 23),
        ("rendered_turn/keypoints2d.npz", (640, 480), 103, 14),
        ("rendered_upper_body/keypoints2d.npz", (640, 480), 98, 14),
    ],
)
def test_real_files(
    shared_data: Path, name: str, size_wh: tuple[int, int], num_frames: int, known: int
) -> None:
    path = shared_data / name
    found = read(path, image_size_wh=size_wh, num_frames=num_frames)
    with np.load(path) as archive:
        confident = archive["confidence"] > 0
        np.testing.assert_array_equal(
            found.positions.numpy()[confident], archive["keypoints"][confident]
        )
        np.testing.assert_array_equal(found.confidence, archive["confidence"])
    assert sum(name in JOINT_NAMES for name in found.names) == known
    assert {"l_wrist", "r_ankle", "vc7", "skull_tip"} <= set(found.names)


def test_real_body_25b_as_openpose_writes_it(shared_data: Path, tmp_path: Path) -> None:
    # Pose2Sim's users have this: 25 joints without names that are not BODY_25.
    path = shared_data / "balance_beam_4cam" / "keypoints2d_cam01.npz"
    with np.load(path) as archive:
        triples = np.dstack([archive["keypoints"], archive["confidence"]])
    folder = write_openpose(tmp_path / "pose", [[person] for person in triples])
    found = read(folder, image_size_wh=(1080, 1920), num_frames=100)
    named = read(path, image_size_wh=(1080, 1920))
    assert any("BODY_25B" in line for line in found.report)
    torch.testing.assert_close(found.positions, named.positions)
    places = [i for i, name in enumerate(named.names) if name in JOINT_NAMES]
    assert all(found.names[i] == named.names[i] for i in places)


@pytest.mark.parametrize("text", ["[1, 2", "{}", '{"people": 3}', "[]"])
def test_an_error_names_the_file_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.json").write_text(text)
    with pytest.raises(KeypointError) as caught:
        read_keypoints("./bad.json", image_size_wh=SIZE, num_frames=5)
    assert str(caught.value).startswith("bad.json: ")
    assert str(caught.value).count("bad.json") == 1

"""Keypoints as other programs write them, made here: orders, units, gaps, several people."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchcss.errors import KeypointError
from torchcss.io.keypoints.annotated import VIA_SHAPE
from torchcss.io.keypoints.frames import Film
from torchcss.io.keypoints.mediapipe import MEDIAPIPE_NAMES
from torchcss.io.keypoints.one_person import Whom
from torchcss.io.keypoints.read import Scale, read_keypoints, read_person
from torchcss.joint_names import ALIASES
from torchcss.types import Keypoints

SIZE = (640, 480)
FRAMES = 6
COCO = ALIASES["COCO-17"]
OPENPOSE = ALIASES["COCO-18"]
LIMBS = ("l_wrist", "r_wrist", "l_hip", "r_ankle", "nose")
PLACES = {
    "nose": (320, 100), "l_eye": (326, 94), "r_eye": (314, 94), "l_ear": (334, 97),
    "r_ear": (306, 97), "l_shoulder": (355, 150), "r_shoulder": (285, 150), "l_elbow": (375, 205),
    "r_elbow": (262, 208), "l_wrist": (388, 255), "r_wrist": (250, 262), "l_hip": (340, 270),
    "r_hip": (300, 270), "l_knee": (345, 345), "r_knee": (296, 347), "l_ankle": (348, 420),
    "r_ankle": (293, 424), "vt1": (320, 150), "HumanoidRoot": (320, 270),
}  # fmt: skip


def person(t: int, names: tuple[str | None, ...] = COCO, shift: float = 0.0) -> np.ndarray:
    """u, v, confidence of every joint in frame t."""
    rows = [PLACES.get(name or "", (330, 300)) for name in names]
    confidence = 0.6 + 0.02 * (np.arange(len(names)) % 15)
    return np.column_stack([np.array(rows, float) + np.array([3 * t + shift, t]), confidence])


def flat(t: int, names: tuple[str | None, ...] = COCO) -> list[float]:
    return person(t, names).ravel().tolist()


def other(t: int) -> np.ndarray:
    """Somebody smaller and less certain who stands to the left."""
    return person(t) * (0.5, 0.5, 0.6) + (40 - 3 * t, 60, 0)


def write(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def read(path: Path | str, **more: Any) -> Keypoints:
    return read_keypoints(path, **{"image_size_wh": SIZE, "num_frames": FRAMES, **more})


def check(found: Keypoints, empty: tuple[int, ...] = (), names: tuple[str, ...] = LIMBS) -> None:
    assert len(found.positions) == FRAMES
    for t in range(FRAMES):
        for name in names:
            joint = found.names.index(name)
            if t in empty:
                assert found.confidence[t, joint] == 0
                continue
            u, v = PLACES[name]
            np.testing.assert_allclose(found.positions[t, joint], (u + 3 * t, v + t), atol=0.6)
            assert found.confidence[t, joint] > 0
    assert all("\n" not in line for line in found.report)
    assert not any("exchanged" in line for line in found.report)


# JSON.


def mmpose(t: int, of: np.ndarray, **more: Any) -> dict[str, Any]:
    return {"keypoints": of[:, :2].tolist(), "keypoint_scores": of[:, 2].tolist(),
            "bbox": [[0, 0, 9, 9]], "bbox_score": 0.9, **more}  # fmt: skip


def points(of: np.ndarray, **more: Any) -> dict[str, Any]:
    """TensorFlow.js: joints as objects."""
    rows = [{"x": x, "y": y, "score": c, "name": n} for (x, y, c), n in zip(of, TFJS, strict=True)]
    return {"keypoints": rows, "score": 0.8, **more}


def columns(of: np.ndarray, **more: Any) -> dict[str, Any]:
    """Ultralytics: lists of x, of y, of confidences."""
    x, y, c = of.T.tolist()
    return {"name": "person", "class": 0, "confidence": 0.9, "box": {"x1": 0, "y1": 0},
            "keypoints": {"x": x, "y": y, "visible": c}, **more}  # fmt: skip


TFJS = tuple((name or "").replace("l_", "left_").replace("r_", "right_") for name in COCO)
T = range(FRAMES)
SEEN = [t for t in T if t != 3]

JSON_FILES: dict[str, tuple[Any, tuple[int, ...]]] = {
    "mmpose demo counts from 1": (
        {
            "meta_info": {"keypoint_id2name": {str(i): n for i, n in enumerate(TFJS)}},
            "instance_info": [
                {"frame_id": t + 1, "instances": [mmpose(t, other(t)), mmpose(t, person(t))]}
                for t in T
            ],
        },
        (),
    ),
    "mmpose tracks": (
        [
            {"frame_id": t, "instances": [mmpose(t, other(t), track_id=4),
                                          mmpose(t, person(t), track_id=9)][:: 1 - 2 * (t % 2)]}
            for t in T
        ],
        (),
    ),
    "alphapose cmu": (
        {f"{t}.jpg": {"version": "AlphaPose v0.3", "bodies": [{"joints": flat(t, OPENPOSE)}]}
         for t in T},
        (),
    ),
    "alphapose list of ids": (
        [{"image_id": f"{t}.jpg", "keypoints": flat(t), "score": 2, "idx": [1.0]} for t in SEEN],
        (3,),
    ),
    "tfjs lists of poses": (
        [[points(other(t), id=2), points(person(t), id=1)] if t != 3 else [] for t in T],
        (3,),
    ),
    "posenet": (
        [
            {"score": 0.9, "keypoints": [
                {"part": n.replace("_", " ").title().replace(" ", ""), "score": c,
                 "position": {"x": x, "y": y}} for (x, y, c), n in zip(person(t), TFJS, strict=True)
            ]}
            for t in T
        ],
        (),
    ),
    "ultralytics": ([[columns(other(t)), columns(person(t))] for t in T], ()),
    "ultralytics with tracks": (
        [[columns(person(t), track_id=2)] if t != 3 else [] for t in T],
        (3,),
    ),
    "vitpose": (
        {
            "keypoints": [
                {"0": other(t)[:, [1, 0, 2]].tolist(), "1": person(t)[:, [1, 0, 2]].tolist()}
                for t in T
            ],
            "skeleton": {str(i): name for i, name in enumerate(TFJS)},
        },
        (),
    ),
    "dwpose frames in a list": (
        [
            {"people": [{"pose_keypoints_2d": flat(t, OPENPOSE) if t != 3 else None}],
             "canvas_width": 640, "canvas_height": 480}
            for t in T
        ],
        (3,),
    ),
    "dwpose at half the size": (
        [
            {"people": [{"keypoints": (person(t, OPENPOSE) * (0.5, 0.5, 1)).tolist()}],
             "canvas_width": 320, "canvas_height": 240}
            for t in T
        ],
        (),
    ),
    "joints by name": (
        {f"frame_{t:03d}": dict(zip(TFJS, person(t).tolist(), strict=True)) for t in T},
        (),
    ),
    "scores of several people beside their joints": (
        [
            {"frame": t, "keypoints": [p[:, :2].tolist() for p in (other(t), person(t))],
             "scores": [p[:, 2].tolist() for p in (other(t), person(t))]}
            for t in T
        ],
        (),
    ),
    "scores of all frames beside the joints": (
        {"keypoints": [[person(t)[:, :2].tolist()] for t in T],
         "scores": [[person(t)[:, 2].tolist()] for t in T]},
        (),
    ),
    "scores of frames beside joints in a row, nobody in one": (
        {"keypoints": [[person(t)[:, :2].ravel().tolist()] if t != 3 else [] for t in T],
         "scores": [[person(t)[:, 2].tolist()] if t != 3 else [] for t in T]},
        (3,),
    ),
    "joints numbered from 100": (
        [
            {"frame": t, "keypoints": [
                {"id": 100 + i, "x": x, "y": y, "score": c} for i, (x, y, c) in enumerate(person(t))
            ]}
            for t in T
        ],
        (),
    ),
    "a skeleton's names": (
        [
            {"frame": t, "joints": {
                f"{side}_{word}_joint": dict(
                    zip(("x", "y", "confidence"), person(t)[COCO.index(f"{side[0]}_{place}")],
                        strict=True)
                )
                for side in ("left", "right")
                for place, word in (
                    ("shoulder", "shoulder_1"), ("elbow", "forearm"), ("wrist", "hand"),
                    ("hip", "upLeg"), ("knee", "leg"), ("ankle", "foot"),
                )
            } | {"nose": {"x": 320 + 3 * t, "y": 100 + t, "confidence": 0.6}}}
            for t in T
        ],
        (),
    ),
    "times in seconds": (
        [{"time": t / 25, "keypoints": person(t).tolist()} for t in SEEN],
        (3,),
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", JSON_FILES)
def test_json(tmp_path: Path, kind: str) -> None:
    content, empty = JSON_FILES[kind]
    found = read(write(tmp_path / "a.json", content))
    check(found, empty)
    assert float(found.confidence[0, found.names.index("nose")]) == pytest.approx(0.6)


FOLDERS: dict[str, Callable[[int], tuple[str, Any]]] = {
    "openpifpaf": lambda t: (f"{t:03d}.jpg.predictions.json", [{"keypoints": flat(t), "bbox": []}]),
    "mmpose": lambda t: (f"{t:03d}.json", [mmpose(t, person(t)), mmpose(t, other(t))]),
    "mmpose demo": lambda t: (
        f"results_{t:03d}.json",
        {"meta_info": {"keypoint_id2name": {str(i): n for i, n in enumerate(TFJS)}},
         "instance_info": [mmpose(t, other(t)), mmpose(t, person(t))]},
    ),
    "easymocap": lambda t: (
        f"cam1/{t:06d}.json",
        {"filename": f"{t:06d}.jpg", "height": 480, "width": 640,
         "annots": [{"personID": 1, "keypoints": other(t).tolist()},
                    {"personID": 0, "keypoints": person(t).tolist()}]},
    ),
    "labelme": lambda t: (
        f"p{t}.json",
        {"imagePath": f"p{t}.png", "imageWidth": 640, "imageHeight": 480, "shapes": [
            {"label": n, "points": [[x, y]], "shape_type": "point", "group_id": None}
            for (x, y, _), n in zip(person(t), TFJS, strict=True)
        ] + [{"label": "person", "points": [[0, 0], [9, 9]], "shape_type": "rectangle"}]},
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", FOLDERS)
def test_folders(tmp_path: Path, kind: str) -> None:
    for t in SEEN:
        name, content = FOLDERS[kind](t)
        write(tmp_path / name, content)
    found = read(tmp_path)
    check(found, (3,))
    assert any("5 of 6 frames" in line for line in found.report)


def test_a_folder_that_holds_one_file_of_a_video(tmp_path: Path) -> None:
    frames = [{"frame_id": t, "instances": [mmpose(t, person(t))]} for t in T]
    write(tmp_path / "predictions" / "clip.json", frames)
    check(read(tmp_path))


def test_a_folder_with_folders_of_several_cameras(tmp_path: Path) -> None:
    for camera in ("a", "b"):
        write(tmp_path / camera / "0.json", {"people": []})
    with pytest.raises(KeypointError, match="give one of 'a, b'"):
        read(tmp_path)


def test_pictures_by_name(tmp_path: Path) -> None:
    names = [f"img_{t + 100}.jpg" for t in T]
    entries = [{"image_id": f"in/IMG_{t + 100}.png", "keypoints": flat(t)} for t in (1, 2, 4)]
    path = write(tmp_path / "a.json", entries)
    found = read(path, frame_names=names, first_frame=1)
    check(found, (0, 3, 5))
    assert any("3 of 6 frames" in line for line in found.report)
    with pytest.raises(KeypointError, match="give the folder of pictures as the video"):
        read(path)


@pytest.mark.parametrize("absent", [np.nan, 0.0])
def test_people_who_keep_their_place(tmp_path: Path, absent: float) -> None:
    """Pose2Sim's of a video, and arrays of tracked people."""
    nobody = np.full((17, 3), absent)
    frames = [
        [nobody if t == 4 else person(t), nobody if t < 3 else person(t, shift=-150)] for t in T
    ]
    for t, people in enumerate(frames):
        content = {"people": [{"person_id": [-1], "pose_keypoints_2d": p.ravel().tolist()}
                              for p in people]}  # fmt: skip
        write(tmp_path / "json" / f"{t}.json", content)
    check(read(tmp_path / "json"), (4,))
    np.save(tmp_path / "a.npy", np.array(frames))
    check(read(tmp_path / "a.npy"), (4,))


def test_people_before_what_fills_up_an_array(tmp_path: Path) -> None:
    """The best first, whoever it is."""
    frames = [[person(t), other(t), nobody := np.zeros((17, 3)), nobody] for t in T]
    frames[2] = [other(2), person(2), nobody, nobody]
    np.save(tmp_path / "a.npy", np.array(frames))
    check(read(tmp_path / "a.npy"))


def test_coco_with_two_skeletons(tmp_path: Path) -> None:
    hand = {"id": 2, "keypoints": ["thumb", "index", "palm"]}
    body = {"id": 7, "keypoints": list(TFJS)}
    content = {
        "categories": [hand, body],
        "images": [{"id": t, "file_name": f"f{t}.png", "width": 320, "height": 240} for t in T],
        "annotations": [
            {"image_id": t, "category_id": 7, "attributes": {"track_id": 1},
             "keypoints": (person(t) * (0.5, 0.5, 0) + (0, 0, 2)).ravel().tolist()} for t in SEEN
        ] + [{"image_id": 0, "category_id": 2, "keypoints": [1, 1, 2] * 3},
             {"image_id": 3, "category_id": 7, "keypoints": []}],
    }  # fmt: skip
    path = write(tmp_path / "a.json", content)
    found = read(path)
    check(found, (3,))
    assert any("2 skeletons" in line for line in found.report)
    assert any("scaled from images of 320 x 240" in line for line in found.report)
    with pytest.raises(KeypointError, match="320 x 240 pixels, the video has 640 x 640"):
        read(path, image_size_wh=(640, 640))


def test_coco_of_twelve_joints(tmp_path: Path) -> None:
    """36 numbers of 12 names are no 18 pairs."""
    names = COCO[5:]
    marks = [{"image_id": t, "keypoints": flat(t, names)} for t in T]
    content = {"annotations": marks, "categories": [{"keypoints": list(TFJS[5:])}]}
    found = read(write(tmp_path / "a.json", content))
    check(found, names=LIMBS[:4])
    assert found.names == names


@pytest.mark.parametrize("more", ["", " 0.91", " 0.91 3"])
@pytest.mark.parametrize("size", [2, 3])
def test_yolo_labels(tmp_path: Path, more: str, size: int) -> None:
    for t in SEEN:
        lines = []
        for p, track in ((other(t), "8"), (person(t), "3")):
            values = (p / (*SIZE, 1))[:, :size]
            words = ["0 .5 .5 .2 .8", *(f"{value:.6f}" for value in values.flat)]
            lines.append(" ".join(words) + more.replace("3", track))
        write(tmp_path / f"clip_{t + 1}.txt", "\n".join(lines) + "\n")
    check(read(tmp_path), (3,))


# Points that somebody marked.


def via_regions(p: np.ndarray, **more: str) -> list[dict[str, Any]]:
    box = {"shape_attributes": {"name": "rect", "x": 1}, "region_attributes": {"what": "dog"}}
    return [box] + [
        {"shape_attributes": {"name": "point", "cx": round(x), "cy": round(y)},
         "region_attributes": {"sort": "joint", "what": name, **more}}
        for (x, y, _), name in zip(p, TFJS, strict=True)
    ]  # fmt: skip


@pytest.mark.parametrize("form", ["1", "2", "project", "csv"])
def test_via(tmp_path: Path, form: str) -> None:
    """Versions, and two people told apart by an attribute."""
    regions = {
        f"f{t}.jpg": via_regions(other(t), person="1") + via_regions(person(t), person="2")
        for t in SEEN
    }
    regions["f3.jpg"] = []
    if form == "csv":
        text = io.StringIO()
        table = csv.writer(text)
        table.writerow(f"#filename,file_size,{VIA_SHAPE},region_attributes".split(","))
        for name, own in regions.items():
            for each in own or [{"shape_attributes": {}, "region_attributes": {}}]:
                table.writerow([name, 9, *map(json.dumps, each.values())])
        found = read(write(tmp_path / "via.csv", text.getvalue()))
    else:
        content: dict[str, Any] = {
            f"{name}9": {"filename": name, "size": 9, "file_attributes": {},
                         "regions": dict(enumerate(own)) if form == "1" else own}
            for name, own in regions.items()
        }  # fmt: skip
        if form == "project":
            content = {"_via_settings": {}, "_via_img_metadata": content}
        found = read(write(tmp_path / "via.json", content))
    check(found, (3,))
    assert any("joints by 'what'" in line for line in found.report)


@pytest.mark.parametrize("form", ["long", "short", "boxes", "relations", "SLEAP's"])
def test_label_studio(tmp_path: Path, form: str) -> None:
    """Percent of a picture of twice the size; people hang on boxes."""

    def marks(p: np.ndarray, who: str) -> list[dict[str, Any]]:
        return [
            {"original_width": 1280, "original_height": 960, "image_rotation": 0,
             "value": {"x": x / 6.4, "y": y / 4.8, "width": 0.3, "keypointlabels": [name]},
             "id": f"{who}{name}", "from_name": "kp", "type": "keypointlabels"}
            for (x, y, _), name in zip(p, TFJS, strict=True)
        ]  # fmt: skip

    content: list[Any] = []
    for t in T:
        results = marks(person(t), "b") if t != 3 else []
        image = f"/data/upload/7/0a1b2c3d-f{t}.jpg"
        if form in ("boxes", "relations") and t != 3:
            results += marks(other(t), "a")
            for mark in results:
                if form == "boxes":
                    mark["parentID"] = mark["id"][0]
            ends = [(mark["id"], mark["id"][0]) for mark in results]
            results += [{"type": "rectanglelabels", "id": who, "value": {}} for who in "ab"]
            if form == "relations":
                results += [{"type": "relation", "from_id": a, "to_id": b} for a, b in ends]
        done = [{"was_cancelled": True, "result": [{}]}, {"result": results}]
        task: dict[str, Any] = {"annotations": done, "data": {"image": image}, "predictions": []}
        if form == "short":
            kp = [mark | mark.pop("value") for mark in results]
            task = {"image": image, "id": t, "kp": kp, "annotator": 1}
        if form == "SLEAP's":
            task |= {"data": {}, "meta": {"video": {"filename": "a.mp4", "frame_idx": t}}}
        content.append(task)
    path = write(tmp_path / "a.json", content)
    check(read(path), (3,))
    if form != "SLEAP's":
        check(read(path, frame_names=[f"f{t}.jpg" for t in T]), (3,))
    if form == "long":
        for spoilt in ({"data": 0, "annotations": []}, {**content[0], "annotations": [3]}):
            with pytest.raises(KeypointError, match=r"task 1: (expected the|not Label)"):
                read(write(path, [content[0], spoilt]))
        content[0]["annotations"][1]["result"][0]["image_rotation"] = 90
        with pytest.raises(KeypointError, match="task 0: annotated in a turned picture"):
            read(write(path, content))


# Arrays.


@pytest.mark.parametrize("name", ["a.npy", "a.json"])
@pytest.mark.parametrize("normalised", [False, "zero-one"])
def test_movenet_without_its_axes_of_one(
    tmp_path: Path, name: str, normalised: bool | Scale
) -> None:
    """Somebody who stands tells that y is before x; x before y is what the caller says."""
    upright = np.stack([(person(t) / (*SIZE, 1))[:, [1, 0, 2]] for t in T])
    other_way = np.stack([(person(t) / (639, 479, 1)) for t in T])
    path = tmp_path / name
    for array in (upright, other_way):
        np.save(path, array) if name == "a.npy" else write(path, array.tolist())
        if array is upright or normalised:
            check(read(path, normalised=normalised))
        else:
            with pytest.raises(KeypointError, match=r"zero-one .*MoveNet's"):
                read(path)


def test_points_in_space_are_refused(tmp_path: Path) -> None:
    points = [{"x": 0.1, "y": 0.2, "z": 0.3, "visibility": 0.9}] * 33
    for key in ("poseWorldLandmarks", "keypoints3D"):
        path = write(tmp_path / "a.json", [{key: points} for _ in T])
        with pytest.raises(KeypointError, match=f"{key}' are points in space"):
            read(path)


def test_boxes_beside_plain_arrays_are_no_archive(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", boxes=np.zeros((6, 4)), kpts=np.stack([person(t) for t in T]))
    check(read(tmp_path / "a.npz"))


@pytest.mark.parametrize("layout", ["MHR-70", "Goliath-308"])
def test_wrists_behind_their_fingers(tmp_path: Path, layout: str) -> None:
    names = ALIASES[layout]
    assert [names.index(f"{side}_wrist") for side in "lr"] == [62, 41]
    np.save(tmp_path / "a.npy", np.stack([person(t, names) for t in T]))
    check(read(tmp_path / "a.npy"))


@pytest.mark.parametrize("name", ["H36M-17", "H36M-16"])
def test_human36m_is_told_by_its_middles(tmp_path: Path, name: str) -> None:
    layout = ALIASES[name]
    frames = np.stack([person(t, layout) for t in T])
    frames[:, 7, :2] = frames[:, [0, 8], :2].mean(1)  # the spine
    np.save(tmp_path / "a.npy", frames)
    found = read(tmp_path / "a.npy")
    check(found, names=("l_wrist", "r_ankle", "l_hip"))
    told = f"{name}, by its {name[-2:]} joints, of which 0 is the middle of 1 and 4"
    assert any(told in line for line in found.report)


def test_a_column_that_counts_the_rows(tmp_path: Path) -> None:
    rows = np.stack([[t, *person(t).flat] for t in T])  # 52 numbers: not 26 pairs
    np.save(tmp_path / "a.npy", rows)
    check(read(tmp_path / "a.npy"))


@pytest.mark.parametrize("form", ["triples", "pairs", "row", "people", "scores", "movenet"])
def test_arrays(tmp_path: Path, form: str) -> None:
    frames = np.stack([person(t) for t in T])
    path = tmp_path / "a.npy"
    if form == "scores":
        path = tmp_path / "a.npz"
        np.savez(path, keypoints=frames[:, None, :, :2], scores=frames[:, None, :, 2])
    elif form == "movenet":
        np.save(path, (frames / (*SIZE, 1))[:, None, None][..., [1, 0, 2]].astype(np.float32))
    else:
        np.save(path, {
            "triples": frames, "pairs": frames[..., :2], "row": frames.reshape(FRAMES, -1),
            "people": np.stack([np.stack([other(t), person(t)]) for t in T]),
        }[form])  # fmt: skip
    found = read(path)
    check(found)
    expected = 1.0 if form == "pairs" else 0.6
    np.testing.assert_allclose(found.confidence[0, 0], expected, atol=1e-6)
    if form == "triples":
        np.save(path, frames[0])
        assert len(read(path, num_frames=1).positions) == 1


def test_detections_of_videopose3d(tmp_path: Path) -> None:
    def found(p: np.ndarray) -> np.ndarray:
        logit = np.zeros(17)
        return np.stack([p[:, 0], p[:, 1], logit, p[:, 2]])

    keypoints = np.empty((FRAMES, 2), object)
    boxes = np.empty((FRAMES, 2), object)
    for t in T:
        people = [found(other(t)), found(person(t))] if t != 3 else []
        keypoints[t, 0] = boxes[t, 0] = []
        keypoints[t, 1], boxes[t, 1] = np.array(people), np.zeros((len(people), 5))
    metadata = np.array({"w": 640, "h": 480}, dtype=object)
    np.savez(tmp_path / "clip.mp4.npz", boxes=boxes, keypoints=keypoints, metadata=metadata)
    check(read(tmp_path / "clip.mp4.npz"), (3,))


# Tables.


@pytest.mark.parametrize("labels", ["columns", "DeepLabCut's", "DeepLabCut's as text"])
@pytest.mark.parametrize("form", ["split", "index", "columns", "records", "table", "lines"])
def test_pandas_json(tmp_path: Path, form: str, labels: str) -> None:
    heads: list[Any] = [[name, kind] for name in TFJS for kind in ("x", "y", "likelihood")]
    if labels == "columns":
        heads = ["frame", *map("_".join, heads)]
    elif form == "split":
        heads = [["net", *each] for each in heads]
    elif labels.endswith("text"):
        heads = [f"{('net', *each)}" for each in heads]
    else:
        heads = list(map(" ".join, heads))
    data = [([t] if labels == "columns" else []) + person(t).ravel().tolist() for t in T]
    records = [dict(zip(map(str, heads), row, strict=True)) for row in data]
    content: Any = {
        "split": {"columns": heads, "index": [*T], "data": data},
        "index": {str(t): each for t, each in enumerate(records)},
        "columns": {head: {str(t): records[t][head] for t in T} for head in records[0]},
        "records": records,
        "table": {"schema": {"fields": []}, "data": [{"index": t, **records[t]} for t in T]},
        "lines": "\n".join(map(json.dumps, records)),
    }[form]  # fmt: skip
    found = read(write(tmp_path / "a.json", content))
    check(found)
    assert float(found.confidence[0, found.names.index("nose")]) == 0.6


def test_pandas_json_of_a_row_a_joint(tmp_path: Path) -> None:
    rows = [
        {"frame": t, "joint": name, "x": x, "y": y, "score": c}
        for t in SEEN
        for name, (x, y, c) in zip(TFJS, person(t), strict=True)
    ]
    check(read(write(tmp_path / "a.json", rows)), (3,))


def test_pixels_beside_fractions(tmp_path: Path) -> None:
    rows = [
        [t, *np.column_stack([p[:, :2] / SIZE, p]).flat] for t, p in ((t, person(t)) for t in T)
    ]
    heading = ["frame", *ends("_x", "_y", "_x_px", "_y_px", "_s")]
    check(read(write(tmp_path / "a.csv", wide(heading, rows))))


def test_body_and_face_of_mediapipe(tmp_path: Path) -> None:
    """Numbers of the body before those of the face, in a table or an array with the hands."""
    layout, rows = ALIASES["MediaPipe-33"], np.full((FRAMES, 501, 4), 0.4)
    for t in T:
        p = person(t, layout)
        rows[t, :33] = np.column_stack([(p[:, :2] + 0.5) / SIZE, p[:, 2:], p[:, 2:]])
    heading = ["class", *(f"{kind}{i}" for i in range(1, 502) for kind in "xyzv")]
    text = wide(heading, [["squat", *each.flat] for each in rows])
    check(read(write(tmp_path / "a.csv", text)))
    holistic = np.full((FRAMES, 1662), 0.4)
    holistic[:, :132] = rows[:, :33].reshape(FRAMES, -1)
    np.save(tmp_path / "a.npy", holistic)
    check(read(tmp_path / "a.npy"))


def table(names: tuple[str, ...], ends: tuple[str, str, str], rows: list[list[Any]]) -> str:
    heading = [name + end for name in names for end in ends]
    return "\r\n".join(",".join(map(str, row)) for row in [heading, *rows]) + "\r\n"


@pytest.mark.parametrize(
    "end", ["_c", "_score", ".likelihood", "_prob", "_confidence", "_vis", "_accu"]
)
def test_confidence_columns(tmp_path: Path, end: str) -> None:
    marks = np.stack([person(t) for t in T])
    marks[2:4, 9] = 0.0
    text = table(TFJS, ("_x", "_y", end), [frame.ravel().tolist() for frame in marks])
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8-sig", newline="")
    found = read(path)
    check(found, names=("r_wrist", "nose"))
    wrist = found.names.index("l_wrist")
    assert found.confidence[:, wrist].bool().tolist() == [True, True, False, False, True, True]
    assert any(f"nose{end}" in line for line in found.report)


def test_no_confidence_and_zero_is_missing(tmp_path: Path) -> None:
    marks = np.stack([person(t)[:, :2] for t in T])
    marks[1, 9] = 0.0
    heading = ",".join(f"{name}_{axis}" for name in TFJS for axis in "xy")
    rows = [",".join(map(str, frame.ravel())) for frame in marks]
    found = read(write(tmp_path / "a.csv", "\n".join([heading, *rows])))
    assert found.confidence[:, 9].tolist() == [1, 0, 1, 1, 1, 1]


def test_sleap_csv_of_two_tracks(tmp_path: Path) -> None:
    heading = [f"{name}.{end}" for name in TFJS for end in ("x", "y", "score")]
    lines = [",".join(["track", "frame_idx", "instance.score", *heading])]
    for t in SEEN:
        for track, p in (("track_1", other(t)), ("track_0", person(t))):
            lines.append(",".join([track, str(t), "0.9", *(f"{v}" for v in p.flat)]))
    check(read(write(tmp_path / "a.analysis.csv", "\n".join(lines))), (3,))


# HDF5.


def test_sleap_hdf5(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    people = np.stack([np.stack([other(t), person(t)]) for t in T])
    people[3] = np.nan
    with h5py.File(tmp_path / "a.analysis.h5", "w") as file:
        file["tracks"] = people[..., :2].transpose(1, 3, 2, 0)
        file["point_scores"] = people[..., 2].transpose(1, 2, 0)
        file["node_names"] = np.array(TFJS, "S")
        file["track_names"] = np.array(["one", "two"], "S")
    check(read(tmp_path / "a.analysis.h5"), (3,))


@pytest.mark.parametrize("form", ["table", "table of two kinds of numbers", "fixed"])
@pytest.mark.parametrize("animals", [("",), ("one", "two")])
def test_deeplabcut_hdf5(tmp_path: Path, form: str, animals: tuple[str, ...]) -> None:
    """As pandas keeps a table: its columns are pickled, or stand in levels."""
    h5py = pytest.importorskip("h5py")
    import pickle

    columns = [
        ("net", *((animal,) if animal else ()), name, kind)
        for animal in animals for name in TFJS for kind in ("x", "y", "likelihood")
    ]  # fmt: skip
    people = [(other, person) if len(animals) > 1 else (person,)] * FRAMES
    values = np.stack([np.concatenate([of(t).ravel() for of in people[t]]) for t in T])
    with h5py.File(tmp_path / "clipDLC.h5", "w") as file:
        group = file.create_group("df_with_missing")
        if form == "table":
            rows = np.zeros(FRAMES, [("index", "i8"), ("values_block_0", "f8", values.shape[1])])
            rows["index"], rows["values_block_0"] = np.arange(FRAMES), values
            group["table"] = rows
            group.attrs["non_index_axes"] = np.bytes_(pickle.dumps([(1, columns)], protocol=0))
        elif form != "fixed":
            cut = [column[-1] == "likelihood" for column in columns]
            kinds = [np.flatnonzero(np.array(cut) == there) for there in (False, True)]
            names = [f"values_block_{number}" for number in (0, 1)]
            shapes = zip(names, ("f8", "f4"), map(len, kinds), strict=True)
            rows = np.zeros(FRAMES, [("index", "i8"), *shapes])
            rows["index"] = np.arange(FRAMES)
            for name, those in zip(names, kinds, strict=True):
                rows[name] = values[:, those]
            group["table"] = rows
            for name, those in zip(names, kinds, strict=True):
                own = pickle.dumps([columns[column] for column in those], protocol=0)
                group["table"].attrs[f"{name}_kind"] = np.bytes_(own)
            group.attrs["non_index_axes"] = np.bytes_(pickle.dumps([(1, columns)], protocol=0))
        else:
            group["block0_values"], group["axis1"] = values, np.arange(FRAMES)
            for level, names in enumerate(zip(*columns, strict=True)):
                known = sorted(set(names))
                group[f"axis0_level{level}"] = np.array(known, "S")
                group[f"axis0_label{level}"] = np.array([known.index(name) for name in names], "i1")
    check(read(tmp_path / "clipDLC.h5"))


def test_hdf5_that_would_run_something(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    h5py = pytest.importorskip("h5py")
    monkeypatch.chdir(tmp_path)
    with h5py.File("a.h5", "w") as file:
        group = file.create_group("df")
        group["table"] = np.zeros(1, [("index", "i8"), ("values_block_0", "f8", 3)])
        group.attrs["non_index_axes"] = np.bytes_(b"cos\nsystem\n(S'touch ran'\ntR.")
    with pytest.raises(KeypointError, match=r"asks for .*system"):
        read(tmp_path / "a.h5")
    assert not (tmp_path / "ran").exists()


def test_hdf5_without_h5py(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    from torchcss.errors import MissingExtraError

    monkeypatch.setitem(sys.modules, "h5py", None)
    (tmp_path / "a.analysis.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(64))
    with pytest.raises(MissingExtraError, match=r"torchcss\[hdf5\].*Analysis CSV"):
        read(tmp_path / "a.analysis.h5")


# What is told.


def test_findings(tmp_path: Path) -> None:
    frames = np.stack([person(t) for t in T])
    frames[..., 0] += 300
    np.save(tmp_path / "a.npy", frames)
    found = read(tmp_path / "a.npy")
    assert any("of 17 confident joints of frame 0 lie outside" in line for line in found.report)
    frames = np.stack([person(t) for t in T])
    frames[:, [11, 12]] = frames[:, [12, 11]]
    np.save(tmp_path / "b.npy", frames)
    found = read(tmp_path / "b.npy")
    assert any("left and right look exchanged: shoulders and hips" in line for line in found.report)


def test_sides_that_change_places_in_time(tmp_path: Path) -> None:
    frames = np.stack([person(t) for t in T])
    np.save(tmp_path / "a.npy", frames)
    assert not any("change places" in line for line in read(tmp_path / "a.npy").report)
    order = np.arange(17)
    order[5:] = order[5:].reshape(-1, 2)[:, ::-1].ravel()
    frames[2:4] = frames[2:4, order]
    np.save(tmp_path / "b.npy", frames)
    found = read(tmp_path / "b.npy")
    assert any("the next before frames 2, 4:" in line for line in found.report)


def test_a_start_that_the_detector_doubts(tmp_path: Path) -> None:
    frames = np.stack([person(t) for t in T])
    frames[:2, :, 2] *= 0.1
    np.save(tmp_path / "a.npy", frames)
    found = read(tmp_path / "a.npy")
    assert any("frame 0, where tracking starts, has" in line for line in found.report)
    assert any(line.endswith("start at frame 2") for line in found.report)
    found = read(tmp_path / "a.npy", first_frame=2)
    assert not any("where tracking starts" in line for line in found.report)


def test_frames_along_the_second_axis(tmp_path: Path) -> None:
    """What networks that lift joints to space take: a batch of one sequence."""
    frames = np.stack([person(0, shift=t) for t in range(40)])
    np.save(tmp_path / "a.npy", frames[None])
    found = read(tmp_path / "a.npy", num_frames=40)
    assert len(found.positions) == 40
    np.testing.assert_allclose(found.positions[7], frames[7, :, :2], atol=1e-4)
    assert any("one person in 40 frames" in line for line in found.report)
    np.save(tmp_path / "b.npy", frames[None, :5])  # five people in a picture
    assert len(read(tmp_path / "b.npy", num_frames=1).positions) == 1


def test_tracks_of_the_file_win_over_nearness(tmp_path: Path) -> None:
    entries = []
    for t in T:
        right, left = person(t, shift=-200 + 80 * t), person(t, shift=200 - 80 * t) * (1, 1, 0.6)
        entries += [{"image_id": t, "keypoints": p.ravel().tolist(), "idx": i}
                    for i, p in ((3, left), (7, right))]  # fmt: skip
    found = read(write(tmp_path / "a.json", entries))
    u = found.positions[:, 0, 0]
    np.testing.assert_allclose(u, [120 + 83 * t for t in T])
    assert any("'7' of the file" in line for line in found.report)
    for word in ("person_id", "instance_id", "trackId"):
        marks = [{"id": n, "image_id": each["image_id"], "keypoints": each["keypoints"],
                  "attributes": {word: each["idx"]}} for n, each in enumerate(entries)]  # fmt: skip
        again = read(write(tmp_path / "b.json", {"annotations": marks}))
        np.testing.assert_array_equal(again.positions, found.positions)


def cvat_point(name: str | None, row: np.ndarray, more: str = "") -> str:
    u, v, _ = row
    return f'<points label="{name}" points="{u:.2f},{v:.2f}" occluded="0" {more}/>'


def test_cvat_of_a_video(tmp_path: Path) -> None:
    text = ""
    for t in range(FRAMES):
        out = 'outside="1"' if t == 3 else 'outside="0"'
        points = "".join(cvat_point(n, row, out) for n, row in zip(COCO, person(t), strict=True))
        text += f'<skeleton frame="{t}" {out}>{points}</skeleton>'
    text = f'<annotations><track id="4" label="person">{text}</track></annotations>'
    check(read(write(tmp_path / "annotations.xml", text)), empty=(3,))


def test_cvat_of_points_without_skeletons(tmp_path: Path) -> None:
    tracks = []
    for joint, name in enumerate(COCO):
        lines = (
            cvat_point(None, person(t)[joint], f'frame="{t}" outside="{int(t == 3)}"')
            for t in range(FRAMES)
        )
        marks = "".join(lines).replace('label="None"', "")
        tracks.append(f'<track id="{joint}" label="{name}">{marks}</track>')
    text = f"<annotations>{''.join(tracks)}</annotations>"
    check(read(write(tmp_path / "annotations.xml", text)), empty=(3,))


def test_cvat_of_people_who_are_many_points(tmp_path: Path) -> None:
    tracks = ""
    for number, of in enumerate((other, person)):
        marks = ""
        for t in SEEN:
            places = ";".join(f"{u},{v}" for u, v, _ in of(t))
            marks += f'<points frame="{t}" outside="0" occluded="0" points="{places}"/>'
        tracks += f'<track id="{number}" label="person">{marks}</track>'
    text = f"<annotations>{tracks}</annotations>"
    check(read(write(tmp_path / "annotations.xml", text)), empty=(3,))


def test_cvat_of_pictures(tmp_path: Path) -> None:
    text = ""
    for t in reversed(range(FRAMES)):
        points = "".join(cvat_point(n, row) for n, row in zip(COCO, person(t), strict=True))
        text += (
            f'<image id="{t}" name="frame_{t:06d}.png">'
            f'<skeleton label="person">{points}</skeleton></image>'
        )
    check(read(write(tmp_path / "annotations.xml", f"<annotations>{text}</annotations>")))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot/>", "expected CVAT's annotations, found <robot>"),
        ("<annotations><track><skeleton frame='x'/></track></annotations>", "a frame's number"),
        ("<annotations><image id='0'><points points='1'/></image></annotations>", "one point"),
        ("<annotations>", "does not parse"),
    ],
)
def test_cvat_that_is_none(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(KeypointError, match=message):
        read(write(tmp_path / "annotations.xml", text))


def test_decimal_commas(tmp_path: Path) -> None:
    heading = ";".join(["frame", *(f"{name}_{axis}" for name in COCO for axis in "xy")])
    rows = [heading]
    for t in range(FRAMES):
        cells = (f"{value:.2f}".replace(".", ",") for value in person(t)[:, :2].ravel())
        rows.append(";".join([str(t), *cells]))
    check(read(write(tmp_path / "a.csv", "\n".join(rows))))


@pytest.mark.parametrize("name", ["a.pkl", "a.p"])
def test_no_pickle_is_read(tmp_path: Path, name: str) -> None:
    with pytest.raises(KeypointError, match=r"code may run.*numpy\.savez"):
        read(write(tmp_path / name, "x"))


# What files call things, and what they leave out.


def wide(heads: list[str], rows: list[list[Any]]) -> str:
    return "\n".join(",".join(map(str, row)) for row in [heads, *rows]) + "\n"


def ends(*kinds: str) -> list[str]:
    return [name + kind for name in TFJS for kind in kinds]


@pytest.mark.parametrize(
    "head", ["", "Unnamed: 0", "Frame #", "frameNumber", "fnum", "image_name", "file", "Time (s)"]
)
def test_columns_that_say_the_frame(tmp_path: Path, head: str) -> None:
    """A frame that is left out does not move those behind it."""
    say = "{}.png" if head in ("image_name", "file") else "{}"
    rows = [[say.format(t / 25 if "Time" in head else t), *person(t).flat] for t in SEEN]
    path = write(tmp_path / "a.csv", wide([head, *ends("_x", "_y", "_c")], rows))
    names = [f"{t}.png" for t in T]
    check(read(path, frame_names=names, frame_rate=25), (3,))


def test_rows_without_a_frame_are_as_many_as_the_frames(tmp_path: Path) -> None:
    path = write(
        tmp_path / "a.csv", wide(ends("_x", "_y", "_c"), [[*person(t).flat] for t in SEEN])
    )
    with pytest.raises(KeypointError, match="expected 6 frames, as the video has, found 5"):
        read(path)


@pytest.mark.parametrize(
    "kinds",
    [("X", "Y", "Score"), (" (x)", " (y)", " (conf)"), ("_u", "_v", "_c"), (":x", ":y", ":p"),
     ("_x_px", "_y_px", "_keypoint_score"), ("_image_x", "_image_y", "_vis")],
)  # fmt: skip
def test_columns_of_joints(tmp_path: Path, kinds: tuple[str, ...]) -> None:
    rows = [[t, *person(t).flat, ""] for t in T]  # and a comma at the end of the line
    text = "# made by a program\n" + wide(["frame", *ends(*kinds)], rows)
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-16")
    found = read(path)
    check(found)
    assert found.confidence[0, 0] == 0.6


@pytest.mark.parametrize("heads", ["frame,body_part,x,y,score", "image,keypoint_name,u,v,conf"])
def test_long_tables(tmp_path: Path, heads: str) -> None:
    rows = [[t, name, *row] for t in SEEN for name, row in zip(TFJS, person(t), strict=True)]
    check(read(write(tmp_path / "a.txt", wide(heads.split(","), rows))), (3,))


def test_columns_left_out_are_told(tmp_path: Path) -> None:
    rows = [[t, *person(t).flat] for t in T]
    found = read(write(tmp_path / "a.csv", wide(["frame", *ends("_x", "_y", "_w")], rows)))
    assert any("columns left out: 'nose_w" in line for line in found.report)


@pytest.mark.parametrize("key", ["joint_names", "keypointNames", "names"])
def test_names_that_a_file_says_win_over_their_number(tmp_path: Path, key: str) -> None:
    layout = ALIASES["H36M-17"]
    names = [name or f"spine{index}" for index, name in enumerate(layout)]
    frames = [{"frame": t, "keypoints": person(t, layout).tolist()} for t in T]
    where = ("l_wrist", "r_ankle", "l_hip")
    check(read(write(tmp_path / "a.json", {key: names, "frames": frames})), names=where)
    array = np.stack([person(t, layout) for t in SEEN])
    np.savez(tmp_path / "a.npz", keypoints=array, frame=SEEN, **{key: np.array(names, "S")})
    check(read(tmp_path / "a.npz"), (3,), names=where)


def test_feet_of_human36m_are_ankles(tmp_path: Path) -> None:
    layout = ALIASES["H36M-17"]
    names = [(name or f"spine{i}").replace("ankle", "foot") for i, name in enumerate(layout)]
    frames = [{"frame": t, "keypoints": person(t, layout).tolist()} for t in T]
    path = write(tmp_path / "a.json", {"joint_names": names, "frames": frames})
    check(read(path), names=("l_ankle", "r_ankle"))


@pytest.mark.parametrize(
    "head",
    [{"videoWidth": 1280, "videoHeight": 960}, {"resolution": [1280, 960]},
     {"metadata": {"width": 1280, "height": 960}}],
)  # fmt: skip
def test_the_size_that_a_file_says(tmp_path: Path, head: dict[str, Any]) -> None:
    frames = [{"frame_id": float(t), "keypoints": (person(t) * (2, 2, 1)).tolist()} for t in SEEN]
    check(read(write(tmp_path / "a.json", {**head, "frames": frames})), (3,))


def test_fractions_of_a_canvas_whose_size_is_said(tmp_path: Path) -> None:
    """DWPose in ComfyUI: not a person of one pixel."""
    canvas = {"canvas_width": 1280, "canvas_height": 960}
    people = [
        [{"pose_keypoints_2d": (person(t, OPENPOSE) / (639, 479, 1)).ravel().tolist()}] for t in T
    ]
    path = write(tmp_path / "a.json", [{"people": each, **canvas} for each in people])
    with pytest.raises(KeypointError, match="zero-one"):
        read(path)
    check(read(path, normalised="zero-one"))


@pytest.mark.parametrize("tell", ["true", "counted"])
def test_times_of_a_film_whose_rate_varies(tmp_path: Path, tell: str) -> None:
    shown = [0.0, 0.03, 0.06, 0.15, 0.24, 0.27]
    times = shown if tell == "true" else [t * 0.054 for t in T]
    entries = [{"timestamp_ms": 1000 * times[t], "keypoints": flat(t)} for t in SEEN]
    path = write(tmp_path / "a.json", entries)
    film = Film(FRAMES, rate=1 / 0.054, times=lambda: shown)
    check(read_person(path, film=film, whom=Whom(0, "largest", SIZE)), (3,))


def test_people_by_float_numbers_and_confidences_beside(tmp_path: Path) -> None:
    def entry(p: np.ndarray, number: float) -> dict[str, Any]:
        return {"keypoints": p[:, :2].ravel().tolist(), "confidence": p[:, 2].tolist(),
                "idx": number}  # fmt: skip

    frames = [{"frame": t, "people": [entry(other(t), 1.0), entry(person(t), 2.0)]} for t in T]
    path = write(tmp_path / "a.json", {"frames": frames})
    whom = Whom(0, "2", SIZE)
    found = read_person(path, film=Film(FRAMES), whom=whom)
    check(found)
    assert found.confidence[0, 0] == 0.6


def test_pairs_in_a_row_and_what_is_minus_one(tmp_path: Path) -> None:
    def pairs(t: int) -> list[float]:
        return np.vstack([person(t)[:1, :2], [[-1, -1]], person(t)[2:, :2]]).ravel().tolist()

    frames = [{"frame": t, "keypoints": pairs(t), "score": 0.9} for t in T]
    found = read(write(tmp_path / "a.json", frames))
    check(found)
    assert (found.confidence[:, 1] == 0).all()


@pytest.mark.parametrize("form", ["root", "movenet", "texts", "names and score"])
def test_frames_in_json_otherwise(tmp_path: Path, form: str) -> None:
    contents: dict[str, Any] = {
        "root": {"fps": 30, "predictions": [[mmpose(t, person(t))] for t in T]},
        "movenet": [[[(person(t) / (*SIZE, 1))[:, [1, 0, 2]].tolist()]] for t in T],
        "texts": [json.dumps([columns(person(t))]) for t in T],
        "names and score": [
            {"score": 0.9, **dict(zip(TFJS, person(t).tolist(), strict=True))} for t in T
        ],
    }
    check(read(write(tmp_path / "a.json", contents[form])))


@pytest.mark.parametrize("form", ["x, y, z, confidence", "joints last", "movenet of many"])
def test_arrays_otherwise(tmp_path: Path, form: str) -> None:
    frames = np.stack([person(t) for t in T])
    many = np.zeros((FRAMES, 1, 6, 56))
    for place, of in ((0, other), (1, person)):
        rows = [(of(t) / (*SIZE, 1))[:, [1, 0, 2]].ravel() for t in T]
        many[:, 0, place, :51] = rows
    array = {
        "x, y, z, confidence": np.insert(frames, 2, 0.1, axis=2),
        "joints last": frames.swapaxes(1, 2),
        "movenet of many": many,
    }[form]
    np.save(tmp_path / "a.npy", array)
    check(read(tmp_path / "a.npy"))


def test_y_before_x_is_told(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.stack([person(t)[:, [1, 0, 2]] for t in T]))
    assert any("y before x" in line for line in read(tmp_path / "a.npy").report)
    np.save(tmp_path / "a.npy", np.stack([person(t) for t in T]))
    assert not any("y before x" in line for line in read(tmp_path / "a.npy").report)


def test_names_of_pictures_with_what_programs_add(tmp_path: Path) -> None:
    codes = ("9f", "12", "e0", "77", "3b", "a4")
    labelled = [
        {"image_id": f"frame_{t:04d}_jpg.rf.{codes[t] * 8}.jpg", "keypoints": flat(t)} for t in T
    ]
    check(read(write(tmp_path / "a.json", labelled)))
    numbered = [{"image_id": 300 + 9 * t, "keypoints": flat(t)} for t in SEEN]
    names = [f"{300 + 9 * t:012d}.jpg" for t in T]
    check(read(write(tmp_path / "b.json", numbered), frame_names=names), (3,))


def test_labels_called_otherwise_than_their_pictures(tmp_path: Path) -> None:
    (tmp_path / "._0.json").write_bytes(b"\0\5\x16\7")  # macOS adds such files
    for t in T:
        _, content = FOLDERS["labelme"](t)
        write(tmp_path / f"{9 - t}.json", content)
    check(read(tmp_path, frame_names=[f"p{t}.png" for t in T]))
    write(tmp_path / "9.json", {**content, "imageWidth": 320})
    with pytest.raises(KeypointError, match="several sizes"):
        read(tmp_path)


def test_labels_of_pictures_that_are_numbered_by_the_camera(tmp_path: Path) -> None:
    for t in T:
        joints = " ".join(f"{u / 640} {v / 480} {c}" for u, v, c in person(t))
        write(tmp_path / f"IMG_{2000 + t}.txt", f"0 0.5 0.5 0.3 0.8 {joints}")
    check(read(tmp_path))
    (tmp_path / "IMG_2003.txt").unlink()
    check(read(tmp_path, frame_names=[f"IMG_{2000 + t}.JPG" for t in T]), (3,))
    (tmp_path / "IMG_2000.txt").unlink()
    with pytest.raises(KeypointError, match="give the folder of pictures as the video"):
        read(tmp_path)


def test_cvat_of_larger_pictures_of_two_people_in_any_order(tmp_path: Path) -> None:
    text = ""
    for t in T:
        people = ""
        for of in (person, other)[:: 1 - 2 * (t % 2)]:
            rows = zip(TFJS, of(t) * 2, strict=True)
            people += f"<skeleton>{''.join(cvat_point(n, row) for n, row in rows)}</skeleton>"
        text += f'<image id="{t}" name="{t}.png" width="1280" height="960">{people}</image>'
    check(read(write(tmp_path / "a.xml", f"<annotations>{text}</annotations>")))


def test_sleap_hdf5_that_ends_early_or_has_frames_first(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    points = np.stack([person(t)[:, :2] for t in T[:5]])[:, None]
    for axes in ((0, 1, 2, 3), (1, 3, 2, 0)):
        with h5py.File(tmp_path / "a.analysis.h5", "w") as file:
            file["tracks"], file["node_names"] = points.transpose(axes), np.array(TFJS, "S")
        check(read(tmp_path / "a.analysis.h5"), (5,))


def test_deeplabcut_hdf5_of_labelled_pictures(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "CollectedData.h5", "w") as file:
        group = file.create_group("df_with_missing")
        group["block0_values"] = np.stack([person(t)[:, :2].ravel() for t in SEEN])
        columns = [("me", name, kind) for name in TFJS for kind in "xy"]
        rows = [("labeled-data", "clip", f"img{t:03d}.png") for t in SEEN]
        for axis, labels in ((0, columns), (1, rows)):
            for level, names in enumerate(zip(*labels, strict=True)):
                known = sorted(set(names))
                group[f"axis{axis}_level{level}"] = np.array(known, "S")
                group[f"axis{axis}_label{level}"] = np.array([known.index(n) for n in names], "i1")
    check(read(tmp_path / "CollectedData.h5"), (3,))


def test_nobody_is_not_the_leftmost(tmp_path: Path) -> None:
    people = np.stack(
        [np.stack([person(t, shift=60), person(t) * (1, 1, 0), person(t)]) for t in T]
    )
    np.save(tmp_path / "a.npy", people)
    whom = Whom(0, "leftmost", SIZE)
    check(read_person(tmp_path / "a.npy", film=Film(FRAMES), whom=whom))


def test_words_that_mean_something_else(tmp_path: Path) -> None:
    """Labels of classes are no joints' names, a video's name no picture's, a box no joint."""
    frames = [{"file": "clip.mp4", "keypoints": person(t).tolist()} for t in T]
    path = write(tmp_path / "a.json", {"labels": ["person"], "frames": frames})
    check(read(path))
    np.savez(tmp_path / "a.npz", keypoints=[person(t) for t in T], labels=np.array(["person"]))
    check(read(tmp_path / "a.npz"))
    rows = [["clip.mp4", 1, 5, 5, 9, 9, *person(t).flat] for t in T]
    heads = ["file", "id", "x", "y", "w", "h", *ends("_x", "_y", "_c")]
    check(read(write(tmp_path / "a.csv", wide(heads, rows))))


@pytest.mark.parametrize("label", ["{}.0", "{}.000e+00"])
def test_frame_numbers_as_decimals(tmp_path: Path, label: str) -> None:
    rows = [[label.format(t), *person(t).flat] for t in SEEN]
    check(read(write(tmp_path / "a.csv", wide(["frame", *ends("_x", "_y", "_c")], rows))), (3,))


def test_a_file_that_may_count_from_one_is_told(tmp_path: Path) -> None:
    for last, doubt in ((5, True), (6, False)):
        rows = [[t, *person(t).flat] for t in range(1, last + 1)]
        path = write(tmp_path / "a.csv", wide(["frame", *ends("_x", "_y", "_c")], rows))
        report = read(path, first_frame=2).report
        assert any("a frame late" in line for line in report) == doubt


def test_a_heading_behind_a_sign_and_columns_set_apart_by_spaces(tmp_path: Path) -> None:
    """NumPy's savetxt."""
    rows = np.array([[t, *person(t).flat] for t in T])
    heads = ["frame", *ends("_x", "_y", "_c")]
    for delimiter in (",", " "):
        path = tmp_path / "a.txt"
        np.savetxt(path, rows, delimiter=delimiter, header="by me\n" + delimiter.join(heads))
        check(read(path))


@pytest.mark.parametrize("merged", [False, True])
def test_joints_above_x_and_y(tmp_path: Path, merged: bool) -> None:
    """Two rows of headings, as pandas and spreadsheets write them."""
    above = [cell for name in TFJS for cell in (name, *([""] * 2 if merged else [name] * 2))]
    rows = [["", *["x", "y", "score"] * 17], *([] if merged else [["frame"]])]
    rows += [[t, *person(t).flat] for t in SEEN]
    check(read(write(tmp_path / "a.csv", wide(["frame" if merged else "", *above], rows))), (3,))


def test_a_comment_with_as_many_commas_is_no_heading(tmp_path: Path) -> None:
    heads = ["frame", *ends("_x", "_y", "_c")]
    table = wide(heads, [[t, *person(t).flat] for t in T])
    check(read(write(tmp_path / "a.csv", f"# {','.join(heads[::-1])}\n{table}")))


def test_two_rows_of_headings_and_nothing_below(tmp_path: Path) -> None:
    rows = [["", *["x", "y"] * 2]]
    path = write(tmp_path / "a.csv", wide(["frame", "nose", "", "l_elbow", ""], rows))
    with pytest.raises(KeypointError, match="a heading and nothing below it"):
        read(path)


def test_joints_by_number_of_which_some_are_left_out(tmp_path: Path) -> None:
    order = np.random.default_rng(0).permutation([i for i in range(17) if i not in (1, 4)])
    rows = [{"frame": t, "keypoints": [{"id": int(i), "x": x, "y": y, "score": c} for i in order
             for x, y, c in [person(t)[i]]]} for t in T]  # fmt: skip
    check(read(write(tmp_path / "a.json", rows)))
    heads = [f"{kind}{i}" for i in order for kind in "xyc"]
    table = wide(["frame", *heads], [[t, *person(t)[order].flat] for t in T])
    check(read(write(tmp_path / "a.csv", table)))
    with pytest.raises(KeypointError, match="row 1: joint 0 has x or y, not both"):
        read(write(tmp_path / "a.csv", table.replace("y0,", "a0,")))
    few = ["frame", *(f"{kind}{i}" for i in range(3, 20) for kind in "xyc")]
    table = wide(few, [[t, *person(t).flat] for t in T])
    with pytest.raises(KeypointError, match="17 joints numbered from 3 to 19: which they are"):
        read(write(tmp_path / "a.csv", table))


def test_a_joint_without_a_place_has_no_confidence(tmp_path: Path) -> None:
    """Whatever stands beside it."""
    frames = [{"frame_id": t, "instances": [mmpose(t, person(t))]} for t in T]
    frames[0]["instances"][0]["keypoints"][9] = [None, 255.0]
    found = read(write(tmp_path / "a.json", frames))
    assert found.confidence[:2, found.names.index("l_wrist")].tolist() == [0.0, 0.78]
    frames[0]["instances"][0]["keypoints"][9] = [255.0]
    with pytest.raises(KeypointError, match="as many numbers for every joint, found 1 and 2"):
        read(write(tmp_path / "a.json", frames))


def test_people_with_boxes_and_how_long_it_took(tmp_path: Path) -> None:
    """Roboflow's: names are classes, and `time` is no frame's."""
    frames = [
        {"predictions": [{"x": 3, "y": 4, "width": 9, "height": 9, "class": "person", "keypoints": [
            {"x": x, "y": y, "confidence": c, "class_id": i, "class": TFJS[i]}
            for i, (x, y, c) in enumerate(person(t)) if i != 3]}],
         "image": {"width": 640, "height": 480}, "time": 0.03 - 0.01 * (t % 2) + 1e-4 * t}
        for t in T
    ]  # fmt: skip
    check(read(write(tmp_path / "a.json", frames)))


def test_times_of_frames_in_any_order(tmp_path: Path) -> None:
    frames = [{"time": t / 25, "instances": [mmpose(t, person(t))]} for t in T]
    rising = read(write(tmp_path / "a.json", frames))
    falling = read(write(tmp_path / "b.json", frames[::-1]))
    assert torch.equal(rising.positions, falling.positions)


@pytest.mark.parametrize("key", ["keypoints", "pred_keypoints", "poseLandmarks"])
def test_words_in_any_case(tmp_path: Path, key: str) -> None:
    rows = [
        {"frame": t, "poseWorldLandmarks": [[0, 0, 0]] * 17, key: person(t).tolist()} for t in T
    ]
    check(read(write(tmp_path / "a.json", rows)))


def test_movenet_of_one_picture_after_the_other(tmp_path: Path) -> None:
    values = [(person(t) / (*SIZE, 1))[None, :, [1, 0, 2]] for t in T]
    np.save(tmp_path / "a.npy", values)
    check(read(tmp_path / "a.npy"))
    named = {"keypoints": np.array(values)[..., [1, 0, 2]], "joint_names": TFJS}
    np.savez(tmp_path / "a.npz", **named)  # whose names say that it is none
    found = [read(tmp_path / "a.npz", normalised="zero-one"), read(tmp_path / "a.npy")]
    torch.testing.assert_close(*(each.positions for each in found), rtol=0, atol=1.0)


def test_names_that_end_in_joint(tmp_path: Path) -> None:
    rows = [[t, *person(t).flat] for t in T]
    heads = ["frame", *(f"{name}_joint{end}" for name in TFJS for end in ("_x", "_y", "_c"))]
    check(read(write(tmp_path / "a.csv", wide(heads, rows))))


def test_y_that_counts_upwards_is_told(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", [person(t) * (1, -1, 1) + (0, 480, 0) for t in T])
    assert any("y counts upwards" in line for line in read(tmp_path / "a.npy").report)


@pytest.mark.parametrize(
    ("name", "words"),
    [("a.mp4", "torchcss detect"), ("a.png", "init PICTURE --click"), ("a.trc", "in space"),
     ("a.xlsx", "save it as CSV"), ("a.json.gz", "unpack"), ("a.yaml", "of another format"),
     ("a.nc", "to_dlc_file"), ("a.nwb", "Neurodata")],
)  # fmt: skip
def test_files_of_other_kinds(tmp_path: Path, name: str, words: str) -> None:
    with pytest.raises(KeypointError, match=words):
        read(write(tmp_path / name, "a: 1"))


@pytest.mark.parametrize("word", ["cameras", "camera_matrix"])
def test_a_calibration_is_no_keypoints(tmp_path: Path, word: str) -> None:
    with pytest.raises(KeypointError, match=r"a\.json: a calibration.*--camera"):
        read(write(tmp_path / "a.json", {word: {"rows": 3, "cols": 3}, "image_width": 640}))


# What programs of other versions write.


def headed(rows: dict[str, np.ndarray], first: str = "frame", factor: float = 1.0) -> str:
    """A table of joints, a row each; what is first in a row stands for its frame."""
    lines = [",".join([first, *(f"{n}_{part}" for n in TFJS for part in ("x", "y", "conf"))])]
    lines += [",".join(map(str, [key, *(of * (1, 1, factor)).ravel()])) for key, of in rows.items()]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("word", "code"),
    [
        ("timestamp", "00:00:00.{:03d}"),
        ("timecode", "0:00,{:03d}"),
        ("time_s", "00:00.{:03d}"),
        ("timestamp", "2024-05-03 10:15:30.{:03d}"),
        ("Time", "2024-05-03T10:15:30.{:03d}Z"),
    ],
)
def test_times_as_text(tmp_path: Path, word: str, code: str) -> None:
    codes = {code.format(40 * t): person(t) for t in SEEN}
    text = headed(codes, word)
    text = text.replace(",", ";").replace("0:00;", "0:00,") if "," in code else text
    path = write(tmp_path / "a.csv", text.replace("\n", "\r\n"))
    check(read(path, frame_rate=25.0), (3,))
    entries = [{word: key, "keypoints": of.tolist()} for key, of in codes.items()]
    check(read(write(tmp_path / "a.json", entries), frame_rate=25.0), (3,))


def test_whole_seconds_as_text_are_seconds(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", headed({f"00:0{t}": person(t) for t in SEEN}, "timestamp"))
    check(read(path, frame_rate=1.0), (3,))
    path = write(tmp_path / "a.json", [{"timestamp": f"0:0{t}", "joints": person(t).tolist()}
                                       for t in SEEN])  # fmt: skip
    check(read(path, frame_rate=1.0), (3,))


def test_a_time_code_that_counts_frames_is_left_out(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", headed({f"01:00:00:0{t}": person(t) for t in T}, "timecode"))
    found = read(path)
    check(found)
    assert "columns left out: 'timecode'" in found.report


def test_confidences_in_percent(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", headed({f"{t}": person(t) for t in T}, factor=100))
    found = read(path)
    check(found)
    assert "confidences run to 88: they are taken for percent" in found.report
    np.testing.assert_allclose(found.confidence[0], person(0)[:, 2])
    write(path, headed({f"{t}": person(t) for t in T}, factor=20))
    with pytest.raises(KeypointError, match=r"confidence 17\.6; expected 0 to 1"):
        read(path)


@pytest.mark.parametrize("form", ["pictures", "video", "names as text"])
def test_via_from_version_3_on(tmp_path: Path, form: str) -> None:
    marks: dict[str, Any] = {
        f"{t}_{i}": {"vid": "1" if form == "video" else f"{t + 1}", "flg": 0,
                     "z": [t / 25] if form == "video" else [], "xy": [1, x, y],
                     "av": {"1": TFJS[i] if form == "names as text" else f"{i}"}}
        for t in SEEN for i, (x, y, _) in enumerate(person(t))
    }  # fmt: skip
    marks["box"] = {**marks["0_0"], "xy": [2, 1, 1, 9, 9]}
    options = {} if form == "names as text" else {str(i): name for i, name in enumerate(TFJS)}
    names = ["clip.mp4"] if form == "video" else [f"f_{t:03d}.jpg" for t in T]
    project = {
        "project": {"data_format_version": "3.1.1"}, "config": {}, "metadata": marks,
        "attribute": {"1": {"aname": "joint", "type": 4, "options": options}},
        "file": {f"{n}": {"fid": n, "fname": name} for n, name in enumerate(names, 1)},
        "view": {f"{n}": {"fid_list": [n]} for n in range(1, len(names) + 1)},
    }  # fmt: skip
    path = write(tmp_path / "a.json", project)
    check(read(path, frame_rate=25.0), (3,))
    if form == "video":
        project["view"] = {"1": {"fid_list": [1]}, "2": {"fid_list": [1]}}
        marks["0_1"]["vid"] = "2"
        with pytest.raises(KeypointError, match="points of several videos"):
            read(write(path, project), frame_rate=25.0)
    project["view"] = {"1": {}}
    with pytest.raises(KeypointError, match="not VIA's pictures"):
        read(write(path, project))


@pytest.mark.parametrize("spelt", [str, json.dumps])
def test_tables_whose_cells_hold_all_joints(tmp_path: Path, spelt: Callable[[Any], str]) -> None:
    """Ultralytics' CSV, by pandas or by Polars."""
    stream = io.StringIO()
    rows = csv.writer(stream)
    rows.writerow(["", "frame", "name", "confidence", "box", "keypoints"])
    for t in T:
        for of in (person(t), other(t))[: 2 * (t != 3)]:
            own = columns(of)["keypoints"]
            rows.writerow([0, t, "person", 0.9, spelt({"x1": 1.0}), spelt(own)])
    rows.writerow([0, 3, "", "", "", ""])
    check(read(write(tmp_path / "a.csv", stream.getvalue())), (3,))


def test_people_by_name_in_frames(tmp_path: Path) -> None:
    frames = {f"{t + 1}": {"Ben": {"keypoints": other(t).tolist()},
                           "Anna": {"keypoints": person(t).tolist()}} for t in T}  # fmt: skip
    found = read(write(tmp_path / "a.json", {"frames": frames}))
    check(found)
    assert any("'Anna' of the file" in line for line in found.report)


def test_arrays_of_several_cameras_are_told(tmp_path: Path) -> None:
    stack = np.stack([person(t)[:, :2] for t in T])
    np.save(tmp_path / "a.npy", np.stack([stack, stack + 5, stack - 5]))
    with pytest.raises(KeypointError, match="3 cameras or people with 6 frames each"):
        read(tmp_path / "a.npy")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"info": {}, "categories": {}, "items": []}, "Datumaro's; datum convert"),
        ({"description": "", "tags": [], "size": {}, "objects": []}, "Supervisely's; export"),
        ([{"version": 0, "tags": [], "shapes": [], "tracks": []}], "CVAT's backup of a task"),
        ({"version": "2.0", "item": {}, "annotations": []}, "V7 Darwin's"),
        ({"bone_list": [], "frames": []}, "in space"),
        ({"univTime": 1.0, "bodies": [{"joints19": [1.0] * 76}]}, "CMU Panoptic's joints in space"),
        ({"annolist": [{"image": [{"name": "0.jpg"}]}]}, "as MPII and PoseTrack had them"),
        ([{"bodyparts": [], "bboxes": [], "bbox_scores": []}], "give the .h5 beside it"),
    ],
)
def test_formats_that_are_not_read_are_named(tmp_path: Path, content: Any, words: str) -> None:
    with pytest.raises(KeypointError, match=words):
        read(write(tmp_path / "a.json", content))
    with pytest.raises(KeypointError, match=words):
        read(write(tmp_path / "folder" / "f_0.json", content).parent)


def test_xml_in_a_folder(tmp_path: Path) -> None:
    for name in ("a", "b"):
        path = write(tmp_path / "x" / f"{name}.xml", "<annotation><object/></annotation>")
        with pytest.raises(KeypointError, match="LabelMe on the web or Pascal VOC"):
            read(path.parent)
    images = "".join(
        f'<image id="{t}" name="f_{t}.png" width="640" height="480"><skeleton label="person">'
        + "".join(f'<points label="{n}" points="{x},{y}"/>'
                  for n, (x, y, _) in zip(TFJS, person(t), strict=True))
        + "</skeleton></image>"
        for t in T
    )  # fmt: skip
    path = write(tmp_path / "cvat" / "annotations.xml", f"<annotations>{images}</annotations>")
    check(read(path.parent))


@pytest.mark.parametrize("seen", ["True", "85%", "2"])
def test_confidences_in_other_words(tmp_path: Path, seen: str) -> None:
    heading = ",".join(f"{n}_x,{n}_y,{n}_visible" for n in TFJS)
    hidden = {"True": "False", "85%": "0 %", "2": "1"}[seen]
    rows = [",".join(f"{x},{y},{seen if n % 3 else hidden}" for n, (x, y, _) in
                     enumerate(person(t))) for t in T]  # fmt: skip
    found = read(write(tmp_path / "a.csv", "\n".join([heading, *rows])))
    check(found, names=("r_eye", "r_wrist"))
    expected = {"True": (0, 1), "85%": (0, 0.85), "2": (0.5, 1)}[seen]
    assert found.confidence.unique().tolist() == pytest.approx(expected)
    assert sum("taken" in line for line in found.report) == (seen != "True")
    if seen == "True":
        entries = [{"frame": t, "keypoints": [{"name": n, "x": x, "y": y, "visible": n != "nose"}
                    for n, (x, y, _) in zip(TFJS, person(t), strict=True)]} for t in T]  # fmt: skip
        check(read(write(tmp_path / "a.json", entries)), names=LIMBS[:4])


@pytest.mark.parametrize("form", ["json", "csv"])
def test_nanoseconds(tmp_path: Path, form: str) -> None:
    times = {f"{1_700_000_000_000_000_000 + 40_000_000 * t}": t for t in SEEN}
    if form == "csv":
        path = write(tmp_path / "a.csv", headed({k: person(t) for k, t in times.items()}, "time"))
    else:
        entries = [{"timestamp": int(k), "joints": person(t).tolist()} for k, t in times.items()]
        path = write(tmp_path / "a.json", entries)
    check(read(path, frame_rate=25.0), (3,))


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_times_as_keys(tmp_path: Path, unit: float) -> None:
    frames = {f"{unit * t / 25:.3f}": person(t).tolist() for t in SEEN}
    check(read(write(tmp_path / "a.json", frames), frame_rate=25.0), (3,))


def test_columns_of_joints_by_index(tmp_path: Path) -> None:
    heads = [f"keypoints[{n}].{axis}" for n in range(17) for axis in ("x", "y", "score")]
    rows = [[t, *person(t).flat] for t in T]
    check(read(write(tmp_path / "a.csv", wide(["frame", *heads], rows))))


def test_the_number_of_a_picture_is_the_one_that_changes(tmp_path: Path) -> None:
    entries = [{"image_id": f"GOPR0042_{t:04d}_1080p.jpg", "keypoints": flat(t)} for t in SEEN]
    check(read(write(tmp_path / "a.json", entries)), (3,))


def test_files_without_numbers_are_as_many_as_the_frames(tmp_path: Path) -> None:
    for t in SEEN:
        write(tmp_path / "a" / f"{'abcdef'[t]}.json", {"people": [{"keypoints": flat(t)}]})
    with pytest.raises(KeypointError, match="expected 6 frames, as the video has, found 5"):
        read(tmp_path / "a")
    write(tmp_path / "a" / "d.json", {"people": []})
    check(read(tmp_path / "a"), (3,))


def test_people_without_a_number(tmp_path: Path) -> None:
    heading, *rows = headed({f"{t},none": person(t) for t in T}, "frame,person_id").split("\n")
    rows += headed({f"{t},None": other(t) for t in T}).split("\n")[1:]
    check(read(write(tmp_path / "a.csv", "\n".join([heading, *rows]))))


def test_arrays_as_ultralytics_calls_them(tmp_path: Path) -> None:
    stack = np.stack([person(t) for t in T])
    np.savez(tmp_path / "a.npz", xy=stack[..., :2], conf=stack[..., 2], names=np.array(TFJS))
    check(read(tmp_path / "a.npz"))


def test_joints_in_capitals(tmp_path: Path) -> None:
    entries = [{"Frame": t, "Joints": [{"Name": n, "X": x, "Y": y, "Confidence": c}
                for n, (x, y, c) in zip(TFJS, person(t), strict=True)]} for t in T]  # fmt: skip
    check(read(write(tmp_path / "a.json", entries)))
    check(read(write(tmp_path / "a.json", {"Version": 2, "Frames": entries})))


@pytest.mark.parametrize("around", ["results", "pictures"])
def test_the_size_that_a_frame_says(tmp_path: Path, around: str) -> None:
    frames = [{"people": [{"keypoints": (person(t) * (0.5, 0.5, 1)).tolist()}],
               "canvas_width": 320, "canvas_height": 240} for t in T]  # fmt: skip
    content = {"fps": 25, "results": frames}
    if around == "pictures":
        content = {f"{t}.jpg": frame for t, frame in enumerate(frames)}
    found = read(write(tmp_path / "a.json", content))
    check(found)
    assert any("scaled from images of 320 x 240" in line for line in found.report)
    boxes = [{"left": 9, "top": 8, "width": 64, "height": 48, "joints": flat(t)} for t in T]
    check(read(write(tmp_path / "a.json", boxes)))
    box = {"bbox": {"left": 1, "top": 2, "width": 64, "height": 48}, "keypoints": flat(0)}
    found = read(write(tmp_path / "a.json", box), num_frames=1)
    assert not any("scaled" in line for line in found.report)


def test_entries_of_several_videos_are_no_people(tmp_path: Path) -> None:
    heading, *rows = headed({f"{t},a.mp4": person(t) for t in T}, "frame,video").split("\n")
    path = write(tmp_path / "a.csv", "\n".join([heading, *rows]))
    check(read(path))
    rows += headed({f"{t},b.mp4": other(t) for t in T}).split("\n")[1:]
    with pytest.raises(KeypointError, match=r"entries of 2 videos, 'a\.mp4, b\.mp4'; expected"):
        read(write(path, "\n".join([heading, *rows])))
    entries = [{"camera": c, "frame": t, "joints": person(t).tolist()} for t in T for c in (0, 1)]
    with pytest.raises(KeypointError, match="entries of 2 videos, '0, 1'"):
        read(write(tmp_path / "a.json", entries))
    check(read(write(tmp_path / "a.json", entries[::2])))


def test_points_of_caliscope(tmp_path: Path) -> None:
    heading = (
        "sync_index,port,frame_index,frame_time,point_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y"
    )
    names = ALIASES["MediaPipe-33"]
    rows = [f"{t},{port},{t},{4e4 + t / 25},{n},{x:.0f},{y:.0f},,"
            for t in SEEN for port in (0, 1)
            for n, (x, y, _) in [*enumerate(person(t, names)), (105, (9, 9, 1))]]  # fmt: skip
    with pytest.raises(KeypointError, match="entries of 2 videos, '0, 1'"):
        read(write(tmp_path / "a.csv", "\n".join([heading, *rows])))
    rows = [row for row in rows if row.split(",")[1] == "1"]
    found = read(write(tmp_path / "a.csv", "\n".join([heading, *rows])))
    check(found, (3,))
    assert "points numbered from 100 on, of hands and face, are left out" in found.report


def test_players_with_what_is_visible_beside(tmp_path: Path) -> None:
    entries = [{"frame_idx": t, "width": 640, "height": 480, "players": [
        {"identity": who, "keypoints_xy": of[:, :2].tolist(), "keypoints_visible": [1] * 16 + [0]}
        for who, of in (("lower", other(t)), ("upper", person(t)))]} for t in T]  # fmt: skip
    found = read(write(tmp_path / "a.json", entries))
    check(found, names=LIMBS[:3])
    assert any("'upper' of the file" in line for line in found.report)
    assert found.confidence[0, found.names.index("r_ankle")] == 0


def test_normalised_columns_beside_pixels(tmp_path: Path) -> None:
    heading, *rows = headed({f"{t}": person(t) for t in T}).split("\n")
    heading += "".join(f",{n}_norm_x,{n}_norm_y" for n in TFJS)
    rows = [row + 17 * ",0.25,0.5" for row in rows]
    found = read(write(tmp_path / "a.csv", "\n".join([heading, *rows])))
    check(found)
    assert found.names == COCO


def test_a_box_beside_named_joints(tmp_path: Path) -> None:
    heading, *rows = headed({f"{t},1,2,300,400": person(t) for t in T}, "frame,x1,y1,x2,y2").split(
        "\n"
    )
    found = read(write(tmp_path / "a.csv", "\n".join([heading, *rows])))
    check(found)
    assert found.names == COCO
    assert any("columns left out: 'x1, y1, x2, y2'" in line for line in found.report)


@pytest.mark.parametrize("word", ["landmarks", "detections", "poses", "kpts", "pose_timeline"])
def test_frames_that_stand_where_people_do(tmp_path: Path, word: str) -> None:
    """Some call the list of frames after what is in them."""
    entries = [{"frame": t, "keypoints": (2 * person(t)[:, :2]).tolist()} for t in SEEN]
    content = {"fps": 25, "width": 1280, "height": 960, word: entries}
    check(read(write(tmp_path / "a.json", content)), (3,))


@pytest.mark.parametrize("kind", ["size", "fractions", "MediaPipe's pixels"])
def test_arrays_beside_the_size_of_the_video(tmp_path: Path, kind: str) -> None:
    stack = np.stack([person(t) for t in T]) * (0.5, 0.5, 1)
    if kind != "size":
        stack = np.stack([person(t, ALIASES["MediaPipe-33"]) for t in T])
        stack = np.insert(stack, 2, 0.1, axis=-1)
    if kind == "fractions":
        stack[..., :2] = (stack[..., :2] + 0.5) / SIZE
    size = (320, 240) if kind == "size" else SIZE
    np.savez(tmp_path / "a.npz", keypoints=stack, world=np.zeros_like(stack), fps=25.0,
             width=size[0], height=size[1])  # fmt: skip
    check(read(tmp_path / "a.npz"))


@pytest.mark.parametrize("suffix", ["json", "jsonl", "ndjson", "txt"])
def test_an_object_in_every_line(tmp_path: Path, suffix: str) -> None:
    lines = [json.dumps({"frame": t, "body": [{"body_id": 4, "keypoints": dict(
        zip(TFJS, person(t).tolist(), strict=True))}]}) for t in SEEN]  # fmt: skip
    check(read(write(tmp_path / f"a.{suffix}", "\n".join(lines))), (3,))
    path = write(tmp_path / f"a.{suffix}", "\n".join([*lines, "{"]))
    with pytest.raises(KeypointError, match="nor one object in every line"):
        read(path)
    with pytest.raises(KeypointError, match=f"b.{suffix}: .*[Nn]o such file|missing"):
        read(tmp_path / f"b.{suffix}")


FOURTEEN = ("LSP-14", "CrowdPose-14", "AIC-14")
TOPS: dict[str | None, tuple[int, int]] = {"skull_tip": (320, 70), "HumanoidRoot": (320, 270)}


def of_layout(name: str) -> np.ndarray:
    """Every frame's joints in an order that a file does not name."""
    rows = [person(t, ALIASES[name]) for t in T]
    for t, of in enumerate(rows):
        for joint, place in enumerate(ALIASES[name]):
            if place in TOPS:
                of[joint, :2] = TOPS[place][0] + 3 * t, TOPS[place][1] + t
    return np.stack(rows)


@pytest.mark.parametrize("name", [*FOURTEEN, "MPI-15", "HumanEva-15", "3DHP-17", "Kinect-25"])
def test_layouts_are_told_by_their_middles(tmp_path: Path, name: str) -> None:
    np.save(tmp_path / "a.npy", of_layout(name))
    found = read(tmp_path / "a.npy")
    check(found, names=LIMBS[:-1])
    assert any(line.startswith(f"layout: {name}, by its") for line in found.report)


def test_a_layout_that_cannot_be_told_is_asked_for(tmp_path: Path) -> None:
    rows = of_layout("LSP-14")
    rows[:, 12] = 0  # nobody's neck is seen
    np.save(tmp_path / "a.npy", rows)
    with pytest.raises(KeypointError, match=r"14 joints.*LSP-14, CrowdPose-14, AIC-14: say so"):
        read(tmp_path / "a.npy")
    check(read(tmp_path / "a.npy", layout="LSP-14"), names=LIMBS[:-1])


@pytest.mark.parametrize("form", ["csv", "npy", "json"])
def test_landmarks_in_space_are_no_places_in_the_picture(tmp_path: Path, form: str) -> None:
    """MediaPipe's pose_world_landmarks: metres about the middle of the hips, in the same form."""
    rows = np.stack([person(t, ALIASES["MediaPipe-33"]) for t in T])
    rows[..., :2] = (rows[..., :2] - rows[:, 23:25, :2].mean(1, keepdims=True)) / 200
    fours = np.insert(rows.round(4), 2, 0.1, axis=-1)
    path = tmp_path / f"a.{form}"
    if form == "npy":
        np.save(path, fours)
    elif form == "json":
        write(path, [[dict(zip("xyz", row, strict=False)) for row in t] for t in fours.tolist()])
    else:
        heads = [f"{axis}{n}" for n in range(1, 34) for axis in "xyzv"]
        rows_of_text = [heads, *fours.reshape(FRAMES, -1).tolist()]
        write(path, "\n".join(",".join(map(str, row)) for row in rows_of_text))
    with pytest.raises(KeypointError, match="points in space about the middle of the hips"):
        read(path)


APPLES = {
    "nose": "head_joint", "l_eye": "left_eye_joint", "vt1": "neck_1_joint",
    **{f"{side[0]}_{place}": f"{side}_{word}_joint"
       for side in ("left", "right")
       for place, word in {"shoulder": "shoulder_1", "elbow": "forearm", "wrist": "hand",
                           "hip": "upLeg", "knee": "leg", "ankle": "foot"}.items()},
}  # fmt: skip


@pytest.mark.parametrize("form", ["Vision", "ARKit", "pixels"])
def test_apples_joints(tmp_path: Path, form: str) -> None:
    """The same names: Vision's y counts upwards, ARKit's downwards."""
    frames = []
    for t in T:
        joints = {}
        for name, word in APPLES.items():
            u, v = PLACES[name][0] + 3 * t, PLACES[name][1] + t
            x, y = (u + 0.5) / 640, (v + 0.5) / 480
            x, y = {"Vision": (x, 1 - y), "ARKit": (x, y), "pixels": (u, v)}[form]
            joints[word] = {"x": x, "y": y, "confidence": 0.8}
        frames.append({"frame": t, "joints": joints})
    found = read(write(tmp_path / "a.json", frames))
    check(found)
    assert {"l_eye", "vt1"} <= {*found.names}
    assert any("counts upwards, as in" in line for line in found.report) == (form == "Vision")


def test_what_ultralytics_returns_as_it_is(tmp_path: Path) -> None:
    def frame(t: int) -> dict[str, Any]:
        people = np.stack([other(t), person(t)])
        keypoints = {"xy": people[..., :2].tolist(), "conf": people[..., 2].tolist()}
        keypoints["xyn"] = (people[..., :2] / SIZE).tolist()
        return {"frame": t, "keypoints": keypoints}

    found = read(write(tmp_path / "a.json", [frame(t) for t in T]))
    check(found)
    assert float(found.confidence[0, 0]) == pytest.approx(0.6)


def test_pixels_beside_points_in_space(tmp_path: Path) -> None:
    """Kinect's: where a joint is, and where the colour camera sees it."""
    words = {"SpineBase": "HumanoidRoot", **{
        place.title() + side: f"{side[0].lower()}_{place}"
        for side in ("Left", "Right")
        for place in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    }}  # fmt: skip
    frames = [
        {"bodies": [{"trackingId": 7, "joints": {
            word: {"x": 0.1, "y": 0.2, "z": 2.0, "colorX": PLACES[name][0] + 3 * t,
                   "colorY": PLACES[name][1] + t}
            for word, name in words.items()}}]}
        for t in T
    ]  # fmt: skip
    check(read(write(tmp_path / "a.json", frames)), names=LIMBS[:-1])


@pytest.mark.parametrize("form", ["FreeMoCap", "PYSKL"])
def test_arrays_whose_first_axis_is_one_person_or_camera(tmp_path: Path, form: str) -> None:
    path = tmp_path / "a.npz"
    if form == "PYSKL":
        rows = np.stack([person(t) for t in T])[None]
        np.savez(path, keypoint=rows[..., :2], keypoint_score=rows[..., 2])
    else:
        rows = np.full((1, FRAMES, 553, 3), np.nan)
        rows[0, :, :33] = [person(t, ALIASES["MediaPipe-33"]) for t in T]
        np.save(path := tmp_path / "a.npy", rows[0])
    found = read(path)
    check(found)
    assert any("one in each" in line for line in found.report) == (form == "PYSKL")
    if form == "FreeMoCap":
        np.save(path, np.concatenate([rows, rows]))
        with pytest.raises(KeypointError, match=r"such as array\[0\]"):
            read(path)


@pytest.mark.parametrize("form", ["a name a column", "body part and kind"])
def test_tables_that_pandas_keeps_in_hdf5(tmp_path: Path, form: str) -> None:
    """With other columns than DeepLabCut's: a block for every kind of number."""
    h5py = pytest.importorskip("h5py")
    parts = [(name, kind) for name in TFJS for kind in ("x", "y", "likelihood")]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("df")
        group["axis1"] = np.arange(FRAMES)
        values = np.array([flat(t) for t in T])
        if form == "a name a column":
            heads = [b"frame", *(f"{name}_{kind}".encode() for name, kind in parts)]
            group["axis0"] = np.array(heads)
            group["block0_items"], group["block0_values"] = np.array(heads[1:]), values
            group["block1_items"] = np.array(heads[:1])
            group["block1_values"] = np.arange(FRAMES)[:, None]
        else:
            for number, own in enumerate(zip(*parts, strict=True)):
                level = sorted({*own})
                group[f"axis0_level{number}"] = np.array([each.encode() for each in level])
                group[f"axis0_label{number}"] = np.array([level.index(each) for each in own])
            group["block0_values"] = values
    check(read(tmp_path / "a.h5"))


@pytest.mark.parametrize("word", ["body_list", "objects"])
def test_bodies_of_zed(tmp_path: Path, word: str) -> None:
    """Pixels beside points in space, confidences in percent, times in nanoseconds."""
    frames = []
    for t in T:
        joints = person(t, OPENPOSE)
        body = {"id": 3, "keypoint": [[0.1, 0.2, 2.0]] * 18, "keypoint_2d": joints[:, :2].tolist(),
                "keypoint_confidence": (100 * joints[:, 2]).tolist()}  # fmt: skip
        frames.append({"ts": 1_700_000_000_000_000_000 + t * 40_000_000, word: [body]})
    found = read(write(tmp_path / "a.json", frames), frame_rate=25.0)
    check(found)
    assert float(found.confidence[0, 0]) == pytest.approx(0.6)


@pytest.mark.parametrize("layout", ["LSP-14", "COCO-18", "BODY_25"])
def test_yolo_labels_of_other_joints(tmp_path: Path, layout: str) -> None:
    for t, rows in enumerate(of_layout(layout)):
        fractions = rows / (*SIZE, 1)
        text = " ".join(map(str, [0, 0.5, 0.5, 0.2, 0.5, *fractions.ravel()]))
        write(tmp_path / "labels" / f"clip_{t + 1}.txt", text)
    check(read(tmp_path / "labels"), names=LIMBS[:-1])


def test_boxes_of_objects_beside_keypoints(tmp_path: Path) -> None:
    frames = [{"frame": t, "objects": [{"bbox": [0, 0, 9, 9]}], "keypoints": person(t).tolist()}
              for t in T]  # fmt: skip
    check(read(write(tmp_path / "a.json", frames)))


@pytest.mark.parametrize("kind", ["MMPose", "Ultralytics", "arrays", "a table"])
def test_the_size_by_other_words(tmp_path: Path, kind: str) -> None:
    """Height and width, and columns; joints of a smaller picture lie inside any larger one."""
    half = np.stack([person(t) for t in T]) * (0.5, 0.5, 1)
    path = tmp_path / {"arrays": "a.npz", "a table": "a.csv"}.get(kind, "a.json")
    if kind == "arrays":
        np.savez(path, keypoints=half, joint_names=np.array(COCO), orig_shape=[240, 320, 3])
    elif kind == "a table":
        rows = [
            ["320", "240", str(t), n, *map(str, joint)]
            for t in T
            for n, joint in zip(TFJS, half[t], strict=True)
        ]
        heading = ["image_width", "image_height", "frame", "joint", "x", "y", "score"]
        path.write_text("\n".join(",".join(row) for row in [heading, *rows]))
    elif kind == "MMPose":
        write(path, [
            {"frame_id": t, "img_shape": [240, 320], "instances": [
                {"keypoints": half[t, :, :2].tolist(), "keypoint_scores": half[t, :, 2].tolist()}
            ]} for t in T
        ])  # fmt: skip
    else:
        write(
            path, {"orig_shape": [240, 320], "frames": [{"keypoints": half[t].tolist()} for t in T]}
        )
    found = read(path)
    check(found)
    assert any("scaled from images of 320 x 240" in line for line in found.report)
    rows = [f"60,90,{t},{n},{x},{y},{c}" for t in T
            for n, (x, y, c) in zip(TFJS, person(t), strict=True)]  # fmt: skip
    path = tmp_path / "b.csv"  # a person's width and height
    path.write_text("\n".join(["width,height,frame,joint,x,y,score", *rows]))
    check(read(path))


@pytest.mark.parametrize("form", ["OpenPose", "COCO"])
def test_frames_from_the_midst_of_a_video(tmp_path: Path, form: str) -> None:
    """OpenPose with --frame_first, and pictures of which some are annotated: no earlier frames."""
    part, path = range(2, 5), tmp_path / "keypoints"
    for t in part if form == "OpenPose" else ():
        people = [{"pose_keypoints_2d": flat(t, OPENPOSE)}]
        write(path / f"clip_{t:012d}_keypoints.json", {"people": people})
    if form == "COCO":
        content = {
            "categories": [{"id": 1, "keypoints": list(TFJS)}],
            "images": [{"id": 9 - t, "file_name": f"frame_{t:06d}.PNG"} for t in part],
            "annotations": [
                {"image_id": 9 - t, "category_id": 1, "keypoints": flat(t)} for t in part
            ],
        }
        write(path, content)
    with pytest.raises(KeypointError, match="with somebody is 2: start there"):
        read(path)
    check(read(path, first_frame=2), (0, 1, 5))


def test_everybody_under_one_number(tmp_path: Path) -> None:
    """AlphaPose without a tracker: the person is the nearest."""
    entries = [
        {"image_id": f"{t}.jpg", "keypoints": p.ravel().tolist(), "score": 2, "idx": 0}
        for t in T
        for p in ((person(t), other(t)) if t % 2 == 0 else (other(t), person(t)))
    ]
    check(read(write(tmp_path / "a.json", entries)))


def test_dwpose_as_it_returns_them(tmp_path: Path) -> None:
    """Places of all people in one list, fractions of the picture; below 0 is who is not there."""
    frames = [
        {"bodies": {"candidate": (person(t, OPENPOSE)[:, :2] / (639, 479)).tolist(),
                    "subset": [[float(n if n != 16 else -1) for n in range(18)]]},
         "hands": [[[0.1, 0.2]] * 21] * 2, "faces": [[[0.1, 0.2]] * 68]}
        if t != 3 else {"bodies": {"candidate": [], "subset": []}}
        for t in T
    ]  # fmt: skip
    path = write(tmp_path / "a.json", frames)
    found = read(path, normalised="zero-one")
    check(found, (3,))
    assert not found.confidence[:, found.names.index("r_ear")].any()
    frames[0]["bodies"]["subset"] = [[0.0] * 20]
    with pytest.raises(KeypointError, match=r"\[18, 2\] for \[1, 20\]"):
        read(write(path, frames), normalised="zero-one")


def test_frames_of_skeletons(tmp_path: Path) -> None:
    """Kinetics as ST-GCN has it: pairs in a row, confidences beside."""
    frames = [
        {"frame_index": t + 1, "skeleton": [
            {"pose": p[:, :2].ravel().tolist(), "score": p[:, 2].tolist()}
            for p in (other(t), person(t))]}
        for t in T
    ]  # fmt: skip
    check(read(write(tmp_path / "a.json", {"data": frames, "label": "walk", "label_index": 3})))


def test_pictures_with_gaps_ask_for_their_folder(tmp_path: Path) -> None:
    entries = [{"image_id": f"img_{5 * t:04d}.png", "keypoints": flat(t)} for t in T]
    path = write(tmp_path / "a.json", entries)
    with pytest.raises(KeypointError, match=r"found 26; .* or give the folder of the pictures"):
        read(path)
    check(read(path, frame_names=[f"img_{5 * t:04d}.jpg" for t in T]))


def test_yolo_labels_of_all_frames_in_one_file(tmp_path: Path) -> None:
    """What its tracker leaves when it gets frame after frame: no picture of so many people."""
    rows = [
        ["0 .5 .5 .2 .8", *map(str, (p / (*SIZE, 1)).flat), track]
        for t in T
        for p, track in ((other(t), "2"), (person(t), "1"))
    ]
    write(tmp_path / "image0.txt", "\n".join(map(" ".join, rows)))
    with pytest.raises(KeypointError, match="12 people under 2 numbers: of several frames"):
        read(tmp_path)


def test_a_table_of_very_many_columns(tmp_path: Path) -> None:
    heading = [f"j{n}_{axis}" for n in range(5001) for axis in "xy"]
    path = write(tmp_path / "a.csv", f"{','.join(heading)}\n{'1,' * 10001}1\n")
    with pytest.raises(KeypointError, match="10002 columns, expected at most 10000: a row for"):
        read(path)


@pytest.mark.parametrize("axes", [(2, 0, 1), (2, 1, 0), (1, 2, 0)])
def test_axes_in_other_orders(tmp_path: Path, axes: tuple[int, int, int]) -> None:
    array = np.stack([person(t) for t in range(12)])
    for each in (array.transpose(axes), array.transpose(axes)[None, ..., None]):
        np.save(tmp_path / "a.npy", each)
        found = read(tmp_path / "a.npy", num_frames=12)
        np.testing.assert_array_equal(found.positions, array[..., :2])
        np.testing.assert_array_equal(found.confidence, array[..., 2])
    np.save(tmp_path / "a.npy", np.zeros((3, 17, 5)))  # five numbers of a joint
    with pytest.raises(KeypointError, match="expected numbers"):
        read(tmp_path / "a.npy", num_frames=None)


def test_numbers_of_pictures_with_a_decimal_point(tmp_path: Path) -> None:
    """As pandas writes a column in which some are missing; and two pictures of one name."""
    marks = [{"image_id": float(t), "keypoints": flat(t), "category_id": 1.0} for t in SEEN]
    check(read(write(tmp_path / "a.json", marks)), (3,))
    images = [{"id": float(t), "file_name": f"{t}.png", "width": 640, "height": 480} for t in T]
    path = write(tmp_path / "b.json", {"images": images, "annotations": marks})
    check(read(path), (3,))
    images[1]["file_name"] = "0.png"
    with pytest.raises(KeypointError, match="an id and file_name of their own each"):
        read(write(path, {"images": images, "annotations": marks}))


def test_openposes_first_file_is_lost(tmp_path: Path) -> None:
    """Its own names count from 0; others may be those of pictures that count from 1."""
    for t in T[1:]:
        people = {"people": [{"pose_keypoints_2d": flat(t)}]}
        write(tmp_path / "a" / f"clip_{t:012d}_keypoints.json", people)
        write(tmp_path / "b" / f"img_{t + 1:04d}.json", people)
        write(tmp_path / "c" / f"clip_{t:012d}_keypoints.json", people)
        write(tmp_path / "c" / f"clip_{6:012d}_keypoints.json", people)
    for name in "ab":
        check(read(tmp_path / name, first_frame=1), (0,))
    assert "frame 1 is the first frame" in read(tmp_path / "c").report


def test_the_path_of_a_picture(tmp_path: Path) -> None:
    frames = [{"img_path": f"/a/img_{100 + t}.jpg", "people": [{"keypoints": flat(t)}]}
              for t in SEEN]  # fmt: skip
    path = write(tmp_path / "a.json", frames)
    check(read(path, frame_names=[f"img_{100 + t}.jpg" for t in T]), (3,))


@pytest.mark.parametrize("lost", [(3,), (3, 15), (2, 3, 4, 13)])
def test_joints_above_a_threshold_by_their_numbers(tmp_path: Path, lost: tuple[int, ...]) -> None:
    """Transformers' ViTPose says in `labels` which joints are left: 16 of them are not MPII's."""
    frames = []
    for t in T:
        left = [n for n in range(len(COCO)) if n not in lost and (n != 1 or t % 2)]
        x_y_c = person(t)[left]
        frames.append([{"keypoints": x_y_c[:, :2].tolist(), "scores": x_y_c[:, 2].tolist(),
                        "labels": left, "bbox": [0, 0, 9, 9]}])  # fmt: skip
    found = read(write(tmp_path / "a.json", frames))
    names = [name for n, name in enumerate(COCO) if n not in lost]
    check(found, names=tuple(name for name in names if name in LIMBS))
    for n in lost:
        assert not found.confidence[:, found.names.index(str(COCO[n]))].any()


def test_joints_of_networks_of_bodies(tmp_path: Path) -> None:
    """SAM 3D Body's and PHALP's places in the picture, beside those in space."""
    names = ALIASES["MHR-70"]
    frames = [[{"pred_keypoints_3d": [[0.1, 0.2, 0.3]] * 70, "bbox": [0, 0, 9, 9],
                "pred_keypoints_2d": person(t, names)[:, :2].tolist()}] for t in T]  # fmt: skip
    check(read(write(tmp_path / "a.json", frames)))
    np.savez(tmp_path / "a.npz", kp2d=np.stack([person(t) for t in T]), box=np.ones((FRAMES, 4)))
    check(read(tmp_path / "a.npz"))


@pytest.mark.parametrize("others", ["left_hand_", "face_landmark_", "right_hand"])
def test_a_body_by_number_beside_hands(tmp_path: Path, others: str) -> None:
    """Holistic tables of MediaPipe name hands and face; the numbers are the body's joints."""
    names = [*(f"pose_{n}" for n in range(33)), *(f"{others}{n}" for n in range(21))]
    heads = ["frame", *(f"{name}{part}" for name in names for part in ("_x", "_y", "_visibility"))]
    hand = np.tile([5.0, 6.0, 0.9], (21, 1))
    rows = [[t, *np.vstack([person(t, ALIASES["MediaPipe-33"]), hand]).flat] for t in T]
    found = read(write(tmp_path / "a.csv", wide(heads, rows)))
    check(found)
    assert any(f"left out: '{others}0_x" in line for line in found.report)


def test_names_of_pythons_enumeration(tmp_path: Path) -> None:
    frames = [{"frame": t, "landmarks": {f"PoseLandmark.{name.upper()}": {
        "x": (u + 0.5) / SIZE[0], "y": (v + 0.5) / SIZE[1], "z": -0.1, "visibility": c}
        for name, (u, v, c) in zip(MEDIAPIPE_NAMES, person(t, ALIASES["MediaPipe-33"]),
                                   strict=True)}} for t in T]  # fmt: skip
    check(read(write(tmp_path / "a.json", frames)))


@pytest.mark.parametrize("form", ["in order", "numbered", "with names for frames"])
def test_frames_that_stand_in_people(tmp_path: Path, form: str) -> None:
    """Somebody's key is no frame: two people were frames 0 and 1, and their frames people."""
    people: dict[str, Any] = {"person_1": [other(t).tolist() for t in T],
                              "person_2": [person(t).tolist() for t in T]}  # fmt: skip
    if form == "numbered":
        people = {who: {str(t): own[t] for t in SEEN} for who, own in people.items()}
    elif form == "with names for frames":
        people = {
            who: {"frames": [{"frame": t, "keypoints": own[t]} for t in SEEN]}
            for who, own in people.items()
        }
    found = read(write(tmp_path / "a.json", people))
    check(found, () if form == "in order" else (3,))
    assert any("'person_2' of the file, by the file's tracks" in line for line in found.report)
    write(tmp_path / "a.json", {"person_1": [flat(t) for t in T], "person_2": [flat(0)]})
    with pytest.raises(KeypointError, match="person_1, person_2: expected as many frames"):
        read(tmp_path / "a.json")


def test_posetrack_without_its_names(tmp_path: Path) -> None:
    """Nose, neck, top of the head, and ears that are never marked, as many joints as COCO has."""
    rows = np.stack([person(t) for t in T])
    rows[:, 1:3, :2] = rows[:, :1, :2] + [(0, 35), (0, -30)]
    rows[:, 3:5] = 0
    content = {
        "images": [{"id": 1000 + t, "file_name": f"images/val/000342/{t:06d}.jpg"} for t in T],
        "annotations": [
            {"image_id": 1000 + t, "track_id": 0, "keypoints": rows[t].ravel().tolist()} for t in T
        ],
    }
    found = read(write(tmp_path / "a.json", content))
    check(found)
    assert "l_eye" not in found.names
    np.testing.assert_allclose(found.positions[2, found.names.index("skull_tip")], (326, 72))
    rows[:, 1:3, :2] = rows[:, :1, :2] + [(6, -6), (-6, -6)]  # eyes of one whose ears are hidden
    np.save(tmp_path / "a.npy", rows)
    assert "l_eye" in read(tmp_path / "a.npy").names


def test_a_joint_with_what_is_visible_and_a_confidence(tmp_path: Path) -> None:
    rows = [[t, *np.insert(person(t), 2, 1.0, axis=1).flat] for t in T]
    found = read(
        write(tmp_path / "a.csv", wide(["frame", *ends("_x", "_y", "_vis", "_conf")], rows))
    )
    check(found)
    assert float(found.confidence[0, 0]) == pytest.approx(0.6)


def test_long_tables_whose_places_are_called_after_the_joint(tmp_path: Path) -> None:
    heads = ["frame", "x", "y", "keypoint_name", "keypoint_x", "keypoint_y", "score"]
    rows = [[t, 1, 2, name, *joint] for t in T for name, joint in zip(TFJS, person(t), strict=True)]
    check(read(write(tmp_path / "a.csv", wide(heads, rows))))


def test_long_tables_of_body_hands_and_face(tmp_path: Path) -> None:
    heads = ["frame", "row_id", "type", "landmark_index", "x", "y", "z"]
    fractions = [(person(t, ALIASES["MediaPipe-33"])[:, :2] + 0.5) / SIZE for t in T]
    rows = [
        [t, f"{t}-{part}-{n}", part, n, *((0.5, 0.5) if part != "pose" else fractions[t][n]), 0]
        for t in T
        for part, count in (("face", 468), ("left_hand", 21), ("pose", 33))
        for n in range(count)
    ]
    found = read(write(tmp_path / "a.csv", wide(heads, rows)))
    check(found)
    assert "rows left out: face, lefthand" in found.report


def test_landmarks_in_a_result(tmp_path: Path) -> None:
    joints = np.stack([person(t, ALIASES["MediaPipe-33"]) for t in T]) + np.array([0.5, 0.5, 0])
    marks = [[dict(zip(("x", "y", "visibility"), each, strict=True)) for each in joint / (*SIZE, 1)]
             for joint in joints]  # fmt: skip
    frames = [{"frame": t, "result": {"pose_landmarks": [marks[t]]}} for t in T]
    check(read(write(tmp_path / "a.json", frames)))


@pytest.mark.parametrize("first", [0, 1])
def test_people_by_number_above_their_frames(tmp_path: Path, first: int) -> None:
    """AlphaPose's tracks as ShanghaiTech's clips have them; frames above people stay so."""
    tracks = {"0": (person, T), "1": (other, [1, 2])}
    people = {
        who: {str(t + first): {"keypoints": of(t).ravel().tolist(), "scores": None} for t in frames}
        for who, (of, frames) in tracks.items()
    }
    check(read(write(tmp_path / "a.json", people)))
    frames = {str(t): {"0": person(t).tolist(), "1": other(t).tolist()} for t in T}
    check(read(write(tmp_path / "a.json", frames)))
    check(
        read(write(tmp_path / "a.json", {str(t): dict(enumerate(frames[str(t)]["0"])) for t in T}))
    )


@pytest.mark.parametrize("form", ["rows", "columns", "some missing"])
def test_frames_of_every_joint(tmp_path: Path, form: str) -> None:
    rows = np.stack([person(t) for t in T], axis=1).tolist()
    content: dict[str, Any] = dict(zip(TFJS, rows, strict=True))
    if form == "columns":
        content = {
            name: dict(zip(("x", "y", "score"), np.transpose(own).tolist(), strict=True))
            for name, own in content.items()
        }
    elif form == "some missing":
        content = {name: [each if t != 3 else None for t, each in enumerate(own)]
                   for name, own in content.items()}  # fmt: skip
    check(read(write(tmp_path / "a.json", content)), (3,) if form == "some missing" else ())
    one = {name: own[0] for name, own in zip(TFJS, rows, strict=True)}
    found = read(write(tmp_path / "b.json", one), num_frames=1)
    np.testing.assert_array_equal(found.positions[0], person(0)[:, :2])


def test_names_of_ml_kit(tmp_path: Path) -> None:
    names = [re.sub("_(.)", lambda each: each[1].upper(), re.sub("(mouth)_(.*)", r"\2_\1", name))
             for name in MEDIAPIPE_NAMES]  # fmt: skip
    frames = [{"frame": t, "landmarks": {
        f"PoseLandmarkType.{name}": {"x": x, "y": y, "z": -3.0, "likelihood": c}
        for name, (x, y, c) in zip(names, person(t, ALIASES["MediaPipe-33"]), strict=True)
    }} for t in T]  # fmt: skip
    found = read(write(tmp_path / "a.json", frames))
    check(found)
    assert "layout: MediaPipe-33, as the file says" in found.report


def test_points_of_openpose_in_a_long_table(tmp_path: Path) -> None:
    """dfMaker's: `points` is the joint, of whatever part `type_points` says; pandas' index too."""
    heads = ["x", "y", "c", "nx", "ny", "type_points", "people_id", "points", "id", "frame"]
    rows = [[*joint, 0, 0, f"{part}_keypoints", 1, n, "clip", t]
            for t in T for part in ("pose", "face")
            for n, joint in enumerate(person(t, OPENPOSE))]  # fmt: skip
    check(read(write(tmp_path / "a.csv", wide(heads, rows))))
    above = [["joint", *np.repeat(TFJS, 3)], ["coord", *("x", "y", "conf") * 17], ["frame"]]
    text = "\n".join(",".join(map(str, row)) for row in [*above, *([t, *flat(t)] for t in T)])
    check(read(write(tmp_path / "b.csv", text)))


def test_depths_are_no_confidences(tmp_path: Path) -> None:
    rows = np.stack([person(t) for t in T])
    rows[..., 2] = np.linspace(-40.0, 30.0, len(COCO))
    rows[3] = 0
    np.save(tmp_path / "a.npy", rows)
    found = read(tmp_path / "a.npy")
    check(found, (3,))
    assert "no confidence in the file, but z: 1 for every joint" in found.report


def test_a_box_beside_numbered_joints(tmp_path: Path) -> None:
    heads = [f"kpt_{n}_{kind}" for n in range(len(COCO)) for kind in ("x", "y", "conf")]
    rows = [[t, 1, 10, 20, 30, 40, 0.9, *flat(t)] for t in T]
    text = wide(["frame", "id", "x1", "y1", "x2", "y2", "conf", *heads], rows)
    check(read(write(tmp_path / "a.csv", text)))


@pytest.mark.parametrize("word", ["coordinate", "position"])
def test_places_of_joints_by_another_word(tmp_path: Path, word: str) -> None:
    """The samples of TensorFlow Lite for Android and iOS."""
    frames = [{"frame": t, "persons": [{"id": 3, "keyPoints": [
        {"bodyPart": name.upper(), word: {"x": x, "y": y} if word == "coordinate" else [x, y],
         "score": c} for name, (x, y, c) in zip(TFJS, person(t), strict=True)
    ]}]} for t in T]  # fmt: skip
    found = read(write(tmp_path / "a.json", frames))
    check(found)
    assert float(found.confidence[0, 0]) == pytest.approx(0.6)


def test_frames_by_number_of_pictures_that_have_names(tmp_path: Path) -> None:
    images = [{"id": t, "frame_id": 7 + t, "file_name": f"{'acbfed'[t]}.jpg"} for t in T]
    marks = [{"image_id": t, "keypoints": flat(t)} for t in T]
    check(read(write(tmp_path / "a.json", {"images": images, "annotations": marks})))

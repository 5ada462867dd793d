"""A file of each kind in `shared/data/cases`, made here with other numbers and other names.

Each is called by the case's id, is read by the public way, and holds what was put into it.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
from PIL import Image

import torchcss
from torchcss.app.view_files import open_view
from torchcss.errors import KeypointError
from torchcss.io.cameras import load_camera
from torchcss.io.keypoints.one_image import read_joints
from torchcss.io.view_files import ViewFiles

SIZE = (800, 600)
T = range(7)
STEP = np.array([4.0, -2.0])
PLACES = {
    "nose": (410.5, 151), "l_eye": (416, 144.5), "r_eye": (404, 144.5), "l_ear": (424, 149),
    "r_ear": (396, 149), "l_shoulder": (450, 210), "r_shoulder": (372, 208),
    "l_elbow": (474, 280), "r_elbow": (341, 276), "l_wrist": (489, 344.5), "r_wrist": (322, 351),
    "l_hip": (434, 362), "r_hip": (388, 361), "l_knee": (440, 449), "r_knee": (379, 452),
    "l_ankle": (445, 533), "r_ankle": (374, 541), "neck": (411, 209), "hips": (411, 361.5),
    "head": (411, 130), "chin": (410, 174), "forehead": (410, 136), "l_toe": (460, 556),
    "l_small_toe": (466, 553), "l_heel": (441, 547), "r_toe": (362, 563), "r_small_toe": (355, 560),
    "r_heel": (377, 554),
}  # fmt: skip
"""Where somebody's joints are in frame 0; STEP further in every frame."""

LIMBS = tuple(f"{side}_{place}" for side in "lr"
              for place in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"))  # fmt: skip
COCO = (
    "nose", "l_eye", "r_eye", "l_ear", "r_ear", "l_shoulder", "r_shoulder", "l_elbow", "r_elbow",
    "l_wrist", "r_wrist", "l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle",
)  # fmt: skip
BODY_8 = (
    "nose", "neck", "r_shoulder", "r_elbow", "r_wrist", "l_shoulder", "l_elbow", "l_wrist",
)  # fmt: skip
FACE = ("r_eye", "l_eye", "r_ear", "l_ear")
LEGS = ("r_hip", "r_knee", "r_ankle", "l_hip", "l_knee", "l_ankle")
FEET = ("l_toe", "l_small_toe", "l_heel", "r_toe", "r_small_toe", "r_heel")
OPENPOSE_18 = (*BODY_8, *LEGS, *FACE)
OPENPOSE_25 = (*BODY_8, "hips", *LEGS, *FACE, *FEET)
HALPE_26 = (
    *COCO, "head", "neck", "hips", "l_toe", "r_toe", "l_small_toe", "r_small_toe", "l_heel",
    "r_heel",
)  # fmt: skip


def walk(t: int, names: tuple[str, ...] = COCO, right: float = 0.0) -> np.ndarray:
    """u, v, confidence of every joint in frame t."""
    places = np.array([PLACES.get(name, (411, 300)) for name in names]) + t * STEP + (right, 0)
    return np.column_stack([places, 0.55 + 0.02 * (np.arange(len(names)) % 20)])


def flat(t: int, names: tuple[str, ...] = COCO) -> list[float]:
    return walk(t, names).ravel().tolist()


def long(names: Iterable[str]) -> list[str]:
    """left_wrist, of l_wrist."""
    words = {"l_": "left_", "r_": "right_"}
    return [words[name[:2]] + name[2:] if name[:2] in words else name for name in names]


def write(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def table(*rows: Iterable[Any]) -> str:
    return "\n".join(",".join(map(str, row)) for row in rows) + "\n"


def read(path: Path | str) -> torchcss.Keypoints:
    return torchcss.read_keypoints(path, image_size_wh=SIZE, num_frames=len(T))


def expect(
    found: torchcss.Keypoints | None,
    names: Iterable[str] = (*LIMBS, "nose"),
    empty: Iterable[int] = (),
    within: float = 1e-3,
    scale: float = 1.0,
) -> None:
    """Somebody who walks as `walk` does, who is missing in frames `empty`."""
    assert found is not None
    assert len(found.positions) == len(T)
    for t in T:
        if t in empty:
            assert not found.confidence[t].any()
            continue
        for name in names:
            joint = found.names.index(name)
            assert found.confidence[t, joint] > 0
            place = scale * (np.array(PLACES[name]) + t * STEP)
            np.testing.assert_allclose(found.positions[t, joint], place, atol=within)


def confidence(found: torchcss.Keypoints, name: str) -> list[float]:
    return found.confidence[:, found.names.index(name)].tolist()


def view(folder: Path, keypoints: str, pictures: Iterable[str], **more: Any) -> Any:
    """Open a folder of pictures with keypoints and a camera."""
    (folder / "p").mkdir()
    for name in pictures:
        Image.new("RGB", SIZE, "grey").save(folder / "p" / name)
    given = ViewFiles(video=folder / "p", keypoints=folder / keypoints, **more)
    return open_view(given, camera(folder))


def camera(folder: Path, size: tuple[int, int] = SIZE) -> Path:
    K = [[700, 0, 399.5], [0, 700, 299.5], [0, 0, 1]]
    entry = {"image_size_wh": size, "K": K}
    return write(folder / "c.json", {"units": "metre, pixel", "cameras": {"hall": entry}})


# Keypoints.


def alphapose_folder(folder: Path) -> None:
    numbers = [340, 341, 342, 345, 346, 347, 349]
    marks = [{"image_id": f"walk_{numbers[t]}.jpg", "category_id": 1, "keypoints": flat(t),
              "score": 2.5, "idx": 1} for t in T if t != 4]  # fmt: skip
    write(folder / "r.json", marks)
    names = [f"walk_{number}.jpg" for number in numbers]
    expect(view(folder, "r.json", names).keypoints, empty=[4])


def alphapose_ids(folder: Path) -> None:
    marks = []
    for t in T:
        for idx, right in ((12, 210 - 70 * t), (5, -210 + 70 * t)):
            row = walk(0, right=right) * (1, 1, 1.0 if idx == 5 else 0.7)
            marks.append({"image_id": f"{t}.jpg", "category_id": 1, "idx": idx, "score": 2.0,
                          "keypoints": row.ravel().tolist()})  # fmt: skip
    found = read(write(folder / "r.json", marks))
    u = found.positions[:, found.names.index("nose"), 0]
    assert u.tolist() == [410.5 - 210 + 70 * t for t in T]


def alphapose_open(folder: Path) -> None:
    people = {f"{t}.png": {"version": 0.1, "people": [{"pose_keypoints_2d": flat(t, OPENPOSE_18)}]}
              for t in T}  # fmt: skip
    expect(read(write(folder / "r.json", people)))


def coco(
    order: tuple[str, ...], frames: dict[int, str], size: tuple[int, int] = SIZE, empty: int = -1
) -> dict[str, Any]:
    """COCO's annotations of frames, by the pictures' names."""
    scale = (size[0] / SIZE[0], size[1] / SIZE[1], 0)
    marks = {t: (walk(t, order) * scale + (0, 0, 2)).ravel().tolist() for t in frames}
    return {
        "images": [{"id": 50 - t, "file_name": name, "width": size[0], "height": size[1]}
                   for t, name in frames.items()],
        "annotations": [{"id": t, "image_id": 50 - t, "category_id": 3,
                         "keypoints": [] if t == empty else marks[t],
                         "num_keypoints": 0 if t == empty else len(order)} for t in frames],
        "categories": [{"id": 3, "name": "walker", "keypoints": long(order)}],
    }  # fmt: skip


def coco_other_size(folder: Path) -> None:
    names = {t: f"shot{t}.png" for t in T}
    expect(read(write(folder / "a.json", coco(LIMBS, names, (2400, 1800)))), LIMBS)


def coco_some_pictures(folder: Path) -> None:
    names = {t: f"shot{t}.png" for t in T}
    write(folder / "a.json", coco(COCO, {t: names[t] for t in (0, 1, 4, 6)}))
    expect(view(folder, "a.json", names.values()).keypoints, empty=[2, 3, 5])


def csv_confidence_c(folder: Path) -> None:
    heads = [f"{name[0].upper()}{name[2:].title()}_{axis}" for name in LIMBS for axis in "xyc"]
    rows = [walk(t, LIMBS) for t in T]
    for t in (1, 4):
        rows[t][LIMBS.index("r_knee")] = 0
    text = table(["frame", *heads], *([t, *row.flat] for t, row in enumerate(rows)))
    found = read(write(folder / "a.csv", text))
    expect(found, [name for name in LIMBS if name != "r_knee"])
    assert confidence(found, "l_elbow") == [pytest.approx(0.57)] * len(T)
    assert [c > 0 for c in confidence(found, "r_knee")] == [t not in (1, 4) for t in T]


def cvat_empty_keypoints(folder: Path) -> None:
    names = {t: f"frame_{t:06d}.PNG" for t in T}
    expect(read(write(folder / "a.json", coco(LIMBS, names, empty=5))), LIMBS, empty=[5])


def deeplabcut(kinds: Mapping[str, int | None], parts: dict[str, str]) -> str:
    """Its three headings and rows: numbers of a joint by kind, of walk's columns or 77."""
    rows = [walk(t, tuple(parts.values())) for t in T]
    count = len(parts) * len(kinds)
    return table(
        ["scorer", *["walker"] * count],
        ["bodyparts", *(part for part in parts for _ in kinds)],
        ["coords", *list(kinds) * len(parts)],
        *([t, *(77 if column is None else joint[column] for joint in rows[t]
                for column in kinds.values())] for t in T),
    )  # fmt: skip


def dlc_human_names(folder: Path) -> None:
    limbs = ("ankle", "knee", "hip", "wrist", "elbow", "shoulder")
    parts = {f"{limb}{n}": f"{side}_{limb}" for limb in limbs for n, side in ((1, "r"), (2, "l"))}
    kinds = {"x": 0, "y": 1, "likelihood": 2}
    text = deeplabcut(kinds, {**parts, "chin": "chin", "forehead": "forehead"})
    expect(read(write(folder / "clipDLC_resnet.csv", text)), LIMBS)


def dwpose_null(folder: Path) -> None:
    for t in T:
        body = None if t == 2 else flat(t, OPENPOSE_18)
        people = [{"pose_keypoints_2d": body, "face_keypoints_2d": None}]
        write(folder / f"pose_{t:03d}.json",
              {"people": people, "canvas_width": SIZE[0], "canvas_height": SIZE[1]})  # fmt: skip
    expect(read(folder), empty=[2])


def easymocap_annots(folder: Path) -> None:
    for t in T:
        person = {"personID": 4, "bbox": [280, 90, 520, 590, 0.9],
                  "keypoints": walk(t, OPENPOSE_25).tolist()}  # fmt: skip
        write(folder / "annots" / "cam2" / f"{t:06d}.json",
              {"filename": f"images/cam2/{t:06d}.jpg", "height": SIZE[1], "width": SIZE[0],
               "annots": [person]})  # fmt: skip
    expect(read(folder / "annots"), (*LIMBS, "nose", "r_toe", "l_heel"))


def eks_more_coords(folder: Path) -> None:
    more = ("x_ens_median", "y_ens_median", "x_ens_var", "y_ens_var", "x_posterior_var")
    kinds = {"x": 0, "y": 1, "likelihood": 2, **dict.fromkeys(more)}
    found = read(
        write(folder / "e.csv", deeplabcut(kinds, dict(zip(long(COCO), COCO, strict=True))))
    )
    expect(found)
    assert any("x_ens_median" in line for line in found.report)


def half_outside(folder: Path) -> None:
    marks = [walk(t) * (2, 2, 1) for t in T]
    outside = int(((marks[0][:, 0] >= SIZE[0]) | (marks[0][:, 1] >= SIZE[1])).sum())
    assert outside == 14
    content = [{"image_id": t, "category_id": 1, "score": 0.9, "keypoints": row.ravel().tolist()}
               for t, row in enumerate(marks)]  # fmt: skip
    report = read(write(folder / "r.json", content)).report
    assert any("14 of 17 confident joints of frame 0 lie outside" in line for line in report)


def hdf5_message(folder: Path) -> None:
    for name in ("walk.predictions.slp", "walk.analysis.h5"):
        (folder / name).write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(24))
        with pytest.raises(KeypointError, match=r"SLEAP.*CSV"):
            read(folder / name)


def humaneva(folder: Path) -> None:
    arms = ("shoulder", "elbow", "wrist")
    legs = ("hip", "knee", "ankle")
    order = ("hips", "neck", *(f"{side}_{place}" for limb in (arms, legs) for side in "lr"
                               for place in limb), "head")  # fmt: skip
    marks = np.stack([walk(t, order)[:, :2] for t in T]).astype(np.float32)
    archive = {
        "Train/Ann": {"Jog 1 chunk0": [marks + 9]},
        "Validate/Ann": {"Jog 1 chunk0": [marks + 5, marks]},
    }
    metadata = {"layout_name": "humaneva15", "num_joints": 15, "keypoints_symmetry": [[2], [5]]}
    path = folder / "data_2d_humaneva15_gt.npz"
    np.savez(path, positions_2d=np.array(archive, object), metadata=np.array(metadata, object))
    expect(read(f"{path}#Validate/Ann/Jog 1 chunk0/1"), LIMBS)


def labelme(folder: Path) -> None:
    shapes = [{"label": label, "points": [[u, v]], "shape_type": "point", "group_id": None}
              for label, (u, v, _) in zip(long(LIMBS), walk(0, LIMBS), strict=True)]  # fmt: skip
    path = write(folder / "still.json", {
        "version": "5.0", "shapes": shapes, "imagePath": "still.jpg", "imageData": None,
        "imageWidth": SIZE[0], "imageHeight": SIZE[1],
    })  # fmt: skip
    found = read_joints(path, image_size_wh=SIZE)
    assert found.names == LIMBS
    np.testing.assert_allclose(found.positions, walk(0, LIMBS)[:, :2], atol=1e-3)
    assert (found.confidence == 1).all()


def mediapipe_timestamps(folder: Path) -> None:
    still = np.random.default_rng(3).uniform(0.2, 0.8, (33, 2))
    entries = [
        {"timestamp_ms": 40 * t, "pose_landmarks": [
            {"x": u + 0.02 * t, "y": v, "z": 0.0, "visibility": 0.8} for u, v in still
        ]} for t in T if t not in (1, 4)
    ]  # fmt: skip
    found = read(write(folder / "pose.json", entries))
    assert found.confidence.bool().any(1).tolist() == [t not in (1, 4) for t in T]
    steps = found.positions[[2, 3, 5, 6], :, 0] - found.positions[0, :, 0]
    np.testing.assert_allclose(steps / 16, np.outer([2, 3, 5, 6], np.ones(33)), atol=1e-4)


def mmpose_video(folder: Path) -> None:
    frames = [{"frame_id": t, "instances": [] if t == 4 else [
        {"keypoints": walk(t)[:, :2].tolist(), "keypoint_scores": walk(t)[:, 2].tolist(),
         "bbox": [[280, 90, 520, 590]], "bbox_score": 0.9}
    ]} for t in T]  # fmt: skip
    found = read(write(folder / "clip.json", frames))
    expect(found, empty=[4])
    np.testing.assert_allclose(found.confidence[0], walk(0)[:, 2])


def movenet17(folder: Path) -> None:
    frames = [{"score": 0.7, "keypoints": [
        {"x": u, "y": v, "score": c, "name": name}
        for (u, v, c), name in zip(walk(t), long(COCO), strict=True)
    ]} for t in T]  # fmt: skip
    expect(read(write(folder / "m.json", frames)))


def npy_triples(folder: Path) -> None:
    np.save(folder / "a.npy", np.stack([walk(t) for t in T]).astype(np.float32))
    found = read(folder / "a.npy")
    expect(found)
    np.testing.assert_allclose(found.confidence[5], walk(5)[:, 2], atol=1e-6)


def openpifpaf_lines(folder: Path) -> None:
    lines = [json.dumps({"frame": t + 1, "predictions": [{"keypoints": flat(t), "score": 0.9}]})
             for t in T if t != 3]  # fmt: skip
    expect(read(write(folder / "clip.mp4.openpifpaf.json", "\r\n".join(lines))), empty=[3])


def openpose(folder: Path, frames: Iterable[int], key: str, names: tuple[str, ...]) -> None:
    for t in frames:
        people = [{key: flat(t, names), "hand_left_keypoints": []}]
        write(folder / f"hall_{t:012d}_keypoints.json", {"version": 1.0, "people": people})


def openpose_old_key(folder: Path) -> None:
    openpose(folder, T, "pose_keypoints", OPENPOSE_18)
    expect(read(folder))


def openpose_one_short(folder: Path) -> None:
    openpose(folder, T[:-1], "pose_keypoints_2d", OPENPOSE_25)
    found = read(folder)
    expect(found, empty=[6])
    assert any("6 of 7" in line for line in found.report)


def pose2sim_nan_person(folder: Path) -> None:
    nobody = [float("nan")] * 3 * len(HALPE_26)
    for t in T:
        pair = [nobody if t in (2, 5) else flat(t, HALPE_26),
                nobody if t < 2 else walk(t, HALPE_26, right=-230).ravel().tolist()]  # fmt: skip
        people = [{"person_id": [-1], "pose_keypoints_2d": each} for each in pair]
        write(folder / f"cam3_{t:06d}.json", {"version": 1.3, "people": people})
    expect(read(folder), empty=[2, 5])


def sleap_frame_idx(folder: Path) -> None:
    heads = [f"{name}.{kind}" for name in long(LIMBS) for kind in ("x", "y", "score")]
    rows = [["", t, 0.93, *flat(t, LIMBS)] for t in T if t not in (1, 4)]
    text = table(["track", "frame_idx", "instance.score", *heads], *rows)
    expect(read(write(folder / "walk.analysis.csv", text)), LIMBS, empty=[1, 4])


def vitpose_yx(folder: Path) -> None:
    frames = [{"3": walk(t)[:, [1, 0, 2]].tolist()} for t in T]
    skeleton = {str(n): name for n, name in enumerate(long(COCO))}
    expect(read(write(folder / "clip_result.json", {"keypoints": frames, "skeleton": skeleton})))


def wholebody133(folder: Path) -> None:
    names = (*COCO, *FEET, *(f"face or hand {n}" for n in range(68 + 42)))
    marks = [{"image_id": t, "category_id": 1, "score": 0.9, "keypoints": flat(t, names)}
             for t in T]  # fmt: skip
    found = read(write(folder / "w.json", marks))
    expect(found, (*LIMBS, "nose", "l_toe", "l_heel", "r_toe", "r_heel"))


def yolo_txt(folder: Path) -> None:
    for t in T:
        row = walk(t) / (*SIZE, 1)
        words = ["0 0.5 0.5 0.3 0.8", *(f"{value:.6f}" for value in row.flat)]
        if t not in (2, 3):
            write(folder / "labels" / f"walk_{t + 1}.txt", " ".join(words) + "\n")
    expect(read(folder / "labels"), empty=[2, 3], within=1.0)


# Cameras.

FX, FY, CX, CY = 915.5, 917.25, 402.75, 296.5
LENS = [-0.13, 0.21, -0.0008, 0.0017, -0.04]
MATRIX = [[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]]


def block(name: str, values: Any, tag: str = "!!opencv-matrix", rows: int = 3) -> str:
    """A matrix of OpenCV's YAML, and of ROS's without a tag."""
    data = np.ravel(values).tolist()
    return (
        f"{name}: {tag}\n   rows: {rows}\n   cols: {len(data) // rows}\n   dt: d\n   data: {data}\n"
    )


def one_camera(
    path: Path, lens: list[float] = LENS, corner: float = 0.0, t: list[float] | None = None
) -> None:
    loaded = load_camera(path)
    expected = np.array(MATRIX)
    expected[:2, 2] -= corner
    np.testing.assert_allclose(loaded.camera.K, expected)
    np.testing.assert_allclose(loaded.camera.distortion[: len(lens)], lens)
    assert loaded.camera.image_size_wh == SIZE
    assert loaded.metric == (t is not None)
    if t is not None:
        np.testing.assert_allclose(loaded.camera.t_camera_world, t)


def toml(name: str, t: list[float], more: str = "") -> str:
    return (
        f"[{name}]\nsize = [ 800, 600,]\nmatrix = {MATRIX}\ndistortions = {LENS}\n"
        f"rotation = [ 0.3, 0.2, -0.1,]\ntranslation = {t}\n{more}\n"
    )


def anipose_mm(folder: Path) -> None:
    t = np.array([640.0, -220.0, 3105.0])
    text = toml("cam_0", t.tolist(), 'name = "left"') + toml("cam_1", [1.0, 2, 2900], 'name = "b"')
    loaded = load_camera(write(folder / "calibration.toml", text + "[metadata]\n"), "left")
    assert loaded.metric
    assert "millimetres" in str(loaded.units_note)
    np.testing.assert_allclose(loaded.camera.t_camera_world, 0.001 * t)


def caliscope(folder: Path) -> None:
    t = [-0.4, 0.7, 2.6]
    text = toml("cameras.2", t, "cam_id = 2\nignore = false")
    empty = "[cameras.5]\ncam_id = 5\nignore = true\nsize = [800, 600]\n"
    one_camera(write(folder / "camera_array.toml", empty + text), t=t)


def colmap(folder: Path) -> None:
    numbers = " ".join(map(str, (FX, FY, CX, CY, *LENS[:4])))
    path = write(folder / "cameras.txt", f"# Camera list\n7 OPENCV 800 600 {numbers}\n")
    one_camera(path, LENS[:4], corner=0.5)


def easymocap_01(folder: Path) -> None:
    focal = {"03": 880.0, "09": 890.0, "11": 900.0}
    text = "%YAML:1.0\n---\nnames:\n" + "".join(f"  - {name}\n" for name in focal)
    for name, f in focal.items():
        text += block(f"K_{name}", [[f, 0, CX], [0, f, CY], [0, 0, 1]])
        text += block(f"dist_{name}", LENS, rows=1) + f"H_{name}: 600\nW_{name}: 800\n"
    cameras = torchcss.read_cameras(write(folder / "intri.yml", text))
    assert {name: float(each.K[0, 0]) for name, each in cameras.items()} == focal
    assert cameras["09"].image_size_wh == SIZE


def opencv_yml(folder: Path) -> None:
    text = "%YAML:1.0\n---\nimage_width: 800\nimage_height: 600\n" + block("camera_matrix", MATRIX)
    text += block("distortion_coefficients", LENS, rows=5) + "avg_reprojection_error: 3.1e-01\n"
    one_camera(write(folder / "out_camera_data.yml", text))


def ros_yaml(folder: Path) -> None:
    text = "image_width: 800\nimage_height: 600\ncamera_name: porch\n"
    text += block("camera_matrix", MATRIX, "") + "distortion_model: plumb_bob\n"
    text += block("distortion_coefficients", LENS, "", 1)
    text += block("rectification_matrix", np.eye(3), "")
    text += block("projection_matrix", 9 * np.eye(3, 4), "")
    one_camera(write(folder / "porch.yaml", text))


# Bodies.

LENGTHS = {"knee": 44.0, "ankle": 39.0, "elbow": 31.0, "wrist": 24.0}


def bvh(form: str, words: str, root: str, up: int = 1, motion: str | None = None) -> str:
    """Somebody who stands along an axis, arms out.

    Args:
        form: A limb's name, of the side's first letter, the side's word, and the limb's word.
        words: Thigh, shin, foot, arm, forearm, hand.
        root: What the root is called.
        up: The vertical axis.
        motion: What stands after MOTION; None: one pose, all zero.
    """

    def joint(name: str, u: float, height: float, inside: str = "") -> str:
        place = [u, 0.0, 0.0]
        place[up] += height
        inside = inside or "End Site\n{\nOFFSET 0 0 9\n}\n"
        return (
            f"JOINT {name}\n{{\nOFFSET {' '.join(map(str, place))}\n"
            f"CHANNELS 3 Zrotation Xrotation Yrotation\n{inside}}}\n"
        )

    def limb(side: str, start: int) -> str:
        sign = 1 if side == "left" else -1
        names = [form.format(side[0], side, word) for word in words.split()[start : start + 3]]
        if start == 0:
            end = joint(names[2], 0, -LENGTHS["ankle"])
            return joint(names[0], sign * 8, -4, joint(names[1], 0, -LENGTHS["knee"], end))
        end = joint(names[2], sign * LENGTHS["wrist"], 0)
        return joint(names[0], sign * 19, 37, joint(names[1], sign * LENGTHS["elbow"], 0, end))

    middle = form.split("{")[0].removesuffix("_") if "Bip" in form else ""
    head = joint(f"{middle}Neck", 0, 40, joint(f"{middle}Head", 0, 11))
    spine = joint(f"{middle}Spine", 0, 12, head + limb("left", 3) + limb("right", 3))
    motion = motion or "Frames: 1\nFrame Time: 0.02\n" + " ".join(["0"] * (6 + 3 * 15)) + "\n"
    return (
        f"HIERARCHY\nROOT {root}\n{{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition "
        f"Zrotation Xrotation Yrotation\n{spine}{limb('left', 0)}{limb('right', 0)}}}\n"
        f"MOTION\n{motion}"
    )


def limbs(form: str, words: str, root: str) -> Callable[[Path], None]:
    def check(folder: Path) -> None:
        body = torchcss.load_body(write(folder / "a.bvh", bvh(form, words, root)))
        assert set(body.joint_names) >= set(LIMBS)
        joints = body.pose(torch.zeros(body.num_parameters, dtype=torch.float64)).joints
        for side, sign in (("l", 1), ("r", -1)):
            for above, joint in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"),
                                 ("elbow", "wrist")):  # fmt: skip
                a, b = (joints[body.joint_index(f"{side}_{name}")] for name in (above, joint))
                np.testing.assert_allclose(torch.linalg.norm(a - b), LENGTHS[joint] / 100)
                assert sign * float(b[0]) > 0

    return check


USUAL = ("{1}{2}", "UpLeg Leg Foot Arm ForeArm Hand", "Hips")


def bvh_no_motion(folder: Path) -> None:
    text = bvh(*USUAL, motion="Frames: 0\nFrame Time: 0.04\n")
    body = torchcss.load_body(write(folder / "a.bvh", text))
    assert body.num_parameters == 6 + 3 * 15
    turns = [n for n, name in enumerate(body.state_names) if not name.startswith("root")]
    widest = torch.rad2deg(torch.stack([body.bounds.lower, body.bounds.upper])[:, turns]).abs()
    np.testing.assert_allclose(widest.max(), 120)


def bvh_z_up(folder: Path) -> None:
    path = write(folder / "a.bvh", bvh(*USUAL, up=2))
    motion = torchcss.read_motion_capture(path)
    head, foot = (motion.joint_names.index(name) for name in ("Head", "rightFoot"))
    height = motion.joints[0, head, 1] - motion.joints[0, foot, 1]
    np.testing.assert_allclose(height, 0.01 * (12 + 40 + 11 + 4 + 44 + 39))
    assert any("z up" in line.lower() for line in motion.report)


def mjcf_equality(folder: Path) -> None:
    pytest.importorskip("mujoco")
    finger = ("<body pos='0 0 .1'><joint name='{0}' type='slide' axis='0 {1} 0' range='0 .05'/>"
              "<geom size='.01'/></body>")  # fmt: skip
    body = torchcss.load_body(write(
        folder / "tongs.xml",
        f"<mujoco><worldbody><body><geom size='.05'/>{finger.format('thumb', 1)}"
        f"{finger.format('index', -1)}</body></worldbody><equality><joint joint1='index' "
        "joint2='thumb' polycoef='0.01 0.5 0 0 0'/></equality></mujoco>",
    ))  # fmt: skip
    assert body.state_names == ("thumb",)
    np.testing.assert_allclose(body.tie @ torch.tensor([0.04]).double() + body.offset, [0.04, 0.03])


def urdf(folder: Path, *joints: str, more: str = "") -> torchcss.BodyModel:
    """A chain of joints, each `name kind` and what is in it; links are called after the joints."""
    text, parent = "<link name='ground'/>", "ground"
    for each in joints:
        name, kind, *inside = each.split(maxsplit=2)
        text += (
            f"<link name='{name}_link'/><joint name='{name}' type='{kind}'>"
            f"<parent link='{parent}'/><child link='{name}_link'/><origin xyz='0 0 0.4'/>"
            f"<axis xyz='0 1 0'/><limit lower='-0.7' upper='2' effort='1' velocity='1'/>"
            f"{''.join(inside)}</joint>"
        )
        parent = f"{name}_link"
    return torchcss.load_body(write(folder / "r.urdf", f"<robot name='r'>{text}{more}</robot>"))


def urdf_floating(folder: Path) -> None:
    body = urdf(folder, "free floating", "shoulder revolute", "elbow revolute")
    assert body.num_parameters == 6 + 2
    assert body.state_names[6:] == ("shoulder", "elbow")


def urdf_mimic_missing(folder: Path) -> None:
    body = urdf(folder, "r_near revolute", "r_far revolute <mimic joint='near' multiplier='0.8'/>")
    assert body.state_names == ("r_near", "r_far")
    assert any("'r_far' mimics 'near'" in note for note in body.notes)


def urdf_prefix(folder: Path) -> None:
    plugin = "<gazebo reference='tilt_link'><ray:scan ray:on='1'><ray:w/></ray:scan></gazebo>"
    body = urdf(folder, "pan revolute", "tilt revolute", "tip fixed", more=plugin)
    assert body.state_names == ("pan", "tilt")
    np.testing.assert_allclose(body.bounds.lower, -0.7)
    np.testing.assert_allclose(body.bounds.upper, 2)
    place = body.pose(torch.zeros(2, dtype=torch.float64)).tree.translation
    np.testing.assert_allclose(place[body.tree.link_names.index("tip_link")], (0, 0, 1.2))


# Videos.


def edit_list(folder: Path) -> None:
    """A telephone trims a film by an edit list: players, and we, begin where it says."""
    path, hidden, count = folder / "a.mp4", 5, len(T)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"bf": "0", "g": "1"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for index in range(hidden + count + 4):
            picture = av.VideoFrame.from_ndarray(
                np.full((48, 64, 3), 20 + 8 * index, np.uint8), format="rgb24"
            )
            picture.pts, picture.time_base = index, Fraction(1, 25)
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
        assert stream.time_base is not None
        scale = stream.time_base.denominator
    data = bytearray(path.read_bytes())
    place = data.index(b"elst") + 12  # version 0: after version, flags and the number of entries
    # In the film's thousandths how long, and in the stream's ticks where it begins.
    data[place : place + 8] = struct.pack(">Ii", count * 40, hidden * scale // 25)
    path.write_bytes(bytes(data))
    marks = np.stack([walk(t) for t in T])
    np.savez(folder / "k.npz", keypoints=marks[..., :2] * 0.08, confidence=marks[..., 2],
             joint_names=np.array(COCO))  # fmt: skip
    given = ViewFiles(video=path, keypoints=folder / "k.npz")
    opened = open_view(given, camera(folder, (64, 48)))
    frames = list(opened.images())
    assert opened.reader.info.num_frames == opened.reader.count_frames() == len(frames) == count
    assert [frame.index for frame in frames] == list(T)
    assert [frame.time_s for frame in frames] == pytest.approx([t / 25 for t in T])
    assert frames[0].image.mean() == pytest.approx(20 + 8 * hidden, abs=3)
    expect(opened.keypoints, scale=0.08)


def folder_rate(folder: Path) -> None:
    write(folder / "j.json", {"joints": {name: PLACES[name] for name in LIMBS}})
    opened = view(folder, "j.json", [f"{t:02d}.png" for t in range(3)], frame_rate=240)
    assert [frame.time_s for frame in opened.images()] == pytest.approx([0, 1 / 240, 2 / 240])


TWINS: dict[str, Callable[[Path], None]] = {
    "body_bvh_biped": limbs("Bip01 {0} {2}", "Thigh Calf Foot UpperArm Forearm Hand", "Bip01"),
    "body_bvh_poser": limbs("{0}{2}", "Thigh Shin Foot Shldr ForeArm Hand", "hip"),
    "body_bvh_unreal": limbs("{2}_{0}", "thigh calf foot upperarm lowerarm hand", "pelvis"),
    "body_side_suffix": limbs("{2}_{0}", "upperleg lowerleg foot upper_arm lowerarm hand", "hips"),
    **{f"body_{check.__name__}": check for check in (
        bvh_no_motion, bvh_z_up, mjcf_equality, urdf_floating, urdf_mimic_missing, urdf_prefix,
    )},
    **{f"cam_{check.__name__}": check for check in (
        anipose_mm, caliscope, colmap, easymocap_01, opencv_yml, ros_yaml,
    )},
    **{f"kp_{check.__name__}": check for check in (
        alphapose_folder, alphapose_ids, alphapose_open, coco_other_size, coco_some_pictures,
        csv_confidence_c, cvat_empty_keypoints, dlc_human_names, dwpose_null, easymocap_annots,
        eks_more_coords, half_outside, hdf5_message, humaneva, labelme, mediapipe_timestamps,
        mmpose_video, movenet17, npy_triples, openpifpaf_lines, openpose_old_key,
        openpose_one_short, pose2sim_nan_person, sleap_frame_idx, vitpose_yx, wholebody133,
        yolo_txt,
    )},
    "vid_edit_list": edit_list,
    "vid_folder_rate": folder_rate,
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(TWINS))
def test_twin(tmp_path: Path, name: str) -> None:
    TWINS[name](tmp_path)


def test_every_case_has_a_twin(shared_data: Path) -> None:
    folder = shared_data / "cases"
    if not folder.is_dir():
        pytest.skip("the cases are not among the shared data on this machine")
    assert {entry.name for entry in folder.iterdir() if entry.is_dir()} == set(TWINS)

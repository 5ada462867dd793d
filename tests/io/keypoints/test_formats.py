"""2D joints as MediaPipe's users, DeepLabCut and VideoPose3D save them."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchcss.errors import KeypointError
from torchcss.io.keypoints.mediapipe import MEDIAPIPE_NAMES
from torchcss.io.keypoints.read import read_keypoints
from torchcss.joint_names import ALIASES, JOINT_NAMES, canonical_joint_name
from torchcss.types import Keypoints

SIZE = (640, 480)
FRAMES = 4


def made(num_joints: int) -> np.ndarray:
    """`[t j 3]`: pixels well inside the image and confidences."""
    source = np.random.default_rng(num_joints)
    first = source.uniform((150, 80), (450, 400), (num_joints, 2))
    places = first + 3.0 * np.arange(FRAMES)[:, None, None]
    return np.concatenate([places, source.uniform(0.5, 1.0, (FRAMES, num_joints, 1))], axis=-1)


def read(path: Path | str, **options: Any) -> Keypoints:
    return read_keypoints(path, **{"image_size_wh": SIZE, **options})


def check(found: Keypoints, triples: np.ndarray, layout: str, *, confidence: bool = True) -> None:
    np.testing.assert_allclose(found.positions, triples[..., :2], atol=1e-6)
    if confidence:
        np.testing.assert_allclose(found.confidence, triples[..., 2], atol=1e-6)
    names = [name if name in JOINT_NAMES else None for name in found.names]
    assert names == list(ALIASES[layout])


# MediaPipe.

MARKS = made(33)


def fractions(pixels: bool = False) -> np.ndarray:
    """`[t 33 4]`: x, y, z, visibility, as MediaPipe gives them."""
    places = MARKS[..., :2] if pixels else (MARKS[..., :2] + 0.5) / SIZE
    z = np.linspace(-0.5, 0.5, 33)[None, :, None].repeat(FRAMES, 0)
    return np.concatenate([places, z, MARKS[..., 2:]], axis=-1)


def landmarks(values: np.ndarray) -> list[dict[str, float]]:
    return [dict(zip(("x", "y", "z", "visibility"), row, strict=True)) for row in values.tolist()]


POSES = [landmarks(frame) for frame in fractions()]


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(POSES, id="lists"),
        pytest.param([{"frame": i, "landmarks": p} for i, p in enumerate(POSES)], id="frames"),
        pytest.param([{"pose_landmarks": {"landmark": pose}} for pose in POSES], id="protobuf"),
        pytest.param([{"pose_landmarks": [pose]} for pose in POSES], id="people of the tasks"),
        pytest.param({"fps": 30, "frames": [{"landmarks": p} for p in POSES]}, id="object"),
        pytest.param({f"frame_{i:03d}": pose for i, pose in enumerate(POSES)}, id="by number"),
        pytest.param(
            [
                dict(zip(map(str.upper, MEDIAPIPE_NAMES), pose, strict=True))
                for pose in POSES
            ],
            id="names",
        ),
        pytest.param(
            [{"frame_number": i, "landmarks": dict(zip(map(str, range(33)), p, strict=True))}
             for i, p in reversed(list(enumerate(POSES)))], id="by index, backwards",
        ),
        pytest.param([landmarks(frame) for frame in fractions(pixels=True)], id="pixels"),
    ],
)  # fmt: skip
def test_mediapipe_json(tmp_path: Path, content: Any) -> None:
    path = tmp_path / "pose.json"
    path.write_text(json.dumps(content))
    check(read(path, num_frames=FRAMES), MARKS, "MediaPipe-33")
    found = read(path)
    check(found, MARKS, "MediaPipe-33")
    assert any("MediaPipe" in line for line in found.report)
    assert any("pixels" in line for line in found.report)


@pytest.mark.parametrize("form", ["triples", "fours", "rows", "rows of fours"])
def test_mediapipe_json_of_plain_numbers(tmp_path: Path, form: str) -> None:
    """Three numbers of a landmark are x, y and z, of which some are negative: no confidence."""
    path, has_confidence = tmp_path / "pose.json", "fours" in form
    values = fractions()[..., : 4 if has_confidence else 3]
    poses = values.reshape(FRAMES, -1) if "rows" in form else values
    path.write_text(json.dumps([{"frame": i, "pose": p.tolist()} for i, p in enumerate(poses)]))
    found = read(path, num_frames=FRAMES)
    check(found, MARKS, "MediaPipe-33", confidence=has_confidence)
    told = any("no confidence in the file, but z" in line for line in found.report)
    assert told == bool((found.confidence == 1).all()) == (not has_confidence)


def test_mediapipe_frames_without_a_person(tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    for nobody in (None, [], {"landmarks": []}, {"landmarks": None}):
        path.write_text(json.dumps([POSES[0], nobody, POSES[2]]))
        found = read(path, num_frames=3)
        assert found.confidence.bool().any(1).tolist() == [True, False, True]
    path.write_text(json.dumps([{"frame": 0, "landmarks": POSES[0]}]))
    assert read(path, num_frames=3).positions.shape == (3, 33, 2)  # the end is often left out


def test_mediapipe_frames_that_count_from_one(tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    entries = [{"frame": i, "landmarks": pose} for i, pose in enumerate(POSES, start=1)]
    for content in (entries, {str(entry["frame"]): entry["landmarks"] for entry in entries}):
        path.write_text(json.dumps(content))
        found = read(path, num_frames=FRAMES)
        check(found, MARKS, "MediaPipe-33")
        assert any("frame 1 is the first frame" in line for line in found.report)
    # Without the last frame nothing tells the two ways of counting apart.
    path.write_text(json.dumps(entries[:-1]))
    with pytest.raises(KeypointError, match=r"somebody is 1: start there .*, or number .* from 0"):
        read(path, num_frames=FRAMES)
    path.write_text(json.dumps([{"frame": 0, "landmarks": POSES[0]}, *entries]))
    with pytest.raises(KeypointError, match=f"expected {FRAMES} frames"):
        read(path, num_frames=FRAMES)


@pytest.mark.parametrize("name", ["landmarks", "arr_0", "anything"])
@pytest.mark.parametrize("shape", [(FRAMES, 33, 4), (FRAMES, 132)])
def test_mediapipe_arrays(tmp_path: Path, name: str, shape: tuple[int, ...]) -> None:
    np.savez(tmp_path / "a.npz", **{name: fractions().reshape(shape)})
    check(read(tmp_path / "a.npz", num_frames=FRAMES), MARKS, "MediaPipe-33")
    np.save(tmp_path / "a.npy", fractions().reshape(shape))
    check(read(tmp_path / "a.npy"), MARKS, "MediaPipe-33")


def test_mediapipe_arrays_without_visibility(tmp_path: Path) -> None:
    values = fractions()[..., :3]
    values[1] = np.nan  # nobody
    np.save(tmp_path / "a.npy", values)
    found = read(tmp_path / "a.npy")
    assert found.confidence.unique(dim=1).flatten().tolist() == [1.0, 0.0, 1.0, 1.0]
    assert any("no confidence in the file" in line for line in found.report)


def wide(heading: list[str], rows: np.ndarray, *, frame: str | None = None) -> str:
    lines = [",".join(([frame] if frame else []) + heading)]
    for index, row in enumerate(rows):
        cells = ["" if np.isnan(value) else f"{value:.9f}" for value in row]
        lines.append(",".join(([str(index)] if frame else []) + cells))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    "form",
    ["x{n}|y{n}|z{n}|v{n}", "landmark_{i}_x|landmark_{i}_y|landmark_{i}_z|landmark_{i}_visibility",
     "{name}_x|{name}_y|{name}_z|{name}_visibility", "x_{NAME}|y_{NAME}|z_{NAME}|v_{NAME}",
     "{NAME}.x|{NAME}.y|{NAME}.z|{NAME}.visibility", "x{i}|y{i}|z{i}|v{i}"],
)  # fmt: skip
@pytest.mark.parametrize("frame", [None, "frame"])
def test_mediapipe_csv(tmp_path: Path, form: str, frame: str | None) -> None:
    heading = [
        part.format(i=i, n=i + 1, name=name, NAME=name.upper())
        for i, name in enumerate(MEDIAPIPE_NAMES)
        for part in form.split("|")
    ]
    path = tmp_path / "pose.csv"
    path.write_text(wide(heading, fractions().reshape(FRAMES, -1), frame=frame))
    check(read(path, num_frames=FRAMES), MARKS, "MediaPipe-33")
    # As spreadsheets of some countries write it.
    path.write_text(path.read_text().replace(",", ";"), encoding="utf-8-sig")
    check(read(path), MARKS, "MediaPipe-33")


def test_mediapipe_long_csv(tmp_path: Path) -> None:
    rows = ["frame,landmark,x,y,z,visibility"]
    for index, frame in enumerate(fractions()):
        rows += [
            f"{index},{name.upper()},{x},{y},{z},{v}"
            for name, (x, y, z, v) in zip(MEDIAPIPE_NAMES, frame.tolist(), strict=True)
        ]
    path = tmp_path / "pose.csv"
    path.write_text("\n".join(rows))
    check(read(path, num_frames=FRAMES), MARKS, "MediaPipe-33")
    path.write_text("\n".join(rows[:1] + [row for row in rows[1:] if not row.startswith("2,")]))
    assert not read(path, num_frames=FRAMES).confidence[2].any()


# DeepLabCut.

PARTS = ("nose", "l_shoulder", "r_shoulder", "leftelbow", "tailbase")


def deeplabcut(people: dict[str, np.ndarray], *, likelihood: bool = True, index: str = "{}") -> str:
    coords = ["x", "y", "likelihood"][: 2 + likelihood]
    columns = [(who, part, c) for who in people for part in PARTS for c in coords]
    multi = len(people) > 1
    lines = [["scorer", *["DLC_resnet50_demoshuffle1_50000"] * len(columns)]]
    if multi:
        lines.append(["individuals", *(who for who, _, _ in columns)])
    lines.append(["bodyparts", *(part for _, part, _ in columns)])
    lines.append(["coords", *(c for _, _, c in columns)])
    for t in range(FRAMES):
        cells = []
        for who, part, c in columns:
            value = people[who][t, PARTS.index(part), ["x", "y", "likelihood"].index(c)]
            cells.append("" if np.isnan(value) else repr(float(value)))
        lines.append([index.format(t), *cells])
    return "\n".join(",".join(line) for line in lines) + "\n"


def test_deeplabcut(tmp_path: Path) -> None:
    marks = made(len(PARTS))
    path = tmp_path / "videoDLC_resnet50.csv"
    path.write_text(deeplabcut({"one": marks}))
    found = read(path, num_frames=FRAMES)
    np.testing.assert_allclose(found.positions, marks[..., :2])
    np.testing.assert_allclose(found.confidence, marks[..., 2])
    assert found.names == ("nose", "l_shoulder", "r_shoulder", "l_elbow", "tailbase")
    assert any("tailbase" in line for line in found.report)
    # Labelled by hand: no likelihood, pictures' names for frames, gaps where nothing was marked.
    marks[2, 1] = np.nan
    path.write_text(deeplabcut({"one": marks}, likelihood=False, index="labeled-data/v/img{}.png"))
    found = read(path)
    assert found.confidence[0].tolist() == [1.0] * 5
    assert found.confidence[2].tolist() == [1.0, 0.0, 1.0, 1.0, 1.0]
    path.write_text(path.read_text().replace("coords,x,y,x,y", "coords,x,y,z,y"))
    with pytest.raises(KeypointError, match="x, y, z are points in space"):
        read(path)


def test_deeplabcut_with_several_animals(tmp_path: Path) -> None:
    one, other = made(len(PARTS)), made(len(PARTS)) * (0.3, 0.3, 0.4)
    other[1] = np.nan
    path = tmp_path / "multi.csv"
    path.write_text(deeplabcut({"individual1": other, "individual2": one}))
    found = read(path, num_frames=FRAMES)
    np.testing.assert_allclose(found.positions, one[..., :2])
    assert any("2 individuals" in line for line in found.report)


def test_deeplabcut_hdf5_is_told_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(KeypointError, match="save it as CSV"):
        read(tmp_path / "a.h5")


# VideoPose3D.


def test_mediapipe_in_mixed_units(tmp_path: Path) -> None:
    values = fractions()
    values[3, 5, :2] *= 1000
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(KeypointError, match="expected fractions of the image, as most are"):
        read(tmp_path / "a.npy")


def archive(path: Path, recordings: Any, layout: str = "h36m") -> Path:
    np.savez_compressed(
        path,
        positions_2d=np.array(recordings, dtype=object),
        metadata=np.array({"layout_name": layout, "num_joints": 17}, dtype=object),
    )
    return path


def test_human36m(tmp_path: Path) -> None:
    marks = made(17)
    flat = marks[..., :2].astype(np.float32)
    recordings = {
        "S9": {"Walking 1": [flat, flat + 1], "Eating": [flat]},
        "S11": {"Walking": [flat + 2]},
    }
    path = archive(tmp_path / "data_2d_h36m_gt.npz", recordings)
    found = read(f"{path}#S9/Walking 1/1", num_frames=FRAMES)
    np.testing.assert_allclose(found.positions, marks[..., :2] + 1, atol=1e-3)
    assert found.confidence.unique().tolist() == [1.0]
    assert found.names[:3] == ("HumanoidRoot", "r_hip", "r_knee")
    assert any("S9/Walking 1/1" in line for line in found.report)
    assert read(f"{path}#S11").positions.shape == (FRAMES, 17, 2)
    for selection, words in (
        ("", r"say which recording.*there are: S9, S11"),
        ("#S7", r"no subject 'S7'.*S9, S11"),
        ("#S9", r"gt.npz#S9/ACTION.*Walking 1, Eating"),
        ("#S9/Sitting", r"no action 'Sitting'.*Walking 1, Eating"),
        ("#S9/Walking 1", r"gt.npz#S9/Walking 1/CAMERA.*0, 1"),
        ("#S9/Walking 1/4", r"no camera '4'.*0, 1"),
        ("#S9/Eating/0/1", "expected SUBJECT/ACTION/CAMERA"),
    ):
        with pytest.raises(KeypointError, match=words):
            read(f"{path}{selection}")
    with pytest.raises(KeypointError, match="no such file"):
        read(f"{tmp_path / 'other.npz'}#S9")


def test_videopose3d_of_a_single_video(tmp_path: Path) -> None:
    marks = made(17)
    marks[1] = np.nan  # nobody found
    path = archive(tmp_path / "a.npz", {"film.mp4": {"custom": [marks[..., :2]]}}, "coco")
    found = read(path, num_frames=FRAMES)
    assert found.names == ALIASES["COCO-17"]
    assert found.confidence[:, 0].tolist() == [1.0, 0.0, 1.0, 1.0]
    assert "layout: COCO-17, as the file says" in found.report


class Malicious:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, ("touch ran",)


def test_archives_run_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = archive(tmp_path / "a.npz", {"S1": {"a": [Malicious()]}})
    with pytest.raises(KeypointError, match=r"asks for .*system"):
        read(path)
    assert not (tmp_path / "ran").exists()
    assert pickle.loads(pickle.dumps(Malicious())) == 0  # it would have
    assert (tmp_path / "ran").exists()


# Files that are wrong.


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.csv", "", "empty"),
        ("a.csv", "\n\n", "empty"),
        ("a.csv", "nose_x,nose_y\n", "nothing below"),
        ("a.csv", "a,b\n1,2\n", "row 1: expected DeepLabCut's headings"),
        ("a.csv", "nose_x,nose_y\n1\n", "row 2: expected 2 columns"),
        ("a.csv", "nose_x,nose_y\n1,two\n", "row 2: expected a number, found 'two'"),
        ("a.csv", "nose_x,nose_y\n1,1_0\n", "row 2: expected a number"),
        ("a.csv", "nose_x,nose_y,nose_x\n1,2,3\n", "is there twice"),
        ("a.csv", "frame,nose_x,nose_y\nx,1,2\n", "'x' has no frame number"),
        ("a.csv", "frame,nose_x,nose_y\n-1,1,2\n", "row 2: expected a frame number"),
        ("a.csv", "frame,nose_x,nose_y\n9999999,1,2\n", "not a frame number"),
        ("a.csv", "frame,joint,x,y\n0,nose,1,2\n0,nose,1,2\n", "row 3: 'nose' is there twice"),
        ("a.csv", "nose_x,nose_y\ninf,20\n", "joint 'nose' is not a number"),
        ("a.csv", "scorer,a,a\nbodyparts,nose,nose\ncoords,x,y\n", "no frames"),
        ("a.csv", "scorer,a,a\nbodyparts,nose,nose\ncoords,x,q\n0,1,2\n", "x and y of 'nose'"),
        ("a.csv", "scorer,a,a\nbodyparts,nose\ncoords,x,y\n0,1,2\n", "under every body part"),
        ("a.csv", "scorer,a,a\nbodyparts,nose,nose\ncoords,x,y\n0,1\n", "row 4: expected 3 col"),
        ("a.json", '[[{"x": 1, "y": 2}]]', "they seem to be fractions"),
        ("a.json", json.dumps([[*POSES[0][:-1], {"x": 1}]]), "joint 32: expected x, y"),
        ("a.json", json.dumps([[*POSES[0][:-1], {"x": "1", "y": 2}]]), "joint 32: expected num"),
        ("a.json", json.dumps([POSES[0], 3]), "frame 1: expected people"),
        ("a.json", json.dumps({"x": POSES[0]}), "frame number"),
        ("a.npy", "PK", "not an NPY file"),
    ],
)  # fmt: skip
def test_malformed(tmp_path: Path, name: str, text: str, words: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(KeypointError, match=words) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "recordings", [3, {}, {"S1": 3}, {"S1": {}}, {"S1": {"a": 3}}, {"S1": {"a": []}},
                   {"S1": {"a": [np.zeros((3, 17))]}}, {"S1": {"a": ["x"]}},
                   {"S1": {"a": [{"b": 1}]}}],
)  # fmt: skip
def test_malformed_archives(tmp_path: Path, recordings: Any) -> None:
    with pytest.raises(KeypointError, match="expected"):
        read(archive(tmp_path / "a.npz", recordings))


def test_names_of_mediapipe_are_its_layout() -> None:
    found = [canonical_joint_name(name) for name in MEDIAPIPE_NAMES]
    assert tuple(found) == ALIASES["MediaPipe-33"]
    assert torch.tensor([len(MEDIAPIPE_NAMES)]).item() == 33

"""Cameras as other programs calibrate them: shapes, units, where pixels begin."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.io import savemat

from torchcss.body.rotations import about
from torchcss.errors import CameraError
from torchcss.io.calibrations.read import read_entries
from torchcss.io.cameras import load_camera, load_lens, read_cameras
from torchcss.io.lenses import Mirror
from torchcss.io.video import VideoWriter

SIZE = (640, 480)
FX, FY, CX, CY = 611.25, 612.75, 317.5, 243.0
K = [[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]]
LENS = [0.11, -0.24, 0.0012, -0.0021, 0.07]


def yaml_matrix(name: str, values: list[Any], rows: int, tag: str = "!!opencv-matrix") -> str:
    data = np.ravel(values).tolist()
    columns = len(data) // rows
    return f"{name}: {tag}\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {data}\n"


SIZES = "image_width: 640\nimage_height: 480\n"
OPENCV = "%YAML:1.0\n---\n" + SIZES
XML = (
    "<?xml version='1.0'?><opencv_storage><image_width>640</image_width>"
    "<image_height>480</image_height><camera_matrix type_id='opencv-matrix'><rows>3</rows>"
    f"<cols>3</cols><dt>d</dt><data>{' '.join(map(str, np.ravel(K)))}</data></camera_matrix>"
    "<distortion_coefficients type_id='opencv-matrix'><rows>5</rows><cols>1</cols><dt>d</dt>"
    f"<data>\n {' '.join(map(str, LENS))}</data></distortion_coefficients></opencv_storage>"
)
MATRIX = {"type_id": "opencv-matrix", "rows": 3, "cols": 3, "dt": "d", "data": np.ravel(K).tolist()}

FILES: dict[str, tuple[str, str]] = {
    "OpenCV, a column": (
        "a.yml",
        OPENCV + yaml_matrix("camera_matrix", K, 3)
        + yaml_matrix("distortion_coefficients", LENS, 5),
    ),
    "OpenCV, a row, eight of which three are zero": (
        "a.yaml",
        OPENCV + yaml_matrix("camera_matrix", K, 3)
        + yaml_matrix("distortion_coefficients", [*LENS, 0, 0, 0], 1),
    ),
    "OpenCV's JSON": (
        "a.json",
        json.dumps({"camera_matrix": MATRIX, "distortion_coefficients": [LENS], "width": 640,
                    "height": 480}),
    ),
    "lists, as tutorials save them": (
        "a.json", json.dumps({"mtx": K, "dist": [LENS], "resolution": [640, 480]})
    ),
    "OpenCV's XML": ("a.xml", XML),
    "OpenCV 5, coefficients without a second axis": (
        "a.yml",
        OPENCV + yaml_matrix("camera_matrix", K, 3) + "distortion_coefficients: !!opencv-nd-matrix"
        f"\n   sizes: [ 5 ]\n   dt: d\n   data: {LENS}\n",
    ),
    "OpenCV 5's XML, coefficients without a second axis": (
        "a.xml", XML.replace("<rows>5</rows><cols>1</cols>", "<sizes>5</sizes>")
    ),
    "ROS": (
        "a.yaml",
        SIZES + "camera_name: left\n" + yaml_matrix("camera_matrix", K, 3, "")
        + "distortion_model: plumb_bob\n" + yaml_matrix("distortion_coefficients", LENS, 1, "")
        + yaml_matrix("projection_matrix", [1.0] * 12, 3, ""),
    ),
    "ROS's message": (
        "a.yaml",
        f"width: 640\nheight: 480\ndistortion_model: plumb_bob\nD: {LENS}\n"
        f"K: {np.ravel(K).tolist()}\nR: [1.0, 0, 0, 0, 1, 0, 0, 0, 1]\nP: {[0.0] * 12}\n",
    ),
    "a list of cameras": (
        "a.json",
        json.dumps({"cameras": [{"name": "a", "K": K, "distCoef": LENS, "size": [640, 480]}]}),
    ),
    "RealSense": (
        "a.json",
        json.dumps({"intrinsics": {"fx": FX, "fy": FY, "ppx": CX, "ppy": CY, "width": 640,
                                   "height": 480, "coeffs": LENS}}),
    ),
    "number by number": (
        "a.json",
        json.dumps({"fx": FX, "fy": FY, "cx": CX, "cy": CY, "w": 640, "h": 480,
                    **dict(zip(("k1", "k2", "p1", "p2", "k3"), LENS, strict=True))}),
    ),
    "MATLAB's structure as JSON": (
        "cameraParams.json",
        json.dumps({"cameraParams": {
            "IntrinsicMatrix": [[FX, 0, 0], [0, FY, 0], [CX + 1, CY + 1, 1]],
            "RadialDistortion": [LENS[0], LENS[1], LENS[4]],
            "TangentialDistortion": LENS[2:4], "ImageSize": [480, 640]}}),
    ),
    "a list of cameras in capitals": (
        "a.json",
        json.dumps({"Unit": "mm", "Cameras": [{"Name": "a", "FocalLength": [FX, FY],
            "PrincipalPoint": [CX, CY], "Resolution": [640, 480], "Distortion": LENS}]}),
    ),
    "MATLAB's numbers as JSON, which count from 1": (
        "a.json",
        json.dumps({"IntrinsicMatrix": [[FX, 0, 0], [0, FY, 0], [CX + 1, CY + 1, 1]],
                    "RadialDistortion": [LENS[0], LENS[1], LENS[4]],
                    "TangentialDistortion": LENS[2:4], "ImageSize": [480, 640]}),
    ),
}  # fmt: skip


def check(path: Path, lens: list[float] = LENS, within: float = 1e-9, **more: Any) -> None:
    found = load_camera(path, **more)
    np.testing.assert_allclose(found.camera.K, K, atol=within)
    np.testing.assert_allclose(found.camera.distortion[: len(lens)], lens)
    assert found.camera.image_size_wh == SIZE
    assert not found.metric
    assert "no extrinsics" in str(found.units_note)


@pytest.mark.parametrize("kind", FILES)
def test_one_camera(tmp_path: Path, kind: str) -> None:
    name, text = FILES[kind]
    (tmp_path / name).write_text(text)
    check(tmp_path / name)


def test_keypoints_are_no_calibration(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", keypoints=np.zeros((2, 17, 2)))
    (tmp_path / "b.json").write_text(json.dumps({"people": [], "version": 1.3}))
    for name in ("a.npz", "b.json"):
        with pytest.raises(CameraError, match=r"keypoints, not a calibration.*--keypoints"):
            load_camera(tmp_path / name)


def test_pixels_of_the_board_beside_the_camera(tmp_path: Path) -> None:
    """OpenCV's program can write the board's corners, pairs in the cells of a matrix."""
    corners = yaml_matrix("image_points", [1.0] * 12, 2).replace("cols: 6", "cols: 3")
    text = FILES["OpenCV, a column"][1] + corners.replace("dt: d", 'dt: "2f"')
    (tmp_path / "a.yml").write_text(text)
    assert load_camera(tmp_path / "a.yml").camera.K[0, 0] == FX


@pytest.mark.parametrize(("columns", "kind"), [("x", "9f"), ("[1]", "9" * 12), ("~", "d")])
def test_columns_that_are_no_number(tmp_path: Path, columns: str, kind: str) -> None:
    corners = yaml_matrix("image_points", [1.0] * 6, 2).replace("cols: 3", f"cols: {columns}")
    text = FILES["OpenCV, a column"][1] + corners.replace("dt: d", f'dt: "{kind}"')
    (tmp_path / "a.yml").write_text(text)
    with pytest.raises(CameraError, match="needs as many numbers as data"):
        load_camera(tmp_path / "a.yml")


@pytest.mark.parametrize("turn", [[10, 5, 3], [90, 0, 45]])
def test_degrees_are_refused(tmp_path: Path, turn: list[float]) -> None:
    entry = {"K": K, "image_size_wh": SIZE, "rotation": turn, "t": [0, 0, 3]}
    (tmp_path / "a.json").write_text(json.dumps({"units": "m", "cameras": {"a": entry}}))
    with pytest.raises(CameraError, match="expected axis times angle in radians"):
        load_camera(tmp_path / "a.json")


@pytest.mark.parametrize("shape", [(5,), (1, 5), (5, 1)])
def test_arrays_take_the_size_of_the_video(tmp_path: Path, shape: tuple[int, ...]) -> None:
    path = tmp_path / "calibration.npz"
    lens = np.array(LENS).reshape(shape)
    np.savez(path, mtx=np.array(K), dist=lens, rvecs=np.zeros((9, 3, 1)), tvecs=np.zeros((9, 3, 1)))
    with pytest.raises(CameraError, match="does not say the image size"):
        load_camera(path)
    with VideoWriter(tmp_path / "a.mp4", 25) as film:
        film.write(np.zeros((480, 640, 3), np.uint8))
    check(path, video=tmp_path / "a.mp4")


@pytest.mark.parametrize("form", ["new", "old", "intrinsics"])
def test_matlab(tmp_path: Path, form: str) -> None:
    one_based = np.array(K) + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    values = {
        "ImageSize": [480, 640], "RadialDistortion": [0.11, -0.24, 0.07],
        "TangentialDistortion": [0.0012, -0.0021],
        **{
            "new": {"K": one_based},
            "old": {"IntrinsicMatrix": one_based.T},
            "intrinsics": {"FocalLength": [FX, FY], "PrincipalPoint": [CX + 1, CY + 1]},
        }[form],
    }  # fmt: skip
    content = {"new": {"cameraParams": values}, "old": values, "intrinsics": {form: values}}[form]
    savemat(tmp_path / "a.mat", content)
    check(tmp_path / "a.mat")
    plain = {key: np.asarray(each).tolist() for key, each in values.items()}
    for content in (plain, {"Intrinsics": plain, "RotationVectors": [[0.1, 0.2, 0.3]]}):
        (tmp_path / "a.json").write_text(json.dumps(content))
        check(tmp_path / "a.json")


@pytest.mark.parametrize("text", ["\n", "a = [\n", "a = [ 1 ;\n", "a = 1 ", " "])
def test_a_script_of_a_stranger_is_looked_at_once(tmp_path: Path, text: str) -> None:
    """Looked at anew from each line, these would take hours."""
    (tmp_path / "a.m").write_text(200_000 * text)
    with pytest.raises(CameraError, match="expected a calibration"):
        load_camera(tmp_path / "a.m")


def test_bouguets_toolbox(tmp_path: Path) -> None:
    values = {"fc": [[FX], [FY]], "cc": [[CX], [CY]], "kc": np.array(LENS)[:, None], "nx": 640}
    savemat(tmp_path / "Calib_Results.mat", {**values, "ny": 480})
    check(tmp_path / "Calib_Results.mat")
    script = ["%-- Focal length: [ px ];", f"fc = [ {FX} ; {FY} ];", f"cc = [ {CX} ; {CY} ];"]
    script += [
        f"kc = [ {' ; '.join(map(str, LENS))} ];",
        "alpha_c = 0.0;",
        "nx = 640;",
        "ny = 480;",
    ]
    script += ["omc_1 = [ 1.6 ; 1.6 ; -0.6 ];", "Tc_1  = [ -177.8 ; -83.1 ; 852.4 ];"]
    (tmp_path / "Calib_Results.m").write_text("\n".join(script))
    check(tmp_path / "Calib_Results.m")
    pair = {
        f"{n}_{side}": each for n, each in values.items() if n != "nx" for side in ("left", "right")
    }
    savemat(tmp_path / "stereo.mat", {**pair, "nx": 640, "ny": 480, "T": [[-100], [0], [0]]})
    check(tmp_path / "stereo.mat", name="right")


def test_opencvs_words_in_a_mat_count_from_zero(tmp_path: Path) -> None:
    values = {"cameraMatrix": K, "distCoeffs": [LENS], "image_width": 640, "image_height": 480}
    savemat(tmp_path / "a.mat", values)
    check(tmp_path / "a.mat")


@pytest.mark.parametrize(
    ("model", "numbers", "lens"),
    [
        ("SIMPLE_PINHOLE", [FX, CX, CY], []),
        ("PINHOLE", [FX, FY, CX, CY], []),
        ("SIMPLE_RADIAL", [FX, CX, CY, 0.1], [0.1]),
        ("RADIAL", [FX, CX, CY, 0.1, -0.2], [0.1, -0.2]),
        ("OPENCV", [FX, FY, CX, CY, *LENS[:4]], LENS[:4]),
        ("FULL_OPENCV", [FX, FY, CX, CY, *LENS, 0, 0, 0], LENS),
    ],
)
def test_colmap(tmp_path: Path, model: str, numbers: list[float], lens: list[float]) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text(f"# Camera list\n3 {model} 640 480 {' '.join(map(str, numbers))}\n")
    for place in (path, tmp_path):
        camera = load_camera(place).camera
        fy = FY if FY in numbers else FX
        expected = [[FX, 0, CX - 0.5], [0, fy, CY - 0.5], [0, 0, 1]]
        np.testing.assert_allclose(camera.K, expected)
        np.testing.assert_allclose(camera.distortion[: len(lens)], lens)
    assert camera.name == "3"


KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [0.11, -0.24, 0.0012, -0.0021]
  distortion_model: radtan
  intrinsics: [611.25, 612.75, 317.5, 243.0]
  resolution: [640, 480]
cam1:
  T_cn_cnm1:
  - [0.0, -1.0, 0.0, 0.1]
  - [1.0, 0.0, 0.0, 0.2]
  - [0.0, 0.0, 1.0, 0.3]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [600.0, 600.0, 320.0, 240.0]
  resolution: [640, 480]
"""


def test_kalibr(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR)
    found = load_camera(path, "cam1")
    assert found.metric
    assert found.camera.t_camera_world.tolist() == [0.1, 0.2, 0.3]
    assert found.camera.R_camera_world[0].tolist() == [0, -1, 0]
    np.testing.assert_allclose(load_camera(path, "cam0").camera.K, K)
    path.write_text(KALIBR.partition("cam1:")[0])
    check(path, LENS[:4])
    path.write_text(KALIBR.replace("radtan", "equidistant"))
    with pytest.raises(CameraError, match="fisheye"):
        load_camera(path, "cam0")
    path.write_text(KALIBR.replace("[1.0, 0.0, 0.0, 0.2]", "[1.0, 0.0]"))
    with pytest.raises(CameraError, match="T_cn_cnm1"):
        load_camera(path, "cam1")


def table(name: str, t: list[float], more: str = "") -> str:
    return (
        f'[{name}]\nname = "{name[-1]}"\nsize = [640, 480]\nmatrix = {K}\ndistortions = {LENS}\n'
        f"rotation = [0.1, 0.2, 0.3]\ntranslation = {t}\n{more}\n"
    )


@pytest.mark.parametrize(
    ("t", "metric", "scale", "words"),
    [
        ([-790.0, 155.0, 2510.0], True, 0.001, "millimetres"),
        ([-0.79, 0.155, 2.51], True, 1.0, None),
        ([-7.9, 1.55, 25.1], False, None, "unknown unit"),
        ([-79.0, 15.5, 251.0], False, None, "unknown unit"),
    ],
)
def test_unit_of_anipose(
    tmp_path: Path, t: list[float], metric: bool, scale: float | None, words: str | None
) -> None:
    path = tmp_path / "calibration.toml"
    text = table("cam_0", [0.0, 0.0, 0.0]) + table("cam_1", t) + "[metadata]\nerror = 0.4\n"
    path.write_text(text)
    found = load_camera(path, "1")
    assert found.metric is metric
    if scale is not None:
        np.testing.assert_allclose(found.camera.t_camera_world, scale * np.array(t))
    assert (found.units_note is None) if words is None else words in str(found.units_note)
    for units, factor in (('"mm"', 0.001), ("0.015", 0.015)):
        path.write_text(f"{text}units = {units}\n")
        said = load_camera(path, "1")
        assert said.metric
        np.testing.assert_allclose(said.camera.t_camera_world, factor * np.array(t))


def test_caliscope_leaves_out_what_is_not_calibrated(tmp_path: Path) -> None:
    path = tmp_path / "camera_array.toml"
    camera = table("cameras.0", [0.25, -0.1, 1.9]).replace('name = "0"\n', "cam_id = 0\n")
    path.write_text(camera + "[cameras.1]\ncam_id = 1\nsize = [640, 480]\n")
    assert load_camera(path).camera.name == "0"
    assert load_camera(path, "cam_0").metric
    path.write_text(camera + camera.replace("cameras.0", "cameras.1"))
    assert load_camera(path, video=tmp_path / "cam_1.mp4").camera.name == "1"
    for word in ("rotation", "translation"):
        camera = re.sub(f"(?m)^{word} = .*", f'{word} = "null"', camera)
    path.write_text(camera)
    assert "no extrinsics" in str(load_camera(path).units_note)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.yml", "a: &a [1, 2]\nb: [*a, *a]\n", "aliases"),
        ("a.yml", "a: 1\n", "camera_matrix"),
        ("a.yml", "- 1\n", "no calibration"),
        ("a.yml", OPENCV + yaml_matrix("camera_matrix", K, 3)
         + yaml_matrix("distortion_coefficients", [*LENS, 0.1, 0, 0], 1), "distortion of 8"),
        ("a.txt", "1 OPENCV 640 480 1 2 3\n", "line 1: expected COLMAP"),
        ("a.txt", "1 OPENCV_FISHEYE 640 480 1 2 3 4 5 6 7 8\n", "fisheye"),
        ("a.xml", "<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", "entities"),
        ("a.xml", "<opencv_storage/>", "camera_matrix"),
        ("a.mat", "MATLAB 5.0 MAT-file", "cannot be read as MATLAB's"),
        ("a.json", '{"camera_matrix": [1, 2], "width": 640, "height": 480}', "K"),
    ],
)  # fmt: skip
def test_bad_files(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CameraError, match=words) as caught:
        load_camera(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_nerfstudio_counts_from_the_corner(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    values = {"fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5, "w": 640, "h": 480}
    lens = dict(zip(("k1", "k2", "p1", "p2"), LENS, strict=False))
    path.write_text(json.dumps({**values, **lens, "camera_model": "OPENCV", "frames": []}))
    check(path, LENS[:4])


def test_a_pair_by_number(tmp_path: Path) -> None:
    path = tmp_path / "intrinsics.yml"
    matrices = (yaml_matrix("M1", K, 3), yaml_matrix("D1", LENS, 1), yaml_matrix("M2", K, 3))
    path.write_text("%YAML:1.0\n---\nimage_size: [640, 480]\n" + "".join(matrices))
    assert set(read_cameras(path)) == {"1", "2"}
    np.testing.assert_allclose(load_camera(path, "1").camera.distortion, LENS)
    assert not load_camera(path, "2").camera.has_distortion


def test_cameras_by_name_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    one = {"K": K, "dist": LENS, "image_size_wh": [640, 480]}
    path.write_text(json.dumps({"left": one, "right": one}))
    assert set(read_cameras(path)) == {"left", "right"}


def test_a_matrix_as_text(tmp_path: Path) -> None:
    path = tmp_path / "K.txt"
    path.write_text("# K\n" + "\n".join(" ".join(map(str, row)) for row in K))
    with pytest.raises(CameraError, match="does not say the image size"):
        load_camera(path)


def test_colmaps_binary(tmp_path: Path) -> None:
    path = tmp_path / "cameras.bin"
    numbers = (FX, FY, CX + 0.5, CY + 0.5, *LENS[:4])
    head = struct.pack("<QiiQQ", 1, 3, 4, 640, 480)
    path.write_bytes(head + struct.pack("<8d", *numbers))
    for place in (path, tmp_path):
        assert load_camera(place).camera.name == "3"
        check(place, LENS[:4])
    for data in (head, b"x"):
        path.write_bytes(data)
        with pytest.raises(CameraError, match=r"COLMAP's cameras\.bin"):
            load_camera(path)
    for model in (-1, 99):
        path.write_bytes(struct.pack("<QiiQQ", 1, 3, model, 640, 480))
        with pytest.raises(CameraError, match=f"camera 3 has COLMAP's model {model}, which is not"):
            load_camera(path)


TURN = about(1, np.array(0.4)) @ about(0, np.array(-0.3))
"""World to camera of some pictures."""


def quaternion(R: np.ndarray) -> list[float]:
    w = 0.5 * np.sqrt(1 + np.trace(R))
    return [float(w), *((R[(2, 0, 1), (1, 2, 0)] - R[(1, 2, 0), (2, 0, 1)]) / (4 * w)).tolist()]


def colmap_model(folder: Path, form: str, rows: list[tuple[Any, list[float], str]]) -> None:
    """A model of one camera and pictures: rotation, translation and name of each."""
    if form == "txt":
        (folder / "cameras.txt").write_text(f"1 PINHOLE 640 480 {FX} {FY} {CX + 0.5} {CY + 0.5}\n")
        lines = ["#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
        for number, (R, t, name) in enumerate(rows, start=1):
            lines.append(" ".join(map(str, [number, *quaternion(R), *t, 1, name])))
            lines.append("10.5 20.5 -1 11 21 7 1 2 3 4.0 5 6" if number % 2 else "")
        (folder / "images.txt").write_text("\n".join(lines) + "\n")
        return
    camera = struct.pack("<QiiQQ4d", 1, 1, 1, 640, 480, FX, FY, CX + 0.5, CY + 0.5)
    (folder / "cameras.bin").write_bytes(camera)
    data = struct.pack("<Q", len(rows))
    for number, (R, t, name) in enumerate(rows, start=1):
        data += struct.pack("<I7dI", number, *quaternion(R), *t, 1) + name.encode() + b"\0"
        data += struct.pack("<Q", 2) + struct.pack("<2dq", 10.5, 20.5, -1) * 2
    (folder / "images.bin").write_bytes(data)


@pytest.mark.parametrize("form", ["txt", "bin"])
def test_places_of_colmaps_pictures(tmp_path: Path, form: str) -> None:
    rows = [
        (TURN, [0.1, 0.2, 3.0], "left.jpg"), (np.eye(3), [0.0, 0.0, 2.0], "right 2.jpg"),
        (TURN.T, [0.5, 0.0, 1.0], "top/000001.jpg"),
    ]  # fmt: skip
    colmap_model(tmp_path, form, rows)
    if form == "txt":
        text = (tmp_path / "images.txt").read_text()
        (tmp_path / "images.txt").write_text("# units: 0.5\n" + text)
    # The camera of many places has none; that of one is where its only picture was taken.
    check(tmp_path, [0.0] * 5)
    places = {"left.mp4": 0, "right2.mp4": 1, "top.mp4": 2, "top": 2}
    for video, number in places.items():
        loaded = load_camera(tmp_path, video=tmp_path / video)
        R, t, name = rows[number]
        assert loaded.camera.name == name
        if form == "bin":  # it cannot say a unit
            assert not loaded.metric
            assert "unknown unit" in str(loaded.units_note)
            entry = read_entries(tmp_path)[name]
            np.testing.assert_allclose(entry.rotation, R, atol=1e-12)
            np.testing.assert_allclose(entry.translation, t)
            continue
        assert loaded.metric
        assert "need not have an axis upwards" in str(loaded.units_note)
        np.testing.assert_allclose(loaded.camera.R_camera_world, R, atol=1e-12)
        np.testing.assert_allclose(loaded.camera.t_camera_world, 0.5 * np.array(t))
    check(tmp_path, [0.0] * 5, video=tmp_path / "other.mp4")
    colmap_model(tmp_path, form, rows[:1])
    assert load_camera(tmp_path).camera.name == "1"
    np.testing.assert_allclose(read_entries(tmp_path)["1"].rotation, TURN, atol=1e-12)


@pytest.mark.parametrize("shared", [True, False])
def test_places_of_nerfstudios_pictures(tmp_path: Path, shared: bool) -> None:
    """Camera to world, with the camera's y up and z backwards."""
    numbers = {"fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5, "w": 640, "h": 480}
    poses = {"images/left.png": (TURN, [0.1, 0.2, 3.0]), "images/right.png": (TURN.T, [0, 0, 2.0])}
    frames = []
    for name, (R, t) in poses.items():
        matrix = np.eye(4)
        matrix[:3, :3] = R.T @ np.diag([1, -1, -1])
        matrix[:3, 3] = -R.T @ np.array(t)
        own = {} if shared else numbers
        frames.append({"file_path": name, "transform_matrix": matrix.tolist(), **own})
    content = {"camera_model": "PINHOLE", "frames": frames, **(numbers if shared else {})}
    path = tmp_path / "transforms.json"
    for units in (None, 0.5):
        path.write_text(json.dumps(content | {"units": units}))
        for video, (R, t) in zip(("left.mp4", "right.mp4"), poses.values(), strict=True):
            loaded = load_camera(path, video=tmp_path / video)
            np.testing.assert_allclose(loaded.camera.K, K)
            assert loaded.metric == (units is not None)
            if loaded.metric:
                np.testing.assert_allclose(loaded.camera.R_camera_world, R, atol=1e-12)
                expected = 0.5 * np.array(t)
                np.testing.assert_allclose(loaded.camera.t_camera_world, expected, atol=1e-12)
    if shared:
        check(path, [0.0] * 5)  # the camera of many places has none
    else:
        with pytest.raises(CameraError, match=r"several cameras, .*right.png"):
            load_camera(path)
    frames[0]["transform_matrix"] = [1, 2]
    path.write_text(json.dumps(content))
    with pytest.raises(CameraError, match=r"left\.png: expected fl_x"):
        load_camera(path)


def test_colmaps_pictures_that_are_none(tmp_path: Path) -> None:
    colmap_model(tmp_path, "txt", [(TURN, [0.1, 0.2, 3.0], "left.jpg")])
    text = (tmp_path / "images.txt").read_text()
    (tmp_path / "images.txt").write_text(text.replace(" 1 left", " 7 left"))
    with pytest.raises(CameraError, match=r"images.txt: picture '1': not COLMAP's"):
        load_camera(tmp_path)
    colmap_model(tmp_path, "bin", [(TURN, [0.1, 0.2, 3.0], "left.jpg")])
    (tmp_path / "images.bin").write_bytes((tmp_path / "images.bin").read_bytes()[:70])
    with pytest.raises(CameraError, match=r"expected COLMAP's images.bin"):
        load_camera(tmp_path / "cameras.bin")


QUALISYS = """<?xml version="1.0"?><calibration><cameras>
<camera active="1" serial="21000" model="Miqus M3" viewrotation="0">{parts}</camera>
<camera active="1" serial="26580" model="Miqus Video" viewrotation="{turned}">{parts}</camera>
</cameras></calibration>"""


@pytest.mark.parametrize("shown", [True, False])
def test_qualisys(tmp_path: Path, shown: bool) -> None:
    """64ths of pixels, millimetres, and a camera whose y is up: it looks along its own -z."""
    look = np.diag([1, -1, -1]) @ TURN
    centre = np.array([1200.0, -300.0, 1500.0])
    turn = " ".join(f'r{i + 1}{j + 1}="{look[i, j]}"' for i in range(3) for j in range(3))
    x, y, z = centre
    left, top = (16, 8) if shown else (0, 0)
    k1, k2, p1, p2, k3 = LENS
    parts = f"""<transform x="{x}" y="{y}" z="{z}" {turn}/>
    <intrinsic focallength="9" sensorMinU="0" sensorMaxU="{640 * 64 - 1}" sensorMinV="0"
    sensorMaxV="{480 * 64 - 1}" focalLengthU="{64 * FX}" focalLengthV="{64 * FY}"
    centerPointU="{64 * (CX + left)}" centerPointV="{64 * (CY + top)}" skew="0"
    radialDistortion1="{k1}" radialDistortion2="{k2}" radialDistortion3="{k3}"
    tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/>"""
    if shown:
        parts += f'<fov_video left="{left}" top="{top}" right="{left + 639}" bottom="{top + 479}"/>'
    path = tmp_path / "a.qca.txt"
    path.write_text(QUALISYS.format(parts=parts, turned=0))
    assert list(read_entries(path)) == ["26580"]  # the other one sees markers alone
    loaded = load_camera(path)
    np.testing.assert_allclose(loaded.camera.K, K)
    np.testing.assert_allclose(loaded.camera.distortion, LENS)
    assert loaded.camera.image_size_wh == SIZE
    assert loaded.metric
    np.testing.assert_allclose(loaded.camera.R_camera_world, TURN, atol=1e-12)
    np.testing.assert_allclose(loaded.camera.centre_world, 0.001 * centre)
    path.write_text(QUALISYS.format(parts=parts, turned=90))
    assert "viewrotation '90'" in str(load_camera(path).units_note)
    path.write_text(QUALISYS.format(parts=parts.replace("r33", "r34"), turned=0))
    with pytest.raises(CameraError, match="camera '26580': not Qualisys'"):
        load_camera(path)


VICON = """<?xml version="1.0" encoding="utf-8"?><Cameras>
<Camera DEVICEID="2100001" DISPLAY_TYPE="Vicon Vantage V5" SENSOR_SIZE="2432 2048" {more}>
<KeyFrames><KeyFrame FRAME="0"/></KeyFrames></Camera>
<Camera DEVICEID="2107343" DISPLAY_TYPE="Vicon Vue 2" SENSOR_SIZE="640 480" {more}><KeyFrames>
<KeyFrame FOCAL_LENGTH="600" FRAME="0" IMAGE_ERROR="0.2" ORIENTATION="{turn}" POSITION="{place}"
PRINCIPAL_POINT="317.5 243" VICON_RADIAL="{k1} {k2}" {radial} WORLD_ERROR="0.4"/>
</KeyFrames></Camera><Camera DEVICEID="7" TYPE="video" SENSOR_SIZE="640 480"/></Cameras>"""


@pytest.mark.parametrize("k3", [None, 4e-18])
def test_vicon(tmp_path: Path, k3: float | None) -> None:
    """Its polynomial undoes the distortion, by pixels from a middle of its own."""
    k1, k2, middle = 2.0e-7, -3e-13, np.array([319.0, 240.0]) if k3 else np.array([317.5, 243])
    angle, axis, centre = 0.8, np.array([2.0, -1, 2]) / 3, np.array([1500.0, -2800, 1200])
    turn = [*np.sin(angle / 2) * axis, np.cos(angle / 2)]
    given = {
        "k1": k1, "k2": k2, "turn": " ".join(map(str, turn)), "place": " ".join(map(str, centre)),
        "more": 'PIXEL_ASPECT_RATIO="1" SKEW="0" USERID="1"',
        "radial": f'VICON_RADIAL2="Vicon3Parameter 319 240 {k1} {k2} {k3}"' if k3 else "",
    }  # fmt: skip
    path = tmp_path / "a.xcp"
    path.write_text(VICON.format(**given))
    assert list(read_entries(path)) == ["2107343"]
    loaded = load_camera(path)
    camera = loaded.camera
    assert loaded.metric
    assert camera.image_size_wh == SIZE
    np.testing.assert_allclose(camera.K, [[600, 0, 317.5], [0, 600, 243], [0, 0, 1]])
    np.testing.assert_allclose(camera.centre_world, 0.001 * centre)
    a, b, c = axis
    cross = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    R = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    np.testing.assert_allclose(camera.R_camera_world, R, atol=1e-12)
    seen = np.array([[10.0, 20], [630, 40], [300, 470], [40, 400], [320, 240]])
    r2 = ((seen - middle) ** 2).sum(-1, keepdims=True)
    straight = middle + (seen - middle) * (1 + k1 * r2 + k2 * r2**2 + (k3 or 0) * r2**3)
    assert np.abs(straight - seen).max() > 5
    rays = np.column_stack([(straight - [317.5, 243]) / 600, np.ones(5)])
    points = torch.from_numpy((rays @ R) + 0.001 * centre)
    np.testing.assert_allclose(camera.project(points).uv, seen, atol=0.05)


@pytest.mark.parametrize("name", ["a.json", "a.toml"])
def test_a_unit_that_a_camera_says_itself(tmp_path: Path, name: str) -> None:
    camera = {"matrix": K, "size": SIZE, "rotation": [0, 0, 0], "translation": [0, 0, 3000],
              "units": "mm"}  # fmt: skip
    text = json.dumps({"a": camera})
    if name == "a.toml":
        lines = (f"{word} = {json.dumps(value)}" for word, value in camera.items())
        text = "\n".join(["[a]", *lines])
    (tmp_path / name).write_text(text)
    loaded = load_camera(tmp_path / name)
    assert loaded.metric
    assert loaded.camera.t_camera_world.tolist() == [0, 0, 3]


def test_a_film_called_by_its_cameras_serial_number(tmp_path: Path) -> None:
    given = {"k1": 0, "k2": 0, "turn": "0 0 0 1", "place": "0 0 0", "more": "", "radial": ""}
    text = VICON.format(**given)
    camera = text[text.index('<Camera DEVICEID="2107343"') : text.index('<Camera DEVICEID="7"')]
    other = camera.replace("2107343", "2107344").replace("600", "700")
    (tmp_path / "a.xcp").write_text(text.replace(camera, camera + other))
    for number, focal in (("2107343", 600), ("2107344", 700)):
        film = tmp_path / f"Walk01.{number}.20240102150405.avi"
        assert load_camera(tmp_path / "a.xcp", video=film).camera.K[0, 0] == focal


def test_vicon_cameras_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "a.xcp"
    given = {"k1": 1e-3, "k2": 0, "turn": "0 0 0 1", "place": "0 0 0", "more": "", "radial": ""}
    path.write_text(VICON.format(**given))
    with pytest.raises(CameraError, match="its distortion is no lens's"):
        load_camera(path)
    path.write_text(VICON.format(**{**given, "k1": 0, "turn": "none"}))
    with pytest.raises(CameraError, match="camera '2107343': not Vicon's"):
        load_camera(path)
    path.write_text("<Cameras><Camera DEVICEID='1'/></Cameras>")
    with pytest.raises(CameraError, match="no camera of these is calibrated"):
        load_camera(path)
    path.write_text("<!DOCTYPE a [<!ENTITY b 'c'>]><Cameras>&b;</Cameras>")
    with pytest.raises(CameraError, match=r"a\.xcp"):
        load_camera(path)


def test_numbers_that_yaml_takes_for_text(tmp_path: Path) -> None:
    """Other writers leave out the point, or what is before it."""
    text = yaml_matrix("camera_matrix", K, 3)
    path = tmp_path / "a.yml"
    path.write_text(OPENCV + text + "k1: 1e-05\nk2: -.25\np1: -2E-4\np2: 5.\n")
    found = load_camera(path).camera.distortion
    np.testing.assert_allclose(found, [1e-5, -0.25, -2e-4, 5, 0])


def test_a_folder_of_openposes(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="no calibration in this folder"):
        load_camera(tmp_path)
    for name in ("1", "2"):
        text = XML.replace("camera_matrix", "Intrinsics")
        text = text.replace("distortion_coefficients", "Distortion")
        (tmp_path / f"{name}.xml").write_text(text)
    assert set(read_cameras(tmp_path)) == {"1", "2"}


@pytest.mark.parametrize("key", ["dist_coefs", "distCoeffs", "Distortion_Coefficients", "kc"])
def test_coefficients_by_any_usual_name(tmp_path: Path, key: str) -> None:
    """Tutorials and versions spell them in many ways; a lens is never left out for it."""
    np.savez(tmp_path / "a.npz", mtx=K, image_size=SIZE, rvecs=np.zeros(3), **{key: [LENS]})
    check(tmp_path / "a.npz")
    content = {"Camera_Matrix": K, key: LENS, "image_Width": 640, "image_Height": 480}
    (tmp_path / "a.json").write_text(json.dumps(content))
    check(tmp_path / "a.json")


@pytest.mark.parametrize(
    "size",
    [{"imageSize": [640, 480]}, {"resolution": {"width": 640, "height": 480}}, {"cols": 640,
     "rows": 480}, {"image_shape": [480, 640, 3]}, {"resolution": "640x480"}],
)  # fmt: skip
def test_sizes_by_any_usual_name(tmp_path: Path, size: dict[str, Any]) -> None:
    cameras = [{"camera_id": name, "K": K, "dist": LENS, **size} for name in "ab"]
    (tmp_path / "a.json").write_text(json.dumps(cameras))
    check(tmp_path / "a.json", name="b")
    (tmp_path / "a.json").write_text(json.dumps([cameras[0]] * 2))
    with pytest.raises(CameraError, match="two cameras of one name"):
        load_camera(tmp_path / "a.json", "a")


@pytest.mark.parametrize(
    "model",
    [{"model": "fisheye"}, {"camera_model": "OPENCV_FISHEYE"}, {"distortion_type": "KannalaBrandt"},
     {"camera_model": "omni", "distortion_model": "radtan"}, {"fisheye_model": 1},
     {"distortion": {"model": "fisheye", "coefficients": [0.1, 0, 0, 0]}, "D": None},
     {"MappingCoefficients": [8e2, -1e-3, 1e-7, 1e-10]}],
)  # fmt: skip
def test_fisheye_by_any_usual_name(tmp_path: Path, model: dict[str, Any]) -> None:
    content = {"K": K, "D": LENS[:4], "width": 640, "height": 480, **model}
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(CameraError, match="fisheye"):
        load_camera(tmp_path / "a.json")


FISHEYE = (0.05, -0.01, 0.003, -0.0004)
K1_TO_K4 = {f"k{n}": value for n, value in enumerate(FISHEYE, start=1)}
FISHEYE_FILES: dict[str, tuple[str, Any]] = {
    "ROS": (
        "a.yaml",
        SIZES + yaml_matrix("camera_matrix", K, 3, "").replace("   dt: d\n", "")
        + yaml_matrix("distortion_coefficients", FISHEYE, 1, "").replace("   dt: d\n", "")
        + "distortion_model: equidistant\n",
    ),
    "Kalibr": (
        "camchain.yaml",
        f"cam0:\n  camera_model: pinhole\n  intrinsics: [{FX}, {FY}, {CX}, {CY}]\n"
        f"  distortion_model: equi\n  distortion_coeffs: {[*FISHEYE]}\n"
        "  resolution: [640, 480]\n",
    ),
    "COLMAP": (
        "cameras.txt",
        f"1 OPENCV_FISHEYE 640 480 {FX} {FY} {CX + 0.5} {CY + 0.5} "
        f"{' '.join(map(str, FISHEYE))}\n",
    ),
    "Anipose, FreeMoCap": (
        "calibration.toml",
        f"[cam_0]\nname = 'a'\nsize = [640, 480]\nmatrix = {K}\ndistortions = {[*FISHEYE]}\n"
        "rotation = [0.0, 0.0, 0.0]\ntranslation = [0.0, 0.0, 2.0]\nfisheye = true\n",
    ),
    "OpenCV's sample": (
        "a.yml",
        OPENCV + "fisheye_model: 1\n" + yaml_matrix("camera_matrix", K, 3)
        + yaml_matrix("distortion_coefficients", FISHEYE, 4),
    ),
    "Nerfstudio": (
        "transforms.json",
        {"camera_model": "OPENCV_FISHEYE", "fl_x": FX, "fl_y": FY, "cx": CX + 0.5,
         "cy": CY + 0.5, "w": 640, "h": 480, **K1_TO_K4},
    ),
    "RealSense T265": (
        "a.json",
        {"fx": FX, "fy": FY, "ppx": CX, "ppy": CY, "width": 640, "height": 480,
         "model": "distortion.kannala_brandt4", "coeffs": [*FISHEYE, 0.0]},
    ),
    "Metashape": (
        "a.xml",
        "<calibration><projection>fisheye</projection><width>640</width><height>480</height>"
        f"<f>{FY}</f><b1>{FX - FY}</b1><cx>{CX - 319.5}</cx><cy>{CY - 239.5}</cy>"
        + "".join(f"<{word}>{value}</{word}>" for word, value in K1_TO_K4.items())
        + "</calibration>",
    ),
    "ORB-SLAM": (
        "a.yaml",
        "%YAML:1.0\nCamera.type: 'KannalaBrandt8'\n" + "".join(
            f"Camera1.{word}: {value}\n"
            for word, value in {"fx": FX, "fy": FY, "cx": CX, "cy": CY, **K1_TO_K4}.items()
        ) + "Camera.width: 640\nCamera.height: 480\n",
    ),
    "camodocal, VINS": (
        "a.yaml",
        "%YAML:1.0\n---\nmodel_type: KANNALA_BRANDT\ncamera_name: a\n" + SIZES
        + "projection_parameters:\n" + "".join(f"   k{n + 2}: {k}\n" for n, k in enumerate(FISHEYE))
        + f"   mu: {FX}\n   mv: {FY}\n   u0: {CX}\n   v0: {CY}\n",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", FISHEYE_FILES)
def test_fisheye_lenses_by_the_formula_of_opencv(tmp_path: Path, kind: str) -> None:
    """Refused as cameras, with the command that makes pictures straight, which reads them."""
    name, content = FISHEYE_FILES[kind]
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(CameraError, match="fisheye lens is not supported: torchcss undistort"):
        load_camera(path)
    loaded, lens = load_lens(path)
    assert lens.is_fisheye
    np.testing.assert_allclose(lens.K, K)
    np.testing.assert_allclose(lens.coefficients, FISHEYE)
    assert not loaded.camera.has_distortion
    assert loaded.camera.image_size_wh == SIZE


INTRINSICS = {"fx": FX, "fy": FY, "cx": CX, "cy": CY}
PINHOLES = [FX, FY, CX, CY]
RADTAN, COEFFICIENTS = LENS[:4], ("k1", "k2", "p1", "p2")
MIRROR_FILES: dict[str, tuple[str, Any, Mirror, list[float]]] = {
    "Kalibr, omni": (
        "camchain.yaml",
        {"cam0": {"camera_model": "omni", "intrinsics": [1.2, *PINHOLES], "resolution": SIZE,
                  "distortion_model": "radtan", "distortion_coeffs": RADTAN}},
        Mirror("omni", (1.2,)), RADTAN,
    ),
    "Kalibr, ds": (
        "camchain.yaml",
        {"cam0": {"camera_model": "ds", "intrinsics": [-0.2, 0.6, *PINHOLES], "resolution": SIZE,
                  "distortion_model": "none", "distortion_coeffs": []}},
        Mirror("ds", (-0.2, 0.6)), [],
    ),
    "Kalibr, eucm": (
        "camchain.yaml",
        {"cam0": {"camera_model": "eucm", "intrinsics": [0.6, 1.1, *PINHOLES],
                  "distortion_model": "none", "distortion_coeffs": [], "resolution": SIZE}},
        Mirror("eucm", (0.6, 1.1)), [],
    ),
    "cv2.omnidir": (
        "a.yml",
        OPENCV + yaml_matrix("camera_matrix", K, 3) + yaml_matrix("xi", [1.2], 1)
        + yaml_matrix("distortion_coefficients", RADTAN, 1),
        Mirror("omni", (1.2,)), RADTAN,
    ),
    "camodocal": (
        "a.yaml",
        "%YAML:1.0\n---\nmodel_type: MEI\ncamera_name: a\n" + SIZES
        + "mirror_parameters:\n   xi: 1.2\ndistortion_parameters:\n"
        + "".join(f"   {n}: {v}\n" for n, v in zip(COEFFICIENTS, RADTAN, strict=True))
        + f"projection_parameters:\n   gamma1: {FX}\n   gamma2: {FY}\n   u0: {CX}\n   v0: {CY}\n",
        Mirror("omni", (1.2,)), RADTAN,
    ),
    "Basalt, ds": (
        "a.json",
        {"cameras": [{"name": "a", "camera_type": "ds", "resolution": SIZE,
                      "intrinsics": {**INTRINSICS, "xi": -0.2, "alpha": 0.6}}]},
        Mirror("ds", (-0.2, 0.6)), [],
    ),
    "Basalt, ucm": (
        "a.json",
        {"cameras": [{"name": "a", "camera_type": "ucm", "resolution": SIZE,
                      "intrinsics": {**INTRINSICS, "alpha": 0.6}}]},
        Mirror("eucm", (0.6, 1.0)), [],
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", MIRROR_FILES)
def test_omnidirectional_lenses(tmp_path: Path, kind: str) -> None:
    """As fisheye lenses: made straight, not tracked as they are."""
    name, content, mirror, coefficients = MIRROR_FILES[kind]
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    refusal = rf"an omnidirectional lens \({mirror.model}\) is not supported: torchcss undistort"
    with pytest.raises(CameraError, match=refusal):
        load_camera(path)
    loaded, lens = load_lens(path)
    assert (lens.mirror, lens.is_fisheye) == (mirror, False)
    np.testing.assert_allclose(lens.K, K)
    np.testing.assert_allclose(lens.coefficients[: len(coefficients)], coefficients)
    assert not np.any(lens.coefficients[len(coefficients) :])
    assert loaded.camera.image_size_wh == SIZE


@pytest.mark.parametrize("count", [5, 8, 12, 14])
def test_lenses_of_many_coefficients(tmp_path: Path, count: int) -> None:
    given = [*LENS, *0.01 * np.arange(1, 10)][:count]
    path = tmp_path / "a.yml"
    text = yaml_matrix("camera_matrix", K, 3) + yaml_matrix("distortion_coefficients", given, 1)
    path.write_text(OPENCV + text)
    assert load_lens(path)[1].coefficients == tuple(given)
    if count > 5:
        with pytest.raises(CameraError, match=f"of {count} coefficients.*torchcss undistort"):
            load_camera(path)
    path.write_text((OPENCV + text).replace(f"{given[-1]}]", ".nan]"))
    with pytest.raises(CameraError, match="distortion"):
        load_lens(path)


@pytest.mark.parametrize("model", ["FOV", "THIN_PRISM_FISHEYE"])
def test_a_camera_of_another_model_beside_one_that_is_read(tmp_path: Path, model: str) -> None:
    numbers = " ".join(["1"] * (5 if model == "FOV" else 12))
    (tmp_path / "cameras.txt").write_text(
        f"1 {model} 640 480 {numbers}\n2 PINHOLE 640 480 {FX} {FY} {CX + 0.5} {CY + 0.5}\n"
    )
    check(tmp_path, [0.0] * 5, name="2")
    with pytest.raises(CameraError, match="this model of a fisheye lens is not supported"):
        load_camera(tmp_path, "1")


@pytest.mark.parametrize(
    "model", ["omni", "ds", "eucm", "FOV", "THIN_PRISM_FISHEYE", "MEI", "Scaramuzza", "division"]
)
def test_lenses_of_other_models(tmp_path: Path, model: str) -> None:
    content = {"K": K, "D": LENS[:4], "width": 640, "height": 480, "camera_model": model}
    (tmp_path / "a.json").write_text(json.dumps(content))
    for read in (load_camera, load_lens):
        with pytest.raises(CameraError, match="this model of a fisheye lens is not supported"):
            read(tmp_path / "a.json")


def test_an_inverse_model_is_refused_unless_it_is_none(tmp_path: Path) -> None:
    content = {"fx": FX, "fy": FY, "ppx": CX, "ppy": CY, "width": 640, "height": 480,
               "model": "distortion.inverse_brown_conrady", "coeffs": [0, 0, 0, 0, 0]}  # fmt: skip
    (tmp_path / "a.json").write_text(json.dumps(content))
    check(tmp_path / "a.json", [0.0] * 5)
    (tmp_path / "a.json").write_text(json.dumps({**content, "coeffs": LENS}))
    with pytest.raises(CameraError, match="an inverse model of a lens is not supported"):
        load_camera(tmp_path / "a.json")


def test_a_folder_of_arrays(tmp_path: Path) -> None:
    np.save(tmp_path / "camera_matrix.npy", K)
    np.save(tmp_path / "dist_coeffs.npy", [LENS])
    np.save(tmp_path / "image_size.npy", SIZE)
    check(tmp_path)
    (tmp_path / "dist_coeffs.npy").write_text("x")
    with pytest.raises(CameraError, match=r"dist_coeffs\.npy: not an NPY file"):
        load_camera(tmp_path)


@pytest.mark.parametrize(
    "words", ["mtx_l dist_l mtx_r", "Kl Dl Kr", "K1 D1 K2", "K_left D_left K_right"]
)
def test_a_pair_beside_what_rectifies_it(tmp_path: Path, words: str) -> None:
    one, lens, other = words.split()
    arrays = {one: K, lens: [LENS], other: np.eye(3), "R": np.eye(3), "T": [[1], [0], [0]],
              "R1": np.eye(3), "R2": np.eye(3), "P1": np.ones((3, 4)), "P2": np.ones((3, 4)),
              "Q": np.eye(4), "imageSize": SIZE}  # fmt: skip
    np.savez(tmp_path / "a.npz", **{word: np.array(array) for word, array in arrays.items()})
    check(tmp_path / "a.npz", name=re.sub("^K_?|^mtx_", "", one))


def test_sides_of_a_pair(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", mtxL=K, distL=LENS, mtxR=K, distR=[0] * 5, imageSize=SIZE)
    check(tmp_path / "a.npz", name="L")


def test_a_message_of_ros_ends_by_a_line(tmp_path: Path) -> None:
    text = f"width: 640\nheight: 480\nk: {np.ravel(K).tolist()}\nd: {LENS}\n---\n"
    (tmp_path / "a.yaml").write_text(f"header: {{seq: 1}}\n{text}header: {{seq: 2}}\n{text}")
    check(tmp_path / "a.yaml")
    (tmp_path / "a.yaml").write_text(text + text.replace("640", "320"))
    with pytest.raises(CameraError, match="several cameras"):
        load_camera(tmp_path / "a.yaml")


def test_colmaps_folders_and_matrices_in_other_files(tmp_path: Path) -> None:
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(f"1 PINHOLE 640 480 {FX} {FY} {CX + 0.5} {CY + 0.5}\n")
    check(tmp_path, lens=[0.0] * 5)
    with VideoWriter(tmp_path / "a.mp4", 25) as film:
        film.write(np.zeros((480, 640, 3), np.uint8))
    np.save(tmp_path / "K.npy", K)
    (tmp_path / "K.csv").write_text("\n".join(",".join(map(str, row)) for row in K))
    for name in ("K.npy", "K.csv"):
        check(tmp_path / name, lens=[0.0] * 5, video=tmp_path / "a.mp4")


def test_pair_of_matlabs(tmp_path: Path) -> None:
    camera = {"K": np.add(K, [[0, 0, 1], [0, 0, 1], [0, 0, 0]]), "ImageSize": [480, 640],
              "RadialDistortion": [LENS[0], LENS[1], LENS[4]],
              "TangentialDistortion": LENS[2:4]}  # fmt: skip
    pair = {"CameraParameters1": camera, "CameraParameters2": camera}
    savemat(tmp_path / "a.mat", {"errors": {"mean": 0.3}, "stereoParams": pair})
    check(tmp_path / "a.mat", name="2")


PLACED = {"R": np.array(about(1, np.array(-0.5))).tolist(), "t": [0.2, -0.1, 2.5]}
PROJECTION = np.array(K) @ np.column_stack([PLACED["R"], PLACED["t"]])


def is_placed(path: Path, name: str | None = None) -> None:
    found = load_camera(path, name)
    assert found.metric
    np.testing.assert_allclose(found.camera.K, K, atol=1e-6)
    np.testing.assert_allclose(found.camera.R_camera_world, PLACED["R"], atol=1e-9)
    np.testing.assert_allclose(found.camera.t_camera_world, PLACED["t"], atol=1e-9)


@pytest.mark.parametrize("form", ["json", "vectors", "yml", "npz", "toml"])
def test_one_camera_with_its_place(tmp_path: Path, form: str) -> None:
    """Without a unit that is told, and used with one; places of the board are none."""
    suffix = form.replace("vectors", "json")
    path, turn = tmp_path / f"a.{suffix}", [0.0, -0.5, 0.0] if form == "vectors" else PLACED["R"]

    def save(**more: Any) -> None:
        values = {"K": K, "R": turn, "T": PLACED["t"], "image_size": [640, 480], **more}
        if suffix == "npz":
            np.savez(path, **{key: np.array(each) for key, each in values.items()})
        elif suffix == "json":
            path.write_text(json.dumps(values))
        else:
            lines = [f"{key}{'=' if form == 'toml' else ': '}{json.dumps(each)}\n"
                     for key, each in values.items()]  # fmt: skip
            path.write_text(("" if form == "toml" else "%YAML:1.0\n---\n") + "".join(lines))

    save()
    note = str(load_camera(path).units_note)
    assert 'has extrinsics of unknown unit (the file may say units: "mm"' in note
    save(units="m")
    is_placed(path)
    save(R=[turn] * 2, T=[PLACED["t"]] * 2, units="m")
    assert "no extrinsics" in str(load_camera(path).units_note)


@pytest.mark.parametrize("factor", [1.0, -0.37])
def test_projection_matrices_are_taken_apart(tmp_path: Path, factor: float) -> None:
    one = {"P": (factor * PROJECTION).tolist(), "image_size_wh": [640, 480]}
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"units": "m", "cameras": {"a": one, "b": {"x": 1}}}))
    is_placed(path, "a")
    path.write_text(json.dumps({"P": np.ones((3, 4)).tolist(), "image_size_wh": [640, 480]}))
    with pytest.raises(CameraError, match=r"a\.json: not a camera's projection matrix"):
        load_camera(path)


@pytest.mark.parametrize("form", ["4 x 4", "3 x 4", "in columns", "apart"])
def test_places_in_one_matrix(tmp_path: Path, form: str) -> None:
    pose = np.vstack([np.column_stack(list(PLACED.values())), [0, 0, 0, 1]])
    said: dict[str, Any] = {
        "4 x 4": {"extrinsics": pose.tolist()},
        "3 x 4": {"RT": pose[:3].tolist()},
        "in columns": {"extrinsic": pose.T.ravel().tolist()},
        "apart": {"extrinsics": {"rotation": PLACED["R"], "translation": PLACED["t"]}},
    }[form]
    K_by = np.ravel(np.transpose(K) if form == "in columns" else K).tolist()
    one = {"intrinsic": {"width": 640, "height": 480, "intrinsic_matrix": K_by}, **said}
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"units": "m", "cameras": {"a": one}}))
    is_placed(path)


def rows(matrix: Any) -> str:
    return "\n".join(" ".join(map(str, row)) for row in np.asarray(matrix).tolist())


@pytest.mark.parametrize(
    ("text", "name"),
    [
        (rows(PROJECTION), None),
        ("CONTOUR\n" + rows(PROJECTION), None),
        ("".join(f"P{i}: {' '.join(map(str, PROJECTION.ravel()))}\n" for i in range(3))
         + "R0_rect: 1 0 0 0 1 0 0 0 1\n", "2"),
        (f"calib_time: 09-Jan-2012 13:57:47\nK_02: {' '.join(map(str, np.ravel(K)))}\n"
         "D_02: 0 0 0 0 0\nP_rect_02: 7 0 6 0 0 7 2 0 0 0 1 0\n", "02"),
        (f"# oST version 5.0 parameters\n[image]\n\nwidth\n640\n\nheight\n480\n\n[left/cam]\n\n"
         f"camera matrix\n{rows(K)}\n\ndistortion\n0 0 0 0 0\n\nprojection\n7 0 6 0\n0 7 2 0\n"
         "0 0 1 0\n", None),
    ],
)  # fmt: skip
def test_numbers_as_text(tmp_path: Path, text: str, name: str | None) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(text)
    entry = read_entries(path)[name or "calib"]
    np.testing.assert_allclose(np.reshape(entry.K, (3, 3)), K, atol=1e-6)
    assert (entry.rotation is None) == ("K_" in text or "camera matrix" in text)  # else P says it
    assert entry.rotation is None or entry.units is None
    assert entry.image_size_wh == ([640, 480] if "width" in text else None)


@pytest.mark.parametrize("form", ["beside", "below", "prefix", "VINS", "ones of a fisheye lens"])
def test_cameras_wherever_they_stand(tmp_path: Path, form: str) -> None:
    single = dict(zip(("fx", "fy", "cx", "cy"), (FX, FY, CX, CY), strict=True))
    size, path = {"image_width": 640, "image_height": 480}, tmp_path / "a.yaml"
    content: dict[str, Any] = {
        "beside": {"version": "1", "a": {"resolution": [640, 480], "intrinsics": single}},
        "below": {"n": 1, "params": {"a": {"K_mx": K, "img_w": 640, "img_h": 480}}, "notes": [1]},
        "prefix": {f"Camera.{k}": v for k, v in {**single, "width": 640, "height": 480}.items()},
        "VINS": {"model_type": "PINHOLE", **size, "projection_parameters": single},
        "ones of a fisheye lens": {"fisheye_params": {"camera_matrix": K, **size}},
    }[form]
    path.write_text(json.dumps(content))
    if form == "ones of a fisheye lens":
        with pytest.raises(CameraError, match="fisheye"):
            load_camera(path)
    else:
        check(path, [0.0] * 5)


POSE = np.linalg.solve(np.array(K), PROJECTION)


@pytest.mark.parametrize("form", ["npz", "stack", "npy", "json", "numbered", "txt", "folder", "K"])
def test_matrices_of_several_cameras(tmp_path: Path, form: str) -> None:
    stack, name = np.stack([PROJECTION, -3 * PROJECTION]), "1"
    path = tmp_path / "a.npz"
    if form == "npz":
        np.savez(path, left=stack[0], right=stack[1], image_size=np.array(SIZE))
        name = "right"
    elif form == "stack":
        np.savez(path, P=stack, units="m", image_size=np.array(SIZE))
    elif form == "npy":
        path = tmp_path / "a.npy"
        np.save(path, stack)
    elif form == "json":
        path, name = tmp_path / "a.json", "cam1"
        path.write_text(json.dumps({"cam0": stack[0].tolist(), "cam1": stack[1].tolist()}))
    elif form == "numbered":
        np.savez(path, P0=stack[0], P1=stack[1])
    elif form == "K":
        R, t = np.stack(2 * [POSE[:, :3]]), np.stack(2 * [POSE[:, 3]])
        np.savez(path, K=np.array([K, K]), dist=np.array([LENS, LENS]), R=R, t=t, units="m",
                 names=np.array(["a", "b"]), image_size=np.array(SIZE))  # fmt: skip
        name = "b"
    else:
        path, name = tmp_path / "all", "view1"
        path.mkdir()
        for index, matrix in enumerate(stack):
            if form == "txt":
                (path / f"view{index}.txt").write_text(rows(matrix))
            else:
                np.savez(path / f"view{index}.npz", proj=matrix)
    assert len(read_entries(path)) == 2
    entry = read_entries(path)[name]
    np.testing.assert_allclose(entry.K, K, atol=1e-9)
    np.testing.assert_allclose(entry.rotation, POSE[:, :3], atol=1e-12)
    np.testing.assert_allclose(entry.translation, POSE[:, 3], atol=1e-12)
    assert entry.units == ("m" if form in ("stack", "K") else None)
    assert entry.image_size_wh == (list(SIZE) if form in ("npz", "stack", "K") else None)
    if form in ("stack", "K"):
        assert load_camera(path, name).metric


def test_a_folder_of_a_file_for_each_camera(tmp_path: Path) -> None:
    for name in ("left", "right"):
        text = FILES["ROS"][1].replace("camera_name: left", "camera_name: narrow_stereo")
        (tmp_path / f"{name}.yaml").write_text(text)
    assert list(read_entries(tmp_path)) == ["narrow_stereo", "right/narrow_stereo"]


@pytest.mark.parametrize(
    "form", ["words", "Human3.6M", "VideoPose3D", "order", "by name", "objects", "data", "told"]
)
def test_coefficients_in_other_orders(tmp_path: Path, form: str) -> None:
    k1, k2, p1, p2, k3 = LENS
    parts = {"radial_distortion": [k1, k2, k3], "tangential_distortion": [p1, p2]}
    size = {"width": 640, "height": 480}
    content: dict[str, Any] = {
        "words": {"camera_matrix": K, **parts, **size},
        "Human3.6M": {"f": [FX, FY], "c": [CX, CY], "k": [k1, k2, k3], "p": [p1, p2], **size},
        "VideoPose3D": {"focal_length": [FX, FY], "center": [CX, CY], **parts, "res_w": 640,
                        "res_h": 480},
        "order": {"K": K, "distortion_order": ["k1", "k2", "k3", "p1", "p2"],
                  "distortion": [k1, k2, k3, p1, p2], **size},
        "objects": {"camera_matrix": {"fx": FX, "fy": FY, "cx": CX, "cy": CY}, "image_size": size,
                    "distortion": {"model": "brown-conrady", "coefficients": LENS},
                    "board": {"rows": 5, "cols": 8}},
        "data": {"camera_matrix": {"data": np.ravel(K).tolist()}, **size,
                 "distortion_coefficients": {"data": LENS}},
        "told": {"distortion_direction": "from rays to pixels", "distortion_model": "plumb_bob",
                 "camera_matrix": K, "distortion_coefficients": LENS, **size},
        "by name": {"K": K, "dist": {"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2}, **size},
    }[form]  # fmt: skip
    (tmp_path / "a.json").write_text(json.dumps(content))
    check(tmp_path / "a.json")


@pytest.mark.parametrize("lens", [{"rows": 1, "cols": 5, "data": LENS[:4]}, "0.1, 0.2", "[1 2]"])
def test_coefficients_that_are_none_are_not_passed_over(tmp_path: Path, lens: Any) -> None:
    content = {"camera_matrix": K, "dist": lens, "width": 640, "height": 480}
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(CameraError, match="distortion: expected numbers"):
        load_camera(tmp_path / "a.json")


def test_metashape_counts_from_the_middle(tmp_path: Path) -> None:
    k1, k2, p1, p2, k3 = LENS
    path = tmp_path / "a.xml"
    values = {"projection": "frame", "width": 640, "height": 480, "f": FY, "cx": CX - 319.5,
              "cy": CY - 239.5, "b1": FX - FY, "k1": k1, "k2": k2, "k3": k3, "p1": p2, "p2": p1,
              "date": "2024-05-03T10:15:30Z"}  # fmt: skip
    inner = "".join(f"<{word}>{value}</{word}>" for word, value in values.items())
    path.write_text(f"<calibration>{inner}</calibration>")
    check(path)
    path.write_text(f"<calibration>{inner.replace('frame', 'fisheye')}</calibration>")
    with pytest.raises(CameraError, match="fisheye"):
        load_camera(path)


@pytest.mark.parametrize("name", ["a.xml", "transforms.json"])
def test_a_radius_to_the_eighth_power(tmp_path: Path, name: str) -> None:
    """k4 of Metashape and Nerfstudio is not OpenCV's, which divides by it."""
    values = {"f": FY, "fl_x": FX, "fl_y": FY, "cx": 1, "cy": 2, "width": 640, "height": 480,
              "w": 640, "h": 480, "k1": 0.1, "k2": 0.0, "k3": 0.0, "k4": 0.3}  # fmt: skip
    inner = "".join(f"<{word}>{value}</{word}>" for word, value in values.items())
    xml = f"<calibration>{inner}</calibration>"
    (tmp_path / name).write_text(xml if name == "a.xml" else json.dumps(values))
    for load in (load_camera, load_lens):
        with pytest.raises(CameraError, match=f"{name}: .*k4 without k5 and k6"):
            load(tmp_path / name)


def test_what_a_camera_file_leaves_open_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text(table("cam_0", [0.0, 0.0, 2.0], "rotation_count = 2"))
    assert "rotation_count 2), its numbers are those of the pictures as recorded" in str(
        load_camera(path).units_note
    )
    path = tmp_path / "a.npz"
    np.savez(path, K=K, D=np.array([[0.02], [-0.01], [0.003], [-0.0004]]), size=np.array(SIZE))
    note = str(load_camera(path).units_note)
    assert "no extrinsics" in note
    assert "as cv2.fisheye writes them" in note


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("results-cam.txt", "Camera-system parameters:\ncam0 (/a):\n", "give the camchain.yaml"),
        ("a.qca.txt", "<calibration/>", "motion capture system; save it as Pose2Sim's"),
        ("a.pickle", "x", "a pickle, from which code may run"),
        ("a.p", "x", "a pickle, from which code may run"),
        ("a.yaml", "a: [" + "1, " * 2**21 + "1]", "more than 4,194,304 bytes; not a calibration"),
        ("a.xml", "<document><chunk/></document>", "save each camera's calibration"),
        ("a.sfm", "{}", "Meshroom's; give K"),
        ("dlt.csv", "1.5,2\n" * 11, "11 coefficients of a DLT"),
        ("dlt.txt", "1.5 " * 11, "11 coefficients of a DLT"),
        ("a.csv", "a,b\n1,2\n", "numbers below their names .* found 2 rows such as 'a,b'"),
        ("a.csv", "#name,x,y,alt,heading,pitch,roll,f\n1.jpg,1,2,3,4,5,6,35\n", "RealityCapture's"),
        ("a.xmp", "<x xmlns:xcr='http://www.capturingreality.com/'/>", "RealityCapture's; give K"),
        ("a.json", '{"sfm_data_version": "0.3", "intrinsics": []}', "openMVG's; give K"),
    ],
)
def test_calibrations_of_other_kinds(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CameraError, match=words):
        load_camera(tmp_path / name)

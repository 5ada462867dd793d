"""Whatever a file holds, its reader gives a value or one typed error that names the file.

Every reader gets a valid file, damaged: bytes flipped, cut off, inserted, taken out, numbers
exchanged for such as nobody expects, another format's file under this name, arbitrary bytes, a
folder in place of the file.
"""

from __future__ import annotations

import json
import pickle
import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from common.flow_files import read_flow, write_flow
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from made_tracks import make_track
from scipy.io import savemat

from torchcss.body.files.mesh import mesh_points
from torchcss.body.load import load_body
from torchcss.errors import TorchcssError, TrackFileError
from torchcss.inference.mixture import GaussianMixture
from torchcss.initialise.result import Initialisation
from torchcss.io.calibrations.read import read_entries
from torchcss.io.cameras import load_lens, read_camera, read_cameras
from torchcss.io.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from torchcss.io.fitted_body import read_fitted_body, write_fitted_body
from torchcss.io.keypoints.one_image import read_joints
from torchcss.io.keypoints.read import read_keypoints
from torchcss.io.motion.positions import read_motion_capture
from torchcss.io.tracks import load_track, read_summary, save_track, write_summary
from torchcss.io.video import VideoReader, VideoWriter
from torchcss.studies.sequences import read_sequence
from torchcss.vision.camera import Camera

SIZE = (64, 48)
T = 3

BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT LeftUpLeg
  {
    OFFSET 10 -5 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 -80 0
    }
  }
  JOINT Spine
  {
    OFFSET 0 50 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 30 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.04
0 90 0 0 0 0  5 10 0  0 20 0
3 91 0 9 8 7  5 40 0  0 70 0
"""
ASF = """:version 1.10
:units
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name leg
    direction 0 -1 0
    length 12
    axis 0 0 20 XYZ
    dof rx rz
  end
  begin
    id 2
    name trunk
    direction 0 1 0
    length 12
    axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root leg trunk
  end
"""
AMC = ":FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 9 0 1 2 3\nleg 5 6\n2\nroot 0 9 1 1 2 4\nleg 6 6\n"
URDF = """<?xml version="1.0"?>
<robot name="r"><link name="a"><visual><origin xyz="0 0 .1" rpy="0 1 0"/>
<geometry><cylinder radius=".05" length=".4"/></geometry></visual></link><link name="b"/>
<link name="c"/><joint name="j" type="revolute"><parent link="a"/><child link="b"/>
<origin xyz="0 .1 .3" rpy="1 0 0"/><axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint>
<joint name="k" type="prismatic"><parent link="b"/><child link="c"/><origin xyz="0 0 .5"/>
<axis xyz="0 1 0"/><limit lower="0" upper=".2"/><mimic joint="j" multiplier="2"/></joint></robot>
"""
MJCF = """<mujoco><compiler angle="degree"/><default><geom type="capsule"/></default><worldbody>
<body name="a" pos="0 0 1" euler="10 0 0"><freejoint/><geom fromto="0 0 0 0 0 .4" size=".05"/>
<body name="b" pos="0 0 .4" quat="1 0 1 0"><joint axis="0 1 0" range="-60 30" pos="0 0 .1"/>
<geom size=".05 .1" pos="0 0 .2"/><body pos="0 0 .4"><joint type="ball" range="0 50"/></body>
</body></body></worldbody></mujoco>
"""
COLLADA = """<COLLADA><asset><unit meter="0.01"/></asset><library_geometries><geometry id="g"><mesh>
<source id="p"><float_array>-5 -3 0 5 3 0 0 0 40</float_array></source>
<vertices><input semantic="POSITION" source="#p"/></vertices></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene><node><matrix>1 0 0 2 0 1 0 0 0 0 1 0 0 0 0 1</matrix>
<rotate>0 2 0 90</rotate><scale>1 2 1</scale><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes></COLLADA>
"""
INTRI = """%YAML:1.0
---
names:
   - "a"
K_a: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 60., 0., 32., 0., 60., 24., 0., 0., 1. ]
dist_a: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0.1, 0., 0., 0., 0. ]
H_a: 48
W_a: 64
"""
TOML = """[a]
name = "a"
size = [64.0, 48.0]
matrix = [[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]]
distortions = [0.1, 0.0, 0.0, 0.0]
rotation = [1.0, 0.2, 0.1]
translation = [0.0, 1.0, 3.0]
"""


CAMERA_MATRIX = """camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 60., 0., 32., 0., 60., 24., 0., 0., 1. ]
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [60.0, 60.0, 32.0, 24.0]
  resolution: [64, 48]
"""


class Reader(NamedTuple):
    """A file of the folder, and what reads it there."""

    name: str
    read: Callable[[Path], object]
    slow: bool = False


def keypoints(path: Path) -> object:
    return read_keypoints(path, image_size_wh=SIZE, num_frames=None)


def joints(path: Path) -> object:
    return read_joints(path, image_size_wh=SIZE)


def pictures(path: Path) -> object:
    return [frame.image.sum() for frame in VideoReader(path)]


def beside(reader: Callable[[Path], object]) -> Callable[[Path], object]:
    """Reads the folder in which the file is."""
    return lambda path: reader(path.parent)


def checkpoint(path: Path) -> Checkpoint:
    if (found := read_checkpoint(path.parent)) is None:
        raise TrackFileError(f"{path}: there is none, which a run may be told")
    return found


READERS = (
    Reader("keypoints.npz", keypoints),
    Reader("coco.json", keypoints),
    Reader("clicked.json", keypoints),
    Reader("mediapipe.json", keypoints),
    Reader("mediapipe.npy", keypoints),
    Reader("mediapipe.csv", keypoints),
    Reader("deeplabcut.csv", keypoints),
    Reader("h36m.npz", keypoints),
    Reader("openpose/0_keypoints.json", beside(keypoints)),
    Reader("labels/a_1.txt", beside(keypoints)),
    Reader("labelme/0.json", beside(keypoints)),
    Reader("mmpose.json", keypoints),
    Reader("openpifpaf.json", keypoints),
    Reader("vitpose.json", keypoints),
    Reader("ultralytics.json", keypoints),
    Reader("annotations.json", keypoints),
    Reader("pandas.json", keypoints),
    Reader("via.json", keypoints),
    Reader("via3.json", keypoints),
    Reader("labelstudio.json", keypoints),
    Reader("cells.csv", keypoints),
    Reader("times.csv", keypoints),
    Reader("triples.npy", keypoints),
    Reader("sleap.csv", keypoints),
    Reader("sleap.analysis.h5", keypoints),
    Reader("deeplabcut.h5", keypoints),
    Reader("clicked.json", joints),
    Reader("joints.csv", joints),
    Reader("cameras.json", read_camera),
    Reader("calib.toml", read_camera),
    Reader("easymocap/intri.yml", beside(read_camera)),
    Reader("opencv.yml", read_camera),
    Reader("kalibr.yaml", read_camera),
    Reader("cameras.txt", read_camera),
    Reader("opencv.xml", read_camera),
    Reader("metashape.xml", read_camera),
    Reader("camera.npz", read_camera),
    Reader("several.npz", lambda path: read_camera(path, "1")),
    Reader("named.json", lambda path: read_camera(path, "b")),
    Reader("matrices/0.txt", beside(read_entries)),
    Reader("colmap/images.txt", beside(read_cameras)),
    Reader("colmap_bin/images.bin", beside(read_cameras)),
    Reader("transforms.json", read_cameras),
    Reader("a.qca.txt", read_camera),
    Reader("fisheye.toml", load_lens),
    Reader("camera.mat", read_camera),
    Reader("motion.bvh", read_motion_capture),
    Reader("motion.amc", read_motion_capture),
    Reader("motion.asf", lambda path: read_motion_capture(path.with_suffix(".amc"))),
    Reader("motion.bvh", load_body),
    Reader("robot.urdf", load_body),
    Reader("a.dae", mesh_points),
    Reader("robot.xml", load_body),
    Reader("a.flo", read_flow),
    Reader("track.npz", load_track),
    Reader("checkpoint.npz", checkpoint),
    Reader("summary.json", read_summary),
    Reader("body.npz", read_fitted_body, slow=True),
    Reader("film.mp4", pictures, slow=True),
    Reader("images/1.png", beside(pictures)),
    Reader("sequence/keypoints2d.npz", beside(read_sequence), slow=True),
    Reader("sequence/reference3d.npz", beside(read_sequence), slow=True),
    Reader("sequence/truth.npz", beside(read_sequence), slow=True),
    Reader("sequence/mask.npz", beside(read_sequence), slow=True),
)


def person(num_joints: int) -> np.ndarray:
    """`[t j 3]`."""
    source = np.random.default_rng(num_joints)
    places = source.uniform((12, 8), (50, 40), (num_joints, 2)) + np.arange(T)[:, None, None]
    return np.concatenate([places, np.full((T, num_joints, 1), 0.9)], axis=-1)


def landmark_rows() -> np.ndarray:
    values = person(33)
    return np.concatenate([values[..., :2] / SIZE, np.zeros((T, 33, 1)), values[..., 2:]], axis=-1)


def write_keypoints(folder: Path, marks: np.ndarray) -> None:
    """Files of detectors and annotation tools."""
    for name in ("labels", "labelme"):
        (folder / name).mkdir()
    names = [f"left_{place}" for place in ("hip", "knee", "wrist")]
    for t, frame in enumerate(marks):
        words = " ".join(f"{v:.4f}" for v in (frame / (*SIZE, 1)).flat)
        (folder / "labels" / f"a_{t + 1}.txt").write_text(f"0 .5 .5 .2 .8 {words}\n")
        shapes = [{"label": name, "points": [row[:2]], "shape_type": "point"}
                  for name, row in zip(names, frame.tolist(), strict=False)]  # fmt: skip
        (folder / "labelme" / f"{t}.json").write_text(json.dumps({"shapes": shapes}))
    frames = [{"keypoints": f[:, :2].tolist(), "keypoint_scores": f[:, 2].tolist()} for f in marks]
    x = [{"keypoints": dict(zip(("x", "y", "visible"), f.T.tolist(), strict=True))} for f in marks]
    annotations = [{"image_id": t, "keypoints": f.ravel().tolist()} for t, f in enumerate(marks)]
    images = [{"id": t, "file_name": f"{t}.png", "width": 64, "height": 48} for t in range(T)]
    skeleton = {str(i): name for i, name in enumerate(names)}
    named = [dict(zip(names, f[:3, :2].tolist(), strict=True)) for f in marks]
    heading = [f"{name}_{end}" for name in names for end in ("x", "y", "score")]
    contents: dict[str, Any] = {
        "mmpose": [{"frame_id": t, "instances": [frame]} for t, frame in enumerate(frames)],
        "vitpose": {"keypoints": [{"0": f[:3, [1, 0, 2]].tolist()} for f in marks],
                    "skeleton": skeleton},
        "ultralytics": [[frame] for frame in x],
        "annotations": {"images": images, "annotations": annotations},
        "pandas": {"columns": heading, "index": [*range(T)],
                   "data": [f[:3].ravel().tolist() for f in marks]},
        "via": {f"{t}.png": {"filename": f"{t}.png", "regions": [
            {"shape_attributes": {"name": "point", "cx": u, "cy": v},
             "region_attributes": {"joint": name}} for name, (u, v) in each.items()]}
             for t, each in enumerate(named)},
        "via3": {
            "attribute": {"1": {"aname": "joint", "options": skeleton}},
            "file": {f"{t}": {"fid": t, "fname": f"{t}.png"} for t in range(T)},
            "view": {f"{t}": {"fid_list": [t]} for t in range(T)},
            "metadata": {f"{t}_{i}": {"vid": f"{t}", "z": [], "xy": [1, *uv], "av": {"1": f"{i}"}}
                         for t, each in enumerate(named) for i, uv in enumerate(each.values())},
        },
        "labelstudio": [{"data": {"image": f"{t}.png"}, "annotations": [{"result": [
            {"type": "keypointlabels", "original_width": 64, "original_height": 48,
             "value": {"x": u / 0.64, "y": v / 0.48, "keypointlabels": [name]}}
             for name, (u, v) in each.items()]}]} for t, each in enumerate(named)],
    }  # fmt: skip
    for name, content in contents.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    lines = [json.dumps({"frame": t + 1, "predictions": [{"keypoints": f.ravel().tolist()}]})
             for t, f in enumerate(marks)]  # fmt: skip
    (folder / "openpifpaf.json").write_text("\n".join(lines))
    np.save(folder / "triples.npy", marks)
    heading = ",".join(f"{name}.{end}" for name in names for end in ("x", "y", "score"))
    rows = [f"a,{t},0.9,{','.join(map(str, f[:3].flat))}" for t, f in enumerate(marks)]
    (folder / "sleap.csv").write_text(
        "\n".join([f"track,frame_idx,instance.score,{heading}", *rows])
    )
    cells = [f'{t},"{each["keypoints"]}"' for t, each in enumerate(x)]
    (folder / "cells.csv").write_text("\n".join(["frame,keypoints", *cells]))
    codes = [f"00:00:00.{40 * t:03d},{','.join(map(str, f[:3].flat))}" for t, f in enumerate(marks)]
    (folder / "times.csv").write_text("\n".join([f"timestamp,{heading}", *codes]))
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "sleap.analysis.h5", "w") as file:
        file["tracks"] = marks[None, ..., :2].transpose(0, 3, 2, 1)
        file["point_scores"] = marks[None, ..., 2].transpose(0, 2, 1)
        file["node_names"] = np.array([f"joint{i}" for i in range(14)] + names, "S")
    columns = [("net", name, kind) for name in names for kind in ("x", "y", "likelihood")]
    with h5py.File(folder / "deeplabcut.h5", "w") as file:
        table = np.zeros(T, [("index", "i8"), ("values_block_0", "f8", 9)])
        table["index"], table["values_block_0"] = np.arange(T), marks[:, :3].reshape(T, 9)
        group = file.create_group("df")
        group["table"] = table
        group.attrs["non_index_axes"] = np.bytes_(pickle.dumps([(1, columns)], protocol=0))


def write_calibrations(folder: Path) -> None:
    """Cameras of other programs."""
    K = [[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]]
    sizes = "%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\n"
    (folder / "opencv.yml").write_text(sizes + CAMERA_MATRIX)
    (folder / "kalibr.yaml").write_text(KALIBR)
    (folder / "cameras.txt").write_text("# Cameras\n1 PINHOLE 64 48 60 60 32 24\n")
    (folder / "opencv.xml").write_text(
        "<opencv_storage><image_width>64</image_width><image_height>48</image_height>"
        "<camera_matrix type_id='opencv-matrix'><rows>3</rows><cols>3</cols><data>"
        f"{' '.join(map(str, np.ravel(K)))}</data></camera_matrix></opencv_storage>"
    )
    np.savez(folder / "camera.npz", mtx=np.array(K), dist=np.zeros((1, 5)), size=np.array(SIZE))
    (folder / "metashape.xml").write_text(
        "<calibration><projection>frame</projection><width>64</width><height>48</height><f>60</f>"
        "<cx>0.5</cx><cy>-0.5</cy><k1>0.1</k1><p1>0.01</p1></calibration>"
    )
    P = np.column_stack([K, [1.0, 2.0, 3.0]])
    size = np.array(SIZE)
    np.savez(folder / "several.npz", K=np.array([K, K]), dist=np.zeros((2, 5)), image_size=size)
    (folder / "named.json").write_text(
        json.dumps({"a": P.tolist(), "b": P.tolist(), "image_size": SIZE})
    )
    (folder / "colmap").mkdir()
    (folder / "colmap" / "cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24\n")
    (folder / "colmap" / "images.txt").write_text("# units: m\n3 1 0 0 0 1 2 3 1 a.jpg\n1 2 -1\n")
    (folder / "colmap_bin").mkdir()
    camera = struct.pack("<QiiQQ4d", 1, 1, 1, 64, 48, 60, 60, 32, 24)
    (folder / "colmap_bin" / "cameras.bin").write_bytes(camera)
    image = struct.pack("<QI7dI", 1, 3, 1, 0, 0, 0, 1, 2, 3, 1) + b"a.jpg\0"
    image += struct.pack("<Q2dq", 1, 1.0, 2.0, -1)
    (folder / "colmap_bin" / "images.bin").write_bytes(image)
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    numbers = {"fl_x": 60, "fl_y": 60, "cx": 32, "cy": 24, "w": 64, "h": 48}
    (folder / "transforms.json").write_text(json.dumps({**numbers, "frames": [frame]}))
    turn = " ".join(f'r{i}{j}="{int(i == j)}"' for i in range(1, 4) for j in range(1, 4))
    (folder / "a.qca.txt").write_text(
        '<calibration><cameras><camera serial="7" model="Miqus Video">'
        f'<transform x="1" y="2" z="3" {turn}/>'
        '<intrinsic sensorMaxU="4095" sensorMaxV="3071" focalLengthU="3840" '
        'focalLengthV="3840" centerPointU="2048" centerPointV="1536"/></camera></cameras>'
        "</calibration>"
    )
    (folder / "fisheye.toml").write_text(
        f"[cam_0]\nname = 'a'\nsize = [64, 48]\nmatrix = {K}\nfisheye = true\n"
        "distortions = [0.05, -0.01, 0.003, -0.0004]\nrotation = [0.0, 0.0, 0.0]\n"
        "translation = [0.0, 0.0, 2.0]\n"
    )
    (folder / "matrices").mkdir()
    np.savetxt(folder / "matrices" / "0.txt", P)
    savemat(folder / "camera.mat", {"K": np.array(K), "ImageSize": SIZE[::-1]}, do_compression=True)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a valid file for every reader."""
    folder = tmp_path_factory.mktemp("good")
    body = load_body("arm7")
    marks = person(17)
    np.savez(folder / "keypoints.npz", keypoints=marks[..., :2], confidence=marks[..., 2])
    rows = [{"image_id": t, "keypoints": frame.ravel().tolist()} for t, frame in enumerate(marks)]
    (folder / "coco.json").write_text(json.dumps(rows))
    clicked = {"joints": {"l_wrist": [3, 4], "l_elbow": [50, 40, 0.5]}}
    (folder / "clicked.json").write_text(json.dumps(clicked))
    keys = ("x", "y", "z", "visibility")
    poses = [[dict(zip(keys, row, strict=True)) for row in t] for t in landmark_rows().tolist()]
    (folder / "mediapipe.json").write_text(json.dumps([{"frame": 0, "landmarks": poses[0]}]))
    np.save(folder / "mediapipe.npy", landmark_rows())
    heading = ",".join(f"x{i},y{i},z{i},v{i}" for i in range(1, 34))
    table = [",".join(f"{v:.4f}" for v in row) for row in landmark_rows().reshape(T, -1)]
    (folder / "mediapipe.csv").write_text("\n".join([heading, *table]))
    (folder / "deeplabcut.csv").write_text(
        "scorer,a,a,a,a,a,a\nindividuals,i,i,i,j,j,j\nbodyparts,nose,nose,nose,nose,nose,nose\n"
        "coords,x,y,likelihood,x,y,likelihood\n0,20,30,0.9,3,4,0.8\n1,21,30,0.9,,,\n"
    )
    recordings = {"S1": {"Walking": [marks[..., :2]]}}
    np.savez(
        folder / "h36m.npz",
        positions_2d=np.array(recordings, dtype=object),
        metadata=np.array({"layout_name": "h36m"}, dtype=object),
    )
    write_keypoints(folder, marks)
    write_calibrations(folder)
    (folder / "openpose").mkdir()
    for t, frame in enumerate(marks):
        content = {"people": [{"pose_keypoints_2d": frame.ravel().tolist()}]}
        (folder / "openpose" / f"{t}_keypoints.json").write_text(json.dumps(content))
    (folder / "joints.csv").write_text("joint,u,v\nl_wrist,3,4\nl_elbow,20,30,0.5\n")
    camera = Camera.pinhole(*SIZE, focal_px=60.0)
    entry = {"K": camera.K.tolist(), "image_size_wh": list(SIZE), "distortion": [0.1, 0, 0, 0, 0],
             "R": np.eye(3).tolist(), "t": [0, 0, 1]}  # fmt: skip
    calibration = json.dumps({"units": "metre", "cameras": {"cam01": entry}})
    (folder / "cameras.json").write_text(calibration)
    (folder / "calib.toml").write_text(TOML)
    (folder / "easymocap").mkdir()
    (folder / "easymocap" / "intri.yml").write_text(INTRI)
    for name, text in (("bvh", BVH), ("asf", ASF), ("amc", AMC)):
        (folder / f"motion.{name}").write_text(text)
    (folder / "robot.urdf").write_text(URDF)
    (folder / "robot.xml").write_text(MJCF)
    (folder / "a.dae").write_text(COLLADA)
    write_flow(folder / "a.flo", torch.randn(2, 4, 5, generator=torch.Generator().manual_seed(0)))
    save_track(folder / "track.npz", make_track(body, (2, 1, 2)))
    write_checkpoint(folder, Checkpoint(2, {"a": torch.zeros(3), "b": torch.tensor(1)}))
    write_summary(folder / "summary.json", {"a": 1.5, "b": [1, 2]})
    x = body.rest[None]
    mixture = GaussianMixture(x, 0.01 * torch.eye(7).double()[None], torch.zeros(1).double())
    found = Initialisation(body, mixture, torch.zeros(1).double(), (), dict(body.lengths))
    write_fitted_body(folder / "body.npz", found, camera)
    images = np.random.default_rng(0).integers(0, 255, (T, *SIZE[::-1], 3), np.uint8)
    (folder / "images").mkdir()
    for film in (folder / "film.mp4", folder / "sequence" / "video.mp4"):
        film.parent.mkdir(exist_ok=True)
        with VideoWriter(film, 25) as writer:
            for image in images:
                writer.write(image)
    from PIL import Image

    for t, image in enumerate(images):
        Image.fromarray(image).save(folder / "images" / f"{t}.png")
    sequence = folder / "sequence"
    (sequence / "cameras.json").write_text(calibration)
    shutil.copy(folder / "keypoints.npz", sequence / "keypoints2d.npz")
    names = np.array(body.joint_names)
    np.savez(sequence / "reference3d.npz", joints=np.zeros((T, len(names), 3)), joint_names=names)
    np.savez(sequence / "mask.npz", mask=np.zeros((T, *SIZE[::-1]), bool))
    np.savez(
        sequence / "truth.npz", body=np.array(body.name), lengths=np.array("{}"),
        base_transform=np.eye(4), state_names=np.array(body.state_names), states=np.zeros((T, 7)),
    )  # fmt: skip
    return folder


NUMBERS = [
    "nan",
    "inf",
    "-inf",
    "1e999",
    "1e308",
    "-1",
    "0",
    "1e-320",
    "9" * 400,
    "true",
    '""',
    "ü",
]


@st.composite
def damages(draw: st.DrawFn, content: bytes, others: tuple[bytes, ...]) -> bytes:
    """Some damage to a file."""
    kind = draw(st.integers(0, 8))
    end = len(content) - 1
    if kind == 0:
        return draw(st.binary(max_size=200))
    if kind == 1:
        return content[: draw(st.integers(0, end))]
    if kind == 2:
        return draw(st.sampled_from(others))
    if kind == 3:
        return content[:8] + draw(st.binary(max_size=300))
    data = bytearray(content)
    if kind == 4:
        at = draw(st.integers(0, end))
        data[at:at] = draw(st.binary(min_size=1, max_size=20))
    elif kind == 5:
        at = draw(st.integers(0, end))
        del data[at : at + draw(st.integers(1, 1 + len(data) // 3))]
    elif kind == 6:
        numbers = [match.span() for match in re.finditer(rb"-?\d+\.?\d*", content)]
        if numbers:
            start, stop = draw(st.sampled_from(numbers))
            data[start:stop] = draw(st.sampled_from(NUMBERS)).encode()
    elif kind == 7:
        return content.decode("latin-1").encode(draw(st.sampled_from(["utf-16", "utf-8", "cp037"])))
    else:
        for _ in range(draw(st.integers(1, 8))):
            data[draw(st.integers(0, end))] = draw(st.integers(0, 255))
    return bytes(data)


def only_typed_errors(reader: Reader, path: Path) -> None:
    try:
        reader.read(path)
    except TorchcssError as error:
        message = str(error)
        assert "\n" not in message
        assert path.stem in message or str(path.parent) in message, message


@pytest.mark.parametrize("reader", READERS, ids=lambda r: f"{r.name}-{r.read.__name__}")
def test_readers_meet_only_typed_errors(
    reader: Reader, good: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    reader.read(good / reader.name)  # the valid file is one
    folder = tmp_path_factory.mktemp("bad")
    shutil.copytree(good, folder, dirs_exist_ok=True)
    path = folder / reader.name
    content = path.read_bytes()
    others = tuple(
        file.read_bytes() for file in sorted(good.rglob("*")) if file.is_file() and file != path
    )

    @settings(
        max_examples=25 if reader.slow else 80,
        deadline=None,
        database=None,
        derandomize=True,
        phases=(Phase.generate,),
        suppress_health_check=list(HealthCheck),
    )
    @given(data=damages(content, others))
    def damaged(data: bytes) -> None:
        path.write_bytes(data)
        only_typed_errors(reader, path)

    damaged()
    path.unlink()
    only_typed_errors(reader, path)
    path.mkdir()
    with pytest.raises(TorchcssError) as caught:
        reader.read(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [r.name for r in READERS], ids=str)
def test_the_valid_files_are_read(good: Path, name: str) -> Any:
    for reader in READERS:
        if reader.name == name:
            assert reader.read(good / name) is not None

"""Files of strangers: nothing in them runs, and no small file takes much memory or time."""

from __future__ import annotations

import io
import json
import pickle
import struct
import time
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from torchcss.body.load import load_body
from torchcss.errors import TorchcssError
from torchcss.files import shortened
from torchcss.io.cameras import load_camera
from torchcss.io.keypoints.read import read_keypoints
from torchcss.io.tracks import load_track
from torchcss.io.video import VideoReader
from torchcss.studies.demo import CLIP

MOST_MEGABYTES = 60


def keypoints(path: Path) -> object:
    return read_keypoints(path, image_size_wh=(640, 480), num_frames=6)


def refused(read: Callable[[Path], object], path: Path) -> str:
    """What a reader says of a bad file, in little time and memory."""
    tracemalloc.start()
    began = time.process_time()
    try:
        with pytest.raises(TorchcssError) as caught:
            read(path)
        most = tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
    assert time.process_time() - began < 10
    assert most < MOST_MEGABYTES
    assert "\n" not in str(caught.value)
    return str(caught.value)


def header(shape: tuple[int, ...], descr: str = "<f8") -> bytes:
    """The heading of an NPY file."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": descr, "fortran_order": False, "shape": shape}
    )
    return stream.getvalue()


@pytest.mark.parametrize("read", [keypoints, load_track, load_camera])
def test_arrays_that_are_larger_than_their_file(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("keypoints.npy", header((10**6, 17, 2)) + bytes(800))
    assert "more than it holds" in refused(read, path)
    if read is keypoints:
        (tmp_path / "a.npy").write_bytes(header((10**6, 17, 3)) + bytes(800))
        assert "more than it holds" in refused(read, tmp_path / "a.npy")


def test_archives_that_unpack_to_more_than_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchcss.files.MOST_ARRAYS", 10**6)
    monkeypatch.setattr("torchcss.io.keypoints.read.MOST_BYTES", 10**6)
    path = tmp_path / "a.npz"
    np.savez_compressed(path, keypoints=np.zeros((10**5, 17, 2)))
    for read in (keypoints, load_track):
        assert "27,200," in refused(read, path)
    monkeypatch.setattr("torchcss.files.MOST_TEXT", 1000)
    (tmp_path / "a.json").write_text(" " * 1001)
    assert "1,001 bytes" in refused(keypoints, tmp_path / "a.json")


class Room:
    """What asks NumPy for an array of any size, whatever numbers or objects follow."""

    def __init__(self, *asks: Any) -> None:
        self.asks = asks

    def __reduce__(self) -> Any:
        return self.asks


@pytest.mark.parametrize("kind", ["ndarray", "_reconstruct", "objects", "objects of a buffer"])
def test_pickles_that_ask_for_room(tmp_path: Path, kind: str) -> None:
    shape = (2**26, 17, 2)
    reconstruct, arguments, _ = np.zeros(1).__reduce__()
    from_buffer, few = np.zeros(1).__reduce_ex__(5)[0], (1, (10**7,), np.dtype("O"), False, [1])
    asks = {"ndarray": Room(np.ndarray, (shape, "f8")),
            "_reconstruct": Room(reconstruct, (arguments[0], shape, "f8")),
            "objects": Room(reconstruct, arguments, few),
            "objects of a buffer": Room(from_buffer, (bytes(8), "f8", (1,), "C"), few)}  # fmt: skip
    head = io.BytesIO()
    plain = {"descr": "|O", "fortran_order": False, "shape": ()}
    np.lib.format.write_array_header_1_0(head, plain)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        value = {"S1": {"Walking": [asks[kind]]}}
        archive.writestr("positions_2d.npy", head.getvalue() + pickle.dumps(value, protocol=2))
    assert "cannot be read" in refused(keypoints, tmp_path / "a.npz")


@pytest.mark.parametrize("read", [keypoints, load_track, load_camera])
def test_pickles_in_arrays(tmp_path: Path, read: Callable[[Path], object]) -> None:
    values = np.array([{1: 2}], dtype=object)
    np.savez(tmp_path / "a.npz", keypoints=values)
    assert "pickled" in refused(read, tmp_path / "a.npz")
    if read is not load_track:
        np.save(tmp_path / "a.npy", values)
        assert "pickled" in refused(read, tmp_path / "a.npy")


class Runs:
    def __reduce__(self) -> tuple[Any, ...]:
        return eval, ("open('ran', 'w')",)


def nested(depth: int) -> list[Any]:
    """A list that holds itself, in a way, 2 ** depth times."""
    inner: list[Any] = ["lol"]
    for _ in range(depth):
        inner = [inner, inner]
    return inner


def test_pickles_of_videopose3d(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.npz"

    def archive(value: object) -> None:
        data = header((), "|O") + pickle.dumps(np.array(value, dtype=object))
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("positions_2d.npy", data)

    archive({"S1": Runs()})
    assert "builtins.eval" in refused(keypoints, path)
    archive({"S1": {"a": {"bomb": nested(60)}}})
    refused(keypoints, path)
    assert not (tmp_path / "ran").exists()


def test_messages_of_deep_values_are_short() -> None:
    assert len(shortened(nested(60))) <= 60
    assert len(shortened({"a" * 10_000: "b" * 10_000})) <= 60


def bomb(depth: int = 10) -> str:
    """Entities that double: a kilobyte of XML that becomes gigabytes."""
    lines = ["<!ENTITY e0 'lol'>"]
    lines += [f"<!ENTITY e{i} '{f'&e{i - 1};' * 10}'>" for i in range(1, depth)]
    return f"<!DOCTYPE a [{''.join(lines)}]>"


@pytest.mark.parametrize(
    ("name", "read", "text"),
    [
        ("a.urdf", load_body, "<robot name='&e9;'><link name='a'/></robot>"),
        ("a.xml", load_body, "<mujoco><worldbody>&e9;</worldbody></mujoco>"),
        ("a.xml", load_camera, "<opencv_storage><K>&e9;</K></opencv_storage>"),
    ],
)  # fmt: skip
def test_entities_of_xml(
    tmp_path: Path, name: str, read: Callable[[Path], object], text: str
) -> None:
    (tmp_path / name).write_text(bomb() + text)
    assert "entities" in refused(read, tmp_path / name)
    secret = tmp_path / "secret"
    secret.write_text("treasure")
    (tmp_path / name).write_text(f"<!DOCTYPE a [<!ENTITY e9 SYSTEM '{secret}'>]>{text}")
    assert "treasure" not in refused(read, tmp_path / name)


def test_aliases_and_objects_of_yaml(tmp_path: Path) -> None:
    path = tmp_path / "a.yml"
    lines = ["a0: &a0 [lol, lol]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    path.write_text("\n".join(lines))
    assert "aliases" in refused(load_camera, path)
    path.write_text("names: !!python/object/apply:os.system ['touch ran']\n")
    refused(load_camera, path)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("suffix", [".json", ".toml", ".yml", ".csv", ".txt"])
def test_brackets_without_end(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_text("a = " * (suffix == ".toml") + "[" * 100_000)
    refused(keypoints if suffix in (".json", ".csv") else load_camera, path)


@pytest.mark.parametrize("depth", [60, 700])
@pytest.mark.parametrize(("opened", "closed"), [("[", "]"), ('{"a":', "}")])
@pytest.mark.parametrize("read", [keypoints, load_camera])
def test_objects_within_objects(
    tmp_path: Path, depth: int, opened: str, closed: str, read: Callable[[Path], object]
) -> None:
    path = tmp_path / "deep.json"
    path.write_text(depth * opened + "1" + depth * closed)
    assert "levels deep" in refused(read, path)


def test_frames_that_are_far_away(tmp_path: Path) -> None:
    person = [300.0, 200.0, 1.0] * 17
    path = tmp_path / "a.json"
    for number in (999_999, 10**9, 10**30):
        path.write_text(json.dumps([{"image_id": n, "keypoints": person} for n in (0, number)]))
        refused(keypoints, path)
    path.write_text(json.dumps([{"time": t, "keypoints": person} for t in (0.0, 1e-300, 1e300)]))
    refused(keypoints, path)


def test_matlab_that_unpacks_to_more_than_there_is(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    packed = zlib.compress(bytes(2**26), 9)
    head = b"MATLAB 5.0".ljust(124) + b"\x00\x01IM"
    path.write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)
    tracemalloc.start()
    with pytest.raises(TorchcssError, match="not a calibration"):
        load_camera(path)
    tracemalloc.stop()


def test_hdf5_that_claims_much_or_links_elsewhere(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    path, other = tmp_path / "a.analysis.h5", tmp_path / "other.h5"
    with h5py.File(path, "w") as file:
        file["node_names"] = np.array(["nose"], "S")
        file.create_dataset("tracks", (10**6, 2, 1, 10**6), "f8", chunks=True)
    assert "not joints" in refused(keypoints, path)
    with h5py.File(other, "w") as file:
        file["tracks"] = np.ones((1, 2, 1, 6))
    with h5py.File(path, "w") as file:
        file["node_names"] = np.array(["nose"], "S")
        file["tracks"] = h5py.ExternalLink(str(other), "tracks")
    assert "another file" in refused(keypoints, path)


def test_playlists_open_no_other_file(tmp_path: Path) -> None:
    clip = CLIP / "video.mp4"
    with av.open(str(clip)) as source, av.open(str(tmp_path / "a.ts"), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            packet.stream = stream
            target.mux([packet] if packet.dts is not None else [])
    folder = tmp_path / "list"
    folder.mkdir()
    listed = "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:2.0,\n{}\n#EXT-X-ENDLIST\n"
    for number, place in enumerate(("../a.ts", tmp_path / "a.ts")):
        (folder / f"{number}.m3u8").write_text(listed.format(place))
        assert "playlist" in refused(VideoReader, folder / f"{number}.m3u8")
    (folder / "b.ffconcat").write_text("ffconcat version 1.0\nfile '../a.ts'\n")
    assert "playlist" in refused(VideoReader, folder / "b.ffconcat")


def test_pictures_that_a_small_video_makes_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchcss.io.containers._MOST_PIXELS", 640 * 480 - 1)
    assert "640 x 480 pixels" in refused(VideoReader, CLIP / "video.mp4")


def test_meshes_and_includes_stay_in_the_folder(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (tmp_path / "secret.xml").write_text("<mujoco><worldbody/></mujoco>")
    folder = tmp_path / "robot"
    folder.mkdir()
    path = folder / "a.xml"
    path.write_text("<mujoco><include file='../secret.xml'/></mujoco>")
    assert "not in its folder" in refused(load_body, path)
    (folder / "a.urdf").write_text(
        "<robot name='a'><link name='b'><visual><geometry><mesh filename='/etc/passwd'/>"
        "</geometry></visual></link></robot>"
    )
    assert load_body(folder / "a.urdf").part_names == ()
    (tmp_path / "a.stl").write_text("solid a\nvertex 0 0 0\nvertex 1 1 1\n")
    (folder / "b.stl").symlink_to(tmp_path / "a.stl")
    for name in ("../a.stl", "package://../a.stl", "package://robot/../a.stl", "b.stl",
                 f"file://{tmp_path}/a.stl", "a\0.stl".replace("\0", "&#9;")):  # fmt: skip
        text = f"<mesh filename='{name}'/></geometry></visual></link></robot>"
        head = "<robot name='a'><link name='b'><visual><geometry>"
        (folder / "a.urdf").write_text(head + text)
        assert load_body(folder / "a.urdf").part_names == (), name


@pytest.mark.parametrize("suffix", [".urdf", ".bvh", ".xml"])
def test_bodies_of_very_many_links(tmp_path: Path, suffix: str) -> None:
    """A few megabytes of them took hours, and gigabytes of memory."""
    path, number = tmp_path / f"a{suffix}", 3000
    if suffix == ".urdf":
        lines = [f"<link name='{i}'/>" for i in range(number + 1)]
        lines += [
            f"<joint name='j{i}' type='fixed'><parent link='0'/><child link='{i}'/></joint>"
            for i in range(1, number + 1)
        ]
        path.write_text(f"<robot name='a'>{''.join(lines)}</robot>")
    elif suffix == ".xml":
        pytest.importorskip("mujoco")
        solid = "<joint/><geom size='1'/>"
        many = f"<replicate count='{number}'><body>{solid}</body></replicate>"
        path.write_text(f"<mujoco><worldbody><body>{solid}{many}</body></worldbody></mujoco>")
    else:
        turns = "OFFSET 0 1 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
        links = (
            f"JOINT j{i}\n{{\n{turns}End Site\n{{\nOFFSET 0 1 0\n}}\n}}\n" for i in range(number)
        )
        text = f"HIERARCHY\nROOT a\n{{\n{turns}{''.join(links)}}}\nMOTION\nFrames: 0\n"
        path.write_text(f"{text}Frame Time: 0.1\n")
    assert "links; expected" in refused(load_body, path)


def test_meshes_are_of_a_links_size(tmp_path: Path) -> None:
    (tmp_path / "a.urdf").write_text(
        "<robot name='a'><link name='b'><visual><geometry><mesh filename='a.stl'/>"
        "</geometry></visual></link></robot>"
    )
    mesh = tmp_path / "a.stl"
    with mesh.open("wb") as file:
        file.truncate(2**26 + 1)
    assert "not a link's mesh" in "".join(load_body(tmp_path / "a.urdf").notes)
    spaces = b"solid a" + b"\n \r\n" * 10**6  # which took hours
    for content in (
        b"x",
        b"solid a\nvertex 0 0 x\n",
        b"solid a\nvertex 0 0 nan\n",
        bytes(84),
        spaces,
    ):
        mesh.write_bytes(content)
        body = load_body(tmp_path / "a.urdf")
        assert not body.part_names
        assert "not an STL" in "".join(body.notes)

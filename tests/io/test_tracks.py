"""Tracks and summaries: what is written is read back, whole or not at all."""

from __future__ import annotations

import enum
import errno
import json
import os
import resource
import signal
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_processes import begin

from torchcss import files as atomic
from torchcss.errors import OutputError, ShapeError, TrackFileError
from torchcss.files import prepare_output_folder
from torchcss.io.tracks import (
    FrameModes,
    Track,
    TrackWriter,
    load_track,
    read_summary,
    write_summary,
)

STATE = ("x", "y", "z")
JOINTS = ("l_elbow", "l_wrist")


def some_modes(k: int, seed: int = 0) -> dict[str, Any]:
    """The arguments of `append` for k modes, best first, as tensors."""
    source = torch.Generator().manual_seed(seed)
    factor = torch.randn(k, 3, 3, generator=source, dtype=torch.float64)
    weights = torch.rand(k, generator=source, dtype=torch.float64).sort(descending=True).values
    return {
        "state": torch.randn(k, 3, generator=source, dtype=torch.float64),
        "covariance": factor @ factor.mT,
        "log_weight": weights.div(weights.sum()).log(),
        "cost": torch.rand(k, generator=source, dtype=torch.float64),
        "parent": torch.full((k,), -1),
        "joints_world": torch.randn(k, 2, 3, generator=source, dtype=torch.float64),
    }


def new_writer(path: Path) -> TrackWriter:
    return TrackWriter(path, Track.empty(STATE, JOINTS))


def write_track(path: Path, counts: tuple[int, ...] = (2, 3, 1)) -> TrackWriter:
    writer = new_writer(path)
    for index, k in enumerate(counts):
        writer.append(FrameModes(
            frame=10 + 2 * index, time_s=index / 30, base_transform=torch.eye(4) * (index + 1),
            **some_modes(k, index),
        ))  # fmt: skip
    writer.save()
    return writer


def assert_same(left: Track, right: Track) -> None:
    for name, one, other in zip(Track._fields, left, right, strict=True):
        np.testing.assert_array_equal(one, other, err_msg=name)


def test_round_trip(tmp_path: Path) -> None:
    writer = write_track(tmp_path / "track.npz")
    track = load_track(tmp_path / "track.npz")
    assert_same(track, load_track(tmp_path))
    assert_same(track, writer.track())
    assert len(writer) == 3
    assert track.frames.tolist() == [10, 12, 14]
    assert track.times.tolist() == [0, 1 / 30, 2 / 30]
    assert (track.state_names, track.joint_names) == (STATE, JOINTS)
    assert track.num_modes.tolist() == [2, 3, 1]
    for index, k in enumerate((2, 3, 1)):
        for name, value in some_modes(k, index).items():
            stored = getattr(track, name)[index]
            np.testing.assert_array_equal(stored[:k], value.numpy(), err_msg=name)
            assert len(stored) == 3
        assert (track.log_weight[index, k:] == -np.inf).all()
        assert (track.cost[index, k:] == np.inf).all()
        assert (track.parent[index, k:] == -1).all()
        assert not track.state[index, k:].any()
        np.testing.assert_array_equal(track.base_transform[index], np.eye(4) * (index + 1))
    assert list(tmp_path.iterdir()) == [tmp_path / "track.npz"]


def test_file_has_exactly_the_arrays_of_the_design(tmp_path: Path) -> None:
    write_track(tmp_path / "track.npz")
    with np.load(tmp_path / "track.npz", allow_pickle=False) as archive:
        shapes = {name: archive[name].shape for name in archive.files}
    assert shapes == {
        "schema_version": (), "frames": (3,), "times": (3,), "state_names": (3,),
        "state": (3, 3, 3), "covariance": (3, 3, 3, 3), "log_weight": (3, 3), "cost": (3, 3),
        "parent": (3, 3), "joint_names": (2,), "joints_world": (3, 3, 2, 3),
        "base_transform": (3, 4, 4),
        "evidence": (), "size_deviation": (), "body": (), "cameras": (), "settings": (),
    }  # fmt: skip


def test_best_mode_first_and_parents_follow(tmp_path: Path) -> None:
    writer = new_writer(tmp_path / "track.npz")
    first, second = some_modes(3, 1), some_modes(2, 2)
    first["log_weight"] = torch.tensor([0.2, 0.5, 0.3]).log()
    second["log_weight"] = torch.tensor([0.1, 0.9]).log()
    second["parent"] = torch.tensor([0, 2])
    writer.append(FrameModes(frame=0, time_s=0.0, **first))
    writer.append(FrameModes(frame=1, time_s=0.1, **second))
    track = writer.track()
    np.testing.assert_array_equal(track.state[0], first["state"][[1, 2, 0]])
    # The second frame's best mode came from mode 2, which now stands at 1; the other from 0, at 2.
    assert track.parent[1].tolist() == [1, 2, -1]
    np.testing.assert_array_equal(track.state[1, :2], second["state"][[1, 0]])


def test_modes_without_weight_are_left_out() -> None:
    writer = new_writer(Path("unused.npz"))
    modes = some_modes(3)
    modes["log_weight"] = torch.tensor([-torch.inf, 0.0, -torch.inf])
    writer.append(FrameModes(frame=0, time_s=0.0, **modes))
    child = some_modes(2)
    child["parent"] = torch.tensor([0, 1])
    writer.append(FrameModes(frame=1, time_s=0.1, **child))
    track = writer.track()
    assert track.num_modes.tolist() == [1, 2]
    np.testing.assert_array_equal(track.state[0, 0], modes["state"][1])
    assert track.parent[1].tolist() == [-1, 0]


def test_saving_again_and_again(tmp_path: Path) -> None:
    path = tmp_path / "track.npz"
    writer = new_writer(path)
    writer.save()
    assert load_track(path).state.shape == (0, 0, 3)
    for index in range(4):
        writer.append(FrameModes(frame=index, time_s=index / 10, **some_modes(2, index)))
        writer.save()
        assert len(load_track(path).frames) == index + 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"state": np.zeros((2, 4))}, "state"),
        ({"state": np.full((2, 3), np.nan)}, "state.*finite"),
        ({"covariance": np.zeros((2, 3))}, "covariance"),
        ({"log_weight": np.zeros(3)}, "."),
        ({"log_weight": [np.nan, 0.0]}, "log_weight"),
        ({"log_weight": [-np.inf, -np.inf]}, "log_weight"),
        ({"log_weight": np.zeros(0)}, "."),
        ({"cost": [np.inf, 0.0]}, "cost"),
        ({"cost": [np.nan, np.nan]}, "cost"),
        ({"parent": [0, 7]}, "parent"),
        ({"parent": [-2, 0]}, "parent"),
        ({"joints_world": np.zeros((2, 3, 3))}, "joints_world"),
        ({"base_transform": np.zeros((3, 3))}, "base_transform"),
        ({"frame": 0}, "rising order"),
        ({"time_s": float("nan")}, "finite times"),
    ],
)
def test_frames_that_do_not_fit(change: dict[str, Any], words: str) -> None:
    writer = new_writer(Path("unused.npz"))
    writer.append(FrameModes(frame=0, time_s=0.0, **some_modes(2)))
    with pytest.raises(ShapeError, match=words):
        writer.append(FrameModes(**{"frame": 1, "time_s": 0.1, **some_modes(2), **change}))
    assert len(writer) == 1
    writer.append(FrameModes(frame=1, time_s=0.1, **some_modes(2)))


# Disks that refuse.


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.ENOSPC, "disk is full"),
        (errno.EACCES, "may not write"),
        (errno.EROFS, "read-only"),
        (errno.EIO, "another folder"),
    ],
)
def test_refusals_keep_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, words: str
) -> None:
    path = tmp_path / "track.npz"
    writer = write_track(path)
    before = path.read_bytes()
    writer.append(FrameModes(frame=100, time_s=9.0, **some_modes(2)))

    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(np.lib.format, "write_array", refuse)
        with pytest.raises(OutputError, match=words) as caught:
            writer.save()
    assert str(path) in str(caught.value)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", refuse)
        with pytest.raises(OutputError, match=words):
            writer.save()
    assert path.read_bytes() == before
    writer.save()  # space was freed
    assert len(load_track(path).frames) == 4


def test_really_full(tmp_path: Path) -> None:
    # A limit on the size of files is a full disk that a test can have.
    path = tmp_path / "track.npz"
    writer = write_track(path)
    for index in range(100, 200):
        writer.append(FrameModes(frame=index, time_s=float(index), **some_modes(3)))
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before), limits[1]))
    try:
        with pytest.raises(OutputError, match="larger than this system allows"):
            writer.save()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_killed_in_mid_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "track.npz"
    write_track(path)
    before = path.read_bytes()
    programme = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from torchcss.files import replace_file\n"
        "with replace_file(Path(sys.argv[1])) as partial:\n"
        "    partial.write_bytes(b'half')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    assert begin(programme, str(path)).end() == -signal.SIGKILL
    assert path.read_bytes() == before


def test_interrupt_in_mid_write_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "track.npz"
    writer = write_track(path)
    before = path.read_bytes()

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(np.lib.format, "write_array", interrupt)
    with pytest.raises(KeyboardInterrupt):
        writer.save()
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_output_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = prepare_output_folder(tmp_path / "a" / "b")
    assert folder.is_dir()
    assert list(folder.iterdir()) == []
    assert prepare_output_folder(str(folder)) == folder
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="a file is in the way"):
        prepare_output_folder(tmp_path / "file")
    with pytest.raises(OutputError, match="a file, not a folder"):
        prepare_output_folder(tmp_path / "file" / "a")
    with pytest.raises(OutputError, match="too long"):
        prepare_output_folder(tmp_path / ("a" * 300))
    with pytest.raises(OutputError):
        prepare_output_folder("a\0b")

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "no")

    monkeypatch.setattr(atomic.tempfile, "NamedTemporaryFile", refuse)
    with pytest.raises(OutputError, match="may not write"):
        prepare_output_folder(tmp_path / "c")


# Files that are wrong.


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        return dict(archive.items())


def test_missing_and_foreign(tmp_path: Path) -> None:
    with pytest.raises(TrackFileError, match="no such file"):
        load_track(tmp_path / "none.npz")
    with pytest.raises(TrackFileError, match=r"track\.npz: there is no such file"):
        load_track(tmp_path)
    with pytest.raises(TrackFileError):
        load_track("a\0b")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(TrackFileError, match="not an NPZ file"):
        load_track(tmp_path / "text.npz")
    (tmp_path / "empty.npz").touch()
    with pytest.raises(TrackFileError, match="empty"):
        load_track(tmp_path / "empty.npz")
    np.savez(tmp_path / "other.npz", keypoints=np.zeros(3))
    with pytest.raises(TrackFileError, match=r"not a track.*schema_version.*keypoints"):
        load_track(tmp_path / "other.npz")
    np.savez(tmp_path / "pickle.npz", schema_version=np.array({}, dtype=object))
    with pytest.raises(TrackFileError, match="pickled"):
        load_track(tmp_path / "pickle.npz")


def test_other_schema_version(tmp_path: Path) -> None:
    write_track(tmp_path / "track.npz")
    arrays = arrays_of(tmp_path / "track.npz")
    np.savez(tmp_path / "b.npz", **(arrays | {"schema_version": np.array(7)}))
    with pytest.raises(TrackFileError, match="version 7, this program reads 1 and 2"):
        load_track(tmp_path / "b.npz")


def test_a_frame_without_modes_is_refused(tmp_path: Path) -> None:
    write_track(tmp_path / "track.npz")
    arrays = arrays_of(tmp_path / "track.npz")
    arrays["log_weight"][1] = -np.inf
    np.savez(tmp_path / "b.npz", **arrays)
    with pytest.raises(TrackFileError, match=r"b\.npz: row 1: no mode; expected one or more"):
        load_track(tmp_path / "b.npz")


OBLIGATORY = [name for name in Track._fields[:11] if name != "base_transform"]


@pytest.mark.parametrize("name", OBLIGATORY)
def test_incomplete_and_misshapen(tmp_path: Path, name: str) -> None:
    write_track(tmp_path / "track.npz")
    arrays = arrays_of(tmp_path / "track.npz")
    np.savez(tmp_path / "b.npz", **{key: arrays[key] for key in arrays if key != name})
    with pytest.raises(TrackFileError, match=f"{name} missing"):
        load_track(tmp_path / "b.npz")
    for bad in (arrays[name][..., None], arrays[name].astype("S"), arrays[name].astype(complex)
                if arrays[name].dtype.kind != "U" else np.zeros(3)):  # fmt: skip
        np.savez(tmp_path / "c.npz", **(arrays | {name: bad}))
        with pytest.raises(TrackFileError):
            load_track(tmp_path / "c.npz")


def test_nan_is_refused(tmp_path: Path) -> None:
    write_track(tmp_path / "track.npz")
    arrays = arrays_of(tmp_path / "track.npz")
    arrays["state"][1, 0, 0] = np.nan
    np.savez(tmp_path / "b.npz", **arrays)
    with pytest.raises(TrackFileError, match="state holds NaN"):
        load_track(tmp_path / "b.npz")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("covariance", np.inf, "covariance holds infinity"),
        ("times", -np.inf, "times holds infinity"),
        ("times", 1e300, "times: expected seconds"),
        ("state", 1e200, "state: expected numbers up to 1e\\+09"),
        ("covariance", -1.0, "covariance: expected variances that are not negative"),
        ("log_weight", 800.0, "log_weight: expected logarithms of weights, at most 1"),
        ("times", 1 / 30 + 1e-9, "times: expected seconds"),
        ("frames", -1, "frames: expected numbers from 0 in rising order"),
        ("frames", 0, "frames: expected numbers from 0 in rising order"),
    ],
)
def test_what_no_tracker_writes_is_refused(
    tmp_path: Path, name: str, value: float, words: str
) -> None:
    write_track(tmp_path / "track.npz")
    arrays = arrays_of(tmp_path / "track.npz")
    arrays[name].flat[-1] = value
    np.savez(tmp_path / "b.npz", **arrays)
    with pytest.raises(TrackFileError, match=words):
        load_track(tmp_path / "b.npz")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("notes", 3), ("events", {}), ("events", [3]), ("events", [{"event": "lost"}]),
        ("optimiser_status", []), ("cameras", 3),
    ],
)  # fmt: skip
def test_a_summary_that_somebody_changed(tmp_path: Path, name: str, value: object) -> None:
    path = tmp_path / "summary.json"
    path.write_text(json.dumps({"ended": "complete", name: value}))
    with pytest.raises(TrackFileError, match=f"{name}: expected"):
        read_summary(path)


def test_the_power_of_the_covariances_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "track.npz"
    writer = TrackWriter(path, Track.empty(("a",), ("b",))._replace(likelihood_power=0.1))
    writer.append(FrameModes(
        frame=0, time_s=0.0, state=[[0.0]], covariance=[[[1.0]]], log_weight=[0.0], cost=[1.0],
        parent=[-1], joints_world=[[[0.0, 0.0, 0.0]]],
    ))  # fmt: skip
    writer.save()
    assert load_track(path).likelihood_power == 0.1
    arrays = dict(np.load(path))
    np.savez(tmp_path / "bad.npz", **{**arrays, "evidence": np.array(0.0)})
    with pytest.raises(TrackFileError, match="positive power, got 0"):
        load_track(tmp_path / "bad.npz")
    # A track of somebody else's need not say it.
    del arrays["evidence"]
    np.savez(tmp_path / "old.npz", **arrays)
    assert load_track(tmp_path / "old.npz").likelihood_power == 1.0


def test_base_transform_is_optional(tmp_path: Path) -> None:
    write_track(tmp_path / "track.npz")
    arrays = arrays_of(tmp_path / "track.npz")
    del arrays["base_transform"]
    np.savez(tmp_path / "b.npz", **arrays)
    assert (load_track(tmp_path / "b.npz").base_transform == np.eye(4)).all()


@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_only_track_file_errors_come_from_bad_bytes(tmp_path: Path, data: st.DataObject) -> None:
    good = tmp_path / "track.npz"
    if not good.exists():
        write_track(good)
    content = bytearray(good.read_bytes())
    kind = data.draw(st.sampled_from(["random", "cut", "changed"]))
    if kind == "random":
        content = bytearray(b"PK\x03\x04" + data.draw(st.binary(max_size=300)))
    elif kind == "cut":
        del content[data.draw(st.integers(0, len(content) - 1)) :]
    else:
        for _ in range(data.draw(st.integers(1, 20))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / "bad.npz"
    path.write_bytes(content)
    message = ""
    try:
        load_track(path)
    except TrackFileError as error:
        message = str(error)
    if kind != "changed":
        assert message
    assert "\n" not in message


# Summaries.


class Colour(enum.Enum):
    RED = "red"


class Record(NamedTuple):
    value: float


@dataclass(frozen=True)
class Choice:
    samples: int
    colour: Colour


def test_summary(tmp_path: Path) -> None:
    summary = {
        "zeta": 1, "alpha": float("nan"), "inf": [np.inf, -np.inf, 1.5], "np": np.float32(0.5),
        "int": np.int64(3), "bool": np.bool_(True), "array": np.array([[1.0, np.nan]]),
        "tensor": torch.tensor([1, 2]), "path": Path("a") / "b", "fraction": Fraction(1, 2),
        "choice": Choice(7, Colour.RED), "record": Record(float("inf")), "none": None,
        "nested": {3: (1, 2)}, "dtype": torch.float64,
    }  # fmt: skip
    write_summary(tmp_path, summary)
    text = (tmp_path / "summary.json").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    found = read_summary(tmp_path)
    assert found == {
        "zeta": 1, "alpha": None, "inf": [None, None, 1.5], "np": 0.5, "int": 3, "bool": True,
        "array": [[1.0, None]], "tensor": [1, 2], "path": "a/b", "fraction": 0.5,
        "choice": {"samples": 7, "colour": "red"}, "record": {"value": None}, "none": None,
        "nested": {"3": [1, 2]}, "dtype": "torch.float64",
    }  # fmt: skip
    assert list(found) == sorted(found)
    assert json.loads(text) == found
    write_summary(tmp_path / "other.json", {"a": 1})
    assert read_summary(tmp_path / "other.json") == {"a": 1}


def test_bad_summaries(tmp_path: Path) -> None:
    with pytest.raises(TrackFileError, match="no such file"):
        read_summary(tmp_path)
    (tmp_path / "summary.json").write_text("[1]")
    with pytest.raises(TrackFileError, match="not a summary"):
        read_summary(tmp_path)
    (tmp_path / "summary.json").write_text("{")
    with pytest.raises(TrackFileError, match="not a JSON"):
        read_summary(tmp_path)
    with pytest.raises(OutputError):
        write_summary(tmp_path / "none" / "summary.json", {})


def test_what_was_written_stays_in_the_file(tmp_path: Path) -> None:
    """Saved after every frame or once: the same arrays, whatever the numbers of modes."""
    counts = (2, 1, 4, 3, 1, 5)
    whole = write_track(tmp_path / "whole.npz", counts)
    writer = new_writer(tmp_path / "pieces.npz")
    for index, k in enumerate(counts):
        writer.append(FrameModes(
            frame=10 + 2 * index, time_s=index / 30, base_transform=torch.eye(4) * (index + 1),
            **some_modes(k, index),
        ))  # fmt: skip
        writer.save()
    assert len(writer) == 6
    assert_same(load_track(writer.path), load_track(whole.path))
    assert_same(writer.track(), whole.track())
    for name, array in np.load(whole.path).items():
        assert np.load(writer.path)[name].dtype == array.dtype
    with pytest.raises(ShapeError, match="rising order"):
        writer.append(FrameModes(frame=20, time_s=9.0, **some_modes(2)))


@pytest.mark.parametrize("now", [b"", b"PK nothing", None])
def test_a_file_that_somebody_changed_is_told(tmp_path: Path, now: bytes | None) -> None:
    writer = write_track(tmp_path / "track.npz")
    writer.append(FrameModes(frame=100, time_s=9.0, **some_modes(2)))
    writer.path.unlink() if now is None else writer.path.write_bytes(now)
    with pytest.raises(OutputError, match=r"track\.npz"):
        writer.save()
    assert len(writer) == 4

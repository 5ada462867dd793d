"""Detectors behind their interface, with stubs in place of the packages; and the real one."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from torchcss.errors import DetectorError, MissingExtraError
from torchcss.io.detect import open_detector
from torchcss.io.video import VideoReader
from torchcss.types import Frame


def frame(width: int = 64, height: int = 48) -> Frame:
    image = np.zeros((height, width, 3), dtype=np.uint8)
    image[..., 0] = 200
    return Frame(0, 0.0, image)


def stub(monkeypatch: pytest.MonkeyPatch, name: str, **members: Any) -> None:
    module = ModuleType(name)
    vars(module).update(members)
    monkeypatch.setitem(sys.modules, name, module)


class Rtmo:
    """What rtmlib's RTMO does, for two people."""

    def __init__(self, model: str) -> None:
        print("load", model)

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert image[0, 0].tolist() == [0, 0, 200]  # blue, green, red
        assert image.flags.c_contiguous
        places = np.stack([np.full((17, 2), 5.0), np.full((17, 2), 9.0)])
        return places, np.full((2, 17), 0.8)


def test_rtmlib(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stub(monkeypatch, "rtmlib", RTMO=Rtmo)
    model = tmp_path / "rtmo.onnx"
    model.write_bytes(b"net")
    detector = open_detector("rtmlib", model)
    people, points, masks = detector.detect(frame())
    detector.close()
    assert points is None
    assert masks is None
    assert people.shape == (2, 17, 3)
    assert people[1, 3].tolist() == [9.0, 9.0, 0.8]
    assert capsys.readouterr().out == ""
    with pytest.raises(DetectorError, match="--detector-model"):
        open_detector("rtmlib", None)  # it would fetch one without asking


def mediapipe(marks: list[list[tuple[float, float, float]]]) -> dict[str, Any]:
    """A stub of the package that sees these people."""

    class Landmarker:
        def __init__(self) -> None:
            self.times: list[int] = []

        def detect_for_video(self, image: Any, time_ms: int) -> Any:
            assert image.data.flags.c_contiguous
            assert time_ms > max(self.times, default=-1)
            self.times.append(time_ms)
            people = [[SimpleNamespace(x=x, y=y, visibility=v) for x, y, v in p] for p in marks]
            space = [[SimpleNamespace(x=x, y=y, z=v) for x, y, v in p] for p in marks]
            height, width = image.data.shape[:2]
            belief = np.full((height, width, 1), 0.2)
            belief[height // 2] = 1.0
            masks = [SimpleNamespace(numpy_view=lambda: belief) for _ in marks]
            return SimpleNamespace(
                pose_landmarks=people,
                pose_world_landmarks=space,
                segmentation_masks=masks or None,  # as MediaPipe has it where nobody is
            )

        def close(self) -> None:
            pass

    vision = SimpleNamespace(
        PoseLandmarkerOptions=SimpleNamespace,
        RunningMode=SimpleNamespace(VIDEO=1),
        PoseLandmarker=SimpleNamespace(create_from_options=lambda _: Landmarker()),
    )
    return {
        "tasks": SimpleNamespace(vision=vision, BaseOptions=SimpleNamespace),
        "Image": SimpleNamespace,
        "ImageFormat": SimpleNamespace(SRGB=1),
    }


def test_mediapipe(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    person = [(0.5, 0.25, 0.6), (0.5, 0.5, 0.05)] + [(0.1, 0.1, 1.0)] * 31
    stub(monkeypatch, "mediapipe", **mediapipe([person]))
    monkeypatch.setattr("torchcss.io.detect.find_model", lambda given: given)
    detector = open_detector("mediapipe", tmp_path / "m.task")
    padded = Frame(0, 0.0, frame(80).image[:, :64])  # rows that do not lie densely
    for _ in range(2):  # frames of one time get times that rise
        people, points, masks = detector.detect(padded)
    detector.close()
    assert points is not None
    assert points[0, 0].tolist() == [0.5, 0.25, 0.6]
    assert masks is not None
    assert masks[0, :, 0].tolist() == [51] * 24 + [255] + [51] * 23
    assert people.shape == (1, 33, 3)
    np.testing.assert_allclose(people[0, 0], [31.5, 11.5, 0.36])  # pixel centres at integers
    assert people[0, 1].tolist() == [0, 0, 0]  # a guess


def test_nobody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    stub(monkeypatch, "mediapipe", **mediapipe([]))
    monkeypatch.setattr("torchcss.io.detect.find_model", lambda given: given)
    detector = open_detector("mediapipe", tmp_path / "m.task")
    people, _, masks = detector.detect(frame())
    assert people.shape == (0, 33, 3)
    assert masks is not None
    assert masks.shape == (0, 48, 64)


def test_what_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mediapipe", None)
    with pytest.raises(MissingExtraError, match=r"torchcss\[detect\].*--keypoints"):
        open_detector("mediapipe", None)

    def bare(name: str) -> None:
        raise ImportError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr("torchcss.io.detect.importlib.import_module", bare)
    with pytest.raises(MissingExtraError, match=r"libGL.*apt-get install libgl1"):
        open_detector("mediapipe", None)


def test_a_real_person(shared_data: Path) -> None:
    pytest.importorskip("mediapipe")
    detector = open_detector("mediapipe", shared_data / "detector" / "pose_landmarker_full.task")
    seen = next(iter(VideoReader(shared_data / "balance_beam_4cam" / "cam01.mp4")))
    people, points, masks = detector.detect(seen)
    detector.close()
    assert len(people) == 1
    assert points is not None
    assert masks is not None
    known = np.load(shared_data / "balance_beam_4cam" / "keypoints2d_cam01.npz")
    wrist = known["keypoints"][0, list(known["joint_names"]).index("LWrist")]
    assert np.linalg.norm(people[0, 15, :2] - wrist) < 40
    assert 1.0 < points[0, :, 1].max() - points[0, :, 1].min() < 2.0  # metres, down
    hip = people[0, 23].round().astype(int)
    assert masks[0, hip[1], hip[0]] > 200 > 50 > masks[0, 5, 5]

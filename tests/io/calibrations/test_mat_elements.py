"""MATLAB's files of strangers: none ends the process, and what SciPy reads is read."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from scipy.sparse import csc_matrix

from torchcss.errors import CameraError
from torchcss.io.calibrations.mat_elements import check_mat_elements
from torchcss.io.cameras import load_camera

K = np.array([[611.0, 0, 318], [0, 612, 243], [0, 0, 1]])
PARAMETERS = {"ImageSize": [480, 640], "RadialDistortion": [0.1, -0.2], "K": K, "Units": "mm"}
CONTENTS = [
    {"cameraParams": PARAMETERS},
    {"fc": [[611.0], [612]], "cc": [[318.0], [243]], "kc": np.zeros((5, 1)), "nx": 640, "ny": 480},
    {"K": K, "ImageSize": [480, 640], "cell": np.array([1, "ab", K], object), "z": [1 + 2j]},
]
CELLS, STRUCTURE, TEXT, DOUBLE = 1, 2, 4, 6

READ = """
import sys
from pathlib import Path
from torchcss.errors import CameraError
from torchcss.io.calibrations.matlab import read_matlab
for path in sys.argv[1:]:
    try:
        read_matlab(Path(path))
    except CameraError as error:
        print(error)
"""
"""A programme of its own, since SciPy's crash would end this one."""


def saved(content: dict[str, Any], **choices: Any) -> bytes:
    stream = io.BytesIO()
    scipy.io.savemat(stream, content, **choices)
    return stream.getvalue()


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<2I", kind, len(content)) + content + bytes(-len(content) % 8)


def matrix(form: int, shape: tuple[int, ...], *parts: bytes) -> bytes:
    """A variable K of this class."""
    head = element(6, struct.pack("<2I", form, 0))
    head += element(5, struct.pack(f"<{len(shape)}i", *shape)) + element(1, b"K")
    return element(14, head + b"".join(parts))


def file_of(variable: bytes, *, packed: bool = False) -> bytes:
    if packed:
        content = zlib.compress(variable)
        variable = struct.pack("<2I", 15, len(content)) + content
    return b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + variable


def nested(levels: int) -> bytes:
    variable = matrix(DOUBLE, (1, 1), element(9, bytes(8)))
    head = matrix(CELLS, (1, 1))[8:]
    size = len(variable) + levels * (8 + len(head))
    opened = (struct.pack("<2I", 14, size - each * (8 + len(head)) - 8) for each in range(levels))
    return b"".join(begin + head for begin in opened) + variable


FIELDS = element(5, struct.pack("<i", 0)), element(1, b"a\0")
MANY = element(5, struct.pack("<i", 2)), element(1, b"a\0" * 2000)
NO_FIELDS = element(5, struct.pack("<i", 2)), element(1, b"")
BAD = {
    "type 8": matrix(DOUBLE, (1, 1), element(8, bytes(8))),
    "type 27401": matrix(DOUBLE, (1, 1), element(27401, bytes(8))),
    "type 19 of text": matrix(TEXT, (1, 1), element(19, b"a")),
    "small of type 10": matrix(DOUBLE, (1, 1), struct.pack("<2HI", 10, 4, 0)),
    "text without dimensions": matrix(TEXT, (), element(1, b"a")),
    "deep": nested(60_000),
    "longer than its file": matrix(DOUBLE, (1, 1), struct.pack("<2I", 9, 2**31)),
    "wider than its file": matrix(STRUCTURE, (2**14, 2**14), *NO_FIELDS),
    "lines without end": matrix(TEXT, (2**28, 0), element(1, b"")),
    "fields of no width": matrix(STRUCTURE, (1, 1), *FIELDS),
    "fields without end": matrix(STRUCTURE, (0, 0), *MANY),
    "class 18": matrix(18, (1, 1), element(9, bytes(8))),
    "negative": matrix(DOUBLE, (-1, 1), element(9, bytes(8))),
}


def test_no_file_ends_the_process(tmp_path: Path) -> None:
    whole = saved(CONTENTS[2])
    place = whole.rindex(struct.pack("<2I", 9, 8))
    files = [whole[: place + 1] + b"\x6b" + whole[place + 2 :]]  # one byte is another
    files += [file_of(each, packed=packed) for each in BAD.values() for packed in (False, True)]
    paths = [tmp_path / f"{number}.mat" for number in range(len(files))]
    for path, data in zip(paths, files, strict=True):
        path.write_bytes(data)
    process = subprocess.run(
        [sys.executable, "-c", READ, *paths], capture_output=True, text=True, check=False
    )
    assert process.returncode == 0, process.stderr[-300:]
    lines = process.stdout.splitlines()
    assert [line.split(": ")[0] for line in lines] == [str(path) for path in paths]
    assert all("cannot be read as MATLAB's: " in line for line in lines)


def test_a_packed_variable_that_is_said_to_be_empty_is_looked_at() -> None:
    variable = BAD["type 8"]
    data = file_of(struct.pack("<2I", 14, 0) + variable[8:], packed=True)
    with pytest.raises(ValueError, match="type 8"):
        check_mat_elements(data)


def test_the_order_of_bytes_is_told_as_scipy_tells_it() -> None:
    data = bytearray(saved(CONTENTS[0]))
    data[126:128] = b"??"
    with pytest.raises(ValueError, match="an element"):
        check_mat_elements(bytes(data))


def test_a_plain_file_larger_than_a_calibration(tmp_path: Path) -> None:
    (tmp_path / "a.mat").write_bytes(file_of(matrix(DOUBLE, (2**23, 1), element(9, bytes(2**26)))))
    with pytest.raises(CameraError, match="not a calibration"):
        load_camera(tmp_path / "a.mat")


def test_changed_bytes_meet_only_typed_errors(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    files = [saved(each, do_compression=packed) for each in CONTENTS for packed in (False, True)]
    files += [saved(each, format="4") for each in CONTENTS[1:2]]
    path, refused = tmp_path / "a.mat", []
    for number in range(350):
        data = bytearray(files[number % len(files)])
        for place in random.integers(128, len(data), random.integers(1, 4)):
            data[place] = random.choice([random.integers(256), random.integers(20)])
        path.write_bytes(data)
        try:
            load_camera(path)
        except CameraError as error:
            refused.append(str(error))
    assert 100 < len(refused) < 350
    assert all("\n" not in each and str(path) in each for each in refused)


def test_what_scipy_reads_is_not_refused() -> None:
    """Files of MATLAB 4 to 7 and of Octave, in both orders of bytes, that SciPy is tested with."""
    folder = Path(scipy.io.__file__).parent / "matlab" / "tests" / "data"
    for path in folder.glob("*.mat"):
        content = None
        with suppress(Exception):  # some are damaged
            content = scipy.io.loadmat(path, simplify_cells=True)
        if content is not None:
            check_mat_elements(path.read_bytes())


def test_a_sparse_matrix_beside_a_camera(tmp_path: Path) -> None:
    beside = {"jacobian": csc_matrix(np.eye(3)), "none": np.zeros((0, 1000))}
    (tmp_path / "a.mat").write_bytes(saved({**PARAMETERS, **beside}))
    assert load_camera(tmp_path / "a.mat").camera.K[0, 0] == 611.0

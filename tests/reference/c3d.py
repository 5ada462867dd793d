"""A minimal reader of C3D files: point data, labels, units and rate of Intel floating files.

From the public description of the format (The C3D File Format, Motion Lab Systems): blocks of 512
bytes, a header, parameters in groups, then frames of four 4-byte floats per point: x, y, z, and a
residual that is -1 where the point is invalid.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np


class C3dFile(NamedTuple):
    labels: tuple[str, ...]
    units: str
    rate: float
    first: int  # the number of the first frame, counted from 1
    points: np.ndarray  # frames, points, 3; NaN where invalid
    screen: tuple[str, str]  # the axes to the right and up


def read_c3d(data: bytes) -> C3dFile:
    """Parse a file."""
    parameters_at, magic, num_points, num_analog = struct.unpack_from("<BBHH", data, 0)
    first, last, _, scale, data_at, _, rate = struct.unpack_from("<HHHfHHf", data, 6)
    assert magic == 0x50
    assert num_analog == 0
    assert scale < 0, "integer points"
    at = (parameters_at - 1) * 512
    assert data[at + 3] == 84, "not Intel"
    at += 4
    groups: dict[int, str] = {}
    values: dict[tuple[int, str], tuple[int, tuple[int, ...], bytes]] = {}
    while data[at]:
        length, group = struct.unpack_from("bb", data, at)
        name = data[at + 2 : at + 2 + abs(length)].decode()
        following = at + 2 + abs(length)
        (step,) = struct.unpack_from("<H", data, following)
        if group < 0:
            groups[-group] = name
        else:
            kind, dimensions = struct.unpack_from("bB", data, following + 2)
            shape = tuple(data[following + 4 : following + 4 + dimensions])
            size = abs(kind) * int(np.prod(shape)) if shape else abs(kind)
            start = following + 4 + dimensions
            values[group, name] = (kind, shape, data[start : start + size])
        if not step:
            break
        at = following + step
    point = next(index for index, name in groups.items() if name == "POINT")

    def text(name: str) -> list[str]:
        _, shape, raw = values[point, name]
        width = shape[0]
        return [raw[i : i + width].decode().strip() for i in range(0, len(raw), width)]

    frames = last - first + 1
    table = np.frombuffer(data, "<f4", frames * num_points * 4, (data_at - 1) * 512)
    table = table.reshape(frames, num_points, 4).astype(np.float64)
    points = np.where(table[..., 3:] < 0, np.nan, table[..., :3])
    screen = (text("X_SCREEN")[0], text("Y_SCREEN")[0])
    return C3dFile(tuple(text("LABELS")), text("UNITS")[0], rate, first, points, screen)

"""No kernel of vision reaches beyond an array, in a process that checks every index."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from torchcss.kernels import compiler

CHECK = """
import numpy as np
import torch
from torchcss.kernels import compiler
from torchcss.kernels.checked import run
from torchcss.vision import blur_kernels, flow_kernels
from torchcss.vision import rasterise_kernels, resample_kernels

assert compiler.CHECKED
rng, single = np.random.default_rng(0), np.float32

for size in ((1, 1), (3, 4), (9, 1)):
    moves = (20 * rng.standard_normal((2, *size))).astype(single)
    first = rng.random((3, *size)).astype(single)
    spline = np.zeros((size[0] + 3, size[1] + 3), single)
    run(flow_kernels.spline, first[0], np.zeros(max(size), single), spline)
    run(flow_kernels.slopes, spline, *first[1:])
    found = np.zeros((2, *size), single), *np.zeros((2, *size), single)
    run(flow_kernels.linearise, moves, first, spline, 1e-10, *found)

for height, width, y, x in ((7, 5, 3, 2), (9, 9, 8, 8), (50, 3, 7, 1), (33, 64, 32, 63)):
    pixels = torch.from_numpy(rng.integers(0, 255, (height, width, 3)).astype(np.uint8))
    resized = torch.zeros(3, y, x)
    resample_kernels.resize(pixels, resized, resample_kernels.triangles)
    levels = resized.permute(1, 2, 0).contiguous()
    resample_kernels.resize(levels, torch.zeros(3, height, width), resample_kernels.cubics)

for size in ((1, 1), (3, 4), (9, 1)):
    image, blurred = rng.random((2, *size))
    run(blur_kernels.blur, image, np.array([0.4, 0.2, 0.1, 0.0]), np.zeros(size[1] + 6), blurred)

place, distance = 40 * rng.random((2, 30, 2)) - 10, rng.random((2, 30)) + 0.5
near, seen = np.full((2, 17, 19), -1, single), np.full((2, 17, 19), -1)
given = place, distance, distance > 0.6, np.arange(30).reshape(-1, 3), np.arange(10)
run(rasterise_kernels.draw_triangles, *given, near, seen)
print("checked")
"""


@pytest.mark.skipif(not compiler.AVAILABLE, reason="numba is not installed")
def test_no_index_is_out_of_range() -> None:
    environment = {**os.environ, "TORCHCSS_CHECK_KERNELS": "1"}
    run = [sys.executable, "-c", CHECK]
    done = subprocess.run(run, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout == "checked\n", done.stderr

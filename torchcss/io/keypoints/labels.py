"""YOLO's pose labels: a folder of one text file for every picture in which somebody was found.

A line is a person: class, box, then x, y or x, y, confidence of every joint as fractions of the
image, then maybe the box's confidence and a track's number. The frames of a video are counted from
1; of pictures the files have the names.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import read_text, shortened
from torchcss.io.keypoints.frames import files_of, plain_name
from torchcss.io.keypoints.people import LAYOUT_SIZES, Frames, People, Person, Size, screened

_BOX = 5
_COUNTS = (17, 26, 133)


def read_labels(folder: Path, image_size_wh: Size) -> People:
    """Read the labels of a video or of a folder of pictures.

    Raises:
        KeypointError: If a line is none; the message names it.
    """
    files = [file for file in files_of(folder, ".txt") if file.name != "classes.txt"]
    frames: Frames = {}
    for file in files:
        lines = read_text(file, KeypointError).splitlines() if file.stat().st_size else []
        frames[plain_name(file.name)] = [
            _person(f"{file}: line {number}", line.split(), image_size_wh)
            for number, line in enumerate(lines, start=1)
            if line.strip()
        ]
        numbers = [person.track for person in frames[plain_name(file.name)]]
        if len(files) == 1 and 1 < len({*numbers} - {None}) < len(numbers) / 2:
            raise KeypointError(
                f"{file}: {len(numbers)} people under {len({*numbers})} numbers: of several "
                "frames, it seems; expected a file for each, as model.track(VIDEO, save_txt=True) "
                "writes"
            )
    return People(frames, None, [f"format: YOLO, {len(files)} files"], first=1)


def _person(where: str, words: list[str], image_size_wh: Size) -> Person:
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.zeros(0)
    count = len(values) - _BOX
    # Behind the joints may stand the box's confidence and the track; other data sets have other
    # numbers of joints, whose labels have neither.
    sizes = [(n, 3, 0) for n in LAYOUT_SIZES if 3 * n == count]
    sizes += [(n, size, more) for size in (3, 2) for more in (0, 1, 2) for n in _COUNTS
              if n * size + more == count]  # fmt: skip
    if not sizes:
        raise KeypointError(
            f"{where}: expected YOLO's pose labels, class, box and x, y, confidence of a known "
            f"number of joints; found {shortened(' '.join(words))} ({len(words)} numbers)"
        )
    num_joints, size, more = sizes[0]
    joints = values[_BOX : _BOX + num_joints * size].reshape(num_joints, size)
    if not (np.abs(joints[:, :2]) <= 2).all():
        raise KeypointError(f"{where}: expected fractions of the image, found {joints.max():g}")
    seen = (joints[:, :2] != 0).any(1)
    places = np.where(seen[:, None], joints[:, :2] * image_size_wh, np.nan)
    confidence = joints[:, 2] if size == 3 else None
    track = str(int(values[-1])) if more == 2 or (more == 1 and values[-1] >= 1) else None
    return Person(screened(places, confidence), track)

"""2D joints in OpenPose's JSON: one file for every frame, `people` with flat triples."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import load_json
from torchcss.io.keypoints.people import People, check_counts, stack, triples
from torchcss.io.video import natural_order


def read_openpose_folder(path: Path) -> People:
    """Read one file for every frame."""
    try:
        files = sorted(path.glob("*.json"), key=lambda entry: natural_order(entry.name))
    except OSError as error:
        raise KeypointError(f"{path}: cannot be read: {error.strerror}") from error
    if not files:
        raise KeypointError(
            f"{path}: no JSON files in this folder; expected OpenPose's, one for every frame"
        )
    numbers = [re.findall(r"[0-9]+", file.stem) for file in files]
    if all(numbers):
        places = [int(found[-1]) for found in numbers]
        for file, before, after in zip(files[1:], places[:-1], places[1:], strict=True):
            if after != before + 1:
                raise KeypointError(
                    f"{path}: expected one file for every frame, but {file.name} follows number "
                    f"{before}; write empty files for frames without people"
                )
    frames = [openpose_people(file, load_json(file, KeypointError)) for file in files]
    check_counts(path, frames)
    return People(frames, None, [f"format: OpenPose, {len(files)} files"])


def openpose_people(path: Path, content: object) -> np.ndarray:
    """All people `[p j 3]` of one file's content."""
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list):
        raise KeypointError(f"{path}: not an OpenPose file; expected a list 'people'")
    return stack(
        path,
        [
            triples(
                person.get("pose_keypoints_2d") if isinstance(person, dict) else None,
                f"{path}: people[{index}].pose_keypoints_2d",
            )
            for index, person in enumerate(people)
        ],
    )

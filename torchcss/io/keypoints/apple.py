"""Apple's names of joints, which Vision and ARKit share: Vision's y counts upwards, ARKit's down.

Both give fractions of the picture. `head_joint` is the nose, `left_upLeg_joint` the hip.
"""

from __future__ import annotations

import re

import numpy as np

from torchcss.io.keypoints.people import People, with_joints

_PLACES = {
    "head": "nose", "forearm": "elbow", "hand": "wrist", "upLeg": "hip", "leg": "knee",
    "foot": "ankle",
}  # fmt: skip
_HIPS = "left_upLeg_joint", "right_upLeg_joint"
_SHOULDERS = "left_shoulder_1_joint", "right_shoulder_1_joint"

_LARGEST_FRACTION = 2.0


def in_plain_words(people: People) -> People:
    """People with Apple's names in the words of detectors, y downwards; others as they are."""
    names = people.names or ()
    if not {*_HIPS, *_SHOULDERS} <= {*names}:
        return people
    everyone = [person.joints for frame in people.frames.values() for person in frame]
    if not everyone or any(len(joints) != len(names) for joints in everyone):
        return people
    joints = np.stack(everyone)
    seen = joints[joints[..., 2] > 0]
    people = people._replace(names=tuple(map(_plain, names)))
    if not len(seen) or not (np.abs(seen[:, :2]) <= _LARGEST_FRACTION).all():  # pixels
        return people
    people, report = people._replace(corner_fractions=True), people.report
    columns = [names.index(name) for name in (*_SHOULDERS, *_HIPS)]
    trunks = joints[(joints[:, columns, 2] > 0).all(1)][:, columns, 1]
    if not len(trunks) or (trunks[:, :2].mean(1) > trunks[:, 2:].mean(1)).mean() <= 0.5:
        return people
    return people._replace(
        frames=with_joints(people.frames, lambda joints: joints * (1, -1, 1) + (0, 1, 0)),
        report=[*report, "y counts upwards, as in Apple's Vision: turned over"],
    )


def _plain(name: str) -> str:
    match = re.fullmatch(r"(left_|right_|)([A-Za-z]+)(_1)?_joint", name)
    return name if match is None else f"{match[1]}{_PLACES.get(match[2], match[2])}"

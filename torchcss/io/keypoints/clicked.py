"""2D joints that somebody clicked, by name, in one frame or some: our own JSON.

`{"joints": {"l_wrist": [u, v]}}` for one frame, `{"frames": {"0": {...}}}` for some.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from torchcss.errors import KeypointError
from torchcss.files import shortened, unexpected
from torchcss.io.keypoints.json_people import JOINTS, PEOPLE, one_person
from torchcss.io.keypoints.people import Frames, People, Size, united


def is_clicked(content: Mapping[str, Any]) -> bool:
    """Whether a file is of our own format: joints by name, of one frame or of some."""
    if isinstance(content.get("joints", []), dict):
        return True
    frames = content.get("frames")
    detected = {*PEOPLE, *JOINTS} - {"joints"}
    if not isinstance(frames, dict):
        return False
    if any(isinstance(each, list) and isinstance((each or [0])[0], (dict, list))
           for each in frames.values()):  # fmt: skip
        return False
    named = [each for each in frames.values() if isinstance(each, dict)]
    inner = [one for each in named for one in each.values() if isinstance(one, dict)]
    return not any(each.keys() & detected for each in (*named, *inner))


def read_clicked(content: Mapping[str, Any], image_size_wh: Size) -> People:
    """Read joints by name, for one frame or for some."""
    size = content.get("image_size_wh")
    if size is not None and size != list(image_size_wh):
        raise KeypointError(
            f"clicked in images of {shortened(size)} pixels, "
            f"the video has {list(image_size_wh)}; click in this video"
        )
    frames = content.get("frames", {"0": content.get("joints")})
    if not isinstance(frames, dict) or not frames:
        raise unexpected(KeypointError, "", "'frames' to name frames", frames)
    clicked: Frames = {}
    for key, joints in frames.items():
        if not re.fullmatch(r"[0-9]{1,6}", key):
            raise unexpected(KeypointError, "", "a frame number", key)
        joints = joints.get("joints", joints) if isinstance(joints, dict) else joints
        if not isinstance(joints, dict):
            raise unexpected(KeypointError, f"frame {key}", "joints by name", joints)
        rows = {
            name: [*place, 1.0] if isinstance(place, list) and len(place) == 2 else place
            for name, place in joints.items()
        }
        clicked[int(key)] = one_person(f"frame {key}", rows) if rows else []
    found, names = united(clicked)
    return People(found, names, ["format: clicked joints"], first=0, by_hand=True)

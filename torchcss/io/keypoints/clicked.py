"""2D joints that somebody clicked, by name, in one frame or some: our own JSON.

`{"joints": {"l_wrist": [u, v]}}` for one frame, `{"frames": {"0": {...}}}` for some.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from torchcss.errors import KeypointError
from torchcss.files import real_numbers, shortened, unexpected
from torchcss.io.keypoints.json_people import JOINTS, PEOPLE
from torchcss.io.keypoints.people import Frames, People, Person, Size, united


def is_clicked(content: Mapping[str, Any]) -> bool:
    """Whether a file is of our own format: joints by name, of one frame or of some."""
    if isinstance(content.get("joints", []), dict):
        return True
    frames = content.get("frames")
    detected = {*PEOPLE, *JOINTS} - {"joints"}
    return isinstance(frames, dict) and not any(
        each.keys() & detected
        if isinstance(each, dict)
        else isinstance(each, list) and bool(each) and isinstance(each[0], (dict, list))
        for each in frames.values()
    )


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
        named = _clicked_joints(f"frame {key}", joints)
        clicked[int(key)] = [Person.by_name(named)] if named else []
    found, names = united(clicked)
    return People(found, names, ["format: clicked joints"], first=0, by_hand=True)


def _clicked_joints(where: str, joints: object) -> dict[str, list[float]]:
    """u, v and confidence of the joints of a frame, by name."""
    if isinstance(joints, dict) and isinstance(joints.get("joints"), dict):
        joints = joints["joints"]
    if not isinstance(joints, dict):
        raise unexpected(KeypointError, where, "joints by name", joints)
    found = {}
    for name, place in joints.items():
        values = real_numbers(place, f"{where}: {name}", KeypointError)
        if values.shape not in ((2,), (3,)):
            raise KeypointError(
                f"{where}: {name}: expected [u, v] or [u, v, confidence], found {shortened(place)}"
            )
        found[name] = [*values.tolist(), 1.0][:3]
    return found

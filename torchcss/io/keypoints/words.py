"""What files of 2D joints call things: one table for tables, JSON and arrays.

Words are compared without case and separators: `Frame Idx`, `frame_idx` and `frameIdx` are one.
Call `first_of`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import lru_cache
from typing import TypeVar

from torchcss.joint_names import names_in

Value = TypeVar("Value")

FRAMES = names_in(
    "frame framenumber frameindex frameidx frameid frameno framenum framenr frames fnum nframe "
    "frameids frameindices framenumbers videoframe frame# # imageid imgid"
)
"""The number of a frame."""

TIMES: dict[str, float | None] = {
    **dict.fromkeys(("timestampms", "timems", "milliseconds"), 1e-3),
    **dict.fromkeys(("timestampus", "timeus"), 1e-6),
    **dict.fromkeys(("timestampns", "timens", "nanoseconds"), 1e-9),
    **dict.fromkeys(("timestamps", "times", "timesec", "timeseconds", "seconds"), 1.0),
    **dict.fromkeys(("timestamp", "time", "timecode", "t", "ts"), None),
}
"""A time, and its unit in seconds, where the word says it."""

PICTURES = names_in(
    "imageid filename image imagename imgname imagepath imgpath imagefile img file filepath "
    "framename picture"
)
"""The name of a frame's picture."""

TRACKS = names_in(
    "trackid track trackname tracking trackingid idx personid person personidx personname "
    "individual individuals instanceid instance objectid subjectid subject playerid player person "
    "identity bodyid pid tid id"
)
"""That by which a person is known again in another frame."""

VIDEOS = names_in(
    "video videoname videoid videopath videofile clip clipname camera cameraid cameraname "
    "cam camid view port"
)
"""Which of several videos an entry belongs to."""

CONFIDENCES = names_in(
    "confidence conf confidencescore c score s keypointscore kptscore likelihood p prob "
    "probability certainty accuracy accu visibility visible vis v presence inframelikelihood"
)
"""The confidence of a joint, the best first where there are several."""

JOINT_WORDS = (
    *(f"{of}{what}"
      for of in names_in("landmark joint keypoint kpt bodypart part node marker point")
      for what in ("", "s", "name", "id", "index", "idx", "type")),
    *names_in("name label class classname id index idx classid type"),
)  # fmt: skip
"""The name of a joint, or else its number."""

SCORES = (
    *names_in("keypointscores keypointsscores scores confidences keypointsconf keypointconfidences "
              "keypointsconfidence keypointconfidence keypointscore likelihoods keypointsvisible "
              "keypointsvisibility"),
    *CONFIDENCES,
)  # fmt: skip
"""The confidences of all joints together."""

ORDER_NAMES = names_in(
    "jointnames keypointnames keypointid2name keypointsnames nodenames landmarknames bodyparts "
    "names labels joints keypoints"
)
"""The names of the joints in their order."""

SIZES = names_in("imagesizewh imagesize imgsize resolution videosize framesize")
"""Width and height in this order."""

SHAPES = names_in("origshape orishape imgshape imageshape inputshape frameshape imagesizehw")
"""Height and width in this order, and a number of colours it may be (Ultralytics, MMPose)."""

SIDES = tuple(
    (f"{of}width", f"{of}height")
    for of in ("canvas", "image", "video", "frame", "img", "original", "")
)
"""Width and height by themselves."""


@lru_cache(4096)
def plain_word(word: str) -> str:
    """A word in small letters, without what parts it."""
    return re.sub(r"[^a-z0-9#]", "", word.lower())


def first_of(
    entry: Mapping[str, Value], words: Sequence[str], kinds: type | tuple[type, ...] = object
) -> Value | None:
    """What stands under the first of some words that is there, and is of a kind and not None."""
    items = reversed([*entry.items()])
    found = {plain_word(k): v for k, v in items if v is not None and isinstance(v, kinds)}
    return next((found[word] for word in words if word in found), None)


def key_of(entry: Iterable[str], words: Sequence[str]) -> str | None:
    """The key that is the first of some words, whatever stands under it."""
    found = {plain_word(key): key for key in entry}
    return next((found[word] for word in words if word in found), None)


def time_word(words: Iterable[str]) -> str | None:
    """Which of the words is a time's, the one that says most if there are several."""
    plain = {plain_word(word) for word in words}
    return next((word for word in TIMES if word in plain), None)


def seconds_in(text: str) -> float | None:
    """The seconds of a time as text: `1:02:03.5`, `02:03,5`, a date with a time; None: it is none.

    A time code whose last number counts frames is none.
    """
    if match := re.fullmatch(r"(?:([0-9]{1,4}):)?([0-9]{1,2}):([0-9]{1,2}(?:[.,][0-9]+)?)", text):
        hours, minutes, seconds = match.groups("0")
        return 3600.0 * int(hours) + 60 * int(minutes) + float(seconds.replace(",", "."))
    with suppress(ValueError, OverflowError):
        if re.match("[0-9]{4}-[0-9]{2}-[0-9]{2}[T ]", text):
            return datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp()
    return None


def track_text(value: float | str) -> str | None:
    """By what a person is known again, as text; None: the file does not know him."""
    text = re.sub(r"\.0*$", "", str(value))
    return None if text.lower() in ("-1", "", "nan", "none", "null") else text

"""Which frame of the video everything in a keypoint file belongs to.

Files that only have an order must have an entry for every frame. Others say numbers, times or the
names of pictures, and may leave out frames in which nobody is seen.

Call `in_order`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import shortened
from torchcss.io.keypoints.people import Frames, Key, People, Person
from torchcss.io.keypoints.words import TIMES

FRAMES_AT_MOST = 1_000_000

_EMPTY_AT_MOST = 100_000
"""Frames that a file may leave out where the video's length is not known; each takes memory."""


class Film(NamedTuple):
    """What is known of the video.

    Attributes:
        num_frames: Its number of frames; None: as many as the file has.
        names: Names of the pictures, if it is a folder of them.
        rate: Frames per second.
        times: Tells when each frame is shown, seconds from the first; None: it does not know.
    """

    num_frames: int | None = None
    names: Sequence[str] | None = None
    rate: float | None = None
    times: Callable[[], Sequence[float] | None] = lambda: None


def in_order(people: People, film: Film, report: list[str]) -> list[list[Person]]:
    """The people of every frame of the video; frames that the file leaves out are empty.

    Args:
        people: What was found in it.
        film: The video.
        report: Gets a line for everything that was assumed.

    Raises:
        KeypointError: If it is not clear which frames the entries are.
    """
    frames = people.frames
    if people.in_order:
        return [*frames.values()]
    if frames and all(isinstance(key, float) for key in frames):
        places = _by_time([float(key) for key in frames], film, report)
    elif (by_name := _by_name(frames, film, report)) is not None:
        places = by_name
    else:
        places = _by_number(people, list(frames), film, report)
    known = [(place, key) for place, key in zip(places, frames, strict=True) if place is not None]
    found = {place: frames[key] for place, key in known}
    if len(found) < len(known):
        again = next(place for place, key in known if frames[key] is not found[place])
        both = " and ".join(shortened(key) for place, key in known if place == again)
        raise KeypointError(
            f"two entries of one frame, {both}; expected one video, each frame once, numbered or "
            "named"
        )
    total = max(max(found, default=-1) + 1, film.num_frames or 0)
    if film.num_frames is not None and total > film.num_frames:
        named = film.names is None and any(isinstance(key, str) for key in frames)
        raise wrong_count(film.num_frames, total, named=named)
    if total > FRAMES_AT_MOST:
        raise KeypointError(f"{total - 1} is not a frame number; number the frames from 0")
    if film.num_frames is None and total - len(found) > _EMPTY_AT_MOST:
        raise KeypointError(
            f"{len(found)} frames are in the file, the last is number {total - 1}: number the "
            "frames from 0, or leave only the one that is meant in the file"
        )
    if len(found) < total:
        report.append(f"{len(found)} of {total} frames are in the file, the others have nobody")
    return [found.get(index, []) for index in range(total)]


def wrong_count(expected: int, found: int, *, named: bool = False) -> KeypointError:
    """The error for a file that has other frames than the video, maybe by pictures' names."""
    cut_off = ", or get a complete copy of it if it is cut off" if found > expected else ""
    cut_off += ", or give the folder of the pictures as the video" if named else ""
    return KeypointError(
        f"expected {expected} frames, as the video has, found {found}; "
        f"make the keypoints from this very video{cut_off}"
    )


def files_of(folder: Path, suffix: str) -> list[Path]:
    """The files of a kind in order; those that begin with a dot are the system's."""
    named = (entry for entry in folder.iterdir() if not entry.name.startswith("."))
    return sorted(entry for entry in named if entry.suffix.lower() == suffix)


def check_one_video(names: Collection[Any]) -> None:
    """Refuse entries of several videos.

    Raises:
        KeypointError: If there is more than one name.
    """
    if len(names) > 1:
        videos = shortened(", ".join(sorted(map(str, names))))
        raise KeypointError(f"entries of {len(names)} videos, {videos}; expected those of one")


def in_seconds(time: str, frames: Frames) -> Frames:
    """The times of frames in seconds; where the word says no unit, no frame lasts a second."""
    unit = TIMES[time]
    if unit is None:
        gap = float(np.diff(np.sort(np.array(list(frames), float))).min(initial=np.inf))
        most = {1.0: 1.0, 1000.0: 1e-3, 5e6: 1e-6, np.inf: 1e-9}  # of a gap, and what counts it
        unit = next((each for end, each in most.items() if gap < end), 1.0)
    return {unit * float(key): people for key, people in frames.items()}


def plain_name(name: str) -> str:
    """The name of a picture without folder, suffixes and what programs append to it."""
    last = PurePosixPath(name.replace("\\", "/")).name.lower()
    last = re.sub(r"\.(json|txt|predictions)$", "", last)
    last = re.sub(r"\.(jpe?g|png|bmp|tiff?|webp|pgm|ppm)$", "", last)
    last = re.sub(r"_(jpe?g|png|bmp)\.rf\.[0-9a-z]+$", "", last)  # Roboflow's
    return re.sub(r"\.(json|predictions)$|_keypoints$|_pose$", "", last)


def _by_name(
    frames: Mapping[Key, object], film: Film, report: list[str]
) -> list[int | None] | None:
    """Places of the pictures; None if the video has no such pictures."""
    names = {plain_name(name): index for index, name in enumerate(film.names or ())}
    if len(names) < len(film.names or ()):
        return None
    places = [names.get(plain_name(key)) if isinstance(key, str) else None for key in frames]
    known = sum(place is not None for place in places)
    if not known:
        # Whoever pads numbers otherwise, or says only the number, means the same picture if it
        # cannot be the frame's place.
        bare = {_unpadded(name): index for name, index in names.items()}
        places = [bare.get(_unpadded(str(key))) for key in frames]
        named = any(re.match(r"[^0-9]", plain_name(str(key))) for key in frames)
        beyond = all(str(key).isdecimal() and int(key) >= len(names) for key in frames)
        if len(bare) < len(names) or None in places or not (named or beyond):
            return None
        known = len(places)
    report.append("frames by the names of the pictures")
    if known < len(places):
        report.append(
            f"{len(places) - known} entries left out, whose pictures are not in the video"
        )
    return places


def _unpadded(name: str) -> str:
    return re.sub(r"0*([0-9]+)", r"\1", plain_name(name))


def _by_number(people: People, keys: Sequence[Key], film: Film, report: list[str]) -> list[int]:
    numbers = _numbers(keys)
    if people.whole and None in numbers:
        if film.num_frames not in (None, len(keys)):
            raise wrong_count(film.num_frames or 0, len(keys))
        report.append("frames in the order of the names")
        return list(range(len(keys)))
    if None in numbers:
        raise KeypointError(
            f"{shortened(keys[numbers.index(None)])} has no frame number of its own; "
            "number the images, or give the folder of pictures as the video"
        )
    places = [number for number in numbers if number is not None]
    if min(places, default=0) < 0:
        raise KeypointError(f"{min(places)} is not a frame number; number them from 0")
    first = _first(people, places, film.num_frames)
    doubt = ", of which the file has nothing: if it counts from 1, all are a frame late"
    known = first != 0 or min(places, default=0) != 1
    report.append(f"frame {first} is the first frame{'' if known else doubt}")
    return [place - first for place in places]


def _first(people: People, places: Sequence[int], num_frames: int | None) -> int:
    """Which number the first frame has."""
    low, high = min(places, default=0), max(places, default=0)
    # Numbers from the midst of the video are its own: of the frames that somebody looked at.
    within = num_frames is not None and 1 < low <= high <= num_frames
    if not places or (people.whole and not within):
        lost = people.first == 0 and low == 1 and high < (num_frames or 0)  # the first of all
        return 0 if lost else low
    if num_frames is not None and high - low + 1 == num_frames and low > 1:
        return low
    if num_frames is not None and low > num_frames:
        raise KeypointError(
            f"frames {low} to {high} for a video of {num_frames}: which of them is the "
            "first is not known; number them from 0, or give the folder of pictures as the video"
        )
    if people.first is not None:
        return min(people.first, low)
    return 1 if low and high == num_frames else 0


def _numbers(keys: Sequence[Key]) -> list[int | None]:
    """The numbers of frames; of a picture's name the last one that not all names have."""
    digits = [re.findall(r"[0-9]+", plain_name(str(key))) for key in keys]
    ends = range(-1, -1 - min(map(len, digits), default=0), -1)
    at = next((end for end in ends if len({each[end] for each in digits}) > 1), -1)
    return [
        key if isinstance(key, int)
        else int(each[at]) if each and len(each[at]) <= 12 and not str(key).startswith("-")
        else None
        for key, each in zip(keys, digits, strict=True)
    ]  # fmt: skip


def _by_time(times: Sequence[float], film: Film, report: list[str]) -> list[int]:
    """Places by time; the interval is the video's, or else the shortest one between entries."""
    order = np.argsort(times)
    sorted_times = np.array(times)[order]
    places = np.empty(len(times), int)
    if len(times) == film.num_frames:
        places[order] = np.arange(len(times))
        report.append("as many times as frames: taken in order")
        return places.tolist()
    gaps = np.diff(sorted_times)
    if film.rate is None and not (len(gaps) and gaps.min() > 0):
        raise KeypointError("times do not rise from entry to entry; number the frames")
    with np.errstate(all="ignore"):
        interval = 1 / film.rate if film.rate else _interval(gaps)
        start = 0.0
        if film.num_frames is not None and sorted_times[-1] > (film.num_frames - 0.5) * interval:
            start = float(sorted_times[0])
        since = sorted_times - start
        found, grid = np.round(since / interval), f"one every {interval:.4g} s"
        if (shown := film.times()) is not None and len(shown) > 1:
            # Of a film whose rate varies: programs tell the true time, or count by the mean rate.
            true = np.array(shown)
            nearest = np.searchsorted(0.5 * (true[1:] + true[:-1]), since)
            if np.abs(true[nearest] - since).max() < np.abs(found * interval - since).max():
                found, grid = nearest, "as the video shows them"
    if not ((found >= 0) & (found < FRAMES_AT_MOST)).all():
        raise KeypointError(
            f"times from {sorted_times[0]:.4g} to {sorted_times[-1]:.4g} s, one every "
            f"{interval:.3g} s, are no video's; number the frames"
        )
    places[order] = found
    report.append(f"frames by their times, {grid}, the first at {start:.4g} s")
    return places.tolist()


def _interval(gaps: np.ndarray) -> float:
    """The time of a frame, of which all gaps are about a multiple."""
    return float(gaps.sum() / np.round(gaps / gaps.min()).sum())

"""What every reader of 2D joints returns, all detections of a file; and what all readers need."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from torchcss.errors import KeypointError
from torchcss.files import real_numbers, unexpected
from torchcss.io.keypoints.words import TRACKS, first_of, track_text
from torchcss.joint_names import ALIASES

Key = int | float | str
"""The number of a frame, its time in seconds, or the name of its picture."""

Names = tuple[str, ...]
"""Names of joints, in their order."""

LAYOUT_SIZES = frozenset(map(len, ALIASES.values()))
"""How many joints people have."""

MOST_JOINTS = max(LAYOUT_SIZES)
"""No layout has so many joints: a larger number is not a joint's."""

Size = tuple[int, int]
"""Width and height of an image in pixels."""


class Person(NamedTuple):
    """A person in one frame.

    Attributes:
        joints: u, v and confidence of every joint.
        track: By what the file knows the person again in other frames; None: it does not.
        names: Names of these joints, in files that may name everyone's otherwise.
    """

    joints: Float[np.ndarray, "j 3"]
    track: str | None = None
    names: Names | None = None

    @classmethod
    def by_name(cls, joints: Mapping[str, Sequence[float]], track: str | None = None) -> Person:
        """A person of u, v and confidence of every joint by its name."""
        return cls(np.array(list(joints.values())).reshape(-1, 3), track, tuple(joints))


Frames = dict[Key, list[Person]]
"""The people of every frame that a file tells of."""


class People(NamedTuple):
    """All detections of a file.

    Attributes:
        frames: The people of every frame, by number, time or picture.
        names: The file's own joint names, or None where it has only an order.
        report: Lines for the user.
        layout: The layout, where the format says it.
        in_order: The frames are those of the video, one after the other; else the file says which
            they are, and may leave out some in which nobody is seen.
        corner_fractions: Coordinates are pixels, or fractions of the image from its corner.
        first: The number of the first frame, where the format says it.
        whole: All frames are there that were looked at: the lowest number is the first frame, but
            where the video goes on before and behind them.
        size_wh: Size of the images in which the file's pixels count, if it says so.
        relative_noise: Standard deviation of a place of confidence 1, in multiples of what
            detectors have.
        by_hand: Somebody typed the names, so that one that is not known is an error.
    """

    frames: Frames
    names: Names | None
    report: list[str]
    layout: str | None = None
    in_order: bool = False
    corner_fractions: bool = False
    first: int | None = None
    whole: bool = False
    size_wh: tuple[float, float] | None = None
    relative_noise: float = 1.0
    by_hand: bool = False


def united(frames: Frames) -> tuple[Frames, Names | None]:
    """People whose joints are all in one order, and the names; joints that someone lacks are zero.

    Raises:
        KeypointError: If some have names and others not, or one has a name twice.
    """
    everyone = [person for people in frames.values() for person in people]
    if all(person.names is None for person in everyone):
        return frames, None
    names = tuple(dict.fromkeys(name for person in everyone for name in person.names or ()))
    place = {name: index for index, name in enumerate(names)}
    found: Frames = {key: [] for key in frames}
    for key, people in frames.items():
        for person in people:
            if person.names is None or len(set(person.names)) < len(person.joints):
                raise unexpected(
                    KeypointError, f"{key}", "a name of its own for every joint", person.names
                )
            joints = np.zeros((len(names), 3))
            joints[[place[name] for name in person.names]] = person.joints
            found[key].append(Person(joints, person.track))
    return found, names


def with_joints(frames: Frames, change: Callable[[np.ndarray], np.ndarray]) -> Frames:
    """The same people with other joints.

    Args:
        frames: The people.
        change: What makes them of someone's joints `[j 3]`.
    """
    return {
        key: [person._replace(joints=change(person.joints)) for person in people]
        for key, people in frames.items()
    }


def one_size(sizes: Collection[Any]) -> Any:
    """The size of all pictures, None if they say none.

    Raises:
        KeypointError: If there are several.
    """
    if len(sizes) > 1:
        raise KeypointError("pictures of several sizes; expected those of one video")
    return next(iter(sizes), None)


def joint_counts(frames: Frames) -> set[int]:
    """How many joints people have."""
    return {len(person.joints) for people in frames.values() for person in people}


def number_array(value: object, where: str) -> np.ndarray:
    """Nested lists of numbers, in which null is NaN, as an array.

    Raises:
        KeypointError: If it is ragged or holds anything else.
    """
    return real_numbers(_without_null(value), where, KeypointError)


def _without_null(value: object) -> object:
    if isinstance(value, list):
        return [_without_null(entry) for entry in value]
    return np.nan if value is None else value


def screened(
    places: Float[np.ndarray, "*b 2"], confidence: Float[np.ndarray, "*b"] | float | None = None
) -> Float[np.ndarray, "*b 3"]:
    """Places with their confidence, which is 0 where there is no place.

    Args:
        places: u and v; NaN where there is none.
        confidence: Of each; NaN or None where the file does not say: 1, but at (0, 0) or (-1, -1),
            which is how many programs write what is not there, 0.
    """
    given = np.broadcast_to(np.nan if confidence is None else confidence, places.shape[:-1])
    assumed = ((places != 0).any(-1) & (places != -1).any(-1)).astype(np.float64)
    given = np.where(np.isnan(given), assumed, given)[..., None]
    seen = ~np.isnan(places).any(-1, keepdims=True)
    return np.where(seen, np.concatenate([places, given], axis=-1), 0.0)


def is_there(joints: Float[np.ndarray, "j 3"]) -> bool:
    """Whether a person is there at all: someone whose joints are all NaN or zero is nobody."""
    places = np.nan_to_num(joints[:, :2], posinf=1.0, neginf=1.0)
    return bool((np.nan_to_num(joints[:, 2]) > 0).any() or places.any())


def keep_places(frames: Iterable[Sequence[Float[np.ndarray, "j 3"]]]) -> bool:
    """Whether the place in a frame says who somebody is, as Pose2Sim and tracked arrays have it.

    Then who is not there is NaN, or zeros before somebody else; zeros at the end fill up an array.
    """
    for people in frames:
        there = [is_there(joints) for joints in people]
        gone = there.index(False) if False in there else len(there)
        if any(there[gone:]) or any(np.isnan(joints[:, :2]).all() for joints in people[gone:]):
            return True
    return False


def track_of(entry: Mapping[str, object], names: Sequence[str] = TRACKS) -> str | None:
    """By what a file knows a person again, out of what it says of him."""
    value = first_of(entry, names)
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    return track_text(value)

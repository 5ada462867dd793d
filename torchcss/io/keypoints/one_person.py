"""Which of several people is the one: as the user says at first, then by continuity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from torchcss.errors import KeypointError
from torchcss.io.keypoints.people import Size
from torchcss.types import ColourImage

_JUMP = 0.5
"""How far (in sizes of the person) a person may move from one frame to the next and be the same."""


class Whom(NamedTuple):
    """Who is to be followed.

    Attributes:
        frame: The frame in which the person is chosen.
        person: `prominent`, `largest`, `leftmost` or `centre` in that frame, or the file's track.
        image_size_wh: Size of the image, of which the centre is meant.
    """

    frame: int
    person: str
    image_size_wh: Size

    def choose(self, people: np.ndarray, tracks: list[str | None]) -> int:
        """The person's place among those of the frame.

        Raises:
            KeypointError: If nobody is called so.
        """
        there = [(person[:, 2] > 0.0).any() for person in people]
        middles = np.array(
            [_middle(p) if seen else (np.inf,) * 2 for p, seen in zip(people, there, strict=True)]
        )
        away = np.linalg.norm(middles - 0.5 * np.array(self.image_size_wh), axis=1)
        ranks = {
            "prominent": [-person[:, 2].sum() * size_of(person) for person in people],
            "largest": [-size_of(person) for person in people],
            "leftmost": middles[:, 0],
            "centre": away,
        }
        if self.person in ranks:
            return int(np.argmin(ranks[self.person]))
        if self.person in tracks:
            return tracks.index(self.person)
        known = ", ".join(repr(track) for track in tracks if track is not None) or "no numbers"
        raise KeypointError(
            f"person {self.person!r} is not in frame {self.frame}, where tracking starts; there "
            f"are {known}; or say largest, leftmost or centre"
        )


_CLOTHES = ("l_shoulder", "r_shoulder", "l_hip", "r_hip", "l_knee", "r_knee")
_INSIDE = (0.25, 0.5, 0.75)
_POINTS = np.array(
    [((1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b, 0, 0) for a in _INSIDE for b in _INSIDE]
    + [(0, 0, 1 - a, 0, a, 0) for a in _INSIDE]
    + [(0, 0, 0, 1 - a, 0, a) for a in _INSIDE]
)
"""Where clothes are looked at, in the trunk and along the thighs: shares of those joints."""

_PARTS = (slice(0, 9), slice(9, 15))
"""Which of these points lie in the trunk, which in the thighs."""

_NEW = 0.1
"""How much of what a person looks like is what the last frame shows: another may have hidden it."""


def colours_of(
    image: ColourImage, people: Float[np.ndarray, "p j 3"], names: Sequence[str]
) -> Float[np.ndarray, "p 2 3"]:
    """Mean colours of everybody's trunk and thighs, from 0 to 1; NaN where they are not seen.

    Args:
        image: The frame.
        people: Everybody's joints, pixels and confidence.
        names: What they are called; shoulders, hips and knees are needed.
    """
    joints = people[:, [list(names).index(name) for name in _CLOTHES]]
    at = (_POINTS @ joints[..., :2]).round()
    seen = ((joints[:, None, :, 2] > 0.0) | (_POINTS == 0.0)).all(-1)
    seen &= ((at >= 0) & (at < image.shape[1::-1])).all(-1)
    u, v = np.moveaxis(np.where(seen[..., None], at, 0.0).astype(int), -1, 0)
    colours = np.full((len(people), 2, 3), np.nan)
    for person, (where, those) in enumerate(zip(seen, image[v, u] / 255.0, strict=True)):
        for part, points in enumerate(_PARTS):
            if where[points].any():
                colours[person, part] = those[points][where[points]].mean(0)
    return colours


def identified(
    frames: Sequence[Float[np.ndarray, "p j 3"]], colours: Sequence[Float[np.ndarray, "p 2 3"]]
) -> list[list[int]]:
    """Who is who in a film, by motion and appearance: a number for everybody in every frame.

    Whoever is near enough to where a person was seen last, and nearest in place and colours, is
    that person.

    Args:
        frames: The people of every frame.
        colours: What they look like (`colours_of`).
    """
    known: dict[int, _Known] = {}
    numbers: list[list[int]] = []
    for index, (people, looks) in enumerate(zip(frames, colours, strict=True)):
        pairs = sorted(
            (distance + _unlikeness(last.colours, looks[place]), number, place)
            for number, last in known.items()
            for place, person in enumerate(people)
            if (distance := _distance(last.joints, person))
            <= _JUMP * (1.0 + 0.2 * (index - last.frame - 1))
        )
        own: dict[int, int] = {}
        for _, number, place in pairs:
            if place not in own and number not in own.values():
                own[place] = number
        for place, person in enumerate(people):
            number = own.setdefault(place, len(known))
            before = known[number].colours if number in known else looks[place]
            mixed = before + _NEW * (looks[place] - before)
            mixed = np.where(
                np.isnan(mixed), np.where(np.isnan(before), looks[place], before), mixed
            )
            known[number] = _Known(person, index, mixed)
        numbers.append([own[place] for place in range(len(people))])
    return numbers


class _Known(NamedTuple):
    """What is known of a person: the last joints, their frame, and the colours until then."""

    joints: np.ndarray
    frame: int
    colours: np.ndarray


def _unlikeness(before: np.ndarray, now: np.ndarray) -> float:
    """Mean distance of the colours of the parts that are known of both; none: 0."""
    apart = np.sqrt(np.square(before - now).sum(-1))
    known = apart[~np.isnan(apart)]
    return float(known.mean()) if len(known) else 0.0


def follow_person(
    frames: list[np.ndarray], tracks: list[list[str | None]], whom: Whom, report: list[str]
) -> np.ndarray:
    """Return `[t j 3]`: the person that is followed among those of every frame.

    Args:
        frames: The people of every frame, `[p j 3]`.
        tracks: By what the file knows each of them again; None where it does not.
        whom: Who is followed from where, by the file's own tracks, and where these end by
            continuity.
        report: Gets a line of what was done.

    Raises:
        KeypointError: If that person is not there.
    """
    first_frame, start = whom.frame, frames[whom.frame]
    place = whom.choose(start, tracks[first_frame])
    chosen = np.zeros((len(frames), start.shape[1], 3))
    most = max(map(len, frames))
    if most <= 1 and len({track for of in tracks for track in of}) <= 1:
        for row, frame in zip(chosen, frames, strict=True):
            row[:] = frame[0] if len(frame) else 0.0
        return chosen
    chosen[first_frame] = start[place]
    own, lost = tracks[first_frame][place], []
    for order in (range(first_frame + 1, len(frames)), range(first_frame - 1, -1, -1)):
        last, missed, track, others = chosen[first_frame], 0, own, _beside(own, tracks)
        for index in order:
            choice = _next(last, frames[index], tracks[index], track, others, missed)
            others |= {*tracks[index]} - {None}
            if choice is None:
                missed += 1
                lost.append(index)
                continue
            if tracks[index][choice] != track:
                track = tracks[index][choice]
                others |= _beside(track, tracks)
            last, missed = frames[index][choice], 0
            chosen[index] = last
    named = "" if own is None else f", {own!r} of the file,"
    which = {"prominent": "most prominent", "centre": "most central"}.get(whom.person, whom.person)
    rest = [str(track) for track in tracks[first_frame] if track not in (None, own)]
    report.append(
        f"up to {most} people in a frame: followed "
        + (f"the {which} one" if whom.person != own else "the one asked for")
        + f" of frame {first_frame}{named} by "
        + ("continuity" if own is None else "the file's tracks")
        + (f"; --person {' or '.join(rest)} follows another" if rest else "")
    )
    looked_at = [index for index, frame in enumerate(frames) if len(frame)]
    if lost := [index for index in lost if looked_at[0] <= index <= looked_at[-1]]:
        report.append(
            f"in {len(lost)} frames (first: {min(lost)}) nobody was near enough to be that person"
        )
    return chosen


def _beside(track: str | None, tracks: list[list[str | None]]) -> set[str | None]:
    """A track, and those that are seen together with it in some frame: they are other people."""
    return {each for together in tracks if track in together for each in together} - {None}


def _next(
    last: np.ndarray,
    people: np.ndarray,
    tracks: list[str | None],
    track: str | None,
    others: set[str | None],
    missed: int,
) -> int | None:
    """Who is the person in the next frame; None: nobody.

    Args:
        last: The person where it was seen last.
        people: Everybody of the frame.
        tracks: Their tracks.
        track: The person's track; who has it is the person, or of several the nearest.
        others: Tracks seen so far or beside the person's, which are other people.
        missed: Frames since the person was seen.
    """
    seen = [index for index, person in enumerate(people) if (person[:, 2] > 0.0).any()]
    if track is not None:
        same = [index for index in seen if tracks[index] == track]
        if len(same) == 1:
            return same[0]
        # Some programs number everybody alike.
        seen = same or [index for index in seen if tracks[index] not in others]
    distances = {index: _distance(last, people[index]) for index in seen}
    nearest = min(distances, key=distances.__getitem__, default=None)
    # After frames without the person it may have gone farther.
    if nearest is None or distances[nearest] > _JUMP * (1.0 + 0.2 * missed):
        return None
    return nearest


def sides_of(names: Sequence[str], place: str) -> list[int]:
    """Where the left and the right joint of a place stand; empty: one of them is missing."""
    pair = [f"{side}_{place}" for side in "lr"]
    return [list(names).index(name) for name in pair] if {*pair} <= {*names} else []


def _middle(person: np.ndarray) -> np.ndarray:
    """The mean place of a person's confident joints."""
    return person[person[:, 2] > 0.0, :2].mean(0)


def size_of(person: np.ndarray) -> float:
    """The diagonal of the box around a person's confident joints, at least one pixel."""
    points = person[person[:, 2] > 0.0, :2]
    return max(1.0, float(np.linalg.norm(np.ptp(points, axis=0)))) if len(points) else 1.0


def _distance(last: np.ndarray, person: np.ndarray) -> float:
    """Mean distance of the joints that both have, in sizes of the person."""
    size = max(size_of(last), size_of(person))
    both = (last[:, 2] > 0.0) & (person[:, 2] > 0.0)
    if both.any():
        gaps = last[both, :2] - person[both, :2]
    else:
        gaps = (_middle(last) - _middle(person))[None]
    return float(np.linalg.norm(gaps, axis=1).mean()) / size

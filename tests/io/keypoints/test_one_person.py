"""Who is who among several people of a film."""

import numpy as np
import pytest

from torchcss.io.keypoints.one_person import Whom, colours_of, follow_person, identified
from torchcss.joint_names import ALIASES

NAMES = [name or "" for name in ALIASES["COCO-17"]]
RED, BLUE, GREY = (200, 30, 40), (20, 60, 190), (120, 120, 120)
BUILD = {"shoulder": (8, 30), "hip": (6, 60), "knee": (6, 85), "ankle": (6, 110)}


def stands(u: float) -> np.ndarray:
    """Somebody who stands at this column."""
    joints = np.zeros((17, 3))
    for place, (aside, down) in BUILD.items():
        for side in (1, -1):
            joints[NAMES.index(f"{'l' if side > 0 else 'r'}_{place}")] = (u + side * aside, down, 1)
    return joints


def picture(people: list[tuple[float, tuple[int, int, int]]]) -> np.ndarray:
    """A grey room with people in clothes of one colour, the last in front."""
    image = np.full((120, 200, 3), GREY, np.uint8)
    for u, colour in people:
        image[25:115, max(0, round(u) - 10) : round(u) + 11] = colour
    return image


def test_people_who_pass_each_other_are_known_by_their_clothes() -> None:
    frames, colours, reds = [], [], []
    for t in range(9):
        red, blue = 60.0 + 10 * t, 140.0 - 10 * t
        image = picture([(red, RED), (blue, BLUE)])
        order = [red, blue][:: (-1) ** t]
        frames.append(np.array([stands(u) for u in order]))
        colours.append(colours_of(image, frames[-1], NAMES))
        reds.append(order.index(red))
    numbers = identified(frames, colours)
    assert {number for people in numbers for number in people} == {0, 1}
    who = [numbers[t][place] for t, place in enumerate(reds)]
    del who[4]  # where both stand at one place
    assert who == [who[0]] * 8
    numbers = identified(frames, [np.full_like(seen, np.nan) for seen in colours])
    assert numbers[8][reds[8]] != who[0]  # places alone say that they have turned back


def test_colours_are_those_inside() -> None:
    person = stands(50.0)
    (found,) = colours_of(picture([(50.0, RED)]), person[None], NAMES)
    assert found == pytest.approx(np.array([RED, RED]) / 255)
    person[NAMES.index("l_knee"), 2] = 0.0  # one thigh is enough
    (found,) = colours_of(picture([(50.0, RED)]), person[None], NAMES)
    assert found == pytest.approx(np.array([RED, RED]) / 255)
    assert np.isnan(colours_of(picture([]), stands(-300.0)[None], NAMES)).all()
    assert colours_of(picture([]), person[:0].reshape(0, 17, 3), NAMES).shape == (0, 2, 3)


def test_who_is_beside_somebody_in_a_later_frame_is_another() -> None:
    """The first is away when the second comes, near enough to be the first."""
    frames = [[stands(50.0)], [stands(60.0)], [stands(50.0), stands(60.0)]]
    tracks: list[list[str | None]] = [["a"], ["b"], ["a", "b"]]
    report: list[str] = []
    whom = Whom(0, "prominent", (200, 120))
    found = follow_person([np.array(each) for each in frames], tracks, whom, report)
    assert found[:, :, 2].any(1).tolist() == [True, False, True]

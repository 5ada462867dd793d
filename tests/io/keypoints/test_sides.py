"""Sides that change places in time are put back, and nothing else is."""

import numpy as np
import pytest

from torchcss.io.keypoints.sides import with_sides_put_back

NAMES = tuple(f"{side}_{place}" for place in ("hip", "knee", "ankle", "shoulder") for side in "lr")
LEGS, OTHER = [0, 1, 2, 3, 4, 5], [1, 0, 3, 2, 5, 4]


def walk(num: int = 60, rate: float = 30.0) -> np.ndarray:
    """Somebody walks across the picture, seen from the side: the legs pass each other."""
    t = np.arange(num) / rate
    reach = np.array([4.0, 30.0, 60.0, 8.0])[:, None] * np.array([1.0, -1.0])
    u = 100 + 80 * t[:, None, None] + reach * np.sin(2 * np.pi * 0.9 * t + 1.0)[:, None, None]
    v = np.broadcast_to(np.array([200.0, 300.0, 400.0, 100.0])[:, None], u.shape)
    noise = np.random.default_rng(0).normal(size=(*u.shape, 2))
    places = np.stack([u, v], -1) + noise
    return np.concatenate([places, np.ones((*u.shape, 1))], -1).reshape(num, 8, 3)


def put_back(joints: np.ndarray) -> tuple[np.ndarray, list[str]]:
    report: list[str] = []
    before = joints.copy()
    found = with_sides_put_back(joints, NAMES, report)
    assert (joints == before).all()
    return found, report


@pytest.mark.parametrize("rate", [30.0, 15.0, 10.0, 6.0])
def test_legs_that_pass_each_other_stay(rate: float) -> None:
    joints = walk(rate=rate)
    found, report = put_back(joints)
    assert (found == joints).all()
    assert not report


@pytest.mark.parametrize("frames", [[0, 1], [14], [40, 41, 42, 43], [7, 25, 26], [58, 59]])
def test_legs_that_change_places_are_put_back(frames: list[int]) -> None:
    given = walk()
    given[np.ix_(frames, LEGS)] = given[np.ix_(frames, OTHER)]
    found, report = put_back(given)
    assert np.allclose(found, walk())
    (line,) = report
    assert line.startswith("left and right of the legs change places")
    assert str(frames[0]) in line


def test_what_is_exchanged_in_the_whole_file_or_most_of_it_stays() -> None:
    given = walk()[:, [*OTHER, 7, 6]]
    assert (put_back(given)[0] == given).all()
    # Of two ways to have no jump the one that alters fewer frames.
    mixed = given.copy()
    mixed[56:] = walk()[56:]
    found, _ = put_back(mixed)
    assert np.allclose(found[:, LEGS], given[:, LEGS])


def test_a_gap_is_bridged_and_frames_with_nobody_stay_empty() -> None:
    given = walk()
    given[20:22] = 0.0
    truth = given.copy()
    given[np.ix_([22, 23], LEGS)] = given[np.ix_([22, 23], OTHER)]
    found, report = put_back(given)
    assert np.allclose(found, truth)
    assert "22, 23" in report[0]


def test_one_joint_that_errs_exchanges_nothing() -> None:
    given = walk()
    given[30, 4, 0] += 200.0
    given[40, [4, 5]] = given[40, [5, 4]]
    assert (put_back(given)[0] == given).all()


@pytest.mark.parametrize("num", [0, 1, 2, 3])
def test_short_files(num: int) -> None:
    given = walk(num)
    assert (put_back(given)[0] == given).all()


def test_without_pairs() -> None:
    joints = np.ones((5, 2, 3))
    assert (with_sides_put_back(joints, ("nose", "l_hip"), []) == joints).all()

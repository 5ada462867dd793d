"""Which of several people is the one: the most prominent at first, then by continuity."""

from __future__ import annotations

import numpy as np

_JUMP = 0.5
"""How far (in sizes of the person) a person may move from one frame to the next and be the same."""


def follow(frames: list[np.ndarray], first_frame: int, report: list[str]) -> np.ndarray:
    """Return `[t j 3]`: the person that continuity chooses among those of every frame."""
    num_joints = frames[first_frame].shape[1]
    chosen = np.zeros((len(frames), num_joints, 3))
    most = max(len(frame) for frame in frames)
    if most <= 1:
        for index, frame in enumerate(frames):
            if len(frame):
                chosen[index] = frame[0]
        return chosen
    start = frames[first_frame]
    chosen[first_frame] = start[int(np.argmax([_prominence(person) for person in start]))]
    lost = []
    for order in (range(first_frame + 1, len(frames)), range(first_frame - 1, -1, -1)):
        last, missed = chosen[first_frame], 0
        for index in order:
            candidates = [person for person in frames[index] if (person[:, 2] > 0.0).any()]
            distances = [_distance(last, person) for person in candidates]
            # After frames without the person it may have gone farther.
            if distances and min(distances) <= _JUMP * (1.0 + 0.2 * missed):
                last, missed = candidates[int(np.argmin(distances))], 0
                chosen[index] = last
            else:
                missed += 1
                lost.append(index)
    report.append(
        f"up to {most} people in a frame: "
        f"followed the most prominent one of frame {first_frame} by continuity"
    )
    if lost:
        report.append(
            f"in {len(lost)} frames (first: {min(lost)}) nobody was near enough to be that person"
        )
    return chosen


def size_of(person: np.ndarray) -> float:
    """The diagonal of the box around a person's confident joints, at least one pixel."""
    points = person[person[:, 2] > 0.0, :2]
    return max(1.0, float(np.linalg.norm(np.ptp(points, axis=0)))) if len(points) else 1.0


def _prominence(person: np.ndarray) -> float:
    """Sum of confidences times size: the largest and most certain person."""
    return float(person[:, 2].sum()) * size_of(person)


def _distance(last: np.ndarray, person: np.ndarray) -> float:
    """Mean distance of the joints that both have, in sizes of the person."""
    size = max(size_of(last), size_of(person))
    both = (last[:, 2] > 0.0) & (person[:, 2] > 0.0)
    if both.any():
        gaps = last[both, :2] - person[both, :2]
    else:
        gaps = (last[last[:, 2] > 0.0, :2].mean(0) - person[person[:, 2] > 0.0, :2].mean(0))[None]
    return float(np.linalg.norm(gaps, axis=1).mean()) / size

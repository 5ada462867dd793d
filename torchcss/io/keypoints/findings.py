"""What looks odd about the keypoints of a person, told to the user after every reading.

Nothing here is refused: all of it can be right. Call `findings`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from torchcss.io.keypoints.one_person import sides_of, size_of
from torchcss.io.keypoints.people import Size
from torchcss.joint_names import LIMB_PLACES

_CONFIDENT = 0.3
_APART = 0.05
"""Share of a person's size that two joints must stand apart for their order to say anything."""

_DOUBTFUL = 0.3
"""Share of the usual confidence below which the first frame's keypoints are doubted."""


def findings(
    joints: Float[np.ndarray, "t j 3"],
    names: Sequence[str],
    image_size_wh: Size,
    first_frame: int,
) -> list[str]:
    """Lines about joints outside the image, sides that look exchanged, and a doubtful start.

    Args:
        joints: The person in every frame, pixels and confidence.
        names: The joints' names.
        image_size_wh: Size of the video.
        first_frame: Where tracking starts.
    """
    return [
        *_outside(joints, image_size_wh, first_frame),
        *_sides(joints, names),
        *_lying(joints, names),
        *_turnabouts(joints, names),
        *_doubtful_start(joints, first_frame),
    ]


def _outside(joints: np.ndarray, image_size_wh: Size, first_frame: int) -> list[str]:
    confident = joints[..., 2] > _CONFIDENT
    low, high = -0.5, np.array(image_size_wh) - 0.5
    outside = confident & ((joints[..., :2] < low) | (joints[..., :2] > high)).any(-1)
    out, of = outside.sum(axis=1), confident.sum(axis=1)
    frames = np.flatnonzero(out)
    if not len(frames):
        return []
    index = first_frame if out[first_frame] else frames[0]
    line = (
        f"{out[index]} of {of[index]} confident joints of frame {index} lie outside the image, and "
        f"some in {len(frames)} of {len(joints)} frames"
    )
    if outside.sum() > 0.2 * confident.sum():
        line += (
            "; were the keypoints made from this video, at this size? A detector guesses what is "
            "not in the picture: an arm alone needs its own joints, and --body arm8"
        )
    return [line]


def _sides(joints: np.ndarray, names: Sequence[str]) -> list[str]:
    """Whether left and right of the parts of a body contradict each other."""
    sizes = np.array([size_of(person) for person in joints])
    facing: dict[str, np.ndarray] = {}  # 1 where the left one is on the right, as of who faces us
    for place in ("shoulder", "hip", "eye"):
        columns = sides_of(names, place)
        if not columns:
            continue
        left, right = joints[:, columns].swapaxes(0, 1)
        seen = (left[:, 2] > _CONFIDENT) & (right[:, 2] > _CONFIDENT)
        gap = (left[:, 0] - right[:, 0]) / sizes
        far = np.abs(gap) > (_APART if place != "eye" else 0.2 * _APART)
        facing[place] = np.where(seen & far, np.sign(gap), 0.0)
    lines = []
    for one, other in (("shoulder", "hip"), ("eye", "shoulder")):
        if {one, other} <= set(facing):
            both = facing[one] * facing[other]
            known, against = int((both != 0).sum()), int((both < 0).sum())
            if against > 0.5 * known:
                lines.append(
                    f"left and right look exchanged: {one}s and {other}s contradict each other in "
                    f"{against} of {known} frames; check the layout"
                )
    return lines


def _lying(joints: np.ndarray, names: Sequence[str]) -> list[str]:
    """Whether shoulders and hips stand side by side or upside down, as with other axes."""
    columns = sides_of(names, "shoulder") + sides_of(names, "hip")
    if len(columns) < 4:
        return []
    seen = joints[(joints[:, columns, 2] > _CONFIDENT).all(1)][:, columns, :2]
    down = seen[:, 2:].mean(1) - seen[:, :2].mean(1)
    along = np.abs(down)
    if len(along) and ((along[:, 1] > along[:, 0]) & (down[:, 1] < 0)).mean() > 0.9:
        return [
            "the hips are above the shoulders: somebody stands on the hands, or y counts upwards "
            "in the file, or it is of a turned video"
        ]
    if not len(along) or (along[:, 0] > along[:, 1]).mean() < 0.9:
        return []
    return [
        "shoulders and hips lie side by side, not one above the other: somebody lies, or the file "
        "has y before x, or it is of a turned video"
    ]


def _turnabouts(joints: np.ndarray, names: Sequence[str]) -> list[str]:
    """Whether left and right change places from one frame to the next."""
    pairs = [columns for place in LIMB_PLACES if (columns := sides_of(names, place))]
    if not pairs:
        return []
    one, other = map(list, zip(*pairs, strict=True))
    here, there = joints[:, one + other], joints[:, other + one]
    seen = (here[1:, :, 2] > _CONFIDENT) & (here[:-1, :, 2] > _CONFIDENT)
    seen &= np.roll(seen, len(pairs), axis=1)  # both sides
    size = np.array([size_of(person) for person in joints[1:]])
    kept, exchanged = (
        np.where(seen, np.linalg.norm(now[1:, :, :2] - here[:-1, :, :2], axis=-1), 0.0).sum(1)
        for now in (here, there)
    )
    jumps = (kept > _APART * size * seen.sum(1)) & (exchanged < 0.5 * kept)
    frames = [int(frame) + 1 for frame in np.flatnonzero(jumps)]
    if not frames:
        return []
    more = f" and {len(frames) - 6} more" if len(frames) > 6 else ""
    return [
        f"left and right change places from one frame to the next before frames "
        f"{', '.join(map(str, frames[:6]))}{more}: they are used as given, so exchange them back "
        "if the pictures agree"
    ]


def _doubtful_start(joints: np.ndarray, first_frame: int) -> list[str]:
    """Whether the frame from which tracking starts is believed much less than the others."""
    belief = joints[..., 2].sum(axis=1)
    typical = float(np.median(belief[belief > 0.0])) if (belief > 0.0).any() else 0.0
    if belief[first_frame] >= _DOUBTFUL * typical:
        return []
    better = np.flatnonzero(belief[first_frame:] >= typical)
    advice = f"; start at frame {first_frame + better[0]}" if len(better) else ""
    return [
        f"frame {first_frame}, where tracking starts, has keypoints of little confidence, "
        f"{belief[first_frame]:.2g} in all where others have {typical:.2g}: its pose may be "
        f"wrong{advice}"
    ]

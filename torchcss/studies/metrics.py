"""How far a tracked body is from a reference: the errors by which trackers are compared.

Positions go in in metres, errors come out in millimetres, which the names say. A reference joint
that was not measured is NaN; it is left out of every mean and never counts as an error of zero.

| error | what is removed first | needs |
|---|---|---|
| `absolute_errors_mm` | nothing | the same world frame |
| `root_aligned_errors_mm` | the root's position, frame by frame | the same axes |
| `procrustes_errors_mm` | rotation, translation and scale, frame by frame | nothing |

MPJPE, the mean per-joint position error, is the mean of such errors; `mpjpe_mm`,
`root_aligned_mpjpe_mm` and `pa_mpjpe_mm` give it frame by frame. The Procrustes alignment finds the
similarity that brings the tracked joints X nearest to the reference Y,

    min  sum_j | s R X_j + t - Y_j |^2     over s >= 0, R a rotation, t

from the singular values U D V^T of the covariance of Y and X: R = U S V^T with S = diag(1, 1, +-1)
so that R is no reflection, and s = tr(D S) / sum |X - mean|^2 (Umeyama, IEEE PAMI 13, 1991).

A monocular tracker keeps several modes. "Best mode" judges the one that it believes most; "best of
modes" lets the reference choose, frame by frame, and tells whether the truth was among them.

A track is lost where it fails and does not regain the body soon: `first_loss`. Whether a tracker
knows how wrong it is tells `probability_within`: the true place of a joint, seen from an estimate
of covariance C, lies at the squared Mahalanobis distance d^2 = e^T C^-1 e, and the ellipsoid
through it holds the probability P(chi^2_3 < d^2). If the covariance is right these probabilities
are spread evenly over 0..1, so that `coverage` at 50 % is 50 %, and so on.

Call `track_errors` for all errors of a whole track. The functions above it are for single poses,
those below it compare trackers frame by frame (`torchcss.studies.evaluation`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from torchcss.errors import ConfigurationError, ShapeError

LOST_MM: Final = 250.0
"""Root-aligned error above which a frame counts as lost."""

REGAIN_S: Final = 0.5
"""Seconds within which a tracker may regain what it failed to follow, before that is a loss."""

LEVELS: Final = (0.5, 0.9, 0.95)
"""Probabilities of the regions by which calibration is told."""

Places = Float[ArrayLike, "*batch j 3"]
"""Joint positions, metres."""

_FEWEST_TO_ALIGN = 3
_MILLIMETRES = 1000.0


class JointErrors(NamedTuple):
    """One kind of error over a sequence.

    Attributes:
        errors_mm: Distance of every joint in every frame; NaN where it cannot be measured.
    """

    errors_mm: Float[np.ndarray, "t j"]

    @property
    def mean_mm(self) -> float:
        """Mean over all joints measured in all frames, each with the same weight."""
        return float(_mean(self.errors_mm.reshape(-1)))

    @property
    def per_joint_mm(self) -> Float[np.ndarray, " j"]:
        """Mean over frames."""
        return _mean(self.errors_mm.T)

    @property
    def per_frame_mm(self) -> Float[np.ndarray, " t"]:
        """Mean over joints."""
        return _mean(self.errors_mm)


class TrackErrors(NamedTuple):
    """All errors of a track.

    Attributes:
        joint_names: The joints that were compared, the order of axis `j`.
        absolute: Errors of the best mode in the world frame.
        root_aligned: The same after the roots were put on each other.
        procrustes: The same after the best similarity.
        absolute_best_of_modes: Of the mode that is best by this error, frame by frame.
        root_aligned_best_of_modes: Of the mode that is best by this error.
        procrustes_best_of_modes: Of the mode that is best by this error.
        lost: True where the best mode's mean root-aligned error exceeds `LOST_MM`; a frame without
            any is not lost.
    """

    joint_names: tuple[str, ...]
    absolute: JointErrors
    root_aligned: JointErrors
    procrustes: JointErrors
    absolute_best_of_modes: JointErrors
    root_aligned_best_of_modes: JointErrors
    procrustes_best_of_modes: JointErrors
    lost: Bool[np.ndarray, " t"]

    @property
    def num_measured(self) -> int:
        """Frames in which at least one joint could be compared, root-aligned."""
        return int(np.isfinite(self.root_aligned.errors_mm).any(-1).sum())


def absolute_errors_mm(tracked_m: Places, reference_m: Places) -> Float[np.ndarray, "*batch j"]:
    """Distance of every joint from its reference, as they stand.

    Args:
        tracked_m: Joint positions, metres.
        reference_m: Where they should be; NaN where unknown. Leading axes broadcast.

    Raises:
        ShapeError: If the shapes do not fit, or a tracked position is not finite.
    """
    return _distances_mm(*_pair(tracked_m, reference_m))


def root_aligned_errors_mm(
    tracked_m: Places, reference_m: Places, joint_names: Sequence[str], *, root: str | None = None
) -> Float[np.ndarray, "*batch j"]:
    """Distance of every joint from its reference when both roots are at the origin.

    Args:
        tracked_m: Joint positions, metres.
        reference_m: Where they should be; NaN where unknown. Where the root itself is unknown,
            all errors of the pose are NaN.
        joint_names: Names of the joints on axis `j`.
        root: Joint to align; None: the midpoint of `l_hip` and `r_hip`.

    Raises:
        ShapeError: If the shapes do not fit, or a tracked position is not finite.
        ConfigurationError: If the root is not among the joints.
    """
    tracked, reference = _pair(tracked_m, reference_m)
    names = list(joint_names)
    if len(names) != tracked.shape[-2]:
        raise ShapeError(f"joint_names: expected {tracked.shape[-2]} names, got {len(names)}")
    wanted = ("l_hip", "r_hip") if root is None else (root,)
    missing = [name for name in wanted if name not in names]
    if missing:
        raise ConfigurationError(
            f"cannot align the roots: {' and '.join(missing)} not among the joints "
            f"{', '.join(names)}; name another root"
        )
    index = [names.index(name) for name in wanted]

    def centred(joints: np.ndarray) -> np.ndarray:
        return joints - joints[..., index, :].mean(axis=-2, keepdims=True)

    return _distances_mm(centred(tracked), centred(reference))


def procrustes_errors_mm(tracked_m: Places, reference_m: Places) -> Float[np.ndarray, "*batch j"]:
    """Distance of every joint from its reference after the best similarity of the pose.

    Args:
        tracked_m: Joint positions, metres.
        reference_m: Where they should be; NaN where unknown. A pose with fewer than three known
            joints has NaN errors: anything fits two points.

    Raises:
        ShapeError: If the shapes do not fit, or a tracked position is not finite.
    """
    return _distances_mm(procrustes_align(tracked_m, reference_m), np.asarray(reference_m))


def procrustes_align(tracked_m: Places, reference_m: Places) -> Float[np.ndarray, "*batch j 3"]:
    """Rotate, shift and scale every tracked pose to where it is nearest to its reference.

    Args:
        tracked_m: Joint positions, metres.
        reference_m: Where they should be; NaN where unknown. Joints without reference move along.

    Returns:
        The moved positions, metres; NaN for a pose with fewer than three known joints.

    Raises:
        ShapeError: If the shapes do not fit, or a tracked position is not finite.
    """
    tracked, reference = _pair(tracked_m, reference_m)
    known = np.isfinite(reference).all(axis=-1, keepdims=True)
    count = known.sum(axis=-2, keepdims=True)

    def centred(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        joints = np.where(known, joints, 0.0)
        mean = joints.sum(axis=-2, keepdims=True) / np.maximum(count, 1)
        return np.where(known, joints - mean, 0.0), mean

    shape, tracked_mean = centred(tracked)
    goal, reference_mean = centred(reference)
    left, values, right = np.linalg.svd(np.swapaxes(goal, -1, -2) @ shape)
    sign = np.ones_like(values)
    sign[..., -1] = np.where(np.linalg.det(left @ right) < 0.0, -1.0, 1.0)
    rotation = (left * sign[..., None, :]) @ right
    spread = np.square(shape).sum(axis=(-2, -1))
    # A pose that is one point has no scale; it stays one point, at the reference's mean.
    scale = np.where(spread > 0.0, (values * sign).sum(-1) / np.where(spread > 0.0, spread, 1.0), 0)
    moved = scale[..., None, None] * (tracked - tracked_mean) @ np.swapaxes(rotation, -1, -2)
    return np.where(count >= _FEWEST_TO_ALIGN, moved + reference_mean, np.nan)


def mpjpe_mm(tracked_m: Places, reference_m: Places) -> Float[np.ndarray, "*batch"]:
    """Mean over the known joints of `absolute_errors_mm`, pose by pose; NaN where none is known."""
    return _mean(absolute_errors_mm(tracked_m, reference_m))


def root_aligned_mpjpe_mm(
    tracked_m: Places, reference_m: Places, joint_names: Sequence[str], *, root: str | None = None
) -> Float[np.ndarray, "*batch"]:
    """Mean over the known joints of `root_aligned_errors_mm`, pose by pose; see there."""
    return _mean(root_aligned_errors_mm(tracked_m, reference_m, joint_names, root=root))


def pa_mpjpe_mm(tracked_m: Places, reference_m: Places) -> Float[np.ndarray, "*batch"]:
    """Mean over the known joints of `procrustes_errors_mm`, pose by pose."""
    return _mean(procrustes_errors_mm(tracked_m, reference_m))


def best_of_modes(
    errors_mm: Float[ArrayLike, "*batch k j"], present: Bool[ArrayLike, "*batch k"] | None = None
) -> tuple[Float[np.ndarray, "*batch j"], Int[np.ndarray, "*batch"]]:
    """Errors of the mode whose mean error is least, frame by frame.

    Args:
        errors_mm: Errors of every mode, NaN where the reference is unknown.
        present: False for entries that only pad; None: all are modes.

    Returns:
        The errors of the chosen modes, and which they are: -1, with NaN errors, where nothing
        could be compared.
    """
    errors = np.asarray(errors_mm, dtype=np.float64)
    mean = _mean(errors)
    if present is not None:
        mean = np.where(np.asarray(present, dtype=bool), mean, np.nan)
    chosen = np.where(np.isnan(mean), np.inf, mean).argmin(axis=-1)
    best = np.take_along_axis(errors, chosen[..., None, None], axis=-2)
    measured = np.isfinite(mean).any(axis=-1, keepdims=True)
    mode = np.where(measured, chosen[..., None], -1)
    return np.where(measured, best[..., 0, :], np.nan), mode[..., 0]


def track_errors(
    tracked_m: Float[ArrayLike, "t k j 3"],
    reference_m: Float[ArrayLike, "t j 3"],
    joint_names: Sequence[str],
    *,
    present: Bool[ArrayLike, "t k"] | None = None,
    compared: Sequence[str] | None = None,
    root: str | None = None,
) -> TrackErrors:
    """All errors of a track with several modes per frame, the best first.

    Args:
        tracked_m: Joint positions of every mode, metres.
        reference_m: Where they should be; NaN where unknown.
        joint_names: Names of the joints on axis `j` of both.
        present: False for entries that only pad; None: all are modes.
        compared: The joints whose errors count, all by default; the root need not be one.
        root: Joint to align; None: the midpoint of `l_hip` and `r_hip`.

    Raises:
        ShapeError: If the shapes do not fit, a tracked position is not finite, or the reference
            has no known joint among those compared.
        ConfigurationError: If the root, or a joint to compare, is not among the joints.
    """
    tracked = np.asarray(tracked_m, dtype=np.float64)
    reference = np.asarray(reference_m, dtype=np.float64)
    if tracked.ndim != 4 or reference.ndim != 3 or len(tracked) != len(reference):
        raise ShapeError(
            "expected tracked positions [t, k, j, 3] and a reference [t, j, 3] of as many frames, "
            f"got {list(tracked.shape)} and {list(reference.shape)}"
        )
    names, chosen = list(joint_names), list(joint_names if compared is None else compared)
    missing = [name for name in chosen if name not in names]
    if missing or not chosen:
        raise ConfigurationError(
            f"joints to compare: expected some of {', '.join(names)}, "
            f"got {', '.join(missing) or 'none'}"
        )
    index = [names.index(name) for name in chosen]
    reference = reference[:, None]
    aligned = root_aligned_errors_mm(tracked, reference, names, root=root)[..., index]
    tracked, reference = tracked[..., index, :], reference[..., index, :]
    if not np.isfinite(reference).all(-1).any():
        raise ShapeError("the reference has no known position of the joints to compare: all is NaN")
    kinds = {
        "absolute": absolute_errors_mm(tracked, reference),
        "root_aligned": aligned,
        "procrustes": procrustes_errors_mm(tracked, reference),
    }
    of_kind = {kind: JointErrors(errors[:, 0]) for kind, errors in kinds.items()}
    of_kind |= {
        f"{kind}_best_of_modes": JointErrors(best_of_modes(errors, present)[0])
        for kind, errors in kinds.items()
    }
    lost = np.nan_to_num(of_kind["root_aligned"].per_frame_mm) > LOST_MM
    return TrackErrors(joint_names=tuple(chosen), lost=lost, **of_kind)


def first_loss(
    failed: Float[ArrayLike, " t"], times_s: Float[ArrayLike, " t"], *, regain_s: float = REGAIN_S
) -> int | None:
    """Find where a track was lost for good: it failed there and in all frames of the time after.

    What fails at the very end for a shorter time than that is no loss: nobody knows.

    Args:
        failed: Frames in which the body was not followed; NaN, where nothing is known, neither
            begins nor ends a stretch of failures.
        times_s: Their times, seconds, rising.
        regain_s: How long a failure has to last.

    Returns:
        The first frame of the first such stretch, as an index; None if there is none.
    """
    start = None
    known = np.asarray(failed, np.float64)
    times = np.asarray(times_s, np.float64)
    for index in np.flatnonzero(~np.isnan(known)).tolist():
        if not known[index]:
            start = None
            continue
        start = index if start is None else start
        # Frame times are rounded; half a millisecond is less than a frame of any camera.
        if times[index] - times[start] > regain_s - 0.0005:
            return start
    return None


def mask_overlap(
    first: Bool[ArrayLike, "*batch h w"], second: Bool[ArrayLike, "*batch h w"]
) -> Float[np.ndarray, "*batch"]:
    """Intersection over union of two silhouettes; NaN where both are empty."""
    first, second = np.asarray(first, bool), np.asarray(second, bool)
    union = (first | second).sum(axis=(-2, -1))
    common = (first & second).sum(axis=(-2, -1))
    return np.where(union > 0, common / np.maximum(union, 1), np.nan)


def probability_within(
    squared_distance: Float[ArrayLike, "*batch"], dimensions: Float[ArrayLike, "*batch"]
) -> Float[np.ndarray, "*batch"]:
    """Probability of the smallest region of a Gaussian that holds a point: chi-square's integral.

    Args:
        squared_distance: Squared Mahalanobis distance of the point; NaN stays NaN.
        dimensions: Of the Gaussian; need not be whole.
    """
    distance = torch.as_tensor(np.asarray(squared_distance, np.float64))
    half = torch.as_tensor(np.asarray(dimensions, np.float64)).expand_as(distance) / 2
    return torch.special.gammainc(half, distance / 2).numpy()


def coverage(
    probability: Float[ArrayLike, "*batch"], levels: Sequence[float] = LEVELS
) -> dict[float, float]:
    """Share of the truths that lie inside the regions of given probabilities.

    Args:
        probability: What `probability_within` gave; NaN is left out.
        levels: Probabilities of the regions, which a calibrated tracker's shares equal.
    """
    known = np.asarray(probability, np.float64)
    known = known[np.isfinite(known)]
    return {level: float((known <= level).mean()) if known.size else np.nan for level in levels}


def spread(values: Float[ArrayLike, " n"]) -> tuple[float, float, float]:
    """Median, least and greatest of the numbers among some values; NaN if there is none."""
    known = np.sort(np.asarray(values, np.float64))
    known = known[~np.isnan(known)].tolist() or [np.nan]
    # The middle by hand: the mean of two middle ones may be that of infinities.
    middle = (known[(len(known) - 1) // 2] + known[len(known) // 2]) / 2
    return middle, known[0], known[-1]


def acceleration_error(
    tracked_m: Float[ArrayLike, "t j 3"], reference_m: Float[ArrayLike, "t j 3"], interval_s: float
) -> float:
    """Mean distance of the joints' accelerations from the reference's, m/s^2: the jitter.

    Accelerations are second differences of three frames in a row; a triple with an unknown
    reference is left out. NaN if none is left.

    Args:
        tracked_m: Joint positions of one mode, metres.
        reference_m: Where they should be; NaN where unknown.
        interval_s: Seconds between the frames.
    """
    tracked, reference = _pair(tracked_m, reference_m)
    bend = np.diff(tracked - reference, n=2, axis=0) / interval_s**2
    return float(_mean(np.linalg.norm(bend, axis=-1).reshape(-1)))


def _pair(tracked_m: ArrayLike, reference_m: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return both as float64 arrays of the same shape."""
    tracked = np.asarray(tracked_m, dtype=np.float64)
    reference = np.asarray(reference_m, dtype=np.float64)
    if tracked.ndim < 2 or tracked.shape[-2:] != reference.shape[-2:] or tracked.shape[-1] != 3:
        raise ShapeError(
            "expected tracked and reference positions of the same shape [..., joints, 3], "
            f"got {list(tracked.shape)} and {list(reference.shape)}"
        )
    try:
        tracked, reference = np.broadcast_arrays(tracked, reference)
    except ValueError as error:
        raise ShapeError(
            f"the frames of tracked and reference positions do not fit: "
            f"{list(tracked.shape)} and {list(reference.shape)}"
        ) from error
    if not np.isfinite(tracked).all():
        # Left out like a missing reference, a failure of the tracker would go unpunished.
        raise ShapeError("tracked positions: expected finite numbers, got some that are not")
    return tracked, reference


def _distances_mm(tracked: np.ndarray, reference: np.ndarray) -> np.ndarray:
    return _MILLIMETRES * np.linalg.norm(tracked - reference, axis=-1)


def _mean(errors: np.ndarray) -> np.ndarray:
    """Mean over the last axis without the NaNs; NaN where there is nothing else."""
    known = ~np.isnan(errors)
    count = known.sum(axis=-1)
    total = np.where(known, errors, 0.0).sum(axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)

"""How well a tracker follows a sequence whose truth is known, frame by frame and as a row.

`evaluate` compares a finished run with joints in space. For runs under way, `Evaluator` measures
every frame of a tracker, `summarise` makes a run one row of numbers, and `over_seeds` the rows of
several runs one of medians. What the words mean (the figures are those of `Thresholds`):

* A frame has *failed* if the best mode's mean root-aligned error exceeds 250 mm, or if its
  silhouette overlaps the true one by less than half (intersection over union; good tracks reach
  0.9 to 0.97 on a rendered arm of our own and 0.75 to 0.87 on a clothed person of others). The body
  is *lost* at the first failed frame from which on all frames fail for half a second.
* An arm hangs on a base that the tracker is told: its root is known, and root-aligned and absolute
  errors are the same. Its frames fail above 150 mm: an arm that follows something else still begins
  at the shoulder, and a tracker that stands still while the arm swings away has 200 mm, where good
  ones have less than 40.
* A *limb* is lost at the first frame from which on one and the same joint is farther than that from
  where it is for half a second: in the best mode, and, as with all that is said to be of the modes,
  in the one nearest to the truth. A mean over the joints forgives an arm that points elsewhere.
* The *true mode is kept* if the mean root-aligned error of any mode is below 100 mm.
* *Calibration*: how often the true joints lie in the 50, 90, and 95 % regions of a mode, the
  joint's covariance (`torchcss.body.uncertainty`) enlarged by the reference's own.
* *Along* and *across* are root mean square errors of the best mode's joints, roots on each other,
  in the direction of the camera's line of sight to the true body, and in the picture's plane.
* A posterior is *multimodal* by the weight of the modes with a joint 3 cm from the best mode's.
* A joint is *at its bound* within half a degree of a limit.
* A pose is *impossible* if an angle is more than a degree beyond its limit, or if a part is deeper
  than 2 cm inside another one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import compress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES, has_root
from torchcss.body.uncertainty import joint_covariance
from torchcss.cost.part_map import part_map
from torchcss.cost.penetration import PenetrationDepth
from torchcss.errors import ConfigurationError, TrackFileError
from torchcss.files import StrPath, load_arrays
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.tracker import TrackerInfo
from torchcss.io.run import Run, as_run
from torchcss.io.tracks import Track
from torchcss.joint_names import LIMB_JOINTS
from torchcss.linalg import squared_mahalanobis
from torchcss.studies.metrics import (
    LEVELS,
    LOST_MM,
    REGAIN_S,
    TrackErrors,
    absolute_errors_mm,
    acceleration_error,
    best_of_modes,
    coverage,
    first_loss,
    mask_overlap,
    probability_within,
    procrustes_errors_mm,
    root_aligned_errors_mm,
    spread,
    track_errors,
)
from torchcss.studies.sequences import RecordedSequence, common_name, read_reference
from torchcss.tracking.session import Posterior
from torchcss.types import Frame, Vector, as_array, frozen
from torchcss.vision.camera import Camera

ARM_LOST_MM = 150.0
"""Error above which a frame of an arm counts as failed."""

LOSSES = ("lost_s", "limb_lost_s", "limb_lost_of_modes_s")
"""Entries of a row that are times of a loss, NaN where there was none."""

_LEAST_DEVIATION_M = 0.005
"""Standard deviation of where a joint is, per coordinate, that is a matter of definition."""

APART_M = 0.03
"""How far some joint of two modes is apart if they are two explanations, metres."""

OfModes = Float[np.ndarray, "k j"]
"""A number for every compared joint of every mode."""


@frozen
class Thresholds:
    """The figures that make the words precise; see the module's page.

    Attributes:
        lost_mm: Error above which a frame has failed.
        least_overlap: Overlap below which it has.
        regain_s: How long failing has to last to be a loss.
        true_mode_mm: Error below which a mode is the true one.
        outside_degrees: How far an angle may pass its limit.
        deep_m: How deep parts may penetrate, metres.
        reference_m: Standard deviation of the reference per coordinate, metres.
    """

    lost_mm: float = LOST_MM
    least_overlap: float = 0.5
    regain_s: float = REGAIN_S
    true_mode_mm: float = 100.0
    outside_degrees: float = 1.0
    deep_m: float = 0.02
    reference_m: float = 0.02

    @classmethod
    def of(cls, sequence: RecordedSequence) -> Thresholds:
        """Those for a sequence.

        A reference that is not of our bodies has its joints a few centimetres elsewhere. Where it
        is, half a centimetre allows for what the linear covariance of a joint leaves out: a limb
        of 0.3 m that is turned by 10 degrees leaves its tangent by 4.6 mm.
        """
        if sequence.truth is None:
            return cls()
        arm = not has_root(sequence.truth.body)
        return cls(lost_mm=ARM_LOST_MM if arm else LOST_MM, reference_m=0.005)


class FrameMeasures(NamedTuple):
    """One frame of one tracker against the truth; modes as the tracker orders them, best first.

    Attributes:
        frame: Index in the video.
        time_s: Seconds since the first frame tracked.
        failed: Whether the best mode does not follow the body; None where nothing is known.
        weight: Weights of the modes.
        absolute_mm: Errors of the compared joints; NaN where the reference is unknown.
        root_aligned_mm: The same with the roots on each other.
        procrustes_mm: The same after the best similarity.
        within: Probability of the region of a mode that just holds the true joint.
        joints_m: Compared joints of the best mode, metres.
        reference_m: Where they should be; NaN where unknown.
        overlap: Of the best mode's silhouette with the true one; NaN if that is not known.
        outside_degrees: How far the best mode's worst angle is beyond its limit.
        penetration_m: How deep the deepest node of every mode is inside another part, metres.
        along_mm: Error along the line of sight; NaN where the reference is unknown.
        across_mm: Error across it.
        apart_weight: Weight of the modes that are another explanation than the best one.
        at_bound: Parameters of the best mode at their bounds.
        evaluations: Evaluations of the cost: with two derivatives for each iteration of a
            descending sample, or the value alone for each weighing of a particle.
        seconds: Wall time by stage.
    """

    frame: int
    time_s: float
    failed: bool | None
    weight: Float[np.ndarray, " k"]
    absolute_mm: OfModes
    root_aligned_mm: OfModes
    procrustes_mm: OfModes
    within: OfModes
    joints_m: Float[np.ndarray, "j 3"]
    reference_m: Float[np.ndarray, "j 3"]
    overlap: float
    outside_degrees: float
    penetration_m: Float[np.ndarray, " k"]
    along_mm: float
    across_mm: float
    apart_weight: float
    at_bound: tuple[str, ...]
    evaluations: int
    seconds: dict[str, float]


def num_evaluations(info: TrackerInfo) -> int:
    """Evaluations of the cost in one step.

    Each iteration of the optimiser is one; filters, which never iterate, weigh every sample once.
    """
    return int(info.num_steps.sum()) or int(info.num_samples)


def silhouette(body: BodyModel, x: Vector, camera: Camera) -> Bool[np.ndarray, "h w"]:
    """Pixels whose centres see the posed body.

    Args:
        body: The body.
        x: Its state.
        camera: The camera.
    """
    return (part_map(body, x, camera, rings=16, meridians=20) >= 0).cpu().numpy()


def region_probability(
    body: BodyModel,
    mixture: GaussianMixture,
    joints: Sequence[int],
    reference_m: Float[np.ndarray, "*k j 3"],
    deviation_m: float,
    *,
    exact: bool = False,
) -> OfModes:
    """Probability of the region that a mode states for a joint and that just holds the true one.

    Where the deviation is an allowance and the reference does not err by it, the squared distance
    of a truth from the stated Gaussian is `sum w_i z_i^2`, `w_i` the shares of the stated variances
    in the sums along their axes: the joints of an arm move on surfaces, and the third `w` is zero.
    Its law is taken as `g chi^2_h` with that mean and variance (Satterthwaite, Biometrics 2, 1946).

    Args:
        body: The body.
        mixture: The modes.
        joints: Which joint centres.
        reference_m: Where they are, metres; NaN where unknown.
        deviation_m: Standard deviation of the reference per coordinate.
        exact: The reference has no error of its own.
    """
    pose, joints = body.pose(mixture.mean), list(joints)
    spread = joint_covariance(body, pose, mixture.covariance)[:, joints].double().cpu()
    allowed = deviation_m**2
    weight = torch.ones_like(spread[..., 0])
    if exact:
        stated = torch.linalg.eigvalsh(spread).clamp(min=0)
        weight = stated / (stated + allowed)
    spread = spread + allowed * torch.eye(3, dtype=spread.dtype)
    away = torch.from_numpy(reference_m) - pose.joints[:, joints].double().cpu()
    known = away.isfinite().all(-1)
    distance = squared_mahalanobis(away.nan_to_num(), spread)
    mean, square = weight.sum(-1), weight.square().sum(-1)
    distance = torch.where(known, distance * mean / square, torch.nan)
    return probability_within(distance.numpy(), (mean.square() / square).numpy())


def compared_joints(sequence: RecordedSequence, body: BodyModel) -> tuple[str, ...]:
    """The joints by which tracks are judged: of limbs, or all that an arm moves, mostly in view.

    Raises:
        ConfigurationError: If the sequence's reference has none of them.
    """
    wanted = LIMB_JOINTS if has_root(body) else _moved_joints(body)
    reference = torch.from_numpy(sequence.joints_world)
    known = reference.isfinite().all(-1)
    uv, _, valid = sequence.camera.project(reference.nan_to_num())
    seen = known & valid & sequence.camera.inside_image(uv)
    share = seen.sum(0) / known.sum(0).clamp(min=1)
    chosen = tuple(
        name
        for name in wanted
        if name in sequence.joint_names and share[sequence.joint_names.index(name)] >= 0.5
    )
    if not chosen:
        raise ConfigurationError(
            f"{sequence.name}: the reference has no joint of {body.name} in view; it has "
            f"{', '.join(sequence.joint_names)}"
        )
    return chosen


def _moved_joints(body: BodyModel) -> tuple[str, ...]:
    """Names of the joint centres that any parameter moves."""
    pose = body.pose(body.rest)
    variance = torch.eye(body.num_parameters).to(body.rest)
    variance = joint_covariance(body, pose, variance).diagonal(dim1=-2, dim2=-1).sum(-1)
    moves = variance > 1e-6  # square metres per radian: more than rounding
    return tuple(compress(body.joint_names, moves.tolist()))


class Evaluator:
    """Measures tracked frames of one sequence.

    Args:
        sequence: What is tracked.
        body: The body that tracks it.
        thresholds: What counts as failed.

    Attributes:
        compared: Names of the joints compared.
    """

    def __init__(self, sequence: RecordedSequence, body: BodyModel, thresholds: Thresholds) -> None:
        self.sequence, self.thresholds = sequence, thresholds
        self.compared = compared_joints(sequence, body)
        # Both hips make the root, whether they are compared or not.
        roots = ("l_hip", "r_hip") if has_root(body) else ()
        self._common = list(dict.fromkeys((*self.compared, *roots)))
        missing = [name for name in self._common if name not in sequence.joint_names]
        if missing:
            raise ConfigurationError(
                f"{sequence.name}: cannot align the roots: the reference has no "
                f"{' and '.join(missing)}"
            )
        self._column = body.joint_columns(self._common)
        index = [sequence.joint_names.index(name) for name in self._common]
        self._reference = sequence.joints_world[:, index]
        self._penetration = PenetrationDepth(body)
        self._roots = [self._common.index(name) for name in roots]

    def __call__(self, tracked: Posterior, start: Frame, features_s: float) -> FrameMeasures:
        """Measure a frame.

        Args:
            tracked: The frame.
            start: The first frame of the track.
            features_s: What its features took, seconds.
        """
        sequence, limits = self.sequence, self.thresholds
        body, number = tracked.body, tracked.frame.index
        mixture = tracked.state.mixture._replace(covariance=tracked.covariance)
        count = len(self.compared)
        joints = as_array(tracked.joints_world[:, self._column])
        reference = self._reference[number]
        absolute = absolute_errors_mm(joints, reference)[:, :count]
        aligned = absolute
        if self._roots:
            aligned = root_aligned_errors_mm(joints, reference, self._common)[:, :count]
        overlap = math.nan
        if sequence.mask is not None:
            drawn = silhouette(body, mixture.mean[0], sequence.camera)
            overlap = float(mask_overlap(drawn, sequence.mask[number]))
        error = _mean(aligned[0])
        weight = as_array(mixture.weight)
        along, across = self._directions(joints[0], reference)
        outside, at_bound = _against_limits(body, mixture.mean[0])
        within = region_probability(
            body, mixture, self._column[:count], reference[:count], limits.reference_m,
            exact=sequence.truth is not None,
        )  # fmt: skip
        failed = error > limits.lost_mm or overlap < limits.least_overlap
        return FrameMeasures(
            frame=number,
            time_s=tracked.frame.time_s - start.time_s,
            failed=None if math.isnan(error) and math.isnan(overlap) else failed,
            weight=weight,
            absolute_mm=absolute,
            root_aligned_mm=aligned,
            procrustes_mm=procrustes_errors_mm(joints[:, :count], reference[:count]),
            within=within,
            joints_m=joints[0, :count],
            reference_m=reference[:count],
            overlap=overlap,
            outside_degrees=outside,
            penetration_m=self._penetration(body, mixture.mean).depth.cpu().numpy(),
            along_mm=along,
            across_mm=across,
            apart_weight=_apart_weight(joints, weight),
            at_bound=at_bound,
            evaluations=num_evaluations(tracked.info),
            seconds={
                "features": features_s,
                "cost": tracked.seconds["features"] - features_s,
                "search": tracked.seconds["search"],
            },
        )

    def _directions(
        self, joints: Float[np.ndarray, "j 3"], reference: Float[np.ndarray, "j 3"]
    ) -> tuple[float, float]:
        """Errors of the compared joints along the line of sight and across it, millimetres."""
        away, count = joints - reference, len(self.compared)
        if self._roots:
            away = away - away[self._roots].mean(0)
        away, known = away[:count], np.isfinite(reference[:count]).all(-1)
        if not known.any() or not np.isfinite(away[known]).all():
            return math.nan, math.nan
        centre = as_array(self.sequence.camera.centre_world)
        sight = reference[:count][known].mean(0) - centre
        along = away[known] @ (sight / np.linalg.norm(sight))
        squared = (away[known] ** 2).sum(-1) - along**2
        return 1000 * float(np.sqrt((along**2).mean())), 1000 * float(np.sqrt(squared.mean()))


def _apart_weight(joints: Float[np.ndarray, "k j 3"], weight: Float[np.ndarray, " k"]) -> float:
    """Weight of the modes of which some joint is `APART_M` from where the best mode has it."""
    apart = np.linalg.norm(joints - joints[:1], axis=-1).max(-1) > APART_M
    return float(weight[apart].sum())


def _against_limits(body: BodyModel, x: Vector) -> tuple[float, tuple[str, ...]]:
    """How far the worst joint angle is beyond its limit, degrees, and which are at their limits."""
    joints = [name not in ROOT_NAMES for name in body.state_names]
    beyond = torch.maximum(body.lower - x, x - body.upper)[joints]
    close = beyond.abs() < math.radians(0.5)
    names = compress(compress(body.state_names, joints), close.tolist())
    return math.degrees(max(0.0, float(beyond.max()))), tuple(names)


def _mean(values: Any) -> float:
    """Mean of the numbers that are none of them NaN; NaN if there are none."""
    values = np.asarray(values, np.float64).reshape(-1)
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else math.nan


def summarise(
    measures: Sequence[FrameMeasures], thresholds: Thresholds, interval_s: float
) -> dict[str, Any]:
    """One run as the numbers of a table's row; NaN what cannot be measured.

    Means are over the frames before the loss, while the tracker still had the body, since a run
    that is stopped when it is lost has no others; samples and seconds are of all frames. Shares
    are of frames (`deep_modes_share`: of the modes in them), calibration is of joints in frames.

    Args:
        measures: All frames of the run, at least one.
        thresholds: What counted as failed.
        interval_s: Seconds between the frames.
    """

    def every(name: str, frames: Sequence[FrameMeasures] = measures) -> list[Any]:
        return [getattr(frame, name) for frame in frames]

    times = every("time_s")
    nearest = [m.root_aligned_mm[_nearest(m)] for m in measures]
    lost = loss(measures, thresholds)
    held = measures if lost is None else measures[: max(lost, 1)]
    return {
        "num_frames": len(measures),
        "lost": lost is not None,
        "lost_s": math.nan if lost is None else times[lost],
        "limb_lost_s": limb_loss([m.root_aligned_mm[0] for m in measures], times, thresholds),
        "limb_lost_of_modes_s": limb_loss(nearest, times, thresholds),
        **_errors(held),
        **_modes(held, thresholds),
        "overlap": _mean(every("overlap", held)),
        "acceleration_error": acceleration_error(
            every("joints_m", held), every("reference_m", held), interval_s
        ),
        **_impossible(held, thresholds),
        **{name: _mean(every(name, held)) for name in ("along_mm", "across_mm", "apart_weight")},
        "evaluations_per_frame": _mean(every("evaluations")),
        **{
            f"{stage}_s_per_frame": _mean([m.seconds[stage] for m in measures])
            for stage in measures[0].seconds
        },
        "per_frame": {
            "frame": every("frame"),
            "time_s": times,
            "failed": every("failed"),
            "root_aligned_mm": [_mean(m.root_aligned_mm[0]) for m in measures],
            "root_aligned_best_of_modes_mm": [_mean(errors) for errors in nearest],
            **{name: every(name) for name in ("overlap", "along_mm", "across_mm", "apart_weight")},
            "penetration_mm": [1000 * float(m.penetration_m[0]) for m in measures],
            "at_bound": every("at_bound"),
            "joints_mm": [np.rint(1000 * m.joints_m).tolist() for m in measures],
        },
    }


def _modes(held: Sequence[FrameMeasures], thresholds: Thresholds) -> dict[str, float]:
    """Whether the true mode is among them, and calibration."""
    near = [_nearest(m) for m in held]
    errors = [_mean(m.root_aligned_mm[n]) for m, n in zip(held, near, strict=True)]
    known = [error < thresholds.true_mode_mm for error in errors if not math.isnan(error)]
    row = {"true_mode_kept": _mean(known)}
    for name, which in (("best", [0] * len(held)), ("nearest", near)):
        inside = np.stack([m.within[n] for m, n in zip(held, which, strict=True)])
        row |= {f"inside_{round(100 * p)}_{name}": s for p, s in coverage(inside).items()}
    return row


def _impossible(held: Sequence[FrameMeasures], thresholds: Thresholds) -> dict[str, float]:
    """Shares of frames with poses that no body can take."""
    best = np.array([m.penetration_m[0] for m in held])
    modes = np.concatenate([m.penetration_m for m in held])
    outside = np.array([m.outside_degrees for m in held])
    return {
        "outside_share": _mean(outside > thresholds.outside_degrees),
        "deep_share": _mean(best > thresholds.deep_m),
        "deep_modes_share": _mean(modes > thresholds.deep_m),
    }


def loss(measures: Sequence[FrameMeasures], thresholds: Thresholds) -> int | None:
    """The frame in which a run was lost for good, see `first_loss`; None if it never was.

    Args:
        measures: The frames of a run.
        thresholds: How long failing has to last.
    """
    failed = np.array([m.failed for m in measures], np.float64)  # None is NaN
    return first_loss(failed, [m.time_s for m in measures], regain_s=thresholds.regain_s)


def limb_loss(
    errors_mm: Sequence[Float[np.ndarray, " j"]], times_s: Sequence[float], thresholds: Thresholds
) -> float:
    """When some joint was lost for good, see `first_loss`; NaN if none ever was.

    Args:
        errors_mm: Errors of the joints, frame by frame; NaN where a joint is not known.
        times_s: Times of the frames, seconds.
        thresholds: How far off a joint has failed, and how long that has to last.
    """
    errors = np.stack(errors_mm)
    failed = np.where(np.isnan(errors), np.nan, errors > thresholds.lost_mm)
    lost = [first_loss(joint, times_s, regain_s=thresholds.regain_s) for joint in failed.T]
    return min((times_s[first] for first in lost if first is not None), default=math.nan)


def _nearest(measures: FrameMeasures) -> int:
    """The mode that is nearest to the truth, the best one where that is not known."""
    return max(0, int(best_of_modes(measures.root_aligned_mm)[1]))


def _errors(measures: Sequence[FrameMeasures]) -> dict[str, float]:
    """Mean errors of the best mode, and of the mode that is best by the error itself."""
    kinds = {"mpjpe": "absolute_mm", "root_aligned": "root_aligned_mm", "pa_mpjpe": "procrustes_mm"}
    errors = {}
    for name, field in kinds.items():
        values = [getattr(m, field) for m in measures]
        errors[f"{name}_mm"] = _mean([_mean(value[0]) for value in values])
        best = [_mean(best_of_modes(value)[0]) for value in values]
        errors[f"{name}_best_of_modes_mm"] = _mean(best)
    return errors


def over_seeds(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Median, least and greatest over runs of one tracker of every number that `summarise` gives.

    Args:
        rows: The runs; None, which files have for NaN, counts as not known. Whoever did not lose
            the body, or a limb, loses it later than anybody: infinite.
    """
    table: dict[str, Any] = {"seeds": len(rows), "lost": sum(row["lost"] for row in rows)}
    for key, example in rows[-1].items():
        if key == "lost" or not (example is None or isinstance(example, (int, float))):
            continue
        missing = math.inf if key in LOSSES else math.nan
        # A file may begin with runs of an earlier version, which did not measure everything.
        values = [number(row[key], missing) for row in rows if key in row]
        table[key] = spread(values)
    return table


def number(value: float | None, missing: float = math.nan) -> float:
    """What a run or its file says; `missing` for NaN and for null, which stands for it."""
    return missing if value is None or math.isnan(value) else float(value)


class Evaluation(NamedTuple):
    """A run against a reference.

    Attributes:
        frames: Index of each frame in the video.
        num_modes: Most modes that a frame has.
        errors: MPJPE as it stands, root-aligned and after Procrustes, of the best mode and of the
            best of the modes; which frames are lost.
        left_out: Joints that were asked for and that run or reference lack.
        away_m: Offset of the best mode's compared joints when the roots are on each other, metres;
            NaN where the reference is unknown.
        covariance: Covariances that the run states for these places; None where it does not say
            which body it was of.
        deviation_m: Standard deviation of the reference per coordinate, metres.
    """

    frames: Int[np.ndarray, " t"]
    num_modes: int
    errors: TrackErrors
    left_out: tuple[str, ...]
    away_m: Float[np.ndarray, "t j 3"]
    covariance: Float[np.ndarray, "t j 3 3"] | None
    deviation_m: float

    def inside(self, levels: Sequence[float] = LEVELS) -> dict[float, float]:
        """Calibration: share of the joints inside the stated regions of these probabilities.

        The regions are those of places from the root, as the offsets are.

        Args:
            levels: Probabilities of the regions.

        Returns:
            Shares by probability; none where no covariances are known.
        """
        if self.covariance is None:
            return {}
        known = np.isfinite(self.away_m).all(-1)
        spread = torch.from_numpy(self.covariance[known] + self.deviation_m**2 * np.eye(3))
        distance = squared_mahalanobis(torch.from_numpy(self.away_m[known]), spread)
        return coverage(probability_within(distance.numpy(), 3), levels)


def evaluate(
    run: Run | StrPath,
    reference: StrPath,
    *,
    joints: Sequence[str] = LIMB_JOINTS,
    root: str | None = None,
    array: str = "joints",
    deviation_m: float | None = None,
    turned: bool = False,
) -> Evaluation:
    """Errors of a run against joints in space.

    Absolute errors mean something only if run and reference share one world frame, root-aligned
    ones, losses and regions only if their axes agree, or with `turned`; Procrustes errors need
    neither.

    Args:
        run: The run, its folder, or its track's file.
        reference: An NPZ file with `joints [T J 3]` in metres, NaN where unknown, and
            `joint_names`; row i belongs to frame i of the video. Names may be spelt as any detector
            spells them.
        joints: Joints to compare; those that run or reference lack are left out.
        root: Joint that is aligned; None: the midpoint of the hips.
        array: Array of the reference that holds the positions.
        deviation_m: Standard deviation of the reference per coordinate, metres; None: what the file
            says in `deviation_m`, or 20 mm. It counts as 5 mm at least: to that much it is a matter
            of definition where a joint is.
        turned: Give the whole run the one turn that brings its best modes nearest to the reference:
            for a camera of which it is not known how it stands in the reference's world.

    Raises:
        TrackFileError: If a file is missing or malformed, or the run has no frames.
        ConfigurationError: If the reference has too few frames, or they have too few joints in
            common.
        ShapeError: If nothing of the reference is known.
    """
    opened = as_run(run)
    track = opened.track
    if not len(track.frames):
        raise TrackFileError(f"{opened.path}: the track has no frames; nothing to evaluate")
    positions, names = read_reference(reference, array)
    if track.frames.min() < 0 or track.frames.max() >= len(positions):
        raise ConfigurationError(
            f"{reference}: has {len(positions)} frames, the track covers frames "
            f"{track.frames.min()} to {track.frames.max()}; use the reference of the whole video"
        )
    tracked_names = [common_name(name) for name in track.joint_names]
    common = [name for name in dict.fromkeys(tracked_names) if name in names]
    wanted = list(dict.fromkeys(common_name(name) for name in joints))
    compared = [name for name in wanted if name in common]
    roots = ["l_hip", "r_hip"] if root is None else [common_name(root)]
    _check_names(wanted, common, roots, track.joint_names, names)
    column = [tracked_names.index(name) for name in common]
    true = positions[track.frames][:, [names.index(name) for name in common]]
    tracked = track.joints_world[:, :, column]
    index, middle = ([common.index(name) for name in some] for some in (compared, roots))
    turn = _turn(tracked[:, 0], true, middle) if turned else np.eye(3)
    tracked = tracked @ turn.T
    present = np.isfinite(track.log_weight)
    errors = track_errors(
        tracked, true, common, present=present, compared=compared,
        root=None if root is None else roots[0],
    )  # fmt: skip
    if deviation_m is None:
        deviation_m = reference_deviation(reference)
    away = tracked[:, 0] - true
    away = away[:, index] - away[:, middle].mean(1, keepdims=True)
    return Evaluation(
        frames=track.frames,
        num_modes=int(present.sum(axis=1).max()),
        errors=errors,
        left_out=tuple(name for name in wanted if name not in common),
        away_m=away,
        covariance=_stated(track, [column[i] for i in index], [column[i] for i in middle], turn),
        deviation_m=max(deviation_m, _LEAST_DEVIATION_M),
    )


def _check_names(
    wanted: Sequence[str],
    common: Sequence[str],
    roots: Sequence[str],
    tracked: Sequence[str],
    known: Sequence[str],
) -> None:
    """Refuse joints that run and reference do not both have."""
    if not set(wanted) & set(common):
        raise ConfigurationError(
            f"no common joints: asked for {', '.join(wanted)}; the track has "
            f"{', '.join(tracked)}; the reference has {', '.join(known)}; "
            "choose with joints (--joints)"
        )
    if not set(roots) <= set(common):
        raise ConfigurationError(
            f"cannot align the roots: track and reference do not both have {' and '.join(roots)}; "
            f"choose one of {', '.join(common)} with root (--root)"
        )


def reference_deviation(path: StrPath) -> float:
    """What a reference file says of its own error, metres per coordinate; 20 mm if nothing."""
    arrays = load_arrays(Path(path), TrackFileError)
    stated = arrays.get("deviation_m", np.array(Thresholds.reference_m))
    if stated.shape != () or not 0 <= stated < np.inf:
        raise TrackFileError(f"{path}: deviation_m: expected a number of metres, got {stated}")
    return float(stated)


def _stated(
    track: Track, joints: list[int], roots: list[int], turn: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "t j 3 3"] | None:
    """Covariances of joints of the best modes, from the roots and turned; None without a body."""
    if track.body is None:
        return None
    return turn @ track.best_covariances(track.body, roots)[:, joints] @ turn.T


def _turn(
    places: Float[np.ndarray, "t j 3"], wanted: Float[np.ndarray, "t j 3"], roots: Sequence[int]
) -> Float[np.ndarray, "3 3"]:
    """The rotation that brings joints, seen from their roots, nearest to where they should be."""
    ours, theirs = (p - p[:, roots].mean(1, keepdims=True) for p in (places, wanted))
    known = np.isfinite(ours + theirs).all(-1)
    left, _, right = np.linalg.svd(theirs[known].T @ ours[known])
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right

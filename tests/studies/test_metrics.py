"""Metrics against SciPy and by their invariances."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import orthogonal_procrustes
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from torchcss.errors import ConfigurationError, ShapeError
from torchcss.joint_names import JOINT_NAMES, LIMB_JOINTS
from torchcss.studies.metrics import (
    absolute_errors_mm,
    acceleration_error,
    best_of_modes,
    coverage,
    first_loss,
    mask_overlap,
    mpjpe_mm,
    pa_mpjpe_mm,
    probability_within,
    procrustes_align,
    procrustes_errors_mm,
    root_aligned_errors_mm,
    root_aligned_mpjpe_mm,
    track_errors,
)

BATCHES = [(), (5,), (2, 3)]
J = len(LIMB_JOINTS)


def poses(batch: tuple[int, ...] = (), *, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(scale=0.4, size=(*batch, J, 3))


def similarity_of(seed: int) -> tuple[np.ndarray, float, np.ndarray]:
    random = np.random.default_rng(seed)
    rotation = Rotation.from_quat(random.normal(size=4)).as_matrix()
    return rotation, float(random.uniform(0.3, 3.0)), random.normal(size=3)


def test_limb_joints_are_names_of_the_catalogue() -> None:
    assert len(set(LIMB_JOINTS)) == 12
    assert set(LIMB_JOINTS) <= set(JOINT_NAMES)


@pytest.mark.parametrize("batch", BATCHES)
def test_known_errors_come_out_in_millimetres(batch: tuple[int, ...]) -> None:
    reference = poses(batch)
    shifted = reference + np.array([0.003, 0.0, 0.004])
    assert mpjpe_mm(shifted, reference) == pytest.approx(np.full(batch, 5.0))
    assert root_aligned_mpjpe_mm(shifted, reference, LIMB_JOINTS) == pytest.approx(
        np.zeros(batch), abs=1e-10
    )
    assert pa_mpjpe_mm(shifted, reference) == pytest.approx(np.zeros(batch), abs=1e-9)
    assert absolute_errors_mm(shifted, reference).shape == (*batch, J)


def test_root_is_the_midpoint_of_the_hips_or_a_named_joint() -> None:
    reference, tracked = poses(), poses(seed=1)
    left, right = LIMB_JOINTS.index("l_hip"), LIMB_JOINTS.index("r_hip")

    def expected(root: np.ndarray, root_of_reference: np.ndarray) -> np.ndarray:
        offsets = (tracked - root) - (reference - root_of_reference)
        return 1000 * np.sqrt((offsets**2).sum(-1))

    middle = [(p[left] + p[right]) / 2 for p in (tracked, reference)]
    got = root_aligned_errors_mm(tracked, reference, LIMB_JOINTS)
    np.testing.assert_allclose(got, expected(*middle))
    got = root_aligned_errors_mm(tracked, reference, LIMB_JOINTS, root="l_hip")
    np.testing.assert_allclose(got, expected(tracked[left], reference[left]))
    assert got[left] == 0.0


@pytest.mark.parametrize("seed", range(20))
def test_alignment_agrees_with_scipy(seed: int) -> None:
    tracked, reference = poses(seed=seed), poses(seed=seed + 100)
    if seed % 2:  # near the solution too, where most tracks are
        reference = tracked + 0.1 * reference
    x, y = tracked - tracked.mean(0), reference - reference.mean(0)
    rotation = Rotation.align_vectors(y, x)[0].as_matrix()
    turned = x @ rotation.T
    scale = (turned * y).sum() / (x * x).sum()
    expected = scale * turned + reference.mean(0)
    np.testing.assert_allclose(procrustes_align(tracked, reference), expected, atol=1e-12)
    error = 1000 * np.linalg.norm(expected - reference, axis=-1)
    np.testing.assert_allclose(procrustes_errors_mm(tracked, reference), error, atol=1e-9)
    # SciPy's orthogonal Procrustes allows reflections: the same where it needs none.
    matrix, values = orthogonal_procrustes(x, y)
    if np.linalg.det(matrix) > 0:
        np.testing.assert_allclose(
            procrustes_align(tracked, reference),
            values / (x * x).sum() * x @ matrix + reference.mean(0),
            atol=1e-12,
        )


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6))
def test_alignment_undoes_any_similarity_of_either_side(seed: int) -> None:
    tracked, reference = poses(seed=seed), poses(seed=seed + 1)
    rotation, scale, shift = similarity_of(seed)
    assert pa_mpjpe_mm(scale * tracked @ rotation.T + shift, tracked) == pytest.approx(0, abs=1e-9)
    error = procrustes_errors_mm(tracked, reference)
    moved = procrustes_errors_mm(scale * tracked @ rotation.T + shift, reference)
    np.testing.assert_allclose(moved, error, atol=1e-8)
    goal = scale * reference @ rotation.T + shift
    np.testing.assert_allclose(procrustes_errors_mm(tracked, goal), scale * error, atol=1e-8)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6))
def test_no_other_similarity_is_nearer(seed: int) -> None:
    random = np.random.default_rng(seed)
    tracked, reference = poses(seed=seed), poses(seed=seed + 1)
    aligned = procrustes_align(tracked, reference)
    turn = Rotation.from_rotvec(0.05 * random.normal(size=3)).as_matrix()
    other = (1 + 0.05 * random.normal()) * aligned @ turn.T + 0.02 * random.normal(size=3)
    best = np.square(aligned - reference).sum()
    assert best <= np.square(other - reference).sum() + 1e-12
    # Nor leaving the pose unscaled and unturned, which the absolute error does.
    assert best <= np.square(tracked - reference).sum()


def test_a_mirrored_pose_is_not_reflected_back() -> None:
    reference = poses()
    mirrored = reference * np.array([-1.0, 1.0, 1.0])
    assert pa_mpjpe_mm(mirrored, reference) > 50.0
    aligned = procrustes_align(mirrored, reference)
    linear = np.linalg.lstsq(
        mirrored - mirrored.mean(0), aligned - aligned.mean(0), rcond=None
    )[0]  # fmt: skip
    assert np.linalg.det(linear) > 0


def test_degenerate_poses_have_finite_errors() -> None:
    reference = poses()
    point = np.ones_like(reference)
    spread = 1000 * np.linalg.norm(reference - reference.mean(0), axis=-1)
    np.testing.assert_allclose(procrustes_errors_mm(point, reference), spread)
    line = np.linspace(0, 1, J)[:, None] * np.array([1.0, 2.0, 3.0])
    assert np.isfinite(procrustes_errors_mm(line, reference)).all()
    np.testing.assert_allclose(procrustes_errors_mm(reference, point), 0, atol=1e-9)


def test_missing_joints_are_as_if_never_asked_for() -> None:
    tracked, reference = poses((4,)), poses((4,), seed=1)
    holes = reference.copy()
    gone = [LIMB_JOINTS.index("l_wrist"), LIMB_JOINTS.index("r_knee")]
    holes[2, gone, 1] = np.nan
    kept = [j for j in range(J) if j not in gone]
    names = [LIMB_JOINTS[j] for j in kept]
    for errors, expected in (
        (absolute_errors_mm(tracked, holes), absolute_errors_mm(tracked, reference)),
        (procrustes_errors_mm(tracked, holes), procrustes_errors_mm(tracked, reference)),
        (
            root_aligned_errors_mm(tracked, holes, LIMB_JOINTS),
            root_aligned_errors_mm(tracked, reference, LIMB_JOINTS),
        ),
    ):
        assert np.isnan(errors[2, gone]).all()
        assert np.isfinite(errors).sum() == 4 * J - 2
        np.testing.assert_allclose(errors[[0, 1, 3]], expected[[0, 1, 3]])
    few = tracked[2, kept], reference[2, kept]
    assert mpjpe_mm(tracked[2], holes[2]) == pytest.approx(mpjpe_mm(*few))
    assert pa_mpjpe_mm(tracked[2], holes[2]) == pytest.approx(pa_mpjpe_mm(*few))
    got = root_aligned_mpjpe_mm(tracked[2], holes[2], LIMB_JOINTS)
    assert got == pytest.approx(root_aligned_mpjpe_mm(*few, names))


def test_a_pose_without_enough_reference_is_nan() -> None:
    tracked, reference = poses((3,)), poses((3,), seed=1)
    reference[0] = np.nan
    reference[1, 2:] = np.nan  # two joints left: any two points can be aligned
    assert np.isnan(pa_mpjpe_mm(tracked, reference)).tolist() == [True, True, False]
    assert np.isnan(mpjpe_mm(tracked, reference)).tolist() == [True, False, False]
    reference[2, LIMB_JOINTS.index("r_hip")] = np.nan
    assert np.isnan(root_aligned_mpjpe_mm(tracked, reference, LIMB_JOINTS)).all()


def test_best_of_modes_picks_frame_by_frame_among_the_present() -> None:
    errors = np.array(
        [
            [[5.0, 5.0], [1.0, 3.0], [0.0, 0.0]],
            [[1.0, np.nan], [2.0, np.nan], [9.0, np.nan]],
            [[np.nan, np.nan]] * 3,
        ]
    )
    present = np.array([[True, True, False], [True, True, True], [True, True, True]])
    best, mode = best_of_modes(errors, present)
    assert mode.tolist() == [1, 0, -1]
    np.testing.assert_array_equal(best, [[1.0, 3.0], [1.0, np.nan], [np.nan, np.nan]])
    assert best_of_modes(errors)[1].tolist() == [2, 0, -1]
    one, index = best_of_modes(errors[0], present[0])
    assert one.tolist() == [1.0, 3.0]
    assert index == 1


def test_frames_lost_by_their_mean_error() -> None:
    errors = np.array([[300.0, 100.0], [300.0, 210.0], [np.nan, 250.1], [np.nan, np.nan]])
    tracked, reference = np.zeros((4, 1, 3, 3)), np.zeros((4, 3, 3))
    tracked[:, 0, 1:, 0] = np.nan_to_num(errors) / 1000
    reference[:, 1:][np.isnan(errors)] = np.nan
    names = ("l_hip", "l_knee", "l_ankle")
    found = track_errors(tracked, reference, names, compared=names[1:], root="l_hip")
    assert found.lost.tolist() == [False, True, True, False]


def test_track_errors_hold_every_kind() -> None:
    reference = poses((4,))
    reference[3, LIMB_JOINTS.index("l_knee")] = np.nan
    tracked = poses((4, 2), seed=1)
    tracked[:, 1] = np.nan_to_num(reference) + 0.01  # the second mode is nearly right
    tracked[2, 0] = np.nan_to_num(reference[2]) * 5
    compared = ("l_wrist", "l_knee", "r_ankle")
    errors = track_errors(tracked, reference, LIMB_JOINTS, compared=compared)
    index = [LIMB_JOINTS.index(name) for name in compared]
    assert errors.joint_names == compared
    assert errors.num_measured == 4
    expected = absolute_errors_mm(tracked[:, 0], reference)[:, index]
    np.testing.assert_allclose(errors.absolute.errors_mm, expected)
    assert errors.absolute.mean_mm == pytest.approx(np.nanmean(expected))
    np.testing.assert_allclose(errors.absolute.per_joint_mm, np.nanmean(expected, 0))
    np.testing.assert_allclose(errors.absolute.per_frame_mm, np.nanmean(expected, 1))
    # The root is aligned although it is not compared.
    expected = root_aligned_errors_mm(tracked[:, 0], reference, LIMB_JOINTS)[:, index]
    np.testing.assert_allclose(errors.root_aligned.errors_mm, expected)
    assert errors.absolute_best_of_modes.mean_mm == pytest.approx(10 * 3**0.5)
    assert errors.root_aligned_best_of_modes.mean_mm == pytest.approx(0.0, abs=1e-9)
    assert errors.procrustes_best_of_modes.mean_mm == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(errors.procrustes.per_frame_mm[3])  # two joints left
    np.testing.assert_array_equal(errors.lost, np.nanmean(expected, 1) > 250)
    assert errors.lost[2]
    without = track_errors(
        tracked, reference, LIMB_JOINTS, compared=compared, present=[[True, False]] * 4
    )
    assert without.absolute_best_of_modes.mean_mm == pytest.approx(errors.absolute.mean_mm)


def test_tensors_are_accepted() -> None:
    tracked, reference = torch.zeros(J, 3), torch.ones(J, 3)
    assert mpjpe_mm(tracked.numpy(), reference) == pytest.approx(1000 * 3**0.5)


def test_bad_input_is_a_typed_error() -> None:
    reference = poses((4,))
    with pytest.raises(ShapeError, match="same shape"):
        mpjpe_mm(reference[:, :5], reference)
    with pytest.raises(ShapeError, match="do not fit"):
        mpjpe_mm(reference[:3], reference)
    with pytest.raises(ShapeError, match="finite"):
        mpjpe_mm(np.where(reference > 0, np.nan, reference), reference)
    with pytest.raises(ShapeError, match="expected 12 names"):
        root_aligned_mpjpe_mm(reference, reference, LIMB_JOINTS[:3])
    with pytest.raises(ConfigurationError, match="sacrum not among"):
        root_aligned_mpjpe_mm(reference, reference, LIMB_JOINTS, root="sacrum")
    with pytest.raises(ShapeError, match=r"\[t, k, j, 3\]"):
        track_errors(reference, reference, LIMB_JOINTS)
    tracked = reference[:, None]
    with pytest.raises(ConfigurationError, match="got nose"):
        track_errors(tracked, reference, LIMB_JOINTS, compared=["nose"])
    with pytest.raises(ShapeError, match="all is NaN"):
        track_errors(tracked, np.full_like(reference, np.nan), LIMB_JOINTS)


TIMES = np.arange(40) / 25


def failing(*stretches: tuple[int, int]) -> np.ndarray:
    failed = np.zeros(len(TIMES), bool)
    for start, stop in stretches:
        failed[start:stop] = True
    return failed


@pytest.mark.parametrize(
    ("failed", "expected"),
    [
        (failing(), None),
        (failing((3, 40)), 3),
        (failing((3, 12)), None),  # regained after 0.32 s
        (failing((3, 16)), None),  # 0.48 s from first to last
        (failing((3, 17)), 3),  # 0.52 s
        (failing((3, 12), (13, 40)), 13),
        (failing((30, 40)), None),  # at the end, too short to know
        (failing((0, 40)), 0),
    ],
)
def test_a_loss_is_a_failure_that_lasts(failed: np.ndarray, expected: int | None) -> None:
    assert first_loss(failed, TIMES) == expected


def test_a_loss_does_not_hang_on_the_rounding_of_times() -> None:
    times = np.round(np.arange(20) / 30, 3)  # 15 frames are half a second
    failed = np.zeros(20, bool)
    failed[2:18] = True
    assert first_loss(failed, times) == first_loss(failed, np.arange(20) / 30) == 2
    assert first_loss(failed, times, regain_s=0.55) is None
    assert first_loss(failed[:17], times[:17]) is None


def test_overlap_of_silhouettes() -> None:
    first, second = np.zeros((3, 10, 10), bool), np.zeros((3, 10, 10), bool)
    first[0, :4], second[0, 2:6] = True, True  # 20 of 60 pixels
    second[1, 0, 0] = True
    overlap = mask_overlap(first, second)
    np.testing.assert_allclose(overlap, [1 / 3, 0.0, np.nan])
    np.testing.assert_allclose(mask_overlap(second, second)[:2], 1.0)


@pytest.mark.parametrize("dimensions", [1, 3, 8, 34])
def test_probability_within_is_the_chi_square_distribution(dimensions: int) -> None:
    distance = np.linspace(0, 4 * dimensions, 50).reshape(5, 10)
    expected = chi2(dimensions).cdf(distance)
    np.testing.assert_allclose(probability_within(distance, dimensions), expected, atol=1e-12)
    assert np.isnan(probability_within(np.nan, dimensions))


def test_coverage_of_a_calibrated_estimate_is_the_level() -> None:
    count = 4000
    random = np.random.default_rng(0)
    distance = np.square(random.normal(size=(count, 3))).sum(-1)
    distance[:5] = np.nan
    for level, share in coverage(probability_within(distance, 3)).items():
        assert share == pytest.approx(level, abs=4 * (level * (1 - level) / count) ** 0.5)
    assert coverage([0.4, 0.6, np.nan], [0.5]) == {0.5: 0.5}
    assert np.isnan(coverage([np.nan])[0.9])


def test_acceleration_error_sees_jitter_and_no_steady_offset() -> None:
    reference = poses((6,))
    moving = reference + np.arange(6)[:, None, None] * [0.1, 0, 0] + 0.3
    assert acceleration_error(moving, reference, 0.04) == pytest.approx(0.0, abs=1e-9)
    jitter = reference.copy()
    jitter[::2, :, 1] += 0.01  # 0.01 up and down: second differences of 0.02
    assert acceleration_error(jitter, reference, 0.1) == pytest.approx(2.0)
    holes = reference.copy()
    holes[2, 1:] = np.nan  # what is known of the others is not affected
    assert acceleration_error(jitter, holes, 0.1) == pytest.approx(2.0)
    assert np.isnan(acceleration_error(jitter[:2], reference[:2], 0.1))

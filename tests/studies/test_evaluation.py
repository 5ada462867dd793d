"""Measuring tracked frames: against known errors, other bases, and drawn states."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from reference.kinematics import rotation
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import move_base
from torchcss.errors import ConfigurationError
from torchcss.inference.mixture import GaussianMixture
from torchcss.joint_names import LIMB_JOINTS
from torchcss.studies.evaluation import (
    Evaluator,
    FrameMeasures,
    Thresholds,
    compared_joints,
    num_evaluations,
    number,
    over_seeds,
    region_probability,
    silhouette,
    summarise,
)
from torchcss.studies.metrics import root_aligned_mpjpe_mm
from torchcss.studies.render.motions import Motion
from torchcss.studies.render.sequences import arm_motion
from torchcss.studies.sequences import RecordedSequence
from torchcss.types import Frame
from torchcss.vision.camera import Camera

CAMERA = Camera(
    [[320.0, 0, 159.5], [0, 320, 119.5], [0, 0, 1]], (320, 240),
    R_camera_world=np.diag([1.0, -1.0, -1.0]), name="c",
)  # fmt: skip


def placed(name: str) -> BodyModel:
    place = [0.3, 0.16, -1.75] if name.startswith("arm") else [0.0, 0.1, -4.0]
    return load_body(name).with_base(torch.eye(3), torch.tensor(place))


def recorded(body: BodyModel, states: Tensor, **changes: Any) -> RecordedSequence:
    """A sequence in memory, without the files that nobody measures by."""
    sequence = RecordedSequence(
        name="made", video=Path("none"), num_frames=len(states), frame_rate=25.0, camera=CAMERA,
        keypoints=SimpleNamespace(), keypoint_noise_px=None,  # type: ignore[arg-type]
        joint_names=body.joint_names, joints_world=body.pose(states).joints.numpy(),
        mask=np.stack([silhouette(body, x, CAMERA) for x in states[:2]]),
        truth=Motion(body, states, 25.0),
    )  # fmt: skip
    return sequence._replace(**changes)


def tracked(
    body: BodyModel, mean: Tensor, *, index: int = 0, deviation: float = 0.05,
    covariance: Tensor | None = None, weight: tuple[float, ...] | None = None,
) -> Any:  # fmt: skip
    """A frame of a tracker whose modes are at `mean [k n]`."""
    k, n = mean.shape
    if covariance is None:
        covariance = deviation**2 * torch.eye(n, dtype=mean.dtype).expand(k, n, n)
    weights = torch.tensor(weight or [1 / k] * k, dtype=mean.dtype)
    info = SimpleNamespace(num_samples=torch.tensor(5), num_steps=torch.tensor([3, 4, 0, 1, 2]))
    return SimpleNamespace(
        frame=Frame(index, index / 25, np.zeros((1, 1, 3), np.uint8)),
        body=body,
        state=SimpleNamespace(mixture=GaussianMixture(mean, covariance, weights.log())),
        info=info,
        covariance=covariance,
        joints_world=body.pose(mean).joints,
        seconds={"features": 0.375, "search": 0.5},
    )


START = Frame(0, 0.0, np.zeros((1, 1, 3), np.uint8))


def arm_and_states(count: int = 2) -> tuple[BodyModel, Tensor]:
    body = placed("arm8")
    return body, arm_motion(body, torch.arange(count, dtype=torch.float64) / 25)


def test_the_truth_has_no_error() -> None:
    body, states = arm_and_states()
    sequence = recorded(body, states)
    evaluator = Evaluator(sequence, body, Thresholds.of(sequence))
    assert evaluator.compared == ("r_shoulder", "r_elbow", "r_wrist", "r_hand_tip")
    measures = evaluator(tracked(body, states[1:2], index=1), START, 0.125)
    assert (measures.frame, measures.time_s, measures.failed) == (1, 0.04, False)
    for errors in (measures.absolute_mm, measures.root_aligned_mm, measures.procrustes_mm):
        np.testing.assert_allclose(errors, 0, atol=1e-6)
    np.testing.assert_allclose(measures.within, 0, atol=1e-9)
    assert measures.overlap == 1.0
    assert measures.outside_degrees == 0.0
    np.testing.assert_array_equal(measures.penetration_m, [0.0])
    assert measures.evaluations == 10
    assert measures.seconds == {"features": 0.125, "cost": 0.25, "search": 0.5}


def test_an_arm_is_measured_where_it_is_and_modes_one_by_one() -> None:
    body, states = arm_and_states()
    sequence = recorded(body, states)
    away = states[0].clone()
    away[body.state_index("r_shoulder_raising")] += 0.3
    modes = torch.stack([away, states[0]])
    measures = Evaluator(sequence, body, Thresholds.of(sequence))(
        tracked(body, modes, deviation=0.1, weight=(0.8, 0.2)), START, 0.0
    )
    step = body.pose(away).joints - body.pose(states[0]).joints
    np.testing.assert_allclose(measures.root_aligned_mm[0], 1000 * step.norm(dim=-1))
    np.testing.assert_allclose(measures.absolute_mm[0], measures.root_aligned_mm[0])
    np.testing.assert_allclose(measures.root_aligned_mm[1], 0, atol=1e-6)
    assert 0.3 < measures.overlap < 1
    np.testing.assert_allclose(measures.weight, [0.8, 0.2])
    assert measures.penetration_m.shape == (2,)
    assert num_evaluations(SimpleNamespace(  # a filter's
        num_steps=torch.zeros(9, dtype=torch.long), num_samples=torch.tensor(90)
    )) == 90  # type: ignore[arg-type]  # fmt: skip


def test_frames_fail_by_error_or_by_overlap() -> None:
    body, states = arm_and_states()
    sequence = recorded(body, states)
    away = states[:1].clone()
    away[:, body.state_index("r_shoulder_swing")] -= 0.7
    frame = tracked(body, away)

    def failed(sequence: RecordedSequence, **figures: float) -> bool:
        return Evaluator(sequence, body, Thresholds(**figures))(frame, START, 0.0).failed

    assert not failed(sequence, lost_mm=1000, least_overlap=0.0)
    assert failed(sequence, lost_mm=50, least_overlap=0.0)
    assert failed(sequence, lost_mm=1000, least_overlap=0.9)
    without = sequence._replace(mask=None)
    assert not failed(without, lost_mm=1000, least_overlap=0.9)
    assert math.isnan(Evaluator(without, body, Thresholds())(frame, START, 0.0).overlap)


def test_true_joints_are_in_the_stated_regions_as_often_as_stated() -> None:
    """Estimates that err by what they state, against references that err by what is allowed."""
    count, noise = 400, 0.004
    body, states = arm_and_states(1)
    generator = torch.Generator().manual_seed(1)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    factor = 0.02 * normal(8, 8) / 8**0.5
    mean = states + normal(count, 8) @ factor.T
    covariance = (factor @ factor.T).expand(count, 8, 8)
    mixture = GaussianMixture(mean, covariance, torch.zeros(count))
    reference = body.pose(states[0]).joints + noise * normal(count, 4, 3)
    within = region_probability(body, mixture, [1, 2, 3], reference[:, 1:].numpy(), noise)
    for level in (0.5, 0.9):
        share = (within <= level).mean(axis=0)
        np.testing.assert_allclose(share, level, atol=4 * (level * (1 - level) / count) ** 0.5)


@pytest.mark.parametrize("name", ["arm7", "arm8", "body34"])
@pytest.mark.parametrize("deviation", [0.03, 0.06])
def test_exact_truths_are_in_the_stated_regions_as_often_as_stated(
    name: str, deviation: float
) -> None:
    """Of joints on surfaces too, with an allowance that the truth does not use."""
    count, body = 400, placed(name)
    middle = body.bounds.project(body.rest) if name == "body34" else arm_and_states(1)[1][0]
    middle = middle[-body.num_parameters :]
    source = torch.Generator().manual_seed(2)
    noise = torch.randn(count, len(middle), generator=source, dtype=torch.float64)
    sequence = recorded(body, middle[None], mask=None)
    compared = compared_joints(sequence, body)
    assert ("r_shoulder" in compared) == (name != "arm7")
    columns = [body.joint_index(joint) for joint in compared]
    mixture = GaussianMixture(
        middle.expand(count, -1),
        (deviation**2 * torch.eye(len(middle)).double()).expand(count, -1, -1),
        torch.zeros(count).double(),
    )
    truth = body.pose(middle + deviation * noise).joints[:, columns].numpy()
    allowance = Thresholds.of(sequence).reference_m
    within = region_probability(body, mixture, columns, truth, allowance, exact=True)
    for level in (0.5, 0.9):
        assert (within <= level).mean() == pytest.approx(level, abs=0.05)


def test_a_body_is_measured_alike_on_any_base() -> None:
    body = placed("body34")
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(3, 34, generator=generator, dtype=torch.float64)
    states = body.bounds.project(0.15 * noise)
    # The reference is seen from other names and lacks most joints.
    names = [*LIMB_JOINTS, "skull_tip"]
    index = body.joint_columns(names)
    sequence = recorded(
        body, states, joint_names=tuple(names),
        joints_world=body.pose(states).joints[:, index].numpy(),
    )  # fmt: skip
    evaluator = Evaluator(sequence, body, Thresholds.of(sequence))
    assert evaluator.compared == LIMB_JOINTS
    mean = states[1:2] + 0.03 * noise[2]
    mean[:, 0] += 0.5  # beside where it is
    covariance = 1e-4 * torch.eye(34, dtype=torch.float64)[None]
    here = evaluator(tracked(body, mean, covariance=covariance, index=1), START, 0.0)
    place = rotation(-0.1, 0.2, 0.4), torch.tensor([0.3, -1.0, 0.2]).double()
    other, there, spread = move_base(body, *place, mean, covariance)
    assert spread is not None
    moved = evaluator(tracked(other, there, covariance=spread, index=1), START, 0.0)
    for one, two in zip(here[4:8], moved[4:8], strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-6)
    expected = root_aligned_mpjpe_mm(
        body.pose(mean).joints[0, index], sequence.joints_world[1], names
    )
    assert np.nanmean(here.root_aligned_mm) == pytest.approx(float(expected), rel=0.1)
    assert np.nanmean(here.absolute_mm) > 450 > np.nanmean(here.root_aligned_mm)


def test_what_cannot_be_measured() -> None:
    body = placed("body34")
    states = body.rest[None].expand(2, -1)
    reference = body.pose(states).joints.numpy()
    names = tuple("far" if name == "l_hip" else name for name in body.joint_names)
    with pytest.raises(ConfigurationError, match="no l_hip"):
        Evaluator(recorded(body, states, joint_names=names), body, Thresholds())
    with pytest.raises(ConfigurationError, match="in view"):
        Evaluator(recorded(body, states, joints_world=reference + 100), body, Thresholds())
    holes = reference.copy()
    holes[:, body.joint_index("l_wrist")] = np.nan
    partly = Evaluator(recorded(body, states, joints_world=holes, truth=None), body, Thresholds())
    assert set(LIMB_JOINTS) - set(partly.compared) == {"l_wrist"}
    measures = partly(tracked(body, states[:1]), START, 0.0)
    assert not measures.failed


def test_frames_without_a_reference_count_neither_way() -> None:
    """The second mode is the near one wherever that can be told."""
    known = [[300.0, 300.0], [20.0, 20.0]]
    unknown = [[np.nan] * 2] * 2
    measures = [measure(i, known if i % 2 else unknown, overlap=math.nan) for i in range(30)]
    measures = [m._replace(failed=bool(i % 2) or None) for i, m in enumerate(measures)]
    row = summarise(measures, Thresholds(), 0.04)
    assert (row["lost"], row["lost_s"]) == (True, 0.04)
    row = summarise([m._replace(failed=None) for m in measures], Thresholds(), 0.04)
    assert not row["lost"]
    assert row["true_mode_kept"] == 1.0


def test_limits_of_bodies_without_roots() -> None:
    body, states = arm_and_states()
    sequence = recorded(body, states)
    x = states[:1].clone()
    x[:, body.state_index("r_elbow_flexion")] = -math.radians(4)
    measures = Evaluator(sequence, body, Thresholds.of(sequence))(tracked(body, x), START, 0.0)
    assert measures.outside_degrees == pytest.approx(4.0)


def measure(
    index: int, errors: list[list[float]], *, failed: bool = False, **changes: Any
) -> FrameMeasures:
    """A frame with these errors of every mode's joints, millimetres."""
    mm = np.array(errors)
    k, j = mm.shape
    return FrameMeasures(
        frame=index, time_s=index / 25, failed=failed, weight=np.full(k, 1 / k), absolute_mm=2 * mm,
        root_aligned_mm=mm, procrustes_mm=mm / 2, within=np.full((k, j), 0.7),
        joints_m=np.zeros((j, 3)), reference_m=np.zeros((j, 3)), overlap=0.8, outside_degrees=0.0,
        penetration_m=np.zeros(k), along_mm=3.0, across_mm=4.0, apart_weight=0.25,
        at_bound=("r_elbow_flexion",), evaluations=100,
        seconds={"features": 1.0, "cost": 0.1, "search": 0.5},
    )._replace(**changes)  # fmt: skip


def test_a_run_is_summed_up_until_it_is_lost() -> None:
    good = [[30.0, 50.0], [10.0, np.nan]]
    bad = [[400.0, 400.0], [300.0, 300.0]]
    measures = [measure(i, good) for i in range(10)]
    measures[3] = measure(3, [[300.0, 300.0], [90.0, 90.0]], failed=True, outside_degrees=5.0)
    deep = np.array([0.03, 0.05])
    measures[4] = measure(4, [[120.0, 120.0], [110.0, 110.0]], penetration_m=deep, overlap=0.4)
    measures[5] = measure(5, good, penetration_m=np.array([0.01, 0.04]))
    measures += [measure(i, bad, failed=True) for i in range(10, 24)]
    row = summarise(measures, Thresholds(), 0.04)
    assert (row["lost"], row["lost_s"], row["num_frames"]) == (True, 0.4, 24)
    assert row["root_aligned_mm"] == pytest.approx((8 * 40 + 300 + 120) / 10)
    assert row["root_aligned_best_of_modes_mm"] == pytest.approx((8 * 10 + 90 + 110) / 10)
    assert row["mpjpe_mm"] == pytest.approx(2 * row["root_aligned_mm"])
    assert row["pa_mpjpe_mm"] == pytest.approx(row["root_aligned_mm"] / 2)
    assert row["true_mode_kept"] == pytest.approx(0.9)
    assert row["overlap"] == pytest.approx(0.76)
    assert (row["outside_share"], row["deep_share"]) == pytest.approx((0.1, 0.1))
    assert row["deep_modes_share"] == pytest.approx(3 / 20)
    assert (row["inside_50_best"], row["inside_90_nearest"]) == (0.0, 1.0)
    assert row["acceleration_error"] == 0.0
    assert row["evaluations_per_frame"] == 100
    assert row["search_s_per_frame"] == 0.5
    assert len(row["per_frame"]["root_aligned_mm"]) == 24
    assert (row["along_mm"], row["across_mm"], row["apart_weight"]) == (3.0, 4.0, 0.25)
    assert row["per_frame"]["at_bound"][-1] == ("r_elbow_flexion",)


def test_errors_along_and_across_the_line_of_sight_and_explanations() -> None:
    body, states = arm_and_states()
    sequence = recorded(body, states)
    evaluator = Evaluator(sequence, body, Thresholds.of(sequence))
    swung = states[0].clone()
    swung[body.state_index("r_elbow_flexion")] = body.upper[body.state_index("r_elbow_flexion")]
    modes = torch.stack([swung, states[0], swung + 1e-4])
    measures = evaluator(tracked(body, modes, weight=(0.5, 0.3, 0.2)), START, 0.0)
    whole = np.sqrt((measures.absolute_mm[0] ** 2).mean())
    assert math.hypot(measures.along_mm, measures.across_mm) == pytest.approx(whole)
    assert measures.apart_weight == pytest.approx(0.3)
    assert measures.at_bound == ("r_elbow_flexion",)
    # Moved towards the camera as a whole, the arm errs along the line of sight.
    frame = tracked(body, states[:1])
    sight = sequence.joints_world[0].mean(0) - CAMERA.centre_world.numpy()
    frame.joints_world = frame.joints_world + torch.from_numpy(0.1 * sight / np.linalg.norm(sight))
    measures = evaluator(frame, START, 0.0)
    assert measures.along_mm == pytest.approx(100, abs=2)
    assert measures.across_mm < 20


def test_a_run_that_is_lost_at_once_and_one_that_is_not() -> None:
    bad = [measure(i, [[400.0]], failed=True) for i in range(20)]
    row = summarise(bad, Thresholds(), 0.04)
    assert (row["lost_s"], row["root_aligned_mm"]) == (0.0, 400.0)
    row = summarise([measure(0, [[20.0]])], Thresholds(), 0.04)
    assert not row["lost"]
    assert math.isnan(row["limb_lost_s"])
    assert math.isnan(row["lost_s"])
    assert math.isnan(row["acceleration_error"])


def test_a_limb_is_lost_where_the_mean_is_not() -> None:
    """From 0.2 s on in the best mode; the nearest one is never so far off."""
    far, near, between = [20.0, 300.0], [240.0, 20.0], [20.0, np.nan]
    modes = [[near, far] if i < 5 else [between if i == 8 else far, near] for i in range(30)]
    measures = [measure(i, errors) for i, errors in enumerate(modes)]
    row = summarise(measures, Thresholds(), 0.04)
    assert not row["lost"]
    assert row["limb_lost_s"] == pytest.approx(0.2)
    assert math.isnan(row["limb_lost_of_modes_s"])
    # From its first frame to the last that is needed it is half a second: 12.5 intervals.
    for count, expected in ((13, math.nan), (14, 0.2)):
        stop = 5 + count
        early = [m if m.frame < stop else measure(m.frame, [near, far]) for m in measures]
        found = summarise(early, Thresholds(), 0.04)["limb_lost_s"]
        np.testing.assert_allclose(found, expected)
    # The first joint of the nearest mode is 240 off but for frame 8, where the other is unknown.
    row = summarise(measures, Thresholds(lost_mm=200.0), 0.04)
    assert row["limb_lost_of_modes_s"] == pytest.approx(0.36)
    row = summarise(measures, Thresholds(lost_mm=350.0), 0.04)
    assert math.isnan(row["limb_lost_s"])


def test_medians_over_seeds() -> None:
    rows = [
        {"lost": True, "lost_s": 0.5, "x": 1.0, "name": "a", "per_frame": {}},
        {"lost": False, "lost_s": None, "x": None, "name": "b", "per_frame": {}},
        {"lost": True, "lost_s": 2.0, "x": 4.0, "name": "c", "per_frame": {}},
        {"lost": False, "lost_s": math.nan, "x": math.nan, "name": "d", "per_frame": {}},
    ]
    table = over_seeds(rows)
    assert table == {"seeds": 4, "lost": 2, "lost_s": (math.inf, 0.5, math.inf), "x": (2.5, 1, 4)}
    assert over_seeds(rows[:3])["lost_s"] == (2.0, 0.5, math.inf)
    assert over_seeds(rows[1:2])["lost_s"] == (math.inf,) * 3
    assert np.isnan(over_seeds(rows[1:2])["x"]).all()
    # An earlier version's run, which did not measure limbs, does not count as one that kept them.
    later = over_seeds([*rows[:1], rows[0] | {"limb_lost_s": 1.0}, rows[1] | {"limb_lost_s": None}])
    assert later["limb_lost_s"] == (math.inf, 1.0, math.inf)
    assert number(None, 3.0) == 3.0
    assert number(2) == 2.0


def test_thresholds_know_what_is_exact() -> None:
    body, states = arm_and_states()
    sequence = recorded(body, states)
    assert Thresholds.of(sequence).lost_mm == 150
    assert Thresholds.of(sequence._replace(truth=None)) == Thresholds()
    person = placed("body34")
    sequence = recorded(person, person.rest[None])
    assert Thresholds.of(sequence).lost_mm == 250
    assert Thresholds.of(sequence).reference_m < Thresholds().reference_m
    assert isinstance(Fraction(sequence.frame_rate), Fraction)

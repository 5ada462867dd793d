"""The study problem: its cost, its start, and how the optimiser fares on it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.errors import BodyError
from torchcss.inference.trust_region import TrustRegionNewton, default_prior_variance
from torchcss.linalg import covariance_factor
from torchcss.studies.reprojection import (
    ReprojectionProblem,
    StudyChoice,
    plausible_pose,
    study_problem,
)
from torchcss.types import Status

EXACT_CLICKS = StudyChoice(pixel_noise=1.0, all_joints=True)


def make(
    body: str = "body34", *, seed: int = 0, pose: dict[str, float] | None = None, **options
) -> ReprojectionProblem:
    choice = replace(EXACT_CLICKS, **options)
    generator = torch.Generator().manual_seed(seed)
    return study_problem(body, generator=generator, choice=choice, pose=pose)


def starts(problem: ReprojectionProblem, number: int, *, spread: float = 0.6) -> Tensor:
    """Around the truth, or for a spread of zero from the start mode's inflated covariance."""
    generator = torch.Generator().manual_seed(1)
    z = torch.randn(number, len(problem.truth), generator=generator, dtype=torch.float64)
    if spread:
        return problem.bounds.project(problem.truth + spread * z)
    factor = covariance_factor(problem.start.covariance)
    return problem.bounds.project(problem.start.mean + 8 * z @ factor.T)


def projected_gradient(problem: ReprojectionProblem, x: Tensor) -> Tensor:
    gradient = problem.cost.local_model(x).gradient
    return (problem.bounds.project(x - gradient) - x).abs().amax(-1)


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("body", ["body34", "arm8"])
def test_the_cost_is_what_the_page_says(body: str, robust: bool) -> None:
    """Errors of all joints count alike, in units of the noise; priors hold hard-to-see joints."""
    problem = make(body, robust=robust, pixel_noise=2.0, prior_scale=1.5)
    x = starts(problem, 20, spread=0.3)
    joints = problem.body.pose(x).joints[:, problem.body.joint_columns(problem.joint_names)]
    apart = (problem.camera.project(joints).uv - problem.observed) / 2.0
    squared = apart.square().sum(-1)
    rho = 8 * torch.log1p(squared / 8) if robust else squared
    z = (x - problem.body.sticky_mean) / problem.body.sticky_deviation
    prior = 9 * torch.log1p(z.square() / 9)
    expected = 0.5 * (rho.sum(-1) + prior.sum(-1))
    torch.testing.assert_close(problem.cost.value(x), expected)
    plain = load_body(body).sticky_deviation
    torch.testing.assert_close(problem.body.sticky_deviation, 1.5 * plain)


@pytest.mark.parametrize("spread", [0.6, 0.0])
@pytest.mark.parametrize("robust", [False, True])
def test_the_table_1_problem_is_solved(robust: bool, spread: float) -> None:
    """From 2000 starts: converged, inside the limits, never above the start, on a true minimum."""
    problem = make(robust=robust, pixel_noise=2.0)
    x0 = starts(problem, 500 if robust else 2000, spread=spread)
    # Far out the Lorentzian is so flat that a millionth of the slope there is a stricter measure.
    newton = TrustRegionNewton(max_steps=300, tolerance=1e-13 if robust else 1e-10)
    modes = newton.minimise(problem.cost, x0, problem.bounds)
    lower, upper = problem.bounds
    assert bool(((modes.mean >= lower) & (modes.mean <= upper)).all())
    assert bool((modes.cost <= problem.cost.value(x0)).all())
    relative = projected_gradient(problem, modes.mean) / projected_gradient(problem, x0)
    assert float((relative < 1e-6).double().mean()) >= 0.99
    assert float((modes.status == Status.CONVERGED).double().mean()) >= 0.99
    curvature = torch.where(
        modes.active[..., None] | modes.active[..., None, :],
        torch.eye(34).double(),
        problem.cost.local_model(modes.mean).hessian,
    )
    settled = modes.status == Status.CONVERGED
    assert bool((torch.linalg.eigvalsh(curvature[settled][:200]) > -1e-6).all())


def test_alone_as_in_a_batch() -> None:
    problem = make()
    x0 = starts(problem, 40)
    newton = TrustRegionNewton()
    together = newton.minimise(problem.cost, x0, problem.bounds)
    crowded = replace(newton, pool_size=7).minimise(problem.cost, x0, problem.bounds)
    for a, b in zip(together, crowded, strict=True):
        assert torch.equal(a, b)
    for i in (0, 13, 39):
        alone = newton.minimise(problem.cost, x0[i], problem.bounds)
        for a, b in zip(together, alone, strict=True):
            assert torch.equal(a[i], b)


def test_a_problem_is_what_its_seed_says() -> None:
    one, same, other = make("arm8"), make("arm8"), make("arm8", seed=1)
    assert torch.equal(one.observed, same.observed)
    assert torch.equal(one.start.mean, same.start.mean)
    assert not torch.equal(one.truth, other.truth)
    noisy = make("arm8", pixel_noise=3.0, robust=True)
    assert torch.equal(noisy.truth, one.truth)
    exact = one.camera.project(one.body.pose(one.truth).joints).uv
    torch.testing.assert_close(noisy.observed - exact, 3.0 * (one.observed - exact))
    assert one.joint_names == tuple(one.body.joint_names)
    assert "nose" not in make(seed=2).joint_names


@pytest.mark.parametrize("body", ["body34", "arm8"])
def test_the_start_mode(body: str) -> None:
    problem = make(body)
    start, bounds = problem.start, problem.bounds
    assert int(start.status) == Status.CONVERGED
    assert float(start.cost) <= float(problem.cost.value(problem.truth))
    assert not bool(start.active.any())
    # The inverse Hessian, but in no direction wider than the prior.
    deviation = default_prior_variance(bounds).sqrt()
    units = deviation[:, None] * deviation
    curvature = torch.linalg.eigvalsh(problem.cost.local_model(start.mean).hessian * units)
    torch.testing.assert_close(
        torch.linalg.eigvalsh(start.covariance / units),
        curvature.clamp(min=1).reciprocal().flip(0),
        rtol=1e-6,
        atol=1e-10,
    )
    deviations = torch.linalg.eigvalsh(start.covariance).sqrt()
    assert 100 < float(deviations[-1] / deviations[0]) < 10_000
    assert bool(((problem.truth >= bounds.lower) & (problem.truth <= bounds.upper)).all())


def test_plausible_poses_follow_the_priors(generator: torch.Generator) -> None:
    body = load_body("arm8")
    poses = torch.stack([plausible_pose(body, generator=generator) for _ in range(400)])
    assert bool(((poses >= body.lower) & (poses <= body.upper)).all())
    wide = body.state_index("r_forearm_twist")  # limits at two deviations: hardly cut off
    deviation = float(body.sticky_deviation[wide])
    assert abs(float(poses[:, wide].mean())) < 4 * deviation / 20
    assert float(poses[:, wide].std()) == pytest.approx(0.88 * deviation, rel=0.15)


def test_bodies_without_a_usual_pose_are_refused(tmp_path) -> None:
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="continuous">'
        '<parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint></robot>'
    )
    with pytest.raises(BodyError, match="sticky prior"):
        plausible_pose(load_body(urdf), generator=torch.Generator())


def test_options_change_what_they_say() -> None:
    problem = make("arm8", pixel_noise=3.0)
    noisy = make("arm8", pixel_noise=6.0)
    torch.testing.assert_close(noisy.truth, problem.truth)
    least, ends = (torch.linalg.eigvalsh(p.start.covariance).sqrt() for p in (problem, noisy))
    assert float(ends[0] / least[0]) == pytest.approx(2, rel=0.2)
    capped = torch.linalg.eigvalsh(make("arm8", pixel_noise=3.0, widest=0.1).start.covariance)
    assert float(capped[-1].sqrt()) == pytest.approx(0.1, abs=1e-6)
    loose = make("arm8", pixel_noise=3.0, prior_scale=30.0, widest=3.0).start.covariance
    assert float(torch.linalg.eigvalsh(loose)[-1].sqrt()) > float(least[-1])
    assert bool(make("arm8", limits=False).bounds.upper.isinf().all())
    far = problem.truth[None] + 0.5
    robust = make("arm8", pixel_noise=3.0, robust=True)
    assert float(robust.cost.value(far)) < 0.2 * float(problem.cost.value(far))
    given = make("arm8", pixel_noise=3.0, pose={"r_elbow_flexion": 1.0})
    assert float(given.truth[given.body.state_index("r_elbow_flexion")]) == 1.0
    assert float(given.cost.value(given.truth[None])) < 50
    with pytest.raises(BodyError, match="no parameter 'elbow'; it has"):
        make("arm8", pose={"elbow": 1.0})

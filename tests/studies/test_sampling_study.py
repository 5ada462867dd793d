import pytest
import torch

from torchcss.errors import BodyError
from torchcss.inference.proposals import CovarianceScaled
from torchcss.studies.sampling_study import (
    ExactSteps,
    StudyChoice,
    depth_flips,
    run_sampler,
    spectrum,
    study_problem,
)
from torchcss.types import BlendedCost, Status


@pytest.fixture(scope="module")
def problem():
    return study_problem("arm8", generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def run(problem):
    proposal = CovarianceScaled(deviation_scale=4, include_modes=False)
    return run_sampler(problem, proposal, 100, generator=torch.Generator().manual_seed(1))


def test_the_start_is_a_minimum_near_the_truth(problem):
    assert int(problem.start.status) == Status.CONVERGED
    assert float(problem.start.cost) < float(problem.cost.value(problem.truth[None]))
    expected = torch.linalg.eigvalsh(problem.start.covariance).sqrt().flip(0)
    torch.testing.assert_close(spectrum(problem.start.covariance), expected)


def test_options_change_what_they_say(problem):
    def other(pose: dict[str, float] | None = None, **options):
        generator = torch.Generator().manual_seed(0)
        return study_problem("arm8", generator=generator, choice=StudyChoice(**options), pose=pose)

    torch.testing.assert_close(other().start.mean, problem.start.mean)
    noisy = other(pixel_noise=6.0)
    torch.testing.assert_close(noisy.truth, problem.truth)
    ratio = float(spectrum(noisy.start.covariance)[-1] / spectrum(problem.start.covariance)[-1])
    assert ratio == pytest.approx(2, rel=0.2)
    capped = other(widest=0.1)
    assert float(spectrum(capped.start.covariance)[0]) == pytest.approx(0.1, abs=1e-6)
    loose = other(prior_scale=30.0, widest=3.0)
    assert float(spectrum(loose.start.covariance)[0]) > float(spectrum(problem.start.covariance)[0])
    assert bool(other(limits=False).bounds.upper.isinf().all())
    far = problem.truth[None] + 0.5
    assert float(other(robust=True).cost.value(far)) < 0.2 * float(problem.cost.value(far))
    given = other(pose={"r_elbow_flexion": 1.0})
    assert float(given.truth[given.cost.body.state_index("r_elbow_flexion")]) == 1.0
    assert float(given.cost.value(given.truth[None])) < 50
    with pytest.raises(BodyError, match="no parameter 'elbow'; it has"):
        other(pose={"elbow": 1.0})


def test_a_run_sums_itself_up(problem, run):
    count = len(run.found.minima)
    assert run.raw.cost.shape == (100,)
    assert run.minima.cost.shape == run.minima.distance.shape == (count,)
    assert run.num_double <= count <= run.num_half
    assert run.num_valleys <= count
    above = problem.cost.value(run.found.raw) - problem.start.cost
    torch.testing.assert_close(run.raw.cost, above)
    apart = run.found.raw - problem.start.mean
    torch.testing.assert_close(run.raw.distance, apart.norm(dim=-1))
    expected = (apart @ torch.linalg.inv(problem.start.covariance) * apart).sum(-1).sqrt()
    torch.testing.assert_close(run.raw.deviations, expected)


def test_flips_are_named(problem):
    """The forearm leans the other way once its angle is reflected about the image plane."""
    assert depth_flips(problem, problem.start.mean[None]) == {}
    body, axis = problem.cost.body, problem.cost.camera.R_camera_world[2]
    elbow = body.state_index("r_elbow_flexion")
    ends = body.joint_index("r_wrist"), body.joint_index("r_elbow")
    x = problem.start.mean.repeat(100, 1)
    x[:, elbow] = torch.linspace(0, 2.6, 100, dtype=x.dtype)
    joints = body.pose(x).joints @ axis
    lean = joints[:, ends[0]] - joints[:, ends[1]]
    start = body.pose(problem.start.mean).joints @ axis
    own = start[ends[0]] - start[ends[1]]
    expected = int(((lean * own < 0) & (lean.abs() > 0.01)).sum())
    assert 0 < expected < 100
    assert depth_flips(problem, x)["r_forearm"] == expected
    assert "r_upper_arm" not in depth_flips(problem, x)


def test_exact_steps_hide_nothing_else(problem):
    cost = ExactSteps(problem.cost)
    assert not isinstance(cost, BlendedCost)
    x = problem.truth[None]
    assert torch.equal(cost.value(x), problem.cost.value(x))

"""Arms for which the picture does not speak are found elsewhere, and all else is left alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from made_costs import Ready
from painted import a_body_before_a_camera, layers, moved, painted
from torch import Tensor

from torchcss.body.flips import Limb, Segments
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.segmentation import SegmentationTerm
from torchcss.cost.total import TrackingCost
from torchcss.inference.dynamics import ConstantVelocity
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.proposals import CovarianceScaled, with_moves
from torchcss.inference.tracker import Tracker, TrackerState
from torchcss.tracking.limb_moves import LostLimbs, astray_limbs, other_poses

DYNAMICS = ConstantVelocity(deviation=0.05, persistence=0.8)


def cost_of(
    angle: float,
    dtype: torch.dtype = torch.float64,
    *,
    missing: tuple[str, ...] = (),
    views: int = 1,
) -> tuple[BodyModel, TrackingCost]:
    """The cost of a person whose right arm is raised by so much.

    Args:
        angle: Radians.
        dtype: Type of it all.
        missing: Parts that the person lacks.
        views: How many cameras look on, all from one place.
    """
    body, camera = a_body_before_a_camera(dtype)
    truth, term = moved(body, angle), SegmentationTerm()
    ratio = painted(body, camera, truth, missing)
    images = term.images(ratio, layers(body)[1], camera, body, truth)
    colours = Ready(term, term.bind(images))
    choice = CostChoice().without("contour", "joints").having(colours)
    view = FrameContext(body=body, camera=camera, deviation=body.motion_rate / 25)
    return body, TrackingCost(choice=choice, views=(view,) * views)


def state_at(body: BodyModel, x: Tensor, *others: Tensor) -> TrackerState:
    mean = torch.stack([x, *others])
    k, n = mean.shape
    mixture = GaussianMixture(
        mean, 1e-3 * torch.eye(n).to(x).expand(k, n, n), -torch.arange(k).to(x)
    )
    tracker = Tracker(proposal=CovarianceScaled(covariance_scale=1), num_samples=1, num_modes=1)
    state = tracker.init(mixture.normalise(), generator=torch.Generator().manual_seed(0))
    return state._replace(velocity=torch.full_like(mean, 0.01))


def move_of(body: BodyModel, cost: TrackingCost, num: int) -> LostLimbs:
    return LostLimbs(search=CovarianceScaled(covariance_scale=1.0), body=body, cost=cost, num=num)


def proposed(
    body: BodyModel, cost: TrackingCost, state: TrackerState, num: int = 4
) -> GaussianMixture | None:
    """The components that are proposed, one frame ahead of a state."""
    ahead = DYNAMICS.predict(state.mixture, state.velocity)
    generator = torch.Generator().manual_seed(0)
    jumps = move_of(body, cost, num).sample(ahead, 8, body.bounds, generator=generator).jumps
    return None if jumps is None else jumps.mixture


def arm(body: BodyModel) -> Limb:
    return next(limb for limb in Segments(body).limbs if limb.name == "r_arm")


def names(limbs: list[Limb]) -> list[str]:
    return [limb.name for limb in limbs]


def find(cost: TrackingCost, body: BodyModel, x: Tensor, limb: Limb, num: int = 4) -> Tensor:
    prior = state_at(body, x).mixture
    return other_poses(cost, body, x, limb, body.bounds, prior=prior, num=num)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("views", [1, 2])
def test_the_limb_that_is_astray_is_named(dtype: torch.dtype, views: int):
    body, cost = cost_of(1.3, dtype, views=views)
    assert names(astray_limbs(cost, body, moved(body, 1.3))) == []
    assert names(astray_limbs(cost, body, moved(body, 0.5))) == ["r_arm"]
    both = moved(body, 0.5) + moved(body, 0.7, "l") - body.rest
    assert names(astray_limbs(cost, body, both)) == ["l_arm", "r_arm"]
    stepping = moved(body, 1.3)
    stepping[body.state_index("l_hip_abduction")] = 0.7
    assert names(astray_limbs(cost, body, stepping)) == [], "legs stand"


def test_it_is_found_where_it_looks_like_itself():
    body, cost = cost_of(1.4)
    x, truth = moved(body, 0.4), moved(body, 1.4)
    poses = find(cost, body, x, arm(body))
    assert 1 <= len(poses) <= 4
    assert torch.equal(body.bounds.project(poses), poses)
    held = torch.ones(len(x), dtype=torch.bool)
    held[arm(body).columns] = False
    assert torch.equal(poses[:, held], x[held].expand(len(poses), -1)), "all else stays"
    # The camera sees no depth: compare in the picture.
    uv = [cost.camera.project(body.pose(pose).joints).uv for pose in (x, truth, *poses)]
    elbow = body.joint_index("r_elbow")
    missed = [float((each[elbow] - uv[1][elbow]).norm()) for each in (uv[0], *uv[2:])]
    assert missed[1] < 0.3 * missed[0]
    assert bool((cost.weight_only(poses) < cost.weight_only(x) - 5).all())
    joints = body.pose(poses).joints
    apart = (joints[:, None] - joints).norm(dim=-1).amax(-1)
    assert float((apart + torch.eye(len(poses))).min()) > 0.15
    # Nothing is random, and the fewer wanted, the same first.
    assert torch.equal(find(cost, body, x, arm(body), num=1), poses[:1])


def test_out_of_the_way_is_not_found():
    """Before the trunk an arm covers nothing wrong; it explains nothing either."""
    right = ("r_clavicle", "r_upper_arm", "r_forearm", "r_hand")
    body, cost = cost_of(0.8, missing=right)
    x = moved(body, 0.8)
    assert "r_arm" in names(astray_limbs(cost, body, x))
    assert len(find(cost, body, x, arm(body))) == 0
    state = state_at(body, x)
    assert proposed(body, cost, state) is None


def test_what_cannot_be_seen_is_left_alone():
    body, cost = cost_of(1.3)
    state = state_at(body, moved(body, 0.5))
    for column, shift in (("root_x", 9.0), ("root_z", -9.0)):  # beside and behind the camera
        away = state._replace(mixture=state.mixture._replace(mean=state.mixture.mean.clone()))
        away.mixture.mean[:, body.state_index(column)] += shift
        assert names(astray_limbs(cost, body, away.mixture.mean[0])) == ["l_arm", "r_arm"]
        assert proposed(body, cost, away) is None
    blind = replace(cost, choice=cost.choice.without("segmentation"))
    assert astray_limbs(blind, body, moved(body, 0.5)) == []
    unknown = replace(cost, choice=cost.choice.having(SegmentationTerm()))
    assert astray_limbs(unknown, body, moved(body, 0.5)) == []


def test_an_arm_before_the_chest_is_found_where_it_is():
    """There it covers nothing wrong, so that nothing else tells."""
    body, cost = cost_of(0.9)
    x = body.rest.clone()
    x[body.state_index("r_shoulder_swing")] = -1.2
    x[body.state_index("r_shoulder_twist")] = 1.2
    x[body.state_index("r_elbow_flexion")] = 1.9
    assert "r_arm" in names(astray_limbs(cost, body, x))
    poses = find(cost, body, x, arm(body))
    uv = [cost.camera.project(body.pose(each).joints).uv for each in (x, moved(body, 0.9))]
    found = cost.camera.project(body.pose(poses[0]).joints).uv
    wrist = body.joint_index("r_wrist")
    assert float((found - uv[1])[wrist].norm()) < 0.5 * float((uv[0] - uv[1])[wrist].norm())


def test_all_but_the_arm_is_where_it_is_expected():
    body, cost = cost_of(1.4)
    x = moved(body, 0.4)
    state = state_at(body, x, moved(body, 0.4, "l"))
    found = proposed(body, cost, state, num=3)
    assert found is not None
    assert 1 <= len(found.mean) <= 3
    ahead = DYNAMICS.predict(state.mixture, state.velocity)
    odds = found.log_weight - ahead.log_weight[0]
    torch.testing.assert_close(odds, torch.full_like(odds, -5.0))
    columns = arm(body).columns
    held = torch.ones(len(x), dtype=torch.bool)
    held[columns] = False
    assert torch.equal(found.mean[:, held], ahead.mean[:1, held].expand(len(found.mean), -1))
    assert bool((found.mean[:, columns] != ahead.mean[:1, columns]).any(-1).all())
    assert torch.equal(found.covariance, ahead.covariance[:1].expand_as(found.covariance))
    assert proposed(body, cost, state_at(body, moved(body, 1.4))) is None


def test_a_tracker_goes_on_with_the_arm_that_it_had_lost():
    """With it the mode that leads after two frames has the arm where it is, without it has not."""
    body, cost = cost_of(1.4)
    tracker = Tracker(
        proposal=CovarianceScaled(covariance_scale=1.0), num_samples=12, num_modes=4,
        dynamics=DYNAMICS, likelihood_power=0.3, soft_matching=True, coarse_every=0,
    )  # fmt: skip
    elbow, truth = body.joint_index("r_elbow"), moved(body, 1.4)
    missed = []
    for num in (0, 4):
        state = state_at(body, moved(body, 0.4))
        moves = ((move_of(body, cost, num), num),)
        jumping = replace(tracker, proposal=with_moves(tracker.proposal, moves, 12))
        for _ in range(2):
            state, info = jumping.step(state, cost.problem(), body.bounds)
            assert int(info.parent.max()) < 4
        places = body.pose(torch.stack([state.mixture.mean[0], truth])).joints[:, elbow]
        uv = cost.camera.project(places).uv
        missed.append(float((uv[0] - uv[1]).norm()))
    assert missed[1] < 0.3 * missed[0]


def test_an_arm_alone_has_no_colours_to_go_by():
    body = load_body("arm7")
    _, camera = a_body_before_a_camera()
    view = FrameContext(body=body, camera=camera)
    cost = TrackingCost(choice=CostChoice().without("contour", "joints"), views=(view,))
    state = state_at(body, body.rest)
    assert proposed(body, cost, state) is None

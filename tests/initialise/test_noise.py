"""How noisy keypoints are, from what the best fit leaves over."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from made_robots import write_arm

from torchcss.body.load import load_body
from torchcss.cost.context import FrameContext
from torchcss.cost.joints import SPREAD
from torchcss.cost.total import TrackingCost
from torchcss.initialise.fit import initialise
from torchcss.initialise.multi_start import StartSearch
from torchcss.initialise.noise import noise_factor
from torchcss.initialise.options import InitialiseOptions
from torchcss.initialise.result import spread_to, with_lengths
from torchcss.studies.random_person import RandomPerson, random_person
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera


def seen(noise_px: float, seed: int) -> tuple[RandomPerson, Keypoints]:
    """A person whose keypoints err as the joint term expects, but for the scale."""
    generator = torch.Generator().manual_seed(seed)
    person = random_person(generator=generator, noise_px=0.0)
    spread = [SPREAD.get(n, SPREAD.get(n.split("_", 1)[-1], 1.0)) for n in person.joint_names]
    noise = torch.randn(person.keypoints.shape, generator=generator, dtype=person.keypoints.dtype)
    uv = person.keypoints + noise_px * noise * noise.new_tensor(spread)[:, None]
    return person, Keypoints(uv, person.confidence, person.joint_names)


def factor(noise_px: float, assumed_px: float, seed: int) -> float:
    return factor_of(*seen(noise_px, seed), assumed_px)


def factor_of(person: RandomPerson, keypoints: Keypoints, assumed_px: float) -> float:
    loose = with_lengths(
        person.body, dict(person.body.lengths), 1.0, free_root=True, free_proportions=True
    )
    cost = TrackingCost(
        choice=InitialiseOptions(sigma=assumed_px).joint_choice.without("pose_prior"),
        views=(FrameContext(body=loose, camera=person.camera, keypoints=keypoints),),
    )
    return noise_factor(cost, spread_to(person.body, loose, person.state[None])[0], StartSearch())


@pytest.mark.parametrize("ratio", [0.4, 1.0, 3.0])
def test_the_noise_shows_in_what_a_fit_leaves_over(ratio: float) -> None:
    """Fourteen marks tell a body of forty parameters little: the guess counts, too."""
    found = torch.tensor([factor(2.0 * ratio, 2.0, seed) for seed in range(3)])
    assert {0.4: found < 0.95, 1.0: (found > 0.8) & (found < 1.25), 3.0: found > 1.1}[ratio].all()


def test_outliers_are_no_noise() -> None:
    person, keypoints = seen(2.0, 0)
    keypoints.positions[3] += 80.0
    assert factor_of(person, keypoints, 2.0) < 1.3


def test_it_is_learnt_where_it_is_not_given() -> None:
    person, keypoints = seen(8.0, 1)
    generator = torch.Generator().manual_seed(0)
    few = StartSearch(num_starts=4, num_flips=0, num_samples=0, leave_out=False)
    noises = {
        given: initialise(
            None,
            keypoints,
            person.camera,
            generator=generator,
            options=InitialiseOptions(sigma=given, learn_noise=learns, search=few),
        )
        for given, learns in ((2.0, None), (2.5, True), (None, None))
    }
    assert noises[2.0].noise == 1.0
    assert noises[2.5].noise > 1.0
    assert noises[None].noise != 1.0
    assert any("noise of a wrist" in line for line in noises[None].report)
    assert not any("fit no pose" in line for line in noises[None].report)


def test_marks_that_fit_no_pose_are_told() -> None:
    person, keypoints = seen(60.0, 1)
    few = StartSearch(num_starts=4, num_flips=0, num_samples=0, leave_out=False)
    found = initialise(
        None,
        keypoints,
        person.camera,
        generator=torch.Generator().manual_seed(0),
        options=InitialiseOptions(sigma=2.0, learn_noise=True, search=few),
    )
    assert any("they fit no pose before this camera well" in line for line in found.report)


@pytest.mark.parametrize(("noise_px", "told"), [(2.0, False), (3.0, False), (60.0, True)])
def test_marks_that_miss_every_pose_by_more_than_their_stated_noise(
    noise_px: float, told: bool
) -> None:
    person, keypoints = seen(noise_px, 1)
    few = StartSearch(num_starts=4, num_flips=0, num_samples=0)
    found = initialise(
        None,
        keypoints,
        person.camera,
        generator=torch.Generator().manual_seed(0),
        options=InitialiseOptions(sigma=2.0, search=few),
    )
    lines = [line for line in found.report if "misses them by more than 3 times" in line]
    assert bool(lines) == told
    assert found.noise == 1.0


def test_a_first_look_that_misses_the_best_fit_does_not_decide(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Exact marks are exact, even where the first fit to them is a wrong one."""
    path = str(write_arm(tmp_path / "arm.urdf"))
    body, camera = load_body(path), Camera.pinhole(640, 480, focal_px=600.0)
    x = body.bounds.project(torch.tensor([[-0.29, 1.57, 1.89, -2.0, 2.9, -1.79, -0.71]]).double())
    side, along, up = body.pose(x).joints[0].unbind(-1)
    points = torch.stack([side, up, 2.5 - along], dim=-1)
    marks = Keypoints(camera.project(points)[0], torch.ones(len(points)), body.joint_names)

    def hardly(search: StartSearch) -> StartSearch:
        few = replace(search, num_starts=1, num_flips=0, num_samples=0, max_steps=1)
        return replace(few, turn=False, anneal=False)

    monkeypatch.setitem(initialise.__globals__, "briefly", hardly)
    fit = initialise(None, marks, camera, path, generator=torch.Generator().manual_seed(0))
    assert float(fit.cost[0]) < 0.1
    assert fit.noise < 0.5

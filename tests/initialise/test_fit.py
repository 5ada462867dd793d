"""Initialisation: known people are found, bad marks are named, and the same seed gives the same."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from made_robots import planar_arm

import torchcss
from torchcss.body.catalog import LENGTHS, PLACES, PROPORTIONS
from torchcss.body.load import load_body
from torchcss.body.root import has_root, unwound
from torchcss.cost.anthropometric import Anthropometric
from torchcss.cost.context import FrameContext
from torchcss.cost.interpenetration import Interpenetration
from torchcss.cost.joints import JointTerm, match_joints
from torchcss.cost.part_map import part_map
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.total import TrackingCost
from torchcss.errors import BodyError, CameraError, ConfigurationError, KeypointError
from torchcss.initialise.fit import DEFAULT_VIEW_DEGREES, default_camera, initialise
from torchcss.initialise.from_joints import hang_before_camera
from torchcss.initialise.keypoint_checks import default_sigma, typical_sigma
from torchcss.initialise.multi_start import (
    PAPER_LENGTHS,
    PAPER_PROPORTIONS,
    PAPERS,
    SINGLE_START,
    StartSearch,
    multi_start_fits,
)
from torchcss.initialise.options import LEAST_JOINTS, InitialiseOptions
from torchcss.initialise.result import Initialisation, hang_on_best, stature_of, with_uncapped
from torchcss.initialise.view import CameraView
from torchcss.joint_names import LIMB_JOINTS
from torchcss.show.initialisation_views import proportion_table
from torchcss.studies.metrics import mask_overlap, pa_mpjpe_mm
from torchcss.studies.random_person import RandomPerson, person_coverage, random_person
from torchcss.studies.render.clutter import clutter_background
from torchcss.studies.render.renderer import Mesh, render_meshes
from torchcss.studies.render.scene import look_at
from torchcss.types import Keypoints, LocalModel, Modes
from torchcss.vision.camera import Camera
from torchcss.vision.rasterise import grid_faces

SMALL = StartSearch(num_starts=16, num_trunks=2, num_flips=16, num_samples=4)


def person(seed: int = 1, **options) -> RandomPerson:
    return random_person(generator=torch.Generator().manual_seed(seed), **options)


def marks(someone: RandomPerson) -> dict[str, tuple[float, ...]]:
    return {
        name: tuple(place)
        for name, place, seen in zip(
            someone.joint_names, someone.keypoints.tolist(), someone.confidence, strict=True
        )
        if seen > 0
    }


def seen(someone: RandomPerson) -> Keypoints:
    return Keypoints(someone.keypoints, someone.confidence, someone.joint_names)


def fit(given: Keypoints | dict, camera: Camera, body: Any = "body34", **options) -> Initialisation:
    """Initialise without a picture."""
    return initialise(
        None, given, camera, body, generator=torch.Generator().manual_seed(0),
        options=InitialiseOptions(**{"search": SMALL, **options}),
    )  # fmt: skip


def find(someone: RandomPerson, search: StartSearch = SMALL, **options) -> Initialisation:
    # Random persons are in poses that nobody takes.
    options = {"least_joints": LEAST_JOINTS, "pose_prior": False, **options}
    return fit(seen(someone), someone.camera, sigma=2.0, search=search, **options)


def error_mm(found: Initialisation, someone: RandomPerson) -> np.ndarray:
    index = found.body.joint_columns(LIMB_JOINTS)
    joints = found.body.pose(found.mixture.mean).joints[:, index].numpy()
    return pa_mpjpe_mm(joints, someone.joints_world(LIMB_JOINTS).numpy()[None])


@pytest.fixture(scope="module")
def found() -> Initialisation:
    return find(person(), num_modes=None)


def test_a_person_is_found_among_the_hypotheses(found: Initialisation):
    errors = error_mm(found, person())
    assert errors[:7].min() < 70
    assert errors[0] < 110
    assert (found.cost.diff() >= 0).all()
    assert len(found.cost) > 3


def test_both_engines_find_the_same():
    """The same poses, to 2 cm of every joint, but for those on a watershed.

    Where a descent starts between two basins, or two fits are as far apart as distinct ones must
    be, the last bit of a cost, and so the processor, says whether there is one fit or two. Lengths
    are those of the best fit: where two are about as good, all costs follow the one that leads.
    """
    fused, eager = (find(person(2), num_modes=None, engine=name) for name in ("fused", "eager"))
    torch.testing.assert_close(eager.cost[0], fused.cost[0], atol=0.1, rtol=0)
    joints = (each.body.pose(each.mixture.mean).joints for each in (fused, eager))
    fused, eager = (places - places.mean(1, keepdim=True) for places in joints)
    apart = (eager[:, None] - fused).norm(dim=-1).amax(-1)
    for missed in (apart.amin(1) > 0.02, apart.amin(0) > 0.02):
        assert missed.sum() <= 2, apart


def test_limits_hold_and_lengths_stay_in_their_interval(found: Initialisation):
    body = found.body
    assert bool((found.mixture.mean >= body.lower).all())
    assert bool((found.mixture.mean <= body.upper).all())
    for name, length in found.lengths.items():
        assert abs(length / LENGTHS[name] - 1) < 0.1 + 1e-9
    assert "prior on proportions sets the scale" in "\n".join(found.report)


def test_hung_on_the_best_fit_no_hypothesis_breaks_a_limit(generator: torch.Generator):
    body = load_body("body34")
    size = (2000, body.num_parameters)
    share = torch.rand(size, generator=generator, dtype=torch.float64)
    lower, upper = body.lower.clamp(min=-3), body.upper.clamp(max=3)
    x = lower + share * (upper - lower)
    x[1, body.state_index("root_pitch")] = body.upper[body.state_index("root_pitch")]
    n = len(body.state_names)
    fits = Modes(
        x, torch.eye(n).expand(len(x), n, n), torch.arange(len(x)), x > upper,
        torch.zeros(len(x)), torch.zeros(len(x)),
    )  # fmt: skip
    hung, kept = hang_on_best(body, fits)
    # Those whose pitch is beyond 85 degrees there are left out.
    assert 1900 < len(kept.cost) < 2000
    assert int(kept.cost[0]) == 0
    assert bool(((kept.mean >= hung.lower) & (kept.mean <= hung.upper)).all())
    joints = body.pose(x).joints[kept.cost]
    torch.testing.assert_close(hung.pose(kept.mean).joints, joints, rtol=0, atol=1e-9)


def test_covariances_are_those_of_modes_with_unknown_lengths(found: Initialisation):
    assert bool((torch.linalg.eigvalsh(found.mixture.covariance) > 0).all())
    body, covariance = found.body, found.mixture.covariance[0]
    columns = [body.state_index(f"root_{axis}") for axis in "xyz"]
    # 4 % of 3.5 m: the person's size is not known.
    largest = torch.linalg.eigvalsh(covariance[columns][:, columns])[-1]
    assert 0.05 < float(largest.sqrt()) < 0.3
    assert found.free_body is not None
    assert found.free_mixture is not None
    stated = person_coverage(person(), found.free_body, found.free_mixture)
    assert stated.parameters > 0.7
    assert found.uncapped is not None
    free = found.uncapped.diagonal() > 0
    wider = torch.linalg.eigvalsh((found.uncapped - covariance)[free][:, free])
    assert float(wider[0]) > -1e-9
    assert float(wider[-1]) > 0


@pytest.mark.parametrize(("curvature", "floored"), [(2.0, False), (-1.0, True)])
def test_a_first_covariance_says_whether_it_was_floored(
    found: Initialisation, curvature: float, floored: bool
):
    hessian = curvature * torch.eye(found.body.num_parameters).to(found.body.tie)[None]
    model = LocalModel(hessian[:, 0, 0], torch.zeros_like(hessian[:, 0]), hessian)
    cost: Any = SimpleNamespace(body=found.body, local_model=lambda _: model)
    assert with_uncapped(found, cost, StartSearch()).uncapped_floored == floored


def test_hypotheses_are_the_fits_and_then_samples(found: Initialisation):
    generator = torch.Generator().manual_seed(0)
    states = found.hypotheses(50, generator=generator)
    fits = len(found.cost)
    assert states.shape == (50, found.body.num_parameters)
    assert torch.equal(states[:fits], found.mixture.mean[:50])
    assert torch.equal(found.hypotheses(2, generator=generator), found.mixture.mean[:2])
    assert torch.equal(states, found.body.bounds.project(states))


def test_gross_marks_are_named_and_the_pose_is_that_without_them():
    someone = person(8, outliers=0.05)
    outliers = {
        name
        for name, is_outlier in zip(someone.joint_names, someone.is_outlier, strict=True)
        if is_outlier
    }
    assert outliers == {"r_wrist", "r_knee", "l_ankle"}
    found = find(someone, num_modes=2)
    assert set(found.left_out) == outliers
    assert any("left out" in line and "r_knee" in line for line in found.report)
    # What is left costs no more than marks with nothing but noise.
    assert float(found.cost[0]) < 8
    assert bool((found.mixture.mean >= found.body.lower).all())
    assert bool((found.mixture.mean <= found.body.upper).all())


def test_many_starts_find_what_a_single_one_does_not(found: Initialisation):
    single = find(person(), SINGLE_START, num_modes=None)
    assert float(found.cost[0]) < float(single.cost[0]) - 1
    assert len(single.cost) == 1


def test_known_stature_sets_the_scale(found: Initialisation):
    tall = find(person(), stature=2.0, num_modes=2)
    assert stature_of(tall.lengths, tall.scale) == pytest.approx(2.0, abs=1e-6)
    assert "a stature of 2 m sets the scale" in "\n".join(tall.report)
    distances = [float(each.body.base_translation.norm()) for each in (tall, found)]
    statures = [stature_of(each.lengths, each.scale) for each in (tall, found)]
    assert distances[0] / distances[1] == pytest.approx(statures[0] / statures[1], rel=0.05)
    with pytest.raises(BodyError, match="stature"):
        find(person(), stature=180)


def test_colours_tell_the_outline_of_a_chequered_shirt():
    """Edges all over draw limbs thin; what is on either side of the outline does not."""
    someone = person()
    size = 0.22  # 180 pixels tall
    camera = someone.camera.scaled(size)
    width, height = camera.image_size_wh
    room = clutter_background(height, width, generator=torch.Generator().manual_seed(1))
    picture = render_meshes(_in_squares(someone), camera, background=room)
    truth = part_map(someone.body, someone.state, camera) >= 0
    keypoints = seen(someone)
    overlap, girth = [], []
    for colours in (False, True):
        found = initialise(
            picture.numpy(), keypoints.scaled(someone.camera.image_size_wh, (width, height)),
            camera, generator=torch.Generator().manual_seed(0),
            options=InitialiseOptions(
                search=SMALL, num_modes=2, colours=colours, pose_prior=False
            ),
        )  # fmt: skip
        drawn = part_map(found.body, found.mixture.mean[0], camera) >= 0
        overlap.append(float(mask_overlap(drawn, truth)))
        girth.append(float((found.body.part_shape / someone.body.part_shape)[:, :2].mean()))
    assert overlap[0] < 0.91
    assert overlap[1] > 0.93
    assert abs(girth[1] - 1) < 0.05 < abs(girth[0] - 1)


def _in_squares(someone: RandomPerson) -> list[Mesh]:
    def squares(points: torch.Tensor) -> torch.Tensor:
        return 0.35 + 0.65 * ((points * 40).floor().sum(-1, keepdim=True) % 2)

    body, size = someone.body, 24
    rotation, centre = body.part_poses(body.pose(someone.state))
    mesh = body.mesh(size, size)
    colours = {"thigh": (0.3, 0.3, 0.7), "shank": (0.3, 0.3, 0.7), "hand": (0.8, 0.6, 0.5)}
    return [
        Mesh(
            points @ turn.T + place,
            normals @ turn.T,
            grid_faces(size, size),
            torch.tensor(colours.get(name[2:], (0.9, 0.3, 0.3)), dtype=torch.float64),
            points,
            squares,
        )
        for name, turn, place, points, normals in zip(
            body.part_names, rotation, centre, mesh.points.flatten(1, 2),
            mesh.normals.flatten(1, 2), strict=True,
        )
    ]  # fmt: skip


def test_marks_keep_their_place_in_a_picture_whose_sides_are_rounded(
    monkeypatch: pytest.MonkeyPatch,
):
    """Sides of 303 and 1000 pixels become 19 and 64: each has a factor of its own."""
    module = import_module("torchcss.initialise.fit")
    monkeypatch.setattr(module, "_with_contours", lambda first, cost, *_: cost)
    camera = Camera.pinhole(303, 1000, focal_px=600.0)
    body = load_body("arm7").with_base(
        torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.0, 0.0, 3.0])
    )
    uv = camera.project(body.pose(body.rest).joints).uv
    keypoints = Keypoints(uv, torch.ones(len(uv)).double(), body.joint_names)
    cost: Any = initialise(
        np.zeros((1000, 303, 3), np.uint8), keypoints, camera, "arm7",
        generator=torch.Generator().manual_seed(0),
        options=InitialiseOptions(search=SINGLE_START, working_size=64),
        others=[CameraView(camera, keypoints)],
    )  # fmt: skip
    for view in cost.views:
        assert view.camera.image_size_wh == (19, 64)
        place, expected = view.camera.undistort(view.keypoints.positions), camera.undistort(uv)
        torch.testing.assert_close(place[0], expected[0])


def test_few_joints_leave_the_prior_and_say_so():
    someone = person()
    one = marks(someone)
    two = {name: one[name] for name in ("l_shoulder", "l_elbow")}
    found = fit(two, someone.camera, num_modes=2, pose_prior=False)
    line = next(line for line in found.report if line.startswith("not determined"))
    for name in ("r_knee_flexion", "l_hip_twist", "neck_twist"):
        assert name in line
    assert not any("swapped" in line for line in found.report)
    knee = found.body.state_index("r_knee_flexion")
    deviation = float(found.mixture.covariance[0, knee, knee].sqrt())
    assert deviation == pytest.approx(float(found.body.sticky_deviation[knee]), rel=0.25)
    with pytest.raises(KeypointError, match="at least 3"):
        find(someone._replace(confidence=(torch.arange(14) < 2).double()))


def test_unseen_legs_stand_as_people_do():
    """With the prior on poses the legs of somebody seen to the hips are where legs usually are."""
    someone = person()
    above = {name: place for name, place in marks(someone).items()
             if not name.endswith(("knee", "ankle"))}  # fmt: skip
    found = fit(above, someone.camera, num_modes=2)
    column = found.body.state_columns(["l_knee_flexion", "r_knee_flexion"])
    spread = found.mixture.covariance[0].diagonal().sqrt()[column]
    assert bool((spread < 0.8 * found.body.sticky_deviation[column]).all())


def test_swapped_sides_are_reported_and_left_as_they_are():
    someone = person(3, joint_names=(*person().joint_names, "nose", "l_toe", "r_toe"))
    legs = {"hip", "knee", "ankle", "toe"}
    swapped = tuple(_swap(name, legs) for name in someone.joint_names)
    given = dict(zip(swapped, someone.keypoints.tolist(), strict=True))
    found = fit(given, someone.camera, num_modes=1)
    assert any("left and right look swapped in the legs" in line for line in found.report)


def _swap(name: str, places: set[str]) -> str:
    side, _, place = name.partition("_")
    return name if place not in places else f"{'l' if side == 'r' else 'r'}_{place}"


def test_odd_marks_are_named_and_gross_ones_move_little():
    someone = person()
    spoilt = marks(someone)
    spoilt["l_wrist"] = spoilt["l_elbow"]
    spoilt["r_ankle"] = (30.0, 1200.0)
    found = fit(spoilt, someone.camera, sigma=2.0, num_modes=1)
    report = "\n".join(found.report)
    assert "at the same place: l_elbow and l_wrist" in report
    assert "outside the image: r_ankle" in report
    assert "r_ankle" in found.left_out
    projected = someone.camera.project(found.body.pose(found.mixture.mean[0]).joints).uv
    others = [name for name in LIMB_JOINTS if name not in ("l_wrist", "r_ankle")]
    fitted = projected[found.body.joint_columns(others)]
    given = fitted.new_tensor([spoilt[name] for name in others])
    assert float((fitted - given).norm(dim=-1).max()) < 20


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "0 joints"),
        ({"l_wrist": (10, 10, 0.0), "r_wrist": (50, 10, 0.0)}, "0 joints"),
        ({"l_wrist": (10, 10), "r_wrist": (10, 10), "nose": (10, 10)}, "all 3 joints"),
        ({"left_tentacle": (10, 10)}, "unknown joint"),
        ({"l_wrist": (float("nan"), 10)}, "0 joints"),
        ({"l_wrist": (10,)}, "expected"),
        ({"l_wrist": (10, 10, 1.0, 3.0)}, r"expected \(u, v\) or"),
        ({"l_wrist": "there"}, r"expected \(u, v\) or"),
    ],
)
def test_marks_from_which_nothing_follows(given: dict, message: str, generator: torch.Generator):
    with pytest.raises(KeypointError, match=message):
        initialise(None, given, person().camera, generator=generator)


def test_keypoints_are_those_of_one_image(generator: torch.Generator):
    someone = person()
    known = Keypoints(someone.keypoints[None], someone.confidence[None], someone.joint_names)
    with pytest.raises(KeypointError, match=r"one image, \[j 2\]: use keypoints\.at"):
        initialise(None, known, someone.camera, generator=generator)
    with pytest.raises(KeypointError, match="expected one of each"):
        initialise(
            None, known.at(0)._replace(confidence=known.confidence), someone.camera,
            generator=generator,
        )  # fmt: skip


def test_joints_of_a_robot_have_its_own_names(tmp_path: Path, generator: torch.Generator):
    path = planar_arm(tmp_path / "arm.urdf", 0.5, 0.4, limit=1.5)
    body = load_body(path)
    x = torch.tensor([0.3, 0.8], dtype=torch.float64)
    camera = look_at([0.0, 0.0, 3.0], [0.0, 0.0, 0.0], focal_px=700.0, name="above")
    places = camera.project(body.pose(x).joints).uv
    marked = dict(zip(body.joint_names, places.tolist(), strict=True))
    for given in (body, str(path)):
        found = initialise(None, marked, camera, given, generator=generator)
        joints = found.body.pose(found.mixture.mean[0]).joints
        torch.testing.assert_close(camera.project(joints).uv, places, rtol=0, atol=1.0)
    with pytest.raises(BodyError, match=r"stature: .* has the lengths of its file"):
        initialise(
            None, marked, camera, str(path), generator=generator,
            options=InitialiseOptions(stature=1.9),
        )  # fmt: skip
    with pytest.raises(KeypointError, match=f"unknown joint 'tap'.* {body.joint_names[-1]}"):
        initialise(None, {"tap": (1.0, 2.0)}, camera, body, generator=generator)


def test_a_joint_without_limits_has_one_value_for_a_pose(tmp_path: Path, generator):
    path = planar_arm(tmp_path / "arm.urdf", 0.5, 0.4, 0.3)
    body = load_body(path)
    x = torch.tensor([0.3, 2.8, -2.9], dtype=torch.float64)
    camera = look_at([0.2, -0.4, 3.0], [0.0, 0.0, 0.0], focal_px=700.0, name="above")
    places = camera.project(body.pose(x).joints).uv
    marked = dict(zip(body.joint_names, places.tolist(), strict=True))
    found = initialise(None, marked, camera, str(path), generator=generator)
    modes = found.mixture.mean
    assert float(modes.abs().max()) <= math.pi
    apart = torch.pdist(found.body.pose(modes).joints.flatten(1))
    assert not bool((apart < 1e-3).any())
    # The arm stands where the fit puts it: turned there, its first joint reaches the same.
    (line,) = (line for line in found.report if line.startswith("not determined"))
    assert line.endswith("as its place was sought as well: joint1")
    limited = load_body(planar_arm(tmp_path / "limited.urdf", 0.5, 0.4, limit=7.0))
    wound = torch.tensor([6.5, -0.1], dtype=torch.float64)
    torch.testing.assert_close(unwound(limited, wound), wound - wound.new_tensor([2 * math.pi, 0]))


def test_cameras(generator: torch.Generator):
    camera, note = default_camera(400, 1000)
    angle = 2 * np.degrees(np.arctan(500 / float(camera.K[0, 0])))
    assert angle == pytest.approx(DEFAULT_VIEW_DEGREES)
    assert "not given" in note
    picture = np.zeros((300, 400, 3), np.uint8)
    with pytest.raises(CameraError, match="neither"):
        initialise(None, marks(person()), generator=generator)
    with pytest.raises(CameraError, match="belongs to images"):
        initialise(picture, marks(person()), person().camera, generator=generator)
    behind = load_body("arm7").with_base(torch.eye(3), torch.tensor([0.0, 0.0, 3.0]))
    with pytest.raises(CameraError, match="looks away"):
        initialise(None, marks(person()), person().camera, behind, generator=generator)


def test_arms_and_single_precision():
    body = load_body("arm7").with_base(torch.eye(3), torch.tensor([0.0, 0.2, -1.5]))
    x = body.rest + 0.2
    x = body.bounds.project(x)
    camera = person().camera
    uv = camera.project(body.pose(x).joints).uv
    keypoints = Keypoints(uv, torch.ones(4), body.joint_names)
    found = fit(keypoints, camera, "arm7", dtype=torch.float32)
    assert found.body.dtype == found.mixture.mean.dtype == torch.float32
    assert float(found.cost[0]) < 8
    placed, again = (fit(keypoints, camera, body, sigma=2.0) for _ in range(2))
    assert torch.equal(placed.mixture.mean, again.mixture.mean)
    assert torch.equal(placed.mixture.covariance, again.mixture.covariance)
    # An elbow that bends the other way, or not: some hypothesis is the truth.
    apart = (placed.body.pose(placed.mixture.mean).joints - body.pose(x).joints).norm(dim=-1)
    assert float(apart.mean(-1).min()) < 0.06


def test_an_arm_that_shall_move_about(generator: torch.Generator):
    body = load_body("arm7").with_base(torch.eye(3), torch.tensor([0.0, 0.2, -1.5]))
    camera = person().camera
    keypoints = Keypoints(
        camera.project(body.pose(body.bounds.project(body.rest + 0.2)).joints).uv,
        torch.ones(4),
        body.joint_names,
    )
    options = InitialiseOptions(sigma=1.0, search=SMALL, contours=False, free_root=True)
    found = initialise(None, keypoints, camera, "arm7", generator=generator, options=options)
    assert has_root(found.body)
    assert found.body.num_parameters == body.num_parameters + 6


def test_terms_of_the_first_stage_can_be_weighed(generator):
    body = load_body("body34", free_proportions=True)
    drawn = torch.randn(2, body.num_parameters, generator=generator).double()
    x = body.bounds.project(0.05 * drawn)
    with_all, without = (
        InitialiseOptions(sigma=1.0, weights=weights).joint_cost(
            body, [CameraView(person().camera)]
        )
        for weights in ({}, {"anthropometric": 0.0})
    )
    told = with_all.terms(x)["anthropometric"]
    assert float(told.min()) > 0
    torch.testing.assert_close(without.value(x), with_all.value(x) - told)


def test_only_the_papers_proportions_if_asked():
    search = replace(SMALL, proportions=PAPER_LENGTHS)
    found = find(person(), search, num_modes=1)
    assert set(found.lengths) == set(PAPER_LENGTHS)
    assert len(PAPER_PROPORTIONS) == 8
    assert all(found.lengths[name] != LENGTHS.get(name, 0.0) for name in PAPER_PROPORTIONS)
    for name, length in PLACES.items():
        assert abs(found.lengths[name]) <= 0.1 * LENGTHS[length]
        assert found.body.lengths[name] == found.lengths[name]
    fixed = {"shoulder_width", "neck", "hand", "foot"}
    assert set(PROPORTIONS) - set(PAPER_LENGTHS) == fixed
    neck = {"neck": LENGTHS["neck"]}  # not fitted
    assert stature_of(found.lengths) == pytest.approx(stature_of({**found.lengths, **neck}))
    rows = {row["name"]: row for row in proportion_table(found.lengths)}
    hip = rows["hip_depth"]
    assert hip["standard_m"] == 0
    assert hip["difference_percent"] == pytest.approx(
        100 * found.lengths["hip_depth"] / LENGTHS["hip_width"]
    )
    with pytest.raises(ConfigurationError, match="tail"):
        StartSearch(proportions=("tail",))


@pytest.mark.parametrize("name", ["num_starts", "num_flips", "max_steps", "covariance_scale"])
def test_searches_out_of_range_are_refused(name: str):
    with pytest.raises(ConfigurationError, match=f"StartSearch.{name}: expected"):
        StartSearch(**{name: torch.nan})


def test_the_papers_stages_are_one_fit_that_keeps_parts_apart():
    options = InitialiseOptions(search=replace(SMALL, coarse_pose={"root_yaw": 1.0})).as_papers()
    assert options.search == replace(PAPERS, coarse_pose={"root_yaw": 1.0})
    assert options.num_modes == 1
    assert not options.colours
    choice = replace(options, sigma=2.0).joint_choice
    assert [type(term) for term in choice.terms] == [
        JointTerm, Stabiliser, Anthropometric, Interpenetration
    ]  # fmt: skip
    stabiliser = choice.find(Stabiliser)
    assert stabiliser is not None
    assert stabiliser.hidden_only
    # [RR] repels no parts.
    report = InitialiseOptions(sigma=2.0, printed="rr").joint_choice
    assert report == choice.without("interpenetration")


def test_a_coarse_pose_leads_a_single_start_to_the_fit(found: Initialisation):
    someone = person()
    names = found.free_body.state_names
    coarse = dict(zip(names, found.free_mixture.mean[0].tolist(), strict=True))
    coarse = {name: value for name, value in coarse.items() if not name.endswith("_length")}
    near = find(someone, replace(PAPERS, coarse_pose=coarse), num_modes=1, printed="ijrr")
    assert len(near.cost) == 1
    assert abs(error_mm(near, someone)[0] - error_mm(found, someone)[0]) < 5
    at_rest = find(someone, PAPERS, num_modes=1, printed="ijrr")
    assert error_mm(at_rest, someone)[0] > error_mm(near, someone)[0] + 20
    with pytest.raises(BodyError, match="tail"):
        find(someone, replace(PAPERS, coarse_pose={"tail": 0.0}))


@pytest.mark.parametrize("yaw", [0.0, math.pi / 2, math.pi])
def test_a_start_is_turned_as_the_joints_say(yaw: float, generator: torch.Generator):
    someone = person()
    body = load_body("body34", free_proportions=True)
    body = hang_before_camera(body, someone.camera, match_joints(seen(someone), body.joint_names))
    x = body.rest[None].clone()
    x[:, body.state_index("root_yaw")] = yaw
    marked = body.pose(x).joints[0]
    keypoints = Keypoints(
        someone.camera.project(marked).uv, torch.ones(len(marked)).to(marked), body.joint_names
    )
    cost = TrackingCost(
        choice=InitialiseOptions(sigma=2.0).joint_choice,
        views=(FrameContext(body=body, camera=someone.camera, keypoints=keypoints),),
    )
    fits = multi_start_fits(cost, search=PAPERS, generator=generator)
    turned = fits.mean[0, body.state_index("root_yaw")]
    assert torch.cos(turned - yaw) > 0.9


def test_default_sigma_follows_the_persons_size():
    box = torch.tensor([[0.0, 0.0], [300.0, 400.0]])
    keypoints = Keypoints(box, torch.ones(2), ("l_wrist", "r_wrist"))
    assert default_sigma(keypoints) == pytest.approx(3.0)
    assert default_sigma(keypoints._replace(positions=box / 100)) == 1.0


def test_typical_sigma_is_that_of_the_middle_frame():
    box = torch.tensor([[0.0, 0.0], [300.0, 400.0], [0.0, 400.0]])
    places = torch.stack([box, 2 * box, 4 * box, 100 * box])
    confidence = torch.tensor([[1, 1, 1], [0.3, 1, 0.3], [1, 1, 1], [1, 0, 0]])
    keypoints = Keypoints(places, confidence, ("l_wrist", "r_wrist", "nose"))
    assert typical_sigma(keypoints) == pytest.approx(6.0)
    assert typical_sigma(keypoints.at(torch.tensor([0, 1]))) == pytest.approx(4.5)
    nowhere = keypoints._replace(positions=places.index_fill(1, torch.tensor([0, 1]), torch.nan))
    for frame in (keypoints, 3), (nowhere, 1):
        with pytest.raises(KeypointError, match="no frame has two keypoints"):
            typical_sigma(frame[0].at(torch.tensor([frame[1]])))


def test_public_name():
    assert torchcss.initialise is initialise


def test_a_detectors_points_are_a_start() -> None:
    someone = person(4, noise_px=0.0)
    names = tuple(n for n in someone.joint_names if n in someone.body.joint_names)
    away = someone.camera.R_camera_world.to(torch.float64) @ someone.joints_world(names).T
    known = seen(someone).only(names)
    told = known._replace(points=1.3 * (away.T - away.T.mean(0)))  # of a larger person
    alone = StartSearch(num_starts=1, num_flips=0, num_samples=0, leave_out=False)
    options = {"sigma": 1.0, "search": alone, "least_joints": LEAST_JOINTS}

    def error(keypoints: Keypoints) -> tuple[float, float]:
        found = fit(keypoints, someone.camera, **options)
        return float(found.cost[0]), float(error_mm(found, someone)[0])

    (cost, near), (cost_alone, far) = error(told), error(known)
    assert near < 0.6 * far
    assert cost < cost_alone
    none = known._replace(points=torch.full_like(told.points, torch.nan))
    assert error(none) == (cost_alone, far)

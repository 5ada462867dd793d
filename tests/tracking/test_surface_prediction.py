"""The prediction by the surface: the trunk goes where it is seen to go, limbs and head hang on."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
import pytest
import torch
from made_sessions import seen_by, session_at, start_at
from torch import Tensor
from torch.nn import functional

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.errors import ConfigurationError
from torchcss.inference.dynamics import ConstantVelocity, Diffusion
from torchcss.inference.mixture import GaussianMixture
from torchcss.studies.render.renderer import Lighting, Mesh, random_texture, render_meshes
from torchcss.tracking.session import Posterior, TrackingSession
from torchcss.tracking.settings import Settings, make_plan
from torchcss.tracking.surface_prediction import (
    PicturePair,
    SurfaceCost,
    SurfaceDynamics,
    SurfaceMotion,
    trunk_of,
)
from torchcss.types import Frame
from torchcss.vision.camera import Camera
from torchcss.vision.contrast import local_contrast
from torchcss.vision.rasterise import grid_faces
from torchcss.vision.spline import SplineField, spline_field

YAW = 3
INTERVAL = 1 / 30
WIDTH, HEIGHT = 320, 240


@cache
def the_body() -> BodyModel:
    """A person who stands before the camera of `the_camera`, Y up."""
    base = torch.tensor([0.0, 0.2, -3.0], dtype=torch.float64)
    return load_body("body34").with_base(torch.eye(3, dtype=torch.float64), base)


@cache
def the_camera() -> Camera:
    K = [[325.0, 0.0, 159.5], [0.0, 325.0, 119.5], [0.0, 0.0, 1.0]]
    return Camera(K, (WIDTH, HEIGHT), R_camera_world=np.diag([1.0, -1.0, -1.0]))


def poses(count: int = 1) -> Tensor:
    body = the_body()
    generator = torch.Generator().manual_seed(0)
    x = body.rest + 0.05 * torch.randn(count, len(body.rest), generator=generator).double()
    return body.bounds.project(x)


def turned(x: Tensor, degrees: float) -> Tensor:
    other = x.clone()
    other[..., YAW] += math.radians(degrees)
    return other


def picture(x: Tensor, *, lamp: float = 0.9, plain: bool = False) -> Tensor:
    """The body in a checked shirt before a checked wall, grey."""
    body, camera = the_body(), the_camera()
    generator = torch.Generator().manual_seed(1)
    fine, faces = body.mesh(30, 36), grid_faces(30, 36)
    rotation, centre = body.part_poses(body.pose(x))
    meshes = []
    for part in range(body.num_parts):
        local, normals = fine.points[part].flatten(0, 1), fine.normals[part].flatten(0, 1)
        turn = rotation[part].T
        cloth = random_texture(generator=generator, shortest=0.08, longest=0.2, contrast=0.4)
        meshes.append(
            Mesh(
                local @ turn + centre[part],
                normals @ turn,
                faces,
                torch.full((3,), 0.6, dtype=torch.float64),
                points_part=local,
                texture=None if plain else cloth,
            )
        )
    wall = torch.rand(1, 1, 24, 32, generator=generator)
    wall = functional.interpolate(wall, size=(HEIGHT, WIDTH), mode="bicubic")[0, 0].clamp(0, 1)
    background = (255 * wall).byte()[..., None].expand(-1, -1, 3).contiguous()

    light = Lighting(lamp_world=(1.0, 2.0, 1.0), target_world=(0.0, 0.0, -3.0), lamp=lamp)
    image = render_meshes(meshes, camera, background=background, shade=light.shade)
    return image.double().mean(-1) / 255


def seen(x: Tensor, **how: bool | float) -> SplineField:
    return spline_field(local_contrast(picture(x, **how)))  # type: ignore[arg-type]


def sight(before: Tensor, now: Tensor) -> PicturePair:
    return PicturePair(the_camera(), seen(before), seen(now))


def carry(
    before: Tensor,
    pairs: Iterable[PicturePair],
    *,
    velocity: Tensor | None = None,
    expected: Tensor | None = None,
) -> Tensor:
    return SurfaceMotion(the_body())(
        the_body(),
        list(pairs),
        before=before,
        velocity=torch.zeros_like(before) if velocity is None else velocity,
        expected=before if expected is None else expected,
        deviation=the_body().motion_rate * INTERVAL,
    )


def turn_between(x: Tensor, other: Tensor) -> Tensor:
    """By how many degrees the chest is turned about the vertical from one pose to the other."""
    body = the_body()
    chest = body.part_names.index("chest")
    first, second = (body.part_poses(body.pose(each))[0][..., chest, :, :] for each in (x, other))
    turn = second @ first.mT
    return torch.rad2deg(
        torch.atan2(turn[..., 0, 2] - turn[..., 2, 0], turn[..., 0, 0] + turn[..., 2, 2])
    )


@cache
def scene() -> tuple[Tensor, Tensor, PicturePair]:
    """A pose, the same turned by eight degrees, and what is seen of the two."""
    before = poses()
    after = turned(before, 8.0)
    return before, after, sight(before[0], after[0])


def test_trunk_turns_with_its_surface() -> None:
    before, after, view = scene()
    found = carry(before, [view])
    assert abs(float(turn_between(before, after))) > 7.5
    # What is left is the prior's, which thinks of nine degrees about none.
    assert abs(float(turn_between(found, after))) < 2.5
    limbs = torch.ones(before.shape[-1], dtype=torch.bool)
    limbs[trunk_of(the_body())[0]] = False
    assert torch.equal(found[:, limbs], before[:, limbs])


def test_it_starts_where_the_last_motion_leads() -> None:
    """A turn of twenty degrees is too far for a match, but not from one of fifteen."""
    before = poses()
    after = turned(before, 20.0)
    view = sight(before[0], after[0])
    velocity = turned(before, 15.0) - before
    expected = before.clone()
    expected[:, -1] += 0.1
    found = carry(before, [view], velocity=velocity, expected=expected)
    assert abs(float(turn_between(found, after))) < 3
    assert torch.equal(found[:, -1], expected[:, -1])
    assert abs(float(turn_between(carry(before, [view]), after))) > 6


def test_another_light_is_no_other_surface() -> None:
    before, after, view = scene()
    found = carry(before, [view._replace(now=seen(after[0], lamp=0.4))])
    assert abs(float(turn_between(found, after))) < 3


def test_a_plain_surface_says_little() -> None:
    """Without texture there is light and the rim; the last motion is not thrown over."""
    before, after, _ = scene()
    view = PicturePair(the_camera(), seen(before[0], plain=True), seen(after[0], plain=True))
    found = carry(before, [view])
    assert abs(float(turn_between(before, found))) < 8


def test_every_mode_has_its_own_past() -> None:
    before, _, view = scene()
    two = torch.cat([before, turned(before, -3.0)])
    found = carry(two, [view])
    alone = torch.cat([carry(one, [view]) for one in two.split(1)])
    torch.testing.assert_close(found, alone, atol=1e-6, rtol=0)
    assert not torch.equal(found[0], found[1])


def test_two_cameras_agree() -> None:
    before, after, view = scene()
    found = carry(before, [view, view])
    assert abs(float(turn_between(found, after))) < 2
    blind = view._replace(now=None)
    assert torch.equal(carry(before, [blind, view]), carry(before, [view]))


@pytest.mark.parametrize("lacks", ["before", "now"])
def test_without_two_pictures_nothing_moves(lacks: str) -> None:
    before, _, view = scene()
    expected = turned(before, 2.0)
    found = carry(before, [view._replace(**{lacks: None})], expected=expected)
    assert torch.equal(found, expected)


def test_without_an_expected_motion_nothing_moves() -> None:
    before, _, view = scene()
    found = SurfaceMotion(the_body())(
        the_body(),
        [view],
        before=before,
        velocity=torch.zeros_like(before),
        expected=before,
        deviation=None,
    )
    assert found is before


def test_limits_hold() -> None:
    body = the_body()
    before = poses()
    index = body.state_index("lumbar_twist")
    before[:, index] = body.bounds.upper[index]
    after = before.clone()
    after[:, index] += 0.2
    view = sight(before[0], after[0])
    found = carry(before, [view], velocity=after - before)
    assert torch.equal(body.bounds.project(found), found)


def a_cost(generator: torch.Generator) -> tuple[SurfaceCost, Tensor]:
    before, _, view = scene()
    carrier, body = SurfaceMotion(the_body()), the_body()
    two = torch.cat([before, turned(before, 4.0)])
    columns = carrier.columns
    cost = SurfaceCost(
        body=body,
        nodes=carrier.nodes,
        chosen=carrier.on_trunk,
        views=carrier.views(body, [view, view], two),
        columns=columns,
        held=two,
        expected=two[:, columns],
        deviation=carrier.spread * (body.motion_rate * INTERVAL)[columns],
    )
    noise = torch.randn(2, len(columns), generator=generator, dtype=torch.float64)
    return cost, two[:, columns] + 0.01 * noise


def test_gradient_is_that_of_the_value(generator: torch.Generator) -> None:
    """By central differences; facing, a ramp, moves a little with the pose."""
    cost, x = a_cost(generator)
    model = cost.local_model(x)
    step = 1e-6
    for column in range(x.shape[-1]):
        move = torch.zeros_like(x)
        move[:, column] = step
        slope = (cost.value(x + move) - cost.value(x - move)) / (2 * step)
        torch.testing.assert_close(model.gradient[:, column], slope, atol=0.6, rtol=0.05)


def test_hessian_is_that_of_gauss_and_newton(generator: torch.Generator) -> None:
    cost, x = a_cost(generator)
    hessian = cost.local_model(x).hessian
    torch.testing.assert_close(hessian, hessian.mT)
    assert torch.linalg.eigvalsh(hessian).min() > 0
    # At the pose that the picture shows, where all nodes agree, it is the Hessian.
    still = seen(poses()[0])
    view = PicturePair(the_camera(), still, still)
    before = poses()
    carrier = SurfaceMotion(the_body())
    alike = SurfaceCost(
        body=cost.body, nodes=cost.nodes, chosen=cost.chosen,
        views=carrier.views(cost.body, [view], before), columns=cost.columns, held=before,
        expected=before[:, cost.columns], deviation=cost.deviation,
    )  # fmt: skip
    at, step = before[:, cost.columns], 1e-5
    model = alike.local_model(at)
    for column in range(at.shape[-1]):
        move = torch.zeros_like(at)
        move[:, column] = step
        ahead, behind = alike.local_model(at + move), alike.local_model(at - move)
        row = (ahead.gradient - behind.gradient) / (2 * step)
        torch.testing.assert_close(row, model.hessian[:, column], atol=1.0, rtol=0.02)


def test_items_are_taken_with_what_is_theirs(generator: torch.Generator) -> None:
    cost, x = a_cost(generator)
    items = torch.tensor([1, 0, 1])
    torch.testing.assert_close(cost.take(items).value(x[items]), cost.value(x)[items])


def test_single_precision_and_another_base() -> None:
    body = the_body().with_base(
        torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.2, -2.9], dtype=torch.float64)
    )
    before, after, view = scene()
    there, goal = before.clone(), after.clone()
    there[:, 2] -= 0.1
    goal[:, 2] -= 0.1
    carrier = SurfaceMotion(load_body("body34", dtype=torch.float32))
    single = load_body("body34", dtype=torch.float32).with_base(
        body.base_rotation.float(), body.base_translation.float()
    )
    camera = Camera(the_camera().K, (WIDTH, HEIGHT), R_camera_world=np.diag([1.0, -1.0, -1.0])).to(
        torch.float32
    )
    fields = (SplineField(field.coefficients.float()) for field in (view.before, view.now) if field)
    x = there.float()
    found = carrier(
        single,
        [PicturePair(camera, *fields)],
        before=x,
        velocity=torch.zeros_like(x),
        expected=x,
        deviation=single.motion_rate * INTERVAL,
    )
    assert found.dtype == torch.float32
    assert abs(float(turn_between(found.double(), goal))) < 2.5


def test_only_a_body_with_a_root_has_a_trunk() -> None:
    arm = load_body("arm8")
    columns, parts = trunk_of(arm)
    assert len(columns) == 0
    assert not parts.any()
    carrier, x = SurfaceMotion(arm), arm.rest[None]
    assert not carrier.knows
    _, _, view = scene()
    found = carrier(
        arm, [view], before=x, velocity=x, expected=x, deviation=arm.motion_rate * INTERVAL
    )
    assert found is x
    columns, parts = trunk_of(the_body())
    names = [the_body().state_names[i] for i in columns]
    assert {"root_x", "root_yaw", "lumbar_flexion", "lumbar_twist"} <= set(names)
    assert not any(name.startswith(("l_", "r_", "neck")) for name in names)
    carrying = {name for name, held in zip(the_body().part_names, parts, strict=True) if held}
    assert carrying == {"pelvis", "chest"}
    # Lengths move parts as well, but not in time.
    free = load_body("body34", free_proportions=True)
    columns, parts = trunk_of(free)
    assert [free.state_names[i] for i in columns] == names
    assert {name for name, held in zip(free.part_names, parts, strict=True) if held} == carrying


def test_dynamics_of_the_surface_spread_as_the_others() -> None:
    mixture = GaussianMixture(poses(2), torch.eye(34).double().expand(2, 34, 34), torch.zeros(2))
    velocity = 0.01 * torch.ones(2, 34).double()
    for inner in (Diffusion(deviation=0.2), ConstantVelocity(deviation=0.2, persistence=0.8)):
        blind = SurfaceDynamics(
            dynamics=inner,
            motion=SurfaceMotion(the_body()),
            body=the_body(),
            pairs=(),
            deviation=None,
        )
        for part, same in zip(
            blind.predict(mixture, velocity), inner.predict(mixture, velocity), strict=True
        ):
            assert torch.equal(part, same)


def test_the_plan_of_a_session_says_whether_surfaces_predict(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = []
    monkeypatch.setattr(
        SurfaceMotion, "__call__", lambda *_, expected, **__: asked.append(expected) or expected
    )
    settings = Settings(terms=("contour",), samples=2, modes=1, working_size=160)
    body, x, view = the_body(), poses(), seen_by(the_camera())
    image = (255 * picture(x[0])).byte()[..., None].expand(-1, -1, 3).numpy()
    for planned in (True, False):
        setting = replace(settings, prediction="velocity" if planned else "surface")
        plan = make_plan(setting, body, view, INTERVAL)._replace(surface_prediction=planned)
        asked.clear()
        session = TrackingSession(setting, start_at(body, x), view, plan=plan)
        next(session.track([image]))
        assert len(asked) == planned


def test_the_setting_is_checked() -> None:
    assert Settings(prediction="surface").prediction == "surface"
    with pytest.raises(ConfigurationError, match="one of velocity, surface"):
        Settings(prediction="guess")  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="does not descend from samples"):
        Settings(prediction="surface", preset="ijrr_condensation")


def tracked(prediction: Literal["velocity", "surface"]) -> list[Posterior]:
    """Three frames of a person who turns by eight degrees in each."""
    settings = Settings(
        prediction=prediction,
        keypoints_use="first",
        terms=("contour", "temporal"),
        seed=0,
        samples=4,
        modes=2,
    )
    body, x = the_body(), poses()
    images = [picture(turned(x, 8.0 * t)[0]) for t in range(3)]
    frames = [
        Frame(t, t * INTERVAL, (255 * image).round().byte()[..., None].expand(-1, -1, 3).numpy())
        for t, image in enumerate(images)
    ]
    session = session_at(settings, body, x, seen_by(the_camera()), variance=1e-4)
    return list(session.track(frames))


def test_a_tracker_turns_with_the_body() -> None:
    first, again, lagging = tracked("surface"), tracked("surface"), tracked("velocity")
    for one, other in zip(first, again, strict=True):
        assert torch.equal(one.state.mixture.mean, other.state.mixture.mean)
    goal = turned(poses(), 16.0)

    def behind(frames: list[Posterior]) -> float:
        return abs(float(turn_between(frames[-1].state.mixture.mean[:1], goal)))

    assert behind(first) < 5
    assert behind(lagging) > behind(first)

"""The camera: derivatives against autograd, OpenCV's projection, inverse, validity, errors."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from reference.autograd import differentiated
from reference.camera import jacobian_of, skew_camera
from torch import Tensor

from torchcss.errors import CameraError, ShapeError
from torchcss.vision.camera import Camera, ProjectionModel

MILD = [-0.33, 0.046, -0.0043, 0.0041, 0.067]
WILD = [-0.014, 1.419, -0.0035, -0.0036, -6.394]
"""A real calibration whose sixth-order term folds the image at a normalised radius of 0.6."""


def make_camera(distortion: list[float] | None = None) -> Camera:
    focal, centre, size = (900.0, 880.0), (317.0, 243.0), (640, 480)
    return skew_camera(focal, centre, size, distortion=distortion)


def hessian_of(camera: Camera, model: ProjectionModel) -> Tensor:
    """Second derivatives of u and v, `[*batch p 2 3 3]`: u and v pulled back as costs."""
    zero = torch.zeros_like(model.a)
    curvature = torch.zeros(*model.uv.shape, 2).to(model.uv)
    pulled = [
        camera.pull_back(model, zero, unit.expand_as(model.uv), curvature).hessian
        for unit in torch.eye(2).to(model.uv)
    ]
    return torch.stack(pulled, dim=-3)


def points_in_camera_frame(camera: Camera, points: list[list[float]] | Tensor) -> Tensor:
    """World points with the given coordinates in the camera's frame."""
    points = torch.as_tensor(points, dtype=torch.float64)
    return (points - camera.t_camera_world) @ camera.R_camera_world


AWKWARD = [
    [0.0, 0.0, 2.0],  # on the optical axis
    [0.0, 0.0, 0.06],  # just beyond the near plane
    [0.0, 0.0, 0.04],  # nearer than the near plane
    [0.0, 0.0, 0.0],  # in the camera
    [0.3, 0.2, -1.0],  # behind
    [0.9, -1.0, 1.0],  # out of the image
    [40.0, 3.0, 1.0],  # far out
    [1e30, -1e30, 1.0],
    [1e30, 1e30, 1e30],
]


@pytest.mark.parametrize("distortion", [None, MILD, WILD])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_derivatives_agree_with_autograd(
    distortion: list[float] | None, batch: tuple[int, ...], generator: torch.Generator
) -> None:
    camera = make_camera(distortion)
    points = torch.randn(*batch, 4, 3, dtype=torch.float64, generator=generator)
    model = camera.project_with_derivatives(points)
    assert model.uv.shape == (*batch, 4, 2)
    jacobians, hessians = jacobian_of(camera, model), hessian_of(camera, model)
    assert hessians.shape == (*batch, 4, 2, 3, 3)

    def total(flat_point: Tensor) -> Tensor:
        return camera.project(flat_point[None]).uv[0]

    for index in np.ndindex(*batch, 4):
        jacobian = torch.autograd.functional.jacobian(total, points[index])
        torch.testing.assert_close(jacobians[index], jacobian, rtol=1e-11, atol=1e-9)
        for k in range(2):
            hessian = torch.autograd.functional.hessian(
                lambda point, k=k: total(point)[k], points[index]
            )
            torch.testing.assert_close(hessians[index][k], hessian, rtol=1e-10, atol=1e-8)


@pytest.mark.parametrize("distortion", [None, MILD, WILD])
def test_awkward_points_stay_finite_and_agree_with_autograd(
    distortion: list[float] | None,
) -> None:
    camera = make_camera(distortion)
    points = points_in_camera_frame(camera, AWKWARD)
    points.requires_grad_()
    projection = camera.project(points)
    model = camera.project_with_derivatives(points.detach())
    assert torch.equal(projection.valid, model.valid)
    assert model.valid[:5].tolist() == [True, True, False, False, False]
    jacobian, hessian = jacobian_of(camera, model), hessian_of(camera, model)
    for tensor in (*model, jacobian, hessian):
        assert torch.isfinite(tensor).all()
    outside = ~model.valid
    assert (jacobian[outside] == 0.0).all()
    assert (hessian[outside] == 0.0).all()
    assert not camera.inside_image(model.uv[outside]).any()
    torch.testing.assert_close(model.uv, projection.uv.detach(), rtol=0.0, atol=0.0)
    for k in range(2):
        _, gradient, curvature = differentiated(projection.uv[:, k], points)
        torch.testing.assert_close(jacobian[:, k], gradient, rtol=1e-10, atol=1e-9)
        torch.testing.assert_close(hessian[:, k], curvature, rtol=1e-9, atol=1e-7)


def test_awkward_points_stay_finite_in_float32() -> None:
    for distortion in (None, MILD, WILD):
        camera = make_camera(distortion)
        points = points_in_camera_frame(camera, AWKWARD).float()
        model = camera.project_with_derivatives(points)
        for tensor in (*model, jacobian_of(camera, model), hessian_of(camera, model)):
            assert torch.isfinite(tensor).all()


def test_float32_agrees_with_float64(generator: torch.Generator) -> None:
    camera = make_camera(MILD)
    points = torch.randn(200, 3, dtype=torch.float64, generator=generator) * 0.5
    single, double = (
        camera.project_with_derivatives(points.float()),
        camera.project_with_derivatives(points),
    )
    assert single.uv.dtype == torch.float32
    assert torch.equal(single.valid, double.valid)
    for one, two in (
        (single.uv, double.uv),
        (single.depth, double.depth),
        (jacobian_of(camera, single), jacobian_of(camera, double)),
        (hessian_of(camera, single), hessian_of(camera, double)),
    ):
        torch.testing.assert_close(one.double(), two, rtol=1e-4, atol=1e-4 * float(two.abs().max()))
    converted = make_camera(MILD).to(torch.float32)
    assert converted.K.dtype == torch.float32
    torch.testing.assert_close(converted.project(points.float()).uv, single.uv)


@pytest.mark.parametrize("gauss_newton", [False, True])
def test_pull_back_is_the_chain_rule(gauss_newton: bool, generator: torch.Generator) -> None:
    camera = make_camera(MILD)
    points = torch.randn(6, 3, dtype=torch.float64, generator=generator) * 0.5
    target = torch.tensor([300.0, 250.0], dtype=torch.float64)

    def cost(uv: Tensor) -> Tensor:
        residual = (uv - target) / 50.0
        return torch.log1p(residual.square().sum(-1) + 0.3 * residual[..., 0] * residual[..., 1])

    model = camera.project_with_derivatives(points)
    g = torch.stack([torch.autograd.functional.jacobian(cost, uv) for uv in model.uv])
    H = torch.stack([torch.autograd.functional.hessian(cost, uv) for uv in model.uv])
    result = camera.pull_back(model, cost(model.uv), g, H, gauss_newton=gauss_newton)
    assert torch.equal(result.value, cost(model.uv))
    for index in range(6):

        def of_point(point: Tensor, index: int = index) -> Tensor:
            uv = camera.project(point[None]).uv[0]
            if gauss_newton:  # linearise the projection
                linear = jacobian_of(camera, model)[index] @ (point - points[index])
                uv = model.uv[index] + linear
            return cost(uv)

        gradient = torch.autograd.functional.jacobian(of_point, points[index])
        hessian = torch.autograd.functional.hessian(of_point, points[index])
        torch.testing.assert_close(result.gradient[index], gradient, rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(result.hessian[index], hessian, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("distortion", [None, MILD, WILD])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_image_normals_are_a_least_squares_solution(
    distortion: list[float] | None, batch: tuple[int, ...], generator: torch.Generator
) -> None:
    camera = make_camera(distortion)
    points = 0.4 * torch.randn(*batch, 6, 3, dtype=torch.float64, generator=generator)
    normals = torch.randn(points.shape, dtype=torch.float64, generator=generator)
    model = camera.project_with_derivatives(points)
    assert model.valid.any()
    solution = torch.linalg.lstsq(jacobian_of(camera, model).mT, normals[..., None]).solution[
        ..., 0
    ]
    expected = solution / solution.norm(dim=-1, keepdim=True)
    got = camera.image_normals(model, normals)
    assert got.shape == model.uv.shape
    torch.testing.assert_close(got[model.valid], expected[model.valid], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_image_normals_have_unit_length_everywhere(dtype: torch.dtype) -> None:
    """Along u where there is none: a normal along the line of sight, or zero."""
    for distortion in (None, MILD, WILD):
        camera = make_camera(distortion)
        points = points_in_camera_frame(camera, AWKWARD).to(dtype)
        model = camera.project_with_derivatives(points)
        for normals in (torch.ones_like(points), torch.zeros_like(points)):
            got = camera.image_normals(model, normals)
            torch.testing.assert_close(got.norm(dim=-1), torch.ones_like(model.depth))
        assert (got == got.new_tensor([1.0, 0.0])).all()


@pytest.mark.parametrize("distortion", [None, MILD, WILD])
def test_projection_agrees_with_opencv(
    distortion: list[float] | None, generator: torch.Generator
) -> None:
    cv2 = pytest.importorskip("cv2")
    camera = make_camera(distortion)
    points = torch.randn(300, 3, dtype=torch.float64, generator=generator) * 0.6
    projection = camera.project(points)
    assert projection.valid.sum() > 200
    rotation_vector, _ = cv2.Rodrigues(camera.R_camera_world.numpy())
    expected, _ = cv2.projectPoints(
        points.numpy(),
        rotation_vector,
        camera.t_camera_world.numpy(),
        camera.K.numpy(),
        camera.distortion.numpy(),
    )
    valid = projection.valid.numpy()
    np.testing.assert_allclose(projection.uv.numpy()[valid], expected[valid, 0], atol=1e-8)
    assert (projection.uv.numpy()[~valid] < 0.0).all()


def test_maximum_radius_is_where_the_distortion_stops_growing() -> None:
    assert make_camera(None).maximum_radius.isinf()
    assert make_camera([0.5, 0.0, 0.0, 0.0, 0.0]).maximum_radius.isinf()
    torch.testing.assert_close(
        make_camera([-0.3, 0.0, 0.0, 0.0, 0.0]).maximum_radius.item(), math.sqrt(1.0 / 0.9)
    )
    assert 0 < make_camera([0.0, -3.6e307, 0.0, 0.0, 1e308]).maximum_radius < 1e-40
    k1, k2, _, _, k3 = WILD
    r = np.linspace(0.0, 2.0, 200001)
    distorted = r * (1.0 + k1 * r**2 + k2 * r**4 + k3 * r**6)
    first_fall = r[np.argmax(np.diff(distorted) < 0.0)]
    assert abs(float(make_camera(WILD).maximum_radius) - first_fall) < 2e-5
    camera = make_camera(WILD)
    points = points_in_camera_frame(camera, [[0.55, 0.0, 1.0], [0.65, 0.0, 1.0], [1.0, 0.0, 2.0]])
    assert camera.project(points).valid.tolist() == [True, False, True]


@pytest.mark.parametrize(
    "distortion", [[0.0, 0.0, 0.0, 0.0, 0.05], [1e-3, 0.2, 0.0, 0.0, 0.0], [500.0, 0.0, 0.0, 0.0]]
)
def test_squares_of_pixels_are_finite_in_single_precision(distortion: list[float]) -> None:
    """Points next to the image plane, which a growing distortion throws away farthest."""
    camera = make_camera(distortion)
    assert camera.maximum_radius > 50  # 1.1 degrees from the image plane
    radius = torch.logspace(0, 5, 200)
    ahead = torch.stack([radius, torch.zeros_like(radius), torch.ones_like(radius)], -1)
    uv, _, valid = camera.project(points_in_camera_frame(camera, ahead).float())
    assert uv[valid].square().sum(-1).isfinite().all()
    assert valid.sum() > 60


@pytest.mark.parametrize(
    "distortion", [None, MILD, WILD, [0.5, 0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.01, 0.0, 0.0]]
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_undistortion_inverts_the_projection(
    distortion: list[float] | None, dtype: torch.dtype, generator: torch.Generator
) -> None:
    camera = make_camera(distortion)
    limit = min(float(camera.maximum_radius), 3.2)  # kornia's fixed point diverges long before 3
    angle = torch.rand(2, 300, generator=generator, dtype=torch.float64) * 2.0 * math.pi
    radius = torch.rand(2, 300, generator=generator, dtype=torch.float64) * 0.93 * limit
    depth = 0.5 + 3.0 * torch.rand(2, 300, generator=generator, dtype=torch.float64)
    directions = [radius * angle.cos(), radius * angle.sin(), torch.ones_like(radius)]
    points = points_in_camera_frame(camera, depth[..., None] * torch.stack(directions, -1)).to(
        dtype
    )
    uv, projected_depth, valid = camera.project(points)
    assert valid.all()
    normalised, reached = camera.undistort(uv)
    assert reached.all()
    tolerance = 1e-9 if dtype == torch.float64 else 2e-3
    torch.testing.assert_close(
        normalised, torch.stack(directions[:2], -1).to(dtype), rtol=0.0, atol=tolerance
    )
    torch.testing.assert_close(
        camera.unproject(uv, projected_depth), points, rtol=0.0, atol=10.0 * tolerance
    )
    rays = camera.rays(uv)
    torch.testing.assert_close(rays.norm(dim=-1), torch.ones_like(rays[..., 0]))
    offset = points - camera.centre_world.to(dtype)
    torch.testing.assert_close(
        rays, offset / offset.norm(dim=-1, keepdim=True), rtol=0.0, atol=tolerance
    )


def test_pixels_that_the_distortion_does_not_reach_are_told() -> None:
    camera = make_camera(WILD)
    uv = torch.tensor([[320.0, 240.0], [5000.0, 240.0], [1e30, -1e30]], dtype=torch.float64)
    normalised, reached = camera.undistort(uv)
    assert reached.tolist() == [True, False, False]
    assert torch.isfinite(normalised).all()
    assert (normalised.norm(dim=-1) <= camera.maximum_radius + 1e-9).all()
    assert torch.isfinite(camera.rays(uv)).all()


def test_real_calibrations(shared_data) -> None:
    """The calibrated images are reachable nearly everywhere, and what is reached comes back."""
    for folder in ("arm_pointing", "walk_sit_mono", "balance_beam_4cam", "handheld_board"):
        cameras = json.loads((shared_data / folder / "cameras.json").read_text())["cameras"]
        for name, entry in cameras.items():
            camera = Camera(
                entry["K"],
                entry["image_size_wh"],
                distortion=entry["distortion"],
                R_camera_world=entry["R"],
                t_camera_world=entry["t"],
                name=name,
            )
            if "centre_world" in entry:
                expected = torch.tensor(entry["centre_world"], dtype=torch.float64)
                torch.testing.assert_close(camera.centre_world, expected, rtol=1e-6, atol=1e-6)
            width, height = camera.image_size_wh
            u = torch.linspace(0, width - 1, 21, dtype=torch.float64)
            v = torch.linspace(0, height - 1, 21, dtype=torch.float64)
            uv = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)
            _, reached = camera.undistort(uv)
            assert reached.double().mean() > 0.98, (folder, name)
            points = camera.unproject(uv, torch.full(uv.shape[:-1], 2.0, dtype=torch.float64))
            back = camera.project(points)
            inner = reached & back.valid
            assert inner.double().mean() > 0.98
            torch.testing.assert_close(back.uv[inner], uv[inner], rtol=0.0, atol=1e-2)


def test_resized_camera_follows_the_image(generator: torch.Generator) -> None:
    camera = make_camera(MILD)
    points = torch.randn(50, 3, dtype=torch.float64, generator=generator) * 0.3
    uv = camera.project(points).uv
    half = camera.scaled(0.5)
    assert half.image_size_wh == (320, 240)
    torch.testing.assert_close(half.project(points).uv, 0.5 * (uv + 0.5) - 0.5)
    odd = camera.resized(101, 33)
    scale = torch.tensor([101 / 640, 33 / 480], dtype=torch.float64)
    torch.testing.assert_close(odd.project(points).uv, scale * (uv + 0.5) - 0.5)
    torch.testing.assert_close(odd.resized(640, 480).K, camera.K)
    assert odd.name == camera.name
    assert odd.near == camera.near
    assert camera.float().scaled(2.0).K.dtype == torch.float32


def test_resized_camera_matches_a_resized_picture() -> None:
    """The centroid of a blob moves as the camera says."""
    image = torch.zeros(1, 1, 96, 128)
    image[..., 20:28, 40:52] = 1.0  # centroid (45.5, 23.5)
    small = torch.nn.functional.interpolate(image, size=(24, 32), mode="bilinear", antialias=True)
    rows, columns = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
    total = small.sum()
    centroid = torch.stack([(small[0, 0] * columns).sum(), (small[0, 0] * rows).sum()]) / total
    camera = Camera.pinhole(128, 96, focal_px=100.0)
    ray_point = camera.unproject(torch.tensor([45.5, 23.5]), torch.tensor(2.0))
    torch.testing.assert_close(
        camera.resized(32, 24).project(ray_point[None]).uv[0], centroid, rtol=0.0, atol=1e-3
    )


def test_cropped_camera_follows_the_image(generator: torch.Generator) -> None:
    camera = make_camera(MILD)
    points = torch.randn(50, 3, dtype=torch.float64, generator=generator) * 0.3
    part = camera.cropped(30, -20, 50, 60)
    assert camera.K[0, 2] - part.K[0, 2] == 30, "the whole image's camera stays"
    assert torch.equal(part.R_camera_world, camera.R_camera_world)
    assert set(part.state_dict()) == set(camera.state_dict())
    assert part.image_size_wh == (50, 60)
    away = torch.tensor([30.0, -20.0], dtype=torch.float64)
    torch.testing.assert_close(part.project(points).uv, camera.project(points).uv - away)
    assert part.name == camera.name
    with pytest.raises(CameraError):
        camera.cropped(0, 0, 0, 5)


def test_own_frame_camera(generator: torch.Generator) -> None:
    camera = make_camera(MILD)
    own = camera.in_own_frame()
    points = torch.randn(50, 3, dtype=torch.float64, generator=generator)
    torch.testing.assert_close(
        own.project(camera.to_camera_frame(points)).uv, camera.project(points).uv
    )
    assert torch.equal(own.centre_world, torch.zeros(3, dtype=torch.float64))


def test_pinhole_from_a_field_of_view() -> None:
    camera = Camera.pinhole(640, 480, field_of_view_degrees=90.0)
    assert camera.K[0, 0] == pytest.approx(320.0)
    projection = camera.project(torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 1.0]]))
    torch.testing.assert_close(projection.uv, torch.tensor([[319.5, 239.5], [-0.5, 239.5]]))
    assert Camera.pinhole(1, 1, focal_px=2.0).image_size_wh == (1, 1)
    for arguments in ({}, {"focal_px": 1.0, "field_of_view_degrees": 50.0}):
        with pytest.raises(CameraError, match="either"):
            Camera.pinhole(64, 48, **arguments)
    with pytest.raises(CameraError, match="between 0 and 180"):
        Camera.pinhole(64, 48, field_of_view_degrees=180.0)
    with pytest.raises(CameraError, match="positive"):
        Camera.pinhole(64, 48, focal_px=-3.0)


def test_inside_image_counts_whole_pixels() -> None:
    camera = Camera.pinhole(4, 3, focal_px=1.0)
    uv = torch.tensor([[-0.5, -0.5], [3.49, 2.49], [3.5, 0.0], [0.0, 2.5], [-0.51, 0.0]])
    assert camera.inside_image(uv).tolist() == [True, True, False, False, False]


def test_state_survives_saving_and_nearly_orthonormal_rotations_are_mended() -> None:
    camera, other = make_camera(WILD), make_camera(None)
    other.load_state_dict(camera.state_dict())
    assert torch.equal(other.maximum_radius, camera.maximum_radius)
    points = torch.tensor([[0.3, -0.2, 4.0], [-0.5, 0.4, 5.0]], dtype=torch.float64)
    assert torch.equal(other.project(points).uv, camera.project(points).uv)
    rounded = torch.tensor(np.round(camera.R_camera_world.numpy(), 5))
    mended = Camera(camera.K, (640, 480), R_camera_world=rounded).R_camera_world
    torch.testing.assert_close(mended @ mended.mT, torch.eye(3, dtype=torch.float64))
    assert "640 x 480" in repr(camera)


def test_values_of_any_type_are_taken() -> None:
    values = torch.diag(torch.tensor([8.0, 8.0, 1.0]))
    for dtype in (torch.bfloat16, torch.float16, torch.int64):
        assert torch.equal(Camera(values.to(dtype), (4, 3)).K, values.double())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": [[1.0, 0.0], [0.0, 1.0]]}, r"shape \[3, 3\]"),
        ({"K": [[-900.0, 0, 1], [0, 900.0, 1], [0, 0, 1]]}, "positive"),
        ({"K": [[900.0, 5.0, 1], [0, 900.0, 1], [0, 0, 1]]}, "no skew.*write 0"),
        ({"K": [[900.0, 0, math.nan], [0, 900.0, 1], [0, 0, 1]]}, "finite"),
        ({"K": "calibration"}, "numbers"),
        ({"image_size_wh": (0, 480)}, "image_size_wh"),
        ({"image_size_wh": (640.5, 480)}, "image_size_wh"),
        ({"distortion": [0.0] * 8}, "distortion"),
        ({"distortion": [math.inf, 0, 0, 0, 0]}, "finite"),
        ({"R_camera_world": 2.0 * np.eye(3)}, "rotation"),
        ({"R_camera_world": np.diag([1.0, 1.0, -1.0])}, "determinant"),
        ({"t_camera_world": [0.0, 1.0]}, r"shape \[3\]"),
        ({"near": 0.0}, "near"),
    ],
)
def test_bad_values_are_refused(change: dict, message: str) -> None:
    arguments = {"K": np.diag([900.0, 900.0, 1.0]), "image_size_wh": (640, 480), "name": "left"}
    with pytest.raises(CameraError, match=message) as caught:
        Camera(**(arguments | change))
    assert str(caught.value).startswith("left: ")
    assert "\n" not in str(caught.value)


def test_bad_points_are_refused() -> None:
    camera = make_camera()
    with pytest.raises(ShapeError, match="points_world"):
        camera.project(torch.zeros(4, 2))
    with pytest.raises(ShapeError, match="uv"):
        camera.rays(torch.zeros(4, 3))
    # A translation in whole metres would be the wrong one.
    for dtype in (torch.int64, torch.float16):
        with pytest.raises(ShapeError, match="points_world: expected float32 or float64"):
            camera.project(torch.ones(4, 3, dtype=dtype))
        with pytest.raises(ShapeError, match="uv: expected float32 or float64"):
            camera.rays(torch.ones(4, 2, dtype=dtype))
    with pytest.raises(CameraError, match="scale factor"):
        camera.scaled(0.0)


@pytest.mark.parametrize(
    ("rotation", "up"),
    [
        pytest.param([[1, 0, 0], [0, 0, -1], [0, 1, 0]], (0, 0, 1), id="level, z up"),
        pytest.param([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]], (0, -1, 0), id="y down"),
        pytest.param([[1, 0, 0], [0, -0.8, 0.6], [0, -0.6, -0.8]], (0, 1, 0), id="y up"),
        pytest.param([[1, 0, 0], [0, 0.7, -0.7141428], [0, 0.7141428, 0.7]], None, id="neither"),
    ],
)  # fmt: skip
def test_up_is_the_axis_of_the_world_nearest_to_the_pictures(
    rotation: list[list[float]], up: tuple[float, ...] | None
) -> None:
    placed = Camera(np.eye(3), (4, 3), R_camera_world=np.array(rotation))
    assert (placed.up and placed.up.direction) == up
    assert placed.up is None or placed.up.deviation == 0


def test_a_camera_without_a_world_is_about_level() -> None:
    own = make_camera().in_own_frame().up
    assert own is not None
    assert own.direction == (0, -1, 0)
    assert own.deviation > 0

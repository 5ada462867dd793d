"""Perspective camera with lens distortion, and its exact first and second derivatives.

The map `P` of section 2 [IJRR], from a point of the world to a pixel:

    x_cam  = R_camera_world x_world + t_camera_world      OpenCV axes: x right, y down, z forward
    (a, b) = (x_cam, y_cam) / z_cam                       normalised coordinates
    r2     = a^2 + b^2
    q      = 1 + k1 r2 + k2 r2^2 + k3 r2^3
    a'     = a q + 2 p1 a b + p2 (r2 + 2 a^2)             Brown's lens distortion in OpenCV's
    b'     = b q + p1 (r2 + 2 b^2) + 2 p2 a b             order [k1, k2, p1, p2, k3]
    (u, v) = (fx a' + cx, fy b' + cy)                     pixel (0, 0) is a pixel's centre

A term of the cost is a scalar function of the image point. `pull_back` carries its gradient g and
Hessian H to the 3D point through the two maps in turn. The lens first: the distortion is the
gradient of a scalar function of (a, b), so its first derivatives D are symmetric and its second
derivatives have only four distinct entries. With F = diag(fx, fy) and e = F g,

    gradient f' = D e
    hessian  f'' = D F H F D + e_a d2a' + e_b d2b'        (Gauss-Newton keeps the first part only)

Then the division: in the camera's frame da = (1, 0, -a) / z and db = (0, 1, -b) / z, so that

    gradient = (f_a, f_b, -a f_a - b f_b) / z
    hessian  = [f'' and the third row and column that follow from it and from f'] / z^2

A few multiplications per point, and one rotation to the world's axes. The Jacobian of (u, v) and
the Hessians of u and v are never formed. Without distortion D is the identity, d2a' and d2b' are
zero, and none of them is computed.

A point is *valid* where the model means anything: farther than the near plane, and within the
radius up to which the distortion polynomial grows. High-order terms of real calibrations fold the
image back on itself outside the region that was calibrated. An invalid point gets a fixed place
outside the image and zero derivatives, so that every number stays finite and a term can give it a
constant cost.

By default: `Camera(K, image_size_wh, ...)` from a calibration, `Camera.pinhole(...)` from a guess;
`project` where the point is enough, `project_with_derivatives` and `pull_back` inside a term.

A new camera holds its numbers in float64 on the CPU; it computes in its argument's dtype and on
its argument's device.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchcss.errors import CameraError, check_floating, check_shape
from torchcss.types import PointCost
from torchcss.vision.sampling import inside_image

ImagePoints = Float[Tensor, "*batch p 2"]
"""Image points, and"""
Points = Float[Tensor, "*batch p 3"]
"""those in space."""

NumbersLike = Tensor | np.ndarray | Sequence[Any]
Values = Float[Tensor, "*batch p"]
Pixels = Float[Tensor, "*batch 2"]
Matrix = Float[Tensor, "3 3"]
Vectors = Float[Tensor, "*batch 3"]

_LEAST_UPRIGHT = math.cos(math.radians(40))
"""How near an axis of the world must be to the picture's up to be that of the world."""

_LEVEL = 0.2
"""Radians by which cameras are off level, on each axis."""

GRAZING_RADIUS = 1.0e4
"""Normalised radius (0.006 degrees from the image plane) beyond which powers overflow float32."""

_LARGEST_TERM = 1.0e14
"""Largest term of the distortion: beyond it squares of pixels overflow float32."""

_ORTHONORMALITY_TOLERANCE = 1.0e-4
"""Largest eigenvalue of `R R^T - I` that is taken for rounding in a calibration file."""

_UNDISTORTION_STEPS = 50
"""Most Newton steps of the undistortion; a handful is enough away from the radius limit."""


class Projection(NamedTuple):
    """Image points.

    Attributes:
        uv: Pixel coordinates; outside the image where `valid` is False.
        depth: Distance along the optical axis in metres; negative behind the camera.
        valid: False where the camera cannot see the direction, whatever the size of its image.
    """

    uv: ImagePoints
    depth: Values
    valid: Bool[Tensor, "*batch p"]


class ProjectionModel(NamedTuple):
    """Image points with what `Camera.pull_back` needs to differentiate them.

    Attributes:
        uv: Pixel coordinates; outside the image where `valid` is False.
        depth: Distance along the optical axis in metres; negative behind the camera.
        valid: False where the camera cannot see the direction, whatever the size of its image.
        a: Normalised coordinate x / z; zero where `valid` is False.
        b: Normalised coordinate y / z; zero where `valid` is False.
        inverse_depth: 1 / z, per metre; zero where `valid` is False.
        lens_aa: First derivative of the distorted a in a.
        lens_ab: First derivative of the distorted a in b, and of the distorted b in a.
        lens_bb: First derivative of the distorted b in b.
    """

    uv: ImagePoints
    depth: Values
    valid: Bool[Tensor, "*batch p"]
    a: Values
    b: Values
    inverse_depth: Values
    lens_aa: Values
    lens_ab: Values
    lens_bb: Values


class Upright(NamedTuple):
    """Which way is up, away from the ground.

    Attributes:
        direction: A unit vector of the world.
        deviation: How far off it may be, radians.
    """

    direction: tuple[float, float, float]
    deviation: float


class Camera(nn.Module):
    """A calibrated camera.

    Args:
        K: Intrinsics `[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]` in pixels.
        image_size_wh: Width and height of the image that `K` belongs to.
        distortion: `k1, k2, p1, p2, k3` in OpenCV's order, or the first four. None: no distortion.
        R_camera_world: Rotation from world to camera axes. None: identity.
        t_camera_world: The world's origin in the camera's frame, metres. None: zero.
        name: How messages and files call the camera.
        near: Points nearer than this depth (metres) are invalid.

    Attributes:
        has_distortion: Whether any coefficient of the distortion differs from zero.
        maximum_radius: Distance from the axis at unit depth up to which the distortion can be
            undone, and squares of pixels are finite in float32; points farther out are invalid.

    Raises:
        CameraError: If a value is not finite, `K` is not of the form above, the rotation is not
            one, or the image is empty.
    """

    K: Matrix
    distortion: Float[Tensor, " 5"]
    R_camera_world: Matrix
    t_camera_world: Float[Tensor, " 3"]
    maximum_radius: Float[Tensor, ""]

    def __init__(
        self,
        K: NumbersLike,
        image_size_wh: Sequence[int],
        *,
        distortion: NumbersLike | None = None,
        R_camera_world: NumbersLike | None = None,
        t_camera_world: NumbersLike | None = None,
        name: str = "camera",
        near: float = 0.05,
    ) -> None:
        super().__init__()
        width, height = _checked_image_size(name, image_size_wh)
        if not (math.isfinite(near) and near > 0.0):
            raise CameraError(f"{name}: near must be a positive number of metres, got {near}")
        coefficients = _finite_tensor(
            name, "distortion", [0.0] * 5 if distortion is None else distortion
        )
        if coefficients.ndim == 1 and coefficients.numel() == 4:
            coefficients = torch.cat([coefficients, coefficients.new_zeros(1)])
        if coefficients.shape != (5,):
            raise CameraError(
                f"{name}: distortion must be k1, k2, p1, p2 and optionally k3, got shape "
                f"{list(coefficients.shape)}; for another lens model undistort the video first"
            )
        rotation = _finite_tensor(
            name, "R_camera_world", np.eye(3) if R_camera_world is None else R_camera_world, 3, 3
        )
        translation = _finite_tensor(
            name, "t_camera_world", [0.0] * 3 if t_camera_world is None else t_camera_world, 3
        )
        self.image_size_wh: tuple[int, int] = (width, height)
        self.name: str = name
        self.near: float = float(near)
        self.has_distortion: bool = bool((coefficients != 0).any())
        self.register_buffer("K", _checked_intrinsics(name, K))
        self.register_buffer("distortion", coefficients)
        self.register_buffer("R_camera_world", _nearest_rotation(name, rotation))
        self.register_buffer("t_camera_world", translation)
        self.register_buffer("maximum_radius", _monotonic_radius(coefficients))
        self.register_load_state_dict_post_hook(_see_distortion)

    @classmethod
    def pinhole(
        cls,
        width: int,
        height: int,
        *,
        focal_px: float | None = None,
        field_of_view_degrees: float | None = None,
        name: str = "pinhole",
    ) -> Self:
        """Make a camera without distortion that looks through the middle of the image.

        Args:
            width: Width of the image in pixels.
            height: Height of the image in pixels.
            focal_px: Focal length in pixels; this or the next, not both.
            field_of_view_degrees: Angle between the left and the right border of the image.
            name: How messages and files call the camera.

        Raises:
            CameraError: If not exactly one of the focal length and the field of view is given, or
                it is out of range.
        """
        if (focal_px is None) == (field_of_view_degrees is None):
            raise CameraError(f"{name}: give either focal_px or field_of_view_degrees")
        if field_of_view_degrees is not None:
            if not 0.0 < field_of_view_degrees < 180.0:
                raise CameraError(
                    f"{name}: field_of_view_degrees must lie between 0 and 180, "
                    f"got {field_of_view_degrees}"
                )
            focal_px = 0.5 * width / math.tan(math.radians(0.5 * field_of_view_degrees))
        K = [
            [focal_px, 0.0, 0.5 * (width - 1)],
            [0.0, focal_px, 0.5 * (height - 1)],
            [0.0, 0.0, 1.0],
        ]
        return cls(K, (width, height), name=name)

    def extra_repr(self) -> str:
        """Name, image size and focal lengths, for `repr`."""
        width, height = self.image_size_wh
        focal_u, focal_v = torch.diagonal(self.K)[:2].tolist()
        return f"{self.name}, {width} x {height}, focal {focal_u:.1f} {focal_v:.1f} px"

    @property
    def centre_world(self) -> Float[Tensor, " 3"]:
        """The centre of projection in the world frame, metres."""
        rotation, translation = self.R_camera_world, self.t_camera_world
        if rotation.dim() == 2:
            return -rotation.mT @ translation
        return -(rotation * translation[:, None]).sum(0).movedim(0, -1)

    # Several cameras as one.

    @classmethod
    def together(cls, each: Sequence[Camera]) -> Camera:
        """Cameras of one image size, each of as many points: `[S b p 3]` or rows of these.

        The numbers of cameras have the axes of points `[S 1 1]` behind their own.
        """
        cameras = copy(each[0])
        cameras._buffers = {
            name: torch.stack([camera.get_buffer(name) for camera in each], -1)[..., None, None]
            for name in each[0]._buffers
        }
        cameras.has_distortion = any(camera.has_distortion for camera in each)
        return cameras

    def of_rows(self, row: Int[Tensor, " k"], size: int) -> Camera:
        """The camera of some of so many points: itself, but for several cameras."""
        if self.K.dim() == 2:
            return self
        number = row // (size // self.K.shape[2])
        rows = copy(self)
        rows._buffers = {
            name: self.get_buffer(name).flatten(-3).index_select(-1, number)
            for name in self._buffers
        }
        return rows

    # From the world to the image.

    @property
    def up(self) -> Upright | None:
        """Which way is up: the axis of the world that is nearest to the picture's.

        Worlds are measured with one axis along gravity, and cameras are held about level. A camera
        that was never placed in a world is its own: it is taken as level. None if no axis is near.
        """
        picture_up = -self.R_camera_world[1]
        axis = int(picture_up.abs().argmax())
        height = float(picture_up[axis])
        if abs(height) < _LEAST_UPRIGHT:
            return None
        direction = [0.0, 0.0, 0.0]
        direction[axis] = math.copysign(1.0, height)
        own_frame = bool((self.R_camera_world.diagonal() == 1).all())
        return Upright((direction[0], direction[1], direction[2]), _LEVEL if own_frame else 0.0)

    def to_camera_frame(self, points_world: Vectors) -> Vectors:
        """Return the points in the camera's frame, `R x + t`, metres."""
        check_shape("points_world", points_world, 3)
        check_floating("points_world", points_world)
        translation = self.t_camera_world.to(points_world).movedim(0, -1)
        return _turned(self.R_camera_world, points_world) + translation

    def project(self, points_world: Points) -> Projection:
        """Project points; autograd differentiates it as often as needed.

        Args:
            points_world: World frame, metres.

        Raises:
            ShapeError: If the last dimension is not 3, or the points are of no floating type.
        """
        return Projection(*self.project_with_derivatives(points_world)[:3])

    def project_with_derivatives(self, points_world: Points) -> ProjectionModel:
        """Project points, ready for `pull_back` to differentiate with respect to the points.

        Args:
            points_world: World frame, metres.

        Raises:
            ShapeError: If the last dimension is not 3, or the points are of no floating type.
        """
        a, b, inverse_depth, depth, valid = self._normalise(points_world)
        if self.has_distortion:
            at = _Lens.at(a, b, self.distortion)
            distorted, lens = at.distorted(), at.jacobian()
        else:
            one, zero = a.new_ones(()).expand_as(a), a.new_zeros(()).expand_as(a)
            distorted, lens = (a, b), (one, zero, one)
        inverse_depth = torch.where(valid, inverse_depth, 0.0)
        uv = self._to_pixels(*distorted, valid)
        return ProjectionModel(uv, depth, valid, a, b, inverse_depth, *lens)

    def pull_back(
        self,
        model: ProjectionModel,
        value: Values,
        gradient_uv: ImagePoints,
        hessian_uv: Float[Tensor, "*batch p 2 2"],
        *,
        gauss_newton: bool = False,
    ) -> PointCost:
        """Carry a cost of image points with its derivatives to the points that they are images of.

        Args:
            model: The points' projection.
            value: Cost of each point in nats; returned as it is.
            gradient_uv: Derivative of the cost with respect to `uv`, nats per pixel.
            hessian_uv: Second derivative, symmetric, nats per square pixel.
            gauss_newton: Drop the curvature of the projection, as eq. 9 of [RR] does.

        Returns:
            The same cost as a function of the 3D point; its derivatives are zero at invalid points.
        """
        a, b, w = model.a, model.b, model.inverse_depth
        focal_u, focal_v = self._focal(a)
        e_a, e_b = focal_u * gradient_uv[..., 0], focal_v * gradient_uv[..., 1]
        h_aa, h_ab, h_bb = (
            first * second * hessian_uv[..., i, j]
            for i, j, first, second in (
                (0, 0, focal_u, focal_u), (0, 1, focal_u, focal_v), (1, 1, focal_v, focal_v)
            )
        )  # fmt: skip
        # Through the lens: derivatives in a and b.
        if self.has_distortion:
            lens, hessian = (model.lens_aa, model.lens_ab, model.lens_bb), (h_aa, h_ab, h_bb)
            f_a, f_b, f_aa, f_ab, f_bb = _through_lens(e_a, e_b, hessian, lens)
            if not gauss_newton:
                aaa, aab, abb, bbb = _Lens.at(a, b, self.distortion).hessian()
                f_aa = f_aa + e_a * aaa + e_b * aab
                f_ab = f_ab + e_a * aab + e_b * abb
                f_bb = f_bb + e_a * abb + e_b * bbb
        else:
            f_a, f_b, f_aa, f_ab, f_bb = e_a, e_b, h_aa, h_ab, h_bb
        # Through the division: derivatives in the camera's frame.
        x, y, z = a * f_aa + b * f_ab, a * f_ab + b * f_bb, a * f_a + b * f_b
        zz = a * x + b * y
        if not gauss_newton:
            x, y, zz = x + f_a, y + f_b, zz + 2 * z
        # Whole components, one after the other in memory: what the lift reads fastest.
        gradient = torch.stack([w * f_a, w * f_b, -w * z]).movedim(0, -1)
        rows = torch.stack([f_aa, f_ab, f_bb, -x, -y, zz]) * w.square()
        hessian = _combined(_congruence(self.R_camera_world.to(a)), rows)
        return PointCost(
            value,
            _turned(self.R_camera_world.transpose(0, 1), gradient),
            hessian.reshape(3, 3, *a.shape).movedim((0, 1), (-2, -1)),
        )

    def image_normals(self, model: ProjectionModel, normals_world: Points) -> ImagePoints:
        """Unit normals m, in the image, of surfaces that are seen edge on.

        With J the derivative of the image point, `J^T m` is parallel to the surface's normal n: a
        motion along the surface does not move the image across itself. Where n is not quite
        perpendicular to the line of sight this is the solution by least squares,
        `m ~ (J J^T)^-1 J n`, and along u where there is none.

        Args:
            model: The points' projection.
            normals_world: The surfaces' normals at the points.
        """
        a, b = model.a, model.b
        focal_u, focal_v = self._focal(a)
        x, y, z = _turned(self.R_camera_world, normals_world).unbind(-1)
        # J = F D [I, -(a b)^T] R / z. The inverses of J J^T's factors as adjugates, scaled lest
        # products overflow: grazing rays have large coordinates and larger derivatives.
        x, y = x - a * z, y - b * z
        x, y = (1 + b * b) * x - a * b * y, (1 + a * a) * y - a * b * x
        if self.has_distortion:
            aa, ab, bb = model.lens_aa, model.lens_ab, model.lens_bb
            largest = torch.maximum(torch.maximum(aa.abs(), bb.abs()), ab.abs())
            scale = torch.where(largest > 0, largest, 1.0).reciprocal()
            aa, ab, bb = scale * aa, scale * ab, scale * bb
            turn = (aa * bb - ab * ab).sign()
            x, y = turn * (bb * x - ab * y), turn * (aa * y - ab * x)
        x, y = x / focal_u, y / focal_v
        length = torch.hypot(x, y)
        some = length > 0
        safe = torch.where(some, length, 1.0)
        normal = torch.where(some, x / safe, 1.0), torch.where(some, y / safe, 0.0)
        return torch.stack(normal).movedim(0, -1)

    def inside_image(self, uv: Pixels) -> Bool[Tensor, "*batch"]:
        """Tell which image points lie on a pixel; a pixel reaches half its side each way."""
        check_shape("uv", uv, 2)
        width, height = self.image_size_wh
        return inside_image(uv, height, width)

    # From the image to the world.

    def undistort(self, uv: Pixels) -> tuple[Pixels, Bool[Tensor, "*batch"]]:
        """Find the normalised coordinates (a, b) whose image is `uv`.

        Newton's method, the step halved per point until the residual falls; where the distortion
        is monotonic it can be inverted and this converges to rounding.

        Args:
            uv: Pixel coordinates.

        Returns:
            The normalised coordinates, and whether the distortion model reaches the pixel at all;
            where it does not, the coordinates are the nearest found within the monotonic region.

        Raises:
            ShapeError: If the last dimension of `uv` is not 2, or it is of no floating type.
        """
        check_shape("uv", uv, 2)
        check_floating("uv", uv)
        K = self.K.to(uv)
        focal = torch.diagonal(K)[:2]
        target = (uv - K[:2, 2]) / focal
        limit = self.maximum_radius.to(uv).clamp(max=GRAZING_RADIUS)

        def residual_of(point: Tensor) -> tuple[Tensor, Tensor]:
            a, b = point.unbind(-1)
            lens = _Lens.at(a, b, self.distortion)
            residual = torch.stack(lens.distorted(), dim=-1) - target
            return residual, residual.square().sum(dim=-1)

        point = _within_radius(target, 0.9 * limit)
        residual, error = residual_of(point)
        damping = torch.ones_like(error)
        tolerance = (4.0 * torch.finfo(uv.dtype).eps) ** 2 * (1.0 + target.square().sum(dim=-1))
        for _ in range(_UNDISTORTION_STEPS):
            if not (error > tolerance).any():
                break
            a, b = point.unbind(-1)
            d_aa, d_ab, d_bb = _Lens.at(a, b, self.distortion).jacobian()
            determinant = d_aa * d_bb - d_ab * d_ab
            determinant = torch.where(determinant > 0.0, determinant, 1.0)
            e_a, e_b = residual.unbind(-1)
            step = torch.stack([d_bb * e_a - d_ab * e_b, d_aa * e_b - d_ab * e_a], dim=-1)
            step = step / determinant[..., None]
            trial = _within_radius(point - damping[..., None] * step, limit)
            trial_residual, trial_error = residual_of(trial)
            better = trial_error < error
            point = torch.where(better[..., None], trial, point)
            residual = torch.where(better[..., None], trial_residual, residual)
            error = torch.where(better, trial_error, error)
            damping = torch.where(better, (2.0 * damping).clamp(max=1.0), 0.5 * damping)
        # One part in 1e5 of the focal length, far below a calibration's error and above rounding.
        reached = error.sqrt() < 1.0e-5 * (1.0 + torch.linalg.vector_norm(target, dim=-1))
        return point, reached

    def rays(self, uv: Pixels) -> Vectors:
        """Return unit directions, in the world frame, from `centre_world` through image points.

        A pixel that the distortion does not reach (see `undistort`) gets the nearest direction.

        Args:
            uv: Pixel coordinates.

        Raises:
            ShapeError: If the last dimension of `uv` is not 2, or it is of no floating type.
        """
        direction = self._at_unit_depth(uv)
        direction = direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
        return direction @ self.R_camera_world.to(uv)

    def unproject(self, uv: Pixels, depth: Float[Tensor, "*batch"]) -> Vectors:
        """Return the world points at image points and depths along the optical axis (metres).

        Args:
            uv: Pixel coordinates.
            depth: Distance along the optical axis, as `project` returns it.

        Raises:
            ShapeError: If the last dimension of `uv` is not 2, or it is of no floating type.
        """
        point = self._at_unit_depth(uv) * depth[..., None] - self.t_camera_world.to(uv)
        return point @ self.R_camera_world.to(uv)

    def _at_unit_depth(self, uv: Pixels) -> Vectors:
        normalised, _ = self.undistort(uv)
        return torch.cat([normalised, torch.ones_like(normalised[..., :1])], dim=-1)

    def check_size(self, width: int, height: int) -> None:
        """Make sure that an image is of the size that the camera belongs to.

        Raises:
            CameraError: If it is not.
        """
        if (width, height) != self.image_size_wh:
            raise CameraError(
                f"camera {self.name!r} belongs to images of {self.image_size_wh} pixels, this one "
                f"has {(width, height)}; use camera.resized if it was only resized"
            )

    # Cameras made from this one.

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera of the same image resampled to `width` x `height` pixels.

        The corners of the image stay its corners: `c' = s (c + 1/2) - 1/2`, which is how
        `interpolate` with `align_corners=False`, OpenCV and ffmpeg resize.

        Raises:
            CameraError: If the new image is empty.
        """
        width, height = _checked_image_size(self.name, (width, height))
        scale = self.K.new_tensor([width, height]) / self.K.new_tensor(self.image_size_wh)
        K = self.K.clone()
        K[:2, :2] = torch.diag(scale * torch.diagonal(self.K)[:2])
        K[:2, 2] = scale * (self.K[:2, 2] + 0.5) - 0.5
        return self._like(K, (width, height), self.R_camera_world, self.t_camera_world)

    def scaled(self, factor: float) -> Camera:
        """Return the camera of the image scaled by `factor`, its size rounded to whole pixels.

        Raises:
            CameraError: If the factor is not positive.
        """
        if not (math.isfinite(factor) and factor > 0.0):
            raise CameraError(f"{self.name}: the scale factor must be positive, got {factor}")
        width, height = (max(1, round(side * factor)) for side in self.image_size_wh)
        return self.resized(width, height)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """Return the camera of a rectangle of the image, by its first pixel and its size.

        Raises:
            CameraError: If the rectangle is empty.
        """
        size = _checked_image_size(self.name, (width, height))
        K = self.K.clone()
        K[:2, 2] -= K.new_tensor([left, top])
        # All else stays, and has been checked: making a camera takes a millisecond.
        camera = copy(self)
        camera._buffers = {**self._buffers, "K": K}
        camera.image_size_wh = size
        return camera

    def in_own_frame(self) -> Camera:
        """Return the camera at the origin of the world, its axes those of the world."""
        rotation = torch.eye(3, dtype=self.K.dtype, device=self.K.device)
        return self._like(self.K, self.image_size_wh, rotation, self.K.new_zeros(3))

    def in_world_times(self, factor: float) -> Camera:
        """Return the camera in a world whose lengths are so many times as large."""
        place = factor * self.t_camera_world
        return self._like(self.K, self.image_size_wh, self.R_camera_world, place)

    def _like(
        self, K: Tensor, image_size_wh: tuple[int, int], rotation: Tensor, translation: Tensor
    ) -> Camera:
        camera = Camera(
            K,
            image_size_wh,
            distortion=self.distortion,
            R_camera_world=rotation,
            t_camera_world=translation,
            name=self.name,
            near=self.near,
        )
        return camera.to(device=self.K.device, dtype=self.K.dtype)

    def _normalise(self, points_world: Points) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return a, b, 1 / depth (zero, zero and one where invalid), depth and valid."""
        x, y, depth = self.to_camera_frame(points_world).unbind(-1)
        limit = self.maximum_radius.to(depth).clamp(max=GRAZING_RADIUS)
        valid = (depth > self.near) & (x * x + y * y < (limit * depth).square())
        # Both sides of the division are made harmless before it, so no derivative is NaN either.
        inverse_depth = torch.where(valid, depth, 1.0).reciprocal()
        a = torch.where(valid, x, 0.0) * inverse_depth
        b = torch.where(valid, y, 0.0) * inverse_depth
        return a, b, inverse_depth, depth, valid

    def _focal(self, like: Tensor) -> tuple[Tensor, Tensor]:
        K = self.K.to(like)
        return K[0, 0], K[1, 1]

    def _to_pixels(self, a: Tensor, b: Tensor, valid: Tensor) -> ImagePoints:
        K = self.K.to(a)
        width, height = self.image_size_wh
        u = torch.where(valid, K[0, 0] * a + K[0, 2], -float(width))
        v = torch.where(valid, K[1, 1] * b + K[1, 2], -float(height))
        # Each coordinate one block in memory, as everything that is computed from points.
        return torch.stack([u, v]).movedim(0, -1)


def _see_distortion(camera: Camera, _keys: object) -> None:
    camera.has_distortion = bool((camera.distortion != 0).any())


def _turned(rotation: Tensor, vectors: Vectors) -> Vectors:
    """Turn vectors. In memory each component of the result is one block, fast to work on."""
    components = vectors.movedim(-1, 0)
    turned = _combined(rotation.to(vectors).transpose(0, 1), components)
    return turned.reshape(components.shape).movedim(0, -1)


def _combined(
    weights: Float[Tensor, "r c *#each"], rows: Float[Tensor, "r *each"]
) -> Float[Tensor, "c *each"]:
    """Sums of rows of numbers, by the same weights or by those of each."""
    if weights.dim() == 2:
        return weights.mT @ rows.reshape(len(rows), rows.shape[1:].numel())
    total = weights[0] * rows[0]
    for weight, row in zip(weights[1:], rows[1:], strict=True):
        total = torch.addcmul(total, weight, row)
    return total


class _Lens(NamedTuple):
    """The distortion at some normalised coordinates.

    Attributes:
        a, b: The coordinates.
        k2, k3, p1, p2: Coefficients of the distortion.
        r2: Squared radii.
        q: `q(r2)`.
        q1: Its first derivative in r2.
    """

    a: Tensor
    b: Tensor
    k2: Tensor
    k3: Tensor
    p1: Tensor
    p2: Tensor
    r2: Tensor
    q: Tensor
    q1: Tensor

    @classmethod
    def at(cls, a: Tensor, b: Tensor, distortion: Tensor) -> _Lens:
        k1, k2, p1, p2, k3 = distortion.to(a).unbind()
        r2 = a * a + b * b
        q = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return cls(a, b, k2, k3, p1, p2, r2, q, k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3)))

    def distorted(self) -> tuple[Tensor, Tensor]:
        """The distorted coordinates."""
        a, b, _, _, p1, p2, r2, q, _ = self
        return (
            a * q + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a),
            b * q + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b,
        )

    def jacobian(self) -> tuple[Tensor, Tensor, Tensor]:
        """The entries aa, ab, bb of the distortion's Jacobian, which is symmetric."""
        a, b, _, _, p1, p2, _, q, q1 = self
        return (
            q + 2.0 * (a * a * q1 + p1 * b + 3.0 * p2 * a),
            2.0 * (a * b * q1 + p1 * a + p2 * b),
            q + 2.0 * (b * b * q1 + 3.0 * p1 * b + p2 * a),
        )

    def hessian(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The entries aaa, aab, abb, bbb of the distortion's symmetric second derivative."""
        a, b, k2, k3, p1, p2, r2, _, q1 = self
        # Four times the second derivative of q(r2).
        bend = 8.0 * k2 + 24.0 * k3 * r2
        return (
            6.0 * (a * q1 + p2) + bend * a * a * a,
            2.0 * (b * q1 + p1) + bend * a * a * b,
            2.0 * (a * q1 + p2) + bend * a * b * b,
            6.0 * (b * q1 + p1) + bend * b * b * b,
        )


def _through_lens(
    e_a: Tensor, e_b: Tensor, hessian: tuple[Tensor, Tensor, Tensor], lens: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return D e and the entries aa, ab, bb of D H D, from e, H and D, both symmetric."""
    (h_aa, h_ab, h_bb), (aa, ab, bb) = hessian, lens
    along_a = h_aa * aa + h_ab * ab, h_ab * aa + h_bb * ab
    along_b = h_aa * ab + h_ab * bb, h_ab * ab + h_bb * bb
    return (
        e_a * aa + e_b * ab,
        e_a * ab + e_b * bb,
        aa * along_a[0] + ab * along_a[1],
        ab * along_a[0] + bb * along_a[1],
        ab * along_b[0] + bb * along_b[1],
    )


def _congruence(rotation: Matrix) -> Float[Tensor, "6 9"]:
    """Return the matrix that maps (xx, xy, yy, xz, yz, zz) of S to the nine entries of R^T S R."""
    i, j = (0, 0, 1, 0, 1, 2), (0, 1, 1, 2, 2, 2)
    outer = rotation[i, :, None] * rotation[j, None, :]
    once = torch.eye(3, dtype=torch.bool, device=rotation.device)[i, j]
    once = once.reshape(-1, *[1] * (outer.dim() - 1))
    return torch.where(once, outer, outer + outer.transpose(1, 2)).flatten(1, 2)


def _within_radius(point: Pixels, limit: Tensor) -> Pixels:
    """Pull points that lie beyond a radius back onto it."""
    radius = torch.linalg.vector_norm(point, dim=-1, keepdim=True)
    outside = radius > limit
    return torch.where(outside, point * (limit / torch.where(outside, radius, 1.0)), point)


def _monotonic_radius(distortion: Float[Tensor, " 5"]) -> Float[Tensor, ""]:
    """Return the radius where the radial distortion stops growing, or is too large; inf: nowhere.

    The derivative of r q(r^2) is 1 + 3 k1 s + 5 k2 s^2 + 7 k3 s^3 with s = r^2. The tangential
    terms, small in any real lens, are left out.
    """
    k1, k2, _, _, k3 = distortion.tolist()
    terms = np.clip([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0], -1e100, 1e100)
    roots = np.roots(np.where(np.abs(terms) > 1e-100, terms, 0.0))  # quotients are finite
    real = roots.real[np.abs(roots.imag) <= 1.0e-9 * np.abs(roots)]
    ends = [math.sqrt(root) for root in real if root > 0.0]
    for k, power in ((k1, 3), (k2, 5), (k3, 7)):
        if abs(k) * GRAZING_RADIUS**power > _LARGEST_TERM:
            ends.append((_LARGEST_TERM / abs(k)) ** (1 / power))
    return distortion.new_tensor(min(ends, default=math.inf))


def _checked_image_size(name: str, image_size_wh: Sequence[int]) -> tuple[int, int]:
    sides = tuple(image_size_wh)
    if len(sides) != 2 or any(int(side) != side or side < 1 for side in sides):
        raise CameraError(
            f"{name}: image_size_wh must be a width and a height in whole pixels, got {list(sides)}"
        )
    return int(sides[0]), int(sides[1])


def _finite_tensor(name: str, what: str, value: object, *shape: int) -> Tensor:
    """Copy a value into a float64 tensor on the CPU and check it."""
    array = value.detach().cpu().double().numpy() if isinstance(value, Tensor) else value
    try:
        tensor = torch.from_numpy(np.array(array, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise CameraError(f"{name}: {what} must be numbers, got {value!r}") from error
    if shape and tensor.shape != shape:
        raise CameraError(f"{name}: {what} must have shape {list(shape)}, got {list(tensor.shape)}")
    if not torch.isfinite(tensor).all():
        raise CameraError(f"{name}: {what} must be finite, got {tensor.tolist()}")
    return tensor


def _checked_intrinsics(name: str, value: object) -> Matrix:
    K = _finite_tensor(name, "K", value, 3, 3)
    if not (K[0, 0] > 0.0 and K[1, 1] > 0.0):
        raise CameraError(
            f"{name}: the focal lengths K[0, 0] and K[1, 1] must be positive, "
            f"got {float(K[0, 0]):g} and {float(K[1, 1]):g}"
        )
    rest = torch.stack([K[0, 1], K[1, 0], K[2, 0], K[2, 1], K[2, 2] - 1.0])
    if (rest.abs() > 1.0e-9 * K[0, 0]).any():
        raise CameraError(
            f"{name}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] (no skew), got {K.tolist()}; "
            "calibrate without skew, or write 0 for it if that moves no point by a pixel"
        )
    return K


def _nearest_rotation(name: str, matrix: Matrix) -> Matrix:
    u, singular_values, vt = torch.linalg.svd(matrix)
    error = float((singular_values.square() - 1.0).abs().max())
    determinant = float(torch.linalg.det(matrix))
    if error > _ORTHONORMALITY_TOLERANCE or determinant < 0.0:
        raise CameraError(
            f"{name}: R_camera_world must be a rotation, but R R^T differs from the identity by "
            f"{error:.2g} and the determinant is {determinant:.4g}; check the order of its entries"
        )
    return u @ vt

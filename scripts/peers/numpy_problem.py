"""Problem of `torchcss.studies.reprojection` in NumPy, one state at a time, with SciPy's solvers.

Residuals with their analytic Jacobian, as somebody who uses SciPy would write them: one pass over
the moving joints, the fixed transforms between them folded into constants. Half the sum of squared
residuals is the cost itself: a robust joint error e enters as `e sqrt(rho(e^2)) / |e|`, a prior as
the signed root of its potential.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy.optimize
import torch

from torchcss.studies.reprojection import ReprojectionCost

INSIDE = 1e-9
"""How far inside the limits a start of `least_squares` is moved; it refuses those on a limit."""


class NumpyProblem:
    """Residuals and derivatives of one `ReprojectionCost`.

    Attributes:
        lower: Least admissible state.
        upper: Greatest admissible state.
    """

    def __init__(self, cost: ReprojectionCost) -> None:
        body, camera = cost.body, cost.camera
        assert body.is_untied
        turn = camera.R_camera_world.numpy()
        base = np.eye(4)
        base[:3, :3] = turn @ body.base_rotation.numpy()
        base[:3, 3] = turn @ body.base_translation.numpy() + camera.t_camera_world.numpy()
        # Per joint, in the order of the tree: the joint above, the constant between, axis and kind.
        self.joints: list[tuple[int, np.ndarray, np.ndarray, bool, int]] = []
        carrier, fixed = {}, {}
        for joint in body.tree.specifications:
            above = -1 if joint.parent is None else carrier[joint.parent]
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = joint.rotation, joint.translation
            matrix = (base if joint.parent is None else fixed[joint.parent]) @ matrix
            if joint.kind == "fixed":
                carrier[joint.link], fixed[joint.link] = above, matrix
                continue
            axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
            column = body.tree.joint_names.index(joint.name)
            carrier[joint.link], fixed[joint.link] = len(self.joints), np.eye(4)
            self.joints.append((above, matrix, axis, joint.kind == "revolute", column))
        self.order = np.array([joint[4] for joint in self.joints])
        self.revolute = np.array([joint[3] for joint in self.joints])[:, None]
        links = [body.tree.link_names[k] for k in body.marker_link[cost.index]]
        homogeneous = np.c_[body.marker_offset[cost.index].numpy(), np.ones(len(links))]
        self.carriers = np.array([carrier[link] for link in links])
        self.offsets = np.stack(
            [(fixed[link] @ point)[:3] for link, point in zip(links, homogeneous, strict=True)]
        )
        moves = body.tree.ancestors[:, body.marker_link[cost.index]].numpy()
        self.moves = moves.T[:, self.order, None]
        self.cost, self.near = cost, camera.near
        self.focal = camera.K.diagonal()[:2].numpy() / cost.pixel_noise
        self.shift = (camera.K[:2, 2] - cost.target).numpy() / cost.pixel_noise
        self.far = np.array(camera.image_size_wh) / cost.pixel_noise
        self.mean, self.nu = body.sticky_mean.numpy(), cost.nu
        self.inverse = 1 / body.sticky_deviation.numpy()
        self.lower, self.upper = (bound.numpy() for bound in body.bounds)
        self._posed_at = b""

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Joint errors, two coordinates each, then the priors."""
        self._pose(x)
        z = (x - self.mean) * self.inverse
        prior = np.sign(z) * np.sqrt(self.nu * np.log1p(z * z / self.nu))
        return np.concatenate([(self.scale[:, None] * self.error).ravel(), prior])

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Derivative of the residuals."""
        self._pose(x)
        axis, origin = self.axes, self.origins
        lever = self.points[:, None] - origin
        moved = np.where(self.revolute, np.cross(axis, lever), axis) * self.moves
        ab = self.points[:, None, :2] * self.inverse_depth[:, None, None]
        slope = (moved[..., :2] - ab * moved[..., 2:]) * self.focal
        slope = slope * self.inverse_depth[:, None, None]
        along = np.einsum("jc,jqc->jq", self.error, slope)
        slope = self.scale[:, None, None] * slope
        slope += (self.bend[:, None] * along)[..., None] * self.error[:, None]
        joints = np.empty((2 * len(slope), len(x)))
        joints[:, self.order] = slope.swapaxes(1, 2).reshape(2 * len(slope), -1)
        z = (x - self.mean) * self.inverse
        root = np.sqrt(self.nu * np.log1p(z * z / self.nu))
        small = root < 1e-8
        steep = np.where(small, 1, np.abs(z) / (1 + z * z / self.nu) / np.where(small, 1, root))
        return np.concatenate([joints, np.diag(steep * self.inverse)])

    def value_and_gradient(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Cost and gradient, for a solver that knows nothing of residuals."""
        residuals = self.residuals(x)
        return 0.5 * float(residuals @ residuals), residuals @ self.jacobian(x)

    def solve(
        self, x0: np.ndarray, method: Literal["trf", "L-BFGS-B"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """States reached from the starts, one after the other, and evaluations of each."""
        limits = scipy.optimize.Bounds(self.lower, self.upper)  # type: ignore[arg-type]
        results = []
        for x in x0:
            if method == "trf":
                x = np.clip(x, self.lower + INSIDE, self.upper - INSIDE)
                result = scipy.optimize.least_squares(
                    self.residuals,
                    x,
                    self.jacobian,  # type: ignore[arg-type]
                    bounds=limits,
                )
            else:
                result = scipy.optimize.minimize(
                    self.value_and_gradient, x, jac=True, method=method, bounds=limits
                )
            results.append(result)
        return np.stack([r.x for r in results]), np.array([r.nfev for r in results])

    def _pose(self, x: np.ndarray) -> None:
        """Points, joint axes and origins in the camera's frame, image errors; of one state."""
        if x.tobytes() == self._posed_at:
            return
        self._posed_at = x.tobytes()
        cosine, sine = np.cos(x), np.sin(x)
        frames = []
        for above, constant, axis, revolute, column in self.joints:
            frame = constant if above < 0 else frames[above] @ constant
            local = np.eye(4)
            if revolute:
                a, b, c = axis
                s, k = sine[column], 1 - cosine[column]
                local[0, :3] = 1 + k * (a * a - 1), k * a * b - s * c, k * a * c + s * b
                local[1, :3] = k * a * b + s * c, 1 + k * (b * b - 1), k * b * c - s * a
                local[2, :3] = k * a * c - s * b, k * b * c + s * a, 1 + k * (c * c - 1)
            else:
                local[:3, 3] = x[column] * axis
            frames.append(frame @ local)
        stacked = np.stack(frames)
        axes = np.stack([joint[2] for joint in self.joints])
        self.axes = (stacked[:, :3, :3] @ axes[:, :, None])[..., 0]
        self.origins = stacked[:, :3, 3]
        carried = stacked[self.carriers]
        self.points = (carried[:, :3, :3] @ self.offsets[:, :, None])[..., 0] + carried[:, :3, 3]
        valid = self.points[:, 2] > self.near
        self.inverse_depth = np.where(valid, 1 / np.where(valid, self.points[:, 2], 1), 0)
        error = self.focal * self.points[:, :2] * self.inverse_depth[:, None] + self.shift
        self.error = np.where(valid[:, None], error, self.far)
        # scale = sqrt(rho / s); d(scale e) = scale de + bend (e . de) e with bend = 2 d scale / ds.
        squared = (self.error**2).sum(1)
        rho, first, _ = (part.numpy() for part in self.cost.potential(torch.from_numpy(squared)))
        small = squared < 1e-12
        safe = np.where(small, 1, squared)
        self.scale = np.sqrt(np.where(small, first, rho / safe))
        self.bend = np.where(small, 0, (first - rho / safe) / safe / self.scale)

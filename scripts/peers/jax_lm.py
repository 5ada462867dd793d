"""The problem of `torchcss.studies.reprojection` for JAX: Levenberg-Marquardt, jitted and vmapped.

Residuals with their analytic Jacobian, normal equations on the variables that no limit holds,
Nielsen's damping per item, steps clipped to the limits, float64. The kinematics are unrolled over
the joints, with the constants of the tree folded into the program. Two ways to run it:

* one compiled call, a `while_loop` under `vmap`, as one writes it first: every item costs as many
  iterations as the slowest;
* compacted: blocks of a few iterations are one compiled call, and between the calls the host drops
  finished items and pads the batch to the next power of two, so that few sizes are compiled.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from torchcss.robust import Lorentzian, Quadratic
from torchcss.studies.reprojection import ReprojectionCost

jax.config.update("jax_enable_x64", True)

FIRST_DAMPING = 0.1
"""Damping at the start over the largest diagonal entry of the normal equations."""
BLOCK = 10
"""Iterations per compiled call."""
SMALLEST = 64
"""Smallest batch that is compiled."""


class Items(NamedTuple):
    """Where every item stands."""

    x: jax.Array
    cost: jax.Array
    residual: jax.Array
    jacobian: jax.Array
    damping: jax.Array
    growth: jax.Array
    steps: jax.Array
    done: jax.Array


class JaxLevenbergMarquardt:
    """Descends on one `ReprojectionCost` from many starts.

    Args:
        cost: The problem.
        max_steps: Iterations per item.
        tolerance: Predicted decrease, nats, below which an item is done.
        compacted: Whether finished items are dropped.
    """

    def __init__(
        self,
        cost: ReprojectionCost,
        *,
        max_steps: int = 200,
        tolerance: float = 1e-6,
        compacted: bool = True,
    ) -> None:
        self.residuals = _make_residuals(cost)
        self.lower, self.upper = (jnp.asarray(bound.numpy()) for bound in cost.body.bounds)
        self.max_steps, self.tolerance, self.compacted = max_steps, tolerance, compacted
        self.start = jax.jit(jax.vmap(self._start))
        self.block = jax.jit(jax.vmap(self._block if compacted else self._to_the_end))

    def __call__(self, x0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States and iterations reached from the starts."""
        x, steps = np.empty_like(x0), np.empty(len(x0), dtype=int)
        index = np.arange(len(x0))
        items = self.start(jnp.asarray(_padded(x0) if self.compacted else x0))
        while len(index):
            items = self.block(items)
            done = np.asarray(items.done)[: len(index)]
            x[index[done]] = np.asarray(items.x)[: len(index)][done]
            steps[index[done]] = np.asarray(items.steps)[: len(index)][done]
            left = np.flatnonzero(~done)
            index = index[left]
            if len(left):
                take = jnp.asarray(_padded(left))
                items = jax.tree.map(lambda part, take=take: part[take], items)
        return x, steps

    def _start(self, x: jax.Array) -> Items:
        x = jnp.clip(x, self.lower, self.upper)
        residual, jacobian = self.residuals(x)
        largest = jnp.max(jnp.sum(jacobian**2, axis=0))
        return Items(
            x, 0.5 * jnp.sum(residual**2), residual, jacobian, FIRST_DAMPING * largest,
            jnp.asarray(2.0), jnp.asarray(0), jnp.asarray(False),
        )  # fmt: skip

    def _block(self, items: Items) -> Items:
        return jax.lax.fori_loop(0, BLOCK, lambda _, now: self._step(now), items)

    def _to_the_end(self, items: Items) -> Items:
        return jax.lax.while_loop(lambda now: ~now.done, self._step, items)

    def _step(self, now: Items) -> Items:
        gradient = now.residual @ now.jacobian
        held = ((now.x <= self.lower) & (gradient > 0)) | ((now.x >= self.upper) & (gradient < 0))
        free = ~held
        gradient = jnp.where(free, gradient, 0.0)
        jacobian = jnp.where(free, now.jacobian, 0.0)
        normal = jacobian.T @ jacobian
        damped = normal + jnp.diag(jnp.where(free, now.damping, 1.0))
        newton = -jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(damped), gradient)
        x = jnp.clip(now.x + newton, self.lower, self.upper)
        step = x - now.x
        predicted = -(gradient @ step + 0.5 * step @ (normal @ step))
        residual, jacobian = self.residuals(x)
        cost = 0.5 * jnp.sum(residual**2)
        # A step that was clipped may promise a rise: then it is too long, and no sign of an end.
        ratio = (now.cost - cost) / jnp.where(predicted > 0, predicted, jnp.inf)
        better = (cost < now.cost) & (ratio > 1e-4)
        shrink = jnp.maximum(1 / 3, 1 - (2 * ratio - 1) ** 3)
        stop = (jnp.abs(predicted) < self.tolerance) | (now.steps + 1 >= self.max_steps)
        after = Items(
            jnp.where(better, x, now.x),
            jnp.where(better, cost, now.cost),
            jnp.where(better, residual, now.residual),
            jnp.where(better, jacobian, now.jacobian),
            jnp.where(better, now.damping * shrink, now.damping * now.growth),
            jnp.where(better, 2.0, 2 * now.growth),
            now.steps + 1,
            stop,
        )
        return jax.tree.map(lambda old, new: jnp.where(now.done, old, new), now, after)


def _padded(array: np.ndarray) -> np.ndarray:
    """Repeat the first item up to the next power of two."""
    size = max(SMALLEST, 2 ** math.ceil(math.log2(len(array))))
    return np.concatenate([array, np.repeat(array[:1], size - len(array), axis=0)])


def _make_residuals(cost: ReprojectionCost):
    """A function of one state that returns residuals and their Jacobian."""
    body, camera = cost.body, cost.camera
    names = body.tree.joint_names
    turn = camera.R_camera_world.numpy()
    base = turn @ body.base_rotation.numpy()
    origin = turn @ body.base_translation.numpy() + camera.t_camera_world.numpy()
    moves = body.tree.ancestors[:, body.marker_link[cost.index]].T.numpy()  # [j q]
    links = [body.tree.link_names[k] for k in body.marker_link[cost.index]]
    offsets = body.marker_offset[cost.index].numpy()
    focal = camera.K.diagonal()[:2].numpy() / cost.pixel_noise
    shift = (camera.K[:2, 2] - cost.target).numpy() / cost.pixel_noise
    far = np.array(camera.image_size_wh) / cost.pixel_noise
    mean, deviation = body.sticky_mean.numpy(), body.sticky_deviation.numpy()
    potential = cost.potential

    def kinematics(x):
        """Points [j 3] and twists [q 3] in the camera's frame."""
        poses, axes, velocities = {}, {}, {}
        for joint in body.tree.specifications:
            rotation, place = (base, origin) if joint.parent is None else poses[joint.parent]
            place = rotation @ np.array(joint.translation) + place
            rotation = rotation @ np.array(joint.rotation)
            if joint.kind != "fixed":
                value = x[names.index(joint.name)]
                local = np.array(joint.axis) / np.linalg.norm(joint.axis)
                axis = rotation @ local
                if joint.kind == "revolute":
                    axes[joint.name], velocities[joint.name] = axis, jnp.cross(place, axis)
                    k = np.cross(np.eye(3), -local).T
                    rodrigues = np.eye(3) + jnp.sin(value) * k + (1 - jnp.cos(value)) * (k @ k)
                    rotation = rotation @ rodrigues
                else:
                    axes[joint.name], velocities[joint.name] = jnp.zeros(3), axis
                    place = place + value * axis
            poses[joint.link] = (rotation, place)
        points = [
            poses[link][0] @ offset + poses[link][1]
            for link, offset in zip(links, offsets, strict=True)
        ]
        return (
            jnp.stack(points),
            jnp.stack([axes[name] for name in names]),
            jnp.stack([velocities[name] for name in names]),
        )

    def residuals(x):
        points, omega, velocity = kinematics(x)
        valid = points[:, 2:] > camera.near
        inverse = jnp.where(valid, 1 / jnp.where(valid, points[:, 2:], 1.0), 0.0)
        ab = points[:, :2] * inverse
        error = jnp.where(valid, focal * ab + shift, far)  # [j 2]
        moved = jnp.cross(omega, points[:, None]) + velocity  # [j q 3]
        moved = jnp.where(moves[:, :, None], moved, 0.0)
        slope = (moved[..., :2] - ab[:, None] * moved[..., 2:]) * (inverse[:, None] * focal)
        error, slope = _robust(error, slope)
        z = (x - mean) / deviation
        rho, first = _long_tailed(z * z, cost.nu)
        prior, prior_slope = _square_root(z, rho, first)
        residual = jnp.concatenate([error.ravel(), prior])
        jacobian = jnp.concatenate(
            [jnp.swapaxes(slope, 1, 2).reshape(-1, len(names)), jnp.diag(prior_slope / deviation)]
        )
        return residual, jacobian

    def _robust(error, slope):
        """Scale errors [j 2] and slopes [j q 2] so that half the square is half of rho."""
        if isinstance(potential, Quadratic):
            scale = math.sqrt(potential.nu) / potential.sigma
            return scale * error, scale * slope
        assert isinstance(potential, Lorentzian)
        squared = jnp.sum(error**2, axis=1) / potential.sigma**2
        rho, first = potential.nu * jnp.log1p(squared), potential.nu / (1 + squared)
        near = squared < 1e-12
        scale2 = jnp.where(near, potential.nu, rho / jnp.where(near, 1.0, squared))
        scale = jnp.sqrt(scale2) / potential.sigma
        # d scale / d squared, along the error's own direction.
        bend = (first - scale2) / jnp.where(near, 1.0, squared) / (2 * jnp.sqrt(scale2))
        bend = jnp.where(near, 0.0, bend) / potential.sigma
        along = 2 * jnp.einsum("jc,jqc->jq", error, slope) / potential.sigma**2
        slope = scale[:, None, None] * slope + (bend[:, None] * along)[..., None] * error[:, None]
        return scale[:, None] * error, slope

    return residuals


def _long_tailed(squared, nu):
    """The Lorentzian of unit curvature, and its derivative."""
    return nu * jnp.log1p(squared / nu), 1 / (1 + squared / nu)


def _square_root(z, rho, first):
    """A residual whose square is rho, and its derivative in z."""
    root = jnp.sqrt(rho)
    small = root < 1e-8
    return jnp.sign(z) * root, jnp.where(small, 1.0, first * jnp.abs(z) / jnp.where(small, 1, root))

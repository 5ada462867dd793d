"""The state of the frame before, integrated out of the covariance of a mode.

Optical flow tells how a body moved, and not where it is. Its cost compares a state x_t with the
mean of the mode x_{t-1} that it came from, as if that were known. With the covariance S of that
mode, the noise Q of the dynamics, the information F of the flow (the Hessian of its cost) and the
information H of all that the frame says of x_t alone, the pair (x_{t-1}, x_t) has the Hessian

    [ S^-1 + A     -A   ]
    [    -A       H + A ],     A = Q^-1 + F.

Its Schur complement, `H + (S + A^-1)^-1`, is what is known of x_t: what flow alone holds in place
drifts by the sum of the errors of all frames. Filters of odometry do the same: stochastic cloning,
Roumeliotis and Burdick, ICRA 2002. Without flow it is the prior `(S + Q)^-1` of eq. 10 [IJRR].
"""

from __future__ import annotations

import torch

from torchcss.linalg import prior_units, symmetric_part
from torchcss.types import Matrices, Vector

_LEAST_VARIANCE = 1e-15
"""Of a parameter that is known exactly, in units of the prior's variance."""


def information_of_past(
    motion: Matrices, before: Matrices, noise: Matrices, prior_variance: Vector
) -> Matrices:
    """What the mode before and the motion since say of a state: `(S + (Q^-1 + F)^-1)^-1`.

    Args:
        motion: F, Hessians of the cost of the motion, nats. Of one that is not positive
            semi-definite, negative curvatures count as zero.
        before: S, covariances of the modes before; may be singular.
        noise: Q, covariances of what the dynamics add; may be singular.
        prior_variance: Positive variance of each parameter before any image is seen: the units.

    Returns:
        Inverse covariances, in the type of F.
    """
    units = prior_units(prior_variance.double().to(motion.device))
    values, vectors = torch.linalg.eigh(symmetric_part(motion.double() * units))
    flow = (vectors * values.clamp(min=0)[..., None, :]) @ vectors.mT
    one = torch.eye(len(units), dtype=units.dtype, device=units.device)
    added = noise.double() / units
    # (Q^-1 + F)^-1 = (1 + Q F)^-1 Q has no inverse of Q.
    step = symmetric_part(torch.linalg.solve_ex(one + added @ flow, added)[0])
    known = symmetric_part(before.double() / units) + step
    information = torch.linalg.inv_ex(known + _LEAST_VARIANCE * one)[0]
    return (symmetric_part(information) / units).to(motion)

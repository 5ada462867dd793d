"""Random people in random poses with marked joints: known truth for the initialisation.

A person is a body with lengths drawn from the anthropometric prior (within 10 % of the standard
humanoid), in a pose drawn from the sticky priors, turned any way about the vertical, seen by the
camera of `torchcss.studies.reprojection`: 1920 x 1080 pixels, at 3.5 m. Keypoints have Gaussian
noise; some may be missing, and some may be anywhere in the image.

Call `random_person(generator=...)`, or `random_lengths` for the lengths alone; `person_coverage`
tells whether stated covariances hold the truth.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcss.body.catalog import LENGTHS, PROPORTION_RANGE
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import move_base
from torchcss.body.rotations import within_half_turn
from torchcss.body.uncertainty import joint_covariance
from torchcss.cost.anthropometric import Anthropometric, proportion_columns
from torchcss.inference.mixture import GaussianMixture
from torchcss.joint_names import LIMB_JOINTS
from torchcss.linalg import squared_mahalanobis
from torchcss.studies.reprojection import DISTANCE, HEIGHT, WIDTH, plausible_pose, study_camera
from torchcss.types import Vector
from torchcss.vision.camera import Camera

_BODY = "body34"

MARKED = (*LIMB_JOINTS, "vc7", "skull_tip")
"""The joints of the keypoints: those of the limbs, the base of the neck, the top of the head."""


class RandomPerson(NamedTuple):
    """A person with marked joints.

    Attributes:
        body: The body with its own lengths, hung before the camera.
        state: Its pose.
        camera: The camera.
        joint_names: Names of the marked joints.
        keypoints: Where they are marked, pixels.
        confidence: 0 where a joint is missing, else 1.
        is_outlier: Whether a keypoint is an outlier, which no fit is told.
    """

    body: BodyModel
    state: Vector
    camera: Camera
    joint_names: tuple[str, ...]
    keypoints: Float[Tensor, "j 2"]
    confidence: Float[Tensor, " j"]
    is_outlier: Bool[Tensor, " j"]

    def joints_world(self, names: tuple[str, ...]) -> Float[Tensor, "j 3"]:
        """True positions of joints, metres."""
        joints = self.body.pose(self.state).joints
        return joints[self.body.joint_columns(names)]


def random_person(
    *,
    generator: torch.Generator,
    joint_names: tuple[str, ...] = MARKED,
    spread: float = 1.0,
    noise_px: float = 2.0,
    missing: float = 0.0,
    outliers: float = 0.0,
) -> RandomPerson:
    """Draw a person, the same one for all kinds of keypoints from the same state of the generator.

    Args:
        generator: Source of everything.
        joint_names: Which joints are marked.
        spread: Factor on how far all angles are from rest. Each by itself is one that people take
            at 1, all together are a contortion; with a half they stand about.
        noise_px: Standard deviation of each coordinate.
        missing: Probability that a joint is missing.
        outliers: Probability that its mark is anywhere in the image.
    """
    lengths = random_lengths(generator=generator)
    place = torch.tensor([0.0, 0.0, -DISTANCE], dtype=torch.float64)
    body = load_body(_BODY, lengths=lengths).with_base(torch.eye(3), place)
    state = torch.lerp(body.rest, plausible_pose(body, generator=generator), spread)
    turn = torch.rand((), generator=generator, dtype=torch.float64)
    state[body.state_index("root_yaw")] = math.pi * (2 * turn - 1)
    camera = study_camera("random")
    index = body.joint_columns(joint_names)
    uv = camera.project(body.pose(state).joints[index]).uv
    noise = torch.randn(uv.shape, generator=generator, dtype=uv.dtype)
    chance = torch.rand(2, len(index), generator=generator, dtype=uv.dtype)
    anywhere = torch.rand(uv.shape, generator=generator, dtype=uv.dtype)
    is_outlier = chance[0] < outliers
    anywhere = anywhere * uv.new_tensor([WIDTH, HEIGHT])
    uv = torch.where(is_outlier[:, None], anywhere, uv + noise_px * noise)
    confidence = (chance[1] >= missing).to(uv)
    return RandomPerson(body, state, camera, joint_names, uv, confidence, is_outlier)


def random_lengths(*, generator: torch.Generator) -> dict[str, float]:
    """Lengths of a person drawn from the anthropometric prior, within its 10 %, metres."""
    free = load_body(_BODY, free_proportions=True)
    factor = torch.linalg.cholesky(Anthropometric().covariance(free))
    drawn = factor @ torch.randn(len(factor), generator=generator, dtype=torch.float64)
    lengths = dict(LENGTHS)
    for name, extra in zip(proportion_columns(free), drawn.tolist(), strict=True):
        margin = PROPORTION_RANGE * LENGTHS[name]
        lengths[name] += min(max(extra, -margin), margin)
    return lengths


class PersonCoverage(NamedTuple):
    """Shares of the truth inside what the nearest mode states at 95 %.

    Attributes:
        parameters: Of pose and lengths, inside their own intervals.
        joints: Of the limbs' joint centres, inside their ellipsoids in space.
    """

    parameters: float
    joints: float


def person_coverage(
    person: RandomPerson, body: BodyModel, mixture: GaussianMixture
) -> PersonCoverage:
    """Compare the true pose and lengths with a mixture over both.

    The nearest mode is that whose deviations, each in its own standard deviations, are least. All
    parameters together are no Gaussian: where a limb may lean either way, poses of equal likelihood
    lie on an arc, thinner than the arc's height.

    Args:
        person: The truth.
        body: The body with free lengths that the mixture is about.
        mixture: Modes of pose and lengths.
    """
    _, state, _ = move_base(person.body, body.base_rotation, body.base_translation, person.state)
    truth = torch.zeros_like(mixture.mean[0])
    truth[body.state_columns(person.body.state_names)] = state
    for name, column in proportion_columns(body).items():
        truth[column] = person.body.lengths[name] - body.lengths[name]
    apart = truth - mixture.mean
    yaw = body.state_index("root_yaw")
    apart[:, yaw] = within_half_turn(apart[:, yaw])
    z = apart.abs() / mixture.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    nearest = int(z.square().mean(-1).argmin())
    index = body.joint_columns(LIMB_JOINTS)
    pose = body.pose(mixture.mean[nearest])
    spread = joint_covariance(body, pose, mixture.covariance[nearest])[index]
    squared = squared_mahalanobis(person.joints_world(LIMB_JOINTS) - pose.joints[index], spread)
    chi_squared_95 = 7.815  # three degrees of freedom
    return PersonCoverage(
        float((z[nearest] < 1.96).double().mean()),
        float((squared < chi_squared_95).double().mean()),
    )

"""Marks of joints in one image: how they come in, how exact they are, and what is odd about them.

Everything here is about the marks as given; nothing is exchanged, moved or left out (that is
`torchcss.initialise.outliers`), only refused or reported.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.body.root import has_root
from torchcss.cost.joints import JointObservation, JointTerm
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.errors import KeypointError
from torchcss.initialise.multi_start import Search, find_interpretations
from torchcss.initialise.outliers import capped_cost
from torchcss.joint_names import JOINT_NAMES, canonical_joint_name
from torchcss.vision.camera import Camera

_SUSPICIOUS = 0.5
"""Nats per marked joint from which a fit is so bad that left and right may be swapped."""

_CLEARLY_BETTER = 5.0
"""Nats by which a fit with exchanged sides must be better to be reported."""

_ARM = ("shoulder", "elbow", "wrist", "hand_tip")
_LEG = ("hip", "knee", "ankle", "toe", "heel", "midtarsal")
_SIDED = {
    "the whole body": (*_ARM, *_LEG, "eye", "ear"),
    "the arms": _ARM,
    "the legs": _LEG,
}


def keypoint_table(
    joints_2d: Mapping[str, Sequence[float]] | Float[Tensor, "j c"],
    joint_names: tuple[str, ...] | None,
) -> tuple[tuple[str, ...], Float[Tensor, "j 2"], Float[Tensor, " j"]]:
    """Canonical names, pixels and confidences of marks however they are given.

    Raises:
        KeypointError: If a joint is unknown, or a row is neither `(u, v)` nor with confidence.
    """
    if isinstance(joints_2d, Mapping):
        names = [canonical_joint_name(name) for name in joints_2d]
        unknown = [given for given, name in zip(joints_2d, names, strict=True) if name is None]
        if unknown:
            raise KeypointError(
                f"unknown joint {unknown[0]!r}; the known ones are {', '.join(JOINT_NAMES)}"
            )
        rows = [[*(float(number) for number in place), 1.0][:3] for place in joints_2d.values()]
        if any(len(row) != 3 for row in rows):
            raise KeypointError("expected (u, v) or (u, v, confidence) for every joint")
        table = torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)
        return tuple(name or "" for name in names), table[:, :2], table[:, 2]
    if (
        joint_names is None
        or len(joint_names) != len(joints_2d)
        or joints_2d.shape[-1] not in (2, 3)
    ):
        raise KeypointError(
            f"joints_2d: expected [joints, 2 or 3] with as many joint_names, got "
            f"{list(joints_2d.shape)} and {'none' if joint_names is None else len(joint_names)}"
        )
    full = joints_2d.shape[-1] == 3
    confidence = joints_2d[:, 2] if full else torch.ones_like(joints_2d[:, 0])
    return joint_names, joints_2d[:, :2], confidence


def default_sigma(keypoints: Float[Tensor, "j 2"]) -> float:
    """Noise of a detector's keypoints, pixels: 0.6 % of the diagonal of the person's box.

    Detectors err in proportion to the person's size in the image: the beam clip's keypoints, 6 px
    on a person of 950 px, set the ratio. At least one pixel.
    """
    keypoints = keypoints[keypoints.isfinite().all(-1)]
    if len(keypoints) < 2:
        return 3.0
    diagonal = (keypoints.max(dim=0).values - keypoints.min(dim=0).values).norm()
    return max(1.0, 0.006 * float(diagonal))


def typical_sigma(keypoints: Float[Tensor, "t j 2"], confidence: Float[Tensor, "t j"]) -> float:
    """Noise of a sequence's keypoints, pixels, from the person's typical size in it.

    Args:
        keypoints: Pixels.
        confidence: 0 where a joint is missing.

    Raises:
        KeypointError: If no frame has two keypoints.
    """
    sizes = [
        default_sigma(points[seen])
        for points, seen in zip(keypoints, confidence > 0, strict=True)
        if int(seen.sum()) >= 2
    ]
    if not sizes:
        raise KeypointError(
            "no frame has two keypoints, at least one has to; the person's size in the image, and "
            "with it the keypoints' noise, cannot be told: give other keypoints"
        )
    return statistics.median(sizes)


def check_joints(
    name: str,
    observation: JointObservation,
    body: BodyModel,
    camera: Camera,
    least: int,
) -> tuple[str, ...]:
    """Refuse joints from which nothing can be fitted, and say what is odd about the others.

    Args:
        name: What the messages call the picture.
        observation: The marked joints.
        body: The body that they belong to.
        camera: The camera that sees them.
        least: How many joints a fit needs.

    Returns:
        What is odd, one sentence each.

    Raises:
        KeypointError: If too few joints are seen, or all are at one place.
    """
    seen = observation.weight > 0
    places, index = observation.target[seen], observation.index[seen].tolist()
    names = [body.joint_names[joint] for joint in index]
    if len(names) < least:
        raise KeypointError(
            f"{len(names)} joints of {name} are marked in the first frame, at least {least} are "
            "needed: start at another frame or mark more joints"
        )
    report = []
    apart = torch.cdist(places, places)
    if len(names) > 1 and float(apart.max()) < 1.0:
        raise KeypointError(
            f"all {len(names)} joints are marked at one place, "
            f"({float(places[0, 0]):.0f}, {float(places[0, 1]):.0f}): mark them where they are"
        )
    pairs = torch.nonzero(torch.triu(apart < 0.5, diagonal=1)).tolist()
    if pairs:
        same = ", ".join(f"{names[a]} and {names[b]}" for a, b in pairs)
        report.append(f"joints marked at the same place: {same}")
    outside = [
        n for n, inside in zip(names, camera.inside_image(places), strict=True) if not inside
    ]
    if outside:
        report.append(f"joints outside the image: {', '.join(outside)}")
    return tuple(report)


def swapped_sides(
    body: BodyModel,
    x: Float[Tensor, " n"],
    camera: Camera,
    keypoints: Tensor,
    confidence: Tensor,
    names: tuple[str, ...],
    joints: JointTerm,
    generator: torch.Generator,
) -> list[str]:
    """Say where exchanging left and right would fit much better; nothing is exchanged.

    Args:
        body: The fitted body.
        x: Its best fit to the marks as given.
        camera: The camera.
        keypoints: The marks, pixels.
        confidence: 0 where one is missing.
        names: Their canonical names.
        joints: The joint term.
        generator: Source of starts.

    Returns:
        A line for the report, or none.
    """

    def cost_of(names: tuple[str, ...]) -> TrackingCost:
        observation = JointObservation(
            body.joint_names, keypoints.to(body.tie), confidence.to(body.tie), names
        )
        choice = CostChoice(contour=None, joints=joints, temporal=None)
        return TrackingCost(body=body, camera=camera, choice=choice, observation=observation)

    # Marks of exchanged joints may have been left out as gross, which has its price too.
    given = cost_of(names)
    assert given.observation is not None
    best = float(capped_cost(given, x))
    if best < _SUSPICIOUS * int((given.observation.weight > 0).sum()) or not has_root(body):
        return []
    quick = Search(num_starts=24, num_flips=0, num_samples=0, max_steps=30)
    costs: dict[str, float] = {}
    for what, places in _SIDED.items():
        swapped = tuple(_other_side(name, places) for name in names)
        if swapped != names:
            cost = cost_of(swapped)
            fits = find_interpretations(cost, search=quick, generator=generator)
            costs[what] = float(capped_cost(cost, fits.mean).min())
    if not costs or min(costs.values()) > best - _CLEARLY_BETTER:
        return []
    what = min(costs, key=lambda name: costs[name])
    return [
        f"left and right look swapped in {what}: exchanged, they fit with cost {costs[what]:.1f} "
        f"instead of {best:.1f}; they are used as given, so exchange them if the picture agrees"
    ]


def _other_side(name: str, places: tuple[str, ...]) -> str:
    side, _, place = name.partition("_")
    if side not in ("l", "r") or place not in places:
        return name
    return f"{'r' if side == 'l' else 'l'}_{place}"

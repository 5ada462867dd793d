"""Keypoints of one image: how they come in, how exact they are, and what is odd about them.

Everything here is about the keypoints as given; nothing is exchanged, moved or left out (that is
`torchcss.initialise.outliers`), only refused or reported.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import torch

from torchcss.body.root import has_root
from torchcss.cost.total import TrackingCost
from torchcss.errors import KeypointError, check_floating, check_shape
from torchcss.files import refusing
from torchcss.initialise.multi_start import StartSearch, multi_start_fits
from torchcss.initialise.outliers import capped_cost
from torchcss.joint_names import JOINT_NAMES, canonical_joint_name
from torchcss.types import Keypoints, Vector
from torchcss.vision.camera import Camera

_SUSPICIOUS = 0.5
"""Nats per keypoint from which a fit is so bad that left and right may be swapped."""

_CLEARLY_BETTER = 5.0
"""Nats by which a fit with exchanged sides must be better to be reported."""

_ARM = ("shoulder", "elbow", "wrist", "hand_tip")
_LEG = ("hip", "knee", "ankle", "toe", "heel", "midtarsal")
_SIDED = {
    "the whole body": (*_ARM, *_LEG, "eye", "ear"),
    "the arms": _ARM,
    "the legs": _LEG,
}


def keypoints_by_name(
    places: Mapping[str, Sequence[float]], *, own: Mapping[str, str] = MappingProxyType({})
) -> Keypoints:
    """Keypoints of one image from pixels by joint name, `(u, v)` or `(u, v, confidence)`.

    Args:
        places: The pixels.
        own: Joints by what the body's file calls them, see `BodyModel.joint_of_name`.

    Raises:
        KeypointError: If a joint is unknown, or a place has other numbers.
    """
    names = tuple(own.get(name) or canonical_joint_name(name) or "" for name in places)
    if "" in names:
        unknown = list(places)[names.index("")]
        known = ", ".join(dict.fromkeys(own.values()) or JOINT_NAMES)
        raise KeypointError(f"unknown joint {unknown!r}; the known ones are {known}")
    with refusing(KeypointError, "expected (u, v) or (u, v, confidence) for every joint"):
        rows = [(u, v, *(told or [1.0])) for u, v, *told in places.values()]
        table = torch.tensor(rows, dtype=torch.float64).reshape(len(rows), 3)
    return Keypoints(table[:, :2], table[:, 2], names)


def check_numbers(keypoints: Keypoints, *, frames: bool) -> None:
    """Refuse keypoints whose places, confidences and names do not agree.

    Args:
        keypoints: Those of an image, `[j 2]`, or of all frames, `[t j 2]`.
        frames: Whether they are to be of all frames.

    Raises:
        ShapeError: If they are no tensors of a floating type, or not pairs of a joint each.
        KeypointError: If the confidences are of another shape, or it is one image instead of all
            frames or the other way round.
    """
    places, confidence = keypoints.positions, keypoints.confidence
    check_shape("keypoints.positions", places, len(keypoints.names), 2)
    check_floating("keypoints.positions", places)
    check_shape("keypoints.confidence", confidence)
    if keypoints.points is not None:
        check_shape("keypoints.points", keypoints.points, *confidence.shape, 3)
    if confidence.shape != places.shape[:-1]:
        raise KeypointError(
            f"keypoints: {list(places.shape)} places have confidences {list(confidence.shape)}; "
            "expected one of each"
        )
    if places.ndim != 2 + frames:
        wanted = "all frames, [t j 2]" if frames else "one image, [j 2]: use keypoints.at(frame)"
        raise KeypointError(f"keypoints: expected those of {wanted}; got {list(places.shape)}")


def default_sigma(keypoints: Keypoints) -> float:
    """Noise of a detector's keypoints, pixels: 0.6 % of the diagonal of the person's box.

    Detectors err in proportion to the person's size in the image. At least one pixel.
    """
    places = keypoints.positions[keypoints.known]
    if len(places) < 2:
        return 3.0
    return max(1.0, 0.006 * float((places.amax(0) - places.amin(0)).norm()))


def typical_sigma(keypoints: Keypoints) -> float:
    """Noise of a sequence's keypoints, pixels, from the person's typical size in it.

    Raises:
        KeypointError: If no frame has two keypoints.
    """
    known = keypoints.known.sum(-1) >= 2
    sizes = [default_sigma(keypoints.at(t)) for t in torch.nonzero(known)[:, 0].tolist()]
    if not sizes:
        raise KeypointError(
            "no frame has two keypoints, at least one has to; the person's size in the image, and "
            "with it the keypoints' noise, cannot be told: give other keypoints"
        )
    return statistics.median(sizes)


def check_keypoints(name: str, keypoints: Keypoints, camera: Camera, least: int) -> tuple[str, ...]:
    """Refuse joints from which nothing can be fitted, and say what is odd about the others.

    Args:
        name: The body's name, for the messages.
        keypoints: Joints of the body.
        camera: The camera that sees them.
        least: How many joints a fit needs.

    Returns:
        What is odd, one sentence each.

    Raises:
        KeypointError: If too few joints are seen, or all are at one place.
    """
    seen = keypoints.known
    places = keypoints.positions[seen]
    names = [keypoints.names[column] for column in torch.nonzero(seen)[:, 0].tolist()]
    if len(names) < least:
        raise KeypointError(
            f"{len(names)} joints of {name} are marked in the first frame, at least {least} are "
            "needed: start at another frame or mark more joints"
        )
    apart = torch.cdist(places, places)
    if len(names) > 1 and float(apart.max()) < 1.0:
        raise KeypointError(
            f"all {len(names)} joints are marked at one place, "
            f"({float(places[0, 0]):.0f}, {float(places[0, 1]):.0f}): mark them where they are"
        )
    report = []
    if pairs := torch.nonzero(torch.triu(apart < 0.5, diagonal=1)).tolist():
        same = ", ".join(f"{names[a]} and {names[b]}" for a, b in pairs)
        report.append(f"joints marked at the same place: {same}")
    inside = camera.inside_image(places).tolist()
    if outside := [name for name, is_in in zip(names, inside, strict=True) if not is_in]:
        report.append(f"joints outside the image: {', '.join(outside)}")
    return tuple(report)


def swapped_sides(cost: TrackingCost, x: Vector, generator: torch.Generator) -> tuple[str, ...]:
    """Say where exchanging left and right would fit much better; nothing is exchanged.

    Args:
        cost: Cost of all keypoints as given.
        x: Its best fit.
        generator: Source of starts.

    Returns:
        A line for the report, or none.
    """
    given = cost.keypoints
    # Exchanged keypoints may have been left out as outliers, which has its price too.
    best = float(capped_cost(cost, x))
    if best < _SUSPICIOUS * int(given.known.sum()) or not has_root(cost.body):
        return ()
    quick = StartSearch(num_starts=24, num_flips=0, num_samples=0, max_steps=30)
    costs: dict[str, float] = {}
    for what, places in _SIDED.items():
        names = tuple(_other_side(name, places) for name in given.names)
        if names != given.names:
            swapped = cost.with_keypoints(given._replace(names=names))
            fits = multi_start_fits(swapped, search=quick, generator=generator)
            costs[what] = float(capped_cost(swapped, fits.mean).min())
    what = min(costs, key=lambda name: costs[name], default="")
    if not what or costs[what] > best - _CLEARLY_BETTER:
        return ()
    return (
        f"left and right look swapped in {what}: exchanged, they fit with cost {costs[what]:.1f} "
        f"instead of {best:.1f}; they are used as given, so exchange them if the picture agrees",
    )


def _other_side(name: str, places: tuple[str, ...]) -> str:
    side, _, place = name.partition("_")
    if side not in ("l", "r") or place not in places:
        return name
    return f"{'r' if side == 'l' else 'l'}_{place}"

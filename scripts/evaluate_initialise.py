"""Errors of initialisation from the joints of one image, as a table and as JSON.

    python scripts/evaluate_initialise.py --data DIR --out initialise.json

Synthetic people (`torchcss.studies.random_person`): random proportions and poses, seen from any
side, fourteen marked joints. Real frames (with `--data`): the beam clip from either camera and the
rendered turn, against their 3D references. Errors are means over the limbs' twelve joints, then
over people or frames. "Inside": the share of true parameters, and of true joints, inside the 95 %
interval or ellipsoid that the nearest mode states. The last rows fit the same data from a single
start, without limits, without the prior on lengths (they stay within their interval), or without
robust potential. The last two fit pose and lengths in one search that leaves no keypoints out, left
and right equal as in section 5 [IJRR], and free. Seconds are the processor's.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from common import Table, start, write_report

from torchcss.body.catalog import specification, without_side
from torchcss.body.model import BodyModel
from torchcss.cost.anthropometric import proportion_columns
from torchcss.cost.joints import match_joints
from torchcss.initialise.fit import initialise
from torchcss.initialise.from_joints import hang_before_camera
from torchcss.initialise.keypoint_checks import default_sigma
from torchcss.initialise.multi_start import SINGLE_START, StartSearch
from torchcss.initialise.options import LEAST_JOINTS, InitialiseOptions
from torchcss.io.cameras import read_camera
from torchcss.io.keypoints.read import read_keypoints
from torchcss.joint_names import LIMB_JOINTS
from torchcss.robust import Quadratic
from torchcss.studies.metrics import pa_mpjpe_mm, root_aligned_mpjpe_mm
from torchcss.studies.random_person import RandomPerson, person_coverage, random_person
from torchcss.studies.sequences import read_reference
from torchcss.types import Keypoints, Vector, frozen
from torchcss.vision.camera import Camera

BONES = {"thigh": ("hip", "knee"), "shank": ("knee", "ankle"), "upper_arm": ("shoulder", "elbow"),
         "forearm": ("elbow", "wrist")}  # fmt: skip
SYNTHETIC: dict[str, dict[str, float]] = {
    "noise 0 px": {"noise_px": 0.0},
    "noise 2 px": {"noise_px": 2.0},
    "noise 5 px": {"noise_px": 5.0},
    "2 px, 20 % missing": {"missing": 0.2},
    "2 px, 5 % outliers": {"outliers": 0.05},
    "the same, told which": {"outliers": 0.05},
}
TOLD = "the same, told which"
"""Outliers have confidence zero: what no method that must find them can surpass."""
CLIPS = {
    "beam, camera 1": ("balance_beam_4cam", "cam01.mp4", "keypoints2d_cam01.npz"),
    "beam, camera 3": ("balance_beam_4cam", "cam03.mp4", "keypoints2d_cam03.npz"),
    "rendered turn": ("rendered_turn", "video.mp4", "keypoints2d.npz"),
}
VARIANTS = ("full", "single start", "without limits", "no prior on lengths", "not robust",
            "sides equal", "sides free")  # fmt: skip
COMPARED = ("noise 2 px", "2 px, 5 % outliers", *CLIPS)
HEADS = ("best", "of 7", "of 50", "r-a best", "r-a of 7", "ratios %", "viol. %", "params %",
         "joints %", "s")  # fmt: skip


@frozen
class Config:
    """What is fitted."""

    data: Path | None = None
    """Folder with balance_beam_4cam and rendered_turn; without it only synthetic people."""
    people: int = 30
    """Synthetic people per row."""
    frames: int = 10
    """Frames per clip, evenly spread."""
    variants: tuple[str, ...] = VARIANTS
    """Rows of the table."""
    small: bool = False
    """One person or frame, few starts and rows, to see that it runs."""
    out: Path | None = None
    """JSON file to write."""


class Case(NamedTuple):
    """Keypoints of one image with their truth; the person only where it is synthetic."""

    camera: Camera
    keypoints: Keypoints
    joints: np.ndarray
    sigma: float
    lengths: dict[str, float]
    person: RandomPerson | None = None


def main(config: Config) -> dict[str, Any]:
    """Fit, print and write the table; return what is written."""
    rows: list[dict[str, Any]] = []
    shown: list[list[str | float]] = []
    report = {"unit": "mm, %, s", "direction": "lower is better; params and joints: 95 is right",
              "setting": config, "rows": rows}  # fmt: skip
    conditions = [*SYNTHETIC, *(CLIPS if config.data else ())]
    for variant in config.variants[: 2 if config.small else None]:
        for condition in ("noise 2 px",) if config.small else conditions:
            if variant != "full" and condition not in COMPARED:
                continue
            fits = [fit(case, variant, config, i) for i, case in cases(config, condition)]
            mean = {key: mean_known([fit[key] for fit in fits]) for key in fits[0]}
            rows.append({"variant": variant, "condition": condition, "count": len(fits), **mean,
                         "per_case": fits})  # fmt: skip
            shown.append([condition, variant, *mean.values()])
            table = Table("First pose", ("condition", "fit", *HEADS), shown)
            table.print()
            write_report(config.out, report, table)
    return report


def mean_known(values: list[float]) -> float:
    """Mean without the NaNs; NaN if there is nothing else."""
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan


def cases(config: Config, condition: str) -> Iterator[tuple[int, Case]]:
    """The images of one condition, numbered."""
    if condition in SYNTHETIC:
        for seed in range(1 if config.small else config.people):
            generator = torch.Generator().manual_seed(seed)
            person = random_person(generator=generator, **SYNTHETIC[condition])  # type: ignore[arg-type]
            noise = SYNTHETIC[condition].get("noise_px", 2.0)
            known = person.is_outlier if condition == TOLD else torch.zeros_like(person.is_outlier)
            yield seed, Case(
                person.camera,
                Keypoints(person.keypoints, person.confidence, person.joint_names).without(known),
                person.joints_world(LIMB_JOINTS).numpy(), max(noise, 1.0), person.body.lengths,
                person,
            )  # fmt: skip
        return
    assert config.data is not None
    folder, video, file = CLIPS[condition]
    camera = read_camera(config.data / folder / "cameras.json", video=video)
    keypoints = read_keypoints(config.data / folder / file, image_size_wh=camera.image_size_wh)
    places, names = read_reference(config.data / folder / "reference3d.npz")
    joints = places[:, [names.index(name) for name in LIMB_JOINTS]]
    at = {name: joints[:, i] for i, name in enumerate(LIMB_JOINTS)}
    lengths = {
        limb: float(np.nanmedian([np.linalg.norm(at[f"{side}_{a}"] - at[f"{side}_{b}"], axis=-1)
                                  for side in "lr"])) for limb, (a, b) in BONES.items()
    }  # fmt: skip
    for frame in np.linspace(0, len(joints) - 1, config.frames).round().astype(int).tolist():
        there = keypoints.at(frame)
        yield frame, Case(camera, there, joints[frame], default_sigma(there), lengths)


def fit(case: Case, variant: str, config: Config, seed: int) -> dict[str, float]:
    """Initialise and compare with the truth."""
    search = (
        StartSearch(num_starts=8, num_flips=8, num_samples=8) if config.small else StartSearch()
    )
    search = SINGLE_START if variant == "single start" else search
    if variant == "without limits":
        search = replace(search, limits=False)
    options = InitialiseOptions(
        sigma=case.sigma, search=search, num_modes=50, least_joints=LEAST_JOINTS
    )
    if variant == "no prior on lengths":
        options = replace(options, weights={"anthropometric": 0.0})
    if variant == "not robust":
        search = replace(search, leave_out=False)
        options = replace(options, potential_kind=Quadratic, search=search)
    generator = torch.Generator().manual_seed(seed)
    given = loose_body(case, tied=variant == "sides equal") if "sides" in variant else "body34"
    began = time.process_time()
    found = initialise(
        None, case.keypoints, case.camera, given, generator=generator, options=options
    )
    seconds = time.process_time() - began
    body, states = found.body, found.hypotheses(50, generator=generator)
    places = body.pose(states).joints[:, body.joint_columns(LIMB_JOINTS)].numpy()
    procrustes = pa_mpjpe_mm(places, case.joints)
    aligned = root_aligned_mpjpe_mm(places, case.joints, LIMB_JOINTS)
    modes = found.mixture.mean
    outside = ((modes < body.lower) | (modes > body.upper)).any(-1)
    share, right = (np.array([lengths[limb] for limb in BONES]) for lengths in
                    (found.lengths or mean_lengths(body, modes[0]), case.lengths))  # fmt: skip
    ratios = (share / share.sum()) / (right / right.sum()) - 1
    parameters, ellipsoids = math.nan, math.nan
    if case.person is not None and found.free_body and found.free_mixture:
        stated = person_coverage(case.person, found.free_body, found.free_mixture)
        parameters, ellipsoids = 100 * stated.parameters, 100 * stated.joints
    numbers = (
        procrustes[0], procrustes[:7].min(), procrustes.min(), aligned[0], aligned[:7].min(),
        100 * np.abs(ratios).mean(), 100 * outside.double().mean(), parameters, ellipsoids, seconds,
    )  # fmt: skip
    keys = ("pa_best_mm", "pa_best_of_7_mm", "pa_best_of_50_mm", "root_aligned_best_mm",
            "root_aligned_best_of_7_mm", "length_ratio_error_percent", "limit_violations_percent",
            "parameters_inside_percent", "joints_inside_percent", "seconds")  # fmt: skip
    return dict(zip(keys, map(float, numbers), strict=True))


def loose_body(case: Case, *, tied: bool) -> BodyModel:
    """A body before the camera whose lengths are parameters, left and right one or two."""
    rows = specification("body34", free_proportions=True)
    if not tied:
        sides = {joint: name for joint, (name, _) in rows.ties.items() if joint.endswith("_length")}
        sticky = {k: v for k, v in rows.sticky.items() if k not in sides.values()}
        sticky |= {joint: rows.sticky[name] for joint, name in sides.items()}
        ties = {joint: row for joint, row in rows.ties.items() if joint not in sides}
        rows = replace(rows, ties=ties, sticky=sticky)
    body = BodyModel(rows).to(torch.float64)
    targets = match_joints(case.keypoints.only(body.joint_names), body.joint_names)
    return hang_before_camera(body, case.camera, targets)


def mean_lengths(body: BodyModel, x: Vector) -> dict[str, float]:
    """The fitted lengths of a body that has them as parameters, the means over the sides."""
    found: dict[str, list[float]] = {}
    for name, column in proportion_columns(body).items():
        bare = without_side(name)
        found.setdefault(bare, []).append(body.lengths[bare] + float(x[column]))
    return {name: float(np.mean(values)) for name, values in found.items()}


if __name__ == "__main__":
    start(main, Config, __doc__)

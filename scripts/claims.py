"""Every claim of the two papers' experiments, held against what our studies saw.

    python scripts/claims.py --failures ARM.json ARM7.json CLUTTER.json DARK.json \
        --table1 TABLE1.json --scores SCORES.json --variations VARIATIONS.json MORE.json \
        --spectra SPECTRA.json --slices SLICES.json --minima MINIMA.json --first-poses POSES.json \
        --profile PROFILE.json --sequences ARM CLUTTER DARK --out docs/results/claims.json

The reports are those of `scripts/failure_modes.py`, `scripts/table1.py`,
`scripts/hypothesis_scores.py`, `scripts/model_variations.py`, `scripts/spectra.py`,
`scripts/cost_slices.py`, `scripts/cost_minima.py`, `scripts/evaluate_initialise.py` and
`scripts/profile_frame.py` (of `ijrr_css`), the
sequences are the folders that the first has tracked, the arm once more with `--tracked-as arm7`;
`--unweighted` are reports of the first with `--terms` that leave out `foreground` and
`motion_boundaries`. A row is a claim, its section, what was seen, and whether it holds. The papers'
sequences are lost and ours are others of the same kind: a claim is held against what becomes of a
tracker and against the order in which trackers fail, not against a time.

A run has *failed* once it has lost the body, or one limb in the mode nearest to the truth
(`torchcss.studies.evaluation`); a tracker fails where most of its seeds do, and lasts longer than
another where its median time does, and is far better where that is twice as long. A claim for which
no report is given is not tested.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import torch
from common import Table, finish, start

from torchcss.errors import ConfigurationError
from torchcss.io.tracks import read_summary
from torchcss.studies.render.clutter import PILLAR_WIDTH
from torchcss.studies.render.sequences import ARM_STYLE
from torchcss.studies.render.sequences import CLUTTER as CLUTTER_STYLE
from torchcss.studies.sequences import RecordedSequence, read_sequence
from torchcss.types import frozen

ARM, CLUTTER, DARK = "arm", "body-clutter", "body-dark"
ARM7 = "arm tracked as arm7"
"""The same sequence, tracked by the arm of [RR]."""
FAILURES, TABLE1, SCORES = "failure_modes.py", "table1.py", "hypothesis_scores.py"
VARIATIONS = "model_variations.py"
SPECTRA, SLICES, FIRST = "spectra.py", "cost_slices.py", "evaluate_initialise.py"
MINIMA, PROFILE = "cost_minima.py", "profile_frame.py"
MULTIMODAL = 0.1
"""Weight of the other explanations above which a frame counts as multimodal."""
SOME = 0.05
"""Share of the frames above which something happens in some of them."""
MOST_OF = 0.75
"""Share of a turn that a tracker has to follow."""
PILLARS = {ARM: ARM_STYLE.pillar, CLUTTER: CLUTTER_STYLE.pillar}
"""Left side of the pillar, as a share of the picture's width."""
AT_PILLAR = 0.02
"""How far beside the pillar is at it, as such a share: a limb's edge, not its middle, is caught."""


@frozen
class Config:
    """The reports to judge by."""

    failures: tuple[Path, ...] = ()
    """Reports of `scripts/failure_modes.py`, one a sequence."""
    table1: Path | None = None
    """Report of `scripts/table1.py`."""
    unweighted: tuple[Path, ...] = ()
    """The same of edges that nothing weighs."""
    scores: Path | None = None
    """Report of `scripts/hypothesis_scores.py`."""
    variations: tuple[Path, ...] = ()
    """Reports of `scripts/model_variations.py`, of other trackers or sequences."""
    spectra: Path | None = None
    """Report of `scripts/spectra.py`."""
    slices: Path | None = None
    """Report of `scripts/cost_slices.py`."""
    minima: Path | None = None
    """Report of `scripts/cost_minima.py`."""
    first_poses: Path | None = None
    """Report of `scripts/evaluate_initialise.py`."""
    profile: Path | None = None
    """Report of `scripts/profile_frame.py`."""
    sequences: tuple[Path, ...] = ()
    """Folders of the sequences, for how they move in depth and turn."""
    out: Path | None = None
    """JSON file to write."""


class Finding(NamedTuple):
    """What was seen of a claim, and whether it holds."""

    words: str
    holds: bool


class Missing(Exception):
    """What a claim would have to be judged by is not there."""


@dataclass(frozen=True)
class Evidence:
    """What was measured.

    Attributes:
        runs: Runs by sequence and preset.
        unweighted: The same of edges that nothing weighs.
        table1: Rows by method and scale.
        spectra: Runs by what the cost is of.
        scores: Rows by sequence and way to score.
        variations: Rows by sequence, and tracker with its variation.
        slices: What was seen along lines, by frame.
        minima: Rows by body, terms, potential and k.
        first_poses: Rows by variant and condition.
        profile: Milliseconds a frame by stage.
        sequences: What was tracked, by name.
    """

    runs: Mapping[str, Mapping[str, list[dict[str, Any]]]]
    unweighted: Mapping[str, Mapping[str, list[dict[str, Any]]]]
    table1: Mapping[tuple[str, float], Mapping[str, Any]]
    spectra: Mapping[str, list[dict[str, Any]]]
    scores: Mapping[str, Mapping[str, Any]]
    variations: Mapping[str, Mapping[str, Any]]
    slices: Mapping[str, Mapping[str, Any]]
    minima: Mapping[tuple[str, str, str, float], Mapping[str, Any]]
    first_poses: Mapping[tuple[str, str], Mapping[str, Any]]
    profile: Mapping[str, float]
    sequences: Mapping[str, RecordedSequence]

    def of(self, sequence: str, preset: str) -> list[dict[str, Any]]:
        """The runs of a tracker on a sequence."""
        runs = self.runs.get(sequence, {}).get(preset)
        if not runs:
            raise Missing(f"no report of {preset} on {sequence} is given")
        return runs

    def row(self, method: str, scale: float) -> Mapping[str, Any]:
        """A row of Table 1."""
        if (method, scale) not in self.table1:
            raise Missing("no report with this scale is given")
        return self.table1[method, scale]

    def sequence(self, name: str) -> RecordedSequence:
        """A sequence."""
        if name not in self.sequences:
            raise Missing("the sequence is not given")
        return self.sequences[name]


Judge = Callable[[Evidence], Finding]


class Claim(NamedTuple):
    """A claim.

    Attributes:
        words: What is claimed, in our words.
        section: Where.
        script: What tests it.
        judge: What says whether it holds.
    """

    words: str
    section: str
    script: str
    judge: Judge


def by(judge: Callable[..., Finding], *given: Any, **options: Any) -> Judge:
    """A judge that also looks at what is given, such as a sequence and a tracker."""
    return lambda evidence: judge(evidence, *given, **options)


def failed_s(run: Mapping[str, Any]) -> float:
    """When a run has failed; infinite if it never did."""
    times = [run[key] for key in ("lost_s", "limb_lost_of_modes_s") if run[key] is not None]
    return min(times, default=math.inf)


def told(runs: list[dict[str, Any]]) -> str:
    """How many runs failed and when."""
    times = [failed_s(run) for run in runs]
    failed = [time for time in times if math.isfinite(time)]
    until = max(run["per_frame"]["time_s"][-1] for run in runs)
    if not failed:
        return f"none of {len(runs)} within {until:.1f} s"
    middle = f"at {median(failed):.1f} s ({min(failed):.1f} to {max(failed):.1f})"
    return f"{len(failed)} of {len(runs)} within {until:.1f} s, {middle}"


def typical(runs: list[dict[str, Any]], key: str) -> float:
    """Median over runs of one of their numbers."""
    return median(run[key] for run in runs if run[key] is not None)


def fails(evidence: Evidence, sequence: str, preset: str) -> Finding:
    """A tracker fails in most of its runs."""
    runs = evidence.of(sequence, preset)
    return Finding(told(runs), median(map(failed_s, runs)) < math.inf)


def tracks(evidence: Evidence, sequence: str, preset: str) -> Finding:
    """A tracker fails in none of its runs."""
    runs = evidence.of(sequence, preset)
    error = typical(runs, "root_aligned_best_of_modes_mm")
    return Finding(
        f"failed: {told(runs)}; until then {error:.0f} mm in the nearest mode",
        all(math.isinf(failed_s(run)) for run in runs),
    )


def outlasts(
    evidence: Evidence, sequence: str, better: str, worse: str, times: float = 1.0
) -> Finding:
    """A tracker fails later than another, or after so many times as long."""
    one, two = evidence.of(sequence, better), evidence.of(sequence, worse)
    return Finding(
        f"{better}: {told(one)}; {worse}: {told(two)}",
        median(map(failed_s, one)) > times * median(map(failed_s, two)),
    )


def limits_regularise(evidence: Evidence) -> Finding:
    """With joint limits a single mode fails on no sequence earlier than without, on one later."""
    found = [
        outlasts(evidence, sequence, "ijrr_single_limits", "ijrr_robust_single")
        for sequence in (ARM, CLUTTER, DARK)
    ]
    no_earlier = not any(
        outlasts(evidence, sequence, "ijrr_robust_single", "ijrr_single_limits").holds
        for sequence in (ARM, CLUTTER, DARK)
    )
    words = "; ".join(
        f"{sequence}: {one.words}"
        for sequence, one in zip((ARM, CLUTTER, DARK), found, strict=True)
    )
    return Finding(words, no_earlier and any(one.holds for one in found))


Frames = Callable[[RecordedSequence], np.ndarray]
"""In which frames of a sequence something is so."""


def slips_there(evidence: Evidence, sequence: str, preset: str, where: Frames) -> Finding:
    """Until a run fails, its error grows more than twice as fast in some frames as in others."""
    there = where(evidence.sequence(sequence))
    growths = []
    for run in evidence.of(sequence, preset):
        frames = run["per_frame"]
        count = sum(time <= failed_s(run) for time in frames["time_s"])
        growth = np.diff(np.array(frames["root_aligned_mm"][:count], np.float64))
        so = there[frames["frame"][1:count]]
        if so.any() and not so.all():
            growths.append((growth[so].mean(), growth[~so].mean()))
    if not growths:
        raise Missing(f"no run of {preset} has such frames and others before it fails")
    own, other = np.median(growths, axis=0)
    words = f"the error grows by {own:.1f} mm a frame there, by {other:.1f} elsewhere"
    return Finding(f"{words} (of {len(growths)} runs)", bool(own > max(0.0, 2 * other)))


def slips_at_pillar(evidence: Evidence, sequence: str, preset: str) -> Finding:
    """Most runs fail with the joint that is farthest off tracked at the pillar."""
    runs, recorded = evidence.of(sequence, preset), evidence.sequence(sequence)
    left, caught = PILLARS[sequence], 0
    for run, frames, joints in tracked_joints(evidence, sequence, preset):
        times = run["per_frame"]["time_s"]
        if math.isfinite(failed_s(run)):
            at = min(sum(time <= failed_s(run) for time in times), len(frames)) - 1
            columns = [recorded.joint_names.index(name) for name in run["joints"]]
            away = np.linalg.norm(joints[at] - recorded.joints_world[frames[at], columns], axis=-1)
            place = torch.from_numpy(joints[at, away.argmax()])
            share = float(recorded.camera.project(place).uv[0]) / recorded.camera.image_size_wh[0]
            caught += left - AT_PILLAR < share < left + PILLAR_WIDTH + AT_PILLAR
    words = f"{told(runs)}; in {caught} the joint that is farthest off is tracked at the pillar"
    return Finding(words, caught > len(runs) / 2)


def hidden_joints(sequence: RecordedSequence) -> np.ndarray:
    """Which joints are in the picture, and behind a part that is not their own; frames by joints.

    A rendered sequence gives these a confidence, but a low one.
    """
    confidence = sequence.keypoints.confidence.numpy(force=True)
    return (confidence > 0) & (confidence < 1)


def hides_itself(sequence: RecordedSequence) -> np.ndarray:
    """Frames in which a part of the body hides a joint of another."""
    return np.logical_or.reduce(hidden_joints(sequence), axis=1)


def moves_in_depth(sequence: RecordedSequence) -> np.ndarray:
    """The half of the frames in which most of the motion is along the line of sight."""
    depth = depth_share(sequence)
    return np.concatenate([[False], depth > np.median(depth)])


def hidden_attach(evidence: Evidence, preset: str) -> Finding:
    """A hidden joint of a limb is tracked off the silhouette, more often than one in sight.

    On some sequence, in at least a twentieth of its frames, until the body is lost.
    """
    words, holds = [], False
    for sequence in (ARM, CLUTTER, DARK):
        recorded = evidence.sequence(sequence)
        hidden, away = hidden_joints(recorded), ([], [])
        for run, frames, joints in tracked_joints(evidence, sequence, preset):
            for index, name in enumerate(run["joints"]):
                if name.endswith(("_elbow", "_wrist", "_knee", "_ankle")):
                    out = off_silhouette(recorded, frames, joints[:, index])
                    behind = hidden[frames, recorded.keypoints.names.index(name)]
                    away[0].extend(out[~behind])
                    away[1].extend(out[behind])
        if away[0] and away[1]:
            seen, unseen = map(float, map(np.mean, away))
            words.append(f"{sequence}: {100 * unseen:.0f} %, of those in sight {100 * seen:.0f}")
            holds |= unseen > max(SOME, seen)
    if not words:
        raise Missing("no joint of a limb is hidden")
    return Finding(f"hidden joints of limbs off the silhouette, {'; '.join(words)}", holds)


def off_silhouette(sequence: RecordedSequence, frames: list[int], places: np.ndarray) -> np.ndarray:
    """Whether places, metres, one a frame, are seen outside the mask; outside the picture: yes."""
    if sequence.mask is None:
        raise Missing("the sequence has no silhouette")
    width, height = sequence.camera.image_size_wh
    uv = sequence.camera.project(torch.from_numpy(places)).uv.round().long().numpy()
    inside = np.logical_and.reduce((uv >= 0) & (uv < (width, height)), axis=1)
    u, v = np.where(inside[:, None], uv, 0).T
    return ~(inside & sequence.mask[frames, v, u])


def in_depth(evidence: Evidence, sequence: str, preset: str) -> Finding:
    """Until a run fails, errors along the line of sight are more than twice those across it."""
    means = []
    for run in evidence.of(sequence, preset):
        frames = run["per_frame"]
        count = sum(time <= failed_s(run) for time in frames["time_s"])
        means.append([np.mean(frames[key][:count]) for key in ("along_mm", "across_mm")])
    along, across = np.median(means, axis=0)
    return Finding(f"{along:.0f} mm along, {across:.0f} mm across", bool(along > 2 * across))


def share(evidence: Evidence, sequence: str, preset: str, key: str, words: str) -> Finding:
    """Something happens in some of a tracker's frames."""
    value = typical(evidence.of(sequence, preset), key)
    return Finding(f"{words} in {100 * value:.1f} % of the frames", value > 0)


def hits_elbow(evidence: Evidence, sequence: str, preset: str) -> Finding:
    """The elbow is at its bound when the track fails."""
    runs = evidence.of(sequence, preset)
    hits = [_elbow_hit(run) for run in runs]
    least = median(hits)
    words = "never" if math.isinf(least) else f"first at {least:.1f} s"
    return Finding(
        f"elbow at its bound: {words} (median); failed: {told(runs)}",
        median(map(failed_s, runs)) < math.inf and least <= median(map(failed_s, runs)),
    )


def _elbow_hit(run: Mapping[str, Any]) -> float:
    frames = zip(run["per_frame"]["time_s"], run["per_frame"]["at_bound"], strict=True)
    return min(
        (time for time, names in frames if any("elbow" in n for n in names)), default=math.inf
    )


Joints = Mapping[str, np.ndarray]
"""Places in the axes of the camera, (t, 3), by joint."""


def elbow_for_shoulder(evidence: Evidence, sequence: str, preset: str) -> Finding:
    """The upper arm follows less than three quarters of its turn in depth, the elbow errs instead.

    By more than 10 degrees in the median, until the body is lost; the right arm.
    """
    followed, pairs = shares_followed(evidence, sequence, preset, arm_in_depth)
    astray = [float(np.median(np.abs(elbow_angle(a) - elbow_angle(b)))) for a, b in pairs]
    return Finding(
        f"the upper arm follows {100 * followed:.0f} % of its turn in depth, "
        f"the elbow is {median(astray):.0f} degrees off",
        followed < MOST_OF and median(astray) > 10,
    )


def trunk_turns_less(evidence: Evidence, sequence: str, preset: str) -> Finding:
    """The shoulders follow less than three quarters of their turn, until the body is lost."""
    followed, _ = shares_followed(evidence, sequence, preset, heading)
    words = f"the shoulders follow {100 * followed:.0f} % of their turn"
    return Finding(words, followed < MOST_OF)


def shares_followed(
    evidence: Evidence, sequence: str, preset: str, angle: Callable[[Joints], np.ndarray]
) -> tuple[float, list[tuple[Joints, Joints]]]:
    """How much of an angle's change since the first frame is followed, by least squares.

    Returns:
        The median over the runs that lasted until the angle had changed by 10 degrees, and the
        joints of these, as `tracked_and_true` has them.
    """
    shares, pairs = [], []
    for tracked, true in tracked_and_true(evidence, sequence, preset):
        seen, moved = (each - each[0] for each in map(angle, (tracked, true)))
        if np.abs(moved).max() > 10:
            shares.append(float(moved @ seen / (moved @ moved)))
            pairs.append((tracked, true))
    if not pairs:
        raise Missing(f"every run of {preset} is lost before anything turns by 10 degrees")
    return median(shares), pairs


def tracked_and_true(
    evidence: Evidence, sequence: str, preset: str
) -> Iterator[tuple[Joints, Joints]]:
    """Joints of the best mode and true ones, run by run, until the body is lost.

    A joint that no parameter moves, such as the shoulder of an arm, is where it is.
    """
    recorded = evidence.sequence(sequence)
    rotation = recorded.camera.R_camera_world.numpy(force=True)
    for run, frames, held in tracked_joints(evidence, sequence, preset):
        places = recorded.joints_world[frames] @ rotation.T
        true = {name: places[:, i] for i, name in enumerate(recorded.joint_names)}
        turned = held @ rotation.T
        yield true | {name: turned[:, i] for i, name in enumerate(run["joints"])}, true


def tracked_joints(
    evidence: Evidence, sequence: str, preset: str
) -> Iterator[tuple[Mapping[str, Any], list[int], np.ndarray]]:
    """Runs, their frames until the body is lost, and joints of the best mode there, metres."""
    for run in evidence.of(sequence, preset):
        frames = run["per_frame"]
        if "joints_mm" not in frames:
            raise Missing("the report has no joints")
        lost_s = math.inf if run["lost_s"] is None else run["lost_s"]
        count = sum(time <= lost_s for time in frames["time_s"])
        held = np.array(frames["joints_mm"][:count], np.float64) / 1000
        yield run, frames["frame"][:count], held


def arm_in_depth(joints: Joints) -> np.ndarray:
    """Angle between the right upper arm and the plane of the picture, degrees."""
    arm = joints["r_elbow"] - joints["r_shoulder"]
    return np.degrees(np.arcsin(arm[:, 2] / np.linalg.norm(arm, axis=-1)))


def elbow_angle(joints: Joints) -> np.ndarray:
    """How far the right elbow is bent, degrees."""
    arm = joints["r_elbow"] - joints["r_shoulder"]
    forearm = joints["r_wrist"] - joints["r_elbow"]
    lengths = np.linalg.norm(arm, axis=-1) * np.linalg.norm(forearm, axis=-1)
    return np.degrees(np.arccos(np.clip((arm * forearm).sum(-1) / lengths, -1, 1)))


def heading(joints: Joints) -> np.ndarray:
    """Where the line of the shoulders points, seen from above, degrees without jumps."""
    line = joints["l_shoulder"] - joints["r_shoulder"]
    return np.degrees(np.unwrap(np.arctan2(line[:, 2], line[:, 0])))


def multimodal(evidence: Evidence, sequence: str, preset: str) -> Finding:
    """Other explanations weigh in some frames, and more so while the body moves in depth."""
    runs = evidence.of(sequence, preset)
    share_in_depth = depth_share(evidence.sequence(sequence))
    deep, flat = [], []
    for run in runs:
        weight = np.array(run["per_frame"]["apart_weight"], np.float64)[1:]
        depth = share_in_depth[: len(weight)]
        much = depth > np.median(depth)
        deep.append(float(weight[much].mean()))
        flat.append(float(weight[~much].mean()))
    often = multimodal_share(runs)
    return Finding(
        f"weight of other explanations: {median(deep):.2f} in the half of the frames that "
        f"moves most in depth, {median(flat):.2f} in the other; above {MULTIMODAL:g} in "
        f"{100 * often:.0f} % of the frames",
        often > SOME and all(one > two for one, two in zip(deep, flat, strict=True)),
    )


def mostly_multimodal(evidence: Evidence, sequence: str, preset: str) -> Finding:
    """Other explanations weigh in most frames."""
    often = multimodal_share(evidence.of(sequence, preset))
    words = f"other explanations weigh more than {MULTIMODAL:g} in {100 * often:.0f} % of the"
    return Finding(f"{words} frames", often > 0.5)


def multimodal_share(runs: list[dict[str, Any]]) -> float:
    """Share of the frames after the first that are multimodal, the median over runs."""
    weights = (np.array(run["per_frame"]["apart_weight"], np.float64)[1:] for run in runs)
    return median(float((weight > MULTIMODAL).mean()) for weight in weights)


def at_all_scales(
    evidence: Evidence, words: str, better: Callable[[Mapping, Mapping], tuple[str, bool]]
) -> Finding:
    """CSS against SS at scales 1, 4 and 8."""
    told_by_scale, holds = [], True
    for scale in (1.0, 4.0, 8.0):
        seen, so = better(evidence.row("CSS", scale), evidence.row("SS", scale))
        told_by_scale.append(f"{seen} at {scale:g}")
        holds &= so
    return Finding(f"{words}: {', '.join(told_by_scale)}", holds)


def _minima(css: Mapping[str, Any], ss: Mapping[str, Any]) -> tuple[str, bool]:
    return f"{css['minima']:g} to {ss['minima']:g}", css["minima"] > ss["minima"]


def _raw_costs(css: Mapping[str, Any], ss: Mapping[str, Any]) -> tuple[str, bool]:
    return f"{css['cost_raw']:.3g} to {ss['cost_raw']:.3g}", css["cost_raw"] < ss["cost_raw"]


def _shared(_: Mapping[str, Any], ss: Mapping[str, Any]) -> tuple[str, bool]:
    return f"{ss['shared']:g} of {ss['minima']:g}", ss["shared"] >= 0.9 * ss["minima"]


def _descent(css: Mapping[str, Any], _: Mapping[str, Any]) -> tuple[str, bool]:
    raw, end = css["cost_raw"], css["cost"]
    return f"{raw:.3g} to {end:.3g}", end is not None and raw > 10 * end


def _separated(css: Mapping[str, Any], _: Mapping[str, Any]) -> tuple[str, bool]:
    """Half and twice the distance within which two are one change the count by a tenth, or one."""
    half, found, double = counts = css["minima_half"], css["minima"], css["minima_double"]
    return "{:g}, {:g}, {:g}".format(*counts), half - double <= max(1, 0.2 * found)


def _farther(css: Mapping[str, Any], ss: Mapping[str, Any]) -> tuple[str, bool]:
    one, two = css.get("distance"), ss.get("distance")
    if one is None or two is None:
        return "none", True
    return f"{one:.2f} to {two:.2f}", one > two


def _barriers(css: Mapping[str, Any], _: Mapping[str, Any]) -> tuple[str, bool]:
    apart, found = css["valleys"], css["minima"]
    return f"{apart:g} of {found:g}", apart > 0.5 * found


def median_costs(evidence: Evidence) -> Finding:
    """SS's minima cost slightly less than CSS's."""
    css, ss = (evidence.row(method, 8.0)["cost"] for method in ("CSS", "SS"))
    return Finding(f"CSS {css:.3g}, SS {ss:.3g} nats above the start at scale 8", ss < css)


def falls_back(evidence: Evidence) -> Finding:
    """Nearly all samples of the covariance itself descend to where they came from."""
    back = evidence.row("CSS", 1.0)["back"], evidence.row("CSS", 8.0)["back"]
    return Finding(
        f"{100 * back[0]:.1f} % of the samples fall back at scale 1, {100 * back[1]:.1f} % at 8",
        back[0] > 0.9 > back[1],
    )


def edges_suffice(evidence: Evidence) -> Finding:
    """Scored by edges alone, a tracker is as near as the worst scored by the whole cost."""
    words, holds = [], True
    for name, rows in _given(evidence.scores, SCORES).items():
        edges, full = (rows[way]["root_aligned_mm"] for way in ("edges", "full"))
        words.append(
            f"{name}: rank correlation {rows['edges']['rank_correlation']:.2f}, error "
            f"{edges[0]:.0f} mm, by the whole cost {full[0]:.0f}"
        )
        holds &= edges[0] <= full[2]
    return Finding("; ".join(words), holds)


def pattern_helps(evidence: Evidence) -> Finding:
    """With the pattern the best mode is nearer than with any seed's random hypotheses."""
    words, holds = [], True
    for name, rows in _given(evidence.scores, SCORES).items():
        pattern, drawn = (rows[way]["root_aligned_mm"] for way in ("edges", "random"))
        words.append(f"{name}: {pattern[0]:.0f} mm, as many at random {_range(drawn)}")
        holds &= pattern[0] < drawn[1]
    return Finding("; ".join(words), holds)


def _range(numbers: list[float]) -> str:
    middle, least, most = numbers
    return f"{middle:.0f} ({least:.0f} to {most:.0f})"


def varied(evidence: Evidence, preset: str, change: str, *, better: bool) -> Finding:
    """A variation's modes are nearer, or farther, on every sequence than those of any seed without.

    Judged is the nearest mode.
    """
    words, holds = [], True
    for name, (plain, other) in _pairs(evidence, preset, change).items():
        before, after = (row["root_aligned_best_of_modes_mm"] for row in (plain, other))
        words.append(f"{name}: {before[0]:.0f} mm ({before[1]:.0f} to {before[2]:.0f}), ")
        words[-1] += f"{change} {_range(after)}"
        holds &= after[0] < before[1] if better else after[0] > before[2]
    return Finding(f"{preset}, {'; '.join(words)}", holds)


def tolerated(evidence: Evidence, preset: str, *changes: str) -> Finding:
    """No more seeds lose the body or a limb than without the changes."""
    words, holds = [], True
    for change in changes:
        for name, pair in _pairs(evidence, preset, change).items():
            before, after = map(_all_held, pair)
            words.append(f"{change}, {name}: {_told_held(after)}, else {_told_held(before)}")
            holds &= after or not before
    return Finding(f"{preset}, {'; '.join(words)}", holds)


def _all_held(row: Mapping[str, Any]) -> bool:
    """Whether no seed has lost the body, and most no limb."""
    return row["lost"] == 0 and row["limb_lost_of_modes_s"][0] is None


def _told_held(held: bool) -> str:
    return "held" if held else "lost"


def _pairs(
    evidence: Evidence, preset: str, change: str
) -> dict[str, tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """A tracker's rows as it is and with a change, by sequence."""
    names = f"{preset}: as it is", f"{preset}: {change}"
    found = {
        sequence: (rows[names[0]], rows[names[1]])
        for sequence, rows in _given(evidence.variations, VARIATIONS).items()
        if set(names) <= set(rows)
    }
    if not found:
        raise Missing(f"no run of {preset}, {change}, is given")
    return found


def weights_help(evidence: Evidence) -> Finding:
    """With weighed edges every tracker has less error on every sequence than any seed without."""
    words, holds = [], True
    for sequence, presets in evidence.unweighted.items():
        for preset, without in presets.items():
            less = typical(evidence.of(sequence, preset), "root_aligned_mm")
            errors = [run["root_aligned_mm"] for run in without]
            words.append(
                f"{preset}, {sequence}: {less:.0f} mm, "
                f"without {_range([median(errors), min(errors), max(errors)])}"
            )
            holds &= less < min(errors)
    if not words:
        raise Missing("no report without weights is given")
    return Finding("; ".join(words), holds)


def spectrum_of(evidence: Evidence, bodies: tuple[str, ...], key: str, least: float) -> Finding:
    """Spectra of all costs of these bodies have at least a number."""
    seen = {
        of: median(run[key] for run in runs)
        for of, runs in _given(evidence.spectra, SPECTRA).items()
        if runs[0]["body"] in bodies
    }
    words = "; ".join(f"{value:.0f} ({of})" for of, value in seen.items())
    return Finding(words, bool(seen) and min(seen.values()) >= least)


def _given(rows: Mapping[Any, Any], script: str) -> Mapping[Any, Any]:
    """The rows of a report, if there is one."""
    if not rows:
        raise Missing(f"no report of {script} is given")
    return rows


def slope_at_limit(evidence: Evidence) -> Finding:
    """In some frame the cost has a slope at a minimum that a joint limit holds."""
    found = {
        name: f"{name}: {frame['displaced_minimum']['line']}, "
        f"{abs(frame['displaced_minimum']['slope_nats_per_radian']):.0f} nats per radian"
        for name, frame in _given(evidence.slices, SLICES).items()
        if frame["displaced_minimum"] is not None
    }
    return Finding("; ".join(found.values()) or "no minimum at a limit was found", bool(found))


def several_minima(evidence: Evidence) -> Finding:
    """Along the least certain direction every frame of the papers' times has several minima."""
    words, holds = [], True
    for name, frame in _given(evidence.slices, SLICES).items():
        if name.startswith(CLUTTER):
            found = [row for row in frame["slices"] if row["line"] == "eigen 0"]
            count = max(row["terms"]["sum"]["num_minima"] for row in found)
            words.append(f"{name}: {count}")
            holds &= count > 1
    if not words:
        raise Missing("no frame of the body before clutter is given")
    return Finding(f"minima along the least certain direction, {'; '.join(words)}", holds)


def few_minima(evidence: Evidence, scale: str, most: float) -> Finding:
    """In no frame more minima a line, in the mean, than so many."""
    counts = {
        name: row["num_minima"]
        for name, frame in _given(evidence.slices, SLICES).items()
        for row in frame["table"]
        if (row["term"], row["scale"]) == ("sum", scale)
    }
    words = "; ".join(f"{name}: {count:.1f}" for name, count in counts.items())
    return Finding(f"minima a line, {words}", max(counts.values()) <= most)


def smooth(evidence: Evidence) -> Finding:
    """On no line the cost jumps by more than a hundredth of its range."""
    jumps = {
        name: max(row["discontinuity"] for row in frame["table"] if row["term"] == "sum")
        for name, frame in _given(evidence.slices, SLICES).items()
    }
    words = "; ".join(f"{name}: {100 * jump:.0f} %" for name, jump in jumps.items())
    return Finding(f"largest jump, of the range of its line, {words}", max(jumps.values()) <= 0.01)


def times_as_long(evidence: Evidence, preset: str, arm: str, least: float) -> Finding:
    """A frame of a body takes so many times as long as one of an arm."""
    one, two = (
        typical(evidence.of(sequence, preset), "search_s_per_frame") for sequence in (CLUTTER, arm)
    )
    return Finding(f"{preset}: {one / two:.1f} times", one / two >= least)


def most_for_cost(evidence: Evidence) -> Finding:
    """More than half of a frame's time is spent in evaluations of the cost."""
    stages = _given(evidence.profile, PROFILE)
    share_of_cost = stages["evaluations"] / stages["all"]
    return Finding(f"{100 * share_of_cost:.0f} % of a frame", share_of_cost > 0.5)


def fewer_spurious(
    evidence: Evidence, better: tuple[str, float], than: tuple[str, float]
) -> Finding:
    """A potential and k leave fewer spurious minima, paired by frame, by two standard errors."""
    words, holds = [], True
    for body in dict.fromkeys(key[0] for key in _given(evidence.minima, MINIMA)):
        first, second = (
            np.array(list(evidence.minima[body, "contour", *each]["fewer_by_frame"].values()))
            for each in (better, than)
        )
        fewer = first - second
        gain, error = fewer.mean(), fewer.std() / max(len(fewer) - 1, 1) ** 0.5
        words.append(f"{body}: {gain:.1f} fewer a line (standard error {error:.1f})")
        holds &= bool(gain > 2 * error)
    return Finding("; ".join(words), holds)


def steadier(evidence: Evidence, variant: str, than: str) -> Finding:
    """Without a constraint the cheapest first poses are worse in all conditions."""
    rows = evidence.first_poses
    seen = {
        condition: (rows[than, condition]["pa_best_mm"], row["pa_best_mm"])
        for (other, condition), row in rows.items()
        if other == variant and (than, condition) in rows
    }
    if not seen:
        raise Missing(f"no report of {FIRST} {variant} is given")
    words = "; ".join(f"{name}: {a:.0f} mm, {variant} {b:.0f}" for name, (a, b) in seen.items())
    return Finding(words, all(a < b for a, b in seen.values()))


def untested(_: Evidence, why: str) -> Finding:
    """A claim that no study of ours can judge."""
    raise Missing(why)


FULL_BODIES = ("body30", "body32", "body34")

CLAIMS: tuple[Claim, ...] = (
    Claim("Gaussian single mode slips off at the pillar (0.5 s and 2.2 s, arm)",
          "[IJRR] 6.1, [RR] 6",
          FAILURES, by(slips_at_pillar, ARM, "ijrr_gaussian_single")),
    Claim("Gaussian single mode slips off at the pillar (0.3 s, body)", "[IJRR] 6.1",
          FAILURES, by(slips_at_pillar, CLUTTER, "ijrr_gaussian_single")),
    Claim("a Gaussian single mode follows motion across the picture, and slips in depth (arm)",
          "[IJRR] 6.1", FAILURES, by(slips_there, ARM, "ijrr_gaussian_single", moves_in_depth)),
    Claim("a Gaussian single mode cannot follow motion in depth (arm)", "[IJRR] 6.1",
          FAILURES, by(in_depth, ARM, "ijrr_gaussian_single")),
    Claim("a Gaussian single mode cannot follow motion in depth (body)", "[IJRR] 6.1",
          FAILURES, by(in_depth, CLUTTER, "ijrr_gaussian_single")),
    Claim("one hypothesis with Gaussian errors has trouble where the arm hides itself", "[RR] 6",
          FAILURES, by(slips_there, ARM, "ijrr_gaussian_single", hides_itself)),
    Claim("a robust single mode follows motion across the picture, and slips in depth (arm)",
          "[IJRR] 6.1", FAILURES, by(slips_there, ARM, "ijrr_robust_single", moves_in_depth)),
    Claim("a robust single mode takes motion in depth for motion in the image (arm)", "[IJRR] 6.1",
          FAILURES, by(in_depth, ARM, "ijrr_robust_single")),
    Claim("a robust single mode takes motion in depth for motion in the image (body)", "[IJRR] 6.1",
          FAILURES, by(in_depth, CLUTTER, "ijrr_robust_single")),
    Claim("a single mode runs into the elbow's bound and fails (2.6 s)", "[IJRR] 6.1",
          FAILURES, by(hits_elbow, ARM, "ijrr_single_limits")),
    Claim("a single mode takes a turn of the shoulder for one of the elbow", "[IJRR] 6.1",
          FAILURES, by(elbow_for_shoulder, ARM, "ijrr_single_limits")),
    Claim("a single mode underestimates how far the trunk turns", "[IJRR] 6.1",
          FAILURES, by(trunk_turns_less, CLUTTER, "ijrr_single_limits")),
    Claim("with limits alone the fist ends up in the body", "[IJRR] 6.1", FAILURES,
          by(share, CLUTTER, "ijrr_single_limits", "deep_share",
             "a part more than 2 cm in another")),
    Claim("CSS with three modes tracks the arm without failure", "[IJRR] 6.1",
          FAILURES, by(tracks, ARM, "ijrr_css")),
    Claim("CSS with seven modes tracks the body without failure", "[IJRR] 6.1",
          FAILURES, by(tracks, CLUTTER, "ijrr_css")),
    Claim("several modes appear mainly while the arm moves in depth", "[IJRR] 6.1",
          FAILURES, by(multimodal, ARM, "ijrr_css")),
    Claim("several modes appear over nearly the whole motion of the body", "[IJRR] 6.1, [RR] 6",
          FAILURES, by(mostly_multimodal, CLUTTER, "ijrr_css")),
    Claim("its modes are the pivoting and what would look like it across the picture",
          "[IJRR] 6.1", FAILURES, by(untested, "reports keep the joints of the best mode alone")),
    Claim("least squares often converge to poses that no body can take", "[IJRR] 6.1", FAILURES,
          by(share, CLUTTER, "ijrr_cham_rehg_ssd", "outside_share", "a joint beyond its limit")),
    Claim("noise of the dynamics with least squares loses the body (0.5 s)", "[IJRR] 6.1",
          FAILURES, by(fails, CLUTTER, "ijrr_cham_rehg_ssd")),
    Claim("with robust costs it lasts longer", "[IJRR] 6.1",
          FAILURES, by(outlasts, CLUTTER, "ijrr_cham_rehg", "ijrr_cham_rehg_ssd")),
    Claim("and is lost, too (0.7 s)", "[IJRR] 6.1", FAILURES, by(fails, CLUTTER, "ijrr_cham_rehg")),
    Claim("CONDENSATION has the same fault", "[IJRR] 6.1",
          FAILURES, by(fails, CLUTTER, "ijrr_condensation")),
    Claim("noise wide enough in depth puts most samples where the cost is high", "[IJRR] 6.1, 9",
          TABLE1, by(at_all_scales, "median cost of raw samples, CSS to a ball", _raw_costs)),
    Claim("Gaussian single mode loses the body in the dark (0.5 s)", "[IJRR] 6.2",
          FAILURES, by(fails, DARK, "ijrr_gaussian_single")),
    Claim("and follows motion across the picture there, and slips in depth", "[IJRR] 6.2",
          FAILURES, by(slips_there, DARK, "ijrr_gaussian_single", moves_in_depth)),
    Claim("a robust single mode follows longer (1 s)", "[IJRR] 6.2",
          FAILURES, by(outlasts, DARK, "ijrr_robust_single", "ijrr_gaussian_single")),
    Claim("and misjudges the depth", "[IJRR] 6.2",
          FAILURES, by(in_depth, DARK, "ijrr_robust_single")),
    Claim("and is lost in the turn", "[IJRR] 6.2", FAILURES, by(fails, DARK, "ijrr_robust_single")),
    Claim("several modes with limits alone converge to impossible poses at times", "[IJRR] 6.2",
          FAILURES,
          by(share, DARK, "ijrr_css_limits", "deep_modes_share", "parts in parts, of all modes")),
    Claim("with terminal consequences", "[IJRR] 6.2", FAILURES, by(fails, DARK, "ijrr_css_limits")),
    Claim("CSS with all constraints tracks the whole sequence", "[IJRR] 6.2",
          FAILURES, by(tracks, DARK, "ijrr_css")),
    Claim("clavicles are essential for many motions of the arms", "[IJRR] 6.2",
          VARIATIONS, by(varied, "css", "clavicles at rest", better=False)),
    Claim("CSS finds more minima than a ball of the same volume", "[IJRR] 4.2, 7",
          TABLE1, by(at_all_scales, "CSS to SS", _minima)),
    Claim("CSS finds the few minima that SS finds", "[IJRR] 7",
          TABLE1, by(at_all_scales, "found by both", _shared)),
    Claim("and many that are farther away", "[IJRR] 7",
          TABLE1, by(at_all_scales, "median distance of minima, CSS to SS", _farther)),
    Claim("minima are separated by barriers of cost", "[IJRR] 4.2",
          TABLE1, by(at_all_scales, "minima of CSS without a low path to another", _barriers)),
    Claim("SS's minima cost slightly less at the median", "[IJRR] 7", TABLE1, median_costs),
    Claim("descent lowers the cost of samples by far", "[IJRR] 7",
          TABLE1, by(at_all_scales, "medians of raw samples to minima, CSS", _descent)),
    Claim("samples at the scale of the covariance fall back into the same minimum", "[IJRR] 4.2",
          TABLE1, falls_back),
    Claim("largest over smallest deviation is 350 for an arm (a third of it at least)",
          "[IJRR] Fig. 5", SPECTRA, by(spectrum_of, ("arm8",), "ratio", 350 / 3)),
    Claim("largest over smallest deviation is 2000 for a body (a third of it at least)",
          "[IJRR] Fig. 5", SPECTRA, by(spectrum_of, FULL_BODIES, "ratio", 2000 / 3)),
    Claim("noise alike in all directions fills 10^54 times the volume (two thirds of the power)",
          "[IJRR] 1.1", SPECTRA, by(spectrum_of, FULL_BODIES, "volume", 36)),
    Claim("a joint limit displaces the minimum", "[IJRR] 4.1, [RR] 4.1", SLICES, slope_at_limit),
    Claim("joint limits regularise tracking", "[RR] 4.1", FAILURES, limits_regularise),
    Claim("the cost is smooth but for where a limit is reached", "[IJRR] 4.2", SLICES, smooth),
    Claim("second minima: both edges of a limb on one edge, or motion in depth misread",
          "[IJRR] 4.2", SLICES, by(untested, "minima are counted, whatever their matches are")),
    Claim("a hidden node that costs a little more than a fitted one gives good results",
          "[IJRR] 3.1.1", VARIATIONS, by(untested, "no study varies what a hidden node costs")),
    Claim("several minima along uncertain directions at 0.8 and 0.9 s",
          "[IJRR] Fig. 7, [RR] Fig. 5", SLICES, several_minima),
    Claim("close to a mode the cost usually has a single peak", "[RR] 4.2",
          SLICES, by(few_minima, "close", 1.5)),
    Claim("at large scale there are few spurious minima", "[IJRR] Fig. 8, [RR] 4.2",
          SLICES, by(few_minima, "far", 3)),
    Claim("CSS is far better than noise of the dynamics (body before clutter)", "[IJRR] 9",
          FAILURES, by(outlasts, CLUTTER, "ijrr_css", "ijrr_cham_rehg", times=2)),
    Claim("CSS is far better than noise of the dynamics (body in the dark)", "[IJRR] 9",
          FAILURES, by(outlasts, DARK, "ijrr_css", "ijrr_cham_rehg", times=2)),
    Claim("weighing contours by foreground and motion boundaries improves much", "[IJRR] 8",
          FAILURES, weights_help),
    Claim("stabilisers hold what is hard to estimate", "[IJRR] 3.2.2, 6.2",
          VARIATIONS, by(varied, "css", "no stabilisers", better=False)),
    Claim("more modes and samples follow what was lost", "[IJRR] 8",
          VARIATIONS, by(varied, "ijrr_css", "three times", better=True)),
    Claim("three hypotheses track the arm over the whole sequence", "[RR] 6",
          FAILURES, by(tracks, ARM7, "rr_multiple_hypothesis")),
    Claim("seven hypotheses track the body over the whole sequence", "[RR] 6",
          FAILURES, by(tracks, CLUTTER, "rr_multiple_hypothesis")),
    Claim("edges alone are enough to score hypotheses", "[RR] 4.2", SCORES, edges_suffice),
    Claim("a pattern along uncertain directions finds more than as many hypotheses at random",
          "[RR] 4.2", SCORES, pattern_helps),
    Claim("motion boundaries tell the arm from the pillar", "[RR] 3.2, 6", VARIATIONS,
          by(varied, "rr_multiple_hypothesis", "no motion boundaries", better=False)),
    Claim("an imperfect model of the arm is tolerated", "[RR] 6, [IJRR] 6.1", VARIATIONS,
          by(tolerated, "rr_multiple_hypothesis", "long arms", "short arms")),
    Claim("robust errors leave fewer spurious minima than least squares", "[IJRR] 3.1, [RR] 3",
          MINIMA, by(fewer_spurious, ("Lorentzian", 0.0), ("quadratic", 0.0))),
    Claim("motion boundaries with k of 0.2 to 0.4 work: fewer still with 0.3", "[IJRR] 3.1.2",
          MINIMA, by(fewer_spurious, ("Lorentzian", 0.3), ("Lorentzian", 0.0))),
    Claim("minima are either far apart or one", "[IJRR] 3.3, note 11", TABLE1,
          by(at_all_scales, "those of CSS within 0.5, 1, 2 deviations counted as one", _separated)),
    Claim("limbs that are hidden are sampled broadly", "[IJRR] 8",
          FAILURES, by(untested, "reports keep no widths of single limbs")),
    Claim("and may attach to clutter", "[IJRR] 8",
          FAILURES, by(hidden_attach, "ijrr_css")),
    Claim("some directions stay uncertain after the first fit (a hundredth as sure as others)",
          "[IJRR] 5", SPECTRA,
          by(spectrum_of, FULL_BODIES, "ratio", 100)),
    Claim("joint limits make the first pose more stable", "[IJRR] 5, [RR] 5",
          FIRST, by(steadier, "without limits", "full")),
    Claim("so do prior lengths", "[IJRR] 5, [RR] 5",
          FIRST, by(steadier, "no prior on lengths", "full")),
    Claim("so does that left and right are equal", "[IJRR] 5, [RR] 5",
          FIRST, by(steadier, "sides free", "sides equal")),
    Claim("a body takes 24 times as long as an arm (a third of it at least; 4 minutes to 10 s)",
          "[RR] 6", FAILURES, by(times_as_long, "rr_multiple_hypothesis", ARM7, 24 / 3)),
    Claim("a body takes 36 times as long as an arm (a third of it at least; 180 to 5 s)",
          "[IJRR] 6", FAILURES, by(times_as_long, "ijrr_css", ARM, 36 / 3)),
    Claim("most of the time goes into evaluations of the cost", "[IJRR] 6, [RR] 6",
          PROFILE, most_for_cost),
)  # fmt: skip
"""All of them, in the papers' order."""


def main(config: Config) -> dict[str, Any]:
    """Judge, print, write; return what is written."""
    evidence = read_evidence(config)
    cells = []
    for claim in CLAIMS:
        seen, verdict = judged(claim, evidence)
        cells.append([claim.words, claim.section, f"scripts/{claim.script}", seen, verdict])
    table = Table("The papers' claims", ("claim", "section", "script", "seen", "verdict"), cells)
    counts = {verdict: sum(row[-1] == verdict for row in cells) for *_, verdict in cells}
    report = {"counts": counts, "reports": [str(path.name) for path in config.failures]}
    return finish(config.out, report, table) | {"rows": cells}


def judged(claim: Claim, evidence: Evidence) -> tuple[str, str]:
    """What was seen of a claim, and the verdict."""
    try:
        seen = claim.judge(evidence)
    except Missing as why:
        return f"because {why}", "not tested"
    return seen.words, "holds" if seen.holds else "does not hold"


def read_evidence(config: Config) -> Evidence:
    """What the reports and sequences say."""
    runs, unweighted = map(read_runs, (config.failures, config.unweighted))
    rows = {}
    if config.table1 is not None:
        report = read_summary(config.table1)
        if "median" not in report:
            raise ConfigurationError(f"{config.table1}: expected a report of {TABLE1}")
        rows = {(row["method"], row["scale"]): row for row in report["median"]}
    variations: dict[str, dict[str, Any]] = {}
    for path in config.variations:
        for sequence, own in rows_of(path, VARIATIONS).items():
            variations.setdefault(sequence, {}).update(own)
    first = rows_of(config.first_poses, FIRST, "rows") or ()
    minima = rows_of(config.minima, MINIMA, "rows") or ()
    of = ("body", "terms", "potential", "k")
    return Evidence(
        runs=runs,
        unweighted=unweighted,
        table1=rows,
        spectra=rows_of(config.spectra, SPECTRA),
        scores=rows_of(config.scores, SCORES),
        variations=variations,
        slices=rows_of(config.slices, SLICES, "frames"),
        minima={tuple(row[name] for name in of): row for row in minima},
        first_poses={(row["variant"], row["condition"]): row for row in first},
        profile={name: own for name, own, *_ in rows_of(config.profile, PROFILE, "rows") or ()},
        sequences={each.name: each for each in map(read_sequence, config.sequences)},
    )


def rows_of(path: Path | None, script: str, name: str = "by_sequence") -> Any:
    """The rows of a report, by sequence or under another name; none without one."""
    if path is None:
        return {}
    rows = read_summary(path).get(name, {})
    if not rows:
        raise ConfigurationError(f"{path}: expected a report of {script}")
    return rows


def read_runs(paths: tuple[Path, ...]) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """The runs of some reports, by sequence and preset."""
    runs: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for path in paths:
        report = read_summary(path)
        if "study" not in report:
            raise ConfigurationError(f"{path}: expected a report of {FAILURES}")
        study = report["study"]
        as_arm7 = study["sequence"] == ARM and study["body"] == "arm7"
        own = runs.setdefault(ARM7 if as_arm7 else study["sequence"], {})
        for run in report["runs"]:
            if "num_frames" in run:
                own.setdefault(run["preset"], []).append(run)
    return runs


def depth_share(sequence: RecordedSequence) -> np.ndarray:
    """Share of the joints' speed along the line of sight, frame by frame from the second."""
    step = np.diff(sequence.joints_world, axis=0)
    axis = sequence.camera.R_camera_world[2].numpy(force=True)
    along, whole = np.abs(step @ axis), np.linalg.norm(step, axis=-1)
    return along.sum(-1) / np.maximum(whole.sum(-1), 1e-9)


if __name__ == "__main__":
    start(main, Config, __doc__)

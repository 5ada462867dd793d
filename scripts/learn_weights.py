"""Learn how much each term of the cost should weigh, from a sequence whose truth is known.

    python scripts/learn_weights.py --train demo:0 --test demo:1 --out J
    python scripts/learn_weights.py --train demo:0 --test DIR

From noisy copies of the true pose before each frame, the optimiser descends on the frame's cost;
the loss is how far the joints of the minimum are from the truth, in the mean. The minimum is a
differentiable function of the weights (`torchcss.inference.implicit`), so that gradient descent on
their logarithms lowers the loss. The test sequence is measured before and after in the same way,
and tracked from end to end with either set of weights.

A sequence is `demo:SEED`, the arm of `torchcss demo` in a room of its own, or a folder with truth
(`scripts/make_sequence.py`). Keypoints are not used, but for the first pose of the track.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from torchcss.body.model import BodyModel
from torchcss.cost.frame import FrameCosts
from torchcss.cost.total import TrackingCost
from torchcss.errors import ConfigurationError, TorchcssError
from torchcss.inference.implicit import TermWeights, weighted_minimum
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.io.sequences import read_sequence
from torchcss.io.tracks import prepare_output_folder, write_summary
from torchcss.io.video import Frame, VideoReader
from torchcss.pipeline import track_frames
from torchcss.settings import (
    Settings,
    boundary_emphasis,
    make_choice,
    make_extractor,
    make_settings_tracker,
)
from torchcss.synthetic import arm_sequence
from torchcss.vision.camera import Camera

LEARNT = ("contour", "region", "flow", "stabiliser", "temporal", "interpenetration")
OPTIMISER = TrustRegionNewton(max_steps=30, tolerance=1e-6)


@dataclass(frozen=True, kw_only=True)
class Config:
    """What to learn from, and how long."""

    train: str = "demo:0"
    """Sequence to learn from."""
    test: str = "demo:1"
    """Sequence to measure on."""
    frames: int = 50
    """Frames of each, from the start."""
    starts: int = 4
    """Noisy starts per frame."""
    noise: float = 1.0
    """Their deviation, in multiples of the everyday motion of one frame."""
    epochs: int = 8
    """Passes over the training sequence."""
    rate: float = 0.1
    """Step on the logarithms of the weights (Adam)."""
    begin: dict[str, float] | None = None
    """Weights to begin with by term; by default those of the tracker, which count as one."""
    working_size: int = 320
    """Longer side of the pictures."""
    seed: int = 0
    """Seed of the noise and of the order of the frames."""
    track: bool = True
    """Track the test sequence with the weights before and after."""
    out: Path | None = None
    """JSON file to write."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """A sequence with true states.

    Attributes:
        body: The body on its base.
        camera: Camera of the full-size images.
        images: The frames.
        states: State of every frame.
        interval: Seconds between frames.
    """

    body: BodyModel
    camera: Camera
    images: list[np.ndarray]
    states: Float[Tensor, "t n"]
    interval: float


def main(config: Config) -> dict[str, Any]:
    """Learn, measure, print, write; return what is written."""
    settings = Settings(body="arm8", keypoints_use="first", working_size=config.working_size)
    generator = torch.Generator().manual_seed(config.seed)
    train, test = (load(name, config.frames) for name in (config.train, config.test))
    settings = replace(settings, body=train.body.name)
    if test.body.name != train.body.name:
        raise ConfigurationError(
            f"{config.test}: has {test.body.name}, {config.train} has {train.body.name}; the "
            "weights of one body say little of another"
        )
    weights = TermWeights(LEARNT, config.begin)
    before = weights.factors()
    tests = list(steps(test, settings, config, generator))
    report: dict[str, Any] = {
        "train": config.train,
        "test": config.test,
        "weights_before": before,
        "test_before_mm": mean_error(tests, weights),
    }
    lessons = list(steps(train, settings, config, generator))
    report["train_mm"] = learn(weights, lessons, config, generator)
    report["weights_after"] = weights.factors()
    report["test_after_mm"] = mean_error(tests, weights)
    if config.track:
        for when, factors in (("before", before), ("after", weights.factors())):
            report[f"track_{when}_mm"] = tracked_error(test, settings, factors, config.seed)
    print_report(report)
    if config.out is not None:
        prepare_output_folder(config.out.parent)
        write_summary(config.out, report)
    return report


def load(name: str, num_frames: int) -> Truth:
    """A sequence by its name."""
    kind, _, seed = name.partition(":")
    if kind == "demo" and seed.isdigit():
        demo = arm_sequence(
            generator=torch.Generator().manual_seed(int(seed)), num_frames=num_frames
        )
        return Truth(
            body=demo.body, camera=demo.camera, images=list(demo.frames), states=demo.states,
            interval=1 / demo.frame_rate,
        )  # fmt: skip
    sequence = read_sequence(Path(name))
    if sequence.truth is None:
        raise ConfigurationError(f"{name}: has no true states; expected demo:SEED or such a folder")
    images = [frame.image for frame in VideoReader(sequence.video, stop=num_frames)]
    return Truth(
        body=sequence.truth.body, camera=sequence.camera, images=images,
        states=sequence.truth.states[: len(images)], interval=1 / sequence.frame_rate,
    )  # fmt: skip


Step = tuple[TrackingCost, Float[Tensor, "s n"], Float[Tensor, "j 3"]]
"""A frame's cost for some samples, where these start, and the true joints."""


def steps(
    truth: Truth, settings: Settings, config: Config, generator: torch.Generator
) -> Iterator[Step]:
    """Every frame but the first, with starts about the truth before it."""
    extractor, body = make_extractor(settings), truth.body
    costs = FrameCosts(
        body, extractor.working_camera(truth.camera), make_choice(settings, 1.0),
        frame_interval=truth.interval, boundary_emphasis=boundary_emphasis(settings),
    )  # fmt: skip
    appearance, last = None, None
    deviation = config.noise * body.motion_rate * truth.interval
    size = (config.starts, body.num_parameters)
    for index, image in enumerate(tqdm(truth.images, unit="frame", desc="features")):
        features = extractor(image, last)
        if last is not None:
            noise = torch.randn(size, generator=generator, dtype=torch.float64)
            start = body.bounds.project(truth.states[index - 1] + deviation * noise)
            like = torch.eye(len(deviation)).to(start).expand(len(start), -1, -1)
            prior = GaussianMixture(start, like, start.new_zeros(len(start)))
            cost = costs(features, body=body, before=start, appearance=appearance)
            cost = cost.of_children(torch.arange(len(start)), prior)
            yield cost, start, body.pose(truth.states[index]).joints
        appearance = costs.learn(appearance, features, body, truth.states[index])
        last = image


def loss_of(step: Step, weights: TermWeights) -> Tensor:
    """Mean distance of the joints from the truth at the minima, metres."""
    cost, start, joints = step
    x = weighted_minimum(cost, weights, start, cost.body.bounds, optimiser=OPTIMISER)
    away = cost.body.pose(x).joints - joints
    return (away.square().sum(-1) + 1e-8).sqrt().mean()


def mean_error(steps: list[Step], weights: TermWeights) -> float:
    """Mean loss, millimetres."""
    with torch.no_grad():
        return 1000 * float(torch.stack([loss_of(step, weights) for step in steps]).mean())


def learn(
    weights: TermWeights, steps: list[Step], config: Config, generator: torch.Generator
) -> list[float]:
    """Gradient descent on the weights, frame by frame; the mean loss of every epoch in mm."""
    descent = torch.optim.Adam(weights.parameters(), lr=config.rate)
    history = []
    for _ in tqdm(range(config.epochs), unit="epoch"):
        losses = []
        for index in torch.randperm(len(steps), generator=generator).tolist():
            descent.zero_grad()
            loss = loss_of(steps[index], weights)
            loss.backward()
            descent.step()
            losses.append(1000 * float(loss.detach()))
        history.append(float(np.mean(losses)))
    return history


def tracked_error(
    truth: Truth, settings: Settings, weights: Mapping[str, float], seed: int
) -> dict[str, float]:
    """Mean error of a whole track from the true first pose, of the best mode and of all, mm."""
    settings = replace(settings, weights=dict(weights))
    n = truth.body.num_parameters
    first = GaussianMixture(
        truth.states[:1], 0.01 * torch.eye(n).double()[None], torch.zeros(1).double()
    )
    best, of_modes = [], []
    frames = (Frame(i, i * truth.interval, image) for i, image in enumerate(truth.images))
    for frame in track_frames(
        tqdm(frames, total=len(truth.images), unit="frame"), body=truth.body, mixture=first,
        camera=truth.camera, extractor=make_extractor(settings),
        tracker=make_settings_tracker(settings, truth.body.motion_rate * truth.interval),
        choice=make_choice(settings, 1.0), observe=lambda index: None,
        frame_interval=truth.interval, generator=torch.Generator().manual_seed(seed),
        boundary_emphasis=boundary_emphasis(settings),
    ):  # fmt: skip
        joints = truth.body.pose(truth.states[frame.frame.index]).joints
        error = (frame.joints_world - joints).norm(dim=-1).mean(-1)
        best.append(1000 * float(error[0]))
        of_modes.append(1000 * float(error.min()))
    return {"best_mode": float(np.mean(best)), "best_of_modes": float(np.mean(of_modes))}


def print_report(report: dict[str, Any]) -> None:
    """The weights, and what they do."""
    print(f"{'term':>18}{'before':>10}{'after':>10}")
    for name, before in report["weights_before"].items():
        print(f"{name:>18}{before:10.3f}{report['weights_after'][name]:10.3f}")
    history = report["train_mm"]
    print(f"one step, train: {history[0]:.1f} mm in the first epoch, {history[-1]:.1f} in the last")
    print(f"one step, test: {report['test_before_mm']:.1f} -> {report['test_after_mm']:.1f} mm")
    if "track_after_mm" in report:
        for kind in ("best_mode", "best_of_modes"):
            before, after = (report[f"track_{when}_mm"][kind] for when in ("before", "after"))
            print(f"whole track, test, {kind.replace('_', ' ')}: {before:.1f} -> {after:.1f} mm")


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, description=__doc__))
    except TorchcssError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)

"""Learn how much each term of the cost should weigh, from a sequence whose truth is known.

    python scripts/learn_weights.py --train demo:0 --test demo:1 --out J
    python scripts/learn_weights.py --train demo:0 --test DIR --begin contour 0.1 region 0.1

A few single modes are tracked through the sequence, each from noise about the true first pose: in
every frame the optimiser descends on the cost from where the mode was and is going. The loss is how
far the joints of the minimum are from the truth, in the mean. The minimum is a differentiable
function of the weights (`torchcss.inference.implicit`), so that gradient descent on their
logarithms lowers the loss; what came before a frame counts as given. A mode that has lost the body
starts anew at the truth. The test sequence is measured before and after in the same way, and
tracked from end to end by the multiple-mode tracker with either set of weights.

A sequence is `demo:SEED`, the arm of `torchcss demo` in a room of its own, or a folder with truth
(`scripts/make_sequence.py`). Keypoints are not used, but for the first pose of the track.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import Table, finish, start
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from torchcss.cli.options import SettingsOptions
from torchcss.cost.frame import NOTHING_KNOWN, FrameCosts, Learnt
from torchcss.errors import ConfigurationError
from torchcss.inference.implicit import TermWeights, weighted_minimum
from torchcss.inference.mixture import GaussianMixture, Prior
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.initialise.result import Initialisation
from torchcss.initialise.view import CameraView
from torchcss.io.video import VideoReader
from torchcss.studies.metrics import mpjpe_mm
from torchcss.studies.render.sequences import SyntheticSequence, arm_sequence
from torchcss.studies.sequences import read_sequence
from torchcss.tracking.presets import PRESETS
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import (
    Settings,
    boundary_emphasis,
    make_choice,
    make_extractor,
)
from torchcss.types import Frame, frozen
from torchcss.vision.features import FrameFeatures

OPTIMISER = TrustRegionNewton(max_steps=30, tolerance=1e-6)
PERSISTENCE = PRESETS["css"].persistence
LOST_M = 0.15
"""Mean error of the joints from which a mode has lost the body, metres."""
TRACKING = Settings(body="arm8", keypoints_use="first", working_size=320)
"""How this script tracks, where nothing else is said."""


@frozen
class Config:
    """What to learn from, and how long."""

    train: str = "demo:0"
    """Sequence to learn from."""
    test: str = "demo:1"
    """Sequence to measure on."""
    frames: int = 50
    """Frames of each, from the start."""
    starts: int = 4
    """Modes that are tracked side by side."""
    noise: float = 0.5
    """Deviation of their starts, in multiples of the everyday motion of one frame."""
    epochs: int = 6
    """Passes over the training sequence."""
    rate: float = 0.05
    """Step on the logarithms of the weights (Adam)."""
    largest: float = 0.02
    """Norm at which the gradient of a frame is cut off, metres: a minimum that is nearly flat along
    some direction moves very far along it, and says little."""
    learnt: tuple[str, ...] = ("contour", "region", "flow", "temporal_mixture")
    """Terms and priors whose weights are learnt; not segmentation, which has no derivatives and
    moves no minimum. What keeps a search from far-away poses, as the
    stabiliser does, cannot be learnt from modes that stay near the truth."""
    begin: dict[str, float] | None = None
    """Weights to begin with by term; by default those of the tracker, which count as one."""
    tracking: SettingsOptions = TRACKING
    """How the test sequence is tracked; its terms are also those of the cost that is learnt from.
    The body is that of the sequences, the weights are those that are learnt; the seed is also that
    of the noise and of the order of the frames."""
    track: bool = True
    """Track the test sequence with the weights before and after."""
    out: Path | None = None
    """JSON file to write."""


def main(config: Config) -> dict[str, Any]:
    """Learn, measure, print, write; return what is written."""
    if "segmentation" in config.learnt:
        raise ConfigurationError(
            "learnt: segmentation has no derivatives and moves no minimum; its weight is not learnt"
        )
    generator = torch.Generator().manual_seed(config.tracking.seed)
    train, test = (load(name, config.frames) for name in (config.train, config.test))
    settings = replace(config.tracking, body=train.body.name)
    if test.body.name != train.body.name:
        raise ConfigurationError(
            f"{config.test}: has {test.body.name}, {config.train} has {train.body.name}; the "
            "weights of one body say little of another"
        )
    weights = TermWeights(config.learnt, config.begin)
    before = weights.factors()
    exam, lesson = Lesson(test, settings), Lesson(train, settings)
    report: dict[str, Any] = {
        "train": config.train,
        "test": config.test,
        "weights_before": before,
        "test_before_mm": mean_error(exam, weights, config),
    }
    report["train_mm"] = learn(weights, lesson, config, generator)
    report["weights_after"] = weights.factors()
    report["test_after_mm"] = mean_error(exam, weights, config)
    if config.track:
        for when, factors in (("before", before), ("after", weights.factors())):
            report[f"track_{when}_mm"] = tracked_error(test, settings, factors)
    rows = [
        [when, *report[f"weights_{when}"].values(), report[f"test_{when}_mm"],
         *report.get(f"track_{when}_mm", {}).values()]
        for when in ("before", "after")
    ]  # fmt: skip
    tracked = ("track mm", "best of modes mm") if config.track else ()
    columns = ("weights", *config.learnt, "minimum mm", *tracked)
    table = Table("Weights learnt from true states", columns, rows)
    tell(report)
    return finish(config.out, report, table)


def load(name: str, num_frames: int) -> SyntheticSequence:
    """A sequence by its name."""
    kind, _, seed = name.partition(":")
    if kind == "demo" and seed.isdigit():
        generator = torch.Generator().manual_seed(int(seed))
        return arm_sequence(generator=generator, num_frames=num_frames)
    sequence = read_sequence(Path(name))
    if sequence.truth is None:
        raise ConfigurationError(f"{name}: has no true states; expected demo:SEED or such a folder")
    images = [frame.image for frame in VideoReader(sequence.video, stop=num_frames)]
    states = sequence.truth.states[: len(images)]
    return SyntheticSequence(
        frames=images, frame_rate=sequence.frame_rate, camera=sequence.camera,
        body=sequence.truth.body, states=states,
    )  # fmt: skip


class Lesson:
    """A sequence with its features, through which modes are tracked.

    Args:
        truth: The sequence.
        settings: Terms and sizes.
    """

    def __init__(self, truth: SyntheticSequence, settings: Settings) -> None:
        extractor, body = make_extractor(settings), truth.body
        self.truth, self.interval = truth, 1 / truth.frame_rate
        self.costs = FrameCosts(
            body, extractor.working_camera(truth.camera), make_choice(settings, 1.0),
            frame_interval=self.interval, boundary_emphasis=boundary_emphasis(settings),
        )  # fmt: skip
        self.joints = truth.joints_world
        self.features: list[FrameFeatures] = []
        self.known: list[Learnt] = [NOTHING_KNOWN]
        last = None
        for index, image in enumerate(tqdm(truth.frames, unit="frame", desc="features")):
            self.features.append(extractor(image, last))
            pose = truth.states[index : index + 1]
            self.known.append(self.costs.learn(self.known[-1], self.features[-1], body, pose))
            last = image

    def errors(
        self, weights: TermWeights, config: Config, generator: torch.Generator
    ) -> Iterator[Float[Tensor, " s"]]:
        """Track modes from frame to frame.

        Yields:
            How far the joints of each are from the truth, metres, frame by frame; differentiable in
            the weights, which may change in between.
        """
        body, states = self.truth.body, self.truth.states
        deviation = config.noise * body.motion_rate * self.interval
        size = (config.starts, body.num_parameters)

        def about(state: Tensor) -> Tensor:
            noise = torch.randn(size, generator=generator, dtype=torch.float64)
            return body.bounds.project(state + deviation * noise)

        x, velocity = about(states[0]), torch.zeros(size, dtype=torch.float64)
        for index in range(1, len(states)):
            start = body.bounds.project(x + PERSISTENCE * velocity)
            like = torch.eye(len(deviation)).to(x).expand(len(x), -1, -1)
            prior = Prior.of(GaussianMixture(start, like, x.new_zeros(len(x))))
            cost = self.costs(
                self.features[index], body=body, before=x, known=self.known[index]
            ).of_children(torch.arange(len(x)), prior)
            new = weighted_minimum(cost, weights, start, body.bounds, optimiser=OPTIMISER)
            away = body.pose(new).joints - self.joints[index]
            error = (away.square().sum(-1) + 1e-8).sqrt().mean(-1)
            yield error
            lost = (error.detach() > LOST_M)[:, None]
            velocity = torch.where(lost, 0.0, new.detach() - x)
            x = torch.where(lost, about(states[index]), new.detach())


def mean_error(lesson: Lesson, weights: TermWeights, config: Config) -> float:
    """Mean error of the modes, millimetres; the same noise every time."""
    generator = torch.Generator().manual_seed(config.tracking.seed)
    with torch.no_grad():
        return 1000 * float(torch.cat(list(lesson.errors(weights, config, generator))).mean())


def learn(
    weights: TermWeights, lesson: Lesson, config: Config, generator: torch.Generator
) -> list[float]:
    """Gradient descent on the weights, frame by frame; the mean loss of every epoch in mm.

    The weights are left as they were before the best epoch, or after the last if that is better: a
    mode that is lost on the way makes an epoch worse, and no derivative tells of that.
    """
    descent = torch.optim.Adam(weights.parameters(), lr=config.rate)
    history, best = [], (math.inf, weights.log_weight.detach().clone())
    for _ in tqdm(range(config.epochs), unit="epoch"):
        losses, before = [], weights.log_weight.detach().clone()
        for error in lesson.errors(weights, config, generator):
            descent.zero_grad()
            # Beyond where a mode counts as lost, how far it is says nothing.
            loss = error.clamp(max=LOST_M).mean()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(weights.parameters(), config.largest)
            descent.step()
            losses.append(1000 * float(loss.detach()))
        history.append(float(np.mean(losses)))
        best = min(best, (history[-1], before), key=lambda pair: pair[0])
    history.append(mean_error(lesson, weights, config))
    if history[-1] > best[0]:
        with torch.no_grad():
            weights.log_weight.copy_(best[1])
    return history


def tracked_error(
    truth: SyntheticSequence, settings: Settings, weights: Mapping[str, float]
) -> dict[str, float]:
    """Mean error of a whole track from the true first pose, of the best mode and of all, mm."""
    settings = replace(settings, weights=dict(weights))
    n, interval = truth.body.num_parameters, 1 / truth.frame_rate
    mixture = GaussianMixture(
        truth.states[:1], 0.01 * torch.eye(n).double()[None], torch.zeros(1).double()
    )
    session = TrackingSession(
        settings,
        Initialisation(truth.body, mixture, torch.zeros(1).double(), ()),
        [CameraView(truth.camera)],
        frame_interval=interval,
    )
    best, of_modes = [], []
    frames = (Frame(i, i * interval, image) for i, image in enumerate(truth.frames))
    for frame in session.track(tqdm(frames, total=len(truth.frames), unit="frame")):
        joints = truth.body.pose(truth.states[frame.frame.index]).joints
        error = mpjpe_mm(frame.joints_world, joints)
        best.append(error[0])
        of_modes.append(error.min())
    return {"best_mode": float(np.mean(best)), "best_of_modes": float(np.mean(of_modes))}


def tell(report: dict[str, Any]) -> None:
    """What the learnt weights do."""
    history = report["train_mm"]
    print(
        f"one mode, train: {history[0]:.1f} mm in the first epoch, {min(history):.1f} in the best"
    )
    print(f"one mode, test: {report['test_before_mm']:.1f} -> {report['test_after_mm']:.1f} mm")
    if "track_after_mm" in report:
        for kind in ("best_mode", "best_of_modes"):
            before, after = (report[f"track_{when}_mm"][kind] for when in ("before", "after"))
            print(f"whole track, test, {kind.replace('_', ' ')}: {before:.1f} -> {after:.1f} mm")


if __name__ == "__main__":
    start(main, Config, __doc__)

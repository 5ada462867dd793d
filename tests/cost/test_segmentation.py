"""The segmentation: poses that cover what looks like the body are told from those that do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from made_costs import Ready
from painted import a_body_before_a_camera, layers, moved, painted
from torch import Tensor

from torchcss.body.load import FileOptions, load_body
from torchcss.body.model import BodyModel
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.flow import FlowTerm
from torchcss.cost.frame import NOTHING_KNOWN, FrameCosts
from torchcss.cost.part_map import bare_pixels, part_map
from torchcss.cost.region import RegionTerm
from torchcss.cost.segmentation import SegmentationImages, SegmentationTerm
from torchcss.cost.total import TrackingCost
from torchcss.inference.mixture import GaussianMixture, Prior
from torchcss.inference.problem import SearchProblem
from torchcss.inference.proposals import CovarianceScaled
from torchcss.inference.tracker import Tracker
from torchcss.initialise.view import CameraView
from torchcss.tracking.view import NOTHING_SEEN, Observer
from torchcss.types import Bounds, Frame, LocalModel
from torchcss.vision.camera import Camera
from torchcss.vision.features import FeatureExtractor, Window
from torchcss.vision.flow import TRACKING_FLOW


def plain_twin(
    term: SegmentationTerm, body: BodyModel, x: Tensor, images: SegmentationImages
) -> float:
    parts = part_map(body, x, images.camera, rings=term.rings, meridians=term.meridians)
    total = 0.0
    for row, line in enumerate(parts.tolist()):
        for column, part in enumerate(line):
            if part >= 0:
                total += float(images.ratio[images.layer[part], row, column])
    return 1 - total / images.area


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (3,), (2, 2), (0,)])
def test_it_is_the_sum_of_the_covered_pixels(batch: tuple[int, ...], dtype: torch.dtype) -> None:
    body, camera = a_body_before_a_camera(dtype)
    generator = torch.Generator().manual_seed(0)
    term = SegmentationTerm(reduction=12)
    ratio = torch.rand(layers(body)[0], 600, 480, generator=generator).to(dtype) * 2 - 1
    images = term.images(ratio, layers(body)[1], camera, body, body.rest)
    x = body.rest + 0.3 * torch.randn(
        *batch, len(body.rest), generator=generator, dtype=torch.float64
    ).to(dtype)
    got = term.value(body, x, images)
    assert got.shape == batch
    assert got.dtype == dtype
    for value, state in zip(got.reshape(-1), x.reshape(-1, x.shape[-1]), strict=True):
        assert float(value) == pytest.approx(plain_twin(term, body, state, images), abs=1e-5)


@pytest.mark.parametrize("reduction", [4, 7])
def test_a_window_is_the_picture_that_is_zero_elsewhere(reduction: int) -> None:
    """A body that is partly outside of it, and blocks that lie across its ends."""
    body, camera = a_body_before_a_camera()
    term, window = SegmentationTerm(reduction=reduction), Window(130, 121, 251, 403)
    whole = painted(body, camera, body.rest)
    part = torch.zeros_like(whole)
    part[window.pixels] = whole[window.pixels]
    layer, seen = layers(body)[1], whole[window.pixels]
    in_window = term.images(seen, layer, camera, body, body.rest, window=window)
    expected = term.images(part, layer, camera, body, body.rest)
    x = torch.stack([moved(body, angle) for angle in (0.0, 0.9, 1.3)])
    torch.testing.assert_close(term.value(body, x, in_window), term.value(body, x, expected))


def test_the_painted_pose_is_the_cheapest() -> None:
    body, camera = a_body_before_a_camera()
    term = SegmentationTerm()
    truth = moved(body, 0.9)
    images = term.images(painted(body, camera, truth), layers(body)[1], camera, body, truth)
    angles = torch.tensor([0.0, 0.5, 0.7, 0.9, 1.1, 1.3])
    values = term.value(body, torch.stack([moved(body, float(a)) for a in angles]), images)
    assert 0.0 < float(values[3]) < 0.2, "nearly every pixel is what it looks like"
    assert float(values.diff()[:3].max()) < 0 < float(values.diff()[3:].min())


def test_a_limb_that_is_left_uncovered_counts() -> None:
    """The pose of a body whose arm is over the leg covers nothing that looks like background."""
    body, camera = a_body_before_a_camera()
    term = SegmentationTerm()
    truth, hidden = moved(body, 1.2), moved(body, 0.0)
    ratio = painted(body, camera, truth).clamp(min=0)  # nothing looks like background
    images = term.images(ratio, layers(body)[1], camera, body, truth)
    values = term.value(body, torch.stack([truth, hidden]), images)
    assert float(values[0]) < float(values[1]) - 0.05


def test_out_of_the_picture_and_behind_the_camera_nothing_is_said() -> None:
    body, camera = a_body_before_a_camera()
    term = SegmentationTerm()
    for place in ([9.0, 0.0, 3.0], [0.0, 0.0, -3.0]):
        away = body.with_base(
            torch.eye(3, dtype=torch.float64), torch.tensor(place, dtype=torch.float64)
        )
        count, layer = layers(away)
        ratio = torch.ones(count, 600, 480, dtype=torch.float64)
        images = term.images(ratio, layer, camera, away, away.rest)
        assert images.area > 0
        assert float(term.value(away, away.rest, images)) == 1.0


@pytest.mark.parametrize("size", [(161, 203), (3, 2)])
def test_pictures_of_odd_and_of_very_small_sizes(size: tuple[int, int]) -> None:
    body, camera = a_body_before_a_camera()
    odd = camera.resized(*size)
    count, layer = layers(body)
    ratio = torch.ones(count, size[1], size[0], dtype=torch.float64)
    images = SegmentationTerm().images(ratio, layer, odd, body, body.rest)
    assert images.ratio.shape[-2:] == images.camera.image_size_wh[::-1]
    assert bool(SegmentationTerm().value(body, body.rest, images).isfinite())


def test_the_whole_cost_leaves_it_out_and_adds_it_where_it_is_asked() -> None:
    body, camera = a_body_before_a_camera()
    term = SegmentationTerm()
    truth = moved(body, 0.9)
    images = term.images(painted(body, camera, truth), layers(body)[1], camera, body, truth)
    view, plain = FrameContext(body=body, camera=camera), CostChoice().without("contour", "joints")
    choice = plain.having(Ready(term, term.bind(images)))
    cost = TrackingCost(choice=choice, views=(view,))
    without = TrackingCost(choice=plain.having(term), views=(view,))
    x = torch.stack([truth, moved(body, 0.2)])
    torch.testing.assert_close(cost.value(x), without.value(x), rtol=0, atol=0)
    assert not without.weight_only(x).any()
    expected = SegmentationTerm().weight * term.value(body, x, images)
    torch.testing.assert_close(cost.weight_only(x), expected)
    halved = cost.with_weights({"segmentation": 0.5})
    torch.testing.assert_close(halved.weight_only(x), 0.5 * expected)
    from_two = TrackingCost(choice=choice, views=(view, FrameContext(body=body, camera=camera)))
    torch.testing.assert_close(from_two.weight_only(x), 2 * expected)


def test_what_a_frame_taught_weighs_the_poses_of_the_next() -> None:
    """From pictures to nats: learned at the true pose, and asked of two poses in the next frame."""
    body, camera = a_body_before_a_camera()
    truth, hidden = moved(body, 1.2), moved(body, 0.0)
    seen = part_map(body, truth, camera) >= 0
    image = torch.where(seen[..., None], torch.tensor([180, 60, 40]), torch.tensor([40, 90, 160]))
    features = FeatureExtractor(working_size=600, colour=True)(image.to(torch.uint8).numpy())
    choice = CostChoice(terms=(SegmentationTerm(),))
    costs = FrameCosts(body, camera, choice)
    unknown = costs(features, body=body, before=truth[None])
    assert not unknown.weighs
    known = costs.learn(NOTHING_KNOWN, features, body, truth[None])
    cost = costs(features, body=body, before=truth[None], known=known)
    right, wrong = cost.weight_only(torch.stack([truth, hidden])).tolist()
    assert 0 < right < 0.4 * SegmentationTerm().weight
    assert right < wrong - 0.05 * SegmentationTerm().weight
    # A frame without a frame before it has no unit of area, and one without a picture says nothing.
    assert not costs(features, body=body, known=known).weighs
    assert not costs(None, body=body, before=truth[None], known=known).weighs


def before_a_wall(body: BodyModel, camera: Camera, state: Tensor) -> np.ndarray:
    """A body before a wall with stripes of its own colour, but for where its arm will be."""
    seen = part_map(body, state, camera) >= 0
    skin, blue = torch.tensor([180, 60, 40]), torch.tensor([40, 90, 160])
    stripes = (torch.arange(seen.shape[1]) // 24 % 2 == 0).expand(seen.shape)
    there = part_map(body, torch.stack([moved(body, 0.0), moved(body, 1.2)]), camera) >= 0
    image = torch.where((seen | (stripes & ~(there[1] & ~there[0])))[..., None], skin, blue)
    image = image.double()
    image += 4 * torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    return image.clamp(0, 255).to(torch.uint8).numpy()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_camera_that_stands_still_knows_what_was_behind(dtype: torch.dtype) -> None:
    """A limb moves before a wall of its own colour: pictures, background, nats."""
    body, camera = a_body_before_a_camera(dtype)
    before, after = moved(body, 0.0), moved(body, 1.2)
    gaps = {}
    for asked in (False, True):
        terms = (RegionTerm(background=asked), SegmentationTerm(background=asked))
        choice = CostChoice().without("joints").having(*terms)
        costs = FrameCosts(body, camera, choice)
        extractor = FeatureExtractor(colour=True).to(dtype)
        observer = Observer(view=CameraView(camera), costs=costs, extractor=extractor)
        seen, memory = NOTHING_SEEN, NOTHING_KNOWN
        for index in range(2):
            frame = Frame(index, 0.0, before_a_wall(body, camera, before))
            seen = observer.observe(frame, seen)
            memory = observer.recall(memory, seen)
            memory = costs.learn(memory, seen.features, body, before[None])
        seen = observer.observe(Frame(2, 0.0, before_a_wall(body, camera, after)), seen)
        memory = observer.recall(memory, seen)
        assert (memory.background is not None) == asked
        cost = observer.cost(seen, memory, body, before[None])
        where = torch.zeros(2, dtype=torch.long)
        prior = Prior.of(
            GaussianMixture(before[None], torch.eye(len(before))[None].to(before), before[:1])
        )
        both = torch.stack([after, before])
        cost = cost.of_children(where, prior)
        shown = cost.weight_only(both) + cost.terms(both)["region"]
        assert shown.dtype == dtype
        gaps[asked] = float(shown[1] - shown[0])
    assert gaps[True] > gaps[False] + 20
    # A cut, and a picture that is missing.
    seen = observer.observe(None, seen)
    memory = costs.learn(memory, seen.features, body, before[None])
    assert memory.background is not None
    seen = observer.observe(Frame(3, 0.0, 255 - before_a_wall(body, camera, after)), seen)
    assert observer.recall(memory, seen).background is None


def test_pixels_are_bare_where_no_likely_pose_is_near() -> None:
    body, camera = a_body_before_a_camera()
    modes = torch.stack([moved(body, 0.0), moved(body, 1.2)])
    seen = part_map(body, modes, camera) >= 0
    raised = seen[1] & ~seen[0]
    alike = bare_pixels(body, modes, torch.tensor([-3.0, -3.0]).double(), camera)
    assert alike.shape == (600, 480)
    assert not (alike & seen.any(0)).any()
    assert alike[:, :20].all()
    unlikely = bare_pixels(body, modes, torch.tensor([0.0, -5.0]).double(), camera)
    assert float(unlikely[raised].double().mean()) > 0.8
    assert not (unlikely & seen[0]).any()
    # Nor within four pixels of a body that is likely: eight, on a grid of four, of a coarse mesh.
    grown = torch.nn.functional.max_pool2d(seen[0][None].double(), 9, 1, 4)[0] > 0
    assert not (unlikely & grown).any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_body_without_flesh_shows_nothing(tmp_path: Path, dtype: torch.dtype) -> None:
    """Such as a robot of which a file has only meshes: its pictures say nothing, of all terms."""
    path = tmp_path / "robot.urdf"
    path.write_text(
        "<robot name='r'><link name='a'/><link name='b'/><joint name='j' type='continuous'>"
        "<parent link='a'/><child link='b'/><origin xyz='0 0 0.3'/></joint></robot>"
    )
    body = load_body(path, file=FileOptions(shape="none"), dtype=dtype)
    body = body.with_base(torch.eye(3), torch.tensor([0.0, 0.0, 2.0]))
    camera = Camera.pinhole(40, 30, focal_px=40.0)
    x = torch.zeros(2, 3, 1, dtype=dtype)
    assert torch.equal(part_map(body, x, camera), torch.full((2, 3, 30, 40), -1))
    noise = torch.rand(30, 40, 3, generator=torch.Generator().manual_seed(0)).numpy()
    features = FeatureExtractor(colour=True, flow=TRACKING_FLOW)(noise, noise)
    choice = CostChoice().having(RegionTerm(), SegmentationTerm(), FlowTerm())
    costs = FrameCosts(body, camera, choice)
    known = costs.learn(NOTHING_KNOWN, features, body, x[0, :1])
    assert known == NOTHING_KNOWN
    cost = costs(features, body=body, before=x[0, :1], known=known)
    for part in (cost.value(x), cost.weight_only(x), *cost.local_model(x)):
        assert part.dtype == dtype
        assert not part.any()


class _TwoWells:
    """Two wells of the same depth, of which something without derivatives prefers one."""

    def value(self, x: Tensor) -> Tensor:
        return self.local_model(x).value

    def local_model(self, x: Tensor) -> LocalModel:
        side = torch.where(x >= 0, 1.0, -1.0)
        gap = x - side
        hessian = 40.0 * torch.eye(x.shape[-1]).to(x).expand(*x.shape, x.shape[-1])
        return LocalModel(20.0 * gap.square().sum(-1), 40.0 * gap, hessian)

    def take(self, items: Tensor) -> _TwoWells:
        return self


def test_the_tracker_counts_it_among_modes() -> None:
    tracker = Tracker(proposal=CovarianceScaled(covariance_scale=8.0), num_samples=30, num_modes=2)
    mixture = GaussianMixture(
        torch.zeros(1, 1, dtype=torch.float64),
        torch.ones(1, 1, 1, dtype=torch.float64),
        torch.zeros(1, dtype=torch.float64),
    )
    bounds = Bounds(*(torch.full((1,), side, dtype=torch.float64) for side in (-9.0, 9.0)))
    start = tracker.init(mixture, generator=torch.Generator().manual_seed(0))
    problem = SearchProblem(_TwoWells(), weight_only=lambda x: torch.where(x[..., 0] > 0, 0.0, 3.0))
    state, info = tracker.step(start, problem, bounds)
    torch.testing.assert_close(
        state.mixture.mean[:, 0], torch.tensor([1.0, -1.0], dtype=torch.float64), atol=1e-3, rtol=0
    )
    difference = state.mixture.log_weight[0] - state.mixture.log_weight[1]
    assert float(difference) == pytest.approx(3.0, abs=1e-3)
    # Smoothing goes by the costs: they are those that the weights were made of.
    torch.testing.assert_close(
        info.cost, torch.tensor([0.0, 3.0], dtype=torch.float64), atol=1e-5, rtol=0
    )

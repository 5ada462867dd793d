"""The feature extractor: every kind of picture, working size, masks, typed errors."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchcss.errors import ConfigurationError, ShapeError
from torchcss.kernels import compiler
from torchcss.vision.boundaries import motion_boundaries
from torchcss.vision.camera import Camera
from torchcss.vision.edges import EdgeConfiguration, edge_features, foreground_weight
from torchcss.vision.features import FeatureExtractor, FrameFeatures, Window
from torchcss.vision.flow import TRACKING_FLOW, robust_flow
from torchcss.vision.sampling import gaussian_blur


@pytest.fixture
def picture(generator: torch.Generator) -> torch.Tensor:
    """A small RGB picture, uint8."""
    coarse = torch.rand(1, 3, 6, 8, generator=generator)
    smooth = torch.nn.functional.interpolate(coarse, size=(48, 64), mode="bicubic").clamp(0.0, 1.0)
    return (255.0 * smooth[0]).round().to(torch.uint8).permute(1, 2, 0).contiguous()


def test_all_kinds_of_pictures_give_the_same_features(picture: torch.Tensor) -> None:
    extractor = FeatureExtractor()
    expected = extractor(picture)
    assert expected.grey.shape == (48, 64)
    assert expected.grey.dtype == torch.float32
    weights = torch.tensor([0.299, 0.587, 0.114])
    torch.testing.assert_close(expected.grey, picture.float() @ weights / 255.0)
    edges = edge_features(expected.grey)
    assert torch.equal(expected.edge_energy, edges.energy)
    assert torch.equal(expected.edge_direction, edges.direction)
    assert expected.flow is None
    assert expected.flow_outlier is None
    assert expected.motion_boundary is None
    assert expected.mask is None
    alpha = torch.full_like(picture[..., :1], 7)
    read_only = picture.numpy().copy()
    read_only.flags.writeable = False
    alternatives = [
        picture.numpy(),
        read_only,
        picture.flip(1).numpy()[:, ::-1],
        torch.cat([picture, alpha], dim=-1),
        picture.float() / 255.0,
        picture.double().numpy() / 255.0,
        picture.numpy().astype(np.uint16) * 257,
        expected.grey,
    ]
    for alternative in alternatives:
        features = extractor(alternative)
        torch.testing.assert_close(features.grey, expected.grey)
        torch.testing.assert_close(features.edge_energy, expected.edge_energy, rtol=0.0, atol=1e-4)


def test_torchs_default_type_changes_nothing(picture: torch.Tensor) -> None:
    expected, before = FeatureExtractor()(picture), torch.get_default_dtype()
    for dtype in (torch.float64, torch.float16):
        torch.set_default_dtype(dtype)
        try:
            features = FeatureExtractor()(picture)
        finally:
            torch.set_default_dtype(before)
        assert features.grey.dtype == torch.float32
        assert torch.equal(features.grey, expected.grey)
        assert torch.equal(features.edge_energy, expected.edge_energy)


def test_features_follow_the_dtype_of_the_module(picture: torch.Tensor) -> None:
    features = FeatureExtractor().to(torch.float64)(picture, mask=picture[..., 0] > 100)
    assert features.mask is not None
    for tensor in (features.grey, features.edge_energy, features.edge_direction, features.mask):
        assert tensor.dtype == torch.float64


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (33, 1), (2, 2), (7, 5)])
@pytest.mark.parametrize("working_size", [None, 16])
def test_thin_and_small_pictures(
    size: tuple[int, int], working_size: int | None, generator: torch.Generator
) -> None:
    frame = torch.randint(0, 256, (*size, 3), generator=generator, dtype=torch.uint8)
    features = FeatureExtractor(working_size=working_size)(frame)
    assert max(features.grey.shape) == min(max(size), working_size or 99)
    for tensor in features[:3]:
        assert torch.isfinite(tensor).all()


def test_flat_frames_are_silent() -> None:
    for level in (0, 77, 255):
        features = FeatureExtractor(working_size=20)(torch.full((45, 31, 3), level).byte())
        assert (features.edge_energy == 0.0).all()


def test_working_size_and_its_camera(picture: torch.Tensor) -> None:
    extractor = FeatureExtractor(working_size=20)
    assert extractor.working_shape(64, 48) == (20, 15)
    assert extractor.working_shape(48, 64) == (15, 20)
    assert extractor.working_shape(19, 3) == (19, 3)
    assert extractor.working_shape(1000, 1) == (20, 1)
    camera = extractor.working_camera(Camera.pinhole(64, 48, focal_px=64.0))
    assert camera.image_size_wh == (20, 15)
    assert camera.K[0, 0] == pytest.approx(20.0)
    features = extractor(picture, previous=picture, mask=picture[..., 0] > 100)
    assert features.mask is not None
    for tensor in (features.grey, features.edge_energy, features.mask):
        assert tensor.shape == (15, 20)
        assert (tensor >= 0.0).all()
        assert (tensor <= 1.0).all()
    torch.testing.assert_close(
        features.grey.mean(), FeatureExtractor()(picture).grey.mean(), rtol=0.02, atol=0.0
    )


def test_choices_reach_the_edge_detector(picture: torch.Tensor) -> None:
    choice = EdgeConfiguration(smoothing=2.5)
    features = FeatureExtractor(edges=choice)(picture)
    assert torch.equal(features.edge_energy, edge_features(features.grey, choice).energy)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (torch.zeros(4), "expected a picture"),
        (torch.zeros(4, 5, 2), "expected a picture"),
        (torch.zeros(1, 3, 4, 5), "expected a picture"),
        (torch.zeros(0, 5), "expected a picture"),
        (torch.zeros(4, 5, dtype=torch.int64), "int64"),
        (np.zeros((4, 5), dtype="U3"), "uint8"),
        (np.zeros((4, 5), dtype=np.complex64), "complex64"),
        (torch.full((4, 5), 255.0), "divide by the value of white"),
        (torch.full((4, 5), torch.nan), "0..1"),
        (torch.full((4, 5), torch.inf), "0..1"),
    ],
)
def test_other_pictures_are_refused(frame: torch.Tensor | np.ndarray, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        FeatureExtractor()(frame)


def test_sizes_that_differ_are_refused(picture: torch.Tensor) -> None:
    with pytest.raises(ShapeError, match=r"mask: .*\[48, 64\].*\[4, 5\]"):
        FeatureExtractor()(picture, mask=torch.zeros(4, 5))
    with pytest.raises(ShapeError, match="previous"):
        FeatureExtractor()(picture, previous=picture[1:])
    for bad in (0, -3, 2.5):
        with pytest.raises(ConfigurationError, match="working_size"):
            FeatureExtractor(working_size=bad)


def texture(generator: torch.Generator, height: int = 60, width: int = 80) -> torch.Tensor:
    """A finely textured grey picture in 0..1."""
    noise = torch.rand(1, 1, height // 3 + 2, width // 3 + 2, generator=generator)
    fine = torch.nn.functional.interpolate(noise, size=(height, width), mode="bicubic")
    return fine[0, 0].clamp(0.0, 1.0)


def moving_square(
    generator: torch.Generator, shift: int = 3
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Two frames in which a textured square moves to the right, and where it was."""
    ground, square = texture(generator), texture(generator, 30, 30)
    before, after, mask = ground.clone(), ground.clone(), torch.zeros(60, 80)
    before[15:45, 20:50] = square
    after[15:45, 20 + shift : 50 + shift] = square
    mask[15:45, 20:50] = 1.0
    return before, after, mask


def assert_unusable(features: FrameFeatures) -> None:
    assert features.flow is not None
    assert features.flow_outlier is not None
    assert features.motion_boundary is not None
    assert not features.flow.any()
    assert (features.flow_outlier == 1.0).all()
    assert (features.motion_boundary == 1.0).all()


def test_features_of_motion(generator: torch.Generator) -> None:
    before, after, mask = moving_square(generator)
    extractor = FeatureExtractor(flow=TRACKING_FLOW)
    assert extractor(after).flow is None
    features = extractor(after, before)
    assert features.flow is not None
    assert features.flow_outlier is not None
    assert features.motion_boundary is not None
    expected = robust_flow(before, after, TRACKING_FLOW)
    assert torch.equal(features.flow, expected.flow)
    assert torch.equal(features.motion_boundary, motion_boundaries(expected))
    assert (features.flow_outlier >= expected.data_outlier - 1e-6).all()
    assert (features.flow_outlier >= 0.5 * expected.smoothness_outlier - 1e-6).all()
    inside = torch.nn.functional.avg_pool2d(mask[None], 9, stride=1, padding=4)[0] == 1.0
    middle = features.flow[:, inside].median(dim=-1).values
    torch.testing.assert_close(middle, torch.tensor([3.0, 0.0]), rtol=0.0, atol=0.1)
    assert float(features.flow_outlier[inside].mean()) < 0.1
    # The potential is low on the boundary of the square, and near one far from it.
    assert float(features.motion_boundary[25:35, 19:21].mean()) < 0.5
    assert float(features.motion_boundary[inside].mean()) > 0.9


def test_edge_fields_emphasise_what_moves(generator: torch.Generator) -> None:
    before, after, mask = moving_square(generator)
    features = FeatureExtractor(flow=TRACKING_FLOW)(after, before, mask)
    assert features.motion_boundary is not None
    plain = features.edge_energy * features.edge_direction
    weight = foreground_weight(mask)
    for k in (0.0, 0.3, 1.0):
        expected = plain * (1.0 - k * features.motion_boundary) * weight
        torch.testing.assert_close(features.edge_field(boundary_emphasis=k), expected)
        torch.testing.assert_close(plain * features.edge_weight(boundary_emphasis=k), expected)
    torch.testing.assert_close(features.edge_field(), features.edge_field(boundary_emphasis=0.3))
    still = features._replace(motion_boundary=None, mask=None)
    torch.testing.assert_close(still.edge_field(), plain)
    assert float(features.edge_field().norm(dim=0).max()) < 1.0
    for bad in (-0.1, 1.1, float("nan")):
        with pytest.raises(ConfigurationError, match="boundary_emphasis"):
            features.edge_field(boundary_emphasis=bad)


def test_a_repeated_frame_does_not_move(generator: torch.Generator) -> None:
    frame = texture(generator)
    features = FeatureExtractor(flow=TRACKING_FLOW)(frame, frame)
    assert features.flow is not None
    assert features.flow_outlier is not None
    assert float(features.flow.abs().max()) < 1e-3
    assert float(features.flow_outlier.max()) < 1e-3


def test_a_dropped_frame_is_a_larger_motion(generator: torch.Generator) -> None:
    before, after, _ = moving_square(generator, shift=6)
    features = FeatureExtractor(flow=TRACKING_FLOW)(after, before)
    assert features.flow is not None
    torch.testing.assert_close(
        features.flow[0, 25:35, 30:40].median(), torch.tensor(6.0), atol=0.3, rtol=0
    )


def test_motion_across_a_cut_is_unusable(generator: torch.Generator) -> None:
    extractor = FeatureExtractor(flow=TRACKING_FLOW)
    one, other = texture(generator, 90, 120), texture(generator, 90, 120)
    assert_unusable(extractor(one, other))
    assert_unusable(extractor(one, 1.0 - one))


@pytest.mark.parametrize("level", [0.0, 0.3, 1.0])
def test_motion_of_a_frame_of_one_colour_is_unusable(
    level: float, generator: torch.Generator
) -> None:
    extractor = FeatureExtractor(flow=TRACKING_FLOW)
    flat, frame = torch.full((60, 80), level), texture(generator)
    for current, previous in ((flat, frame), (frame, flat), (flat, flat), (flat, 1.0 - flat)):
        features = extractor(current, previous)
        assert_unusable(features)
        assert features.edge_field().isfinite().all()


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (33, 1), (2, 2), (7, 5), (23, 31)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_motion_of_thin_small_and_saturated_frames(
    size: tuple[int, int], dtype: torch.dtype, generator: torch.Generator
) -> None:
    extractor = FeatureExtractor(flow=TRACKING_FLOW, working_size=24, colour=True).to(dtype)
    frames = torch.randint(0, 256, (2, *size, 4), generator=generator, dtype=torch.uint8)
    saturated = torch.where(frames > 128, 255, 0).to(torch.uint8)
    for before, after in (frames, saturated, (frames[0], saturated[1])):
        features = extractor(after, before, mask=after[..., 0] > 100)
        assert features.flow is not None
        assert features.colour is not None
        assert features.flow.shape == (2, *features.grey.shape)
        images = features._replace(window=None)
        for part in (*(image for image in images if image is not None), features.edge_field()):
            assert part.dtype == dtype
            assert part.isfinite().all()
        for part in (features.flow_outlier, features.motion_boundary, features.mask):
            assert part is not None
            assert 0.0 <= float(part.min()) <= float(part.max()) <= 1.0


def test_motion_between_pictures_of_all_kinds(picture: torch.Tensor) -> None:
    extractor = FeatureExtractor(flow=TRACKING_FLOW)
    shifted = picture.roll(2, dims=1)
    expected = extractor(shifted, picture)
    assert expected.flow is not None
    sixteen = picture.numpy().astype(np.uint16) * 257
    with_alpha = torch.cat([picture, picture[..., :1]], dim=-1)
    for previous in (sixteen, with_alpha, picture.float() / 255.0, extractor(picture).grey):
        features = extractor(shifted, previous)
        torch.testing.assert_close(features.flow, expected.flow, rtol=0.0, atol=1e-2)


def test_colours_are_those_of_the_frame_at_the_working_size(picture: torch.Tensor) -> None:
    assert FeatureExtractor()(picture).colour is None
    extractor = FeatureExtractor(colour=True)
    features = extractor(picture)
    torch.testing.assert_close(features.colour, picture[..., :3].movedim(-1, 0) / 255.0)
    torch.testing.assert_close(
        torch.einsum("chw,c->hw", features.colour, extractor.luma), features.grey
    )
    grey = extractor(features.grey)
    torch.testing.assert_close(grey.colour, features.grey.expand(3, -1, -1))
    small = FeatureExtractor(colour=True, working_size=20)(picture)
    assert small.colour.shape == (3, *small.grey.shape)


def test_in_a_window_features_are_those_of_the_whole_but_for_its_border() -> None:
    """And outside it nothing is known."""
    generator = torch.Generator().manual_seed(2)
    texture = gaussian_blur(torch.rand(120, 160, generator=generator), 2.0)
    texture = (texture - texture.min()) / (texture.max() - texture.min())
    before, after = texture[:, :-2], texture[:, 2:]
    extractor, window = FeatureExtractor(flow=TRACKING_FLOW, colour=True), Window(40, 24, 128, 96)
    whole = extractor(after, before)
    part = extractor(after, extractor(before), window=window)
    inner = (..., slice(24 + 20, 96 - 20), slice(40 + 20, 128 - 20))
    assert torch.equal(part.grey, whole.grey)
    torch.testing.assert_close(part.edge_energy[inner], whole.edge_energy[inner], rtol=0, atol=0.1)
    assert whole.flow is not None
    assert part.flow is not None
    torch.testing.assert_close(part.flow[inner], whole.flow[inner], rtol=0, atol=0.1)
    outside = torch.ones_like(part.grey, dtype=torch.bool)
    outside[window.pixels] = False
    assert not bool(part.edge_energy[outside].any())
    assert not bool(part.edge_field()[:, outside].any())
    assert not bool(part.flow[:, outside].any())
    for unknown in (part.flow_outlier, part.motion_boundary):
        assert unknown is not None
        assert bool((unknown[outside] == 1).all())


@pytest.mark.skipif(not compiler.COMPILED, reason="numba is not installed")
@pytest.mark.parametrize("working_size", [20, 47, 63])
def test_whole_numbers_shrink_as_their_twin_in_torch(
    picture: torch.Tensor, working_size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    extractor = FeatureExtractor(working_size=working_size, colour=True)
    opaque = torch.cat([picture, picture[..., :1]], dim=-1)
    kinds = [picture, picture[..., 0], opaque, picture.numpy().astype(np.uint16) * 257]
    compiled = [extractor(kind).colour for kind in kinds]
    monkeypatch.setattr(compiler, "COMPILED", False)
    for got, kind in zip(compiled, kinds, strict=True):
        assert got is not None
        torch.testing.assert_close(got, extractor(kind).colour, rtol=0, atol=1e-6)


def test_flow_is_looked_for_where_the_window_was_in_the_frame_before(
    generator: torch.Generator,
) -> None:
    """Less what may have come in since; what the image cuts off is kept."""
    assert Window(0, 5, 100, 200, spare=4).before(200, 300) == Window(0, 9, 96, 200)
    texture = gaussian_blur(torch.rand(60, 82, generator=generator), 1.5)
    texture = (texture - texture.min()) / (texture.max() - texture.min())
    extractor, window = FeatureExtractor(flow=TRACKING_FLOW), Window(10, 0, 70, 50, spare=8)
    features = extractor(texture[:, 1:-1], texture[:, :-2], window=window)
    inside = torch.zeros(60, 80, dtype=torch.bool)
    inside[window.before(60, 80).pixels] = True
    assert features.flow is not None
    assert features.flow_outlier is not None
    assert float((features.flow[0, inside] + 1).abs().median()) < 0.2
    assert not bool(features.flow[:, ~inside].any())
    assert bool((features.flow_outlier[~inside] == 1).all())
    # Edges are looked for in all of it.
    assert bool(features.edge_energy[0:50, 10:18].any())

"""The feature extractor: every kind of picture, working size, masks, typed errors."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchcss.errors import ConfigurationError, ShapeError
from torchcss.vision.camera import Camera
from torchcss.vision.edges import EdgeConfiguration, edge_features
from torchcss.vision.features import FeatureExtractor


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

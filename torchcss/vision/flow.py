"""Robust dense optical flow between two frames, with the maps of where its model fails.

Section 3.1.2 [IJRR] takes its flow and its motion boundaries from the method of Black and Anandan
(1996). With a flow f = (u, v) in pixels, first frame A, second frame B, the energy is

    E(f) = sum_x rho_D( (B(x + f) - A(x) - c(x))^2 )  +  sum_{x ~ y} rho_S( |f(x) - f(y)|^2 )

over pixels x and pairs of neighbours x ~ y: brightness that is constant but for a smooth change c
(Negahdaripour 1998; ours), and first-order smoothness, each under a robust potential of
`torchcss.robust`, so that an occluded pixel or a motion boundary costs little more than a moderate
misfit. At the minimum, the weight rho'(s) / rho'(0) of a residual says how far the model holds
there; one minus it is the **outlier map** of that term, in [0, 1]. The maps widen sigma to a
residual that matters to a user of the flow (the *outlier scale*): the sigma that gives the best
flow already doubts the noise of a camera.

How it is minimised:

- *Coarse to fine*: a pyramid of both frames; every level starts from the flow of the level above.
- *Noise*: both frames are blurred as far as their noise asks for.
- *Texture*: each level loses much of its smooth structure (Rudin, Osher and Fatemi 1992), which
  takes shadows along.
- *Changes of light*: with every second warp c is found anew, as a weighted mean of the residual
  about each pixel.
- *Warping*: B is sampled at x + f and made linear in f; pixels that leave the view have no data
  term. Between pixels an image is the natural cubic spline through them: on smooth images its flow
  is biased by less than 0.01 px, with cubic convolution by 0.04 (measured).
- *Graduated non-convexity*: sigma starts large, where the energy is convex, and shrinks to its
  own value, the curvature rho'(0) being kept.
- *Reweighted least squares*: for given weights the energy is quadratic; Chebyshev's semi-iteration
  solves it, preconditioned by the exact inverse of every pixel's 2 x 2 block.
- *Medians*: after each warp a median over a small window removes isolated outliers, as Sun, Roth
  and Black (2010) advise. At the end of each level the `ACCURATE` preset replaces it, along jumps
  of the flow, by their median weighted by distance, by similarity of texture, and by how far the
  data term holds; motion boundaries then follow the outlines of objects.

By default: `robust_flow(first, second)`; `configuration=TRACKING_FLOW` when every frame of a video
needs it.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import field
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from torchcss.errors import ConfigurationError, FrameError, ShapeError
from torchcss.kernels.checked import run
from torchcss.robust import Charbonnier, Leclerc, Lorentzian, Quadratic
from torchcss.types import frozen
from torchcss.vision.sampling import gaussian_blur
from torchcss.vision.warping import (
    Coefficients,
    Constancy,
    Field,
    Images,
    Plane,
    constancy_about,
    has_flow_kernels,
    image_slopes,
    image_spline,
)

Right = Float[Tensor, "b 1 h x"]
"""One number for each link to the right, and"""
Down = Float[Tensor, "b 1 y w"]
"""for each link downwards."""

FlowPotential = Quadratic | Lorentzian | Leclerc | Charbonnier

_STRUCTURE_SCALE = 1.0 / 16.0
"""Weight of the total variation when structure is separated from texture, grey levels of 0..1."""
_STRUCTURE_STEPS = 30
_DATA_OUTLIER_SCALE, _SMOOTHNESS_OUTLIER_SCALE = 0.02, 0.25
"""Sigmas of the outlier maps: of the data term, grey levels of 0..1, and of smoothness, pixels."""
_CONTINUED = 8
"""How far the frames are continued before structure is separated, pixels."""
_BRIGHTNESS_RADIUS = 5.0
"""Standard deviation of the mean that finds changes of brightness, pixels of a level."""
_UNSEEN = 1.0e-6
"""Share in that mean of a pixel that says nothing."""
_FIFTH = 6.0 * 0.2533
"""A fifth of the sizes of second differences along both axes is below this, in units of white
noise's deviation."""
_LEAST_BLUR = 0.3
"""Standard deviation below which a Gaussian leaves 99 % of a pixel where it is."""
_SMALLEST_SIDE = 6
"""No level has a shorter side than this, pixels, unless the frame has."""
_NUM_ITERATIONS = 16
"""Chebyshev steps per solve."""
_SPECTRUM = 0.004, 2.0
"""Eigenvalues between which these steps shrink errors evenly, of the matrix times the inverse of
its blocks. Two is its bound; below the first lie errors as wide as 30 pixels, which the level above
has removed."""
_MEDIAN_RADIUS = 2
"""Radius of the plain median's square window, pixels."""
_WEAKEST_LINK = 1.0e-6
"""Least relative weight of a link: a pixel whose every term is an outlier stays determined."""
_JUMP = 0.2
"""Difference of neighbouring flows, pixels, along which the weighted median is taken."""
_STRIP_VALUES = 65_536
"""Values of a strip of the median: some of these planes fit in the cache of a core."""
_SIMILAR = 7.0 / 255.0
"""Scale of brightness differences in the weighted median, grey levels of 0..1."""
_WINDOWS_AT_ONCE = 16384
"""Windows of the weighted median per pass; bounds its memory."""


@frozen
class FlowConfiguration:
    """Choices of the flow.

    The potentials' defaults are between the two that Sun, Roth and Black (2010) find best, the
    Lorentzian and the generalised Charbonnier; the ratio of the two nu weighs smoothness against
    brightness.

    Attributes:
        data: Potential of brightness differences; sigma in grey levels of 0..1.
        smoothness: Potential of differences between neighbouring flows; sigma in pixels.
        texture: Share of the smooth structure that is taken out of the frames, 0 to 1.
        pyramid_factor: Size of a level relative to the finer one.
        sigma_factors: The graduated non-convexity: what sigma is multiplied by, in order; the
            warps of each level are shared out evenly among them.
        num_warps: How often each level warps the second frame anew.
        num_reweightings: Solves with fresh robust weights per warp.
        weighted_median_radius: Radius of the weighted median's window; 0 leaves it out.
    """

    data: FlowPotential = field(
        default_factory=lambda: Charbonnier(nu=0.9, sigma=0.0033, power=0.4)
    )
    smoothness: FlowPotential = field(
        default_factory=lambda: Charbonnier(nu=0.045, sigma=0.042, power=0.4)
    )
    texture: float = 0.72
    pyramid_factor: float = 0.7
    sigma_factors: tuple[float, ...] = (100.0, 10.0, 1.0)
    num_warps: int = 9
    num_reweightings: int = 2
    weighted_median_radius: int = 5

    def __post_init__(self) -> None:
        factors = self.sigma_factors
        for name, bound, fits in (
            ("num_warps", "at least 1", self.num_warps >= 1),
            ("num_reweightings", "at least 1", self.num_reweightings >= 1),
            ("weighted_median_radius", "at least 0", self.weighted_median_radius >= 0),
            ("sigma_factors", "given", factors),
            ("sigma_factors", "positive and finite", all(0.0 < f < math.inf for f in factors)),
            ("texture", "in 0..1", 0.0 <= self.texture <= 1.0),
            ("pyramid_factor", "between 0 and 1", 0.0 < self.pyramid_factor < 1.0),
        ):
            if not fits:
                raise ConfigurationError(f"flow: {name} must be {bound}, got {getattr(self, name)}")
        if len(self.sigma_factors) > self.num_warps:
            raise ConfigurationError(
                f"flow: {len(self.sigma_factors)} sigma_factors need as many warps, "
                f"got num_warps={self.num_warps}"
            )


ACCURATE = FlowConfiguration()
"""The best flow; seconds per 640 x 480 pair."""

TRACKING_FLOW = FlowConfiguration(
    data=Lorentzian(nu=1.0, sigma=0.0033),
    smoothness=Lorentzian(nu=0.06, sigma=0.042),
    texture=0.75,
    pyramid_factor=0.5,
    sigma_factors=(100.0, 1.0),
    num_warps=4,
    num_reweightings=1,
    weighted_median_radius=0,
)
"""A good flow at a fraction of the time, for every frame of a video."""


class OpticalFlow(NamedTuple):
    """Where each pixel of the first frame went, and where that answer is in doubt.

    Attributes:
        flow: Displacement to the second frame, pixels: (u to the right, v down).
        data_outlier: One minus the relative robust weight of the brightness difference; 1 where
            the pixel leaves the view. With the Lorentzian it is 1/2 at the outlier scale.
        smoothness_outlier: The same of the largest of the differences to the four neighbours.
    """

    flow: Float[Tensor, "*batch 2 h w"]
    data_outlier: Float[Tensor, "*batch h w"]
    smoothness_outlier: Float[Tensor, "*batch h w"]


@torch.no_grad()
def robust_flow(
    first: Float[Tensor, "*batch h w"],
    second: Float[Tensor, "*batch h w"],
    configuration: FlowConfiguration = ACCURATE,
) -> OpticalFlow:
    """Estimate the flow from the first frame to the second; Black and Anandan (1996).

    Frames without contrast, of one pixel, or without any relation give a finite flow: zero or
    smooth where nothing is seen. Gradients do not pass through.

    Args:
        first: Grey levels in 0..1.
        second: The other frame of each pair, of the same size.
        configuration: The choices; `ACCURATE` or `TRACKING_FLOW` as they are, or changed.

    Raises:
        ShapeError: If the two are not floating-point `[..., h, w]` of one shape, dtype and device
            with at least one pixel.
        FrameError: If a grey level is not finite or far outside 0..1.
    """
    _check_frames(first, second)
    height, width = first.shape[-2:]
    batch = first.shape[:-2]
    frames = _without_noise(torch.stack([first, second], dim=-3).reshape(-1, 2, height, width))
    state = frames.new_zeros(frames.shape[0], 3, 1, 1)
    levels = [_Level.of(grey, configuration.texture) for grey in _pyramid(frames, configuration)]
    for level in levels:
        rows, columns = level.first.shape[-2:]
        scale = state.new_tensor([columns / state.shape[-1], rows / state.shape[-2], 1.0])
        state = _resized(state, (rows, columns)) * scale.view(1, 3, 1, 1)
        state = torch.cat(_refine(state[:, :2], state[:, 2:], level, configuration), dim=1)
    flow, brighter = state[:, :2], state[:, 2:]
    data = _of_scale(configuration.data, _DATA_OUTLIER_SCALE)
    smoothness = _of_scale(configuration.smoothness, _SMOOTHNESS_OUTLIER_SCALE)
    data_outlier = 1.0 - levels[-1].held(flow, brighter, data)
    right, down = (_relative_weight(smoothness, s) for s in _squared_differences(flow))
    smoothness_outlier = _largest_of_neighbours(1.0 - right, 1.0 - down)
    return OpticalFlow(
        flow.reshape(*batch, 2, height, width),
        data_outlier.reshape(*batch, height, width),
        smoothness_outlier.reshape(*batch, height, width),
    )


def _check_frames(first: Tensor, second: Tensor) -> None:
    if (
        first.shape != second.shape
        or first.dtype != second.dtype
        or first.device != second.device
        or first.dtype not in (torch.float32, torch.float64)
        or first.ndim < 2
        or first.numel() == 0
    ):
        raise ShapeError(
            "flow: expected two frames [..., h, w] of one shape in float32 or float64 with at "
            f"least one pixel, got {first.dtype} {list(first.shape)} on {first.device} and "
            f"{second.dtype} {list(second.shape)} on {second.device}"
        )
    for name, frame in (("first", first), ("second", second)):
        low, high = (float(bound) for bound in frame.aminmax())
        if not (low >= -0.5 and high <= 1.5):  # also true of NaN
            raise FrameError(
                f"flow: the {name} frame must hold grey levels in 0..1, got {low:g} to {high:g}; "
                "divide 8-bit levels by 255 and replace missing pixels"
            )


def _pyramid(frames: Images, configuration: FlowConfiguration) -> list[Images]:
    """The frames at all sizes, the smallest first; each is made from the next larger one.

    So fine texture is blurred anew at each of them, and does not come back as a coarse one: on
    rendered bodies errors are 14 % lower than with each made from the frames (measured).
    """
    levels, factor = [frames], configuration.pyramid_factor
    height, width = frames.shape[-2:]
    while min(height, width) * factor ** len(levels) >= _SMALLEST_SIDE:
        scale = factor ** len(levels)
        size = round(height * scale), round(width * scale)
        levels.append(_resized(levels[-1], size))
    return levels[::-1]


def _resized(images: Images, size: tuple[int, int]) -> Images:
    """Images made smaller without aliases, or larger by cubic convolution."""
    if images.shape[-2:] == size:
        return images
    smaller = sum(size) < sum(images.shape[-2:])
    if has_flow_kernels(images):
        from torchcss.vision.resample_kernels import cubics, resize, triangles

        resized = images.new_empty(*images.shape[:-2], *size)
        for image, to in zip(images.flatten(0, 1), resized.flatten(0, 1), strict=True):
            resize(image[..., None], to[None], triangles if smaller else cubics)
        return resized
    if smaller:
        return functional.interpolate(images, size=size, mode="bilinear", antialias=True)
    return functional.interpolate(images, size=size, mode="bicubic", align_corners=False)


def _structure(images: Images) -> Images:
    """Smooth part of each image: least total variation near the image (Chambolle 2004)."""
    step = 0.249 / _STRUCTURE_SCALE
    if has_flow_kernels(images):
        from torchcss.vision import flow_kernels

        structure, (height, width) = images.clone(), images.shape[-2:]
        for out, image in zip(structure.flatten(0, 1), images.flatten(0, 1), strict=True):
            links = images.new_zeros(height, width + 1), images.new_zeros(height + 1, width)
            choice = _STRUCTURE_SCALE, step, _STRUCTURE_STEPS
            run(flow_kernels.structure, image, *choice, *links, out)
        return structure
    dual_right = images.new_zeros(*images.shape[:-1], images.shape[-1] - 1)
    dual_down = images.new_zeros(*images.shape[:-2], images.shape[-2] - 1, images.shape[-1])
    structure = images
    for _ in range(_STRUCTURE_STEPS):
        dual_right = dual_right + step * structure.diff(dim=-1)
        dual_down = dual_down + step * structure.diff(dim=-2)
        squared = functional.pad(dual_right, (0, 1)).square_()
        squared[..., :-1, :] += dual_down.square()
        length = squared.sqrt_().clamp_(min=1.0)
        dual_right /= length[..., :-1]
        dual_down /= length[..., :-1, :]
        structure = images.clone()
        structure[..., :-1].add_(dual_right, alpha=_STRUCTURE_SCALE)
        structure[..., 1:].sub_(dual_right, alpha=_STRUCTURE_SCALE)
        structure[..., :-1, :].add_(dual_down, alpha=_STRUCTURE_SCALE)
        structure[..., 1:, :].sub_(dual_down, alpha=_STRUCTURE_SCALE)
    return structure


class _Level(NamedTuple):
    """A level of the pyramid.

    Attributes:
        first: What is left of the first frame without structure, and its slopes.
        second: Spline through what is left of the second frame.
    """

    first: Float[Tensor, "b 3 h w"]
    second: Coefficients

    @staticmethod
    def of(frames: Field, texture: float) -> _Level:
        """The level of both frames, with so large a share of their structure taken out."""
        frames = frames - texture * _structure_of_wider(frames)
        spline = image_spline(frames)
        first = torch.cat([frames[:, :1], image_slopes(spline[:, :1])], dim=1)
        return _Level(first, spline[:, 1:])

    def held(self, flow: Field, brighter: Plane, potential: FlowPotential) -> Plane:
        """How far constant brightness holds under a flow: 0 where the pixel leaves the view."""
        constancy = constancy_about(flow, self.first, self.second)
        squared = (constancy.residual(flow) - brighter).square()
        return _relative_weight(potential, squared) * constancy.visible


def _without_noise(frames: Field) -> Field:
    """Blur pairs of frames so far that white noise of theirs is one of 255 grey levels at most.

    Noise is told from a difference of second derivatives, which straight edges do not have
    (Immerkaer 1996): by a low quantile over the image, that texture counts little. Of white noise a
    Gaussian leaves a share of one over two roots of pi times its width.
    """
    if min(frames.shape[-2:]) < _SMALLEST_SIDE:
        return frames
    lines = frames.unfold(-2, 3, 4) @ frames.new_tensor([1.0, -2.0, 1.0])
    bends = (lines.unfold(-1, 3, 2) @ frames.new_tensor([1.0, -2.0, 1.0])).abs().flatten(2)
    noise = bends.kthvalue(1 + bends.shape[-1] // 5).values.amax(dim=-1) / _FIFTH
    radii = (255.0 / math.sqrt(4.0 * math.pi)) * noise
    blurred = [
        gaussian_blur(pair, radius) if radius > _LEAST_BLUR else pair
        for pair, radius in zip(frames, radii.tolist(), strict=True)
    ]
    return torch.stack(blurred)


def _refine(
    flow: Field, brighter: Plane, level: _Level, configuration: FlowConfiguration
) -> tuple[Field, Plane]:
    """Minimise on one level; also find how much brighter the second frame is there."""
    factors = configuration.sigma_factors
    for warp in range(configuration.num_warps):
        factor = factors[warp * len(factors) // configuration.num_warps]
        data = _of_scale(configuration.data, factor * configuration.data.sigma)
        smoothness = _of_scale(configuration.smoothness, factor * configuration.smoothness.sigma)
        constancy = constancy_about(flow, level.first, level.second)
        if warp % 2 == 0:  # as good as in each of them (measured)
            brighter = _brighter(constancy.residual(flow), constancy.visible, brighter)
        constancy = constancy._replace(offset=constancy.offset - brighter)
        for _ in range(configuration.num_reweightings):
            flow = _solve(flow, _weighed(flow, constancy, data, smoothness), _NUM_ITERATIONS)
        unfiltered = flow
        flow = _median(flow, _MEDIAN_RADIUS)
        if configuration.weighted_median_radius and warp + 1 == configuration.num_warps:
            held = level.held(unfiltered, brighter, configuration.data)
            guide, radius = level.first[:, :1], configuration.weighted_median_radius
            flow = _with_weighted_median_along_jumps(flow, unfiltered, held, guide, radius)
    return flow, brighter


def _brighter(residual: Plane, visible: Plane, before: Plane) -> Plane:
    """How much brighter the second frame is, a smooth picture: a mean about each pixel.

    Residuals count in it as far as they are near to what was found before. Half the size is enough
    for a mean so wide.
    """
    height, width = residual.shape[-2:]
    share = visible / (1 + ((residual - before) / _DATA_OUTLIER_SCALE).square()) + _UNSEEN
    half = -(-height // 2), -(-width // 2)
    both = _resized(torch.cat([share * residual, share], dim=1), half)
    both = gaussian_blur(both, _BRIGHTNESS_RADIUS / 2)
    return _resized(both[:, :1] / both[:, 1:], (height, width))


def _structure_of_wider(images: Images) -> Images:
    """Smooth part of images that are continued on all sides, their edge the middle of a turn.

    Total variation bends towards a border, and a thing is at another distance from it in the other
    frame: flow at the border was off by half a pixel (measured).
    """
    around = [min(_CONTINUED, length - 1) for length in images.shape[-2:]]
    wider = _continued(_continued(images, around[1]).mT, around[0]).mT.contiguous()
    height, width = images.shape[-2:]
    return _structure(wider)[
        ..., around[0] : around[0] + height, around[1] : around[1] + width
    ].contiguous()


def _continued(images: Images, num: int) -> Images:
    """Images with so many columns more on either side."""
    left = 2 * images[..., :1] - images[..., 1 : num + 1].flip(-1)
    right = 2 * images[..., -1:] - images[..., -num - 1 : -1].flip(-1)
    return torch.cat([left, images, right], dim=-1)


def _of_scale(potential: FlowPotential, sigma: float) -> FlowPotential:
    """Exchange sigma, and nu so that the curvature nu / sigma^2 at zero stays."""
    nu = potential.nu * (sigma / potential.sigma) ** 2
    return dataclasses.replace(potential, nu=nu, sigma=sigma)


def _squared_differences(flow: Field) -> tuple[Right, Down]:
    """Squared lengths of the differences to the neighbour on the right and to the one below."""
    right, down = flow.diff(dim=-1), flow.diff(dim=-2)
    return right.square().sum(dim=1, keepdim=True), down.square().sum(dim=1, keepdim=True)


def _relative_weight(
    potential: FlowPotential, squared: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Robust weight relative to that of a residual of zero, in [0, 1]."""
    weight = potential(squared).first * (potential.sigma**2 / potential.nu)
    return weight.clamp(0.0, 1.0)


def _largest_of_neighbours(right: Right, down: Down) -> Plane:
    """Largest of the values on the four links of each pixel; 0 where it has none."""
    horizontal = functional.pad(right, (1, 1))
    vertical = functional.pad(down, (0, 0, 1, 1))
    horizontal = torch.maximum(horizontal[..., 1:], horizontal[..., :-1])
    return torch.maximum(horizontal, torch.maximum(vertical[..., 1:, :], vertical[..., :-1, :]))


class _Quadratic(NamedTuple):
    """The quadratic energy that fixed weights leave: its normal equations (q q^T + L) f = target.

    Attributes:
        q: Gradient of the brightness times the root of its weight.
        target: -q times offset and root.
        right: Weights on the links between columns, of which L is the Laplacian; zero at both ends.
        down: The same between rows.
    """

    q: Field
    target: Field
    right: Float[Tensor, "b 1 h w+1"]
    down: Float[Tensor, "b 1 h+1 w"]

    @staticmethod
    def of(constancy: Constancy, weight: Plane, right: Right, down: Down) -> _Quadratic:
        """The energy of some weights of pixels and links."""
        root = weight.sqrt()
        q = root * constancy.gradient
        links = functional.pad(right, (1, 1)), functional.pad(down, (0, 0, 1, 1))
        return _Quadratic(q, -q * (root * constancy.offset), *links)


def _weighed(
    flow: Field, constancy: Constancy, data: FlowPotential, smoothness: FlowPotential
) -> _Quadratic:
    """The energy with the robust weights that pixels and links have under a flow."""
    weakest = _WEAKEST_LINK * smoothness.nu / smoothness.sigma**2
    known = isinstance(data, Lorentzian) and isinstance(smoothness, Lorentzian)
    if known and has_flow_kernels(flow):
        from torchcss.vision import flow_kernels

        batch, _, height, width = flow.shape
        found = _Quadratic(
            torch.empty_like(constancy.gradient),
            torch.empty_like(constancy.gradient),
            flow.new_empty(batch, 1, height, width + 1),
            flow.new_empty(batch, 1, height + 1, width),
        )
        choice = [
            tuple(map(np.float32, (potential.nu, potential.sigma**2, least)))
            for potential, least in ((data, 0.0), (smoothness, weakest))
        ]
        for x, *parts in zip(flow, *constancy, *found, strict=True):
            arrays = tuple(part.squeeze(0).numpy() for part in parts)
            run(flow_kernels.weigh, x, arrays[:3], *choice, arrays[3:])
        return found
    weight = data(constancy.residual(flow).square()).first * constancy.visible
    right, down = (
        smoothness(squared).first.clamp(min=weakest) for squared in _squared_differences(flow)
    )
    return _Quadratic.of(constancy, weight, right, down)


def _solve(flow: Field, energy: _Quadratic, num_iterations: int) -> Field:
    """Improve the flow on a quadratic energy, by Chebyshev's semi-iteration.

    The matrix is B - N: blocks of pixels, and links between them. A step adds to f a share of
    Jacobi's step, which goes to B^-1 (target + N f), and a share of the last change; the shares
    need no inner products (Saad, Iterative Methods for Sparse Linear Systems, 2003, algorithm
    12.1).
    """
    inverse, target = _inverse_blocks(flow, energy)
    shares = _chebyshev_shares(num_iterations)
    if has_flow_kernels(flow):
        from torchcss.vision import flow_kernels

        height, width = flow.shape[-2:]
        memory, improved = flow.new_empty(2, 2, height + 2, width + 2), torch.empty_like(flow)
        system = target, inverse, energy.right.squeeze(1), energy.down.squeeze(1)
        for x, *parts, to in zip(flow, *system, improved, strict=True):
            arrays = tuple(part.numpy() for part in parts)
            run(flow_kernels.solve_flow, x, arrays, shares, *memory, to)
        return improved
    (uu, vv, uv), before = inverse.split(1, dim=1), flow
    right, down = energy.right[..., 1:-1], energy.down[..., 1:-1, :]
    for length, keep in shares.tolist():
        pull = target.clone()
        pull[..., 1:].addcmul_(right, flow[..., :-1])
        pull[..., :-1].addcmul_(right, flow[..., 1:])
        pull[..., 1:, :].addcmul_(down, flow[..., :-1, :])
        pull[..., :-1, :].addcmul_(down, flow[..., 1:, :])
        u, v = pull.split(1, dim=1)
        jacobi = torch.cat([uu * u + uv * v, vv * v + uv * u], dim=1)
        flow, before = flow + length * (jacobi - flow) + keep * (flow - before), flow
    return flow


def _chebyshev_shares(num: int) -> np.ndarray:
    """Shares of Jacobi's step and of the last change, `[num 2]`."""
    least, most = _SPECTRUM
    middle, half = 0.5 * (most + least), 0.5 * (most - least)
    length, keep, ratio = 1 / middle, 0.0, half / middle
    shares = np.empty((num, 2), np.float32)
    for row in shares:
        row[:] = length, keep
        following = 1 / (2 * middle / half - ratio)
        length, keep, ratio = 2 * following / half, following * ratio, following
    return shares


def _inverse_blocks(flow: Field, energy: _Quadratic) -> tuple[Float[Tensor, "b 3 h w"], Field]:
    """Inverse of each pixel's block (uu, vv, uv), and the target beside it.

    A block is degree I + q q^T, whose determinant is degree (degree + |q|^2); it is never formed as
    a difference, so float32 will do. A pixel without links keeps its flow.
    """
    right, down = energy.right, energy.down
    if has_flow_kernels(flow):
        from torchcss.vision import flow_kernels

        inverse, target = flow.new_empty(len(flow), 3, *flow.shape[-2:]), torch.empty_like(flow)
        given = *energy[:2], right.squeeze(1), down.squeeze(1)
        for x, *parts, to, wanted in zip(flow, *given, inverse, target, strict=True):
            run(flow_kernels.inverse_blocks, x, tuple(p.numpy() for p in parts), to, wanted)
        return inverse, target
    degree = right[..., :-1] + right[..., 1:] + down[..., :-1, :] + down[..., 1:, :]
    u, v = energy.q.split(1, dim=1)
    linked = degree > 0.0
    share = 1.0 / (degree * (degree + u.square() + v.square())).where(linked, 1.0)
    inverse = torch.cat([degree + v.square(), degree + u.square(), -u * v], dim=1) * share
    alone = flow.new_tensor([1.0, 1.0, 0.0]).view(3, 1, 1)
    return torch.where(linked, inverse, alone), torch.where(linked, energy.target, flow)


def _median(images: Images, radius: int) -> Images:
    """Median over a square window, the border replicated.

    Strip by strip: what is worked on at a time stays in the cache (twice as fast, measured).
    """
    height, width = images.shape[-2:]
    if has_flow_kernels(images) and radius == 2:
        from torchcss.vision import flow_kernels

        padded = images.new_empty(height + 2 * radius, width + 2 * radius)
        out = torch.empty_like(images)
        for plane, filtered in zip(images.flatten(0, 1), out.flatten(0, 1), strict=True):
            run(flow_kernels.median, plane, padded, filtered)
        return out
    rows = max(1, _STRIP_VALUES // (images.shape[0] * images.shape[1] * width))
    padded = functional.pad(images, (radius,) * 4, mode="replicate")
    strips = [
        _inner_median(padded[..., top : min(top + rows, height) + 2 * radius, :], radius)
        for top in range(0, height, rows)
    ]
    return torch.cat(strips, dim=-2)


def _inner_median(padded: Float[Tensor, "b c y x"], radius: int) -> Images:
    """Median over the windows that lie inside.

    Keeps just so many planes that the least and the greatest of them cannot be the median, drops
    these two, takes the next plane in: minima and maxima of whole planes, 20 times faster than
    sorting windows (measured).
    """
    height, width = (length - 2 * radius for length in padded.shape[-2:])
    side = 2 * radius + 1
    waiting = [
        padded[..., row : row + height, column : column + width]
        for row in range(side)
        for column in range(side)
    ]
    num_kept = len(waiting) // 2 + 2
    kept, waiting = [plane.clone() for plane in waiting[:num_kept]], waiting[num_kept:]
    spare = torch.empty_like(kept[0])

    def order(low: int, high: int) -> None:
        nonlocal spare
        torch.minimum(kept[low], kept[high], out=spare)
        torch.maximum(kept[low], kept[high], out=kept[high])
        kept[low], spare = spare, kept[low]

    while len(kept) > 1:
        last = len(kept) - 1
        for position in range(len(kept) // 2):
            order(position, last - position)
        for position in range(1, last // 2 + 1):
            order(0, position)
        for position in range(len(kept) // 2, last):
            order(position, last)
        kept = kept[1:-1]
        if waiting:
            kept.append(waiting.pop().clone())
    return kept[0]


def _with_weighted_median_along_jumps(
    filtered: Field, flow: Field, held: Plane, guide: Plane, radius: int
) -> Field:
    """Return the filtered flow with, near jumps, the weighted median of the flow in its place."""
    filtered = filtered.clone()
    height, width = flow.shape[-2:]
    jump = _largest_of_neighbours(*_squared_differences(flow)) > _JUMP**2
    near = functional.max_pool2d(jump.to(flow.dtype), 5, stride=1, padding=2) > 0.0
    item, _, row, column = near.nonzero(as_tuple=True)
    axis = torch.arange(-radius, radius + 1, device=flow.device)
    row_offset, column_offset = (x.flatten() for x in torch.meshgrid(axis, axis, indexing="ij"))
    # Every other pixel, as on a chessboard, gives the same median in half the time (measured).
    voting = (row_offset + column_offset) % 2 == 0
    row_offset, column_offset = row_offset[voting], column_offset[voting]
    distance = (row_offset.square() + column_offset.square()).to(flow.dtype)
    log_nearness = -distance / (2.0 * (1.4 * radius) ** 2)
    planes = flow.transpose(0, 1).reshape(2, -1)
    guide, held = guide.flatten(), held.flatten()
    for start in range(0, len(item), _WINDOWS_AT_ONCE):
        part = slice(start, start + _WINDOWS_AT_ONCE)
        i, r, c = item[part, None], row[part, None], column[part, None]
        rows, columns = r + row_offset, c + column_offset
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        index = (i * height + rows.clamp(0, height - 1)) * width + columns.clamp(0, width - 1)
        contrast = guide[index] - guide[(i * height + r) * width + c]
        similarity = torch.exp(log_nearness - contrast.square() / (2.0 * _SIMILAR**2))
        # A pixel keeps a vote of its own where the data term holds nowhere.
        weight = similarity * inside * held[index].clamp(min=1.0e-6)
        sorted_flow, order = planes[:, index].sort(dim=-1)
        cumulative = weight.expand_as(order).gather(-1, order).cumsum(dim=-1)
        middle = (cumulative < 0.5 * cumulative[..., -1:]).sum(dim=-1, keepdim=True)
        median = sorted_flow.gather(-1, middle.clamp(max=len(distance) - 1))[..., 0]
        filtered[i[:, 0], :, r[:, 0], c[:, 0]] = median.mT
    return filtered

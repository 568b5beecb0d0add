"""Renders as pictures: colour, depth, alpha, number of splats in each pixel, and their skew.

Pictures are (H, W, 3) bytes. Depth, counts and skew are shown with one colour map, from dark to bright.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..cameras.camera import Camera
from ..errors import InputError, check_choice
from ..splats.color import BLACK
from ..splats.fields import Array
from ..splats.harmonics import SH_C0
from ..splats.shapes import SKEW_LIMIT, shape_named
from ..splats.splats import Splats
from .renderer import Rendered, Renderer

Picture = NDArray[np.uint8]

MODES = ("colour", "depth", "alpha", "splats", "skew")
FULL_COUNT = 255  # splats of a pixel at the bright end; the scale is logarithmic, because counts span decades

# Violet, blue, teal, green, yellow. Lightness L* rises evenly from 12 to 92 (CIELAB), and the hue falls evenly in
# OKLab. The chroma is the largest that sRGB has there.
_CONTROL = np.array(
    [
        (57, 2, 75),
        (60, 27, 136),
        (18, 68, 165),
        (12, 106, 148),
        (17, 137, 151),
        (25, 168, 150),
        (54, 200, 124),
        (168, 220, 95),
        (253, 235, 85),
    ],
    np.float64,
)
_STEPS = np.linspace(0.0, 1.0, 256)
_TABLE = np.stack([np.interp(_STEPS, np.linspace(0.0, 1.0, len(_CONTROL)), channel) for channel in _CONTROL.T], axis=1)
_QUANTILES = (0.02, 0.98)  # of the depths, so that a few stray splats do not stretch the range
_SAMPLES = 50_000  # pixels that determine the quantiles well enough
_SOLID = 0.5  # alpha from which a pixel counts for the range of depths


def picture(
    renderer: Renderer,
    splats: Splats,
    camera: Camera,
    mode: str = "colour",
    background: ArrayLike = BLACK,
    near_far: tuple[float, float] | None = None,
    sh_degree: int | None = None,
) -> Picture:
    """Render one view of a model as a picture.

    Parameters
    ----------
    splats : result of `model_for` for the model and the mode.
    mode : one of MODES.
    near_far : depths at the bright and at the dark end [world units]; None for the range of the image (`depth_range`).
    sh_degree : highest band of spherical harmonics in use; None for all.

    Raises
    ------
    InputError : unknown mode, or wrong `near_far`.
    """
    check_choice("picture", mode, MODES)
    image = renderer.render(splats, camera, BLACK if mode == "skew" else background, sh_degree)
    return picture_of(image, mode, background, near_far, renderer.count_splats() if mode == "splats" else None)


def picture_of(
    image: Rendered,
    mode: str = "colour",
    background: ArrayLike = BLACK,
    near_far: tuple[float, float] | None = None,
    counts: Array | None = None,
) -> Picture:
    """Return the picture of a rendered image (see `picture`).

    Parameters
    ----------
    image : for mode "skew", the splats of `model_for` on black.
    counts : (H, W) number of splats of each pixel; mode "splats" needs it.

    Raises
    ------
    InputError : wrong `near_far`.
    """
    if mode == "depth":
        return depth_picture(image, near_far, background)
    if mode == "alpha":
        return to_bytes(image.alpha)[..., None].repeat(3, axis=2)
    if mode == "splats":
        if counts is None:
            raise ValueError('mode "splats" needs `counts`')
        return count_picture(counts)
    if mode == "skew":
        return _over(_divided(image.color[..., 0], image.alpha), image.alpha, background)
    return to_bytes(image.color)


def model_for(splats: Splats, mode: str) -> Splats:
    """Return the splats to render in a mode: the model itself, or for "skew" with its skew as the colour.

    The colour is `skew_magnitude`. Keep the result: a renderer uploads every new object.
    """
    if mode != "skew":
        return splats
    colour = np.zeros_like(splats.sh)
    colour[:, 0] = ((skew_magnitude(splats) - 0.5) / SH_C0)[:, None]
    return splats.with_arrays({**splats.arrays, "sh": colour})


def skew_magnitude(splats: Splats) -> NDArray[np.float64]:
    """Return the magnitude of the skew (N,), from 0 for a Gaussian to 1 for the limit.

    The magnitude is |m| / limit, where m is the shift from location to mean in standard deviations. A slant eta is
    converted to the m of the same skewness. Shapes without skew have 0.
    """
    form = shape_named(splats.shape).skew_form
    squared = np.sum(splats.skew.astype(np.float64) ** 2, axis=1)
    if form is None:
        return np.zeros(len(splats))
    if form == "direct":  # t = k / (pi/2 - k) with k = |eta|^2 / (1 + |eta|^2) (Azzalini & Dalla Valle 1996)
        k = squared / (1.0 + squared)
        squared = k / (0.5 * math.pi - k)
    return np.minimum(np.sqrt(squared) / SKEW_LIMIT, 1.0)


def colour_map(values: Array) -> Picture:
    """Return colours (..., 3) for values 0..1, dark to bright. Values outside are clipped; NaN is dark."""
    return np.take(np.rint(_TABLE).astype(np.uint8), to_bytes(values), axis=0)


def to_bytes(values: Array) -> Picture:
    """Return reals as bytes for image files: clipped to 0..1 and rounded; NaN becomes 0."""
    reals = np.atleast_1d(np.clip(values, 0.0, 1.0))
    if np.isnan(reals).any():
        np.nan_to_num(reals, copy=False, nan=0.0)
    reals *= 255.0
    return np.rint(reals, out=reals).astype(np.uint8).reshape(np.shape(values))


def depth_range(image: Rendered) -> tuple[float, float]:
    """Return the nearest and farthest depth: quantiles over the pixels that are mostly covered."""
    depths = _divided(image.depth, image.alpha)
    for min_alpha in (_SOLID, 1.0 / 255.0):
        seen = depths[(image.alpha > min_alpha) & (depths > 0.0) & np.isfinite(depths)]
        if len(seen):
            seen = seen[:: max(len(seen) // _SAMPLES, 1)]
            near, far = (float(depth) for depth in np.quantile(seen, _QUANTILES))
            return near, max(far, 1.001 * near)
    return 1.0, 2.0


def depth_picture(
    image: Rendered, near_far: tuple[float, float] | None = None, background: ArrayLike = BLACK
) -> Picture:
    """Return the mean depth with the colour map, near bright and far dark, over the background.

    The scale is even in 1/depth, so near depths are resolved as well as far ones.

    Raises
    ------
    InputError : `near_far` is not 0 < near < far.
    """
    near, far = near_far or depth_range(image)
    if not 0.0 < near < far < math.inf:
        raise InputError(f"depth: near {near:g} and far {far:g}; expected 0 < near < far, both finite")
    depths = np.clip(_divided(image.depth, image.alpha), near, far)
    return _over((1.0 / depths - 1.0 / far) / (1.0 / near - 1.0 / far), image.alpha, background)


def count_picture(counts: Array) -> Picture:
    """Return counts with the colour map: 0 is dark, `FULL_COUNT` and more is bright, doublings are even steps."""
    return colour_map(np.log1p(counts) / math.log1p(FULL_COUNT))


def _divided(sums: Array, alpha: Array) -> Array:
    """Return means of weighted sums; 0 in pixels without splats."""
    return np.divide(sums, alpha, out=np.zeros_like(sums), where=alpha > 0.0)


def _over(values: Array, alpha: Array, background: ArrayLike) -> Picture:
    """Return values with the colour map, blended over a background by alpha."""
    cover = np.clip(alpha, 0.0, 1.0, dtype=np.float32)[..., None]
    shown = np.take((_TABLE / 255.0).astype(np.float32), to_bytes(values), axis=0)
    shown *= cover
    if np.any(background):
        shown += (1.0 - cover) * np.asarray(background, np.float32)
    return to_bytes(shown)

"""Renders as pictures to look at: colour, depth, alpha, how many splats a pixel takes in, and how skewed they are.

Pictures are (H, W, 3) bytes. Depth, counts and skew go through one colour map, dark to bright.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..cameras.camera import Camera
from ..errors import InputError
from ..splats.color import BLACK
from ..splats.fields import Array
from ..splats.shapes import SKEW_LIMIT, shape_named
from ..splats.splats import SH_C0, Splats
from .renderer import Rendered, Renderer

Picture = NDArray[np.uint8]

MODES = ("colour", "depth", "alpha", "splats", "skew")
FULL_COUNT = 255  # splats a pixel at the bright end; the scale is logarithmic, as counts spread over decades

# Violet over blue, teal and green to yellow: lightness L* rises evenly from 12 to 92 (CIELAB), at hues that fall evenly
# in OKLab and as much chroma as sRGB has there.
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
_QUANTILES = (0.02, 0.98)  # of depths: a few stray splats do not stretch the range
_SAMPLES = 50_000  # pixels that are enough for quantiles
_SOLID = 0.5  # alpha from which a pixel has a say in the range of depths


def picture(
    renderer: Renderer,
    splats: Splats,
    camera: Camera,
    mode: str = "colour",
    background: ArrayLike = BLACK,
    near_far: tuple[float, float] | None = None,
    sh_degree: int | None = None,
) -> Picture:
    """One view of a model.

    Parameters
    ----------
    splats : what `model_for` makes of the model in this mode.
    mode : one of MODES.
    near_far : depths at the bright and at the dark end [world units]; None: the image's own (`depth_range`).
    sh_degree : highest band of colour shown; None: all.

    Raises
    ------
    InputError : an unknown mode.
    """
    if mode not in MODES:
        raise InputError(f"picture {mode!r}: choose one of {', '.join(MODES)}")
    image = renderer.render(splats, camera, BLACK if mode == "skew" else background, sh_degree)
    return picture_of(image, mode, background, near_far, renderer.count_splats() if mode == "splats" else None)


def picture_of(
    image: Rendered,
    mode: str = "colour",
    background: ArrayLike = BLACK,
    near_far: tuple[float, float] | None = None,
    counts: Array | None = None,
) -> Picture:
    """The picture of a render in a mode (see `picture`).

    Parameters
    ----------
    image : in mode "skew" of `model_for`'s splats before black.
    counts : (H, W) splats a pixel, for mode "splats".
    """
    if mode == "depth":
        return depth_picture(image, near_far, background)
    if mode == "alpha":
        return to_bytes(image.alpha)[..., None].repeat(3, axis=2)
    if mode == "splats":
        assert counts is not None
        return count_picture(counts)
    if mode == "skew":
        return _over(_divided(image.color[..., 0], image.alpha), image.alpha, background)
    return to_bytes(image.color)


def model_for(splats: Splats, mode: str) -> Splats:
    """The splats to render in a mode: the model itself, or with the magnitude of its skew for a colour.

    The magnitude is |m|, the shift from location to mean in standard deviations, over its limit; a slant eta counts as
    the m of the same skewness. Shapes without skew have 0. Keep the result: each one is uploaded for itself.
    """
    if mode != "skew":
        return splats
    colour = np.zeros_like(splats.sh)
    colour[:, 0] = ((skew_magnitude(splats) - 0.5) / SH_C0)[:, None]
    return splats.with_arrays({**splats.arrays, "sh": colour})


def skew_magnitude(splats: Splats) -> NDArray[np.float64]:
    """(N,) |m| over its limit, 0 (a Gaussian) to 1."""
    form = shape_named(splats.shape).skew_form
    squared = np.sum(splats.skew.astype(np.float64) ** 2, axis=1)
    if form is None:
        return np.zeros(len(splats))
    if form == "direct":  # t = k / (pi/2 - k) with k = |eta|^2 / (1 + |eta|^2) (Azzalini & Dalla Valle 1996)
        k = squared / (1.0 + squared)
        squared = k / (0.5 * math.pi - k)
    magnitude: NDArray[np.float64] = np.minimum(np.sqrt(squared) / SKEW_LIMIT, 1.0)
    return magnitude


def colour_map(values: Array) -> Picture:
    """(..., 3) bytes of values 0..1, dark to bright; what lies beyond takes the end's, NaN the dark one."""
    colours: Picture = np.take(np.rint(_TABLE).astype(np.uint8), to_bytes(values), axis=0)
    return colours


def to_bytes(values: Array) -> Picture:
    """Reals to bytes as PNG files have them: clipped to 0..1, rounded; NaN becomes 0."""
    reals = np.atleast_1d(np.clip(values, 0.0, 1.0))
    if np.isnan(reals).any():
        np.nan_to_num(reals, copy=False, nan=0.0)
    reals *= 255.0
    rounded: Picture = np.rint(reals, out=reals).astype(np.uint8).reshape(np.shape(values))
    return rounded


def depth_range(image: Rendered) -> tuple[float, float]:
    """Nearest and farthest depth that matter: quantiles over the pixels that are mostly covered."""
    depths = _divided(image.depth, image.alpha)
    for least in (_SOLID, 1.0 / 255.0):
        seen = depths[(image.alpha > least) & (depths > 0.0) & np.isfinite(depths)]
        if len(seen):
            seen = seen[:: max(len(seen) // _SAMPLES, 1)]
            near, far = (float(depth) for depth in np.quantile(seen, _QUANTILES))
            return near, max(far, 1.001 * near)
    return 1.0, 2.0


def depth_picture(
    image: Rendered, near_far: tuple[float, float] | None = None, background: ArrayLike = BLACK
) -> Picture:
    """Mean depth by the colour map, near bright and far dark; the background shows where the splats let it.

    Even in 1/depth: the near is told apart as well as the far.

    Raises
    ------
    InputError : near_far not 0 < near < far.
    """
    near, far = near_far or depth_range(image)
    if not 0.0 < near < far < math.inf:
        raise InputError(f"depth: near {near:g} and far {far:g}; expected 0 < near < far, both finite")
    depths = np.clip(_divided(image.depth, image.alpha), near, far)
    return _over((1.0 / depths - 1.0 / far) / (1.0 / near - 1.0 / far), image.alpha, background)


def count_picture(counts: Array) -> Picture:
    """Counts by the colour map: 0 is dark, `FULL_COUNT` and more is bright, doublings are even steps."""
    return colour_map(np.log1p(counts) / math.log1p(FULL_COUNT))


def _divided(sums: Array, alpha: Array) -> Array:
    """Weighted sums to means; 0 where nothing is seen."""
    mean: Array = np.divide(sums, alpha, out=np.zeros_like(sums), where=alpha > 0.0)
    return mean


def _over(values: Array, alpha: Array, background: ArrayLike) -> Picture:
    """Values by the colour map before a background, as far as alpha covers it."""
    cover = np.clip(alpha, 0.0, 1.0, dtype=np.float32)[..., None]
    shown = np.take((_TABLE / 255.0).astype(np.float32), to_bytes(values), axis=0)
    shown *= cover
    if np.any(background):
        shown += (1.0 - cover) * np.asarray(background, np.float32)
    return to_bytes(shown)

"""Random splats and views of any number and size, for measurements of speed without photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.images import ImageU8
from ..splats.fields import Array, Field, public_shape, sh_coefficients
from ..splats.shapes import DEFAULT_SHAPE, Shape, shape_named
from ..splats.splats import Splats
from .colmap import NO_POINTS
from .demo.scene import RING_RADIUS, RING_TARGET, ring_cameras
from .scene import Scene, View

OVERDRAW = 24.0  # number of ellipses over a pixel if all splats had the median size; the real number is about twice
_BALL = 0.6 * RING_RADIUS  # radius of the ball of splats [world units]; it extends beyond the sides of the images
_CUTOFF = 2.6  # standard deviations from the centre of a typical splat to where alpha falls to 1/255
_SPREAD = 0.4  # standard deviation of the log scales
_MAX_SKEW = 0.97  # largest length of a bounded vector over its limit; the median is 0.82, as after short trainings


def synthetic_scene(
    n: int,
    width: int = 640,
    height: int = 480,
    shape: str = DEFAULT_SHAPE,
    sh_degree: int = 3,
    n_views: int = 6,
    seed: int = 0,
) -> tuple[Scene, Splats]:
    """Return views of a ball of `n` random splats from a ring of cameras, and the splats.

    The views' images are smooth waves to compare renders with. Sizes fall as 1/sqrt(n), so that the number of splats
    over a pixel hardly depends on `n`; it grows if splats are so small that the low-pass filter widens them. Opacities
    have all values, and are mostly low or high, as in trained models. Parameters such as the skew vary as much. Equal
    arguments give equal bits.

    Parameters
    ----------
    n : number of splats, at least 1.
    width, height : size of the images [px], at least 16.
    shape : name of the splats' shape.
    sh_degree : degree of the spherical harmonics.
    n_views : number of cameras, at least 2; half of them on the upper ring.
    seed : seed of the random numbers.

    Raises
    ------
    InputError : there are too few splats, pixels or views, or the shape is unknown.
    """
    if n < 1 or min(width, height) < 16 or n_views < 2:
        raise InputError(
            f"synthetic scene: {n} splats, {width}x{height} px, {n_views} views; "
            "needs at least 1 splat, 16x16 px and 2 views"
        )
    rng = np.random.default_rng(seed)
    splats = _splats(n, shape_named(shape), sh_degree, rng)
    views = [
        View(f"view_{index:03d}.png", camera, _smooth_image(width, height, rng))
        for index, camera in enumerate(ring_cameras(width, height, n_views))
    ]
    return Scene("synthetic", Path("synthetic"), views, NO_POINTS), splats


def _splats(n: int, shape: Shape, sh_degree: int, rng: np.random.Generator) -> Splats:
    direction = _directions(n, 3, rng)
    radius = _BALL * np.cbrt(rng.random((n, 1)))
    # n ellipses of this size cover the ball's disk OVERDRAW times.
    scale = _BALL / _CUTOFF * np.sqrt(OVERDRAW / n)
    sh = rng.standard_normal((n, sh_coefficients(sh_degree), 3), np.float32)
    sh[:, 1:] *= 0.1
    opacity = 0.02 + 0.96 * rng.beta(0.7, 0.7, n)
    arrays: dict[str, Array] = {
        "mean": RING_TARGET + radius * direction,
        "quat": rng.standard_normal((n, 4)),
        "log_scale": rng.normal(np.log(scale), _SPREAD, (n, 3)),
        "opacity_logit": shape.raw_opacity(opacity),
        "sh": sh,
    }
    for field in shape.fields:
        arrays[field.name] = _shape_values(field, n, arrays, rng)
    return Splats(shape.name, {name: values.astype(np.float32, copy=False) for name, values in arrays.items()})


def _shape_values(field: Field, n: int, arrays: dict[str, Array], rng: np.random.Generator) -> Array:
    """Return values of a field that only this shape has, away from the values of a Gaussian."""
    if field.neutral_from is not None:
        return rng.permutation(arrays[field.neutral_from])
    if field.limit is not None or field.nonzero:
        length = 1.0 if field.limit is None else _MAX_SKEW * field.limit * rng.random((n, 1)) ** 0.25
        return length * _directions(n, field.width, rng)
    start = field.neutral[0] if field.start is None else field.start
    return start * np.exp(rng.normal(0, 0.2, public_shape(field, n)))


def _directions(n: int, width: int, rng: np.random.Generator) -> NDArray[np.float64]:
    vectors = rng.standard_normal((n, width))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _smooth_image(width: int, height: int, rng: np.random.Generator) -> ImageU8:
    """Return an image of waves with a few periods in each channel."""
    x, y = np.arange(width)[None, :, None] / width, np.arange(height)[:, None, None] / height
    periods, phase = rng.uniform(-4, 4, (2, 3)), rng.uniform(0, 2 * np.pi, 3)
    wave = 0.5 + 0.4 * np.sin(2 * np.pi * (periods[0] * x + periods[1] * y) + phase)
    return np.rint(255 * wave).astype(np.uint8)

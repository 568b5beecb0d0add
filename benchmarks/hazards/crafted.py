"""Static hazards: crafted splats that a file may hold or that training may reach.

Every function returns the arrays of one shape, as `Splats` holds them. The camera is at the origin and looks along z. A
splat of scale 1 at depth 4 has a deviation of 10 px.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clsplat.cameras.camera import Camera
from clsplat.splats.fields import public_shape
from clsplat.splats.near_plane import NEAR_PLANE as NEAR
from clsplat.splats.shapes import Shape

Arrays = dict[str, NDArray[np.float64]]

WIDTH, HEIGHT, FOCAL, DEPTH = 45, 35, 40.0, 4.0
COUNT = 24
_STRONG = 0.98  # share of a vector's limit: a strong skew that is not at its bound


def camera(scale: float = 1.0) -> Camera:
    """Return a camera at the origin with an off-centre, non-square image; its position scales with `scale`."""
    pose = np.eye(4)
    pose[:3, 3] *= scale
    return Camera(WIDTH, HEIGHT, FOCAL, 1.1 * FOCAL, 0.45 * WIDTH, 0.55 * HEIGHT, pose)


def benign(shape: Shape, n: int = COUNT, strength: float = 0.6) -> Arrays:
    """Return splats of 2 to 8 px all over the image, with a skew of `strength` times its limit."""
    rng = np.random.default_rng(5)
    depth = rng.uniform(0.8, 1.2, n) * DEPTH
    pixel = rng.uniform(0.1, 0.9, (n, 2)) * (WIDTH, HEIGHT)
    across = (pixel - (0.45 * WIDTH, 0.55 * HEIGHT)) / (FOCAL, 1.1 * FOCAL) * depth[:, None]
    arrays: Arrays = {
        "mean": np.column_stack([across, depth]),
        "quat": rng.normal(size=(n, 4)),
        "log_scale": np.log(rng.uniform(0.2, 0.8, (n, 3))),
        "opacity_logit": shape.raw_opacity(rng.uniform(0.2, 0.8, n)),
        "sh": rng.normal(0, 0.3, (n, 4, 3)),
    }
    arrays["sh"][:, 0] += rng.uniform(0, 1.5, (n, 3))
    for field in shape.fields:
        if field.limit is not None:
            arrays[field.name] = strength * field.limit * unit(rng.normal(size=(n, field.width)))
        elif field.neutral_from is not None:
            arrays[field.name] = np.roll(arrays[field.neutral_from], 1)
        elif field.nonzero:
            arrays[field.name] = rng.normal(size=(n, field.width))
        else:
            middle = field.neutral[0] if field.start is None else field.start
            arrays[field.name] = (middle * rng.uniform(0.7, 1.4, n)).reshape(public_shape(field, n))
    return arrays


def unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors of length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def fields_at_bound(shape: Shape, factor: float = 1 - 1e-6) -> Arrays:
    """Return splats whose shape-specific fields are at `factor` times their limits, bounded ones at either end.

    The default factor stays just inside: the radial gradient of a slant ends at its bound.
    """
    arrays, met = benign(shape), False
    for field in shape.fields:
        values = arrays[field.name]
        if field.limit is not None:
            arrays[field.name] = factor * field.limit * unit(values)
        elif field.bounds is not None:
            low, high = field.bounds
            values[::2], values[1::2] = low / factor, high * factor
        elif field.nonzero:
            values[::2] *= 1e-14 if factor < 1 else 1e-30
        else:
            continue
        met = True
    return arrays if met else {}


def needles(shape: Shape, turn: str = "any", pixels: float = 8.0, ratio: float = 1e-4) -> Arrays:
    """Return needles of 1:10^4 in "any" direction, or disks seen "edge-on"; `pixels` is their long axis."""
    arrays = benign(shape)
    log_scale = np.full((COUNT, 3), np.log(pixels * DEPTH / FOCAL))
    if turn == "any":
        log_scale[:, 1:] += np.log(ratio)
    else:
        log_scale[:, 2] += np.log(ratio)  # the disk's normal
        arrays["quat"] = np.tile([1.0, 0.0, 0.0, 0.0], (COUNT, 1))
        angle = 0.5 * np.pi + np.linspace(-1e-3, 1e-3, COUNT)  # about x: the normal lies across the view
        arrays["quat"][:, 0], arrays["quat"][:, 1] = np.cos(0.5 * angle), np.sin(0.5 * angle)
    arrays["log_scale"] = log_scale
    return arrays


def sized(shape: Shape, pixels: float) -> Arrays:
    """Return splats whose deviations have that many pixels."""
    arrays = benign(shape)
    arrays["log_scale"] += np.log(pixels * DEPTH / FOCAL / 0.4)
    return arrays


def at_near_plane(shape: Shape) -> Arrays:
    """Return small and large splats from behind the camera to just in front of the near plane."""
    arrays = benign(shape)
    beyond = np.geomspace(1e-3, 1.0, COUNT - 8)
    depth = NEAR + np.concatenate([[-1.0, -NEAR, -1e-3, -1e-7, 2e-9, 1e-7, 1e-6, 1e-4], beyond])
    arrays["mean"] *= (depth / arrays["mean"][:, 2])[:, None]
    arrays["log_scale"] += np.log(np.where(np.arange(COUNT) % 2, 0.3, 1e-3))[:, None]
    return arrays


def across_near_plane(shape: Shape) -> Arrays:
    """Return splats skewed along the view, with centroid and location on opposite sides of the near plane."""
    if shape.skew_form is None and "normal" not in shape.schema(1):
        return {}
    arrays = benign(shape)
    arrays["quat"] = np.tile([1.0, 0.0, 0.0, 0.0], (COUNT, 1))
    name = "skew" if shape.skew_form else "normal"
    field = shape.schema(1)[name]
    length = 1.0 if field.limit is None else _STRONG * field.limit
    arrays[name] = length * unit(
        np.random.default_rng(6).normal(0, 0.1, (COUNT, 3))
        + np.where(np.arange(COUNT)[:, None] % 2, 1.0, -1.0) * np.array([0.0, 0.0, 1.0])
    )
    # The deviation along the view is 0.5; the middle of each splat is closer than that to the near plane.
    arrays["log_scale"] = np.log(np.array([[0.02, 0.02, 0.5]])) + np.zeros((COUNT, 3))
    arrays["mean"] *= ((NEAR + np.linspace(-0.45, 0.45, COUNT)) / arrays["mean"][:, 2])[:, None]
    return arrays


def opacity(shape: Shape, values: NDArray[np.float64]) -> Arrays:
    """Return splats whose raw opacities take these values in turn."""
    arrays = benign(shape)
    for name in ("opacity_logit", "opacity_minus_logit"):
        if name in arrays:
            arrays[name] = np.resize(values, COUNT)
            values = values[::-1]
    return arrays


def faint(shape: Shape) -> Arrays:
    """Return splats of opacity 1/255, and one rounding beside it."""
    exact = float(shape.raw_opacity(np.float64(1 / 255)))
    return opacity(shape, exact + np.array([0.0, 1e-6, -1e-6, 1e-3, -1e-3, -30.0, -100.0]))


def opaque(shape: Shape) -> Arrays:
    """Return splats whose opacity rounds to 1 in float32; signed ones have either sign."""
    raw = np.array([4.0, 10.0, 20.0, 90.0])
    return opacity(shape, np.concatenate([raw, -raw]) if shape.signed else raw)


def quaternions(shape: Shape) -> Arrays:
    """Return quaternions of norms 1e-15 to 1e15, the limits of a model."""
    arrays = benign(shape)
    arrays["quat"] = unit(arrays["quat"]) * np.geomspace(1.1e-15, 0.9e15, COUNT)[:, None]
    return arrays


def duplicates(shape: Shape) -> Arrays:
    """Return the same splat 40 times, and other splats at exactly its depth."""
    arrays = benign(shape, 16)
    arrays["mean"][:, 2] = DEPTH
    return {name: np.concatenate([np.repeat(values[:1], 40, axis=0), values]) for name, values in arrays.items()}


def raw_extremes(shape: Shape) -> Arrays:
    """Return values whose activation overflows or vanishes in float32: scales of e^±90, colours, positions of 1e30."""
    arrays = benign(shape)
    arrays["log_scale"][::4] = 90.0
    arrays["log_scale"][1::4] = -90.0
    arrays["sh"][2::8] = 1e30
    arrays["mean"][3::8] = 1e30
    return arrays


def not_a_number(shape: Shape) -> Arrays:
    """Return splats with one NaN, which a model refuses."""
    arrays = benign(shape)
    arrays["log_scale"][3, 1] = np.nan
    return arrays


Craft = Callable[[Shape], Arrays]  # returns {} if the shape has nothing at risk

STATIC: dict[str, Craft] = {
    "benign": benign,
    "skew (own field) at its bound": fields_at_bound,
    "skew (own field) beyond it": lambda s: fields_at_bound(s, 1.5),
    "needles 1:10^4": needles,
    "needles 1:10^4, 400 px long": lambda s: needles(s, pixels=400.0),
    "disks 1:10^4, edge-on": lambda s: needles(s, "edge-on"),
    "sub-pixel, 1e-3 px": lambda s: sized(s, 1e-3),
    "sub-pixel, 1e-8 px": lambda s: sized(s, 1e-8),
    "screen-filling, 1e3 px": lambda s: sized(s, 1e3),
    "screen-filling, 3e5 px": lambda s: sized(s, 3e5),
    "at and behind the near plane": at_near_plane,
    "centroid and location across it": across_near_plane,
    "opacity 1/255": faint,
    "opacity 1": opaque,
    "quaternion norms 1e-15 to 1e15": quaternions,
    "duplicates, coincident depths": duplicates,
    "values that overflow": raw_extremes,
    "NaN in the model": not_a_number,
}

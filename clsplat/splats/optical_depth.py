"""Optical depth -log(1 - |o|) of opacities: exact for opaque and for nearly transparent splats.

The optical depth of a stack of N equal splats is N times that of one. A signed opacity keeps its sign.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping

import numpy as np
from numpy.typing import NDArray

from .fields import Array, DoubleArray
from .shapes import Shape

MIN_DEPTH = 1e-37  # the smallest optical depth; its raw value is finite in float32
MAX_COORDINATE = 1e15  # SGHMC can throw a splat farther; it never returns, and viewers cannot bound it

_NAMES = ("opacity_logit", "opacity_minus_logit")


def opacity_names(arrays: Container[str]) -> tuple[str, ...]:
    """Return the names of the opacity fields among the fields of a model: one, or one for each side of a plane."""
    return tuple(name for name in _NAMES if name in arrays)


def finite_rows(arrays: Mapping[str, Array]) -> NDArray[np.bool_]:
    """Return (N,) whether all parameters are finite and the square of the position is finite in float32."""
    finite = np.ones(len(arrays["mean"]), np.bool_)
    finite &= (np.abs(arrays["mean"]) <= MAX_COORDINATE).all(axis=1)  # this is False for a NaN
    for array in arrays.values():
        finite &= np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    return finite


def optical_depth(shape: Shape, raw: Array) -> DoubleArray:
    """Return -log(1 - |o|) for the raw values of an opacity."""
    wide = raw.astype(np.float64)
    depth = np.logaddexp(0.0, 2.0 * np.abs(wide)) - math.log(2.0) if shape.signed else np.logaddexp(0.0, wide)
    return np.maximum(depth, 0.0)


def raw_of_optical_depth(shape: Shape, depth: DoubleArray | np.float64, old: Array) -> DoubleArray:
    """Return the raw values of |o| = 1 - exp(-depth); signed opacities get the sign of the raw values `old`."""
    depth = np.maximum(depth, MIN_DEPTH)
    opacity = -np.expm1(-depth)
    if shape.signed:  # artanh
        return np.copysign(0.5 * (np.log1p(opacity) + depth), old)
    return np.log(opacity) + depth

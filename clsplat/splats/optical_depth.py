"""Opacities by their optical thickness -log(1 - |o|): exact for opaque and for nearly transparent splats.

A stack of N equal splats is N times as thick as one. A signed opacity keeps its sign throughout.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from .fields import Array, DoubleArray
from .shapes import Shape

THINNEST = 1e-37  # its raw value is finite in float32
FARTHEST = 1e15  # coordinate; what SGHMC has thrown beyond never comes back, and breaks the bounds of viewers

_NAMES = ("opacity_logit", "opacity_minus_logit")


def opacity_names(arrays: Mapping[str, Array]) -> tuple[str, ...]:
    """The opacities that a model has: one, or one for each side of a plane (plus, minus)."""
    return tuple(name for name in _NAMES if name in arrays)


def finite_rows(arrays: Mapping[str, Array]) -> NDArray[np.bool_]:
    """(N,) whether all parameters of a splat are finite, and its position is one that can be squared in float32."""
    finite = np.ones(len(arrays["mean"]), np.bool_)
    finite &= (np.abs(arrays["mean"]) <= FARTHEST).all(axis=1)  # False for a NaN
    for array in arrays.values():
        finite &= np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    return finite


def thickness(shape: Shape, raw: Array) -> DoubleArray:
    """-log(1 - |o|) of the raw values of an opacity."""
    wide = raw.astype(np.float64)
    thick: DoubleArray = (
        np.logaddexp(0.0, 2.0 * np.abs(wide)) - math.log(2.0) if shape.signed else np.logaddexp(0.0, wide)
    )
    return np.maximum(thick, 0.0)


def raw_of_thickness(shape: Shape, thick: DoubleArray, old: Array) -> DoubleArray:
    """Raw values of |o| = 1 - exp(-thick), with the sign of the raw values `old` where opacities have one."""
    thick = np.maximum(thick, THINNEST)
    opacity = -np.expm1(-thick)
    if shape.signed:  # artanh
        raw: DoubleArray = np.copysign(0.5 * (np.log1p(opacity) + thick), old)
        return raw
    raw = np.log(opacity) + thick
    return raw

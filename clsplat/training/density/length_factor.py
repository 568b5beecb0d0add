"""Length factors of relocation: by how much the scales of a splat change if N copies replace it.

With the opacity o of the splat, the opacity o' of each copy, and the profile g of the kernel along a line
(splats/profiles.py):

    length factor = integral of o g  /  integral of 1 - (1 - o' g)^N

`by_quadrature` computes both integrals for every profile, with some hundred exponentials for each splat.

The profiles of the Gaussian and of the skew-normal depend on one number, the slope of the skew. If o = 1 - (1 - o')^N,
their factor is a smooth function of o' and the slope for each N. A polynomial interpolates it at Chebyshev points
(Trefethen 2013, "Approximation Theory and Approximation Practice"). Its coefficients come from the quadrature when an
N occurs for the first time in a process. Any other o is a factor in front, because the first integral is linear in o.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from ...splats import profiles
from ...splats.fields import Array, DoubleArray
from ...splats.shapes import SLANT_MAX

# The nodes on each side of 0 are z = _KNEE sinh(asinh(_FARTHEST / _KNEE) u^3), with u the midpoints of equal cells. A
# step or a cusp at 0 causes no error, because each side is smooth in u. The cube places nodes close to the cusp of
# exp(-|z|^beta), beta < 1. tests/training/test_relocation.py compares the integrals with adaptive quadrature.
_NODES = 96
_KNEE = 3.0
_FARTHEST = 4e3
_CHUNK = 2048  # number of splats that are integrated at once, to limit the memory to some megabytes

# Largest degrees of the polynomials. Few copies need lower degrees: the last coefficients are below _LEFT_OUT.
# tests/training/test_length_factor.py compares the polynomials with the quadrature.
_SLOPE_DEGREE = 14
_OPACITY_DEGREE = 24
_LEFT_OUT = 1e-10


def length_factor(
    profile: Callable[..., Array],
    arrays: Mapping[str, Array],
    depth: DoubleArray,
    new_depth: DoubleArray,
    count: NDArray[np.integer],
) -> DoubleArray:
    """Return the length factors of N stacks, (N,). A stack of one splat has the factor 1.

    Parameters
    ----------
    profile : the kernel along one line (profiles.py). arrays : public arrays of the splats before.
    depth, new_depth : (N, S) optical depths of the splat and of each copy. count : (N,) number of copies.
    """
    if profile in profiles.SLOPES:
        old, new = depth[:, 0], new_depth[:, 0]
        factor = _interpolated(profiles.SLOPES[profile](arrays), -np.expm1(-new), count)
        factor *= -np.expm1(-old) / np.maximum(-np.expm1(-count * new), 1e-300)
    else:
        factor = np.empty(len(count))
        for first in range(0, len(count), _CHUNK):
            rows = slice(first, first + _CHUNK)
            part = {name: array[rows] for name, array in arrays.items()}
            old, new = -np.expm1(-depth[rows]), -np.expm1(-new_depth[rows])
            factor[rows] = by_quadrature(profile, part, old, new, count[rows])
    return np.where(count > 1, factor, 1.0)


def by_quadrature(
    profile: Callable[..., Array],
    arrays: Mapping[str, Array],
    opacity: DoubleArray,
    new_opacity: DoubleArray,
    count: NDArray[np.integer],
) -> DoubleArray:
    """Return the integral of each splat divided by the integral of its stack, (N,).

    opacity, new_opacity : (N, S) opacities of the splat and of each copy. The rest is as in `length_factor`.
    """
    z, weight = _nodes(profile in profiles.EVEN, profile in profiles.SHORT)
    values = profile(z, arrays)  # (N, S, K)
    one = np.einsum("nsk,ns,k->n", values, opacity, weight)
    alpha = np.minimum(np.einsum("nsk,ns->nk", values, new_opacity), 1.0)
    with np.errstate(divide="ignore"):  # alpha = 1: an opaque splat has an opaque stack
        stack = np.einsum("nk,k->n", -np.expm1(count[:, None] * np.log1p(-alpha)), weight)
    factor: DoubleArray = one / np.maximum(stack, 1e-300)
    return factor


def _interpolated(slope: DoubleArray, new_opacity: DoubleArray, count: NDArray[np.integer]) -> DoubleArray:
    """Return the length factors of skew-normals whose opacity is 1 - (1 - new_opacity)^count, (N,).

    Parameters
    ----------
    slope : (N,) or, if all are equal, (1,) slope of the skew; 0 is a Gaussian. Larger slopes than SLANT_MAX count as
        SLANT_MAX, as in the kernels.
    new_opacity : (N,) opacity of each copy, 0 to 1. count : (N,) number of copies, at least 1.
    """
    factor = np.ones(len(count))
    for copies in np.flatnonzero(np.bincount(count)).tolist():
        rows = np.flatnonzero(count == copies)
        for first in range(0, len(rows) if copies > 1 else 0, _CHUNK):
            part = rows[first : first + _CHUNK]
            table = _coefficients(copies)
            x = _from_slope(slope if len(slope) == 1 else slope[part])
            # einsum, not BLAS, whose threads wait for each other if another program uses the processor.
            by_opacity = np.einsum("so,ns->on", table, chebyshev.chebvander(x, len(table) - 1))
            factor[part] = chebyshev.chebval(_from_opacity(new_opacity[part], copies), by_opacity, tensor=False)
    return factor


@lru_cache
def _coefficients(copies: int) -> DoubleArray:
    """Return the Chebyshev coefficients of the length factor of `copies` copies, (by slope, by opacity)."""
    points = [chebyshev.chebpts1(degree + 1) for degree in (_SLOPE_DEGREE, _OPACITY_DEGREE)]
    slope, new = np.meshgrid(_to_slope(points[0]), _to_opacity(points[1], copies), indexing="ij")
    new_opacity, count = new.reshape(-1, 1), np.full(new.size, copies)
    fields = {"skew": slope.reshape(-1, 1)}  # the profile uses only the length of this vector
    opacity = -np.expm1(copies * np.log1p(-new_opacity))
    factor = by_quadrature(profiles.skew_normal_direct, fields, opacity, new_opacity, count)
    by_slope, by_opacity = (np.linalg.inv(chebyshev.chebvander(x, len(x) - 1)) for x in points)
    table: DoubleArray = by_slope @ factor.reshape(slope.shape) @ by_opacity.T
    rows, columns = (np.flatnonzero(np.abs(table).max(axis=axis) > _LEFT_OUT)[-1] + 1 for axis in (1, 0))
    table = np.ascontiguousarray(table[:rows, :columns])
    table.setflags(write=False)
    return table


# The variables of the polynomials are between -1 and 1. Functions of the opacity turn from linear to logarithmic in
# N o', because many copies absorb 1 - exp(-N o' g). Functions of the slope are even, with singularities at negative
# squares, and approach a limit for steep slopes. Trials gave the constants: others need higher degrees.
_BEND = 0.2
_CURVE, _POWER = 0.5, -1.0 / 3.0
_LAST = (1.0 + _CURVE * SLANT_MAX**2) ** _POWER


def _from_opacity(opacity: DoubleArray, copies: int) -> DoubleArray:
    x: DoubleArray = np.log1p(_BEND * copies * opacity) * (2.0 / math.log1p(_BEND * copies)) - 1.0
    return x


def _to_opacity(x: DoubleArray, copies: int) -> DoubleArray:
    opacity: DoubleArray = np.expm1(0.5 * (x + 1.0) * math.log1p(_BEND * copies)) / (_BEND * copies)
    return opacity


def _from_slope(slope: DoubleArray) -> DoubleArray:
    place: DoubleArray = (1.0 + _CURVE * np.minimum(slope, SLANT_MAX) ** 2) ** _POWER
    return (2.0 * place - 1.0 - _LAST) / (1.0 - _LAST)


def _to_slope(x: DoubleArray) -> DoubleArray:
    place = 0.5 * (x * (1.0 - _LAST) + 1.0 + _LAST)
    slope: DoubleArray = np.sqrt((place ** (1.0 / _POWER) - 1.0) / _CURVE)
    return slope


@lru_cache
def _nodes(even: bool, short: bool) -> tuple[DoubleArray, DoubleArray]:
    """Return the nodes and weights of integrals over a line, (K,) each.

    even : the integrand is even, so that nodes above 0 are enough. short : it is 0 beyond `profiles.REACH`.
    """
    u = (np.arange(_NODES) + 0.5) / _NODES
    reach = math.asinh(_FARTHEST / _KNEE)
    z = _KNEE * np.sinh(reach * u**3)
    weight = _KNEE * np.cosh(reach * u**3) * reach * 3.0 * u**2 / _NODES
    if short:
        z, weight = z[z <= profiles.REACH], weight[z <= profiles.REACH]
    if even:
        nodes, weights = z, 2.0 * weight
    else:
        nodes, weights = np.concatenate([-z[::-1], z]), np.concatenate([weight[::-1], weight])
    for array in (nodes, weights):
        array.setflags(write=False)
    return nodes, weights

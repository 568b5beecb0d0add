"""Lens polynomials that COLMAP's models do not have, as models that it has, with the largest error in the image."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

MAX_ERROR = 0.25  # px: a lens that differs by more from its file is refused; calibrations are about that exact
_WIDEST = 1.5  # rad: pinhole images end before 90 degrees
_LARGEST = 3.0  # distance from the axis at depth 1: 72 degrees
_STEPS = 2000


def odd_powers(polynomial: Polynomial, reach: float) -> tuple[NDArray[np.float64], float]:
    """Return the odd polynomial nearest to a fisheye's radius over the angle of view, and its largest error.

    OPENCV_FISHEYE has odd powers only. A polynomial that is odd and of degree 9 at most comes back as it is.

    Parameters
    ----------
    polynomial : the radius at an angle from the axis [rad], with a rising start.
    reach : the radius of the farthest corner.

    Returns
    -------
    Coefficients of the powers 1, 3, 5, 7 and 9, (5,), and the largest error in units of the radius.
    """
    coefficients = np.zeros(10)
    coefficients[: len(polynomial.coef)] = polynomial.coef
    if not coefficients[::2].any():
        return coefficients[1::2], 0.0
    angle = _rising(np.linspace(0.0, _WIDEST, _STEPS), polynomial, reach)
    powers = np.stack([angle**power for power in (1, 3, 5, 7, 9)], axis=1)
    radius = polynomial(angle)
    found = np.linalg.lstsq(powers, radius, rcond=None)[0]
    return found, float(np.abs(powers @ found - radius).max())


def quotient(radial: NDArray[np.float64], reach: float) -> tuple[NDArray[np.float64], float]:
    """Return OpenCV's k1 to k6 for the factor 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8, and the largest error.

    OpenCV's factor is (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6). The six coefficients solve a
    linear least squares problem: the numerator, minus the polynomial times the denominator.

    Parameters
    ----------
    radial : k1 to k4 of the polynomial, (4,).
    reach : distorted radius of the farthest corner.

    Returns
    -------
    The coefficients, (6,), and the largest error in units of the radius, infinite if the denominator has a zero.
    """
    if not radial[3]:
        return np.append(radial[:3], [0.0, 0.0, 0.0]), 0.0
    factor = Polynomial(np.append(1.0, radial))
    radius = _rising(np.linspace(0.0, _LARGEST, _STEPS), lambda r: r * factor(r * r), reach)
    largest = radius[-1] ** 2
    square = radius**2 / largest
    growth = factor(radius**2)
    fits = [_quotient(radius, square, growth, below) for below in (1, 2, 3)]
    found, error = min(fits, key=lambda fit: fit[1])
    return np.asarray(found / largest ** np.array([1, 2, 3, 1, 2, 3]), np.float64), error


def _quotient(
    radius: NDArray[np.float64], square: NDArray[np.float64], growth: NDArray[np.float64], below: int
) -> tuple[NDArray[np.float64], float]:
    """Return the six coefficients with this number of terms in the denominator, and the largest error."""
    powers = np.stack([square, square**2, square**3], axis=1)
    system = np.hstack([powers, -growth[:, None] * powers[:, :below]]) * radius[:, None]
    found = np.zeros(6)
    found[: 3 + below] = np.linalg.lstsq(system, (growth - 1.0) * radius, rcond=None)[0]
    denominator = 1.0 + powers @ found[3:]
    if denominator.min() <= 0.0:
        return found, np.inf
    return found, float((radius * np.abs((1.0 + powers @ found[:3]) / denominator - growth)).max())


def _rising(
    values: NDArray[np.float64], function: Callable[[NDArray[np.float64]], NDArray[np.float64]], reach: float
) -> NDArray[np.float64]:
    """Return the first of the rising values, up to where the function reaches a height or stops to rise."""
    heights = function(values)
    ends = np.flatnonzero((heights[:-1] >= reach) | (np.diff(heights) <= 0.0))
    return values[: max(ends[0] + 1, 2)] if ends.size else values

"""Derives the polynomials of cl/math/approx.clh and prints their coefficients beside those in the source.

    python benchmarks/fit_polynomials.py

The fit is a least-squares fit on Chebyshev points that is repeated with larger weights where the error is large (Lawson
1961). It converges to the polynomial with the smallest maximum error. The errors below are those of the coefficients,
rounded to float32, in double arithmetic; the rounding of the operations in float32 comes on top.

exp   2^n P(r), |r| <= ln(2)/2: P of degree 5 with P(0) = 1, relative error
log   f - f^2/2 + f^3 P(f), f in [sqrt(1/2) - 1, sqrt(2) - 1]: P of degree 6, relative error of the logarithm
Phi   1/2 + z P(2 z^2/25 - 1), |z| <= 5: P of degree 12, absolute error
odds  1 / (1 + 2^(z P(z^2))), z <= 7: P of degree 6, absolute error of Phi to first order

tests/rendering/test_polynomials.py holds the source to these errors.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

from clsplat.device.program import source

Array = NDArray[np.float64]
ROUNDS = 300
POINTS = 4000


@dataclass(frozen=True)
class Fit:
    """One polynomial of the source.

    Parameters
    ----------
    function_name : the function of cl/math/approx.clh; order : powers of the numbers that follow `after` in it.
    fixed_powers : powers whose coefficients are not fitted.
    low, high : interval of x.
    argument, factor, rest : of x; the approximation is rest + factor * P(argument).
    function : the approximated function. weight : factor of its error.
    stated : the largest weighted error that the source claims, without the rounding of float32 operations.
    """

    name: str
    function_name: str
    after: str
    order: tuple[int, ...]
    fixed_powers: tuple[int, ...]
    low: float
    high: float
    argument: Callable[[Array], Array]
    factor: Callable[[Array], Array]
    rest: Callable[[Array], Array]
    function: Callable[[Array], Array]
    weight: Callable[[Array], Array]
    stated: float

    @property
    def committed(self) -> tuple[float, ...]:
        """Coefficients of the source, of increasing power, rounded to float32."""
        text = source("math/approx.clh").split(f" {self.function_name}(", 1)[1].split(self.after, 1)[1]
        numbers = [float(np.float32(number)) for number in re.findall(r"[( ](-?\d+\.\d+(?:e-\d+)?)f\)?[,)]", text)]
        return tuple(number for _, number in sorted(zip(self.order, numbers, strict=False)))

    def error(self, coefficients: tuple[float, ...]) -> float:
        """The largest weighted error of the function with these coefficients, in double arithmetic."""
        x = self.points()
        value = self.rest(x) + self.factor(x) * polynomial.polyval(self.argument(x), np.array(coefficients))
        return float(np.abs((value - self.function(x)) * self.weight(x)).max())

    def points(self) -> Array:
        """Chebyshev points of the interval."""
        return 0.5 * (self.low + self.high) + 0.5 * (self.high - self.low) * np.cos(
            np.pi * (np.arange(POINTS) + 0.5) / POINTS
        )

    def fitted(self) -> tuple[float, ...]:
        """Coefficients of the smallest largest weighted error; the fixed ones are those of the source."""
        x = self.points()
        t, scale = self.argument(x), self.factor(x) * self.weight(x)
        powers = [power for power in range(len(self.order)) if power not in self.fixed_powers]
        fixed = np.array([0.0 if power in powers else c for power, c in enumerate(self.committed)])
        columns = np.stack([t**power for power in powers], axis=1) * scale[:, None]
        residual = (self.function(x) - self.rest(x)) * self.weight(x) - scale * polynomial.polyval(t, fixed)
        lawson = np.full(POINTS, 1.0 / POINTS)
        best, best_error = np.zeros(len(powers)), np.inf
        for _ in range(ROUNDS):
            root = np.sqrt(lawson)
            solution = np.linalg.lstsq(columns * root[:, None], residual * root, rcond=None)[0]
            error = np.abs(columns @ solution - residual)
            if error.max() < best_error:
                best, best_error = solution, float(error.max())
            lawson *= error
            lawson /= lawson.sum()
        result = fixed.copy()
        result[powers] = best
        return tuple(float(c) for c in result)


def _zero(x: Array) -> Array:
    return np.zeros_like(x)


def _one(x: Array) -> Array:
    return np.ones_like(x)


def _away_from_zero(x: Array) -> Array:
    """x, with the points next to 0 moved: the relative error there is a quotient of rounding errors."""
    return np.where(np.abs(x) < 1e-3, 1e-3, x)


EXP = Fit(
    "exp",
    "lanes_exp",
    "vreal odd",
    (5, 3, 4, 2, 1, 0),
    (0,),
    -0.5 * np.log(2.0),
    0.5 * np.log(2.0),
    argument=lambda x: x,
    factor=_one,
    rest=_zero,
    function=np.exp,
    weight=lambda x: np.exp(-x),
    stated=1.9e-7,
)
LOG = Fit(
    "log",
    "log_of_parts_",
    "vreal p",
    (6, 5, 4, 3, 2, 1, 0),
    (),
    np.sqrt(0.5) - 1.0,
    np.sqrt(2.0) - 1.0,
    argument=lambda x: x,
    factor=lambda x: _away_from_zero(x) ** 3,
    rest=lambda x: _away_from_zero(x) - 0.5 * _away_from_zero(x) ** 2,
    function=lambda x: np.log1p(_away_from_zero(x)),
    weight=lambda x: 1.0 / np.abs(np.log1p(_away_from_zero(x))),
    stated=3.6e-8,
)
PHI = Fit(
    "Phi",
    "lanes_phi",
    "vreal even",
    (12, 10, 11, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0),
    (),
    0.0,
    5.0,
    argument=lambda x: 0.08 * x * x - 1.0,
    factor=lambda x: x,
    rest=lambda x: np.full_like(x, 0.5),
    function=ndtr,
    weight=_one,
    stated=1.8e-7,
)
ODDS = Fit(
    "odds",
    "native_phi",
    "real p",
    (6, 5, 4, 3, 2, 1, 0),
    (),
    0.0,
    7.0,
    argument=lambda x: x * x,
    factor=lambda x: x,
    rest=_zero,
    function=lambda x: (log_ndtr(-x) - log_ndtr(x)) / np.log(2.0),
    weight=lambda x: np.log(2.0) * ndtr(x) * ndtr(-x),
    stated=3.6e-8,
)
FITS = (EXP, LOG, PHI, ODDS)


def main() -> None:
    for fit in FITS:
        fitted = fit.fitted()
        print(f"{fit.name}: largest error {fit.error(fit.committed):.2e} in the source, {fit.error(fitted):.2e} fitted")
        print(f"{'power':>6} {'source':>16} {'fitted':>16}")
        for power, (committed, best) in enumerate(zip(fit.committed, fitted, strict=True)):
            note = "  fixed" if power in fit.fixed_powers else ""
            print(f"{power:>6} {committed:>16.10g} {best:>16.10g}{note}")
        print()


if __name__ == "__main__":
    main()

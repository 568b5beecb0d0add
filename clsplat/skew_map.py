"""From the trainable skew vector s in R^3 to the kernel's m with |m| < SKEW_MAX, and back.

Kernels and files know only m (see shapes.py). Both maps keep the direction and bend the length r = |s|:

    cube-root   |m| = SKEW_MAX * tanh(r)^(1/3)   the skewness index is cubic in |m|, so linear in r near 0
    linear      |m| = SKEW_MAX * tanh(r)

At s = 0 the cube root's slope is infinite, so r is floored at R_FLOOR inside the factors: below it m is
linear in s, and every gradient is finite. m = 0 is a stationary point of the kernel (which changes
by the third order in m): training must start from a small m of random direction, see initialise.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .shapes import SKEW_MAX

# By the form of the skew (shapes.Shape.skew_form); the first is its default.
MAPS = {"centred": ("cube-root", "linear"), "direct": ("polar", "radial", "coupled")}
SKEW_MAPS = tuple(name for names in MAPS.values() for name in names)
R_FLOOR = 1e-6  # a kernel that repeats this map in float32 needs the same constants
R_CEILING = 20.0  # cosh(r)^2 stays in float32's range; tanh is 1 long before
TANH_CEILING = 1.0 - 1e-4  # inverse: keeps s where the map still has a slope

_F = TypeVar("_F", np.float32, np.float64)


def map_named(name: str, form: str | None) -> str:
    """`name`, or for "auto" the default map of a form of skew; "" where there is no skew."""
    if form is None:
        return ""
    return MAPS[form][0] if name == "auto" else name


def check_map(name: str, form: str | None) -> None:
    """Raises InputError unless `name` is "auto" or a map of the form (any map where there is no skew)."""
    known = SKEW_MAPS if form is None else MAPS[form]
    if name != "auto" and name not in known:
        kind = "" if form is None else f" for the {form} form of skew"
        raise InputError(f"skew_map {name!r}{kind}: choose auto or one of {', '.join(known)}")


@dataclass(frozen=True, slots=True)
class SkewMap:
    """One parameterisation of the skew; arrays are (N, 3) of float32 or float64 and the dtype is kept.

    Parameters
    ----------
    name : one of SKEW_MAPS.

    Raises
    ------
    InputError : unknown name.
    """

    name: str = "cube-root"

    def __post_init__(self) -> None:
        if self.name not in SKEW_MAPS:
            raise InputError(f"unknown skew map {self.name!r}: choose one of {', '.join(SKEW_MAPS)}")

    def forward(self, s: NDArray[_F]) -> NDArray[_F]:
        """m of s."""
        r = _radius(s)
        m: NDArray[_F] = s * (self._length(r) / r)
        return m

    def vjp(self, s: NDArray[_F], v_m: NDArray[_F]) -> NDArray[_F]:
        """Gradient with respect to s, given the gradient with respect to m.

        With n = s / r, f = |m| / r and g = d|m|/dr the Jacobian is f I + (g - f) n n', symmetric.
        """
        r = _radius(s)
        n = s / r
        f = self._length(r) / r
        g = self._slope(r)
        along = np.sum(n * v_m, axis=-1, keepdims=True)
        # Below the floor the factors are constants and |n| < 1: the map is f s, its Jacobian f I.
        bend = np.where(r > R_FLOOR, g - f, np.zeros_like(f))
        v_s: NDArray[_F] = f * v_m + bend * along * n
        return v_s

    def inverse(self, m: NDArray[_F]) -> NDArray[_F]:
        """The s that gives m; |m| at or above SKEW_MAX is taken as just below it."""
        length = np.sqrt(np.sum(m * m, axis=-1, keepdims=True))
        bent = length / length.dtype.type(SKEW_MAX)
        tanh = bent**3 if self.name == "cube-root" else bent
        r = np.arctanh(np.minimum(tanh, length.dtype.type(TANH_CEILING)))
        floor = np.full_like(r, R_FLOOR)
        per_length = np.where(r > floor, r / np.maximum(length, np.finfo(length.dtype).tiny),
                              floor / self._length(floor))
        s: NDArray[_F] = m * per_length
        return s

    def _length(self, r: NDArray[_F]) -> NDArray[_F]:
        """|m| of r = |s|."""
        bent = np.cbrt(np.tanh(r)) if self.name == "cube-root" else np.tanh(r)
        length: NDArray[_F] = r.dtype.type(SKEW_MAX) * bent
        return length

    def _slope(self, r: NDArray[_F]) -> NDArray[_F]:
        """d|m| / dr."""
        cosh = np.cosh(np.minimum(r, r.dtype.type(R_CEILING)))
        shrink = cosh * cosh
        if self.name == "cube-root":
            root = np.cbrt(np.tanh(r))
            shrink = shrink * (3 * root * root)
        slope: NDArray[_F] = (SKEW_MAX / shrink).astype(r.dtype, copy=False)
        return slope


def _radius(s: NDArray[_F]) -> NDArray[_F]:
    """|s| floored at R_FLOOR, (N, 1)."""
    r: NDArray[_F] = np.maximum(np.sqrt(np.sum(s * s, axis=-1, keepdims=True)), s.dtype.type(R_FLOOR))
    return r

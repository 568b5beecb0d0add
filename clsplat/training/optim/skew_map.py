"""Maps from the trainable skew s of a splat to the bounded vector of the kernel, and back.

Kernels and files hold only the vector: m in the centred form, the slant eta in the direct form (splats/shapes.py).
With r = |s| and n = s / r:

    cube-root   m = n SKEW_MAX tanh(r)^(1/3)                  the skewness index, cubic in |m|, is linear in r near 0
    polar       eta = u/|u| SLANT_MAX tanh(rho / SLANT_MAX)   s = (rho, u): a magnitude and a free direction
    coupled     eta = R' a, a = n SLANT_MAX tanh(r / SLANT_MAX)

"polar" follows 3D Skew-Normal Splatting (SNS, 2026), which does not give the activation of the magnitude. "coupled" is
the textbook form that SNS improves. Its slant a is in the world's frame, with Omega^(1/2) = R S R'. The kernel's skew
then depends on the rotation, so the chain rule also adds to the gradient of the rotation.

The slope of the cube root is infinite at s = 0, and u = 0 has no direction. So the factors use lengths of at least
R_FLOOR. Below it the map is linear, and every gradient is finite. m = 0 is a stationary point of the kernel, because
the kernel changes only in third order of m. So training starts from a small m of random direction
(training/initialise.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...splats.fields import Array
from ...splats.quaternions import rotations, rotations_vjp
from ...splats.shapes import SKEW_MAX, SLANT_MAX

# Maps by form of the skew (Shape.skew_form). The first map is the default.
MAPS = {"centred": ("cube-root",), "direct": ("polar", "coupled")}
SKEW_MAPS = tuple(name for names in MAPS.values() for name in names)
R_FLOOR = 1e-6
R_CEILING = 20.0  # bound of r that keeps cosh(r)^2 in the range of float32; tanh is 1 there
TANH_CEILING = 1.0 - 1e-4  # largest tanh of the inverse map, so that the slope of the map is not zero

_F = TypeVar("_F", np.float32, np.float64)


def map_named(name: str, form: str | None) -> str:
    """Return `name`, or for "auto" the default map of the form. The result is "" for shapes without a skew (None)."""
    if form is None:
        return ""
    return MAPS[form][0] if name == "auto" else name


def check_map(name: str, form: str | None) -> None:
    """Raise InputError unless `name` is "auto" or a map of the form. form : None allows every map."""
    known = SKEW_MAPS if form is None else MAPS[form]
    if name != "auto" and name not in known:
        kind = "" if form is None else f" for the {form} form of skew"
        raise InputError(f"skew_map {name!r}{kind}: choose auto or one of {', '.join(known)}")


@dataclass(frozen=True, slots=True)
class SkewMap:
    """One parameterisation of the skew.

    Arrays are s (N, width), skew and its gradient (N, 3), and quat (N, 4) of any norm above 0. All arrays and results
    have one dtype, float32 or float64. Only "coupled" depends on the rotation.

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

    @property
    def width(self) -> int:
        """Number of trainable reals per splat."""
        return 4 if self.name == "polar" else 3

    @property
    def rotates(self) -> bool:
        """Whether the skew depends on the splat's rotation too."""
        return self.name == "coupled"

    @property
    def limit(self) -> float:
        """Upper bound of the length of the skew."""
        return SKEW_MAX if self.name in MAPS["centred"] else SLANT_MAX

    def forward(self, s: NDArray[_F], quat: NDArray[_F]) -> NDArray[_F]:
        """Return the skew of s."""
        if self.name == "polar":
            return self._length(s[:, :1]) * (s[:, 1:] / _radius(s[:, 1:]))
        r = _radius(s)
        skew: NDArray[_F] = s * (self._length(r) / r)
        return _turned(skew, rotations(quat), back=True) if self.rotates else skew

    def vjp(self, s: NDArray[_F], quat: NDArray[_F], v_skew: NDArray[_F]) -> tuple[NDArray[_F], Array]:
        """Return the gradient of s and the addition to the gradient of the rotation (N, 4).

        With n = s / r, f = length / r and g = d length / dr, the Jacobian is the symmetric f I + (g - f) n n'.
        """
        if self.name == "polar":
            return self._polar_vjp(s, v_skew), np.zeros_like(quat)
        v_quat: Array = np.zeros_like(quat)
        if self.rotates:
            rotation = rotations(quat)
            world = s * (self._length(_radius(s)) / _radius(s))
            v_quat = rotations_vjp(quat, world[:, :, None] * v_skew[:, None, :])
            v_skew = _turned(v_skew, rotation)
        r = _radius(s)
        n = s / r
        f = self._length(r) / r
        along = np.sum(n * v_skew, axis=-1, keepdims=True)
        # Below R_FLOOR the factors are constants and |n| < 1. The map is f s, with the Jacobian f I.
        bend = np.where(r > R_FLOOR, self._slope(r) - f, np.zeros_like(f))
        v_s: NDArray[_F] = f * v_skew + bend * along * n
        return v_s, v_quat

    def inverse(self, skew: NDArray[_F], quat: NDArray[_F]) -> NDArray[_F]:
        """Return the s that gives `skew`. A length at or above the limit is replaced by one just below it."""
        if self.rotates:
            skew = _turned(skew, rotations(quat))
        length = np.sqrt(np.sum(skew * skew, axis=-1, keepdims=True))
        bent = length / length.dtype.type(self.limit)
        tanh = bent**3 if self.name == "cube-root" else bent
        r = np.arctanh(np.minimum(tanh, length.dtype.type(TANH_CEILING))) * length.dtype.type(self._scale)
        tiny = np.finfo(length.dtype).tiny
        if self.name == "polar":
            pole = np.array([0, 0, 1], length.dtype)  # an arbitrary direction for a skew of zero
            direction = np.where(length > tiny, skew / np.maximum(length, tiny), pole)
            return np.concatenate([r, direction], axis=-1)
        floor = np.full_like(r, R_FLOOR)
        with np.errstate(invalid="ignore"):  # non-finite values stay non-finite
            s: NDArray[_F] = skew * np.where(r > floor, r / np.maximum(length, tiny), floor / self._length(floor))
        return s

    def follow(self, s: NDArray[_F], before: Mapping[str, Array], after: Mapping[str, Array]) -> NDArray[_F]:
        """Return s after changes of the fields `skew` and `quat`.

        Changed rows get the inverse of the map. The other rows keep their s, because the inverse loses digits near the
        limit.
        """
        names = ("skew", "quat") if self.rotates else ("skew",)
        changed = np.zeros(len(s), bool)
        for name in names:
            for differs in (before[name] != after[name]).T:  # faster than any(axis=1)
                changed |= differs
        followed = s.copy()
        followed[changed] = self.inverse(after["skew"][changed], after["quat"][changed])
        return followed

    def _polar_vjp(self, s: NDArray[_F], v_skew: NDArray[_F]) -> NDArray[_F]:
        rho, u = s[:, :1], s[:, 1:]
        norm = _radius(u)
        n = u / norm
        along = np.sum(n * v_skew, axis=-1, keepdims=True)
        # Below R_FLOOR the norm is a constant.
        across = v_skew - np.where(norm > R_FLOOR, along, np.zeros_like(along)) * n
        v_s: NDArray[_F] = np.concatenate([self._slope(rho) * along, self._length(rho) / norm * across], axis=-1)
        return v_s

    @property
    def _scale(self) -> float:
        """Scale of r in the tanh: 1 in the centred form. In the direct form the slope at 0 becomes 1."""
        return 1.0 if self.name in MAPS["centred"] else SLANT_MAX

    def _length(self, r: NDArray[_F]) -> NDArray[_F]:
        """Return the length of the skew at r; odd in r."""
        tanh = np.tanh(r / r.dtype.type(self._scale))
        bent = np.cbrt(tanh) if self.name == "cube-root" else tanh
        length: NDArray[_F] = r.dtype.type(self.limit) * bent
        return length

    def _slope(self, r: NDArray[_F]) -> NDArray[_F]:
        """Return d length / dr."""
        bent = np.clip(r / r.dtype.type(self._scale), r.dtype.type(-R_CEILING), r.dtype.type(R_CEILING))
        shrink = np.cosh(bent) ** 2
        if self.name == "cube-root":
            root = np.cbrt(np.tanh(bent))
            shrink = shrink * (3 * root * root)
        slope: NDArray[_F] = (self.limit / self._scale / shrink).astype(r.dtype, copy=False)
        return slope


def _radius(s: NDArray[_F]) -> NDArray[_F]:
    """Return |s|, at least R_FLOOR, (N, 1)."""
    r: NDArray[_F] = np.maximum(np.sqrt(np.sum(s * s, axis=-1, keepdims=True)), s.dtype.type(R_FLOOR))
    return r


def _turned(vector: NDArray[_F], rotation: Array, back: bool = False) -> NDArray[_F]:
    """Return R v for (N, 3) vectors, or R' v."""
    turned: NDArray[_F] = np.einsum("nji,nj->ni" if back else "nij,nj->ni", rotation, vector)
    return turned

"""Lenses of OPF projects.

Perspective lenses: Pix4D's article on internal camera parameters (https://support.pix4d.com/hc/en-us/articles/202559089)
and `examples/compute_reprojection_error.py` of https://github.com/Pix4D/pyopf. In a camera with x to the right, y down
and z forward, let x = X / Z, y = Y / Z and s = x^2 + y^2. The pixel is

    u = f (x (1 + R1 s + R2 s^2 + R3 s^3) + 2 T1 x y + T2 (s + 2 x^2)) + cx,
    v = f (y (1 + R1 s + R2 s^2 + R3 s^3) + 2 T2 x y + T1 (s + 2 y^2)) + cy,

with (0, 0) at the corner of the first pixel: OpenCV's model with p1 = T1 and p2 = T2.

Fisheyes: Strecha et al., "Camera internals for fisheye lens" (Pix4D). With the angle a from the axis, the direction
(x, y) / |(x, y)| is multiplied by p0 + p1 t + p2 t^2 + ... for t = 2 a / pi, then by [[c, d], [e, f]], then the centre
is added. OPENCV_FISHEYE has the odd powers of a; `odd_powers` finds the nearest of its polynomials.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from ...errors import InputError
from ...files.json_file import MAX_NUMBER, get_matrix, get_text, get_value
from ..undistort import Lens, brown_lens, make_lens
from .lens_fit import MAX_ERROR, odd_powers

REMEDY = "export the project again"
_MAX_TERMS = 10  # the polynomial of a fisheye has 4


def opf_lens(internals: dict[str, Any], width: int, height: int) -> Lens:
    """Return the lens of the internals of a sensor.

    Parameters
    ----------
    internals : the object `internals` of a calibrated sensor.
    width, height : size of its photos [px].

    Raises
    ------
    InputError : a key is missing or has a bad value, or the lens has no counterpart.
    """
    kind = get_text(internals, "type", REMEDY)
    if kind not in _READERS:
        raise InputError(
            f"key 'type' is {kind[:40]!r}; only {' and '.join(_READERS)} lenses have a pinhole image: make perspective "
            "views first"
        )
    return _READERS[kind](internals, width, height)


def _perspective(internals: dict[str, Any], width: int, height: int) -> Lens:
    cx, cy = numbers(internals, "principal_point_px", 2)
    focal = float(_number(internals, "focal_length_px"))
    if focal <= 0.0:
        raise InputError(f"key 'focal_length_px' is {focal:g}; it must be above 0")
    radial, tangential = numbers(internals, "radial_distortion", 3), numbers(internals, "tangential_distortion", 2)
    return brown_lens(width, height, (focal, focal, cx, cy), radial.tolist(), tangential.tolist())


def _fisheye(internals: dict[str, Any], width: int, height: int) -> Lens:
    cx, cy = numbers(internals, "principal_point_px", 2)
    across, skew, other, down = numbers(internals, "affine", 4)
    found = get_value(internals, "polynomial", REMEDY)
    terms = len(found) if isinstance(found, list) else 0
    if not 2 <= terms <= _MAX_TERMS:
        raise InputError(f"key 'polynomial' has {terms} numbers; expected 2 to {_MAX_TERMS}")
    per_radian = (2.0 / math.pi) ** np.arange(terms)
    polynomial = Polynomial(numbers(internals, "polynomial", terms) * per_radian)
    if skew or other or polynomial.coef[0]:
        raise InputError(
            "a fisheye whose 'affine' has d or e, or whose 'polynomial' begins with another number than 0, has no "
            "counterpart in COLMAP: undistort the photos first"
        )
    if min(across, down) <= 0.0 or polynomial.coef[1] <= 0.0:
        raise InputError("'affine' and the second number of 'polynomial' must be above 0; calibrate the project again")
    corner = max(math.hypot((cx - x) / across, (cy - y) / down) for x in (0, width) for y in (0, height))
    powers, error = odd_powers(polynomial, corner)
    if not error * max(across, down) <= MAX_ERROR or powers[0] <= 0.0:
        raise InputError(
            f"the 'polynomial' of the fisheye has no counterpart in COLMAP within {MAX_ERROR} px: undistort the photos "
            "first"
        )
    focal = powers[0]
    return make_lens(
        "OPENCV_FISHEYE", width, height, [across * focal, down * focal, cx, cy, *(powers[1:] / focal).tolist()]
    )


_READERS = {"perspective": _perspective, "fisheye": _fisheye}


def numbers(entry: dict[str, Any], key: str, count: int) -> NDArray[np.float64]:
    """Return the `count` numbers at a key, all below 1e30; raises InputError."""
    found = get_matrix(entry, key, (count,), REMEDY)
    if np.abs(found).max() >= MAX_NUMBER:
        raise InputError(f"key {key!r} has a number above {MAX_NUMBER:g}; {REMEDY}")
    return found


def _number(entry: dict[str, Any], key: str) -> float:
    return float(numbers({key: [get_value(entry, key, REMEDY)]}, key, 1)[0])

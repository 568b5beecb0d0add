"""Lenses of Agisoft Metashape.

Formulas: appendix "Camera models" of the Agisoft Metashape User Manual, Professional Edition. In a camera with x to the
right, y down and z forward, a frame camera has x = X / Z, y = Y / Z. A fisheye has (x, y) of the same direction. With
the angle a from the axis, the length of (x, y) is a; in an equisolid fisheye it is 2 sin(a / 2). Metashape 2.3 has the
types equidistant_fisheye and equisolid_fisheye. The former is the type fisheye of older files. With s = x^2 + y^2 and
the width w and height h of the photo, the pixel is

    x' = x (1 + K1 s + K2 s^2 + K3 s^3 + K4 s^4) + P1 (s + 2 x^2) + 2 P2 x y,
    y' = y (1 + K1 s + K2 s^2 + K3 s^3 + K4 s^4) + P2 (s + 2 y^2) + 2 P1 x y,
    u = w / 2 + cx + f x' + B1 x' + B2 y',    v = h / 2 + cy + f y',

with (0.5, 0.5) at the centre of the first pixel. P1 and P2 are OpenCV's p2 and p1. COLMAP's THIN_PRISM_FISHEYE has the
equidistant fisheye. An equisolid one becomes the nearest lens of this model. A frame camera with K4 becomes OpenCV's
quotient, and a small B2 is left out. `lens_fit` has the limit of the error.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from ...errors import InputError
from ...files.xml_file import get_numbers
from ..photo_size import MAX_SIDE
from ..undistort import Lens, brown_lens, make_lens
from .lens_fit import MAX_ERROR, quotient

_FRAME, _EQUISOLID = "frame", "equisolid_fisheye"
_EQUIDISTANT = ("fisheye", "equidistant_fisheye")
_KINDS = (_FRAME, *_EQUIDISTANT, _EQUISOLID)
_WIDEST = 1.5  # rad: pinhole images end before 90 degrees
_STEPS = 2000
_REMEDY = "export undistorted photos, and their cameras, as a COLMAP model"


def metashape_lens(sensor: ET.Element) -> Lens:
    """Return the lens of a <sensor>: that of its adjusted <calibration>, or else of the first one.

    Raises
    ------
    InputError : a number is missing or bad, or the camera type or a coefficient has no counterpart in COLMAP.
    """
    calibrations = sensor.findall("calibration")
    adjusted = [each for each in calibrations if each.get("class") == "adjusted"]
    calibration = next(iter([*adjusted, *calibrations]), None)
    kind = _kind(sensor if calibration is None else calibration, sensor)
    # A spherical camera has no calibration, and its type is the reason.
    if calibration is None:
        raise InputError("has no <calibration>; align the photos, and export the cameras again")
    width, height = _size(calibration, sensor)
    focal, radial, (p1, p2) = (
        _value(calibration, "f"),
        _values(calibration, "k1 k2 k3 k4"),
        _values(calibration, "p1 p2"),
    )
    (cx, cy), (b1, b2) = _values(calibration, "cx cy"), _values(calibration, "b1 b2")
    if _values(calibration, "p3 p4").any():
        raise InputError(f"p3 and p4 have no counterpart in COLMAP; {_REMEDY}")
    if min(focal, focal + b1) <= 0.0:
        raise InputError(f"its focal length f is {focal:g}, with b1 {focal + b1:g}; both must be above 0")
    core = [focal + b1, focal, width / 2 + cx, height / 2 + cy]
    skew = abs(b2) * (height / 2 + abs(cy)) / focal  # px, at the upper or lower edge
    if skew > MAX_ERROR:
        raise InputError(
            f"b2 moves pixels by {skew:.2g} px and has no counterpart in COLMAP: do not fit it, or {_REMEDY}"
        )
    if kind in _EQUIDISTANT:
        return _fisheye(width, height, core, radial, (p1, p2))
    corner = math.hypot(width / 2 + abs(cx), height / 2 + abs(cy)) / focal
    if kind == _EQUISOLID:
        factors, ratio, error = _equidistant(radial, math.hypot(p1, p2), corner)
        if not error * max(core[:2]) <= MAX_ERROR:
            raise InputError(f"k1 to k4, p1 and p2 have no counterpart in COLMAP within {MAX_ERROR} px: {_REMEDY}")
        return _fisheye(width, height, core, factors, (ratio * p1, ratio * p2))
    factors, error = quotient(radial, corner)
    if not error * focal <= MAX_ERROR:
        raise InputError(f"k1 to k4 have no counterpart in COLMAP within {MAX_ERROR} px: do not fit k4, or {_REMEDY}")
    return brown_lens(width, height, core, factors.tolist(), (p2, p1))


def _kind(calibration: ET.Element, sensor: ET.Element) -> str:
    kind = calibration.get("type") or sensor.get("type") or _FRAME
    if kind not in _KINDS:
        raise InputError(
            f"its type is {ascii(kind)[:40]}; only {', '.join(_KINDS[:-1])} and {_KINDS[-1]} cameras have a pinhole "
            "image: make perspective views first"
        )
    return kind


def _fisheye(
    width: int, height: int, core: list[float], radial: NDArray[np.float64], tangential: tuple[float, float]
) -> Lens:
    """Return the lens of an equidistant fisheye.

    Parameters
    ----------
    core : focal lengths fx, fy and centre [px].
    radial : k1 to k4, (4,).
    tangential : Metashape's p1 and p2.
    """
    k1, k2, k3, k4 = radial.tolist()
    p1, p2 = tangential
    return make_lens("THIN_PRISM_FISHEYE", width, height, [*core, k1, k2, p2, p1, k3, k4, 0.0, 0.0])


def _equidistant(
    radial: NDArray[np.float64], tangential: float, reach: float
) -> tuple[NDArray[np.float64], float, float]:
    """Return the equidistant fisheye nearest to an equisolid one, and the largest error.

    Parameters
    ----------
    radial : k1 to k4 of the equisolid fisheye, (4,).
    tangential : length of (p1, p2).
    reach : distorted radius of the farthest corner.

    Returns
    -------
    k1 to k4 of the equidistant fisheye, (4,), the factor from p1 and p2 to its own, and the largest error in units of
    the radius.
    """
    angle = np.linspace(0.0, _WIDEST, _STEPS)
    square = (2.0 * np.sin(angle / 2.0)) ** 2
    radius = np.sqrt(square) * Polynomial(np.append(1.0, radial))(square)
    ends = np.flatnonzero((radius[:-1] >= reach) | (np.diff(radius) <= 0.0))
    used = slice(max(ends[0] + 1, 2) if ends.size else _STEPS)
    angle, square, radius = angle[used], square[used], radius[used]
    largest = angle[-1]
    # The focal length stays, because both radii begin as the angle.
    powers = np.stack([(angle / largest) ** power for power in (3, 5, 7, 9)], axis=1)
    found = np.linalg.lstsq(powers, (radius - angle) / largest, rcond=None)[0]
    error = np.abs(angle + largest * (powers @ found) - radius).max()
    ratio = float(square @ angle**2 / (angle**2 @ angle**2))
    # The tangential terms move a point by up to 3 s |(p1, p2)|, in its own direction.
    error += 3.0 * tangential * np.abs(square - ratio * angle**2).max()
    return found / largest ** np.array([2, 4, 6, 8]), ratio, float(error)


def _size(calibration: ET.Element, sensor: ET.Element) -> tuple[int, int]:
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    texts = [(resolution.get(key, "") if resolution is not None else "") for key in ("width", "height")]
    sides = [int(text) if text.isdecimal() and len(text) < 9 else 0 for text in texts]
    if not all(1 <= side <= MAX_SIDE for side in sides):
        raise InputError(f"its <resolution> is {' x '.join(ascii(text)[:20] for text in texts)}; expected pixels")
    return sides[0], sides[1]


def _value(calibration: ET.Element, name: str) -> float:
    found = get_numbers(calibration, name, 1)
    if found is None:
        raise InputError(
            f"its <calibration> has no <{name}>; export the cameras with Metashape, or PhotoScan 1.2 or later"
        )
    return float(found[0])


def _values(calibration: ET.Element, names: str) -> NDArray[np.float64]:
    """Return the values of several children; a missing one is 0."""
    found = [get_numbers(calibration, name, 1) for name in names.split()]
    return np.array([0.0 if value is None else value[0] for value in found])

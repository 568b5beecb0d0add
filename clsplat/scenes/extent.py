"""The size of a scene as training needs it: learning rates of positions and limits of sizes are in proportion to it.

3DGS takes 1.1 times the largest distance of a camera from the mean of all. If the cameras go around an object, this is
about as wide as what they see. On a tripod it is far too small, and so it is for cameras that look ahead from nearly
one place. For photos from afar, and with one wrong pose, it is far too large. So cameras that are far from all others
do not count, and what the cameras see limits the result. On a walk it grows with the way, and in a survey with the
area, although each camera sees what is near it: there the nearest points limit the result.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..cameras.camera import Camera
from ..cameras.orbits import in_one_place, where_axes_meet
from ..cameras.seen import sampled, seen
from ..splats.fields import DoubleArray

_MARGIN = 1.1  # of 3DGS
_USUAL_SHARE = 0.95  # of the cameras; their largest distance from the middle is usual
_FAR = 3.0  # usual distances, beyond which a camera does not count

# Limits of the extent in half diagonals of the images at the depth of the points. Cameras around an object have 1 to 3.
_SMALLEST, _LARGEST = 0.3, 4.0
_LARGEST_OF_WALK = 1.4  # half diagonals at the depth of the nearest points
_MIDDLE, _NEAREST = 0.5, 0.1  # parts of the points in an image that are nearer than the depth
_AROUND = 0.75  # of the cameras that see the place where all look, so that they are around it
_MAX_CAMERAS = 100  # that are looked through
_MIN_POINTS = 20  # in an image, so that their median depth is that of the scene


def extent_of(cameras: Sequence[Camera], xyz: DoubleArray) -> float:
    """Return the size of a scene [world units]. It is 1 if all cameras are at one position and see no points.

    Parameters
    ----------
    cameras : training cameras, at least one. xyz : (P, 3) points of the scene; P may be 0.
    """
    cameras = together(cameras)
    centres, some = np.array([camera.position for camera in cameras]), sampled(xyz)
    extent = 0.0 if in_one_place(centres) else _reach(centres)
    cameras = cameras[:: -(-len(cameras) // _MAX_CAMERAS)]
    middle = _depths_of_middle(cameras)
    if (width := _width_at_points(cameras, some, _MIDDLE)) is not None:
        largest = _LARGEST * width
        if np.isfinite(middle).mean() < _AROUND and (near := _width_at_points(cameras, some, _NEAREST)) is not None:
            largest = min(largest, _LARGEST_OF_WALK * near)
        extent = max(min(extent, largest), _SMALLEST * width)
    elif extent > 0 and np.isfinite(middle).all():
        widths = [_half_diagonal(camera) * depth for camera, depth in zip(cameras, middle, strict=True)]
        extent = min(extent, _LARGEST * float(np.median(widths)))
    return extent if extent > 0 else 1.0


def together(cameras: Sequence[Camera]) -> list[Camera]:
    """Return the cameras without those that are far from all others: their poses are wrong."""
    centres = np.array([camera.position for camera in cameras])
    away = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    usual = float(np.quantile(away, _USUAL_SHARE, method="lower"))
    return [camera for camera, far in zip(cameras, away, strict=True) if usual == 0 or far <= _FAR * usual]


def _reach(centres: DoubleArray) -> float:
    """Return 3DGS's extent of the centres (N, 3)."""
    return _MARGIN * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


def _width_at_points(cameras: Sequence[Camera], xyz: DoubleArray, nearer: float) -> float | None:
    """Return half the diagonal of an image at the depth of its points, a median of images; None if they have too few.

    nearer : part of the points in an image that are nearer than this depth.
    """
    widths: list[float] = []
    for camera in cameras:
        found = seen(camera, xyz)
        if np.count_nonzero(found.inside) >= _MIN_POINTS:
            widths.append(_half_diagonal(camera) * float(np.quantile(found.depth[found.inside], nearer)))
    return float(np.median(widths)) if widths else None


def _depths_of_middle(cameras: Sequence[Camera]) -> DoubleArray:
    """Return the depth of the place where all cameras look, in each of them, (N,); infinity outside its image."""
    middle = where_axes_meet(cameras)
    if middle is None:
        return np.full(len(cameras), np.inf)
    found = [seen(camera, middle[None]) for camera in cameras]
    return np.array([one.depth[0] if one.inside[0] else np.inf for one in found])


def _half_diagonal(camera: Camera) -> float:
    """Return half the diagonal of an image at a depth of 1."""
    return 0.5 * float(np.hypot(camera.width / camera.fx, camera.height / camera.fy))

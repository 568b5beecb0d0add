"""Scenes whose coordinates are large numbers, as those of maps are. They are moved, because float32 trains them.

A scene is moved by round numbers. So a photo more or less does not change them.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cameras.orbits import ROUNDING
from ..cameras.seen import sampled, sampled_views
from ..errors import InputError
from ..splats.fields import Array
from .posed_images import PosedImages

# Largest distance from the origin in units of the scene's size. Beyond it, training in float32 loses image quality.
FAR = 1e4
# In a long scene details are small for its size. The step of float32 there may be this part of a pixel.
_STEP_SHARE = 0.5
_LONG = FAR / 100.0  # scenes nearer to the origin, in units of their size, are no case for this rule
_NEAREST = 0.1  # part of the points in an image that are nearer than its details
_FEWEST_POINTS = 5  # in an image, to tell where its details are
_LOST = 1e10  # beyond this distance, float64 has lost the scene, too


def near_origin(root: Path, posed: PosedImages, size: float, origin: Sequence[float] | None = None) -> PosedImages:
    """Return a scene in coordinates that float32 holds.

    Parameters
    ----------
    size : of the scene (`size_of`).
    origin : the point of the file's coordinates that becomes the origin, (3,). By default that is a round point inside
        a scene that is far from the origin, and other scenes are not moved.

    Warns
    -----
    UserWarning : the scene is moved, and `origin` is None.

    Raises
    ------
    InputError : `origin` is not three finite numbers.
    """
    shift = _round_point(posed, size) if origin is None else _checked(origin)
    if not shift.any():
        return posed
    if origin is None:
        place = ", ".join(f"{value:.15g}" for value in shift)
        warnings.warn(
            f"{root}: is too far from the origin for its size or its details, which float32 cannot hold: "
            f"({place}) becomes the origin of the scene and of its model",
            stacklevel=4,
        )
    photos = []
    for photo in posed.photos:
        pose = photo.cam_from_world.copy()
        pose[:3, 3] += pose[:3, :3] @ shift
        photos.append(replace(photo, cam_from_world=pose))
    points = replace(posed.points, xyz=posed.points.xyz - shift)
    return replace(posed, photos=photos, points=points, origin=(float(shift[0]), float(shift[1]), float(shift[2])))


def _checked(origin: Sequence[float]) -> NDArray[np.float64]:
    try:
        point = np.asarray(origin, np.float64)
    except (TypeError, ValueError):
        point = np.empty(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(f"origin {origin!r}: choose three finite numbers")
    return point


def camera_centres(posed: PosedImages) -> NDArray[np.float64]:
    """Return the centre of each photo's camera, (N, 3)."""
    poses = np.array([photo.cam_from_world for photo in posed.photos]).reshape(-1, 4, 4)
    return -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])


def is_far(xyz: Array) -> bool:
    """Return whether splats, (N, 3), have the coordinates of a scene that was not moved, although it might be.

    The origin of a moved scene is inside of it, so that its splats are near.
    """
    wide = xyz.astype(np.float64)
    return len(wide) > 0 and _ratio(np.median(wide, axis=0), _spread(wide) or 1.0) >= _LONG


def size_of(posed: PosedImages) -> float:
    """Return the median distance of the points, or else of the cameras, from their median; 1 if all are in one place.

    Outliers do not change it.
    """
    return _spread(posed.points.xyz) or _spread(camera_centres(posed)) or 1.0


def _spread(xyz: NDArray[np.float64]) -> float:
    if not len(xyz):
        return 0.0
    middle = np.median(xyz, axis=0)
    with np.errstate(over="ignore"):  # outliers may be at any distance
        spread = float(np.median(np.abs(xyz - middle).max(axis=1)))
    return 0.0 if spread <= ROUNDING * np.abs(middle).max() else spread


def _ratio(centre: NDArray[np.float64], size: float) -> float:
    return float(np.abs(centre).max()) / size


def _is_coarse(centre: NDArray[np.float64], detail: float) -> bool:
    """Return whether the step of float32 at a place is too large for details of this size."""
    return float(np.spacing(np.float32(np.abs(centre).max()))) > _STEP_SHARE * detail


def _round_point(posed: PosedImages, size: float) -> NDArray[np.float64]:
    """Return a round point inside a scene that is far from the origin; the origin for other scenes."""
    if not posed.photos:
        return np.zeros(3)
    centre = np.median(posed.points.xyz if len(posed.points) else camera_centres(posed), axis=0)
    ratio = _ratio(centre, size)
    if not _LONG <= ratio <= _LOST:
        return np.zeros(3)
    if ratio < FAR and not ((detail := _size_of_pixel(posed)) and _is_coarse(centre, detail)):
        return np.zeros(3)
    unit = 10.0 ** np.ceil(np.log10(size))
    return np.asarray(np.round(centre / unit) * unit, np.float64)


def _size_of_pixel(posed: PosedImages) -> float | None:
    """Return the size of a pixel at what is near the cameras [world units], a median of photos; None if it is unknown.

    Without points in the images, the way from camera to camera stands for the depth.
    """
    xyz, sizes = sampled(posed.points.xyz), list[float]()
    for photo in sampled_views(posed.photos):
        lens, pose = photo.lens, photo.cam_from_world
        local = xyz @ pose[:3, :3].T + pose[:3, 3]
        half = 0.5 * np.array([lens.width, lens.height]) / lens.mean_focal_length()
        depth = local[(local[:, 2] > 0) & (np.abs(local[:, :2]) < half * local[:, 2:]).all(axis=1), 2]
        if len(depth) >= _FEWEST_POINTS:
            sizes.append(float(np.quantile(depth, _NEAREST)) / lens.mean_focal_length())
    if sizes:
        return float(np.median(sizes))
    ways = np.linalg.norm(np.diff(camera_centres(posed), axis=0), axis=1)
    focal = float(np.median([photo.lens.mean_focal_length() for photo in posed.photos]))
    return float(np.median(ways)) / focal if len(ways) and np.median(ways) > 0 else None

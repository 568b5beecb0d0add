"""Points that do not fit the photos, such as those of another coordinate system than the poses.

Photos show the colour of a point where it lies. Wrong points lie in the photos by chance. Points may also have colours
that are not those of the scene, such as their heights. Such points are right if the photos agree about what is there:
whether it is brighter or darker than the pixels around it. Brightness alone would agree by chance, because near photos
have the sky, or a wall, in the same place.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cameras.seen import Seen, sampled, sampled_views, seen
from ..scenes.colmap import NO_POINTS, Points
from ..splats.color import SPREAD
from ..splats.fields import DoubleArray
from .silhouettes import opaque_at

if TYPE_CHECKING:
    from ..scenes.scene import Scene
    from ..scenes.view import View

# Between those of right and of wrong points (docs/decisions.md, "Points that do not fit the photos are left out").
_LEAST_CORRELATION, _LEAST_AGREEMENT = 0.05, 0.1
_FEWEST_POINTS = 100  # in two photos or more
_CELLS = 16  # along each side of a photo; only the nearest point of a cell counts, because walls hide the others
_SAMPLED = 20_000  # points that are looked at: enough if most of them are in other rooms
_AROUND = 5  # side of the square of pixels that a pixel is compared with
_FLOOR = 10.0  # added to brightness 0..255 before its logarithm, so that noise in the dark counts little


def with_fitting_points(scene: Scene) -> Scene:
    """Return the scene, or without its points if they do not fit its training photos.

    The result says so (`Scene.points_fit`), and is not looked at again.

    Warns
    -----
    UserWarning : the points are left out.
    """
    if scene.points_fit:
        return scene
    fit = point_fit(scene.train, scene.points)
    if fit is None or fit[0] >= _LEAST_CORRELATION or fit[1] >= _LEAST_AGREEMENT:
        return replace(scene, points_fit=True)
    warnings.warn(
        f"{scene.path}: the photos do not show the colours of its {len(scene.points)} points where these lie, so the "
        "points do not fit the poses; they are left out: check that both have one coordinate system",
        stacklevel=3,
    )
    return replace(scene, points=NO_POINTS, points_fit=True)


def point_fit(views: Sequence[View], points: Points) -> tuple[float, float] | None:
    """Return how well photos show points; None if too few points are in several photos, or if points have no colours.

    In each part of a photo, only the nearest point counts. Masked and transparent pixels do not count.

    Returns
    -------
    The correlation of the brightness of points and pixels, over all photos; -1 to 1.
    The intraclass correlation of the local contrasts of a point in several photos (Fisher 1925), at most 1.
    """
    if not len(points) or np.ptp(points.rgb.astype(int), axis=0).max() <= SPREAD:
        return None
    xyz, colors = sampled(points.xyz, _SAMPLED), sampled(points.rgb, _SAMPLED)
    found = np.array([_at_points(view.loaded(), xyz) for view in sampled_views(views)])
    if not len(found):
        return None
    pixels, contrasts = found[:, 0], found[:, 1]
    shown = ~np.isnan(pixels)
    count = shown.sum(axis=0)
    several = count > 1
    if np.count_nonzero(several) < _FEWEST_POINTS:
        return None
    brightness = np.broadcast_to(colors.mean(axis=1), pixels.shape)
    contrasts, count = contrasts[:, several], count[several]
    within = np.nansum((contrasts - np.nansum(contrasts, axis=0) / count) ** 2) / np.sum(count - 1)
    overall = np.nanvar(contrasts)
    if not overall or not brightness[shown].std() or not pixels[shown].std():
        return None
    return float(np.corrcoef(brightness[shown], pixels[shown])[0, 1]), float(1.0 - within / overall)


def _at_points(view: View, xyz: DoubleArray) -> DoubleArray:
    """Return the brightness and the local contrast where points are in a photo, (2, P); NaN where it does not show one.

    The local contrast is the logarithm of the brightness, less its mean over the pixels around.
    """
    found = seen(view.camera, xyz)
    index, row, column = _nearest(found, view.camera.width, view.camera.height)
    image, near = np.asarray(view.image), np.arange(_AROUND) - _AROUND // 2
    rows = np.clip(row[:, None] + near, 0, image.shape[0] - 1)
    columns = np.clip(column[:, None] + near, 0, image.shape[1] - 1)
    around = image[rows[:, :, None], columns[:, None, :]].mean(axis=3)  # (P, 5, 5)
    center = around[:, _AROUND // 2, _AROUND // 2]
    shown = np.array([center, np.log(center + _FLOOR) - np.log(around + _FLOOR).mean(axis=(1, 2))])
    shown[:, ~opaque_at(view, (row, column))] = np.nan
    values = np.full((2, len(xyz)), np.nan)
    values[:, index] = shown
    return values


def _nearest(found: Seen, width: int, height: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return index, row and column of the nearest point in each cell of a photo with this size [px]."""
    row, column = found.rows_and_columns
    index = np.flatnonzero(found.inside)
    cell = row * _CELLS // height * _CELLS + column * _CELLS // width
    order = np.lexsort((found.depth[index], cell))
    first = order[np.diff(cell[order], prepend=-1) > 0]
    return index[first], row[first], column[first]

"""Colours of points from the photos, for files of points without colours: all points have one colour there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..cameras.seen import sampled_views, seen
from .silhouettes import opaque_at

if TYPE_CHECKING:
    from ..scenes.colmap import Points
    from ..scenes.view import View

_AT_A_TIME = 65_536  # points, which keeps the pixels of all photos small


def with_colors(points: Points, views: Sequence[View]) -> Points:
    """Return the points with the colours of the photos, if all points have one colour; else the same points.

    A point gets the median of the pixels where it is, in at most 32 photos. A photo may show something before it, but
    rarely do half of them. Points that no photo shows keep their colour.
    """
    if len(points.rgb) < 2 or (points.rgb != points.rgb[0]).any():
        return points
    rgb = points.rgb.copy()
    photos = [view.loaded() for view in sampled_views(views)]
    for first in range(0, len(points.rgb), _AT_A_TIME):
        part = slice(first, first + _AT_A_TIME)
        pixels = np.full((len(photos), *rgb[part].shape), np.nan, np.float32)
        for number, photo in enumerate(photos):
            found = seen(photo.camera, points.xyz[part])
            at = found.rows_and_columns
            color = np.asarray(photo.image)[at].astype(np.float32)
            color[~opaque_at(photo, at)] = np.nan
            pixels[number, found.inside] = color
        shown = ~np.isnan(pixels[:, :, 0]).all(axis=0)
        rgb[part][shown] = np.rint(np.nanmedian(pixels[:, shown], axis=0))
    return replace(points, rgb=rgb)

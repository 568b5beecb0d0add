"""Pixels that are the same in all photos, although the scene goes on there.

Bars of a video, rims that undistortion leaves without data, watermarks and the bonnet of a car are such pixels. A run
would learn them as a part of the scene, right in front of each camera. Nothing behind an object is such a place: no
points of the scene are there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from ..cameras.camera import Camera
from ..cameras.seen import sampled, sampled_views, seen
from ..files.masks import Mask
from ..splats.color import SPREAD
from ..splats.fields import DoubleArray
from .view import View

FEWEST_VIEWS = 6  # fewer photos may agree by chance
_FEWEST_POINTS = 50  # points in all photos together, in the pixels that do not change
LEAST, _MOST = 0.01, 0.3  # of a photo: less is harmless, more is the background of an object
MOST_OF_RIM = 0.8  # of a photo, if what all photos show has the same outline
ALIKE_OUTLINES = 0.9  # of what any photo shows, the mean share that a photo shows: those of objects differ
# Least points a pixel, in units of the mean of the photo. Points gather in the middle of photos, far from rims.
DENSITY = 0.03
EMPTY = 8  # largest alpha of a pixel without data
_ALIKE = 0.8  # of the transparent pixels of photos, those that all photos have in common; silhouettes of objects differ


class StillPixels(NamedTuple):
    """Pixels that never change: their share of a photo, 0 to 1, and whether they are transparent."""

    share: float
    is_empty: bool


def pixels_before_scene(views: Sequence[View], xyz: DoubleArray) -> StillPixels | None:
    """Return the pixels that never change where points of the scene lie; None if there are hardly any, or too many.

    Parameters
    ----------
    views : those of the commonest size are looked at, at most 32 of them. xyz : points of the scene (P, 3).
    """
    sizes = Counter((view.camera.width, view.camera.height) for view in views)
    if not len(xyz) or not sizes:
        return None
    size, count = sizes.most_common(1)[0]
    alike = [view for view in views if (view.camera.width, view.camera.height) == size]
    if count < FEWEST_VIEWS:
        return None
    still, is_empty, is_rim = still_pixels(sampled_views(alike))
    limit = MOST_OF_RIM if is_rim else _MOST
    if not hide_points(float(still.mean()), ((view.camera, still) for view in alike), xyz, limit):
        return None
    return StillPixels(float(still.mean()), is_empty)


def hide_points(share: float, parts: Iterable[tuple[Camera, Mask]], xyz: DoubleArray, limit: float = _MOST) -> bool:
    """Return whether points of the scene lie in parts of photos, which are neither tiny nor most of the photos.

    Parameters
    ----------
    share : of the pixels of a photo in its part, 0 to 1. Parts of another size than is possible are not looked at.
    parts : camera of each photo, and the part of it, (H, W) bool. xyz : points of the scene (P, 3).
    limit : largest share of the pixels, and of the points.
    """
    if not LEAST <= share <= limit:
        return False
    some = sampled(xyz)
    inside, within = 0, 0
    for camera, part in parts:
        found = seen(camera, some)
        inside += int(np.count_nonzero(found.inside))
        within += int(np.count_nonzero(part[found.rows_and_columns]))
    return within >= _FEWEST_POINTS and DENSITY * share <= within / inside <= limit


def still_pixels(views: Sequence[View]) -> tuple[Mask, bool, bool]:
    """Return the pixels that are transparent in all photos, or else of one colour, (H, W).

    Two further results say whether they are transparent, and whether what the photos show then has the same outline.

    Transparent pixels count only if they are about the same in all photos. Else they are around the silhouettes of an
    object.

    Parameters
    ----------
    views : of one size. Their photos are decoded one after the other. Pixels that a mask hides in any of them do not
        count.
    """
    photos = (view.loaded() for view in views)
    first = next(photos)
    low, high = first.image.copy(), first.image.copy()
    counted: Mask = np.ones(low.shape[:2], np.bool_)
    empty: Mask | None = counted.copy()  # None as soon as a photo is opaque
    transparent = 0  # pixels of all photos
    for photo in chain([first], photos):
        if photo.mask is not None:
            counted &= photo.mask
        if empty is not None and photo.alpha is not None:
            part = photo.alpha <= EMPTY
            transparent += int(np.count_nonzero(part))
            empty = empty & part
        else:
            empty = None
        np.minimum(low, photo.image, out=low)
        np.maximum(high, photo.image, out=high)
    if empty is not None:
        alike = len(views) * int(np.count_nonzero(empty)) >= _ALIKE * transparent
        n_shown = len(views) * empty.size - transparent
        is_rim = n_shown >= ALIKE_OUTLINES * len(views) * int(np.count_nonzero(~empty))
        return counted & empty & alike, True, is_rim
    still: Mask = (high - low).max(axis=2) <= SPREAD
    return counted & still, False, False

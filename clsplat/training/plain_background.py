"""A colour that surrounds an object in all photos: studio photos, and renders that are stored without transparency.

With that colour behind the splats, no splat has to show it. Behind another colour, splats would stand in front of the
cameras for it, and other views see them before the object. Photos whose background is cut out (scenes/cut_out.py) have
all that transparent photos have: a start inside the silhouettes, and random backgrounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..cameras.seen import sampled_views
from ..splats.color import SPREAD, Color
from ..splats.fields import DoubleArray

if TYPE_CHECKING:
    from ..scenes.view import View

_SHARE = 0.9  # of the pixels at the sides of a photo, and of the photos, that have the colour


def plain_background(views: Sequence[View]) -> Color | None:
    """Return the colour, 0..1, at all four sides of nearly all photos; None without one.

    Parameters
    ----------
    views : training views. At most 32 of them are read, evenly spread. If one of them has transparent or masked
        pixels, these are the background, and the result is None.
    """
    found: list[DoubleArray] = []
    for view in sampled_views(views):
        photo = view.loaded()
        if photo.alpha is not None or photo.mask is not None:
            return None
        found.append(_side_color(np.asarray(photo.image)))
    colors = np.array(found).reshape(-1, 3)
    plain = colors[np.isfinite(colors).all(axis=1)]
    if not len(plain):
        return None
    color = np.median(plain, axis=0)
    if np.count_nonzero(np.abs(plain - color).max(axis=1) <= SPREAD) < _SHARE * len(colors):
        return None
    red, green, blue = (float(part) for part in color / 255.0)
    return red, green, blue


def _side_color(image: np.ndarray) -> DoubleArray:
    """Return the colour of the outermost pixels of an image (H, W, 3), 0 to 255; NaN if they have several."""
    sides = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]).astype(np.float64)
    color = np.median(sides, axis=0)
    alike = np.abs(sides - color).max(axis=1) <= SPREAD
    return np.asarray(color if alike.mean() >= _SHARE else np.full(3, np.nan))

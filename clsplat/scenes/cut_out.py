"""Photos of an object before one colour, as photos with transparency: the colour is cut out.

Pixels of the colour are cut out if they are connected to a side of the photo, or surrounded by pixels that differ much:
the background is seen through a hole. A bright spot of the object, which fades into the colour, stays. Pixels next to
the cut mix the object with the colour. How much of the object they have follows from the purest pixel nearby, as in
matting with a known background (Smith and Blinn, Blue Screen Matting, 1996).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..files.masks import Mask
from ..splats.color import SPREAD, Color
from .view import StoredView, View

FloatImage = NDArray[np.float32]

_NOISY_SPREAD = 12  # SPREAD in a photo with noise, such as the traces of JPEG beside outlines
_NOISY = 0.9  # pixels that nearly have the colour in a photo with noise, for each pixel of the outline; without, some
_REACH = 2  # px from a mixed pixel, or from a hole, to pixels that may be the pure object
_CONTRAST = 50.0  # smallest distance of the object from the colour, 0 to 441, by which a mixture is resolved
_RING_SHARE = 0.9  # of the pixels around a hole that are the object for sure
_SMALLEST_HOLE = 4  # px: smaller ones are noise
_WORKING_BYTES = 48  # of a pixel, while a photo is cut out
_CORNERS = np.ones((3, 3), np.bool_)  # neighbours of a pixel, also those at its corners


def share_cut_out(views: Sequence[View], color: Color) -> float:
    """Return the share of the pixels of photos, 0 to 1, that `cut_out` makes transparent. Each photo counts alike."""
    shares = [np.mean(view.alpha == 0) for photo in views if (view := cut_out(photo.loaded(), color)).alpha is not None]
    return float(np.mean(shares)) if shares else 0.0


def cut_out_when_read(view: View, color: Color) -> View:
    """Return the view with `cut_out`. A photo that is not in memory is cut out when it is decoded."""
    if isinstance(view, StoredView):
        nbytes = _WORKING_BYTES * view.camera.width * view.camera.height
        return view.changed(lambda photo: cut_out(photo, color), nbytes)
    return cut_out(view, color)


def cut_out(view: View, color: Color) -> View:
    """Return the view with `alpha`: 0 where the photo has the colour, from its sides inwards.

    Parameters
    ----------
    view : a photo. One with transparency or with a mask stays as it is.
    color : the colour behind the object, each part 0 to 1.
    """
    if view.alpha is not None or view.mask is not None:
        return view
    difference = np.asarray(view.image).astype(np.float32) - np.rint(255.0 * np.asarray(color)).astype(np.float32)
    contrast = np.einsum("ijk,ijk->ij", difference, difference)
    empty = _background(_alike(np.abs(difference).max(axis=2)), contrast)
    alpha = np.where(empty, np.uint8(0), np.uint8(255))
    _set_mixed(alpha, empty, difference, contrast)
    return View(view.name, view.camera, view.image, None, alpha)


def _alike(difference: FloatImage) -> Mask:
    """Return which pixels have the colour but for noise. difference : (H, W), the largest one of a pixel's channels."""
    from scipy.ndimage import binary_dilation  # lazy: a slow import

    alike: Mask = difference <= SPREAD
    outline = binary_dilation(alike, _CORNERS) & ~alike
    if np.count_nonzero(alike & (difference > 0)) > _NOISY * np.count_nonzero(outline):
        alike = difference <= _NOISY_SPREAD
    return alike


def _background(alike: Mask, contrast: FloatImage) -> Mask:
    """Return which of the pixels with the background's colour are background, (H, W)."""
    from scipy.ndimage import binary_dilation, label, maximum_filter

    regions, n_regions = label(alike)
    wider = maximum_filter(regions, 2 * _REACH + 1)
    around = (wider > 0) & ~binary_dilation(alike, _CORNERS)  # without the mixed pixels, which are next to a region
    counts = np.bincount(wider[around], minlength=n_regions + 1)
    differing = np.bincount(wider[around & (contrast >= _CONTRAST**2)], minlength=n_regions + 1)
    sizes = np.bincount(regions.ravel(), minlength=n_regions + 1)
    chosen = (sizes >= _SMALLEST_HOLE) & (counts > 0) & (differing >= _RING_SHARE * counts)
    for side in (regions[0], regions[-1], regions[:, 0], regions[:, -1]):
        chosen[side] = True
    chosen[0] = False  # pixels of other colours
    found: Mask = chosen[regions]
    return found


def _set_mixed(alpha: NDArray[np.uint8], empty: Mask, difference: FloatImage, contrast: FloatImage) -> None:
    """Set the opacity of the pixels next to empty ones.

    A pixel p = a f + (1 - a) c mixes the object's colour f with the background's c. f is the nearby pixel that differs
    most from c, and a is the least-squares solution. If the object hardly differs from c, the pixel stays opaque.

    Parameters
    ----------
    difference : (H, W, 3), of the photo from the colour, in steps of a byte. contrast : (H, W), its squared length.
    """
    from scipy.ndimage import binary_dilation

    y, x = np.nonzero(binary_dilation(empty, _CORNERS) & ~empty)
    height, width = empty.shape
    mixed = difference[y, x]
    pure, largest = mixed.copy(), contrast[y, x]
    steps = range(-_REACH, _REACH + 1)
    for row, column in ((row, column) for row in steps for column in steps):
        place = np.clip(y + row, 0, height - 1), np.clip(x + column, 0, width - 1)
        more = contrast[place] > largest
        pure[more], largest[more] = difference[place][more], contrast[place][more]
    share = np.where(largest < _CONTRAST**2, 1.0, (mixed * pure).sum(axis=1) / np.maximum(largest, 1.0))
    alpha[y, x] = np.rint(255.0 * np.clip(share, 1 / 255, 1.0))

"""Rims of one colour around all photos: image circles of fisheye lenses, and corners that undistortion leaves empty.

The colour is in all four corners of each photo. What all photos show has the same outline. An object in front of one
colour has other outlines in each photo, and a dark or bright scene has its colour in other places.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from ..cameras.seen import sampled_views
from ..errors import InputError
from ..files.images import read_image
from ..files.masks import Mask, read_mask
from ..splats.color import SPREAD
from .bars import commonest_size
from .posed_images import PosedImages
from .still_pixels import ALIKE_OUTLINES, FEWEST_VIEWS, LEAST, MOST_OF_RIM, hide_points
from .undistort import RegisteredImage

_SIDE = 1024  # px: larger photos are looked at in every second pixel, or in fewer
_SOFT = 0.01  # of the shorter side: lenses and JPEG blur the edge of a rim
_USUAL = 0.5  # of the photos: traces of JPEG beside the edge change from photo to photo
_CORNERS = ((0, 0, -1, -1), (0, -1, 0, -1))  # rows and columns


def rim_of(root: Path, posed: PosedImages, mask_of: Mapping[str, Path], known: bool = False) -> Mask | None:
    """Return the pixels of the rim that photos of the commonest size have, (H, W), and warn of it; None without one.

    The photos of all views are looked at, so that a part of a scene is read as the whole. A rim where no points lie is
    the background of an object.

    Parameters
    ----------
    root : the scene, for the warning. mask_of : files of masks by photo name. Those that hide the corners hide the rim.
    known : whether an earlier run found the rim: neither points nor a warning are needed.
    """
    size = commonest_size(posed.sizes)
    photos = [photo for photo in posed.photos if posed.sizes[photo.name] == size]
    if size is None or len(photos) < FEWEST_VIEWS or not (known or len(posed.points)):
        return None
    some = sampled_views(photos)
    # A photo that cannot be used is reported when all are read.
    with suppress(InputError):
        files = {photo.name: posed.files[photo.name] for photo in some}
        rim = find_rim(list(files.values()), {files[name] for name in files.keys() & posed.upright})
        if rim is None or known:
            return rim

        def hidden(photo: RegisteredImage) -> Mask:
            is_masked = photo.name in mask_of and not read_mask(mask_of[photo.name])[_CORNERS].any()
            return np.zeros(size[::-1], np.bool_) if is_masked else ~photo.fit_mask(~rim, *size)

        parts = ((photo.fitted_camera(*size), hidden(photo)) for photo in some)
        if hide_points(float(rim.mean()), parts, posed.points.xyz, MOST_OF_RIM):
            warnings.warn(
                f"{root}: {rim.mean():.0%} of the pixels are a rim of one colour around all photos, and points of the "
                'scene lie there: the rim is left out; with masks "none" it is a part of the photos',
                stacklevel=4,
            )
            return rim
    return None


def find_rim(files: Sequence[Path], upright: Collection[Path] = ()) -> Mask | None:
    """Return the pixels of a rim that photos of one size have in common, (H, W); None without one.

    Reading ends at the first photo without the colour in its corners, so photos of most scenes are not read.

    Parameters
    ----------
    upright : those of the files that are turned by their EXIF orientation.

    Raises
    ------
    InputError : a photo cannot be read.
    """
    from scipy.ndimage import binary_dilation  # lazy: a slow import

    color, counts = None, None
    shown, height, width = 0.0, 0, 0
    for file in files:
        image = read_image(file, file in upright)
        if image.shape[2] == 4 and image[..., 3].min() < 255:
            return None
        height, width = image.shape[:2]
        step = -(-max(height, width) // _SIDE)
        small = image[::step, ::step, :3].astype(np.int16)
        if color is None:
            color = np.median(small[_CORNERS], axis=0)
        part = _from_corners(np.abs(small - color).max(axis=2) <= SPREAD)
        if part is None:
            return None
        shown += 1.0 - float(part.mean())
        counts = part.astype(np.int64) if counts is None else counts + part
    if counts is None:
        return None
    common = counts == len(files)
    if not LEAST <= common.mean() <= MOST_OF_RIM:
        return None
    if shown < ALIKE_OUTLINES * len(files) * (1.0 - float(common.mean())):
        return None
    usual = counts >= _USUAL * len(files)
    wider = binary_dilation(usual, iterations=max(1, round(_SOFT * min(usual.shape))))
    rows, columns = (
        np.arange(length) * len_small // length for length, len_small in zip((height, width), wider.shape, strict=True)
    )
    rim: Mask = wider[rows[:, None], columns]
    return rim


def _from_corners(part: Mask) -> Mask | None:
    """Return what is connected with the corners in a part of a photo, (H, W); None unless all corners belong to it."""
    from scipy.ndimage import label  # lazy: a slow import

    if not part[_CORNERS].all():
        return None
    regions, _ = label(part)
    connected: Mask = np.isin(regions, regions[_CORNERS])
    return connected

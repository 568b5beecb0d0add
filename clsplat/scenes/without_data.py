"""Parts of photos that hold no data: transparent rims, and bars. Points of the scene that lie there show it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from ..cameras.seen import sampled_views
from ..errors import InputError
from ..files.images import has_alpha
from ..files.masks import Mask, read_mask
from ..splats.color import Color
from .bars import NO_BARS, Bars, commonest_size, find_bars
from .options import ALPHA_USES
from .posed_images import PosedImages
from .read_view import PhotoReader
from .still_pixels import FEWEST_VIEWS, hide_points, pixels_before_scene
from .undistort import RegisteredImage
from .view import StoredView


def use_of_alpha(root: Path, posed: PosedImages, resolution: int, background: Color) -> str:
    """Return what the transparency of the photos means, one of ALPHA_USES, and warn if it means that data is missing.

    The photos of all views are looked at, so that a part of a scene is read as the whole.

    Parameters
    ----------
    root : the scene, for the warning. resolution, background : as for `load_scene`.
    """
    some = sampled_views(posed.photos)
    readers = [
        PhotoReader(photo, posed.files[photo.name], posed.sizes[photo.name], resolution, background, None, False)
        for photo in some
    ]
    found = None
    # A photo that cannot be used is reported when all are read.
    with suppress(InputError):
        if len(posed.points) and all(has_alpha(reader.file) for reader in readers):
            views = [StoredView(reader.photo.name, reader.camera(), reader.view) for reader in readers]
            found = pixels_before_scene(views, posed.points.xyz)
    if found is None:
        return ALPHA_USES[0]
    warnings.warn(
        f"{root}: {found.share:.0%} of the pixels are transparent in all photos, but points of the scene lie there: "
        'they are left out as pixels without data (alpha "mask"); with alpha "background" they are the background of '
        "an object",
        stacklevel=4,
    )
    return ALPHA_USES[1]


def bars_of(root: Path, posed: PosedImages, mask_of: Mapping[str, Path]) -> Bars:
    """Return the bars that hide the scene in photos of the commonest size, and warn of them.

    The photos of all views are looked at, as by `use_of_alpha`. Bars where no points lie are the background of an
    object.

    Parameters
    ----------
    root : the scene, for the warning. mask_of : files of masks by photo name. What they hide already is not looked at.
    """
    size = commonest_size(posed.sizes)
    photos = [photo for photo in posed.photos if posed.sizes[photo.name] == size]
    if size is None or len(photos) < FEWEST_VIEWS or not len(posed.points):
        return NO_BARS
    some = sampled_views(photos)
    # A photo that cannot be used is reported when all are read.
    with suppress(InputError):
        bars = find_bars([posed.files[photo.name] for photo in some])
        if bars == NO_BARS:
            return bars
        covered = ~bars.uncovered(*size)

        def hidden(photo: RegisteredImage) -> Mask:
            part = ~photo.fit_mask(~covered, *size)
            return part & photo.fit_mask(read_mask(mask_of[photo.name]), *size) if photo.name in mask_of else part

        parts = ((photo.fitted_camera(*size), hidden(photo)) for photo in some)
        if hide_points(float(covered.mean()), parts, posed.points.xyz):
            sides = " and ".join(side for side, share in zip(bars._fields, bars, strict=True) if share)
            warnings.warn(
                f"{root}: {covered.mean():.0%} of the pixels are bars at the {sides} of all photos, and points of the "
                'scene lie there: the bars are left out; with masks "none" they are parts of the photos',
                stacklevel=4,
            )
            return bars
    return NO_BARS

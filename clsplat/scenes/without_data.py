"""Parts of photos that hold no data: transparent rims, parts that were cut out, and bars.

Points of the scene that lie there show it.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..cameras.seen import sampled, sampled_views, seen
from ..errors import InputError
from ..files.images import has_alpha
from ..files.masks import Mask, read_mask
from ..splats.color import Color
from .bars import NO_BARS, Bars, commonest_size, find_bars
from .options import ALPHA_USES
from .posed_images import PosedImages
from .read_view import PhotoReader
from .still_pixels import DENSITY, FEWEST_VIEWS, hide_points, pixels_before_scene
from .undistort import RegisteredImage
from .view import StoredView

# Share of photos with transparent parts from which the others do not show that these are no background: an object may
# fill the others. Without points nothing else separates the two.
_MOST_CUT, _MOST_CUT_WITHOUT_POINTS = 0.9, 0.5


def use_of_alpha(root: Path, posed: PosedImages, resolution: int, background: Color) -> str:
    """Return what the transparency of the photos means, one of ALPHA_USES, and warn if it means that data is missing.

    The photos of all views are looked at, so that a part of a scene is read as the whole.

    Parameters
    ----------
    root : the scene, for the warning. resolution, background : as for `load_scene`.
    """
    found = None
    # A photo that cannot be used is reported when all are read.
    with suppress(InputError):
        photos = [photo for photo in posed.photos if has_alpha(posed.files[photo.name])]
        readers = [
            PhotoReader.of(posed, photo, resolution, background, alpha_hides=True) for photo in sampled_views(photos)
        ]
        if len(photos) == len(posed.photos) and len(posed.points):
            found = _rims(readers, posed)
        if found is None and photos:
            found = _cut_outs(readers, posed, len(photos))
    if found is None:
        return ALPHA_USES[0]
    warnings.warn(
        f'{root}: {found}: they are left out as pixels without data (alpha "mask"); with alpha "background" they are '
        "the background of an object",
        stacklevel=4,
    )
    return ALPHA_USES[1]


def _rims(readers: Sequence[PhotoReader], posed: PosedImages) -> str | None:
    """Return words for pixels that are transparent in all photos where points of the scene lie; None without such."""
    views = [
        StoredView(reader.photo.name, reader.camera(), replace(reader, alpha_hides=False).view) for reader in readers
    ]
    found = pixels_before_scene(views, posed.points.xyz)
    if found is None:
        return None
    return f"{found.share:.0%} of the pixels are transparent in all photos, but points of the scene lie there"


def _cut_outs(readers: Sequence[PhotoReader], posed: PosedImages, with_alpha: int) -> str | None:
    """Return words for transparent parts of some photos, if other photos are opaque; None without such.

    Opaque photos show what is around, so transparent parts are no background of an object. But an object may fill a few
    of its photos, and a sky may be cut out of those that show it: no points of the scene lie there.

    Parameters
    ----------
    readers : of the photos that may be transparent, or of some of them. with_alpha : number of these photos.
    """
    n, xyz = len(posed.photos), posed.points.xyz
    per_reader = with_alpha / len(readers)
    limit = n * (_MOST_CUT if len(xyz) else _MOST_CUT_WITHOUT_POINTS)
    shares: list[float] = []
    within, expected = 0, 0.0
    for reader in readers:
        view = reader.read()
        if isinstance(view, str) or view.mask is None:
            continue
        found = seen(view.camera, sampled(xyz))
        shares.append(1.0 - float(view.mask.mean()))
        within += int(np.count_nonzero(~view.mask[found.rows_and_columns]))
        expected += shares[-1] * int(np.count_nonzero(found.inside))
        if len(shares) * per_reader >= limit:
            return None
    if not shares or within < DENSITY * expected:
        return None
    number = f"{'about ' if per_reader > 1 else ''}{round(len(shares) * per_reader)} of {n}"
    return f"{number} photos have transparent parts ({np.mean(shares):.0%} of their pixels), and the others are opaque"


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
        files = {photo.name: posed.files[photo.name] for photo in some}
        bars = find_bars(list(files.values()), {files[name] for name in files.keys() & posed.upright})
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

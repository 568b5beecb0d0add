"""Parts of photos that hold no data: transparent rims, parts that were cut out, and bars.

Points of the scene that lie there show it.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..cameras.seen import sampled, sampled_views, seen
from ..errors import InputError
from ..files.images import ImageU8, has_alpha
from ..files.masks import Mask, read_mask
from ..splats.color import Color
from ..splats.fields import DoubleArray
from .bars import NO_BARS, Bars, commonest_size, find_bars
from .options import ALPHA_USES
from .posed_images import PosedImages
from .read_view import PhotoReader
from .still_pixels import DENSITY, EMPTY, FEWEST_VIEWS, hide_points, pixels_before_scene
from .undistort import RegisteredImage
from .view import StoredView, View

# Share of photos with transparent parts from which the others do not show that these are no background: an object may
# fill the others. Without points nothing else separates the two.
_MOST_CUT, _MOST_CUT_WITHOUT_POINTS = 0.9, 0.5


class AlphaUse(NamedTuple):
    """What transparency means, one of ALPHA_USES, and the views that were read to find out, by name.

    The views are composited over the background. If transparency means something else, the mapping is empty.
    """

    use: str
    decoded: Mapping[str, View]


def use_of_alpha(
    root: Path, posed: PosedImages, resolution: int, background: Color, kept: Collection[str] = ()
) -> AlphaUse:
    """Return what the transparency of the photos means, and warn if it means that data is missing.

    It is "mask" if the same pixels are transparent in all photos, and points lie there: rims without data. So it is if
    some photos have transparent parts, and others are opaque: something was cut out there. It is "ignore" if all pixels
    of all photos are transparent. Else it is "background". The photos of all views are looked at, so that a part of a
    scene is read as the whole.

    Parameters
    ----------
    root : the scene, for the warning. resolution, background : as for `load_scene`.
    kept : names of the photos whose views are returned if they are read.
    """
    found, decoded = None, dict[str, View]()
    # A photo that cannot be used is reported when all are read.
    with suppress(InputError):
        photos = [photo for photo in posed.photos if has_alpha(posed.files[photo.name])]
        readers = [PhotoReader.of(posed, photo, resolution, background) for photo in sampled_views(photos)]
        sample = _TransparentPhotos(readers, posed.points.xyz, kept, decoded)
        if len(photos) == len(posed.photos) and len(posed.points):
            found = sample.rims()
        if found is None and photos:
            found = sample.cut_outs(len(photos), len(posed.photos))
        if len(photos) == len(posed.photos) and sample.show_nothing:
            warnings.warn(
                f"{root}: all pixels of all photos are transparent: their alpha channel says nothing, and is ignored "
                '(alpha "ignore")',
                stacklevel=4,
            )
            return AlphaUse(ALPHA_USES[2], {})
    if found is None:
        return AlphaUse(ALPHA_USES[0], decoded)
    warnings.warn(
        f'{root}: {found}: they are left out as pixels without data (alpha "mask"); with alpha "background" they are '
        "the background of an object",
        stacklevel=4,
    )
    return AlphaUse(ALPHA_USES[1], {})


class _Part(NamedTuple):
    """The transparent part of a photo: its share, 0 to 1, and the points of the scene in the photo and in the part."""

    share: float
    inside: int
    within: int


class _TransparentPhotos:
    """Photos that may be transparent. A photo is decoded once for all questions.

    Parameters
    ----------
    readers : of the photos, over the background. xyz : points of the scene (P, 3).
    kept : names of the photos whose views go into `decoded`.
    """

    def __init__(
        self, readers: Sequence[PhotoReader], xyz: DoubleArray, kept: Collection[str], decoded: dict[str, View]
    ) -> None:
        self.xyz, self.kept, self.decoded = xyz, kept, decoded
        self.views = [StoredView(reader.photo.name, reader.camera(), partial(self._read, reader)) for reader in readers]
        self._parts: dict[str, _Part | None] = {}  # of the photos that were decoded; None for opaque ones
        self._empty: dict[str, bool] = {}  # whether these photos show nothing

    def _read(self, reader: PhotoReader) -> View:
        view = reader.view(partial(self._look, reader))
        if view.name in self.kept:
            self.decoded[view.name] = view
        return view

    def _look(self, reader: PhotoReader, stored: ImageU8) -> None:
        opaque: Mask = reader.opaque_part(stored) if stored.shape[2] == 4 else np.ones(1, np.bool_)
        part = None
        if opaque.any() and not opaque.all():
            found = seen(reader.camera(), sampled(self.xyz))
            within = np.count_nonzero(~opaque[found.rows_and_columns])
            part = _Part(1.0 - float(opaque.mean()), int(np.count_nonzero(found.inside)), int(within))
        self._parts[reader.photo.name] = part
        self._empty[reader.photo.name] = stored.shape[2] == 4 and int(stored[:, :, 3].max()) <= EMPTY

    @property
    def show_nothing(self) -> bool:
        """Whether all photos show nothing, if all were decoded. Recordings of games have such an alpha channel."""
        return len(self._empty) == len(self.views) > 0 and all(self._empty.values())

    def rims(self) -> str | None:
        """Return words for pixels that are transparent in all photos where points of the scene lie, or None."""
        found = pixels_before_scene(self.views, self.xyz)
        if found is None:
            return None
        return f"{found.share:.0%} of the pixels are transparent in all photos, but points of the scene lie there"

    def cut_outs(self, with_alpha: int, n: int) -> str | None:
        """Return words for transparent parts of some photos, if other photos are opaque; None without such.

        Opaque photos show what is around, so transparent parts are no background of an object. But an object may fill a
        few of its photos, and a sky may be cut out of those that show it: no points of the scene lie there.

        Parameters
        ----------
        with_alpha : number of photos that may be transparent, of n.
        """
        per_view = with_alpha / len(self.views)
        limit = n * (_MOST_CUT if len(self.xyz) else _MOST_CUT_WITHOUT_POINTS)
        shares: list[float] = []
        within, expected = 0, 0.0
        for view in self.views:
            if view.name not in self._parts:
                with suppress(InputError):
                    view.loaded()
            part = self._parts.get(view.name)
            if part is None:
                continue
            shares.append(part.share)
            within += part.within
            expected += part.share * part.inside
            if len(shares) * per_view >= limit:
                return None
        if not shares or within < DENSITY * expected:
            return None
        number = f"{'about ' if per_view > 1 else ''}{round(len(shares) * per_view)} of {n}"
        return (
            f"{number} photos have transparent parts ({np.mean(shares):.0%} of their pixels), and the others are opaque"
        )


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

"""Photos whose cameras are those of the upright photos: some programs apply the EXIF orientation, COLMAP does not."""

from __future__ import annotations

from dataclasses import replace

from ..errors import InputError
from ..files.images import read_photo_header, same_aspect
from .posed_images import PosedImages
from .undistort import Lens


def with_upright_photos(posed: PosedImages) -> PosedImages:
    """Return the photos with upright sizes, to be read upright, if some of them fit their cameras in no other way.

    The program that found the poses then applied the orientation of all photos, also where both ways fit, as upside
    down. Photos that fit as stored only stay so.
    """
    stored = {photo.name for photo in posed.photos if _fits(posed.sizes[photo.name], photo.lens)}
    if len(stored) == len(posed.photos):
        return posed
    upright = {}
    for photo in posed.photos:
        try:
            header = read_photo_header(posed.files[photo.name])
        except InputError:  # a damaged photo is reported when it is read
            continue
        if _fits((header.width, header.height), photo.lens):
            upright[photo.name] = header.width, header.height
    if upright.keys() <= stored:
        return posed
    return replace(posed, sizes=posed.sizes | upright, upright=frozenset(upright))


def _fits(size: tuple[int, int], lens: Lens) -> bool:
    return same_aspect(size, (lens.width, lens.height))

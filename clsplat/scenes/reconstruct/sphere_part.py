"""Equirectangular photos: the part of the sphere that each says it shows (the name space GPano of XMP)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...files.images import ImageU8, image_size
from ...files.masks import Mask

ASPECT = 2.0  # width of a whole sphere by its height

_XMP_BYTES = 1 << 18  # the XMP data of a JPEG are within this number of bytes
_XMP_MARKS = (b"ProjectionType", b"equirectangular")
_NUMBER = rb"""GPano:%b(?:\s*=\s*["']|>)\s*(\d+)"""  # an attribute or an element
_WHOLE_WIDTH, _WHOLE_HEIGHT = b"FullPanoWidthPixels", b"FullPanoHeightPixels"
_WIDTH, _HEIGHT = b"CroppedAreaImageWidthPixels", b"CroppedAreaImageHeightPixels"
_LEFT, _TOP = b"CroppedAreaLeftPixels", b"CroppedAreaTopPixels"


@dataclass(frozen=True)
class SpherePart:
    """The place of a photo in the panorama of the whole sphere.

    Attributes
    ----------
    whole : width and height of the whole panorama [px of the photo]. left, top : the photo's first pixel in it.
    size : width and height of the photo [px].
    """

    whole: tuple[int, int]
    left: int
    top: int
    size: tuple[int, int]

    @property
    def is_whole(self) -> bool:
        """Whether the photo shows the whole sphere."""
        return self.whole == self.size

    def spread(self, photo: ImageU8, mask: Mask | None) -> tuple[ImageU8, Mask]:
        """Return the whole panorama (H, W, C) around the photo, and the mask (H, W) of what the photo shows.

        Parameters
        ----------
        mask : of the photo; None if all of its pixels count.
        """
        width, height = self.whole
        rows, columns = slice(self.top, self.top + self.size[1]), slice(self.left, self.left + self.size[0])
        panorama, shown = np.zeros((height, width, photo.shape[2]), np.uint8), np.zeros((height, width), np.bool_)
        panorama[rows, columns] = photo
        shown[rows, columns] = True if mask is None else mask
        return panorama, shown


def sphere_part(photo: Path) -> SpherePart | None:
    """Return which part of the sphere a photo shows, or None if it does not say that it is equirectangular.

    A photo that was reduced after it was taken keeps the numbers of the larger one, so they are scaled. A photo whose
    numbers contradict each other shows the whole sphere if it is twice as wide as high.

    Raises
    ------
    InputError : the photo cannot be read.
    """
    width, height = image_size(photo)
    with photo.open("rb") as stream:
        start = stream.read(_XMP_BYTES)
    if not all(mark in start for mark in _XMP_MARKS):
        return None
    found = {name: _number(start, name) for name in (_WHOLE_WIDTH, _WHOLE_HEIGHT, _WIDTH, _HEIGHT, _LEFT, _TOP)}
    numbers = [value for value in found.values() if value is not None]
    if len(numbers) == len(found) and found[_WIDTH] and found[_HEIGHT]:
        whole_width, whole_height, stated_width, stated_height, left, top = numbers
        across, down = width / stated_width, height / stated_height
        whole = round(whole_width * across), round(whole_height * down)
        place = round(left * across), round(top * down)
        inside = place[0] + width <= whole[0] and place[1] + height <= whole[1]
        if inside and abs(whole[0] - ASPECT * whole[1]) <= ASPECT:
            return SpherePart((round(ASPECT * whole[1]), whole[1]), *place, (width, height))
    return SpherePart((width, height), 0, 0, (width, height)) if width == ASPECT * height else None


def _number(xmp: bytes, name: bytes) -> int | None:
    match = re.search(_NUMBER % name, xmp)
    return int(match[1]) if match else None

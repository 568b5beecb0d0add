"""Where an object can be, by the silhouettes of transparent photos: its visual hull (Laurentini 1994).

A place is empty if a photo shows it as transparent. The hull is what is left. It contains the object, and the hollows
that no silhouette shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.seen import seen
from ..splats.fields import DoubleArray

if TYPE_CHECKING:
    from ..files.images import ImageU8
    from ..scenes.view import View

TRANSPARENT_SHARE = 0.01  # photos with a smaller share of transparent pixels count as opaque
_STEP = 8  # pixels between two that are looked at
_OPAQUE = 250  # smallest alpha of a pixel that counts as opaque: photos are resampled and rounded
_SIDE = 256  # px: the longer side of a silhouette is reduced to at most this
_VIEWS = 128  # largest number of silhouettes
_COLORED_BY = 32  # largest number of photos whose colours are averaged
_WRONG = 0.02  # share of the silhouettes that may exclude a place of the object: poses and cut-outs have errors


def transparent_share(views: Sequence[View]) -> float:
    """Return the share of transparent pixels in photos, 0 to 1, from every 8th row and column."""
    samples = [alpha[::_STEP, ::_STEP] for view in views if (alpha := view.alpha) is not None]
    total = sum(-(-view.camera.width // _STEP) * -(-view.camera.height // _STEP) for view in views)
    return float(sum((sample < _OPAQUE).sum() for sample in samples)) / total if total else 0.0


class Silhouettes:
    """Cameras, and the parts of their photos that show something. Photos without transparency are left out.

    Parameters
    ----------
    views : views with photos. At most 128 of them are read, evenly spread.
    """

    def __init__(self, views: Sequence[View]) -> None:
        self._photos: list[tuple[Camera, _Silhouette]] = []
        for view in views[:: -(-len(views) // _VIEWS)]:
            pixels = view.loaded()
            if pixels.alpha is not None:
                self._photos.append((view.camera, _Silhouette.of(pixels.image, pixels.alpha)))
        self._allowed = int(_WRONG * len(self._photos))

    def admit(self, xyz: DoubleArray) -> NDArray[np.bool_]:
        """Return whether points (P, 3) are in the visual hull. Points outside all photos are."""
        rows = np.arange(len(xyz))  # of points that are not excluded yet
        excluded = np.zeros(len(xyz), np.int64)
        for camera, silhouette in self._photos:
            _, pixel, inside = seen(camera, xyz[rows])
            y, x = silhouette.block(pixel[inside])
            excluded[rows[inside]] += ~silhouette.shows[y, x]
            rows = rows[excluded[rows] <= self._allowed]
        admitted = np.zeros(len(xyz), np.bool_)
        admitted[rows] = True
        return admitted

    def colors(self, xyz: DoubleArray) -> NDArray[np.uint8]:
        """Return the mean colour (P, 3) that the photos have at points (P, 3). Points that no photo shows are black."""
        total, count = np.zeros((len(xyz), 3)), np.zeros((len(xyz), 1))
        for camera, silhouette in self._photos[:: max(-(-len(self._photos) // _COLORED_BY), 1)]:
            _, pixel, inside = seen(camera, xyz)
            y, x = silhouette.block(pixel[inside])
            total[inside] += silhouette.color[y, x] * silhouette.shows[y, x, None]
            count[inside, 0] += silhouette.shows[y, x]
        return (total / np.maximum(count, 1.0)).round().astype(np.uint8)


@dataclass(frozen=True)
class _Silhouette:
    """What a photo shows, in square blocks of pixels.

    Attributes
    ----------
    shows : (h, w) whether a pixel of the block is not wholly transparent.
    color : (h, w, 3) float32, mean colour of these pixels by their alpha, 0..255.
    side : side of a block [px].
    """

    shows: NDArray[np.bool_]
    color: NDArray[np.float32]
    side: int

    @classmethod
    def of(cls, image: ImageU8, alpha: ImageU8) -> _Silhouette:
        """Return the silhouette of an image (H, W, 3) with its alpha (H, W)."""
        side = -(-max(alpha.shape) // _SIDE)
        height, width = (-(-length // side) for length in alpha.shape)
        margin = ((0, height * side - alpha.shape[0]), (0, width * side - alpha.shape[1]))

        def block_sums(values: NDArray[np.float32]) -> NDArray[np.float32]:
            padded = np.pad(values, (*margin, (0, 0)))
            by_row = padded.reshape(height, side, width * side, -1).sum(axis=1)  # two sums are faster than one
            return by_row.reshape(height, width, side, -1).sum(axis=2)

        weight = alpha[:, :, None].astype(np.float32)
        sums = block_sums(weight)
        color = (block_sums(weight * image) / np.maximum(sums, 1.0)).astype(np.float32)
        return cls(sums[:, :, 0] > 0, color, side)

    def block(self, pixel: DoubleArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows and the columns of the blocks at pixel positions (P, 2)."""
        x, y = (pixel // self.side).astype(np.int64).T
        return y, x

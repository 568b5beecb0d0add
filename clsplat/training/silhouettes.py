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

from ..cameras.seen import seen
from ..splats.fields import DoubleArray

if TYPE_CHECKING:
    from ..scenes.view import View

TRANSPARENT_SHARE = 0.01  # photos with a smaller share of transparent pixels count as opaque
_STEP = 8  # pixels between two that are looked at
OPAQUE = 250  # smallest alpha of a pixel that counts as opaque: photos are resampled and rounded
_SIDE = 256  # px: the longer side of a silhouette is reduced to at most this
_VIEWS = 128  # largest number of silhouettes
_COLORED_BY = 32  # largest number of photos whose colours are averaged
_WRONG = 0.02  # share of the silhouettes that may exclude a place of the object: poses and cut-outs have errors


def transparent_share(views: Sequence[View]) -> float:
    """Return the share of transparent pixels in photos, 0 to 1, from every 8th row and column."""
    samples = [alpha[::_STEP, ::_STEP] for view in views if (alpha := view.alpha) is not None]
    total = sum(-(-view.camera.width // _STEP) * -(-view.camera.height // _STEP) for view in views)
    return float(sum((sample < OPAQUE).sum() for sample in samples)) / total if total else 0.0


def opaque_at(view: View, at: tuple[NDArray[np.int64], NDArray[np.int64]]) -> NDArray[np.bool_]:
    """Return whether pixels of a photo show something, (P,): no mask hides them, and they are opaque.

    at : their rows and columns, (P,) each.
    """
    shows = np.ones(len(at[0]), np.bool_)
    if view.mask is not None:
        shows &= view.mask[at]
    if view.alpha is not None:
        shows &= view.alpha[at] >= OPAQUE
    return shows


class Silhouettes:
    """Cameras, and the parts of their photos that show something. Photos without transparency are left out.

    Parameters
    ----------
    views : views with photos. At most 128 of them are read, evenly spread.
    """

    def __init__(self, views: Sequence[View]) -> None:
        found = (_Silhouette.of(view) for view in views[:: -(-len(views) // _VIEWS)])
        self._silhouettes = [silhouette for silhouette in found if silhouette is not None]
        self._allowed = int(_WRONG * len(self._silhouettes))

    def admit(self, xyz: DoubleArray) -> NDArray[np.bool_]:
        """Return whether points (P, 3) are in the visual hull. Points outside all photos are."""
        rows = np.arange(len(xyz))  # of points that are not excluded yet
        excluded = np.zeros(len(xyz), np.int64)
        for silhouette in self._silhouettes:
            inside, y, x = silhouette.blocks_at(xyz[rows])
            excluded[rows[inside]] += ~silhouette.shows[y, x]
            rows = rows[excluded[rows] <= self._allowed]
        admitted = np.zeros(len(xyz), np.bool_)
        admitted[rows] = True
        return admitted

    def draw(self, count: int, far: float, rng: np.random.Generator) -> DoubleArray:
        """Return at most `count` points (P, 3) that photos show, at random depths up to `far`: many are in the hull."""
        share = count // max(len(self._silhouettes), 1)
        drawn = [silhouette.draw(share, far, rng) for silhouette in self._silhouettes]
        return np.concatenate([np.zeros((0, 3)), *drawn])

    def colors(self, xyz: DoubleArray) -> NDArray[np.uint8]:
        """Return the mean colour (P, 3) that the photos have at points (P, 3). Points that no photo shows are black."""
        total, count = np.zeros((len(xyz), 3)), np.zeros((len(xyz), 1))
        for silhouette in self._silhouettes[:: max(-(-len(self._silhouettes) // _COLORED_BY), 1)]:
            inside, y, x = silhouette.blocks_at(xyz)
            total[inside] += silhouette.colors()[y, x] * silhouette.shows[y, x, None]
            count[inside, 0] += silhouette.shows[y, x]
        return (total / np.maximum(count, 1.0)).round().astype(np.uint8)


@dataclass(frozen=True)
class _Silhouette:
    """What a photo shows, in square blocks of pixels.

    Attributes
    ----------
    view : the photo with its camera. Its pixels are not kept here.
    shows : (h, w) whether a pixel of the block is not wholly transparent.
    side : side of a block [px].
    """

    view: View
    shows: NDArray[np.bool_]
    side: int

    @classmethod
    def of(cls, view: View) -> _Silhouette | None:
        """Return the silhouette of a photo; None for a photo without transparency."""
        alpha = view.alpha
        if alpha is None:
            return None
        side = -(-max(alpha.shape) // _SIDE)
        return cls(view, _block_sums(alpha[:, :, None].astype(np.float32), side)[:, :, 0] > 0, side)

    def blocks_at(self, xyz: DoubleArray) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
        """Return which of the points (P, 3) are in the photo, and the rows and columns of the blocks of these."""
        _, pixel, inside = seen(self.view.camera, xyz)
        x, y = (pixel[inside] // self.side).astype(np.int64).T
        return inside, y, x

    def draw(self, count: int, far: float, rng: np.random.Generator) -> DoubleArray:
        """Return (count, 3) points at random in what the photo shows, and in depth; none if it shows nothing."""
        shown = np.argwhere(self.shows)[:, ::-1]
        if not len(shown):
            return np.zeros((0, 3))
        camera, depth = self.view.camera, rng.uniform(0.0, far, (count, 1))
        pixel = self.side * (shown[rng.integers(len(shown), size=count)] + rng.uniform(size=(count, 2)))
        local = np.concatenate([depth * (pixel - (camera.cx, camera.cy)) / (camera.fx, camera.fy), depth], axis=1)
        return np.asarray((local - camera.translation) @ camera.rotation)

    def colors(self) -> NDArray[np.float32]:
        """Return the mean colour of each block by the alpha of its pixels, (h, w, 3), 0..255."""
        pixels = self.view.loaded()
        assert pixels.alpha is not None
        weight = pixels.alpha[:, :, None].astype(np.float32)
        sums = _block_sums(weight, self.side)
        return (_block_sums(weight * pixels.image, self.side) / np.maximum(sums, 1.0)).astype(np.float32)


def _block_sums(values: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Return the sums over square blocks of an image (H, W, C). Blocks at its ends may be smaller."""
    height, width = (-(-length // side) for length in values.shape[:2])
    margin = [(0, blocks * side - length) for blocks, length in zip((height, width), values.shape[:2], strict=True)]
    padded = np.pad(values, (*margin, (0, 0)))
    by_row = padded.reshape(height, side, width * side, -1).sum(axis=1)  # two sums are faster than one
    return by_row.reshape(height, width, side, -1).sum(axis=2)

"""Bars at the sides of photos, as of a video in another format. They have one colour, and hide the scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.images import ImageU8, read_image
from ..files.masks import Mask
from ..splats.color import SPREAD

_LEAST = 0.005  # of the height or width: narrower bars are harmless
_BLURRED_ROWS, _BLURRED = 2, 0.005  # rows by which edges of a bar differ between photos, and parts of the height


class Bars(NamedTuple):
    """Bars at the four sides of a photo, in parts of its height and width, 0 to 1."""

    top: float
    right: float
    bottom: float
    left: float

    def uncovered(self, width: int, height: int, margin: int = 0) -> Mask:
        """Return the pixels of a photo of this size that no bar covers, (height, width).

        Parameters
        ----------
        margin : rows and columns beside each bar that count as covered.
        """

        def between(first: float, last: float, n: int) -> Mask:
            place = np.arange(n) + 0.5
            before, after = (share * n + margin if share else 0.0 for share in (first, last))
            kept: Mask = (place > before) & (place < n - after)
            return kept

        uncovered: Mask = between(self.top, self.bottom, height)[:, None] & between(self.left, self.right, width)
        return uncovered


NO_BARS = Bars(0.0, 0.0, 0.0, 0.0)


def checked_bars(bars: Sequence[float]) -> Bars:
    """Return the bars; raise InputError unless they are four parts from 0 to 1."""
    if len(bars) != len(NO_BARS) or not all(0 <= share <= 1 for share in bars):
        raise InputError(f"bars {tuple(bars)}: give four parts from 0 to 1: {', '.join(Bars._fields)}")
    return Bars(*bars)


def commonest_size(sizes: Mapping[str, tuple[int, int]]) -> tuple[int, int] | None:
    """Return the (width, height) that most photos have, of those by name [px]; None without photos."""
    return Counter(sizes.values()).most_common(1)[0][0] if sizes else None


def find_bars(files: Sequence[Path], upright: Collection[Path] = ()) -> Bars:
    """Return the bars that photos of one size have in common.

    Bars end in the same row or column of most photos. What is alike in all photos, but ends elsewhere in each, is the
    scene, such as a bright sky. Reading ends as soon as no bar is left, so photos of most scenes are not read.

    Parameters
    ----------
    upright : those of the files that are turned by their EXIF orientation.

    Raises
    ------
    InputError : a photo cannot be read.
    """
    found: list[list[int]] = []  # rows of each side, of each photo
    lengths = np.ones(4)
    colors: list[NDArray[np.float64]] = []
    for file in files:
        image = read_image(file, file in upright)
        if image.shape[2] == 4 and image[..., 3].min() < 255:
            return NO_BARS
        across = image[..., :3].transpose(1, 0, 2)
        sides = (image[..., :3], across[::-1], image[::-1, :, :3], across)
        lengths = np.array([len(side) for side in sides])
        colors = colors or [np.median(side[0], axis=0) for side in sides]
        found.append([_rows_of_color(side, color) for side, color in zip(sides, colors, strict=True)])
        if (np.min(found, axis=0) / lengths).max() < _LEAST:
            return NO_BARS
    if not found:
        return NO_BARS
    rows = np.min(found, axis=0)
    near = np.maximum(_BLURRED_ROWS, _BLURRED * lengths)
    is_bar = (rows / lengths >= _LEAST) & (np.median(found, axis=0) <= rows + near)
    return Bars(*np.where(is_bar, rows / lengths, 0.0).tolist())


def _rows_of_color(image: ImageU8, color: NDArray[np.float64]) -> int:
    """Return the number of rows of an image (H, W, 3), from the first on, that have a colour (3,), 0 to 255.

    Their means have to, because JPEG and videos blur the edges of bars.
    """
    for number, row in enumerate(image):
        if np.abs(row - color).mean() > SPREAD:
            return number
    return len(image)

"""Sizes that photos are read at, and the memory that they need."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from ..errors import SMALLER_IMAGES, InputError
from ..files.host_memory import available_bytes

MAX_SIDE = 1 << 20  # largest side of an image that a file may name [px]
MAX_WIDTH = 1600  # with resolution -1, wider images are reduced to this width [px], as in 3DGS
MIN_WIDTH = 24  # smallest resolution that is a width [px]; a smaller one is a divisor that 3DGS does not have
_DIVISORS = (1, 2, 4, 8)
_CHANNELS = 3
_DECODING = 2  # copies of a photo at its stored size while it is read: decoded, and as an array


def target_size(width: int, height: int, resolution: int) -> tuple[int, int]:
    """Return (width, height) [px] by 3DGS's rule: divisors round, widths truncate."""
    if resolution in _DIVISORS:
        return max(1, round(width / resolution)), max(1, round(height / resolution))
    if resolution == -1 and width <= MAX_WIDTH:
        return width, height
    target = MAX_WIDTH if resolution == -1 else resolution
    return target, max(1, int(height * target / width))


def check_resolution(resolution: int) -> None:
    """Raise InputError if a resolution is neither a divisor of 3DGS's rule, nor a width, nor -1."""
    if isinstance(resolution, bool) or not isinstance(resolution, int | np.integer):
        raise InputError(f"resolution {resolution!r}: expected a whole number: 1, 2, 4, 8, a width in pixels, or -1")
    if resolution != -1 and resolution not in _DIVISORS and resolution < MIN_WIDTH:
        raise InputError(f"resolution {resolution}: use 1, 2, 4, 8, a width of at least {MIN_WIDTH} pixels, or -1")


def check_memory(source: object, sizes: Collection[tuple[int, int]], resolution: int) -> None:
    """Raise InputError if photos cannot fit into the free memory of the machine. No photo is decoded for that.

    Parameters
    ----------
    source : where the photos come from, for the message.
    sizes : (width, height) of the photos as stored [px]. resolution : as for `load_scene`.
    """
    if not sizes:
        return
    targets = [target_size(width, height, resolution) for width, height in sizes]
    kept = _CHANNELS * sum(width * height for width, height in targets)
    largest = _DECODING * _CHANNELS * max(width * height for width, height in sizes)
    needed, free = kept + largest, available_bytes()
    if needed > free:
        width, height = max(targets)
        raise InputError(
            f"{source}: {len(sizes)} photos of {width}x{height} px need at least {needed / 1e6:.0f} MB of memory, "
            f"{free / 1e6:.0f} MB are free",
            SMALLER_IMAGES,
        )

"""Masks beside photos: which pixels count. Black hides, white counts."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from .images import read_image

Mask = NDArray[np.bool_]

MASK_FOLDER = "masks"  # inside a scene, unless another is named
NO_MASKS = "none"  # in the place of a folder
_COUNTS = 127.5  # from this mean of the channels on


def mask_files(folder: Path, names: list[str]) -> dict[str, Path]:
    """The masks in a folder, by the names of their photos.

    `sub/a.jpg` is masked by `sub/a.jpg.png` (COLMAP's form), `sub/a.png`, `sub/a.mask.png` or `sub/a.jpg`, whichever
    is there first.
    """
    return {name: file for name in names for file in [_mask_of(folder, name)] if file is not None}


def _mask_of(folder: Path, name: str) -> Path | None:
    photo = PurePosixPath(name)
    candidates = (f"{name}.png", str(photo.with_suffix(".png")), str(photo.with_suffix(".mask.png")), name)
    return next((folder / candidate for candidate in candidates if (folder / candidate).is_file()), None)


def read_mask(path: Path) -> Mask:
    """(H, W), True where the photo's pixel counts.

    Raises
    ------
    InputError : the file is no image.
    """
    counts: Mask = read_image(path)[:, :, :3].mean(axis=2) >= _COUNTS
    return counts


def resize_mask(mask: Mask, width: int, height: int) -> Mask:
    """The mask at another size [px], each pixel from the nearest one."""
    rows, columns = mask.shape
    at_rows = ((np.arange(height) + 0.5) * rows / height).astype(int)
    at_columns = ((np.arange(width) + 0.5) * columns / width).astype(int)
    resized: Mask = mask[at_rows[:, None], at_columns]
    return resized

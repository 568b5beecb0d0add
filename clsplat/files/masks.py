"""Masks beside photos show which pixels count: white pixels count, black pixels do not."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from .images import read_image

Mask = NDArray[np.bool_]

MASK_FOLDER = "masks"  # default folder of masks inside a scene
NO_MASKS = "none"  # the user's word for using no masks, in place of a folder's name
_THRESHOLD = 127.5  # smallest mean of the channels of a pixel that counts


def mask_files(folder: Path, names: list[str]) -> dict[str, Path]:
    """Return the mask files in a folder by the names of their photos.

    The mask of `sub/a.jpg` is the first existing file of `sub/a.jpg.png` (COLMAP's form), `sub/a.png`,
    `sub/a.mask.png` and `sub/a.jpg`.
    """
    return {name: file for name in names for file in [_mask_of(folder, name)] if file is not None}


def _mask_of(folder: Path, name: str) -> Path | None:
    photo = PurePosixPath(name)
    candidates = (f"{name}.png", str(photo.with_suffix(".png")), str(photo.with_suffix(".mask.png")), name)
    return next((folder / candidate for candidate in candidates if (folder / candidate).is_file()), None)


def read_mask(path: Path) -> Mask:
    """Return a mask, (H, W), True if the photo's pixel counts.

    Raises
    ------
    InputError : the file cannot be read as an image.
    """
    return read_image(path)[:, :, :3].mean(axis=2) >= _THRESHOLD


def resize_mask(mask: Mask, width: int, height: int) -> Mask:
    """Return the mask at another size [px]; each pixel takes the value of the nearest old pixel."""
    old_height, old_width = mask.shape
    rows = ((np.arange(height) + 0.5) * old_height / height).astype(int)
    columns = ((np.arange(width) + 0.5) * old_width / width).astype(int)
    return mask[rows[:, None], columns]

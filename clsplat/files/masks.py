"""Masks beside photos show which pixels count: white pixels count, black pixels do not."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from .image_names import IMAGE_SUFFIXES
from .images import read_image

Mask = NDArray[np.bool_]

BESIDE = ".mask.png"  # end of the name of a mask beside its photo
MASK_FOLDER = "masks"  # default folder of masks inside a scene
NO_MASKS = "none"  # the user's word for using no masks, in place of a folder's name
_THRESHOLD = 127.5  # smallest mean of the channels of a pixel that counts


def mask_files(folder: Path, photos: Mapping[str, Path]) -> dict[str, Path]:
    """Return the mask files in a folder by the names of their photos.

    The mask of `sub/a.jpg` is the first existing file of `sub/a.jpg.png` (COLMAP's form), `sub/a.png`,
    `sub/a.mask.png` and `sub/a.jpg`, or of the same with `.PNG`. A photo is never its own mask.

    Parameters
    ----------
    photos : file of each photo by name.
    """
    found = {name: _mask_of(folder, name, file) for name, file in photos.items()}
    return {name: mask for name, mask in found.items() if mask is not None}


def warn_of_unused(folder: Path, photos: Mapping[str, Path], masks: Mapping[str, Path]) -> None:
    """Warn if images in a folder of masks have names that are not quite those of masks.

    Masks of other photos are no reason: a scene may have fewer photos than there are masks.

    Parameters
    ----------
    photos : file of each photo by name. masks : those that `mask_files` found there.
    """
    files = (Path(place) / name for place, _, names in os.walk(folder) for name in names)
    used = {str(mask) for mask in masks.values()}
    found = [file for file in files if file.suffix.lower() in IMAGE_SUFFIXES and str(file) not in used]
    without = {str(PurePosixPath(name).with_suffix("")): name for name in photos if name not in masks}
    misnamed = {}
    for file in found:
        stem = file.relative_to(folder)
        while stem.suffix and stem.as_posix() not in without:
            stem = stem.with_suffix("")
        if stem.as_posix() in without:
            misnamed[file.name] = without[stem.as_posix()]
    if not masks and found and photos:
        misnamed = misnamed or {min(found).name: min(photos)}
    if misnamed:
        file_name, photo = min(misnamed.items())
        warnings.warn(
            f"{folder}: {len(misnamed) if masks else len(found)} images in it are masks of no photo, for example "
            f"{file_name!r}; a mask of {photo!r} is {photo}.png: rename them",
            stacklevel=4,
        )


def masks_beside(photos: Mapping[str, Path]) -> dict[str, Path]:
    """Return the masks beside photos, as RealityScan writes them, by the names of the photos.

    The mask of `a.jpg` is `a.jpg.mask.png` or `a.mask.png`.

    Parameters
    ----------
    photos : file of each photo by name.
    """
    found = {}
    for name, file in photos.items():
        masks = (file.with_name(f"{start}{BESIDE}") for start in (file.name, file.stem))
        found[name] = next((mask for mask in masks if mask.is_file()), None)
    return {name: mask for name, mask in found.items() if mask is not None}


def _mask_of(folder: Path, name: str, file: Path) -> Path | None:
    photo = PurePosixPath(name)
    candidates = [f"{name}.png", str(photo.with_suffix(".png")), str(photo.with_suffix(BESIDE)), name]
    candidates += [f"{name}.PNG", str(photo.with_suffix(".PNG"))]
    masks = (folder / candidate for candidate in candidates)
    return next((mask for mask in masks if os.path.isfile(mask) and not is_same_file(mask, file)), None)


def is_same_file(a: Path, b: Path) -> bool:
    """Return whether two paths lead to one existing file."""
    return a.exists() and b.exists() and a.samefile(b)


def read_mask(path: Path) -> Mask:
    """Return a mask, (H, W), True if the photo's pixel counts.

    Values from the middle up count. In a mask of black and one dark value, such as 0 and 1, the dark one counts.

    Raises
    ------
    InputError : the file cannot be read as an image.
    """
    values = read_image(path)[:, :, :3].mean(axis=2)
    largest = values.max()
    numbered = largest == 1 or (values.min() == 0 and np.isin(values, (0.0, largest)).all())
    return values > 0 if numbered and largest < _THRESHOLD else values >= _THRESHOLD


def resize_mask(mask: Mask, width: int, height: int) -> Mask:
    """Return the mask at another size [px]; each pixel takes the value of the nearest old pixel."""
    old_height, old_width = mask.shape
    rows = ((np.arange(height) + 0.5) * old_height / height).astype(int)
    columns = ((np.arange(width) + 0.5) * old_width / width).astype(int)
    return mask[rows[:, None], columns]

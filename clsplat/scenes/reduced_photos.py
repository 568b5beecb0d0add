"""Photos that have other names than in the model: reduced ones, as in images_4, and those of another format."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from ..files.image_names import IMAGE_SUFFIXES, bare_name

_REDUCED = re.compile(r"images_\d+")


def with_reduced_photos(folder: Path, files: Mapping[str, Path]) -> dict[str, Path]:
    """Return the files by photo, with other files for photos that have another name in the folder.

    A file with another suffix is taken first: IMG_1.png for IMG_1.JPG, as after cutting objects out, or for IMG_1.
    LLFF's scenes number their reduced photos instead (image000.png, ...). Sorted names then belong together, as in
    LLFF's loader (Mildenhall et al. 2019). Their number must be that of the photos in the folder "images", or in the
    model.

    Parameters
    ----------
    folder : folder of the photos. Only photos of a folder images_N may have names of another order.
    files : where the photo of each name would be.
    """
    missing = {name: file for name, file in files.items() if not file.is_file()}
    taken = set(files.values())
    others = ((name, _other_suffix(file)) for name, file in missing.items())
    found = {name: other for name, other in others if other is not None and other not in taken}
    if not found and len(missing) == len(files) and _REDUCED.fullmatch(folder.name):
        found = _by_order(folder, files)
    return {**files, **found}


def _other_suffix(file: Path) -> Path | None:
    """Return the one image beside a missing file that differs from it in the suffix only, which the file may lack."""
    suffixes = [suffix for each in IMAGE_SUFFIXES for suffix in (each, each.upper())]
    candidates = {file.with_name(bare_name(file.name) + suffix) for suffix in suffixes}
    there = [candidate for candidate in candidates if candidate.is_file()]
    return there[0] if len(there) == 1 else None


def _by_order(folder: Path, files: Mapping[str, Path]) -> dict[str, Path]:
    """Return the files of a folder by the names in the same place of the sorted order."""
    reduced = _images_in(folder)
    for names in (sorted(path.name for path in _images_in(folder.with_name("images"))), sorted(files)):
        if len(names) == len(reduced) and set(files) <= set(names):
            return {name: file for name, file in zip(names, reduced, strict=True) if name in files}
    return {}


def _images_in(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file())

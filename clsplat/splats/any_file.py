"""Files of splats of any format that clsplat knows, chosen by the file's ending."""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import OutputError
from .splats import Splats

PLY_ENDING = ".ply"
GAUSSIAN_ENDINGS = (".splat", ".spz")  # formats that hold Gaussians only


def load_splats(path: str | os.PathLike[str]) -> Splats:
    """Read a .splat or .spz file, or else a PLY.

    Raises
    ------
    InputError : the file is missing or damaged.
    """
    path = Path(path)
    if path.suffix.lower() == ".splat":
        from .dot_splat import read_splat

        return read_splat(path)
    if path.suffix.lower() == ".spz":
        from .spz import read_spz

        return read_spz(path)
    return Splats.load(path)


def save_splats(path: str | os.PathLike[str], splats: Splats) -> None:
    """Write a .ply file with all columns, or a .splat or .spz file.

    Raises
    ------
    OutputError : the ending is not one of these, or the file cannot be written.
    InputError : the format does not support the shape of the splats.
    """
    path = Path(path)
    suffix = check_ending(path)
    if suffix == ".splat":
        from .dot_splat import write_splat

        write_splat(path, splats)
    elif suffix == ".spz":
        from .spz import write_spz

        write_spz(path, splats)
    else:
        splats.save(path)


def check_ending(path: Path) -> str:
    """Return the file's ending in lower case; raise OutputError if `save_splats` does not know it."""
    suffix = path.suffix.lower()
    if suffix not in (PLY_ENDING, *GAUSSIAN_ENDINGS):
        raise OutputError(f"{path}: writes .ply, {' and '.join(GAUSSIAN_ENDINGS)} files: choose one of these endings")
    return suffix

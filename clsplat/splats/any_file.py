"""Files of splats in any format that clsplat knows: the content decides, and for .splat files the ending."""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import InputError, OutputError
from .dot_splat import read_splat, write_splat
from .page_payload import PAGE_ENDING, read_page
from .ply import read_ply, write_ply
from .sog import META, is_sog, read_sog
from .spz import VERSIONS as SPZ_VERSIONS
from .spz import read_spz, write_spz
from .spz_streams import is_spz
from .stored import StoredSplats

PLY_ENDING = ".ply"
SPZ_ENDING = ".spz"
GAUSSIAN_ENDINGS = (".splat", SPZ_ENDING)  # formats that hold Gaussians only
READ_ENDINGS = (PLY_ENDING, *GAUSSIAN_ENDINGS, ".sog", PAGE_ENDING)

_PAGE_START = b"<!DOCTYP"
_ELSEWHERE = (".ksplat", ".lcc", ".lcc2")  # formats that splat-transform of PlayCanvas reads


def read_splats(path: str | os.PathLike[str]) -> StoredSplats:
    """Read a PLY of splats (whole, compact or compressed), an .spz, .sog or .splat file, a SOG's meta.json, or a page.

    Splats and columns that cannot be used are left out, with a warning.

    Raises
    ------
    InputError : the file is missing or damaged, or has another format.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in _ELSEWHERE:
        raise InputError(
            f"{path}: {suffix} files are not read: convert it with `splat-transform {path.name} {path.stem}.ply` "
            "(npm install @playcanvas/splat-transform)"
        )
    if suffix == ".splat":
        return read_splat(path)
    start = _start(path)
    if suffix == PAGE_ENDING or start == _PAGE_START:
        return read_page(path)
    if suffix == SPZ_ENDING or is_spz(start):
        return read_spz(path)
    return read_sog(path) if suffix == ".sog" or path.name == META or is_sog(start) else read_ply(path)


def write_splats(
    path: str | os.PathLike[str], splats: StoredSplats, compact: bool = False, spz_version: int = SPZ_VERSIONS[0]
) -> None:
    """Write a .splat or .spz file, or else a PLY.

    Parameters
    ----------
    compact : as for `write_ply`.
    spz_version : version of an .spz file, 3 or 4.

    Raises
    ------
    OutputError : the file cannot be written, or is a page, which needs cameras as well.
    InputError : the format does not support the shape of the splats.
    """
    suffix = Path(path).suffix.lower()
    if suffix == PAGE_ENDING:
        raise OutputError(f"{path}: pages are written by `clsplat convert` and clsplat.convert_model: use one of these")
    if suffix == ".splat":
        write_splat(path, splats)
    elif suffix == SPZ_ENDING:
        write_spz(path, splats, spz_version)
    else:
        write_ply(
            path,
            splats.shape,
            splats.normalisation,
            splats.arrays,
            compact,
            splats.antialiased,
            splats.near_plane,
        )


def check_ending(path: Path, *more: str) -> str:
    """Return the file's ending in lower case; raise OutputError if it is not that of a format that is written.

    more : further endings that the caller can write.
    """
    endings = (PLY_ENDING, *GAUSSIAN_ENDINGS, *more)
    suffix = path.suffix.lower()
    if suffix not in endings:
        raise OutputError(
            f"{path}: writes {', '.join(endings[:-1])} and {endings[-1]} files: choose one of these endings"
        )
    return suffix


def _start(path: Path) -> bytes:
    """Return the first bytes of a file; none if it cannot be read, which its reader reports."""
    try:
        with path.open("rb") as stream:
            return stream.read(8)
    except OSError:
        return b""

"""Files of splats in any format that clsplat knows: the content decides, and for some formats the ending."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import InputError, OutputError
from ..activated import EXTRA_FIELDS
from ..checks import check_arrays, far_away, sh_degree_for
from ..fields import Array
from ..shapes import GAUSSIAN, SKEW_NORMAL, shape_named
from ..stored import StoredSplats
from .dot_splat import read_splat, write_splat
from .glb import is_glb
from .gltf_splats import GLB_ENDING, GLTF_ENDING, read_gltf_splats, write_gltf_splats
from .page_payload import PAGE_ENDING, PAGE_SHAPES, read_page
from .ply import read_ply, write_ply
from .sog import META, is_sog, read_sog
from .sog_writer import write_sog
from .spz import VERSIONS as SPZ_VERSIONS
from .spz import read_spz, write_spz
from .spz_streams import GZIP_START, is_spz
from .streamed_sog import LEVELS, LOD_META, read_streamed_sog, write_streamed_sog
from .usd import USD_ENDINGS, is_usd, read_usd, write_usd

PLY_ENDING, SPLAT_ENDING, SPZ_ENDING, SOG_ENDING = ".ply", ".splat", ".spz", ".sog"

_PLY_STARTS = (b"ply\n", b"ply\r")
_PAGE_START = b"<!DOCTYP"
ELSEWHERE = (".ksplat", ".lcc", ".lcc2")  # formats that splat-transform of PlayCanvas reads


@dataclass(frozen=True)
class WrittenFormat:
    """A format that is written.

    Parameters
    ----------
    shapes : the kernels that it holds; None: all.
    rounds : whether the file holds fewer digits than float32.
    numbers : whether the file holds the near plane and the low pass of the model.
    antialiased : whether the file says that a model is antialiased.
    bands : whether the file holds SH bands above 0.
    """

    shapes: tuple[str, ...] | None
    rounds: bool
    numbers: bool = True
    antialiased: bool = True
    bands: bool = True


_GAUSSIAN_ONLY, _EXTENDED = (GAUSSIAN.name,), tuple(EXTRA_FIELDS)
# By ending or whole name, in the order of messages. `clsplat convert` writes pages, because they have cameras as well.
WRITTEN = {
    PLY_ENDING: WrittenFormat(None, False),
    SPLAT_ENDING: WrittenFormat(_GAUSSIAN_ONLY, True, False, False, False),
    SPZ_ENDING: WrittenFormat(_GAUSSIAN_ONLY, True, False),
    SOG_ENDING: WrittenFormat((GAUSSIAN.name, SKEW_NORMAL.name), True),
    LOD_META: WrittenFormat(_GAUSSIAN_ONLY, True),
    GLB_ENDING: WrittenFormat(_EXTENDED, False),
    **{ending: WrittenFormat(_EXTENDED, False) for ending in USD_ENDINGS},
    PAGE_ENDING: WrittenFormat(PAGE_SHAPES, True),
}
# For a beginning that says nothing: these readers say what is missing.
_BY_ENDING: dict[str, Callable[[Path], StoredSplats]] = {
    PAGE_ENDING: read_page,
    GLB_ENDING: read_gltf_splats,
    GLTF_ENDING: read_gltf_splats,
    **dict.fromkeys(USD_ENDINGS, read_usd),
    SPZ_ENDING: read_spz,
    SOG_ENDING: read_sog,
}
READ_ENDINGS = (*WRITTEN, GLTF_ENDING)  # lod-meta.json ends a path too
READ_NAMES = (META, LOD_META)  # JSON files that are models; all other ones are not


def read_splats(path: str | os.PathLike[str]) -> StoredSplats:
    """Read a file of splats: a PLY, .spz, .splat, .sog (or its meta.json), .glb, .gltf or USD file, or a page.

    Splats and columns that cannot be used are left out, with a warning.

    Raises
    ------
    InputError : the file is missing or damaged, or has another format.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in ELSEWHERE:
        raise InputError(
            f"{path}: {suffix} files are not read: convert it with `splat-transform {path.name} {path.stem}.ply` "
            "(npm install @playcanvas/splat-transform)"
        )
    found = read_streamed_sog(path) if path.name == LOD_META else _reader(path, suffix, _start(path))(path)
    if (text := far_away(found.arrays)) is not None:
        warnings.warn(f"{path}: {text}", stacklevel=2)
    return found


def _reader(path: Path, suffix: str, start: bytes) -> Callable[[Path], StoredSplats]:
    """Return the function that reads a file with this ending and this beginning."""
    if start.startswith(_PLY_STARTS):
        return read_ply
    if start == _PAGE_START:
        return read_page
    if is_glb(start):
        return read_gltf_splats
    if is_usd(start):
        if suffix not in USD_ENDINGS:
            raise InputError(f"{path}: is an OpenUSD file, which needs its ending: rename it to {path.stem}.usd")
        return read_usd
    if is_sog(start):  # a zip archive
        return read_usd if suffix in USD_ENDINGS else read_sog
    if suffix == SPLAT_ENDING:  # its content has no mark; the first number may look like one of two bytes
        return read_spz if start.startswith(GZIP_START) else read_splat
    if is_spz(start):
        return read_spz
    return _BY_ENDING.get(suffix, read_sog if path.name == META else read_ply)


def write_splats(
    path: str | os.PathLike[str], splats: StoredSplats, compact: bool = False, spz_version: int = SPZ_VERSIONS[0]
) -> None:
    """Write a .splat, .spz, .sog, .glb or USD file, or else a PLY.

    Parameters
    ----------
    compact : as for `write_ply`.
    spz_version : version of an .spz file, 3 or 4.

    Raises
    ------
    OutputError : the file cannot be written, or is a page, which needs cameras as well.
    InputError : the format does not support the shape of the splats, or float32 does not hold their values.
    """
    if any(values.dtype != np.float32 for values in splats.arrays.values()):
        with np.errstate(over="ignore"):  # the check finds and names values that overflow
            single: dict[str, Array] = {name: values.astype(np.float32) for name, values in splats.arrays.items()}
        check_arrays(shape_named(splats.shape).schema(sh_degree_for(single)), single)
    if (text := far_away(splats.arrays)) is not None:
        raise InputError(f"{path}: not written: {text}")
    suffix = format_of(Path(path))
    if suffix == PAGE_ENDING:
        raise OutputError(f"{path}: pages are written by `clsplat convert` and clsplat.convert_model: use one of these")
    if suffix == SPLAT_ENDING:
        write_splat(path, splats)
    elif suffix == SPZ_ENDING:
        write_spz(path, splats, spz_version)
    elif suffix == SOG_ENDING:
        write_sog(path, splats)
    elif suffix == LOD_META:
        write_streamed_sog(path, splats, LEVELS)
    elif suffix == GLB_ENDING:
        write_gltf_splats(path, splats)
    elif suffix in USD_ENDINGS:
        write_usd(path, splats)
    else:
        write_ply(
            path,
            splats.shape,
            splats.normalisation,
            splats.arrays,
            compact,
            splats.antialiased,
            splats.near_plane,
            splats.low_pass,
        )


def stored_bytes(path: Path) -> int:
    """Return the bytes of a file of splats, with those of the images that a meta.json or lod-meta.json names."""
    if path.name not in READ_NAMES:
        return path.stat().st_size
    parts = path.parent.glob("*") if path.name == META else path.parent.rglob("*")
    kinds = (".webp", ".json")
    return sum(part.stat().st_size for part in parts if part.suffix in kinds and part.is_file())


def format_of(path: Path) -> str:
    """Return the key of a file in WRITTEN: its ending in lower case, or its whole name."""
    return LOD_META if path.name == LOD_META else path.suffix.lower()


def check_ending(path: Path, *without: str) -> str:
    """Return `format_of` a file; raise OutputError if that format is not written.

    without : endings that the caller cannot write.
    """
    endings = [ending for ending in WRITTEN if ending not in without]
    suffix = format_of(path)
    if suffix not in endings:
        raise OutputError(
            f"{path}: writes {', '.join(endings[:-1])} and {endings[-1]} files: choose one of these endings"
        )
    return suffix


def check_shape(path: Path, form: str, shape: str) -> None:
    """Raise OutputError if files of a format of WRITTEN do not hold splats of a shape."""
    shapes = WRITTEN[form].shapes
    if shapes is not None and shape not in shapes:
        raise OutputError(
            f"{path}: {form} files hold {', '.join(shapes)} splats, not {shape}: choose .ply, or convert it"
        )


def _start(path: Path) -> bytes:
    """Return the first bytes of a file; none if it cannot be read, which its reader reports."""
    try:
        with path.open("rb") as stream:
            return stream.read(8)
    except OSError:
        return b""

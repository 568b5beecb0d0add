"""Containers of `.spz` files: header, extensions, and one stream of bytes for each attribute.

Format: https://github.com/nianticlabs/spz, "File Format". All numbers are little-endian.

Versions 1 to 3 are one gzip stream: a header of 16 bytes, the attributes one after the other, extensions.

    uint32 magic, version, number of splats     uint8 SH degree, fraction bits of a position, flags, 0

Version 4 is not compressed as a whole: a header of 32 bytes, extensions, a table, then one Zstandard frame for each
attribute. The table has the compressed and the original size of each frame, as uint64.

    uint32 magic, version, number of splats     uint8 SH degree, fraction bits, flags, number of frames
    uint32 place of the table     12 bytes 0

The attributes are positions, opacities, colours, scales, rotations and, above SH degree 0, harmonics. An extension has
uint32 type, uint32 length, and that many bytes.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...files import zstd
from ..fields import sh_coefficients

Bytes = NDArray[np.uint8]

GZIP_VERSION, ZSTD_VERSION = 3, 4  # the newest version of each container
ANTIALIASED, _EXTENDED = 1, 2  # flags
MAX_DEGREE = 4
RUB = 4  # the coordinate system of files without an extension: x right, y up, z back
_COORDINATE_SYSTEM = 0xADBE0003  # extension with the coordinate system as uint32
_MAGIC = 0x5053474E
_GZIP_MAGIC = b"\x1f\x8b"
GZIP_START = _GZIP_MAGIC + b"\x08"  # with the only method of compression that there is
_HEADER = struct.Struct("<IIIBBBB")
_HEADER_4 = struct.Struct("<IIIBBBBI12x")
_TABLE_ROW = struct.Struct("<QQ")
_EXTENSION = struct.Struct("<II")
_POSITION_BYTES = {1: 6, 2: 9, 3: 9, 4: 9}  # version 1 has half floats, the others 24-bit numbers
_ROTATION_BYTES = {1: 3, 2: 3, 3: 4, 4: 4}
_MAX_EXTENSIONS = 1 << 20  # bytes
_MAX_GZIP_RATIO = 1100  # above the limit of gzip, 1032
_MAX_ZSTD_RATIO = 50_000  # above the limit of Zstandard: blocks of 128 KiB from 4 bytes


@dataclass(frozen=True)
class SpzHeader:
    """The header of a file.

    Parameters
    ----------
    version : 1 to 4. count : number of splats. degree : SH degree, 0 to 4.
    fraction_bits : of a position. flags : ANTIALIASED or 0.
    coordinate_system : number of the axes, as in the extension of Adobe.
    """

    version: int
    count: int
    degree: int
    fraction_bits: int
    flags: int
    coordinate_system: int = RUB

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes of a splat in each attribute, in the order of the file."""
        rest = 3 * (sh_coefficients(self.degree) - 1)
        return (_POSITION_BYTES[self.version], 1, 3, 3, _ROTATION_BYTES[self.version], rest)


def is_spz(start: bytes) -> bool:
    """Return whether a file that begins with these bytes is an .spz file, or another gzip file."""
    return start.startswith((_GZIP_MAGIC, _MAGIC.to_bytes(4, "little")))


def write_container(header: SpzHeader, parts: Sequence[bytes]) -> bytes:
    """Return the bytes of a file of version 3 or 4. The same parts give the same bytes.

    Raises
    ------
    InputError : version 4 needs Zstandard, which is not installed. The message names no file.
    """
    start = (_MAGIC, header.version, header.count, header.degree, header.fraction_bits, header.flags)
    if header.version != ZSTD_VERSION:
        # The gzip header gets neither name nor time.
        return gzip.compress(_HEADER.pack(*start, 0) + b"".join(parts), mtime=0)
    parts = [part for part, width in zip(parts, header.widths, strict=True) if width]
    try:
        frames = [zstd.compress(part) for part in parts]
    except zstd.ZstdMissingError as error:
        raise InputError(f"version {header.version} {error}") from None
    table = b"".join(_TABLE_ROW.pack(len(frame), len(part)) for frame, part in zip(frames, parts, strict=True))
    return b"".join([_HEADER_4.pack(*start, len(frames), _HEADER_4.size), table, *frames])


def read_container(path: Path) -> tuple[SpzHeader, list[Bytes]]:
    """Return the header and the six attributes, each with (N, width) bytes.

    Raises
    ------
    InputError : the file cannot be read, is damaged, or has an unknown version; or it needs Zstandard, which is not
        installed.
    """
    try:
        with path.open("rb") as stream:
            is_gzip = stream.read(2) == _GZIP_MAGIC
        header, parts = _read_gzip(path) if is_gzip else _read_zstd(path)
    except OSError as error:  # gzip.BadGzipFile too
        reason = error.strerror or str(error)
        raise InputError(f"{path}: cannot be read ({reason}); check name and rights, or export it again") from None
    except (EOFError, zlib.error) as error:
        raise InputError(f"{path}: is damaged ({error}); export it again") from None
    return header, [
        np.frombuffer(part, np.uint8).reshape(header.count, width)
        for part, width in zip(parts, header.widths, strict=True)
    ]


def _read_gzip(path: Path) -> tuple[SpzHeader, list[bytes]]:
    with gzip.open(path) as stream:
        start = stream.read(_HEADER.size)
        if len(start) < _HEADER.size:
            raise InputError(f"{path}: is not a .spz file (it ends in the header); export it again")
        magic, version, count, degree, bits, flags, _ = _HEADER.unpack(start)
        header = _checked(path, magic, SpzHeader(version, count, degree, bits, flags), GZIP_VERSION)
        size = count * sum(header.widths)
        # A gzip stream is at most 1032 times its file, so a false count is found before memory is allocated.
        if size > _MAX_GZIP_RATIO * path.stat().st_size:
            raise InputError(f"{path}: is too short for the {count} splats of its header; export it again")
        body = stream.read(size)
        extensions = stream.read(_MAX_EXTENSIONS if flags & _EXTENDED else 1)
    if len(body) != size or (extensions and not flags & _EXTENDED):
        raise InputError(f"{path}: does not hold the {count} splats of its header; export it again")
    ends = np.cumsum([0, *(count * width for width in header.widths)])
    return _with_extensions(path, header, extensions), [body[a:b] for a, b in pairwise(ends)]


def _read_zstd(path: Path) -> tuple[SpzHeader, list[bytes]]:
    data = path.read_bytes()
    if len(data) < _HEADER_4.size:
        raise InputError(f"{path}: is not a .spz file (it ends in the header); export it again")
    magic, version, count, degree, bits, flags, frames, place = _HEADER_4.unpack_from(data)
    header = _checked(path, magic, SpzHeader(version, count, degree, bits, flags), ZSTD_VERSION, ZSTD_VERSION)
    widths = [width for width in header.widths if width]
    end = place + frames * _TABLE_ROW.size
    if frames < len(widths) or place < _HEADER_4.size or end > len(data):
        raise InputError(f"{path}: its table of {frames} attributes is damaged; export it again")
    parts = []
    for width, (packed, size) in zip(widths, _TABLE_ROW.iter_unpack(data[place:end]), strict=False):
        if size != count * width or size > _MAX_ZSTD_RATIO * packed or end + packed > len(data):
            raise InputError(f"{path}: does not hold the {count} splats of its header; export it again")
        try:
            parts.append(zstd.decompress(data[end : end + packed], size))
        except (InputError, zstd.ZstdMissingError) as error:
            remedy = "; export it again" if isinstance(error, InputError) else ", or write it as version 3"
            raise InputError(f"{path}: version {version}: {error}{remedy}") from None
        end += packed
    parts += [b""] * (len(header.widths) - len(widths))
    return _with_extensions(path, header, data[_HEADER_4.size : place]), parts


def _checked(path: Path, magic: int, header: SpzHeader, newest: int, oldest: int = 1) -> SpzHeader:
    if magic != _MAGIC:
        raise InputError(f"{path}: is not a .spz file; choose a file of splats")
    if not oldest <= header.version <= newest:
        raise InputError(
            f"{path}: has version {header.version}, versions 1 to {ZSTD_VERSION} of .spz are read; "
            "write it as .ply with the program that made it"
        )
    if header.degree > MAX_DEGREE:
        raise InputError(f"{path}: has SH degree {header.degree}, expected 0 to {MAX_DEGREE}; export it again")
    return header


def _with_extensions(path: Path, header: SpzHeader, records: bytes) -> SpzHeader:
    """Return the header with the coordinate system of the extensions; unknown ones are skipped."""
    at = 0
    while header.flags & _EXTENDED and at + _EXTENSION.size <= len(records):
        kind, length = _EXTENSION.unpack_from(records, at)
        payload = records[at + _EXTENSION.size : at + _EXTENSION.size + length]
        if len(payload) != length:
            raise InputError(f"{path}: its extensions are damaged; export it again")
        if kind == _COORDINATE_SYSTEM and length == 4:
            system = int.from_bytes(payload, "little") or RUB
            header = SpzHeader(header.version, header.count, header.degree, header.fraction_bits, header.flags, system)
        at += _EXTENSION.size + length
    return header

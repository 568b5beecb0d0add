"""The header of a PLY file: parsed strictly, so that a wrong file is named before anything is allocated.

Format: Greg Turk, "The PLY Polygon File Format" (1994).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import BinaryIO

from .errors import InputError

BYTE_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
REAL_TYPES = {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
_INTEGER_TYPES = (
    "char", "uchar", "short", "ushort", "int", "uint",
    "int8", "uint8", "int16", "uint16", "int32", "uint32",
)  # fmt: skip
_MAX_LINE = 4096
_MAX_LINES = 4096


@dataclass
class Header:
    """What a PLY header says: encoding, vertices, and (type, name) of their properties in file order."""

    encoding: str = ""
    count: int = -1
    properties: list[tuple[str, str]] = field(default_factory=list)
    comments: list[str] = field(default_factory=list)

    @property
    def names(self) -> list[str]:
        return [name for _, name in self.properties]


def read_header(path: object, stream: BinaryIO) -> Header:
    """Header of the PLY file `stream`, which is left at the first byte after it.

    Raises
    ------
    InputError : not a PLY file, a line that is no PLY, or anything but one element `vertex` of scalars;
        it names the file (`path`) and the line.
    """
    if stream.readline(_MAX_LINE).rstrip(b"\r\n") != b"ply":
        raise InputError(f"{path}: not a PLY file (its first line is not 'ply'); choose a splat .ply")
    header = Header()
    for number in range(2, _MAX_LINES):
        raw = stream.readline(_MAX_LINE)
        if not raw.endswith(b"\n"):
            raise InputError(f"{path}: header line {number} is cut off; the file is truncated or no PLY")
        line = raw.decode("latin-1").rstrip("\r\n")
        words = line.split()
        keyword = words[0] if words else ""
        if keyword == "end_header":
            break
        try:
            _take(header, keyword, words, line)
        except InputError as error:
            raise InputError(f"{path}: header line {number}: {error}") from None
    else:
        raise InputError(f"{path}: no end_header within {_MAX_LINES} lines; the header is damaged")
    if not header.encoding:
        raise InputError(f"{path}: header has no format line; add 'format binary_little_endian 1.0'")
    if header.count < 0:
        raise InputError(f"{path}: header has no element 'vertex'; choose a splat .ply")
    return header


def _take(header: Header, keyword: str, words: list[str], line: str) -> None:
    """Put one header line into `header`; raises InputError without the place."""
    shown = line[:80].encode("unicode_escape").decode("ascii")
    if keyword == "comment":
        header.comments.append(line.strip()[len("comment") :].strip())
    elif keyword == "format" and len(words) == 3:
        if words[1] not in BYTE_ORDER:
            raise InputError(f"format {words[1]!r} is unknown; expected one of {', '.join(BYTE_ORDER)}")
        header.encoding = words[1]
    elif keyword == "element" and len(words) == 3:
        if words[1] != "vertex" or header.count >= 0:
            raise InputError(
                f"element {words[1]!r}: a splat file has one element, 'vertex' "
                "(meshes and compressed PLY files are not read; export plain splats)"
            )
        if not (words[2].isascii() and words[2].isdigit() and len(words[2]) <= 15):
            raise InputError(f"element 'vertex' has count {words[2][:20]!r}; expected a whole number")
        header.count = int(words[2])
    elif keyword == "property" and len(words) >= 2 and words[1] == "list":
        raise InputError(f"property {words[-1]!r} is a list; a splat file has plain float properties")
    elif keyword == "property" and len(words) == 3:
        if header.count < 0:
            raise InputError(f"property {words[2]!r} comes before any element; the header is damaged")
        if words[1] not in REAL_TYPES and words[1] not in _INTEGER_TYPES:
            raise InputError(f"property {words[2]!r} has unknown type {words[1]!r}; expected float or double")
        if words[2] in header.names:
            raise InputError(f"property {words[2]!r} occurs twice; rename or remove one")
        header.properties.append((words[1], words[2]))
    elif keyword != "obj_info":  # obj_info is a second kind of comment
        raise InputError(f"{shown!r} is no PLY header line; the header is damaged")

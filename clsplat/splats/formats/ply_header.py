"""Parser of PLY headers: a wrong file gives an error before memory is allocated.

Format: Greg Turk, "The PLY Polygon File Format" (1994).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import BinaryIO

from ...errors import InputError, named_place

BYTE_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
REAL_TYPES = {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
INTEGER_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
}
SIDE_PREFIX = "clsplat_"  # begins the names of elements that follow the vertices (ply_compact.py)
VERTEX = "vertex"
_MAX_LINE = 4096
_MAX_LINES = 4096


@dataclass
class Element:
    """One table of the body.

    Parameters
    ----------
    count : number of rows. properties : (type, name) in file order, without lists.
    has_lists : whether rows have lists too, so that their lengths are unknown. Such tables are not read.
    """

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    has_lists: bool = False

    @property
    def names(self) -> list[str]:
        return [name for _, name in self.properties]


@dataclass
class Header:
    """The content of a PLY header: encoding and elements. The element `vertex` exists and has no lists."""

    encoding: str = ""
    elements: list[Element] = field(default_factory=list)
    comments: list[str] = field(default_factory=list)

    @property
    def vertex(self) -> Element:
        """The element with the splats or points."""
        return next(element for element in self.elements if element.name == VERTEX)

    @property
    def tables(self) -> list[Element]:
        """The elements that can be read: those before the first one with lists."""
        end = next((i for i, element in enumerate(self.elements) if element.has_lists), len(self.elements))
        return self.elements[:end]

    @property
    def side_elements(self) -> list[Element]:
        """The elements of clsplat that follow the vertices."""
        return [element for element in self.elements if element.name.startswith(SIDE_PREFIX)]

    @property
    def count(self) -> int:
        """Number of vertices."""
        return self.vertex.count

    @property
    def properties(self) -> list[tuple[str, str]]:
        """(type, name) of the properties of a vertex."""
        return self.vertex.properties

    @property
    def names(self) -> list[str]:
        """Names of the properties of a vertex."""
        return self.vertex.names


def read_header(path: object, stream: BinaryIO) -> Header:
    """Read the header of a PLY file; the stream is left at the first byte of the body.

    Raises
    ------
    InputError : the file is not a PLY file, a line is wrong, or no element `vertex` can be read. The message names the
        file (`path`) and the line.
    """
    if stream.readline(_MAX_LINE).rstrip(b"\r\n") != b"ply":
        raise InputError(f"{path}: not a PLY file (its first line is not 'ply'); choose a splat .ply")
    header = Header()
    for number in range(2, _MAX_LINES):
        raw = stream.readline(_MAX_LINE)
        if not raw.endswith(b"\n"):
            raise InputError(f"{path}: header line {number} is cut off; the file is truncated or not a PLY file")
        line = raw.decode("latin-1").rstrip("\r\n")
        words = line.split()
        keyword = words[0] if words else ""
        if keyword == "end_header":
            break
        with named_place(f"{path}: header line {number}"):
            _take(header, keyword, words, line)
    else:
        raise InputError(f"{path}: no end_header within {_MAX_LINES} lines; the header is damaged")
    if not header.encoding:
        raise InputError(f"{path}: header has no format line; add 'format binary_little_endian 1.0'")
    if all(element.name != VERTEX for element in header.elements):
        raise InputError(f"{path}: header has no element 'vertex'; choose a splat .ply")
    names = [element.name for element in header.tables]
    for element in (header.vertex, *header.side_elements):
        if element.name not in names or names.index(element.name) < names.index(VERTEX):
            raise InputError(f"{path}: element {element.name!r} comes before 'vertex' or after lists; export it again")
    return header


def _take(header: Header, keyword: str, words: list[str], line: str) -> None:
    """Add one header line to `header`; the InputError does not name the line."""
    shown = line[:80].encode("unicode_escape").decode("ascii")
    if keyword == "comment":
        header.comments.append(line.strip()[len("comment") :].strip())
    elif keyword == "format" and len(words) == 3:
        if words[1] not in BYTE_ORDER:
            raise InputError(f"format {words[1]!r} is unknown; expected one of {', '.join(BYTE_ORDER)}")
        header.encoding = words[1]
    elif keyword == "element" and len(words) == 3:
        _take_element(header, words[1], words[2])
    elif keyword == "property" and len(words) == 5 and words[1] == "list" and header.elements:
        if header.elements[-1].name == VERTEX:
            raise InputError(f"property {words[-1]!r} is a list; a splat file has plain float properties")
        header.elements[-1].has_lists = True
    elif keyword == "property" and len(words) == 3:
        if not header.elements:
            raise InputError(f"property {words[2]!r} comes before any element; the header is damaged")
        if words[1] not in REAL_TYPES and words[1] not in INTEGER_TYPES:
            raise InputError(f"property {words[2]!r} has unknown type {words[1]!r}; expected float or double")
        if words[2] in header.elements[-1].names:
            raise InputError(f"property {words[2]!r} occurs twice; rename or remove one")
        header.elements[-1].properties.append((words[1], words[2]))
    elif keyword != "obj_info":  # obj_info is a second kind of comment
        raise InputError(f"{shown!r} is not a PLY header line; the header is damaged")


def _take_element(header: Header, name: str, count: str) -> None:
    """Begin an element; the InputError does not name the line."""
    if any(element.name == name for element in header.elements):
        raise InputError(f"element {name!r} occurs twice; rename or remove one")
    if not (count.isascii() and count.isdigit() and len(count) <= 15):
        raise InputError(f"element {name!r} has count {count[:20]!r}; expected a whole number")
    header.elements.append(Element(name, int(count)))

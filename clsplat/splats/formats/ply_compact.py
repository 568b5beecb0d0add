"""Compact splat files: the layout that leaves out unused values.

A compact file is a PLY file. Its first element, `vertex`, is a usable splat file with fewer columns: no normals, SH up
to a base degree, and only those fields of the shape that most splats use. Further elements follow. Each has one row
for each splat that uses its columns, in rising order of the index:

    clsplat_NAME    uint index, and the columns of the field NAME; splats without a row have its neutral value
    clsplat_sh_D    uint index, and f_rest_* of the bands above the base; splats without a row have zeros

`clsplat_sh_D` holds the splats whose highest band is D, with f_rest_* numbered as in a file of degree D. Other viewers
read the first element and skip the rest: they show the base colours, without the moved fields. The degree of the file
is the highest degree in use; higher bands are not stored. All values are float32 and keep their bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..fields import MAX_SH_DEGREE, Array, Field, Schema, sh_coefficients
from .ply_header import SIDE_PREFIX, Header

INDEX = "index"
_SH = SIDE_PREFIX + "sh_"
RowIndices = NDArray[np.int64]
SideTable = tuple[str, dict[str, NDArray[Any]]]


@dataclass(frozen=True)
class Layout:
    """The division of a compact file into elements.

    Parameters
    ----------
    degree : the highest SH degree in use. base : the SH degree of the vertices.
    bands : for each D above the base, the splats whose highest band is D.
    sparse : for each moved field, the splats whose value is not neutral.
    """

    degree: int
    base: int
    bands: dict[int, RowIndices] = field(default_factory=dict)
    sparse: dict[str, RowIndices] = field(default_factory=dict)


def bands_in_use(sh: Array) -> NDArray[np.int64]:
    """Return for each colour (N, K, 3) the highest band (N,) with a coefficient that is not zero."""
    highest = np.zeros(len(sh), np.int64)
    for band in range(1, MAX_SH_DEGREE + 1):
        start, stop = sh_coefficients(band - 1), sh_coefficients(band)
        if stop <= sh.shape[1]:
            highest[_nonzero(sh[:, start:stop])] = band
    return highest


def in_use(field_: Field, values: Array) -> NDArray[np.bool_]:
    """Return (N,) whether the value of a field differs from the neutral one."""
    return _nonzero(values.reshape(len(values), field_.width) - np.asarray(field_.neutral, values.dtype))


def plan_layout(schema: Schema, arrays: Mapping[str, Array]) -> Layout:
    """Return the layout that needs the fewest bytes.

    Parameters
    ----------
    arrays : all public arrays, float32.
    """
    n = len(arrays["mean"])
    highest = bands_in_use(arrays["sh"])
    degree = int(highest.max(initial=0))
    counts = np.bincount(highest, minlength=MAX_SH_DEGREE + 1)

    def size(base: int) -> int:
        """Return the number of four-byte words for colour."""
        k = sh_coefficients(base)
        return 3 * k * n + sum(
            (1 + 3 * (sh_coefficients(band) - k)) * int(counts[band]) for band in range(base + 1, degree + 1)
        )

    base = min(range(degree + 1), key=size)
    bands = {band: np.flatnonzero(highest == band) for band in range(base + 1, degree + 1) if counts[band]}
    sparse = {}
    for candidate in movable(schema):
        rows = np.flatnonzero(in_use(candidate, arrays[candidate.name]))
        if (1 + candidate.width) * len(rows) < candidate.width * n:
            sparse[candidate.name] = rows
    return Layout(degree, base, bands, sparse)


def movable(schema: Schema) -> list[Field]:
    """Return the fields that may be left out for a splat: those whose neutral value is a constant."""
    core = {"mean", "quat", "log_scale", "opacity_logit", "sh"}
    return [f for f in schema if f.name not in core and f.neutral_from is None and not f.nonzero]


def layout_bytes(schema: Schema, layout: Layout, n: int) -> int:
    """Return the bytes of a compact file of n splats, without its header."""
    k = sh_coefficients(layout.base)
    words = n * (3 * k + sum(f.width for f in schema if f.name != "sh" and f.name not in layout.sparse))
    words += sum((1 + schema[name].width) * len(rows) for name, rows in layout.sparse.items())
    words += sum((1 + 3 * (sh_coefficients(band) - k)) * len(rows) for band, rows in layout.bands.items())
    return 4 * words


def rest_columns(band: int, base: int) -> dict[str, tuple[int, int]]:
    """Return (coefficient, channel) of each f_rest_* above degree `base` in a file of degree `band`."""
    per_channel = sh_coefficients(band) - 1
    return {
        f"f_rest_{channel * per_channel + k - 1}": (k, channel)
        for channel in range(3)
        for k in range(sh_coefficients(base), per_channel + 1)
    }


def side_tables(schema: Schema, arrays: Mapping[str, Array], layout: Layout) -> list[SideTable]:
    """Return name and columns, the index first, of each element that follows the vertices."""
    tables: list[SideTable] = []
    for name, rows in layout.sparse.items():
        values = arrays[name].reshape(len(arrays[name]), schema[name].width)[rows]
        columns = dict(zip(schema[name].ply, values.T, strict=True))
        tables.append((SIDE_PREFIX + name, {INDEX: rows.astype(np.uint32), **columns}))
    for band, rows in layout.bands.items():
        places = rest_columns(band, layout.base)
        columns = {name: arrays["sh"][rows, k, channel] for name, (k, channel) in places.items()}
        tables.append((f"{_SH}{band}", {INDEX: rows.astype(np.uint32), **columns}))
    return tables


def side_fields(path: object, header: Header, schema: Schema) -> dict[str, Field]:
    """Return the fields that have an element of their own, by the names of the elements.

    Raises
    ------
    InputError : an element does not belong to the shape, or has wrong properties.
    """
    by_element = {SIDE_PREFIX + field_.name: field_ for field_ in movable(schema)}
    found = {}
    base = schema.sh_degree
    for element in header.side_elements:
        expected: tuple[str, ...]
        if element.name in by_element:
            found[element.name] = by_element[element.name]
            expected = by_element[element.name].ply
        elif element.name in {f"{_SH}{band}" for band in range(base + 1, MAX_SH_DEGREE + 1)}:
            expected = tuple(rest_columns(int(element.name[len(_SH) :]), base))
        else:
            raise InputError(
                f"{path}: element {element.name!r} does not match this shape and the vertices' SH "
                f"degree {base}; export again"
            )
        if [*element.properties] != [("uint", INDEX), *(("float", name) for name in expected)]:
            raise InputError(
                f"{path}: element {element.name!r}: its properties must be uint {INDEX} and float "
                f"{expected[0]} to {expected[-1]}; export again"
            )
    return found


def filled_in(
    path: object,
    header: Header,
    body: Mapping[str, Mapping[str, NDArray[Any]]],
    schema: Schema,
    arrays: dict[str, Array],
) -> dict[str, Array]:
    """Return the arrays of the vertices, completed from the other elements.

    Parameters
    ----------
    schema : schema at the degree of the vertices. arrays : public arrays of the vertices, without the moved fields.

    Raises
    ------
    InputError : an index is out of range or does not rise, or a splat is in two elements of bands.
    """
    n, base = header.count, schema.sh_degree
    moved = side_fields(path, header, schema)
    degree = max((int(e.name[len(_SH) :]) for e in header.side_elements if e.name.startswith(_SH)), default=base)
    sh = arrays["sh"]
    if degree > base:
        sh = np.zeros((n, sh_coefficients(degree), 3), sh.dtype)
        sh[:, : arrays["sh"].shape[1]] = arrays["sh"]
    taken = np.zeros(n, bool)
    full = dict(arrays)
    for element in header.side_elements:
        columns = body[element.name]
        rows = _index(path, element.name, columns[INDEX], n)
        if element.name in moved:
            moved_field = moved[element.name]
            values = np.tile(np.asarray(moved_field.neutral, sh.dtype), (n, 1))
            for component, name in enumerate(moved_field.ply):
                values[rows, component] = columns[name]
            full[moved_field.name] = values[:, 0] if moved_field.width == 1 else values
            continue
        if taken[rows].any():
            twice = int(rows[taken[rows]][0])
            raise InputError(f"{path}: splat {twice} is in two elements {_SH}*; export again")
        taken[rows] = True
        for name, (k, channel) in rest_columns(int(element.name[len(_SH) :]), base).items():
            sh[rows, k, channel] = columns[name]
    return full | {"sh": sh}


def _index(path: object, element: str, index: NDArray[Any], n: int) -> RowIndices:
    """Return the index of an element if it rises and stays below n; raise InputError otherwise."""
    rows = index.astype(np.int64)
    bad = np.flatnonzero((rows >= n) | (np.diff(rows, prepend=-1) <= 0))
    if bad.size:
        raise InputError(
            f"{path}: element {element!r}, row {bad[0]}: index {rows[bad[0]]} must rise and be below {n}, "
            "the number of vertices; export again"
        )
    return rows


def _nonzero(values: Array) -> NDArray[np.bool_]:
    """Return (N,) whether a row has a value that is not zero. Negative zeros count, so that their bit is kept."""
    used = (values != 0) | np.signbit(values)
    return np.asarray(used.any(axis=tuple(range(1, used.ndim))))

"""Splat files without what their splats do not use: how columns are shared out between elements.

A compact file is a PLY whose first element, `vertex`, is a usable splat file of fewer columns: no normals, SH up to a
base degree, and of the shape's own fields those that most splats use. What the other splats have beyond that follows in
elements of its own, one row for each splat that has it, in rising order:

    clsplat_NAME    uint index, and the columns of the shape's own field NAME; splats without a row: its neutral value
    clsplat_sh_D    uint index, and f_rest_* of the bands above the base; splats without a row: zeros

`clsplat_sh_D` holds the splats whose highest band is D, with f_rest_* numbered as in a file of degree D. Viewers read
the first element and pass over the others: they show the base colours, and splats without the fields that moved. The
highest degree in use is the file's: bands that no splat uses are not kept. All values are float32, bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .fields import MAX_SH_DEGREE, Array, Field, Schema, sh_coefficients
from .ply_header import SIDE_PREFIX, Header

INDEX = "index"
_SH = SIDE_PREFIX + "sh_"
Rows = NDArray[np.int64]
Table = tuple[str, dict[str, NDArray[Any]]]


@dataclass(frozen=True)
class Layout:
    """Where a compact file has what.

    Parameters
    ----------
    degree : the highest SH degree in use. base : the degree that all vertices have.
    bands : splats whose highest band is D, by D above the base.
    sparse : splats with another value than the neutral one, by the name of each field that moved.
    """

    degree: int
    base: int
    bands: dict[int, Rows] = field(default_factory=dict)
    sparse: dict[str, Rows] = field(default_factory=dict)


def bands_in_use(sh: Array) -> NDArray[np.int64]:
    """(N,) highest band of colours (N, K, 3) with a coefficient that is not zero."""
    highest = np.zeros(len(sh), np.int64)
    for band in range(1, MAX_SH_DEGREE + 1):
        first, past = sh_coefficients(band - 1), sh_coefficients(band)
        if past <= sh.shape[1]:
            highest[_nonzero(sh[:, first:past])] = band
    return highest


def in_use(field_: Field, values: Array) -> NDArray[np.bool_]:
    """(N,) whether a field's value is another than the neutral one."""
    return _nonzero(values.reshape(len(values), field_.width) - np.asarray(field_.neutral, values.dtype))


def plan_layout(schema: Schema, arrays: Mapping[str, Array]) -> Layout:
    """The layout of fewest bytes.

    Parameters
    ----------
    arrays : all public arrays, float32.
    """
    n = len(arrays["mean"])
    highest = bands_in_use(arrays["sh"])
    degree = int(highest.max(initial=0))
    counts = np.bincount(highest, minlength=MAX_SH_DEGREE + 1)

    def size(base: int) -> int:
        """Words of four bytes for colour."""
        k = sh_coefficients(base)
        return 3 * k * n + sum(
            (1 + 3 * (sh_coefficients(band) - k)) * int(counts[band]) for band in range(base + 1, degree + 1)
        )

    base = min(range(degree + 1), key=size)
    bands = {band: np.flatnonzero(highest == band) for band in range(base + 1, degree + 1) if counts[band]}
    sparse = {}
    for own in movable(schema):
        rows = np.flatnonzero(in_use(own, arrays[own.name]))
        if (1 + own.width) * len(rows) < own.width * n:
            sparse[own.name] = rows
    return Layout(degree, base, bands, sparse)


def movable(schema: Schema) -> list[Field]:
    """Own fields that a splat may lack: their neutral value is a constant."""
    core = {"mean", "quat", "log_scale", "opacity_logit", "sh"}
    return [f for f in schema if f.name not in core and f.neutral_from is None and not f.nonzero]


def layout_bytes(schema: Schema, layout: Layout, n: int) -> int:
    """Bytes of a compact file of n splats, without its header."""
    k = sh_coefficients(layout.base)
    words = n * (3 * k + sum(f.width for f in schema if f.name != "sh" and f.name not in layout.sparse))
    words += sum((1 + schema[name].width) * len(rows) for name, rows in layout.sparse.items())
    words += sum((1 + 3 * (sh_coefficients(band) - k)) * len(rows) for band, rows in layout.bands.items())
    return 4 * words


def rest_columns(band: int, base: int) -> dict[str, tuple[int, int]]:
    """(coefficient, channel) of each f_rest_* of a file of degree `band`, without those up to `base`."""
    per_channel = sh_coefficients(band) - 1
    return {
        f"f_rest_{channel * per_channel + k - 1}": (k, channel)
        for channel in range(3)
        for k in range(sh_coefficients(base), per_channel + 1)
    }


def side_tables(schema: Schema, arrays: Mapping[str, Array], layout: Layout) -> list[Table]:
    """Names and columns, the index first, of the elements that follow the vertices."""
    tables: list[Table] = []
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
    """Fields of the shape that are in elements of their own, by the elements' names.

    Raises
    ------
    InputError : an element that does not belong to the shape, or whose properties are not what they must be.
    """
    own = {SIDE_PREFIX + field_.name: field_ for field_ in movable(schema)}
    found = {}
    base = schema.sh_degree
    for element in header.elements[1:]:
        wanted: tuple[str, ...]
        if element.name in own:
            found[element.name] = own[element.name]
            wanted = own[element.name].ply
        elif element.name in {f"{_SH}{band}" for band in range(base + 1, MAX_SH_DEGREE + 1)}:
            wanted = tuple(rest_columns(int(element.name[len(_SH) :]), base))
        else:
            raise InputError(
                f"{path}: element {element.name!r} does not go with this shape and the vertices' SH "
                f"degree {base}; export again"
            )
        if [*element.properties] != [("uint", INDEX), *(("float", name) for name in wanted)]:
            raise InputError(
                f"{path}: element {element.name!r}: its properties must be uint {INDEX} and float "
                f"{wanted[0]} to {wanted[-1]}; export again"
            )
    return found


def filled_in(
    path: object,
    header: Header,
    body: Mapping[str, Mapping[str, NDArray[Any]]],
    schema: Schema,
    arrays: dict[str, Array],
) -> dict[str, Array]:
    """The vertices' arrays, with what the other elements hold.

    Parameters
    ----------
    schema : of the vertices' degree. arrays : public arrays of the vertices; fields that moved are missing.

    Raises
    ------
    InputError : an index out of range, or not rising, or a splat in two elements of bands.
    """
    n, base = header.count, schema.sh_degree
    moved = side_fields(path, header, schema)
    degree = max((int(e.name[len(_SH) :]) for e in header.elements if e.name.startswith(_SH)), default=base)
    sh = arrays["sh"]
    if degree > base:
        sh = np.zeros((n, sh_coefficients(degree), 3), sh.dtype)
        sh[:, : arrays["sh"].shape[1]] = arrays["sh"]
    taken = np.zeros(n, bool)
    full = dict(arrays)
    for element in header.elements[1:]:
        columns = body[element.name]
        rows = _index(path, element.name, columns[INDEX], n)
        if element.name in moved:
            own = moved[element.name]
            values = np.tile(np.asarray(own.neutral, sh.dtype), (n, 1))
            for component, name in enumerate(own.ply):
                values[rows, component] = columns[name]
            full[own.name] = values[:, 0] if own.width == 1 else values
            continue
        if taken[rows].any():
            twice = int(rows[taken[rows]][0])
            raise InputError(f"{path}: splat {twice} is in two elements {_SH}*; export again")
        taken[rows] = True
        for name, (k, channel) in rest_columns(int(element.name[len(_SH) :]), base).items():
            sh[rows, k, channel] = columns[name]
    return full | {"sh": sh}


def _index(path: object, element: str, index: NDArray[Any], n: int) -> Rows:
    """An element's index, if it rises and stays below n."""
    rows = index.astype(np.int64)
    bad = np.flatnonzero((rows >= n) | (np.diff(rows, prepend=-1) <= 0))
    if bad.size:
        raise InputError(
            f"{path}: element {element!r}, row {bad[0]}: index {rows[bad[0]]} must rise and be below {n}, "
            "the number of vertices; export again"
        )
    return rows


def _nonzero(values: Array) -> NDArray[np.bool_]:
    """(N,) whether any of a row's values is not zero (a negative zero is not, or its bit would be lost)."""
    used = (values != 0) | np.signbit(values)
    return np.asarray(used.any(axis=tuple(range(1, used.ndim))))

"""Splat models as PLY files in the layout of 3DGS, so that other viewers open them.

All columns are float32, in this order: `x y z`, `nx ny nz` (zeros), `f_dc_0..2`, `f_rest_*`, `opacity` (logit),
`scale_0..2` (natural log), `rot_0..3` (w, x, y, z of any norm), then the columns of the shape. `f_rest_*` has all of
red, then green, then blue. The header names the kernel:
`comment clsplat shape=<name> normalisation=<peak|pdf|none>`. Models from antialiased training have
`comment SplatRenderMode: mip`, which other programs write as well. Compact files (ply_compact.py) leave out unused
values and store rarely used ones in elements after the vertices.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...files.atomic import atomic_writer
from ..checks import Fault, check_arrays, sh_degree_for
from ..fields import Array, Field, Group, Schema, public_shape, sh_coefficients, sh_field
from ..low_pass import LOW_PASSES
from ..near_plane import NEAR_PLANES
from ..shapes import check_normalisation, shape_named
from ..stored import StoredSplats, usable_arrays
from .ply_body import read_body
from .ply_compact import SideTable, filled_in, plan_layout, side_fields, side_tables
from .ply_header import VERTEX, read_header
from .ply_packed import is_packed, unpacked
from .ply_schema import (
    COMMENT,
    NORMALS,
    SURFEL_COLUMN,
    SURFEL_LOG_SCALE,
    file_order,
    find_kernel,
    find_schema,
    refuse_point_cloud,
    warn_of_left_out,
)

_ANTIALIASED = "SplatRenderMode: mip"
_ANTIALIASED_ELSEWHERE = "antialiased 1"  # as PostShot writes it
_ROWS_AT_ONCE = 1 << 16  # that are made and written at a time, so that a file of millions needs little memory


def read_ply(path: str | os.PathLike[str]) -> StoredSplats:
    """Read a splat model, whole, compact or compressed, from a binary file of either byte order or an ascii file.

    Properties are found by name; normals are ignored. A file with the comment of clsplat must have all columns of its
    shape. A file without it is read as the first shape that has exactly its columns, else as Gaussians. Other columns,
    other elements and unusable splats are left out, with a warning.

    Raises
    ------
    InputError : the file is not a splat file, or has a wrong length; a property is missing or not float; or most of the
        splats are unusable. The message names file, property and vertex.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            header = read_header(path, stream)
            if is_packed(header):
                return unpacked(path, header, read_body(path, stream, header))
            refuse_point_cloud(path, header)
            shape, normalisation = find_kernel(path, header)
            schema = find_schema(path, header, shape)
            moved = side_fields(path, header, schema)
            body = read_body(path, stream, header)
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: cannot be read ({reason}); check name and rights") from error
    columns = {name: values for name, values in body[VERTEX].items() if any(name in field.ply for field in schema)}
    if "scale_0" in columns and SURFEL_COLUMN not in columns:
        columns[SURFEL_COLUMN] = np.full(header.count, SURFEL_LOG_SCALE, np.float32)
    arrays = {field.name: _gather(field, columns, header.count) for field in schema if field not in moved.values()}
    if header.side_elements:
        arrays = filled_in(path, header, body, schema, arrays)
        schema = shape.schema(sh_degree_for(arrays))
    warn_of_left_out(path, header, shape, schema)
    antialiased = any(comment in (_ANTIALIASED, _ANTIALIASED_ELSEWHERE) for comment in header.comments)
    numbers = [number.find(path, header.comments) for number in (NEAR_PLANES, LOW_PASSES)]
    return StoredSplats(shape.name, normalisation, antialiased, usable_arrays(path, schema, arrays, _place), *numbers)


def write_ply(
    path: str | os.PathLike[str],
    shape: str,
    normalisation: str,
    arrays: Mapping[str, Array],
    compact: bool = False,
    antialiased: bool = False,
    near_plane: float = NEAR_PLANES.usual,
    low_pass: float = LOW_PASSES.usual,
) -> None:
    """Write a splat model, binary little-endian float32 (float64 is rounded), atomically.

    Parameters
    ----------
    arrays : every field of the shape, by name, in its public shape.
    compact : leave out the values that the splats do not use (ply_compact.py). `read_ply` then returns the same
        splats, with SH up to the highest band in use.

    Raises
    ------
    InputError : the shape or normalisation is unknown, or the arrays are not a usable model in float32.
    OutputError : the file cannot be written.
    """
    check_normalisation(normalisation)
    with np.errstate(over="ignore"):  # the check finds and names values that overflow
        single = {name: np.asarray(values, np.float32) for name, values in arrays.items()}
    schema = shape_named(shape).schema(sh_degree_for(single))
    check_arrays(schema, single)
    n = len(single["mean"])
    tables: list[SideTable] = []
    if compact:
        layout = plan_layout(schema, single)
        tables = side_tables(schema, single, layout)
        single["sh"] = single["sh"][:, : sh_coefficients(layout.base)]
        fields = [sh_field(layout.base) if f.group is Group.SH else f for f in schema if f.name not in layout.sparse]
        schema = Schema(tuple(fields))
    names = [name for name in file_order(schema) if not compact or name not in NORMALS]
    head = ["ply", "format binary_little_endian 1.0", f"comment {COMMENT} shape={shape} normalisation={normalisation}"]
    head += [f"comment {_ANTIALIASED}"] if antialiased else []
    head += [f"comment {comment}" for comment in NEAR_PLANES.comments(near_plane) + LOW_PASSES.comments(low_pass)]
    head += [f"element {VERTEX} {n}", *(f"property float {name}" for name in names)]
    for element, table in tables:
        head.append(f"element {element} {len(next(iter(table.values())))}")
        head += [f"property {'float' if values.dtype.kind == 'f' else 'uint'} {name}" for name, values in table.items()]
    with atomic_writer(path) as stream:
        stream.write("".join(line + "\n" for line in (*head, "end_header")).encode("ascii"))
        for first in range(0, n, _ROWS_AT_ONCE):
            rows = {name: values[first : first + _ROWS_AT_ONCE] for name, values in single.items()}
            stream.write(_words(_columns(schema, rows, names)))
        for _, table in tables:
            stream.write(_words(table))


def _columns(schema: Schema, arrays: Mapping[str, Array], names: Sequence[str]) -> dict[str, Array]:
    """Return the columns with these names. Those that no field has are zero."""
    n = len(arrays["mean"])
    columns: dict[str, Array] = dict.fromkeys(names, np.zeros(n, dtype=np.float32))
    for field in schema:
        values = arrays[field.name]
        flat = _channel_major(values) if field.group is Group.SH else values.reshape(n, field.width)
        columns.update(zip(field.ply, flat.T, strict=True))
    return columns


def _words(table: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the rows of a table as they stand in the file. Floats and uints alike are words of four bytes."""
    words = [values.astype(values.dtype.newbyteorder("<")).view("<u4") for values in table.values()]
    return np.stack(words, axis=1).tobytes()


def _place(field: Field, fault: Fault) -> str:
    """Return property and vertex of an unusable value."""
    column = f"{field.ply[0]}..{field.ply[-1]}"
    if fault.component or field.width == 1:
        column = field.ply[_column(field, fault.component)]
    return f"property {column}, vertex {fault.index}"


def _column(field: Field, component: tuple[int, ...]) -> int:
    """Return the place of one component among the property names of the field."""
    if field.group is not Group.SH:
        return component[0] if component else 0
    k, channel = component
    return channel if k == 0 else 3 + channel * (field.width // 3 - 1) + k - 1


def _channel_major(sh: Array) -> Array:
    """Reorder (N, K, 3) to (N, 3 K) as in the file: f_dc, then f_rest channel by channel."""
    n, k, _ = sh.shape
    return np.concatenate([sh[:, 0], sh[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (k - 1))], axis=1)


def _gather(field: Field, columns: Mapping[str, Array], n: int) -> Array:
    """Return the public array of the field."""
    double = all(values.dtype == np.float64 for values in columns.values())
    dtype = np.dtype(np.float64 if double else np.float32)
    flat: Array = np.empty((n, field.width), dtype)
    coefficients = field.width // 3
    with np.errstate(over="ignore"):  # the check finds and names values that overflow
        for number, name in enumerate(field.ply):
            place = number
            if field.group is Group.SH and number >= 3:  # the file has all of red, then green, then blue
                channel, k = divmod(number - 3, coefficients - 1)
                place = 3 * (k + 1) + channel
            flat[:, place] = columns[name]
    return flat.reshape(public_shape(field, n))

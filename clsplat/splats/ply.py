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
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files.atomic import atomic_writer
from .checks import check_arrays, first_fault, sh_degree_for
from .fields import (
    CORE,
    LOG_SCALE,
    MEAN,
    OPACITY_LOGIT,
    QUAT,
    Array,
    Field,
    Group,
    Schema,
    public_shape,
    sh_coefficients,
    sh_field,
)
from .ply_body import read_body
from .ply_compact import SideTable, filled_in, plan_layout, side_fields, side_tables
from .ply_header import REAL_TYPES, Header, read_header
from .shapes import GAUSSIAN, NORMALISATIONS, SHAPES, Shape, check_normalisation, shape_named

_NORMALS = ("nx", "ny", "nz")
_COMMENT = "clsplat"
_ANTIALIASED = "SplatRenderMode: mip"
_ANTIALIASED_ELSEWHERE = "antialiased 1"  # as PostShot writes it
_REST_COUNTS = (0, 9, 24, 45)  # f_rest_* of SH degree 0 to 3


@dataclass(frozen=True, slots=True)
class PlyModel:
    """The content of a splat PLY file.

    Parameters
    ----------
    shape, normalisation : names of the kernel and its normalisation. antialiased : see `Splats`.
    arrays : public arrays by field name; float32, or float64 if every property is `double`.
    """

    shape: str
    normalisation: str
    antialiased: bool
    arrays: dict[str, Array]


def read_ply(path: str | os.PathLike[str]) -> PlyModel:
    """Read a splat model, whole or compact, from a binary file of either byte order or an ascii file.

    Properties are found by name; normals are ignored. A file with the comment of clsplat must have all columns of its
    shape. A file without it is read as the first shape that has exactly its columns, else as Gaussians.

    Raises
    ------
    InputError : the file is not a splat file, or has a wrong length; a property is missing, unknown or not float; or
        a value is unusable. The message names file, property and vertex.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            header = read_header(path, stream)
            _refuse_point_cloud(path, header)
            shape, normalisation = _kernel(path, header)
            schema = _schema(path, header, shape)
            moved = side_fields(path, header, schema)
            body = read_body(path, stream, header)
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: cannot be read ({reason}); check name and rights") from error
    columns = {name: values for name, values in body["vertex"].items() if name not in _NORMALS}
    arrays = {field.name: _gather(field, columns, header.count) for field in schema if field not in moved.values()}
    if len(header.elements) > 1:
        arrays = filled_in(path, header, body, schema, arrays)
        schema = shape.schema(sh_degree_for(arrays))
    for field in schema:
        fault = first_fault(field, arrays[field.name])
        if fault is not None:
            column = f"{field.ply[0]}..{field.ply[-1]}"
            if fault.component or field.width == 1:
                column = field.ply[_column(field, fault.component)]
            place = f"property {column}, vertex {fault.index}"
            raise InputError(f"{path}: {place}: {fault.what}; remove that splat or export again")
    antialiased = any(comment in (_ANTIALIASED, _ANTIALIASED_ELSEWHERE) for comment in header.comments)
    return PlyModel(shape.name, normalisation, antialiased, arrays)


def write_ply(
    path: str | os.PathLike[str],
    shape: str,
    normalisation: str,
    arrays: Mapping[str, Array],
    compact: bool = False,
    antialiased: bool = False,
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
        single = {name: np.asarray(values).astype(np.float32) for name, values in arrays.items()}
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
    names = [name for name in _file_order(schema) if not compact or name not in _NORMALS]
    columns: dict[str, Array] = dict.fromkeys(names, np.zeros(n, dtype=np.float32))
    for field in schema:
        values = single[field.name]
        flat = _channel_major(values) if field.group is Group.SH else values.reshape(n, field.width)
        columns.update(zip(field.ply, flat.T, strict=True))
    head = ["ply", "format binary_little_endian 1.0", f"comment {_COMMENT} shape={shape} normalisation={normalisation}"]
    head += [f"comment {_ANTIALIASED}"] if antialiased else []
    for element, table in (("vertex", columns), *tables):
        head.append(f"element {element} {len(next(iter(table.values())))}")
        head += [f"property {'float' if values.dtype.kind == 'f' else 'uint'} {name}" for name, values in table.items()]
    with atomic_writer(path) as stream:
        stream.write("".join(line + "\n" for line in (*head, "end_header")).encode("ascii"))
        for table in (columns, *(table for _, table in tables)):
            # Floats and uints alike are words of four bytes, rows of them one array.
            words = [values.astype(values.dtype.newbyteorder("<")).view("<u4") for values in table.values()]
            stream.write(np.stack(words, axis=1).tobytes())


def _file_order(schema: Schema) -> list[str]:
    """Return all property names in the order of 3DGS, those of the shape last."""
    shape_fields = [f for f in schema if f.group is Group.GEOM and f not in CORE]
    names = [*MEAN.ply, *_NORMALS]
    for field in (schema["sh"], OPACITY_LOGIT, LOG_SCALE, QUAT, *shape_fields):
        names += field.ply
    return names


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
    with np.errstate(over="ignore"):  # the check finds and names values that overflow
        flat = np.stack([columns[name].astype(dtype) for name in field.ply], axis=1)
    if field.group is Group.SH:
        rest = flat[:, 3:].reshape(n, 3, field.width // 3 - 1).transpose(0, 2, 1)
        return np.concatenate([flat[:, None, :3], rest], axis=1)
    return flat.reshape(public_shape(field, n))


def _refuse_point_cloud(path: Path, header: Header) -> None:
    names = set(header.names)
    splat_names = {"f_dc_0", *OPACITY_LOGIT.ply, *LOG_SCALE.ply, *QUAT.ply}
    if names.issuperset(MEAN.ply) and names.isdisjoint(splat_names):
        raise InputError(f"{path}: is a point cloud, not splats; choose a trained point_cloud.ply")


def _kernel(path: Path, header: Header) -> tuple[Shape, str]:
    """Return shape and normalisation, from the comment of clsplat or else from the columns."""
    for comment in header.comments:
        words = comment.split()
        values = dict(word.split("=", 1) for word in words[1:] if "=" in word)
        if words[:1] != [_COMMENT] or "shape" not in values:
            continue
        try:
            shape = shape_named(values["shape"])
            return shape, check_normalisation(values.get("normalisation", NORMALISATIONS[0]))
        except InputError as error:
            raise InputError(f"{path}: comment {comment[:80]!r}: {error}") from None
    columns = {shape.name: {name for field in shape.fields for name in field.ply} for shape in SHAPES.values()}
    held = [name for element in header.elements for name in element.names]
    shape_columns = set(held) & set().union(*columns.values())
    if not shape_columns:
        return GAUSSIAN, NORMALISATIONS[0]
    # If no shape has exactly these columns, the closest one is chosen; the error then names the missing column.
    candidates = [shape for shape in SHAPES.values() if columns[shape.name] & shape_columns]
    return min(candidates, key=lambda shape: len(columns[shape.name] ^ shape_columns)), NORMALISATIONS[0]


def _schema(path: Path, header: Header, shape: Shape) -> Schema:
    """Return the schema of the columns; raise InputError if they do not form one."""
    names = set(header.names)
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in _REST_COUNTS:
        counts = ", ".join(str(count) for count in _REST_COUNTS)
        raise InputError(f"{path}: has {rest} properties f_rest_*; SH degree 0 to 3 has one of {counts}")
    schema = shape.schema(_REST_COUNTS.index(rest))
    moved = {name for field in side_fields(path, header, schema).values() for name in field.ply}
    needed = set(_file_order(schema)) - set(_NORMALS) - moved
    missing = [name for name in _file_order(schema) if name in needed - names]
    if missing:
        of_shape = any(missing[0] in field.ply for field in shape.fields)
        remedy = (
            f"shape {shape.name} has it; export the shape's columns, or name the shape that the file holds"
            if of_shape
            else "export all of 3DGS's properties"
        )
        raise InputError(f"{path}: property {missing[0]!r} is missing; {remedy}")
    for kind, name in header.properties:
        if name not in needed and name not in _NORMALS:
            raise InputError(f"{path}: property {name!r} is unknown for shape {shape.name}; remove it")
        if kind not in REAL_TYPES:
            raise InputError(f"{path}: property {name!r} has type {kind}; expected float or double")
    return schema

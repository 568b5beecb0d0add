"""The columns of splat PLY files: which shape and fields they hold, and their order in files of 3DGS."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

from ...errors import InputError, named_place
from ..fields import CORE, LOG_SCALE, MEAN, OPACITY_LOGIT, QUAT, Group, Schema
from ..shapes import GAUSSIAN, NORMALISATIONS, SHAPES, Shape, check_normalisation, shape_named
from .ply_compact import side_fields
from .ply_header import REAL_TYPES, SIDE_PREFIX, VERTEX, Header

COMMENT = "clsplat"  # begins the comment that names the kernel
NORMALS = ("nx", "ny", "nz")
# 2DGS (Huang et al. 2024) has surfels without a third scale. The log of one that is as good as none stands for it.
SURFEL_COLUMN, SURFEL_LOG_SCALE = "scale_2", math.log(1e-6)
_REST_COUNTS = (0, 9, 24, 45)  # f_rest_* of SH degree 0 to 3


def file_order(schema: Schema) -> list[str]:
    """Return all property names in the order of 3DGS, those of the shape last."""
    shape_fields = [f for f in schema if f.group is Group.GEOM and f not in CORE]
    names = [*MEAN.ply, *NORMALS]
    for field in (schema["sh"], OPACITY_LOGIT, LOG_SCALE, QUAT, *shape_fields):
        names += field.ply
    return names


def refuse_point_cloud(path: Path, header: Header) -> None:
    """Raise InputError if the vertices have positions, but no column of splats."""
    names = set(header.names)
    splat_names = {"f_dc_0", *OPACITY_LOGIT.ply, *LOG_SCALE.ply, *QUAT.ply}
    if names.issuperset(MEAN.ply) and names.isdisjoint(splat_names):
        raise InputError(f"{path}: is a point cloud, not splats; choose a trained point_cloud.ply")


def find_kernel(path: Path, header: Header) -> tuple[Shape, str]:
    """Return shape and normalisation, from the comment of clsplat or else from the columns."""
    for comment in header.comments:
        words = comment.split()
        values = dict(word.split("=", 1) for word in words[1:] if "=" in word)
        if words[:1] != [COMMENT] or "shape" not in values:
            continue
        with named_place(f"{path}: comment {comment[:80]!r}"):
            shape = shape_named(values["shape"])
            return shape, check_normalisation(values.get("normalisation", NORMALISATIONS[0]))
    columns = {shape.name: {name for field in shape.fields for name in field.ply} for shape in SHAPES.values()}
    held = [name for element in header.elements for name in element.names]
    shape_columns = set(held) & set().union(*columns.values())
    if not shape_columns:
        return GAUSSIAN, NORMALISATIONS[0]
    # If no shape has exactly these columns, the closest one is chosen; the error then names the missing column.
    candidates = [shape for shape in SHAPES.values() if columns[shape.name] & shape_columns]
    return min(candidates, key=lambda shape: len(columns[shape.name] ^ shape_columns)), NORMALISATIONS[0]


def find_schema(path: Path, header: Header, shape: Shape) -> Schema:
    """Return the schema of the columns; raise InputError if they do not form one. Surfels lack SURFEL_COLUMN."""
    names = set(header.names)
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in _REST_COUNTS:
        counts = ", ".join(str(count) for count in _REST_COUNTS)
        raise InputError(f"{path}: has {rest} properties f_rest_*; SH degree 0 to 3 has one of {counts}")
    schema = shape.schema(_REST_COUNTS.index(rest))
    moved = {name for field in side_fields(path, header, schema).values() for name in field.ply}
    needed = set(file_order(schema)) - set(NORMALS) - moved
    missing = [name for name in file_order(schema) if name in needed - names]
    if missing == [SURFEL_COLUMN] and not any(comment.startswith(COMMENT) for comment in header.comments):
        warnings.warn(
            f"{path}: holds surfels (no {SURFEL_COLUMN}), as 2DGS writes them; they become flat splats", stacklevel=3
        )
    elif missing:
        of_shape = any(missing[0] in field.ply for field in shape.fields)
        remedy = (
            f"shape {shape.name} has it; export the shape's columns, or name the shape that the file holds"
            if of_shape
            else "export all of 3DGS's properties"
        )
        raise InputError(f"{path}: property {missing[0]!r} is missing; {remedy}")
    for kind, name in header.properties:
        if name in needed and kind not in REAL_TYPES:
            raise InputError(f"{path}: property {name!r} has type {kind}; expected float or double")
    return schema


def warn_of_left_out(path: Path, header: Header, shape: Shape, schema: Schema) -> None:
    """Warn about columns and elements that are not of the model."""
    columns = [name for name in header.names if name not in file_order(schema)]
    elements = [element.name for element in header.elements if element.name != VERTEX]
    elements = [name for name in elements if not name.startswith(SIDE_PREFIX)]
    kinds = [f"{kind} {', '.join(names)}" for kind, names in (("columns", columns), ("elements", elements)) if names]
    if kinds:
        shown = " and ".join(kinds).encode("unicode_escape").decode("ascii")[:200]
        warnings.warn(f"{path}: left out {shown}, which {shape.name} splats do not have", stacklevel=2)

"""Coloured point clouds in PLY files, as nerfstudio (`ply_file_path`) and 3DGS (`points3d.ply`) store them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.atomic import atomic_writer
from ..splats.formats.ply_body import read_body
from ..splats.formats.ply_header import read_header
from .colmap import NO_POINTS, Points

GREY = 128  # colour of points in files without colours
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))


def read_point_cloud(path: str | os.PathLike[str]) -> Points:
    """Read points from the properties x, y, z and red, green, blue (0 to 255; reals may end at 1, 16-bit numbers at
    65535). The colours may have other usual names. Points without colours are grey.

    Returns
    -------
    Points with tracks of length 1, because the file does not contain tracks.

    Raises
    ------
    InputError : the file is missing or damaged, or a position is missing or not finite.
    """
    path = Path(path)
    if path.exists() and not path.is_file() and not path.is_dir():  # opening a pipe would wait for ever
        raise InputError(f"{path}: is not a regular file; give a PLY file of points")
    try:
        with path.open("rb") as stream:
            header = read_header(path, stream)
            columns = read_body(path, stream, header)["vertex"]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); give a PLY file of points") from None
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        raise InputError(f"{path}: has no property {missing[0]!r}; give a PLY file of points with x, y and z")
    xyz = np.empty((len(columns["x"]), 3))
    for axis, name in enumerate("xyz"):
        xyz[:, axis] = columns[name]
    bad = np.flatnonzero(~np.isfinite(xyz).all(axis=1))
    if bad.size:
        raise InputError(f"{path}: point {bad[0]} has a position that is not finite; export the points again")
    rgb = np.full((len(xyz), 3), GREY, np.uint8)
    named = next((names for names in _COLORS if all(name in columns for name in names)), None)
    if named is not None:
        rgb = _bytes(np.stack([columns[name] for name in named], axis=1))
    return Points(xyz, rgb, np.ones(len(xyz), np.int64))


def _bytes(colors: NDArray[Any]) -> NDArray[np.uint8]:
    """Return colours as 0 to 255. Files have them as bytes, as 16-bit numbers, or as reals up to 1 or 255."""
    if colors.dtype == np.uint8:
        return colors
    values = np.nan_to_num(colors.astype(np.float64), nan=GREY, posinf=255.0, neginf=0.0)
    if colors.dtype.kind == "f" and values.max(initial=0.0) <= 1.0:
        values = 255.0 * values
    elif colors.dtype.itemsize == 2 and colors.dtype.kind == "u" and values.max(initial=0.0) > 255.0:
        values = values / 257.0
    return np.rint(np.clip(values, 0.0, 255.0)).astype(np.uint8)


def write_point_cloud(path: str | os.PathLike[str], points: Points) -> None:
    """Write positions (float32) and colours to a binary PLY file; raises OutputError."""
    columns = [("float", name) for name in "xyz"] + [("uchar", name) for name in ("red", "green", "blue")]
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property {kind} {name}" for kind, name in columns),
        "end_header",
    ]
    table = np.empty(len(points), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    table["xyz"], table["rgb"] = points.xyz, points.rgb
    with atomic_writer(path) as stream:
        stream.write(("\n".join(head) + "\n").encode("ascii") + table.tobytes())


def join_points(clouds: Sequence[Points]) -> Points:
    """Return several clouds as one; no cloud gives one without points."""
    parts = [NO_POINTS, *clouds]
    return Points(
        np.concatenate([part.xyz for part in parts]),
        np.concatenate([part.rgb for part in parts]),
        np.concatenate([part.track_length for part in parts]),
    )

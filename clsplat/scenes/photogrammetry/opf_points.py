"""Point clouds of OPF projects, in glTF files.

Format: https://pix4d.github.io/opf-spec/specification/point_cloud.html. Every node of the scene is a cloud, with
POSITION (float32), COLOR_0 (RGBA) and the extension OPF_mesh_primitive_matches. glTF's y axis points up and that of a
project's world is z, so a reader turns (x, y, z) to (x, -z, y).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...splats.formats.glb import GltfFile, Json, read_gltf
from ...splats.formats.gltf_scene import scene_primitives
from ..colmap import Points
from ..point_cloud import GREY, join_points

_MATCHES = "OPF_mesh_primitive_matches"
# Extensions that do not change the numbers of a cloud.
_HARMLESS = ("KHR_materials_unlit", "OPF_")
_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_COUNT_SHIFT = 8  # bits of the second half of a range that belong to its offset; the other 24 are its count


def read_opf_points(path: Path) -> Points:
    """Read the clouds of a .gltf file in the world of the project. Points without colours are grey.

    Returns
    -------
    Points; the length of a track is the point's number of matches, or 1 without matches.

    Raises
    ------
    InputError : the file or a file of its arrays is missing or damaged, or a position is not finite.
    """
    file = read_gltf(path)
    required = file.json.get("extensionsRequired", [])
    names = map(str, required) if isinstance(required, list) else ["?"]
    unknown = [name for name in names if not name.startswith(_HARMLESS)]
    if unknown:
        raise InputError(f"{path}: needs the glTF extension {unknown[0][:80]}, which is not read; export it without")
    return join_points([_cloud(file, primitive, matrix) for primitive, matrix in scene_primitives(file)])


def _cloud(file: GltfFile, primitive: Json, matrix: NDArray[np.float64]) -> Points:
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict):
        raise file.fault("a cloud has no attributes")
    stored = file.array(attributes.get("POSITION"))
    if stored.shape[1] != 3:
        raise file.fault("the POSITION of a cloud is not 3 numbers for each point")
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = (stored.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]) @ _Z_UP.T
    bad = np.flatnonzero(~np.isfinite(xyz).all(axis=1))
    if bad.size:
        raise file.fault(f"point {bad[0]} has a position that is not finite")
    return Points(xyz, _colours(file, attributes, len(xyz)), _track_lengths(file, primitive, len(xyz)))


def _colours(file: GltfFile, attributes: Json, n: int) -> NDArray[np.uint8]:
    index = attributes.get("COLOR_0")
    if index is None:
        return np.full((n, 3), GREY, np.uint8)
    found = file.array(index)
    if len(found) != n or found.shape[1] < 3:
        raise file.fault(f"the COLOR_0 of a cloud is not a colour for each of {n} points")
    whole = found.dtype.kind != "f" or file.object("accessors", index).get("normalized") is not True
    scale = 1.0 if whole and np.nanmax(found, initial=0.0) > 1.0 else 255.0
    return np.rint(np.clip(np.nan_to_num(scale * found[:, :3]), 0.0, 255.0)).astype(np.uint8)


def _track_lengths(file: GltfFile, primitive: Json, n: int) -> NDArray[np.int64]:
    """Return the number of matches of each point: the upper 24 of the 64 bits of its range."""
    extensions = primitive.get("extensions")
    matches = extensions.get(_MATCHES) if isinstance(extensions, dict) else None
    if matches is None:
        return np.ones(n, np.int64)
    if not isinstance(matches, dict):
        raise file.fault(f"{_MATCHES} is not an object")
    ranges = file.array(matches.get("pointIndexRanges"))
    if ranges.shape != (n, 2):
        raise file.fault(f"{_MATCHES} has not 2 numbers for each of {n} points")
    upper = np.nan_to_num(ranges[:, 1]).clip(0.0, 2.0**32 - 1.0).astype(np.int64)
    return np.maximum(upper >> _COUNT_SHIFT, 1)

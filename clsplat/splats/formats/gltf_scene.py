"""The scene of a glTF file: its primitives, and where its nodes place them.

Specification: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, section 3.5 (scenes, nodes, transforms).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ..fields import DoubleArray
from .glb import GltfFile, Json


def scene_primitives(file: GltfFile) -> Iterator[tuple[Json, DoubleArray]]:
    """Yield the primitives of the file's scene, each with the (4, 4) matrix of its node in the world.

    Raises
    ------
    InputError : a node, mesh or matrix is damaged, or a node has two parents.
    """
    scenes = file.objects("scenes")
    if scenes:
        roots = file.object("scenes", file.json.get("scene", 0)).get("nodes", [])
    else:
        nodes = file.objects("nodes")
        below = [child for node in nodes for child in _list(file, node.get("children", []), "children")]
        roots = [index for index in range(len(nodes)) if index not in below]
    waiting = [(node, np.eye(4)) for node in reversed(_list(file, roots, "nodes of its scene"))]
    seen: set[int] = set()
    while waiting:
        index, above = waiting.pop()
        node = file.object("nodes", index)
        if index in seen:
            raise file.fault(f"nodes[{index}] has two parents")
        seen.add(index)
        matrix = above @ _matrix(file, node)
        waiting += [(child, matrix) for child in reversed(_list(file, node.get("children", []), "children"))]
        if "mesh" in node:
            primitives = _list(file, file.object("meshes", node["mesh"]).get("primitives", []), "primitives")
            yield from ((primitive, matrix) for primitive in primitives if isinstance(primitive, dict))


def _list(file: GltfFile, found: Any, name: str) -> list[Any]:
    if not isinstance(found, list):
        raise file.fault(f"its {name} are not a list")
    return found


def _matrix(file: GltfFile, node: Json) -> DoubleArray:
    """Return the (4, 4) matrix of a node from its matrix or its translation, rotation and scale."""
    from scipy.spatial.transform import Rotation  # lazy: a slow import

    def numbers(key: str, default: list[float]) -> DoubleArray:
        try:
            values = np.asarray(node.get(key, default), np.float64)
        except (TypeError, ValueError, OverflowError):
            values = np.empty(0)
        if values.shape != (len(default),) or not np.isfinite(values).all():
            raise file.fault(f"the {key} of a node is not {len(default)} numbers")
        return values

    if "matrix" in node:
        return numbers("matrix", np.eye(4).ravel().tolist()).reshape(4, 4).T
    matrix = np.eye(4)
    turn = numbers("rotation", [0.0, 0.0, 0.0, 1.0])
    if not np.linalg.norm(turn) > 0.0:
        raise file.fault("the rotation of a node is 0")
    matrix[:3, :3] = Rotation.from_quat(turn).as_matrix() * numbers("scale", [1.0] * 3)
    matrix[:3, 3] = numbers("translation", [0.0] * 3)
    return matrix

"""The world of a chunk of Metashape.

The <transform> of a component, or else of the chunk, leads to the world: p -> scale R p + t, with <rotation> row by
row, <translation> and <scale> (`Chunk.transform` of the Metashape Python Reference). The world of a georeferenced chunk
is geocentric: its origin is the centre of the earth, its z axis goes to the north pole, and its unit is the metre.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...cameras.rotations import NearestRotation, NotARotation, nearest_rotation
from ...errors import InputError, named_place
from ...files.xml_file import get_numbers

_LOCAL = "LOCAL_CS"  # how the coordinate system of a chunk begins that is not georeferenced
_FLATTENED = 0.996647189335**2  # square of the polar radius of WGS 84 over the equatorial one


@dataclass(frozen=True, eq=False)
class ChunkWorld:
    """Chunk to world: p -> scale * rotation p + translation."""

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    scale: float
    is_geocentric: bool = False

    @staticmethod
    def of(path: Path, chunk: ET.Element, component: str | None) -> ChunkWorld:
        """Return the transform of a component, or else of the chunk; without either the chunk is the world."""
        components = [each for each in chunk.iterfind("components/component") if each.get("id") == component]
        holder = next((each for each in (*components, chunk) if each.find("transform") is not None), None)
        element = None if holder is None else holder.find("transform")
        if element is None:
            return ChunkWorld(np.eye(3), np.zeros(3), 1.0)
        with named_place(f"{path}: <transform> of the chunk"):
            rotation, translation, scale = (
                get_numbers(element, name, count) for name, count in (("rotation", 9), ("translation", 3), ("scale", 1))
            )
            if scale is not None and scale[0] <= 0.0:
                raise InputError(f"<scale> is {scale[0]:g}; it must be above 0")
            turn = np.eye(3) if rotation is None else rotation_of(rotation.reshape(3, 3), "<rotation>").matrix
        system = (chunk.findtext("reference") or _LOCAL).strip()
        return ChunkWorld(
            turn,
            np.zeros(3) if translation is None else translation,
            1.0 if scale is None else float(scale[0]),
            not system.startswith(_LOCAL),
        )

    def around(self, position: NDArray[np.float64]) -> ChunkWorld:
        """Return the world with its origin at a position in the chunk, and the axes east, north and up.

        Parameters
        ----------
        position : (3,), in a chunk whose world is geocentric.
        """
        origin = self._moved(position)
        # The normal of the ellipsoid; an altitude of 1 km turns it by 1e-6. A file may also place the camera at 0.
        up = origin / (1.0, 1.0, _FLATTENED) if origin.any() else np.array([0.0, 0.0, 1.0])
        up /= np.linalg.norm(up)
        east = np.array([-up[1], up[0], 0.0])
        east = east / np.linalg.norm(east) if east.any() else np.array([0.0, 1.0, 0.0])  # at a pole
        axes = np.stack([east, np.cross(up, east), up])
        return ChunkWorld(axes @ self.rotation, axes @ (self.translation - origin), self.scale)

    def camera_pose(self, rotation: NDArray[np.float64], position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return world-to-camera, (4, 4), for a camera-to-chunk rotation and a position in the chunk."""
        pose = np.eye(4)
        pose[:3, :3] = (self.rotation @ rotation).T
        pose[:3, 3] = -pose[:3, :3] @ self._moved(position)
        return pose

    def _moved(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.scale * (self.rotation @ position) + self.translation


def rotation_of(matrix: NDArray[np.float64], what: str) -> NearestRotation:
    """Return the rotation nearest to a matrix (3, 3); raises InputError, which begins with `what`."""
    try:
        return nearest_rotation(matrix)
    except NotARotation as error:
        raise InputError(f"{what} {error}; export the cameras again") from None

"""Scenes of Agisoft Metashape: the XML file of "Export Cameras", and points in a PLY file beside it.

The file has a <chunk> with <sensors>, <components> and <cameras>. The <transform> of a camera is camera-to-chunk, 16
numbers row by row, with OpenCV's axes (x right, y down, z forward; the manual's appendix "Camera models"). Cameras of
other components than the active one are left out, because nothing relates their poses.

A georeferenced scene lies around the mean of its cameras. Its points are exported in a map projection, which is not
read, so they are left out.
"""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...cameras.rotations import NearestRotation, warn_of_corrections
from ...errors import InputError, named_place
from ...files.xml_file import get_numbers, read_xml
from ..colmap import Points
from ..point_cloud import join_points, read_point_cloud
from ..posed_images import PosedImages, read_sizes
from ..undistort import Lens, RegisteredImage
from .metashape_lens import metashape_lens
from .metashape_world import ChunkWorld, rotation_of
from .named_photos import find_named_photos

_EXPECTED = "the XML file of Metashape's Export Cameras"
_LAST_ROW = 1e-6  # largest error of the last row of a pose
_OFF = ("0", "false")


def read_metashape(path: Path, images: str | None = None) -> PosedImages:
    """Read the photos with poses of an XML file of Metashape, and the points in a PLY file beside it.

    Photos that are disabled, that have no pose, or that belong to another component are left out.

    Parameters
    ----------
    path : the XML file.
    images : folder of the photos, instead of the file's folder or its folder `images`.

    Warns
    -----
    UserWarning : rotations were corrected, or the points of a georeferenced chunk are left out.

    Raises
    ------
    InputError : the file is damaged, a number is missing or bad, or a lens has no counterpart. The message names file,
        camera and element.
    """
    chunk = read_xml(path, _EXPECTED).find("chunk")
    if chunk is None:
        raise InputError(f"{path}: has no <chunk>; choose {_EXPECTED}")
    cameras = _cameras(path, chunk)
    placed = find_named_photos(path, list(cameras), images)
    named = {placed[label][0]: camera for label, camera in cameras.items()}
    files = dict(placed.values())
    active = _active_component(chunk, cameras.values())
    reasons = {name: reason for name, camera in named.items() if (reason := camera.unused(active)) is not None}
    sizes, left_out = read_sizes({name: file for name, file in files.items() if name not in reasons})
    left_out |= {name: f"{path}: {reason}" for name, reason in reasons.items()}
    lenses = _lenses(path, chunk, {named[name].sensor for name in sizes})
    poses = {name: named[name].pose() for name in sorted(sizes)}
    world = ChunkWorld.of(path, chunk, active)
    if world.is_geocentric:
        aligned = [camera.pose()[1] for name, camera in named.items() if name not in reasons]
        local = world.around(np.mean(aligned, axis=0))
    else:
        local = world
    warn_of_corrections(path, {named[name].place: rotation for name, (rotation, _) in poses.items()})
    photos = [
        RegisteredImage(name, local.camera_pose(rotation.matrix, position), lenses[named[name].sensor])
        for name, (rotation, position) in poses.items()
    ]
    return PosedImages(photos, files, sizes, _points(path, world.is_geocentric), left_out=left_out)


@dataclass(frozen=True, eq=False)
class _MetashapeCamera:
    """A <camera>, with its place for messages."""

    place: str
    element: ET.Element

    @property
    def sensor(self) -> str:
        return self.element.get("sensor_id", "")

    @property
    def component(self) -> str | None:
        return self.element.get("component_id")

    def unused(self, active: str | None) -> str | None:
        """Return why the camera is left out, or None.

        Parameters
        ----------
        active : id of the component whose cameras are used.
        """
        if self.element.get("enabled", "1").lower() in _OFF:
            return f"{self.place} is disabled"
        if self.element.find("transform") is None:
            return f"{self.place} has no pose: it was not aligned"
        if active is not None and self.component not in (None, active):
            return f"{self.place} belongs to component {self.component}, and {active} is the active one"
        return None

    def pose(self) -> tuple[NearestRotation, NDArray[np.float64]]:
        """Return the rotation of camera-to-chunk and the position in the chunk, (3,)."""
        with named_place(self.place):
            found = get_numbers(self.element, "transform", 16)
            matrix = np.zeros((4, 4)) if found is None else found.reshape(4, 4)
            if np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > _LAST_ROW:
                raise InputError("the last row of <transform> is not 0 0 0 1; export the cameras again")
            return rotation_of(matrix[:3, :3], "the left 3 x 3 block of <transform>"), matrix[:3, 3]


def _cameras(path: Path, chunk: ET.Element) -> dict[str, _MetashapeCamera]:
    """Return the cameras of a chunk and of its groups, by label."""
    cameras: dict[str, _MetashapeCamera] = {}
    for index, element in enumerate(chunk.iterfind("cameras//camera")):
        label = element.get("label", "")
        if not label:
            raise InputError(f"{path}: camera {index} has no label; export the cameras again")
        if label in cameras:
            raise InputError(
                f"{path}: two cameras have the label {label!r}; rename one in Metashape, and export the cameras again"
            )
        cameras[label] = _MetashapeCamera(f"{path}: camera {label!r}", element)
    if not cameras:
        raise InputError(f"{path}: has no <camera>; choose {_EXPECTED}")
    return cameras


def _active_component(chunk: ET.Element, cameras: Iterable[_MetashapeCamera]) -> str | None:
    """Return the id of the active component, or that of the most cameras if none is named; None without components."""
    components = chunk.find("components")
    if components is not None and (active := components.get("active_id")) is not None:
        return active
    counts = Counter(camera.component for camera in cameras if camera.component is not None)
    return counts.most_common(1)[0][0] if counts else None


def _lenses(path: Path, chunk: ET.Element, used: Collection[str]) -> dict[str, Lens]:
    """Return the lenses of the sensors that are used, by id."""
    sensors = {sensor.get("id", ""): sensor for sensor in chunk.iterfind("sensors/sensor")}
    lenses = {}
    for number in sorted(used):
        with named_place(f"{path}: sensor {number[:40]!r}"):
            if number not in sensors:
                raise InputError("is not among the <sensors>; export the cameras again")
            lenses[number] = metashape_lens(sensors[number])
    return lenses


def _points(path: Path, in_projection: bool) -> Points:
    """Return the points of the PLY file with the name of the XML file, or else of the only PLY file in its folder.

    Parameters
    ----------
    in_projection : whether the points are in a map projection, so they are left out.
    """
    files = sorted(file for file in path.parent.iterdir() if file.suffix.lower() == ".ply" and file.is_file())
    named = [file for file in files if file.stem == path.stem] or files
    if named and in_projection:
        warnings.warn(
            f"{path}: the chunk is georeferenced, so the points of {named[0].name} are in a map projection: they are "
            "left out. Export a COLMAP model to have points",
            stacklevel=5,
        )
        return join_points([])
    if len(named) > 1:
        raise InputError(
            f"{path}: {len(named)} PLY files are beside it; name that of the points {path.with_suffix('.ply').name}"
        )
    return read_point_cloud(named[0]) if named else join_points([])

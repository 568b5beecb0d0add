"""Scenes of Agisoft Metashape: the XML file of "Export Cameras", and points in a PLY file beside it.

The file has a <chunk> with <sensors>, <components> and <cameras>. The <transform> of a camera is camera-to-chunk, 16
numbers row by row, with OpenCV's axes (x right, y down, z forward; the manual's appendix "Camera models"). Cameras of
other components than the active one are left out, because nothing relates their poses.

The cameras of a rig are a master and its slaves. A slave has a `master_id` and no <transform>. Its <sensor> has the
place of the slave in the master's camera: <rotation>, 9 numbers row by row, and <location>, in units of the chunk.
Camera-to-chunk of the slave is that of the master times [rotation | location].

A georeferenced scene lies around the mean of its cameras. Its points are exported in a map projection, which is not
read, so they are left out.
"""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
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

    Photos that are disabled, that have no pose, or that belong to another component are left out. A slave of a rig has
    a pose if its master has one. If there are several chunks, that with the most poses is read.

    Parameters
    ----------
    path : the XML file.
    images : folder of the photos, instead of the file's folder or its folder `images`.

    Warns
    -----
    UserWarning : rotations were corrected, or chunks, or the points of a georeferenced chunk, are left out.

    Raises
    ------
    InputError : the file is damaged, a number is missing or bad, a slave's master is unknown, a lens has no
        counterpart, or no camera can be used. The message names file, camera and element.
    """
    chunk = _chunk(path)
    sensors = {sensor.get("id", ""): sensor for sensor in chunk.iterfind("sensors/sensor")}
    cameras = _cameras(path, chunk, sensors)
    placed = find_named_photos(path, list(cameras), images)
    named = {placed[label][0]: camera for label, camera in cameras.items()}
    files = dict(placed.values())
    active = _active_component(chunk, cameras.values())
    reasons = {name: reason for name, camera in named.items() if (reason := camera.unused(active)) is not None}
    if len(reasons) == len(named):
        first = next(iter(reasons.values()))
        raise InputError(f"{first}, and no other camera can be used; align the photos, and export the cameras again")
    sizes, left_out = read_sizes({name: file for name, file in files.items() if name not in reasons})
    left_out |= reasons
    lenses = _lenses(path, sensors, {named[name].sensor for name in sizes})
    poses = {name: named[name].pose() for name in sorted(sizes)}
    world = ChunkWorld.of(path, chunk, active)
    if world.is_geocentric:
        aligned = [camera.pose()[1] for name, camera in named.items() if name not in reasons]
        local = world.around(np.mean(aligned, axis=0))
    else:
        local = world
    warn_of_corrections(path, {named[name].title: rotation for name, (rotation, _) in poses.items()})
    photos = [
        RegisteredImage(name, local.camera_pose(rotation.matrix, position), lenses[named[name].sensor])
        for name, (rotation, position) in poses.items()
    ]
    return PosedImages(
        photos, files, sizes, _points(path, world.is_geocentric), left_out=left_out, unused=frozenset(reasons)
    )


def _chunk(path: Path) -> ET.Element:
    """Return the chunk with the most poses."""
    chunks = read_xml(path, _EXPECTED).findall("chunk")
    if not chunks:
        raise InputError(f"{path}: has no <chunk>; choose {_EXPECTED}")
    chosen = max(chunks, key=lambda chunk: len(chunk.findall("cameras//camera/transform")))
    if len(chunks) > 1:
        warnings.warn(
            f"{path}: has {len(chunks)} chunks, and only the one with the most poses is read "
            f"({chosen.get('label', 'without a label')}): export each chunk to a separate file",
            stacklevel=4,
        )
    return chosen


@dataclass(frozen=True, eq=False)
class _MetashapeCamera:
    """A <camera>.

    Parameters
    ----------
    path : the XML file, for messages.
    element : the <camera>, with a label.
    sensors : each <sensor> of the chunk, by id.
    master : for a slave of a rig, the camera whose pose leads to its own.
    """

    path: Path
    element: ET.Element
    sensors: Mapping[str, ET.Element]
    master: _MetashapeCamera | None = None

    @property
    def title(self) -> str:
        return f"camera {self.element.get('label')!r}"

    @property
    def place(self) -> str:
        return f"{self.path}: {self.title}"

    @property
    def sensor(self) -> str:
        return self.element.get("sensor_id", "")

    @property
    def component(self) -> str | None:
        return self._posed.element.get("component_id")

    @property
    def has_transform(self) -> bool:
        return self.element.find("transform") is not None

    @property
    def _posed(self) -> _MetashapeCamera:
        """The camera with the <transform>: the master of a slave, and any other camera itself."""
        return self.master or self

    def unused(self, active: str | None) -> str | None:
        """Return why the camera is left out, or None.

        Parameters
        ----------
        active : id of the component whose cameras are used.
        """
        if self.element.get("enabled", self._posed.element.get("enabled", "1")).lower() in _OFF:
            return f"{self.place} is disabled"
        if not self._posed.has_transform:
            whose = "it" if self.master is None else f"its master, {self.master.title},"
            return f"{self.place} has no pose: {whose} was not aligned"
        if active is not None and self.component not in (None, active):
            return f"{self.place} belongs to component {self.component}, and {active} is the active one"
        return None

    def pose(self) -> tuple[NearestRotation, NDArray[np.float64]]:
        """Return the rotation of camera-to-chunk and the position in the chunk, (3,)."""
        if self.master is None:
            return self._stored_pose()
        rotation, position = self.master.pose()
        turn, location = self._mount()
        combined = NearestRotation(
            rotation.matrix @ turn.matrix, max(rotation.deviation, turn.deviation), rotation.scale * turn.scale
        )
        return combined, position + rotation.matrix @ location

    def _stored_pose(self) -> tuple[NearestRotation, NDArray[np.float64]]:
        with named_place(self.place):
            found = get_numbers(self.element, "transform", 16)
            matrix = np.zeros((4, 4)) if found is None else found.reshape(4, 4)
            if np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > _LAST_ROW:
                raise InputError("the last row of <transform> is not 0 0 0 1; export the cameras again")
            return rotation_of(matrix[:3, :3], "the left 3 x 3 block of <transform>"), matrix[:3, 3]

    def _mount(self) -> tuple[NearestRotation, NDArray[np.float64]]:
        """Return the rotation of slave-to-master, and the slave's position in the master's camera, (3,)."""
        with named_place(_sensor_place(self.path, self.sensor)):
            sensor = _known_sensor(self.sensors, self.sensor)
            rotation, location = get_numbers(sensor, "rotation", 9), get_numbers(sensor, "location", 3)
            turn = np.eye(3) if rotation is None else rotation.reshape(3, 3)
            return rotation_of(turn, "<rotation>"), np.zeros(3) if location is None else location


def _cameras(path: Path, chunk: ET.Element, sensors: Mapping[str, ET.Element]) -> dict[str, _MetashapeCamera]:
    """Return the cameras of a chunk, of its groups and below their masters, by label."""
    cameras: dict[str, _MetashapeCamera] = {}
    for index, element in enumerate(chunk.iterfind("cameras//camera")):
        label = element.get("label", "")
        if not label:
            raise InputError(f"{path}: camera {index} has no label; export the cameras again")
        if label in cameras:
            raise InputError(
                f"{path}: two cameras have the label {label!r}; rename one in Metashape, and export the cameras again"
            )
        cameras[label] = _MetashapeCamera(path, element, sensors)
    if not cameras:
        raise InputError(f"{path}: has no <camera>; choose {_EXPECTED}")
    return _with_masters(cameras)


def _with_masters(cameras: Mapping[str, _MetashapeCamera]) -> dict[str, _MetashapeCamera]:
    """Return the cameras by label, the slaves of rigs with their masters.

    A master is the camera that the slave's `master_id` names, or else the <camera> that the slave is in.
    """
    by_id: dict[str | None, list[_MetashapeCamera]] = {}
    parents: dict[ET.Element, _MetashapeCamera] = {}
    for camera in cameras.values():
        by_id.setdefault(camera.element.get("id"), []).append(camera)
        parents |= dict.fromkeys(camera.element.iterfind("camera"), camera)
    masters = {}
    for label, camera in cameras.items():
        number = camera.element.get("master_id")
        found = [parents.get(camera.element, camera)] if number is None else by_id.get(number, [])
        if camera.has_transform or found == [camera]:
            continue
        if len(found) != 1:
            raise InputError(
                f"{camera.place}: its master_id is {ascii(number)[:40]}, and {len(found) or 'no'} cameras have this "
                "id; export all cameras of the rig again"
            )
        masters[label] = found[0]
    for label, master in masters.items():
        if master.element.get("label") in masters:
            raise InputError(
                f"{cameras[label].place}: its master, {master.title}, has a master too; export the cameras again"
            )
    return {label: replace(camera, master=masters.get(label)) for label, camera in cameras.items()}


def _active_component(chunk: ET.Element, cameras: Iterable[_MetashapeCamera]) -> str | None:
    """Return the id of the active component, or that of the most cameras if none is named; None without components."""
    components = chunk.find("components")
    if components is not None and (active := components.get("active_id")) is not None:
        return active
    counts = Counter(camera.component for camera in cameras if camera.component is not None)
    return counts.most_common(1)[0][0] if counts else None


def _lenses(path: Path, sensors: Mapping[str, ET.Element], used: Collection[str]) -> dict[str, Lens]:
    """Return the lenses of the sensors that are used, by id."""
    lenses = {}
    for number in sorted(used):
        with named_place(_sensor_place(path, number)):
            lenses[number] = metashape_lens(_known_sensor(sensors, number))
    return lenses


def _sensor_place(path: Path, number: str) -> str:
    return f"{path}: sensor {number[:40]!r}"


def _known_sensor(sensors: Mapping[str, ET.Element], number: str) -> ET.Element:
    if number not in sensors:
        raise InputError("is not among the <sensors>; export the cameras again")
    return sensors[number]


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

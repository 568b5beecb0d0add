"""Scenes of OPF projects, the Open Photogrammetry Format of Pix4D.

Format: https://pix4d.github.io/opf-spec (version 1.0). A project (.opf) lists items, and items list resources. Read are
the camera list (the file of each photo), the calibrated cameras (poses and lenses), the input cameras (sizes of
photos), and a point cloud: the tracks of the calibration, or else the dense clouds.

A camera's orientation is omega, phi, kappa [degrees], and camera-to-world is Rx(omega) Ry(phi) Rz(kappa). Its axes are
x right, y up and z backwards, which are OpenGL's. The world is the processing coordinate system of the project.
"""

from __future__ import annotations

import ntpath
import os
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
from numpy.typing import NDArray

from ...cameras.path import cam_from_world_of
from ...errors import InputError, named_place
from ...files.file_names import can_be_file
from ...files.json_file import get_id, get_objects, get_size, get_text, get_value, read_json
from ..colmap import Points
from ..point_cloud import join_points
from ..posed_images import PosedImages, read_sizes
from ..undistort import Lens, RegisteredImage
from .named_photos import find_named_photos
from .opf_lens import REMEDY, numbers, opf_lens
from .opf_points import read_opf_points

_FORMAT = "application/opf-{}+json"
_PROJECT, _LIST = _FORMAT.format("project"), _FORMAT.format("camera-list")
_CALIBRATED, _INPUT = _FORMAT.format("calibrated-cameras"), _FORMAT.format("input-cameras")
_CLOUD = "model/gltf+json"
_CALIBRATION_ITEM, _CLOUD_ITEM = "calibration", "point_cloud"
_DRIVE = re.compile(r"/[A-Za-z]:")  # a path of Windows in a URI
_LOCAL_SCHEMES = ("", "file")
_FIRST_PAGE = ("", "page=0")


def read_opf(path: Path, images: str | None = None) -> PosedImages:
    """Read the photos with poses of an OPF project.

    Parameters
    ----------
    path : the project's file.
    images : folder of the photos, instead of the project's folder or its folder `images`.

    Raises
    ------
    InputError : a file of the project is missing or damaged, or a key is missing or has a bad value. The project has no
        calibration or several. A lens has no counterpart. The message names file, camera and key.
    """
    project = _Project.read(path)
    calibrated = project.calibration()
    uris, cameras = project.photos(), list(_cameras(calibrated))
    strangers = [camera for camera in cameras if camera.id not in uris]
    if len(strangers) == len(cameras):
        raise InputError(f"{strangers[0].place}: is in no camera list of {path}; {REMEDY}")
    if strangers:
        warnings.warn(
            f"{path}: {len(strangers)} of {len(cameras)} calibrated cameras are in no camera list; they are left out",
            stacklevel=4,
        )
        cameras = [camera for camera in cameras if camera.id in uris]
    found = find_named_photos(path, [uris[camera.id] for camera in cameras], images)
    placed = [(camera, *found[uris[camera.id]]) for camera in cameras]
    files = {name: file for _, name, file in placed}
    sizes, left_out = read_sizes(files)
    lenses = _Lenses(calibrated, project.image_sizes())
    photos = [
        RegisteredImage(name, camera.cam_from_world, lenses.of(camera, sizes[name]))
        for camera, name, _ in sorted(placed, key=lambda each: each[1])
        if name in sizes
    ]
    return PosedImages(photos, files, sizes, project.points(), left_out=left_out)


@dataclass(frozen=True, eq=False)
class _File:
    """A JSON file of a project."""

    path: Path
    values: dict[str, Any]

    @staticmethod
    def read(path: Path, form: str) -> _File:
        """Read a file, whose key `format` must have this value."""
        if not path.is_file():
            raise InputError(f"{path}: there is no such file, but the project needs it; copy it there")
        values = read_json(path, f"a file of an OPF project ({form})")
        if not isinstance(values, dict) or values.get("format") != form:
            raise InputError(f"{path}: its key 'format' is not {form!r}; choose a file of an OPF project")
        return _File(path, values)

    def objects(self, key: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield the objects of a list, each with its place for messages."""
        with named_place(str(self.path)):
            found = get_objects(self.values, key, REMEDY)
        yield from ((f"{self.path}: {key}[{index}]", entry) for index, entry in enumerate(found))


@dataclass(frozen=True, eq=False)
class _Project:
    """An OPF project: its file and its resources, each with the type of its item."""

    path: Path
    resources: list[tuple[str, str, Path]]

    @staticmethod
    def read(path: Path) -> _Project:
        resources = []
        for place, item in _File.read(path, _PROJECT).objects("items"):
            with named_place(place):
                kind = get_text(item, "type", REMEDY)
                for resource in get_objects(item, "resources", REMEDY):
                    uri, form = (get_text(resource, key, REMEDY) for key in ("uri", "format"))
                    resources.append((kind, form, path.parent / _path_of(uri)))
        return _Project(path, resources)

    def files(self, form: str, item: str | None = None) -> list[Path]:
        """Return the resources of a format, of all items or of those of one type."""
        return [path for kind, each, path in self.resources if each == form and item in (None, kind)]

    def calibration(self) -> _File:
        """Return the calibrated cameras."""
        files = self.files(_CALIBRATED)
        if len(files) != 1:
            state = "is not calibrated" if not files else f"has {len(files)} calibrations"
            raise InputError(f"{self.path}: {state}; export a project with one calibration")
        return _File.read(files[0], _CALIBRATED)

    def photos(self) -> dict[int, str]:
        """Return the path of each photo relative to the project, or its absolute path, by the camera's id."""
        found: dict[int, str] = {}
        for file in self.files(_LIST):
            for place, camera in _File.read(file, _LIST).objects("cameras"):
                with named_place(place):
                    number, uri = get_id(camera, "id", REMEDY), _path_of(get_text(camera, "uri", REMEDY))
                    name = self._relative(file, uri)
                    if found.setdefault(number, name) != name:
                        raise InputError(f"key 'id' is {number}, which is {found[number]!r} already; {REMEDY}")
        return found

    def image_sizes(self) -> dict[int, tuple[int, int]]:
        """Return (width, height) of the photos [px] by the sensor's id; empty without input cameras."""
        sizes = {}
        for file in self.files(_INPUT):
            for place, sensor in _File.read(file, _INPUT).objects("sensors"):
                with named_place(place):
                    found = numbers(sensor, "image_size_px", 2).tolist()
                    width, height = (get_size({"image_size_px": side}, "image_size_px", REMEDY) for side in found)
                    sizes[get_id(sensor, "id", REMEDY)] = width, height
        return sizes

    def points(self) -> Points:
        """Return the tracks of the calibration, or else the dense clouds; without either no points."""
        files = self.files(_CLOUD, _CALIBRATION_ITEM) or self.files(_CLOUD, _CLOUD_ITEM)
        return join_points([read_opf_points(file) for file in files])

    def _relative(self, file: Path, uri: str) -> str:
        """Return a path in a file of the project as a path relative to the project; an absolute one stays."""
        if PurePath(uri).is_absolute() or ntpath.isabs(uri):
            return uri
        return os.path.relpath(file.parent / uri, self.path.parent).replace("\\", "/")


@dataclass(frozen=True, eq=False)
class _OpfCamera:
    """A calibrated camera, with its place for messages."""

    place: str
    id: int
    sensor: int
    cam_from_world: NDArray[np.float64]


def _cameras(calibrated: _File) -> Iterator[_OpfCamera]:
    seen: set[int] = set()
    for place, camera in calibrated.objects("cameras"):
        with named_place(place):
            number = get_id(camera, "id", REMEDY)
            if number in seen:
                raise InputError(f"key 'id' is {number}, which another camera has already; {REMEDY}")
            seen.add(number)
            pose = np.eye(4)
            pose[:3, :3] = _rotation(np.radians(numbers(camera, "orientation_deg", 3)))
            pose[:3, 3] = numbers(camera, "position", 3)
            yield _OpfCamera(place, number, get_id(camera, "sensor_id", REMEDY), cam_from_world_of(pose))
    if not seen:
        raise InputError(f"{calibrated.path}: no camera is calibrated; calibrate the project, and export it again")


class _Lenses:
    """Lenses of the sensors of a project, one for each size of photos.

    Parameters
    ----------
    calibrated : the calibrated cameras.
    sizes : (width, height) of the photos of a sensor [px]; other photos have the size of their files.
    """

    def __init__(self, calibrated: _File, sizes: dict[int, tuple[int, int]]) -> None:
        self._sizes = sizes
        self._sensors: dict[int, tuple[str, dict[str, Any]]] = {}
        self._made: dict[tuple[int, int, int], Lens] = {}
        for place, sensor in calibrated.objects("sensors"):
            with named_place(place):
                self._sensors[get_id(sensor, "id", REMEDY)] = place, sensor

    def of(self, camera: _OpfCamera, stored: tuple[int, int]) -> Lens:
        """Return the lens of a camera whose photo is stored with this size [px]."""
        if camera.sensor not in self._sensors:
            raise InputError(f"{camera.place}: its sensor {camera.sensor} is not among the sensors; {REMEDY}")
        size = self._sizes.get(camera.sensor, stored)
        key = (camera.sensor, *size)
        if key not in self._made:
            place, sensor = self._sensors[camera.sensor]
            with named_place(f"{place}: internals"):
                internals = get_value(sensor, "internals", REMEDY)
                if not isinstance(internals, dict):
                    raise InputError(f"is not an object; {REMEDY}")
                self._made[key] = opf_lens(internals, *size)
        return self._made[key]


def _rotation(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Rx(omega) Ry(phi) Rz(kappa), (3, 3), for three angles [rad]."""
    (a, b, c), (u, v, w) = np.cos(angles), np.sin(angles)
    around_x = np.array([[1.0, 0.0, 0.0], [0.0, a, -u], [0.0, u, a]])
    around_y = np.array([[b, 0.0, v], [0.0, 1.0, 0.0], [-v, 0.0, b]])
    around_z = np.array([[c, -w, 0.0], [w, c, 0.0], [0.0, 0.0, 1.0]])
    return around_x @ around_y @ around_z


def _path_of(uri: str) -> str:
    """Return the path of a URI reference (RFC 3986)."""
    try:
        parts = urlsplit(uri)
    except ValueError:
        raise InputError(f"key 'uri' is {ascii(uri)[:60]}, which is not a URI; {REMEDY}") from None
    drive = len(parts.scheme) == 1  # not a scheme, but a drive of Windows
    if not drive and (parts.scheme not in _LOCAL_SCHEMES or parts.netloc not in ("", "localhost")):
        raise InputError(f"key 'uri' is {ascii(uri)[:60]}; only files on this machine are read: copy it here")
    if parts.fragment not in _FIRST_PAGE:
        raise InputError(f"key 'uri' is {ascii(uri)[:60]}; only the first page of a file is read: export the pages")
    path = unquote(f"{parts.scheme}:{parts.path}" if drive else parts.path)
    if not can_be_file(path):
        raise InputError(f"key 'uri' is {ascii(uri)[:60]}, which is not the name of a file; {REMEDY}")
    return path[1:] if _DRIVE.match(path) else path

"""`cameras.json`: a list of named cameras as 3DGS writes it, extended by the principal point.

An entry is `{id, img_name, width, height, position [3], rotation [3][3], fy, fx, cx, cy}`. The position is the camera
centre; the rotation is camera-to-world with OpenCV axes. `cx` and `cy` are optional additions of clsplat. Without them
the principal point is the image centre, as 3DGS assumes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, named_place
from ..files.atomic import atomic_writer
from ..files.image_names import bare_name
from ..files.json_file import describe, get_matrix, get_number, get_size, get_value, read_json
from .camera import Camera
from .rotations import NearestRotation, NotARotation, nearest_rotation, warn_of_corrections

_REMEDY = "add it as 3DGS writes it"


@dataclass(frozen=True, slots=True)
class NamedCamera:
    """A camera and the name of its image (`img_name`, without folder)."""

    name: str
    camera: Camera


def img_names(names: Sequence[str]) -> list[str]:
    """Return the `img_name` of each image file.

    Names lose their extensions, as 3DGS writes them, unless two names would then be equal.
    """
    bare = [bare_name(name) for name in names]
    return bare if len(set(bare)) == len(bare) else list(names)


def named_cameras(names: Sequence[str], cameras: Sequence[Camera]) -> list[NamedCamera]:
    """Return cameras of image files, each with its `img_name`."""
    return [NamedCamera(name, camera) for name, camera in zip(img_names(names), cameras, strict=True)]


def read_cameras(path: str | os.PathLike[str]) -> list[NamedCamera]:
    """Return the cameras of a file in file order. `id` and unknown keys are ignored.

    Warns
    -----
    UserWarning : rotations in the file are rounded or have a scale.

    Raises
    ------
    InputError : the file is not a JSON list, or an entry lacks a key or has an unusable value. The message names
        file, entry and key.
    """
    return cameras_of(read_json(path, "a cameras.json"), path)


def cameras_of(entries: Any, path: str | os.PathLike[str]) -> list[NamedCamera]:
    """Return the cameras in a list that was read from `path`; warns and raises InputError as `read_cameras`."""
    if not isinstance(entries, list):
        raise InputError(f"{path}: holds {describe(entries)}; expected a list of cameras, as 3DGS writes it")
    named, rotations = [], {}
    for index, entry in enumerate(entries):
        place = f"{path}: entry {index}"
        if not isinstance(entry, dict):
            raise InputError(f"{place}: is {describe(entry)}; expected an object with img_name, width, ...")
        if isinstance(entry.get("img_name"), str):
            place += f" ({ascii(entry['img_name'])[:80]})"
        with named_place(place):
            rotation = _rotation(entry)
            named.append(_named_camera(entry, rotation.matrix))
            rotations[f"entry {index}"] = rotation
    warn_of_corrections(path, rotations)
    return named


def write_cameras(path: str | os.PathLike[str], named: Sequence[NamedCamera]) -> None:
    """Write cameras atomically in their order, one per line. Reading returns exactly the same cameras.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    lines = []
    for index, item in enumerate(named):
        camera = item.camera
        entry = {
            "id": index,
            "img_name": item.name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.position.tolist(),
            "rotation": camera.rotation.T.tolist(),
            "fy": camera.fy,
            "fx": camera.fx,
            "cx": camera.cx,
            "cy": camera.cy,
        }
        lines.append(json.dumps(entry))
    with atomic_writer(path) as stream:
        stream.write(("[\n" + ",\n".join(lines) + "\n]\n").encode("utf-8"))


def _rotation(entry: dict[str, Any]) -> NearestRotation:
    """Return the camera-to-world rotation of one entry; raises InputError that names the key."""
    try:
        return nearest_rotation(get_matrix(entry, "rotation", (3, 3), _REMEDY))
    except NotARotation as error:
        raise InputError(f"key 'rotation' {error}; write the cameras again") from None


def _named_camera(entry: dict[str, Any], rotation: NDArray[np.float64]) -> NamedCamera:
    """Return the camera of one entry with a camera-to-world rotation; raises InputError that names the key."""
    name = get_value(entry, "img_name", _REMEDY)
    if not isinstance(name, str) or not name:
        raise InputError(f"key 'img_name' is {describe(name)}; expected a name")
    width, height = get_size(entry, "width", _REMEDY), get_size(entry, "height", _REMEDY)
    fx, fy = get_number(entry, "fx", _REMEDY), get_number(entry, "fy", _REMEDY)
    cx = get_number(entry, "cx", _REMEDY) if "cx" in entry else width / 2
    cy = get_number(entry, "cy", _REMEDY) if "cy" in entry else height / 2
    cam_from_world = np.zeros((3, 4))
    cam_from_world[:, :3] = rotation.T
    cam_from_world[:, 3] = -cam_from_world[:, :3] @ get_matrix(entry, "position", (3,), _REMEDY)
    return NamedCamera(name, Camera(width, height, fx, fy, cx, cy, cam_from_world))

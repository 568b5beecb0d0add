"""`cameras.json`: named cameras in the list that 3DGS writes, with the principal point beside.

An entry: `{id, img_name, width, height, position [3], rotation [3][3], fy, fx, cx, cy}`; position is the
camera centre, rotation camera-to-world (OpenCV axes). `cx`, `cy` are clsplat's own and optional: the image
centre where they are absent, as 3DGS assumes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError
from ..files.atomic import atomic_writer
from ..files.image_names import bare_name
from ..files.json_file import describe, get_matrix, get_number, get_size, get_value, read_json
from .camera import Camera

_REMEDY = "add it as 3DGS writes it"


@dataclass(frozen=True, slots=True)
class NamedCamera:
    """A camera and the image it belongs to (`img_name`, without folder)."""

    name: str
    camera: Camera


def img_names(names: Sequence[str]) -> list[str]:
    """`img_name` of each image file: without its extension, as 3DGS writes it, unless two would be the same."""
    bare = [bare_name(name) for name in names]
    return bare if len(set(bare)) == len(bare) else list(names)


def named_cameras(names: Sequence[str], cameras: Sequence[Camera]) -> list[NamedCamera]:
    """Cameras of image files, each under its `img_name`."""
    return [NamedCamera(name, camera) for name, camera in zip(img_names(names), cameras, strict=True)]


def read_cameras(path: str | os.PathLike[str]) -> list[NamedCamera]:
    """Cameras in file order; keys that clsplat does not know are ignored, `id` too.

    Raises
    ------
    InputError : no JSON list, or an entry with a key missing or unusable; names file, entry and key.
    """
    return cameras_of(read_json(path, "a cameras.json"), path)


def cameras_of(entries: Any, path: str | os.PathLike[str]) -> list[NamedCamera]:
    """As `read_cameras`, of a list that has been read from `path`; raises InputError."""
    if not isinstance(entries, list):
        raise InputError(f"{path}: holds {describe(entries)}; expected a list of cameras, as 3DGS writes it")
    named = []
    for index, entry in enumerate(entries):
        place = f"{path}: entry {index}"
        if not isinstance(entry, dict):
            raise InputError(f"{place}: is {describe(entry)}; expected an object with img_name, width, ...")
        if isinstance(entry.get("img_name"), str):
            place += f" ({ascii(entry['img_name'])[:80]})"
        try:
            named.append(_named_camera(entry))
        except InputError as error:
            raise InputError(f"{place}: {error}") from None
    return named


def write_cameras(path: str | os.PathLike[str], named: Sequence[NamedCamera]) -> None:
    """Write cameras in the order given, one line each, atomically; reading gives them back exactly.

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


def _named_camera(entry: dict[str, Any]) -> NamedCamera:
    """One entry; raises InputError naming the key."""
    name = get_value(entry, "img_name", _REMEDY)
    if not isinstance(name, str) or not name:
        raise InputError(f"key 'img_name' is {describe(name)}; expected a name")
    width, height = get_size(entry, "width", _REMEDY), get_size(entry, "height", _REMEDY)
    fx, fy = get_number(entry, "fx", _REMEDY), get_number(entry, "fy", _REMEDY)
    cx = get_number(entry, "cx", _REMEDY) if "cx" in entry else width / 2
    cy = get_number(entry, "cy", _REMEDY) if "cy" in entry else height / 2
    cam_from_world = np.zeros((3, 4))
    cam_from_world[:, :3] = get_matrix(entry, "rotation", (3, 3), _REMEDY).T
    cam_from_world[:, 3] = -cam_from_world[:, :3] @ get_matrix(entry, "position", (3,), _REMEDY)
    return NamedCamera(name, Camera(width, height, fx, fy, cx, cy, cam_from_world))

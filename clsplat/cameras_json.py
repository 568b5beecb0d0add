"""`cameras.json`: named cameras in the list that 3DGS writes, with the principal point beside.

An entry: `{id, img_name, width, height, position [3], rotation [3][3], fy, fx, cx, cy}`; position is the
camera centre, rotation camera-to-world (OpenCV axes). `cx`, `cy` are clsplat's own and optional: the image
centre where they are absent, as 3DGS assumes.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_writer
from .camera import Camera
from .errors import InputError


@dataclass(frozen=True, slots=True)
class NamedCamera:
    """A camera and the image it belongs to (`img_name`, without folder)."""

    name: str
    camera: Camera


IMAGE_SUFFIXES = frozenset((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp"))


def bare_name(name: str) -> str:
    """An image's name without its extension; other names, dots included, stay."""
    stem, dot, suffix = name.rpartition(".")
    return stem if stem and dot + suffix.lower() in IMAGE_SUFFIXES else name


def img_names(names: Sequence[str]) -> list[str]:
    """`img_name` of each image file: without its extension, as 3DGS writes it, unless two would be the same."""
    bare = [bare_name(name) for name in names]
    return bare if len(set(bare)) == len(bare) else list(names)


def read_cameras(path: str | os.PathLike[str]) -> list[NamedCamera]:
    """Cameras in file order; keys that clsplat does not know are ignored, `id` too.

    Raises
    ------
    InputError : no JSON list, or an entry with a key missing or unusable; names file, entry and key.
    """
    path = Path(path)
    try:
        entries = json.loads(path.read_bytes())
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: cannot be read ({reason}); check name and rights") from error
    except (ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: is no JSON ({reason}); choose a cameras.json") from error
    if not isinstance(entries, list):
        raise InputError(f"{path}: holds {_kind(entries)}; expected a list of cameras, as 3DGS writes it")
    named = []
    for number, entry in enumerate(entries):
        place = f"{path}: entry {number}"
        if not isinstance(entry, dict):
            raise InputError(f"{place}: is {_kind(entry)}; expected an object with img_name, width, ...")
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
    name = _value(entry, "img_name")
    if not isinstance(name, str) or not name:
        raise InputError(f"key 'img_name' is {_kind(name)}; expected a name")
    size = [_number(entry, key) for key in ("width", "height")]
    for key, real in zip(("width", "height"), size, strict=True):
        if real < 1 or real != int(real):
            raise InputError(f"key {key!r} is {real:g}; expected a whole number of pixels, at least 1")
    width, height = int(size[0]), int(size[1])
    fx, fy = _number(entry, "fx"), _number(entry, "fy")
    cx = _number(entry, "cx") if "cx" in entry else width / 2
    cy = _number(entry, "cy") if "cy" in entry else height / 2
    cam_from_world = np.zeros((3, 4))
    cam_from_world[:, :3] = _matrix(entry, "rotation", (3, 3)).T
    cam_from_world[:, 3] = -cam_from_world[:, :3] @ _matrix(entry, "position", (3,))
    return NamedCamera(name, Camera(width, height, fx, fy, cx, cy, cam_from_world))


def _value(entry: dict[str, Any], key: str) -> Any:
    if key not in entry:
        raise InputError(f"key {key!r} is missing; add it as 3DGS writes it")
    return entry[key]


def _number(entry: dict[str, Any], key: str) -> float:
    return _finite(_value(entry, key), key)


def _finite(value: object, key: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"key {key!r} is {_kind(value)}; expected a number")
    try:
        real = float(value)
    except OverflowError:
        real = math.inf
    if not math.isfinite(real):
        raise InputError(f"key {key!r} is not finite; expected a number")
    return real


def _matrix(entry: dict[str, Any], key: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Nested lists of exactly `shape`."""
    value = _value(entry, key)
    rows = value if len(shape) == 2 else [value]
    right = isinstance(rows, list) and (len(shape) == 1 or len(rows) == shape[0])
    if not right or not all(isinstance(row, list) and len(row) == shape[-1] for row in rows):
        form = " x ".join(str(size) for size in shape)
        raise InputError(f"key {key!r} has the wrong form; expected {form} numbers in lists")
    return np.array([[_finite(number, key) for number in row] for row in rows]).reshape(shape)


def _kind(value: object) -> str:
    """What a JSON value is, in a word."""
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, str):
        return f"the text {ascii(value)[:40]}"
    if isinstance(value, (list, dict)):
        return "a list" if isinstance(value, list) else "an object"
    return "a number"

"""Camera paths: frames in order, at a rate, and their files.

A path file is nerfstudio's `camera_path.json`: an object with `render_width`, `render_height` [px], `fps`, `seconds`
and a list `camera_path` of frames `{camera_to_world [16, row by row], fov [degrees, vertical], aspect}`; `keyframes`
are what the frames were interpolated from, `is_cycle` whether the last leads back to the first. Its axes are OpenGL's
(x right, y up, z back), its pixels square, its principal point the centre of the image; where ours are not, the frame
has `fl_x`, `fl_y`, `cx`, `cy` [px] beside, which nerfstudio passes over. Positions are in the world of the splats:
nerfstudio's own paths are in its rescaled world, and fit models that were trained in it. A `cameras.json` is a path
too, of its cameras in file order.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.atomic import atomic_writer
from ..files.json_file import describe, get_matrix, get_number, get_size, get_value, read_json
from .camera import Camera
from .cameras_json import cameras_of

DEFAULT_FPS = 30.0
_REMEDY = "add it as nerfstudio's camera_path.json has it"
_PIXELS = ("fl_x", "fl_y", "cx", "cy")
_CENTRED = 1e-9  # of the image; from where on a principal point is off centre, and a pixel not square
# OpenGL's axes of a camera in OpenCV's.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Frames in order.

    Attributes
    ----------
    cameras : a frame each, at least one.
    fps : frames a second, above 0.
    keys : the cameras that the frames were interpolated from; () where there are none.
    closed : whether the last frame leads back to the first.

    Raises
    ------
    InputError : no frame, or a rate that is not above 0.
    """

    cameras: tuple[Camera, ...]
    fps: float = DEFAULT_FPS
    keys: tuple[Camera, ...] = ()
    closed: bool = False

    def __post_init__(self) -> None:
        if not self.cameras:
            raise InputError("camera path: has no frames; it needs at least one")
        if not (math.isfinite(self.fps) and self.fps > 0):
            raise InputError(f"camera path: fps is {self.fps}; it must be above 0")

    @property
    def seconds(self) -> float:
        """How long the path lasts [s]."""
        return len(self.cameras) / self.fps


def read_path(path: str | os.PathLike[str]) -> CameraPath:
    """A camera_path.json, or a cameras.json at the default rate.

    Raises
    ------
    InputError : the file cannot be read, or a field is missing or unusable; names file, frame and key.
    """
    return path_of(read_json(path, "a camera_path.json or a cameras.json"), path)


def write_path(path: str | os.PathLike[str], camera_path: CameraPath) -> None:
    """Write a camera_path.json, atomically; reading gives the cameras back to rounding.

    Raises
    ------
    InputError : frames of different sizes. OutputError : the file cannot be written.
    """
    text = path_text(camera_path)
    with atomic_writer(path) as stream:
        stream.write(text.encode("utf-8"))


def path_text(camera_path: CameraPath) -> str:
    """The text of the path's camera_path.json; raises InputError for frames of different sizes."""
    first = camera_path.cameras[0]
    for index, camera in enumerate(camera_path.cameras):
        if (camera.width, camera.height) != (first.width, first.height):
            raise InputError(
                f"camera path: frame {index} is {camera.width}x{camera.height} px, the first "
                f"{first.width}x{first.height}; a camera_path.json has one size: write a cameras.json"
            )
    step = camera_path.seconds / max(len(camera_path.keys) - (not camera_path.closed), 1)
    head = {
        "camera_type": "perspective",
        "render_width": first.width,
        "render_height": first.height,
        "fps": camera_path.fps,
        "seconds": camera_path.seconds,
        "is_cycle": camera_path.closed,
        "default_fov": _fov(first),
        "default_transition_sec": step,
    }
    keys = [
        {
            "matrix": pose_of(key).ravel().tolist(),
            **_lens(key),
            "override_transition_enabled": False,
            "override_transition_sec": None,
        }
        for key in camera_path.keys
    ]
    frames = [{"camera_to_world": pose_of(camera).ravel().tolist(), **_lens(camera)} for camera in camera_path.cameras]
    lines = [f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in head.items()]
    lines += [
        f"{json.dumps(name)}: {_listed(entries)}" for name, entries in (("keyframes", keys), ("camera_path", frames))
    ]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def path_of(content: Any, source: str | os.PathLike[str]) -> CameraPath:
    """The path in the content of a JSON file; raises InputError."""
    if isinstance(content, list):
        named = cameras_of(content, source)
        if not named:
            raise InputError(f"{source}: holds no cameras; a path needs at least one")
        return CameraPath(tuple(item.camera for item in named))
    if not isinstance(content, dict):
        raise InputError(f"{source}: holds {describe(content)}; expected a camera_path.json or a cameras.json")
    try:
        model = content.get("camera_type", "perspective")
        if model != "perspective":
            raise InputError(f"key 'camera_type' is {ascii(model)[:40]}; only perspective cameras can be rendered")
        width, height = get_size(content, "render_width", _REMEDY), get_size(content, "render_height", _REMEDY)
        frames = _entries(get_value(content, "camera_path", _REMEDY), "camera_path")
        if not frames:
            raise InputError("key 'camera_path' is empty; a path needs at least one frame")
        fps = get_number(content, "fps", _REMEDY) if "fps" in content else _rate(content, len(frames))
        cameras = _cameras(frames, "camera_path", "camera_to_world", width, height)
        keys = _cameras(_entries(content.get("keyframes", []), "keyframes"), "keyframes", "matrix", width, height)
        return CameraPath(cameras, fps, keys, content.get("is_cycle") is True)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def pose_of(camera: Camera) -> NDArray[np.float64]:
    """Camera to world (4, 4) in OpenGL's axes (x right, y up, z back)."""
    return opengl_pose(camera.cam_from_world)


def opengl_pose(cam_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Camera to world (4, 4) in OpenGL's axes, of a rigid (4, 4) world to camera in OpenCV's."""
    pose = np.eye(4)
    pose[:3, :3] = cam_from_world[:3, :3].T
    pose[:3, 3] = -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
    posed: NDArray[np.float64] = pose @ _FLIP
    return posed


def cam_from_world_of(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """World to camera (4, 4) in OpenCV's axes, of a rigid (4, 4) camera to world in OpenGL's."""
    turned = pose @ _FLIP
    inverse = np.eye(4)
    inverse[:3, :3] = turned[:3, :3].T
    inverse[:3, 3] = -turned[:3, :3].T @ turned[:3, 3]
    return inverse


def _rate(content: dict[str, Any], frames: int) -> float:
    """Frames a second where only `seconds` is known, or neither."""
    if "seconds" not in content:
        return DEFAULT_FPS
    seconds = get_number(content, "seconds", _REMEDY)
    if seconds <= 0:
        raise InputError(f"key 'seconds' is {seconds:g}; it must be above 0")
    return frames / seconds


def _entries(given: Any, key: str) -> list[dict[str, Any]]:
    if not isinstance(given, list) or not all(isinstance(entry, dict) for entry in given):
        raise InputError(f"key {key!r} has the wrong form; expected a list of objects")
    return given


def _cameras(entries: Sequence[dict[str, Any]], key: str, pose_key: str, width: int, height: int) -> tuple[Camera, ...]:
    cameras = []
    for index, entry in enumerate(entries):
        try:
            cameras.append(_camera(entry, pose_key, width, height))
        except InputError as error:
            raise InputError(f"{key}[{index}]: {error}") from None
    return tuple(cameras)


def _camera(entry: dict[str, Any], pose_key: str, width: int, height: int) -> Camera:
    """One frame or keyframe; raises InputError naming the key."""
    if isinstance(entry.get(pose_key), str):  # nerfstudio's older viewer: a list as text
        try:
            entry = entry | {pose_key: json.loads(entry[pose_key])}
        except ValueError:
            raise InputError(f"key {pose_key!r} is {describe(entry[pose_key])}; expected 16 numbers") from None
    given = get_value(entry, pose_key, _REMEDY)
    nested = isinstance(given, list) and len(given) == 4
    pose = get_matrix(entry, pose_key, (4, 4) if nested else (16,), _REMEDY).reshape(4, 4)
    if np.any(pose[3, :3] != 0.0) and np.all(pose[:3, 3] == 0.0):
        pose = pose.T  # the older viewer's keyframes go column by column
    fov = get_number(entry, "fov", _REMEDY)
    if not 0 < fov < 180:
        raise InputError(f"key 'fov' is {fov:g}; expected degrees between 0 and 180")
    focal = height / (2 * math.tan(math.radians(fov) / 2))
    pixels = (focal, focal, width / 2, height / 2)
    if all(name in entry for name in _PIXELS):
        pixels = tuple(get_number(entry, name, _REMEDY) for name in _PIXELS)  # type: ignore[assignment]
    try:
        if np.any(pose[3] != [0.0, 0.0, 0.0, 1.0]):
            raise InputError("last row")
        return Camera(width, height, *pixels, cam_from_world_of(pose))
    except InputError:
        raise InputError(
            f"key {pose_key!r} is no rotation and translation; expected a rigid 4 x 4 matrix, row by row"
        ) from None


def _fov(camera: Camera) -> float:
    """Vertical, in degrees, of the image's height at `fy`."""
    return math.degrees(2 * math.atan2(camera.height, 2 * camera.fy))


def _lens(camera: Camera) -> dict[str, float]:
    lens = {"fov": _fov(camera), "aspect": camera.width / camera.height}
    off = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5), abs(camera.fx / camera.fy - 1))
    if off <= _CENTRED:
        return lens
    return lens | dict(zip(_PIXELS, (camera.fx, camera.fy, camera.cx, camera.cy), strict=True))


def _listed(entries: Sequence[dict[str, Any]]) -> str:
    """A JSON list, an entry a line."""
    return "[" + ",".join("\n  " + json.dumps(entry) for entry in entries) + ("\n]" if entries else "]")

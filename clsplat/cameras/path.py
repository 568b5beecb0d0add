"""Camera paths: frames in order at a frame rate, and their files.

A path file is nerfstudio's `camera_path.json`: an object with `render_width`, `render_height` [px], `fps`, `seconds`
and a list `camera_path`. A frame is `{camera_to_world [16, row by row], fov [degrees, vertical], aspect}`. `keyframes`
holds the cameras that the frames were interpolated from. `is_cycle` says whether the last frame leads to the first.

The axes are OpenGL's (x right, y up, z back), pixels are square, and the principal point is the image centre. Frames of
other cameras have the additional keys `fl_x`, `fl_y`, `cx`, `cy` [px], which nerfstudio ignores.

Positions are in the world of the splats. Paths from nerfstudio are in its rescaled world, and fit only models that were
trained in that world. A `cameras.json` can be read as a path of its cameras in file order.
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

from ..errors import InputError, named_place
from ..files.atomic import atomic_writer
from ..files.json_file import describe, get_matrix, get_number, get_objects, get_size, get_value, read_json
from .camera import Camera
from .cameras_json import cameras_of
from .rotations import NearestRotation, NotARotation, nearest_rotation, warn_of_corrections

DEFAULT_FPS = 30.0
_REMEDY = "add it as nerfstudio's camera_path.json has it"
_PIXELS = ("fl_x", "fl_y", "cx", "cy")
_CENTRED = 1e-9  # largest relative difference of a centred principal point and of square pixels
# Turns OpenCV's camera axes into OpenGL's, and back.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class CameraPath:
    """A camera path: frames in order at a frame rate.

    Attributes
    ----------
    cameras : one camera per frame, at least one.
    fps : frames per second, above 0.
    keys : the cameras that the frames were interpolated from; may be empty.
    closed : whether the last frame leads back to the first.

    Raises
    ------
    InputError : the path has no frame, or the frame rate is not above 0.
    """

    cameras: tuple[Camera, ...]
    fps: float = DEFAULT_FPS
    keys: tuple[Camera, ...] = ()
    closed: bool = False

    def __post_init__(self) -> None:
        if not self.cameras:
            raise InputError("camera path: there are no frames; a path needs at least one")
        if not (math.isfinite(self.fps) and self.fps > 0):
            raise InputError(f"camera path: fps is {self.fps}; it must be above 0")

    @property
    def seconds(self) -> float:
        """Duration of the path [s]."""
        return len(self.cameras) / self.fps


def read_path(path: str | os.PathLike[str]) -> CameraPath:
    """Read a camera_path.json, or a cameras.json at the default frame rate.

    Raises
    ------
    InputError : the file cannot be read, or a key is missing or unusable. The message names file, frame and key.
    """
    return path_of(read_json(path, "a camera_path.json or a cameras.json"), path)


def write_path(path: str | os.PathLike[str], camera_path: CameraPath) -> None:
    """Write a camera_path.json atomically. Reading it returns the same cameras up to rounding.

    Raises
    ------
    InputError : the frames have different sizes.
    OutputError : the file cannot be written.
    """
    text = path_text(camera_path)
    with atomic_writer(path) as stream:
        stream.write(text.encode("utf-8"))


def path_text(camera_path: CameraPath) -> str:
    """Return the path as the text of a camera_path.json; raises InputError if frames have different sizes."""
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
    """Return the path in the content of a JSON file; raises InputError that begins with `source`."""
    if isinstance(content, list):
        named = cameras_of(content, source)
        if not named:
            raise InputError(f"{source}: has no cameras; a path needs at least one")
        return CameraPath(tuple(item.camera for item in named))
    if not isinstance(content, dict):
        raise InputError(f"{source}: holds {describe(content)}; expected a camera_path.json or a cameras.json")
    with named_place(str(source)):
        model = content.get("camera_type", "perspective")
        if model != "perspective":
            raise InputError(f"key 'camera_type' is {ascii(model)[:40]}; only perspective cameras can be rendered")
        width, height = get_size(content, "render_width", _REMEDY), get_size(content, "render_height", _REMEDY)
        frames = get_objects(content, "camera_path", _REMEDY)
        if not frames:
            raise InputError("key 'camera_path' is empty; a path needs at least one frame")
        fps = get_number(content, "fps", _REMEDY) if "fps" in content else _fps_of(content, len(frames))
        rotations: dict[str, NearestRotation] = {}
        cameras = _cameras(frames, "camera_path", "camera_to_world", width, height, rotations)
        entries = get_objects(content, "keyframes", _REMEDY) if "keyframes" in content else []
        keys = _cameras(entries, "keyframes", "matrix", width, height, rotations)
        warn_of_corrections(source, rotations)
        return CameraPath(cameras, fps, keys, content.get("is_cycle") is True)


def pose_of(camera: Camera) -> NDArray[np.float64]:
    """Return the camera-to-world matrix, (4, 4), with OpenGL's axes (x right, y up, z back)."""
    return opengl_pose(camera.cam_from_world)


def opengl_pose(cam_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return camera-to-world with OpenGL's axes for a rigid world-to-camera with OpenCV's axes, (4, 4) each."""
    pose = np.eye(4)
    pose[:3, :3] = cam_from_world[:3, :3].T
    pose[:3, 3] = -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
    return pose @ _FLIP


def cam_from_world_of(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return world-to-camera with OpenCV's axes for a rigid camera-to-world with OpenGL's axes, (4, 4) each."""
    turned = pose @ _FLIP
    inverse = np.eye(4)
    inverse[:3, :3] = turned[:3, :3].T
    inverse[:3, 3] = -turned[:3, :3].T @ turned[:3, 3]
    return inverse


def _fps_of(content: dict[str, Any], frames: int) -> float:
    """Return the frame rate of a file without `fps`: from `seconds` if present, otherwise the default."""
    if "seconds" not in content:
        return DEFAULT_FPS
    seconds = get_number(content, "seconds", _REMEDY)
    if seconds <= 0:
        raise InputError(f"key 'seconds' is {seconds:g}; it must be above 0")
    return frames / seconds


def _cameras(
    entries: Sequence[dict[str, Any]],
    key: str,
    pose_key: str,
    width: int,
    height: int,
    rotations: dict[str, NearestRotation],
) -> tuple[Camera, ...]:
    """Return the cameras of frames or keyframes, and add their rotations to `rotations`."""
    cameras = []
    for index, entry in enumerate(entries):
        with named_place(f"{key}[{index}]"):
            pose, rotation = _pose(entry, pose_key)
            cameras.append(_camera(entry, pose, width, height))
            rotations[f"{key}[{index}]"] = rotation
    return tuple(cameras)


def _pose(entry: dict[str, Any], pose_key: str) -> tuple[NDArray[np.float64], NearestRotation]:
    """Return the camera-to-world matrix, (4, 4), of one frame or keyframe, and its rotation as it is in the file."""
    if isinstance(entry.get(pose_key), str):  # nerfstudio's older viewer writes the list as text
        try:
            entry = entry | {pose_key: json.loads(entry[pose_key])}
        except (ValueError, RecursionError):
            raise InputError(f"key {pose_key!r} is {describe(entry[pose_key])}; expected 16 numbers") from None
    numbers = get_value(entry, pose_key, _REMEDY)
    nested = isinstance(numbers, list) and len(numbers) == 4
    pose = get_matrix(entry, pose_key, (4, 4) if nested else (16,), _REMEDY).reshape(4, 4)
    if np.any(pose[3, :3] != 0.0) and np.all(pose[:3, 3] == 0.0):
        pose = pose.T  # the older viewer writes keyframes column by column
    try:
        if np.any(pose[3] != [0.0, 0.0, 0.0, 1.0]):
            raise NotARotation("has another last row than 0 0 0 1")
        rotation = nearest_rotation(pose[:3, :3])
    except NotARotation as error:
        raise InputError(f"key {pose_key!r} {error}; expected a rigid 4 x 4 matrix, row by row") from None
    return np.vstack([np.hstack([rotation.matrix, pose[:3, 3:]]), pose[3]]), rotation


def _camera(entry: dict[str, Any], pose: NDArray[np.float64], width: int, height: int) -> Camera:
    """Return the camera of one frame or keyframe with a camera-to-world pose; raises InputError that names the key."""
    fov = get_number(entry, "fov", _REMEDY)
    if not 0 < fov < 180:
        raise InputError(f"key 'fov' is {fov:g}; expected degrees between 0 and 180")
    focal = height / (2 * math.tan(math.radians(fov) / 2))
    pixels = (focal, focal, width / 2, height / 2)
    if all(name in entry for name in _PIXELS):
        pixels = tuple(get_number(entry, name, _REMEDY) for name in _PIXELS)  # type: ignore[assignment]
    return Camera(width, height, *pixels, cam_from_world_of(pose))


def _fov(camera: Camera) -> float:
    """Return the vertical field of view [degrees]."""
    return math.degrees(2 * math.atan2(camera.height, 2 * camera.fy))


def _lens(camera: Camera) -> dict[str, float]:
    lens = {"fov": _fov(camera), "aspect": camera.width / camera.height}
    off_centre = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
    if max(off_centre, abs(camera.fx / camera.fy - 1)) <= _CENTRED:
        return lens
    return lens | dict(zip(_PIXELS, (camera.fx, camera.fy, camera.cx, camera.cy), strict=True))


def _listed(entries: Sequence[dict[str, Any]]) -> str:
    """Return entries as a JSON list with one entry per line."""
    return "[" + ",".join("\n  " + json.dumps(entry) for entry in entries) + ("\n]" if entries else "]")

"""Camera paths on request: around a scene, between cameras, or from a file."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError
from ..files.image_names import bare_name
from ..files.json_file import describe_any, is_real, is_whole
from ..splats.splats import Splats
from .camera import Camera
from .cameras_json import NamedCamera
from .interpolate import interpolate, resized_by_height
from .path import DEFAULT_FPS, CameraPath, read_path

AROUND = ("orbit", "ellipse", "spiral")
BETWEEN = "interpolate"
FRAMES = 60  # default number of frames
MAX_FRAMES = 100_000  # an hour at 30 frames a second
_MAX_UNSEEN = 0.05  # share of frames from unseen sides that needs no warning
_NAMES_IN_MESSAGE = 8  # longest list of camera names in a message


@dataclass(frozen=True)
class PathRequest:
    """Description of a camera path to make.

    Parameters
    ----------
    kind : one of AROUND, BETWEEN, or a path file's name.
    keys : names of the cameras to interpolate between, in this order; None for all cameras, sorted by name.
    closed : whether to interpolate back to the first camera.
    frames, seconds : length of the path, one of the two; by default FRAMES, or the length of the path file.
    fps : frames per second; by default DEFAULT_FPS, or the rate of the path file.
    size : (width, height) of the images [px]; the vertical field of view stays.

    Raises
    ------
    InputError : `frames` and `seconds` are both set, a value has another type, or a number is not above 0 and finite.
    """

    kind: str
    keys: tuple[str, ...] | None = None
    closed: bool = False
    frames: int | None = None
    seconds: float | None = None
    fps: float | None = None
    size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.frames is not None and self.seconds is not None:
            raise InputError("camera path: give frames or seconds, not both")
        self._check_types()
        for name, value in (("seconds", self.seconds), ("fps", self.fps)):
            if value is not None and not 0 < value < math.inf:
                raise InputError(f"camera path: {name} {value}: must be above 0 and finite")
        if self.frames is not None and self.frames < 1:
            raise InputError(f"camera path: frames {self.frames}: must be at least 1")
        if self.size is not None and min(self.size) < 1:
            raise InputError("camera path: size {}x{}: must be at least 1x1".format(*self.size))

    def _check_types(self) -> None:
        """Raise InputError if a value has another type than it needs."""
        texts = isinstance(self.keys, tuple | list) and all(isinstance(key, str) for key in self.keys)
        whole = isinstance(self.size, tuple | list) and len(self.size) == 2 and all(map(is_whole, self.size))
        for name, is_right, expected in (
            ("kind", isinstance(self.kind, str | os.PathLike), f"{', '.join(AROUND)}, {BETWEEN} or a file's name"),
            ("keys", self.keys is None or texts, "names of cameras in a tuple"),
            ("frames", self.frames is None or is_whole(self.frames), "a whole number"),
            ("seconds", self.seconds is None or is_real(self.seconds), "a number"),
            ("fps", self.fps is None or is_real(self.fps), "a number"),
            ("size", self.size is None or whole, "two whole numbers of pixels, (width, height)"),
        ):
            if not is_right:
                raise InputError(f"camera path: {name} is {describe_any(getattr(self, name))}; expected {expected}")

    def frame_count(self, fps: float) -> int | None:
        """Return the number of frames at a frame rate; None if the request sets neither frames nor seconds.

        Raises
        ------
        InputError : more than MAX_FRAMES.
        """
        count = self.frames if self.seconds is None else max(1, round(min(self.seconds * fps, 2.0 * MAX_FRAMES)))
        if count is not None and count > MAX_FRAMES:
            length = f"{self.frames} frames" if self.seconds is None else f"{self.seconds:g} s at {fps:g} a second"
            raise InputError(f"camera path: {length} are more than {MAX_FRAMES} frames: make it shorter")
        return count


def make_path(
    request: PathRequest, splats: Splats, views: Sequence[NamedCamera] = (), source: str | Path = "cameras"
) -> CameraPath:
    """Make the cameras of a path.

    Parameters
    ----------
    request : description of the path.
    splats : the model; without views, a path goes around these splats.
    views : cameras that the path goes around or between.
    source : origin of the views, for messages.

    Warns
    -----
    UserWarning : a part of the path around the scene looks from sides that no camera saw.

    Raises
    ------
    InputError : the path file is missing or damaged, a key is not among the views, or there are no views to
        interpolate between.
    """
    fps = request.fps or DEFAULT_FPS
    count = request.frame_count(fps) or FRAMES
    if request.kind in AROUND:
        from . import orbits

        known = [view.camera for view in views]
        cameras = getattr(orbits, request.kind)(splats, known, count)
        unseen = orbits.share_unseen(cameras, splats, known)
        if unseen > _MAX_UNSEEN:
            warnings.warn(
                f"--path {request.kind}: {unseen:.0%} of the frames look from sides that no camera saw: "
                f"--path spiral and --path {BETWEEN} stay near the cameras",
                stacklevel=2,
            )
        path = CameraPath(tuple(cameras), fps, closed=True)
    elif request.kind == BETWEEN:
        keys = _chosen(views, source, request.keys)
        path = CameraPath(tuple(interpolate(keys, count, request.closed)), fps, tuple(keys), request.closed)
    else:
        path = _from_file(request)
    return path if request.size is None else resize_path(path, request.size)


def resize_path(path: CameraPath, size: tuple[int, int]) -> CameraPath:
    """Return the path at another image size (width, height) [px]."""
    cameras, keys = (tuple(resized_by_height(camera, *size) for camera in part) for part in (path.cameras, path.keys))
    return CameraPath(cameras, path.fps, keys, path.closed)


def name_frames(path: CameraPath, kind: str) -> list[NamedCamera]:
    """Return the path's frames with the names of their images."""
    stem = kind if kind in AROUND else "frame"
    digits = max(3, len(str(len(path.cameras) - 1)))
    return [NamedCamera(f"{stem}_{index:0{digits}}", camera) for index, camera in enumerate(path.cameras)]


def _from_file(request: PathRequest) -> CameraPath:
    if not Path(request.kind).is_file():
        raise InputError(f"--path {request.kind}: no such file; give one, or {', '.join(AROUND)} or {BETWEEN}")
    path = read_path(request.kind)
    fps = request.fps or path.fps
    count = request.frame_count(fps)
    if count is None or count == len(path.cameras):
        return CameraPath(path.cameras, fps, path.keys, path.closed)
    return CameraPath(tuple(interpolate(path.cameras, count, path.closed, even=True)), fps, path.keys, path.closed)


def _chosen(views: Sequence[NamedCamera], source: str | Path, keys: Sequence[str] | None) -> list[Camera]:
    """Return the cameras with these names, or all cameras sorted by name; raises InputError."""
    if not views:
        raise InputError(
            f"{source}: no cameras to interpolate between: give --cameras cameras.json, or a scene with -s"
        )
    if keys is None:
        return [view.camera for view in sorted(views, key=lambda view: view.name)]
    known = {bare_name(view.name): view.camera for view in views} | {view.name: view.camera for view in views}
    chosen = []
    for name in keys:
        camera = known.get(name) or known.get(bare_name(name))
        if camera is None:
            names = sorted(view.name for view in views)
            more = f", ... ({len(names)} in all)" if len(names) > _NAMES_IN_MESSAGE else ""
            raise InputError(
                f"{source}: has no camera {name!r}: choose --keys from {', '.join(names[:_NAMES_IN_MESSAGE])}{more}"
            )
        chosen.append(camera)
    return chosen

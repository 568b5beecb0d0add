"""Recording a camera path while looking: keys, and the path through them."""

from __future__ import annotations

import re
from pathlib import Path

from ..cameras.camera import Camera
from ..cameras.interpolate import interpolate
from ..cameras.path import DEFAULT_FPS, CameraPath, path_text, write_path
from ..errors import InputError

MOST_KEYS = 1000
LONGEST = 60.0  # seconds between two keys
FILE_NAME = "camera_path.json"
_NUMBERED = re.compile(r"camera_path_(\d+)\.json")


class Recording:
    """Keys of one looker-on.

    Attributes
    ----------
    keys : cameras in order. seconds : from each key to the next. closed : whether the path returns to the first key.
    """

    def __init__(self) -> None:
        self.keys: list[Camera] = []
        self.seconds = 2.0
        self.closed = False

    def add(self, camera: Camera) -> None:
        """One key more. Raises InputError where there are too many."""
        if len(self.keys) >= MOST_KEYS:
            raise InputError(f"path: has {MOST_KEYS} keys already; save it and begin another")
        self.keys.append(camera)

    def remove_last(self) -> None:
        """One key less, if there is any."""
        del self.keys[-1:]

    def clear(self) -> None:
        """No keys."""
        self.keys.clear()

    def path(self, fps: float = DEFAULT_FPS) -> CameraPath:
        """Frames through the keys.

        Raises
        ------
        InputError : fewer than two keys.
        """
        if len(self.keys) < 2:
            raise InputError(f"path: has {len(self.keys)} keys; add two or more")
        stretches = len(self.keys) - (not self.closed)
        seconds = min(max(self.seconds, 1.0 / fps), LONGEST)
        frames = max(round(stretches * seconds * fps), 2) + (not self.closed)
        cameras = interpolate(self.keys, frames, self.closed)
        return CameraPath(tuple(cameras), fps, tuple(self.keys), self.closed)

    def text(self) -> str:
        """The path's camera_path.json. Raises InputError as `path`."""
        return path_text(self.path())

    def save(self, folder: Path) -> Path:
        """Write the path into a folder, under a name that is free; returns it. Raises InputError and OutputError."""
        path = self.path()
        found = (_NUMBERED.fullmatch(file.name) for file in folder.glob("camera_path_*.json"))
        last = max((int(match[1]) for match in found if match), default=0)
        target = folder / f"camera_path_{last + 1:03}.json"
        write_path(target, path)
        return target

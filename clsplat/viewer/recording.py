"""Recording of a camera path: key cameras, and the path through them."""

from __future__ import annotations

from pathlib import Path

from ..cameras.camera import Camera
from ..cameras.interpolate import interpolate
from ..cameras.path import DEFAULT_FPS, CameraPath, path_text, write_path
from ..errors import InputError
from .numbered import save_numbered

MAX_KEYS = 1000
MAX_SECONDS = 60.0  # between two keys
FILE_NAME = "camera_path.json"


class Recording:
    """The key cameras of one client.

    Attributes
    ----------
    keys : cameras in order. seconds : time from each key to the next. closed : whether the path ends at the first key.
    """

    def __init__(self) -> None:
        self.keys: list[Camera] = []
        self.seconds = 2.0
        self.closed = False

    def add(self, camera: Camera) -> None:
        """Add a key. Raises InputError if there are too many."""
        if len(self.keys) >= MAX_KEYS:
            raise InputError(f"path: has {MAX_KEYS} keys already; save it and begin another")
        self.keys.append(camera)

    def remove_last(self) -> None:
        """Remove the last key, if there is one."""
        del self.keys[-1:]

    def clear(self) -> None:
        """Remove all keys."""
        self.keys.clear()

    def path(self, fps: float = DEFAULT_FPS) -> CameraPath:
        """Return frames through the keys.

        Raises
        ------
        InputError : there are fewer than two keys.
        """
        if len(self.keys) < 2:
            raise InputError(f"path: has {len(self.keys)} keys; add two or more")
        stretches = len(self.keys) - (not self.closed)
        seconds = min(max(self.seconds, 1.0 / fps), MAX_SECONDS)
        frames = max(round(stretches * seconds * fps), 2) + (not self.closed)
        cameras = interpolate(self.keys, frames, self.closed)
        return CameraPath(tuple(cameras), fps, tuple(self.keys), self.closed)

    def text(self) -> str:
        """Return the text of camera_path.json. Raises InputError as `path`."""
        return path_text(self.path())

    def save(self, folder: Path) -> Path:
        """Write the path into a folder under a free name and return it. Raises InputError and OutputError."""
        path = self.path()
        return save_numbered(folder, "camera_path", ".json", lambda target: write_path(target, path))

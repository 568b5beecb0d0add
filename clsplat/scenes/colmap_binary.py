"""COLMAP's binary model files: checked before pycolmap reads them, and written for scenes that clsplat makes.

The layout follows COLMAP's documentation (https://colmap.github.io/format.html, "Binary File Format"). A file is little
endian: a 64-bit count, then the records one after another. A reader without checks can loop for ever on a wrong count,
and can load a truncated file as a wrong model without an error. `check_binary_model` checks every record first.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.atomic import atomic_writer
from .colmap_text import read_image_lines
from .photo_size import MAX_SIDE

# Number of parameters of each camera model, by COLMAP's model id (https://colmap.github.io/cameras.html), from
# SIMPLE_PINHOLE to EQUIRECTANGULAR.
_MODEL_PARAMS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)
_PINHOLE = 1  # COLMAP's model id of PINHOLE


class _Cursor:
    """A reader of records in a mapped file; it raises InputError with the file's name at the file's end."""

    def __init__(self, path: Path, data: mmap.mmap) -> None:
        self.path, self.data, self.at = path, data, 0

    def take(self, layout: struct.Struct) -> tuple[int | float, ...]:
        """Unpack one fixed-size record."""
        start = self.skip(layout.size)
        return layout.unpack_from(self.data, start)

    def skip(self, size: int) -> int:
        """Skip `size` bytes and return the position of the first."""
        start = self.at
        if start + size > len(self.data):
            raise InputError(
                f"{self.path}: the file ends early ({len(self.data)} bytes, needs at least "
                f"{start + size}); it is truncated or damaged: copy or rebuild it"
            )
        self.at += size
        return start

    def text(self) -> str:
        """Read a name that ends with a NUL byte."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise InputError(
                f"{self.path}: the file ends inside a name; it is truncated or damaged: copy or rebuild it"
            )
        raw = self.data[self.at : end]
        self.at = end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            raise InputError(
                f"{self.path}: the name at byte {end - len(raw)} is not text; the file is damaged: copy or rebuild it"
            ) from None


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters
_IMAGE = struct.Struct("<I4d3dI")  # id, quaternion wxyz, translation, camera id; then the name
_POINT = struct.Struct("<Q3d3BdQ")  # id, xyz, rgb, error, track length; then the track
_RIG = struct.Struct("<II")  # id, number of sensors; then the reference sensor and the others
_SENSOR = struct.Struct("<iI")
_FLAG = struct.Struct("<B")
_FRAME = struct.Struct("<II7dI")  # id, rig id, pose, number of data ids
_OBSERVATION_BYTES, _TRACK_BYTES, _POSE_BYTES, _DATA_ID_BYTES = 24, 8, 56, 16


def _walk_camera(cursor: _Cursor) -> None:
    camera_id, model, width, height = cursor.take(_CAMERA)
    if not 0 <= model < len(_MODEL_PARAMS):
        raise InputError(
            f"{cursor.path}: camera {camera_id} has the unknown model id {model}; "
            "convert it to PINHOLE with COLMAP's image_undistorter"
        )
    if not (0 < width < MAX_SIDE and 0 < height < MAX_SIDE):
        raise InputError(f"{cursor.path}: camera {camera_id} is {width}x{height} px; the file is damaged: rebuild it")
    cursor.skip(8 * _MODEL_PARAMS[int(model)])


def _walk_image(cursor: _Cursor) -> None:
    image_id = cursor.take(_IMAGE)[0]
    if not cursor.text():
        raise InputError(f"{cursor.path}: image {image_id} has an empty name; the file is damaged: rebuild it")
    cursor.skip(_OBSERVATION_BYTES * int(cursor.take(_COUNT)[0]))


def _walk_point(cursor: _Cursor) -> None:
    cursor.skip(_TRACK_BYTES * int(cursor.take(_POINT)[-1]))


def _walk_rig(cursor: _Cursor) -> None:
    sensors = int(cursor.take(_RIG)[1])
    for index in range(sensors):
        cursor.skip(_SENSOR.size)
        if index and cursor.take(_FLAG)[0]:  # the first sensor is the reference and has no pose
            cursor.skip(_POSE_BYTES)


def _walk_frame(cursor: _Cursor) -> None:
    cursor.skip(_DATA_ID_BYTES * int(cursor.take(_FRAME)[-1]))


_WALKERS: dict[str, Callable[[_Cursor], None]] = {
    "cameras.bin": _walk_camera,
    "images.bin": _walk_image,
    "points3D.bin": _walk_point,
    "rigs.bin": _walk_rig,
    "frames.bin": _walk_frame,
}


@contextmanager
def _opened(path: Path) -> Iterator[_Cursor]:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        yield _Cursor(path, data)


def _check_file(path: Path) -> int:
    """Check every record of one file and return their number."""
    walk = _WALKERS[path.name]
    size = path.stat().st_size
    if size < _COUNT.size:
        raise InputError(f"{path}: only {size} bytes; the file is empty or truncated: copy or rebuild it")
    with _opened(path) as cursor:
        count = int(cursor.take(_COUNT)[0])
        for _ in range(count):  # a wrong count ends at the end of the file
            walk(cursor)
        if cursor.at != size:
            raise InputError(
                f"{path}: {size - cursor.at} bytes follow its {count} records; the file is damaged: copy or rebuild it"
            )
    return count


def check_binary_model(folder: Path) -> None:
    """Check every record of a binary model's files, so that a damaged file is refused before pycolmap reads it.

    Parameters
    ----------
    folder : folder with cameras.bin, images.bin and possibly points3D.bin, rigs.bin and frames.bin.

    Raises
    ------
    InputError : a file ends early, has bytes left over, or contains an impossible camera.
    """
    for name in _WALKERS:
        path = folder / name
        if path.is_file():
            _check_file(path)


def binary_without_observations(images: Path, points: Path) -> tuple[bytes, bytes, dict[int, list[int]]]:
    """Return images.bin without observations, points3D.bin without tracks, and the image ids of each point's track.

    Parameters
    ----------
    images, points : files that `check_binary_model` has accepted.
    """
    tracks = {}
    with _opened(images) as cursor:
        bare_images = [cursor.data[: _COUNT.size]]
        for _ in range(int(cursor.take(_COUNT)[0])):
            start = cursor.at
            cursor.take(_IMAGE)
            cursor.text()
            bare_images += [cursor.data[start : cursor.at], _COUNT.pack(0)]
            cursor.skip(_OBSERVATION_BYTES * int(cursor.take(_COUNT)[0]))
    with _opened(points) as cursor:
        bare_points = [cursor.data[: _COUNT.size]]
        for _ in range(int(cursor.take(_COUNT)[0])):
            *point, length = cursor.take(_POINT)
            bare_points.append(_POINT.pack(*point, 0))
            start = cursor.skip(_TRACK_BYTES * int(length))
            tracks[int(point[0])] = np.frombuffer(cursor.data[start : cursor.at], "<u4")[::2].tolist()
    return b"".join(bare_images), b"".join(bare_points), tracks


def count_registered(folder: Path) -> int:
    """Return the number of registered images of the model in a folder.

    The number is the count in images.bin, or the number of images in images.txt.
    """
    binary = folder / "images.bin"
    if binary.is_file():
        with binary.open("rb") as file:
            head = file.read(_COUNT.size)
        return int(_COUNT.unpack(head)[0]) if len(head) == _COUNT.size else 0
    return sum(1 for _ in read_image_lines(folder / "images.txt", "replace"))


@dataclass(frozen=True, eq=False)
class ModelView:
    """A registered image to write: its name, camera and observations.

    Parameters
    ----------
    name : file name inside the images folder.
    size : (width, height) [px].
    intrinsics : (fx, fy, cx, cy) [px], or the parameters of another model.
    cam_from_world : (4, 4) world-to-camera pose.
    pixels : (M, 2) observations [px], with pixel centres at half-integers.
    point_index : (M,) index of each observation's point among the model's points.
    model : COLMAP's id of the camera model, PINHOLE by default.
    """

    name: str
    size: tuple[int, int]
    intrinsics: tuple[float, ...]
    cam_from_world: NDArray[np.float64]
    pixels: NDArray[np.float64]
    point_index: NDArray[np.int64]
    model: int = _PINHOLE


def write_binary_model(
    folder: Path,
    views: Sequence[ModelView],
    xyz: NDArray[np.float64],
    rgb: NDArray[np.uint8],
    error: NDArray[np.float64] | None = None,
) -> None:
    """Write cameras.bin, images.bin and points3D.bin. Tracks follow from the views' observations.

    Parameters
    ----------
    folder : created if it does not exist.
    views : registered images; they get the ids 1, 2, ..., and equal cameras share one camera id.
    xyz : (P, 3) positions in the world.
    rgb : (P, 3) colours.
    error : (P,) mean reprojection error of each point [px], 0 by default.

    Raises
    ------
    OutputError : a file cannot be written.
    """
    from scipy.spatial.transform import Rotation

    cameras: dict[tuple[int | float, ...], int] = {}
    images: list[bytes] = []
    tracks: list[list[tuple[int, int]]] = [[] for _ in range(len(xyz))]
    for image_id, view in enumerate(views, start=1):
        camera_id = cameras.setdefault((view.model, *view.size, *view.intrinsics), len(cameras) + 1)
        qx, qy, qz, qw = Rotation.from_matrix(view.cam_from_world[:3, :3]).as_quat()
        images.append(_IMAGE.pack(image_id, qw, qx, qy, qz, *view.cam_from_world[:3, 3], camera_id))
        images.append(view.name.encode("utf-8") + b"\0" + _COUNT.pack(len(view.pixels)))
        observations = np.zeros(len(view.pixels), dtype=[("xy", "<f8", 2), ("point", "<u8")])
        observations["xy"], observations["point"] = view.pixels, view.point_index + 1
        images.append(observations.tobytes())
        for slot, point in enumerate(view.point_index):
            tracks[point].append((image_id, slot))
    errors = np.zeros(len(xyz)) if error is None else error
    points = [
        _POINT.pack(index, *position, *(int(c) for c in colour), off, len(track))
        + np.array(track, dtype="<u4").tobytes()
        for index, (position, colour, off, track) in enumerate(zip(xyz, rgb, errors, tracks, strict=True), 1)
    ]
    _write(
        folder / "cameras.bin",
        len(cameras),
        (
            _CAMERA.pack(camera_id, *map(int, key[:3])) + struct.pack(f"<{len(key) - 3}d", *key[3:])
            for key, camera_id in cameras.items()
        ),
    )
    _write(folder / "images.bin", len(views), images)
    _write(folder / "points3D.bin", len(xyz), points)


def _write(path: Path, count: int, records: Iterable[bytes]) -> None:
    with atomic_writer(path) as stream:
        stream.write(_COUNT.pack(count) + b"".join(records))

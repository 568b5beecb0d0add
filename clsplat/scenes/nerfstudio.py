"""Posed photos from `transforms.json`: NeRF's Blender sets, instant-ngp and nerfstudio.

A frame has `file_path` and `transform_matrix`, camera-to-world with OpenGL's axes (x right, y up, z backwards). Lens
keys stand beside the frames for all of them, or in a frame for itself: `w`, `h`, `fl_x`, `fl_y`, `cx`, `cy` [px],
`camera_angle_x`, `camera_angle_y` [rad] instead of focal lengths, `k1` ... `k4`, `p1`, `p2`, `camera_model`,
`is_fisheye`. The world is the file's own: nerfstudio's `applied_transform` and `applied_scale` are in the poses
already, and are put on points only where these come from the COLMAP model that the poses were made from.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import is_rotation
from ..cameras.path import cam_from_world_of
from ..errors import InputError
from ..files.image_names import IMAGE_SUFFIXES
from ..files.images import image_size
from ..files.json_file import read_json, to_real
from .colmap import Points, read_model
from .point_cloud import read_point_cloud
from .posed_images import PosedImages
from .undistort import Lens, RegisteredImage, make_lens

FILE, TRAIN, TEST = "transforms.json", "transforms_train.json", "transforms_test.json"

_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
_MAX_SIDE = 1 << 20  # of an image [px]
_LONGEST_NAME, _LONGEST_PATH = 240, 2000  # bytes; file systems take 255 and 4096
_LARGEST = 1e30  # of a number; float32 holds it
_COLMAP = ("colmap/sparse/0", "sparse/0")  # nerfstudio's place for the model, and COLMAP's own
_SUFFIXES = (".png", *sorted(IMAGE_SUFFIXES - {".png"}))


def find_transforms(path: Path) -> list[Path]:
    """The transforms files of a scene: those of training and test, or the one; none where it has none.

    Parameters
    ----------
    path : the scene's folder, or a file. Beside `transforms_train.json` `transforms_test.json` is taken along.
    """
    if path.is_file():
        return find_transforms(path.parent) if path.name == TRAIN else [path]
    pair = [path / TRAIN, path / TEST]
    if pair[0].is_file():
        return [file for file in pair if file.is_file()]
    return [path / FILE] if (path / FILE).is_file() else []


def read_transforms(files: list[Path], images: str | None = None) -> PosedImages:
    """Posed photos of transforms files.

    Parameters
    ----------
    files : of `find_transforms`. images : folder that takes the place of the first one in each `file_path`.

    Warns
    -----
    UserWarning : frames whose photos are not there; they are left out.

    Raises
    ------
    InputError : damaged or without frames, a key missing or unusable, no photo there, or points that cannot be read;
        names file, frame and key.
    """
    documents = [_Document.read(file) for file in files]
    frames = [frame for document in documents for frame in document.frames(images)]
    photos: dict[str, _Frame] = {}
    for frame in frames:
        if frame.name in photos:
            raise InputError(f"{frame.place}: {frame.name!r} has a frame already; remove one")
        photos[frame.name] = frame
    kept = {name: frame for name, frame in sorted(photos.items()) if frame.file.is_file()}
    missing = [name for name in photos if name not in kept]
    if not kept:
        raise InputError(
            f"{files[0]}: none of its {len(photos)} photos is there, such as {missing[0]!r}; "
            "copy them beside it, or name their folder"
        )
    if missing:
        warnings.warn(
            f"{files[0]}: {len(missing)} of {len(photos)} frames name photos that are not there, such as "
            f"{missing[0]!r}; they are left out",
            stacklevel=3,
        )
    test_names = _held_out(documents, kept)
    used = set().union(*(document.listed() or kept for document in documents))
    kept = {name: frame for name, frame in kept.items() if name in used}
    return PosedImages(
        [frame.photo() for frame in kept.values()],
        {name: frame.file for name, frame in kept.items()},
        documents[0].points(),
        test_names,
        {name: mask for name, frame in kept.items() for mask in [frame.mask_file()] if mask is not None},
    )


def _held_out(documents: list[_Document], kept: dict[str, _Frame]) -> frozenset[str] | None:
    """Names of the test views, where the files say."""
    if len(documents) == 2:
        return frozenset(name for name, frame in kept.items() if frame.document is documents[1])
    for key in ("test_filenames", "val_filenames"):
        if documents[0].listed(key):
            return frozenset(documents[0].listed(key) & set(kept))
    return None


@dataclass(frozen=True, eq=False)
class _Frame:
    """A frame: the photo's name and file, and where it stands."""

    document: _Document
    number: int
    values: dict[str, Any]
    name: str
    file: Path

    @property
    def place(self) -> str:
        return f"{self.document.path}: frame {self.number}"

    def photo(self) -> RegisteredImage:
        return RegisteredImage(self.name, self.pose(), self.lens())

    def mask_file(self) -> Path | None:
        """nerfstudio's mask_path."""
        named = self.values.get("mask_path")
        if named is None:
            return None
        if not isinstance(named, str) or not named.isprintable() or not _can_be_name(named):
            raise InputError(f"{self.place}: mask_path {named!r} is not the name of a file; name a mask, or remove it")
        return self.document.path.parent / named.replace("\\", "/")

    def pose(self) -> NDArray[np.float64]:
        """(4, 4) world-to-camera, OpenCV's axes."""
        given = self.values.get("transform_matrix")
        matrix = _matrix(given)
        if matrix is None:
            raise InputError(f"{self.place}: transform_matrix must be 4 x 4 finite numbers; write the poses again")
        if not is_rotation(matrix[:3, :3]):
            raise InputError(
                f"{self.place}: transform_matrix has no rotation in its left 3 x 3 block; write the "
                "poses again, without a scale"
            )
        return cam_from_world_of(matrix)

    def lens(self) -> Lens:
        """The lens, of the size that the file gives, or the photo has."""
        size = image_size(self.file)
        width, height = int(self.number_of("w", size[0])), int(self.number_of("h", size[1]))
        if not (1 <= width <= _MAX_SIDE and 1 <= height <= _MAX_SIDE):
            raise InputError(f"{self.place}: w x h is {width} x {height}; both must be 1 to {_MAX_SIDE}")
        fx = self.focal("fl_x", "camera_angle_x", width)
        fy = self.focal("fl_y", "camera_angle_y", height, fx)
        if fx is None or fy is None:
            raise InputError(f"{self.place}: has neither fl_x nor camera_angle_x; add the focal length")
        core = [fx, fy, self.number_of("cx", width / 2), self.number_of("cy", height / 2)]
        k1, k2, k3, k4, p1, p2 = (self.number_of(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
        model = str(self.value("camera_model") or "OPENCV").upper()
        if model in _FISHEYE or self.value("is_fisheye"):
            return make_lens("OPENCV_FISHEYE", width, height, [*core, k1, k2, k3, k4])
        if model not in _PERSPECTIVE:
            raise InputError(
                f"{self.place}: camera_model {model!r} has no pinhole image; make perspective views "
                f"first, or use one of {', '.join((*_PERSPECTIVE[:2], _FISHEYE[0]))}"
            )
        if k4:
            raise InputError(f"{self.place}: k4 of a perspective lens is not supported; undistort the photos first")
        return make_lens("FULL_OPENCV", width, height, [*core, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0])

    def focal(self, key: str, angle: str, size: int, default: float | None = None) -> float | None:
        """Focal length [px] from its own key, or an angle of view."""
        if self.value(key) is not None:
            return self.positive(key)
        if self.value(angle) is None:
            return default
        whole = self.positive(angle)
        if whole >= math.pi:
            raise InputError(f"{self.place}: {angle} is {whole:g}; an angle of view is below pi")
        return 0.5 * size / math.tan(0.5 * whole)

    def positive(self, key: str) -> float:
        value = self.number_of(key, 0.0)
        if value <= 0:
            raise InputError(f"{self.place}: {key} is {value:g}; it must be above 0")
        return value

    def number_of(self, key: str, default: float) -> float:
        value = self.value(key)
        if value is None:
            return default
        real = to_real(value)
        if real is None or not abs(real) < _LARGEST:
            raise InputError(f"{self.place}: {key} is {str(value)[:40]!r}; it must be a number")
        return real

    def value(self, key: str) -> Any:
        """The frame's own value, else that of all frames."""
        return self.values.get(key, self.document.values.get(key))


@dataclass(frozen=True, eq=False)
class _Document:
    """A transforms file."""

    path: Path
    values: dict[str, Any]

    @staticmethod
    def read(path: Path) -> _Document:
        values = read_json(path, "a transforms.json of NeRF, instant-ngp or nerfstudio")
        if not isinstance(values, dict) or not isinstance(values.get("frames"), list) or not values["frames"]:
            raise InputError(f"{path}: has no list 'frames'; give a transforms.json of NeRF, instant-ngp or nerfstudio")
        return _Document(path, values)

    def frames(self, images: str | None) -> Iterator[_Frame]:
        """All frames, also those whose photos are not there."""
        for number, values in enumerate(self.values["frames"]):
            if not isinstance(values, dict) or not isinstance(values.get("file_path"), str) or not values["file_path"]:
                raise InputError(f"{self.path}: frame {number}: has no file_path; name its photo")
            file = self.photo_file(values["file_path"], images)
            yield _Frame(self, number, values, self.name_of(file), file)

    def photo_file(self, file_path: str, images: str | None = None) -> Path:
        """The photo's file; Blender sets leave the suffix out. Raises InputError where no file can have the name."""
        if not _can_be_name(file_path):
            raise InputError(f"{self.path}: {ascii(file_path)[:60]} is not the name of a photo; name a file beside it")
        relative = Path(file_path.replace("\\", "/"))
        if images is not None and not relative.is_absolute():
            relative = Path(images, *relative.parts[1:] if len(relative.parts) > 1 else relative.parts)
        file = self.path.parent / relative
        if file.suffix.lower() in IMAGE_SUFFIXES:
            return file
        candidates = [file.with_name(file.name + suffix) for suffix in _SUFFIXES]
        return next((candidate for candidate in candidates if candidate.is_file()), candidates[0])

    def name_of(self, file: Path) -> str:
        """A photo's name: its path below the scene's folder, `/` between folders; elsewhere its file name."""
        # Without "..", which can lead out of the folder: images are written under these names.
        folder, plain = (Path(os.path.normpath(path)) for path in (self.path.parent, file))
        return plain.relative_to(folder).as_posix() if plain.is_relative_to(folder) else plain.name

    def listed(self, key: str | None = None) -> set[str]:
        """Names in nerfstudio's list `key`, or in all of its lists."""
        keys = ("train_filenames", "val_filenames", "test_filenames") if key is None else (key,)
        lists = [self.values.get(key) or [] for key in keys]
        if not all(isinstance(names, list) and all(isinstance(name, str) for name in names) for names in lists):
            raise InputError(f"{self.path}: {' or '.join(keys)} is not a list of photos; remove it or name files")
        names = [name for names in lists for name in names]
        return {self.name_of(self.photo_file(name)) for name in names}

    def points(self) -> Points:
        """The file's points, those of the COLMAP model behind it, or none."""
        folder, named = self.path.parent, self.values.get("ply_file_path")
        if isinstance(named, str) and named:
            if not named.isprintable() or not _can_be_name(named):
                raise InputError(
                    f"{self.path}: ply_file_path {named!r} is not the name of a file; name a PLY, or remove it"
                )
            return read_point_cloud(folder / named)
        if (folder / "points3d.ply").is_file():
            return read_point_cloud(folder / "points3d.ply")
        for place in _COLMAP if "applied_transform" in self.values else ():
            if (folder / place).is_dir():
                found = read_model(folder / place).points
                return Points(self.applied(found.xyz), found.rgb, found.track_length)
        return Points(np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0, np.int64))

    def applied(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points of the COLMAP model, moved as its poses were."""
        matrix = _matrix(self.values["applied_transform"])
        scale = to_real(self.values.get("applied_scale", 1.0))
        if matrix is None or scale is None or not 0 < scale < _LARGEST:
            raise InputError(f"{self.path}: applied_transform must be 3 x 4 numbers and applied_scale above 0")
        moved: NDArray[np.float64] = scale * (xyz @ matrix[:3, :3].T + matrix[:3, 3])
        return moved


def _can_be_name(text: str) -> bool:
    """Whether a file can have this path, with a suffix added."""
    path = PurePosixPath(text.replace("\\", "/"))
    try:
        parts = [len(os.fsencode(part)) for part in path.parts]
        short = max(parts, default=0) <= _LONGEST_NAME and sum(parts) <= _LONGEST_PATH
        return short and bool(path.name) and "\0" not in text
    except UnicodeEncodeError:  # half of a surrogate pair
        return False


def _matrix(given: Any) -> NDArray[np.float64] | None:
    """(4, 4) of a nested list of 4 x 4 or 3 x 4 finite numbers, else None."""
    try:
        matrix = np.array(given, dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        return None
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    return matrix if matrix.shape == (4, 4) and np.isfinite(matrix).all() else None

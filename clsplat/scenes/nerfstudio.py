"""Scenes in `transforms.json` files, as of NeRF's Blender sets, instant-ngp and nerfstudio.

A frame has a `file_path` and a `transform_matrix`, camera-to-world with OpenGL's axes (x right, y up, z backwards).
Lens keys are in the frame, or beside the list of frames for all of them: `w`, `h`, `fl_x`, `fl_y`, `cx`, `cy` [px],
`k1` ... `k4`, `p1`, `p2`, `camera_model` and `is_fisheye`. The angles of view `camera_angle_x` and `camera_angle_y`
[rad], or `x_fov` and `y_fov` [degrees], can replace focal lengths. So can a matrix, `intrinsic_matrix` or `K`. Poses of
NeuS2, with `from_na`, have OpenCV's axes (y down, z forwards).

The world is that of the poses, which include nerfstudio's `applied_transform` and `applied_scale`. Points are moved by
these two only if they come from the COLMAP model behind the poses.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.path import cam_from_world_of
from ..cameras.rotations import NearestRotation, NotARotation, nearest_rotation, warn_of_corrections
from ..errors import InputError, Remedy
from ..files.file_names import can_be_file
from ..files.image_names import CONVERTERS, IMAGE_SUFFIXES
from ..files.json_file import MAX_NUMBER, read_json, to_real
from ..files.masks import is_same_file
from .colmap import Points, read_model
from .colmap_folder import PHOTOS
from .photo_names import is_absolute, last_parts
from .point_cloud import join_points, read_point_cloud
from .posed_images import PosedImages, read_sizes
from .reduced_photos import with_reduced_photos
from .transforms_lens import FrameLens
from .undistort import Lens, RegisteredImage

_LAST_ROW = 1e-6  # largest error of the last row of a pose
_HELD_OUT = "test_frames"  # of ScanNet++, beside the list `frames`
_OPENCV_AXES = "from_na"  # of NeuS2: poses have y down and z forwards
_LISTS = ("train_filenames", "val_filenames", "test_filenames")  # nerfstudio's lists of photos
_COLMAP_FOLDERS = ("colmap/sparse/0", "sparse/0")  # where nerfstudio and COLMAP put a COLMAP model
_SUFFIXES = (".png", *sorted(IMAGE_SUFFIXES - {".png"}))


def read_transforms(files: list[Path], images: str | None = None) -> PosedImages:
    """Read the photos with poses of transforms files.

    Parameters
    ----------
    files : result of `find_transforms`.
    images : folder of photos that replaces the first folder of each `file_path`.

    Warns
    -----
    UserWarning : the lists of training and test photos name photos without a frame, or rotations were corrected.

    Raises
    ------
    InputError : a file is damaged or has no frames, a key is missing or unusable, no photo of a list has a frame, or
        the points cannot be read. The message names file, frame and key.
    """
    documents = [_Document.read(file, may_be_empty=number > 0) for number, file in enumerate(files)]
    frames = [frame for document in documents for frame in document.frames(images)]
    photos: dict[str, _Frame] = {}
    for frame in frames:
        if frame.name in photos:
            raise InputError(f"{frame.place}: {frame.name!r} has a frame already; remove one")
        photos[frame.name] = frame
    _warn_of_motion(documents[0].path, frames)
    used = set().union(*(document.listed_frames(photos) for document in documents))
    listed = {name: frame for name, frame in sorted(photos.items()) if name in used}
    photo_files = with_reduced_photos(files[0].parent, {name: frame.file for name, frame in listed.items()})
    sizes, left_out = read_sizes(photo_files)
    bad = {name: frame for name, frame in listed.items() if frame.values.get("is_bad") is True}  # of ScanNet++
    for name in [name for name in sizes if listed[name].is_lost]:
        left_out[name] = f"{listed[name].place}: its transform_matrix is not finite"
    left_out |= {name: f"{frame.place}: is marked as bad (is_bad)" for name, frame in bad.items()}
    sizes = {name: size for name, size in sizes.items() if name not in left_out}
    kept = {name: listed[name] for name in sizes}
    for document in documents:
        of_file = (frame for frame in kept.values() if frame.document is document)
        warn_of_corrections(
            document.path, {frame.place.removeprefix(f"{document.path}: "): frame.rotation for frame in of_file}
        )
    return PosedImages(
        [frame.photo(sizes[name]) for name, frame in kept.items()],
        photo_files,
        sizes,
        documents[0].points(),
        _held_out(documents, listed),
        {name: frame.mask_file for name, frame in kept.items() if frame.values.get("mask_path") is not None},
        left_out,
        unused=frozenset(bad),
    )


def _warn_of_motion(path: Path, frames: Iterable[_Frame]) -> None:
    """Warn if the frames are of different times, as those of D-NeRF."""
    times = {time for time in (to_real(frame.values.get("time")) for frame in frames) if time is not None}
    if len(times) > 1:
        warnings.warn(
            f"{path}: its frames have different times (time); what moves will be blurred: a model does not move",
            stacklevel=4,
        )


def _with_suffix(file: Path) -> Path | None:
    """Return a photo's file, which may lack its suffix; None if it lacks one and no photo has the name.

    A name with the suffix of an image, or of photos that are not supported, lacks none.
    """
    if file.suffix.lower() in (*IMAGE_SUFFIXES, *CONVERTERS) or file.is_file():
        return file
    candidates = (file.with_name(file.name + suffix) for suffix in _SUFFIXES)
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _held_out(documents: list[_Document], frames: dict[str, _Frame]) -> frozenset[str] | None:
    """Return the names of the test views that the files hold out; None if they hold none out."""
    if len(documents) == 2:
        return frozenset(name for name, frame in frames.items() if frame.document is documents[1])
    if held_out := frozenset(name for name, frame in frames.items() if frame.held_out):
        return held_out
    for key in ("test_filenames", "val_filenames"):
        if documents[0].listed_names(key):
            return frozenset(documents[0].listed_names(key) & set(frames))
    return None


@dataclass(frozen=True, eq=False)
class _Frame:
    """A frame of a transforms file, with its photo's name and file."""

    document: _Document
    place: str
    values: dict[str, Any]
    name: str
    file: Path
    held_out: bool

    def photo(self, size: tuple[int, int]) -> RegisteredImage:
        """Return the photo, whose file has this size [px], with its pose and lens."""
        return RegisteredImage(self.name, self.pose(), self.lens(size))

    @property
    def is_lost(self) -> bool:
        """Whether the pose is a matrix with numbers that are not finite: ScanNet has them where tracking failed."""
        matrix = _matrix(self.values.get("transform_matrix"))
        return matrix is not None and not np.isfinite(matrix).all()

    def mask_file(self) -> Path:
        """Return the mask file named by nerfstudio's `mask_path`; raise InputError if it cannot be used."""
        mask = self.values.get("mask_path")
        if not isinstance(mask, str) or not mask.isprintable() or not can_be_file(mask):
            raise InputError(f"{self.place}: mask_path {mask!r} is not the name of a file; name a mask, or remove it")
        file = self.document.path.parent / mask.replace("\\", "/")
        if not file.is_file():
            raise InputError(
                f"{self.place}: mask_path {mask!r} is not a file",
                Remedy("copy it there"),
                Remedy("use no masks", "--masks none"),
            )
        if is_same_file(file, self.file):
            raise InputError(f"{self.place}: mask_path {mask!r} is the photo itself; name a mask, or remove it")
        return file

    @cached_property
    def matrix(self) -> NDArray[np.float64]:
        """The transform_matrix as it is in the file, (4, 4)."""
        matrix = _matrix(self.values.get("transform_matrix"))
        if matrix is None or not np.isfinite(matrix).all():
            raise InputError(f"{self.place}: transform_matrix must be 4 x 4 finite numbers; write the poses again")
        if np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > _LAST_ROW:
            row = " ".join(f"{value:g}" for value in matrix[3])
            raise InputError(
                f"{self.place}: the last row of transform_matrix is {row}, not 0 0 0 1; write camera-to-world "
                "poses, row by row"
            )
        return matrix

    @cached_property
    def rotation(self) -> NearestRotation:
        """The rotation of the pose."""
        try:
            return nearest_rotation(self.matrix[:3, :3])
        except NotARotation as error:
            raise InputError(
                f"{self.place}: the left 3 x 3 block of transform_matrix {error}; write the poses again"
            ) from None

    def pose(self) -> NDArray[np.float64]:
        """Return the world-to-camera matrix, (4, 4), with OpenCV's axes."""
        pose = self.matrix.copy()
        pose[:3, :3] = self.rotation.matrix
        if self.values.get(_OPENCV_AXES, self.document.values.get(_OPENCV_AXES)):
            pose[:3, 1:3] *= -1.0
        return cam_from_world_of(pose)

    def lens(self, size: tuple[int, int]) -> Lens:
        """Return the lens, with the size in the file, or else the photo's size."""
        return FrameLens(self.place, self.values, self.document.values).read(size)


@dataclass(frozen=True, eq=False)
class _Document:
    """A transforms file."""

    path: Path
    values: dict[str, Any]

    @staticmethod
    def read(path: Path, *, may_be_empty: bool = False) -> _Document:
        values = read_json(path, "a transforms.json of NeRF, instant-ngp or nerfstudio")
        frames = values.get("frames") if isinstance(values, dict) else None
        if (
            not isinstance(frames, list)
            or not (frames or may_be_empty)
            or not isinstance(values.get(_HELD_OUT, []), list)
        ):
            if isinstance(values, list) and values and isinstance(values[0], dict) and "position" in values[0]:
                raise InputError(f"{path}: has the cameras of a model, without a scene; give the scene's folder")
            raise InputError(f"{path}: has no list 'frames'; give a transforms.json of NeRF, instant-ngp or nerfstudio")
        return _Document(path, values)

    def frames(self, images: str | None) -> Iterator[_Frame]:
        """Yield all frames, including frames without an existing photo."""
        without = 0
        for held_out, key in ((False, "frames"), (True, _HELD_OUT)):
            for number, values in enumerate(self.values.get(key) or []):
                if isinstance(values, dict) and "file_path" in values and values["file_path"] is None:
                    without += 1  # other programs write poses to render so
                    continue
                place = f"{self.path}: {'test frame' if held_out else 'frame'} {number}"
                path = values.get("file_path") if isinstance(values, dict) else None
                if not isinstance(path, str) or not path:
                    raise InputError(f"{place}: has no file_path; name its photo")
                file = self.photo_file(path, images)
                yield _Frame(self, place, values, self.name_of(file), file, held_out)
        if without:
            warnings.warn(
                f"{self.path}: {without} frames have no photo (file_path null); they are left out", stacklevel=4
            )

    def photo_file(self, file_path: str, images: str | None = None) -> Path:
        """Return the photo's file; Blender sets omit the suffix. Raises InputError if no file can have the name."""
        if not can_be_file(file_path):
            raise InputError(f"{self.path}: {ascii(file_path)[:60]} is not the name of a photo; name a file beside it")
        places = self._places(file_path, images)
        files = [_with_suffix(place) for place in places]
        found = next((file for file in files if file is not None and file.is_file()), None)
        return found or files[0] or places[0].with_name(places[0].name + _SUFFIXES[0])

    def _places(self, file_path: str, images: str | None) -> list[Path]:
        """Return where a photo may be. Its path may be one of another computer, or begin in another folder."""
        home, parts = self.path.parent, last_parts(file_path)
        if is_absolute(file_path):
            first = [] if images is not None else [Path(file_path)]
        else:
            relative = Path(file_path.replace("\\", "/")).parts
            first = [home.joinpath(*relative if images is None else (images, *(relative[1:] or relative)))]
        if images is not None:
            return [*first, *(home / images / part for part in reversed(parts))]
        return [*first, *(folder / part for folder in (home, home / PHOTOS) for part in parts)]

    def name_of(self, file: Path) -> str:
        """Return a photo's name: its path below the scene's folder with `/` between folders, or else its file name."""
        # Paths lose "..", which could lead out of the folder, because renders are written under these names.
        folder, plain = (Path(os.path.normpath(path)) for path in (self.path.parent, file))
        return plain.relative_to(folder).as_posix() if plain.is_relative_to(folder) else plain.name

    def listed_names(self, key: str) -> set[str]:
        """Return the photo names in nerfstudio's list `key`; an empty set without the list."""
        names = self.values.get(key) or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{self.path}: {key} is not a list of photos; remove it or name files")
        return {self.name_of(self.photo_file(name)) for name in names}

    def listed_frames(self, frames: Iterable[str]) -> set[str]:
        """Return the names of the frames that nerfstudio's lists name; all frames without such lists."""
        known, listed = set(frames), set()
        for key in _LISTS:
            names = self.listed_names(key)
            if not names:
                continue
            unknown = sorted(names - known)
            if len(unknown) == len(names):
                raise InputError(
                    f"{self.path}: {key} names no photo of a frame, for example {unknown[0]!r}; name photos such as "
                    f"{min(known)!r}, or remove the list"
                )
            if unknown:
                warnings.warn(
                    f"{self.path}: {key} names {len(unknown)} of {len(names)} photos that have no frame, for example "
                    f"{unknown[0]!r}; they are left out",
                    stacklevel=5,
                )
            listed |= names & known
        return listed or known

    def points(self) -> Points:
        """Return the file's points, or the points of the COLMAP model behind it, or an empty point cloud."""
        folder, ply = self.path.parent, self.values.get("ply_file_path")
        if isinstance(ply, str) and ply:
            if not ply.isprintable() or not can_be_file(ply):
                raise InputError(
                    f"{self.path}: ply_file_path {ply!r} is not the name of a file; name a PLY, or remove it"
                )
            if not (folder / ply).is_file():
                raise InputError(
                    f"{self.path}: ply_file_path {ply!r} is not a file: copy the points there, or remove the key"
                )
            return read_point_cloud(folder / ply)
        if (folder / "points3d.ply").is_file():
            return read_point_cloud(folder / "points3d.ply")
        for place in _COLMAP_FOLDERS if "applied_transform" in self.values else ():
            if (folder / place).is_dir():
                points = read_model(folder / place).points
                return Points(self.apply_transform(points.xyz), points.rgb, points.track_length)
        return join_points([])

    def apply_transform(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points of the COLMAP model in the world of the poses."""
        matrix = _matrix(self.values["applied_transform"])
        scale = to_real(self.values.get("applied_scale", 1.0))
        if matrix is None or not np.isfinite(matrix).all() or scale is None or not 0 < scale < MAX_NUMBER:
            raise InputError(f"{self.path}: applied_transform must be 3 x 4 numbers and applied_scale above 0")
        return scale * (xyz @ matrix[:3, :3].T + matrix[:3, 3])


def _matrix(value: Any) -> NDArray[np.float64] | None:
    """Return nested lists of 4 x 4 or 3 x 4 numbers as a (4, 4) matrix; None for other values."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        return None
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    return matrix if matrix.shape == (4, 4) else None

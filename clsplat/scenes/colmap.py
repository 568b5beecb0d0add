"""COLMAP models through pycolmap: poses, lenses and points."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, reason_of
from .colmap_binary import check_binary_model, count_registered
from .undistort import RegisteredImage, colmap_library

_FILES = ("cameras", "images", "points3D")


@dataclass(frozen=True, eq=False)
class Points:
    """A structure-from-motion point cloud.

    Parameters
    ----------
    xyz : (P, 3) float64, world positions.
    rgb : (P, 3) uint8.
    track_length : (P,) int64, number of images that observe each point.
    """

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    track_length: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class SparseReconstruction:
    """A sparse model: registered photos sorted by name, and points."""

    photos: list[RegisteredImage]
    points: Points


def find_model(scene: Path) -> Path:
    """The model folder of a scene: `sparse` itself if it holds one, else the largest of `sparse/*`.

    Raises
    ------
    InputError : the scene has no COLMAP model.
    """
    if not scene.is_dir():
        raise InputError(f"{scene}: no such folder; give a scene folder with images/ and sparse/, or transforms.json")
    sparse = scene / "sparse"
    if not sparse.is_dir():
        raise InputError(
            f"{scene}: no folder 'sparse'; a scene needs a COLMAP model in sparse/0 "
            "(clsplat reconstruct makes one of photos), or a transforms.json"
        )
    candidates = [sparse, *sorted(folder for folder in sparse.iterdir() if folder.is_dir())]
    models = [folder for folder in candidates if _suffix(folder)]
    if not models:
        raise InputError(
            f"{sparse}: no COLMAP model (cameras and images, .bin or .txt) in it or below; "
            "run COLMAP's mapper, or copy the missing files"
        )
    return max(models, key=count_registered)  # the first of equals


def read_model(folder: Path) -> SparseReconstruction:
    """Read a binary or text model; missing points give an empty cloud.

    Raises
    ------
    InputError : missing, truncated or damaged files, or no registered image.
    """
    suffix = _suffix(folder)
    if not suffix:
        raise InputError(f"{folder}: cameras or images file is missing (.bin or .txt)")
    if suffix == ".bin":
        check_binary_model(folder)
    pycolmap = colmap_library()
    try:
        with _complete(folder, suffix) as whole:
            reconstruction = pycolmap.Reconstruction(str(whole))
        photos, points = read_registered(reconstruction), read_points(reconstruction)
    except (ValueError, IndexError, KeyError, RuntimeError, MemoryError, OSError) as error:
        raise InputError(
            f"{folder}: COLMAP's reader refuses the model ({reason_of(error)}); the files are "
            "damaged or do not belong together: copy or rebuild them"
        ) from None
    if not photos:
        raise InputError(f"{folder}: the model registers no image; rebuild it with COLMAP's mapper")
    bad = int((~np.isfinite(points.xyz)).any(axis=1).sum())
    if bad:
        raise InputError(
            f"{folder}: {bad} points have a position that is not finite; the points3D file is damaged: rebuild it"
        )
    return SparseReconstruction(photos, points)


def _suffix(folder: Path) -> str:
    """ ".bin" or ".txt" as pycolmap will choose, "" where the folder holds no model."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{stem}{suffix}").is_file() for stem in _FILES[:2]):
            return suffix
    return ""


@contextmanager
def _complete(folder: Path, suffix: str) -> Iterator[Path]:
    """The folder itself, or, as the library insists on a points file, a copy with an empty one."""
    if (folder / f"points3D{suffix}").is_file():
        yield folder
        return
    with tempfile.TemporaryDirectory() as temporary:
        whole = Path(temporary)
        for file in folder.glob(f"*{suffix}"):
            (whole / file.name).write_bytes(file.read_bytes())
        (whole / f"points3D{suffix}").write_bytes(bytes(8) if suffix == ".bin" else b"")
        yield whole


def read_registered(reconstruction: Any) -> list[RegisteredImage]:
    """Registered photos of a pycolmap.Reconstruction, sorted by name."""
    photos = []
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.images[image_id]
        pose = image.cam_from_world
        pose = pose() if callable(pose) else pose  # an attribute before pycolmap 3.12
        photos.append(
            RegisteredImage(
                image.name, np.vstack([pose.matrix(), [0.0, 0.0, 0.0, 1.0]]), reconstruction.cameras[image.camera_id]
            )
        )
    return sorted(photos, key=lambda photo: photo.name)


def read_points(reconstruction: Any) -> Points:
    """Points of a pycolmap.Reconstruction, by rising id."""
    found = reconstruction.points3D
    xyz, rgb = np.empty((len(found), 3)), np.empty((len(found), 3), np.uint8)
    track_length = np.empty(len(found), np.int64)
    for row, (_, point) in enumerate(sorted(found.items(), key=lambda item: item[0])):
        xyz[row], rgb[row], track_length[row] = point.xyz, point.color, point.track.length()
    return Points(xyz, rgb, track_length)

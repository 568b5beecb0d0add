"""COLMAP models, read through pycolmap: poses, lenses and points."""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.seen import sampled
from ..errors import InputError, reason_of
from ..splats.quaternions import rotations
from .colmap_binary import check_binary_model, count_registered
from .colmap_copies import complete_model, without_observations
from .colmap_faults import image_fault, text_fault
from .colmap_folder import colmap_folder, model_suffix, models_in
from .colmap_text import names_with_spaces, read_image_lines
from .scene_files import OTHER_KINDS
from .undistort import RegisteredImage, colmap_library

_LACKING = "does not exist"  # in pycolmap's message on a frame of an image that the model lacks
_UNIT = 1e-6  # largest error of the norm of a quaternion that pycolmap turns into a rotation as it is


@dataclass(frozen=True, eq=False)
class Points:
    """A structure-from-motion point cloud.

    Parameters
    ----------
    xyz : (P, 3) float64, positions in the world.
    rgb : (P, 3) uint8, colours.
    track_length : (P,) int64, number of images that observe each point.
    """

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    track_length: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.xyz)


NO_POINTS = Points(np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0, np.int64))


def few_of(points: Points) -> Points:
    """Return the points that `sampled` takes, without the others in memory."""
    return Points(sampled(points.xyz).copy(), sampled(points.rgb).copy(), sampled(points.track_length).copy())


@dataclass(frozen=True, eq=False)
class SparseReconstruction:
    """A COLMAP model: registered photos sorted by name, and points."""

    photos: list[RegisteredImage]
    points: Points


def find_model(scene: Path) -> Path:
    """Return the folder of a scene's COLMAP model.

    Among `sparse` and `sparse/*`, this is the model with the most registered images. Without `sparse` it is the one
    beside the photos.

    Raises
    ------
    InputError : the scene has no COLMAP model.
    """
    if not scene.is_dir():
        raise InputError(f"{scene}: no such folder; give a folder with images/ and sparse/, or {OTHER_KINDS}")
    sparse = colmap_folder(scene) or (scene if model_suffix(scene) else None)
    if sparse is None:
        raise InputError(
            f"{scene}: no folder 'sparse'; a scene needs a COLMAP model in sparse/0 (clsplat reconstruct makes one of "
            f"photos), or {OTHER_KINDS}"
        )
    if sparse == scene:
        return scene
    models = models_in(sparse)
    if not models:
        raise InputError(
            f"{sparse}: no COLMAP model (cameras and images, .bin or .txt) in this folder or below; "
            "run COLMAP's mapper, or copy the missing files"
        )
    return max(models, key=count_registered)  # max takes the first of equal models


def read_model(folder: Path) -> SparseReconstruction:
    """Read a binary or text model. A missing file of points gives an empty point cloud.

    Raises
    ------
    InputError : a file is missing, truncated or damaged, or the model has no registered image.
    """
    with _opened(folder) as (reconstruction, names, tracks):
        photos = read_registered(reconstruction, names)
        lengths = {number: len(images) for number, images in tracks.items()}
        points = read_points(reconstruction, lengths or None)
    if not photos:
        raise InputError(f"{folder}: the model registers no image; rebuild it with COLMAP's mapper")
    bad = int((~np.isfinite(points.xyz)).any(axis=1).sum())
    if bad:
        raise InputError(
            f"{folder}: {bad} points have a position that is not finite; the points3D file is damaged: rebuild it"
        )
    return SparseReconstruction(photos, points)


def points_of_photos(folder: Path, photos: Collection[str], at_least: int) -> Points:
    """Return the points of a model that `at_least` of the named photos show, sorted by id.

    Raises
    ------
    InputError : as `read_model`.
    """
    with _opened(folder) as (reconstruction, names, tracks):
        images = {number for number, image in reconstruction.images.items() if names.get(number, image.name) in photos}
        tracks = tracks or {
            number: {element.image_id for element in point.track.elements}
            for number, point in reconstruction.points3D.items()
        }
        counts = {number: len(track & images) for number, track in tracks.items()}
        return read_points(reconstruction, {number: count for number, count in counts.items() if count >= at_least})


@contextmanager
def _opened(folder: Path) -> Iterator[tuple[Any, dict[int, str], dict[int, set[int]]]]:
    """Yield a pycolmap.Reconstruction, names that replace its own, and tracks that do so; the two may be empty.

    A track is the set of the ids of images that observe a point. Raise InputError if the model cannot be read.
    """
    suffix = model_suffix(folder)
    if not suffix:
        raise InputError(f"{folder}: cameras or images file is missing (.bin or .txt)")
    if suffix == ".bin":
        check_binary_model(folder)
    pycolmap = colmap_library()
    tracks: dict[int, set[int]] = {}
    try:
        images = folder / "images.txt"
        poses = [image.pose for image in read_image_lines(images, "replace")] if suffix == ".txt" else []
        if (fault := image_fault(images, poses)) is not None:
            raise InputError(fault)
        with complete_model(folder, suffix) as whole:
            try:
                reconstruction = pycolmap.Reconstruction(str(whole))
                reconstruction.reg_image_ids()  # pycolmap checks the frames here
            except (IndexError, ValueError) as error:
                if not isinstance(error, IndexError) and _LACKING not in str(error):
                    raise
                with without_observations(whole, suffix) as (bare, named):
                    reconstruction = pycolmap.Reconstruction(str(bare))
                known = set(reconstruction.images)
                tracks = {number: images & known for number, images in named.items()}
                warnings.warn(
                    f"{folder}: its points or frames name images or observations that the model lacks; they are left "
                    "out",
                    stacklevel=5,
                )
            yield reconstruction, names_with_spaces(poses), tracks
    except (ValueError, IndexError, KeyError, RuntimeError, MemoryError, OSError) as error:
        if suffix == ".txt" and (fault := text_fault(folder)) is not None:
            raise InputError(fault) from None
        raise InputError(
            f"{folder}: COLMAP cannot read the model ({reason_of(error)}); the files are "
            "damaged or do not belong together: copy or rebuild them"
        ) from None


def read_registered(reconstruction: Any, names: Mapping[int, str] | None = None) -> list[RegisteredImage]:
    """Return the registered photos of a pycolmap.Reconstruction, sorted by name.

    Parameters
    ----------
    names : names that replace those of the reconstruction, by image id.
    """
    photos, names = [], names or {}
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.images[image_id]
        pose = image.cam_from_world
        pose = pose() if callable(pose) else pose  # before pycolmap 3.12 this is an attribute
        name = names.get(image_id, image.name)
        matrix = np.vstack([_rigid(name, pose), [0.0, 0.0, 0.0, 1.0]])
        photos.append(RegisteredImage(name, matrix, reconstruction.cameras[image.camera_id]))
    return sorted(photos, key=lambda photo: photo.name)


def _rigid(name: str, pose: Any) -> NDArray[np.float64]:
    """Return a pycolmap.Rigid3d as a matrix, (3, 4); its quaternion may have any norm above 0."""
    quaternion = np.asarray(pose.rotation.quat, np.float64)
    largest = float(np.abs(quaternion).max())
    if not 0.0 < largest < math.inf or not np.isfinite(pose.translation).all():
        fault = "a quaternion of norm 0" if largest == 0.0 else "a pose that is not finite"
        raise InputError(f"image {name!r} has {fault}; rebuild the model, or remove the image from it")
    matrix: NDArray[np.float64] = pose.matrix()
    if abs(largest * float(np.linalg.norm(quaternion / largest)) - 1.0) > _UNIT:
        x, y, z, w = quaternion / largest
        matrix[:, :3] = rotations(np.array([[w, x, y, z]]))[0]
    return matrix


def read_points(reconstruction: Any, counts: Mapping[int, int] | None = None) -> Points:
    """Return the points of a pycolmap.Reconstruction, sorted by id.

    Parameters
    ----------
    counts : ids of the points to return, with the number of images that stands for the length of their tracks. None:
        all points.
    """
    points = reconstruction.points3D
    ids = sorted(points if counts is None else counts)
    xyz, rgb = np.empty((len(ids), 3)), np.empty((len(ids), 3), np.uint8)
    track_length = np.empty(len(ids), np.int64)
    for row, number in enumerate(ids):
        point = points[number]
        xyz[row], rgb[row] = point.xyz, point.color
        track_length[row] = point.track.length() if counts is None else counts[number]
    return Points(xyz, rgb, track_length)

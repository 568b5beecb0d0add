"""Scenes of pinhole images from a sparse model of distorted photos: undistorted photos and moved observations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...cameras.camera import Camera
from ...files.images import write_photo, write_png
from ...files.masks import MASK_FOLDER
from ..colmap import Points, read_points, read_registered
from ..colmap_binary import ModelView, write_binary_model
from ..undistort import RegisteredImage, colmap_library
from .photo_files import StagedPhoto


class SparseModel:
    """A sparse model that COLMAP's mapper wrote.

    Parameters
    ----------
    folder : the model's folder.
    """

    def __init__(self, folder: Path) -> None:
        self._model = colmap_library().Reconstruction(str(folder))
        self._photos = {photo.name: photo for photo in read_registered(self._model)}
        self._images = {image.name: image for image in self._model.images.values()}
        self._rows = {number: row for row, number in enumerate(sorted(self._model.points3D))}

    @property
    def names(self) -> set[str]:
        """Names of the registered photos."""
        return set(self._photos)

    @property
    def points(self) -> Points:
        """Points with positions, colours and track lengths."""
        return read_points(self._model)

    @property
    def errors(self) -> NDArray[np.float64]:
        """Mean reprojection error of each point [px], (P,)."""
        return np.array([self._model.points3D[number].error for number in self._rows])

    def photo(self, name: str) -> RegisteredImage:
        """Return a registered photo with its lens."""
        return self._photos[name]

    def view(self, name: str, camera: Camera, scene_name: str) -> ModelView:
        """Return a photo as a view of a pinhole camera, with its observations moved to that camera [px].

        Observations that the pinhole camera cannot see are dropped.
        """
        observed = [(point.xy, self._rows[point.point3D_id]) for point in self._images[name].get_observation_points2D()]
        lens = self._photos[name].lens
        rays = np.asarray(lens.cam_from_img(np.array([xy for xy, _ in observed]).reshape(-1, 2))).reshape(-1, 2)
        kept = np.isfinite(rays).all(axis=1)
        pixels = rays[kept] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        return ModelView(
            scene_name,
            (camera.width, camera.height),
            (camera.fx, camera.fy, camera.cx, camera.cy),
            camera.cam_from_world,
            pixels,
            np.array([row for _, row in observed], np.int64)[kept],
        )


def write_undistorted_photo(model: SparseModel, photo: StagedPhoto, scene: Path) -> ModelView:
    """Write a registered photo and its mask undistorted into the scene's folders, and return its view.

    Raises
    ------
    InputError : the file has changed, or the lens has no pinhole image.
    OutputError : a file cannot be written.
    """
    registered, pixels = model.photo(photo.staged), photo.pixels()
    height, width = pixels.shape[:2]
    undistorted, camera = registered.fit(np.ascontiguousarray(pixels[:, :, :3]))
    if pixels.shape[2] == 4:
        undistorted = np.dstack([undistorted, registered.fit_alpha(pixels[:, :, 3])])
    mask = photo.mask()
    write_photo(scene / "images" / photo.source.name, undistorted)
    if mask is not None:
        write_png(
            scene / MASK_FOLDER / f"{photo.source.name}.png",
            np.where(registered.fit_mask(mask, width, height), 255, 0).astype(np.uint8),
        )
    return model.view(photo.staged, camera, photo.source.name)


def write_undistorted_model(model: SparseModel, views: Sequence[ModelView], scene: Path) -> None:
    """Write sparse/0 of the scene with cameras, poses, points and tracks; raises OutputError."""
    points = model.points
    write_binary_model(scene / "sparse" / "0", views, points.xyz, points.rgb, model.errors)

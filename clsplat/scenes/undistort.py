"""Lenses, and undistortion of registered images to pinhole images, as COLMAP does it through pycolmap."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..errors import InputError, reason_of

# This import loads Pillow before pycolmap (see images.py). For the same reason functions import pycolmap late.
from ..files import images as _images
from ..files.masks import resize_mask
from ..files.stop_signals import kept_from_libraries

Lens = Any  # a pycolmap.Camera

_PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
# Perspective models that are pinholes if every distortion coefficient is 0.
_DISTORTED_PINHOLES = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """A registered image: its file name inside the images folder, its pose and its lens.

    Parameters
    ----------
    name : file name as COLMAP stores it, with `/` between folders.
    cam_from_world : (4, 4) world-to-camera pose.
    lens : camera of a pycolmap model, or result of `make_lens`.
    """

    name: str
    cam_from_world: NDArray[np.float64]
    lens: Lens

    def fit(self, image: _images.ImageU8) -> tuple[_images.ImageU8, Camera]:
        """Return the photo as a pinhole image, and its camera.

        The lens is scaled to the image, because folders such as images_2 and images_4 hold reduced photos. A distorted
        photo is undistorted with the defaults of COLMAP's image_undistorter: focal lengths stay, and the border is
        cropped or widened so that no pixel is blank.

        Parameters
        ----------
        image : (H, W, 3) uint8, the photo as stored.

        Raises
        ------
        InputError : the image has another aspect ratio than the camera, or the lens has no pinhole image.
        """
        height, width = image.shape[:2]
        lens = _scaled(self.lens, width, height, self.name)
        if not is_pinhole(lens):
            image, lens = _undistorted(image, lens, self.name)
        return image, self._camera(lens)

    def fitted_camera(self, width: int, height: int) -> Camera:
        """Return the camera of the image that `fit` makes of a photo of this size [px]; raises as `fit`."""
        lens = _scaled(self.lens, width, height, self.name)
        return self._camera(lens if is_pinhole(lens) else _pinhole_of(lens, self.name))

    def _camera(self, lens: Lens) -> Camera:
        try:
            return pinhole_camera(lens, self.cam_from_world, lens.width, lens.height)
        except InputError as error:
            raise InputError(f"image {self.name!r}: {error}; rebuild the model") from None

    def fit_alpha(self, alpha: _images.ImageU8) -> _images.ImageU8:
        """Return the photo's opacity, (H, W) as stored, moved as `fit` moves its pixels; raises as `fit`."""
        if is_pinhole(self.lens):
            return alpha
        return self.fit(np.repeat(alpha[:, :, None], 3, axis=2))[0][:, :, 0].copy()

    def fit_mask(self, mask: NDArray[np.bool_], width: int, height: int) -> NDArray[np.bool_]:
        """Return a mask of the photo as a mask of the image that `fit` returns.

        Each pixel takes the value of the nearest mask pixel; pixels outside the photo are False.

        Parameters
        ----------
        mask : (h, w) bool, True for pixels that count, of the photo's size or reduced.
        width, height : size of the photo as stored, before `fit` [px].

        Returns
        -------
        (H, W) bool, of the size of `fit`'s image.

        Raises
        ------
        InputError : the mask has another aspect ratio than the photo, or `fit` would raise.
        """
        rows, columns = mask.shape
        if not _images.same_aspect((columns, rows), (width, height)):
            raise InputError(
                f"image {self.name!r}: its mask is {columns}x{rows} px, the photo {width}x{height}; "
                "make the mask as large as the photo"
            )
        lens = _scaled(self.lens, width, height, self.name)
        if is_pinhole(lens):
            return resize_mask(mask, width, height)
        across, down = _seen_from(_pinhole_of(lens, self.name), lens)
        # Bilinear interpolation leaves the image blank outside the outermost pixel centres. Rays that no pixel sees
        # are NaN.
        inside = (across >= 0.5) & (across <= width - 0.5) & (down >= 0.5) & (down <= height - 0.5)
        fitted = np.zeros(inside.shape, bool)
        row, column = down[inside] * (rows / height), across[inside] * (columns / width)
        fitted[inside] = mask[row.astype(int), column.astype(int)]
        return fitted


def make_lens(model: str, width: int, height: int, params: list[float]) -> Lens:
    """Return a lens by COLMAP's model name and parameters: focal lengths and centre [px], then distortion."""
    return colmap_library().Camera(model=model, width=width, height=height, params=params)


def brown_lens(
    width: int, height: int, core: Sequence[float], radial: Sequence[float], tangential: Sequence[float]
) -> Lens:
    """Return the lens of the Brown-Conrady model, as OpenCV writes it.

    Parameters
    ----------
    core : focal lengths fx, fy and centre cx, cy [px].
    radial : k1, k2, k3, or k1 to k6: from k4 on they are the coefficients of OpenCV's denominator.
    tangential : p1, p2.
    """
    k1, k2, k3, *below = radial
    return make_lens("FULL_OPENCV", width, height, [*core, k1, k2, *tangential, k3, *(below or [0.0, 0.0, 0.0])])


def pinhole_camera(lens: Lens, cam_from_world: NDArray[np.float64], width: int, height: int) -> Camera:
    """Return the camera of an undistorted lens for images of this size [px]; raises as `Camera`."""
    return Camera(
        width,
        height,
        lens.focal_length_x,
        lens.focal_length_y,
        lens.principal_point_x,
        lens.principal_point_y,
        cam_from_world,
    )


def colmap_library() -> ModuleType:
    """Import pycolmap without its log messages; its errors reach the user as exceptions."""
    with kept_from_libraries():
        import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    return pycolmap


def _scaled(lens: Any, width: int, height: int, name: str) -> Any:
    """Return the lens for an image of this size [px]; raises InputError for another aspect ratio."""
    if not np.isfinite(lens.params).all():
        raise InputError(f"image {name!r}: its camera has a parameter that is not finite; rebuild the model")
    if not _images.same_aspect((width, height), (lens.width, lens.height)):
        raise InputError(
            f"image {name!r} is {width}x{height} px but its camera {lens.width}x{lens.height}; "
            "use the photos that the model was made from, whole, and turned as its poses are"
        )
    scaled = copy.copy(lens)
    if (width, height) != (lens.width, lens.height):
        scaled.rescale(width, height)
    return scaled


def is_pinhole(lens: Any) -> bool:
    """Return whether photos of this lens are pinhole images already."""
    kind = lens.model.name
    if kind in _PINHOLES:
        return True
    return kind in _DISTORTED_PINHOLES and not np.any(np.asarray(lens.params)[list(lens.extra_params_idxs())])


def _undistorted(image: _images.ImageU8, lens: Any, name: str) -> tuple[_images.ImageU8, Any]:
    _pinhole_of(lens, name)
    pycolmap = colmap_library()
    try:
        bitmap, pinhole = pycolmap.undistort_image(
            pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(np.ascontiguousarray(image)), lens
        )
    except (ValueError, RuntimeError, MemoryError) as error:
        raise _not_undistorted(lens, name, error) from None
    return np.ascontiguousarray(bitmap.to_array()), pinhole


def _pinhole_of(lens: Any, name: str) -> Any:
    """Return the pinhole lens of the image that `_undistorted` returns."""
    pycolmap = colmap_library()
    try:
        pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens)
    except (ValueError, RuntimeError, MemoryError) as error:
        raise _not_undistorted(lens, name, error) from None
    # pycolmap returns panoramas unchanged, and reading their focal length would abort the process.
    if pinhole.model.name != "PINHOLE":
        raise InputError(
            f"image {name!r}: the camera model {lens.model.name} has no pinhole image; "
            "make perspective views of it first"
        )
    return pinhole


def _not_undistorted(lens: Any, name: str, error: Exception) -> InputError:
    return InputError(
        f"image {name!r}: its {lens.model.name} camera cannot be undistorted "
        f"({reason_of(error)}); undistort the photos first"
    )


def _seen_from(pinhole: Any, lens: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where a lens sees the pixel centres of a pinhole camera: x and y [px], (H, W) each, NaN if unseen."""
    down, across = np.mgrid[: pinhole.height, : pinhole.width] + 0.5
    rays = np.stack(
        [
            (across - pinhole.principal_point_x) / pinhole.focal_length_x,
            (down - pinhole.principal_point_y) / pinhole.focal_length_y,
            np.ones(across.shape),
        ],
        axis=2,
    )
    seen = np.asarray(lens.img_from_cam(rays.reshape(-1, 3)), np.float64).reshape(*across.shape, 2)
    return seen[..., 0], seen[..., 1]

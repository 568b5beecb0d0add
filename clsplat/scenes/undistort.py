"""Lenses: photos with their poses, undistorted to pinhole images. Undistortion is COLMAP's, through pycolmap."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..errors import InputError, reason_of

# Before pycolmap on purpose (see images.py), hence also pycolmap only inside functions.
from ..files import images as _images
from ..files.masks import resize_mask

Lens = Any  # a pycolmap.Camera

_PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
# Perspective models that are a plain pinhole when every distortion coefficient is 0.
_DISTORTED_PINHOLES = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """A registered image: its file name inside the images folder, its pose and its lens.

    Parameters
    ----------
    name : as COLMAP stores it, with `/` between folders.
    cam_from_world : (4, 4) world-to-camera pose.
    lens : of the model, or of `make_lens`.
    """

    name: str
    cam_from_world: NDArray[np.float64]
    lens: Lens

    def fit(self, image: _images.ImageU8) -> tuple[_images.ImageU8, Camera]:
        """The photo as a pinhole image, and its camera.

        The lens is scaled to the image (folders images_2, images_4, ... hold reduced photos). A distorted
        photo is undistorted as COLMAP's image_undistorter does it by default: focal lengths kept, the border
        cropped or widened so that no pixel stays blank.

        Parameters
        ----------
        image : (H, W, 3) uint8, as stored.

        Raises
        ------
        InputError : the image has another aspect than the camera, or the lens has no pinhole image.
        """
        height, width = image.shape[:2]
        lens = _scaled(self.lens, width, height, self.name)
        if not is_pinhole(lens):
            image, lens = _undistorted(image, lens, self.name)
            height, width = image.shape[:2]
        try:
            return image, pinhole_camera(lens, self.cam_from_world, width, height)
        except InputError as error:
            raise InputError(f"image {self.name!r}: {error}; rebuild the model") from None

    def fit_alpha(self, alpha: _images.ImageU8) -> _images.ImageU8:
        """The photo's opacity, (H, W) as stored, where `fit` puts its pixels; raises what `fit` raises."""
        fitted: _images.ImageU8 = self.fit(np.repeat(alpha[:, :, None], 3, axis=2))[0][:, :, 0]
        return fitted

    def fit_mask(self, mask: NDArray[np.bool_], width: int, height: int) -> NDArray[np.bool_]:
        """A mask of the photo as a mask of `fit`'s image: the nearest pixel, False outside the photo.

        Parameters
        ----------
        mask : (h, w) bool, True where the photo counts; of the photo's size or a reduction of it.
        width, height : of the photo as stored, before `fit` [px].

        Returns
        -------
        (H, W) bool, of the size of `fit`'s image.

        Raises
        ------
        InputError : the mask has another aspect than the photo, or what `fit` raises.
        """
        rows, columns = mask.shape
        if not _images.same_aspect((columns, rows), (width, height)):
            raise InputError(
                f"image {self.name!r}: its mask is {columns}x{rows} px, the photo {width}x{height}; "
                "make the mask of the photo's size"
            )
        lens = _scaled(self.lens, width, height, self.name)
        if is_pinhole(lens):
            return resize_mask(mask, width, height)
        across, down = _seen_from(_pinhole_of(lens, self.name), lens)
        # Outside the outermost pixel centres the image is blank (bilinear); rays that no pixel sees are NaN.
        inside = (across >= 0.5) & (across <= width - 0.5) & (down >= 0.5) & (down <= height - 0.5)
        fitted = np.zeros(inside.shape, bool)
        row, column = down[inside] * (rows / height), across[inside] * (columns / width)
        fitted[inside] = mask[row.astype(int), column.astype(int)]
        return fitted


def make_lens(model: str, width: int, height: int, params: list[float]) -> Lens:
    """A lens by COLMAP's name of its model and its parameters [px, then distortion]."""
    return colmap_library().Camera(model=model, width=width, height=height, params=params)


def pinhole_camera(lens: Lens, cam_from_world: NDArray[np.float64], width: int, height: int) -> Camera:
    """The camera of a lens without distortion, for images of this size [px]; raises what Camera raises."""
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
    """pycolmap, silent: its errors reach the user as exceptions."""
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    library: ModuleType = pycolmap
    return library


def _scaled(lens: Any, width: int, height: int, name: str) -> Any:
    """The lens for an image of another size."""
    if not np.isfinite(lens.params).all():
        raise InputError(f"image {name!r}: its camera has a parameter that is not finite; rebuild the model")
    if not _images.same_aspect((width, height), (lens.width, lens.height)):
        raise InputError(
            f"image {name!r} is {width}x{height} px but its camera {lens.width}x{lens.height}; "
            "use the photos that the model was made from, whole and unrotated"
        )
    scaled = copy.copy(lens)
    if (width, height) != (lens.width, lens.height):
        scaled.rescale(width, height)
    return scaled


def is_pinhole(lens: Any) -> bool:
    """Whether its photos are pinhole images as they are."""
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
    """The camera that `_undistorted` will give."""
    pycolmap = colmap_library()
    try:
        pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens)
    except (ValueError, RuntimeError, MemoryError) as error:
        raise _not_undistorted(lens, name, error) from None
    # A panorama comes back as it was, and asking its camera for a focal length would end the process.
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
    """Where a lens puts the pixel centres of a pinhole camera: x and y [px], (H, W) each; NaN where nowhere."""
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

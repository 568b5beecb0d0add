"""Exact conversion between camera values of Blender and the pinhole of clsplat, without `bpy`.

Blender measures a camera in millimetres of the sensor and in shares of one side of the image, the *fitted* one. This is
the width for HORIZONTAL, the height for VERTICAL, and for AUTO the side that shows more of the world. AUTO always uses
the sensor width. Pixels have the aspect a = pixel_aspect_y / pixel_aspect_x. So the image is `width` by `a height` in
widths of a pixel. With `fitted` = width or a height:

    fx = lens / sensor * fitted        cx = width / 2 - shift_x fitted
    fy = fx / a                        cy = height / 2 + shift_y fitted / a
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.cameras.camera import Camera
from clsplat.cameras.path import cam_from_world_of, pose_of
from clsplat.errors import InputError

SENSOR = 36.0  # default sensor width of Blender [mm]
_KINDS = {"ORTHO": "orthographic", "PANO": "panoramic", "CUSTOM": "custom"}


@dataclass(frozen=True)
class Lens:
    """Values of a Blender camera with the names that Blender uses.

    Attributes
    ----------
    lens, sensor_width, sensor_height : focal length and sensor [mm]. sensor_fit : "AUTO", "HORIZONTAL" or "VERTICAL".
    shift_x, shift_y : shift to the right and up, as shares of the fitted side.
    type : "PERSP"; other types are refused.
    """

    lens: float = 50.0
    sensor_width: float = SENSOR
    sensor_height: float = 24.0
    sensor_fit: str = "AUTO"
    shift_x: float = 0.0
    shift_y: float = 0.0
    type: str = "PERSP"


@dataclass(frozen=True)
class Raster:
    """Size of the image [px] and aspect of its pixels, as in the output settings of Blender.

    Attributes
    ----------
    border : the visible part as left, bottom, right, top in shares of the image, or None for all.
    """

    width: int
    height: int
    pixel_aspect_x: float = 1.0
    pixel_aspect_y: float = 1.0
    border: tuple[float, float, float, float] | None = None

    @staticmethod
    def of_settings(
        resolution_x: int,
        resolution_y: int,
        percentage: int,
        pixel_aspect_x: float = 1.0,
        pixel_aspect_y: float = 1.0,
        border: tuple[float, float, float, float] | None = None,
    ) -> Raster:
        """Return the raster of the settings; sizes are rounded down, as Blender does."""
        return Raster(
            max(1, resolution_x * percentage // 100),
            max(1, resolution_y * percentage // 100),
            pixel_aspect_x,
            pixel_aspect_y,
            border,
        )

    @property
    def pixels(self) -> tuple[int, int, int, int]:
        """Left, bottom, right and top of the visible part, counted from below [px]."""
        if self.border is None:
            return 0, 0, self.width, self.height
        sides = np.array(self.border, np.float32) * np.array([self.width, self.height] * 2, np.float32)
        left, bottom, right, top = (int(side) for side in sides)  # in float32, as Blender rounds them
        return left, bottom, right, top


def camera_of(lens: Lens, raster: Raster, matrix_world: ArrayLike, name: str = "camera") -> Camera:
    """Return the pinhole of a Blender camera for the whole image.

    Parameters
    ----------
    matrix_world : (4, 4) camera to world, x right, y up, z back; its scale does not matter.
    name : for messages.

    Raises
    ------
    InputError : no perspective camera, or one with a sheared transform.
    """
    if lens.type != "PERSP":
        raise InputError(f"{name} is {_KINDS.get(lens.type, lens.type)}: set its type to Perspective")
    aspect = raster.pixel_aspect_y / raster.pixel_aspect_x
    wide = raster.width * raster.pixel_aspect_x >= raster.height * raster.pixel_aspect_y
    horizontal = wide if lens.sensor_fit == "AUTO" else lens.sensor_fit == "HORIZONTAL"
    sensor = lens.sensor_height if lens.sensor_fit == "VERTICAL" else lens.sensor_width
    fitted = raster.width if horizontal else aspect * raster.height
    fx = lens.lens / sensor * fitted
    cx = raster.width / 2 - lens.shift_x * fitted
    cy = raster.height / 2 + lens.shift_y * fitted / aspect
    pose = np.array(matrix_world, np.float64)
    if not np.linalg.det(pose[:3, :3]) > 0.0:
        raise InputError(f"{name}: its transform is mirrored or flat; set its scale above 0")
    pose[:3, :3] /= np.maximum(np.linalg.norm(pose[:3, :3], axis=0), 1e-30)
    try:
        return Camera(raster.width, raster.height, fx, fx / aspect, cx, cy, cam_from_world_of(pose))
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def camera_of_matrices(view: ArrayLike, projection: ArrayLike, width: int, height: int) -> Camera:
    """Return the pinhole of a viewport from world to view (4, 4) and the projection of OpenGL (4, 4).

    Raises
    ------
    InputError : an orthographic projection.
    """
    lens, pose = np.array(projection, np.float64), np.array(view, np.float64)
    if abs(lens[3, 2]) < 0.5:
        raise InputError("the view is orthographic: press 5 on the number pad for perspective")
    world = np.asarray(np.linalg.inv(pose), np.float64)
    world[:3, :3] /= np.linalg.norm(world[:3, :3], axis=0)
    # Clip x = (P00 x + P02 z) / -z runs from -1 to 1 over the width, y likewise, upwards.
    return Camera(
        width,
        height,
        lens[0, 0] * width / 2,
        lens[1, 1] * height / 2,
        (1 - lens[0, 2]) * width / 2,
        (1 + lens[1, 2]) * height / 2,
        cam_from_world_of(world),
    )


def lens_of(camera: Camera) -> tuple[Lens, tuple[float, float]]:
    """Return the Blender values of a pinhole, fitted to the width, and the pixel aspects x and y (the smaller is 1)."""
    aspect = camera.fx / camera.fy
    if math.isclose(aspect, 1.0, rel_tol=1e-6):
        aspect = 1.0
    lens = Lens(
        camera.fx * SENSOR / camera.width,
        SENSOR,
        SENSOR * camera.height / camera.width,
        "HORIZONTAL",
        0.5 - camera.cx / camera.width,
        (camera.cy - camera.height / 2) * aspect / camera.width,
    )
    return lens, (max(1.0, 1.0 / aspect), max(1.0, aspect))


def matrix_world_of(camera: Camera) -> NDArray[np.float64]:
    """Return the camera-to-world matrix (4, 4) with the axes of Blender."""
    return pose_of(camera)


def moved(camera: Camera, scale: float, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> Camera:
    """Return the camera that sees x as `camera` sees s R x + t; its depths are those of `camera` divided by s."""
    pose = np.eye(4)
    pose[:3, :3] = camera.rotation @ rotation
    pose[:3, 3] = (camera.rotation @ translation + camera.translation) / scale
    return camera.posed(pose)

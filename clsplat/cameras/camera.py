"""Pinhole cameras with OpenCV axes (x right, y down, z forward) and pixel centres at half-integers."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..files.json_file import describe_any


def is_rotation(matrix: NDArray[np.float64]) -> bool:
    """Return whether a (3, 3) matrix is a rotation, without mirroring or scale, to 1e-3."""
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() <= 1e-3 and np.linalg.det(matrix) >= 0)


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: intrinsics in pixels and a world-to-camera pose.

    Parameters
    ----------
    width, height : image size [px].
    fx, fy, cx, cy : focal lengths and principal point [px].
    cam_from_world : (4, 4) or (3, 4) rigid transform from the world to the camera.

    Raises
    ------
    InputError : a size is not a whole number of at least 1, or a focal length is not above 0. Or a value is not
        a finite number, or the pose is not a rotation and a translation.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    cam_from_world: NDArray[np.float64]

    def __init__(
        self, width: int, height: int, fx: float, fy: float, cx: float, cy: float, cam_from_world: ArrayLike
    ) -> None:
        for name, size in (("width", width), ("height", height)):
            if isinstance(size, bool) or not isinstance(size, Real) or not float(size).is_integer():
                raise InputError(f"camera: {name} is {describe_any(size)}; expected a whole number of pixels")
        if width < 1 or height < 1:
            raise InputError(f"camera: width x height is {width}x{height}; both must be at least 1")
        for name, real in (("fx", fx), ("fy", fy), ("cx", cx), ("cy", cy)):
            if isinstance(real, bool) or np.ndim(real) > 0 or not isinstance(real, Real | np.ndarray):
                raise InputError(f"camera: {name} is {describe_any(real)}; expected a number of pixels")
        intrinsics = np.array([fx, fy, cx, cy], dtype=np.float64)
        if not np.all(np.isfinite(intrinsics)) or fx <= 0 or fy <= 0:
            raise InputError(f"camera: fx={fx} fy={fy} cx={cx} cy={cy}; focal lengths must be above 0, all finite")
        try:
            pose = np.array(cam_from_world, dtype=np.float64)
        except (TypeError, ValueError):
            pose = np.zeros(0)
        if pose.shape == (3, 4):
            pose = np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])
        if pose.shape != (4, 4) or not np.all(np.isfinite(pose)):
            raise InputError("camera: cam_from_world must be a finite (4, 4) or (3, 4) matrix")
        if not is_rotation(pose[:3, :3]):
            raise InputError("camera: cam_from_world's left 3x3 block must be a rotation matrix")
        if np.abs(pose[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-3:
            raise InputError(f"camera: cam_from_world's last row is {pose[3].tolist()}; it must be 0, 0, 0, 1")
        pose.setflags(write=False)
        for name, value in zip(("width", "height"), (width, height), strict=True):
            object.__setattr__(self, name, int(value))
        for name, value in zip(("fx", "fy", "cx", "cy"), intrinsics, strict=True):
            object.__setattr__(self, name, float(value))
        object.__setattr__(self, "cam_from_world", pose)

    @property
    def rotation(self) -> NDArray[np.float64]:
        """World-to-camera rotation, (3, 3)."""
        return self.cam_from_world[:3, :3]

    @property
    def translation(self) -> NDArray[np.float64]:
        """World-to-camera translation, (3,)."""
        return self.cam_from_world[:3, 3]

    @property
    def position(self) -> NDArray[np.float64]:
        """Camera centre in the world, (3,)."""
        return -self.rotation.T @ self.translation

    def resized(self, width: int, height: int) -> Camera:
        """Return the same camera for an image of another size; the field of view stays."""
        sx, sy = width / self.width, height / self.height
        return Camera(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, self.cam_from_world)

    def at_most(self, longest: int) -> Camera:
        """Return the same camera for an image whose longest side is at most `longest` px."""
        factor = min(1.0, longest / max(self.width, self.height))
        return self.resized(max(round(factor * self.width), 1), max(round(factor * self.height), 1))

    def posed(self, cam_from_world: ArrayLike) -> Camera:
        """Return a camera with the same intrinsics at another pose."""
        return Camera(self.width, self.height, self.fx, self.fy, self.cx, self.cy, cam_from_world)

"""Cameras of browsers, and the resolution of their frames while they move."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError
from ..splats.optical_depth import MAX_COORDINATE
from ..splats.quaternions import NORM_FLOOR, rotations

MAX_FOV = math.radians(170.0)  # largest vertical field of view; beyond it every splat covers the image
MAX_WINDOW = 16384  # px

_STEP = 2.0**-0.25  # one step of the scale; two steps halve the number of pixels
_STEPS = 16  # the smallest frame has a sixteenth of the size


@dataclass(frozen=True)
class Pose:
    """The camera that a browser reports (OpenCV axes, camera to world), unchecked.

    Attributes
    ----------
    wxyz, position : rotation as a quaternion, and the centre.
    fov : vertical field of view [radians]. width, height : size of the window [px].
    """

    wxyz: Sequence[float]
    position: Sequence[float]
    fov: float
    width: int
    height: int


def window_of(pose: Pose, longest: int, enlarge: bool = False) -> tuple[int, int]:
    """Return (width, height) of a frame for the window, at most `longest` px; 1 x 1 if the window is unusable.

    Parameters
    ----------
    enlarge : make the longest side `longest` px also in a smaller window.
    """
    try:
        width, height = (min(max(int(side), 1), MAX_WINDOW) for side in (pose.width, pose.height))
    except (TypeError, ValueError, OverflowError):
        return 1, 1
    scale = longest / max(width, height)
    scale = scale if enlarge else min(1.0, scale)
    return max(round(scale * width), 1), max(round(scale * height), 1)


def camera_of(pose: Pose, longest: int, enlarge: bool = False) -> Camera | None:
    """Return the camera of a frame of at most `longest` px, or None if the pose is unusable.

    The frame has the whole field of view of the window, also if its sides are rounded. `enlarge` as for `window_of`.
    """
    try:
        width, height = window_of(pose, MAX_WINDOW)
        quat = np.asarray(pose.wxyz, np.float64).reshape(1, 4)
        position = np.asarray(pose.position, np.float64).reshape(3)
        if not 0.0 < pose.fov <= MAX_FOV or not NORM_FLOOR < math.hypot(*quat[0]) < 1 / NORM_FLOOR:
            return None
        if not np.abs(position).max() <= MAX_COORDINATE:  # this is False for a NaN
            return None
        to_world = rotations(quat)[0]
        focal = 0.5 * height / math.tan(0.5 * pose.fov)
        cam_from_world = np.concatenate([to_world.T, -to_world.T @ position[:, None]], axis=1)
        camera = Camera(width, height, focal, focal, width / 2, height / 2, cam_from_world)
        return camera.resized(*window_of(pose, longest, enlarge))
    except (InputError, TypeError, ValueError, OverflowError):
        return None


class AdaptiveResolution:
    """The scale of frames of a moving camera, so that each takes at most a given time.

    Parameters
    ----------
    seconds : time allowed for a frame.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.step = 4  # the first frame has half the size

    @property
    def scale(self) -> float:
        """Factor for the sides of a moving frame."""
        return _STEP**self.step

    def update(self, seconds: float) -> None:
        """Adapt the scale to the time that a frame took.

        The scale falls at once by the steps that the excess needs if time is proportional to pixels. It rises by one
        step at a time.
        """
        over = seconds / self.seconds
        if over > 1.0:
            self.step = min(self.step + math.ceil(2.0 * math.log2(over)), _STEPS)
        elif over < 0.6:
            self.step = max(self.step - 1, 0)

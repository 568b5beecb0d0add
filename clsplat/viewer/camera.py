"""Cameras of browsers as ours, and how large their pictures are while they move."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError
from ..splats.optical_depth import MAX_COORDINATE
from ..splats.quaternions import NORM_FLOOR, rotations

WIDEST = math.radians(170.0)  # vertical field of view; beyond, every splat covers the image
LARGEST_WINDOW = 16384  # px

_STEP = 2.0**-0.25  # of the scale while moving: each step down halves the pixels of two steps before
_STEPS = 16  # down to a sixteenth of the size


@dataclass(frozen=True)
class Pose:
    """What a browser tells of its camera (OpenCV axes, camera to world); nothing of it is checked.

    Attributes
    ----------
    wxyz, position : rotation as a quaternion, and the centre.
    fov : vertical [radians]. width, height : of its window [px].
    """

    wxyz: Sequence[float]
    position: Sequence[float]
    fov: float
    width: int
    height: int


def window_of(pose: Pose, longest: int) -> tuple[int, int]:
    """(width, height) of a picture for the pose's window, no longer than `longest` px; 1 x 1 where it has none."""
    try:
        width, height = (min(max(int(side), 1), LARGEST_WINDOW) for side in (pose.width, pose.height))
    except (TypeError, ValueError, OverflowError):
        return 1, 1
    scale = min(1.0, longest / max(width, height))
    return max(round(scale * width), 1), max(round(scale * height), 1)


def camera_of(pose: Pose, longest: int) -> Camera | None:
    """The camera for a picture no longer than `longest` px; None where the pose is none that can be looked from.

    The picture has the window's whole field of view, also where its sides are rounded.
    """
    try:
        width, height = window_of(pose, LARGEST_WINDOW)
        quat = np.asarray(pose.wxyz, np.float64).reshape(1, 4)
        position = np.asarray(pose.position, np.float64).reshape(3)
        if not 0.0 < pose.fov <= WIDEST or not NORM_FLOOR < np.linalg.norm(quat) < math.inf:
            return None
        if not np.abs(position).max() <= MAX_COORDINATE:  # also of a NaN
            return None
        to_world = rotations(quat)[0]
        focal = 0.5 * height / math.tan(0.5 * pose.fov)
        cam_from_world = np.concatenate([to_world.T, -to_world.T @ position[:, None]], axis=1)
        camera = Camera(width, height, focal, focal, width / 2, height / 2, cam_from_world)
        return camera.resized(*window_of(pose, longest))
    except (InputError, TypeError, ValueError, OverflowError):
        return None


class Pace:
    """How much smaller pictures are made while the camera moves, so that they keep coming.

    Parameters
    ----------
    seconds : that a picture may take.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.step = 4  # half the size to begin with: the first picture tells

    @property
    def scale(self) -> float:
        """Of a moving picture's sides."""
        return _STEP**self.step

    def took(self, seconds: float) -> None:
        """Told of the time that a picture at the present scale took.

        Down at once by as many steps as the time asks for, were it all pixels; up by one where there is room for it.
        """
        over = seconds / self.seconds
        if over > 1.0:
            self.step = min(self.step + math.ceil(2.0 * math.log2(over)), _STEPS)
        elif over < 0.6:
            self.step = max(self.step - 1, 0)

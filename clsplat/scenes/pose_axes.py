"""Poses in another convention than the file's: with other axes, or inverted.

OpenGL's cameras look along -z with y upwards, OpenCV's along z with y downwards. transforms.json has camera-to-world
poses of the first kind, a COLMAP model world-to-camera poses of the second. Poses that were taken for those of another
kind look like poses, but their cameras do not see the points.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..cameras.camera import Camera
from ..cameras.seen import mean_share_seen, sampled, sampled_views
from .colmap import Points

_FEW, _MANY = 0.05, 0.5  # of the points in an image, as the poses are, and in the other convention
_TURN = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenGL's axes to OpenCV's, and back
_AXES = "the y and z axes of their cameras turned around, as from OpenCV's to OpenGL's"
_INVERTED = "inverted poses, as from world-to-camera to camera-to-world"
# Words for a convention, and the matrices left and right of the pose or, if there is a right one, of its inverse.
_CONVENTIONS = (
    (_AXES, _TURN, None),
    (_INVERTED, _TURN, _TURN),
    (_INVERTED, np.eye(4), _TURN),
    (_INVERTED, np.eye(4), np.eye(4)),
)


def warn_of_convention(root: Path, points: Points, cameras: Sequence[Camera]) -> None:
    """Warn if the cameras see hardly any of the points, but many of them in another convention of poses."""
    some, xyz = sampled_views(cameras), sampled(points.xyz)
    share = mean_share_seen(some, xyz)
    if not some or share >= _FEW:
        return
    for words, left, right in _CONVENTIONS:
        others = [_turned(camera, left, right) for camera in some]
        if (other := mean_share_seen(others, xyz)) > _MANY:
            warnings.warn(
                f"{root}: a photo shows {share:.1%} of the points, but {other:.0%} with {words}: correct the poses",
                stacklevel=5,
            )
            return


def _turned(camera: Camera, left: np.ndarray, right: np.ndarray | None) -> Camera:
    """Return a camera with the pose left @ pose, or with left @ inverse of the pose @ right."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.rotation, camera.translation
    return camera.posed(left @ pose if right is None else left @ np.linalg.inv(pose) @ right)

"""Points in the image of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from .camera import Camera

_SAMPLED_POINTS, _SAMPLED_VIEWS = 2000, 32

T = TypeVar("T")
Number = TypeVar("Number", bound=np.generic)


class Seen(NamedTuple):
    """Where P points are in an image.

    Attributes
    ----------
    depth : (P,) camera z [world units].
    pixel : (P, 2) x and y [px]. They mean nothing for points that are not in front of the camera.
    inside : (P,) whether a point is in front of the camera and inside its image.
    """

    depth: NDArray[np.float64]
    pixel: NDArray[np.float64]
    inside: NDArray[np.bool_]

    @property
    def rows_and_columns(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns of the pixels in which the points are, of those inside: the index into an image."""
        column, row = self.pixel[self.inside].astype(np.int64).T
        return row, column


def seen(camera: Camera, xyz: NDArray[np.float64]) -> Seen:
    """Return where points (P, 3) in the world are in the image of a camera. Nothing hides them."""
    local = xyz @ camera.rotation.T + camera.translation
    depth = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = local[:, :2] / depth[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    inside: NDArray[np.bool_] = (depth > 0) & ((pixel >= 0) & (pixel < (camera.width, camera.height))).all(axis=1)
    return Seen(depth, pixel, inside)


def sampled(xyz: NDArray[Number], at_most: int = _SAMPLED_POINTS) -> NDArray[Number]:
    """Return at most 2000 (or `at_most`) of the points (P, ...), evenly spread: enough for what holds for all."""
    return xyz[:: -(-len(xyz) // at_most) or 1]


def sampled_views(views: Sequence[T]) -> Sequence[T]:
    """Return at most 32 of the views or photos, evenly spread in their order: enough for what holds for all of them."""
    return views[:: -(-len(views) // _SAMPLED_VIEWS) or 1]


def mean_share_seen(cameras: Sequence[Camera], xyz: NDArray[np.float64]) -> float:
    """Return the share of points (P, 3) in the image of a camera, 0 to 1, as a mean over cameras; 1 without points."""
    return float(np.mean([seen(camera, xyz).inside.mean() for camera in cameras])) if len(xyz) else 1.0

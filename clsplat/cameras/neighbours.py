"""Cameras that look at the same place from nearby."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .camera import Camera

_TURN = np.pi / 18  # that counts as much as the usual distance to the nearest camera [rad]


def nearest_cameras(cameras: Sequence[Camera], count: int) -> NDArray[np.int64]:
    """Return the indices of the cameras that are nearest to each, in position and viewing direction, (N, count).

    A turn of the optical axis by 10 degrees counts as much as the median distance of a camera to the nearest other.
    Rolls do not count.

    Parameters
    ----------
    cameras : none, or more than `count`.
    """
    if not cameras:
        return np.empty((0, count), np.int64)
    positions = np.stack([camera.position for camera in cameras])
    axes = np.stack([camera.rotation[2] for camera in cameras])
    distances = np.asarray(cKDTree(positions).query(positions, k=2)[0])
    usual = float(np.median(distances[:, 1]))
    # Without a distance, as on a tripod, only the directions differ.
    coordinates = np.hstack([positions, (usual / _TURN if usual else 1.0) * axes])
    found = np.asarray(cKDTree(coordinates).query(coordinates, k=count + 1)[1], np.int64)
    # Cameras in one place are equally near: a camera is not always the first one of its own row.
    is_own = found == np.arange(len(cameras))[:, None]
    is_own[~is_own.any(axis=1), -1] = True
    return found[~is_own].reshape(len(cameras), count)

"""Cameras between those of neighbouring photos."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from .camera import Camera

_NEIGHBOURS = 2  # of each camera, by position
_PLACES = (1 / 3, 2 / 3)  # of the way from one camera to the other
_LARGEST_TURN = 2 * np.pi / 3  # between two cameras; others look at different things


def between(cameras: Sequence[Camera]) -> list[Camera]:
    """Return cameras on the ways from each camera to its two nearest ones.

    Positions are on the straight line, and rotations on the shortest arc. Intrinsics and size are those of one of the
    two. Pairs whose rotations differ by more than 120 degrees are left out.
    """
    if len(cameras) < 2:
        return []
    positions = np.stack([camera.position for camera in cameras])
    _, nearest = cKDTree(positions).query(positions, k=min(_NEIGHBOURS + 1, len(cameras)))  # itself and the others
    rows = np.atleast_2d(nearest).tolist()
    pairs = {(min(one, other), max(one, other)) for one, row in enumerate(rows) for other in row if one != other}
    found = []
    for first, second in sorted(pairs):
        ends = Rotation.from_matrix(np.stack([cameras[first].rotation, cameras[second].rotation]))
        if (ends[0].inv() * ends[1]).magnitude() > _LARGEST_TURN:
            continue
        for place, rotation in zip(_PLACES, Slerp((0, 1), ends)(_PLACES).as_matrix(), strict=True):
            pose = np.eye(4)
            pose[:3, :3] = rotation
            pose[:3, 3] = -rotation @ ((1 - place) * positions[first] + place * positions[second])
            found.append(cameras[first].posed(pose))
    return found

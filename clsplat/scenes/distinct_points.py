"""Points in one place, as in files whose coordinates were rounded, and in clouds that were joined twice.

Copies say nothing about the scene. Whoever counts or samples points would take them for parts of it.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..splats.fields import DoubleArray

if TYPE_CHECKING:
    from .colmap import Points  # loads Pillow, which would slow down --help

_MANY = 0.2  # part of the points that are copies: COLMAP's models have up to a sixteenth, which changes nothing


def without_copies(root: Path, points: Points) -> Points:
    """Return the points, or the first of each place and a warning if many are copies."""
    apart = distinct(points.xyz)
    if len(apart) >= (1.0 - _MANY) * len(points):
        return points
    warnings.warn(
        f"{root}: only {len(apart)} of its {len(points)} points are in different places: one of each place is used; "
        "check that their coordinates have enough digits",
        stacklevel=4,
    )
    return replace(points, xyz=points.xyz[apart], rgb=points.rgb[apart], track_length=points.track_length[apart])


def distinct(xyz: DoubleArray) -> NDArray[np.int64]:
    """Return the indices of the first point in each place, in rising order.

    Parameters
    ----------
    xyz : positions (P, 3).
    """
    if len(xyz) < 2:
        return np.arange(len(xyz))
    # Few points share an x, which one fast sort shows. Only these are compared in all coordinates.
    by_x = np.argsort(xyz[:, 0], kind="stable")
    x = xyz[by_x, 0]
    equal = np.concatenate([[False], x[1:] == x[:-1], [False]])
    shared = np.sort(by_x[equal[1:] | equal[:-1]])
    order = shared[np.lexsort(xyz[shared].T)]
    same = np.zeros(len(xyz), np.bool_)
    same[order[1:]] = (xyz[order[1:]] == xyz[order[:-1]]).all(axis=1)  # lexsort is stable: the first comes first
    return np.flatnonzero(~same)

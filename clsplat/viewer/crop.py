"""A box that hides the splats outside of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..splats.fields import Array, DoubleArray
from ..splats.quaternions import NORM_FLOOR, rotations

# The first box is wider by a share of its size on each side than these quantiles of the coordinates. So stray splats do
# not stretch it, and few others are outside.
_QUANTILES, _MARGIN = (0.05, 0.95), 0.25
_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_EDGES = [(i, j) for i in range(8) for j in range(i) if np.abs(_CORNERS[i] - _CORNERS[j]).sum() == 1.0]


@dataclass(frozen=True)
class CropBox:
    """A box in the world of the splats.

    Attributes
    ----------
    centre : its middle. wxyz : rotation from its axes to the world's. size : lengths of its edges, above 0.
    """

    centre: tuple[float, float, float]
    wxyz: tuple[float, float, float, float]
    size: tuple[float, float, float]

    @classmethod
    def of(cls, centre: ArrayLike, wxyz: ArrayLike, size: ArrayLike) -> CropBox:
        """Return a box of values that a browser sent. Raises InputError if they are not a box."""
        try:
            values = [np.asarray(part, np.float64).reshape(n) for part, n in ((centre, 3), (wxyz, 4), (size, 3))]
        except (TypeError, ValueError):
            raise InputError("box: its values are not numbers") from None
        if not all(np.isfinite(part).all() for part in values):
            raise InputError("box: its values are not finite")
        if not (values[2] > 0.0).all() or not np.linalg.norm(values[1]) > NORM_FLOOR:
            raise InputError("box: its size is not above 0")
        (x, y, z), (w, i, j, k), (a, b, c) = (part.tolist() for part in values)
        return cls((x, y, z), (w, i, j, k), (a, b, c))

    @property
    def axes(self) -> DoubleArray:
        """Unit vectors along the edges, as the columns of (3, 3)."""
        return np.asarray(rotations(np.array([self.wxyz]))[0], np.float64)

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Return whether each point (N, 3) is inside, (N,)."""
        local = (points.astype(np.float64) - self.centre) @ self.axes
        return np.asarray((np.abs(local) <= 0.5 * np.asarray(self.size)).all(axis=1), np.bool_)


def unit_edges() -> DoubleArray:
    """Return the edges of a box of size 1 about the origin, (12, 2, 3)."""
    return np.array([(_CORNERS[i], _CORNERS[j]) for i, j in _EDGES])


def box_around(points: Array, up: DoubleArray) -> CropBox:
    """Return an upright box around nearly all points (N, 3).

    Parameters
    ----------
    up : direction of its third axis.
    """
    third = np.asarray(up, np.float64) / np.linalg.norm(up)
    first = np.eye(3)[int(np.argmin(np.abs(third)))]
    first = first - (first @ third) * third
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(third, first), third], axis=1)
    local = points.astype(np.float64).reshape(-1, 3) @ axes
    low, high = np.quantile(local, _QUANTILES, axis=0) if len(local) else (-np.ones(3), np.ones(3))
    size = (1.0 + 2.0 * _MARGIN) * np.maximum(high - low, 1e-3 * max(float((high - low).max()), 1e-3))
    return CropBox.of(axes @ (0.5 * (low + high)), quaternion_of(axes), size)


def quaternion_of(matrix: DoubleArray) -> DoubleArray:
    """Return the unit quaternion (4,) of a rotation matrix (3, 3): an eigenvector (Bar-Itzhack 2000)."""
    m = np.asarray(matrix, np.float64)
    trace = np.trace(m)
    turn = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    system = np.empty((4, 4))
    system[0, 0], system[0, 1:], system[1:, 0] = trace, turn, turn
    system[1:, 1:] = m + m.T - trace * np.eye(3)
    return np.asarray(np.linalg.eigh(system)[1][:, -1], np.float64)

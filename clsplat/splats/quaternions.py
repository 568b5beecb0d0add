"""Quaternions w, x, y, z with any norm above 0: their rotation matrices, their gradient and other forms of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .fields import Array

NORM_FLOOR = 1e-15  # lower bound of |q|, as in cl/math/algebra.clh
OTHER_PLACES = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the places that are not the largest


def rotations(quat: Array) -> Array:
    """Return the rotation matrices (N, 3, 3) of quaternions (N, 4), with the same dtype."""
    w, x, y, z = _unit(quat)[0].T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    matrices: Array = np.empty((len(quat), 3, 3), quat.dtype)
    for i, row in enumerate(rows):
        for j, column in enumerate(row):
            matrices[:, i, j] = column
    return matrices


def of_rotations(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit quaternions (N, 4) of rotation matrices (N, 3, 3)."""
    from scipy.spatial.transform import Rotation  # lazy: a slow import

    if len(matrices) == 0:
        return np.empty((0, 4))
    return Rotation.from_matrix(matrices).as_quat()[:, [3, 0, 1, 2]]


def from_smallest_three(others: NDArray[np.float64], largest: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return unit quaternions (N, 4), from which many formats leave the largest component out.

    Parameters
    ----------
    others : (N, 3) the other components, in their order.
    largest : (N,) place of the largest component, 0 to 3.
    """
    quat = np.empty((len(others), 4))
    np.put_along_axis(quat, OTHER_PLACES[largest], others, axis=1)
    # If the three others are at their maximum, rounding can make the largest negative under the root.
    quat[np.arange(len(quat)), largest] = np.sqrt(np.maximum(1.0 - np.sum(others**2, axis=1), 0.0))
    return quat


def rotations_vjp(quat: Array, v: Array) -> Array:
    """Return the gradient (N, 4) of the raw quaternions, given the gradient v (N, 3, 3) of the matrices."""
    unit, norm = _unit(quat)
    w, x, y, z = unit.T
    sums, gaps = v + v.transpose(0, 2, 1), v - v.transpose(0, 2, 1)
    xy, xz, yz = sums[:, 0, 1], sums[:, 0, 2], sums[:, 1, 2]
    zy, xz_gap, yx = gaps[:, 2, 1], gaps[:, 0, 2], gaps[:, 1, 0]
    v_unit = 2 * np.stack(
        [
            x * zy + y * xz_gap + z * yx,
            w * zy + y * xy + z * xz - 2 * x * (v[:, 1, 1] + v[:, 2, 2]),
            w * xz_gap + x * xy + z * yz - 2 * y * (v[:, 0, 0] + v[:, 2, 2]),
            w * yx + x * xz + y * yz - 2 * z * (v[:, 0, 0] + v[:, 1, 1]),
        ],
        axis=1,
    )
    along = np.sum(unit * v_unit, axis=1, keepdims=True)
    return (v_unit - along * unit) / norm


def to_rodrigues(quat: Array) -> Array:
    """Return the modified Rodrigues parameters (N, 3) of quaternions: (x, y, z) / (1 + w) with |q| = 1 and w >= 0."""
    unit = _unit(quat)[0]
    unit = np.where(unit[:, :1] < 0.0, -unit, unit)
    parameters: Array = unit[:, 1:] / (1.0 + unit[:, :1])
    return parameters


def from_rodrigues(parameters: Array) -> Array:
    """Return the unit quaternions (N, 4) of modified Rodrigues parameters (N, 3)."""
    square = np.sum(parameters**2, axis=1, keepdims=True)
    quat: Array = np.concatenate([1.0 - square, 2.0 * parameters], axis=1) / (1.0 + square)
    return quat


def _unit(quat: Array) -> tuple[Array, Array]:
    """Return normalised quaternions (N, 4) and the norms (N, 1)."""
    norm = np.maximum(np.linalg.norm(quat, axis=1, keepdims=True), quat.dtype.type(NORM_FLOOR))
    return quat / norm, norm

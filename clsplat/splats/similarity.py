"""Rotation, uniform scale and translation of the arrays of splats."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from .fields import Array, DoubleArray, sh_coefficients, sh_degree_of
from .harmonics import sh_basis
from .quaternions import of_rotations

_DIRECTIONS = 64  # directions in which a band of harmonics is sampled; a band has at most 7 functions
_TOLERANCE = 1e-4  # deviation of a matrix from a rotation times a scale; float32 transforms deviate by 1e-6


def similarity(matrix: ArrayLike) -> tuple[float, DoubleArray, DoubleArray]:
    """Return scale s, rotation R (3, 3) and translation t (3,) of a (4, 4) matrix x -> s R x + t.

    Raises
    ------
    InputError : the axes have different scales, are sheared or mirrored, or have no length.
    """
    transform = np.asarray(matrix, np.float64)
    linear = transform[:3, :3]
    lengths = np.linalg.norm(linear, axis=0)
    if not np.isfinite(transform).all() or lengths.min() <= 0:
        raise InputError("its transform has no size; set its scale above 0")
    scale = float(np.cbrt(np.prod(lengths)))
    if lengths.max() - lengths.min() > _TOLERANCE * scale:
        shown = ", ".join(f"{length:.6g}" for length in lengths)
        raise InputError(f"its axes are scaled by {shown}; splats can only be scaled alike on all axes")
    rotation = linear / scale
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _TOLERANCE:
        raise InputError("its transform is sheared; splats can only be turned, moved and scaled alike on all axes")
    if np.linalg.det(rotation) < 0:
        raise InputError("its transform is mirrored; splats can only be turned, moved and scaled alike on all axes")
    left, _, right = np.linalg.svd(rotation)
    return scale, left @ right, transform[:3, 3].copy()


def moved(
    arrays: Mapping[str, Array], scale: float, rotation: DoubleArray, translation: DoubleArray
) -> dict[str, Array]:
    """Return public arrays of splats after x -> s R x + t, in their dtype; their colours turn with them.

    The fields of the shape do not change, as they are relative to the frame and the size of each splat.
    """
    w, x, y, z = of_rotations(rotation[None])[0]
    # The product from the left with (w, x, y, z); the other quaternion may have any norm.
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    changed = {
        "mean": scale * arrays["mean"] @ rotation.T + translation,
        "quat": arrays["quat"] @ left.T,
        "log_scale": arrays["log_scale"] + np.log(scale),
        "sh": turned_harmonics(arrays["sh"], rotation),
    }
    return dict(arrays) | {name: values.astype(arrays[name].dtype) for name, values in changed.items()}


def turned_harmonics(sh: Array, rotation: DoubleArray) -> Array:
    """Return the coefficients (N, K, 3) of colours turned by `rotation`: c'(R d) = c(d).

    Bands do not mix. The matrix of a band maps its values in sampled directions to its values in the directions turned
    back, exact up to rounding.
    """
    degree = sh_degree_of(sh.shape[1])
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    here, back = sh_basis(directions, degree), sh_basis(directions @ rotation, degree)
    turned = sh.astype(np.float64)
    for band in range(1, degree + 1):
        part = slice(sh_coefficients(band - 1), sh_coefficients(band))
        mixing = np.linalg.lstsq(here[:, part], back[:, part], rcond=None)[0]
        turned[:, part] = np.einsum("ij,njc->nic", mixing, turned[:, part])
    return turned.astype(sh.dtype)

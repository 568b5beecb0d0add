"""Closed forms of the reference renderer. test_formulas.py checks each of them by brute force.

Every function accepts complex arrays: comparisons use real parts only, and products never conjugate. An input
x + i h then gives f(x) + i h f'(x), so the derivative is exact up to rounding (Squire & Trapp 1998).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from clsplat.cameras.camera import Camera

Array = NDArray[Any]

CLAMP_MARGIN = 0.3  # bound of the tangents in the Jacobian only, as a multiple of tan(half the field of view)
SKEW_MAX = 0.985 * np.sqrt(2.0 / (np.pi - 2.0))
SLANT_MAX = 10.0


def normal_cdf(x: Array) -> Array:
    """Return Phi(x). For complex x this is the first-order expansion about the real part, for the complex step."""
    value: Array = ndtr(x.real)
    if np.iscomplexobj(x):
        density = np.exp(-0.5 * x.real**2) / np.sqrt(2.0 * np.pi)
        return value + 1j * x.imag * density
    return value


def peak(c: Array) -> Array:
    """Return the highest value of exp(-x²/2) Phi(sqrt(c) x) over x, for c >= 0.

    The mode is x = sqrt(c) r with r = phi(c r) / Phi(c r), between 0 and 2 phi(0). Bisection finds r.
    exp(-c r²/2) Phi(c r) is stationary in r, so its derivative in c does not need that of r (envelope theorem).
    """
    real_c = c.real
    low, high = np.zeros_like(real_c), np.full_like(real_c, 0.8)
    for _ in range(60):
        r = 0.5 * (low + high)
        below = r * ndtr(real_c * r) < np.exp(-0.5 * (real_c * r) ** 2) / np.sqrt(2.0 * np.pi)
        low, high = np.where(below, r, low), np.where(below, high, r)
    return np.exp(-0.5 * c * r * r) * normal_cdf(c * r)


def rotation(quat: Array) -> Array:
    """Return the (B, 3, 3) rotations of (B, 4) quaternions w, x, y, z of any norm above 0."""
    w, x, y, z = np.moveaxis(quat / np.sqrt((quat * quat).sum(-1, keepdims=True)), -1, 0)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def sh_basis(direction: Array, degree: int) -> Array:
    """Return (B, (degree + 1)²) real spherical harmonics of unit vectors (B, 3), with 3DGS's signs and order."""
    x, y, z = np.moveaxis(direction, -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    root = np.sqrt(np.array([1, 3, 15, 5, 15, 35 / 2, 105, 21 / 2, 7, 105]) / np.pi)
    c = root * np.array([1 / 2, 1 / 2, 1 / 2, 1 / 4, 1 / 4, 1 / 4, 1 / 2, 1 / 4, 1 / 4, 1 / 4])
    bands = [
        [c[0] * np.ones_like(x)],
        [-c[1] * y, c[1] * z, -c[1] * x],
        [c[2] * x * y, -c[2] * y * z, c[3] * (2 * zz - xx - yy), -c[2] * x * z, c[4] * (xx - yy)],
        [
            -c[5] * y * (3 * xx - yy),
            c[6] * x * y * z,
            -c[7] * y * (4 * zz - xx - yy),
            c[8] * z * (2 * zz - 3 * xx - 3 * yy),
            -c[7] * x * (4 * zz - xx - yy),
            c[9] * z * (xx - yy),
            -c[5] * x * (xx - 3 * yy),
        ],
    ]
    return np.stack([value for band in bands[: degree + 1] for value in band], -1)


def jacobian(point: Array, camera: Camera) -> Array:
    """Return the (B, 2, 3) derivative of the pinhole projection at camera points (B, 3) [px], with clamped tangents."""
    x, y, z = np.moveaxis(point, -1, 0)
    tangents = []
    for tangent, size, focal, centre in (
        (x / z, camera.width, camera.fx, camera.cx),
        (y / z, camera.height, camera.fy, camera.cy),
    ):
        margin = CLAMP_MARGIN * 0.5 * size / focal
        low, high = -(centre / focal + margin), (size - centre) / focal + margin
        tangents.append(np.where(tangent.real < low, low, np.where(tangent.real > high, high, tangent)))
    zero = np.zeros_like(z)
    rows = [
        np.stack([camera.fx / z, zero, -camera.fx * tangents[0] / z], -1),
        np.stack([zero, camera.fy / z, -camera.fy * tangents[1] / z], -1),
    ]
    return np.stack(rows, -2)


def bounded(skew: Array, largest: float = SKEW_MAX) -> Array:
    """Return the (B, 3) skew vectors. Vectors longer than `largest` are scaled down to that length."""
    squared = (skew * skew).sum(-1, keepdims=True)
    long = squared.real > largest**2
    return np.where(long, skew * (largest / np.sqrt(np.where(long, squared, 1.0))), skew)


def direct_form(covariance: Array, shift: Array) -> tuple[Array, Array]:
    """Return the scale matrix (B, 3, 3) and skew displacement (B, 3) of a skew-normal, from its moments.

    mean = location + sqrt(2/pi) delta and covariance = scale matrix - (2/pi) delta delta'. `shift` (B, 3) is
    mean - location.
    """
    return covariance + shift[..., :, None] * shift[..., None, :], np.sqrt(np.pi / 2.0) * shift


def slope_of(scale2d: Array, delta: Array) -> tuple[Array, Array]:
    """Return slope (B, 2) and c = slope' scale2d slope (B,), from the 2D scale matrix and skew displacement."""
    weighted = np.einsum("...ij,...j->...i", inverse_2x2(scale2d), delta)
    k = (weighted * delta).sum(-1)
    return weighted / np.sqrt(1.0 - k)[..., None], k / (1.0 - k)


def determinant(matrix: Array) -> Array:
    """Return the determinants (B,) of (B, 2, 2) symmetric matrices."""
    return matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] ** 2


def inverse_2x2(matrix: Array) -> Array:
    """Return the inverses of (B, 2, 2) symmetric matrices."""
    a, b, c = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    rows = [np.stack([c, -b], -1), np.stack([-b, a], -1)]
    return np.stack(rows, -2) / determinant(matrix)[..., None, None]

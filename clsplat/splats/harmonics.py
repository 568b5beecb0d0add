"""Real spherical harmonics up to degree 3 in NumPy, with the basis and signs of 3DGS and cl/math/harmonics.clh."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

SH_C0 = 0.28209479177387814  # the constant harmonic, 1 / (2 sqrt(pi))


def sh_basis(direction: NDArray[Any], degree: int) -> NDArray[Any]:
    """Return the basis (N, (degree + 1)^2) in unit directions (N, 3), with the same dtype."""
    x, y, z = direction.T
    xx, yy, zz = x * x, y * y, z * z
    bands = [
        [np.full_like(x, SH_C0)],
        [-0.48860251190291992 * y, 0.48860251190291992 * z, -0.48860251190291992 * x],
        [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.54627421529603959 * (xx - yy),
        ],
        [
            -0.59004358992664352 * y * (3 * xx - yy),
            2.8906114426405540 * x * y * z,
            -0.45704579946446577 * y * (4 * zz - xx - yy),
            0.37317633259011546 * z * (2 * zz - 3 * (xx + yy)),
            -0.45704579946446577 * x * (4 * zz - xx - yy),
            1.4453057213202770 * z * (xx - yy),
            -0.59004358992664352 * x * (xx - 3 * yy),
        ],
    ]
    return np.stack([values for band in bands[: degree + 1] for values in band], axis=1)


def axis_flip_signs(signs: NDArray[Any], degree: int) -> NDArray[np.float64]:
    """Return the factors (K,), 1 or -1, of coefficients when axes change their signs.

    Each function of the basis is odd or even in each of x, y and z. One direction without zeros shows which.

    Parameters
    ----------
    signs : (3,) the sign of each axis, 1 or -1.
    """
    direction = np.array([[0.36, 0.48, 0.8]])
    return np.sign(sh_basis(direction * signs, degree) / sh_basis(direction, degree))[0]

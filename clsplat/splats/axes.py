"""Signs of coordinate axes: the same splats with some of their axes turned round.

A PLY of splats has the axes RDF: x right, y down, z forward. Other formats prescribe other axes.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .fields import Array, sh_degree_of
from .harmonics import axis_flip_signs

Signs = tuple[int, int, int]  # 1 or -1 for x, y and z

LUF: Signs = (-1, -1, 1)  # x left, y up, z forward: glTF
RUB: Signs = (1, -1, -1)  # x right, y up, z back: USD, as its cameras look along -z


def flipped(arrays: Mapping[str, Array], signs: Signs) -> dict[str, Array]:
    """Return public arrays of splats with other signs of their axes.

    A vector in the frame of a splat, such as the skew, changes its signs too.

    arrays : public arrays by field name, all of one real type.
    """
    factors = np.array(signs, arrays["mean"].dtype)
    degree = sh_degree_of(arrays["sh"].shape[1])
    # The rotation R becomes F R F with the flips F. The covariance F R F S² F Rᵀ F is the flipped one, because S is
    # diagonal. A component of the axis of rotation changes its sign with the two other axes.
    changed = {
        "mean": arrays["mean"] * factors,
        "quat": arrays["quat"] * np.array([1, *factors.prod() * factors], factors.dtype),
        "sh": arrays["sh"] * axis_flip_signs(factors, degree)[:, None].astype(factors.dtype),
    }
    changed |= {name: arrays[name] * factors for name in ("skew", "normal") if name in arrays}
    return dict(arrays) | changed

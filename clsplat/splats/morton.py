"""Morton order: neighbours in space become neighbours in memory, which helps the caches of the device."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BITS = 10  # bits for each axis


def morton_order(mean: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the indices of points (N, 3) along a Z-order curve (Morton 1966).

    Each axis is divided by rank into 2^10 parts with equal numbers of points. So distant points do not make the grid
    too coarse for the others. Ties keep their order.
    """
    code = np.zeros(len(mean), np.uint32)
    for axis in range(3):
        rank = np.empty(len(mean), np.int64)
        rank[np.argsort(mean[:, axis], kind="stable")] = np.arange(len(mean))
        part = (rank * (1 << _BITS) // max(len(mean), 1)).astype(np.uint32)
        for bit in range(_BITS):
            code |= ((part >> np.uint32(bit)) & np.uint32(1)) << np.uint32(3 * bit + axis)
    return np.argsort(code, kind="stable")

"""Splats in an order in which neighbours in space are neighbours in memory: caches of the device like it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BITS = 10  # of each axis


def morton_order(mean: NDArray[np.floating]) -> NDArray[np.int64]:
    """Indices of points (N, 3) along a Z-order curve (Morton 1966).

    Each axis is cut by rank into 2^10 parts with as many points each, so that far points leave near ones their
    detail. Ties keep their order.
    """
    code = np.zeros(len(mean), np.uint32)
    for axis in range(3):
        rank = np.empty(len(mean), np.int64)
        rank[np.argsort(mean[:, axis], kind="stable")] = np.arange(len(mean))
        part = (rank * (1 << _BITS) // max(len(mean), 1)).astype(np.uint32)
        for bit in range(_BITS):
            code |= ((part >> np.uint32(bit)) & np.uint32(1)) << np.uint32(3 * bit + axis)
    return np.argsort(code, kind="stable")

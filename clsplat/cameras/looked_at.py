"""What cameras look at together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .camera import Camera

# Least eigenvalue of the mean of I - d d' below which the optical axes d count as parallel (about 4 degrees).
_PARALLEL = 5e-3


def where_axes_meet(cameras: Sequence[Camera]) -> NDArray[np.float64] | None:
    """(3,) the point nearest to all optical axes; None where they are parallel."""
    centres = np.array([camera.position for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.mean(axis=0)
    if np.linalg.eigvalsh(system)[0] <= _PARALLEL:
        return None
    return np.asarray(np.linalg.solve(system, np.einsum("nij,nj->i", across, centres) / len(cameras)), np.float64)

"""`.splat` files, as viewers in the browser read them: 32 bytes a splat, no header, Gaussians of one colour each.

    float32 x, y, z     float32 scale x, y, z (linear)     uint8 red, green, blue, opacity     uint8 w, x, y, z

A quaternion's component c is 128 + 128 c, to whole numbers. The most important splats (volume times opacity) come
first, because viewers show what has arrived.
"""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_writer
from .errors import InputError
from .shapes import GAUSSIAN
from .splats import SH_C0, Splats

RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("quaternion", "u1", 4)])


def write_splat(path: str | os.PathLike[str], splats: Splats) -> None:
    """Write Gaussians; their SH bands above 0 are left out.

    Raises
    ------
    InputError : another shape than the Gaussian. OutputError : cannot be written.
    """
    if splats.shape != GAUSSIAN.name:
        raise InputError(f"{path}: .splat files hold Gaussians, not {splats.shape} splats; convert them first")
    with atomic_writer(path) as stream:
        stream.write(records(splats).tobytes())


def records(splats: Splats) -> NDArray[np.void]:
    """(N,) of RECORD, the most important first."""
    opacity: NDArray[np.float64] = GAUSSIAN.opacity(splats.opacity_logit.astype(np.float64)).astype(np.float64)
    scale = np.exp(np.clip(splats.log_scale.astype(np.float64), -80.0, 80.0))
    quat = splats.quat.astype(np.float64)
    unit = np.asarray(quat / np.linalg.norm(quat, axis=1, keepdims=True), np.float64)
    table = np.empty(len(splats), RECORD)
    table["position"], table["scale"] = splats.mean, scale
    table["colour"][:, :3] = _bytes(0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64), 255.0)
    table["colour"][:, 3] = _bytes(opacity, 255.0)
    table["quaternion"] = _bytes(0.5 + 0.5 * unit, 256.0)
    return table[np.argsort(-scale.prod(axis=1) * opacity, kind="stable")]


def _bytes(values: NDArray[np.float64], factor: float) -> NDArray[np.uint8]:
    rounded: NDArray[np.uint8] = np.clip(np.rint(factor * values), 0, 255).astype(np.uint8)
    return rounded

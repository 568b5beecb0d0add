"""`.splat` files for browser viewers: 32 bytes for each Gaussian of one colour, without a header.

    float32 x, y, z     float32 scale x, y, z (linear)     uint8 red, green, blue, opacity     uint8 w, x, y, z

A quaternion component c is stored as 128 + 128 c, rounded. The most important splats (volume times opacity) come first,
because viewers show the splats that have arrived.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...files.atomic import atomic_writer
from ..fields import scale_of
from ..harmonics import SH_C0
from ..shapes import GAUSSIAN
from ..stored import StoredSplats, check_gaussian, gaussians

RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("quaternion", "u1", 4)])


def write_splat(path: str | os.PathLike[str], splats: StoredSplats) -> None:
    """Write Gaussians without their SH bands above 0.

    Raises
    ------
    InputError : the shape is not Gaussian. OutputError : the file cannot be written.
    """
    check_gaussian(path, splats.shape, ".splat")
    with atomic_writer(path) as stream:
        stream.write(records(splats).tobytes())


def read_splat(path: str | os.PathLike[str]) -> StoredSplats:
    """Read Gaussians of SH degree 0.

    Raises
    ------
    InputError : the file cannot be read, has a wrong length, or most of its splats are unusable.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check name and rights") from None
    if len(data) % RECORD.itemsize:
        raise InputError(
            f"{path}: is not a .splat file ({len(data)} bytes is not a multiple of {RECORD.itemsize}); export it again"
        )
    table = np.frombuffer(data, RECORD)
    with np.errstate(all="ignore"):  # `gaussians` treats values that are not finite
        arrays = {
            "mean": table["position"],
            "log_scale": np.log(table["scale"]),
            "quat": table["quaternion"] / 128.0 - 1.0,
            "opacity_logit": GAUSSIAN.raw_opacity(table["colour"][:, 3] / 255.0),
            "sh": ((table["colour"][:, :3] / 255.0 - 0.5) / SH_C0)[:, None],
        }
    return gaussians(path, arrays)


def records(splats: StoredSplats) -> NDArray[np.void]:
    """Return (N,) values of RECORD, the most important splats first."""
    wide = {name: values.astype(np.float64) for name, values in splats.arrays.items()}
    opacity: NDArray[np.float64] = GAUSSIAN.opacity(wide["opacity_logit"]).astype(np.float64)
    scale = scale_of(wide["log_scale"])
    unit = np.asarray(wide["quat"] / np.linalg.norm(wide["quat"], axis=1, keepdims=True), np.float64)
    table = np.empty(len(opacity), RECORD)
    table["position"], table["scale"] = wide["mean"], scale
    table["colour"][:, :3] = _bytes(0.5 + SH_C0 * wide["sh"][:, 0], 255.0)
    table["colour"][:, 3] = _bytes(opacity, 255.0)
    table["quaternion"] = _bytes(0.5 + 0.5 * unit, 256.0)
    return table[np.argsort(-scale.prod(axis=1) * opacity, kind="stable")]


def _bytes(values: NDArray[np.float64], factor: float) -> NDArray[np.uint8]:
    return np.clip(np.rint(factor * values), 0, 255).astype(np.uint8)

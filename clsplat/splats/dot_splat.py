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

from ..errors import InputError
from ..files.atomic import atomic_writer
from .shapes import GAUSSIAN
from .splats import SH_C0, Splats

RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("quaternion", "u1", 4)])

_LOGIT_MAX = 15.0  # the logit of a stored opacity of 255; its negative is that of 0
_MIN_SCALE = 1e-30  # some files have zeros


def write_splat(path: str | os.PathLike[str], splats: Splats) -> None:
    """Write Gaussians without their SH bands above 0.

    Raises
    ------
    InputError : the shape is not Gaussian. OutputError : the file cannot be written.
    """
    if splats.shape != GAUSSIAN.name:
        raise InputError(f"{path}: .splat files hold Gaussians, not {splats.shape} splats; convert them first")
    with atomic_writer(path) as stream:
        stream.write(records(splats).tobytes())


def read_splat(path: str | os.PathLike[str]) -> Splats:
    """Read Gaussians of SH degree 0.

    Raises
    ------
    InputError : the file cannot be read, has a wrong length, or holds an unusable value.
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
    with np.errstate(all="ignore"):  # the check finds and names values that are not finite
        logit = np.clip(GAUSSIAN.raw_opacity(table["colour"][:, 3] / 255.0), -_LOGIT_MAX, _LOGIT_MAX)
        arrays = {
            "mean": table["position"],
            "log_scale": np.log(np.maximum(table["scale"], _MIN_SCALE)),
            "quat": table["quaternion"] / 128.0 - 1.0,
            "opacity_logit": logit,
            "sh": ((table["colour"][:, :3] / 255.0 - 0.5) / SH_C0)[:, None],
        }
    try:
        return Splats(GAUSSIAN.name, {name: values.astype(np.float32) for name, values in arrays.items()})
    except InputError as error:
        raise InputError(f"{path}: {error}; remove that splat or export again") from None


def records(splats: Splats) -> NDArray[np.void]:
    """Return (N,) values of RECORD, the most important splats first."""
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
    return np.clip(np.rint(factor * values), 0, 255).astype(np.uint8)

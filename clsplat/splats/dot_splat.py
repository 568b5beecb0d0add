"""`.splat` files, as viewers in the browser read them: 32 bytes a splat, no header, Gaussians of one colour each.

    float32 x, y, z     float32 scale x, y, z (linear)     uint8 red, green, blue, opacity     uint8 w, x, y, z

A quaternion's component c is 128 + 128 c, to whole numbers. The most important splats (volume times opacity) come
first, because viewers show what has arrived.
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

_LOGIT_MAX = 15.0  # of an opacity of 0 or 255
_LEAST_SCALE = 1e-30  # some files have zeros


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


def read_splat(path: str | os.PathLike[str]) -> Splats:
    """The Gaussians of a file, of SH degree 0.

    Raises
    ------
    InputError : cannot be read, no whole number of splats, or an unusable value.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check name and rights") from None
    if len(data) % RECORD.itemsize:
        raise InputError(
            f"{path}: is no .splat file ({len(data)} bytes, no multiple of {RECORD.itemsize}); export it again"
        )
    table = np.frombuffer(data, RECORD)
    with np.errstate(all="ignore"):  # what is not finite is found and named by the check
        logit = np.clip(GAUSSIAN.raw_opacity(table["colour"][:, 3] / 255.0), -_LOGIT_MAX, _LOGIT_MAX)
        arrays = {
            "mean": table["position"],
            "log_scale": np.log(np.maximum(table["scale"], _LEAST_SCALE)),
            "quat": table["quaternion"] / 128.0 - 1.0,
            "opacity_logit": logit,
            "sh": ((table["colour"][:, :3] / 255.0 - 0.5) / SH_C0)[:, None],
        }
    try:
        return Splats(GAUSSIAN.name, {name: values.astype(np.float32) for name, values in arrays.items()})
    except InputError as error:
        raise InputError(f"{path}: {error}; remove that splat or export again") from None


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

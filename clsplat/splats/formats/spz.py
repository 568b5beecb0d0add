"""`.spz` files: Gaussians with quantised attributes. spz_streams.py describes their containers.

Format: https://github.com/nianticlabs/spz, "File Format".

    position   3 x 24-bit signed fixed point; version 1: 3 half floats
    opacity    1 byte, 0 to 255
    colour     3 bytes, 127.5 + 38.25 f_dc
    scale      3 bytes, 16 (10 + natural log)
    rotation   4 bytes: 2 bits name the largest of x, y, z, w; 10 bits each, sign and size, for the others
               versions 1 and 2: 3 bytes, 127.5 + 127.5 c for x, y, z, with a positive w
    SH         bands above 0, one byte for each coefficient and channel, the channels of a coefficient side by side:
               128 + 128 c, in steps of 2 (band 1) or 4

The format leaves the steps to the writer. Steps of 8 and 16 are usual, but they change the image too much
(docs/decisions.md).

The axes are RUB: x right, y up, z back. Those of a PLY are RDF: x right, y down, z forward. So y and z change their
signs here, and with them the harmonics that are odd in y and z together.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError, named_place
from ...files.atomic import atomic_writer
from ..axes import flipped
from ..fields import MAX_SH_DEGREE, Array, sh_coefficients, sh_degree_of
from ..quaternions import OTHER_PLACES, from_smallest_three
from ..shapes import GAUSSIAN
from ..stored import StoredSplats, check_gaussian, gaussians
from .spz_streams import (
    ANTIALIASED,
    GZIP_VERSION,
    RUB,
    ZSTD_VERSION,
    Bytes,
    SpzHeader,
    read_container,
    write_container,
)

VERSIONS = (GZIP_VERSION, ZSTD_VERSION)  # that are written, the default first

_MAX_FIXED = (1 << 23) - 1  # the largest fixed-point position
_SCALES = (-10.0 - 0.5 / 16, 255.5 / 16 - 10.0)  # logarithms of the scales that a byte holds
_MEAN_ROUNDING = 0.25  # of a step: the mean error of a rounded position
_MOVED = 0.1  # of the median size: positions that are rounded more than this are warned of
_FRACTION_BITS = 20  # the most that are used; positions then reach 8 units
_FINE, _COARSE = 2, 4  # quantisation steps of SH band 1 and of the others
_RDF = 6  # the coordinate system of a PLY
_FLIPPED_SYSTEMS = range(1, 9)  # systems that differ by signs of axes only; one less, its bits are x, y and z


def write_spz(path: str | os.PathLike[str], splats: StoredSplats, version: int = VERSIONS[0]) -> None:
    """Write Gaussians with as many fraction bits as the farthest position allows.

    Raises
    ------
    InputError : the shape is not Gaussian, the version is not 3 or 4, or a position is beyond 8 million units; or
        version 4 needs Zstandard, which is not installed.
    OutputError : the file cannot be written.

    Warns
    -----
    UserWarning : the sizes of some splats are clipped, or a far splat leaves few digits for the positions of all.
    """
    check_gaussian(path, splats.shape, ".spz")
    if version not in VERSIONS:
        raise InputError(f"{path}: version {version} of .spz is not written: choose {VERSIONS[0]} or {VERSIONS[1]}")
    arrays = _other_axes(splats.arrays, RUB)
    farthest = float(np.abs(arrays["mean"]).max(initial=0.0))
    if farthest > _MAX_FIXED:
        raise InputError(
            f"{path}: a splat lies {farthest:.3g} units away, .spz files reach {_MAX_FIXED}: remove it, or write a .ply"
        )
    bits = min(_FRACTION_BITS, math.floor(math.log2(_MAX_FIXED / max(farthest, 1e-30))))
    _warn_of_sizes(path, arrays["log_scale"])
    _warn_of_places(path, arrays["log_scale"], farthest, 2.0**-bits)
    degree = sh_degree_of(arrays["sh"].shape[1])
    header = SpzHeader(version, len(arrays["mean"]), degree, bits, ANTIALIASED * splats.antialiased)
    parts: list[NDArray[Any]] = [
        _positions(arrays["mean"], bits),
        _bytes(255.0 * GAUSSIAN.opacity(arrays["opacity_logit"].astype(np.float64))),
        _bytes(127.5 + 38.25 * arrays["sh"][:, 0].astype(np.float64)),
        _bytes(16.0 * (10.0 + arrays["log_scale"].astype(np.float64))),
        _rotations(arrays["quat"]),
        _harmonics(arrays["sh"][:, 1:]),
    ]
    with named_place(str(path)):
        data = write_container(header, [part.tobytes() for part in parts])
    with atomic_writer(path) as stream:
        stream.write(data)


def _warn_of_places(
    path: str | os.PathLike[str], log_scale: NDArray[np.floating], farthest: float, step: float
) -> None:
    """Warn if rounded positions move splats by a part of their size. The farthest splat decides the step.

    step : distance of two positions that the file holds [world units].
    """
    if not len(log_scale):
        return
    size = math.exp(np.median(np.clip(log_scale.max(axis=1), *_SCALES)))
    if _MEAN_ROUNDING * step > _MOVED * size:
        warnings.warn(
            f"{path}: a splat lies {farthest:.3g} units away, so .spz holds positions in steps of {step:.2g} units, "
            f"and half of the splats are smaller than {size:.2g}: remove far splats (clsplat clean), or write a .ply "
            "or a .sog",
            stacklevel=3,
        )


def _warn_of_sizes(path: str | os.PathLike[str], log_scale: NDArray[np.floating]) -> None:
    """Warn of splats whose size the file cannot hold: a scale is too large, or all three are too small."""
    clipped = (log_scale > _SCALES[1]).any(axis=1) | (log_scale < _SCALES[0]).all(axis=1)
    if clipped.any():
        low, high = np.exp(_SCALES)
        warnings.warn(
            f"{path}: {clipped.mean():.1%} of the splats are smaller or larger than .spz holds ({low:.2g} to "
            f"{high:.3g} units): their sizes are clipped; write a .ply or a .sog",
            stacklevel=3,
        )


def read_spz(path: str | os.PathLike[str]) -> StoredSplats:
    """Read Gaussians from a file of version 1 to 4. SH band 4 is left out, with a warning.

    Raises
    ------
    InputError : the file cannot be read, is damaged, or has another version; or most of its splats are unusable.
    """
    path = Path(path)
    header, (places, opacity, colour, scale, rotation, rest) = read_container(path)
    if header.coordinate_system not in _FLIPPED_SYSTEMS:
        raise InputError(f"{path}: coordinate system {header.coordinate_system} is not read; write it with axes RUB")
    if header.degree > MAX_SH_DEGREE:
        warnings.warn(f"{path}: left out SH bands above {MAX_SH_DEGREE}", stacklevel=2)
    degree = min(header.degree, MAX_SH_DEGREE)
    bands = rest.reshape(header.count, sh_coefficients(header.degree) - 1, 3)[:, : sh_coefficients(degree) - 1]
    with np.errstate(divide="ignore"):  # the logits of 0 and 255 are infinite, which `gaussians` replaces
        logit = GAUSSIAN.raw_opacity(opacity[:, 0] / 255.0)
    arrays = {
        "mean": _places(places, header),
        "quat": _quaternions(rotation),
        "log_scale": scale / 16.0 - 10.0,
        "opacity_logit": logit,
        "sh": np.concatenate([(colour[:, None] - 127.5) / 38.25, (bands - 128.0) / 128.0], axis=1),
    }
    return gaussians(path, _other_axes(arrays, header.coordinate_system), bool(header.flags & ANTIALIASED))


def _other_axes(arrays: Mapping[str, Array], system: int) -> dict[str, Array]:
    """Return the arrays with the axes of a PLY exchanged for those of another coordinate system, or the other way."""
    differing = (system - 1) ^ (_RDF - 1)
    x, y, z = (-1 if differing >> axis & 1 else 1 for axis in range(3))
    return flipped(arrays, (x, y, z))


def _places(stored: Bytes, header: SpzHeader) -> NDArray[np.float64]:
    """Return positions (N, 3)."""
    if header.version == 1:
        return stored.view("<f2").astype(np.float64)
    wide = np.zeros((len(stored), 3, 4), np.uint8)
    wide[..., 1:] = stored.reshape(-1, 3, 3)
    fixed = wide.view("<i4")[..., 0] >> 8
    return fixed / 2.0**header.fraction_bits


def _quaternions(stored: Bytes) -> NDArray[np.float64]:
    """Return quaternions (N, 4) as w, x, y, z."""
    if stored.shape[1] == 3:
        xyz = stored / 127.5 - 1.0
        return np.column_stack([np.sqrt(np.maximum(1.0 - np.sum(xyz**2, axis=1), 0.0)), xyz])
    packed = stored.view("<u4")[:, 0]
    fields = np.stack([packed >> 20, packed >> 10, packed], axis=1) & 1023
    others = (fields & 511) * np.where(fields & 512, -1.0, 1.0) / (511.0 * math.sqrt(2.0))
    return from_smallest_three(others, (packed >> 30).astype(np.int64))[:, [3, 0, 1, 2]]


def _bytes(values: NDArray[np.floating]) -> Bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _positions(mean: NDArray[np.floating], bits: int) -> Bytes:
    """Return positions as (N, 3, 3) bytes, the low byte first."""
    fixed = np.rint(mean.astype(np.float64) * 2.0**bits).astype("<i4")
    return np.ascontiguousarray(fixed[..., None].view(np.uint8)[..., :3])


def _rotations(quat: NDArray[np.floating]) -> NDArray[np.uint32]:
    """Return (N,) packed rotations: the index of the largest component, then the others with a positive largest one."""
    xyzw = quat.astype(np.float64)[:, [1, 2, 3, 0]]
    xyzw /= np.linalg.norm(xyzw, axis=1, keepdims=True)
    largest = np.abs(xyzw).argmax(axis=1)
    rows = np.arange(len(xyzw))
    xyzw *= np.where(xyzw[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = np.take_along_axis(xyzw, OTHER_PLACES[largest], axis=1)
    sizes = np.minimum(np.rint(511.0 * math.sqrt(2.0) * np.abs(others)), 511).astype(np.uint32)
    fields = sizes | (others < 0).astype(np.uint32) << 9
    index = largest.astype(np.uint32) << 30
    return (index | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]).astype("<u4")


def _harmonics(rest: NDArray[np.floating]) -> Bytes:
    """Return quantised coefficients (N, K - 1, 3) of the bands above 0."""
    step = np.where(np.arange(rest.shape[1]) < 3, _FINE, _COARSE)[:, None]
    return _bytes(step * np.rint((128.0 + 128.0 * rest.astype(np.float64)) / step))

"""`.spz` files of version 3: quantised Gaussians, compressed with gzip.

Format: https://github.com/nianticlabs/spz, "File Format". The header has 16 bytes: magic, version, number of splats, SH
degree, number of fraction bits of a position, flags, 0. Each attribute follows for all splats:

    position   3 x 24-bit signed fixed point        opacity   1 byte, 0 to 255
    colour     3 bytes, 127.5 + 38.25 f_dc          scale     3 bytes, 16 (10 + natural log)
    rotation   4 bytes: 2 bits name the largest of x, y, z, w; 10 bits each, sign and size, for the others
    SH         bands above 0, one byte for each coefficient and channel: 128 + 128 c, in steps of 2 (band 1) or 4

The format leaves the steps to the writer. Steps of 8 and 16 are usual, but they change the image too much
(docs/decisions.md).

The axes are those of the PLY file, as splat-transform of PlayCanvas and Spark read and write them. The authors of the
format assume that y points up and z towards the viewer; the world of a capture has no such axes.
"""

from __future__ import annotations

import gzip
import math
import os
import struct
import zlib
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.atomic import atomic_writer
from .fields import MAX_SH_DEGREE, sh_coefficients
from .shapes import GAUSSIAN
from .splats import Splats

Bytes = NDArray[np.uint8]

_HEADER = struct.Struct("<IIIBBBB")
_MAGIC, _VERSION = 0x5053474E, 3
_ANTIALIASED = 1  # flag
_MAX_FIXED = (1 << 23) - 1  # the largest fixed-point position
_FRACTION_BITS = 20  # the most that are used; positions then reach 8 units
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the components that are not the largest
_LOGIT_MAX = 15.0  # the logit of a stored opacity of 255; its negative is that of 0
_MAX_GZIP_RATIO = 1100  # above the limit of gzip, 1032
_FINE, _COARSE = 2, 4  # quantisation steps of SH band 1 and of the others


def write_spz(path: str | os.PathLike[str], splats: Splats) -> None:
    """Write Gaussians with as many fraction bits as the farthest position allows.

    Raises
    ------
    InputError : the shape is not Gaussian, or a position is beyond 8 million units. OutputError : the file cannot be
        written.
    """
    if splats.shape != GAUSSIAN.name:
        raise InputError(f"{path}: .spz files hold Gaussians, not {splats.shape} splats; convert them first")
    farthest = float(np.abs(splats.mean).max(initial=0.0))
    if farthest > _MAX_FIXED:
        raise InputError(
            f"{path}: a splat lies {farthest:.3g} units away, .spz files reach {_MAX_FIXED}: remove it, or write a .ply"
        )
    bits = min(_FRACTION_BITS, math.floor(math.log2(_MAX_FIXED / max(farthest, 1e-30))))
    head = _HEADER.pack(_MAGIC, _VERSION, len(splats), splats.sh_degree, bits, _ANTIALIASED * splats.antialiased, 0)
    opacity = GAUSSIAN.opacity(splats.opacity_logit.astype(np.float64))
    colour = _bytes(127.5 + 38.25 * splats.sh[:, 0])
    parts: list[NDArray[Any]] = [
        _positions(splats.mean, bits),
        _bytes(255.0 * opacity),
        colour,
        _bytes(16.0 * (10.0 + splats.log_scale)),
        _rotations(splats.quat),
        _harmonics(splats.sh[:, 1:]),
    ]
    with atomic_writer(path) as stream:
        # The gzip header gets neither name nor time, so that the same splats give the same bytes.
        stream.write(gzip.compress(head + b"".join(part.tobytes() for part in parts), mtime=0))


def read_spz(path: str | os.PathLike[str]) -> Splats:
    """Read Gaussians from a file of version 3.

    Raises
    ------
    InputError : the file cannot be read, is damaged, or has another version.
    """
    path = Path(path)
    try:
        with gzip.open(path) as stream:
            head = stream.read(_HEADER.size)
            if len(head) < _HEADER.size:
                raise InputError(f"{path}: is not a .spz file (it ends in the header); export it again")
            magic, version, n, degree, bits, flags, _ = _HEADER.unpack(head)
            if magic != _MAGIC or version != _VERSION or degree > MAX_SH_DEGREE:
                raise InputError(
                    f"{path}: is not a .spz file of version {_VERSION} with SH up to degree {MAX_SH_DEGREE}; "
                    "write it as .ply with the program that made it"
                )
            widths = (9, 1, 3, 3, 4, 3 * (sh_coefficients(degree) - 1))
            # A gzip stream is at most 1032 times its file, so a false count is found before memory is allocated.
            if n * sum(widths) > _MAX_GZIP_RATIO * path.stat().st_size:
                raise InputError(f"{path}: is too short for the {n} splats of its header; export it again")
            body = stream.read(n * sum(widths) + 1)
    except OSError as error:  # gzip.BadGzipFile too
        reason = error.strerror or str(error)
        raise InputError(f"{path}: cannot be read ({reason}); check name and rights, or export it again") from None
    except (EOFError, zlib.error) as error:
        raise InputError(f"{path}: is damaged ({error}); export it again") from None
    if len(body) != n * sum(widths):
        raise InputError(f"{path}: does not hold the {n} splats of its header; export it again")
    ends = np.cumsum([0, *(n * width for width in widths)])
    flat = np.frombuffer(body, np.uint8)
    places, opacity, colour, scale, rotation, rest = (flat[a:b] for a, b in pairwise(ends))
    bands = rest.reshape(n, sh_coefficients(degree) - 1, 3)
    sh = np.concatenate([(colour.reshape(n, 1, 3) - 127.5) / 38.25, (bands - 128.0) / 128.0], axis=1)
    with np.errstate(divide="ignore"):
        logit = np.clip(GAUSSIAN.raw_opacity(opacity / 255.0), -_LOGIT_MAX, _LOGIT_MAX)
    arrays = {
        "mean": _places(places.reshape(n, 3, 3)) / 2.0**bits,
        "quat": _quaternions(rotation.view("<u4")),
        "log_scale": scale.reshape(n, 3) / 16.0 - 10.0,
        "opacity_logit": logit,
        "sh": sh,
    }
    return Splats(
        GAUSSIAN.name,
        {name: values.astype(np.float32) for name, values in arrays.items()},
        antialiased=bool(flags & _ANTIALIASED),
    )


def _places(low_first: Bytes) -> NDArray[np.int32]:
    """Return (N, 3) signed numbers from three bytes each."""
    wide = np.zeros((*low_first.shape[:2], 4), np.uint8)
    wide[..., 1:] = low_first
    return wide.view("<i4")[..., 0] >> 8


def _quaternions(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Return quaternions (N, 4) as w, x, y, z."""
    fields = np.stack([packed >> 20, packed >> 10, packed], axis=1) & 1023
    others = (fields & 511) * np.where(fields & 512, -1.0, 1.0) / (511.0 * math.sqrt(2.0))
    largest = (packed >> 30).astype(np.int64)
    xyzw = np.empty((len(packed), 4))
    np.put_along_axis(xyzw, _OTHERS[largest], others, axis=1)
    # If the three others are at their maximum, rounding can make the largest negative under the root.
    xyzw[np.arange(len(packed)), largest] = np.sqrt(np.maximum(1.0 - np.sum(others**2, axis=1), 0.0))
    return xyzw[:, [3, 0, 1, 2]]


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
    others = np.take_along_axis(xyzw, _OTHERS[largest], axis=1)
    sizes = np.minimum(np.rint(511.0 * math.sqrt(2.0) * np.abs(others)), 511).astype(np.uint32)
    fields = sizes | (others < 0).astype(np.uint32) << 9
    index = largest.astype(np.uint32) << 30
    return (index | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]).astype("<u4")


def _harmonics(rest: NDArray[np.floating]) -> Bytes:
    """Return quantised coefficients (N, K - 1, 3) of the bands above 0."""
    step = np.where(np.arange(rest.shape[1]) < 3, _FINE, _COARSE)[:, None]
    return _bytes(step * np.rint((128.0 + 128.0 * rest.astype(np.float64)) / step))

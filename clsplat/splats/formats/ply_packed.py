"""Compressed PLY files of PlayCanvas and SuperSplat: Gaussians packed into words of 32 bits.

Format: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply/ ("compressed PLY"). The elements:

    chunk     for each 256 splats the least and greatest x, y, z, scale_x, scale_y, scale_z and, in newer files, r, g, b
    vertex    packed_position    11, 10 and 11 bits of x, y, z, between the limits of the chunk
              packed_scale       the same of the log scales
              packed_rotation    2 bits name the largest of w, x, y, z; 10 bits each for the others, +-sqrt(1/2)
              packed_color       8 bits each of red, green, blue, opacity; colours between the chunk's limits or 0 and 1
    sh        one byte for each f_rest_*, from -4 to 4; missing at SH degree 0
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..fields import MAX_SH_DEGREE, sh_coefficients
from ..harmonics import SH_C0
from ..quaternions import from_smallest_three
from ..shapes import GAUSSIAN
from ..stored import StoredSplats, gaussians
from .ply_header import VERTEX, Header

Table = Mapping[str, NDArray[Any]]

_CHUNK_SIZE = 256
_CHUNK, _SH = "chunk", "sh"
_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_POSITION, _SCALE, _COLOR = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
_BITS = ((21, 11), (11, 10), (0, 11))  # shift and width of x, y, z
_ROTATION_BITS = ((20, 10), (10, 10), (0, 10))
_COLOR_BITS = ((24, 8), (16, 8), (8, 8))
_SH_RANGE = 8.0


def is_packed(header: Header) -> bool:
    """Return whether the file is a compressed PLY."""
    return _WORDS[0] in header.names


def unpacked(path: Path, header: Header, body: Mapping[str, Table]) -> StoredSplats:
    """Return the splats of a compressed PLY, without unusable ones.

    Raises
    ------
    InputError : an element or a column is missing, has another type or a wrong length.
    """
    n = header.count
    words = {name: _column(path, body, VERTEX, name, np.uint32) for name in _WORDS}
    chunks = -(-n // _CHUNK_SIZE)
    if len(next(iter(body.get(_CHUNK, {"": np.empty(0)}).values()))) != chunks:
        raise InputError(f"{path}: needs {chunks} rows of element 'chunk' for its {n} splats; export it again")
    limits = np.arange(n) // _CHUNK_SIZE

    def between(names: tuple[str, ...], shares: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return values (N, 3) from their places between the least and the greatest of the chunk."""
        low, high = (
            np.stack([_column(path, body, _CHUNK, f"{end}_{name}", np.float32) for name in names], axis=1)[limits]
            for end in ("min", "max")
        )
        with np.errstate(all="ignore"):  # unusable limits are found with the splats that they spoil
            return low * (1.0 - shares) + high * shares

    color = _shares(words["packed_color"], _COLOR_BITS)
    if "min_r" in body[_CHUNK]:
        color = between(_COLOR, color)
    with np.errstate(divide="ignore"):  # the logits of 0 and 255 are infinite, which `gaussians` replaces
        logit = GAUSSIAN.raw_opacity((words["packed_color"] & 255) / 255.0)
    arrays = {
        "mean": between(_POSITION, _shares(words["packed_position"], _BITS)),
        "quat": _quaternions(words["packed_rotation"]),
        "log_scale": between(_SCALE, _shares(words["packed_scale"], _BITS)),
        "opacity_logit": logit,
        "sh": np.concatenate([(color[:, None] - 0.5) / SH_C0, _bands(path, body, n)], axis=1),
    }
    return gaussians(path, arrays)


def _column(path: Path, body: Mapping[str, Table], element: str, name: str, dtype: type[np.generic]) -> NDArray[Any]:
    """Return a column as `dtype`; raise InputError if it is missing or has another type."""
    values = body.get(element, {}).get(name)
    if values is None or values.dtype != dtype:
        raise InputError(f"{path}: element {element!r} needs {name} as {np.dtype(dtype)}; export it again")
    return values


def _shares(words: NDArray[Any], bits: tuple[tuple[int, int], ...]) -> NDArray[np.float64]:
    """Return packed whole numbers as shares (N, 3) of their greatest value."""
    wide = words.astype(np.int64)
    return np.stack([((wide >> shift) & ((1 << width) - 1)) / ((1 << width) - 1) for shift, width in bits], axis=1)


def _quaternions(words: NDArray[Any]) -> NDArray[np.float64]:
    """Return quaternions (N, 4) as w, x, y, z."""
    others = (_shares(words, _ROTATION_BITS) - 0.5) * math.sqrt(2.0)
    return from_smallest_three(others, words.astype(np.int64) >> 30)


def _bands(path: Path, body: Mapping[str, Table], n: int) -> NDArray[np.float64]:
    """Return coefficients (N, K - 1, 3) of the SH bands above 0."""
    table = body.get(_SH, {})
    counts = {3 * (sh_coefficients(degree) - 1) for degree in range(MAX_SH_DEGREE + 1)}
    if len(table) not in counts:
        raise InputError(f"{path}: element 'sh' has {len(table)} columns, expected 9, 24 or 45; export it again")
    columns = [_column(path, body, _SH, f"f_rest_{i}", np.uint8) for i in range(len(table))]
    if any(len(values) != n for values in columns):
        raise InputError(f"{path}: element 'sh' needs a row for each of the {n} splats; export it again")
    if not columns:
        return np.empty((n, 0, 3))
    stored = np.stack(columns, axis=1).astype(np.float64)
    # A byte stands for the middle of its range, the first and the last for its ends.
    shares = np.where(stored == 0, 0.0, np.where(stored == 255, 1.0, (stored + 0.5) / 256.0))
    rest: NDArray[np.float64] = ((shares - 0.5) * _SH_RANGE).reshape(n, 3, -1).transpose(0, 2, 1)
    return rest

"""Splats inside a web page: columns of whole numbers, and back. `clsplat/webpage/` makes the page.

The page has an element `<script id="payload" type="text/plain">` with a gzip stream in base64. The stream begins with
the length of a JSON text as four bytes, the lowest first. Then come the text and the columns. The text has the number
of splats, the kernel, and the columns in their order: name, width, bytes of a number, the largest number, and the map
from numbers to values. Each component of a column is stored alone: first the lowest bytes of all splats, then the next
ones. So equal bytes lie side by side, which gzip needs.

Maps from a whole number q to a value, with u = q / largest and s = 2 u - 1:

    linear    low + u (high - low)
    root      s |s| high: finer near zero, for values that are mostly small
    log       low + sign(s) (exp(|s| high) - 1): finer near the middle of the scene
    float     the four bytes are those of a float32

Rotations are stored as (x, y, z) / (1 + w) of the unit quaternion with w >= 0 (modified Rodrigues parameters): three
numbers between -1 and 1, without a place where they are inexact.
"""

from __future__ import annotations

import base64
import binascii
import gzip
import json
import os
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..fields import Array, DoubleArray, sh_coefficients, sh_degree_of
from ..low_pass import LOW_PASS, LOW_PASSES
from ..near_plane import NEAR_PLANES
from ..quaternions import from_rodrigues, to_rodrigues
from ..shapes import GAUSSIAN, GENERALISED_EXPONENTIAL, NORMALISATIONS, SKEW_NORMAL
from ..stored import StoredSplats, usable_arrays

PAGE_ENDING = ".html"
PAGE_SHAPES = (GAUSSIAN.name, SKEW_NORMAL.name, GENERALISED_EXPONENTIAL.name)  # kernels that a page draws
PRECISIONS = ("compact", "full")
_OPEN, _CLOSE = b'<script id="payload" type="text/plain">', b"</script>"
_MAX_TEXT = 1 << 16  # bytes of the JSON text
_MAX_RATIO = 1100  # of a gzip stream; above its limit, 1032
_FLAT = 20.0  # a scale that is e^20 times smaller than the largest one might as well be 0
HUGE = 10.0  # a scale that is e^10 times larger than the median is that of a stray splat: nobody sees where it ends
_MIN_ALPHA = 1.0 / 255.0  # no image shows a splat of less opacity
_GZIP = 31  # of zlib's window: with the header of gzip
_LEVEL = 6


@dataclass(frozen=True)
class _Column:
    """How a page stores the values of a field: the map, the bytes of a number, and the largest number."""

    name: str
    map: str
    nbytes: int
    largest: int


# With an even largest number, the maps `root` and `log` have an exact zero. "full" keeps every value as float32.
_COMPACT = (
    _Column("mean", "log", 3, (1 << 20) - 2),
    _Column("log_scale", "linear", 2, 1022),
    _Column("rotation", "linear", 2, 1022),
    _Column("opacity", "linear", 1, 255),
    _Column("color", "root", 2, 510),
    _Column("harmonics", "root", 1, 30),
    _Column("skew", "linear", 1, 126),
    _Column("beta", "linear", 1, 255),
)
_WIDTHS: dict[str, tuple[int, ...]] = dict.fromkeys(("mean", "log_scale", "rotation", "color", "skew"), (3,))
_WIDTHS |= {"opacity": (1,), "beta": (1,)}
_WIDTHS |= {"harmonics": tuple(3 * (sh_coefficients(degree) - 1) for degree in (1, 2, 3))}
_OPTIONAL = ("harmonics", "skew", "beta")


def pack(splats: StoredSplats, precision: str = PRECISIONS[0]) -> bytes:
    """Return the payload of splats of one of PAGE_SHAPES.

    precision : "full" keeps the bits of float32; "compact" rounds to one to three bytes.
    """
    fields = _fields(splats.arrays)
    columns, parts = [], []
    for column in _COMPACT:
        values = fields[column.name]
        if values.shape[1] == 0:
            continue
        if precision == "full":
            entry: dict[str, Any] = {"map": "float", "bytes": 4}
            numbers = values.astype("<f4").view("<u4")
        else:
            entry = {"map": column.map, "bytes": column.nbytes, "largest": column.largest} | _range(column, values)
            numbers = _numbers(entry, values)
        columns.append({"name": column.name, "width": values.shape[1], **entry})
        parts += [_planes(component, entry["bytes"]) for component in numbers.T]
    text = json.dumps(
        {
            "splats": len(splats.arrays["mean"]),
            "normalisation": NORMALISATIONS.index(splats.normalisation) if splats.shape == SKEW_NORMAL.name else 0,
            "antialiased": splats.antialiased,
            "near_plane": splats.near_plane,
            "low_pass": splats.low_pass,
            "columns": columns,
        }
    ).encode()
    # No time in the header: equal models give equal bytes.
    return gzip.compress(struct.pack("<I", len(text)) + text + b"".join(parts), _LEVEL, mtime=0)


def clipped_sizes(splats: StoredSplats) -> int:
    """Return the number of splats that "compact" draws smaller than they are, without those that nobody sees."""
    log_scale = splats.arrays["log_scale"].astype(np.float64)
    if not len(log_scale):
        return 0
    clipped = np.any(log_scale > _largest(log_scale), axis=1)
    seen = GAUSSIAN.opacity(splats.arrays["opacity_logit"].astype(np.float64)) >= _MIN_ALPHA
    return int(np.count_nonzero(clipped & seen))


def read_page(path: str | os.PathLike[str]) -> StoredSplats:
    """Read the splats of a page.

    Raises
    ------
    InputError : the file is missing, or it is not a page of clsplat, or its payload is damaged.
    """
    path = Path(path)
    try:
        text = path.read_bytes()
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: cannot be read ({reason}); check name and rights") from error
    start = text.find(_OPEN) + len(_OPEN)
    end = text.find(_CLOSE, start)
    if start < len(_OPEN) or end < 0:
        raise InputError(f"{path}: is not a page with splats; choose one that clsplat convert has written")
    try:
        return unpack(path, base64.b64decode(text[start:end], validate=True))
    except binascii.Error:
        raise _damaged(path, "its payload is not base64") from None


def unpack(path: object, payload: bytes) -> StoredSplats:
    """Return the splats of a payload. path : named in errors. Raises InputError if it is damaged."""
    try:
        start = zlib.decompressobj(_GZIP).decompress(payload, 4 + _MAX_TEXT)
        length = int.from_bytes(start[:4], "little")
        head = json.loads(start[4 : 4 + length])
        columns = _checked_columns(head)
        total = 4 + length + sum(column["width"] * column["bytes"] for column in columns) * head["splats"]
        # A stream is at largest 1032 times its file, so a false number of splats is found before memory is allocated.
        if total > _MAX_RATIO * len(payload) + 4 + _MAX_TEXT:
            raise ValueError
        stream = zlib.decompressobj(_GZIP)
        whole = stream.decompress(payload, total + 1)
        if len(whole) != total or not stream.eof or not isinstance(head["antialiased"], bool):
            raise ValueError
        near_plane = NEAR_PLANES.usable(head["near_plane"])
        low_pass = LOW_PASSES.usable(head.get("low_pass", LOW_PASS))
        normalisation = NORMALISATIONS[head["normalisation"]]
    except (InputError, zlib.error, ValueError, KeyError, TypeError, IndexError, RecursionError, OverflowError):
        raise _damaged(path, "its payload cannot be read") from None
    fields, at, n = {}, 4 + length, head["splats"]
    for column in columns:
        size = column["width"] * column["bytes"] * n
        planes = np.frombuffer(whole, np.uint8, size, at).reshape(column["width"], column["bytes"], n)
        at += size
        numbers = np.zeros((column["width"], n), np.uint32)
        for byte in range(column["bytes"]):
            numbers |= planes[:, byte].astype(np.uint32) << np.uint32(8 * byte)
        fields[column["name"]] = _values(column, numbers.T)
    shape, arrays = GAUSSIAN, _arrays(fields)
    if "skew" in fields:
        shape, arrays["skew"] = SKEW_NORMAL, _within(fields["skew"], SKEW_NORMAL.schema(0)["skew"].limit)
    elif "beta" in fields:
        shape, arrays["beta"] = GENERALISED_EXPONENTIAL, fields["beta"][:, 0]
    with np.errstate(over="ignore"):  # values that overflow are found below
        single: dict[str, Array] = {name: np.ascontiguousarray(each, np.float32) for name, each in arrays.items()}
    degree = sh_degree_of(single["sh"].shape[1])
    usable = usable_arrays(path, shape.schema(degree), single)
    return StoredSplats(shape.name, normalisation, head["antialiased"], usable, near_plane, low_pass)


def _damaged(path: object, what: str) -> InputError:
    return InputError(f"{path}: {what}; the page is damaged or cut off: write it again with clsplat convert")


def _checked_columns(head: Any) -> list[dict[str, Any]]:
    """Return the columns of the JSON text. Raises ValueError, KeyError or TypeError if something does not fit."""
    n, columns = head["splats"], head["columns"]
    maps = {column.name: column for column in _COMPACT}
    if not isinstance(n, int) or isinstance(n, bool) or n < 0 or not isinstance(columns, list):
        raise ValueError
    for column in columns:
        expected = maps[column["name"]]
        if column["width"] not in _WIDTHS[expected.name] or type(column["width"]) is not int:
            raise ValueError
        if column["map"] == "float":
            if column["bytes"] != 4:
                raise ValueError
            continue
        if (column["map"], column["bytes"]) != (expected.map, expected.nbytes):
            raise ValueError
        bounds = np.array([column["low"], column["high"]], np.float64)
        if not 0 < column["largest"] < 256 ** column["bytes"]:
            raise ValueError
        if bounds.shape != (2, column["width"]) or not np.isfinite(bounds).all():
            raise ValueError
    names = [column["name"] for column in columns]
    if names != [column.name for column in _COMPACT if column.name in names or column.name not in _OPTIONAL]:
        raise ValueError
    return columns


def _arrays(fields: Mapping[str, DoubleArray]) -> dict[str, DoubleArray]:
    """Return the public arrays of the core fields."""
    n = len(fields["mean"])
    with np.errstate(divide="ignore"):  # the logits of 0 and 1 are infinite, which `usable_arrays` replaces
        logit = GAUSSIAN.raw_opacity(fields["opacity"][:, 0])
    return {
        "mean": fields["mean"],
        "log_scale": fields["log_scale"],
        "quat": from_rodrigues(fields["rotation"]),
        "opacity_logit": logit,
        "sh": np.concatenate([fields["color"], fields.get("harmonics", np.zeros((n, 0)))], axis=1).reshape(n, -1, 3),
    }


def _fields(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return the values of each column, (N, width); a width of 0 if the splats do not have them."""
    n = len(arrays["mean"])
    sh = arrays["sh"].reshape(n, -1)
    degree = round((sh.shape[1] / 3) ** 0.5) - 1
    while degree > 0 and not sh[:, 3 * sh_coefficients(degree - 1) : 3 * sh_coefficients(degree)].any():
        degree -= 1
    skew = arrays["skew"] if "skew" in arrays and arrays["skew"].any() else np.zeros((n, 0), np.float32)
    return {
        "mean": arrays["mean"],
        "log_scale": arrays["log_scale"],
        "rotation": to_rodrigues(arrays["quat"].astype(np.float64)),
        "opacity": GAUSSIAN.opacity(arrays["opacity_logit"].astype(np.float64))[:, None],
        "color": sh[:, :3],
        "harmonics": sh[:, 3 : 3 * sh_coefficients(degree)],
        "skew": skew,
        "beta": arrays["beta"][:, None] if "beta" in arrays else np.zeros((n, 0), np.float32),
    }


def _range(column: _Column, values: Array) -> dict[str, list[float]]:
    """Return the numbers of a map, for each component."""
    if not len(values):
        return {"low": [0.0] * values.shape[1], "high": [1.0] * values.shape[1]}
    values = values.astype(np.float64)
    if column.name == "opacity":
        return {"low": [0.0], "high": [1.0]}
    if column.map == "root":
        high = np.abs(values).max(axis=0)
        return {"low": (0.0 * high).tolist(), "high": high.tolist()}
    if column.map == "log":
        low = np.median(values, axis=0)
        return {"low": low.tolist(), "high": np.log1p(np.abs(values - low)).max(axis=0).tolist()}
    high = values.max(axis=0)
    low = values.min(axis=0)
    if column.name == "log_scale":
        high = np.minimum(high, _largest(values))
        low = np.maximum(low, high - _FLAT)
    return {"low": low.tolist(), "high": high.tolist()}


def _largest(log_scale: Array) -> DoubleArray:
    """Return the largest log scale of each axis that "compact" keeps, (3,): a stray splat must not clip all others."""
    return np.asarray(np.median(log_scale, axis=0) + HUGE)


def _numbers(entry: Mapping[str, Any], values: Array) -> NDArray[np.uint32]:
    """Return the whole numbers of values, (N, width)."""
    low, high = np.array(entry["low"]), np.array(entry["high"])
    values = values.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        if entry["map"] == "linear":
            share = (values - low) / (high - low)
        elif entry["map"] == "root":
            share = 0.5 + 0.5 * np.sign(values) * np.sqrt(np.abs(values) / high)
        else:
            share = 0.5 + 0.5 * np.sign(values - low) * np.log1p(np.abs(values - low)) / high
    share = np.where(high > low, share, 0.0) if entry["map"] == "linear" else np.where(high > 0.0, share, 0.5)
    return np.rint(np.clip(share, 0.0, 1.0) * entry["largest"]).astype(np.uint32)


def _values(column: Mapping[str, Any], numbers: NDArray[np.uint32]) -> DoubleArray:
    """Return the values of whole numbers, (N, width): the inverse of `_numbers`."""
    if column["map"] == "float":
        return np.ascontiguousarray(numbers).view(np.float32).astype(np.float64)
    low, high = np.array(column["low"]), np.array(column["high"])
    share = numbers / float(column["largest"])
    if column["map"] == "linear":
        return np.asarray(low + share * (high - low))
    side = 2.0 * share - 1.0
    if column["map"] == "root":
        return np.asarray(side * np.abs(side) * high)
    with np.errstate(over="ignore"):  # of damaged pages
        return np.asarray(low + np.sign(side) * np.expm1(np.abs(side) * high))


def _planes(numbers: NDArray[np.uint32], nbytes: int) -> bytes:
    """Return the lowest bytes of all numbers, then the next ones."""
    return b"".join((numbers >> np.uint32(8 * byte)).astype(np.uint8).tobytes() for byte in range(nbytes))


def _within(vectors: DoubleArray, limit: float | None) -> DoubleArray:
    """Shorten vectors that rounding has made longer than the limit."""
    longest = np.inf if limit is None else limit
    norm = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(np.where(norm > longest, vectors * (longest / np.maximum(norm, 1e-300)), vectors))

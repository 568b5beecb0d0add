"""Writer of SOG files, version 2: a zip archive of lossless images and meta.json. sog.py has the layout.

Format: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog. It leaves the order of splats, the
codebooks and the palette to the writer:

- The images are compressed afterwards, so numbers of few different values are cheaper. A palette of few entries saves
  less than coarse steps of its numbers do. So each splat has its own entry as long as the format allows it.
- Errors in large and opaque splats change a picture more. These splats have more weight in codebooks and palette.
- A Gaussian does not change if it turns by half a turn about one of its axes. One of these turns makes w the largest
  component of the quaternion, so that its place needs no bits.

docs/decisions.md has the measurements.
"""

from __future__ import annotations

import json
import math
import os
import zipfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..._version import __version__
from ...errors import InputError, OutputError
from ...files.atomic import atomic_writer
from ..fields import Array, DoubleArray, sh_degree_of
from ..morton import morton_order
from ..shapes import GAUSSIAN, SKEW_MAX, SKEW_NORMAL
from ..stored import StoredSplats
from .codebooks import best_levels, nearest_level, palette
from .sog import EXTRA, META, SKEW_ZERO

Bytes = NDArray[np.uint8]

_PALETTE_ROW = 64  # entries
_TAG = 252  # alpha of a rotation whose largest component is w
_MAX_SIDE = 16380  # pixels: the limit of WebP is 16383, and graphics cards like multiples of 4
_SH_STEP = 1.0 / 64.0  # of the coefficients above band 0: an error of 0.005 in the colour of a splat
_MAX_SH = 1e6  # larger coefficients overflow when they are squared
_WEIGHTS = 1e3  # the largest weight of a splat and the inverse of the smallest one, relative to the median

# By the largest component of q = w, x, y, z: the product of q and 1, i, j or k has that component in front. These are
# the places of its components in q, and their signs.
_TURNED = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_SIGNS = np.array([[1.0, 1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, -1.0], [-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, -1.0, 1.0]])

_AXES = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])  # after these turns


def write_sog(path: str | os.PathLike[str], splats: StoredSplats) -> None:
    """Write Gaussians or skew-normals as a .sog archive, in Morton order. Equal splats give equal bytes.

    Raises
    ------
    InputError : the shape is another one, or there are more than 268 million splats.
    OutputError : the file cannot be written, or Pillow cannot write WebP.
    """
    files = sog_files(path, splats, morton_order(splats.arrays["mean"]))
    with atomic_writer(path) as stream, zipfile.ZipFile(stream, "w") as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name)  # with the year 1980 as its time
            entry.create_system, entry.external_attr = 3, 0o644 << 16  # the same bytes on every system
            archive.writestr(entry, data)


def sog_files(path: object, splats: StoredSplats, order: NDArray[np.int64]) -> dict[str, bytes]:
    """Return the files of a SOG by their names, meta.json first.

    Parameters
    ----------
    path : named in errors.
    order : (N,) places of the splats to write, in the order of the images.

    Raises
    ------
    InputError, OutputError : as for `write_sog`.
    """
    from ...files.images import encode_pixels  # lazy: a slow import

    if splats.shape not in (GAUSSIAN.name, SKEW_NORMAL.name):
        raise InputError(
            f"{path}: .sog files hold Gaussians and skew-normals, not {splats.shape} splats; convert them first"
        )
    count = len(order)
    if count > _MAX_SIDE**2:
        raise InputError(f"{path}: .sog files hold at most {_MAX_SIDE**2} splats, not {count}: write a .ply")
    arrays = {name: values[order].astype(np.float64) for name, values in splats.arrays.items() if name != "sh"}
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": f"clsplat {__version__}"},
        "count": count,
        "antialias": splats.antialiased,
        EXTRA: {"nearPlane": splats.near_plane, "lowPass": splats.low_pass},
    }
    if "skew" in arrays:
        meta[EXTRA]["normalisation"] = splats.normalisation
    images: dict[str, Bytes] = {}
    _add_places(meta, images, arrays["mean"])
    _add_rotations(meta, images, arrays)
    _add_scales(meta, images, arrays)
    _add_color(meta, images, splats.arrays["sh"][order, 0], arrays)
    if splats.arrays["sh"].shape[1] > 1:
        _add_bands(meta, images, splats.arrays["sh"][order, 1:], arrays)
    try:
        encoded = {f"{name}.webp": encode_pixels(pixels) for name, pixels in images.items()}
    except OutputError as error:
        raise OutputError(f"{path}: {error}") from None
    return {META: json.dumps(meta, separators=(",", ":")).encode(), **encoded}


def _add_places(meta: dict[str, Any], images: dict[str, Bytes], mean: DoubleArray) -> None:
    """Add positions: 16 bits of the logarithmic coordinates."""
    place = np.sign(mean) * np.log1p(np.abs(mean))
    lower, upper = (place.min(axis=0), place.max(axis=0)) if len(place) else (np.zeros(3), np.zeros(3))
    share = (place - lower) / np.where(upper > lower, upper - lower, 1.0)
    number = np.rint(65535.0 * share).astype(np.uint16)
    images["means_l"], images["means_u"] = _image(number & 255), _image(number >> 8)
    meta["means"] = {"mins": lower.tolist(), "maxs": upper.tolist(), "files": ["means_l.webp", "means_u.webp"]}


def _add_rotations(meta: dict[str, Any], images: dict[str, Bytes], arrays: dict[str, DoubleArray]) -> None:
    """Add x, y and z of the quaternions that have the largest component in front, with a positive sign; and the skew.

    A half turn changes the signs of the skew in the frame of the splat.
    """
    quat = arrays["quat"]
    largest = np.abs(quat).argmax(axis=1)
    turned = np.take_along_axis(quat, _TURNED[largest], axis=1) * _SIGNS[largest]
    turned *= np.copysign(1.0, turned[:, :1]) / np.linalg.norm(turned, axis=1, keepdims=True)
    images["quats"] = _image(np.rint(255.0 * (turned[:, 1:] * math.sqrt(0.5) + 0.5)), _TAG)
    meta["quats"] = {"files": ["quats.webp"]}
    if "skew" in arrays:
        _add_skew(meta, images, arrays["skew"] * _AXES[largest])


def _add_skew(meta: dict[str, Any], images: dict[str, Bytes], skew: DoubleArray) -> None:
    """Add skews (N, 3), shortened as the kernels shorten them."""
    length = np.linalg.norm(skew, axis=1, keepdims=True)
    skew = skew * np.minimum(SKEW_MAX / np.maximum(length, 1e-300), 1.0)
    limit = float(np.abs(skew).max(initial=0.0))
    images["skew"] = _image(np.rint(SKEW_ZERO * (skew / max(limit, 1e-300) + 1.0)))
    meta[EXTRA]["skew"] = {"limit": limit, "files": ["skew.webp"]}


def _add_scales(meta: dict[str, Any], images: dict[str, Bytes], arrays: dict[str, DoubleArray]) -> None:
    """Add log scales."""
    levels = _stored(best_levels(arrays["log_scale"], _weights(arrays, 1.0)[:, None]))
    images["scales"] = _image(nearest_level(levels, arrays["log_scale"]))
    meta["scales"] = {"codebook": levels.tolist(), "files": ["scales.webp"]}


def _add_color(meta: dict[str, Any], images: dict[str, Bytes], color: Array, arrays: dict[str, DoubleArray]) -> None:
    """Add SH band 0 (N, 3) and opacities."""
    levels = _stored(best_levels(color))
    images["sh0"] = _image(nearest_level(levels, color), np.rint(255.0 * GAUSSIAN.opacity(arrays["opacity_logit"])))
    meta["sh0"] = {"codebook": levels.tolist(), "files": ["sh0.webp"]}


def _add_bands(meta: dict[str, Any], images: dict[str, Bytes], bands: Array, arrays: dict[str, DoubleArray]) -> None:
    """Add the SH bands (N, K - 1, 3) above 0."""
    width = bands.shape[1]
    rows = np.clip(bands.reshape(len(bands), 3 * width), -_MAX_SH, _MAX_SH).astype(np.float32)
    entries, labels = palette(rows, _weights(arrays, 0.5))
    levels = _stored(best_levels(entries, finest=_SH_STEP))
    height = max(-(-len(entries) // _PALETTE_ROW), 1)
    numbers = np.zeros((height * _PALETTE_ROW, 3 * width), np.uint8)
    numbers[: len(entries)] = nearest_level(levels, entries)
    images["shN_centroids"] = np.insert(numbers.reshape(height, _PALETTE_ROW * width, 3), 3, 255, axis=2)
    images["shN_labels"] = _image(np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1))
    meta["shN"] = {
        "count": len(entries),
        "bands": sh_degree_of(width + 1),
        "codebook": levels.tolist(),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }


def _image(channels: NDArray[Any], alpha: NDArray[Any] | int = 255) -> Bytes:
    """Return whole numbers (N, 3) and alpha (N,), row by row, as the pixels (H, W, 4) of a nearly square image."""
    count = len(channels)
    width = 4 * max(math.ceil(math.sqrt(count) / 4), 1)
    pixels = np.full((max(-(-count // width), 1) * width, 4), (0, 0, 0, 255), np.uint8)
    pixels[:count, :3], pixels[:count, 3] = channels, alpha
    return pixels.reshape(-1, width, 4)


def _stored(levels: DoubleArray) -> DoubleArray:
    """Return levels with the seven digits of float32, which make meta.json half as long."""
    return np.array([float(f"{level:.7g}") for level in levels])


def _weights(arrays: dict[str, DoubleArray], power: float) -> DoubleArray:
    """Return the importance (N,) of splats in pictures: opacity times a power of the radius, relative to the median.

    The radius is the geometric mean of the two larger scales.
    """
    if len(arrays["mean"]) == 0:
        return np.ones(0)
    log_radius = np.sort(arrays["log_scale"], axis=1)[:, 1:].mean(axis=1)
    opacity = np.maximum(GAUSSIAN.opacity(arrays["opacity_logit"]), 1e-30)
    log_weight = np.log(opacity) + power * log_radius
    return np.exp(np.clip(log_weight - np.median(log_weight), -math.log(_WEIGHTS), math.log(_WEIGHTS)))

"""SOG files of PlayCanvas, version 2: Gaussians as images, in a zip archive with meta.json, or beside meta.json.

Format: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog. Pixel i of each image, row by row
from the top, belongs to splat i:

    means_l, means_u    low and high bytes of x, y, z as shares n of the range mins..maxs; x = sign(n) (exp |n| - 1)
    quats               three components, +-sqrt(1/2); alpha is 252 plus the place of the largest in w, x, y, z
    scales              a byte for each axis: its log scale in the codebook
    sh0                 a byte for each channel: f_dc in the codebook; alpha is the opacity
    shN_labels          red and green: low and high byte of the splat's entry in the palette
    shN_centroids       the palette, 64 entries in a row: a pixel for each coefficient, its channels in the codebook

The object `clsplat` in meta.json is not of the format, and other programs ignore it. It has the near plane, and for
skew-normals the normalisation and one more image:

    skew                a byte for each component: 127 is zero, 0 and 254 are the limits
"""

from __future__ import annotations

import json
import lzma
import math
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..fields import MAX_SH_DEGREE, sh_coefficients
from ..low_pass import LOW_PASSES
from ..model_number import ModelNumber
from ..near_plane import NEAR_PLANES
from ..quaternions import from_smallest_three
from ..shapes import GAUSSIAN, NORMALISATIONS, SKEW_LIMIT, SKEW_NORMAL
from ..stored import StoredSplats, joined_parts

META = "meta.json"
EXTRA = "clsplat"
SKEW_ZERO = 127  # byte of a component of the skew that is zero
_MAX_FILE = 1 << 28  # bytes of one file in the archive
_TAG = 252  # alpha of a rotation whose largest component is w
_PALETTE_ROW, _MOST_ENTRIES = 64, 1 << 16
_SMALL_IMAGE = 1 << 16  # an image may always have this number of pixels
_LEVELS = 256  # length of a codebook


def is_sog(start: bytes) -> bool:
    """Return whether a file that begins with these bytes is a zip archive."""
    return start.startswith(b"PK\3\4")


def read_sog(path: Path, with_unusable: bool = False) -> StoredSplats:
    """Read a .sog archive, or the meta.json of a folder.

    with_unusable : whether to keep unusable splats, for a caller that counts them.

    Raises
    ------
    InputError : a file is missing or damaged, or has another version; or most of the splats are unusable.
    """
    try:
        if path.name == META:
            found = _Reader(path, lambda name: (path.parent / Path(name).name).read_bytes()).splats()
        else:
            with zipfile.ZipFile(path) as archive:
                found = _Reader(path, lambda name: _member(path, archive, name)).splats()
    except OSError as error:
        name = error.filename or path
        raise InputError(f"{name}: cannot be read ({error.strerror or error}); check name and rights") from None
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, UnicodeDecodeError, lzma.LZMAError) as error:
        raise InputError(f"{path}: is not a sound .sog file ({error}); export it again") from None
    return found if with_unusable else joined_parts(path, [found])


class _Reader:
    """Reader of one set of files.

    Parameters
    ----------
    read : returns the bytes of a file by its name.
    """

    def __init__(self, path: Path, read: Callable[[str], bytes]) -> None:
        self.path, self.read = path, read
        try:
            self.meta = json.loads(read(META))
        except (ValueError, RecursionError):
            raise InputError(f"{path}: {META} is not JSON; export it again") from None
        version = self._value("version", default=1)
        if version != 2:
            raise InputError(f"{path}: has version {version!r}, version 2 of SOG is read; write it as .ply or .spz")
        self.count = self._whole("count", "count", 1 << 32)

    def splats(self) -> StoredSplats:
        """Return the splats, with unusable ones."""
        low, high = (self._pixels("means", i) for i in (0, 1))
        lower, upper = self._reals("means", "mins", 3), self._reals("means", "maxs", 3)
        share = (low[:, :3] + 256.0 * high[:, :3]) / 65535.0
        color = self._pixels("sh0", 0)
        with np.errstate(all="ignore"):  # `joined_parts` treats values that are not finite
            place = lower + share * (upper - lower)
            arrays = {
                "mean": np.sign(place) * np.expm1(np.abs(place)),
                "quat": self._quaternions(),
                "log_scale": self._reals("scales", "codebook", _LEVELS)[self._pixels("scales", 0)[:, :3]],
                "opacity_logit": GAUSSIAN.raw_opacity(color[:, 3] / 255.0),
                "sh": np.concatenate(
                    [self._reals("sh0", "codebook", _LEVELS)[color[:, None, :3]], self._bands()], axis=1
                ),
            }
        shape = GAUSSIAN.name
        if self._value(EXTRA, "skew") is not None:
            shape, arrays["skew"] = SKEW_NORMAL.name, self._skew()
        antialiased = self._value("antialias", default=False) is True
        near_plane, low_pass = self._number("nearPlane", NEAR_PLANES), self._number("lowPass", LOW_PASSES)
        return StoredSplats(shape, self._normalisation(), antialiased, arrays, near_plane, low_pass)

    def _skew(self) -> NDArray[np.float64]:
        """Return skews (N, 3)."""
        limit = self._value(EXTRA, "skew", "limit")
        if type(limit) not in (int, float) or not 0.0 <= limit <= SKEW_LIMIT:
            raise InputError(f"{self.path}: skew.limit in {META} is {str(limit)[:40]!r}; export it again")
        stored = self._pixels(EXTRA, 0, "skew")[:, :3].astype(np.float64)
        return np.clip((stored - SKEW_ZERO) / SKEW_ZERO, -1.0, 1.0) * limit

    def _normalisation(self) -> str:
        found = self._value(EXTRA, "normalisation", default=NORMALISATIONS[0])
        if found not in NORMALISATIONS:
            raise InputError(f"{self.path}: normalisation {str(found)[:40]!r} in {META} is unknown; export it again")
        return str(found)

    def _number(self, name: str, number: ModelNumber) -> float:
        found = self._value(EXTRA, name, default=number.usual)
        if not number.accepts(found):
            raise InputError(f"{self.path}: {EXTRA}.{name} in {META} is {str(found)[:40]!r}; give {number.what}")
        return number.usable(found)

    def _quaternions(self) -> NDArray[np.float64]:
        """Return quaternions (N, 4) as w, x, y, z; zeros, which are unusable, for wrong tags."""
        stored = self._pixels("quats", 0)
        others = (stored[:, :3] / 255.0 - 0.5) * math.sqrt(2.0)
        quat = from_smallest_three(others, np.maximum(stored[:, 3].astype(np.int64) - _TAG, 0))
        quat[stored[:, 3] < _TAG] = 0.0
        return quat

    def _bands(self) -> NDArray[np.float64]:
        """Return coefficients (N, K - 1, 3) of the SH bands above 0."""
        if "shN" not in self.meta:
            return np.empty((self.count, 0, 3))
        bands = self._whole("shN", "bands", MAX_SH_DEGREE)
        entries, width = self._whole("shN", "count", _MOST_ENTRIES), sh_coefficients(bands) - 1
        rows = -(-entries // _PALETTE_ROW)
        palette = self._image("shN", 0, max_pixels=_MOST_ENTRIES * max(width, 1))[..., :3]
        if palette.shape[1] != _PALETTE_ROW * width or palette.shape[0] < rows:
            raise InputError(f"{self.path}: its palette is too small for {entries} entries of {bands} bands")
        stored = self._pixels("shN", 1).astype(np.int64)
        label = stored[:, 0] + 256 * stored[:, 1]
        if (label >= entries).any():
            raise InputError(f"{self.path}: splat {(label >= entries).argmax()} is not in the palette; export it again")
        coefficients: NDArray[np.float64] = self._reals("shN", "codebook", _LEVELS)[palette[:rows]]
        return coefficients.reshape(-1, width, 3)[label]

    def _pixels(self, group: str, place: int, *inner: str) -> NDArray[np.uint8]:
        """Return the values (N, 4) of the splats in an image. inner : keys of a group inside the group."""
        flat = self._image(group, place, *inner).reshape(-1, 4)
        if len(flat) < self.count:
            raise InputError(f"{self.path}: image {place} of {group} has {len(flat)} pixels for {self.count} splats")
        return flat[: self.count].copy()  # the image may be much larger

    def _image(self, group: str, place: int, *inner: str, max_pixels: int | None = None) -> NDArray[np.uint8]:
        """Return an image, (H, W, 4). max_pixels : its largest size, by default what the splats may need."""
        from ...files.images import decode_pixels  # lazy: a slow import

        names = self._value(group, *inner, "files")
        if not isinstance(names, list) or len(names) <= place or not isinstance(names[place], str):
            raise InputError(f"{self.path}: {group}.files in {META} has no file {place}; export it again")
        return decode_pixels(
            self.read(names[place]), f"{self.path}: {names[place][:80]!r}", max_pixels or 4 * self.count + _SMALL_IMAGE
        )

    def _reals(self, group: str, name: str, length: int) -> NDArray[np.float64]:
        """Return a list of numbers; values that are not finite are found with the splats that they spoil."""
        found = self._value(group, name)
        try:
            values = np.asarray([np.nan if value is None else value for value in found], np.float64)
        except (TypeError, ValueError, OverflowError):
            values = np.empty(0)
        if values.shape != (length,):
            raise InputError(f"{self.path}: {group}.{name} in {META} is not {length} numbers; export it again")
        return values

    def _whole(self, group: str, name: str, largest: int) -> int:
        found = self._value(group) if group == name else self._value(group, name)
        if type(found) is not int or not 0 <= found <= largest:
            raise InputError(
                f"{self.path}: {name} in {META} is {str(found)[:40]!r}, expected 0 to {largest}; export it again"
            )
        return found

    def _value(self, *keys: str, default: Any = None) -> Any:
        """Return a value of meta.json by its path of keys."""
        found: Any = self.meta
        for key in keys:
            found = found.get(key, default) if isinstance(found, dict) else default
        return found


def _member(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    """Return a file of the archive."""
    try:
        with archive.open(name) as stream:
            data = stream.read(_MAX_FILE + 1)
    except KeyError:
        raise InputError(f"{path}: has no file {name[:80]!r}; export it again") from None
    if len(data) > _MAX_FILE:
        raise InputError(f"{path}: {name[:80]!r} is larger than {_MAX_FILE} bytes; export it again")
    return data

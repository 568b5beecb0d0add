"""A splat model on the host: checked arrays that cannot be changed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..files.stop_signals import held
from .checks import check_arrays, sh_degree_for
from .fields import MAX_SH_DEGREE, Array, Schema, public_shape, sh_coefficients
from .formats.any_file import read_splats, write_splats
from .formats.spz import VERSIONS as SPZ_VERSIONS
from .harmonics import SH_C0
from .low_pass import LOW_PASS, LOW_PASSES
from .near_plane import NEAR_PLANE, NEAR_PLANES
from .shapes import DEFAULT_SHAPE, check_normalisation, shape_named
from .stored import StoredSplats

_MIN_SQUARED_DISTANCE = 1e-7  # the floor of 3DGS, for points that coincide
_MIN_OF_TYPICAL = 1e-2  # the floor of small scenes, as a share of the median squared distance
_OPACITIES = (1e-12, 1.0 - 1e-7)  # the range of opacities with finite raw values


class Splats:
    """N splats of one shape with their raw parameters (before any activation); immutable.

    Parameters
    ----------
    shape : name of the kernel (see `shapes.SHAPES`).
    arrays : one array for each field name. The core fields are mean (N, 3) [world units], quat (N, 4), log_scale
        (N, 3), opacity_logit (N,) and sh (N, K, 3) with K = 1, 4, 9 or 16. Quaternions are w, x, y, z of any norm above
        0; scales are natural logs of world units. The shape has fields of its own, such as skew (N, 3). Those that are
        missing get their neutral value.
        They become float32 unless all of them are float64.
    normalisation : "peak", "pdf" or "none".
    antialiased : whether the opacity of a small splat falls as the low-pass filter widens it, as in training.
    near_plane : depth below which a splat is not drawn, by its centre [world units].
    low_pass : variance that widens each splat in the image [px²].
    copy : whether the arrays are copied. Otherwise those of the right type become read-only, and must not change.

    Raises
    ------
    InputError : a name is unknown, an array has a wrong shape, or a value is unusable.
    """

    __slots__ = ("_antialiased", "_arrays", "_low_pass", "_near_plane", "_normalisation", "_schema", "_shape")

    _antialiased: bool
    _arrays: dict[str, Array]
    _low_pass: float
    _near_plane: float
    _normalisation: str
    _schema: Schema
    _shape: str

    def __init__(
        self,
        shape: str,
        arrays: Mapping[str, ArrayLike],
        normalisation: str = "peak",
        antialiased: bool = False,
        near_plane: float = NEAR_PLANE,
        low_pass: float = LOW_PASS,
        *,
        copy: bool = True,
    ) -> None:
        descriptor = shape_named(shape)
        double = all(getattr(values, "dtype", None) == np.float64 for values in arrays.values())
        dtype: np.dtype[Any] = np.dtype(np.float64 if double and arrays else np.float32)
        fields = {name: _real(name, values, dtype, copy) for name, values in arrays.items()}
        schema = descriptor.schema(sh_degree_for(fields))
        n = len(fields["mean"]) if "mean" in fields and fields["mean"].ndim else 0
        for field in descriptor.fields:
            if field.name not in fields and field.neutral_from in fields:
                fields[field.name] = fields[field.neutral_from].copy()
            elif field.name not in fields:
                fields[field.name] = np.tile(np.asarray(field.neutral, dtype=dtype), (n, 1)).reshape(
                    public_shape(field, n)
                )
        check_arrays(schema, fields)
        for values in fields.values():
            values.setflags(write=False)
        self._shape = descriptor.name
        self._normalisation = check_normalisation(normalisation)
        self._antialiased = bool(antialiased)
        self._near_plane = NEAR_PLANES.usable(near_plane)
        self._low_pass = LOW_PASSES.usable(low_pass)
        self._schema = schema
        self._arrays = {field.name: fields[field.name] for field in schema}

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Splats:
        """Read a file of splats: a PLY (also of 3DGS, or compressed), glTF, OpenUSD, .sog, .spz, .splat or a page.

        The content decides which format it is.

        Splats and columns that cannot be used are left out, with a warning. `load_model` reads model folders.

        Raises
        ------
        InputError : the file is missing or damaged, or has another format.
        """
        found = read_splats(path)
        numbers = found.near_plane, found.low_pass
        return cls(found.shape, found.arrays, found.normalisation, found.antialiased, *numbers, copy=False)

    def save(self, path: str | os.PathLike[str], compact: bool = False, *, spz_version: int = SPZ_VERSIONS[0]) -> None:
        """Write a .splat, .spz, .sog, .glb or OpenUSD file, or else a PLY file in float32, atomically.

        Parameters
        ----------
        compact : leave out the values that the splats do not use (see ply_compact.py). Do not set it for other
            programs: some read only the first element, and no other program reads the columns of the later elements.
        spz_version : version of an .spz file, 3 or 4. Version 4 needs the extra `spz`.

        Raises
        ------
        InputError : the format does not hold splats of this shape.
        OutputError : the file cannot be written.
        """
        write_splats(path, self.stored(), compact, spz_version)

    def stored(self) -> StoredSplats:
        """Return the content of a file of these splats, which shares the arrays."""
        return StoredSplats(
            self._shape, self._normalisation, self._antialiased, self._arrays, self._near_plane, self._low_pass
        )

    @classmethod
    def from_points(
        cls,
        xyz: ArrayLike,
        rgb: ArrayLike,
        shape: str = DEFAULT_SHAPE,
        sh_degree: int = 3,
        normalisation: str = "peak",
        opacity: float = 0.1,
        scale_factor: float = 1.0,
    ) -> Splats:
        """Make round splats at points, as large as the distance to their neighbours (the initialisation of 3DGS).

        Parameters
        ----------
        xyz : (N, 3) positions [world units].
        rgb : (N, 3) whole numbers 0..255 or real numbers 0..1.
        opacity : opacity of every splat, between 0 and 1, exclusive.
        scale_factor : the standard deviation in units of the root mean square distance to the 3 nearest other points.
            With fewer than 4 points all others count. The neighbours of a single point are one world unit away.

        Raises
        ------
        InputError : shapes do not fit, or values are out of range or not finite.
        """
        points = _real("xyz", xyz, np.dtype(np.float64))
        colours = _real("rgb", rgb, np.dtype(np.float64))
        if points.ndim != 2 or points.shape[1] != 3 or colours.shape != points.shape:
            shapes = f"{points.shape} of xyz, {colours.shape} of rgb"
            raise InputError(f"points: shapes {shapes}; both must be (N, 3)")
        if not np.isfinite(points).all():
            bad = int(np.argwhere(~np.isfinite(points))[0][0])
            raise InputError(f"points: xyz[{bad}] is {points[bad]}; remove the point or make it finite")
        if np.issubdtype(np.asarray(rgb).dtype, np.integer):
            colours = colours / 255.0
        if not ((colours >= 0.0) & (colours <= 1.0)).all():
            raise InputError("points: rgb is out of range; give whole numbers 0..255 or real numbers 0..1")
        if not 0.0 < opacity < 1.0 or not 0.0 < scale_factor < np.inf:
            raise InputError(f"points: opacity={opacity} must lie between 0 and 1, scale_factor={scale_factor} above 0")
        if sh_degree not in range(MAX_SH_DEGREE + 1):
            raise InputError(f"points: sh_degree is {sh_degree}; choose 0 to {MAX_SH_DEGREE}")
        n = len(points)
        squared = _squared_spacing(points)
        typical = float(np.median(squared)) if n else 0.0
        floor = min(_MIN_SQUARED_DISTANCE, _MIN_OF_TYPICAL * typical) if typical else _MIN_SQUARED_DISTANCE
        squared = np.maximum(squared, floor)
        sh = np.zeros((n, sh_coefficients(sh_degree), 3))
        sh[:, 0] = (colours - 0.5) / SH_C0
        arrays = {
            "mean": points,
            "quat": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
            "log_scale": np.repeat(np.log(np.sqrt(squared) * scale_factor)[:, None], 3, axis=1),
            "opacity_logit": shape_named(shape).raw_opacity(np.full(n, opacity)),
            "sh": sh,
        }
        single = {name: values.astype(np.float32) for name, values in arrays.items()}
        return cls(shape, single, normalisation, copy=False)

    @property
    def shape(self) -> str:
        """Name of the kernel."""
        return self._shape

    @property
    def normalisation(self) -> str:
        """Name of the normalisation."""
        return self._normalisation

    @property
    def antialiased(self) -> bool:
        """Whether opacities fall as the low-pass widens small splats."""
        return self._antialiased

    @property
    def near_plane(self) -> float:
        """Depth below which a splat is not drawn, by its centre [world units]."""
        return self._near_plane

    @property
    def low_pass(self) -> float:
        """Variance that widens each splat in the image [px²]."""
        return self._low_pass

    @property
    def schema(self) -> Schema:
        """Fields of these splats."""
        return self._schema

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""
        return self._schema.sh_degree

    @property
    def arrays(self) -> Mapping[str, Array]:
        """Every field's array by name, read-only, not copied."""
        return MappingProxyType(self._arrays)

    @property
    def mean(self) -> Array:
        """(N, 3) centres [world units]."""
        return self._arrays["mean"]

    @property
    def quat(self) -> Array:
        """(N, 4) rotations, w x y z, of any norm above 0."""
        return self._arrays["quat"]

    @property
    def log_scale(self) -> Array:
        """(N, 3) natural log of the standard deviations [world units]."""
        return self._arrays["log_scale"]

    @property
    def opacity_logit(self) -> Array:
        """(N,) logit of the opacity."""
        return self._arrays["opacity_logit"]

    @property
    def sh(self) -> Array:
        """(N, K, 3) spherical-harmonic coefficients of the colour."""
        return self._arrays["sh"]

    @property
    def skew(self) -> Array:
        """(N, 3) skew vectors; zeros if the shape has no skew."""
        return self._arrays["skew"] if "skew" in self._arrays else np.zeros_like(self.mean)

    def __len__(self) -> int:
        return len(self.mean)

    def __repr__(self) -> str:
        kind = f"{self.shape}, {self.normalisation}-normalised" + (", antialiased" if self.antialiased else "")
        return f"Splats({len(self)} x {kind}, SH degree {self.sh_degree})"

    def to_numpy(self) -> dict[str, Array]:
        """Writable copies of every field's array, by name."""
        return {name: values.copy() for name, values in self._arrays.items()}

    def with_arrays(self, arrays: Mapping[str, ArrayLike]) -> Splats:
        """Return splats of the same kind with other arrays of any length. Raises InputError as `Splats` does."""
        return self.like(self._shape, arrays, self._normalisation)

    def with_near_plane(self, depth: float) -> Splats:
        """Return the same splats with another near plane [world units]. Raises InputError if it is not above 0."""
        if depth == self._near_plane:
            return self
        numbers = depth, self._low_pass
        return Splats(self._shape, self._arrays, self._normalisation, self._antialiased, *numbers, copy=False)

    def like(self, shape: str, arrays: Mapping[str, ArrayLike], normalisation: str, *, copy: bool = True) -> Splats:
        """Return splats of any shape that are drawn with the antialiasing, near plane and low pass of these.

        copy : as of `Splats`. Raises InputError as `Splats` does.
        """
        numbers = self._near_plane, self._low_pass
        return Splats(shape, arrays, normalisation, self._antialiased, *numbers, copy=copy)

    def select(self, indices: ArrayLike) -> Splats:
        """Return the splats at `indices`: whole numbers in any order with repeats, or an (N,) boolean mask.

        Raises
        ------
        InputError : an index is out of range, a mask has another length, or `indices` is neither.
        """
        chosen = np.asarray(indices)
        if chosen.size == 0 and chosen.dtype != np.bool_:
            chosen = chosen.astype(np.int64)  # NumPy makes an empty list a float array
        whole = np.issubdtype(chosen.dtype, np.integer)
        if chosen.ndim != 1 or not (whole or chosen.dtype == np.bool_):
            raise InputError("select: give a list of whole numbers or a boolean mask")
        try:
            taken = {name: values[chosen] for name, values in self._arrays.items()}
        except IndexError as error:
            raise InputError(f"select: {error}; there are {len(self)} splats") from None
        return self.like(self._shape, taken, self._normalisation, copy=False)

    def as_shape(self, name: str) -> Splats:
        """Return the splats as another shape. Fields that it lacks are dropped; fields that it adds are neutral.

        Raises
        ------
        InputError : the shape is unknown, or it does not support the negative opacities of these splats.
        """
        source, target = shape_named(self._shape), shape_named(name)
        shared = [field.name for field in target.schema(self.sh_degree) if field in self._schema.fields]
        arrays = {field: self._arrays[field] for field in shared}
        if source.signed != target.signed:
            raw = arrays["opacity_logit"]
            opacity = source.opacity(raw.astype(np.float64))
            negative = int(np.sum(opacity < 0))
            if negative:
                raise InputError(
                    f"{negative} of {len(self)} splats have negative opacity, which shape {name} does not support; "
                    "remove them or choose another shape"
                )
            arrays["opacity_logit"] = target.raw_opacity(np.clip(opacity, *_OPACITIES)).astype(raw.dtype)
        return self.like(name, arrays, self._normalisation)


def _real(name: str, values: ArrayLike, dtype: np.dtype[Any], copy: bool = True) -> Array:
    """Return `values` as a contiguous array of real numbers, or a copy of them.

    A part of a larger array is always copied, so that the rest does not stay in memory.
    """
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "fiub":
            raise TypeError
        with np.errstate(over="ignore"):  # the check finds and names values that overflow
            is_whole = array.base is None or getattr(array.base, "nbytes", None) == array.nbytes
            convert = np.asarray if is_whole and not copy else np.array
            return convert(array, dtype=dtype, order="C")
    except (TypeError, ValueError):
        raise InputError(f"splats: {name!r} is not an array of real numbers") from None


def _squared_spacing(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the mean squared distance (N,) of each point to its 3 nearest neighbours."""
    from scipy.spatial import cKDTree  # lazy: a slow import

    n = len(points)
    if n < 2:
        return np.ones(n)
    neighbours = min(3, n - 1)
    # The nearest hit is the point itself (or one that coincides, at the same distance 0).
    with held():
        distances, _ = cKDTree(points).query(points, k=neighbours + 1, workers=-1)
    return np.asarray(np.mean(np.asarray(distances)[:, 1:] ** 2, axis=1))

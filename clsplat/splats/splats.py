"""`Splats`: a model on the host, checked and read-only."""

from __future__ import annotations

import os
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from .checks import check_arrays, sh_degree_for
from .fields import MAX_SH_DEGREE, Array, Schema, public_shape, sh_coefficients
from .ply import read_ply, write_ply
from .shapes import DEFAULT_SHAPE, check_normalisation, shape_named

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))
_MIN_SQUARED_DISTANCE = 1e-7  # 3DGS's floor, for points that coincide
_MIN_OF_TYPICAL = 1e-2  # where the scene is small: of the median squared distance
_OPACITIES = (1e-12, 1.0 - 1e-7)  # whose raw values are finite


class Splats:
    """N splats of one shape, as stored (before any activation); immutable.

    Parameters
    ----------
    shape : name of the kernel (see `shapes.SHAPES`).
    arrays : by field name: mean (N, 3) [world units], quat (N, 4) as w, x, y, z of any norm above 0,
        log_scale (N, 3) natural log of world units, opacity_logit (N,), sh (N, K, 3) with K = 1, 4, 9 or
        16, and the shape's own, such as skew (N, 3); the shape's own may be left out (neutral). Copied;
        float32 unless all are float64 arrays.
    normalisation : "peak", "pdf" or "none".
    antialiased : whether opacities fall as the low-pass widens small splats, as they did in training.

    Raises
    ------
    InputError : an unknown name, a shape that does not fit, or an unusable value; names field and splat.
    """

    __slots__ = ("_antialiased", "_arrays", "_normalisation", "_schema", "_shape")

    _antialiased: bool
    _arrays: dict[str, Array]
    _normalisation: str
    _schema: Schema
    _shape: str

    def __init__(
        self, shape: str, arrays: Mapping[str, ArrayLike], normalisation: str = "peak", antialiased: bool = False
    ) -> None:
        descriptor = shape_named(shape)
        double = all(getattr(values, "dtype", None) == np.float64 for values in arrays.values())
        dtype: np.dtype[Any] = np.dtype(np.float64 if double and arrays else np.float32)
        own = {name: _real(name, values, dtype) for name, values in arrays.items()}
        schema = descriptor.schema(sh_degree_for(own))
        n = len(own["mean"]) if "mean" in own and own["mean"].ndim else 0
        for field in descriptor.fields:
            if field.name not in own and field.neutral_from in own:
                own[field.name] = own[field.neutral_from].copy()
            elif field.name not in own:
                own[field.name] = np.tile(np.asarray(field.neutral, dtype=dtype), (n, 1)).reshape(
                    public_shape(field, n)
                )
        check_arrays(schema, own)
        for values in own.values():
            values.setflags(write=False)
        self._shape = descriptor.name
        self._normalisation = check_normalisation(normalisation)
        self._antialiased = bool(antialiased)
        self._schema = schema
        self._arrays = {field.name: own[field.name] for field in schema}

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Splats:
        """Read a splat PLY; a plain 3DGS file gives Gaussians. Raises InputError (see `ply.read_ply`)."""
        model = read_ply(path)
        return cls(model.shape, model.arrays, model.normalisation, model.antialiased)

    def save(self, path: str | os.PathLike[str], compact: bool = False) -> None:
        """Write a PLY in float32, atomically. Raises OutputError where it cannot be written.

        Parameters
        ----------
        compact : leave out what the splats do not use (see ply_compact.py). Files for other programs are best whole:
            some readers know one element only, and none but clsplat's the columns that moved to others.
        """
        write_ply(path, self._shape, self._normalisation, self._arrays, compact, self._antialiased)

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
        """3DGS's initialisation: round splats at points, as large as their neighbours are far.

        Parameters
        ----------
        xyz : (N, 3) positions [world units].
        rgb : (N, 3) whole numbers 0..255 or real numbers 0..1.
        opacity : 0 to 1, exclusive.
        scale_factor : times the root of the mean squared distance to the 3 nearest other points (fewer
            where there are fewer; a lone point counts as one world unit from the next).

        Raises
        ------
        InputError : shapes that do not fit, values out of range or not finite.
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
        return cls(shape, {name: values.astype(np.float32) for name, values in arrays.items()}, normalisation)

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
    def schema(self) -> Schema:
        """The fields that these splats have."""
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
        """(N, 3) skew vectors; zeros for shapes without."""
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
        """Splats of the same kind with other arrays, any number of them. Raises InputError as `Splats` does."""
        return Splats(self._shape, arrays, self._normalisation, self._antialiased)

    def select(self, indices: ArrayLike) -> Splats:
        """The splats at `indices` (whole numbers in any order, repeats allowed, or an (N,) boolean mask).

        Raises
        ------
        InputError : an index out of range, a mask of another length, or neither.
        """
        chosen = np.asarray(indices)
        if chosen.size == 0 and chosen.dtype != np.bool_:
            chosen = chosen.astype(np.int64)  # an empty list has no type of its own
        whole = np.issubdtype(chosen.dtype, np.integer)
        if chosen.ndim != 1 or not (whole or chosen.dtype == np.bool_):
            raise InputError("select: give a list of whole numbers or a boolean mask")
        try:
            taken = {name: values[chosen] for name, values in self._arrays.items()}
        except IndexError as error:
            raise InputError(f"select: {error}; there are {len(self)} splats") from None
        return self.with_arrays(taken)

    def as_shape(self, name: str) -> Splats:
        """The same splats as another shape: fields it lacks are dropped, fields it adds are neutral.

        Raises
        ------
        InputError : an unknown shape, or negative opacities for a shape that has none.
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
                    f"splats: {negative} of {len(self)} have a negative opacity, which shape {name} has "
                    "not: remove them or choose another shape"
                )
            arrays["opacity_logit"] = target.raw_opacity(np.clip(opacity, *_OPACITIES)).astype(raw.dtype)
        return Splats(name, arrays, self._normalisation, self._antialiased)


def _real(name: str, values: ArrayLike, dtype: np.dtype[Any]) -> Array:
    """An own, contiguous, real copy of `values`."""
    try:
        given = np.asarray(values)
        if given.dtype.kind not in "fiub":
            raise TypeError
        with np.errstate(over="ignore"):  # what overflows is found and named by the check
            return np.array(given, dtype=dtype, order="C")
    except (TypeError, ValueError):
        raise InputError(f"splats: {name!r} is no array of real numbers") from None


def _squared_spacing(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean squared distance of each point to its 3 nearest others, (N,)."""
    from scipy.spatial import cKDTree  # a third of a second to import

    n = len(points)
    if n < 2:
        return np.ones(n)
    neighbours = min(3, n - 1)
    # The nearest hit is the point itself (or one that coincides, at the same distance 0).
    distances, _ = cKDTree(points).query(points, k=neighbours + 1, workers=-1)
    mean: NDArray[np.float64] = np.mean(np.asarray(distances)[:, 1:] ** 2, axis=1)
    return mean

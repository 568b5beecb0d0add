"""Learnable parameters of a splat: one `Field` each. Buffers, files and the optimizer use this definition.

A buffer `[rows, capacity]` is component-major: row `offset + component` of splat i is at `row * capacity + i`. A model
has two buffers, because their sizes differ much: `sh` holds the colour, `geom` all other fields.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
DoubleArray = NDArray[np.float64]

MAX_SH_DEGREE = 3
MAX_LOG_SCALE = 80.0


class Group(Enum):
    """The device buffer that holds a field."""

    GEOM = "geom"
    SH = "sh"


@dataclass(frozen=True, slots=True)
class Field:
    """One learnable parameter with its raw values, before any activation.

    Parameters
    ----------
    name : key in arrays, gradients and checkpoints.
    width : reals per splat.
    ply : names of the columns of a PLY file in their order, one per component (ply.py has other rules for `sh`).
    neutral : value that makes the shape a Gaussian; the value of a field that a file does not have.
    lr : Adam's learning rate at 30 000 iterations. If the field has an option (`--opacity-lr`, `--beta-lr`, ...), the
        value of the option is used instead.
    lr_power : p in the factor max(1, 30 000 / iterations)^p of the rate: shorter runs need larger steps.
    limit : largest allowed Euclidean norm of the stored vector, or None.
    bounds : lowest and highest allowed value of each component, or None. Bounded fields are positive, and the
        optimizer steps their logarithm.
    neutral_from : another field of the same width; its values replace `neutral`.
    nonzero : whether the vector must not be 0 because only its direction is used (quaternions, normals).
    start : first value in training if all splats are neutral. A vector has this length and a random direction. None:
        the neutral value.
    """

    name: str
    width: int
    ply: tuple[str, ...]
    neutral: tuple[float, ...]
    lr: float
    lr_power: float = 0.0
    group: Group = Group.GEOM
    limit: float | None = None
    bounds: tuple[float, float] | None = None
    neutral_from: str | None = None
    nonzero: bool = False
    start: float | None = None


def sh_coefficients(degree: int) -> int:
    """Return the number of spherical-harmonic coefficients per colour channel up to `degree`."""
    return (degree + 1) ** 2


def sh_degree_of(n_coefficients: int) -> int:
    """Return the SH degree with this number of coefficients; raise ValueError if there is none."""
    for degree in range(MAX_SH_DEGREE + 1):
        if sh_coefficients(degree) == n_coefficients:
            return degree
    raise ValueError(f"{n_coefficients} SH coefficients per channel: expected 1, 4, 9 or 16")


# The rates are those of 3DGS. The rate of the mean is multiplied by the scene extent and decays during a run.
MEAN = Field("mean", 3, ("x", "y", "z"), (0.0, 0.0, 0.0), 1.6e-4, 0.75)
QUAT = Field("quat", 4, ("rot_0", "rot_1", "rot_2", "rot_3"), (1.0, 0.0, 0.0, 0.0), 1e-3, 0.5, nonzero=True)
LOG_SCALE = Field("log_scale", 3, ("scale_0", "scale_1", "scale_2"), (0.0, 0.0, 0.0), 5e-3, 0.25)
OPACITY_LOGIT = Field("opacity_logit", 1, ("opacity",), (0.0,), 5e-2)


def sh_field(degree: int) -> Field:
    """Return the field of the colour. Its rows are `3 * coefficient + channel`; its public arrays are (N, K, 3)."""
    k = sh_coefficients(degree)
    dc = ("f_dc_0", "f_dc_1", "f_dc_2")
    rest = tuple(f"f_rest_{i}" for i in range(3 * (k - 1)))
    return Field("sh", 3 * k, dc + rest, (0.0,) * (3 * k), 2.5e-3, group=Group.SH)


CORE = (MEAN, QUAT, LOG_SCALE, OPACITY_LOGIT)


@dataclass(frozen=True, slots=True)
class Schema:
    """The fields of one shape at one SH degree, in buffer order."""

    fields: tuple[Field, ...]

    def __iter__(self) -> Iterator[Field]:
        return iter(self.fields)

    def group(self, group: Group) -> tuple[Field, ...]:
        """Return the fields of one buffer, in the order of their rows."""
        return tuple(f for f in self.fields if f.group is group)

    def rows(self, group: Group) -> int:
        """Return the number of rows of one buffer."""
        return sum(f.width for f in self.group(group))

    def offset(self, name: str) -> int:
        """Return the first row of field `name` in its buffer."""
        field = self[name]
        offset = 0
        for other in self.group(field.group):
            if other.name == name:
                return offset
            offset += other.width
        raise KeyError(name)

    def __getitem__(self, name: str) -> Field:
        for field in self.fields:
            if field.name == name:
                return field
        raise KeyError(name)

    def __contains__(self, name: object) -> bool:
        return any(field.name == name for field in self.fields)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(field.name for field in self.fields)

    @property
    def sh_degree(self) -> int:
        return sh_degree_of(self["sh"].width // 3)


def make_schema(shape_fields: tuple[Field, ...], sh_degree: int) -> Schema:
    """Return the schema of a shape: the core fields, the fields of the shape, then colour."""
    return Schema((*CORE, *shape_fields, sh_field(sh_degree)))


def public_shape(field: Field, n: int) -> tuple[int, ...]:
    """Return the shape of a field's public array: (n,) for scalars, (n, K, 3) for colour, otherwise (n, width)."""
    if field.group is Group.SH:
        return (n, field.width // 3, 3)
    return (n,) if field.width == 1 else (n, field.width)


def scale_of(log_scale: Array) -> DoubleArray:
    """Return standard deviations. Logarithms beyond ±80 are cut, because single precision has no larger numbers."""
    return np.exp(np.clip(log_scale.astype(np.float64), -MAX_LOG_SCALE, MAX_LOG_SCALE))

"""Learnable parameters of a splat: one `Field` each, from which buffers, I/O and optimizer derive.

A buffer is component-major, `[rows, capacity]`: row `offset + component` of splat i at `row * capacity + i`.
Two buffers hold a model, because their sizes differ by far: `geom` (everything but colour) and `sh`.
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


class Group(Enum):
    """The device buffer that a field lives in."""

    GEOM = "geom"
    SH = "sh"


@dataclass(frozen=True, slots=True)
class Field:
    """One learnable parameter, as stored (raw values, before any activation).

    Parameters
    ----------
    name : key in arrays, gradients and checkpoints.
    width : reals per splat.
    ply : property names in file order, one per component (`sh` has its own rule in ply.py).
    neutral : value at which a shape *is* the Gaussian; used where a file lacks the field.
    lr : Adam's learning rate at 30 000 iterations. For the fields that have an option (`--opacity-lr`,
        `--beta-lr`, ...) the value of the option counts instead.
    lr_power : p in the factor max(1, 30 000 / iterations)^p of the rate: shorter runs need larger steps.
    limit : largest allowed Euclidean norm of the stored vector, or None.
    bounds : lowest and highest allowed value of each component, or None. Bounded fields are positive, and the
        optimizer steps their logarithm.
    neutral_from : another field of the same width whose value is the neutral one, instead of `neutral`.
    nonzero : whether the vector's length carries no meaning and must not be 0 (quaternions, directions).
    start : what training starts from where all is neutral: the length of a vector in a random direction, or a
        number; None: the neutral value itself.
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
    """Number of spherical-harmonic coefficients per colour channel up to `degree`."""
    return (degree + 1) ** 2


def sh_degree_of(n_coefficients: int) -> int:
    """Degree whose coefficient count is `n_coefficients`; raises ValueError if there is none."""
    for degree in range(MAX_SH_DEGREE + 1):
        if sh_coefficients(degree) == n_coefficients:
            return degree
    raise ValueError(f"{n_coefficients} SH coefficients per channel: expected 1, 4, 9 or 16")


# 3DGS's learning rates; the mean's is multiplied by the scene extent and decays (see train).
MEAN = Field("mean", 3, ("x", "y", "z"), (0.0, 0.0, 0.0), 1.6e-4, 0.75)
QUAT = Field("quat", 4, ("rot_0", "rot_1", "rot_2", "rot_3"), (1.0, 0.0, 0.0, 0.0), 1e-3, 0.5, nonzero=True)
LOG_SCALE = Field("log_scale", 3, ("scale_0", "scale_1", "scale_2"), (0.0, 0.0, 0.0), 5e-3, 0.25)
OPACITY_LOGIT = Field("opacity_logit", 1, ("opacity",), (0.0,), 5e-2)


def sh_field(degree: int) -> Field:
    """Colour: rows are coefficient-major (`row = 3 * k + channel`), public arrays are (N, K, 3)."""
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
        """Fields living in one buffer, in row order."""
        return tuple(f for f in self.fields if f.group is group)

    def rows(self, group: Group) -> int:
        """Rows of one buffer."""
        return sum(f.width for f in self.group(group))

    def offset(self, name: str) -> int:
        """First row of field `name` in its buffer."""
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
    """Schema of a shape: the core fields, the shape's own, then colour."""
    return Schema((*CORE, *shape_fields, sh_field(sh_degree)))


def public_shape(field: Field, n: int) -> tuple[int, ...]:
    """Shape of the field's public array: (N,) for scalars, (N, K, 3) for colour, else (N, width)."""
    if field.group is Group.SH:
        return (n, field.width // 3, 3)
    return (n,) if field.width == 1 else (n, field.width)

"""Checks of the arrays of a model, shared by files and `Splats`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .fields import MAX_SH_DEGREE, Array, Field, Schema, public_shape, sh_coefficients

# The squared norm of a quaternion or direction must neither vanish nor overflow in float32 (1.2e-38 to 3.4e38).
QUAT_NORM_MIN, QUAT_NORM_MAX = 1e-15, 1e15
_MOVED = 0.1  # sizes of a splat that rounding may move it by
LIMIT_SLACK = 1e-5  # relative; a vector at its limit may round up in float32


@dataclass(frozen=True, slots=True)
class Fault:
    """The first unusable value of a field.

    Parameters
    ----------
    index : number of the splat.
    component : position within the splat, or () if the whole vector is at fault.
    what : the value and the rule that it breaks.
    """

    index: int
    component: tuple[int, ...]
    what: str


def first_fault(field: Field, values: Array) -> Fault | None:
    """Return the first value of `field` that a model must not hold, or None.

    Parameters
    ----------
    values : the public array of the field (see `fields.public_shape`).
    """
    finite = np.isfinite(values)
    if not finite.all():
        index, *component = (int(i) for i in np.argwhere(~finite)[0])
        value = float(values[(index, *component)])
        return Fault(index, tuple(component), f"value is {value}, must be finite")
    if field.bounds is not None:
        low, high = field.bounds
        bad = np.flatnonzero((values < low * (1 - LIMIT_SLACK)) | (values > high * (1 + LIMIT_SLACK)))
        if bad.size == 0:
            return None
        index = int(bad[0])
        return Fault(index, (), f"value is {float(values[index]):.6g}, must be {low:g} to {high:g}")
    if not field.nonzero and field.limit is None:
        return None
    norms = np.linalg.norm(values.astype(np.float64), axis=1)
    if field.nonzero:
        bad = np.flatnonzero((norms < QUAT_NORM_MIN) | (norms > QUAT_NORM_MAX))
        rule = "above 0" if bad.size and norms[bad[0]] < 1 else f"at most {QUAT_NORM_MAX:g}"
    else:
        assert field.limit is not None
        bad = np.flatnonzero(norms > field.limit * (1 + LIMIT_SLACK))
        rule = f"at most {field.limit:.6g}"
    if bad.size == 0:
        return None
    index = int(bad[0])
    return Fault(index, (), f"norm is {norms[index]:.6g}, must be {rule}")


def far_away(arrays: Mapping[str, Array]) -> str | None:
    """Return a text on splats that float32 moves by more than a tenth of their size, in most of a model; else None.

    Kernels and files compute in float32. Only positions in double precision can be so far from the origin.
    """
    mean = arrays["mean"]
    if mean.dtype == np.float32 or not len(mean):
        return None
    with np.errstate(over="ignore"):
        moved = float(np.median(np.abs(mean - mean.astype(np.float32)).max(axis=1)))
        size = float(np.exp(np.median(arrays["log_scale"].max(axis=1))))
    if moved <= _MOVED * size:
        return None
    place = ", ".join(f"{value:.6g}" for value in np.median(mean, axis=0))
    return (
        f"its splats are around ({place}), where float32 moves them by {moved:.2g}, and half of them are smaller than "
        f"{size:.2g}: subtract a point near them from all positions first"
    )


def unusable(schema: Schema, arrays: Mapping[str, Array]) -> NDArray[np.bool_]:
    """Return (N,) whether a splat has a value that is not finite, or a rotation or direction without one.

    Parameters
    ----------
    arrays : every field of the schema, in its public shape.
    """
    bad = np.zeros(len(arrays["mean"]), bool)
    for field in schema:
        values = arrays[field.name]
        bad |= ~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
        if field.nonzero:
            with np.errstate(invalid="ignore"):
                norms = np.linalg.norm(values.astype(np.float64), axis=1)
            bad |= ~((norms >= QUAT_NORM_MIN) & (norms <= QUAT_NORM_MAX))
    return bad


def sh_degree_for(arrays: Mapping[str, Array]) -> int:
    """Return the SH degree of `arrays["sh"]`, or the next lower one, so that `check_arrays` names the fault."""
    sh = arrays.get("sh")
    coefficients = sh.shape[1] if sh is not None and sh.ndim == 3 else 1
    return max((d for d in range(MAX_SH_DEGREE + 1) if sh_coefficients(d) <= coefficients), default=0)


def check_arrays(schema: Schema, arrays: Mapping[str, Array]) -> None:
    """Check that `arrays` is a complete and usable model of `schema`.

    Raises
    ------
    InputError : a field is missing or unknown, an array has a wrong shape, or a value is unusable. The message names
        field, splat and value.
    """
    unknown = [name for name in arrays if name not in schema]
    if unknown:
        raise InputError(f"splats: unknown field {unknown[0]!r}; this shape has {', '.join(schema.names)}")
    n = len(arrays["mean"]) if "mean" in arrays and arrays["mean"].ndim else 0
    for field in schema:
        if field.name not in arrays:
            raise InputError(f"splats: field {field.name!r} is missing; give {', '.join(schema.names)}")
        values, expected = arrays[field.name], public_shape(field, n)
        if values.shape != expected:
            raise InputError(f"splats: field {field.name!r} has shape {values.shape}; expected {expected}")
    for field in schema:
        fault = first_fault(field, arrays[field.name])
        if fault is not None:
            place = ", ".join(str(i) for i in (fault.index, *fault.component))
            raise InputError(f"splats: {field.name}[{place}]: {fault.what}")

"""The content of a file of splats, and the treatment of values that a model must not hold.

Other programs write such values: .splat converters give an opacity of 255 the logit infinity, and a training run may
leave a few splats that are not finite. Readers keep the rest of the file.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .checks import Fault, first_fault, unusable
from .fields import Array, Field, Schema, sh_degree_of
from .low_pass import LOW_PASS
from .near_plane import NEAR_PLANE
from .shapes import GAUSSIAN, shape_named

OPAQUE_LOGIT = 15.0  # stands for an opacity of 1; its negative stands for 0
FLAT_LOG_SCALE = -69.0  # stands for a standard deviation of 0
_MAX_UNUSABLE = 0.5  # share of unusable splats above which a file is refused
_OPACITIES = ("opacity_logit", "opacity_minus_logit")


@dataclass(frozen=True, slots=True)
class StoredSplats:
    """The content of a file of splats.

    Parameters
    ----------
    shape, normalisation : names of the kernel and its normalisation.
    antialiased, near_plane, low_pass : see `Splats`.
    arrays : public arrays by field name, all of one real type.
    """

    shape: str
    normalisation: str
    antialiased: bool
    arrays: Mapping[str, Array]
    near_plane: float = NEAR_PLANE
    low_pass: float = LOW_PASS


def gaussians(path: object, arrays: Mapping[str, NDArray[np.floating]], antialiased: bool = False) -> StoredSplats:
    """Return the content of a file that holds Gaussians only, without unusable splats (see `usable_arrays`)."""
    with np.errstate(over="ignore"):  # values that overflow are found below
        single: dict[str, Array] = {name: values.astype(np.float32) for name, values in arrays.items()}
    degree = sh_degree_of(single["sh"].shape[1])
    return StoredSplats(GAUSSIAN.name, "peak", antialiased, usable_arrays(path, GAUSSIAN.schema(degree), single))


def usable_arrays(
    path: object,
    schema: Schema,
    arrays: Mapping[str, Array],
    place: Callable[[Field, Fault], str] | None = None,
) -> dict[str, Array]:
    """Return the arrays of a file without the splats that have an unusable value, with a warning that counts them.

    Infinite logits become `OPAQUE_LOGIT` or its negative, and scales of 0 become tiny. Values that are finite but
    outside the limits of their field are an error, because the file then means something else.

    Parameters
    ----------
    place : returns how the file names a value.

    Raises
    ------
    InputError : most of the splats are unusable, or a value is outside its limits.
    """
    place = place or _plain_place
    arrays = {name: _clamped(name, values) for name, values in arrays.items()}
    bad = unusable(schema, arrays)
    kept = np.flatnonzero(~bad)
    if len(kept) < len(bad):
        first = next(_faults(schema, arrays, place, np.arange(len(bad))))
        counted = f"{len(bad) - len(kept)} of {len(bad)} splats"
        if len(kept) < (1 - _MAX_UNUSABLE) * len(bad):
            raise InputError(f"{path}: {counted} are unusable ({first}): export it again")
        warnings.warn(f"{path}: left out {counted} ({first})", stacklevel=4)
        arrays = {name: values[kept] for name, values in arrays.items()}
    for what in _faults(schema, arrays, place, kept):
        raise InputError(f"{path}: {what}; remove that splat or export again")
    return arrays


def joined_parts(path: object, parts: Sequence[StoredSplats]) -> StoredSplats:
    """Return the splats of the parts of a file as one, in float32, without unusable ones (see `usable_arrays`).

    SH bands that some parts lack are 0. The near plane is the smallest.

    Raises
    ------
    InputError : the parts have several kernels.
    """
    first = parts[0]
    kinds = {(part.shape, part.normalisation, part.antialiased, part.low_pass) for part in parts}
    if len(kinds) > 1:
        raise InputError(f"{path}: has splats of several kernels; export each of them as a file")
    width = max(part.arrays["sh"].shape[1] for part in parts)
    arrays = {}
    for name in first.arrays:
        several = [part.arrays[name] for part in parts]
        if name == "sh":
            several = [np.pad(sh, ((0, 0), (0, width - sh.shape[1]), (0, 0))) for sh in several]
        with np.errstate(over="ignore"):  # values that overflow are found below
            arrays[name] = np.concatenate(several).astype(np.float32)
    schema = shape_named(first.shape).schema(sh_degree_of(width))
    return replace(first, arrays=usable_arrays(path, schema, arrays), near_plane=min(part.near_plane for part in parts))


def check_gaussian(path: object, shape: str, ending: str) -> None:
    """Raise InputError if splats of this shape cannot be written as a file that holds Gaussians only."""
    if shape_named(shape) is not GAUSSIAN:
        raise InputError(f"{path}: {ending} files hold Gaussians, not {shape} splats; convert them first")


def _clamped(name: str, values: Array) -> Array:
    """Return the values with infinities replaced that other programs write on purpose."""
    if name in _OPACITIES and np.isinf(values).any():
        return np.where(np.isinf(values), np.copysign(np.asarray(OPAQUE_LOGIT, values.dtype), values), values)
    if name == "log_scale" and np.isneginf(values).any():
        return np.where(np.isneginf(values), np.asarray(FLAT_LOG_SCALE, values.dtype), values)
    return values


def _faults(
    schema: Schema, arrays: Mapping[str, Array], place: Callable[[Field, Fault], str], numbers: NDArray[np.int64]
) -> Iterator[str]:
    """Yield the first fault of each field, as text.

    Parameters
    ----------
    numbers : the number in the file of each splat.
    """
    for field in schema:
        fault = first_fault(field, arrays[field.name])
        if fault is not None:
            named = replace(fault, index=int(numbers[fault.index]))
            yield f"{place(field, named)}: {fault.what}"


def _plain_place(field: Field, fault: Fault) -> str:
    return f"{field.name} of splat {fault.index}"

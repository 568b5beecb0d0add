"""What a strategy reads of the splats: a summary of every splat, and all parameters of a few.

A strategy decides by the size, the opacity and the gradients of every splat. Only the splats that it changes need their
other parameters. So a device with memory of its own sends 2 numbers of each splat to the host instead of up to 59.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...errors import TrainingError
from ...splats.fields import Array
from ...splats.optical_depth import finite_rows, opacity_names
from ...splats.shapes import Shape
from .edit import Indices

# Number of values from which `smallest` estimates a bound, and the factor by which it estimates too many.
_SAMPLE = 8192
_MARGIN = 1.1


@dataclass(frozen=True, slots=True)
class Summary:
    """Two numbers of each splat. They are NaN if a parameter of the splat is not finite (optical_depth.finite_rows).

    Attributes
    ----------
    log_size : (N,) the largest log scale.
    raw_opacity : (N,) the raw value of the largest |opacity|; of signed shapes, its absolute value.
    """

    log_size: Array
    raw_opacity: Array

    @property
    def finite(self) -> NDArray[np.bool_]:
        """Whether all parameters of a splat are finite, (N,)."""
        return ~np.isnan(self.log_size)

    def some_finite(self) -> NDArray[np.bool_]:
        """Return `finite`. Raise TrainingError if there are splats and none is finite."""
        finite = self.finite
        if len(finite) and not finite.any():
            raise TrainingError("no splat has finite parameters any more: lower the learning rates")
        return finite


class SplatTable(Protocol):
    """The splats before a densification."""

    def summary(self) -> Summary:
        """Return the summary of all splats."""

    def take(self, rows: Indices) -> dict[str, Array]:
        """Return the public arrays of some splats, without the colour."""

    def field(self, name: str) -> Array:
        """Return the public array of one field of all splats."""


class HostSplats:
    """Splats on the host, the reference of `DeviceSplats` (on_device.py). arrays : all public arrays of a model."""

    def __init__(self, shape: Shape, arrays: Mapping[str, Array]) -> None:
        self.shape, self.arrays = shape, arrays

    def summary(self) -> Summary:
        raw = np.stack([self.arrays[name] for name in opacity_names(self.arrays)])
        raw_opacity = (np.abs(raw) if self.shape.signed else raw).max(axis=0)
        log_size, sound = self.arrays["log_scale"].max(axis=1), finite_rows(self.arrays)
        nan = log_size.dtype.type(np.nan)
        return Summary(np.where(sound, log_size, nan), np.where(sound, raw_opacity, nan))

    def take(self, rows: Indices) -> dict[str, Array]:
        return {name: array[rows] for name, array in self.arrays.items() if name != "sh"}

    def field(self, name: str) -> Array:
        return self.arrays[name]


def smallest(values: Array, count: int) -> Indices:
    """Return the indices of the `count` smallest values, in rising order of index. The first of equal ones count.

    values : (N,) without NaN.
    """
    count = min(count, len(values))
    if count <= 0:
        return np.zeros(0, np.int64)
    among = _below_estimate(values, count)
    found = values[among]
    last = np.partition(found, count - 1)[count - 1]
    chosen = found < last
    chosen[np.flatnonzero(found == last)[: count - np.count_nonzero(chosen)]] = True
    return among[chosen]


def _below_estimate(values: Array, count: int) -> Indices:
    """Return the indices of at least `count` values, in rising order, which include the `count` smallest ones.

    A sample estimates the largest of them. A pass over all values that compares them with one number is several times
    faster than a partition.
    """
    sample = values[:: max(len(values) // _SAMPLE, 1)]
    rank = int(_MARGIN * len(sample) * count / len(values)) + _SAMPLE // 128
    if rank < len(sample):
        among = np.flatnonzero(values <= np.partition(sample, rank)[rank])
        if len(among) >= count:
            return among
    return np.arange(len(values))

"""Splats, their gradients and their statistics on the device. A buffer has a row for each component of a field, and a
column for each splat.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ..device.device import Device
from ..device.memory import Pool, fill_zero, to_device, to_host
from ..device.opencl import Buffer
from ..device.pending_arrays import PendingArrays
from ..splats.fields import Array, Group, Schema, public_shape
from ..splats.harmonics import sh_basis
from ..splats.splats import Splats

CAPACITY_STEP = 1024  # columns are padded, so that whole groups of 64 items with 16 lanes stay inside
COMPACT_ROWS = 6  # of `CompactGradients.sh`: the gradient of the colour, and a direction
_ROWS_AT_ONCE = 8  # rows of a field that are copied together, so that the host holds no second copy of a large field


def capacity_for(n: int) -> int:
    """Return the number of columns to allocate for n splats."""
    return max(CAPACITY_STEP, -(-n // CAPACITY_STEP) * CAPACITY_STEP)


class ParameterBuffers:
    """One value for each parameter of every splat, in buffers `geom` and `sh`, each [rows, capacity]; zero at first."""

    def __init__(
        self,
        device: Device,
        schema: Schema,
        capacity: int,
        dtype: np.dtype[np.floating],
    ) -> None:
        self.device, self.schema, self.capacity, self.dtype = device, schema, capacity_for(capacity), dtype
        self.buffers = {group: device.alloc(self.group_bytes(group)) for group in Group}
        for group, buffer in self.buffers.items():
            fill_zero(device, buffer, self.group_bytes(group))

    def group_bytes(self, group: Group) -> int:
        """Return the size of one of the two buffers."""
        return self.schema.rows(group) * self.capacity * self.dtype.itemsize

    @property
    def geom(self) -> Buffer:
        return self.buffers[Group.GEOM]

    @property
    def sh(self) -> Buffer:
        return self.buffers[Group.SH]

    def upload(self, arrays: Mapping[str, Array]) -> None:
        """Copy arrays of n <= capacity splats, by field, into the first n columns (shapes: fields.public_shape)."""
        for name in arrays:
            field = self.schema[name]
            array = np.asarray(arrays[name], self.dtype)
            columns = array.reshape(len(array), field.width)
            for row in range(0, field.width, _ROWS_AT_ONCE):
                part = columns[:, row : row + _ROWS_AT_ONCE].T
                padded = np.zeros((len(part), self.capacity), self.dtype)
                padded[:, : part.shape[1]] = part
                to_device(self.device, self.buffers[field.group], padded, self._offset_bytes(name, row))

    def download(self, n: int, names: Sequence[str] | None = None, first: int = 0) -> dict[str, Array]:
        """Return the arrays of n splats from `first` on, by field."""
        arrays: dict[str, Array] = {}
        for name in self.schema.names if names is None else names:
            field = self.schema[name]
            array: Array = np.empty((n, field.width), self.dtype)
            for row in range(0, field.width, _ROWS_AT_ONCE):
                rows: Array = np.empty((min(_ROWS_AT_ONCE, field.width - row), self.capacity), self.dtype)
                to_host(self.device, self.buffers[field.group], rows, self._offset_bytes(name, row))
                array[:, row : row + len(rows)] = rows[:, first : first + n].T
            arrays[name] = array.reshape(public_shape(field, n))
        return arrays

    def pending(self, n: int, names: Sequence[str] | None = None, first: int = 0) -> PendingArrays:
        """Return what `download` returns, but each field is read when it is asked for."""

        def read(name: str) -> Array:
            return self.download(n, (name,), first)[name]

        return PendingArrays({name: partial(read, name) for name in (self.schema.names if names is None else names)})

    def _offset_bytes(self, name: str, row: int) -> int:
        return (self.schema.offset(name) + row) * self.capacity * self.dtype.itemsize


class SplatBuffers(ParameterBuffers):
    """Splats on the device; `n` of `capacity` columns are in use.

    Parameters
    ----------
    n_frozen : splats that a run shows but does not change (training/context.py), the last ones of all.
    """

    def __init__(
        self,
        device: Device,
        schema: Schema,
        capacity: int,
        dtype: np.dtype[np.floating],
        n_frozen: int = 0,
    ) -> None:
        super().__init__(device, schema, capacity, dtype)
        self.n, self.n_frozen = 0, n_frozen

    @classmethod
    def of(
        cls,
        device: Device,
        splats: Splats,
        dtype: np.dtype[np.floating],
        capacity: int = 0,
    ) -> SplatBuffers:
        """Copy splats to the device, with room for `capacity`."""
        self = cls(device, splats.schema, max(capacity, len(splats)), dtype)
        self.set(splats.arrays)
        return self

    @property
    def n_live(self) -> int:
        """Number of splats that a run changes: those before the frozen ones."""
        return self.n - self.n_frozen

    @property
    def live_capacity(self) -> int:
        """Number of columns of buffers that only splats before the frozen ones need."""
        return capacity_for(self.capacity - self.n_frozen)

    def set(self, arrays: Mapping[str, Array]) -> None:
        """Replace all splats."""
        self.upload(arrays)
        self.n = len(arrays["mean"])


class CompactGradients(ParameterBuffers):
    """Gradients of all parameters. The gradients of the SH coefficients are kept as the two factors of a product.

    `sh` is [6 photos, capacity], or (N, 2 photos, 3) on the host: for each photo the gradient of the colour, and the
    unit direction from the camera, at which the SH basis is evaluated. Their product would have 3 K numbers for each
    splat and would be the largest output of the backward pass.

    Parameters
    ----------
    photos : photos whose gradients are summed; the backward pass writes those of one.
    """

    def __init__(
        self, device: Device, schema: Schema, capacity: int, dtype: np.dtype[np.floating], photos: int = 1
    ) -> None:
        self.sh_degree = schema.sh_degree
        fields = (replace(field, width=COMPACT_ROWS * photos) if field.name == "sh" else field for field in schema)
        super().__init__(device, Schema(tuple(fields)), capacity, dtype)

    def written_out(self, n: int) -> dict[str, Array]:
        """Return the gradients of the first n splats by field, with `sh` multiplied out to (N, K, 3)."""
        arrays = self.download(n)
        sh = sum(
            sh_basis(direction, self.sh_degree)[:, :, None] * v_rgb[:, None]
            for v_rgb, direction in zip(*(arrays["sh"][:, part::2].swapaxes(0, 1) for part in (0, 1)), strict=True)
        )
        return arrays | {"sh": np.asarray(sh, self.dtype)}


class SplatStatistics:
    """Statistics of every splat's gradients over the images since `reset` (rows: cl/render/project.cl).

    Densification reads them: sums of the screen gradient and of the depth gradient, and the number of images in which
    the splat was visible.
    """

    ROWS = 3
    SCREEN_GRADIENT, DEPTH_GRADIENT, TIMES_SEEN = range(ROWS)

    def __init__(self, pool: Pool, dtype: np.dtype[np.floating]) -> None:
        self.device, self.dtype = pool.device, dtype
        self._rows = pool.buffer(dtype, self.ROWS)
        self._capacity = 0

    def reserve(self, capacity: int) -> Buffer:
        """Return the buffer [3, capacity]. Another capacity than before resets the statistics."""
        if capacity == self._capacity:
            return self._rows.buffer
        self._capacity = capacity
        return self._rows.zeros(capacity)

    def reset(self) -> None:
        """Set all statistics to zero."""
        if self._capacity:
            self._rows.zeros(self._capacity)

    def read(self, n: int) -> Array:
        """Return the statistics (3, n) of the first n splats."""
        if not self._capacity:
            return np.zeros((self.ROWS, n), self.dtype)
        rows = np.empty((self.ROWS, self._capacity), self.dtype)
        return to_host(self.device, self._rows.buffer, rows)[:, :n]

    def write(self, statistics: Array, capacity: int) -> None:
        """Continue from statistics (3, n)."""
        rows = np.zeros((self.ROWS, capacity), self.dtype)
        rows[:, : statistics.shape[1]] = statistics
        to_device(self.device, self.reserve(capacity), rows)

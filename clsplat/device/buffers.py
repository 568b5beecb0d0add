"""Device memory: a pool of named buffers that only grow, and the splats as component-major buffers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..splats.schema import Array, Group, Schema, public_shape
from ..splats.splats import Splats
from .device import Device

CAPACITY_STEP = 1024  # columns are padded: whole groups of 64 items of 16 lanes stay inside
HALF_MAX = 65504.0  # largest half-precision number


class Pool:
    """Buffers by name. A larger request replaces the buffer, half as large again; contents are then lost."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self._buffers: dict[str, Any] = {}
        self._bytes: dict[str, int] = {}

    def get(self, name: str, nbytes: int) -> Any:
        """Buffer of at least `nbytes`; raises DeviceError when the device has no room for it."""
        if self._bytes.get(name, -1) < nbytes:
            first = name not in self._bytes
            self._buffers.pop(name, None)
            most = max(self.device.info.max_alloc_bytes, int(nbytes))
            size = int(nbytes) if first else min(int(1.5 * nbytes), most)
            self._bytes[name] = 0
            self._buffers[name] = self.device.alloc(size)
            self._bytes[name] = size
        return self._buffers[name]

    def zeroed(self, name: str, nbytes: int) -> Any:
        """As `get`, set to zero up to `nbytes`."""
        buffer = self.get(name, nbytes)
        fill_zero(self.device, buffer, nbytes)
        return buffer

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return sum(self._bytes.values())


def fill_zero(device: Device, buffer: Any, nbytes: int) -> None:
    """Zero the first `nbytes` (a multiple of 4) of a buffer."""
    import pyopencl as cl

    if nbytes:
        event = cl.enqueue_fill_buffer(device.queue, buffer, np.zeros(1, np.uint32), 0, nbytes)
        device.observe("fill", (nbytes,), event)


def copy(device: Device, source: Any, target: Any, nbytes: int) -> None:
    """Copy the first `nbytes` of a buffer to another."""
    import pyopencl as cl

    if nbytes:
        device.observe("copy", (nbytes,), cl.enqueue_copy(device.queue, target, source, byte_count=nbytes))


def send_to_device(device: Device, buffer: Any, array: NDArray[Any], queue: Any = None, after: Any = None) -> Any:
    """Copy an array into a buffer without waiting, on the device's or another queue, after an event if one is given.

    Keep what is returned until the copy is done: letting go waits.
    """
    import pyopencl as cl

    event = cl.enqueue_copy(queue or device.queue, buffer, np.ascontiguousarray(array), is_blocking=False,
                            wait_for=None if after is None else [after])
    device.observe("upload", (array.nbytes,), event)
    return event


def to_device(device: Device, buffer: Any, array: NDArray[Any], offset: int = 0) -> None:
    """Copy an array into a buffer, at `offset` bytes; returns when it is there."""
    import pyopencl as cl

    if array.size:
        event = cl.enqueue_copy(device.queue, buffer, np.ascontiguousarray(array), dst_offset=offset)
        device.observe("upload", (array.nbytes,), event)


def to_host(device: Device, buffer: Any, array: NDArray[Any], offset: int = 0) -> NDArray[Any]:
    """Fill `array` from a buffer, from `offset` bytes on; returns it."""
    import pyopencl as cl

    if array.size:
        event = cl.enqueue_copy(device.queue, array, buffer, src_offset=offset)
        device.observe("download", (array.nbytes,), event)
    return array


def capacity_for(n: int) -> int:
    """Columns to allocate for n splats."""
    return max(CAPACITY_STEP, -(-n // CAPACITY_STEP) * CAPACITY_STEP)


class ParameterBuffers:
    """One value per parameter of every splat: `geom` and `sh`, each [rows, capacity]. Starts at zero."""

    def __init__(self, device: Device, schema: Schema, capacity: int, dtype: np.dtype[np.floating],
                 sh_dtype: np.dtype[np.floating] | None = None) -> None:
        self.device, self.schema, self.capacity, self.dtype = device, schema, capacity_for(capacity), dtype
        self.dtypes = {Group.GEOM: dtype, Group.SH: sh_dtype or dtype}
        self.buffers = {group: device.alloc(self.group_bytes(group)) for group in Group}
        for group, buffer in self.buffers.items():
            fill_zero(device, buffer, self.group_bytes(group))

    def group_bytes(self, group: Group) -> int:
        """Size of one of the two buffers."""
        return self.schema.rows(group) * self.capacity * self.dtypes[group].itemsize

    @property
    def geom(self) -> Any:
        return self.buffers[Group.GEOM]

    @property
    def sh(self) -> Any:
        return self.buffers[Group.SH]

    def upload(self, arrays: Mapping[str, Array]) -> None:
        """Public arrays (schema.public_shape) of n <= capacity splats, by field, into the first n columns."""
        for name in arrays:
            field = self.schema[name]
            dtype = self.dtypes[field.group]
            array = np.asarray(arrays[name], self.dtype)
            if dtype == np.float16:
                array = array.clip(-HALF_MAX, HALF_MAX)
            rows = array.reshape(len(array), field.width).T
            padded = np.zeros((field.width, self.capacity), dtype)
            padded[:, : rows.shape[1]] = rows
            to_device(self.device, self.buffers[field.group], padded, self._offset_bytes(field.name))

    def download(self, n: int, names: tuple[str, ...] | None = None) -> dict[str, Array]:
        """Public arrays of the first n splats."""
        arrays: dict[str, Array] = {}
        for name in names or self.schema.names:
            field = self.schema[name]
            rows: Array = np.empty((field.width, self.capacity), self.dtypes[field.group])
            to_host(self.device, self.buffers[field.group], rows, self._offset_bytes(name))
            arrays[name] = np.ascontiguousarray(rows[:, :n].T).reshape(public_shape(field, n))
        return arrays

    def _offset_bytes(self, name: str) -> int:
        return self.schema.offset(name) * self.capacity * self.dtypes[self.schema[name].group].itemsize


class SplatBuffers(ParameterBuffers):
    """Splats on the device; `n` of `capacity` columns are in use."""

    def __init__(self, device: Device, schema: Schema, capacity: int, dtype: np.dtype[np.floating],
                 sh_dtype: np.dtype[np.floating] | None = None) -> None:
        super().__init__(device, schema, capacity, dtype, sh_dtype)
        self.n = 0

    @classmethod
    def of(cls, device: Device, splats: Splats, dtype: np.dtype[np.floating],
           capacity: int = 0, sh_dtype: np.dtype[np.floating] | None = None) -> SplatBuffers:
        """Upload of host splats, with room for `capacity`; colour as `sh_dtype`, if given."""
        self = cls(device, splats.schema, max(capacity, len(splats)), dtype, sh_dtype)
        self.set(splats.to_numpy())
        return self

    def set(self, arrays: Mapping[str, Array]) -> None:
        """Replace all splats."""
        self.upload(arrays)
        self.n = len(arrays["mean"])

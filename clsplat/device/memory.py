"""Device memory: a pool of named buffers that only grow, and copies between host and device."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .device import Device


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

    event = cl.enqueue_copy(
        queue or device.queue,
        buffer,
        np.ascontiguousarray(array),
        is_blocking=False,
        wait_for=None if after is None else [after],
    )
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

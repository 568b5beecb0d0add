"""Device memory: buffers that grow and are reused, and copies between host and device."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..errors import DeviceError
from .device import Device
from .opencl import Buffer, Event

_GROWTH = 1.5  # size of a buffer that had to grow, in sizes that were needed


class GrowingBuffer:
    """Device memory for rows of one type. It grows with what it has to hold and is reused otherwise.

    Parameters
    ----------
    dtype : type of an element.
    width : elements of a row.
    """

    def __init__(self, device: Device, dtype: DTypeLike, width: int = 1) -> None:
        self.device, self.dtype, self.width = device, np.dtype(dtype), width
        self.nbytes = 0
        self._buffer: Buffer | None = None

    def reserve(self, rows: int) -> Buffer:
        """Return the buffer with room for `rows` rows. Growing it loses its contents.

        Raises
        ------
        DeviceError : the device does not have the memory.
        """
        needed = self._bytes_of(rows)
        if self._buffer is None or self.nbytes < needed:
            size = needed
            if self._buffer is not None:
                size = min(int(_GROWTH * needed), max(self.device.info.max_alloc_bytes, needed))
            self._buffer, self.nbytes = None, 0  # released first: memory may be short
            try:
                self._buffer = self.device.alloc(size)
            except DeviceError:
                if size == needed:
                    raise
                size = needed
                self._buffer = self.device.alloc(size)
            self.nbytes = size
        return self._buffer

    @property
    def buffer(self) -> Buffer:
        """The buffer as `reserve` last returned it. Raises RuntimeError if nothing was reserved."""
        if self._buffer is None:
            raise RuntimeError("the buffer has no memory yet: call `reserve` first")
        return self._buffer

    def zeros(self, rows: int) -> Buffer:
        """Return the buffer with its first `rows` rows set to zero."""
        buffer = self.reserve(rows)
        fill_zero(self.device, buffer, self._bytes_of(rows))
        return buffer

    def read(self, rows: int) -> NDArray[Any]:
        """Return the first rows: (rows,), or (rows, width) if a row has several elements."""
        if self.nbytes < self._bytes_of(rows):
            raise RuntimeError(f"a buffer of {self.nbytes} bytes does not hold {rows} rows")
        shape = (rows,) if self.width == 1 else (rows, self.width)
        return to_host(self.device, self.buffer, np.empty(shape, self.dtype))

    def _bytes_of(self, rows: int) -> int:
        return int(rows) * self.width * self.dtype.itemsize


class Pool:
    """The growing buffers of one owner, and their total size."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self._buffers: list[GrowingBuffer] = []

    def buffer(self, dtype: DTypeLike, width: int = 1) -> GrowingBuffer:
        """Return a new, empty buffer for rows of `width` elements."""
        buffer = GrowingBuffer(self.device, dtype, width)
        self._buffers.append(buffer)
        return buffer

    @property
    def nbytes(self) -> int:
        """Bytes of device memory held."""
        return sum(buffer.nbytes for buffer in self._buffers)


class UploadQueue:
    """Uploads that run beside the commands of the device's queue."""

    def __init__(self, device: Device) -> None:
        import pyopencl as cl

        self._device = device
        self._queue = cl.CommandQueue(device.context, properties=cl.command_queue_properties.PROFILING_ENABLE)

    def send(self, buffer: Buffer, array: NDArray[Any], after: Event | None = None) -> Event:
        """Start to copy an array into a buffer, once the event `after` is complete. Keep the returned event."""
        event = _enqueue_upload(self._device, self._queue, buffer, array, after)
        self._queue.flush()
        return event

    def wait_on_device(self, event: Event) -> None:
        """Let later commands of the device's queue wait for an upload; the host does not wait."""
        cl: Any = _pyopencl()
        cl.enqueue_barrier(self._device.queue, wait_for=[event])


def fill_zero(device: Device, buffer: Buffer, nbytes: int) -> None:
    """Set the first `nbytes` bytes (a multiple of 4) of a buffer to zero."""
    if nbytes:
        event = _pyopencl().enqueue_fill_buffer(device.queue, buffer, np.zeros(1, np.uint32), 0, nbytes)
        device.observe("fill", (nbytes,), event)


def copy(device: Device, source: Buffer, target: Buffer, nbytes: int) -> None:
    """Copy the first `nbytes` bytes of a buffer to another."""
    if nbytes:
        event = _pyopencl().enqueue_copy(device.queue, target, source, byte_count=nbytes)
        device.observe("copy", (nbytes,), event)


def send_to_device(device: Device, buffer: Buffer, array: NDArray[Any]) -> Event:
    """Start to copy an array into a buffer, without waiting.

    Keep the returned event until the copy is complete: its destructor waits.
    """
    return _enqueue_upload(device, device.queue, buffer, array, None)


def to_device(device: Device, buffer: Buffer, array: NDArray[Any], offset: int = 0) -> None:
    """Copy an array into a buffer at `offset` bytes, and wait."""
    if array.size:
        source = np.ascontiguousarray(array)
        event = _pyopencl().enqueue_copy(device.queue, buffer, source, dst_offset=offset)
        device.observe("upload", (array.nbytes,), event)


def to_host(device: Device, buffer: Buffer, array: NDArray[Any], offset: int = 0) -> NDArray[Any]:
    """Fill an array from a buffer, starting at `offset` bytes, and return the array."""
    if array.size:
        event = _pyopencl().enqueue_copy(device.queue, array, buffer, src_offset=offset)
        device.observe("download", (array.nbytes,), event)
    return array


def send_to_host(device: Device, buffer: Buffer, array: NDArray[Any]) -> Event:
    """Start to fill an array from a buffer, without waiting. The array is valid after the event's `wait`."""
    event: Event = _pyopencl().enqueue_copy(device.queue, array, buffer, is_blocking=False)
    device.observe("download", (array.nbytes,), event)
    return event


def _enqueue_upload(device: Device, queue: Any, buffer: Buffer, array: NDArray[Any], after: Event | None) -> Event:
    wait_for = None if after is None else [after]
    source = np.ascontiguousarray(array)
    event: Event = _pyopencl().enqueue_copy(queue, buffer, source, is_blocking=False, wait_for=wait_for)
    device.observe("upload", (array.nbytes,), event)
    return event


def _pyopencl() -> Any:
    """The library, without its own types: `Buffer` and `Event` stand for them here."""
    import pyopencl

    return pyopencl

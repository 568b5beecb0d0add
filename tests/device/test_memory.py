"""Buffers that grow: contents, sizes, reuse, and errors instead of silent allocations."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from clsplat.device.device import Device
from clsplat.device.memory import Pool, UploadQueue, to_device, to_host
from clsplat.device.opencl import Buffer
from clsplat.device.pending_arrays import PendingArrays
from clsplat.errors import DeviceError


def test_a_buffer_is_reused_until_it_is_too_small(device: Device) -> None:
    pool = Pool(device)
    memory = pool.buffer(np.uint32, 3)
    first = memory.reserve(10)
    assert memory.nbytes == pool.nbytes == first.size == 120
    assert memory.reserve(4) is first
    assert memory.buffer is first
    grown = memory.reserve(20)
    assert grown is not first
    assert memory.nbytes == grown.size == 360  # half as large again
    assert memory.reserve(30) is grown


def test_a_buffer_does_not_grow_beyond_the_largest_allocation(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "info", replace(device.info, max_alloc_bytes=4 * 25))
    memory = Pool(device).buffer(np.uint32)
    memory.reserve(1)
    assert memory.reserve(20).size == 4 * 25


def test_a_buffer_takes_what_is_needed_if_there_is_no_more(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    memory = Pool(device).buffer(np.uint32)
    memory.reserve(1)
    alloc, asked = device.alloc, []

    def limited(size: int) -> Buffer:
        asked.append(size)
        if size > 100:
            raise DeviceError("no more than 100 bytes")
        return alloc(size)

    monkeypatch.setattr(device, "alloc", limited)
    assert memory.reserve(20).size == memory.nbytes == 80
    assert asked == [120, 80]
    with pytest.raises(DeviceError, match="no more than 100 bytes"):
        memory.reserve(26)


def test_rows_are_read_back(device: Device) -> None:
    memory = Pool(device).buffer(np.float32, 2)
    rows = np.arange(12, dtype=np.float32).reshape(6, 2)
    to_device(device, memory.reserve(6), rows)
    np.testing.assert_array_equal(memory.read(4), rows[:4])
    memory.zeros(3)
    np.testing.assert_array_equal(memory.read(6), np.where(np.arange(6)[:, None] < 3, 0, rows))


def test_reading_what_was_never_reserved_is_an_error(device: Device) -> None:
    memory = Pool(device).buffer(np.float32)
    with pytest.raises(RuntimeError, match="no memory yet"):
        _ = memory.buffer
    memory.reserve(2)
    with pytest.raises(RuntimeError, match="does not hold 3 rows"):
        memory.read(3)


def test_uploads_beside_the_device_s_queue(device: Device) -> None:
    """A later command of the device's queue finds the array; a second upload waits for an event."""
    queue, values = UploadQueue(device), np.arange(1000, dtype=np.int32)
    buffer = device.alloc(values.nbytes)
    first = queue.send(buffer, values)
    second = queue.send(buffer, values[::-1], after=first)
    queue.wait_on_device(second)
    np.testing.assert_array_equal(to_host(device, buffer, np.empty_like(values)), values[::-1])


def test_pending_arrays_are_read_when_they_are_asked_for() -> None:
    values = {"a": np.zeros(2), "b": np.ones(3)}
    read: list[str] = []

    def reader(name: str) -> NDArray[Any]:
        read.append(name)
        return values[name]

    pending = PendingArrays.of(
        PendingArrays({name: partial(reader, name) for name in values}), {"c": np.arange(4), "a": np.full(2, 5.0)}
    )
    assert (list(pending), len(pending), read) == (["a", "b", "c"], 3, [])
    assert pending["a"].tolist() == [5.0, 5.0], "the last part counts"
    values["b"] = np.full(3, 7.0)
    assert pending["b"].tolist() == [7.0] * 3
    assert read == ["b"]
    assert set(dict(pending)) == {"a", "b", "c"}

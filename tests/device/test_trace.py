"""Recording: each command is listed once, in order and by name; commands outside the block are not."""

from __future__ import annotations

import numpy as np
import pytest

from clsplat.device.device import Device
from clsplat.device.memory import fill_zero, to_device, to_host
from clsplat.device.program import build
from clsplat.device.trace import TRANSFERS, recorded


def test_every_command_is_recorded_once(device: Device) -> None:
    smoke = build(device, ("measure/smoke.cl",)).smoke
    x = np.linspace(-1, 1, 100, dtype=np.float32)
    source, result = device.alloc(x.nbytes), device.alloc(x.nbytes)
    with recorded(device) as launches:
        to_device(device, source, x)
        fill_zero(device, result, x.nbytes)
        with recorded(device) as inner:
            smoke.over(x.size, x=source, y=result, n=x.size)
        smoke((0,), None, x=source, y=result, n=0)  # an empty launch
        to_host(device, result, np.empty_like(x))
    to_device(device, source, x)
    device.finish()
    assert [launch.name for launch in inner] == ["smoke"]
    assert [(launch.name, launch.size) for launch in launches] == [
        ("upload", (400,)),
        ("fill", (400,)),
        ("smoke", (128,)),
        ("download", (400,)),
    ]
    assert all(launch.ms >= 0 for launch in launches)
    assert inner[0].ms > 0
    assert {"upload", "fill", "download"} <= set(TRANSFERS)


def test_only_recorded_commands_have_times(device: Device) -> None:
    """Recording uses another queue. What it does stays in order with the commands before and after it."""
    import pyopencl as cl

    profiling = cl.command_queue_properties.PROFILING_ENABLE
    smoke = build(device, ("measure/smoke.cl",)).smoke
    x = np.linspace(-1, 1, 1 << 20, dtype=np.float32)
    first, second, third = (device.alloc(x.nbytes) for _ in range(3))
    to_device(device, first, x)
    queue = device.queue
    assert not queue.properties & profiling
    smoke.over(x.size, x=first, y=second, n=x.size)
    with recorded(device):
        assert device.queue.properties & profiling
        smoke.over(x.size, x=second, y=third, n=x.size)
    assert device.queue is queue
    smoke.over(x.size, x=third, y=first, n=x.size)
    y = x.copy()
    for _ in range(3):
        to_device(device, second, y)
        smoke.over(x.size, x=second, y=third, n=x.size)
        to_host(device, third, y)
    assert np.array_equal(to_host(device, first, np.empty_like(x)), y, equal_nan=True)


def test_recording_ends_with_an_error(device: Device) -> None:
    with pytest.raises(ZeroDivisionError), recorded(device):
        raise ZeroDivisionError
    assert device.observer is None
    assert not device.queue.properties

"""`Device` objects of one device share its context and programs, and nothing that a thread sets."""

from __future__ import annotations

import gc
from concurrent.futures import ThreadPoolExecutor
from weakref import WeakValueDictionary

import numpy as np
import pytest

from clsplat.device import context as context_module
from clsplat.device import program as program_module
from clsplat.device.device import Device, open_device
from clsplat.device.memory import to_device, to_host
from clsplat.device.program import build


def test_a_device_opened_again_builds_nothing(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    first = build(device, ("measure/smoke.cl",), {"AGAIN": 1})
    monkeypatch.setattr(program_module, "_compiled", None)  # building would fail
    again = open_device(device.info.index)
    second = build(again, ("measure/smoke.cl",), {"AGAIN": 1})
    assert again.context is device.context
    assert again.queue is not device.queue
    assert second is not first
    assert second.smoke is not first.smoke
    assert second.device is again


def test_devices_of_two_threads_do_not_disturb_each_other(device: Device) -> None:
    """Each thread sets arguments of a kernel of its own, although the program is one."""

    def results(seed: int) -> set[bytes]:
        own = open_device(device.info.index)
        smoke = build(own, ("measure/smoke.cl",)).smoke
        x = np.random.default_rng(seed).uniform(0.1, 1.0, 64).astype(np.float32)
        source, result = own.alloc(x.nbytes), own.alloc(x.nbytes)
        to_device(own, source, x)
        got = set()
        for _ in range(200):
            smoke((64,), None, x=source, y=result, n=x.size)
            got.add(to_host(own, result, np.empty_like(x)).tobytes())
        return got

    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(results, range(4)))
    assert [len(one) for one in found] == [1, 1, 1, 1]
    assert len(set.union(*found)) == 4


def test_a_context_goes_with_its_last_device(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process gets the memory of a context back, and the programs of one that failed do not stay."""
    monkeypatch.setattr(context_module, "_LIVING", living := WeakValueDictionary())
    first, second = open_device(device.info.index), open_device(device.info.index)
    assert first.shared is second.shared
    assert first.shared is not device.shared
    del first
    gc.collect()
    assert len(living) == 1
    del second
    gc.collect()
    assert not living

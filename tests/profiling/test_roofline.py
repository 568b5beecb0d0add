"""The roofline: both kernels compute what they claim, so that their times mean something."""

from __future__ import annotations

import numpy as np
import pytest

from clsplat.device.device import Device
from clsplat.device.memory import to_device, to_host
from clsplat.profiling.roofline import CHAINS, STEPS, measure_roofline, roofline_program


@pytest.mark.parametrize("chains", CHAINS)
def test_fma_takes_every_step_on_every_chain(device: Device, chains: int) -> None:
    lanes = 16 if device.info.type == "CPU" else 1
    sums = device.alloc(4 * 64)
    roofline_program(device, chains).fma_chains.over(64, sums=sums, a=0.96875, b=0.25, rounds=2)
    x = np.add.outer(np.arange(chains), np.arange(lanes)).astype(np.float64)
    for _ in range(2 * STEPS):
        x = 0.96875 * x + 0.25
    np.testing.assert_allclose(to_host(device, sums, np.empty(64, np.float32)), np.full(64, x.sum()), rtol=1e-5)


def test_copy_copies_all_and_no_more(device: Device) -> None:
    lanes = 16 if device.info.type == "CPU" else 1
    values = np.random.default_rng(0).random((100, lanes), np.float32)
    source, target = device.alloc(values.nbytes), device.alloc(values.nbytes)
    to_device(device, source, values)
    to_device(device, target, np.zeros_like(values))
    roofline_program(device, CHAINS[0]).copy_vectors.over(99, values=source, copied=target, n=99)
    copied = to_host(device, target, np.empty_like(values))
    np.testing.assert_array_equal(copied[:99], values[:99])
    assert not copied[99:].any()


def test_limits_are_positive(device: Device) -> None:
    limits = measure_roofline(device, repeats=1, nbytes=1 << 20)
    assert limits.copy > 0
    assert limits.fma > 0
    assert "GB/s" in str(limits)
    assert "Gflop/s" in str(limits)

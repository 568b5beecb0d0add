"""The roofline: both kernels compute what they claim, so that their times mean something."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from clsplat.device.device import Device
from clsplat.device.memory import to_device, to_host
from clsplat.profiling import roofline
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
    lanes = 16 if device.info.type == "CPU" else 4
    values = np.random.default_rng(0).random((100, lanes), np.float32)
    source, target = device.alloc(values.nbytes), device.alloc(values.nbytes)
    to_device(device, source, values)
    to_device(device, target, np.zeros_like(values))
    roofline_program(device, CHAINS[0]).copy_vectors.over(99, values=source, copied=target, n=99)
    copied = to_host(device, target, np.empty_like(values))
    np.testing.assert_array_equal(copied[:99], values[:99])
    assert not copied[99:].any()


def test_limits_are_work_over_time(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """With launches of 10 ms each, the limits follow from the bytes and operations that the tests above count."""
    launches: list[int] = []

    def ten_ms(launch: Callable[[], Any], repeats: int) -> float:
        launches.append(repeats)
        launch().wait()
        return 10.0

    monkeypatch.setattr(roofline, "_median_ms", ten_ms)
    limits = measure_roofline(device, repeats=3, nbytes=1 << 20)
    assert limits.copy == pytest.approx(2 * (1 << 20) / 0.01)
    assert launches == [1, 3] * len(CHAINS) + [3], "a launch of 10 ms is long enough"
    steps_of_a_lane = limits.fma * 0.01 / (2 * STEPS * 64 * max(CHAINS))  # 64 rounds of the most chains
    units = device.info.compute_units
    assert steps_of_a_lane == round(steps_of_a_lane)
    assert steps_of_a_lane % units == 0, "each compute unit has the same number of work-items"


def test_the_kernel_runs_long_enough_to_be_timed(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounds are added until a launch takes 5 ms on a device that needs 0.01 ms for each."""
    rounds: list[int] = []

    def launched(launch: Callable[[], Any], repeats: int) -> float:
        rounds.append(inspect.getclosurevars(launch).nonlocals["rounds"])
        return 0.01 * rounds[-1]

    monkeypatch.setattr(roofline, "_median_ms", launched)
    rate = roofline._fma(device, CHAINS[0], 3)
    assert rounds == sorted(rounds)
    assert 5.0 <= 0.01 * rounds[-1] <= 5.0 * 16
    assert rate > 0

"""Sums over the isects of each splat, which the work-items of a group share where a splat has many."""

from __future__ import annotations

import numpy as np
import pytest
from device_schedules import as_kind
from numpy.typing import NDArray

from clsplat.device.device import Device
from clsplat.device.memory import to_device, to_host
from clsplat.device.schedule import SCHEDULES
from clsplat.rendering.build import KernelBuild

COUNTS = (0, 1, 5, 255, 256, 257, 1000, 9000)  # isects of a splat; 256 is the most that one item adds up


def counts_of(n: int) -> NDArray[np.int64]:
    """Return isects of n splats: few in most groups, several large ones in the first and one in the last group."""
    counts = np.random.default_rng(3).integers(0, 9, n)
    counts[: len(COUNTS)] = COUNTS
    counts[-1] = 700
    return counts


@pytest.mark.parametrize("name", ["gpu32", "cpu16", "scalar"])
@pytest.mark.parametrize("group", [1, 32, 64])
@pytest.mark.parametrize("go_on", [0, 1])
def test_sums_are_those_of_numpy(device: Device, name: str, group: int, go_on: int) -> None:
    """70 splats are two groups, and the second one is not full."""
    schedule = SCHEDULES[name]
    if (group > 1) != (schedule.group > 1) or group > device.info.max_group:
        pytest.skip("not a group of this schedule")
    kernels = KernelBuild("skew-normal", 0, schedule)
    device = as_kind(device, "GPU" if group > 1 else device.info.type)
    rng, n, capacity = np.random.default_rng(4), 70, 96
    counts = counts_of(n)
    ends = np.cumsum(counts)
    ranges = np.stack([ends - counts, ends], axis=1).astype(np.uint32)
    grads = rng.normal(size=(int(ends[-1]), kernels.v_record)).astype(np.float32)
    before = rng.normal(size=(kernels.v_record, capacity)).astype(np.float32)
    buffers = {}
    for key, array in (("splat_isects", ranges), ("isect_grads", grads), ("moments", before)):
        buffers[key] = device.alloc(array.nbytes)
        to_device(device, buffers[key], array)
    kernels.pixel_program(device).gather_isect_grads.over(
        -(-n // schedule.lanes), group, **buffers, capacity=capacity, n_splats=n, go_on=go_on
    )
    found = to_host(device, buffers["moments"], np.empty_like(before))
    first, wide = go_on * before[:, :n].astype(np.float64), grads.astype(np.float64)
    exact = first + np.stack([wide[a:b].sum(axis=0) for a, b in ranges], axis=1)
    terms = np.abs(first) + np.stack([np.abs(wide[a:b]).sum(axis=0) for a, b in ranges], axis=1)
    assert (np.abs(found[:, :n] - exact) <= 2e-7 * terms).all()  # a term is about 1, and the largest sum has 9000
    if schedule.lanes == 1:
        assert np.array_equal(found[:, n:], before[:, n:])

"""Sorting on the device equals NumPy's."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import USABLE
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from clsplat.device.device import Device
from clsplat.device.memory import Pool, to_device, to_host
from clsplat.rendering.radix_sort import Sorter, SortMemory

SIZES = [
    0,
    1,
    2,
    15,
    16,
    17,
    63,
    64,
    65,
    255,
    256,
    257,
    1023,
    1024,
    1025,
    4095,
    4096,
    4097,
    8191,
    8193,
    16384,
    16385,
    100_003,
]  # sizes around every boundary of runs, groups, blocks and chunks
ALL_BITS = 32
UINT32 = np.uint32

MACHINES: dict[Device, SortMachine] = {}  # kept between examples

Array = NDArray[np.uint32]


class SortMachine:
    """A sorter whose buffers are reused between calls."""

    def __init__(self, device: Device) -> None:
        pool = Pool(device)
        self.device, self.sorter, self.memory = device, Sorter(pool), SortMemory(pool)
        self.keys = pool.buffer(UINT32)

    def sort(self, keys: Array, key_bits: int, in_place: bool, smallest: int = 0) -> tuple[Array, Array]:
        """Return the sorted keys and the original index of each. Other buffers keep the keys."""
        device, n = self.device, len(keys)
        given = self.memory.keys if in_place else self.keys
        to_device(device, given.reserve(n), keys)
        sorted_keys, order = self.sorter.sort(given.buffer, n, key_bits, self.memory, smallest)
        assert in_place or np.array_equal(given.read(n), keys)
        return to_host(device, sorted_keys, np.empty(n, UINT32)), to_host(device, order, np.empty(n, UINT32))


@pytest.fixture(scope="module")
def sorter(device: Device) -> SortMachine:
    return SortMachine(device)


def check_sort(sorter: SortMachine, keys: Array, key_bits: int = ALL_BITS) -> None:
    for in_place in (False, True):
        sorted_keys, order = sorter.sort(keys, key_bits, in_place)
        assert np.array_equal(order, np.argsort(keys, kind="stable")), f"n={len(keys)}"
        assert np.array_equal(sorted_keys, np.sort(keys)), f"n={len(keys)}"


@pytest.mark.parametrize("n", SIZES)
def test_sort_is_numpy_s_stable_sort(sorter: SortMachine, n: int) -> None:
    """Keys use all 32 bits and include the largest key, which marks culled splats. Many keys are equal."""
    rng = np.random.default_rng(n)
    keys = rng.integers(0, 2**32, n, UINT32)
    keys[rng.random(n) < 0.1] = 0xFFFFFFFF
    check_sort(sorter, keys)
    check_sort(sorter, rng.integers(0, 3, n, UINT32) << np.uint32(30))


@pytest.mark.parametrize("key_bits", [1, 4, 5, 8, 11, 12, 13, 16, 22, 23, 31, 32])
def test_any_number_of_bits(sorter: SortMachine, key_bits: int) -> None:
    """Test odd and even numbers of passes, and a shorter last digit. Higher bits of the keys are zero."""
    keys = np.random.default_rng(key_bits).integers(0, 2**key_bits, 5000, UINT32)
    check_sort(sorter, keys, key_bits)


def test_more_blocks_than_a_group_has_items(sorter: SortMachine) -> None:
    n_blocks, n_pairs = sorter.sorter.group + 3, 2048
    check_sort(sorter, np.random.default_rng(0).integers(0, 2**5, n_blocks * n_pairs, UINT32), 5)


def test_sorted_reversed_and_equal_keys(sorter: SortMachine) -> None:
    ascending = np.arange(5000, dtype=UINT32) * np.uint32(800_000)
    largest = np.full(5000, 0xFFFFFFFF, UINT32)
    for keys in (ascending, ascending[::-1].copy(), largest, 0 * largest):
        check_sort(sorter, keys)


@pytest.mark.parametrize("key_bits", [4, 30])
def test_keys_above_a_smallest_one(sorter: SortMachine, key_bits: int) -> None:
    """Keys from the smallest one on are sorted. Keys whose difference has more bits come last, in their order."""
    smallest, rng = 0x3C23D70A, np.random.default_rng(key_bits)  # the bits of 0.01
    top = (1 << key_bits) - 1
    keys = (smallest + rng.integers(0, top + 1, 5000)).astype(UINT32)
    keys[:2] = smallest, smallest + top
    far = rng.random(5000) < 0.2
    keys[far] = rng.choice(np.array([smallest + top + 1, 0xFFFFFFFF, smallest - 1, 0], UINT32), far.sum())
    order = sorter.sort(keys, key_bits, False, smallest)[1]
    low = (keys >= smallest) & (keys < smallest + top)
    assert np.array_equal(order[: low.sum()], np.flatnonzero(low)[np.argsort(keys[low], kind="stable")])
    assert np.array_equal(order[low.sum() :], np.flatnonzero(~low))


@pytest.mark.skipif(not USABLE, reason="no OpenCL device")
@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_any_keys(devices: list[Device], data: st.DataObject) -> None:
    """Sizes come in any order, so some buffers are larger than their contents."""
    keys = np.array(data.draw(st.lists(st.integers(0, 2**32 - 1), max_size=700)), UINT32)
    sorter = MACHINES.setdefault(devices[0], SortMachine(devices[0]))
    check_sort(sorter, keys)

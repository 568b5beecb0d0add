"""Sort and scan on the device against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import USABLE
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from clsplat.device.device import Device
from clsplat.device.memory import Pool, to_device, to_host
from clsplat.rendering.radix_sort import Sorter

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
]  # about every run, group, block and chunk boundary
ALL_BITS = 32
UINT32, UINT64 = np.uint32, np.uint64

POOLS: dict[Device, Pool] = {}  # kept from example to example

Array = NDArray[np.uint32]


@pytest.fixture(scope="module")
def sorter(device: Device) -> Sorter:
    return Sorter(device, Pool(device))


def sort_on(sorter: Sorter, keys: Array, key_bits: int) -> tuple[Array, Array]:
    """Sorted keys, and where each came from."""
    device, pool, n = sorter.pool.device, sorter.pool, len(keys)
    to_device(device, pool.get("keys", 4 * n), keys)
    sorter.iota(pool.get("values", 4 * n), n)
    sorted_keys, order = sorter.sort("keys", "values", n, key_bits)
    return to_host(device, sorted_keys, np.empty(n, UINT32)), to_host(device, order, np.empty(n, UINT32))


def scan_on(sorter: Sorter, values: Array) -> tuple[Array, int]:
    """Exclusive scan and total."""
    device, pool, n = sorter.pool.device, sorter.pool, len(values)
    given, scanned, total = pool.get("given", 4 * n), pool.get("scanned", 4 * n), pool.get("total", 8)
    to_device(device, given, values)
    sorter.scan(given, scanned, n, total)
    return to_host(device, scanned, np.empty(n, UINT32)), int(to_host(device, total, np.empty(1, UINT64))[0])


def check_sort(sorter: Sorter, keys: Array, key_bits: int = ALL_BITS) -> None:
    sorted_keys, order = sort_on(sorter, keys, key_bits)
    assert np.array_equal(order, np.argsort(keys, kind="stable")), f"n={len(keys)}"
    assert np.array_equal(sorted_keys, np.sort(keys)), f"n={len(keys)}"


def check_scan(sorter: Sorter, values: Array) -> None:
    scanned, total = scan_on(sorter, values)
    want = np.concatenate([np.zeros(1, UINT64), np.cumsum(values, dtype=UINT64)])
    assert np.array_equal(scanned, want[:-1].astype(UINT32)), f"n={len(values)}"  # modulo 2^32
    assert total == want[-1]


@pytest.mark.parametrize("n", SIZES)
def test_sort_is_numpy_s_stable_sort(sorter: Sorter, n: int) -> None:
    """Keys over all 32 bits (with the largest, which marks culled splats), and keys with many equals."""
    rng = np.random.default_rng(n)
    keys = rng.integers(0, 2**32, n, UINT32)
    keys[rng.random(n) < 0.1] = 0xFFFFFFFF
    check_sort(sorter, keys)
    check_sort(sorter, rng.integers(0, 3, n, UINT32) << np.uint32(30))


@pytest.mark.parametrize("key_bits", [1, 4, 5, 8, 11, 12, 13, 16, 22, 23, 31, 32])
def test_any_number_of_bits(sorter: Sorter, key_bits: int) -> None:
    """An odd and an even number of passes, digits cut by the top; keys have no higher bits."""
    keys = np.random.default_rng(key_bits).integers(0, 2**key_bits, 5000, UINT32)
    check_sort(sorter, keys, key_bits)


def test_sorted_reversed_and_equal_keys(sorter: Sorter) -> None:
    ascending = np.arange(5000, dtype=UINT32) * np.uint32(800_000)
    largest = np.full(5000, 0xFFFFFFFF, UINT32)
    for keys in (ascending, ascending[::-1].copy(), largest, 0 * largest):
        check_sort(sorter, keys)


@pytest.mark.parametrize("n", SIZES)
def test_scan_is_numpy_s_cumulative_sum(sorter: Sorter, n: int) -> None:
    rng = np.random.default_rng(n)
    check_scan(sorter, rng.integers(0, 9, n, UINT32))
    check_scan(sorter, rng.integers(0, 2**32, n, UINT32))  # wraps


@pytest.mark.skipif(not USABLE, reason="no OpenCL device")
@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_any_keys(devices: list[Device], data: st.DataObject) -> None:
    """Sizes in any order: the pool's buffers are larger than what they hold."""
    keys = np.array(data.draw(st.lists(st.integers(0, 2**32 - 1), max_size=700)), UINT32)
    sorter = Sorter(devices[0], POOLS.setdefault(devices[0], Pool(devices[0])))
    check_sort(sorter, keys)
    check_scan(sorter, keys)

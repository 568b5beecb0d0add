"""What a device can do at best, measured on it: bytes copied and fused multiply-adds a second."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..device.device import Device
from ..device.memory import fill_zero
from ..device.program import GROUP_ITEMS, Program, build
from ..device.trace import Launch

CHAINS = (4, 8, 12)  # too few leave the units idle, too many spill registers: the best of them counts
STEPS = 16  # of a round, in cl/measure/roofline.cl
_LONG_MS = 5.0  # a launch of this length is timed well by any driver
_REPEATS = 7
_CACHES, _LEAST_BYTES, _MOST_BYTES = 4, 128 << 20, 512 << 20  # an array: several caches
_GROUPS_PER_UNIT = {"CPU": 8}
_GPU_GROUPS_PER_UNIT = 64


@dataclass(frozen=True)
class Limits:
    """Measured bounds.

    Attributes
    ----------
    copy : bytes read plus bytes written a second by a kernel that copies arrays much larger than the caches.
    fma : float32 operations a second of independent fused multiply-adds, two each.
    """

    copy: float
    fma: float

    def __str__(self) -> str:
        return f"copy {1e-9 * self.copy:.1f} GB/s, FMA {1e-9 * self.fma:.0f} Gflop/s"


def limits_program(device: Device, chains: int) -> Program:
    """The two kernels; on CPUs in vectors of 16, whatever the schedule: these are the device's limits."""
    lanes = 16 if device.info.type == "CPU" else 1
    return build(device, ("math/lanes.clh", "measure/roofline.cl"), {"LANES": lanes, "CHAINS": chains})


def measure_limits(device: Device, repeats: int = _REPEATS, nbytes: int | None = None) -> Limits:
    """Medians of `repeats` launches each, about a second in all.

    Parameters
    ----------
    nbytes : size of each of the two arrays copied; by default four times the device's cache, 128 to 512 MB.

    Raises
    ------
    DeviceError : no memory for the arrays.
    """
    if nbytes is None:
        cache = int(getattr(device.cl_device, "global_mem_cache_size", 0))
        nbytes = min(max(_CACHES * cache, _LEAST_BYTES), _MOST_BYTES, device.info.max_alloc_bytes)
    fma = max(_fma(device, chains, repeats) for chains in CHAINS)
    return Limits(_copy(device, nbytes, repeats), fma)


def _copy(device: Device, nbytes: int, repeats: int) -> float:
    kernel = limits_program(device, CHAINS[0]).copy_vectors
    vector = 64 if device.info.type == "CPU" else 4  # bytes
    n = nbytes // vector
    source, target = device.alloc(n * vector), device.alloc(n * vector)
    fill_zero(device, source, n * vector)
    return 2e3 * n * vector / _median_ms(lambda: kernel.over(n, values=source, copied=target, n=n), repeats)


def _fma(device: Device, chains: int, repeats: int) -> float:
    kernel = limits_program(device, chains).fma_chains
    is_cpu = device.info.type == "CPU"
    group, lanes = (1, 16) if is_cpu else (GROUP_ITEMS, 1)
    items = device.info.compute_units * group * _GROUPS_PER_UNIT.get(device.info.type, _GPU_GROUPS_PER_UNIT)
    sums = device.alloc(4 * items)

    def launch(rounds: int) -> Callable[[], Any]:
        return lambda: kernel((items,), (group,), sums=sums, a=0.5, b=1.0, rounds=rounds)

    rounds = 64
    while (ms := _median_ms(launch(rounds), 1)) < _LONG_MS:
        rounds = int(rounds * min(max(1.5 * _LONG_MS / max(ms, 1e-3), 1.5), 16))
    return 2e3 * STEPS * chains * lanes * items * rounds / _median_ms(launch(rounds), repeats)


def _median_ms(launch: Callable[[], Any], repeats: int) -> float:
    """Device time of `launch`, after one that is not counted."""
    times = []
    for _ in range(repeats + 1):
        event = launch()
        event.wait()
        times.append(Launch("", (), event).ms)
    return statistics.median(times[1:])

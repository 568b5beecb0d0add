"""The roofline of a device, measured: bytes copied and fused multiply-adds per second."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass

from ..device.device import Device
from ..device.memory import fill_zero
from ..device.opencl import Event, elapsed_ms
from ..device.program import GROUP_ITEMS, Define, Program, build

# Independent sums of a work-item. Few leave units idle and many spill registers, so the fastest number counts.
CHAINS = (4, 8, 12)
STEPS = 16  # multiply-adds of a round in cl/measure/roofline.cl
_LONG_MS = 5.0  # length of a launch that every driver times well
_REPEATS = 7
_CACHES, _MIN_BYTES, _MAX_BYTES = 4, 128 << 20, 512 << 20  # size of an array: several caches
_GROUPS_PER_UNIT = {"CPU": 8}
_GPU_GROUPS_PER_UNIT = 64


@dataclass(frozen=True)
class Roofline:
    """Measured limits of a device.

    Attributes
    ----------
    copy : bytes read plus bytes written per second by a kernel that copies arrays much larger than the caches.
    fma : float32 operations per second of independent fused multiply-adds; each one counts as two.
    """

    copy: float
    fma: float

    def __str__(self) -> str:
        return f"copy {1e-9 * self.copy:.1f} GB/s, FMA {1e-9 * self.fma:.0f} Gflop/s"


def roofline_program(device: Device, chains: int) -> Program:
    """Return the program of the two kernels. CPUs use vectors of 16, whatever the schedule."""
    lanes, copied = (16, "vreal") if device.info.type == "CPU" else (1, "real4")
    defines: dict[str, Define] = {"LANES": lanes, "COPIED": copied, "CHAINS": chains}
    return build(device, ("math/lanes.clh", "measure/roofline.cl"), defines)


def measure_roofline(device: Device, repeats: int = _REPEATS, nbytes: int | None = None) -> Roofline:
    """Measure both limits as medians of `repeats` launches; this takes about a second.

    Parameters
    ----------
    nbytes : size of each of the two arrays of the copy. The default is four times the device's cache, 128 to 512 MB.

    Raises
    ------
    DeviceError : the device does not have the memory for the arrays.
    """
    if nbytes is None:
        cache = int(getattr(device.cl_device, "global_mem_cache_size", 0))
        nbytes = min(max(_CACHES * cache, _MIN_BYTES), _MAX_BYTES, device.info.max_alloc_bytes)
    with device.profiled():
        fma = max(_fma(device, chains, repeats) for chains in CHAINS)
        return Roofline(_copy(device, nbytes, repeats), fma)


def _copy(device: Device, nbytes: int, repeats: int) -> float:
    kernel = roofline_program(device, CHAINS[0]).copy_vectors
    vector = 64 if device.info.type == "CPU" else 16  # bytes
    n = nbytes // vector
    source, target = device.alloc(n * vector), device.alloc(n * vector)
    fill_zero(device, source, n * vector)
    return 2e3 * n * vector / _median_ms(lambda: kernel.over(n, values=source, copied=target, n=n), repeats)


def _fma(device: Device, chains: int, repeats: int) -> float:
    kernel = roofline_program(device, chains).fma_chains
    is_cpu = device.info.type == "CPU"
    group, lanes = (1, 16) if is_cpu else (GROUP_ITEMS, 1)
    items = device.info.compute_units * group * _GROUPS_PER_UNIT.get(device.info.type, _GPU_GROUPS_PER_UNIT)
    sums = device.alloc(4 * items)

    def launch(rounds: int) -> Callable[[], Event]:
        return lambda: kernel.over(items, group, sums=sums, a=0.5, b=1.0, rounds=rounds)

    rounds = 64
    while (ms := _median_ms(launch(rounds), 1)) < _LONG_MS:
        rounds = int(rounds * min(max(1.5 * _LONG_MS / max(ms, 1e-3), 1.5), 16))
    return 2e3 * STEPS * chains * lanes * items * rounds / _median_ms(launch(rounds), repeats)


def _median_ms(launch: Callable[[], Event], repeats: int) -> float:
    """Return the median device time of `launch` [ms]. One more launch before is not counted."""
    times = []
    for _ in range(repeats + 1):
        event = launch()
        event.wait()
        times.append(elapsed_ms(event))
    return statistics.median(times[1:])

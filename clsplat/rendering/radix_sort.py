"""Stable radix sort of pairs, for devices with many work-items (CPUs use cl/render/order.cl)."""

from __future__ import annotations

import numpy as np

from ..device.device import Device
from ..device.memory import Pool
from ..device.opencl import Buffer
from ..device.program import Program, build

DIGIT_BITS = 6  # sorted by one pass
_MAX_GROUP, _GROUP_STEP = 128, 1 << DIGIT_BITS  # a group has a whole number of work-items for each digit
_RUN = 16  # pairs of a work-item, a multiple of 4
_IN_GROUPS = ("radix_histogram", "radix_scan", "radix_scatter")  # kernels whose work-items work together


def radix_passes(key_bits: int) -> int:
    """Return the number of passes over all pairs in a sort by `key_bits` bits."""
    return -(-key_bits // DIGIT_BITS)


def sort_program(device: Device, group: int) -> Program:
    """Return the program of sorts, for work-groups of `group` items."""
    defines = {"SCAN_GROUP": group, "RADIX_BITS": DIGIT_BITS, "RUN": _RUN}
    return build(device, ("math/lanes.clh", "render/scan.clh", "render/sort.cl"), {"LANES": 1, **defines})


def sort_group(device: Device) -> int:
    """Return the size of the work-groups that sort and scan on a device; 0 if its groups are too small."""
    group = _whole_steps(min(_MAX_GROUP, device.info.max_group))
    if not group:
        return 0
    program = sort_program(device, group)
    return _whole_steps(min(group, *(program[name].max_group for name in _IN_GROUPS)))


def _whole_steps(group: int) -> int:
    return group // _GROUP_STEP * _GROUP_STEP


class SortMemory:
    """Memory for two copies of pairs of uint32, because a pass reads one and writes the other."""

    def __init__(self, pool: Pool) -> None:
        self.keys, self.values = pool.buffer(np.uint32), pool.buffer(np.uint32)
        self.spare_keys, self.spare_values = pool.buffer(np.uint32), pool.buffer(np.uint32)

    def reserve(self, n: int) -> None:
        """Make room for n pairs."""
        for memory in (self.keys, self.values, self.spare_keys, self.spare_values):
            memory.reserve(n)


class Sorter:
    """Sorts uint32 buffers, on a device whose `sort_group` is not 0."""

    def __init__(self, pool: Pool) -> None:
        self.group = sort_group(pool.device)
        self.program = sort_program(pool.device, self.group)
        self._counts, self._totals = pool.buffer(np.uint32), pool.buffer(np.uint32)

    def sort(self, keys: Buffer, n: int, key_bits: int, memory: SortMemory, smallest: int = 0) -> tuple[Buffer, Buffer]:
        """Sort the first n keys.

        Parameters
        ----------
        keys : not changed, unless they are `memory.keys`.
        key_bits : bits of the difference of a key and the smallest one, at least one. Keys with larger differences
            come last, in their order.
        smallest : lower bound of the keys.

        Returns
        -------
        keys, order : the sorted keys, and the place that each had; both in `memory`.
        """
        n_blocks = max(-(-n // (_RUN * self.group)), 1)
        counts, totals = self._counts.reserve(n_blocks << DIGIT_BITS), self._totals.reserve(1 << DIGIT_BITS)
        size, local = (n_blocks * self.group,), (self.group,)
        values = memory.values.reserve(n)  # the first pass reads none
        target = memory.spare_keys.reserve(n), memory.spare_values.reserve(n)
        spare = memory.keys.reserve(n), values
        for shift in range(0, key_bits, DIGIT_BITS):
            part = {"n": n, "base": smallest, "top": (1 << key_bits) - 1, "shift": shift}
            self.program.radix_histogram(size, local, keys=keys, counts=counts, **part)
            self.program.radix_scan((self.group << DIGIT_BITS,), local, counts=counts, totals=totals, n_blocks=n_blocks)
            self.program.radix_scatter(
                size,
                local,
                keys=keys,
                values=values,
                counts=counts,
                totals=totals,
                keys_out=target[0],
                values_out=target[1],
                numbered=int(shift == 0),
                **part,
            )
            (keys, values), target, spare = target, spare, target
        return keys, values

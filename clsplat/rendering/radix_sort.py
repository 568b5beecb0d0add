"""Stable radix sort of pairs and exclusive scan, for devices with many work-items (CPUs use cl/render/order.cl)."""

from __future__ import annotations

import numpy as np

from ..device.device import Device
from ..device.memory import Pool
from ..device.opencl import Buffer
from ..device.program import GROUP_ITEMS, Program, build

DIGIT_BITS = 5  # sorted by one pass
_MAX_GROUP, _GROUP_STEP = 256, 1 << DIGIT_BITS  # a group has a whole number of work-items for each digit
_SORT_RUN, _SCAN_RUN = 16, 64  # values of a work-item
_IN_GROUPS = ("radix_histogram", "radix_scan", "radix_scatter", "scan_spine")  # kernels whose work-items work together


def radix_passes(key_bits: int) -> int:
    """Return the number of passes over all pairs in a sort by `key_bits` bits."""
    return -(-key_bits // DIGIT_BITS)


def sort_program(device: Device, group: int) -> Program:
    """Return the program of sorts and scans, for work-groups of `group` items."""
    return build(device, ("render/sort.cl",), {"SORT_GROUP": group, "RADIX_BITS": DIGIT_BITS})


def sort_group(device: Device) -> int:
    """Return the size of the work-groups that sort on a device; 0 if its groups are too small."""
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
    """Sorts and scans uint32 buffers, on a device whose `sort_group` is not 0."""

    def __init__(self, pool: Pool) -> None:
        self.group = sort_group(pool.device)
        self.program = sort_program(pool.device, self.group)
        self._scan_sums = pool.buffer(np.uint64)
        self._counts, self._totals = pool.buffer(np.uint32), pool.buffer(np.uint32)

    def scan(self, values: Buffer, scanned: Buffer, n: int, total: Buffer) -> None:
        """Write the exclusive scan of n values, modulo 2^32, into another buffer, and their sum (uint64) to `total`."""
        # Whole groups: the items beyond n sum nothing.
        n_runs = -(-max(n, 1) // (_SCAN_RUN * GROUP_ITEMS)) * GROUP_ITEMS
        sums = self._scan_sums.reserve(n_runs)
        self.program.scan_sums.over(n_runs, values=values, sums=sums, n=n, run=_SCAN_RUN)
        self.program.scan_spine((self.group,), (self.group,), sums=sums, total=total, n=n_runs)
        self.program.scan_apply.over(n_runs, values=values, sums=sums, scanned=scanned, n=n, run=_SCAN_RUN)

    def sort(self, keys: Buffer, n: int, key_bits: int, memory: SortMemory) -> tuple[Buffer, Buffer]:
        """Sort the first n keys by their low `key_bits` bits, at least one.

        Parameters
        ----------
        keys : not changed, unless they are `memory.keys`.

        Returns
        -------
        keys, order : the sorted keys, and the place that each had; both in `memory`.
        """
        n_blocks = max(-(-n // (_SORT_RUN * self.group)), 1)
        counts, totals = self._counts.reserve(n_blocks << DIGIT_BITS), self._totals.reserve(1 << DIGIT_BITS)
        size, local = (n_blocks * self.group,), (self.group,)
        values = memory.values.reserve(n)  # the first pass reads none
        target = memory.spare_keys.reserve(n), memory.spare_values.reserve(n)
        spare = memory.keys.reserve(n), values
        for shift in range(0, key_bits, DIGIT_BITS):
            part = {"n": n, "run": _SORT_RUN, "shift": shift}
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

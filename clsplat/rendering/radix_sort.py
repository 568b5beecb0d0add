"""Stable radix sort of pairs and exclusive scan, for devices with many work-items (CPUs use cl/render/order.cl)."""

from __future__ import annotations

import numpy as np

from ..device.device import Device
from ..device.memory import Pool
from ..device.opencl import Buffer
from ..device.program import GROUP_ITEMS, Program, build

DIGIT_BITS = 4  # sorted by one pass
_MAX_GROUP = 256
_SORT_RUN, _SCAN_RUN = 16, 64  # values of a work-item


def radix_passes(key_bits: int) -> int:
    """Return the number of passes over all pairs in a sort by `key_bits` bits."""
    return -(-key_bits // DIGIT_BITS)


def sort_program(device: Device, group: int) -> Program:
    """Return the program of sorts and scans, for work-groups of `group` items."""
    return build(device, ("render/sort.cl",), {"SORT_GROUP": group, "RADIX_BITS": DIGIT_BITS})


class SortPairs:
    """Memory for pairs of uint32. Each array has a spare, because a pass reads one and writes the other."""

    def __init__(self, pool: Pool) -> None:
        self.keys, self.values = pool.buffer(np.uint32), pool.buffer(np.uint32)
        self.spare_keys, self.spare_values = pool.buffer(np.uint32), pool.buffer(np.uint32)


class Sorter:
    """Sorts and scans uint32 buffers."""

    def __init__(self, pool: Pool) -> None:
        device = pool.device
        self.group = min(_MAX_GROUP, device.info.max_group)
        self.program = sort_program(device, self.group)
        self._scan_sums = pool.buffer(np.uint64)
        self._counts, self._starts, self._total = (pool.buffer(t) for t in (np.uint32, np.uint32, np.uint64))

    def scan(self, values: Buffer, scanned: Buffer, n: int, total: Buffer) -> None:
        """Write the exclusive scan of n values, modulo 2^32, into another buffer, and their sum (uint64) to `total`."""
        # Whole groups: the items beyond n sum nothing.
        n_runs = -(-max(n, 1) // (_SCAN_RUN * GROUP_ITEMS)) * GROUP_ITEMS
        sums = self._scan_sums.reserve(n_runs)
        self.program.scan_sums.over(n_runs, values=values, sums=sums, n=n, run=_SCAN_RUN)
        self.program.scan_spine((self.group,), (self.group,), sums=sums, total=total, n=n_runs)
        self.program.scan_apply.over(n_runs, values=values, sums=sums, scanned=scanned, n=n, run=_SCAN_RUN)

    def sort(self, pairs: SortPairs, n: int, key_bits: int) -> tuple[Buffer, Buffer]:
        """Sort the first n pairs by the low `key_bits` bits of their keys.

        Returns
        -------
        keys, values : the sorted arrays. The other two buffers of `pairs` are overwritten.
        """
        source = pairs.keys.reserve(n), pairs.values.reserve(n)
        target = pairs.spare_keys.reserve(n), pairs.spare_values.reserve(n)
        n_blocks = max(-(-n // (_SORT_RUN * self.group)), 1)
        n_counts = n_blocks << DIGIT_BITS
        counts, starts, total = self._counts.reserve(n_counts), self._starts.reserve(n_counts), self._total.reserve(1)
        size, local = (n_blocks * self.group,), (self.group,)
        for shift in range(0, key_bits, DIGIT_BITS):
            self.program.radix_histogram(size, local, keys=source[0], counts=counts, n=n, run=_SORT_RUN, shift=shift)
            self.scan(counts, starts, n_counts, total)
            self.program.radix_scatter(
                size,
                local,
                keys=source[0],
                values=source[1],
                starts=starts,
                keys_out=target[0],
                values_out=target[1],
                n=n,
                run=_SORT_RUN,
                shift=shift,
            )
            source, target = target, source
        return source

    def iota(self, values: Buffer, n: int) -> None:
        """Set values[i] = i."""
        self.program.fill_iota.over(n, values=values, n=n)

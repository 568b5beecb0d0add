"""Stable radix sort of (key, value) pairs and exclusive scan, on the device."""

from __future__ import annotations

from typing import Any

from .buffers import Pool
from .device import Device
from .program import build

_CPU_CHUNKS = 16  # runs that a CPU's work is cut into


def digit_bits(is_cpu: bool) -> int:
    """Bits that one pass of the sort looks at."""
    return 11 if is_cpu else 4


def radix_passes(is_cpu: bool, key_bits: int) -> int:
    """Passes over all pairs that a sort by `key_bits` bits takes."""
    return -(-key_bits // digit_bits(is_cpu))


class Sorter:
    """Sorts, scans uint32 buffers. CPU: a work-item per chunk, 11-bit digits; else groups of 256, 4 bits."""

    def __init__(self, device: Device, pool: Pool) -> None:
        self.is_cpu = device.info.type == "CPU"
        group = 1 if self.is_cpu else min(256, device.info.max_group)
        self.group, self.bits, self.pool = group, digit_bits(self.is_cpu), pool
        self.program = build(device, ("sort.cl",), {"SORT_GROUP": group, "RADIX_BITS": self.bits})

    def scan(self, values: Any, scanned: Any, n: int, total: Any) -> None:
        """scanned = exclusive scan of n values (two distinct buffers); total[0] = their sum (modulo 2^32)."""
        run = max(-(-n // _CPU_CHUNKS), 1024) if self.is_cpu else 64
        n_runs = max(-(-n // run), 1)
        sums = self.pool.get("scan_sums", 4 * n_runs)
        self.program.scan_sums.over(n_runs, 1, values=values, sums=sums, n=n, run=run)
        self.program.scan_spine((self.group,), (self.group,), sums=sums, total=total, n=n_runs)
        self.program.scan_apply.over(n_runs, 1, values=values, sums=sums, scanned=scanned, n=n, run=run)

    def sort(self, keys: str, values: str, n: int, key_bits: int) -> tuple[Any, Any]:
        """Sort n pairs held in the pool's buffers `keys` and `values` by the low `key_bits` bits.

        Returns the buffers with the result (those, or their pair); contents of the others are lost.
        """
        pool = self.pool
        here = (pool.get(keys, 4 * n), pool.get(values, 4 * n))
        there = (pool.get(keys + "_pair", 4 * n), pool.get(values + "_pair", 4 * n))
        run = max(-(-n // _CPU_CHUNKS), 1024) if self.is_cpu else 16
        n_blocks = max(-(-n // (run * self.group)), 1)
        n_counts = n_blocks << self.bits
        counts, starts = pool.get("radix_counts", 4 * n_counts), pool.get("radix_starts", 4 * n_counts)
        total = pool.get("radix_total", 4)
        size, local = (n_blocks * self.group,), (self.group,)
        for shift in range(0, key_bits, self.bits):
            self.program.radix_histogram(size, local, keys=here[0], counts=counts, n=n, run=run, shift=shift)
            self.scan(counts, starts, n_counts, total)
            self.program.radix_scatter(size, local, keys=here[0], values=here[1], starts=starts,
                                       keys_out=there[0], values_out=there[1], n=n, run=run, shift=shift)
            here, there = there, here
        return here

    def iota(self, values: Any, n: int) -> None:
        """values[i] = i."""
        self.program.fill_iota.over(n, values=values, n=n)

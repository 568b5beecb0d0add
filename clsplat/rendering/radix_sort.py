"""Stable radix sort of (key, value) pairs and exclusive scan, on devices of many work-items (order.cl: CPUs)."""

from __future__ import annotations

from typing import Any

from ..device.device import Device
from ..device.memory import Pool
from ..device.program import GROUP_ITEMS, build

DIGIT_BITS = 4  # that one pass of the sort looks at
_MOST_ITEMS = 256  # of a group
_SORT_RUN, _SCAN_RUN = 16, 64  # values of a work-item


def radix_passes(key_bits: int) -> int:
    """Passes over all pairs that a sort by `key_bits` bits takes."""
    return -(-key_bits // DIGIT_BITS)


class Sorter:
    """Sorts and scans uint32 buffers."""

    def __init__(self, device: Device, pool: Pool) -> None:
        self.group, self.pool = min(_MOST_ITEMS, device.info.max_group), pool
        self.program = build(device, ("render/sort.cl",), {"SORT_GROUP": self.group, "RADIX_BITS": DIGIT_BITS})

    def scan(self, values: Any, scanned: Any, n: int, total: Any) -> None:
        """scanned = exclusive scan of n values (two distinct buffers), modulo 2^32; total[0] = their sum, uint64."""
        n_runs = -(-max(n, 1) // (_SCAN_RUN * GROUP_ITEMS)) * GROUP_ITEMS  # whole groups: those past n sum nothing
        sums = self.pool.get("scan_sums", 8 * n_runs)
        self.program.scan_sums.over(n_runs, values=values, sums=sums, n=n, run=_SCAN_RUN)
        self.program.scan_spine((self.group,), (self.group,), sums=sums, total=total, n=n_runs)
        self.program.scan_apply.over(n_runs, values=values, sums=sums, scanned=scanned, n=n, run=_SCAN_RUN)

    def sort(self, keys: str, values: str, n: int, key_bits: int) -> tuple[Any, Any]:
        """Sort n pairs held in the pool's buffers `keys` and `values` by the low `key_bits` bits.

        Returns the buffers with the result (those, or their pair); contents of the others are lost.
        """
        pool = self.pool
        here = (pool.get(keys, 4 * n), pool.get(values, 4 * n))
        there = (pool.get(keys + "_pair", 4 * n), pool.get(values + "_pair", 4 * n))
        n_blocks = max(-(-n // (_SORT_RUN * self.group)), 1)
        n_counts = n_blocks << DIGIT_BITS
        counts, starts = pool.get("radix_counts", 4 * n_counts), pool.get("radix_starts", 4 * n_counts)
        total = pool.get("radix_total", 8)
        size, local = (n_blocks * self.group,), (self.group,)
        for shift in range(0, key_bits, DIGIT_BITS):
            self.program.radix_histogram(size, local, keys=here[0], counts=counts, n=n, run=_SORT_RUN, shift=shift)
            self.scan(counts, starts, n_counts, total)
            self.program.radix_scatter(
                size,
                local,
                keys=here[0],
                values=here[1],
                starts=starts,
                keys_out=there[0],
                values_out=there[1],
                n=n,
                run=_SORT_RUN,
                shift=shift,
            )
            here, there = there, here
        return here

    def iota(self, values: Any, n: int) -> None:
        """values[i] = i."""
        self.program.fill_iota.over(n, values=values, n=n)

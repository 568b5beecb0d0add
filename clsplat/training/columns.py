"""Moves and sums of columns of buffers [rows, capacity] on the device (cl/train/columns.cl)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..device.device import Device
from ..device.memory import to_device, to_host
from ..device.opencl import Buffer
from ..device.program import GROUP_ITEMS, Program
from ..splats.fields import Array


class Columns:
    """The columns of all buffers of one capacity and precision.

    Parameters
    ----------
    program : programs.columns_program.
    capacity : number of columns of a buffer.
    """

    def __init__(self, device: Device, program: Program, capacity: int, dtype: np.dtype[np.floating]) -> None:
        self.device, self.program, self.capacity, self.dtype = device, program, capacity, dtype

    def indices(self, rows: NDArray[np.int64]) -> Buffer:
        """Return a buffer with the numbers of some columns."""
        buffer = self.device.alloc(max(4 * len(rows), 4))
        to_device(self.device, buffer, rows.astype(np.int32))
        return buffer

    def gather(self, values: Buffer, source: Buffer, moved: Buffer, n: int, rows: int) -> None:
        """Copy n columns of `values`, with the indices `source`, into the first columns of another buffer."""
        self._gather(values, source, moved, self.capacity, 0, n, rows)

    def take(self, values: Buffer, source: Buffer, n: int, first: int, rows: int) -> Array:
        """Return rows of n columns with the indices `source`, (n, rows). first : the first of the rows."""
        found: Array = np.empty((rows, n), self.dtype)
        if n:
            compact = self.device.alloc(found.nbytes)
            self._gather(values, source, compact, n, first, n, rows)
            to_host(self.device, compact, found)
        return np.ascontiguousarray(found.T)

    def put(self, values: Buffer, target: Buffer, array: Array, first: int) -> None:
        """Write rows of n different columns with the indices `target`. array : (n, rows). first : the first row."""
        n, rows = array.shape
        if not n:
            return
        compact = self.device.alloc(array.size * self.dtype.itemsize)
        to_device(self.device, compact, array.astype(self.dtype).T)
        self.program.scatter_columns.over(
            n, GROUP_ITEMS, rows, moved=compact, target=target, values=values, capacity=self.capacity, first=first, n=n
        )

    def zero(self, values: Buffer, fresh: Buffer, n: int, rows: int) -> None:
        """Set those of the first n columns to zero for which `fresh` (n bytes) is not 0."""
        self.program.zero_columns.over(n, GROUP_ITEMS, rows, values=values, fresh=fresh, capacity=self.capacity, n=n)

    def add(
        self,
        total: Buffer,
        addend: Buffer,
        n: int,
        target: slice,
        source: slice,
        factor: float = 1.0,
        adds: bool = True,
    ) -> None:
        """Add rows of the first n columns, times a factor, to rows of `total`, or replace those rows.

        Parameters
        ----------
        target, source : rows of `total` and of `addend`, equally many.
        adds : False to replace the rows.
        """
        self.program.add_columns.over(
            n,
            GROUP_ITEMS,
            target.stop - target.start,
            sum=total,
            addend=addend,
            **{"capacity": self.capacity, "first": target.start, "from": source.start, "n": n},
            factor=factor,
            adds=int(adds),
        )

    def _gather(self, values: Buffer, source: Buffer, moved: Buffer, width: int, first: int, n: int, rows: int) -> None:
        self.program.gather_columns.over(
            n,
            GROUP_ITEMS,
            rows,
            values=values,
            source=source,
            moved=moved,
            capacity=self.capacity,
            width=width,
            first=first,
            n=n,
        )

"""From projected splats to the isects of each tile, front to back: in one band of tiles or in several.

Reads the pool's "depth_key_kept" [n] and "tile_rect" [n]. Both binners give the same numbers: CPUs cut the work into a
few chunks and count by tile; the others take a work-item a splat, and sort.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..device.device import Device
from ..device.memory import Pool, copy, to_host
from ..device.program import build
from ..errors import DeviceError
from .radix_sort import Sorter

MAX_ISECTS = 2**31 - 1  # of a band: ids are 32 bits
BUCKET_BITS = 11  # of a depth key, that choose its bucket
_SPLATS_PER_CHUNK = 2048  # at least, so that counters are few beside splats
_CHUNKS_PER_UNIT = 4  # at most: near splats have more tiles, so equal chunks take unequal time


@dataclass(frozen=True)
class Band:
    """Tiles `first` to `past` (past the end) in row-major order, and their isects."""

    first: int
    past: int
    n_isects: int


class Binner(Protocol):
    """`order`, then `begin`, then the others, `list_isects` for bands that have no tile in common."""

    def order(self, n: int) -> None:
        """Sort the n splats by depth, equal depths by index."""

    def begin(self, n: int, tiles_x: int, tiles_y: int) -> None:
        """Start on an image of so many tiles."""

    def count(self, first: int, past: int) -> int:
        """Isects of the tiles from `first` to `past`; waits for the device."""

    def list_isects(self, band: Band) -> Any:
        """Lists [n_isects] of isect ids by tile, and the pool's "tile_ranges" of the band's tiles (only those),
        "isect_splat" and "splat_isects" to go with them.
        """


def make_binner(device: Device, pool: Pool) -> Binner:
    """The one for this kind of device."""
    return ChunkBinner(device, pool) if device.info.type == "CPU" else GroupBinner(device, pool)


def cut(count: Callable[[int, int], int], tiles_x: int, tiles_y: int, limit: int) -> tuple[Band, ...]:
    """Bands of at most `limit` isects, in order: all tiles, or halves of whole rows, or halves of a row.

    Raises
    ------
    DeviceError : one tile alone has more.
    """

    def halved(first: int, past: int) -> tuple[Band, ...]:
        n_isects, n_tiles = count(first, past), past - first
        if n_isects <= limit:
            return (Band(first, past, n_isects),)
        if n_tiles == 1:
            raise DeviceError(
                f"{n_isects} splats over one tile, and buffers for {limit} at most: "
                "use fewer splats (--cap-max) or another --device"
            )
        unit = tiles_x if n_tiles > tiles_x else 1
        middle = first + n_tiles // unit // 2 * unit
        return halved(first, middle) + halved(middle, past)

    return halved(0, tiles_x * tiles_y)


class ChunkBinner:
    """For CPUs (cl/render/order.cl, and the second half of cl/render/bin.cl)."""

    def __init__(self, device: Device, pool: Pool) -> None:
        self.device, self.pool, self.units = device, pool, max(device.info.compute_units, 1)
        self.program = build(device, ("render/order.cl", "render/bin.cl"), {"BUCKET_BITS": BUCKET_BITS})
        self._image: tuple[int, int, int, int] = (0, 0, 0, 0)  # chunks, cells of a chunk, tiles a row, tiles
        self._totals: NDArray[np.int64] | None = None  # isects before each tile, once they were asked for

    def order(self, n: int) -> None:
        pool, program = self.pool, self.program
        keys, buckets = pool.get("depth_key_kept", 0), 1 << BUCKET_BITS
        chunks = min(-(-n // _SPLATS_PER_CHUNK), self.units)
        split = {"n_splats": n, "run": -(-n // chunks)}
        span, counts = pool.get("depth_span", 8 * chunks), pool.get("bucket_counts", 4 * chunks * buckets)
        starts, pairs = pool.get("bucket_starts", 4 * (buckets + 1)), pool.get("depth_pairs", 8 * n)
        program.depth_span.over(
            chunks, 1, depth_key=keys, span=span, splat_isects=pool.get("splat_isects", 8 * n), **split
        )
        program.depth_histogram.over(chunks, 1, depth_key=keys, span=span, counts=counts, n_chunks=chunks, **split)
        program.depth_scatter.over(
            chunks,
            1,
            depth_key=keys,
            span=span,
            counts=counts,
            pairs=pairs,
            bucket_starts=starts,
            n_visible=pool.get("n_visible", 4),
            n_chunks=chunks,
            **split,
        )
        program.depth_buckets.over(
            min(-(-n // _SPLATS_PER_CHUNK), _CHUNKS_PER_UNIT * self.units),
            1,
            bucket_starts=starts,
            span=span,
            pairs=pairs,
            spare=pool.get("depth_spare", 8 * n),
            depth_order=pool.get("depth_order", 4 * n),
            n_chunks=chunks,
        )

    def begin(self, n: int, tiles_x: int, tiles_y: int) -> None:
        pool, tiles, cells = self.pool, tiles_x * tiles_y, (tiles_x + 1) * (tiles_y + 1)
        # Splats enough for the chunk's counters, a chunk for each unit in any case.
        most = max(min(_CHUNKS_PER_UNIT * self.units, 4 * n // cells), self.units)
        chunks = min(most, -(-n // _SPLATS_PER_CHUNK))
        counts = pool.get("tile_counts", 4 * chunks * cells)
        self.program.count_tiles.over(
            chunks,
            1,
            order=pool.get("depth_order", 0),
            n_visible=pool.get("n_visible", 0),
            tile_rect=pool.get("tile_rect", 0),
            ranked_rect=pool.get("ranked_rect", 8 * n),
            counts=counts,
            tiles_x=tiles_x,
            tiles_y=tiles_y,
        )
        parts = min(self.units, -(-chunks * tiles // _SPLATS_PER_CHUNK))
        self.program.total_tiles.over(
            parts,
            1,
            counts=counts,
            totals=pool.get("tile_totals", 4 * tiles),
            n_chunks=chunks,
            cells=cells,
            n_tiles=tiles,
            run=-(-tiles // parts),
        )
        self._image, self._totals = (chunks, cells, tiles_x, tiles), None

    def count(self, first: int, past: int) -> int:
        if self._totals is None:
            tiles = self._image[3]
            totals = to_host(self.device, self.pool.get("tile_totals", 0), np.empty(tiles, np.uint32))
            self._totals = np.concatenate([[0], np.cumsum(totals, dtype=np.int64)])
        return int(self._totals[past] - self._totals[first])

    def list_isects(self, band: Band) -> Any:
        pool, (chunks, cells, tiles_x, tiles) = self.pool, self._image
        lists = pool.get("lists", 4 * band.n_isects)
        self.program.list_isects.over(
            chunks,
            1,
            order=pool.get("depth_order", 0),
            n_visible=pool.get("n_visible", 0),
            ranked_rect=pool.get("ranked_rect", 0),
            totals=pool.get("tile_totals", 0),
            counts=pool.get("tile_counts", 0),
            tile_ranges=pool.get("tile_ranges", 8 * tiles),
            splat_isects=pool.get("splat_isects", 0),
            isect_splat=pool.get("isect_splat", 4 * band.n_isects),
            lists=lists,
            cells=cells,
            first_tile=band.first,
            past_tile=band.past,
            tiles_x=tiles_x,
        )
        return lists


class GroupBinner:
    """For devices of many work-items (cl/render/sort.cl, and the first half of cl/render/bin.cl)."""

    def __init__(self, device: Device, pool: Pool) -> None:
        self.device, self.pool = device, pool
        self.sorter = Sorter(device, pool)
        self.program = build(device, ("render/bin.cl",))
        self._n, self._tiles_x, self._tiles = 0, 0, 0
        self._order: Any = None
        self._counted: tuple[int, int] | None = None  # the tiles whose counts are in the buffers

    def order(self, n: int) -> None:
        pool = self.pool
        copy(self.device, pool.get("depth_key_kept", 0), pool.get("depth_key", 4 * n), 4 * n)
        self.sorter.iota(pool.get("depth_order", 4 * n), n)
        self._order = self.sorter.sort("depth_key", "depth_order", n, 32)[1]

    def begin(self, n: int, tiles_x: int, tiles_y: int) -> None:
        self._n, self._tiles_x, self._tiles, self._counted = n, tiles_x, tiles_x * tiles_y, None

    def count(self, first: int, past: int) -> int:
        self._count(first, past)
        return int(to_host(self.device, self.pool.get("n_isects", 0), np.empty(1, np.uint64))[0])

    def list_isects(self, band: Band) -> Any:
        pool, n, n_isects = self.pool, self._n, band.n_isects
        if self._counted != (band.first, band.past):
            self._count(band.first, band.past)
        self.program.emit_isects.over(
            n,
            order=self._order,
            tile_rect=pool.get("tile_rect", 0),
            offsets=pool.get("isect_offsets", 0),
            splat_isects=pool.get("splat_isects", 8 * n),
            isect_tile=pool.get("isect_tile", 4 * n_isects),
            isect_id=pool.get("isect_id", 4 * n_isects),
            isect_splat=pool.get("isect_splat", 4 * n_isects),
            n_splats=n,
            first_tile=band.first,
            past_tile=band.past,
            tiles_x=self._tiles_x,
        )
        ranges, lists = pool.zeroed("tile_ranges", 8 * self._tiles), pool.get("isect_id", 0)
        if n_isects:
            bits = max((self._tiles - 1).bit_length(), 1)
            tiles, lists = self.sorter.sort("isect_tile", "isect_id", n_isects, bits)
            self.program.find_tile_ranges.over(n_isects, sorted_tile=tiles, tile_ranges=ranges, n_isects=n_isects)
        return lists

    def _count(self, first: int, past: int) -> None:
        pool, n = self.pool, self._n
        counts, offsets = pool.get("isect_counts", 4 * n), pool.get("isect_offsets", 4 * n)
        self.program.count_isects.over(
            n,
            order=self._order,
            tile_rect=pool.get("tile_rect", 0),
            counts=counts,
            n_splats=n,
            first_tile=first,
            past_tile=past,
            tiles_x=self._tiles_x,
        )
        self.sorter.scan(counts, offsets, n, pool.get("n_isects", 8))
        self._counted = (first, past)

"""From projected splats to the isects of each tile, front to back, for one band of tiles at a time.

Two binners give the same numbers. The one for CPUs cuts the work into a few chunks and counts by tile. The other one
takes a work-item for each splat, and sorts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..device.device import Device
from ..device.memory import Pool
from ..device.opencl import Buffer
from ..device.program import Define, build
from ..errors import FEWER_SPLATS, OTHER_DEVICE, DeviceError
from .build import CULLED_KEY
from .frame import Band, ProjectedSplats, TileLists
from .radix_sort import Sorter, SortMemory, sort_group

MAX_ISECTS = 2**31 - 1  # of a band: ids have 32 bits
BUCKET_BITS = 11  # bits of a depth key that choose its bucket
ORDER_DEFINES: dict[str, Define] = {"BUCKET_BITS": BUCKET_BITS, "CULLED_KEY": f"{CULLED_KEY:#x}u"}
_MIN_CHUNK = 2048  # splats of a chunk, so that there are few counters for each splat
_CHUNKS_PER_UNIT = 4  # at most; near splats have more tiles, so equal chunks take unequal time


class Binner(Protocol):
    """Lists the isects of an image.

    Call `order` for a camera, then `begin` for an image, then the other two. `list_isects` takes bands that have no
    tile in common.
    """

    def order(self, splats: ProjectedSplats) -> None:
        """Sort splats by depth; splats of equal depth by index."""

    def begin(self, tiles_x: int, tiles_y: int) -> None:
        """Start an image of this number of tiles."""

    def count(self, first: int, end: int) -> int:
        """Return the number of isects of the tiles from `first` to `end` (exclusive); waits for the device."""

    def list_isects(self, band: Band) -> TileLists:
        """List the isects of a band. The next call overwrites the lists."""


def make_binner(device: Device, pool: Pool) -> Binner:
    """Return the binner for this kind of device. The one for CPUs works with groups of one."""
    return ChunkBinner(pool) if device.info.type == "CPU" or not sort_group(device) else GroupBinner(pool)


def cut_bands(count: Callable[[int, int], int], tiles_x: int, tiles_y: int, limit: int) -> tuple[Band, ...]:
    """Cut an image into bands of at most `limit` isects, in order.

    Tiles are halved until they fit: first by whole rows, then within a row.

    Parameters
    ----------
    count : returns the number of isects of the tiles from its first argument to its second (exclusive).

    Raises
    ------
    DeviceError : one tile alone has more isects.
    """

    def halved(first: int, end: int) -> tuple[Band, ...]:
        n_isects, n_tiles = count(first, end), end - first
        if n_isects <= limit:
            return (Band(first, end, n_isects),)
        if n_tiles == 1:
            raise DeviceError(
                f"{n_isects} splats over one tile, and buffers for {limit} at most", FEWER_SPLATS, OTHER_DEVICE
            )
        unit = tiles_x if n_tiles > tiles_x else 1
        middle = first + n_tiles // unit // 2 * unit
        return halved(first, middle) + halved(middle, end)

    return halved(0, tiles_x * tiles_y)


@dataclass(frozen=True)
class _Image:
    """Sizes of the image that a binner works on; `chunks` of splats with `cells` counters each."""

    tiles_x: int
    n_tiles: int
    chunks: int = 0
    cells: int = 0


class ChunkBinner:
    """The binner for CPUs (cl/render/order.cl, and the second half of cl/render/bin.cl)."""

    def __init__(self, pool: Pool) -> None:
        self.units = max(pool.device.info.compute_units, 1)
        self.program = build(pool.device, ("render/order.cl", "render/bin.cl"), ORDER_DEFINES)
        # Order by depth.
        self._span, self._bucket_counts = pool.buffer(np.uint32, 2), pool.buffer(np.uint32, 1 << BUCKET_BITS)
        self._bucket_starts, self._n_visible = pool.buffer(np.uint32), pool.buffer(np.uint32)
        self._pairs, self._spare_pairs = pool.buffer(np.uint32, 2), pool.buffer(np.uint32, 2)
        self.depth_order = pool.buffer(np.uint32)
        # Counts by tile.
        self._ranked_rect, self._tile_counts = pool.buffer(np.uint16, 4), pool.buffer(np.uint32)
        self._tile_totals = pool.buffer(np.uint32)
        # Lists.
        self._ranges, self._splat_isects = pool.buffer(np.uint32, 2), pool.buffer(np.uint32, 2)
        self._isects, self._isect_splat = pool.buffer(np.uint32), pool.buffer(np.uint32)
        self._splats: ProjectedSplats
        self._image: _Image
        self._isects_before: NDArray[np.int64] | None = None  # each tile of the image

    def order(self, splats: ProjectedSplats) -> None:
        program, n = self.program, splats.n
        self._splats = splats
        chunks = min(-(-n // _MIN_CHUNK), self.units)
        split = {"n_splats": n, "run": -(-n // chunks)}
        span, counts = self._span.reserve(chunks), self._bucket_counts.reserve(chunks)
        starts, pairs = self._bucket_starts.reserve((1 << BUCKET_BITS) + 1), self._pairs.reserve(splats.capacity)
        program.depth_span.over(
            chunks,
            1,
            depth_key=splats.depth_key,
            span=span,
            splat_isects=self._splat_isects.reserve(splats.capacity),
            **split,
        )
        program.depth_histogram.over(
            chunks, 1, depth_key=splats.depth_key, span=span, counts=counts, n_chunks=chunks, **split
        )
        program.depth_scatter.over(
            chunks,
            1,
            depth_key=splats.depth_key,
            span=span,
            counts=counts,
            pairs=pairs,
            bucket_starts=starts,
            n_visible=self._n_visible.reserve(1),
            n_chunks=chunks,
            **split,
        )
        program.depth_buckets.over(
            min(-(-n // _MIN_CHUNK), _CHUNKS_PER_UNIT * self.units),
            1,
            bucket_starts=starts,
            span=span,
            pairs=pairs,
            spare=self._spare_pairs.reserve(splats.capacity),
            depth_order=self.depth_order.reserve(splats.capacity),
            n_chunks=chunks,
        )

    def begin(self, tiles_x: int, tiles_y: int) -> None:
        splats, n_tiles, cells = self._splats, tiles_x * tiles_y, (tiles_x + 1) * (tiles_y + 1)
        # A chunk has at least a quarter as many splats as counters, but each unit gets a chunk in any case.
        chunks = max(min(_CHUNKS_PER_UNIT * self.units, 4 * splats.n // cells), self.units)
        chunks = min(chunks, -(-splats.n // _MIN_CHUNK))
        counts = self._tile_counts.reserve(chunks * cells)
        self.program.count_tiles.over(
            chunks,
            1,
            order=self.depth_order.buffer,
            n_visible=self._n_visible.buffer,
            tile_rect=splats.tile_rect,
            ranked_rect=self._ranked_rect.reserve(splats.capacity),
            counts=counts,
            tiles_x=tiles_x,
            tiles_y=tiles_y,
        )
        parts = min(self.units, -(-chunks * n_tiles // _MIN_CHUNK))
        self.program.total_tiles.over(
            parts,
            1,
            counts=counts,
            totals=self._tile_totals.reserve(n_tiles),
            n_chunks=chunks,
            cells=cells,
            n_tiles=n_tiles,
            run=-(-n_tiles // parts),
        )
        self._image, self._isects_before = _Image(tiles_x, n_tiles, chunks, cells), None

    def count(self, first: int, end: int) -> int:
        if self._isects_before is None:
            totals = self._tile_totals.read(self._image.n_tiles)
            self._isects_before = np.concatenate([[0], np.cumsum(totals, dtype=np.int64)])
        return int(self._isects_before[end] - self._isects_before[first])

    def list_isects(self, band: Band) -> TileLists:
        image = self._image
        whole = (band.first, band.end) == (0, image.n_tiles)  # the kernel writes the ranges of the band's tiles only
        lists = TileLists(
            ranges=self._ranges.reserve(image.n_tiles) if whole else self._ranges.zeros(image.n_tiles),
            isects=self._isects.reserve(band.n_isects),
            isect_splat=self._isect_splat.reserve(band.n_isects),
            splat_isects=self._splat_isects.buffer,
        )
        self.program.list_isects.over(
            image.chunks,
            1,
            order=self.depth_order.buffer,
            n_visible=self._n_visible.buffer,
            ranked_rect=self._ranked_rect.buffer,
            totals=self._tile_totals.buffer,
            counts=self._tile_counts.buffer,
            tile_ranges=lists.ranges,
            splat_isects=lists.splat_isects,
            isect_splat=lists.isect_splat,
            lists=lists.isects,
            cells=image.cells,
            first_tile=band.first,
            end_tile=band.end,
            tiles_x=image.tiles_x,
        )
        return lists


class GroupBinner:
    """The binner for devices with many work-items (cl/render/sort.cl, and the first half of cl/render/bin.cl)."""

    def __init__(self, pool: Pool) -> None:
        self.sorter = Sorter(pool)
        self.program = build(pool.device, ("render/bin.cl",))
        self._by_depth, self._by_tile = SortMemory(pool), SortMemory(pool)
        self._counts, self._offsets, self._n_isects = (pool.buffer(t) for t in (np.uint32, np.uint32, np.uint64))
        self._ranges, self._splat_isects = pool.buffer(np.uint32, 2), pool.buffer(np.uint32, 2)
        self._isect_splat = pool.buffer(np.uint32)
        self._splats: ProjectedSplats
        self._image: _Image
        self._order: Buffer
        self._counted: tuple[int, int] | None = None  # tiles whose counts are in the buffers

    def order(self, splats: ProjectedSplats) -> None:
        self._splats = splats
        self._by_depth.reserve(splats.capacity)
        self._order = self.sorter.sort(splats.depth_key, splats.n, 32, self._by_depth)[1]

    def begin(self, tiles_x: int, tiles_y: int) -> None:
        self._image, self._counted = _Image(tiles_x, tiles_x * tiles_y), None

    def count(self, first: int, end: int) -> int:
        self._count(first, end)
        return int(self._n_isects.read(1)[0])

    def list_isects(self, band: Band) -> TileLists:
        splats, image, n_isects = self._splats, self._image, band.n_isects
        if self._counted != (band.first, band.end):
            self._count(band.first, band.end)
        ids = self._by_tile.values.reserve(n_isects)
        tiles = self._by_tile.keys.reserve(n_isects)
        splat_isects, isect_splat = self._splat_isects.reserve(splats.capacity), self._isect_splat.reserve(n_isects)
        self.program.emit_isects.over(
            splats.n,
            order=self._order,
            tile_rect=splats.tile_rect,
            offsets=self._offsets.buffer,
            splat_isects=splat_isects,
            isect_tile=tiles,
            isect_splat=isect_splat,
            n_splats=splats.n,
            first_tile=band.first,
            end_tile=band.end,
            tiles_x=image.tiles_x,
        )
        ranges = self._ranges.zeros(image.n_tiles)
        if n_isects:
            bits = max((image.n_tiles - 1).bit_length(), 1)
            tiles, ids = self.sorter.sort(tiles, n_isects, bits, self._by_tile)
            self.program.find_tile_ranges.over(n_isects, sorted_tile=tiles, tile_ranges=ranges, n_isects=n_isects)
        return TileLists(ranges, ids, isect_splat, splat_isects)

    def _count(self, first: int, end: int) -> None:
        splats = self._splats
        counts, offsets = self._counts.reserve(splats.capacity), self._offsets.reserve(splats.capacity)
        self.program.count_isects.over(
            splats.n,
            order=self._order,
            tile_rect=splats.tile_rect,
            counts=counts,
            n_splats=splats.n,
            first_tile=first,
            end_tile=end,
            tiles_x=self._image.tiles_x,
        )
        self.sorter.scan(counts, offsets, splats.n, self._n_isects.reserve(1))
        self._counted = (first, end)

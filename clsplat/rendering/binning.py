"""From projected splats to the isects of each tile, front to back, for one band of tiles at a time.

Two binners give the same numbers. `ChunkBinner` is for CPUs: it cuts the work into a few chunks and counts by tile.
`GroupBinner` (group_binner.py) has many work-items, and sorts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..device.memory import Pool
from ..device.opencl import Buffer
from ..device.program import Define
from ..errors import FEWER_SPLATS, OTHER_DEVICE, DeviceError
from .build import CULLED_KEY, KernelBuild
from .frame import Band, ProjectedSplats, TileLists

MAX_ISECTS = 2**31 - 1  # of a band: ids have 32 bits
BUCKET_BITS = 11  # bits of a depth key that choose its bucket
CHUNK_FILES = ("render/order.cl", "render/band.clh", "render/bin.cl")
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


def strip_arguments(splats: ProjectedSplats, strips: Buffer | None) -> dict[str, Buffer]:
    """Return what the kernel that lists isects needs to write their strips; nothing without a buffer for them."""
    return {} if strips is None else {"records": splats.records, "isect_blocks": strips}


@dataclass(frozen=True)
class _Image:
    """Sizes of the image that the binner works on; `chunks` of splats with `cells` counters each."""

    tiles_x: int
    n_tiles: int
    chunks: int
    cells: int


class ChunkBinner:
    """The binner for CPUs (cl/render/order.cl, cl/render/bin.cl). kernels : the build that draws the isects."""

    def __init__(self, pool: Pool, kernels: KernelBuild) -> None:
        self.units, self.kernels = max(pool.device.info.compute_units, 1), kernels
        self.program = kernels.binning_program(pool.device, CHUNK_FILES, ORDER_DEFINES)
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
        self._isects, self._isect_splat, self._isect_strips = (pool.buffer(np.uint32) for _ in range(3))
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
            strips=self._isect_strips.reserve(band.n_isects) if self.kernels.culls_strips else None,
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
            **strip_arguments(self._splats, lists.strips),
            cells=image.cells,
            first_tile=band.first,
            end_tile=band.end,
            tiles_x=image.tiles_x,
        )
        return lists

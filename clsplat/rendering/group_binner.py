"""The binner for devices with many work-items: a work-item for each splat and for each isect, and two sorts."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..device.device import Device
from ..device.memory import Pool
from ..device.opencl import Buffer
from ..device.program import Program
from .binning import Binner, ChunkBinner, strip_arguments
from .build import KernelBuild
from .frame import Band, ProjectedSplats, TileLists
from .radix_sort import Sorter, SortMemory, sort_group

DEPTH_BITS = 30  # of a depth key above that of the near plane: all depths up to 2^128 times the nearest one


def make_binner(pool: Pool, kernels: KernelBuild) -> Binner:
    """Return the binner for a kind of device. The one for CPUs works with groups of one, too."""
    device = pool.device
    few_items = device.info.type == "CPU" and not device.info.ends_long_loops
    if few_items or not sort_group(device):
        return ChunkBinner(pool, kernels)
    return GroupBinner(pool, kernels)


def group_binning_program(device: Device, kernels: KernelBuild, group: int) -> Program:
    """Return the program that lists isects by splat, for work-groups of `group` items."""
    files = ("render/scan.clh", "render/band.clh", "render/group_bin.cl")
    return kernels.binning_program(device, files, {"SCAN_GROUP": group})


class GroupBinner:
    """The `Binner` for devices with many work-items (cl/render/sort.cl, cl/render/group_bin.cl).

    Parameters
    ----------
    kernels : the build that draws the isects.
    """

    def __init__(self, pool: Pool, kernels: KernelBuild) -> None:
        self.sorter, self.kernels = Sorter(pool), kernels
        self.group = self.sorter.group
        self.program = group_binning_program(pool.device, kernels, self.group)
        self._by_depth, self._by_tile = SortMemory(pool), SortMemory(pool)
        self._blocks, self._n_isects = pool.buffer(np.uint32), pool.buffer(np.uint64)
        self._ranges, self._splat_isects = pool.buffer(np.uint32, 2), pool.buffer(np.uint32, 2)
        self._isect_splat, self._isect_strips = pool.buffer(np.uint32), pool.buffer(np.uint32)
        self._splats: ProjectedSplats
        self._order: Buffer  # splats by depth
        self._rank_starts: Buffer  # in the memory of the sorted depths, which nothing else needs
        self._tiles_x, self._n_tiles = 0, 0
        self._counted: tuple[int, int] | None = None  # tiles whose counts are in the buffer

    def order(self, splats: ProjectedSplats) -> None:
        self._splats = splats
        self._by_depth.reserve(splats.capacity)
        self._rank_starts, self._order = self.sorter.sort(
            splats.depth_key, splats.n, DEPTH_BITS, self._by_depth, int(np.float32(splats.near_plane).view(np.uint32))
        )

    def begin(self, tiles_x: int, tiles_y: int) -> None:
        self._tiles_x, self._n_tiles, self._counted = tiles_x, tiles_x * tiles_y, None

    def count(self, first: int, end: int) -> int:
        self._count(first, end)
        return int(self._n_isects.read(1)[0])

    def list_isects(self, band: Band) -> TileLists:
        splats, n_isects = self._splats, band.n_isects
        if self._counted != (band.first, band.end):
            self._count(band.first, band.end)
        ids = self._by_tile.values.reserve(n_isects)
        tiles = self._by_tile.keys.reserve(n_isects)
        isect_splat = self._isect_splat.reserve(n_isects)
        strips = self._isect_strips.reserve(n_isects) if self.kernels.culls_strips else None
        self.program.emit_isects.over(
            n_isects,
            block_starts=self._blocks.buffer,
            isect_tile=tiles,
            isect_splat=isect_splat,
            n_blocks=self._n_blocks,
            n_isects=n_isects,
            **strip_arguments(splats, strips),
            **self._shared(band.first, band.end),
        )
        if n_isects:
            bits = max((self._n_tiles - 1).bit_length(), 1)
            tiles, ids = self.sorter.sort(tiles, n_isects, bits, self._by_tile)
        ranges = self._ranges.reserve(self._n_tiles)
        self.program.find_tile_ranges.over(
            self._n_tiles, sorted_tile=tiles, tile_ranges=ranges, n_isects=n_isects, n_tiles=self._n_tiles
        )
        return TileLists(ranges, ids, isect_splat, self._splat_isects.buffer, strips)

    @property
    def _n_blocks(self) -> int:
        """Blocks of depth ranks; a work-group has one."""
        return -(-self._splats.n // self.group)

    def _shared(self, first: int, end: int) -> dict[str, Any]:
        """Arguments of the kernels that count and list the isects of a band."""
        return {
            "order": self._order,
            "tile_rect": self._splats.tile_rect,
            "rank_starts": self._rank_starts,
            "splat_isects": self._splat_isects.reserve(self._splats.capacity),
            "n_splats": self._splats.n,
            "first_tile": first,
            "end_tile": end,
            "tiles_x": self._tiles_x,
        }

    def _count(self, first: int, end: int) -> None:
        """Write the first isect of each block, and the number of isects."""
        blocks = self._blocks.reserve(self._n_blocks)
        self.program.count_isects(
            (self._n_blocks * self.group,), (self.group,), block_counts=blocks, **self._shared(first, end)
        )
        self.program.scan_isects(
            (self.group,),
            (self.group,),
            block_counts=blocks,
            total=self._n_isects.reserve(1),
            n_blocks=self._n_blocks,
        )
        self._counted = (first, end)

"""How many pairs of splat and pixel a frame could not do without: |alpha| >= 1/255, pixel not finished before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..device.device import TILE
from ..device.memory import to_host
from .pipeline import Frame, Pipeline


def count_pairs(pipeline: Pipeline, frame: Frame) -> int:
    """Useful pairs of the pipeline's last frame; runs the pixel formula of every isect once more."""
    return int(_counts(pipeline, frame).sum())


def pairs_per_pixel(pipeline: Pipeline, frame: Frame) -> NDArray[np.float32]:
    """(H, W) splats that a pixel of the last frame takes in, as the mean over its block of pixels.

    A block is what the schedule makes at once: 4 x 4 pixels with 16 lanes, 4 x 2 with 8, a single one with 1.
    """
    layout, lanes = frame.layout, pipeline.kernels.lanes
    wide = 1 if lanes == 1 else 4  # BLOCK_W and BLOCK_H of cl/math/lanes.clh
    high = lanes // wide
    blocks_x, blocks_y = TILE // wide, TILE // high
    by_tile = _counts(pipeline, frame).reshape(layout.tiles_y, layout.tiles_x, blocks_y, blocks_x)
    blocks = by_tile.transpose(0, 2, 1, 3).reshape(layout.tiles_y * blocks_y, layout.tiles_x * blocks_x)
    rows = np.clip(layout.height - high * np.arange(len(blocks)), 1, high)  # of the block within the image
    columns = np.clip(layout.width - wide * np.arange(blocks.shape[1]), 1, wide)
    mean = (blocks / (rows[:, None] * columns)).astype(np.float32)
    return mean.repeat(high, axis=0).repeat(wide, axis=1)[: layout.height, : layout.width]


def _counts(pipeline: Pipeline, frame: Frame) -> NDArray[np.int64]:
    """(tiles * blocks of a tile,) useful pairs of each block of pixels (cl/measure/count.cl)."""
    kernels, layout, pool = pipeline.kernels, frame.layout, pipeline.pool
    n_counts = layout.tiles_x * layout.tiles_y * TILE**2 // kernels.lanes
    counts = pool.get("pair_counts", 4 * n_counts)
    useful = np.zeros(n_counts, np.int64)
    for _, lists in pipeline.bands(frame):
        kernels.count_program(pipeline.device).count_pairs.over(
            n_counts,
            pipeline.group,
            tile_ranges=pool.get("tile_ranges", 0),
            lists=lists,
            isect_splat=pool.get("isect_splat", 0),
            records=pool.get("records", 0),
            counts=counts,
            n_counts=n_counts,
            width=layout.width,
            height=layout.height,
            tiles_x=layout.tiles_x,
        )
        useful += to_host(pipeline.device, counts, np.empty(n_counts, np.uint32))
    return useful

"""Overdraw: how many splats a pixel needs. A pair counts if |alpha| >= 1/255 and the pixel is not opaque before it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..device.memory import to_host
from ..device.schedule import TILE
from .frame import Frame
from .pipeline import Pipeline


def count_pairs(pipeline: Pipeline, frame: Frame) -> int:
    """Return the number of useful pairs of splat and pixel; evaluates the pixel formula of every isect once more."""
    return int(_block_counts(pipeline, frame).sum())


def splats_per_pixel(pipeline: Pipeline, frame: Frame) -> NDArray[np.float32]:
    """Return the useful splats of each pixel (H, W), as the mean over its block of pixels.

    A block is what the schedule computes at once (`Schedule.block`).
    """
    layout = frame.layout
    wide, high = pipeline.kernels.schedule.block
    blocks_x, blocks_y = TILE // wide, TILE // high
    by_tile = _block_counts(pipeline, frame).reshape(layout.tiles_y, layout.tiles_x, blocks_y, blocks_x)
    blocks = by_tile.transpose(0, 2, 1, 3).reshape(layout.tiles_y * blocks_y, layout.tiles_x * blocks_x)
    rows = np.clip(layout.height - high * np.arange(len(blocks)), 1, high)  # of the block within the image
    columns = np.clip(layout.width - wide * np.arange(blocks.shape[1]), 1, wide)
    mean = (blocks / (rows[:, None] * columns)).astype(np.float32)
    return mean.repeat(high, axis=0).repeat(wide, axis=1)[: layout.height, : layout.width]


def _block_counts(pipeline: Pipeline, frame: Frame) -> NDArray[np.int64]:
    """Useful pairs of each block of pixels, (tiles * blocks of a tile,) (cl/measure/count.cl)."""
    kernels, layout, device = pipeline.kernels, frame.layout, pipeline.device
    n_counts = layout.n_tiles * TILE**2 // kernels.lanes
    counts = device.alloc(4 * n_counts)
    useful = np.zeros(n_counts, np.int64)
    for _, lists in pipeline.bands(frame):
        kernels.count_program(device).count_pairs.over(
            n_counts,
            pipeline.group,
            tile_ranges=lists.ranges,
            lists=lists.isects,
            isect_splat=lists.isect_splat,
            records=frame.projected.records,
            counts=counts,
            n_counts=n_counts,
            width=layout.width,
            height=layout.height,
            tiles_x=layout.tiles_x,
        )
        useful += to_host(device, counts, np.empty(n_counts, np.uint32))
    return useful

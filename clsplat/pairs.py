"""How many pairs of splat and pixel a frame could not do without: |alpha| >= 1/255, pixel not finished before."""

from __future__ import annotations

import numpy as np

from .buffers import to_host
from .pipeline import Frame, Pipeline


def count_pairs(pipeline: Pipeline, frame: Frame) -> int:
    """Useful pairs of the pipeline's last frame; runs the pixel formula of every isect once more."""
    kernels, layout, pool = pipeline.kernels, frame.layout, pipeline.pool
    n_counts = layout.tiles_x * layout.tiles_y * layout.tile**2 // kernels.lanes
    counts = pool.get("pair_counts", 4 * n_counts)
    useful = 0
    for _, lists in pipeline.bands(frame):
        kernels.count_program(pipeline.device).count_pairs.over(
            n_counts, pipeline.group, tile_ranges=pool.get("tile_ranges", 0), lists=lists,
            isect_splat=pool.get("isect_splat", 0), records=pool.get("records", 0), counts=counts, n_counts=n_counts,
            width=layout.width, height=layout.height, tiles_x=layout.tiles_x)
        useful += int(to_host(pipeline.device, counts, np.empty(n_counts, np.uint32)).sum(dtype=np.int64))
    return useful

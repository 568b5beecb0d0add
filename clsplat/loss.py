"""(1 - lambda) L1 + lambda (1 - SSIM) on the device: value, gradient, and the numbers for the log."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .buffers import to_device, to_host
from .pipeline import ImageLayout, Pipeline

_SUM_RUN = 512  # partial sums added by one work-item


@dataclass(frozen=True)
class LossValue:
    """Means over pixels and channels; `total` is the weighted loss."""

    total: float
    l1: float
    ssim: float
    mse: float

    @property
    def psnr(self) -> float:
        """Peak signal-to-noise ratio of the unrounded image [dB]."""
        return -10 * math.log10(max(self.mse, 1e-12))


class ImageLoss:
    """Loss of a pipeline's "color" image against a truth.

    Parameters
    ----------
    weight : lambda, of 1 - SSIM.
    """

    def __init__(self, pipeline: Pipeline, weight: float) -> None:
        self.pipeline, self.weight = pipeline, weight
        self.device, self.kernels = pipeline.device, pipeline.kernels
        self.program = self.kernels.loss_program(self.device)
        self._sums: tuple[Any, int, int] | None = None

    def set_truth(self, image: NDArray[np.uint8]) -> ImageLayout:
        """Upload an (H, W, 3) image; returns its layout."""
        height, width = image.shape[:2]
        layout = ImageLayout(width, height)
        buffer = self.pipeline.pool.get("truth_bytes", image.nbytes)
        to_device(self.device, buffer, image)
        self.program.unpack_image((width, height), self._row(width), bytes=buffer,
                                  image=self.pipeline.image("truth", layout, 3), width=width,
                                  stride=layout.stride, plane=layout.plane)
        return layout

    def gradient(self, layout: ImageLayout) -> Any:
        """Gradient of the loss with respect to "color", as a buffer; the value waits for `value`."""
        image, pool, real = self.pipeline.image, self.pipeline.pool, self.kernels.dtype.itemsize
        size = (layout.tiles_x * 16 // self.kernels.lanes, layout.height, 3)
        n_runs = size[0] * size[1] * size[2]
        row = self._row(size[0]) and (size[0], 1, 1)
        common = {"stride": layout.stride, "plane": layout.plane}
        pair = {"rendered": image("color", layout, 3), "truth": image("truth", layout, 3)}
        maps, v_maps = image("ssim_maps", layout, 15), image("ssim_v_maps", layout, 9)
        hmaps, v_color = image("ssim_v_rows", layout, 9), image("v_color", layout, 3)
        partial = pool.get("loss_partial", 3 * n_runs * real)
        count = 3 * layout.width * layout.height
        program = self.program
        program.ssim_rows(size, row, maps=maps, **pair, **common)
        program.ssim_columns(size, row, maps=maps, v_maps=v_maps, partial=partial, width=layout.width, **pair,
                             **common)
        program.ssim_rows_vjp(size, row, v_maps=v_maps, hmaps=hmaps, **common)
        program.loss_vjp(size, row, hmaps=hmaps, v_color=v_color, width=layout.width,
                         l1_scale=(1 - self.weight) / count, ssim_scale=self.weight / count, **pair, **common)
        n_parts = -(-n_runs // _SUM_RUN)
        sums = pool.get("loss_sums", 3 * n_parts * real)
        program.sum_runs((n_parts, 3), (1, 1), partial=partial, sums=sums, n=n_runs, run=_SUM_RUN)
        self._sums = (sums, n_parts, count)
        return v_color

    def _row(self, items: int) -> tuple[int, int] | None:
        """Groups of one row on CPUs (see Kernel.over), the driver's choice elsewhere."""
        return (items, 1) if self.device.info.type == "CPU" and items <= self.device.info.max_group else None

    def value(self) -> LossValue:
        """The loss of the last `gradient` call (waits for the device)."""
        assert self._sums is not None
        sums, n_parts, count = self._sums
        parts = to_host(self.device, sums, np.empty((3, n_parts), self.kernels.dtype))
        l1, ssim, mse = (parts.astype(np.float64).sum(axis=1) / count).tolist()
        return LossValue((1 - self.weight) * l1 + self.weight * (1 - ssim), l1, ssim, mse)

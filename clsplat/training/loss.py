"""(1 - lambda) L1 + lambda (1 - SSIM) on the device: value, gradient, and the numbers for the log."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..device.device import TILE
from ..device.memory import to_host
from ..device.program import GROUP_ITEMS, lane_group
from ..rendering.pipeline import ImageLayout, Pipeline
from .programs import loss_program, loss_strip

_LEAST_ROWS = 32  # of a work-item, which blurs ten rows beyond them
_ITEMS_PER_UNIT = {"CPU": 6, "GPU": 2048}  # so many that no compute unit of the device waits long for the last


@dataclass(frozen=True)
class LossValue:
    """Means over the pixels that count and channels; `total` is the weighted loss, over all pixels."""

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
        self.program = loss_program(self.device, self.kernels)
        # One lane, an item a pixel column: groups that read whole lines of memory.
        self._group = lane_group(self.device) if self.kernels.lanes > 1 else GROUP_ITEMS
        self._sums: tuple[Any, int, int, float] | None = None

    def gradient(self, layout: ImageLayout, truth: Any, rendered: Any = None, counted: float = 1.0) -> Any:
        """Gradient of the loss with respect to "color", as a buffer; the value waits for `value`.

        Parameters
        ----------
        truth : buffer of bytes [3, rows, stride] in the layout (truths.py).
        rendered : image in the layout to take in the place of "color".
        counted : fraction of the pixels that are not masked; the others have no error.
        """
        image, kernels = self.pipeline.image, self.kernels
        strips = -(-layout.tiles_x * TILE // (kernels.lanes * loss_strip(kernels)))
        segment = self._rows(strips, layout.height)
        segments = -(-layout.height // segment)
        n_parts = 3 * segments * strips
        partial = self.pipeline.pool.get("loss_partial", 3 * n_parts * kernels.dtype.itemsize)
        group, count = self._group, 3 * layout.width * layout.height
        size, v_color = (-(-strips // group) * group, segments, 3), image("v_color", layout, 3)
        common = {
            "rendered": image("color", layout, 3) if rendered is None else rendered,
            "truth": truth,
            "v_maps": image("loss_v_maps", layout, 9),
            "width": layout.width,
            "height": layout.height,
            "stride": layout.stride,
            "plane": layout.plane,
            "segment": segment,
        }
        self.program.image_loss(size, (group, 1, 1), partial=partial, **common)
        self.program.image_loss_vjp(
            size,
            (group, 1, 1),
            v_color=v_color,
            l1_scale=(1 - self.weight) / count,
            ssim_scale=self.weight / count,
            **common,
        )
        self._sums = (partial, n_parts, count, counted)
        return v_color

    def value(self) -> LossValue:
        """The loss of the last `gradient` call (waits for the device)."""
        assert self._sums is not None
        partial, n_parts, count, counted = self._sums
        parts = to_host(self.device, partial, np.empty((3, n_parts), self.kernels.dtype))
        l1, ssim, mse = (parts.astype(np.float64).sum(axis=1) / count).tolist()
        total = (1 - self.weight) * l1 + self.weight * (1 - ssim)
        return LossValue(total, l1 / counted, 1 - (1 - ssim) / counted, mse / counted)

    def _rows(self, strips: int, height: int) -> int:
        """Rows of a work-item: as many as still leave work for the whole device."""
        info = self.device.info
        wanted = info.compute_units * _ITEMS_PER_UNIT["CPU" if info.type == "CPU" else "GPU"]
        return max(-(-height // -(-wanted // (3 * strips))), _LEAST_ROWS)

"""The training loss on the device, its gradient, and the values for the log.

The loss is (1 - lambda) L1 + lambda (1 - SSIM), the loss of 3DGS. L1 may be smooth: e^2 / (2 beta) for an error e below
beta, and |e| - beta / 2 from there on (Girshick 2015, arXiv 1504.08083).
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device.memory import Pool, send_to_host, to_host
from ..device.opencl import Buffer, Event, KernelArgument
from ..device.program import GROUP_ITEMS, lane_group
from ..device.schedule import TILE
from ..rendering.build import KernelBuild
from ..rendering.frame import DeviceImage, ImageLayout
from .programs import loss_program, loss_strip

MIN_ROWS = 32  # minimum rows of a work-item, which also blurs ten rows outside of them
STEEPEST = 1e30  # slope of L1 near 0, in place of 1 / beta
ITEMS_PER_UNIT = {"CPU": 6, "GPU": 2048}  # enough work-items that no compute unit waits long for the last one


@dataclass(frozen=True)
class LossValue:
    """The loss of one image.

    Attributes
    ----------
    total : the weighted loss, a mean over all pixels.
    l1, ssim, mse : means over the pixels that are not masked, and over channels.
    """

    total: float
    l1: float
    ssim: float
    mse: float

    @property
    def psnr(self) -> float:
        """Peak signal-to-noise ratio of the unrounded image [dB]."""
        return -10 * math.log10(max(self.mse, 1e-12))

    def to_json(self) -> dict[str, float]:
        """Return the values by name, as in log.jsonl."""
        return {"loss": self.total, "l1": self.l1, "ssim": self.ssim, "psnr": self.psnr}


def mean_loss(values: Sequence[LossValue]) -> LossValue:
    """Return the mean of the losses of several images."""
    means = (statistics.fmean(getattr(value, name) for value in values) for name in ("total", "l1", "ssim", "mse"))
    return LossValue(*means)


@dataclass(frozen=True)
class LossResult:
    """One evaluation of the loss, valid until the next evaluation of the same `ImageLoss`.

    Attributes
    ----------
    v_color : buffer with the gradient of the loss with respect to the image.
    partial : buffer (4, n_parts) with sums of smooth L1, SSIM, L1 and squared error.
    count : pixels times channels.
    unmasked : fraction of the pixels that are not masked.
    number : position among the evaluations of its `ImageLoss`.
    """

    v_color: Buffer
    partial: Buffer
    n_parts: int
    count: int
    unmasked: float
    number: int


@dataclass(frozen=True)
class PendingValue:
    """Values of the loss that are on the way to the host. `wait` returns them."""

    result: LossResult
    weight: float
    parts: NDArray[np.floating]
    event: Event

    def wait(self) -> LossValue:
        """Return the values after waiting for the device."""
        self.event.wait()
        result = self.result
        smooth, ssim, l1, mse = (self.parts.astype(np.float64).sum(axis=1) / result.count).tolist()
        total = (1 - self.weight) * smooth + self.weight * (1 - ssim)
        seen = result.unmasked or 1.0  # a mask may hide all of a small image: the errors are 0 then
        return LossValue(total, l1 / seen, 1 - (1 - ssim) / seen, mse / seen)


class ImageLoss:
    """Loss of rendered images against target images.

    Parameters
    ----------
    pool : owner of the device memory.
    weight : lambda, the weight of 1 - SSIM.
    beta : error below which L1 is quadratic; 0 means L1 throughout.
    """

    def __init__(self, pool: Pool, kernels: KernelBuild, weight: float, beta: float = 0.0) -> None:
        self.device, self.pool, self.kernels = pool.device, pool, kernels
        self.weight, self.beta = weight, beta
        self.program = loss_program(self.device, self.kernels)
        # With one lane, a work-item is a column of pixels. A group then reads whole lines of memory.
        self._group = lane_group(self.device) if self.kernels.lanes > 1 else GROUP_ITEMS
        self._v_color, self._v_maps = DeviceImage(pool, kernels.dtype, 3), DeviceImage(pool, kernels.dtype, 9)
        self._partial = pool.buffer(kernels.dtype, 4)
        self._evaluations = 0

    def evaluate(self, layout: ImageLayout, rendered: Buffer, target: Buffer, unmasked: float = 1.0) -> LossResult:
        """Return the loss and its gradient with respect to the image, without waiting for the device.

        Parameters
        ----------
        rendered : image of 3 planes in the layout.
        target : buffer of bytes [3, rows, stride] in the layout (targets.py).
        unmasked : fraction of the pixels that are not masked. Masked pixels must be equal in both images.
        """
        kernels = self.kernels
        strips = -(-layout.tiles_x * TILE // (kernels.lanes * loss_strip(kernels)))
        segment = self._rows(strips, layout.height)
        segments = -(-layout.height // segment)
        n_parts = 3 * segments * strips  # for each channel
        partial = self._partial.reserve(n_parts)
        group, count = self._group, 3 * layout.width * layout.height
        v_color = self._v_color.reserve(layout)
        common: dict[str, KernelArgument] = {
            "rendered": rendered,
            "truth": target,
            "v_maps": self._v_maps.reserve(layout),
            "width": layout.width,
            "height": layout.height,
            "stride": layout.stride,
            "plane": layout.plane,
            "segment": segment,
            "steepness": 1 / self.beta if self.beta else STEEPEST,
        }
        self.program.image_loss.over(strips, group, segments, 3, partial=partial, beta=self.beta, **common)
        self.program.image_loss_vjp.over(
            strips,
            group,
            segments,
            3,
            v_color=v_color,
            l1_scale=(1 - self.weight) / count,
            ssim_scale=self.weight / count,
            **common,
        )
        self._evaluations += 1
        return LossResult(v_color, partial, n_parts, count, unmasked, self._evaluations)

    def gradient(self, result: LossResult, layout: ImageLayout) -> NDArray[np.floating]:
        """Return the gradient (H, W, 3) of an evaluation in this layout after waiting for the device."""
        planes = np.empty((3, layout.rows, layout.stride), self.kernels.dtype)
        return layout.unpack(to_host(self.device, result.v_color, planes))

    def value(self, result: LossResult) -> LossValue:
        """Return the values of the latest evaluation after waiting for the device.

        Raises
        ------
        RuntimeError : a later evaluation has overwritten the result.
        """
        return self.value_later(result).wait()

    def value_later(self, result: LossResult) -> PendingValue:
        """Return the values of the latest evaluation without waiting for the device; raises as `value`."""
        if result.number != self._evaluations:
            raise RuntimeError(f"loss result {result.number} was overwritten by evaluation {self._evaluations}")
        parts = np.empty((4, result.n_parts), self.kernels.dtype)
        return PendingValue(result, self.weight, parts, send_to_host(self.device, result.partial, parts))

    def _rows(self, strips: int, height: int) -> int:
        """Return the number of rows of a work-item: the largest that still leaves work for every compute unit."""
        info = self.device.info
        items = info.compute_units * ITEMS_PER_UNIT["CPU" if info.type == "CPU" else "GPU"]
        return max(-(-height // -(-items // (3 * strips))), MIN_ROWS)

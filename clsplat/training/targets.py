"""The training images on the device: 8-bit planes that stay there, as far as they fit a budget.

Planes are r, g, b; where any view has a mask or, for random backgrounds, transparency, then also mask and opacity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..cameras.camera import Camera
from ..device.device import Device
from ..device.memory import Pool, send_to_device
from ..files.images import ImageU8
from ..rendering.build import KernelBuild
from ..rendering.pipeline import ImageLayout
from ..scenes.scene import View
from .programs import loss_program

_COLOR, _WITH_MASKS = 3, 5  # planes
_HIDDEN, _COUNTS, _OPAQUE = 0, 255, 255
_SLOTS = 2  # for bytes on their way: a transfer need not wait for the iteration before


@dataclass(frozen=True)
class _Upload:
    """A transfer into one of the slots, still to be unpacked."""

    slot: int
    packed: Any
    event: Any


@dataclass
class Truth:
    """One image to learn: bytes [channels, rows, stride] with a zero margin, once `upload` is None.

    index : of the view. counted : fraction of the pixels that no mask hides.
    """

    index: int
    camera: Camera
    layout: ImageLayout
    counted: float
    buffer: Any
    upload: _Upload | None


class Truths:
    """Views at the size that an iteration asks for.

    An image is uploaded when it is first drawn, beside what the device is doing, and stays until the size changes.
    Those beyond the budget are uploaded whenever they are drawn.

    Parameters
    ----------
    views : training views.
    budget : bytes of device memory for images that stay.
    channels : of `truth_channels`.
    """

    def __init__(
        self, device: Device, kernels: KernelBuild, views: Sequence[View], budget: int, channels: int = _COLOR
    ) -> None:
        self.device, self.views, self.budget = device, views, budget
        self.channels = channels
        self.program = loss_program(device, kernels)
        self.pool = Pool(device)
        self._downscale = 0
        self._kept: dict[int, Truth] = {}
        self._kept_bytes = 0
        self._reduced: dict[int, View] = {}  # of those that do not stay
        self._queue: Any = None  # of transfers
        self._slot = 0
        self._unpacked: list[Any] = [None] * _SLOTS  # events after which a slot may be overwritten

    @property
    def nbytes(self) -> int:
        """Bytes of device memory held."""
        return self._kept_bytes + self.pool.nbytes

    def get(self, index: int, downscale: int) -> Truth:
        """View `index` at 1/downscale of its size. Starts its upload where it needs one; does not wait for it."""
        if downscale != self._downscale:
            self._downscale, self._kept_bytes = downscale, 0
            self._kept, self._reduced = {}, {}
        if index in self._kept:
            return self._kept[index]
        view = self._reduced.get(index)
        if view is None:
            view = self.views[index] if downscale == 1 else reduced(self.views[index], downscale)
        layout = ImageLayout(view.camera.width, view.camera.height)
        nbytes = self.channels * layout.plane
        stays = self._kept_bytes + nbytes <= self.budget
        buffer = self.device.alloc(nbytes) if stays else self.pool.get("truth", nbytes)
        counted = 1.0 if view.mask is None else float(view.mask.mean())
        truth = Truth(index, view.camera, layout, counted, buffer, self._start_upload(self._bytes(view)))
        if stays:
            self._kept[index] = truth
            self._kept_bytes += nbytes
        elif downscale > 1:
            self._reduced[index] = view
        return truth

    def planes(self, truth: Truth) -> Any:
        """The truth's buffer; commands that follow on the device's queue find the image in it."""
        import pyopencl as cl

        upload, layout = truth.upload, truth.layout
        if upload is not None:
            cl.enqueue_barrier(self.device.queue, wait_for=[upload.event])
            self._unpacked[upload.slot] = self.program.unpack_image(
                (layout.stride, layout.rows),
                (16, 1),
                bytes=upload.packed,
                truth=truth.buffer,
                channels=self.channels,
                width=layout.width,
                height=layout.height,
                plane=layout.plane,
            )
            truth.upload = None
        return truth.buffer

    def _bytes(self, view: View) -> ImageU8:
        """(H, W, channels)."""
        if self.channels == _COLOR:
            return view.image
        size = view.image.shape[:2]
        counts = np.full(size, _COUNTS, np.uint8) if view.mask is None else np.where(view.mask, _COUNTS, _HIDDEN)
        opacity = np.full(size, _OPAQUE, np.uint8) if view.alpha is None else view.alpha
        return np.dstack([view.image, counts.astype(np.uint8), opacity])

    def _start_upload(self, image: ImageU8) -> _Upload:
        import pyopencl as cl

        if self._queue is None:
            profiling = cl.command_queue_properties.PROFILING_ENABLE
            self._queue = cl.CommandQueue(self.device.context, properties=profiling)
        slot = self._slot = (self._slot + 1) % _SLOTS
        packed = self.pool.get(f"bytes{slot}", image.nbytes)
        event = send_to_device(self.device, packed, image, self._queue, self._unpacked[slot])
        self._queue.flush()
        return _Upload(slot, packed, event)


def reduced(view: View, downscale: int) -> View:
    """A view at 1/downscale of its size."""
    width, height = max(view.camera.width // downscale, 1), max(view.camera.height // downscale, 1)
    return view.resized(width, height)


def truth_channels(views: Sequence[View], with_alpha: bool) -> int:
    """Planes of each truth, as many as the views need; with_alpha: their transparency is of use."""
    more = any(view.mask is not None or (with_alpha and view.alpha is not None) for view in views)
    return _WITH_MASKS if more else _COLOR


def truth_budget(device: Device) -> int:
    """Bytes that images may keep on a device: a quarter of its memory."""
    return device.info.global_mem_bytes // 4


def truth_bytes(views: Sequence[View], budget: int, channels: int = _COLOR) -> int:
    """Most device memory that `Truths` of these views holds, with tiles of this side."""
    sizes = [channels * ImageLayout(view.camera.width, view.camera.height).plane for view in views]
    return min(sum(sizes), budget) + (_SLOTS + 1) * max(sizes)

"""The training images on the device: 8-bit planes that stay there, as far as they fit a budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from .buffers import Pool, send_to_device
from .camera import Camera
from .device import Device
from .images import ImageU8, resize_area
from .kernels import KernelBuild
from .pipeline import ImageLayout
from .scene import View

_PLANES = 3  # of bytes, in the layout of all images
_SLOTS = 2  # for bytes on their way: a transfer need not wait for the iteration before


@dataclass(frozen=True)
class _Upload:
    """A transfer into one of the slots, still to be unpacked."""

    slot: int
    packed: Any
    event: Any


@dataclass
class Truth:
    """One image to learn: bytes [3, rows, stride] with a zero margin, once `upload` is None."""

    camera: Camera
    layout: ImageLayout
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
    """

    def __init__(self, device: Device, kernels: KernelBuild, views: Sequence[View], budget: int) -> None:
        self.device, self.views, self.budget, self.tile = device, views, budget, kernels.schedule.tile
        self.program = kernels.loss_program(device)
        self.pool = Pool(device)
        self._downscale = 0
        self._kept: dict[int, Truth] = {}
        self._kept_bytes = 0
        self._reduced: dict[int, tuple[Camera, ImageU8]] = {}  # of those that do not stay
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
        if index in self._reduced:
            camera, image = self._reduced[index]
        else:
            view = self.views[index]
            camera, image = (view.camera, view.image) if downscale == 1 else reduced(view, downscale)
        layout = ImageLayout(camera.width, camera.height, self.tile)
        nbytes = _PLANES * layout.plane
        stays = self._kept_bytes + nbytes <= self.budget
        buffer = self.device.alloc(nbytes) if stays else self.pool.get("truth", nbytes)
        truth = Truth(camera, layout, buffer, self._start_upload(image))
        if stays:
            self._kept[index] = truth
            self._kept_bytes += nbytes
        elif downscale > 1:
            self._reduced[index] = camera, image
        return truth

    def planes(self, truth: Truth) -> Any:
        """The truth's buffer; commands that follow on the device's queue find the image in it."""
        import pyopencl as cl

        upload, layout = truth.upload, truth.layout
        if upload is not None:
            cl.enqueue_barrier(self.device.queue, wait_for=[upload.event])
            self._unpacked[upload.slot] = self.program.unpack_image(
                (layout.stride, layout.rows), (16, 1), bytes=upload.packed, truth=truth.buffer, width=layout.width,
                height=layout.height, plane=layout.plane)
            truth.upload = None
        return truth.buffer

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


def reduced(view: View, downscale: int) -> tuple[Camera, ImageU8]:
    """A view at 1/downscale of its size."""
    width, height = max(view.camera.width // downscale, 1), max(view.camera.height // downscale, 1)
    return view.camera.resized(width, height), resize_area(view.image, width, height)


def truth_budget(device: Device) -> int:
    """Bytes that images may keep on a device: a quarter of its memory."""
    return device.info.global_mem_bytes // 4


def truth_bytes(views: Sequence[View], budget: int, tile: int) -> int:
    """Most device memory that `Truths` of these views holds, with tiles of this side."""
    sizes = [_PLANES * ImageLayout(view.camera.width, view.camera.height, tile).plane for view in views]
    return min(sum(sizes), budget) + (_SLOTS + 1) * max(sizes)

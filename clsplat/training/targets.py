"""Target images: the training photos as 8-bit planes, which stay on the device if they fit a memory budget.

The planes are r, g, b. Two more planes follow if any view has a mask, or transparency with random backgrounds or
exposures: the mask and the opacity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..cameras.camera import Camera
from ..device.device import Device
from ..device.memory import Pool, UploadQueue
from ..device.opencl import Buffer, Event
from ..files.host_memory import give_back_free_memory
from ..files.images import ImageU8
from ..rendering.build import KernelBuild
from ..rendering.frame import ImageLayout
from ..scenes.scene import View
from .config import TrainConfig
from .programs import loss_program

_COLOR, _WITH_MASKS = 3, 5  # planes
_MASKED, _UNMASKED, _OPAQUE = 0, 255, 255
_SLOTS = 2  # number of buffers for transfers, so that a transfer does not wait for the previous iteration


@dataclass(frozen=True)
class _Upload:
    """A transfer into one of the slots. Its image is not unpacked yet."""

    slot: int
    packed: Buffer
    event: Event


@dataclass(frozen=True)
class Target:
    """One target image. `Targets.planes` returns its pixels.

    Attributes
    ----------
    index : index of the view. downscale : its image has 1/downscale of the view's size.
    unmasked : fraction of the pixels that are not masked.
    buffer : bytes [channels, rows, stride] with a zero margin.
    """

    index: int
    downscale: int
    camera: Camera
    layout: ImageLayout
    unmasked: float
    buffer: Buffer


class Targets:
    """Target images of the training views, at the image size of the current stage.

    An image is uploaded at its first request, while the device works on the previous iteration. It stays until the size
    changes. Images that do not fit the budget are uploaded each time. The memory of a CPU is that of the host: once a
    photo of the full size is there, its view gives up its pixels.

    Parameters
    ----------
    views : training views.
    budget : bytes of device memory for images that stay on the device.
    channels : planes of each image, from `target_channels`.
    """

    def __init__(
        self, device: Device, kernels: KernelBuild, views: Sequence[View], budget: int, channels: int = _COLOR
    ) -> None:
        self.device, self.views, self.budget = device, views, budget
        self.channels = channels
        self.program = loss_program(device, kernels)
        self.pool = Pool(device)
        self._downscale = 0
        self._kept: dict[int, Target] = {}
        self._kept_bytes = 0
        self._reduced: dict[int, View] = {}  # smaller photos of views whose planes do not stay on the device
        self._uploads: dict[int, _Upload] = {}  # pending transfers by view
        self._visitor = self.pool.buffer(np.uint8)  # the planes of an image that does not stay
        self._queue = UploadQueue(device)
        self._slots = [self.pool.buffer(np.uint8) for _ in range(_SLOTS)]
        self._slot = 0
        self._unpacked: list[Event | None] = [None] * _SLOTS  # a slot may be overwritten after its event

    @property
    def nbytes(self) -> int:
        """Bytes of device memory in use."""
        return self._kept_bytes + self.pool.nbytes

    def get(self, index: int, downscale: int) -> Target:
        """Return view `index` at 1/downscale of its size. If necessary, start its upload without waiting for it."""
        if downscale != self._downscale:
            self._downscale, self._kept_bytes = downscale, 0
            self._kept, self._reduced, self._uploads = {}, {}, {}
        if index in self._kept:
            return self._kept[index]
        view = self._reduced.get(index)
        if view is None:
            view = self.views[index].loaded() if downscale == 1 else reduced(self.views[index], downscale)
        layout = ImageLayout(view.camera.width, view.camera.height)
        nbytes = self.channels * layout.plane
        stays = self._kept_bytes + nbytes <= self.budget
        buffer = self.device.alloc(nbytes) if stays else self._visitor.reserve(nbytes)
        unmasked = 1.0 if view.mask is None else float(view.mask.mean())
        target = Target(index, downscale, view.camera, layout, unmasked, buffer)
        self._uploads[index] = self._start_upload(self._bytes(view))
        if stays:
            self._kept[index] = target
            self._kept_bytes += nbytes
            if downscale == 1 and self.device.info.type == "CPU":
                self.views[index].release()
                give_back_free_memory()
        elif downscale > 1:
            self._reduced[index] = view
        return target

    def planes(self, target: Target) -> Buffer:
        """Return the buffer of the target. All later commands in the device's queue may use it."""
        layout = target.layout
        upload = self._uploads.pop(target.index, None)
        if upload is not None:
            self._queue.wait_on_device(upload.event)
            self._unpacked[upload.slot] = self.program.unpack_image.over(
                layout.stride,
                16,
                layout.rows,
                bytes=upload.packed,
                truth=target.buffer,
                channels=self.channels,
                width=layout.width,
                height=layout.height,
                plane=layout.plane,
            )
        return target.buffer

    def _bytes(self, view: View) -> ImageU8:
        """Return the planes as (H, W, channels)."""
        if self.channels == _COLOR:
            return view.image
        size = view.image.shape[:2]
        mask = np.full(size, _UNMASKED, np.uint8) if view.mask is None else np.where(view.mask, _UNMASKED, _MASKED)
        opacity = np.full(size, _OPAQUE, np.uint8) if view.alpha is None else view.alpha
        return np.dstack([view.image, mask.astype(np.uint8), opacity])

    def _start_upload(self, image: ImageU8) -> _Upload:
        slot = self._slot = (self._slot + 1) % _SLOTS
        packed = self._slots[slot].reserve(image.nbytes)
        return _Upload(slot, packed, self._queue.send(packed, image, self._unpacked[slot]))


def reduced(view: View, downscale: int) -> View:
    """Return the view at 1/downscale of its size."""
    camera = reduced_camera(view.camera, downscale)
    return view.resized(camera.width, camera.height)


def reduced_camera(camera: Camera, downscale: int) -> Camera:
    """Return the camera of the view that `reduced` returns."""
    return camera.resized(max(camera.width // downscale, 1), max(camera.height // downscale, 1))


def target_channels(views: Sequence[View], config: TrainConfig) -> int:
    """Return the number of planes that the views need in a run."""
    with_alpha = config.random_background or config.appearance.exposure
    more = any(view.mask is not None or (with_alpha and view.alpha is not None) for view in views)
    return _WITH_MASKS if more else _COLOR


def target_budget(device: Device) -> int:
    """Return the bytes that target images may use on a device: a quarter of its memory."""
    return device.info.global_mem_bytes // 4


def target_bytes(views: Sequence[View], budget: int, channels: int = _COLOR) -> int:
    """Return an upper bound of the device memory of `Targets`."""
    sizes = [channels * ImageLayout(view.camera.width, view.camera.height).plane for view in views]
    return min(sum(sizes), budget) + (_SLOTS + 1) * max(sizes)

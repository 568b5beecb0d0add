"""Iterations of several photos, on one or several devices: their step has the mean of the photos' gradients.

Each device has a copy of the splats and the same number of photos of each iteration, one after another. The first
device sums the gradients in the order of the photos. So the sum has the same bits on any number of equal devices. The
first device alone has the optimizer and the densification. The others take its splats before each iteration. Rates grow
with the root of the number of photos (Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting Training").
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from ..device.memory import to_device, to_host
from ..device.opencl import Buffer
from ..errors import InputError
from ..rendering.frame import Frame
from ..rendering.splat_buffers import COMPACT_ROWS, CompactGradients, SplatStatistics
from ..splats.color import Color
from ..splats.fields import Array, Group, sh_coefficients
from .columns import Columns
from .config import TrainConfig
from .loss import PendingValue
from .programs import columns_program
from .replica import Replica


@dataclass(frozen=True)
class Photo:
    """A photo of an iteration: the index of its view, the downscale of its image, and the colour behind the splats."""

    view: int
    downscale: int
    background: Color


@dataclass(frozen=True)
class _Learned:
    """What an iteration needs of a photo.

    Attributes
    ----------
    rows : gradients of geometry and colour, and statistics, [rows, capacity] each; empty if they are summed already.
    """

    photo: Photo
    value: PendingValue
    exposure: NDArray[np.floating] | None
    rows: tuple[Array, ...] = ()


class Batch:
    """The photos of an iteration.

    Parameters
    ----------
    replicas : a copy of the splats for each device. Their number divides that of the photos.

    Attributes
    ----------
    grads : means of the gradients over the photos of the last iteration, on the first device.
    """

    def __init__(self, replicas: Sequence[Replica], config: TrainConfig) -> None:
        self.replicas, self.main, self.photos = replicas, replicas[0], config.schedule.batch
        main = self.main
        self._share = self.photos // len(replicas)  # photos of each device
        capacity, dtype = main.splats.capacity, main.splats.dtype
        self.grads = CompactGradients(main.device, main.splats.schema, capacity, dtype, self.photos)
        self._columns = Columns(main.device, columns_program(main.device, main.kernels), capacity, dtype)
        self._incoming = [main.pipeline.pool.buffer(dtype) for _ in self._rows]  # rows of another device
        self._lock = Lock()  # of the photos, which all devices read
        others = len(replicas) - 1
        self._threads = ThreadPoolExecutor(others, "clsplat-device") if others else None

    def learn(self, photos: Sequence[Photo], sh_degree: int, iteration: int) -> tuple[Frame, list[PendingValue]]:
        """Write the mean gradients of some photos into `grads`, and step their exposures.

        Returns
        -------
        The last frame of the first device, and the losses of the photos.
        """
        share, main = self._share, self.main
        splats = self._snapshot(sh_degree) if self._threads else []
        waiting: list[Future[list[_Learned]]] = []
        for number, replica in enumerate(self.replicas[1:], 1):
            of_replica = photos[number * share : (number + 1) * share]
            assert self._threads is not None
            waiting.append(self._threads.submit(self._learn, replica, of_replica, sh_degree, iteration, splats))
        learned = []
        try:
            for slot, photo in enumerate(photos[:share]):
                frame, one = self._learn_one(main, photo, sh_degree, iteration)
                learned.append(one)
                self._add(slot, main.grads.geom, main.grads.sh)
        finally:  # the threads may not outlive the iteration, also if a device fails
            wait(waiting)
            others = [one for future in waiting for one in future.result()]
        for slot, one in enumerate(others, share):
            self._add_rows(slot, one.rows)
        learned += others
        for one in learned:
            main.exposure.step(one.photo.view, one.exposure)
        for replica in self.replicas[1:]:
            replica.exposure.follow(main.exposure)
        return frame, [one.value for one in learned]

    def _learn(
        self, replica: Replica, photos: Sequence[Photo], sh_degree: int, iteration: int, splats: list[Array]
    ) -> list[_Learned]:
        """Do the photos of a device that is not the first one."""
        device, statistics = replica.device, replica.pipeline.statistics
        replica.splats.n = self.main.splats.n
        for buffer, rows in zip((replica.splats.geom, replica.splats.sh), splats, strict=True):
            to_device(device, buffer, rows)
        learned = []
        for photo in photos:
            statistics.reset()
            _, one = self._learn_one(replica, photo, sh_degree, iteration)
            buffers = (replica.grads.geom, replica.grads.sh, statistics.reserve(replica.splats.capacity))
            pairs = zip(buffers, self._rows, strict=True)
            learned.append(replace(one, rows=tuple(self._download(replica, *pair) for pair in pairs)))
        return learned

    def _learn_one(self, replica: Replica, photo: Photo, sh_degree: int, iteration: int) -> tuple[Frame, _Learned]:
        with self._lock:
            target = replica.targets.get(photo.view, photo.downscale)
        frame, result = replica.learn(target, photo.background, sh_degree, iteration)
        return frame, _Learned(photo, replica.loss.value_later(result), replica.exposure.sums())

    @property
    def _rows(self) -> tuple[int, int, int]:
        """Rows of the gradients of the geometry, of those of the colour of one photo, and of the statistics."""
        return self.main.splats.schema.rows(Group.GEOM), COMPACT_ROWS, SplatStatistics.ROWS

    def _snapshot(self, sh_degree: int) -> list[Array]:
        """Return the rows of the geometry, and those of the colours in use."""
        splats = self.main.splats
        return [
            self._download(self.main, splats.geom, splats.schema.rows(Group.GEOM)),
            self._download(self.main, splats.sh, 3 * sh_coefficients(sh_degree)),
        ]

    def _download(self, replica: Replica, buffer: Buffer, rows: int) -> Array:
        found: Array = np.empty((rows, self.main.splats.capacity), self.main.splats.dtype)
        return to_host(replica.device, buffer, found)

    def _add(self, slot: int, geom: Buffer, sh: Buffer) -> None:
        """Add the gradients of a photo to the means. The factors of its colours have rows of their own."""
        n, rows, share = self.main.splats.n, self.main.splats.schema.rows(Group.GEOM), 1.0 / self.photos
        first = slot * COMPACT_ROWS
        color, direction = slice(0, COMPACT_ROWS // 2), slice(COMPACT_ROWS // 2, COMPACT_ROWS)
        self._columns.add(self.grads.geom, geom, n, slice(0, rows), slice(0, rows), share, adds=slot > 0)
        for part, factor in ((color, share), (direction, 1.0)):
            target = slice(first + part.start, first + part.stop)
            self._columns.add(self.grads.sh, sh, n, target, part, factor, adds=False)

    def _add_rows(self, slot: int, rows: tuple[Array, ...]) -> None:
        """Add the gradients and the statistics of a photo of another device."""
        main, capacity = self.main, self.main.splats.capacity
        incoming = [buffer.reserve(capacity * len(array)) for buffer, array in zip(self._incoming, rows, strict=True)]
        for buffer, array in zip(incoming, rows, strict=True):
            to_device(main.device, buffer, array)
        geom, sh, statistics = incoming
        self._add(slot, geom, sh)
        every = slice(0, SplatStatistics.ROWS)
        total = main.pipeline.statistics.reserve(capacity)
        self._columns.add(total, statistics, main.splats.n, every, every)


def check_batch(config: TrainConfig, devices: int) -> None:
    """Raise InputError if a run with these options cannot share its photos among some devices."""
    photos = config.schedule.batch
    if photos % devices:
        raise InputError(
            f"batch {photos} on {devices} devices: each device needs as many photos as the others: "
            f"use a multiple of {devices}"
        )
    if photos > 1 and config.optim.visible_adam:
        raise InputError(f"visible_adam updates the splats of one image, and the batch is {photos}: use one of the two")

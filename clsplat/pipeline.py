"""Splats to an image and gradients back, as a list of kernel launches. Everything stays on the device.

project -> depth sort -> count, scan -> emit -> tile sort -> ranges -> rasterize
rasterize_vjp -> gather -> project_vjp
One number crosses to the host in each frame: the count of isects, which sizes the buffers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .buffers import ParameterBuffers, Pool, SplatBuffers, fill_zero, to_device, to_host
from .camera import Camera
from .device import Device
from .errors import DeviceError
from .gradients import CompactGradients
from .kernels import MARGIN_X, MARGIN_Y, NEAR, TILE, KernelBuild
from .program import lane_group
from .sort import Sorter

MAX_ISECTS = 2**31 - 1
SIGNALS = 3  # screen gradient, depth gradient, times seen


@dataclass(frozen=True)
class ImageLayout:
    """Planes of an image on the device: whole tiles, inside a margin (cl/raster.cl)."""

    width: int
    height: int

    @property
    def tiles_x(self) -> int:
        return -(-self.width // TILE)

    @property
    def tiles_y(self) -> int:
        return -(-self.height // TILE)

    @property
    def stride(self) -> int:
        """Pixels from one row to the next."""
        return self.tiles_x * TILE + 2 * MARGIN_X

    @property
    def rows(self) -> int:
        return self.tiles_y * TILE + 2 * MARGIN_Y

    @property
    def plane(self) -> int:
        """Pixels from one plane to the next."""
        return self.stride * self.rows

    def pack(self, image: NDArray[Any], dtype: np.dtype[np.floating]) -> NDArray[Any]:
        """(H, W, C) or (H, W) to planes with a zero margin, (C, rows, stride)."""
        image = image.reshape(self.height, self.width, -1)
        planes = np.zeros((image.shape[2], self.rows, self.stride), dtype)
        rows, columns = slice(MARGIN_Y, MARGIN_Y + self.height), slice(MARGIN_X, MARGIN_X + self.width)
        planes[:, rows, columns] = np.moveaxis(image, 2, 0)
        return planes

    def unpack(self, planes: NDArray[Any]) -> NDArray[Any]:
        """Planes (C, rows, stride) to (H, W, C)."""
        inside = planes[:, MARGIN_Y : MARGIN_Y + self.height, MARGIN_X : MARGIN_X + self.width]
        return np.ascontiguousarray(np.moveaxis(inside, 0, 2))


@dataclass(frozen=True)
class Frame:
    """A rendered frame on the device; valid until the pipeline's next forward.

    lists : isect ids [n_isects] by tile, front to back.
    """

    layout: ImageLayout
    n_isects: int
    sh_degree: int
    splats: SplatBuffers
    lists: Any


def camera_block(camera: Camera) -> NDArray[np.float64]:
    """The camera as kernels read it (order: cl/camera/pinhole.clh). Tangent clamp as in gsplat."""
    tan_x, tan_y = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    return np.concatenate([
        camera.rotation.ravel(), camera.translation, [camera.fx, camera.fy, camera.cx, camera.cy],
        [-(camera.cx / camera.fx + 0.3 * tan_x), (camera.width - camera.cx) / camera.fx + 0.3 * tan_x],
        [-(camera.cy / camera.fy + 0.3 * tan_y), (camera.height - camera.cy) / camera.fy + 0.3 * tan_y],
        camera.position, [NEAR],
    ])


class Pipeline:
    """Forward and backward for one kernel build on one device.

    Images are buffers of the pool in the layout of `ImageLayout`: "color" (3 planes), "transmittance",
    "depth".
    """

    def __init__(self, device: Device, kernels: KernelBuild) -> None:
        self.device, self.kernels = device, kernels
        self.pool = Pool(device)
        self.sorter = Sorter(device, self.pool)
        self.program = kernels.raster_program(device)
        self._real = kernels.dtype.itemsize
        self._layouts: dict[str, tuple[ImageLayout, Any]] = {}
        self.frame: Frame | None = None  # the last one
        self._forward_event: Any = None
        self._signal_capacity = 0
        self._backward_event: Any = None
        self.group = lane_group(device)

    def forward(self, splats: SplatBuffers, camera: Camera,
                background: tuple[float, float, float] = (0, 0, 0), sh_degree: int | None = None) -> Frame:
        """Render into the pool's "color", "transmittance" and (with depth) "depth" buffers.

        Raises
        ------
        DeviceError : more isects than fit.
        """
        layout = ImageLayout(camera.width, camera.height)
        degree = self.kernels.sh_degree if sh_degree is None else min(sh_degree, self.kernels.sh_degree)
        n_tiles, n = layout.tiles_x * layout.tiles_y, splats.n
        pool, real = self.pool, self._real
        ranges = pool.zeroed("tile_ranges", 8 * n_tiles)
        records = pool.get("records", n * self.kernels.record * real)
        pool.get("splat_isects", 8 * n)
        n_isects = 0
        if n:
            self._project(splats, camera, layout, degree, records)
            n_isects = self._bin(layout, n)
        lists = pool.get("isect_id", 4 * n_isects)
        if n_isects:
            bits = max((n_tiles - 1).bit_length(), 1)
            tiles, lists = self.sorter.sort("isect_tile", "isect_id", n_isects, bits)
            self.program.find_tile_ranges.over(n_isects, sorted_tile=tiles, tile_ranges=ranges,
                                               n_isects=n_isects)
        group = self.kernels.schedule.group
        r, g, b = background
        self._forward_event = self.program.rasterize(
            (n_tiles * group,), (group,), tile_ranges=ranges, lists=lists,
            isect_splat=pool.get("isect_splat", 4 * n_isects), records=records,
            color=self.image("color", layout, 3), transmittance=self.image("transmittance", layout),
            depth=self.image("depth", layout), isect_runs=pool.get("isect_runs", 4 * n_isects), width=layout.width,
            height=layout.height, tiles_x=layout.tiles_x, stride=layout.stride, plane=layout.plane,
            background_r=r, background_g=g, background_b=b,
        )
        self.frame = Frame(layout, n_isects, degree, splats, lists)
        return self.frame

    def backward(self, frame: Frame, v_color: Any, grads: ParameterBuffers,
                 v_alpha: Any | None = None) -> None:
        """Gradients of the raw parameters of the last frame's splats into `grads` (overwritten).

        v_color, v_alpha : buffers in the frame's layout. SH bands above the frame's degree are left alone.
        """
        pool, layout, splats = self.pool, frame.layout, frame.splats
        if not splats.n:
            return
        width = self.kernels.v_record * self._real
        isect_grads = pool.get("isect_grads", frame.n_isects * width)
        moments = pool.get("moments", splats.capacity * width)
        group = self.kernels.schedule.group
        self._backward_event = self.program.rasterize_vjp(
            (layout.tiles_x * layout.tiles_y * group,), (group,), tile_ranges=pool.get("tile_ranges", 0),
            lists=frame.lists, isect_splat=pool.get("isect_splat", 0), records=pool.get("records", 0),
            color=pool.get("color", 0), transmittance=pool.get("transmittance", 0), v_color=v_color,
            v_alpha=v_color if v_alpha is None else v_alpha, isect_runs=pool.get("isect_runs", 0),
            isect_grads=isect_grads, width=layout.width, height=layout.height, tiles_x=layout.tiles_x,
            stride=layout.stride, plane=layout.plane,
        )
        self.program.gather_isect_grads.over(
            splats.n, self.group, splat_isects=pool.get("splat_isects", 0), isect_grads=isect_grads,
            moments=moments, capacity=splats.capacity, n_splats=splats.n,
        )
        self.program.project_splats_vjp.over(
            -(-splats.n // self.kernels.lanes), self.group, geom=splats.geom, sh=splats.sh,
            cam=pool.get("camera", 0), moments=moments, records=pool.get("records", 0),
            depth_key=pool.get("depth_key_kept", 0), grad_geom=grads.geom, grad_sh=grads.sh,
            signals=self.signals(splats.capacity), capacity=splats.capacity, n_splats=splats.n,
            sh_degree=frame.sh_degree, compact=int(isinstance(grads, CompactGradients)), width=layout.width,
            height=layout.height,
        )

    def read_image(self, name: str, layout: ImageLayout) -> NDArray[Any]:
        """One of the images as (H, W, C)."""
        planes = 3 if name == "color" else 1
        host = np.empty((planes, layout.rows, layout.stride), self.kernels.dtype)
        return layout.unpack(to_host(self.device, self.pool.get(name, 0), host))

    def signals(self, capacity: int) -> Any:
        """Buffer [3, capacity] for strategies, collected since `reset_signals` (rows: cl/project.cl)."""
        known = self._signal_capacity
        buffer = self.pool.get("signals", SIGNALS * capacity * self._real)
        if known != capacity:
            self._signal_capacity = capacity
            self.reset_signals()
        return buffer

    def read_signals(self, n: int) -> NDArray[Any]:
        """`signals` of the first n splats, (3, n)."""
        rows = np.empty((SIGNALS, self._signal_capacity), self.kernels.dtype)
        return np.ascontiguousarray(to_host(self.device, self.pool.get("signals", 0), rows)[:, :n])

    def write_signals(self, signals: NDArray[Any], capacity: int) -> None:
        """Go on collecting from `signals` (3, n)."""
        rows = np.zeros((SIGNALS, capacity), self.kernels.dtype)
        rows[:, : signals.shape[1]] = signals
        to_device(self.device, self.signals(capacity), rows)

    def reset_signals(self) -> None:
        """Start collecting anew."""
        fill_zero(self.device, self.pool.get("signals", 0), SIGNALS * self._signal_capacity * self._real)

    def raster_events(self) -> tuple[Any, Any]:
        """Finished events of the last rasterize and rasterize_vjp, for timing."""
        self.device.queue.finish()
        return self._forward_event, self._backward_event

    def image(self, name: str, layout: ImageLayout, planes: int = 1) -> Any:
        """Buffer for an image, zeroed whenever its layout changes: its margin must stay zero."""
        nbytes = planes * layout.plane * self._real
        buffer = self.pool.get(name, nbytes)
        if self._layouts.get(name) != (layout, buffer):
            fill_zero(self.device, buffer, nbytes)
            self._layouts[name] = (layout, buffer)
        return buffer

    def _project(self, splats: SplatBuffers, camera: Camera, layout: ImageLayout, degree: int,
                 records: Any) -> None:
        pool, n = self.pool, splats.n
        block = camera_block(camera).astype(self.kernels.dtype)
        cam = pool.get("camera", block.nbytes)
        to_device(self.device, cam, block)
        self.program.project_splats.over(
            -(-n // self.kernels.lanes), self.group, geom=splats.geom, sh=splats.sh, cam=cam,
            records=records, depth_key=pool.get("depth_key_kept", 4 * n),
            tile_rect=pool.get("tile_rect", 16 * n),
            capacity=splats.capacity, n_splats=n, sh_degree=degree, width=layout.width, height=layout.height,
            tiles_x=layout.tiles_x, tiles_y=layout.tiles_y,
        )

    def _bin(self, layout: ImageLayout, n: int) -> int:
        """Depth order, isects in depth order; returns their number."""
        import pyopencl as cl

        pool, program = self.pool, self.program
        keys, values = pool.get("depth_key", 4 * n), pool.get("depth_order", 4 * n)
        event = cl.enqueue_copy(self.device.queue, keys, pool.get("depth_key_kept", 0), byte_count=4 * n)
        self.device.observe("copy", (4 * n,), event)
        self.sorter.iota(values, n)
        _, order = self.sorter.sort("depth_key", "depth_order", n, 32)
        counts, offsets = pool.get("isect_counts", 4 * n), pool.get("isect_offsets", 4 * n)
        rect, total = pool.get("tile_rect", 0), pool.get("n_isects", 4)
        program.count_isects.over(n, order=order, tile_rect=rect, counts=counts, n_splats=n)
        self.sorter.scan(counts, offsets, n, total)
        n_isects = int(to_host(self.device, total, np.empty(1, np.uint32))[0])
        if n_isects > MAX_ISECTS:
            raise DeviceError(f"{n_isects} splat-tile pairs in one image: use smaller images (-r 2, 4, 8)")
        program.emit_isects.over(
            n, order=order, tile_rect=rect, offsets=offsets, splat_isects=pool.get("splat_isects", 8 * n),
            isect_tile=pool.get("isect_tile", 4 * n_isects), isect_id=pool.get("isect_id", 4 * n_isects),
            isect_splat=pool.get("isect_splat", 4 * n_isects), n_splats=n, tiles_x=layout.tiles_x,
        )
        return n_isects

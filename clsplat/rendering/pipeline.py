"""Splats to an image and gradients back, as a list of kernel launches. Everything stays on the device.

project -> depth order -> isects by tile -> rasterize
rasterize_vjp -> gather -> project_vjp
The counts of isects cross to the host once in each frame: they size the buffers. An image with more isects than one
buffer holds is made in bands of tiles, each listed, rasterized, and listed again by the gradient.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..device.device import TILE, Device
from ..device.memory import Pool, fill_zero, send_to_device, to_device, to_host
from ..device.program import lane_group
from ..splats.color import BLACK, Color
from .binning import MAX_ISECTS, Band, cut, make_binner
from .build import MARGIN_X, MARGIN_Y, NEAR, KernelBuild
from .splat_buffers import CompactGradients, ParameterBuffers, SplatBuffers

SIGNALS = 3  # screen gradient, depth gradient, times seen
TIMES_SEEN = 2


@dataclass(frozen=True)
class ImageLayout:
    """Planes of an image on the device: whole tiles, inside a margin (cl/render/rasterize.cl)."""

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

    bands : of tiles, in order; the isects of one at a time are on the device (`Pipeline.bands`).
    """

    layout: ImageLayout
    sh_degree: int
    splats: SplatBuffers
    bands: tuple[Band, ...]

    @property
    def n_isects(self) -> int:
        return sum(band.n_isects for band in self.bands)


def camera_block(camera: Camera) -> NDArray[np.float64]:
    """The camera as kernels read it (order: cl/camera/pinhole.clh). Tangent clamp as in gsplat."""
    tan_x, tan_y = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    return np.concatenate(
        [
            camera.rotation.ravel(),
            camera.translation,
            [camera.fx, camera.fy, camera.cx, camera.cy],
            [-(camera.cx / camera.fx + 0.3 * tan_x), (camera.width - camera.cx) / camera.fx + 0.3 * tan_x],
            [-(camera.cy / camera.fy + 0.3 * tan_y), (camera.height - camera.cy) / camera.fy + 0.3 * tan_y],
            camera.position,
            [NEAR],
        ]
    )


class Pipeline:
    """Forward and backward for one kernel build on one device.

    Images are buffers of the pool in the layout of `ImageLayout`: "color" (3 planes), "transmittance",
    "depth".

    Parameters
    ----------
    max_isects : most isects on the device at once; None for what the device allows.
    """

    def __init__(self, device: Device, kernels: KernelBuild, max_isects: int | None = None) -> None:
        self.device, self.kernels = device, kernels
        self.pool = Pool(device)
        self.binner = make_binner(device, self.pool)
        self.max_isects = most_isects(device, kernels) if max_isects is None else max_isects
        self.program = kernels.raster_program(device)
        self._real = kernels.dtype.itemsize
        self._layouts: dict[str, tuple[ImageLayout, Any]] = {}
        self.frame: Frame | None = None  # the last one
        self._forward_event: Any = None
        self._signal_capacity = 0
        self._backward_event: Any = None
        self._camera_event: Any = None
        self._lists: Any = None  # of the band on the device
        self.group = lane_group(device)

    def forward(
        self,
        splats: SplatBuffers,
        camera: Camera,
        background: Color = BLACK,
        sh_degree: int | None = None,
    ) -> Frame:
        """Render into the pool's "color", "transmittance" and (with depth) "depth" buffers.

        Raises
        ------
        DeviceError : more splats over one tile than fit.
        """
        layout = ImageLayout(camera.width, camera.height)
        degree = self.kernels.sh_degree if sh_degree is None else min(sh_degree, self.kernels.sh_degree)
        bands = self._project(splats, camera, layout, degree)
        self.frame = Frame(layout, degree, splats, bands)
        # The last band first: each launch covers the tiles before its band, too, as tiles without isects.
        for band in reversed(bands):
            self._list(self.frame, band)
            self._forward_event = self._rasterize(layout, band, "", background)
        return self.frame

    def bands(self, frame: Frame) -> Iterator[tuple[Band, Any]]:
        """The last frame's bands in order, each with its lists (isect ids by tile, front to back) while it is on the
        device with "tile_ranges" (others': empty), "isect_splat" and "splat_isects".
        """
        if len(frame.bands) > 1:
            self.binner.begin(frame.splats.n, frame.layout.tiles_x, frame.layout.tiles_y)
        for band in frame.bands:
            if len(frame.bands) > 1:
                self._list(frame, band)
            yield band, self._lists

    def backward(self, frame: Frame, v_color: Any, grads: ParameterBuffers, v_alpha: Any | None = None) -> None:
        """Gradients of the raw parameters of the last frame's splats into `grads` (overwritten).

        v_color, v_alpha : buffers in the frame's layout. SH bands above the frame's degree are left alone.
        """
        pool, layout, splats = self.pool, frame.layout, frame.splats
        if not splats.n:
            return
        width = self.kernels.v_record * self._real
        isect_grads = pool.get("isect_grads", max(band.n_isects for band in frame.bands) * width)
        moments = pool.get("moments", splats.capacity * width)
        group = self.kernels.schedule.group
        for band, lists in self.bands(frame):
            if len(frame.bands) > 1:  # what the forward told of the band's isects is lost; the image must not be
                self._rasterize(layout, band, "again_")
            self._backward_event = self.program.rasterize_vjp(
                (band.past * group,),
                (group,),
                tile_ranges=pool.get("tile_ranges", 0),
                lists=lists,
                isect_splat=pool.get("isect_splat", 0),
                records=pool.get("records", 0),
                color=pool.get("color", 0),
                transmittance=pool.get("transmittance", 0),
                v_color=v_color,
                v_alpha=v_color if v_alpha is None else v_alpha,
                isect_blocks=pool.get("isect_blocks", 0),
                isect_grads=isect_grads,
                width=layout.width,
                height=layout.height,
                tiles_x=layout.tiles_x,
                stride=layout.stride,
                plane=layout.plane,
            )
            self.program.gather_isect_grads.over(
                -(-splats.n // self.kernels.lanes),
                self.group,
                splat_isects=pool.get("splat_isects", 0),
                isect_grads=isect_grads,
                moments=moments,
                capacity=splats.capacity,
                n_splats=splats.n,
                go_on=int(band.first > 0),
            )
        self.program.project_splats_vjp.over(
            -(-splats.n // self.kernels.lanes),
            self.group,
            geom=splats.geom,
            sh=splats.sh,
            cam=pool.get("camera", 0),
            moments=moments,
            records=pool.get("records", 0),
            depth_key=pool.get("depth_key_kept", 0),
            grad_geom=grads.geom,
            grad_sh=grads.sh,
            signals=self.signals(splats.capacity),
            capacity=splats.capacity,
            n_splats=splats.n,
            sh_degree=frame.sh_degree,
            compact=int(isinstance(grads, CompactGradients)),
            width=layout.width,
            height=layout.height,
        )

    def read_image(self, name: str, layout: ImageLayout) -> NDArray[Any]:
        """One of the images as (H, W, C)."""
        planes = 3 if name == "color" else 1
        host = np.empty((planes, layout.rows, layout.stride), self.kernels.dtype)
        return layout.unpack(to_host(self.device, self.pool.get(name, 0), host))

    def signals(self, capacity: int) -> Any:
        """Buffer [3, capacity] for strategies, collected since `reset_signals` (rows: cl/render/project.cl)."""
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

    def _project(self, splats: SplatBuffers, camera: Camera, layout: ImageLayout, degree: int) -> tuple[Band, ...]:
        """Screen records, depth order, and the bands that the image is cut into."""
        pool, n = self.pool, splats.n
        records = pool.get("records", n * self.kernels.record * self._real)
        if not n:
            return (Band(0, layout.tiles_x * layout.tiles_y, 0),)
        block = camera_block(camera).astype(self.kernels.dtype)
        cam = pool.get("camera", block.nbytes)
        self._camera_event = send_to_device(self.device, cam, block)
        self.program.project_splats.over(
            -(-n // self.kernels.lanes),
            self.group,
            geom=splats.geom,
            sh=splats.sh,
            cam=cam,
            records=records,
            depth_key=pool.get("depth_key_kept", 4 * n),
            tile_rect=pool.get("tile_rect", 16 * n),
            capacity=splats.capacity,
            n_splats=n,
            sh_degree=degree,
            width=layout.width,
            height=layout.height,
            tiles_x=layout.tiles_x,
            tiles_y=layout.tiles_y,
        )
        self.binner.order(n)
        self.binner.begin(n, layout.tiles_x, layout.tiles_y)
        return cut(self.binner.count, layout.tiles_x, layout.tiles_y, self.max_isects)

    def _list(self, frame: Frame, band: Band) -> None:
        """The band's isects onto the device."""
        n_tiles = frame.layout.tiles_x * frame.layout.tiles_y
        if not frame.splats.n or len(frame.bands) > 1:  # tiles that the binner leaves alone are empty
            self.pool.zeroed("tile_ranges", 8 * n_tiles)
        self._lists = self.binner.list_isects(band) if frame.splats.n else self.pool.get("isect_splat", 0)

    def _rasterize(self, layout: ImageLayout, band: Band, prefix: str, background: Color = BLACK) -> Any:
        """Images into the buffers of these names after `prefix`; returns the event."""
        pool, group = self.pool, self.kernels.schedule.group
        r, g, b = background
        return self.program.rasterize(
            (band.past * group,),
            (group,),
            tile_ranges=pool.get("tile_ranges", 0),
            lists=self._lists,
            isect_splat=pool.get("isect_splat", 0),
            records=pool.get("records", 0),
            color=self.image(prefix + "color", layout, 3),
            transmittance=self.image(prefix + "transmittance", layout),
            depth=self.image(prefix + "depth", layout),
            isect_blocks=pool.get("isect_blocks", 4 * band.n_isects),
            width=layout.width,
            height=layout.height,
            tiles_x=layout.tiles_x,
            stride=layout.stride,
            plane=layout.plane,
            background_r=r,
            background_g=g,
            background_b=b,
        )


def most_isects(device: Device, kernels: KernelBuild) -> int:
    """Isects that fit the device at once: their records in one buffer, all about them in a third of its memory."""
    record = kernels.v_record * kernels.dtype.itemsize
    info = device.info
    return max(min(MAX_ISECTS, info.max_alloc_bytes // record, info.global_mem_bytes // (3 * isect_bytes(kernels))), 1)


def isect_bytes(kernels: KernelBuild) -> int:
    """Device memory for an isect: its gradient record; tile, id and their pairs (if sorted), splat, blocks."""
    return kernels.v_record * kernels.dtype.itemsize + 4 * 6

"""Splats to an image and gradients back, as a list of kernel launches. Everything stays on the device.

project -> depth order -> isects by tile -> rasterize
rasterize_vjp -> gather -> project_vjp

The host reads the number of isects once in each frame, because it sizes the buffers. An image with more isects than one
buffer holds is made in bands of tiles. Each band is listed and rasterized, and the gradient lists it once more.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator

import numpy as np

from ..cameras.camera import Camera
from ..device.device import Device
from ..device.memory import Pool, send_to_device
from ..device.opencl import Buffer, Event
from ..device.program import lane_group
from ..device.schedule import require_groups
from ..splats.color import BLACK, Color
from .binning import MAX_ISECTS, cut_bands
from .build import KernelBuild
from .camera_block import camera_block
from .frame import Band, Frame, ImageLayout, ProjectedSplats, RenderedImages, TileLists
from .group_binner import make_binner
from .splat_buffers import CompactGradients, ParameterBuffers, SplatBuffers, SplatStatistics


class Pipeline:
    """Forward and backward for one kernel build on one device.

    Its memory is reused from frame to frame: a frame is valid until the next `forward`, and raises after that.

    Parameters
    ----------
    max_isects : limit of the isects on the device at once; None for the limit of the device.

    Attributes
    ----------
    pool : the memory of frames and their gradients.
    statistics : statistics of the gradients that `backward` adds up for each splat.
    isect_blocks : for each isect of the last band, the set of pixel blocks that its splat reaches, a bit each;
        only of builds with `culls_blocks`.
    group : group size of kernels over vectors of splats.
    """

    def __init__(self, device: Device, kernels: KernelBuild, max_isects: int | None = None) -> None:
        self.device, self.kernels = device, kernels
        self.max_isects = isect_limit(device, kernels) if max_isects is None else max_isects
        require_groups(kernels.schedule, device.info, device.info.max_group)
        self.projection, self.pixels = kernels.projection_program(device), kernels.pixel_program(device)
        for name in ("rasterize", "rasterize_vjp"):
            require_groups(kernels.schedule, device.info, self.pixels[name].max_group)
        self.group = lane_group(device)
        self.pool = pool = Pool(device)
        self.statistics = SplatStatistics(pool, kernels.dtype)
        self.binner = make_binner(pool, kernels)
        real = kernels.dtype
        self._camera, self._records = pool.buffer(real), pool.buffer(real, kernels.record)
        self._depth_key, self._tile_rect = pool.buffer(np.uint32), pool.buffer(np.int32, 4)
        self.isect_blocks = pool.buffer(np.uint32)
        self._isect_grads, self._moments = pool.buffer(real, kernels.v_record), pool.buffer(real, kernels.v_record)
        self._images = RenderedImages(pool, kernels)
        self._scratch_images = RenderedImages(pool, kernels)  # of bands that are rasterized again
        self._no_ranges, self._no_isects = pool.buffer(np.uint32, 2), pool.buffer(np.uint32)
        self._lists: TileLists  # of the band on the device
        self._frame: weakref.ref[Frame] | None = None  # the last one
        self._camera_event: Event | None = None

    def forward(
        self,
        splats: SplatBuffers,
        camera: Camera,
        background: Color = BLACK,
        sh_degree: int | None = None,
        hide: Callable[[ProjectedSplats], None] | None = None,
        near_plane: float | None = None,
    ) -> Frame:
        """Render an image. The previous frame of this pipeline is overwritten.

        Parameters
        ----------
        sh_degree : highest band of spherical harmonics in use; None for all.
        hide : called with the projected splats before they are sorted; it may set some to CULLED_KEY and no tiles.
        near_plane : depth below which splats are not drawn [world units]; None for that of the kernels.

        Raises
        ------
        DeviceError : one tile alone has more isects than fit the device.
        """
        previous = None if self._frame is None else self._frame()
        if previous is not None:
            previous.expire()
        layout = ImageLayout(camera.width, camera.height)
        self._images.reserve(layout)  # an image that does not fit is refused before its tiles are counted
        degree = self.kernels.sh_degree if sh_degree is None else min(sh_degree, self.kernels.sh_degree)
        near_plane = self.kernels.near_plane if near_plane is None else near_plane
        projected = self._project(splats, camera, layout, degree, near_plane)
        if hide is not None and projected.n:
            hide(projected)
        frame = Frame(layout, degree, splats, projected, self._images, self._bands(projected, layout))
        self._frame = weakref.ref(frame)
        # The last band comes first: each launch also covers the tiles before its band, as tiles without isects.
        for band in reversed(frame.bands):
            self._lists = self._list(frame, band)
            self._rasterize(frame, band, self._images, background)
        return frame

    def bands(self, frame: Frame) -> Iterator[tuple[Band, TileLists]]:
        """Yield the bands of a frame in order, each with its lists, which are on the device until the next band.

        Raises
        ------
        RuntimeError : the frame is overwritten.
        """
        frame.check_current()
        if len(frame.bands) == 1:
            yield frame.bands[0], self._lists
            return
        self.binner.begin(frame.layout.tiles_x, frame.layout.tiles_y)
        for band in frame.bands:
            self._lists = self._list(frame, band)
            yield band, self._lists

    def backward(self, frame: Frame, v_color: Buffer, grads: ParameterBuffers, v_alpha: Buffer | None = None) -> None:
        """Write the gradients of the raw parameters of a frame's splats into `grads`.

        SH bands above the frame's degree are not written.

        Parameters
        ----------
        v_color, v_alpha : gradients of the loss with respect to the image, in the frame's layout. v_alpha is needed
            if and only if the build has it.

        Raises
        ------
        RuntimeError : the frame is overwritten. ValueError : v_alpha does not fit the build.
        """
        frame.check_current()
        if (v_alpha is not None) != self.kernels.with_v_alpha:
            raise ValueError(f"v_alpha: this build has {'one' if self.kernels.with_v_alpha else 'none'}")
        layout, splats, projected, n = frame.layout, frame.splats, frame.projected, frame.n_splats
        if not n:
            return
        isect_grads = self._isect_grads.reserve(max(band.n_isects for band in frame.bands))
        moments = self._moments.reserve(splats.capacity)
        group = self.kernels.schedule.group
        for band, lists in self.bands(frame):
            if len(frame.bands) > 1:
                # The block sets of this band are lost by now. Rasterize it again, without changing the images.
                self._rasterize(frame, band, self._scratch_images)
            self.pixels.rasterize_vjp(
                (band.end * group,),
                (group,),
                tile_ranges=lists.ranges,
                lists=lists.isects,
                isect_splat=lists.isect_splat,
                records=projected.records,
                color=frame.images.color.buffer,
                transmittance=frame.images.transmittance.buffer,
                v_color=v_color,
                **({} if v_alpha is None else {"v_alpha": v_alpha}),
                **self._block_sets(lists),
                isect_grads=isect_grads,
                width=layout.width,
                height=layout.height,
                tiles_x=layout.tiles_x,
                stride=layout.stride,
                plane=layout.plane,
            )
            self.pixels.gather_isect_grads.over(
                -(-n // self.kernels.lanes),
                self.group,
                splat_isects=lists.splat_isects,
                isect_grads=isect_grads,
                moments=moments,
                capacity=splats.capacity,
                n_splats=n,
                go_on=int(band.first > 0),
            )
        self.projection.project_splats_vjp.over(
            -(-n // self.kernels.lanes),
            self.group,
            geom=splats.geom,
            sh=splats.sh,
            cam=projected.camera,
            moments=moments,
            records=projected.records,
            depth_key=projected.depth_key,
            grad_geom=grads.geom,
            grad_sh=grads.sh,
            statistics=self.statistics.reserve(splats.capacity),
            capacity=splats.capacity,
            n_splats=n,
            sh_degree=frame.sh_degree,
            compact=int(isinstance(grads, CompactGradients)),
            width=layout.width,
            height=layout.height,
        )

    def _project(
        self, splats: SplatBuffers, camera: Camera, layout: ImageLayout, degree: int, near_plane: float
    ) -> ProjectedSplats:
        """Project the splats into the image."""
        n, capacity = splats.n, splats.capacity
        block = camera_block(camera, near_plane).astype(self.kernels.dtype)
        projected = ProjectedSplats(
            n,
            capacity,
            camera=self._camera.reserve(len(block)),
            records=self._records.reserve(capacity),
            depth_key=self._depth_key.reserve(capacity),
            tile_rect=self._tile_rect.reserve(capacity),
            near_plane=near_plane,
        )
        if not n:
            return projected
        self._camera_event = send_to_device(self.device, projected.camera, block)
        self.projection.project_splats.over(
            -(-n // self.kernels.lanes),
            self.group,
            geom=splats.geom,
            sh=splats.sh,
            cam=projected.camera,
            records=projected.records,
            depth_key=projected.depth_key,
            tile_rect=projected.tile_rect,
            capacity=capacity,
            n_splats=n,
            sh_degree=degree,
            width=layout.width,
            height=layout.height,
            tiles_x=layout.tiles_x,
            tiles_y=layout.tiles_y,
        )
        return projected

    def _bands(self, projected: ProjectedSplats, layout: ImageLayout) -> tuple[Band, ...]:
        """Sort the splats by depth and cut the image into bands."""
        if not projected.n:
            return (Band(0, layout.n_tiles, 0),)
        self.binner.order(projected)
        self.binner.begin(layout.tiles_x, layout.tiles_y)
        return cut_bands(self.binner.count, layout.tiles_x, layout.tiles_y, self.max_isects)

    def _list(self, frame: Frame, band: Band) -> TileLists:
        """List the isects of a band."""
        if frame.n_splats:
            return self.binner.list_isects(band)
        empty = self._no_isects.reserve(0)
        strips = empty if self.kernels.culls_strips else None
        return TileLists(self._no_ranges.zeros(frame.layout.n_tiles), empty, empty, empty, strips)

    def _block_sets(self, lists: TileLists, n_isects: int | None = None) -> dict[str, Buffer]:
        """Return the argument with the block sets of a band. n_isects : their number, if they are to be written."""
        if lists.strips is not None:
            return {"isect_blocks": lists.strips}
        if self.kernels.culls_blocks:
            sets = self.isect_blocks
            return {"isect_blocks": sets.buffer if n_isects is None else sets.reserve(n_isects)}
        return {}

    def _rasterize(self, frame: Frame, band: Band, images: RenderedImages, background: Color = BLACK) -> None:
        """Draw the tiles of a band, and those before it."""
        layout, group, (r, g, b) = frame.layout, self.kernels.schedule.group, background
        self.pixels.rasterize(
            (band.end * group,),
            (group,),
            tile_ranges=self._lists.ranges,
            lists=self._lists.isects,
            isect_splat=self._lists.isect_splat,
            records=frame.projected.records,
            **images.reserve(layout),
            **self._block_sets(self._lists, band.n_isects),
            width=layout.width,
            height=layout.height,
            tiles_x=layout.tiles_x,
            stride=layout.stride,
            plane=layout.plane,
            background_r=r,
            background_g=g,
            background_b=b,
        )


def isect_limit(device: Device, kernels: KernelBuild) -> int:
    """Return the number of isects that fit the device at once.

    Their gradient records must fit one buffer, and everything about them a third of the memory.
    """
    record = kernels.v_record * kernels.dtype.itemsize
    info = device.info
    return max(min(MAX_ISECTS, info.max_alloc_bytes // record, info.global_mem_bytes // (3 * isect_bytes(kernels))), 1)


def isect_bytes(kernels: KernelBuild) -> int:
    """Return the device memory of an isect: its gradient record, two copies of tile and id, splat and block set."""
    return kernels.v_record * kernels.dtype.itemsize + 4 * 6

"""A rendered frame on the device: its layout, its images, the projected splats and the lists of each tile."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..device.memory import Pool, to_device, to_host
from ..device.opencl import Buffer
from ..device.schedule import TILE
from ..splats.near_plane import NEAR_PLANE
from .build import MARGIN_X, MARGIN_Y, KernelBuild
from .splat_buffers import SplatBuffers


@dataclass(frozen=True)
class ImageLayout:
    """Planes of an image on the device: whole tiles inside a margin (cl/render/rasterize.cl)."""

    width: int
    height: int

    @property
    def tiles_x(self) -> int:
        return -(-self.width // TILE)

    @property
    def tiles_y(self) -> int:
        return -(-self.height // TILE)

    @property
    def n_tiles(self) -> int:
        return self.tiles_x * self.tiles_y

    @property
    def stride(self) -> int:
        """Pixels from one row to the next."""
        return self.tiles_x * TILE + 2 * MARGIN_X

    @property
    def rows(self) -> int:
        """Rows of a plane, with its margin."""
        return self.tiles_y * TILE + 2 * MARGIN_Y

    @property
    def plane(self) -> int:
        """Pixels from one plane to the next."""
        return self.stride * self.rows

    def pack(self, image: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
        """Return planes (C, rows, stride) with a zero margin for an image (H, W, C) or (H, W)."""
        image = image.reshape(self.height, self.width, -1)
        planes = np.zeros((image.shape[2], self.rows, self.stride), dtype)
        rows, columns = slice(MARGIN_Y, MARGIN_Y + self.height), slice(MARGIN_X, MARGIN_X + self.width)
        planes[:, rows, columns] = np.moveaxis(image, 2, 0)
        return planes

    def unpack(self, planes: NDArray[Any]) -> NDArray[Any]:
        """Return the image (H, W, C) of planes (C, rows, stride)."""
        inside = planes[:, MARGIN_Y : MARGIN_Y + self.height, MARGIN_X : MARGIN_X + self.width]
        return np.ascontiguousarray(np.moveaxis(inside, 0, 2))


@dataclass(frozen=True)
class Band:
    """Tiles `first` to `end` (exclusive) in row-major order, and the number of their isects."""

    first: int
    end: int
    n_isects: int


class DeviceImage:
    """An image on the device, whose memory is reused from frame to frame. Its margin is always zero.

    Parameters
    ----------
    dtype : type of a pixel.
    planes : number of channels.
    """

    def __init__(self, pool: Pool, dtype: np.dtype[Any], planes: int) -> None:
        self.device, self.dtype, self.planes = pool.device, dtype, planes
        self._memory = pool.buffer(dtype, planes)
        self._layout: ImageLayout | None = None

    def reserve(self, layout: ImageLayout) -> Buffer:
        """Return the buffer for an image of this layout. It is set to zero when the layout changes."""
        if layout == self._layout:
            return self._memory.buffer
        self._layout = None  # until the memory is there
        buffer = self._memory.zeros(layout.plane)
        self._layout = layout
        return buffer

    def write(self, layout: ImageLayout, image: NDArray[Any]) -> Buffer:
        """Copy an image (H, W, C) or (H, W) to the device and return its buffer."""
        buffer = self.reserve(layout)
        to_device(self.device, buffer, layout.pack(image, self.dtype))
        return buffer

    @property
    def layout(self) -> ImageLayout:
        """Layout of the present image."""
        if self._layout is None:
            raise RuntimeError("the image has no memory yet: call `reserve` first")
        return self._layout

    @property
    def buffer(self) -> Buffer:
        """Buffer of the present image."""
        return self._memory.buffer

    def read(self) -> NDArray[Any]:
        """Return the present image (H, W, C)."""
        layout = self.layout
        planes = np.empty((self.planes, layout.rows, layout.stride), self.dtype)
        return layout.unpack(to_host(self.device, self.buffer, planes))


class RenderedImages:
    """The images that `rasterize` writes.

    Attributes
    ----------
    color : 3 planes. transmittance : light left behind all splats.
    depth : sum of weight * camera z; None if the build has no depth.
    """

    def __init__(self, pool: Pool, kernels: KernelBuild) -> None:
        self.color = DeviceImage(pool, kernels.dtype, 3)
        self.transmittance = DeviceImage(pool, kernels.dtype, 1)
        self.depth = DeviceImage(pool, kernels.dtype, 1) if kernels.with_depth else None

    def reserve(self, layout: ImageLayout) -> dict[str, Buffer]:
        """Return the buffers for images of this layout, by the names of the kernel's parameters."""
        buffers = {"color": self.color.reserve(layout), "transmittance": self.transmittance.reserve(layout)}
        return buffers if self.depth is None else buffers | {"depth": self.depth.reserve(layout)}


@dataclass(frozen=True)
class ProjectedSplats:
    """The splats as one camera sees them (cl/render/project.cl).

    Attributes
    ----------
    n : number of splats. capacity : number that the parameters have room for.
    camera : the camera block (cl/camera/pinhole.clh).
    records : (n, R) screen records. depth_key : (n,) uint32, sorts splats by depth.
    tile_rect : (n, 4) int32, first x, first y, end x and end y of the tiles that the splat covers.
    near_plane : depth below which splats are not drawn [world units].
    """

    n: int
    capacity: int
    camera: Buffer
    records: Buffer
    depth_key: Buffer
    tile_rect: Buffer
    near_plane: float = NEAR_PLANE


@dataclass(frozen=True)
class TileLists:
    """The isects of one band of tiles. An isect is a pair of a splat and a tile that it covers.

    Attributes
    ----------
    ranges : (tiles, 2) uint32, where the list of each tile begins and ends; tiles outside the band are empty.
    isects : (isects,) uint32, isect ids by tile, front to back.
    isect_splat : (isects,) uint32, the splat of each isect id.
    splat_isects : (n, 2) uint32, first and end of the isect ids of each splat.
    strips : (isects,) uint32, the strips of its tile that each isect id reaches, a bit each; None if the build does not
        cull strips (KernelBuild.culls_strips).
    """

    ranges: Buffer
    isects: Buffer
    isect_splat: Buffer
    splat_isects: Buffer
    strips: Buffer | None = None


class Frame:
    """A rendered frame. Its buffers are overwritten by the next `forward` of the same pipeline.

    Attributes
    ----------
    sh_degree : highest band of spherical harmonics in use.
    splats : parameters of the splats. n_splats : their number when the frame was rendered.
    bands : bands of tiles in order; the lists of one band at a time are on the device (`Pipeline.bands`).
    """

    def __init__(
        self,
        layout: ImageLayout,
        sh_degree: int,
        splats: SplatBuffers,
        projected: ProjectedSplats,
        images: RenderedImages,
        bands: tuple[Band, ...],
    ) -> None:
        self.layout, self.sh_degree, self.splats, self.bands = layout, sh_degree, splats, bands
        self.n_splats = projected.n
        self._projected, self._images = projected, images
        self._is_current = True

    @property
    def n_isects(self) -> int:
        return sum(band.n_isects for band in self.bands)

    @property
    def projected(self) -> ProjectedSplats:
        """The projected splats. Raises RuntimeError if the frame is overwritten."""
        self.check_current()
        return self._projected

    @property
    def images(self) -> RenderedImages:
        """The images. Raises RuntimeError if the frame is overwritten."""
        self.check_current()
        return self._images

    def expire(self) -> None:
        """Mark the frame as overwritten."""
        self._is_current = False

    def check_current(self) -> None:
        """Raise RuntimeError if the pipeline has rendered another frame into the same buffers."""
        if not self._is_current:
            raise RuntimeError("the frame is overwritten: its pipeline has rendered another one since")

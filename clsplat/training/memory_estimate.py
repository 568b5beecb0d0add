"""Estimate of the device memory of a run, before it starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..device.device import Device, DeviceInfo
from ..errors import FEWER_SPLATS, OTHER_DEVICE, SMALLER_IMAGES, DeviceError, Remedy
from ..rendering.build import KernelBuild
from ..rendering.frame import ImageLayout
from ..rendering.pipeline import isect_bytes
from ..rendering.splat_buffers import CAPACITY_STEP, COMPACT_ROWS, SplatStatistics, capacity_for
from ..scenes.scene import View
from ..splats.fields import Group
from .config import TrainConfig
from .depth_smoothness import SMALLEST_SIDE
from .exposure import exposure_bytes
from .optim.skew_map import SkewMap
from .targets import target_budget, target_bytes, target_channels

# A parameter has a value, a spare copy, a gradient, and two moments if it changes. The colour's gradient is smaller.
_COPIES, _MOMENTS = 2, 2
# Planes of an image: colour and transmittance, the same for rendering in bands, gradients of the SSIM maps, v_color.
_IMAGE_PLANES = 4 + 4 + 9 + 3
_DEPTH_PLANES = 4 + 4 + 3  # the same for images of depths, without the gradients of the SSIM maps
# Splat-tile pairs of an image: 100 for each tile and 4 for each splat, more than real scenes have at the end of a run.
_ISECTS_PER_TILE, _ISECTS_PER_SPLAT = 100, 4
_MIN_ISECTS = 1 << 20  # isects that must fit; images with more are rendered in bands
# Words of a splat on the screen: key, order, two rectangles (6), two pairs (4), range of isects (2), statistics (3),
# tile counts (4).
_SCREEN_WORDS = 21
_DENSIFY_WORDS = 6  # words of a splat while splats are added and removed: its summary (2), its source, new values (3)
_WAITING_WORDS = 4  # additional words of a splat with `visible_adam`, if a vector has one splat
_MOST_SPLATS = 1 << 30  # upper end of the search for the number that fits

_REMEDIES = (SMALLER_IMAGES, Remedy("use fewer spherical harmonics", "--sh-degree"), OTHER_DEVICE)


@dataclass(frozen=True)
class Estimate:
    """Bytes of a run by purpose.

    Attributes
    ----------
    isect : bytes of one isect.
    largest_buffer : bytes of the largest buffer that does not hold isects.
    available : bytes of the device; 0 if it is not known.
    most_splats : largest number of splats with which the run fits the device; 0 if it is not known.
    """

    splats: int
    isects: int
    images: int
    isect: int
    largest_buffer: int
    available: int = 0
    most_splats: int = 0

    @property
    def total(self) -> int:
        return self.splats + self.isects + self.images

    def __str__(self) -> str:
        of = f" of {self.available / 1e6:.0f} MB" if self.available else ""
        return (
            f"{self.total / 1e6:.0f} MB{of} of device memory (splats {self.splats / 1e6:.0f}, "
            f"splat-tile pairs {self.isects / 1e6:.0f}, images {self.images / 1e6:.0f}){self.room}"
        )

    @property
    def room(self) -> str:
        """The number of splats that fit, as the end of a sentence."""
        return f"; up to {self.most_splats} splats fit" if self.most_splats else ""


def estimate(
    config: TrainConfig,
    kernels: KernelBuild,
    layout: ImageLayout,
    target_bytes: int,
    splats: int | None = None,
    n_frozen: int = 0,
) -> Estimate:
    """Return the memory of a run with the largest image.

    Parameters
    ----------
    target_bytes : bytes of the photos on the device, and of what belongs to them.
    splats : largest number of splats that change; None for that of the options.
    n_frozen : splats that do not change (context.py).
    """
    real, live = kernels.dtype.itemsize, config.cap_max if splats is None else splats
    n, live = capacity_for(live + n_frozen), capacity_for(live)
    rows = {group: kernels.schema.rows(group) for group in Group}
    screen = (kernels.record + kernels.v_record) * real + 4 * (
        _SCREEN_WORDS + _DENSIFY_WORDS + _WAITING_WORDS * config.optim.visible_adam
    )
    isect = isect_bytes(kernels)
    n_isects = _ISECTS_PER_TILE * layout.tiles_x * layout.tiles_y + _ISECTS_PER_SPLAT * n
    state = 6 * SkewMap(config.skew_map).width if config.skew_map else 0  # s and two moments, with spare copies
    state += 0 if config.sghmc.position_optimizer == "adam" else 6  # momentum
    state += (
        _MOMENTS * rows[Group.GEOM] + (_MOMENTS - config.optim.half_moments) * rows[Group.SH]
    )  # or one word for both
    extra, batch = 0, config.schedule.batch
    if batch > 1:  # the mean gradients, and rows that come from another device
        extra += 2 * rows[Group.GEOM] + (batch + 1) * COMPACT_ROWS + SplatStatistics.ROWS
    planes: float = _IMAGE_PLANES
    if config.views.depth_smoothness:  # a copy of the splats with depths as colours, its gradients, and its images
        extra += 2 * rows[Group.GEOM] + 3 + COMPACT_ROWS
        screen, isect = 2 * screen, 2 * isect
        # The shorter side of an image of depths is below twice SMALLEST_SIDE, also while the photos are small.
        planes += _DEPTH_PLANES * min(2 * SMALLEST_SIDE / min(layout.width, layout.height), 1.0) ** 2
    widest = max(*rows.values(), kernels.record, kernels.v_record)  # of the buffers with a column for each splat
    splat = (_COPIES + 1) * rows[Group.GEOM] + _COPIES * rows[Group.SH] + COMPACT_ROWS + extra
    return Estimate(
        n * (splat * real + screen) + live * state * real,
        n_isects * isect,
        int(planes * layout.plane * real) + target_bytes,
        isect,
        max(widest * n * real, 9 * layout.plane * real),
    )


def run_memory(
    device: Device, kernels: KernelBuild, config: TrainConfig, views: Sequence[View], n_frozen: int = 0
) -> Estimate:
    """Return the memory estimate of a run on these views. Raise DeviceError if the device has too little memory.

    n_frozen : splats that do not change, beside those of the options.
    """
    largest = max((view.camera for view in views), key=lambda camera: camera.width * camera.height)
    layout = ImageLayout(largest.width, largest.height)
    channels = target_channels(views, config)
    images = target_bytes(views, target_budget(device), channels)
    images += exposure_bytes(layout, kernels.dtype.itemsize, config, channels)
    needed = estimate(config, kernels, layout, images, n_frozen=n_frozen)
    needed = replace(
        needed,
        available=device.info.global_mem_bytes,
        most_splats=most_splats(config, kernels, layout, images, device.info, n_frozen),
    )
    check(needed, device)
    return needed


def most_splats(
    config: TrainConfig,
    kernels: KernelBuild,
    layout: ImageLayout,
    target_bytes: int,
    info: DeviceInfo,
    n_frozen: int = 0,
) -> int:
    """Return the largest number of splats with which a run fits a device, a multiple of 1024; 0 if none fits.

    n_frozen : splats that do not change. They are not counted.
    """

    def fits(steps: int) -> bool:
        found = estimate(config, kernels, layout, target_bytes, steps * CAPACITY_STEP, n_frozen)
        return fault(found, info) is None

    low, high = 0, _MOST_SPLATS // CAPACITY_STEP  # low fits or is 0, high does not fit
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low * CAPACITY_STEP


def room_for_isects(needed: Estimate, info: DeviceInfo) -> int:
    """Return the number of isects that fit besides splats and images. Buffers may be larger by half as they grow."""
    return max(info.global_mem_bytes - needed.splats - needed.images, 0) * 2 // (3 * needed.isect)


def fault(needed: Estimate, info: DeviceInfo) -> str | None:
    """Return why splats, images and _MIN_ISECTS isects do not fit a device; None if they fit."""
    if needed.total > info.global_mem_bytes and room_for_isects(needed, info) < _MIN_ISECTS:
        text = replace(needed, available=0)
        return f"{info} has {info.global_mem_bytes / 1e6:.0f} MB, the run needs about {text}"
    if needed.largest_buffer > info.max_alloc_bytes:
        return (
            f"{info} allows {info.max_alloc_bytes / 1e6:.0f} MB in one buffer, "
            f"the run needs about {needed.largest_buffer / 1e6:.0f} MB{needed.room}"
        )
    return None


def check(needed: Estimate, device: Device) -> None:
    """Raise DeviceError if the run does not fit the device. The error names the number of splats that fits."""
    found = fault(needed, device.info)
    if found is not None:
        raise DeviceError(found, *([FEWER_SPLATS] if needed.most_splats else []), *_REMEDIES)

"""The stages of an iteration: the kernels of each, and the least that it has to read, write and compute."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from ..device.trace import TRANSFERS, Launch
from ..rendering.build import KernelBuild
from ..rendering.group_binner import DEPTH_BITS
from ..rendering.radix_sort import radix_passes
from ..splats.fields import Group, sh_coefficients
from ..splats.flops import ADAM, BLEND, BLEND_VJP, LOSS
from ..splats.shapes import shape_named

STAGES = {
    "project": ("project_splats", "drop_splats", "color_by_depth"),
    "depth sort": ("depth_span", "depth_histogram", "depth_scatter", "depth_buckets"),
    "binning": ("count_tiles", "total_tiles", "count_isects", "scan_isects", "emit_isects"),
    "tile sort": ("list_isects", "find_tile_ranges"),
    "rasterize": ("rasterize",),
    "loss": (
        "unpack_image",
        "photo_of_render",
        "image_loss",
        "image_loss_vjp",
        "photo_of_render_vjp",
        "step_exposure",
        "smooth_depth",
    ),
    "rasterize_vjp": ("rasterize_vjp",),
    "gather": ("gather_isect_grads",),
    "project_vjp": ("project_splats_vjp", "add_depth_gradient"),
    "step": (
        "step_splats",
        "turn_skew_gradient",
        "map_skew",
        "sghmc_step",
        "mcmc_noise",
        "wake_visible",
        "wake_all",
        "settle_color",
        "settle_geometry",
        "settle_skew",
        "add_columns",
    ),
    "strategy": ("summarise_splats", "gather_columns", "scatter_columns", "zero_columns"),
    "transfers": TRANSFERS,
}
HOST = "host"  # wall time in which the device is idle
STAGE_OF = {kernel: stage for stage, kernels in STAGES.items() for kernel in kernels}

# Kernels that several stages share. They belong to the stage that the last launch of _BEGINS has begun.
SHARED = ("radix_histogram", "radix_scan", "radix_scatter")
_BEGINS = {"project_splats": "depth sort", "count_isects": "binning", "emit_isects": "tile sort"}


@dataclass(frozen=True)
class Sizes:
    """Sizes that determine the work of one iteration.

    Attributes
    ----------
    splats, isects, pixels : numbers of splats, of splat-tile pairs, and of pixels of the image.
    pairs : number of useful splat-pixel pairs (rendering/overdraw.py).
    sh_degree : degree of spherical harmonics in use.
    """

    splats: int
    isects: int
    pixels: int
    pairs: int
    sh_degree: int


@dataclass(frozen=True)
class Work:
    """Bytes read and written, each array once, and floating-point operations; 0 if they are not counted."""

    bytes: int = 0
    flops: int = 0


def by_stage(launches: Iterable[Launch]) -> Iterator[tuple[str, Launch]]:
    """Yield the launches with their stages, in order. Raises KeyError for a kernel without a stage."""
    shared = "depth sort"
    for launch in launches:
        shared = _BEGINS.get(launch.name, shared)
        yield (shared if launch.name in SHARED else STAGE_OF[launch.name]), launch


def work_of(kernels: KernelBuild, sizes: Sizes, is_cpu: bool) -> dict[str, Work]:
    """Return the work of each stage at these sizes. Stages that are not counted are left out.

    Operations are those of useful pairs in the raster stages, of pixels in the loss, and of Adam. Bytes are those of
    the buffers of a stage, as if caches kept everything within a kernel and nothing between two.
    """
    real, shape = kernels.dtype.itemsize, shape_named(kernels.shape)
    n, isects, pixels, pairs = sizes.splats, sizes.isects, sizes.pixels, sizes.pairs
    geometry, colour = kernels.schema.rows(Group.GEOM), 3 * sh_coefficients(sizes.sh_degree)
    record, v_record = real * kernels.record, real * kernels.v_record
    tiles = -(-pixels // 256)
    depth_passes, tile_passes = (radix_passes(bits) for bits in (DEPTH_BITS, max((tiles - 1).bit_length(), 1)))
    forward, backward = shape.flops
    if is_cpu:
        listing = {
            "depth sort": Work(40 * n),  # keys read three times, pairs and numbers written, pairs read twice
            "binning": Work(28 * n),  # order and boxes read, boxes written in order
            # Order, boxes and the range of each splat; ids and splats of isects.
            "tile sort": Work(20 * n + 8 * isects + 8 * tiles),
        }
    else:
        listing = {
            # In each pass keys are read twice, values once except in the first pass, and both are written.
            "depth sort": Work(n * (20 * depth_passes - 4)),
            # Order and boxes read twice, the record and the range of each splat; three words of each isect written.
            "binning": Work((48 + 4 * kernels.record) * n + 12 * isects),
            "tile sort": Work(20 * tile_passes * isects + 8 * tiles),
        }
    return listing | {
        "project": Work(n * (real * (geometry + colour) + record + 20)),
        "rasterize": Work((12 + record) * isects + 4 * real * pixels, pairs * (forward + BLEND)),
        # The target is read twice. The planes are 3 and three maps of each written, 12 read, 3 written.
        "loss": Work((6 + real * 27) * pixels, 3 * LOSS * pixels),
        "rasterize_vjp": Work(
            (12 + record + v_record) * isects + 6 * real * pixels, pairs * (forward + backward + BLEND_VJP)
        ),
        "gather": Work((8 + v_record) * n + v_record * isects),
        # The gradients of colour are compact: 6 rows.
        "project_vjp": Work(n * (real * (2 * geometry + colour + 6 + 3 + 6) + v_record + 4)),
        "step": Work(real * n * (7 * geometry + 6 * colour + 6), ADAM * n * (geometry + colour)),
    }

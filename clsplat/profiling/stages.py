"""The stages of an iteration: which kernels make up each, and what each must read, write and compute at least."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from ..device.trace import TRANSFERS, Launch
from ..rendering.build import KernelBuild
from ..rendering.radix_sort import radix_passes
from ..splats.fields import Group, sh_coefficients
from ..splats.flops import ADAM, BLEND, BLEND_VJP, LOSS
from ..splats.shapes import shape_named

STAGES = {
    "project": ("project_splats",),
    "depth sort": ("depth_span", "depth_histogram", "depth_scatter", "depth_buckets", "fill_iota"),
    "binning": ("count_tiles", "total_tiles", "count_isects", "emit_isects"),
    "tile sort": ("list_isects", "find_tile_ranges"),
    "rasterize": ("rasterize",),
    "loss": ("unpack_image", "photo_of_render", "image_loss", "image_loss_vjp", "photo_of_render_vjp", "step_exposure"),
    "rasterize_vjp": ("rasterize_vjp",),
    "gather": ("gather_isect_grads",),
    "project_vjp": ("project_splats_vjp",),
    "step": (
        "step_color",
        "step_geometry",
        "step_skew",
        "turn_skew_gradient",
        "map_skew",
        "sghmc_step",
        "mcmc_noise",
        "wake_visible",
        "wake_all",
        "settle_color",
        "settle_geometry",
        "settle_skew",
        "step_visible_color",
        "step_visible_geometry",
        "step_visible_skew",
    ),
    "strategy": ("gather_columns", "zero_columns"),
    "transfers": TRANSFERS,
}
HOST = "host"  # wall time in which the device did nothing
STAGE_OF = {kernel: stage for stage, kernels in STAGES.items() for kernel in kernels}

# Kernels that several stages share: theirs is the stage that the last of these launches began.
SHARED = ("radix_histogram", "radix_scatter", "scan_sums", "scan_spine", "scan_apply")
_BEGINS = {"fill_iota": "depth sort", "count_isects": "binning", "emit_isects": "tile sort"}


@dataclass(frozen=True)
class Sizes:
    """What the work of one iteration grows with.

    Attributes
    ----------
    splats, isects : their numbers. pixels : of the image.
    pairs : useful pairs of splat and pixel (pairs.py).
    sh_degree : in use.
    """

    splats: int
    isects: int
    pixels: int
    pairs: int
    sh_degree: int


@dataclass(frozen=True)
class Work:
    """Bytes read and written, each array once, and floating-point operations (0: not counted)."""

    bytes: int = 0
    flops: int = 0


def by_stage(launches: Iterable[Launch]) -> Iterator[tuple[str, Launch]]:
    """The launches with their stages, in order; raises KeyError for a kernel that has none."""
    shared = "depth sort"
    for launch in launches:
        shared = _BEGINS.get(launch.name, shared)
        yield (shared if launch.name in SHARED else STAGE_OF[launch.name]), launch


def work_of(kernels: KernelBuild, sizes: Sizes, is_cpu: bool) -> dict[str, Work]:
    """What each stage must move and compute at these sizes; without those that are not counted.

    Flops are those of useful pairs, in the raster stages, of pixels in the loss, and of Adam. Bytes are those of the
    stages' own buffers as ARCHITECTURE.md lists them, as if caches kept nothing between kernels and all within one.
    """
    real, shape = kernels.dtype.itemsize, shape_named(kernels.shape)
    n, isects, pixels, pairs = sizes.splats, sizes.isects, sizes.pixels, sizes.pairs
    geometry, colour = kernels.schema.rows(Group.GEOM), 3 * sh_coefficients(sizes.sh_degree)
    record, v_record = real * kernels.record, real * kernels.v_record
    tiles = -(-pixels // 256)
    depth_passes, tile_passes = (radix_passes(bits) for bits in (32, max((tiles - 1).bit_length(), 1)))
    forward, backward = shape.flops
    if is_cpu:
        listing = {
            "depth sort": Work(40 * n),  # keys three times; pairs and numbers written, pairs twice read
            "binning": Work(28 * n),  # order, boxes, boxes in order
            "tile sort": Work(20 * n + 8 * isects + 8 * tiles),  # order, boxes, each splat's range; ids and splats
        }
    else:
        listing = {
            "depth sort": Work(n * (4 + 20 * depth_passes)),  # numbers; keys twice, values, and both written
            "binning": Work(68 * n + 12 * isects),  # order and boxes twice, counts and their scan; three words out
            "tile sort": Work((4 + 20 * tile_passes) * isects + 8 * tiles),
        }
    return listing | {
        "project": Work(n * (real * (geometry + colour) + record + 20)),
        "rasterize": Work((12 + record) * isects + 4 * real * pixels, pairs * (forward + BLEND)),
        # truth twice; planes: 3 and three maps of each out, 12 back, 3 out
        "loss": Work((6 + real * 27) * pixels, 3 * LOSS * pixels),
        "rasterize_vjp": Work(
            (12 + record + v_record) * isects + 6 * real * pixels, pairs * (forward + backward + BLEND_VJP)
        ),
        "gather": Work((8 + v_record) * n + v_record * isects),
        "project_vjp": Work(n * (real * (2 * geometry + colour + 6 + 3 + 6) + v_record + 4)),  # colour read, 6 out
        "step": Work(real * n * (7 * geometry + 6 * colour + 6), ADAM * n * (geometry + colour)),
    }

"""What each stage asks of a GPU: bytes, instructions, accesses to local memory and commands.

Bytes are those of `stages.work_of`. Instructions are those of the loops over isects and rows, as NVIDIA's compiler has
them for sm_90 (benchmarks/results/isa.json). The instructions of other kernels are not counted, because their bytes
take longer.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..device.schedule import SCHEDULES, Schedule
from ..rendering.build import SUM_ROWS, KernelBuild
from ..rendering.group_binner import DEPTH_BITS
from ..rendering.radix_sort import radix_passes
from ..splats.flops import BLEND, BLEND_VJP
from ..splats.shapes import shape_named
from ..training.loss import ITEMS_PER_UNIT, MIN_ROWS
from .stages import Sizes, work_of

WARP = 32  # work-items that run together
GPU_SCHEDULES = {name: schedule for name, schedule in SCHEDULES.items() if schedule.group > 1}
SUM_ROUND = 64  # instructions of a round of a group's sums: eight reads of 16 bytes, their additions, and the place
_PART_READS = 32  # accesses of a warp that reads 32 values of 32 sums
_ROWS, _ROWS_VJP = 295, 193  # instructions of image_loss and image_loss_vjp for a pixel of a row and channel
_WINDOW_ROWS = 10  # rows that a work-item of the loss reads besides its own
_SKIPPED = 6  # instructions of an isect whose tile the splat does not reach
_EMIT, _STRIP = 210, 56  # instructions of emit_isects for an isect, with two searches, and for each of its strips
_EMIT_SKEWED, _STRIP_SKEWED = 230, 87
_WAITING = 28  # bytes of each splat that the selection of visible splats reads and writes
_PER_FLOP = 1.1  # instructions of a pixel for each operation; for shapes that the compilers were not asked about


@dataclass(frozen=True)
class PixelLoop:
    """Instructions of a work-item for one isect.

    Attributes
    ----------
    single : with one block of pixels, if the splat reaches it.
    isect : with several blocks, besides the blocks.
    block : a block that the splat reaches.
    """

    single: float
    isect: float
    block: float

    def of(self, vecs: int, tiles: float, reached: float) -> float:
        """Return the mean instructions with `vecs` blocks, if a tile and a block are reached in these shares."""
        isect = tiles * self.single if vecs == 1 else tiles * self.isect + self.block * vecs * reached
        return isect + (1 - tiles) * _SKIPPED


FORWARD = {"gaussian": PixelLoop(31.25, 19, 18.25), "skew-normal": PixelLoop(52, 22, 32.25)}
BACKWARD = {"gaussian": PixelLoop(79, 51, 33.25), "skew-normal": PixelLoop(107, 59, 54.25)}  # without the sums


@dataclass(frozen=True)
class Shares:
    """How much of the listed work is done.

    The defaults are those of a made-up scene of a million splats at 1080p (benchmarks/results/gpu_workloads.jsonl).

    Attributes
    ----------
    looked : isects that a tile looks at before all of its pixels are finished, of all.
    tiles : of these isects, those whose splat reaches its tile.
    rows2, rows4 : strips of 2 and of 4 rows of a tile that a splat reaches, of all.
    stepping : splats whose parameters step, of all; None if all do, without `visible_adam`.
    """

    looked: float = 1.0
    tiles: float = 0.93
    rows2: float = 0.46
    rows4: float = 0.53
    stepping: float | None = None

    def reached(self, schedule: Schedule) -> float:
        """Return the share of a work-item's blocks that it computes."""
        rows = WARP // 16 if schedule.group == WARP else schedule.group // 16
        return {2: self.rows2, 4: self.rows4}.get(rows, self.tiles)


@dataclass(frozen=True)
class Counts:
    """Work of a stage.

    Attributes
    ----------
    bytes : of device memory. instructions : of work-items. local_bytes : of local memory.
    commands : kernels and transfers.
    waits : times that the host waits for the device and the device then waits for the host.
    """

    bytes: float = 0
    instructions: float = 0
    local_bytes: float = 0
    commands: int = 0
    waits: int = 0


def counts_of(
    kernels: KernelBuild, sizes: Sizes, schedule: Schedule, units: int, shares: Shares | None = None
) -> dict[str, Counts]:
    """Return the counts of each stage of a training step.

    Parameters
    ----------
    schedule : a schedule of `GPU_SCHEDULES`, or another one of groups.
    units : multiprocessors; the loss cuts its strips by them.
    shares : None for the defaults.
    """
    shares = shares or Shares()
    work = work_of(kernels, sizes, is_cpu=False)
    forward, backward = loops_of(kernels.shape)
    looked, group = shares.looked * sizes.isects, schedule.group
    warps, tiles, reached = group / WARP, shares.tiles, shares.reached(schedule)
    rounds, sum_reads = sum_work(kernels.v_record, group)
    gradient = backward.of(schedule.vecs, tiles, reached) + tiles * SUM_ROUND * rounds / warps
    reads = warps * -(-kernels.record // 4)  # 16 bytes at once
    skewed = shape_named(kernels.shape).skew_form is not None
    emit, strip = (_EMIT_SKEWED, _STRIP_SKEWED) if skewed else (_EMIT, _STRIP)
    instructions = {
        "binning": sizes.isects * (emit + strip * schedule.vecs),
        "rasterize": looked * group * forward.of(schedule.vecs, tiles, reached),
        "rasterize_vjp": looked * group * gradient,
        "loss": 3 * sizes.pixels * _halo(sizes.pixels, units) * (_ROWS + _ROWS_VJP),
    }
    local = {
        "rasterize": looked * tiles * reads * 4 * WARP,
        "rasterize_vjp": looked * tiles * (reads + sum_reads) * 4 * WARP,
    }
    size = {stage: one.bytes for stage, one in work.items()}
    if shares.stepping is not None:  # skipped steps are done in the launch of the next one, which reads no byte more
        size["step"] = round(shares.stepping * size["step"]) + _WAITING * sizes.splats
    waits = {"transfers": 1}
    return {
        stage: Counts(
            size.get(stage, 0), instructions.get(stage, 0), local.get(stage, 0), commands, waits.get(stage, 0)
        )
        for stage, commands in commands_of(kernels, sizes.pixels, shares.stepping is not None).items()
    }


def commands_of(kernels: KernelBuild, pixels: int, visible_only: bool = False) -> dict[str, int]:
    """Return the commands of each stage of a training step on a GPU. visible_only : with `visible_adam`."""
    tiles = -(-pixels // 256)
    depth_passes, tile_passes = (radix_passes(bits) for bits in (DEPTH_BITS, max((tiles - 1).bit_length(), 1)))
    return {
        "project": 1,
        "depth sort": 3 * depth_passes,
        "binning": 3,
        "tile sort": 3 * tile_passes + 1,
        "rasterize": 1,
        "loss": 3,
        "rasterize_vjp": 1,
        "gather": 1,
        "project_vjp": 1,
        "step": 1 + visible_only,
        "transfers": 3 + visible_only,  # the photo, the camera and the number of isects; the table of skipped steps
    }


def loops_of(shape: str) -> tuple[PixelLoop, PixelLoop]:
    """Return the loops of `rasterize` and `rasterize_vjp`. A block of an uncounted shape follows its operations."""
    if shape in FORWARD:
        return FORWARD[shape], BACKWARD[shape]
    forward, backward = shape_named(shape).flops
    return (
        _with_block(FORWARD["gaussian"], _PER_FLOP * (forward + BLEND)),
        _with_block(BACKWARD["gaussian"], _PER_FLOP * (forward + backward + BLEND_VJP)),
    )


def _with_block(loop: PixelLoop, block: float) -> PixelLoop:
    """Return a loop whose blocks have another number of instructions."""
    return PixelLoop(loop.single + block - loop.block, loop.isect, block)


def sum_work(n: int, group: int) -> tuple[float, float]:
    """Return the rounds of warps for an isect, and their accesses to local memory, of `n` sums over a group.

    A warp adds up parts of 32 values. Small groups wait for several isects (SUM_BATCH of cl/render/group.clh).
    """
    batch = 1 if group > 64 or n > SUM_ROWS else SUM_ROWS // n
    parts = group // WARP
    rounds = -(-batch * n * parts // WARP) / batch
    last = (parts > 1) * (1 + parts) / batch  # parts are stored, and one warp adds them up
    return rounds, n * parts + rounds * _PART_READS + last


def _halo(pixels: int, units: int) -> float:
    """Rows that the loss reads, of those that it writes."""
    rows = max(3 * pixels / (units * ITEMS_PER_UNIT["GPU"]), MIN_ROWS)
    return (rows + _WINDOW_ROWS) / rows

"""Predicted times of the stages of a training step on GPUs. The model was fitted to one of them, an H100.

    python benchmarks/gpu_model.py                # print the predictions of the stored workloads
    python benchmarks/gpu_model.py --write        # write them into GPU.md, too
    python benchmarks/gpu_model.py --measure      # render the frames whose work is counted, and store the counts

The model is clsplat/profiling/gpu_model.py. A workload is a frame that was rendered on a processor: its splats, isects
and useful pairs, the isects that its tiles look at, and the strips of its tiles that splats reach.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import common
import numpy as np
from numpy.typing import NDArray

from clsplat.cameras.camera import Camera
from clsplat.device.device import open_device
from clsplat.device.memory import to_host
from clsplat.device.opencl import Buffer
from clsplat.device.schedule import SCHEDULES
from clsplat.profiling.bench import bench_trainer
from clsplat.profiling.gpu_counts import Shares, counts_of
from clsplat.profiling.gpu_model import Predicted, fastest_schedule, predict, total_ms
from clsplat.profiling.gpus import GPUS, Gpu
from clsplat.profiling.stages import Sizes
from clsplat.rendering.build import CULLED_KEY, GROUP_BATCH, KernelBuild
from clsplat.rendering.overdraw import count_pairs
from clsplat.rendering.pipeline import Pipeline
from clsplat.rendering.splat_buffers import SplatBuffers
from clsplat.scenes.random_scene import synthetic_scene
from clsplat.training.trainer import Trainer

OUT = common.RESULTS / "gpu_workloads.jsonl"
PAGE = common.ROOT / "benchmarks" / "GPU.md"
SHAPES = ("gaussian", "skew-normal")
SYNTHETIC, SPLATS, WIDTH, HEIGHT = "synthetic", 1_000_000, 1920, 1080
SCENES = ("fox", "south_building_large")
# Isects of a trained scene with a million splats, and the share that tiles look at. Both are assumptions.
MANY_ISECTS, MANY_LOOKED = 5_000_000, 0.75
STEP_MS, SKEW_RATIO, TARGET_GPU = 4.0, 1.2, "H200"  # targets
# Clocks for an isect in a tile as counted at 546ceb8 with gpu256, and the target's share of them.
CYCLES = {"rasterize": (136, 0.45), "rasterize_vjp": (473, 0.35)}
_LETTERS = {"bandwidth": "B", "instructions": "I", "local memory": "L", "launches": "–"}
STEPPING = (0.65, 0.3, 0.12)  # shares of the splats that step, with visible_adam
_BEGIN, _END = "<!-- table of gpu_model.py -->", "<!-- end of the table of gpu_model.py -->"


@dataclass(frozen=True)
class Workload:
    """A frame's work.

    Attributes
    ----------
    scene, shape : which splats. width, height : size of the image [px].
    visible : splats that the image shows.
    """

    scene: str
    shape: str
    width: int
    height: int
    visible: int
    sizes: Sizes
    shares: Shares

    @property
    def kernels(self) -> KernelBuild:
        """The kernels of the shape."""
        return KernelBuild(self.shape, self.sizes.sh_degree, SCHEDULES["gpu64"])

    def predicted(self, gpu: Gpu) -> tuple[Predicted, ...]:
        """Return the stages with the fastest schedule."""
        return predict(self.kernels, self.sizes, gpu, shares=self.shares)

    def total_ms(self, gpu: Gpu) -> float:
        """Return the time of a step."""
        return total_ms(self.predicted(gpu))


def main() -> None:
    parser = common.parser(__doc__, OUT, table=False)
    parser.add_argument("--measure", action="store_true", help="render the frames and store their counts")
    parser.add_argument("--write", action="store_true", help="write the tables into GPU.md")
    args = parser.parse_args()
    if args.measure or args.smoke:
        rows = "".join(json.dumps(asdict(one)) + "\n" for one in measured(args.device, args.smoke))
        args.out.write_text(rows, encoding="utf-8")
    text = "\n\n".join(tables(read(args.out)))
    print(text)
    if args.write:
        common.write_between(PAGE, _BEGIN, _END, text)


def read(path: Path = OUT) -> list[Workload]:
    """Return the stored workloads."""
    return [
        Workload(**{**row, "sizes": Sizes(**row["sizes"]), "shares": Shares(**row["shares"])})
        for row in common.read(path)
    ]


def measured(device_name: str | None, smoke: bool) -> Iterator[Workload]:
    """Render a frame of each scene and shape on a processor, and yield its work."""
    device = open_device(device_name)
    n, width, height = (500, 64, 48) if smoke else (SPLATS, WIDTH, HEIGHT)
    for shape in SHAPES:
        scene, splats = synthetic_scene(n, width, height, shape)
        yield frame_work(bench_trainer(scene, device, shape, splats), SYNTHETIC)
    for name in () if smoke else SCENES:
        real = common.real_scene(name, -1)
        for shape in SHAPES:
            yield frame_work(bench_trainer(real, device, shape, len(real.points)), name)


def frame_work(trainer: Trainer, scene: str) -> Workload:
    """Render the run's first view and return its work. The device must be a processor, which lists blocks."""
    pipeline, splats, camera = trainer.pipeline, trainer.splats, trainer.scene.train[0].camera
    first = pipeline.forward(splats, camera)
    pipeline.isect_blocks.zeros(first.n_isects)  # blocks of isects that no tile looks at stay 0
    frame = pipeline.forward(splats, camera)
    ((_, lists),) = pipeline.bands(frame)
    n, n_isects, layout = frame.n_splats, frame.n_isects, frame.layout

    def array(buffer: Buffer, shape: int | tuple[int, ...], dtype: type[Any]) -> NDArray[Any]:
        return to_host(trainer.device, buffer, np.empty(shape, dtype))

    ids = array(lists.isects, n_isects, np.uint32)
    blocks = array(pipeline.isect_blocks.buffer, n_isects, np.uint32)[ids]
    ranges = array(lists.ranges, (layout.n_tiles, 2), np.uint32).astype(np.int64)
    tile = np.repeat(np.arange(layout.n_tiles), ranges[:, 1] - ranges[:, 0])
    order = np.concatenate([np.arange(a, b) for a, b in ranges])
    place = order - ranges[tile, 0]  # in the list of its tile
    last = np.zeros(layout.n_tiles, np.int64)
    np.maximum.at(last, tile, np.where(blocks[order] != 0, place + 1, 0))
    looked = place < -(-last[tile] // GROUP_BATCH) * GROUP_BATCH
    seen = np.zeros(n_isects, bool)
    seen[ids[order]] = looked

    def reached(schedule: str) -> float:
        """Return the share of a tile's strips that a splat reaches, of the isects that are looked at."""
        form = SCHEDULES[schedule]
        strips = isect_strips(Pipeline(trainer.device, replace(trainer.kernels, schedule=form)), splats, camera)
        if len(strips) == n_isects:  # else a box has rounded to another pixel: the isects have other numbers
            strips = strips[seen]
        return round(float(np.bitwise_count(strips).mean()) / form.vecs, 3)

    keys = array(frame.projected.depth_key, n, np.uint32)
    sizes = Sizes(n, n_isects, layout.width * layout.height, count_pairs(pipeline, frame), frame.sh_degree)
    shares = Shares(round(float(looked.mean()), 3), *(reached(name) for name in ("gpu256", "gpu32", "gpu64")))
    visible = int((keys != CULLED_KEY).sum())
    return Workload(scene, trainer.kernels.shape, layout.width, layout.height, visible, sizes, shares)


def isect_strips(pipeline: Pipeline, splats: SplatBuffers, camera: Camera) -> NDArray[np.uint32]:
    """Return the set of strips of each isect of an image. Nothing is drawn: groups are slow on a processor."""
    with mock.patch.object(pipeline, "_rasterize"):
        frame = pipeline.forward(splats, camera)
    ((_, lists),) = pipeline.bands(frame)
    assert lists.strips is not None
    return to_host(pipeline.device, lists.strips, np.empty(frame.n_isects, np.uint32))


def tables(workloads: list[Workload]) -> Iterator[str]:
    """Yield the workloads, a table of times for each scene, and the targets."""
    yield common.table(
        (
            "scene",
            "shape",
            "image",
            "splats",
            "visible",
            "isects",
            "useful pairs a pixel",
            "looked at",
            "tiles",
            "2 rows",
            "4 rows",
        ),
        (
            (
                one.scene,
                one.shape,
                f"{one.width}×{one.height}",
                one.sizes.splats,
                one.visible,
                one.sizes.isects,
                f"{one.sizes.pairs / one.sizes.pixels:.0f}",
                *(
                    f"{share:.0%}"
                    for share in (one.shares.looked, one.shares.tiles, one.shares.rows2, one.shares.rows4)
                ),
            )
            for one in workloads
        ),
        ("splats", "visible", "isects", "useful pairs a pixel", "looked at", "2 rows", "4 rows"),
    )
    pairs = [workloads[i : i + len(SHAPES)] for i in range(0, len(workloads), len(SHAPES))]
    many = [
        replace(one, sizes=replace(one.sizes, isects=MANY_ISECTS), shares=replace(one.shares, looked=MANY_LOOKED))
        for one in pairs[0]
    ]
    for gaussian, skewed in [pairs[0], many, *pairs[1:]]:
        title = f"{gaussian.scene}, {gaussian.sizes.splats} splats, {gaussian.sizes.isects} isects"
        yield f"#### {title}" + (" (assumed)" if gaussian is many[0] else "")
        yield times(gaussian, skewed)
    yield "#### Steps of visible splats"
    yield visible_steps(pairs[0][0])
    yield "#### Targets"
    yield targets(*pairs[0], many[0])


def times(gaussian: Workload, skewed: Workload) -> str:
    """Return the table of stages and GPUs of a scene."""
    columns = [(gaussian.predicted(gpu), skewed.predicted(gpu)) for gpu in GPUS]
    rows = [
        [stage.stage, *(f"{cell(plain[i])}, {cell(skew[i])}" for plain, skew in columns)]
        for i, stage in enumerate(columns[0][0])
    ]
    sums = [(total_ms(plain), total_ms(skew)) for plain, skew in columns]
    rows.append(["**sum**", *(f"**{plain:.2f}, {skew:.2f}**" for plain, skew in sums)])
    rows.append(["skew-normal / gaussian", *(f"{skew / plain:.2f}" for plain, skew in sums)])
    schedules = (
        ", ".join(
            dict.fromkeys(fastest_schedule(one.kernels, one.sizes, gpu, one.shares) for one in (gaussian, skewed))
        )
        for gpu in GPUS
    )
    rows.append(["schedule", *schedules])
    names = [gpu.name for gpu in GPUS]
    return common.table(("stage [ms]", *names), rows, names)


def visible_steps(workload: Workload) -> str:
    """Return the time of Adam and of the whole step if only a share of the splats steps."""
    names = [gpu.name for gpu in GPUS]
    rows = []
    for share in (None, *STEPPING):
        one = replace(workload, shares=replace(workload.shares, stepping=share))
        stages = [one.predicted(gpu) for gpu in GPUS]
        times = (
            f"{next(stage.ms for stage in each if stage.stage == 'step'):.2f}, {total_ms(each):.2f}" for each in stages
        )
        rows.append(("all" if share is None else f"{share:.0%}", *times))
    return common.table(("splats that step: Adam, all stages [ms]", *names), rows, names)


def cell(stage: Predicted) -> str:
    """Return the time of a stage and the letter of its bound."""
    return f"{stage.ms:.2f} {_LETTERS[stage.bound]}" if stage.ms else "0"


def targets(gaussian: Workload, skewed: Workload, many: Workload) -> str:
    """Return the targets and what the model predicts."""
    gpu = next(gpu for gpu in GPUS if gpu.name == TARGET_GPU)
    step, ratio = gaussian.total_ms(gpu), skewed.total_ms(gpu) / gaussian.total_ms(gpu)
    steps = {
        f"a step at 1 M splats, 1080p, on {gpu.name}: at most {STEP_MS:g} ms": step,
        f"... with {1e-6 * MANY_ISECTS:g} M isects, {MANY_LOOKED:.0%} looked at": many.total_ms(gpu),
    }
    rows = [(name, f"{ms:.1f} ms", verdict(ms, STEP_MS)) for name, ms in steps.items()]
    for stage, (before, share) in CYCLES.items():
        cycles = cycles_of(stage, gaussian, gpu)
        name = f"cycles of `{stage}` for an isect in a tile: at most {share:.0%} of {before}"
        rows.append((name, f"{cycles:.0f} cycles", verdict(cycles, share * before)))
    rows.append(
        (f"skew-normal at most {SKEW_RATIO:g} times the Gaussian", f"{ratio:.2f} times", verdict(ratio, SKEW_RATIO))
    )
    return common.table(("target", "predicted", ""), rows)


def cycles_of(stage: str, workload: Workload, gpu: Gpu) -> float:
    """Return the clocks of a multiprocessor for one isect that a tile looks at: of instructions or of local memory."""
    schedule = SCHEDULES[fastest_schedule(workload.kernels, workload.sizes, gpu, workload.shares)]
    counts = counts_of(workload.kernels, workload.sizes, schedule, gpu.units, workload.shares)[stage]
    looked = workload.shares.looked * workload.sizes.isects
    return max(counts.instructions / gpu.lanes, counts.local_bytes / gpu.local) / looked


def verdict(predicted: float, target: float) -> str:
    """Return whether a target is met, and by which part of it."""
    part = abs(predicted - target) / target
    return f"met, {part:.0%} below" if predicted <= target else f"missed, {part:.0%} above"


if __name__ == "__main__":
    main()

"""Vectors against scalars: training steps of one source in two schedules, one work-item a tile and one a pixel.

    python benchmarks/scalar.py [--device 0:0] [--scenes kitchen] [--splats 20000] [--iterations 20]
    python benchmarks/scalar.py --table                       # print the finished runs, run nothing
    python benchmarks/scalar.py --smoke --out FILE            # some seconds, for tests

`256x1x1` has a work-item for every pixel and no vector types in its source: it shows what a compiler makes of the plain
form. Both runs step in turn, over the same views, from a scene's points at full size. Times are medians of the device's
clock, but the whole step is wall time. Each run is a JSON line with the ratio of the second schedule to the first.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from typing import Any

import common

WARM_UP = 2
RASTER = ("rasterize", "rasterize_vjp")


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "scalar.jsonl")
    parser.add_argument("--scenes", nargs="+", default=["kitchen"], help="scenes of the data folder, or `synthetic`")
    parser.add_argument("--shapes", nargs="+", default=["gaussian", "skew-normal"])
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--schedules", nargs=2, default=["cpu16", "gpu256"])
    parser.add_argument("--iterations", type=int, default=20)
    args = parser.parse_args()
    if args.smoke:
        args.scenes, args.shapes, args.splats, args.iterations = ["synthetic"], ["gaussian"], 100, 2
    for scene in args.scenes if not args.table else ():
        for shape in args.shapes:
            common.append(args.out, run(scene, shape, args))
    print_table(common.read(args.out))


def run(name: str, shape: str, args: argparse.Namespace) -> dict[str, Any]:
    """Return the line of a scene and shape."""
    from clsplat.device.device import open_device
    from clsplat.device.schedule import Schedule
    from clsplat.profiling.bench import bench_trainer
    from clsplat.rendering.tuning import SCHEDULE_VARIABLE
    from clsplat.scenes.random_scene import synthetic_scene
    from clsplat.scenes.scene import load_scene

    device, load = open_device(args.device), common.load_average()
    schedules = [str(Schedule.parse(schedule)) for schedule in args.schedules]
    if name == "synthetic":
        scene, start = synthetic_scene(args.splats, 64, 48, shape)
    else:
        scene, start = load_scene(common.data_folder() / name, eval=False), args.splats
    trainers = {}
    for schedule in schedules:
        os.environ[SCHEDULE_VARIABLE] = schedule
        trainers[schedule] = bench_trainer(scene, device, shape, start)
    steps: dict[str, list[dict[str, float]]] = {schedule: [] for schedule in schedules}
    for _ in range(WARM_UP + args.iterations):
        for schedule, trainer in trainers.items():
            steps[schedule].append(timed_step(trainer))
    times = {
        schedule: {stage: statistics.median(one[stage] for one in each[WARM_UP:]) for stage in (*RASTER, "step")}
        for schedule, each in steps.items()
    }
    camera = scene.cameras[0]
    return common.environment(device, schedules[0]) | {
        "scene": name,
        "shape": shape,
        "splats": trainers[schedules[0]].splats.n,
        "width": camera.width,
        "height": camera.height,
        "load": load,
        "other": schedules[1],
        "ms": times,
        "raster_ratio": raster(times[schedules[1]]) / raster(times[schedules[0]]),
        "step_ratio": times[schedules[1]]["step"] / times[schedules[0]]["step"],
    }


def timed_step(trainer: Any) -> dict[str, float]:
    """Return the milliseconds of a training step: both raster stages on the device, and the whole step."""
    from clsplat.device.trace import recorded

    trainer.device.finish()
    with recorded(trainer.device) as launches:
        start = time.perf_counter()
        trainer.step()
        trainer.device.finish()
        wall = 1e3 * (time.perf_counter() - start)
    return {stage: sum(launch.ms for launch in launches if launch.name == stage) for stage in RASTER} | {"step": wall}


def raster(times: dict[str, float]) -> float:
    """Return the time of both raster stages."""
    return sum(times[stage] for stage in RASTER)


def print_table(rows: list[dict[str, Any]]) -> None:
    """Print a line for each case: the times of both schedules and their ratios."""
    head = ["scene", "splats", "shape", "platform", "schedules", "load"]
    head += ["rasterize [ms]", "rasterize_vjp [ms]", "both: ratio", "step [ms]", "step: ratio"]
    lines = []
    for row in rows:
        pair = (row["schedule"], row["other"])
        forward, backward, step = (
            " / ".join(f"{row['ms'][schedule][stage]:.1f}" for schedule in pair) for stage in (*RASTER, "step")
        )
        line = [f"{row['scene']} {row['width']}x{row['height']}", row["splats"], row["shape"]]
        line += [row["platform"].split()[0], " / ".join(pair), f"{row['load']:.1f}", forward, backward]
        lines.append([*line, f"{row['raster_ratio']:.1f}", step, f"{row['step_ratio']:.1f}"])
    print(common.table(head, lines))


if __name__ == "__main__":
    main()

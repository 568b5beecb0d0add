"""Seconds of training until held-out views reach 20, 22, 24 and 26 dB; a JSON line a run.

    python benchmarks/time_to_quality.py [--scenes fox kitchen] [--device 0:0] [--iterations 3000] [--every 50]
        [--cap 20000] [--seeds 0] [--options "" coarse_to_fine=false "lambda_dssim=0,growth=1.1"] [--validate]
    python benchmarks/time_to_quality.py --table              # print what is there, run nothing
    python benchmarks/time_to_quality.py --smoke --scenes NAME --out FILE

A report, from which nothing is chosen: with --validate every 7th training view is held out instead of the test views,
and choices are made from those runs alone. Seconds are wall time of training, without the evaluations and with programs
built; CPU seconds, of all cores, likewise. Each of --options is a run by itself: options of TrainConfig with commas
between, "" for none. A run that is there for this commit, device and schedule is skipped. `load` is the machine's
one-minute load at the start.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
from systems import validation

LEVELS_DB = (20, 22, 24, 26)
RESOLUTION = {"fox": 2}  # of load_scene; others as they are
KEY = ("scene", "views", "options", "cap", "iterations", "seed", "platform", "schedule", "commit")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["fox", "kitchen", "sceaux_castle"])
    parser.add_argument("--options", nargs="+", default=[""])
    parser.add_argument("--cap", type=int, default=20_000)
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--every", type=int, default=50, help="iterations from one evaluation to the next")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--device")
    parser.add_argument("--out", type=Path, default=common.RESULTS / "time_to_quality.jsonl")
    parser.add_argument("--validate", action="store_true")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--smoke", action="store_true")
    args = parser.parse_args()
    if args.smoke:
        args.cap, args.iterations, args.every = 60, 4, 2
    for name in args.scenes if not args.table else ():
        for seed in args.seeds:
            for options in args.options:
                run(name, options, seed, args)
    print_table(common.read(args.out))


def run(name: str, options: str, seed: int, args: argparse.Namespace) -> None:
    """One training; appends its line."""
    from clsplat.comparison.methods import parse_methods
    from clsplat.device.device import open_device
    from clsplat.rendering.tuning import schedule_for
    from clsplat.scenes.scene import load_scene
    from clsplat.training.trainer import Trainer

    device, load = open_device(args.device), os.getloadavg()[0]
    environment = common.environment(device, schedule_for(device))
    key = {
        "scene": name,
        "views": "validation" if args.validate else "test",
        "options": options,
        "cap": args.cap,
        "iterations": args.iterations,
        "seed": seed,
    } | {k: environment[k] for k in KEY if k in environment}
    if any(all(row[k] == value for k, value in key.items()) for row in common.read(args.out)):
        return
    (system,) = parse_methods(f"default:{options}" if options else "default")
    config = system.config(args.cap, seed, {"iterations": args.iterations})
    scene = load_scene(common.data_folder() / name, resolution=RESOLUTION.get(name, -1), eval=True)
    if args.validate:
        scene = validation(scene)
    Trainer(scene, replace(config, iterations=1), device=device).run()  # builds
    trainer = Trainer(scene, config, device=device)
    seconds = cpu = 0.0
    along = []
    while trainer.iteration < config.iterations:
        start, cpu_start = time.perf_counter(), time.process_time()
        for _ in range(min(args.every, config.iterations - trainer.iteration)):
            trainer.step()
        device.queue.finish()
        seconds, cpu = seconds + time.perf_counter() - start, cpu + time.process_time() - cpu_start
        along.append(
            [
                trainer.iteration,
                round(seconds, 3),
                round(cpu, 3),
                trainer.splats.n,
                round(trainer.evaluate(scene.test).psnr, 3),
            ]
        )
    common.append(args.out, key | environment | {"load": load, "along": along})
    print(f"{name} {options} seed {seed}: {along[-1][-1]:.2f} dB after {seconds:.1f} s", flush=True)


def reached(along: list[list[float]], level: float, column: int) -> float | None:
    """When the quality first was at `level`, between two evaluations by their line; column: 1 seconds, 2 CPU seconds.

    Before the first evaluation: the time of that one, as the quality at the start is not known.
    """
    before = None
    for point in along:
        if point[-1] >= level:
            if before is None:
                return point[column]
            part = (level - before[-1]) / (point[-1] - before[-1])
            return before[column] + part * (point[column] - before[column])
        before = point
    return None


def print_table(rows: list[dict[str, Any]]) -> None:
    """A line a run."""
    titles = [
        "scene",
        "views",
        "options",
        "seed",
        "platform",
        "commit",
        "load",
        *(f"s to {db} dB" for db in LEVELS_DB),
        "iterations",
        "seconds",
        "CPU s",
        "splats",
        "PSNR [dB]",
    ]
    print("| " + " | ".join(titles) + " |\n|" + "---|" * len(titles))
    for row in rows:
        iterations, seconds, cpu, splats, psnr = row["along"][-1]
        times = [reached(row["along"], level, 1) for level in LEVELS_DB]
        cells = [
            row["scene"],
            row["views"],
            row["options"] or "default",
            row["seed"],
            row["platform"].split()[0],
            row["commit"],
            f"{row['load']:.1f}",
            *("" if at is None else f"{at:.1f}" for at in times),
            iterations,
            f"{seconds:.1f}",
            f"{cpu:.1f}",
            splats,
            f"{psnr:.2f}",
        ]
        print("| " + " | ".join(map(str, cells)) + " |")


if __name__ == "__main__":
    main()

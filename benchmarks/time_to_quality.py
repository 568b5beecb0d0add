"""Seconds of training until held-out views reach 20, 22, 24 and 26 dB; a JSON line a run.

    python benchmarks/time_to_quality.py [--scenes fox kitchen] [--device 0:0] [--iterations 3000] [--every 50]
        [--cap 20000] [--seeds 0] [--options "" coarse_to_fine=false "lambda_dssim=0,growth=1.1"] [--validate]
    python benchmarks/time_to_quality.py --table              # print the finished runs, run nothing
    python benchmarks/time_to_quality.py --smoke --scenes NAME --out FILE

Nothing is chosen from runs on test views. With --validate every 7th training view is held out instead, and choices are
made from those runs alone. Seconds are wall time of training, without the evaluations and with programs already built.
CPU seconds count all cores in the same way. Each of --options is one run: options of TrainConfig with commas between
them, "" for the defaults. A finished run of this commit, device and schedule is skipped. `load` is the machine's
one-minute load at the start.
"""

from __future__ import annotations

import argparse
import itertools
import time
from typing import Any

import common

LEVELS_DB = (20, 22, 24, 26)
KEY = ("scene", "views", "options", "cap", "iterations", "seed", "platform", "schedule", "commit")


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "time_to_quality.jsonl")
    parser.add_argument("--scenes", nargs="+", default=["fox", "kitchen", "sceaux_castle"])
    parser.add_argument("--options", nargs="+", default=[""])
    parser.add_argument("--cap", type=int, default=20_000)
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--every", type=int, default=50, help="iterations from one evaluation to the next")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--validate", action="store_true", help="measure on held-out training views")
    args = parser.parse_args()
    if args.smoke:
        args.cap, args.iterations, args.every = 60, 4, 2
    runs = common.Runs(args.out, KEY)
    if not args.table:
        for name, seed, options in itertools.product(args.scenes, args.seeds, args.options):
            train(runs, name, options, seed, args)
    print_table(runs.rows)


def train(runs: common.Runs, name: str, options: str, seed: int, args: argparse.Namespace) -> None:
    """Train once and append the line, unless the run is finished."""
    from clsplat.comparison.methods import parse_methods
    from clsplat.device.device import open_device
    from clsplat.rendering.tuning import schedule_for
    from clsplat.training.trainer import Trainer

    device, load = open_device(args.device), common.load_average()
    case = {
        "scene": name,
        "views": "validation" if args.validate else "test",
        "options": options,
        "cap": args.cap,
        "iterations": args.iterations,
        "seed": seed,
        **common.environment(device, schedule_for(device)),
    }
    if case in runs:
        return
    (method,) = parse_methods(f"default:{options}" if options else "default")
    config = method.config(args.cap, seed, {"iterations": args.iterations})
    scene = common.real_scene(name, validate=args.validate)
    Trainer(scene, config.replace(iterations=1), device=device).run()  # builds the programs
    trainer = Trainer(scene, config, device=device)
    seconds = cpu = 0.0
    along = []
    while trainer.iteration < config.iterations:
        start, cpu_start = time.perf_counter(), time.process_time()
        for _ in range(min(args.every, config.iterations - trainer.iteration)):
            trainer.step()
        device.finish()
        seconds, cpu = seconds + time.perf_counter() - start, cpu + time.process_time() - cpu_start
        psnr = trainer.evaluate(scene.test).psnr
        along.append([trainer.iteration, round(seconds, 3), round(cpu, 3), trainer.splats.n, round(psnr, 3)])
    runs.add(case | {"load": load, "along": along})
    print(f"{name} {options} seed {seed}: {along[-1][-1]:.2f} dB after {seconds:.1f} s", flush=True)


def reached(along: list[list[float]], level: float, column: int) -> float | None:
    """Return when the quality first reached `level`, interpolated between two evaluations; None if it did not.

    The quality at the start is not known, so a level reached by the first evaluation has the time of that one.

    Parameters
    ----------
    column : 1 for seconds, 2 for CPU seconds.
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
    """Print a line for each run."""
    head = ["scene", "views", "options", "seed", "platform", "commit", "load"]
    head += [*(f"s to {db} dB" for db in LEVELS_DB), "iterations", "seconds", "CPU s", "splats", "PSNR [dB]"]
    lines = []
    for row in rows:
        iterations, seconds, cpu, splats, psnr = row["along"][-1]
        times = [reached(row["along"], level, 1) for level in LEVELS_DB]
        line = [row["scene"], row["views"], row["options"] or "default", row["seed"], row["platform"].split()[0]]
        line += [row["commit"], f"{row['load']:.1f}", *("" if at is None else f"{at:.1f}" for at in times)]
        lines.append([*line, iterations, f"{seconds:.1f}", f"{cpu:.1f}", splats, f"{psnr:.2f}"])
    print(common.table(head, lines))


if __name__ == "__main__":
    main()

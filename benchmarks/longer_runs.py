"""Runs that become longer: PSNR on validation views after `--resume --iterations N`, by several schedules.

    python benchmarks/longer_runs.py --scenes fox kitchen --strategies adc mcmc     # about 20 minutes on two cores
    python benchmarks/longer_runs.py --first 400

A run of `--first` iterations goes on to `--iterations` in these ways:

- continued: as clsplat does it, with the schedules of the longer run; SH degree and image size do not go back.
- free: with the schedules of the longer run alone.
- last rates: with the last learning rates of the first run, and without densification.
- new schedule: position rates and densification begin again for the additional iterations.

"direct" is a run of the whole length from the start, and "first" the first run. Writes one JSON line a seed, and prints
a table of the means. No test view is looked at.
"""

from __future__ import annotations

import json
import statistics
from dataclasses import replace
from pathlib import Path
from typing import Any

from common import RESULTS, commit, parser, real_scene

from clsplat.device.device import Device, open_device
from clsplat.scenes.scene import Scene
from clsplat.training.checkpoint import Checkpoint, Reached
from clsplat.training.config import TrainConfig
from clsplat.training.schedules import RunSchedule, exponential_decay
from clsplat.training.trainer import Trainer

RUNS = ("first", "continued", "free", "last rates", "new schedule", "direct")
FULL_SIZE = 1  # downscale


def resumed(scene: Scene, config: TrainConfig, checkpoint: Checkpoint, device: Device, way: str) -> Trainer:
    """Return the trainer of the rest of a run."""
    trainer = Trainer(scene, config, checkpoint, device=device)
    if way == "continued":
        return trainer
    if way == "free":
        same_length = checkpoint.config | {"iterations": config.iterations}
        return Trainer(scene, config, replace(checkpoint, config=same_length), device=device)
    first, added = checkpoint.iteration, config.iterations - checkpoint.iteration
    trainer.reached = Reached(config.sh_degree, FULL_SIZE)
    trainer.views.stages = [(0, FULL_SIZE)]
    if way == "last rates":
        before = RunSchedule.create(TrainConfig.from_json(checkpoint.config), checkpoint.n_first)
        trainer.schedule = replace(before, densify_first=config.iterations + 1)
    else:
        again = RunSchedule.create(config.replace(iterations=added), checkpoint.n_first)
        rate = exponential_decay(config.optim.position_lr_init, config.optim.position_lr_final, added)
        trainer.schedule = replace(
            again,
            mean_rate=lambda iteration: rate(iteration - first),
            densify_first=first + again.densify_first,
            densify_last=first + again.densify_last,
        )
    trainer.density.schedule = trainer.schedule
    return trainer


def measure(scene: Scene, config: TrainConfig, first: int, device: Device) -> dict[str, float]:
    """Return the PSNR [dB] of all runs of one seed."""
    found = {}
    begun = Trainer(scene, config.replace(iterations=first), device=device)
    begun.run()
    checkpoint = begun.checkpoint()
    trainers = {"first": begun}
    for way in RUNS[1:-1]:
        trainers[way] = resumed(scene, config, checkpoint, device, way)
    trainers["direct"] = Trainer(scene, config, device=device)
    for name, trainer in trainers.items():
        trainer.run()  # the first run is at its end
        found[name] = round(trainer.evaluate(scene.test).psnr, 3)
    return found


def table(rows: list[dict[str, Any]]) -> str:
    """Return a Markdown table: means over the seeds."""
    lines = [f"| scene | strategy | iterations | {' | '.join(RUNS)} |", "|---" * (len(RUNS) + 3) + "|"]
    cases = sorted({(row["scene"], row["strategy"], row["first_iterations"], row["iterations"]) for row in rows})
    for case in cases:
        keys = ("scene", "strategy", "first_iterations", "iterations")
        chosen = [row["psnr"] for row in rows if tuple(row[key] for key in keys) == case]
        means = " | ".join(f"{statistics.fmean(psnr[name] for psnr in chosen):.2f}" for name in RUNS)
        lines.append(f"| {case[0]} | {case[1]} | {case[2]} → {case[3]} | {means} |")
    return "\n".join(lines)


def main() -> None:
    flags = parser(__doc__, RESULTS / "longer_runs.jsonl")
    flags.add_argument("--scenes", nargs="+", default=["fox", "kitchen"])
    flags.add_argument("--strategies", nargs="+", default=["adc"])
    flags.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    flags.add_argument("--first", type=int, default=1000)
    flags.add_argument("--iterations", type=int, default=2000)
    flags.add_argument("--cap-max", type=int, default=8000)
    args = flags.parse_args()
    out: Path = args.out
    if args.smoke:
        args.first, args.iterations, args.cap_max, args.seeds = 4, 8, 100, [0]
    if not args.table:
        device = open_device(args.device)
        for name in args.scenes:
            scene = real_scene(name, -1 if args.smoke else 4, validate=True)
            for strategy in args.strategies:
                for seed in args.seeds:
                    config = TrainConfig(iterations=args.iterations, cap_max=args.cap_max, strategy=strategy, seed=seed)
                    row = {
                        "scene": name,
                        "strategy": strategy,
                        "seed": seed,
                        "first_iterations": args.first,
                        "iterations": args.iterations,
                        "cap_max": args.cap_max,
                        "commit": commit(),
                        "psnr": measure(scene, config, args.first, device),
                    }
                    with out.open("a", encoding="utf-8") as stream:
                        stream.write(json.dumps(row) + "\n")
    print(table([json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]))


if __name__ == "__main__":
    main()

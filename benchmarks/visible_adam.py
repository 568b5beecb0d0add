"""What it is worth to step only the splats that an image saw (TrainConfig.visible_adam); a JSON line a run.

    python benchmarks/visible_adam.py [--device 0:0] [--tasks wide train] [--splats 100000 1000000]
        [--scenes fox:2:20000 ...] [--options visible_adam=false visible_adam=true] [--iterations 1000] [--seeds 0 1]
    python benchmarks/visible_adam.py --table                # print what is there, run nothing
    python benchmarks/visible_adam.py --smoke --scenes NAME:1:60 --out FILE

`wide`: cameras around a ball of random splats that see about an eighth of them; 40 iterations that learn nothing
useful, the splats in Morton order. `train`: SCENE:REDUCTION:CAP, from the points on, every 7th training
view held out: of its PSNR choices are made. Times are medians of the device's own clock, at full size, but for `wall`;
vectors are those of a schedule's LANES splats, `seen` those of which the image saw one (mean over the iterations looked
at). A run that is there for this commit, device and schedule is skipped. `load`: the machine's one-minute load at the
start.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import numpy as np
from systems import validation

KEY = ("task", "scene", "splats", "shape", "options", "seed", "iterations", "platform", "schedule", "commit")
LENS = 3.7  # times the focal length of synthetic_scene
LOOK_EVERY = 7  # iterations from one that is timed to the next: other images, and all stages of a run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["wide", "train"], choices=["wide", "train"])
    parser.add_argument("--options", nargs="+", default=["visible_adam=false", "visible_adam=true"])
    parser.add_argument("--splats", nargs="+", type=int, default=[100_000, 1_000_000], help="of the wide scene")
    parser.add_argument(
        "--scenes", nargs="+", default=["fox:2:20000", "fox:4:5000", "kitchen:-1:20000", "sceaux_castle:-1:18000"]
    )
    parser.add_argument("--shapes", nargs="+", default=["skew-normal"])
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--device")
    parser.add_argument("--out", type=Path, default=common.RESULTS / "visible_adam.jsonl")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--smoke", action="store_true")
    args = parser.parse_args()
    if args.smoke:
        args.splats, args.seeds, args.iterations = [300], [0], 8
    if not args.table:
        for shape in args.shapes:
            for task in args.tasks:
                if task == "wide":
                    cases = [("wide", n, 0, 8 if args.smoke else 40) for n in args.splats]
                else:
                    cases = [(scene, 0, seed, args.iterations) for scene in args.scenes for seed in args.seeds]
                for scene, n, seed, iterations in cases:
                    for options in args.options:
                        run(task, scene, n, shape, options, seed, iterations, args)
    print_table(common.read(args.out))


def run(
    task: str, name: str, n: int, shape: str, options: str, seed: int, iterations: int, args: argparse.Namespace
) -> None:
    """One run; appends its line."""
    from clsplat.comparison.methods import parse_methods
    from clsplat.device.device import open_device
    from clsplat.rendering.tuning import schedule_for
    from clsplat.scenes.scene import load_scene
    from clsplat.training.trainer import Trainer

    device, load = open_device(args.device), os.getloadavg()[0]
    environment = common.environment(device, schedule_for(device))
    (system,) = parse_methods(f"{shape}:{options}" if options else shape)
    name, reduction, cap = [*name.split(":"), "-1", str(n)][:3]
    key = {
        "task": task,
        "scene": name,
        "splats": int(cap),
        "shape": shape,
        "options": options,
        "seed": seed,
        "iterations": iterations,
    } | {k: environment[k] for k in KEY if k in environment}
    if any(all(row[k] == value for k, value in key.items()) for row in common.read(args.out)):
        return
    with tempfile.TemporaryDirectory() as folder:
        fixed: dict[str, Any] = {"iterations": iterations}
        if task == "wide":  # as in the middle of a long run: full size, all bands, no action of the strategy
            scene, start = wide_scene(int(cap), shape, (64, 48) if args.smoke else (640, 480))
            fixed |= {"iterations": 30_000, "sh_interval": 1, "coarse_to_fine": False, "init": f"{folder}/start.ply"}
            start.save(fixed["init"])
        else:
            scene = validation(load_scene(common.data_folder() / name, resolution=int(reduction), eval=True))
        trainer = Trainer(scene, system.config(int(cap), seed, fixed), device=device)
        measured = measure(trainer, iterations)
    if task == "train":
        measured |= {"psnr": trainer.evaluate(scene.test).psnr, "end": trainer.splats.n}
    common.append(args.out, key | environment | {"load": load} | measured)
    print(*(f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in (key | measured).items()), flush=True)


def measure(trainer: Any, iterations: int) -> dict[str, Any]:
    """Train, and look closely at some of the iterations."""
    from clsplat.device.memory import to_host
    from clsplat.device.trace import recorded
    from clsplat.profiling.stages import by_stage

    lanes, queue, seconds = trainer.kernels.lanes, trainer.device.queue, 0.0
    trainer.step()  # kernels are built
    queue.finish()
    stages: dict[str, list[float]] = {"step": [], "device": []}
    splats_seen, seen = [], []
    for iteration in range(2, iterations + 1):
        start = time.perf_counter()
        if iteration % LOOK_EVERY:
            frame = trainer.step()
        else:
            with recorded(trainer.device) as launches:
                frame = trainer.step()
            queue.finish()
            ms = {"step": 0.0, "strategy": 0.0, "device": 0.0}
            for stage, launch in by_stage(launches):
                ms[stage] = ms.get(stage, 0.0) + launch.ms
                ms["device"] += launch.ms
            for name, kept in stages.items():
                kept.append(ms[name])
        if iteration == iterations:
            queue.finish()
        seconds += time.perf_counter() - start
        if iteration % LOOK_EVERY == 0:
            n = frame.n_splats
            keys = np.full(-(-n // lanes) * lanes, 0xFFFFFFFF, np.uint32)
            to_host(trainer.device, frame.projected.depth_key, keys[:n])
            visible = keys != 0xFFFFFFFF
            splats_seen.append(visible.sum() / n)
            seen.append(visible.reshape(-1, lanes).any(axis=1).mean())
    late = {name: statistics.median(kept[len(kept) // 2 :]) for name, kept in stages.items()}  # at full size
    return {
        "splats_seen": float(np.mean(splats_seen)),
        "vectors_seen": float(np.mean(seen)),
        "step_ms": late["step"],
        "device_ms": late["device"],
        "wall_ms": 1e3 * seconds / (iterations - 1),
    }


def wide_scene(n: int, shape: str, size: tuple[int, int]) -> Any:
    """A synthetic scene through long lenses, and its splats along a Morton curve."""
    from clsplat.cameras.camera import Camera
    from clsplat.scenes.random_scene import synthetic_scene
    from clsplat.splats.morton import morton_order
    from clsplat.splats.splats import Splats

    scene, splats = synthetic_scene(n, *size, shape, n_views=8)
    order = morton_order(splats.mean)
    arrays = {name: array[order] for name, array in splats.to_numpy().items()}

    def through_long_lens(view: Any) -> Any:
        c = view.camera
        longer = Camera(c.width, c.height, LENS * c.fx, LENS * c.fy, c.cx, c.cy, c.cam_from_world)
        return replace(view, camera=longer)

    return replace(scene, views=[through_long_lens(view) for view in scene.views]), Splats(shape, arrays)


def print_table(rows: list[dict[str, Any]]) -> None:
    """A line for all seeds of a case, means of them."""
    titles = [
        "scene",
        "splats",
        "shape",
        "options",
        "platform",
        "seeds",
        "splats seen",
        "vectors seen",
        "step [ms]",
        "device [ms]",
        "wall [ms]",
        "PSNR [dB]",
    ]
    print("| " + " | ".join(titles) + " |\n|" + "---|" * len(titles))
    cases: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        place = tuple(row[k] for k in KEY if k not in ("seed", "commit"))
        cases.setdefault(place, []).append(row)
    for found in cases.values():
        row = found[-1]

        def mean(name: str, found: list[dict[str, Any]] = found) -> float:
            return statistics.mean(one[name] for one in found)

        cells = [
            row["scene"],
            row.get("end", row["splats"]),
            row["shape"],
            row["options"],
            row["platform"].split()[0],
            len(found),
            f"{mean('splats_seen'):.0%}",
            f"{mean('vectors_seen'):.0%}",
            f"{mean('step_ms'):.2f}",
            f"{mean('device_ms'):.1f}",
            f"{mean('wall_ms'):.1f}",
            ", ".join(f"{one['psnr']:.3f}" for one in found if "psnr" in one),
        ]
        print("| " + " | ".join(map(str, cells)) + " |")


if __name__ == "__main__":
    main()

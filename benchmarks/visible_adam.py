"""Effect of stepping only the splats that an image saw (TrainConfig.visible_adam); a JSON line a run.

    python benchmarks/visible_adam.py [--device 0:0] [--tasks wide train] [--splats 100000 1000000]
        [--scenes fox:2:20000 ...] [--options visible_adam=false visible_adam=true] [--iterations 1000] [--seeds 0 1]
    python benchmarks/visible_adam.py --table                # print the finished runs, run nothing
    python benchmarks/visible_adam.py --smoke --scenes NAME:1:60 --out FILE

`wide`: cameras around a ball of random splats; each sees about an eighth of them. 40 iterations learn nothing useful,
with the splats in Morton order. `train`: SCENE:REDUCTION:CAP from the points on, with every 7th
training view held out; choices are made on their PSNR. Times are medians of the device's clock at full size, except
`wall`. A vector holds as many splats as the schedule has lanes. `splats seen` and `vectors seen` are the shares that
the image saw, as means over the measured iterations. A finished run of this commit, device and schedule is skipped.
`load` is the machine's one-minute load at the start.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from dataclasses import replace
from typing import Any

import common
import numpy as np

KEY = ("task", "scene", "splats", "shape", "options", "seed", "iterations", "platform", "schedule", "commit")
CASE = tuple(name for name in KEY if name not in ("seed", "commit"))  # a line of the table
MEASURED = ("splats_seen", "vectors_seen", "step_ms", "device_ms", "wall_ms")
LENS = 3.7  # times the focal length of synthetic_scene
MEASURED_EVERY = 7  # iterations: prime to the number of views, so that images and stages of the run vary


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "visible_adam.jsonl")
    parser.add_argument("--tasks", nargs="+", default=["wide", "train"], choices=["wide", "train"])
    parser.add_argument("--options", nargs="+", default=["visible_adam=false", "visible_adam=true"])
    parser.add_argument("--splats", nargs="+", type=int, default=[100_000, 1_000_000], help="of the wide scene")
    parser.add_argument(
        "--scenes", nargs="+", default=["fox:2:20000", "fox:4:5000", "kitchen:-1:20000", "sceaux_castle:-1:18000"]
    )
    parser.add_argument("--shapes", nargs="+", default=["skew-normal"])
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    args = parser.parse_args()
    if args.smoke:
        args.splats, args.seeds, args.iterations = [300], [0], 8
    runs = common.Runs(args.out, KEY)
    for case in cases(args) if not args.table else ():
        train(runs, case, args)
    print_table(runs.rows)


def cases(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the cases, each with the values of KEY that the command line sets, and "resolution"."""
    wide = [("wide", "wide", -1, n, 0, 8 if args.smoke else 40) for n in args.splats]
    real = []
    for place in args.scenes:
        name, resolution, cap = place.split(":")
        real += [("train", name, int(resolution), int(cap), seed, args.iterations) for seed in args.seeds]
    names = ("task", "scene", "resolution", "splats", "seed", "iterations")
    return [
        dict(zip(names, values, strict=True)) | {"shape": shape, "options": options}
        for shape in args.shapes
        for task in args.tasks
        for values in (wide if task == "wide" else real)
        for options in args.options
    ]


def train(runs: common.Runs, case: dict[str, Any], args: argparse.Namespace) -> None:
    """Train once and append the line, unless the run is finished."""
    from clsplat.comparison.methods import parse_methods
    from clsplat.device.device import open_device
    from clsplat.rendering.tuning import schedule_for
    from clsplat.training.trainer import Trainer

    device, load = open_device(args.device), common.load_average()
    resolution, iterations = case.pop("resolution"), case["iterations"]
    case |= common.environment(device, schedule_for(device))
    if case in runs:
        return
    (method,) = parse_methods(f"{case['shape']}:{case['options']}" if case["options"] else case["shape"])
    with tempfile.TemporaryDirectory() as folder:
        fixed: dict[str, Any] = {"iterations": iterations}
        if case["task"] == "wide":  # as in the middle of a long run: full size, all bands, no action of the strategy
            size = (64, 48) if args.smoke else (640, 480)
            scene, start = wide_scene(case["splats"], case["shape"], size)
            fixed |= {"iterations": 30_000, "sh_interval": 1, "coarse_to_fine": False, "init": f"{folder}/start.ply"}
            start.save(fixed["init"])
        else:
            scene = common.real_scene(case["scene"], resolution, validate=True)
        trainer = Trainer(scene, method.config(case["splats"], case["seed"], fixed), device=device)
        measured = measure(trainer, iterations)
    if case["task"] == "train":
        measured |= {"psnr": trainer.evaluate(scene.test).psnr, "end": trainer.splats.n}
    runs.add(case | {"load": load} | measured)
    print(*(f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in (case | measured).items()), flush=True)


def measure(trainer: Any, iterations: int) -> dict[str, Any]:
    """Train, and measure every MEASURED_EVERY-th iteration closely."""
    from clsplat.device.memory import to_host
    from clsplat.device.trace import recorded
    from clsplat.profiling.stages import by_stage

    lanes, seconds = trainer.kernels.lanes, 0.0
    trainer.step()  # builds the kernels
    trainer.device.finish()
    stages: dict[str, list[float]] = {"step": [], "device": []}
    splats_seen, seen = [], []
    for iteration in range(2, iterations + 1):
        start = time.perf_counter()
        if iteration % MEASURED_EVERY:
            frame = trainer.step()
        else:
            with recorded(trainer.device) as launches:
                frame = trainer.step()
            trainer.device.finish()
            ms = {"step": 0.0, "strategy": 0.0, "device": 0.0}
            for stage, launch in by_stage(launches):
                ms[stage] = ms.get(stage, 0.0) + launch.ms
                ms["device"] += launch.ms
            for name, times in stages.items():
                times.append(ms[name])
        if iteration == iterations:
            trainer.device.finish()
        seconds += time.perf_counter() - start
        if iteration % MEASURED_EVERY == 0:
            n = frame.n_splats
            keys = np.full(-(-n // lanes) * lanes, 0xFFFFFFFF, np.uint32)
            to_host(trainer.device, frame.projected.depth_key, keys[:n])
            visible = keys != 0xFFFFFFFF
            splats_seen.append(visible.sum() / n)
            seen.append(visible.reshape(-1, lanes).any(axis=1).mean())
    # Images are at full size in the second half of a run.
    late = {name: statistics.median(times[len(times) // 2 :]) for name, times in stages.items()}
    return {
        "splats_seen": float(np.mean(splats_seen)),
        "vectors_seen": float(np.mean(seen)),
        "step_ms": late["step"],
        "device_ms": late["device"],
        "wall_ms": 1e3 * seconds / (iterations - 1),
    }


def wide_scene(n: int, shape: str, size: tuple[int, int]) -> Any:
    """Return a synthetic scene with long lenses, and its splats in Morton order."""
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
    """Print a line for each case: means over its seeds."""
    head = ["scene", "splats", "shape", "options", "platform", "load", "seeds", "splats seen", "vectors seen"]
    head += ["step [ms]", "device [ms]", "wall [ms]", "PSNR [dB]"]
    lines = []
    for runs in common.groups(rows, *CASE).values():
        last = runs[-1]
        mean = {name: statistics.mean(run[name] for run in runs) for name in MEASURED}
        line = [last["scene"], last.get("end", last["splats"]), last["shape"], last["options"]]
        line += [last["platform"].split()[0], f"{statistics.mean(run['load'] for run in runs):.1f}", len(runs)]
        line += [f"{mean['splats_seen']:.0%}", f"{mean['vectors_seen']:.0%}", f"{mean['step_ms']:.2f}"]
        line += [f"{mean['device_ms']:.1f}", f"{mean['wall_ms']:.1f}"]
        lines.append([*line, ", ".join(f"{run['psnr']:.3f}" for run in runs if "psnr" in run)])
    print(common.table(head, lines))


if __name__ == "__main__":
    main()

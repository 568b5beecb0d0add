"""`--budget auto` on the real scenes, beside the sweep of caps of benchmarks/frontier.py; a line of JSON a search.

    python benchmarks/budget.py [--scenes fox kitchen sceaux_castle] [--shapes skew-normal gaussian] [--device 0:0]
        [--iterations 1000] [--cap 50000] [--tolerance 0.1] [--work DIR]
    python benchmarks/budget.py --table        # print what is there, run nothing
    python benchmarks/budget.py --smoke --scenes NAME --out DIR

Records have the keys of `clsplat compare`'s runs, with system "auto SHAPE", and "budget": what the search found. A
search that is there is not made again; one that was killed goes on at its last stage (in --work). Seconds are of the
whole search: growth, held-out run, rounds, refit. The table sets each search beside the best cap of the sweep for its
scene, shape and iterations, on test views, at which neither looked.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import common

from clsplat.comparison.compare import RUNS, RunFile, digest, scene_identity, warm_up
from clsplat.comparison.table import MEASURED, Record
from clsplat.compression.rules import BudgetOptions
from clsplat.compression.search import train_budget
from clsplat.compression.state import FILE
from clsplat.device.device import open_device
from clsplat.evaluation.evaluate import evaluate
from clsplat.evaluation.metrics import DEFAULT_PROTOCOL
from clsplat.rendering.renderer import Renderer
from clsplat.rendering.tuning import schedule_for
from clsplat.scenes.scene import load_scene
from clsplat.splats.shapes import SHAPES
from clsplat.training.config import TrainConfig
from clsplat.training.memory_estimate import peak_bytes

OUT = common.RESULTS / "budget"
RESOLUTION = {"fox": 2}  # of load_scene; others as they are
HEAD = (
    "scene",
    "shape",
    "system",
    "PSNR [dB]",
    "SSIM",
    "splats",
    "MB",
    "render ms",
    "seconds",
    "PSNR less best",
    "splats of best",
    "bytes of best",
    "time of best",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["fox", "kitchen", "sceaux_castle"])
    parser.add_argument("--shapes", nargs="+", default=["skew-normal", "gaussian"], choices=list(SHAPES))
    parser.add_argument("--device")
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--cap", type=int, default=50_000)
    parser.add_argument("--tolerance", type=float, default=0.1)
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "clsplat-budget")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--smoke", action="store_true")
    args = parser.parse_args()
    if args.smoke:
        args.shapes, args.iterations, args.cap, args.tolerance = ["skew-normal"], 8, 60, 1.0
    for name in args.scenes if not args.table else ():
        for shape in args.shapes:
            run(name, shape, args)
    print_table(common.read(args.out / RUNS), common.read(args.out.parent / "frontier" / RUNS))


def run(name: str, shape: str, args: argparse.Namespace) -> None:
    """One search; appends its line."""
    scene = load_scene(common.data_folder() / name, resolution=RESOLUTION.get(name, -1), eval=True)
    config = TrainConfig(shape=shape, iterations=args.iterations, cap_max=args.cap, device=args.device)
    options = BudgetOptions(args.tolerance)
    label = f"auto {shape}" + ("" if args.tolerance == BudgetOptions().tolerance else f" {args.tolerance:g} dB")
    runs, identity = RunFile(args.out), scene_identity(scene)
    if runs.find(identity, label, config) is not None:
        return
    device = open_device(args.device)
    warm_up(scene, config, device)
    work = args.work / f"{name}-{shape}-{args.iterations}-{args.cap}-{args.tolerance:g}"
    resume = (work / FILE).is_file()
    started = time.process_time()
    found = train_budget(
        scene,
        config,
        options,
        lambda progress: say(name, progress.message),
        output=work,
        resume=resume,
        overwrite=not resume,
    )
    cpu_seconds = time.process_time() - started
    measured = evaluate(Renderer(device), found.splats, scene.test, config.background)
    report, arrays = found.report, found.splats.arrays
    kept = {key: value for key, value in report.items() if key not in ("config", "options", "scene")}
    record: Record = dict.fromkeys(MEASURED) | {
        "scene": identity,
        "system": label,
        "config": config.to_json(),
        "failed": report["final"]["missed"],
        "finite": True,
        "cap_held": len(found.splats) <= args.cap,
        "device": str(device.info),
        "driver": f"{device.info.driver} ({device.info.version})",
        "schedule": str(schedule_for(device)),
        "protocol": DEFAULT_PROTOCOL.describe(),
        "psnr": measured.psnr,
        "ssim": measured.ssim,
        "render_ms": measured.render_ms,
        "seconds": found.seconds,
        "cpu_seconds": None if resume else cpu_seconds,
        "splats": len(found.splats),
        "bytes": found.path.stat().st_size,
        "parameters": report["final"]["parameters_in_use"],
        "device_bytes": 0,
        "peak_bytes": peak_bytes(),
        "digest": digest(arrays),
        "curve": None,
        "commit": common.commit(),
        "version": version(),
        "budget": {"options": asdict(options), **kept},
    }
    runs.add(record)


def version() -> str:
    import clsplat

    return clsplat.__version__


def say(scene: str, message: str) -> None:
    if message:
        print(f"{scene}: {message}", flush=True)


def best_of(record: Record, sweep: list[Record]) -> Record | None:
    """The run of the sweep with the highest PSNR for the same scene, shape and iterations."""
    same = [
        run
        for run in sweep
        if run["scene"] == record["scene"]
        and not run["failed"]
        and run["system"] == record["config"]["shape"]
        and run["config"]["iterations"] == record["config"]["iterations"]
    ]
    return max(same, key=lambda run: float(run["psnr"]), default=None)


def print_table(records: list[Record], sweep: list[Record]) -> None:
    """A line for each search, after that of the best cap where the sweep is there."""
    print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD))
    for record in records:
        best = best_of(record, sweep)
        shape, scene = record["config"]["shape"], record["scene"]["name"]
        if best is not None:
            line(scene, shape, f"best cap: {best['config']['cap_max']}", best, ("", "", "", ""))
        against: tuple[Any, ...] = ("", "", "", "")
        if best is not None:
            against = (
                f"{record['psnr'] - best['psnr']:+.2f}",
                *(f"{record[key] / best[key]:.0%}" for key in ("splats", "bytes")),
                f"{record['seconds'] / best['seconds']:.1f}",
            )
        line(scene, shape, record["system"], record, against)


def line(scene: str, shape: str, system: str, record: Record, against: tuple[Any, ...]) -> None:
    cells = (
        scene,
        shape,
        system,
        f"{record['psnr']:.2f}",
        f"{record['ssim']:.4f}",
        record["splats"],
        f"{record['bytes'] / 1e6:.2f}",
        f"{record['render_ms']:.1f}",
        f"{record['seconds']:.1f}",
        *against,
    )
    print("| " + " | ".join(map(str, cells)) + " |")


if __name__ == "__main__":
    main()

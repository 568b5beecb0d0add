"""`--budget auto` on the real scenes, beside the sweep of caps of benchmarks/frontier.py; a line of JSON a search.

    python benchmarks/budget.py [--scenes fox kitchen sceaux_castle] [--shapes skew-normal gaussian] [--device 0:0]
        [--iterations 1000] [--cap 50000] [--tolerance 0.1] [--work DIR]
    python benchmarks/budget.py --table        # print the finished searches, run nothing
    python benchmarks/budget.py --smoke --scenes NAME --out DIR

Records have the keys of `clsplat compare`'s runs, with system "auto SHAPE", and "budget": the report of the search. A
finished search is not repeated. A search that was killed continues after its last finished stage (in --work). Seconds
are those of the whole search: growth, held-out run, rounds, refit. The table shows each search beside the best cap of
the sweep for its scene, shape and iterations. Both are measured on test views, and neither was chosen on them.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import common

from clsplat.comparison.measure import empty_record, measure_model, warm_up
from clsplat.comparison.runs import RUNS, RunFile, scene_identity
from clsplat.comparison.table import Record
from clsplat.compression.rules import BudgetOptions
from clsplat.compression.search import train_budget
from clsplat.compression.state import FILE
from clsplat.device.device import open_device
from clsplat.files.host_memory import peak_bytes
from clsplat.rendering.renderer import Renderer
from clsplat.rendering.tuning import schedule_for
from clsplat.splats.shapes import SHAPES
from clsplat.training.config import TrainConfig

OUT = common.RESULTS / "budget"
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
    parser = common.parser(__doc__, OUT)
    parser.add_argument("--scenes", nargs="+", default=["fox", "kitchen", "sceaux_castle"])
    parser.add_argument("--shapes", nargs="+", default=["skew-normal", "gaussian"], choices=list(SHAPES))
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--cap", type=int, default=50_000)
    parser.add_argument("--tolerance", type=float, default=0.1)
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "clsplat-budget")
    args = parser.parse_args()
    if args.smoke:
        args.shapes, args.iterations, args.cap, args.tolerance = ["skew-normal"], 8, 60, 1.0
    for name in args.scenes if not args.table else ():
        for shape in args.shapes:
            search(name, shape, args)
    print_table(common.read(args.out / RUNS), common.read(args.out.parent / "frontier" / RUNS))


def search(name: str, shape: str, args: argparse.Namespace) -> None:
    """Run one search and append its line."""
    scene = common.real_scene(name)
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
    result = train_budget(
        scene,
        config,
        options,
        lambda progress: print_message(name, progress.message),
        output=work,
        resume=resume,
        overwrite=not resume,
    )
    cpu_seconds = time.process_time() - started
    report = {key: value for key, value in result.report.items() if key not in ("config", "options", "scene")}
    record = empty_record(device, schedule_for(device))
    record |= measure_model(Renderer(device), result.splats, result.path, scene, config)
    record |= {
        "scene": identity,
        "system": label,
        "config": config.to_json(),
        "failed": report["final"]["missed"],
        "seconds": result.seconds,
        "cpu_seconds": None if resume else cpu_seconds,
        "parameters": report["final"]["parameters_in_use"],  # a compact file leaves out neutral ones
        "device_bytes": 0,
        "peak_bytes": peak_bytes(),
        "commit": common.commit(),
        "budget": {"options": asdict(options), **report},
    }
    runs.add(record)


def print_message(scene: str, message: str) -> None:
    """Print a stage of a search."""
    if message:
        print(f"{scene}: {message}", flush=True)


def best_of(record: Record, sweep: list[Record]) -> Record | None:
    """Return the run of the sweep with the highest PSNR for the same scene, shape and iterations."""
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
    """Print a line for each search, after the line of the best cap if the sweep is there."""
    lines = []
    for record in records:
        best, against = best_of(record, sweep), ("", "", "", "")
        if best is not None:
            lines.append(cells(best, record, f"best cap: {best['config']['cap_max']}", against))
            against = (
                f"{record['psnr'] - best['psnr']:+.2f}",
                f"{record['splats'] / best['splats']:.0%}",
                f"{record['bytes'] / best['bytes']:.0%}",
                f"{record['seconds'] / best['seconds']:.1f}",
            )
        lines.append(cells(record, record, record["system"], against))
    print(common.table(HEAD, lines))


def cells(run: Record, searched: Record, system: str, against: tuple[str, ...]) -> list[object]:
    """Return the cells of a run, which stands in the lines of the search `searched`."""
    return [
        searched["scene"]["name"],
        searched["config"]["shape"],
        system,
        f"{run['psnr']:.2f}",
        f"{run['ssim']:.4f}",
        run["splats"],
        f"{run['bytes'] / 1e6:.2f}",
        f"{run['render_ms']:.1f}",
        f"{run['seconds']:.1f}",
        *against,
    ]


if __name__ == "__main__":
    main()

"""Time of each stage of a training step and of an image, beside limits measured in the same run; a JSON line a case.

    python benchmarks/stages.py                               # synthetic 10k to 1M splats, and the real scenes
    python benchmarks/stages.py --splats 30000 --scenes --shapes gaussian [--width 640 --height 480] [--iterations 20]
    python benchmarks/stages.py --table                       # print the finished cases, run nothing
    python benchmarks/stages.py --against other.jsonl         # print ratios of their times to those of another file
    python benchmarks/stages.py --smoke --out FILE            # a few seconds, for tests

Real scenes have full size (at most 1600 px wide) and start from their points. Synthetic ones have about the same number
of useful pairs a pixel at every count (clsplat/scenes/random_scene.py). A finished case of this commit and device is
skipped: kill and restart at will. Times are medians of the device's clock, except `wall`, `host` and `strategy`. `load`
is the machine's one-minute load at the start of a case: the numbers mean little if others were at work.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import common

CASE = ("scene", "splats", "shape", "width", "height")
PLACE = ("device", "platform", "schedule", "commit")
SPLATS = (10_000, 30_000, 100_000, 300_000, 1_000_000)
SCENES = ("fox", "sceaux_castle", "kitchen")
SYNTHETIC = "synthetic"


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "stages.jsonl")
    parser.add_argument("--splats", nargs="*", type=int, default=SPLATS, help="of synthetic scenes")
    parser.add_argument("--scenes", nargs="*", default=SCENES, help="real scenes, of the data folder")
    parser.add_argument("--shapes", nargs="+", default=["gaussian", "skew-normal"])
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument("--against", type=Path, metavar="OTHER.jsonl")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        run(json.loads(args.one), args.device, args.iterations, args.out)
        return
    if args.against and not args.against.is_file():
        parser.error(f"{args.against}: no such file")
    if not args.table and not args.against:
        for case in cases(args):
            start = [sys.executable, __file__, "--out", str(args.out), "--iterations", str(args.iterations)]
            if args.smoke:  # all cases in this process
                run(case, args.device, 2, args.out, limits={"repeats": 1, "nbytes": 1 << 20})
            else:  # a process for each case, so that the peak memory is that of the case
                device = ["--device", args.device] if args.device else []
                subprocess.run([*start, *device, "--one", json.dumps(case)], check=True)
    rows = common.read(args.out)
    if args.against:
        print_ratios(rows, common.read(args.against))
    else:
        print_table(rows)


def cases(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the cases; the count and the size of real scenes are known only when they are read."""
    if args.smoke:
        return [dict(zip(CASE, (SYNTHETIC, 500, shape, 64, 48), strict=True)) for shape in args.shapes]
    made_up = [(SYNTHETIC, n, shape, args.width, args.height) for n in args.splats for shape in args.shapes]
    real = [(scene, None, shape, None, None) for scene in args.scenes for shape in args.shapes]
    return [dict(zip(CASE, values, strict=True)) for values in (*made_up, *real)]


def run(
    case: dict[str, Any], device_name: str | None, iterations: int, out: Path, limits: dict[str, int] | None = None
) -> None:
    """Measure one case and append its line, unless it is finished. limits : options of `measure_roofline`."""
    from clsplat.device.device import open_device
    from clsplat.files.host_memory import peak_bytes
    from clsplat.profiling.bench import bench_trainer, measure_render, measure_training
    from clsplat.profiling.roofline import measure_roofline
    from clsplat.rendering.tuning import schedule_for
    from clsplat.scenes.random_scene import synthetic_scene
    from clsplat.scenes.scene import load_scene

    device, load = open_device(device_name), common.load_average()
    environment = common.environment(device, schedule_for(device))
    if case["scene"] != SYNTHETIC:
        scene = load_scene(common.data_folder() / case["scene"], eval=False)
        start = len(scene.points)
        largest = max(scene.cameras, key=lambda camera: camera.width * camera.height)
        case |= {"splats": start, "width": largest.width, "height": largest.height}
    runs = common.Runs(out, (*CASE, *PLACE))
    if (case | environment) in runs:
        return
    if case["scene"] == SYNTHETIC:
        scene, start = synthetic_scene(case["splats"], case["width"], case["height"], case["shape"])
    trainer = bench_trainer(scene, device, case["shape"], start)
    measured = measure_roofline(device, **limits or {})
    reports = [measure(trainer, measured, iterations) for measure in (measure_training, measure_render)]
    row = (
        case
        | environment
        | {
            "load": load,
            "copy_bytes_per_s": measured.copy,
            "fma_flops_per_s": measured.fma,
            "peak_mb": peak_bytes() / 1e6,
            "reports": [report.to_json() for report in reports],
        }
    )
    runs.add(row)
    print(" ".join(str(case[name]) for name in CASE), *(f"{r.task} {r.wall_ms:.1f} ms" for r in reports), flush=True)


def print_table(rows: list[dict[str, Any]]) -> None:
    """Print a line for each case and task: size, wall time, and each stage's time as a fraction of its limit."""
    stages = _stage_names(rows)
    head = ["scene", "size", "splats", "shape", "device", "load", "task", "useful pairs", "isects", "wall [ms]"]
    lines = []
    for row in rows:
        case = [row["scene"], f"{row['width']}x{row['height']}", row["splats"], row["shape"]]
        case += [f"{row['platform'].split()[0]} {row['schedule']}", f"{row['load']:.1f}"]
        for report in row["reports"]:
            sizes, by_name = report["sizes"], {stage["stage"]: stage for stage in report["stages"]}
            line = [*case, report["task"], f"{1e-6 * sizes['pairs']:.2f} M", sizes["isects"]]
            lines.append([*line, f"{report['wall_ms']:.2f}", *(_cell(by_name.get(name)) for name in stages)])
    print(common.table([*head, *stages], lines))


def print_ratios(rows: list[dict[str, Any]], others: list[dict[str, Any]]) -> None:
    """Print the ratios of times to the last line of the same case, platform and schedule in another file, by stage."""
    others_by_place = {_place(row): row for row in others}
    stages = _stage_names(rows)
    lines = []
    for place, row in {_place(row): row for row in rows}.items():
        if place not in others_by_place:
            continue
        for report, other in zip(row["reports"], others_by_place[place]["reports"], strict=False):
            ms, other_ms = ({stage["stage"]: stage["ms"] for stage in r["stages"]} for r in (report, other))
            ratios = [f"{ms[s] / other_ms[s]:.2f}" if s in ms and other_ms.get(s) else "" for s in stages]
            line = [row["scene"], row["splats"], row["shape"], row["platform"].split()[0], report["task"]]
            lines.append([*line, f"{report['wall_ms'] / other['wall_ms']:.2f}", *ratios])
    print(common.table(["scene", "splats", "shape", "platform", "task", "wall", *stages], lines))


def _stage_names(rows: list[dict[str, Any]]) -> list[str]:
    """Return the names of all stages, in order of appearance."""
    return list(dict.fromkeys(s["stage"] for row in rows for report in row["reports"] for s in report["stages"]))


def _place(row: dict[str, Any]) -> tuple[Any, ...]:
    """Return the case with its platform and schedule."""
    return (*(row[name] for name in CASE), row["platform"], row["schedule"])


def _cell(stage: dict[str, Any] | None) -> str:
    """Return a stage's time with its larger fraction of a limit: "12.3 (31 % FMA)"."""
    if stage is None:
        return ""
    limits = {"FMA": stage["of_fma"] or 0.0, "copy": stage["of_copy"] or 0.0}
    name = max(limits, key=limits.__getitem__)
    return f"{stage['ms']:.2f}" + (f" ({100 * limits[name]:.0f} % {name})" if limits[name] else "")


if __name__ == "__main__":
    main()

"""Train shapes x caps x iterations x seeds on the real scenes, hold out every 8th view, write one JSON line a run.

    python benchmarks/train_scenes.py --scenes fox kitchen --shapes gaussian skew-normal --caps 5000 20000 \\
        --iterations 2000 --seeds 0 1 2 [--out benchmarks/results/scenes.jsonl]
    python benchmarks/train_scenes.py --table                 # print the finished runs, run nothing
    python benchmarks/train_scenes.py --pairs                 # print them in pairs, gaussian beside skew-normal

A finished run is skipped: kill and restart at will. Test views are measured along the run for the time-to-quality
columns; nothing is selected on them. `seconds` is wall time of training alone, on a machine that others may share
(`load`: its five-minute load at the end). `CPU s` counts all cores, with evaluations and start-up.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import common
import numpy as np

LEVELS_DB = (16, 18, 20, 22, 24)
MARKS = 8  # evaluations along a run
KEY = ("scene", "shape", "cap", "iterations", "seed", "label")


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "scenes.jsonl", device=False, smoke=False)
    parser.add_argument("--scenes", nargs="+", default=["fox", "sceaux_castle", "kitchen"])
    parser.add_argument("--shapes", nargs="+", default=["gaussian", "skew-normal"])
    parser.add_argument("--caps", nargs="+", type=int, default=[5000, 20000])
    parser.add_argument("--iterations", nargs="+", type=int, default=[2000])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--option", action="append", default=[], help="NAME=VALUE of TrainConfig, part of the label")
    parser.add_argument("--models", type=Path, help="keep the trained models here")
    parser.add_argument("--pairs", action="store_true", help="print gaussian beside skew-normal, run nothing")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    runs = common.Runs(args.out, KEY)
    if args.table or args.pairs:
        (print_pairs if args.pairs else print_table)(runs.rows)
        return
    label = " ".join(args.option)
    for values in itertools.product(args.scenes, args.caps, args.iterations, args.seeds, args.shapes):
        key = dict(zip(("scene", "cap", "iterations", "seed", "shape"), values, strict=True)) | {"label": label}
        if key in runs:
            continue
        if args.one:
            run(runs, key, args.option, args.models)
        else:  # a process for each run, so that the peak memory is that of the run
            command = [sys.executable, __file__, "--one", "--out", str(args.out)]
            command += ["--models", str(args.models)] if args.models else []
            for option in args.option:
                command += ["--option", option]
            for name in ("scene", "shape", "cap", "seed"):
                command += [f"--{name}s", str(key[name])]
            subprocess.run([*command, "--iterations", str(key["iterations"])], check=True)
    if not args.one:
        print_table(runs.rows)


def run(runs: common.Runs, key: dict[str, Any], options: list[str], models: Path | None) -> None:
    """Train once and append the line."""
    import clsplat
    from clsplat.device.device import open_device
    from clsplat.rendering.tuning import schedule_for
    from clsplat.training.config import TrainConfig

    n = key["iterations"]
    marks = tuple(sorted({max(n * i // MARKS, 1) for i in range(1, MARKS + 1)}))
    defaults = {
        "shape": key["shape"],
        "cap_max": key["cap"],
        "iterations": n,
        "seed": key["seed"],
        "test_iterations": marks,
    }
    config = TrainConfig(**(defaults | {k: _value(v) for k, v in (o.split("=", 1) for o in options)}))
    scene = clsplat.load_scene(common.data_folder() / key["scene"])
    device = open_device(config.device)
    schedule = schedule_for(device)  # measured before the clock starts
    folder = models and models / "-".join(str(key[k]) for k in KEY if key[k] != "")
    cpu = time.process_time()
    model = clsplat.train(scene, config, output=folder, overwrite=True)
    cpu = time.process_time() - cpu
    last = model.evaluations[n]
    skew = np.linalg.norm(model.splats.skew, axis=1)
    row = key | {
        "psnr": last.psnr,
        "ssim": last.ssim,
        "per_view": last.per_view,
        "seconds": model.seconds,
        "cpu_seconds": cpu,
        "load": common.load_average(5),
        "splats": len(model.splats),
        "peak_mb": model.peak_bytes / 1e6,
        "render_ms": last.render_ms,
        "along": [
            [it, round(model.evaluation_seconds[it], 2), round(e.psnr, 3)]
            for it, e in sorted(model.evaluations.items())
        ],
        "skew_quantiles": [round(float(q), 3) for q in np.quantile(skew, (0.1, 0.25, 0.5, 0.75, 0.9))],
        "skewed_share": float(np.mean(skew > 0.5)),
    }
    runs.add(row | common.environment(device, schedule))
    print(f"{key} {last.psnr:.3f} dB SSIM {last.ssim:.4f} {model.seconds:.0f} s", flush=True)


def print_table(rows: list[dict[str, Any]]) -> None:
    """Print the mean over the seeds of each configuration, and its spread (maximum less minimum)."""
    head = ["scene", "shape", "cap", "iterations", "options", "seeds", "PSNR [dB]", "spread", "SSIM", "seconds"]
    head += ["CPU s", "peak MB", "render ms", "skewed", *(f"s to {db} dB" for db in LEVELS_DB)]
    lines = []
    for key, runs in sorted(common.groups(rows, *(name for name in KEY if name != "seed")).items()):
        psnr = [run["psnr"] for run in runs]
        line = [*key, len(runs), f"{statistics.fmean(psnr):.2f}", f"{max(psnr) - min(psnr):.2f}"]
        line.append(f"{_mean(runs, 'ssim'):.4f}")
        line += [f"{_mean(runs, name):.0f}" for name in ("seconds", "cpu_seconds", "peak_mb", "render_ms")]
        line.append("" if runs[0]["shape"] == "gaussian" else f"{100 * _mean(runs, 'skewed_share'):.0f} %")
        lines.append([*line, *(_seconds_to(runs, db) for db in LEVELS_DB)])
    print(common.table(head, lines))


def print_pairs(rows: list[dict[str, Any]]) -> None:
    """Print gaussian beside skew-normal at equal splats, iterations and seeds, and the mean difference of the pairs."""
    head = ["scene", "splats", "iterations", "seeds", "gaussian PSNR / SSIM", "skew-normal PSNR / SSIM"]
    head += ["difference [dB]", "CPU s", "render ms"]
    skewed = {tuple(row[name] for name in KEY if name != "shape"): row for row in rows if row["shape"] == "skew-normal"}
    pairs: dict[tuple[Any, ...], list[tuple[dict[str, Any], dict[str, Any]]]] = {}
    for row in rows:
        other = skewed.get(tuple(row[name] for name in KEY if name != "shape"))
        if row["shape"] == "gaussian" and other is not None:
            pairs.setdefault((row["scene"], row["cap"], row["iterations"], row["label"]), []).append((row, other))
    lines = []
    for (scene, cap, iterations, label), members in sorted(pairs.items()):
        sides = [[pair[side] for pair in members] for side in (0, 1)]
        gain = [b["psnr"] - a["psnr"] for a, b in members]
        spread = f" ({min(gain):+.2f} to {max(gain):+.2f})" if len(gain) > 1 else ""
        line = [scene, cap, f"{iterations} {label}".strip(), len(members)]
        line += [f"{_mean(runs, 'psnr'):.2f} / {_mean(runs, 'ssim'):.4f}" for runs in sides]
        line.append(f"{statistics.fmean(gain):+.2f}{spread}")
        line += [" / ".join(f"{_mean(runs, name):.0f}" for runs in sides) for name in ("cpu_seconds", "render_ms")]
        lines.append(line)
    print(common.table(head, lines))


def _seconds_to(runs: list[dict[str, Any]], level: float) -> str:
    """Return the median time until the mean test PSNR first reached `level`; "" if a run never did."""
    times = [next((s for _, s, p in r["along"] if p >= level), None) for r in runs]
    if None in times:
        return ""
    return f"{statistics.median(times):.0f}"


def _mean(runs: list[dict[str, Any]], field: str) -> float:
    """Return the mean of a field over runs."""
    return statistics.fmean(r[field] for r in runs)


def _value(text: str) -> Any:
    """Return the value of an option: a number, true, false or text."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return {"true": True, "false": False}.get(text.lower(), text)


if __name__ == "__main__":
    main()

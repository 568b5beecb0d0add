"""Train shapes x caps x iterations x seeds on the real scenes, hold out every 8th view, write one JSON line a run.

    python benchmarks/train_scenes.py --scenes fox kitchen --shapes gaussian skew-normal --caps 5000 20000 \\
        --iterations 2000 --seeds 0 1 2 [--out benchmarks/results/scenes.jsonl]
    python benchmarks/train_scenes.py --table                 # print what is there, run nothing
    python benchmarks/train_scenes.py --pairs                 # likewise, gaussian beside skew-normal

A run that is in the file already is skipped: kill and restart at will. Test views are measured along the run for the
time-to-quality columns; nothing is selected on them. `seconds` is wall time of training alone, on a machine that others
may share (`load`: its five-minute load at the end); `CPU s` counts both cores, evaluations and start-up included.
"""

from __future__ import annotations

import argparse
import itertools
import os
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["fox", "sceaux_castle", "kitchen"])
    parser.add_argument("--shapes", nargs="+", default=["gaussian", "skew-normal"])
    parser.add_argument("--caps", nargs="+", type=int, default=[5000, 20000])
    parser.add_argument("--iterations", nargs="+", type=int, default=[2000])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--option", action="append", default=[], help="NAME=VALUE of TrainConfig, part of the label")
    parser.add_argument("--out", type=Path, default=common.RESULTS / "scenes.jsonl")
    parser.add_argument("--models", type=Path, help="keep the trained models here")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--pairs", action="store_true")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.table or args.pairs:
        (print_pairs if args.pairs else print_table)(common.read(args.out))
        return
    label = " ".join(args.option)
    for scene, cap, iterations, seed, shape in itertools.product(
        args.scenes, args.caps, args.iterations, args.seeds, args.shapes
    ):
        key = dict(zip(KEY, (scene, shape, cap, iterations, seed, label), strict=True))
        if any(all(row[k] == v for k, v in key.items()) for row in common.read(args.out)):
            continue
        if args.one:
            run(key, args.option, args.out, args.models)
        else:  # a process of its own: peak memory is then the run's
            command = [
                sys.executable,
                __file__,
                "--one",
                "--scenes",
                scene,
                "--shapes",
                shape,
                "--caps",
                str(cap),
                "--iterations",
                str(iterations),
                "--seeds",
                str(seed),
                "--out",
                str(args.out),
            ]
            for option in args.option:
                command += ["--option", option]
            subprocess.run(command + (["--models", str(args.models)] if args.models else []), check=True)
    if not args.one:
        print_table(common.read(args.out))


def run(key: dict[str, Any], options: list[str], out: Path, models: Path | None) -> None:
    """One training; appends its line."""
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
        "load": os.getloadavg()[1],
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
    common.append(out, row | common.environment(device, schedule))
    print(f"{key} {last.psnr:.3f} dB SSIM {last.ssim:.4f} {model.seconds:.0f} s", flush=True)


def print_table(rows: list[dict[str, Any]]) -> None:
    """Mean over seeds of each configuration, and its spread (max - min)."""
    titles = [
        "scene",
        "shape",
        "cap",
        "iterations",
        "options",
        "seeds",
        "PSNR [dB]",
        "spread",
        "SSIM",
        "seconds",
        "CPU s",
        "peak MB",
        "render ms",
        "skewed",
        *(f"s to {db} dB" for db in LEVELS_DB),
    ]
    print("| " + " | ".join(titles) + " |\n|" + "---|" * len(titles))
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[k] for k in KEY if k != "seed"), []).append(row)
    for (scene, shape, cap, iterations, label), runs in sorted(groups.items()):
        psnr = [r["psnr"] for r in runs]
        cells = [
            scene,
            shape,
            cap,
            iterations,
            label,
            len(runs),
            f"{statistics.fmean(psnr):.2f}",
            f"{max(psnr) - min(psnr):.2f}",
            f"{_mean(runs, 'ssim'):.4f}",
            f"{_mean(runs, 'seconds'):.0f}",
            f"{_mean(runs, 'cpu_seconds'):.0f}",
            f"{_mean(runs, 'peak_mb'):.0f}",
            f"{_mean(runs, 'render_ms'):.0f}",
            f"{100 * _mean(runs, 'skewed_share'):.0f} %" if shape != "gaussian" else "",
        ]
        cells += [_seconds_to(runs, db) for db in LEVELS_DB]
        print("| " + " | ".join(str(c) for c in cells) + " |")


def print_pairs(rows: list[dict[str, Any]]) -> None:
    """Gaussian beside skew-normal at equal splats, iterations and seeds; difference: mean of the paired runs."""
    titles = [
        "scene",
        "splats",
        "iterations",
        "seeds",
        "gaussian PSNR / SSIM",
        "skew-normal PSNR / SSIM",
        "difference [dB]",
        "CPU s",
        "render ms",
    ]
    print("| " + " | ".join(titles) + " |\n|" + "---|" * len(titles))
    by_key = {tuple(row[k] for k in KEY): row for row in rows}
    groups: dict[tuple[Any, ...], list[tuple[dict[str, Any], dict[str, Any]]]] = {}
    for row in rows:
        other = by_key.get(tuple("skew-normal" if k == "shape" else row[k] for k in KEY))
        if row["shape"] == "gaussian" and other is not None:
            groups.setdefault((row["scene"], row["cap"], row["iterations"], row["label"]), []).append((row, other))
    for (scene, cap, iterations, label), pairs in sorted(groups.items()):
        sides = [[pair[side] for pair in pairs] for side in (0, 1)]
        gain = [b["psnr"] - a["psnr"] for a, b in pairs]
        spread = f" ({min(gain):+.2f} to {max(gain):+.2f})" if len(gain) > 1 else ""
        cells = [
            scene,
            cap,
            f"{iterations} {label}".strip(),
            len(pairs),
            *(f"{_mean(runs, 'psnr'):.2f} / {_mean(runs, 'ssim'):.4f}" for runs in sides),
            f"{statistics.fmean(gain):+.2f}{spread}",
            " / ".join(f"{_mean(runs, 'cpu_seconds'):.0f}" for runs in sides),
            " / ".join(f"{_mean(runs, 'render_ms'):.0f}" for runs in sides),
        ]
        print("| " + " | ".join(str(c) for c in cells) + " |")


def _seconds_to(runs: list[dict[str, Any]], level: float) -> str:
    """Median time until the mean test PSNR first reached `level`."""
    times = [next((s for _, s, p in r["along"] if p >= level), None) for r in runs]
    found = [t for t in times if t is not None]
    return f"{statistics.median(found):.0f}" if len(found) == len(times) else ""


def _mean(runs: list[dict[str, Any]], field: str) -> float:
    return statistics.fmean(r[field] for r in runs)


def _value(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return {"true": True, "false": False}.get(text.lower(), text)


if __name__ == "__main__":
    main()

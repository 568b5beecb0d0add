"""Wall time of whole processes: `clsplat --help`, and `clsplat render` of one view; a JSON line a case.

    python benchmarks/startup.py [--device 0:0] [--runs 5] [--splats 20000 --width 640 --height 480]
    python benchmarks/startup.py --table                      # print the finished runs, run nothing
    python benchmarks/startup.py --smoke --out FILE           # a few seconds, for tests

A render is of a synthetic model, in three states of the caches. `warm`: an earlier process has built everything.
`cold`: empty folders, the schedule known. `first`: empty folders and no schedule, as for the first command after
installing, which also measures the device. Caches are those of clsplat, PoCL and CUDA, in folders of this script.
Times are medians.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import common

STATES = ("warm", "cold", "first")
SMOKE = {"runs": 1, "splats": 50, "width": 32, "height": 16, "shapes": ["gaussian"], "states": ["warm"]}


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "startup.jsonl")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--shapes", nargs="+", default=["gaussian", "skew-normal"])
    parser.add_argument("--states", nargs="+", choices=STATES, default=STATES)
    args = parser.parse_args()
    if args.smoke:
        vars(args).update(SMOKE)
    if not args.table:
        with tempfile.TemporaryDirectory() as folder:
            measure(args, Path(folder))
    print_table(common.read(args.out))


def measure(args: argparse.Namespace, folder: Path) -> None:
    """Measure all cases and append a line for each."""
    from clsplat.cameras.cameras_json import NamedCamera, write_cameras
    from clsplat.device.device import open_device
    from clsplat.rendering.tuning import schedule_for
    from clsplat.scenes.random_scene import synthetic_scene

    device = open_device(args.device)
    schedule = schedule_for(device)
    row = common.environment(device, schedule) | {"runs": args.runs, "load": common.load_average()}
    command = common.CLSPLAT
    append(args.out, row | {"task": "--help", "caches": ""}, [seconds([*command, "--help"]) for _ in range(args.runs)])
    for shape in args.shapes:
        scene, splats = synthetic_scene(args.splats, args.width, args.height, shape)
        model, cameras = folder / f"{shape}.ply", folder / "cameras.json"
        splats.save(model)
        write_cameras(cameras, [NamedCamera("view", scene.cameras[0])])
        render = [
            *command,
            "render",
            str(model),
            "--cameras",
            str(cameras),
            "-o",
            str(folder / "images"),
            "--quiet",
            "--overwrite",
            "--device",
            device.info.index,
        ]
        case = row | {
            "task": "render",
            "shape": shape,
            "splats": args.splats,
            "width": args.width,
            "height": args.height,
        }
        for state in args.states:
            times = [
                seconds(render, caches(folder / "caches", state, str(schedule), index))
                for index in range(args.runs + (state == "warm"))
            ]
            append(args.out, case | {"caches": state}, times[-args.runs :])  # the first warm run only fills the caches


def caches(folder: Path, state: str, schedule: str, index: int) -> dict[str, str]:
    """Return the environment variables of the `index`th run in a state; its folders are made, and emptied if needed."""
    if state != "warm" or index == 0:
        shutil.rmtree(folder, ignore_errors=True)
    names = ("XDG_CACHE_HOME", "LOCALAPPDATA", "POCL_CACHE_DIR", "CUDA_CACHE_PATH")
    for name in names:
        (folder / name).mkdir(parents=True, exist_ok=True)
    return {name: str(folder / name) for name in names} | {"CLSPLAT_SCHEDULE": "" if state == "first" else schedule}


def seconds(command: list[str], variables: dict[str, str] | None = None) -> float:
    """Return the wall time of a process, which must succeed."""
    start = time.perf_counter()
    subprocess.run(command, env=os.environ | (variables or {}), check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def append(out: Path, row: dict[str, Any], times: list[float]) -> None:
    """Append the line of a case."""
    row |= {"seconds": statistics.median(times), "fastest": min(times), "slowest": max(times)}
    common.append(out, row)
    print(row["task"], row.get("shape", ""), row["caches"], f"{row['seconds']:.2f} s", file=sys.stderr, flush=True)


def print_table(rows: list[dict[str, Any]]) -> None:
    """Print a line for each case."""
    head = ["task", "model", "caches", "device", "commit", "load", "runs", "median [s]", "from", "to"]
    lines = []
    for row in rows:
        model = f"{row['splats']} {row['shape']}, {row['width']}x{row['height']}" if "shape" in row else ""
        line = [row["task"], model, row["caches"], row["platform"].split()[0] if model else "", row["commit"]]
        line += [f"{row['load']:.1f}", row["runs"]]
        lines.append([*line, *(f"{row[name]:.2f}" for name in ("seconds", "fastest", "slowest"))])
    print(common.table(head, lines))


if __name__ == "__main__":
    main()

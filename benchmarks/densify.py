"""Host time of one densification, by strategy and shape; a JSON line a run.

    python benchmarks/densify.py [--device 0:0] [--splats 1000000] [--shapes gaussian skew-normal] [--repeats 5]
    python benchmarks/densify.py --table [--write]   # print the finished runs, run nothing; write the table into GPU.md
    python benchmarks/densify.py --smoke --out FILE

The splats, their opacities and their gradients are random. About one in twenty is cloned or split, relocated or added.
`wall` is the whole action. `device` is the sum of its kernels and transfers by the device's clock. `host` is the rest:
what a GPU waits for. All are medians [ms]. `read` and `written` are MB that the action moves between host and device.
"""

from __future__ import annotations

import argparse
import re
import statistics
import time
from typing import Any

import common
import numpy as np

from clsplat.device.device import Device, open_device
from clsplat.device.memory import Pool
from clsplat.device.schedule import SCHEDULES
from clsplat.device.trace import TRANSFERS, recorded
from clsplat.rendering.splat_buffers import SplatBuffers, SplatStatistics
from clsplat.splats.fields import public_shape
from clsplat.splats.shapes import Shape, shape_named
from clsplat.training.config import TrainConfig
from clsplat.training.density.control import DensityControl
from clsplat.training.optim.optimizer import make_optimizer
from clsplat.training.options.density import Adc
from clsplat.training.programs import kernel_build
from clsplat.training.schedules import RunSchedule

KEY = ("action", "shape", "splats", "platform", "device", "commit")
EXTENT = 5.0
LOUD = 0.05  # share of the splats with a gradient above the threshold
ROOM = 1.1  # capacity over number of splats
_BEGIN, _END = "<!-- table of densify.py -->", "<!-- end of the table of densify.py -->"

PUBLISHED: dict[str, Any] = {"split": "published", "turnover": 0.05}

# Options of the run, and the iteration of the action.
ACTIONS: dict[str, tuple[dict[str, Any], int]] = {
    "clone, split, prune": ({"strategy": "adc"} | PUBLISHED, 1000),
    "the same at the cap": ({"strategy": "adc", "cap_max": 1.0} | PUBLISHED, 1000),
    "with an opacity reset": ({"strategy": "adc", "opacity_reset": 10} | PUBLISHED, 3000),
    "split along an axis": ({"strategy": "adc"}, 1000),
    "split along an axis at the cap": ({"strategy": "adc", "cap_max": 1.0}, 1000),
    "relocate, grow": ({"strategy": "mcmc"} | PUBLISHED, 1000),
    "relocate at the cap": ({"strategy": "mcmc", "cap_max": 1.0} | PUBLISHED, 1000),
    "relocate halves, grow": ({"strategy": "mcmc"}, 1000),
    "relocate halves at the cap": ({"strategy": "mcmc", "cap_max": 1.0}, 1000),
}


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "densify.jsonl")
    parser.add_argument("--splats", nargs="+", type=int, default=[1_000_000])
    parser.add_argument("--shapes", nargs="+", default=["gaussian", "skew-normal"])
    parser.add_argument("--actions", nargs="+", default=list(ACTIONS), choices=list(ACTIONS))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--write", action="store_true", help="write the table into GPU.md")
    args = parser.parse_args()
    if args.smoke:
        args.splats, args.repeats = [2000], 1
    runs = common.Runs(args.out, KEY)
    if not args.table:
        measure_all(runs, args)
    text = table(runs.rows)
    print(text)
    if args.write:
        common.write_between(common.ROOT / "benchmarks" / "GPU.md", _BEGIN, _END, text)


def measure_all(runs: common.Runs, args: argparse.Namespace) -> None:
    """Measure the cases that are not in the results yet."""
    device = open_device(args.device)
    where = common.environment(device, SCHEDULES["scalar"])
    for shape in args.shapes:
        for n in args.splats:
            for action in args.actions:
                case = {"action": action, "shape": shape, "splats": n, **where}
                if case not in runs:
                    runs.add(case | measure(device, action, shape_named(shape), n, args.repeats))


def measure(device: Device, action: str, shape: Shape, n: int, repeats: int) -> dict[str, float]:
    """Return the medians of one case."""
    options, iteration = ACTIONS[action]
    capacity = int(ROOM * n)
    options = options | {"cap_max": int(options.get("cap_max", ROOM) * n), "iterations": 30_000, "shape": shape.name}
    config = TrainConfig(**options)
    kernels = kernel_build(config, SCHEDULES["scalar"])
    splats = SplatBuffers(device, shape.schema(config.sh_degree), capacity, kernels.dtype)
    arrays, gradients = random_splats(shape, n, config.sh_degree)
    splats.set(arrays)
    optimizer = make_optimizer(device, kernels, splats, config, EXTENT)
    found: list[dict[str, float]] = []
    for seed in range(repeats + 1):
        splats.set(arrays)
        statistics_ = SplatStatistics(Pool(device), kernels.dtype)
        statistics_.write(gradients, splats.capacity)
        control = DensityControl(
            config,
            kernels,
            RunSchedule.create(config, n),
            splats,
            optimizer,
            statistics_,
            np.random.default_rng(seed),
            EXTENT,
            1,
        )
        device.finish()
        with recorded(device) as launches:
            start = time.perf_counter()
            control.densify(iteration)
            device.finish()
            wall = 1e3 * (time.perf_counter() - start)
        on_device = sum(launch.ms for launch in launches)
        moved = {name: sum(launch.size[0] for launch in launches if launch.name == name) / 1e6 for name in TRANSFERS}
        found.append(
            {
                "host_ms": wall - on_device,
                "device_ms": on_device,
                "wall_ms": wall,
                "read_mb": moved["download"],
                "written_mb": moved["upload"],
            }
        )
    return {name: round(statistics.median(one[name] for one in found[1:]), 2) for name in found[0]}


def random_splats(shape: Shape, n: int, sh_degree: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the public arrays of n splats, and their statistics."""
    rng = np.random.default_rng(0)
    arrays = {}
    for field in shape.schema(sh_degree):
        values = rng.standard_normal(public_shape(field, n), np.float32)
        if field.name == "log_scale":
            values -= 3
        elif field.bounds is not None:
            values = np.exp(rng.uniform(*np.log(field.bounds), n)).astype(np.float32)
        elif field.name == "skew":
            values *= 0.3 / np.linalg.norm(values, axis=1, keepdims=True)
        arrays[field.name] = values
    seen = rng.integers(1, 30, n)
    gradient = np.exp(rng.standard_normal(n))
    gradient *= Adc.grad_threshold / np.quantile(gradient, 1 - LOUD)
    return arrays, np.stack([gradient * seen, gradient * seen, seen]).astype(np.float32)


def table(rows: list[dict[str, Any]]) -> str:
    """Return the last result of each case on each processor, as a Markdown table."""
    devices = list(dict.fromkeys(row["device"] for row in rows))
    latest = {
        (devices.index(row["device"]), row["shape"], row["splats"], list(ACTIONS).index(row["action"])): row
        for row in rows
    }
    columns = {"action": "action", "shape": "shape", "splats": "splats"}
    columns |= {"host_ms": "host ms", "read_mb": "read MB", "written_mb": "written MB"}
    columns |= {"device": "processor", "commit": "commit"}
    cells = ([cell(row[name]) for name in columns] for _, row in sorted(latest.items()))
    return common.table(list(columns.values()), cells, set(list(columns.values())[2:-2]))


def cell(value: Any) -> Any:
    """Return a value of a row as it is printed; of a processor's name without PoCL's prefix."""
    if isinstance(value, float):
        return f"{value:.1f}"
    return re.sub(r"^pthread-[\w-]+-(?=AMD|Intel)|\(R\)", "", value) if isinstance(value, str) else value


if __name__ == "__main__":
    main()

"""Hazards x shapes x parameterisations x optimizers: what survives, what stops with a message, what is lost.

    python benchmarks/stability.py [--kinds static training capacity recovery arithmetic] [--out FILE]
    python benchmarks/stability.py --table      # print the tables from the file, run nothing
    python benchmarks/stability.py --charts     # draw the heat maps beside the file

Kinds (benchmarks/hazards/ has each):
  static      crafted splats: float32 kernels against the double build, on every usable device and with fast-math
  training    a small capture with something wrong, beside the same run with nothing wrong (its benign twin)
  capacity    120 000 splats over a tile; gradient records of more than 2^31 bytes in one buffer
  recovery    known skewed splats, found again with every parameterisation of the slant
  arithmetic  the textbook formula of a projected slant beside clsplat's

A line that is in the file already is not run again: kill and restart at will. A model that training writes is read
back: a number in it that is not finite is a failure, whatever the run said. benchmarks/STABILITY.md reads the results.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import common
from hazards import coupled, crafted, slant_arithmetic
from hazards.capacity import CAPACITY, capacity_row
from hazards.report import print_tables, write_charts
from hazards.static import Renderers, static_row
from hazards.training import TRAINING, Trainings, build_options
from hazards.variants import OPTIMIZERS, VARIANTS

from clsplat.device.device import Device, list_devices, open_device
from clsplat.rendering.tuning import schedule_for
from clsplat.splats.shapes import DEFAULT_SHAPE, SHAPES

Row = dict[str, Any]
Task = tuple[Row, Callable[[], Row | None]]  # what tells a line from others, and what measures it

KEY = ("kind", "hazard", "system", "optimizer", "device", "build")
FAST_MATH = "-cl-fast-relaxed-math"
SMOKE = {"static": ("benign", "needles 1:10^4"), "training": ("all rates x10", "one image")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--device", help="the first of the devices, as for clsplat; default: the best")
    parser.add_argument("--out", type=Path, default=common.RESULTS / "stability.jsonl")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--charts", action="store_true")
    parser.add_argument("--smoke", action="store_true", help="a few tiny cases of each kind")
    args = parser.parse_args()
    if args.table or args.charts:
        rows = common.read(args.out)
        if args.table:
            print_tables(rows)
        if args.charts:
            for path in write_charts(rows, args.out.parent):
                print(path)
        return
    first = open_device(args.device)
    devices = [first] + [
        open_device(info.index)
        for info in list_devices()
        if info.fault is None and info.platform != "Oclgrind" and info.index != first.info.index
    ]
    done = {tuple(row[key] for key in KEY) for row in common.read(args.out)}
    for kind in args.kinds:
        for key, measure in KINDS[kind](devices[:1] if args.smoke else devices, args.smoke):
            if tuple(key[name] for name in KEY) in done:
                continue
            measured = measure()
            if measured is None:
                continue
            device = next(device for device in devices if device.info.index == key["device"])
            common.append(args.out, key | measured | {"environment": common.environment(device, schedule_for(device))})
            print(
                f"{kind}: {key['hazard']}, {key['system']} {key['optimizer']} {key['build']}: "
                f"{measured['verdict']} {measured['message']}",
                flush=True,
            )
    print_tables(common.read(args.out))


def key_of(kind: str, hazard: str, system: str, device: Device, optimizer: str = "", build: str = "") -> Row:
    return dict(zip(KEY, (kind, hazard, system, optimizer, device.info.index, build), strict=True))


def static_tasks(devices: list[Device], smoke: bool) -> Iterator[Task]:
    """Every device as usual, and the first one with fast-math; a shape's kernels are built once for all its hazards."""
    builds = [(device, "") for device in devices] + ([] if smoke else [(devices[0], FAST_MATH)])
    for device, build in builds:
        for shape in some(SHAPES, smoke, ("gaussian",)):
            renderers: list[Renderers] = []

            def measure(
                hazard: str,
                shape: str = shape,
                device: Device = device,
                build: str = build,
                kept: list[Renderers] = renderers,
            ) -> Row | None:
                with build_options(build):
                    if not kept:
                        kept.append(Renderers(device, schedule_for(device)))
                    return static_row(hazard, shape, kept[0])

            for hazard in some(crafted.STATIC, smoke, SMOKE["static"]):
                yield key_of("static", hazard, shape, device, build=build), lambda h=hazard, m=measure: m(h)


def training_tasks(devices: list[Device], smoke: bool) -> Iterator[Task]:
    runs = Trainings(devices[0], devices[1] if len(devices) > 1 else None, *([20, 4] if smoke else []))
    for system in VARIANTS[:1] if smoke else VARIANTS:
        for optimizer in some(OPTIMIZERS, smoke, ("adam",)):
            for hazard in some(TRAINING, smoke, SMOKE["training"]):
                yield (
                    key_of("training", hazard, system.label, devices[0], optimizer),
                    lambda h=hazard, s=system, o=optimizer: runs.row(h, s, o),
                )


def capacity_tasks(devices: list[Device], smoke: bool) -> Iterator[Task]:
    for hazard in CAPACITY:
        for shape in ("gaussian", DEFAULT_SHAPE):
            yield (
                key_of("capacity", hazard, shape, devices[0]),
                lambda h=hazard, s=shape: capacity_row(h, s, devices[0], smoke),
            )


def recovery_tasks(devices: list[Device], smoke: bool) -> Iterator[Task]:
    for case in coupled.cases()[: 1 if smoke else None]:
        for form in some(coupled.FORMS, smoke, ("coupled", "vanilla")):
            name = f"slant {case['slant']:g}, 1:{case['aspect']:g}, rate {case['skew_lr']:g}"

            def measure(form: str = form, case: dict[str, float] = case) -> Row:
                found = coupled.recovered(devices[0], form, case, **({"iterations": 10} if smoke else {}))
                return (
                    case
                    | found
                    | {"verdict": "stops" if found["message"] else "survives" if found["finite"] else "fails"}
                )

            yield key_of("recovery", name, form, devices[0]), measure


def arithmetic_tasks(devices: list[Device], smoke: bool) -> Iterator[Task]:
    for length in slant_arithmetic.LENGTHS:
        for aspect in slant_arithmetic.ASPECTS[-1 if smoke else 0 :]:
            for slant in slant_arithmetic.SLANTS:

                def measure(slant: float = slant, aspect: float = aspect, length: float = length) -> Row:
                    found = slant_arithmetic.arithmetic_row(slant, aspect, length)
                    lost = found["squares_not_positive"] > 0
                    return found | {"finite": not lost, "message": "", "verdict": "fails" if lost else "survives"}

                yield key_of("arithmetic", f"{length:g} px, 1:{aspect:g}, slant {slant:g}", "", devices[0]), measure


def some(all_of: Iterable[str], smoke: bool, few: Iterable[str]) -> list[str]:
    return list(few if smoke else all_of)


KINDS: dict[str, Callable[[list[Device], bool], Iterator[Task]]] = {
    "static": static_tasks,
    "training": training_tasks,
    "capacity": capacity_tasks,
    "recovery": recovery_tasks,
    "arithmetic": arithmetic_tasks,
}

if __name__ == "__main__":
    main()

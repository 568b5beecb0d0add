"""Hazards x shapes x parameterisations x optimizers: what survives, what stops with a message, what is lost.

    python benchmarks/stability.py [--kinds static training capacity recovery arithmetic] [--out FILE]
    python benchmarks/stability.py --table      # print the tables from the file, run nothing
    python benchmarks/stability.py --charts     # draw the heat maps beside the file

Kinds (benchmarks/hazards/ defines each):

- static: crafted splats, float32 kernels against the double build, on every usable device and with fast-math
- training: a small capture with a fault, beside the same run without the fault (its benign twin)
- capacity: 120 000 splats over a tile; gradient records of more than 2^31 bytes in one buffer
- recovery: known skewed splats, recovered with every parameterisation of the slant
- arithmetic: the textbook formula of a projected slant beside clsplat's

A finished line is not repeated: kill and restart at will. A model that training writes is read back: a value that is
not finite is a failure, also if the run reported none. benchmarks/STABILITY.md discusses the results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
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
Task = tuple[Row, Callable[[], Row | None]]  # the key of a line, and the function that measures it

KEY = ("kind", "hazard", "system", "optimizer", "device", "build")
FAST_MATH = "-cl-fast-relaxed-math"
SMOKE = {"static": ("benign", "needles 1:10^4"), "training": ("all rates x10", "one image")}


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "stability.jsonl")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--charts", action="store_true", help="draw the heat maps, run nothing")
    args = parser.parse_args()
    runs = common.Runs(args.out, KEY)
    if args.table or args.charts:
        rows = runs.rows
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
    for kind in args.kinds:
        for key, measure in KINDS[kind](devices[:1] if args.smoke else devices, args.smoke):
            if key in runs:
                continue
            measured = measure()
            if measured is None:
                continue
            device = next(device for device in devices if device.info.index == key["device"])
            runs.add(key | measured | {"environment": common.environment(device, schedule_for(device))})
            print(
                f"{kind}: {key['hazard']}, {key['system']} {key['optimizer']} {key['build']}: "
                f"{measured['verdict']} {measured['message']}",
                flush=True,
            )
    print_tables(runs.rows)


def key_of(kind: str, hazard: str, system: str, device: Device, optimizer: str = "", build: str = "") -> Row:
    """Return the key of a line."""
    return dict(zip(KEY, (kind, hazard, system, optimizer, device.info.index, build), strict=True))


def static_tasks(devices: list[Device], smoke: bool) -> Iterator[Task]:
    """Yield tasks for every device, and for the first one with fast-math; each shape's kernels are built once."""
    builds = [(device, "") for device in devices] + ([] if smoke else [(devices[0], FAST_MATH)])
    for device, build in builds:
        for shape in some(SHAPES, smoke, ("gaussian",)):
            renderers: list[Renderers] = []

            def measure(
                hazard: str,
                shape: str = shape,
                device: Device = device,
                build: str = build,
                cache: list[Renderers] = renderers,
            ) -> Row | None:
                with build_options(build):
                    if not cache:
                        cache.append(Renderers(device, schedule_for(device)))
                    return static_row(hazard, shape, cache[0])

            for hazard in some(crafted.STATIC, smoke, SMOKE["static"]):
                yield key_of("static", hazard, shape, device, build=build), lambda h=hazard, m=measure: m(h)


def training_tasks(devices: list[Device], smoke: bool) -> Iterator[Task]:
    """Yield tasks: runs with a fault."""
    runs = Trainings(devices[0], devices[1] if len(devices) > 1 else None, *([20, 4] if smoke else []))
    for variant in VARIANTS[:1] if smoke else VARIANTS:
        for optimizer in some(OPTIMIZERS, smoke, ("adam",)):
            for hazard in some(TRAINING, smoke, SMOKE["training"]):
                yield (
                    key_of("training", hazard, variant.label, devices[0], optimizer),
                    lambda h=hazard, s=variant, o=optimizer: runs.row(h, s, o),
                )


def capacity_tasks(devices: list[Device], smoke: bool) -> Iterator[Task]:
    """Yield tasks: scenes of extreme size."""
    for hazard in CAPACITY:
        for shape in ("gaussian", DEFAULT_SHAPE):
            yield (
                key_of("capacity", hazard, shape, devices[0]),
                lambda h=hazard, s=shape: capacity_row(h, s, devices[0], smoke),
            )


def recovery_tasks(devices: list[Device], smoke: bool) -> Iterator[Task]:
    """Yield tasks: recoveries of known splats."""
    for case in coupled.cases()[: 1 if smoke else None]:
        for form in some(coupled.FORMS, smoke, ("coupled", "vanilla")):
            name = f"slant {case['slant']:g}, 1:{case['aspect']:g}, rate {case['skew_lr']:g}"

            def measure(form: str = form, case: dict[str, float] = case) -> Row:
                result = coupled.recovered(devices[0], form, case, **({"iterations": 10} if smoke else {}))
                return (
                    case
                    | result
                    | {"verdict": "stops" if result["message"] else "survives" if result["finite"] else "fails"}
                )

            yield key_of("recovery", name, form, devices[0]), measure


def arithmetic_tasks(devices: list[Device], smoke: bool) -> Iterator[Task]:
    """Yield tasks: formulas of the projected slant."""
    for length in slant_arithmetic.LENGTHS:
        for aspect in slant_arithmetic.ASPECTS[-1 if smoke else 0 :]:
            for slant in slant_arithmetic.SLANTS:

                def measure(slant: float = slant, aspect: float = aspect, length: float = length) -> Row:
                    result = slant_arithmetic.arithmetic_row(slant, aspect, length)
                    lost = result["squares_not_positive"] > 0
                    return result | {"finite": not lost, "message": "", "verdict": "fails" if lost else "survives"}

                yield key_of("arithmetic", f"{length:g} px, 1:{aspect:g}, slant {slant:g}", "", devices[0]), measure


def some(all_of: Iterable[str], smoke: bool, few: Iterable[str]) -> list[str]:
    """Return all names, or a few in a smoke run."""
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

"""Methods, shapes and parameterisations against each other in one engine: the tables of SYSTEMS.md.

    python benchmarks/systems.py fox kitchen --groups presets forms [--caps 5000] [--seeds 0 1 2] [--device 0:0]
    python benchmarks/systems.py fox kitchen --validate      # groups for choices, on held-out training views
    python benchmarks/systems.py --table                     # print all runs, run nothing
    python benchmarks/systems.py --page [--validate]         # print the tables of SYSTEMS.md, by question

Each scene has a folder under benchmarks/results/systems (runs.jsonl, table.md, results.json; see `clsplat compare`).
A finished run is not repeated: kill and restart at will, add seeds, caps or groups later. Two scenes may run in two
processes. Fox is read at half size to save time.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import common

from clsplat.comparison.compare import compare
from clsplat.comparison.methods import Method, parse_methods
from clsplat.comparison.runs import RUNS
from clsplat.comparison.table import Record, markdown
from clsplat.splats.shapes import SHAPES
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import as_decided

OUT = common.RESULTS / "systems"

# Training options of the shapes: the defaults of the day on which these tables were begun. They are written out so that
# the tables stay one experiment when defaults change. Presets bring their own options.
BASE = {
    "strategy": "mcmc",
    "relocation": "length",
    "growth": 1.05,
    "noise_lr": 5e5,
    "init_opacity": 0.5,
    "init_scale": 0.5,
    "opacity_reg": 0.001,
    "scale_reg": 0.001,
    "densify_from": 0.05,
    "densify_until": 0.8,
    "densify_interval": 100,
    "grad_threshold": 2e-4,
    "opacity_reset": 10,
    "turnover": 0.0,
    "split": "published",
}


class Group(NamedTuple):
    """Methods that answer one question, their caps, and the views to measure on.

    `validate`: measure on held-out training views, because a default depends on the answer.
    """

    methods: tuple[str, ...]
    caps: tuple[int, ...]
    iterations: int = 1000
    validate: bool = False

    def contestants(self) -> list[Method]:
        """Return the methods; shapes get the options of BASE."""
        return [
            replace(method, changes=_with_base(method.changes)) if method.base in SHAPES else method
            for method in parse_methods(",".join(self.methods))
        ]


def _with_base(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the changes of a system together with BASE, without the options that its strategy does not have."""
    options = BASE | dict(changes)
    unused = TrainConfig(strategy=options["strategy"]).without_effect(options)
    return {name: value for name, value in options.items() if name not in unused}


# Growth by gradient instead of BASE's by opacity.
ADC = "strategy=adc,noise_lr=0,densify_until=0.5,opacity_reg=0,scale_reg=0"
START = "init_opacity=0.2,init_scale=0.7"


def adc(shape: str, *more: str) -> str:
    """Return a shape with growth by gradient and more options."""
    return ",".join((f"{shape}:{ADC}", *more))


SHORT = {ADC: "adc*", START: "start*"}  # in the tables
KERNELS = tuple(adc(shape, START) for shape in ("gaussian", "skew-normal", "generalised-exponential"))

GROUPS = {
    # every published method as published, and clsplat's default
    "presets": Group(("default", "3dgs", "3dgs-mcmc", "ges", "3d-hgs", "sss", "sns", "3dsgs"), (5000, 20000)),
    # one optimizer; the form of the skew and its training: the four ablation rows of SNS (vanilla, decomposition,
    # alternation, both) and the centred form with and without alternation
    "forms": Group(
        (
            "skew-normal",
            "skew-normal:alternation=cyclic",
            "skew-normal-direct:skew_map=coupled",
            "skew-normal-direct:skew_map=polar",
            "skew-normal-direct:skew_map=coupled,alternation=cyclic",
            "skew-normal-direct:skew_map=polar,alternation=cyclic",
            "gaussian",
        ),
        (1000, 5000, 20000),
    ),
    # one optimizer, every kernel
    "shapes": Group(
        (
            "gaussian",
            "skew-normal",
            "skew-normal-direct:skew_map=polar",
            "half-gaussian",
            "bisected-skew",
            "generalised-exponential",
            "ges-modulation",
            "student-t:opacity_lr=0.005",
        ),
        (5000,),
    ),
    # one kernel, other options
    "factors": Group(
        (
            "gaussian",
            "gaussian:noise_lr=0",
            "gaussian:position_optimizer=sghmc,noise_lr=0",
            "gaussian:position_optimizer=sghmc-sss,noise_lr=0",
            "gaussian:strategy=adc,noise_lr=0",
            "skew-normal",
            "skew-normal:strategy=adc,noise_lr=0",
            "skew-normal:position_optimizer=sghmc,noise_lr=0",
            "skew-normal:normalisation=pdf",
            "skew-normal:normalisation=none",
        ),
        (5000,),
    ),
    # start and strategy
    "strategies": Group(
        (
            "skew-normal",
            "skew-normal:init_opacity=0.1,init_scale=1",
            "skew-normal:init_opacity=0.1,init_scale=1,opacity_reg=0,scale_reg=0",
            "3dgs:shape=skew-normal",
            "3dgs",
            "3dgs:shape=generalised-exponential",
            "generalised-exponential",
            "gaussian",
        ),
        (5000, 20000),
        validate=True,
    ),
    # the cause of the difference between the two strategies, with and without room to grow
    "growth": Group(
        (
            "skew-normal",
            "skew-normal:strategy=adc,noise_lr=0,densify_until=0.5",
            adc("skew-normal"),
            "3dgs:shape=skew-normal",
            "skew-normal:densify_until=0.5",
            "skew-normal:noise_lr=0",
        ),
        (5000, 20000),
        validate=True,
    ),
    # the best start for each strategy
    "starts": Group(
        (
            adc("skew-normal"),
            adc("skew-normal", "init_opacity=0.1,init_scale=0.5"),
            adc("skew-normal", "init_opacity=0.5,init_scale=1"),
            adc("skew-normal", START),
            adc("skew-normal", "init_opacity=0.1,init_scale=1"),
        ),
        (5000, 20000),
        validate=True,
    ),
    # the candidates for a default, then the kernel with the best of them
    "candidates": Group(
        (
            "skew-normal",
            adc("skew-normal", START),
            adc("skew-normal", "init_opacity=0.1,init_scale=0.5"),
            f"skew-normal:strategy=adc,noise_lr=0,densify_until=0.5,{START}",
        ),
        (5000, 20000),
        validate=True,
    ),
    "kernels": Group(("skew-normal", *KERNELS), (5000, 20000), validate=True),
    "kernels-long": Group(
        ("skew-normal", *KERNELS, *(f"{kernel},opacity_reset=0" for kernel in KERNELS)), (20000,), 3000, validate=True
    ),
    # whether three times the iterations give the same order
    "long": Group(
        (
            "skew-normal",
            "skew-normal:alternation=cyclic",
            "skew-normal:alternation=cyclic,alternation_split=0.8",
            "gaussian",
            "generalised-exponential",
        ),
        (5000,),
        3000,
    ),
}


def main() -> None:
    parser = common.parser(__doc__, OUT, smoke=False)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--groups", nargs="+", choices=tuple(GROUPS), help="default: all groups for these views")
    parser.add_argument(
        "--caps", nargs="+", type=int, help="only these caps of a group; new caps if it has none of them"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--iterations", type=int, help="instead of those of the group")
    parser.add_argument(
        "--validate", action="store_true", help="measure on held-out training views, never on test views"
    )
    parser.add_argument("--page", action="store_true", help="print the tables of SYSTEMS.md")
    args = parser.parse_args()
    if args.validate:
        args.out = args.out.with_name(args.out.name + "-validation")
    if args.page:
        print(page(args.out, args.validate))
        return
    names = args.groups or [name for name, group in GROUPS.items() if group.validate == args.validate]
    for scene_name in args.scenes if not args.table else ():
        scene = common.real_scene(scene_name, validate=args.validate)
        for group in (GROUPS[name] for name in names):
            caps = [cap for cap in group.caps if args.caps is None or cap in args.caps] or args.caps or []
            compare(
                [scene],
                group.contestants(),
                args.out / scene_name,
                caps,
                args.seeds,
                {"iterations": args.iterations or group.iterations, "device": args.device},
                extra={"commit": common.commit()},
                on_run=common.print_run,
            )
    for path in sorted(args.out.glob(f"*/{RUNS}")):
        print(markdown(common.read(path)))


def page(folder: Path, validate: bool) -> str:
    """Return the tables by question: for each group and cap, the scenes side by side.

    Each method has its mean ± half the spread over its seeds. The difference to the first method of the group is over
    the seeds that both have.
    """
    scenes = {path.parent.name: common.read(path) for path in sorted(folder.glob(f"*/{RUNS}"))}
    tables = []
    for name, group in GROUPS.items():
        for cap in group.caps if group.validate == validate else ():
            runs = {
                (scene, method.label): runs_by_seed(records, method, cap, group.iterations)
                for scene, records in scenes.items()
                for method in group.contestants()
            }
            base, *others = group.methods
            if not any(runs[scene, method] for scene in scenes for method in others):
                continue
            head = ["system"]
            for scene in scenes:
                head += [f"{scene}: PSNR", f"to {short(base)}", "SSIM", "CPU s", "seeds"]
            rows = [
                [short(method), *(cell for scene in scenes for cell in cells(runs[scene, method], runs[scene, base]))]
                for method in group.methods
            ]
            title = f"**{name}, {cap} splats, {group.iterations} iterations**"
            tables.append(f"{title}\n\n{common.table(head, rows, right=head[1:])}\n")
    return "\n".join(tables)


def short(label: str) -> str:
    """Return a method's label with short names for the options that many methods share."""
    for options, name in SHORT.items():
        label = label.replace(options, name)
    return label


def runs_by_seed(records: list[Record], method: Method, cap: int, iterations: int) -> dict[int, Record]:
    """Return the runs of a method by seed; runs that had other options are left out.

    Options that a run decided by its scene may differ. The last run of a seed counts.
    """

    def same(record: Record) -> bool:
        options = TrainConfig.from_json(record["config"]).replace(device=None)
        return options == as_decided(method.config(cap, options.seed, {"iterations": iterations}), options.to_json())

    return {
        record["config"]["seed"]: record
        for record in records
        if record["system"] == method.label and record["config"]["cap_max"] == cap and same(record)
    }


def cells(runs: dict[int, Record], base: dict[int, Record]) -> list[str]:
    """Return the cells of one method on one scene."""
    finished = {seed: record for seed, record in runs.items() if not record["failed"]}
    if not finished:
        return ["failed" if runs else "", "", "", "", str(len(runs) or "")]
    psnr = [record["psnr"] for record in finished.values()]
    gains = [
        record["psnr"] - base[seed]["psnr"]
        for seed, record in finished.items()
        if runs is not base and seed in base and not base[seed]["failed"]
    ]
    to_base = f"{min(gains):+.2f} to {max(gains):+.2f}" if len(gains) > 1 else "".join(f"{d:+.2f}" for d in gains)
    return [
        f"{statistics.fmean(psnr):.2f} ± {(max(psnr) - min(psnr)) / 2:.2f}" if len(psnr) > 1 else f"{psnr[0]:.2f}",
        to_base,
        f"{statistics.fmean(record['ssim'] for record in finished.values()):.4f}",
        f"{statistics.fmean(record['cpu_seconds'] for record in finished.values()):.0f}",
        str(len(finished)),
    ]


if __name__ == "__main__":
    main()

"""Systems, shapes and parameterisations against each other in one engine: the tables behind SYSTEMS.md.

    python benchmarks/systems.py fox kitchen --groups presets forms [--caps 5000] [--seeds 0 1 2] [--device 0:0]
    python benchmarks/systems.py fox kitchen --validate      # groups for choices: no test view is looked at
    python benchmarks/systems.py --table                  # print what is there, run nothing
    python benchmarks/systems.py --page [--validate]      # likewise, the tables of SYSTEMS.md: by question

One folder a scene under benchmarks/results/systems (runs.jsonl, table.md, results.json; see `clsplat compare`). A
run that is there already is not done again: kill and restart at will, add seeds, caps or groups later. Two scenes may
run in two processes. Fox is read at half size: what the seconds allow.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import common

from clsplat.comparison.compare import RUNS, Run, compare
from clsplat.comparison.methods import Method, parse_methods
from clsplat.comparison.table import Record, markdown
from clsplat.scenes.scene import Scene, load_scene
from clsplat.splats.shapes import SHAPES
from clsplat.training.config import TrainConfig

OUT = common.RESULTS / "systems"
RESOLUTION = {"fox": 2}  # of load_scene; others as they are


# What shapes are trained with: the defaults of the day on which these tables were begun, written out so that they stay
# one experiment when defaults change. Presets bring their own.
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
}


class Group(NamedTuple):
    """Systems that answer one question, the caps to ask it at, and on which views: defaults hang on some answers."""

    systems: tuple[str, ...]
    caps: tuple[int, ...]
    iterations: int = 1000
    validate: bool = False

    def contestants(self) -> list[Method]:
        """The systems, shapes with the options of BASE."""
        return [
            replace(system, changes=_with_base(system.changes)) if system.base in SHAPES else system
            for system in parse_methods(",".join(self.systems))
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
    """A shape with growth by gradient and more options."""
    return ",".join((f"{shape}:{ADC}", *more))


SHORT = {ADC: "adc*", START: "start*"}  # in the tables
KERNELS = tuple(adc(shape, START) for shape in ("gaussian", "skew-normal", "generalised-exponential"))

GROUPS = {
    # every published system as published, and clsplat's default
    "presets": Group(("default", "3dgs", "3dgs-mcmc", "ges", "3d-hgs", "sss", "sns", "3dsgs"), (5000, 20000)),
    # one optimizer; the skew's form and its training: SNS's four ablation rows (vanilla, decomposition, alternation,
    # both) and the centred form with and without alternation
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
    # which start and which strategy
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
    # what makes the difference between the two strategies, with and without room to grow
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
    # which start goes with which strategy
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
    # whether three times the iterations say the same
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--groups", nargs="+", choices=tuple(GROUPS), help="not given: all for these views")
    parser.add_argument("--caps", nargs="+", type=int, help="only these of the groups' caps; others where none is one")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--iterations", type=int, help="instead of the groups' own")
    parser.add_argument("--device")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--validate", action="store_true", help="hold out training views; test views are not looked at")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--page", action="store_true")
    args = parser.parse_args()
    if args.validate:
        args.out = args.out.with_name(args.out.name + "-validation")
    if args.page:
        print(page(args.out, args.validate))
        return
    for name in args.scenes if not args.table else ():
        scene = load_scene(common.data_folder() / name, resolution=RESOLUTION.get(name, -1), eval=True)
        if args.validate:
            scene = validation(scene)
        asked = args.groups or [group for group in GROUPS if GROUPS[group].validate == args.validate]
        for group in (GROUPS[group] for group in asked):
            caps = [cap for cap in group.caps if args.caps is None or cap in args.caps] or args.caps or []
            common_options = {"iterations": args.iterations or group.iterations, "device": args.device}
            compare(
                [scene],
                group.contestants(),
                args.out / name,
                caps,
                args.seeds,
                common_options,
                extra={"commit": common.commit()},
                on_run=say,
            )
    for path in sorted(args.out.glob(f"*/{RUNS}")):
        print(markdown(common.read(path)))


def validation(scene: Scene) -> Scene:
    """The scene without its test views, and every 7th training view held out instead."""
    return replace(scene, views=scene.train, test_names=frozenset(view.name for view in scene.train[3::7]))


def page(folder: Path, validate: bool) -> str:
    """The tables by question: for each group and cap the scenes side by side, and the difference to the first system.

    A system's mean ± half the spread is over the seeds it has; the difference over those that both have, seed by seed.
    """
    scenes = {path.parent.name: common.read(path) for path in sorted(folder.glob(f"*/{RUNS}"))}
    lines = []
    for name, group in GROUPS.items():
        for cap in group.caps if group.validate == validate else ():
            by = {
                (scene, system.label): own_runs(records, system, cap, group.iterations)
                for scene, records in scenes.items()
                for system in group.contestants()
            }
            if not any(len(seeds) for (_, system), seeds in by.items() if system != group.systems[0]):
                continue
            lines += [
                f"**{name}, {cap} splats, {group.iterations} iterations**",
                "",
                "| system | "
                + " | ".join(f"{scene}: PSNR | to {short(group.systems[0])} | SSIM | CPU s | seeds" for scene in scenes)
                + " |",
                "|---|" + "---:|" * 5 * len(scenes),
            ]
            for system in group.systems:
                cells = [cell for scene in scenes for cell in row(by[scene, system], by[scene, group.systems[0]])]
                lines.append(f"| {short(system)} | " + " | ".join(cells) + " |")
            lines.append("")
    return "\n".join(lines)


def short(label: str) -> str:
    """A system's label without the options that many have."""
    for options, name in SHORT.items():
        label = label.replace(options, name)
    return label


def own_runs(records: list[Record], system: Method, cap: int, iterations: int) -> dict[int, Record]:
    """A system's runs by seed: those made with the options it has now."""

    def same(record: Record) -> bool:
        options = replace(TrainConfig.from_json(record["config"]), device=None)
        return options == system.config(cap, options.seed, {"iterations": iterations})

    return {
        record["config"]["seed"]: record
        for record in records
        if record["system"] == system.label and record["config"]["cap_max"] == cap and same(record)
    }


def row(own: dict[int, Record], base: dict[int, Record]) -> list[str]:
    """Cells of one system on one scene."""
    done = [record for record in own.values() if not record["failed"]]
    if not done:
        return ["failed" if own else "", "", "", "", str(len(own) or "")]
    psnr = [record["psnr"] for record in done]
    pairs = [
        own[seed]["psnr"] - base[seed]["psnr"]
        for seed in own
        if seed in base and own is not base and not own[seed]["failed"] and not base[seed]["failed"]
    ]
    to_base = f"{min(pairs):+.2f} to {max(pairs):+.2f}" if len(pairs) > 1 else "".join(f"{d:+.2f}" for d in pairs)
    return [
        f"{statistics.fmean(psnr):.2f} ± {(max(psnr) - min(psnr)) / 2:.2f}" if len(psnr) > 1 else f"{psnr[0]:.2f}",
        to_base,
        f"{statistics.fmean(record['ssim'] for record in done):.4f}",
        f"{statistics.fmean(record['cpu_seconds'] for record in done):.0f}",
        str(len(done)),
    ]


def say(run: Run, record: Record | None) -> None:
    """Progress, a line a run."""
    if record is not None:
        result = record["failed"] or f"{record['psnr']:.3f} dB, {record['cpu_seconds']:.0f} CPU s"
        print(f"{run}: {result}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()

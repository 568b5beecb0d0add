"""`clsplat compare`: train systems side by side and print a table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.comparison.methods import DEFAULT, Method, parse_methods
from clsplat.errors import InputError
from clsplat.files.real_path import real_path
from clsplat.scenes.options import READING_OPTIONS
from clsplat.splats.color import BLACK
from clsplat.training.presets import PRESETS
from clsplat.training.stored_run import load_recorded_scene

from .comparison_options import check_devices_of_runs, cluster_option, comparison_sections, grid_options
from .options import (
    PATH,
    TrainingCommand,
    config_options,
    config_values,
    hiding_options,
    is_given,
    photo_options,
    quiet_option,
    split_options,
    warn_without_effect,
)
from .progress import TrainingDisplay, duration, table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from clsplat.comparison.runs import Run
    from clsplat.comparison.table import Record
    from clsplat.scenes.scene import Scene


CAPS = (5000,)
SYSTEMS = (DEFAULT, *PRESETS)


@click.command(
    "compare",
    cls=TrainingCommand,
    sections=comparison_sections("save_models"),
    examples=(
        (
            "clsplat compare SCENE -o table --systems 3dgs,default --iterations 1000",
            "Two systems, each trained once.",
        ),
        (
            "clsplat compare SCENE -o table --cap-max 5000,20000 --seeds 0,1,2",
            "All systems at two sizes, with three seeds each.",
        ),
        (
            "clsplat compare SCENE -o table --cluster local:2",
            "Two runs at a time, each with half of the cores.",
        ),
    ),
    see_also=("frontier", "benchmark", "worker"),
)
@click.argument("scenes", nargs=-1, required=True, type=PATH)
@grid_options(
    output="Folder of the runs and the table.",
    systems=SYSTEMS,
    about_systems=(
        'Presets, shapes, or "default". Each may have changes, such as sns:alternation=off,skew-map=coupled.'
    ),
    caps=CAPS,
)
@photo_options
@hiding_options
@split_options()
@click.option("--save-models", is_flag=True, help="Keep the splats of each run, in DIR/models.")
@cluster_option
@quiet_option
@config_options(
    *("shape", "cap_max", "seed", "iterations", "save_iterations", "test_iterations"),
    *("checkpoint_interval", "checkpoint_minutes"),
)
@click.pass_context
def compare_systems(
    ctx: click.Context,
    /,
    scenes: tuple[Path, ...],
    output: Path,
    systems: str,
    caps: tuple[tuple[int, ...], ...],
    lengths: tuple[tuple[int, ...], ...],
    seeds: tuple[tuple[int, ...], ...],
    save_models: bool,
    cluster: str | None,
    quiet: bool,
    **values: Any,
) -> None:
    """Train each system on SCENES with equal caps, iterations and seeds, and measure the test views.

    Training options apply to all systems; the changes of a system replace them. The command appends a line for each
    run to DIR/runs.jsonl, and writes table.md and results.json of all runs there. After Ctrl-C, the same command
    continues.
    """
    from clsplat.comparison.compare import compare
    from clsplat.comparison.table import HEAD, cells, notes, summarise

    check_devices_of_runs(values.get("device"), cluster)
    methods = parse_methods(systems)
    common, loaded = options_and_scenes(ctx, scenes, methods, values)
    with TrainingDisplay(quiet) as display:
        records = compare(
            loaded,
            methods,
            output,
            distinct_numbers(caps) or CAPS,
            distinct_numbers(seeds) or [0],
            common,
            lengths=distinct_numbers(lengths),
            save_models=save_models,
            cluster=cluster,
            progress=display,
            on_run=None if quiet else report_run,
        )
    if not quiet:
        rows = summarise(records)
        click.echo(table(HEAD, map(cells, rows)))
        for note in notes(records, rows):
            click.echo(note)


def options_and_scenes(
    ctx: click.Context, paths: Sequence[Path], methods: Sequence[Method], values: dict[str, Any]
) -> tuple[dict[str, Any], Iterator[Scene]]:
    """Return the training options on the command line, and an iterator that reads the scenes one by one."""
    common = config_values(ctx, values)
    configs = [method.config(1, 0, common) for method in methods]
    warn_without_effect(configs, common)
    reading = {key: values[key] for key in READING_OPTIONS if key in values and is_given(ctx, key)} | {"eval": True}
    names = [real_path(path).name for path in paths]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two scenes are called {name}: rename one of the folders")
    for path in paths:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder: check its name")
    background = common.get("background", BLACK)
    return common, (load_recorded_scene(path, reading, background) for path in paths)


def distinct_numbers(groups: tuple[tuple[int, ...], ...]) -> list[int]:
    """Return all numbers of an option once, in the order of the command line."""
    return list(dict.fromkeys(number for group in groups for number in group))


def report_run(run: Run, record: Record | None) -> None:
    """Print the name of a run before it starts, and its result after it."""
    if record is None:
        click.echo(str(run), err=True)
    elif record["failed"]:
        click.echo(f"{run}: failed: {record['failed']}", err=True)
    else:
        click.echo(
            f"{run}: PSNR {record['psnr']:.2f} dB, SSIM {record['ssim']:.4f}, {record['splats']} splats, "
            f"{duration(record['seconds'])}",
            err=True,
        )

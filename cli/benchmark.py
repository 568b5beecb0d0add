"""`clsplat benchmark`: train the scenes of a published set by its protocol, and print the published figures beside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from clsplat.benchmark.sets import SETS
from clsplat.comparison.methods import DEFAULT, parse_methods

from .compare import distinct_numbers, report_run
from .comparison_options import check_devices_of_runs, cluster_option, grid_options
from .options import (
    PATH,
    TrainingCommand,
    config_options,
    config_values,
    photo_options,
    quiet_option,
    warn_without_effect,
)
from .progress import TrainingDisplay, table

_COMMON = (
    "output",
    "systems",
    "caps",
    "seeds",
    "iterations",
    "images",
    "resolution",
    "photos",
    "lpips",
    "cluster",
    "device",
    "quiet",
)


@click.command(
    "benchmark",
    cls=TrainingCommand,
    sections={"Common options": _COMMON},
    examples=(
        (
            "clsplat benchmark nerf-synthetic SETS -o results",
            "All scenes of a set in the folder SETS, as published.",
        ),
        ("clsplat benchmark llff SETS -o results --photos 3", "Train on three photos of each scene."),
    ),
    see_also=("compare",),
)
@click.argument("name", metavar="SET", type=click.Choice(SETS))
@click.argument("folder", type=PATH)
@grid_options(
    output="Folder of the models, runs and tables.  [default: benchmark-SET]",
    default_output=True,
    systems=(DEFAULT,),
    also_systems=("--preset",),
    about_systems="Systems to train, as in `clsplat compare`.",
    caps="the published number of each scene",
    lengths=False,
)
@click.option(
    "--iterations",
    "--steps",
    type=click.IntRange(min=1),
    metavar="N",
    help="Number of training steps.  [default: as published, 30000]",
)
@photo_options
@click.option(
    "--photos",
    type=click.IntRange(min=1),
    metavar="N",
    help="Train on N photos of each scene: 3, 6 or 9 of LLFF, 12 or 24 of Mip-NeRF 360 have published figures.  "
    "[default: all]",
)
@click.option("--lpips", is_flag=True, help="Measure LPIPS too; needs the extra lpips.")
@cluster_option
@quiet_option
@config_options("shape", "cap_max", "seed", "iterations", "save_iterations", "test_iterations")
@click.pass_context
def benchmark(
    ctx: click.Context,
    /,
    name: str,
    folder: Path,
    output: Path | None,
    systems: str,
    caps: tuple[tuple[int, ...], ...],
    seeds: tuple[tuple[int, ...], ...],
    iterations: int | None,
    images: str | None,
    resolution: int | None,
    photos: int | None,
    lpips: bool,
    cluster: str | None,
    quiet: bool,
    **values: Any,
) -> None:
    """Train the scenes of a published set by its protocol, and print their quality beside published figures.

    SET is nerf-synthetic, mipnerf360, tanks, deepblending or llff. FOLDER holds the set's scenes in folders with their
    names, or is one of them. Scenes that are not there are left out.

    The set fixes photos, test views, background and the length of the runs. Options change them, and the tables say so.
    DIR gets SET.md, SET.csv, SET.json, runs.jsonl and the models. Finished runs there are not repeated. After Ctrl-C,
    the same command continues.
    """
    from clsplat.benchmark.results import WORDS, result_notes, result_tables
    from clsplat.benchmark.run import run_benchmark
    from clsplat.benchmark.sets import benchmark_set

    check_devices_of_runs(values.get("device"), cluster)
    methods = parse_methods(systems)
    common = config_values(ctx, values)
    if iterations is not None:
        common["iterations"] = iterations
    warn_without_effect([method.config(1, 0, common) for method in methods], common)
    with TrainingDisplay(quiet) as display:
        records = run_benchmark(
            name,
            folder,
            methods,
            output,
            caps=distinct_numbers(caps),
            seeds=distinct_numbers(seeds) or [0],
            common=common,
            images=images,
            resolution=resolution,
            photos=photos,
            lpips=lpips,
            cluster=cluster,
            progress=display,
            on_run=None if quiet else report_run,
        )
    if quiet:
        return
    chosen = benchmark_set(name, photos)
    for each in result_tables(chosen, records):
        click.echo(f"{each.title}\n{table(each.head, each.rows, WORDS)}\n")
    for note in result_notes(chosen, records):
        click.echo(note)

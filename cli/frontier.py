"""`clsplat frontier`: train systems at several caps or lengths, and write charts and a page that shows them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.comparison.methods import parse_methods
from clsplat.splats.shapes import DEFAULT_SHAPE, SHAPES

from .compare import distinct_numbers, options_and_scenes, report_run
from .comparison_options import check_devices_of_runs, cluster_option, comparison_sections, grid_options
from .options import (
    PATH,
    TrainingCommand,
    config_options,
    hiding_options,
    photo_options,
    quiet_option,
    split_options,
)
from .progress import TrainingDisplay, table

if TYPE_CHECKING:
    from clsplat.comparison.table import Record

CAPS = (1000, 2500, 5000, 10_000)
SYSTEMS = (next(iter(SHAPES)), DEFAULT_SHAPE)


@click.command(
    "frontier",
    cls=TrainingCommand,
    sections=comparison_sections("curve", "repeat", "add", "charts_only"),
    examples=(
        (
            "clsplat frontier SCENE -o out --systems 3dgs,default --iterations 500,1000",
            "Quality against the time of training.",
        ),
        (
            "clsplat frontier SCENE -o out --cap-max 1000,5000,20000",
            "Quality against the number of splats and bytes.",
        ),
    ),
    see_also=("compare",),
)
@click.argument("scenes", nargs=-1, type=PATH)
@grid_options(
    output="Folder of the runs, charts and page.",
    systems=SYSTEMS,
    about_systems="Systems as in `clsplat compare`. The first one is the reference for equal quality and equal time.",
    caps=CAPS,
    about_seeds=" Three or more also make a chart of their spread.",
)
@click.option(
    "--repeat",
    type=click.IntRange(1, 1000),
    default=1,
    show_default=True,
    metavar="N",
    help="Train the first seed N times, to compare the splats bit by bit.",
)
@click.option(
    "--curve",
    type=click.IntRange(0, 1000),
    default=12,
    show_default=True,
    metavar="N",
    help="Measure the test views at N iterations of each run. 0: only at its end.",
)
@click.option(
    "--add",
    type=PATH,
    multiple=True,
    metavar="DIR",
    help="Also draw the runs of this folder, such as those of another comparison.",
)
@click.option("--charts-only", is_flag=True, help="Draw the existing runs, without training.")
@photo_options
@hiding_options
@split_options()
@cluster_option
@quiet_option
@config_options(
    *("shape", "cap_max", "seed", "iterations", "save_iterations", "test_iterations"),
    *("checkpoint_interval", "checkpoint_minutes"),
)
@click.pass_context
def draw_frontier(
    ctx: click.Context,
    /,
    scenes: tuple[Path, ...],
    output: Path,
    systems: str,
    caps: tuple[tuple[int, ...], ...],
    lengths: tuple[tuple[int, ...], ...],
    seeds: tuple[tuple[int, ...], ...],
    repeat: int,
    curve: int,
    add: tuple[Path, ...],
    charts_only: bool,
    cluster: str | None,
    quiet: bool,
    **values: Any,
) -> None:
    """Train the systems on SCENES and chart quality against time, render time, bytes and splats.

    Several caps (--cap-max) make the charts of render time, bytes and splats, and several lengths of the runs
    (--iterations) the chart of training time.

    The command writes DIR/report.html, DIR/charts (PNG, SVG, and their data as CSV and JSON) and the files of `clsplat
    compare`. Existing runs are not repeated. After Ctrl-C, the charts show the finished runs, and the same command
    continues.
    """
    from clsplat.comparison.runs import distinct, read_runs
    from clsplat.comparison.sweep import sweep, write_report

    if charts_only == bool(scenes):
        raise click.UsageError("give scenes, or --charts-only to draw the existing runs")
    methods = parse_methods(systems)
    more = [record for path in add for record in read_runs(path)]
    if charts_only:
        records = read_runs(output)
        write_report(output, [*records, *more], reference=methods[0].label)
    else:
        check_devices_of_runs(values.get("device"), cluster)
        common, loaded = options_and_scenes(ctx, scenes, methods, values)
        with TrainingDisplay(quiet) as display:
            records = sweep(
                loaded,
                methods,
                output,
                distinct_numbers(caps) or CAPS,
                distinct_numbers(seeds) or [0],
                common,
                lengths=distinct_numbers(lengths),
                curve=curve,
                repeat=repeat,
                more=more,
                cluster=cluster,
                progress=display,
                on_run=None if quiet else report_run,
            )
    if not quiet:
        report(distinct([*records, *more]), methods[0].label)
        click.echo(f"{output / 'report.html'}: charts and tables")


def report(records: list[Record], reference: str) -> None:
    """Print the tables that the charts do not show: all runs, splats at equal quality, and quality in equal time."""
    from clsplat.comparison.length_rows import equal_time_rows, length_rows
    from clsplat.comparison.sweep_rows import equal_rows, point_rows
    from clsplat.comparison.sweep_tables import equal_table, equal_time_table
    from clsplat.comparison.table import HEAD, cells, summarise

    click.echo(table(HEAD, map(cells, summarise(records))))
    equal = equal_rows(point_rows(records), reference)
    if equal:
        click.echo("\nsplats needed for the PSNR of the first system:\n" + table(*equal_table(equal, reference)))
    leads = equal_time_rows(length_rows(records), reference)
    if leads:
        click.echo("\nlead over the first system in equal time [dB]:\n" + table(*equal_time_table(leads, reference)))

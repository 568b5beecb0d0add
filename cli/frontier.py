"""`clsplat frontier`: a sweep of systems and caps, its charts and the page that shows them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.comparison.methods import parse_methods
from clsplat.splats.shapes import DEFAULT_SHAPE, SHAPES

from .compare import flat, options_and_scenes, say_run
from .options import (
    PATH,
    Numbers,
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


@click.command("frontier", cls=TrainingCommand)
@click.argument("scenes", nargs=-1, type=PATH)
@click.option("-o", "--output", required=True, type=PATH, metavar="DIR", help="Folder of the runs, charts and page.")
@click.option(
    "--systems",
    default=",".join(SYSTEMS),
    show_default=True,
    metavar="NAME,NAME,...",
    help="As of `clsplat compare`; the splats of the others are counted against the first.",
)
@click.option(
    "--cap-max",
    "caps",
    type=Numbers("caps"),
    multiple=True,
    help=f"Most splats.  [default: {','.join(map(str, CAPS))}]",
)
@click.option("--seeds", type=Numbers("seeds", 0), multiple=True, help="A run for each; 3 make a chart.  [default: 0]")
@click.option(
    "--repeat",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    metavar="N",
    help="Train the first seed N times: are the splats the same, bit by bit?",
)
@click.option(
    "--curve",
    type=click.IntRange(min=0),
    default=12,
    show_default=True,
    metavar="N",
    help="Measure the test views at N iterations along each run; 0: at its end only.",
)
@click.option(
    "--add",
    type=PATH,
    multiple=True,
    metavar="DIR",
    help="Draw the runs of this folder as well, such as another comparison's.",
)
@click.option("--charts-only", is_flag=True, help="Train nothing: draw what is there.")
@photo_options
@hiding_options
@split_options
@quiet_option
@config_options("shape", "cap_max", "seed", "save_iterations", "test_iterations", "checkpoint_interval")
@click.pass_context
def draw_frontier(
    ctx: click.Context,
    /,
    scenes: tuple[Path, ...],
    output: Path,
    systems: str,
    caps: tuple[tuple[int, ...], ...],
    seeds: tuple[tuple[int, ...], ...],
    repeat: int,
    curve: int,
    add: tuple[Path, ...],
    charts_only: bool,
    quiet: bool,
    **values: Any,
) -> None:
    """Train the systems on SCENES at several caps and chart quality against time, render time, bytes and splats.

    Writes DIR/report.html, DIR/charts (PNG, SVG, and their data as CSV and JSON) and what `clsplat compare` writes.
    Runs that are there are not done again; after Ctrl-C the charts show what is there, and the same command goes on.
    """
    from clsplat.comparison.runs import distinct, read_runs
    from clsplat.comparison.sweep import sweep, write_report

    if charts_only == bool(scenes):
        raise click.UsageError("give scenes, or --charts-only to draw the runs that are there")
    contestants = parse_methods(systems)
    more = [record for path in add for record in read_runs(path)]
    if charts_only:
        records = read_runs(output)
        write_report(output, [*records, *more], reference=contestants[0].label)
    else:
        common, loaded = options_and_scenes(ctx, scenes, values)
        with TrainingDisplay(quiet) as display:
            records = sweep(
                loaded,
                contestants,
                output,
                flat(caps) or CAPS,
                flat(seeds) or [0],
                common,
                curve=curve,
                repeat=repeat,
                more=more,
                progress=display,
                on_run=None if quiet else say_run,
            )
    if not quiet:
        report(distinct([*records, *more]), contestants[0].label)
        click.echo(f"{output / 'report.html'}: charts and tables")


def report(records: list[Record], reference: str) -> None:
    """The tables that charts do not hold: all runs, and splats at equal quality."""
    from clsplat.comparison.sweep_rows import equal_rows, point_rows
    from clsplat.comparison.sweep_tables import equal_table
    from clsplat.comparison.table import HEAD, cells, summarise

    click.echo(table(HEAD, map(cells, summarise(records))))
    equal = equal_rows(point_rows(records), reference)
    if equal:
        click.echo("\nsplats needed for the PSNR of the first system:\n" + table(*equal_table(equal, reference)))

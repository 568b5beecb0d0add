"""`clsplat train --blocks` and `clsplat partition`: large scenes in parts."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from clsplat.blocks.cells import parse_blocks
from clsplat.blocks.state import BlocksOptions
from clsplat.files.stop_signals import exit_code
from clsplat.training.config import TrainConfig

from .options import F
from .progress import TrainingDisplay, report_test_views, resume_command, table

if TYPE_CHECKING:
    from clsplat.blocks.partition import Partition
    from clsplat.scenes.scene import Scene


ONE_MODEL = ("save_iterations", "test_iterations")
BLOCKS_HELP = (
    "Divide a large scene into N x M blocks, which are trained one by one or on workers. auto: blocks of 200000 splats "
    "at most."
)


def blocks_options(function: F) -> F:
    """Add `--blocks` and `--polish`."""
    for option in (
        click.option(
            "--polish",
            type=click.IntRange(min=0),
            metavar="N",
            help="Iterations that train all blocks together at the end.  [default: half of --iterations]",
        ),
        click.option(
            "--blocks",
            metavar="NxM|auto",
            help=f"{BLOCKS_HELP} --cap-max is that of the whole model, and --iterations are those of each block.",
        ),
    ):
        function = option(function)
    return function


def given_blocks(values: dict[str, Any], resume: bool = False) -> Callable[[TrainConfig], BlocksOptions] | None:
    """Remove the options of blocks from `values`.

    Returns
    -------
    A function that returns them for the options of the training; None if no blocks were requested.
    """
    blocks, polish = values.pop("blocks"), values.pop("polish")
    if blocks is None:
        if polish is not None and resume:
            raise click.UsageError("--polish stays as it was when a training goes on: remove it")
        if polish is not None:
            raise click.UsageError("--polish is for trainings in blocks: give --blocks too")
        return None
    return lambda config: BlocksOptions(*parse_blocks(blocks, config.cap_max), polish)


def run_blocks(
    ctx: click.Context,
    scene: Scene,
    config: TrainConfig,
    options: BlocksOptions,
    model_path: Path,
    resume: bool,
    overwrite: bool,
    quiet: bool,
    cluster: str | None,
) -> None:
    """Train in blocks with a live display, and print the result."""
    warn_of_single_model(config, "--blocks", ONE_MODEL)  # validate is refused
    from clsplat.blocks.train import train_in_blocks
    from clsplat.training.run import evaluate_test_views

    try:
        with TrainingDisplay(quiet) as display:
            result = train_in_blocks(
                scene,
                options,
                config,
                display,
                output=model_path,
                resume=resume,
                overwrite=overwrite,
                cluster=cluster,
            )
    except KeyboardInterrupt:
        report_interruption(ctx, model_path, cluster)
    if quiet:
        return
    head = ("block", "photos", "splats", "around it", "seconds", "MB of device", "MB in all")
    rows = [
        (
            str(row["number"]),
            str(row["views"]),
            str(row["splats"]),
            str(row["context"]),
            f"{row['seconds']:.0f}",
            f"{row['device_bytes'] / 1e6:.0f}",
            f"{row['peak_bytes'] / 1e6:.0f}",
        )
        for row in result.report["blocks"]
    ]
    click.echo(table(head, rows))
    click.echo(f"{result.path}: {len(result.splats)} splats, {result.path.stat().st_size / 1e6:.2f} MB")
    decided = TrainConfig.from_json(result.report["config"]).replace(device=config.device)
    report_test_views(evaluate_test_views(result.splats, scene, decided))


def warn_of_single_model(config: TrainConfig, flag: str, names: Sequence[str] = (*ONE_MODEL, "validate")) -> None:
    """Warn about options that write or measure models before the last one. Trainings with `flag` ignore them."""
    for name in names:
        if config.named_options.get(name):
            warnings.warn(f"--{name.replace('_', '-')} has no effect with {flag}", stacklevel=2)


def report_interruption(ctx: click.Context, model_path: Path, cluster: str | None = None) -> NoReturn:
    """Print how to continue after Ctrl-C or another signal, and exit."""
    click.echo(f"interrupted, finished steps are kept; to continue: {resume_command(model_path, cluster)}", err=True)
    ctx.exit(exit_code())


def partition_table(partition: Partition) -> str:
    """Return a line for each block: its splats, points and photos."""
    head = ("block", "splats", "points", "photos", "most of a photo")
    rows = [
        (
            str(block.number),
            str(block.splats),
            str(block.points),
            str(len(block.views)),
            f"{max(block.shares, default=0):.0%}",
        )
        for block in partition.blocks
    ]
    return table(head, rows)

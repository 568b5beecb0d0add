"""`clsplat train --budget auto`: the search for the smallest model, its messages, and its chart."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.compression.rules import TOLERANCE, BudgetOptions
from clsplat.training.config import TrainConfig

from .blocks import report_interruption, warn_of_single_model
from .options import Decibels, F
from .progress import TrainingDisplay, report_test_views

if TYPE_CHECKING:
    from clsplat.compression.search import Budgeted
    from clsplat.scenes.scene import Scene

KEYS = ("budget", "budget_tolerance", "target_psnr", "max_bytes")


def budget_options(function: F) -> F:
    """Add `--budget`, `--budget-tolerance`, `--target-psnr` and `--max-bytes`."""
    for option in (
        click.option(
            "--max-bytes",
            type=click.IntRange(min=1),
            metavar="N",
            help="Search for the best model whose file has at most N bytes; implies --budget auto.",
        ),
        click.option(
            "--target-psnr",
            type=Decibels(),
            metavar="DB",
            help="Search for the smallest model with this PSNR on validation views; implies --budget auto.",
        ),
        click.option(
            "--budget-tolerance",
            type=Decibels(),
            metavar="DB",
            help="Loss of PSNR on validation views that the search for a smaller model may accept; implies --budget "
            f"auto.  [default: {TOLERANCE:g}]",
        ),
        click.option(
            "--budget",
            type=click.Choice(["auto"]),
            help="Search for the smallest model that is as good as the one with --cap-max splats, on views held out of "
            "training for it. Test views may lose more. The search takes the time of two to five runs.",
        ),
    ):
        function = option(function)
    return function


def search_options(values: dict[str, Any]) -> BudgetOptions | None:
    """Remove the options of the search from `values` and return them; None if no search was requested."""
    search = {key: values.pop(key) for key in KEYS}
    if all(value is None for value in search.values()):
        return None
    tolerance = search["budget_tolerance"]
    return BudgetOptions(TOLERANCE if tolerance is None else tolerance, search["target_psnr"], search["max_bytes"])


def run_search(
    ctx: click.Context,
    scene: Scene,
    config: TrainConfig,
    options: BudgetOptions,
    model_path: Path,
    resume: bool,
    overwrite: bool,
    quiet: bool,
    cluster: str | None = None,
) -> None:
    """Run the search with a live display, and print its result."""
    warn_of_single_model(config, "--budget")
    from clsplat.comparison.search_chart import draw_search
    from clsplat.compression.search import train_budget
    from clsplat.training.run import evaluate_test_views

    try:
        with TrainingDisplay(quiet) as display:
            result = train_budget(
                scene,
                config,
                options,
                display,
                output=model_path,
                resume=resume,
                overwrite=overwrite,
                cluster=cluster,
            )
    except KeyboardInterrupt:
        report_interruption(ctx, model_path, cluster)
    charts = draw_search(result.report, model_path)
    if (missed := result.report["final"]["missed"]) is not None:
        warnings.warn(missed, stacklevel=2)
    if quiet:
        return
    for line in result_lines(result):
        click.echo(line)
    if charts:
        click.echo(f"chart of the rounds: {', '.join(str(file) for file in charts)}")
    decided = TrainConfig.from_json(result.report["config"]).replace(device=config.device)
    report_test_views(evaluate_test_views(result.splats, scene, decided))


def result_lines(result: Budgeted) -> list[str]:
    """Return the lines that describe the result of the search."""
    report, final = result.report, result.report["final"]
    held_out = report["held_out"]
    return [
        f"rounds: {final['splats']} of {report['rounds'][0]['splats']} splats remain",
        f"validation views: PSNR {held_out['psnr_pruned']:.2f} dB, with all splats and parameters "
        f"{report['rounds'][0]['psnr']:.2f} dB",
        f"{result.path}: {final['splats']} splats, {final['skewed_fraction']:.0%} skewed, "
        f"{final['parameters_in_use']} parameters, {final['bytes'] / 1e6:.2f} MB; {result.seconds:.0f} s in total",
    ]

"""`clsplat eval`: metrics of trained models on views of their scenes, in 3DGS's files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.evaluation.metrics import DEFAULT_PROTOCOL, PROTOCOLS, MetricProtocol, protocol_named

from .command import SectionedCommand
from .models import scene_choice
from .options import (
    PATH,
    background_of,
    background_options,
    changed_photos_option,
    device_option,
    hiding_options,
    iteration_option,
    overwrite_option,
    quiet_option,
    scene_options,
    set_option,
)
from .progress import ViewCount, table

if TYPE_CHECKING:
    from clsplat.models.measurements import ModelEvaluation

_DIGITS = {"PSNR": 3, "SSIM": 4, "LPIPS": 4, "FLIP": 4}


SECTIONS = {
    "Common options": (
        "source_path",
        "view_set",
        "resolution",
        "white_background",
        "lpips",
        "flip",
        "report",
        "save_renders",
        "overwrite",
        "device",
        "quiet",
    ),
    "Models": ("more_models", "iteration", "background"),
    "Photos": ("images", "masks", "alpha", "test_every", "test_list", "allow_changed_photos"),
    "Metrics": ("compat", "color_correct"),
    "Files": ("no_report", "numbers"),
}


@click.command(
    "eval",
    cls=SectionedCommand,
    sections=SECTIONS,
    examples=(
        ("clsplat eval MODEL", "Measure the test views and write a page with the images."),
        ("clsplat eval MODEL OTHER --report both.html", "Compare two models on one page."),
        ("clsplat eval FILE.ply -s SCENE", "Measure splats of another program."),
    ),
    see_also=("train", "compare"),
)
@click.argument("models", nargs=-1, type=PATH)
@click.option("-m", "--model-path", "more_models", type=PATH, multiple=True, help="The same as an argument.")
@scene_options
@hiding_options
@click.option(
    "--test-every",
    type=int,
    metavar="N",
    help="Every Nth of the sorted views is a test view, for models that do not record their test views.  [default: 8]",
)
@click.option(
    "--test-list",
    type=PATH,
    metavar="FILE",
    help="Names of the test views, one per line, for models that do not record their test views.",
)
@changed_photos_option
@set_option
@click.option(
    "--compat",
    type=click.Choice(list(PROTOCOLS)),
    default=DEFAULT_PROTOCOL.name,
    show_default=True,
    help="How PSNR and SSIM are computed; 3dgs pads SSIM with zeros.",
)
@click.option(
    "--color-correct",
    is_flag=True,
    help="Measure and show each render after the affine map of colours that brings it nearest to its photo.",
)
@click.option("--lpips", is_flag=True, help="Also measure LPIPS, with VGG16 (pip install 'clsplat[lpips]').")
@click.option(
    "--flip", is_flag=True, help="Also measure FLIP, and show its maps in the report (pip install 'clsplat[flip]')."
)
@click.option(
    "--report",
    type=PATH,
    metavar="FILE",
    help="File of one page with all models.  [default: report.html in each model folder, none for files of splats]",
)
@click.option("--no-report", is_flag=True, help="Write no page.")
@click.option("--json", "numbers", type=PATH, metavar="FILE", help="Also write all numbers to this file.")
@click.option("--save-renders", type=PATH, metavar="DIR", help="Also write the images as PNG.")
@background_options
@iteration_option
@overwrite_option("the files of --report, --json and --save-renders that are there")
@device_option
@quiet_option
def evaluate_models(
    models: tuple[Path, ...],
    more_models: tuple[Path, ...],
    report: Path | None,
    no_report: bool,
    numbers: Path | None,
    save_renders: Path | None,
    iteration: int | None,
    overwrite: bool,
    device: str | None,
    quiet: bool,
    **values: Any,
) -> None:
    """Measure MODELS on the test views of their scenes.

    Writes results.json, per_view.json and report.html, a page with the images, into each model folder (with --set
    train or all: results_train.json and so on). A model may also be a file of splats: name its scene with -s. Nothing
    is written for it unless --report, --json or --save-renders name a place.
    """
    from clsplat.models import evaluation

    paths = (*more_models, *models)
    if not paths:
        raise click.UsageError("give at least one model folder or file of splats")
    if report is not None and no_report:
        raise click.UsageError("give --report or --no-report, not both")
    options = evaluation.EvaluationOptions(
        values["view_set"] or "test",
        replace(protocol_named(values["compat"]), corrected=values["color_correct"]),
        values["lpips"],
        values["flip"],
        background_of(values["background"], values["white_background"]),
        replace(scene_choice(values), **{name: values[name] for name in ("masks", "alpha", "test_every", "test_list")}),
        report=not no_report,
    )
    with ViewCount("measuring", quiet) as progress:
        measured = evaluation.evaluate_models(
            paths,
            options,
            comparison=report,
            iteration=iteration,
            overwrite=overwrite,
            renders=save_renders,
            numbers=numbers,
            device=device,
            progress=progress,
        )
    if not quiet:
        click.echo(_table(paths, measured))
        for path, model in zip(paths, measured, strict=True):
            if model.floaters is not None:
                click.echo((f"{path}: " if len(paths) > 1 else "") + model.floaters.describe())
        click.echo(describe(options.protocol))
        pages = [model.report for model in measured] if report is None else [report]
        for page in pages:
            if page is not None:
                click.echo(f"page: {page}")
    for model in measured:
        if model.write_error is not None:
            raise model.write_error


def describe(protocol: MetricProtocol) -> str:
    """Return one line on how the numbers were computed."""
    texts = protocol.describe()
    return f"protocol {texts['name']}: PSNR {texts['PSNR']}; SSIM {texts['SSIM']}"


def _table(paths: Sequence[Path], measured: Sequence[ModelEvaluation]) -> str:
    metrics = [metric for metric in _DIGITS if metric in measured[0].result]
    rows = [
        (
            str(path),
            str(model.result["splats"]),
            *(f"{model.result[name]:.{_DIGITS[name]}f}" for name in metrics),
            f"{model.result['render_ms']:.1f}",
            f"{model.result['bytes'] / 1e6:.2f}",
        )
        for path, model in zip(paths, measured, strict=True)
    ]
    return table(("model", "splats", *metrics, "render ms", "MB"), rows)

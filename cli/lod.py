"""`clsplat lod`: levels of detail of a model, what they cost and what they save."""

from __future__ import annotations

from pathlib import Path

import click

from .command import DocumentedCommand
from .options import PATH, detail_option, device_option, iteration_option, overwrite_option, quiet_option
from .progress import table


@click.command(
    "lod",
    cls=DocumentedCommand,
    examples=(
        ("clsplat lod MODEL", "What each level costs, and what they save from far away."),
        ("clsplat lod MODEL -o levels", "Each level as a file, too."),
        ("clsplat render MODEL -o renders --detail 0.25", "Images with levels of detail."),
    ),
    see_also=("render", "view", "convert"),
)
@click.argument("model", type=PATH, metavar="MODEL_OR_PLY")
@click.option(
    "-o", "--output", type=PATH, metavar="DIR", help="Folder for the levels after the first one, a PLY file each."
)
@click.option(
    "--levels",
    type=click.IntRange(2, 12),
    default=8,
    show_default=True,
    metavar="N",
    help="Number of levels. Each one has about half of the splats of the one before.",
)
@detail_option(0.25)
@iteration_option
@overwrite_option("the levels that are there")
@device_option
@quiet_option
def lod(
    model: Path,
    output: Path | None,
    levels: int,
    detail: float,
    iteration: int | None,
    overwrite: bool,
    device: str | None,
    quiet: bool,
) -> None:
    """Merge the splats of MODEL_OR_PLY in levels of detail, and measure them.

    The first table has each level as a whole, against the model. The second one has images from farther away, where
    each part of the scene is as coarse as --detail allows. `render` and `view` have --detail, too.
    """
    from clsplat.models.lod import model_levels

    found = model_levels(model, levels, output=output, iteration=iteration, overwrite=overwrite)
    if quiet:
        return
    whole, distances = found.measure(detail, device)
    rows = [(str(one.level), str(one.splats), f"{one.psnr:.1f}") for one in whole]
    click.echo(table(("level", "splats", "PSNR [dB]"), rows))
    click.echo()
    lines = [
        (
            f"{one.factor}x",
            f"{one.splats:.0f}",
            f"{one.splats / one.whole:.0%}",
            *(f"{value:.1f}" for value in (one.ms, one.whole_ms, one.psnr)),
        )
        for one in distances
    ]
    click.echo(table(("distance", "splats", "of all", "ms", "ms, whole", "PSNR [dB]"), lines))
    for file in found.files:
        click.echo(str(file))
    if output is not None and not found.files:
        click.echo("no files: these splats have a single level")

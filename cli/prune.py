"""`clsplat prune`: a model without the parts that its images do not need."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .command import DocumentedCommand
from .models import scene_choice
from .options import (
    PATH,
    Decibels,
    changed_photos_option,
    device_option,
    iteration_option,
    overwrite_option,
    quiet_option,
    scene_options,
)
from .progress import TrainingDisplay

if TYPE_CHECKING:
    from clsplat.models.prune import PrunedModel


@click.command(
    "prune",
    cls=DocumentedCommand,
    examples=(
        ("clsplat prune MODEL -o small.ply", "As small as a loss of 0.1 dB allows."),
        (
            "clsplat prune MODEL -o small.ply --tolerance 0.5 --iterations 200",
            "Smaller, with some training between the rounds.",
        ),
    ),
    see_also=("clean", "convert"),
)
@click.argument("model", type=PATH)
@scene_options
@changed_photos_option
@click.option("-o", "--output", required=True, type=PATH, metavar="FILE", help="The PLY file to write.")
@click.option(
    "--tolerance", type=Decibels(), default=0.1, show_default=True, help="Allowed loss of PSNR on the validation views."
)
@click.option(
    "--iterations",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    metavar="N",
    help="Iterations of training after each round that removes a quarter of the splats. 0: no training.",
)
@click.option("--whole", is_flag=True, help="Write all columns of 3DGS, for programs that read no other files.")
@iteration_option
@overwrite_option()
@device_option
@quiet_option
def prune_model(model: Path, output: Path, whole: bool, quiet: bool, **values: Any) -> None:
    """Write MODEL, a folder or any splat PLY, without the splats, skew and SH bands that its images do not need.

    Some training views are held out to measure the loss. Their PSNR falls by no more than the tolerance. Test views are
    never used. A PLY file needs the scene (-s); every eighth of its views is then a test view.
    """
    from clsplat.models.prune import prune_model as prune

    scene = scene_choice(values)
    with TrainingDisplay(quiet) as display:
        pruned = prune(model, output, compact=not whole, scene=scene, progress=display, **values)
    if not quiet:
        for line in _summary(pruned):
            click.echo(line)


def _summary(result: PrunedModel) -> list[str]:
    """Return lines on the removed parts and the loss of quality."""
    from clsplat.splats.stats import complexity

    pruned, output = result.pruned, result.output
    old, new = complexity(result.source.splats), complexity(pruned.splats)
    old_bytes, new_bytes = result.source_bytes, output.stat().st_size
    lines = [f"{output}: {new_bytes / 1e6:.2f} MB, {new_bytes / old_bytes:.0%} of {old_bytes / 1e6:.2f} MB"]
    kinds = [("splats", "splats", new.splats, old.splats)]
    kinds += [(name, f"splats with {name}", new.fields[name], count) for name, count in old.fields.items()]
    kinds.append(("bands", "SH coefficients", sum(new.coefficients), sum(old.coefficients)))
    for kind, what, left, total in kinds:
        cost = f", {pruned.costs[kind]:+.3f} dB lost" if kind in pruned.costs else ""
        lines.append(f"{what}: {left} of {total}{cost}")
    lines.append(f"validation views: PSNR {pruned.after:.2f} dB, was {pruned.before:.2f} dB")
    return lines

"""`clsplat clean`: a model without floaters, oversized splats and splats that no training view sees."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .command import SectionedCommand
from .models import cost_line, missing_numbers, scene_choice
from .options import (
    PATH,
    Decibels,
    background_of,
    background_options,
    changed_photos_option,
    device_option,
    is_given,
    iteration_option,
    overwrite_option,
    quiet_option,
    scene_options,
)
from .progress import activity_line, table

if TYPE_CHECKING:
    from clsplat.evaluation.evaluate import Evaluation
    from clsplat.models.clean import CleanedModel

SECTIONS = {
    "Common options": (
        "source_path",
        "output",
        "dry_run",
        "tolerance",
        "min_views",
        "no_photos",
        "white_background",
        "overwrite",
        "device",
        "quiet",
    ),
    "Model": ("iteration", "background"),
    "Photos": ("images", "resolution", "allow_changed_photos"),
}


@click.command(
    "clean",
    cls=SectionedCommand,
    sections=SECTIONS,
    examples=(
        ("clsplat clean MODEL --dry-run", "What would be removed, and what it would cost."),
        ("clsplat clean MODEL -s SCENE -o cleaned.ply", "Remove it, and write a file of splats."),
    ),
    see_also=("prune", "view"),
)
@click.argument("model", type=PATH)
@scene_options
@changed_photos_option
@click.option(
    "-o",
    "--output",
    type=PATH,
    metavar="PATH",
    help="A file to write (.ply, .splat, .spz, .sog, .glb or USD), or the folder of a new model.",
)
@click.option("--dry-run", is_flag=True, help="Print what would be removed, and write nothing.")
@click.option(
    "--tolerance", type=Decibels(), default=0.05, show_default=True, help="Allowed loss of PSNR on the training views."
)
@click.option(
    "--min-views",
    type=click.IntRange(min=1),
    default=3,
    show_default=True,
    metavar="N",
    help="Splats that fewer training views see are candidates for removal.",
)
@click.option("--no-photos", is_flag=True, help="Use only the rules that need no photos. Nothing is then measured.")
@background_options
@iteration_option
@overwrite_option()
@device_option
@quiet_option
@click.pass_context
def clean_model(
    ctx: click.Context,
    /,
    model: Path,
    output: Path | None,
    dry_run: bool,
    no_photos: bool,
    quiet: bool,
    **values: Any,
) -> None:
    """Remove floaters from MODEL, a folder or any file of splats.

    Oversized, isolated and invisible splats go too. The training photos judge every rule: their PSNR falls by no more
    than the tolerance. Test views are measured, but decide nothing. A file needs the scene (-s); without it, only rules
    that need no photos are used.
    """
    from clsplat.models.clean import clean_model as clean

    if (output is None) != dry_run:
        raise click.UsageError("give the output with -o, or --dry-run to write nothing")
    scene = scene_choice(values)
    background = background_of(values.pop("background"), values.pop("white_background"))
    if no_photos and scene.path is not None:
        raise click.UsageError("give -s or --no-photos, not both")
    if no_photos and any(is_given(ctx, name) for name in ("tolerance", "min_views")):
        raise click.UsageError("--tolerance and --min-views are for rules that need photos: remove --no-photos")
    with activity_line(quiet):
        result = clean(
            model, output, scene=scene, background=background, use_photos=False if no_photos else None, **values
        )
    if not quiet:
        for line in (*_summary(result), *_losses(result, values["device"])):
            click.echo(line)


def _summary(result: CleanedModel) -> list[str]:
    """Return lines on what was removed, and on the metrics before and after."""
    from clsplat.cleaning.rules import DESCRIPTIONS

    cleaned = result.cleaned
    rows = [
        (
            f"{rule.rule}: {DESCRIPTIONS[rule.rule]}",
            str(rule.candidates),
            str(rule.removed),
            *([] if cleaned.before is None else [f"{0.0 - round(rule.cost or 0.0, 3):+.3f}"]),
        )
        for rule in cleaned.rules
    ]
    head = ("rule", "candidates", "removed", *([] if cleaned.before is None else ["dB"]))
    lines = [table(head, rows), f"splats: {len(cleaned.splats)} left of {len(result.source.splats)}"]
    if cleaned.before is None:
        lines.append("no photos: nothing was measured; look at the result, or name the scene")
    lines += _measured("training views", cleaned.before, cleaned.after)
    lines += _measured("test views, not used to decide", result.test_before, result.test_after)
    lines.append("nothing was written" if result.output is None else f"written: {result.output}")
    return lines


def _losses(result: CleanedModel, device: str | None) -> list[str]:
    """Return lines on what the written file lacks of the cleaned model."""
    from clsplat.models.convert import conversion_cost

    written = result.written
    if written is None:
        return []
    lines = missing_numbers(written)
    if written.rounds:
        cost = conversion_cost(written, device=device)
        lines.append(f"the file is rounded; {'what that costs was not measured' if cost is None else cost_line(cost)}")
    return lines


def _measured(what: str, before: Evaluation | None, after: Evaluation | None) -> list[str]:
    if before is None or after is None:
        return []
    return [
        f"{what} ({len(before.per_view)}): PSNR {after.psnr:.2f} dB, was {before.psnr:.2f} dB; "
        f"SSIM {after.ssim:.4f}, was {before.ssim:.4f}"
    ]

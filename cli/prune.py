"""`clsplat prune`: a model without what its images do not miss."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from clsplat.errors import InputError, OutputError

from .models import LoadedModel, load_model, scene_of
from .options import PATH, Decibels, device_option, iteration_option, quiet_option, scene_options
from .progress import TrainingDisplay

if TYPE_CHECKING:
    from clsplat.compression.prune import Pruned
    from clsplat.scenes.scene import Scene


@click.command("prune")
@click.argument("model", type=PATH)
@scene_options
@click.option("-o", "--output", required=True, type=PATH, metavar="FILE", help="The PLY file to write.")
@click.option(
    "--tolerance", type=Decibels(), default=0.1, show_default=True, help="PSNR that the validation views may lose."
)
@click.option(
    "--iterations",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Train on after each quarter of the splats that goes; 0: only leave out.",
)
@click.option("--whole", is_flag=True, help="Write all columns of 3DGS, for programs that know no other files.")
@iteration_option
@click.option("--overwrite", is_flag=True, help="Replace the file that is there.")
@device_option
@quiet_option
def prune_model(
    model: Path,
    source_path: Path | None,
    images: str | None,
    resolution: int | None,
    output: Path,
    tolerance: float,
    iterations: int,
    whole: bool,
    iteration: int | None,
    overwrite: bool,
    device: str | None,
    quiet: bool,
) -> None:
    """Write MODEL, a folder or any splat PLY, without splats, skew and SH bands that its images do not miss.

    Some training views are held out to measure the loss: their PSNR falls by no more than the tolerance.
    Test views are never used.
    A PLY needs the scene, -s; every 8th of its views then counts as a test view.
    """
    if output.is_dir():
        raise OutputError(f"{output}: is a folder: name the PLY file to write")
    if output.exists() and not overwrite:
        raise OutputError(f"{output}: exists already: use --overwrite or another name")
    loaded = load_model(model, iteration)
    if not len(loaded.splats):
        raise InputError(f"{model}: has no splats")
    scene = scene_of(loaded, source_path, images, resolution)
    with TrainingDisplay(quiet) as display:
        pruned = pruned_model(loaded, scene, tolerance, iterations, device, display)
    pruned.splats.save(output, compact=not whole)
    if not quiet:
        for line in lines_of(loaded, pruned, output):
            click.echo(line)


def pruned_model(
    loaded: LoadedModel, scene: Scene, tolerance: float, iterations: int, device: str | None, display: TrainingDisplay
) -> Pruned:
    """The smaller model, and what it cost."""
    from clsplat.compression.prune import SHARES, Validation, prune
    from clsplat.device.device import open_device
    from clsplat.rendering.renderer import Renderer
    from clsplat.scenes.split import hold_out

    opened = open_device(device)
    renderer = Renderer(opened)
    split = hold_out(scene)
    validation = Validation(renderer, split.test, loaded.background)
    splats = loaded.splats
    if not iterations:
        return prune(splats, scene.train, validation, tolerance)
    from clsplat.compression.prune_and_refine import trained_rounds

    before = validation.psnr(splats)
    splats = trained_rounds(
        scene, splats, validation, before - SHARES["splats"] * tolerance, iterations, opened, display
    )
    now = validation.psnr(splats)
    parts = prune(splats, scene.train, validation, max(now - before + tolerance, 0.0), ("fields", "bands"))
    return replace(parts, before=before, costs={"splats": before - now, **parts.costs})


def lines_of(loaded: LoadedModel, pruned: Pruned, output: Path) -> list[str]:
    """What went, and what it cost."""
    from clsplat.splats.stats import complexity

    old, new = complexity(loaded.splats), complexity(pruned.splats)
    was, now = loaded.ply.stat().st_size, output.stat().st_size
    lines = [f"{output}: {now / 1e6:.2f} MB, {now / was:.0%} of {was / 1e6:.2f} MB"]
    kinds = [("splats", "splats", new.splats, old.splats)]
    kinds += [(name, f"splats with {name}", new.fields[name], count) for name, count in old.fields.items()]
    kinds.append(("bands", "SH coefficients", sum(new.coefficients), sum(old.coefficients)))
    for kind, what, left, of in kinds:
        cost = f", {pruned.costs[kind]:+.3f} dB lost" if kind in pruned.costs else ""
        lines.append(f"{what}: {left} of {of}{cost}")
    lines.append(f"validation views: PSNR {pruned.after:.2f} dB, was {pruned.before:.2f} dB")
    return lines

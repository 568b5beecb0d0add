"""`clsplat convert`: a model as another shape."""

from __future__ import annotations

from pathlib import Path

import click

from clsplat.errors import OutputError
from clsplat.shapes import SHAPES

from .models import load_model
from .options import PATH, iteration_option, quiet_option


@click.command("convert")
@click.argument("model", type=PATH)
@click.argument("output", type=PATH)
@click.option("--shape", required=True, type=click.Choice(list(SHAPES)), help="The splat kernel to convert to.")
@iteration_option
@click.option("--overwrite", is_flag=True, help="Replace OUTPUT.")
@quiet_option
def convert_model(model: Path, output: Path, shape: str, iteration: int | None, overwrite: bool, quiet: bool) -> None:
    """Write MODEL, a folder or a PLY, into the PLY file OUTPUT as another shape that shows the same images.

    Only exact conversions are made: where a splat has no equal in the other shape, nothing is written.
    """
    from clsplat.convert import convert

    if output.exists() and not overwrite:
        raise OutputError(f"{output}: exists already: use --overwrite or another name")
    splats = load_model(model, iteration).splats
    converted = convert(splats, shape)
    converted.save(output)
    if not quiet:
        click.echo(f"{output}: {len(converted)} splats, {splats.shape} to {shape}, with the same images")

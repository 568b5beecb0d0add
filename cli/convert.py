"""`clsplat convert`: a model as another shape, or as a file for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from clsplat.errors import InputError, OutputError
from clsplat.shapes import GAUSSIAN, SHAPES

from .models import LoadedModel, load_model, recorded_cameras
from .options import PATH, device_option, iteration_option, quiet_option

if TYPE_CHECKING:
    from clsplat.splats import Splats

_SPLAT = ".splat"


@click.command("convert")
@click.argument("model", type=PATH)
@click.argument("output", type=PATH)
@click.option("--shape", type=click.Choice(list(SHAPES)),
              help="The splat kernel to convert to.  [default: the model's; of a .splat file gaussian]")
@click.option("--approximate", is_flag=True,
              help="Where skewed splats have no equal Gaussian, take the nearest, and measure what it costs.")
@click.option("--cameras", type=PATH, metavar="FILE",
              help="A cameras.json to measure from.  [default: that of the model's folder]")
@iteration_option
@click.option("--overwrite", is_flag=True, help="Replace OUTPUT.")
@device_option
@quiet_option
def convert_model(model: Path, output: Path, shape: str | None, approximate: bool, cameras: Path | None,
                  iteration: int | None, overwrite: bool, device: str | None, quiet: bool) -> None:
    """Write MODEL, a folder or a PLY, into OUTPUT: a PLY of all columns, or a .splat file for viewers in the browser.

    Without --approximate only exact conversions of the shape are made: where a splat has no equal in the other shape,
    nothing is written. A .splat file has no SH bands above 0, whatever the model has.
    """
    from clsplat.convert import convert
    from clsplat.splat_file import write_splat

    if output.suffix.lower() not in (".ply", _SPLAT):
        raise OutputError(f"{output}: writes .ply and {_SPLAT} files: choose one of these endings")
    if output.exists() and not overwrite:
        raise OutputError(f"{output}: exists already: use --overwrite or another name")
    as_splat = output.suffix.lower() == _SPLAT
    loaded = load_model(model, iteration)
    target = shape or (GAUSSIAN.name if as_splat else loaded.splats.shape)
    if as_splat and target != GAUSSIAN.name:
        raise InputError(f"{output}: {_SPLAT} files hold Gaussians: leave --shape out, or write a .ply")
    nearest = approximate and target == GAUSSIAN.name and loaded.splats.skew.any()
    if nearest:
        from clsplat.nearest import nearest_gaussians

        converted = nearest_gaussians(loaded.splats)
    else:
        try:
            converted = convert(loaded.splats, target)
        except InputError as error:
            hint = "; or --approximate" if target == GAUSSIAN.name and loaded.splats.skew.any() else ""
            raise InputError(f"{error}{hint}") from None
    write_splat(output, converted) if as_splat else converted.save(output)
    if quiet:
        return
    said = "each the nearest" if nearest else "with the same images"
    click.echo(f"{output}: {len(converted)} splats, {loaded.splats.shape} to {target}, {said}")
    shown = _first_band(converted) if as_splat else converted
    if nearest or (as_splat and converted.sh_degree):
        click.echo(_cost(loaded, shown, cameras, device))


def _first_band(splats: Splats) -> Splats:
    """What a .splat file holds of the colours."""
    from clsplat.splats import Splats

    return Splats(splats.shape, splats.to_numpy() | {"sh": splats.sh[:, :1]}, splats.normalisation)


def _cost(loaded: LoadedModel, converted: Splats, cameras: Path | None, device: str | None) -> str:
    """How far the images are from the model's own."""
    from clsplat.cameras_json import read_cameras
    from clsplat.evaluate import MAX_PSNR
    from clsplat.metrics import psnr
    from clsplat.render import Renderer

    named = recorded_cameras(loaded) if cameras is None else read_cameras(cameras)
    if not named:
        return "what that costs was not measured: name cameras with --cameras FILE"
    renderer, worst, total = Renderer(device), float("inf"), 0.0
    for entry in named:
        own, new = (renderer.render(splats, entry.camera, loaded.background).color
                    for splats in (loaded.splats, converted))
        value = min(psnr(own, new), MAX_PSNR)
        worst, total = min(worst, value), total + value
    return (f"PSNR against the model's own images, {len(named)} cameras: {total / len(named):.2f} dB, "
            f"worst {worst:.2f} dB")

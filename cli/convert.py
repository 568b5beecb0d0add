"""`clsplat convert`: a model as another shape, or as a file for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from clsplat.errors import InputError, OutputError
from clsplat.splats.fields import MAX_SH_DEGREE, sh_coefficients
from clsplat.splats.shapes import GAUSSIAN, SHAPES

from .models import LoadedModel, load_model, load_splats, recorded_cameras
from .options import PATH, device_option, iteration_option, quiet_option

if TYPE_CHECKING:
    from clsplat.splats.splats import Splats

_PLY = ".ply"
_GAUSSIANS = (".splat", ".spz")  # files that hold no other shape


@click.command("convert")
@click.argument("model", type=PATH)
@click.argument("output", type=PATH)
@click.option(
    "--shape",
    type=click.Choice(list(SHAPES)),
    help="The splat kernel to convert to.  [default: the model's; of .splat and .spz files gaussian]",
)
@click.option(
    "--approximate",
    is_flag=True,
    help="Where splats have no equal Gaussian, take the nearest, and measure what it costs.",
)
@click.option(
    "--sh-degree",
    type=click.IntRange(0, MAX_SH_DEGREE),
    help="Leave out the SH bands above, or add bands of zeros: some programs read degree 3 only.",
)
@click.option(
    "--cameras",
    type=PATH,
    metavar="FILE",
    help="A cameras.json to measure from.  [default: that of the model's folder]",
)
@iteration_option
@click.option("--overwrite", is_flag=True, help="Replace OUTPUT.")
@device_option
@quiet_option
def convert_model(
    model: Path,
    output: Path,
    shape: str | None,
    approximate: bool,
    sh_degree: int | None,
    cameras: Path | None,
    iteration: int | None,
    overwrite: bool,
    device: str | None,
    quiet: bool,
) -> None:
    """Write MODEL, a folder or a file of splats, into OUTPUT: a .ply of all columns, or a .splat or .spz file.

    Without --approximate only exact conversions of the shape are made: where a splat has no equal in the other shape,
    nothing is written. With --shape gaussian a .ply has 3DGS's columns and no others. A .splat file has no SH bands
    above 0; .spz files round everything to a byte or so. What a file loses is measured on images.
    """
    from clsplat.splats.dot_splat import write_splat
    from clsplat.splats.spz import write_spz

    suffix = output.suffix.lower()
    if suffix not in (_PLY, *_GAUSSIANS):
        raise OutputError(f"{output}: writes .ply, {' and '.join(_GAUSSIANS)} files: choose one of these endings")
    if output.exists() and not overwrite:
        raise OutputError(f"{output}: exists already: use --overwrite or another name")
    loaded = load_model(model, iteration)
    target = shape or (GAUSSIAN.name if suffix in _GAUSSIANS else loaded.splats.shape)
    if suffix in _GAUSSIANS and target != GAUSSIAN.name:
        raise InputError(f"{output}: {suffix} files hold Gaussians: leave --shape out, or write a .ply")
    converted, nearest = _converted(loaded.splats, target, approximate)
    if sh_degree is not None:
        converted = _of_degree(converted, sh_degree)
    if suffix == _PLY:
        converted.save(output)
    else:
        (write_spz if suffix == ".spz" else write_splat)(output, converted)
    if quiet:
        return
    said = "each the nearest" if nearest else "with the same images"
    click.echo(f"{output}: {len(converted)} splats, {loaded.splats.shape} to {target}, {said}")
    if missing := len(loaded.splats) - len(converted):
        click.echo(f"{missing} splats of negative opacity, which no {target} has, are left out")
    if nearest or suffix != _PLY or converted.sh_degree < loaded.splats.sh_degree:
        click.echo(_cost(loaded, load_splats(output), cameras, device))


def _converted(splats: Splats, target: str, approximate: bool) -> tuple[Splats, bool]:
    """The splats as `target`, and whether they are only the nearest.

    Raises
    ------
    InputError : some have no equal, and none that is nearest is asked for, or there.
    """
    from clsplat.splats.convert import convert

    try:
        return convert(splats, target), False
    except InputError as error:
        if target != GAUSSIAN.name:
            raise
        if not approximate:
            raise InputError(f"{error}; or --approximate") from None
    from clsplat.splats.approximate import nearest_gaussians

    return nearest_gaussians(splats), True


def _of_degree(splats: Splats, degree: int) -> Splats:
    """The colours cut to an SH degree, or with bands of zeros up to it."""
    import numpy as np

    sh = splats.sh[:, : sh_coefficients(degree)]
    sh = np.pad(sh, ((0, 0), (0, sh_coefficients(degree) - sh.shape[1]), (0, 0)))
    return splats.with_arrays(splats.to_numpy() | {"sh": sh})


def _cost(loaded: LoadedModel, converted: Splats, cameras: Path | None, device: str | None) -> str:
    """How far the images are from the model's own."""
    from clsplat.cameras.cameras_json import read_cameras
    from clsplat.evaluation.evaluate import MAX_PSNR
    from clsplat.evaluation.metrics import psnr
    from clsplat.rendering.renderer import Renderer

    named = recorded_cameras(loaded) if cameras is None else read_cameras(cameras)
    if not named:
        return "what that costs was not measured: name cameras with --cameras FILE"
    renderer, worst, total = Renderer(device), float("inf"), 0.0
    for entry in named:
        own, new = (
            renderer.render(splats, entry.camera, loaded.background).color for splats in (loaded.splats, converted)
        )
        value = min(psnr(own, new), MAX_PSNR)
        worst, total = min(worst, value), total + value
    return (
        f"PSNR against the model's own images, {len(named)} cameras: {total / len(named):.2f} dB, worst {worst:.2f} dB"
    )

"""`clsplat convert`: a model as another shape, or as a file for other programs."""

from __future__ import annotations

from itertools import zip_longest
from pathlib import Path

import click

from clsplat.splats.fields import MAX_SH_DEGREE
from clsplat.splats.formats.page_payload import PAGE_ENDING, PRECISIONS
from clsplat.splats.formats.spz import VERSIONS as SPZ_VERSIONS
from clsplat.splats.formats.streamed_sog import MAX_LEVELS
from clsplat.splats.shapes import SHAPES

from .command import SectionedCommand
from .models import cost_line, missing_numbers
from .options import PATH, device_option, iteration_option, overwrite_option, quiet_option


@click.command(
    "convert",
    cls=SectionedCommand,
    sections={
        "Options": ("shape", "approximate", "sh_degree", "cameras", "iteration", "overwrite", "device", "quiet"),
        "Web pages": ("precision", "camera_path", "title"),
        "Other formats": ("spz_version", "levels"),
    },
    examples=(
        ("clsplat convert MODEL scene.html", "A page that shows the splats, for anybody with a browser."),
        (
            "clsplat convert MODEL out.ply --shape gaussian --approximate",
            "Gaussians for other programs, with the loss that this costs.",
        ),
        ("clsplat convert MODEL scene.glb", "A standard file with the skew in it."),
        ("clsplat convert MODEL out.sog", "A small file for viewers on the web."),
    ),
    see_also=("view", "cameras"),
)
@click.argument("model", type=PATH)
@click.argument("output", type=PATH)
@click.option(
    "--shape",
    type=click.Choice(list(SHAPES)),
    help="Kernel of the splats to convert to.  [default: the model's, or an equal one that the format holds]",
)
@click.option(
    "--approximate",
    is_flag=True,
    help="Use the nearest splat of the shape where none is equal, and measure the loss.",
)
@click.option(
    "--sh-degree",
    type=click.IntRange(0, MAX_SH_DEGREE),
    metavar="N",
    help="Degree of the spherical harmonics: remove the bands above, or add bands of zeros. Some programs read degree "
    "3 only.",
)
@click.option(
    "--spz-version",
    type=click.Choice([str(version) for version in SPZ_VERSIONS]),
    help="Version of an .spz file. Some programs read only one of them.  [default: 3]",
)
@click.option(
    "--levels",
    type=click.IntRange(1, MAX_LEVELS),
    metavar="N",
    help="Number of levels of detail of a lod-meta.json. Each has about half of the splats of the one before.  "
    "[default: 4]",
)
@click.option(
    "--cameras",
    type=PATH,
    metavar="FILE",
    help="A cameras.json with the cameras of the measurement and of a page.  [default: that of the model folder]",
)
@click.option(
    "--precision",
    type=click.Choice(list(PRECISIONS)),
    help="Compact rounds each value to one to three bytes, full keeps all digits.  [default: compact]",
)
@click.option(
    "--camera-path",
    type=PATH,
    metavar="FILE",
    help="The camera path that the page plays, as recorded in the viewer.  [default: around the scene]",
)
@click.option("--title", metavar="TEXT", help="Heading of the page.  [default: the model's name]")
@iteration_option
@overwrite_option()
@device_option
@quiet_option
def convert_model(
    model: Path,
    output: Path,
    shape: str | None,
    approximate: bool,
    sh_degree: int | None,
    spz_version: str | None,
    levels: int | None,
    cameras: Path | None,
    precision: str | None,
    camera_path: Path | None,
    title: str | None,
    iteration: int | None,
    overwrite: bool,
    device: str | None,
    quiet: bool,
) -> None:
    """Write MODEL, a folder or a file of splats, into OUTPUT, a file for other programs or a web page.

    The ending of OUTPUT is the format: .ply, .glb (glTF), .usd, .usda, .usdc, .usdz (OpenUSD), .sog, .spz, .splat or
    .html. An .html page shows the splats in any browser with WebGL 2. It needs no server and no network: send it to
    anybody.

    A .ply holds every kernel. Pages, glTF and OpenUSD hold Gaussians, skew-normals and generalised exponentials, .sog
    files the first two. Programs that do not know a kernel show its ellipses. The other formats hold Gaussians. The
    last three round each value to about a byte, and a .splat file has no SH bands above 0. The loss is measured on
    images.

    An OUTPUT with the name lod-meta.json is written as streamed SOG: parts and levels of detail for viewers on the web.

    Without --approximate, nothing is written if a splat cannot be converted exactly. With --shape gaussian, a .ply has
    only 3DGS's columns.
    """
    from clsplat.cameras.cameras_json import read_cameras
    from clsplat.models.convert import PageOptions, conversion_cost, level_costs
    from clsplat.models.convert import convert_model as convert

    if cameras is not None:
        read_cameras(cameras)  # a wrong file stops the command before it writes
    page = None
    if output.suffix.lower() == PAGE_ENDING or precision or camera_path or title:
        page = PageOptions(precision or PRECISIONS[0], cameras, camera_path, title)
    converted = convert(
        model,
        output,
        shape,
        approximate=approximate,
        sh_degree=sh_degree,
        spz_version=None if spz_version is None else int(spz_version),
        levels=levels,
        page=page,
        iteration=iteration,
        overwrite=overwrite,
    )
    if quiet:
        return
    before, after = converted.source.splats, converted.splats
    if converted.approximate:
        how = "each the nearest"
    elif converted.is_exact:
        how = "with the same images"
    else:
        how = "rounded" if converted.rounds else "with fewer SH bands"
    click.echo(f"{output}: {len(after)} splats, {before.shape} to {after.shape}, {how}")
    if converted.removed:
        click.echo(f"{converted.removed} splats of negative opacity are left out, which {after.shape} does not support")
    for line in missing_numbers(converted):
        click.echo(line)
    if not converted.is_exact:
        cost = conversion_cost(converted, cameras, device)
        click.echo(
            "what that costs was not measured: name cameras with --cameras FILE" if cost is None else cost_line(cost)
        )
    for number, (level, cost) in enumerate(
        zip_longest(converted.levels, level_costs(converted, cameras, device)), start=1
    ):
        click.echo(f"level {number}: {len(level)} splats" + ("" if cost is None else f", {cost.mean:.2f} dB"))

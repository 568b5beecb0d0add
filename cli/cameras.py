"""`clsplat cameras`: write cameras and points of a scene or a model as files for other programs."""

from __future__ import annotations

from pathlib import Path

import click

from clsplat.scenes.options import CAMERA_FORMATS

from .command import DocumentedCommand
from .options import PATH, iteration_option, overwrite_option, quiet_option


@click.command(
    "cameras",
    cls=DocumentedCommand,
    examples=(
        ("clsplat cameras SCENE transforms.json", "For nerfstudio and instant-ngp."),
        ("clsplat cameras MODEL colmap --format colmap-text", "A COLMAP model as text files."),
    ),
    see_also=("convert",),
)
@click.argument("source", type=PATH)
@click.argument("output", type=PATH)
@click.option(
    "--format",
    "form",
    type=click.Choice(CAMERA_FORMATS),
    help="Format: nerfstudio's and instant-ngp's transforms.json, a COLMAP model (.bin or .txt), or 3DGS's "
    "cameras.json.  [default: by OUTPUT: cameras.json, other .json files transforms, else colmap]",
)
@click.option("-i", "--images", metavar="NAME", help="Folder of the photos inside a scene, such as images_4.")
@iteration_option
@overwrite_option("the files that are there")
@quiet_option
def write_cameras_of(
    source: Path,
    output: Path,
    form: str | None,
    images: str | None,
    iteration: int | None,
    overwrite: bool,
    quiet: bool,
) -> None:
    """Write the cameras and points of SOURCE to OUTPUT, a .json file or the folder of a COLMAP model.

    SOURCE is a scene or the file of its cameras, a model folder, a cameras.json or a camera path. Cameras of a scene
    keep their lenses, and the files name its photos. Cameras of a model are those of its training images, undistorted
    and at their reduced size. Their images are named images/NAME.png, and their points are the centres of opaque
    splats.
    """
    from clsplat.models.cameras import export_cameras

    written = export_cameras(source, output, form, images=images, iteration=iteration, overwrite=overwrite)
    if not quiet:
        points = f", {written.points} points" if written.points else ""
        click.echo(f"{output}: {written.cameras} cameras{points}")

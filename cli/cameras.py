"""`clsplat cameras`: cameras and points of a scene or a model as files for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from clsplat.errors import InputError, OutputError

from .options import PATH, iteration_option, overwrite_option, quiet_option

if TYPE_CHECKING:
    from clsplat.scenes.colmap import Points
    from clsplat.scenes.undistort import RegisteredImage

FORMATS = ("transforms", "colmap", "colmap-text", "cameras")
OPAQUE = 0.5  # splats of this opacity and above are points of a model
_COLMAP_FILES = ("cameras", "images", "points3D")


@click.command("cameras")
@click.argument("source", type=PATH)
@click.argument("output", type=PATH)
@click.option(
    "--format",
    "form",
    type=click.Choice(FORMATS),
    help="nerfstudio's and instant-ngp's transforms.json, a COLMAP model (.bin or .txt), or 3DGS's "
    "cameras.json.  [default: by OUTPUT: cameras.json, other .json files transforms, else colmap]",
)
@click.option("-i", "--images", help="Folder of the photos inside a scene.")
@iteration_option
@overwrite_option
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
    """Write the cameras of SOURCE into OUTPUT, a .json file or a COLMAP model's folder, with points beside them.

    SOURCE is a scene (its cameras keep their lenses, and the files name its photos), a model folder, or a cameras.json
    or camera path. Cameras of models are those of its training images: free of distortion, at the size they were
    reduced to; images/NAME.png is then the name of each, and the centres of opaque splats are the points.
    """
    from clsplat.scenes.export import relative_files, write_colmap, write_transforms

    if form is None:
        form = "cameras" if output.name == "cameras.json" else "transforms" if output.suffix == ".json" else "colmap"
    suffix = ".txt" if form == "colmap-text" else ".bin"
    made = [output / f"{name}{suffix}" for name in _COLMAP_FILES] if form.startswith("colmap") else [output]
    if any(path.exists() for path in made) and not overwrite:
        raise OutputError(f"{output}: exists already: use --overwrite or another name")
    if source.is_dir() and not (source / "point_cloud").is_dir():
        photos, files, points = _of_scene(source, images)
    else:
        photos, points = _of_model(source, iteration)
        files = [output.parent / "images" / photo.name for photo in photos]
    if form == "cameras":
        _write_3dgs(output, photos)
    elif form == "transforms":
        write_transforms(output, photos, relative_files(files, output.parent), points)
    else:
        write_colmap(output, photos, points, form == "colmap-text")
    if not quiet:
        said = "" if form == "cameras" or not len(points) else f", {len(points)} points"
        click.echo(f"{output}: {len(photos)} cameras{said}")


def _of_scene(scene: Path, images: str | None) -> tuple[list[RegisteredImage], list[Path], Points]:
    """Photos, their files, and points. Names lose the one folder that all of them lie in."""
    from dataclasses import replace

    from clsplat.scenes.scene import read_posed_images

    posed = read_posed_images(scene, images)
    first = {photo.name.partition("/")[0] if "/" in photo.name else None for photo in posed.photos}
    cut = len(first.pop() or "") + 1 if len(first) == 1 and None not in first else 0
    return (
        [replace(photo, name=photo.name[cut:]) for photo in posed.photos],
        [posed.files[photo.name] for photo in posed.photos],
        posed.points,
    )


def _of_model(source: Path, iteration: int | None) -> tuple[list[RegisteredImage], Points]:
    """Photos of a model's or a file's cameras, and a model's opaque splats."""
    import numpy as np

    from clsplat.cameras.cameras_json import NamedCamera, read_cameras
    from clsplat.cameras.path import read_path
    from clsplat.files.json_file import read_json
    from clsplat.scenes.colmap import Points
    from clsplat.scenes.undistort import RegisteredImage, make_lens
    from clsplat.splats.shapes import shape_named
    from clsplat.splats.splats import SH_C0

    from .models import load_model, recorded_cameras

    points = Points(np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0, np.int64))
    if source.is_file() and source.suffix == ".json":
        if isinstance(read_json(source, "a cameras.json"), list):
            named = read_cameras(source)
        else:
            named = [NamedCamera(f"{i:05d}", camera) for i, camera in enumerate(read_path(source).cameras)]
    else:
        loaded = load_model(source, iteration)
        named, splats = recorded_cameras(loaded), loaded.splats
        seen = shape_named(splats.shape).strength(splats.arrays) >= OPAQUE
        rgb = np.rint(255 * np.clip(0.5 + SH_C0 * splats.sh[seen, 0], 0, 1)).astype(np.uint8)
        points = Points(splats.mean[seen].astype(np.float64), rgb, np.zeros(len(rgb), np.int64))
    if not named:
        raise InputError(f"{source}: has no cameras: give a scene, a model's folder with cameras.json, or such a file")
    photos = []
    for entry in named:
        camera = entry.camera
        lens = make_lens("PINHOLE", camera.width, camera.height, [camera.fx, camera.fy, camera.cx, camera.cy])
        photos.append(RegisteredImage(f"{entry.name}.png", camera.cam_from_world, lens))
    return photos, points


def _write_3dgs(output: Path, photos: list[RegisteredImage]) -> None:
    from clsplat.cameras.cameras_json import named_cameras, write_cameras
    from clsplat.scenes.undistort import is_pinhole, pinhole_camera

    bent = [photo for photo in photos if not is_pinhole(photo.lens)]
    if bent:
        raise InputError(
            f"image {bent[0].name!r}: 3DGS's cameras.json has no distorted lenses: write transforms or a COLMAP model"
        )
    cameras = [
        pinhole_camera(photo.lens, photo.cam_from_world, photo.lens.width, photo.lens.height) for photo in photos
    ]
    write_cameras(output, named_cameras([photo.name for photo in photos], cameras))

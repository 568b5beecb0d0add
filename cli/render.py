"""`clsplat render`: images, alpha and depth of a model or of any splat PLY."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from clsplat.cameras_json import NamedCamera, bare_name, img_names, read_cameras, write_cameras
from clsplat.errors import InputError

from .models import LoadedModel, load_model, scene_of
from .options import (
    PATH,
    RGB,
    background_of,
    background_options,
    device_option,
    iteration_option,
    quiet_option,
    scene_options,
    set_option,
)
from .outputs import ImageWriter, output_stems
from .progress import counted

if TYPE_CHECKING:
    from clsplat.camera import Camera


@click.command()
@click.argument("model", required=False, type=PATH, metavar="MODEL_OR_PLY")
@click.option("-m", "--model-path", type=PATH, help="The same as MODEL_OR_PLY.")
@click.option("-o", "--output", type=PATH, required=True, metavar="DIR", help="Where the images go.")
@click.option("--cameras", type=PATH, metavar="FILE", help="Render the cameras of this cameras.json.")
@scene_options
@set_option
@click.option("--path", type=click.Choice(["orbit"]), help="Render a path around the scene.")
@click.option("--frames", type=click.IntRange(min=1), default=60, show_default=True,
              help="Images of the path.")
@click.option("--format", "format", type=click.Choice(["png", "npy"]), default="png", show_default=True,
              help="png: 8 bits, rounded; npy: float32 as rendered.")
@click.option("--alpha", is_flag=True, help="Also write alpha.")
@click.option("--depth", is_flag=True, help="Also write depth, the alpha-weighted sum of camera z "
                                            "(png: 16 bits, full scale is printed).")
@background_options
@iteration_option
@device_option
@quiet_option
def render(model: Path | None, model_path: Path | None, output: Path, cameras: Path | None,
           source_path: Path | None, images: str | None, resolution: int | None, view_set: str | None,
           path: str | None, frames: int, format: str, alpha: bool, depth: bool, background: RGB | None,
           white_background: bool, iteration: int | None, device: str | None, quiet: bool) -> None:
    """Render MODEL_OR_PLY: a model's folder, or any splat PLY.

    The views: all of --cameras, or the test views of the scene given with -s; with a model's folder alone its
    own test views. Where none were held out: all. --path orbit turns around what the cameras look at; with a
    PLY alone around its middle, the y axis pointing down.
    """
    from_scene = source_path is not None or images is not None or resolution is not None
    if cameras is not None and from_scene:
        raise click.UsageError("give --cameras or a scene (-s, -i, -r), not both")
    if path is not None and view_set is not None:
        raise click.UsageError("give --path or --set, not both")
    given = model or model_path
    if given is None or (model and model_path and model != model_path):
        raise click.UsageError("give one model folder or PLY file")
    colour = background_of(background, white_background)
    loaded = load_model(given, iteration)
    test_names, source = loaded.test_names, loaded.path
    if cameras is not None:
        views, source, view_set = read_cameras(cameras), cameras, view_set or "all"
    elif from_scene:
        scene = scene_of(loaded, source_path, images, resolution)
        names = img_names([view.name for view in scene.views])
        views = [NamedCamera(name, view.camera) for name, view in zip(names, scene.views, strict=True)]
        test_names, source = scene.test_names, scene.path
    else:
        views = _recorded_cameras(loaded)
    if path is not None:
        views = _orbit(loaded, [view.camera for view in views], frames)
    else:
        views = _chosen(views, test_names, view_set, source)
    colour = loaded.background if colour is None else colour
    seconds = render_views(loaded, views, output, colour, device, format, alpha, depth, quiet)
    if path is not None:
        write_cameras(output / "cameras.json", views)
    if not quiet:
        size = f"{views[0].camera.width}x{views[0].camera.height}"
        click.echo(f"{output}: {len(views)} images, the first {size} px, {1e3 * seconds:.1f} ms each")


def render_views(model: LoadedModel, views: Sequence[NamedCamera], output: Path, background: RGB,
                 device: str | None = None, format: str = "png", alpha: bool = False, depth: bool = False,
                 quiet: bool = False) -> float:
    """Render and write all views; the median wall time of a render after the first [s].

    Raises
    ------
    InputError : views whose files would be the same, or lie outside `output`.
    OutputError : `output` cannot be written.
    """
    from clsplat.render import Renderer

    extras = [name for name, wanted in (("alpha", alpha), ("depth", depth)) if wanted]
    stems = output_stems([view.name for view in views], extras, keep_suffix=format == "npy")
    writer = ImageWriter(output, format, extras)
    renderer = Renderer(device)
    times = []
    for stem, view in counted(list(zip(stems, views, strict=True)), "rendering", quiet):
        start = time.perf_counter()
        image = renderer.render(model.splats, view.camera, background)
        times.append(time.perf_counter() - start)
        note = writer.write(stem, image)
        if note and not quiet:
            click.echo(note)
    return statistics.median(times[1:] or times)  # the first one builds and uploads


def _recorded_cameras(model: LoadedModel) -> list[NamedCamera]:
    """The cameras in the model's folder; none for a PLY or a folder without them."""
    if model.folder is None or not model.folder.cameras_path.is_file():
        return []
    return read_cameras(model.folder.cameras_path)


def _chosen(views: list[NamedCamera], test_names: frozenset[str] | None, view_set: str | None,
            source: Path) -> list[NamedCamera]:
    """The test, train or all views; by default the test views, where there are any among them."""
    if not views:
        raise InputError(f"{source}: no cameras to render: give --cameras cameras.json, a scene with -s, "
                         "or --path orbit")
    held_out = test_names or frozenset()
    names = held_out | {bare_name(name) for name in held_out}  # cameras.json has them without the extension
    test = [view for view in views if view.name in names]
    if view_set in (None, "all"):
        return test if test and view_set is None else views
    if not test:
        raise InputError(f"{source}: no test views are known: train with --eval, or use --set all")
    return test if view_set == "test" else [view for view in views if view.name not in names]


def _orbit(model: LoadedModel, cameras: list[Camera], frames: int) -> list[NamedCamera]:
    from clsplat.paths_around import orbit

    return [NamedCamera(f"orbit_{index:03}", camera)
            for index, camera in enumerate(orbit(model.splats, cameras, frames))]

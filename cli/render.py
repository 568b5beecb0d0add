"""`clsplat render`: images, alpha and depth of a model or of any splat PLY, and videos of them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from clsplat.cameras.cameras_json import NamedCamera, named_cameras, read_cameras, write_cameras
from clsplat.cameras.interpolate import resized_by_height
from clsplat.cameras.path import DEFAULT_FPS, write_path
from clsplat.errors import InputError
from clsplat.splats.color import Color

from .models import LoadedModel, both_forms, load_model, one_model, recorded_cameras, scene_of
from .options import (
    PATH,
    background_of,
    background_options,
    device_option,
    iteration_option,
    quiet_option,
    scene_options,
    set_option,
)
from .outputs import ImageWriter, VideoFiles, beside, output_stems
from .path_options import Range, named, path_of, path_options, resized
from .progress import counted

if TYPE_CHECKING:
    from clsplat.rendering.renderer import Renderer

_QUARTILES = (0.25, 0.75)  # of their ranges' near and far ends
_SAMPLES = 12  # frames that the range of depths is taken from, at a quarter of the size


@click.command()
@click.argument("model", required=False, type=PATH, metavar="MODEL_OR_PLY")
@click.option("-m", "--model-path", type=PATH, help="The same as MODEL_OR_PLY.")
@click.option("-o", "--output", type=PATH, metavar="DIR", help="Where the images go.")
@click.option("--video", type=PATH, metavar="FILE", help="Write a video (.mp4), instead of images or beside them.")
@click.option("--cameras", type=PATH, metavar="FILE", help="Render the cameras of this cameras.json.")
@scene_options
@set_option
@path_options
@click.option(
    "--format",
    "format",
    type=click.Choice(["png", "npy"]),
    default="png",
    show_default=True,
    help="png: 8 bits, rounded; npy: float32 as rendered.",
)
@click.option("--alpha", is_flag=True, help="Also write alpha.")
@click.option(
    "--depth",
    is_flag=True,
    help="Also write depth, the alpha-weighted sum of camera z (png: 16 bits, full scale is printed; video: colours).",
)
@click.option(
    "--depth-colours", "--depth-colors", is_flag=True, help="Write mean depth in colours, not in 16 bits of grey."
)
@click.option("--depth-range", type=Range(), help="Depths at the ends of the colours.  [default: those seen]")
@background_options
@iteration_option
@device_option
@quiet_option
def render(
    model: Path | None,
    model_path: Path | None,
    output: Path | None,
    video: Path | None,
    cameras: Path | None,
    source_path: Path | None,
    images: str | None,
    resolution: int | None,
    view_set: str | None,
    path: str | None,
    keys: str | None,
    closed: bool,
    frames: int | None,
    seconds: float | None,
    fps: float | None,
    size: tuple[int, int] | None,
    save_path: Path | None,
    format: str,
    alpha: bool,
    depth: bool,
    depth_colours: bool,
    depth_range: tuple[float, float] | None,
    background: Color | None,
    white_background: bool,
    iteration: int | None,
    device: str | None,
    quiet: bool,
) -> None:
    """Render MODEL_OR_PLY: a model's folder, or any splat PLY.

    The views: all of --cameras, or the test views of the scene given with -s; with a model's folder alone its
    own test views. Where none were held out: all. --path orbit, ellipse and spiral go around what these cameras
    look at; with a PLY alone around its middle, the y axis pointing down.
    """
    from_scene = source_path is not None or images is not None or resolution is not None
    if cameras is not None and from_scene:
        raise click.UsageError("give --cameras or a scene (-s, -i, -r), not both")
    if path is not None and view_set is not None:
        raise click.UsageError("give --path or --set, not both")
    if path is None and (keys or closed or frames or seconds or save_path):
        raise click.UsageError("--keys, --closed, --frames, --seconds and --save-path belong to --path")
    if output is None and video is None:
        raise click.UsageError("give -o DIR for images, --video FILE, or both")
    given = one_model(model, model_path)
    colour = background_of(background, white_background)
    if video is not None:
        from clsplat.files.video import VideoWriter

        VideoWriter(video, fps or 1.0)  # a wrong name or a missing encoder is told before anything is loaded
    loaded = load_model(given, iteration)
    test_names, source = loaded.test_names, loaded.path
    if cameras is not None:
        views, source, view_set = read_cameras(cameras), cameras, view_set or "all"
    elif from_scene:
        scene = scene_of(loaded, source_path, images, resolution)
        views = named_cameras(scene.names, scene.cameras)
        test_names, source = scene.test_names, scene.path
    else:
        views = recorded_cameras(loaded)
    if path is None:
        views = _resized(_chosen(views, test_names, view_set, source), size)
        rate = fps or DEFAULT_FPS
    else:
        along = resized(path_of(loaded, views, source, path, keys, closed, frames, seconds, fps), size)
        views, rate = named(along, path), along.fps
        if save_path is not None:
            write_path(save_path, along)
    colour = loaded.background if colour is None else colour
    extras = [name for name, wanted in (("alpha", alpha), ("depth", depth or depth_colours)) if wanted]
    milliseconds = render_views(
        loaded, views, output, colour, device, format, extras, quiet, video, rate, depth_range, depth_colours
    )
    if path is not None and output is not None:
        write_cameras(output / "cameras.json", views)
    if not quiet:
        shown = f"{views[0].camera.width}x{views[0].camera.height}"
        if output is not None:
            click.echo(f"{output}: {len(views)} images, the first {shown} px, {milliseconds:.1f} ms each")
        if video is not None:
            files = ", ".join([str(video), *(beside(video, extra).name for extra in extras)])
            click.echo(
                f"{files}: {len(views)} frames of {shown} px, {len(views) / rate:.4g} s at {rate:g} a second, "
                f"{milliseconds:.1f} ms each"
            )


def render_views(
    model: LoadedModel,
    views: Sequence[NamedCamera],
    output: Path | None,
    background: Color,
    device: str | None = None,
    format: str = "png",
    extras: Sequence[str] = (),
    quiet: bool = False,
    video: Path | None = None,
    fps: float = 30.0,
    depth_range: tuple[float, float] | None = None,
    depth_colours: bool = False,
) -> float:
    """Render and write all views, one at a time; the median wall time of a render after the first [ms].

    Parameters
    ----------
    output : folder of the images, or None. video : file of the video, or None.
    extras : any of "alpha", "depth". depth_range : of coloured depths; None: what is seen along the views.

    Raises
    ------
    InputError : views whose files would be the same, or lie outside `output`.
    OutputError : a file cannot be written.
    """
    from clsplat.rendering.renderer import Renderer

    stems = output_stems([view.name for view in views], extras, keep_suffix=format == "npy")
    renderer = Renderer(device)
    if "depth" in extras and (depth_colours or video is not None) and depth_range is None:
        depth_range = _depths_seen(renderer, model, views)
    times: list[float] = []
    with ExitStack() as files:
        sinks: list[ImageWriter | VideoFiles] = []
        if output is not None:
            sinks.append(ImageWriter(output, format, extras, depth_range if depth_colours else None, background))
        if video is not None:
            sinks.append(files.enter_context(VideoFiles(video, fps, extras, depth_range, background)))
        try:
            for stem, view in counted(list(zip(stems, views, strict=True)), "rendering", quiet):
                start = time.perf_counter()
                image = renderer.render(model.splats, view.camera, background)
                times.append(time.perf_counter() - start)
                notes = [sink.write(stem, image) for sink in sinks]
                for note in notes:
                    if note and not quiet:
                        click.echo(note)
        except KeyboardInterrupt:
            done = f"{len(times)} of {len(views)} frames were rendered"
            click.echo(f"{video}: not written, as only {done}" if video else f"{output}: {done}", err=True)
            raise
    return 1e3 * statistics.median(times[1:] or times)  # the first one builds and uploads


def _depths_seen(renderer: Renderer, model: LoadedModel, views: Sequence[NamedCamera]) -> tuple[float, float]:
    """One range for the whole path, so that its colours do not flicker: over a few small frames."""
    from clsplat.rendering.colormaps import depth_range

    step = -(-len(views) // _SAMPLES)
    ranges = []
    for view in views[::step]:
        camera = view.camera
        small = camera.resized(max(1, camera.width // 4), max(1, camera.height // 4))
        ranges.append(depth_range(renderer.render(model.splats, small)))
    near, far = np.quantile(ranges, _QUARTILES, axis=0).diagonal()  # a frame inside a wall does not stretch it
    return float(near), float(far)


def _resized(views: list[NamedCamera], size: tuple[int, int] | None) -> list[NamedCamera]:
    if size is None:
        return views
    return [NamedCamera(view.name, resized_by_height(view.camera, *size)) for view in views]


def _chosen(
    views: list[NamedCamera], test_names: frozenset[str] | None, view_set: str | None, source: Path
) -> list[NamedCamera]:
    """The test, train or all views; by default the test views, where there are any among them."""
    if not views:
        raise InputError(
            f"{source}: no cameras to render: give --cameras cameras.json, a scene with -s, or --path orbit"
        )
    names = both_forms(test_names or frozenset())
    test = [view for view in views if view.name in names]
    if view_set in (None, "all"):
        return test if test and view_set is None else views
    if not test:
        raise InputError(f"{source}: no test views are known: train with --eval, or use --set all")
    return test if view_set == "test" else [view for view in views if view.name not in names]

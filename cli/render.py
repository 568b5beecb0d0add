"""`clsplat render`: images, alpha, depth and videos of a model or of a file of splats."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .command import SectionedCommand
from .models import one_model, scene_choice
from .options import (
    PATH,
    background_of,
    background_options,
    detail_option,
    device_option,
    iteration_option,
    overwrite_option,
    quiet_option,
    scene_options,
    set_option,
)
from .path_options import Range, path_options, path_request
from .progress import ViewCount

if TYPE_CHECKING:
    from clsplat.models.render import ModelRenders
    from clsplat.rendering.views import RenderOutput


SECTIONS = {
    "Common options": (
        "output",
        "video",
        "path",
        "view_set",
        "frames",
        "fps",
        "size",
        "depth",
        "white_background",
        "overwrite",
        "device",
        "quiet",
    ),
    "Views": ("model_path", "iteration", "cameras", "source_path", "images", "resolution"),
    "Camera path": ("keys", "closed", "seconds", "save_path"),
    "Images": ("format", "alpha", "depth_colours", "depth_range", "background", "detail"),
}


@click.command(
    cls=SectionedCommand,
    sections=SECTIONS,
    examples=(
        ("clsplat render MODEL -o renders", "The test views as images."),
        ("clsplat render MODEL --path orbit --video turn.mp4", "A flight around the scene."),
    ),
    see_also=("view", "eval"),
)
@click.argument("model", required=False, type=PATH, metavar="MODEL_OR_PLY")
@click.option("-m", "--model-path", type=PATH, help="The same as MODEL_OR_PLY.")
@click.option("-o", "--output", type=PATH, metavar="DIR", help="Folder of the images.")
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
@click.option("--depth-range", type=Range(), help="Depths at the ends of the colours.  [default: from the images]")
@background_options
@detail_option(0.0)
@iteration_option
@overwrite_option("files that are there")
@device_option
@quiet_option
def render(
    model: Path | None,
    model_path: Path | None,
    cameras: Path | None,
    view_set: str | None,
    save_path: Path | None,
    iteration: int | None,
    overwrite: bool,
    device: str | None,
    quiet: bool,
    **values: Any,
) -> None:
    """Render MODEL_OR_PLY, a model folder or a file of splats.

    By default these views are rendered: all of --cameras, or the test views of the scene given with -s, or else the
    test views of the model folder. Without test views all views are rendered. --path orbit, ellipse and spiral go
    around the point that these cameras look at. A file alone has no cameras: the path then goes around the splats,
    with the y axis pointing down.
    """
    from clsplat.models.render import ViewChoice, render_views
    from clsplat.rendering.views import RenderOutput

    scene = scene_choice(values)
    if cameras is not None and scene:
        raise click.UsageError("give --cameras or a scene (-s, -i, -r), not both")
    size = values["size"]
    if values["path"] is not None and view_set is not None:
        raise click.UsageError("give --path or --set, not both")
    if values["fps"] is not None and values["path"] is None and values["video"] is None:
        raise click.UsageError("--fps is for videos and paths: give --video FILE or --path")
    request = path_request(values | {"save_path": save_path})
    if values["output"] is None and values["video"] is None:
        raise click.UsageError("give -o DIR for images, --video FILE, or both")
    if values["format"] == "npy" and values["depth_colours"] and values["video"] is None:
        raise click.UsageError("--depth-colours are for --format png and videos")
    if values["format"] == "npy" and values["output"] is None:
        raise click.UsageError("--format npy is for images: give -o DIR")
    if (
        values["depth_range"] is not None
        and not values["depth_colours"]
        and (values["video"] is None or not values["depth"])
    ):
        raise click.UsageError("--depth-range is for colours: give --depth-colours")
    source = one_model(model, model_path)
    depth = values["depth"] or values["depth_colours"]
    output = RenderOutput(
        values["output"],
        values["video"],
        values["format"],
        tuple(name for name, chosen in (("alpha", values["alpha"]), ("depth", depth)) if chosen),
        values["depth_colours"],
        values["depth_range"],
        values["fps"],
    )
    started = time.time()
    with ViewCount("rendering", quiet) as progress:
        try:
            rendered = render_views(
                source,
                output,
                ViewChoice(cameras, scene, view_set, request, size),
                background=background_of(values["background"], values["white_background"]),
                save_path=save_path,
                iteration=iteration,
                overwrite=overwrite,
                device=device,
                detail=values["detail"],
                progress=progress,
            )
        except KeyboardInterrupt:
            progress.clear()
            if progress.total and (text := _interrupted(output, progress, started)):
                click.echo(text, err=True)
            raise
    if not quiet:
        for line in _summary(output, rendered):
            click.echo(line)


def _interrupted(output: RenderOutput, progress: ViewCount, started: float) -> str | None:
    """Return what an interruption left; None if the video was complete. started : time of the command's start [s]."""
    if not output.video:
        return f"{output.folder}: {progress.done} of {progress.total} frames were rendered"
    video = Path(output.video)
    if video.is_file() and video.stat().st_mtime >= started:
        return None
    return f"{video}: not written, as the command was stopped at frame {progress.done + 1} of {progress.total}"


def _summary(output: RenderOutput, rendered: ModelRenders) -> list[str]:
    """Return lines on the files that were written."""
    from clsplat.rendering.outputs import extra_video

    lines = [f"{name}: 65535 = {depth:.6g} world units" for name, depth in rendered.depth_scales.items()]
    count, camera, fps = len(rendered.views), rendered.views[0].camera, rendered.fps
    size, time = f"{camera.width}x{camera.height} px", f"{rendered.render_ms:.1f} ms each"
    if output.folder is not None:
        lines.append(f"{output.folder}: {count} images, the first {size}, {time}")
    if output.video is not None:
        files = ", ".join([str(output.video), *(extra_video(output.video, extra).name for extra in output.extras)])
        size = f"{camera.width + camera.width % 2}x{camera.height + camera.height % 2} px"  # as H.264 needs it
        lines.append(f"{files}: {count} frames of {size}, {count / fps:.4g} s at {fps:g} a second, {time}")
    return lines

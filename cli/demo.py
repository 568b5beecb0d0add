"""`clsplat demo`: the whole way once, on a scene that clsplat makes itself."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import click

from clsplat.errors import OutputError
from clsplat.training.config import TrainConfig
from clsplat.training.folder import ModelFolder

from .eval_pages import ViewRecorder, write_model_page
from .evaluate import REPORT, describe, measure_model
from .models import load_model
from .options import PATH, device_option, overwrite_option, quiet_option
from .outputs import output_stems
from .progress import duration
from .train import read_scene, run_training, say_stopped

# Small enough for two CPU cores in minutes.
ITERATIONS, CAP = 1500, 6000


@click.command()
@click.argument("out", type=PATH)
@click.option("--iterations", "--steps", type=click.IntRange(min=1), default=ITERATIONS, show_default=True)
@click.option("--cap-max", type=click.IntRange(min=1), default=CAP, show_default=True, help="Most splats.")
@click.option("--width", type=click.IntRange(min=32), default=200, show_default=True, help="Of a photo [px].")
@click.option("--views", type=click.IntRange(min=4), default=40, show_default=True, help="Number of photos.")
@overwrite_option
@device_option
@quiet_option
@click.pass_context
def demo(
    ctx: click.Context,
    out: Path,
    iterations: int,
    cap_max: int,
    width: int,
    views: int,
    overwrite: bool,
    device: str | None,
    quiet: bool,
) -> None:
    """Make a small scene in OUT/scene, train on it, render its test views and measure them.

    OUT/scene is kept when it is there already; OUT/model and OUT/renders are replaced with --overwrite.
    """
    from clsplat.evaluation.metrics import DEFAULT_PROTOCOL
    from clsplat.rendering.renderer import Renderer

    start = time.perf_counter()
    folder = ModelFolder(out / "model")
    if folder.is_used and not overwrite:
        raise OutputError(f"{folder.path}: already holds a model: use --overwrite or another folder")
    _make_scene(out / "scene", width, views, quiet)
    config = TrainConfig(iterations=iterations, cap_max=cap_max, device=device)
    scene, record = read_scene(out / "scene", {"eval": True}, config.background)
    model = run_training(scene, config, folder.path, record, overwrite=overwrite, quiet=quiet)
    if not model.finished:
        say_stopped(ctx, model)
    trained = load_model(folder.path)
    renders = out / "renders"
    measured = measure_model(trained, scene, Renderer(device), renders=renders, recorder=ViewRecorder(), quiet=quiet)
    page = write_model_page(folder.path / REPORT, "the demo", [measured], [folder.path.name])
    result = measured.result
    if quiet:
        return
    click.echo(
        f"\ntest views ({len(scene.test)}): PSNR {result['PSNR']:.2f} dB, SSIM {result['SSIM']:.4f}, "
        f"{result['render_ms']:.1f} ms each; {result['splats']} splats"
    )
    click.echo(describe(DEFAULT_PROTOCOL))
    click.echo(f"all done in {duration(time.perf_counter() - start)}. Look at:")
    first = output_stems([scene.test[0].name])[0]
    for path, what in (
        (page, "the test views beside their photos, in a browser"),
        (renders / f"{first}.png", "a rendered test view"),
        (out / "scene" / "images" / scene.test[0].name, "the photo of it"),
        (trained.ply, "the splats, for any viewer"),
        (folder.path / "results.json", "the numbers"),
    ):
        click.echo(f"  {path}  {what}")


def _make_scene(scene: Path, width: int, views: int, quiet: bool) -> None:
    """Write the capture, all of it or nothing."""
    if scene.exists():
        if not quiet:
            click.echo(f"{scene}: already there, used as it is", err=True)
        return
    from clsplat.scenes.demo.scene import write_capture

    if not quiet:
        click.echo(f"making {views} photos in {scene}", err=True)
    unfinished = scene.with_name(f".{scene.name}.unfinished")
    try:
        if unfinished.exists():  # of a run that was interrupted
            shutil.rmtree(unfinished)
        write_capture(unfinished, width, width * 3 // 4, views)
        os.replace(unfinished, scene)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{scene}: cannot be written ({reason}): choose another folder") from None

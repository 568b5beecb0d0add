"""`clsplat demo`: make a small scene, train on it, render it and measure it."""

from __future__ import annotations

import time
from pathlib import Path

import click

from clsplat.errors import OutputError
from clsplat.training.config import TrainConfig
from clsplat.training.folder import ModelFolder

from .command import DocumentedCommand
from .evaluate import describe
from .options import PATH, device_option, overwrite_option, quiet_option
from .progress import ViewCount, duration
from .train import report_interruption, run_training

# These values take minutes on two CPU cores.
ITERATIONS, CAP = 1500, 6000


@click.command(
    cls=DocumentedCommand,
    examples=(
        ("clsplat demo out", "Minutes on two processor cores."),
        ("clsplat demo out --iterations 300 --cap-max 1000", "A shorter run and a coarser model."),
    ),
    see_also=("train", "view"),
)
@click.argument("out", type=PATH)
@click.option(
    "--iterations",
    "--steps",
    type=click.IntRange(min=1),
    default=ITERATIONS,
    show_default=True,
    metavar="N",
    help="Number of training steps.",
)
@click.option(
    "--cap-max",
    type=click.IntRange(min=1),
    default=CAP,
    show_default=True,
    metavar="N",
    help="Largest number of splats.",
)
@click.option(
    "--width", type=click.IntRange(32, 4096), default=200, show_default=True, metavar="N", help="Width of a photo [px]."
)
@click.option(
    "--views", type=click.IntRange(4, 1000), default=40, show_default=True, metavar="N", help="Number of photos."
)
@overwrite_option("the model and the renders that are there")
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

    An existing OUT/scene is used again. --overwrite replaces OUT/model and OUT/renders.
    """
    from clsplat.evaluation.metrics import DEFAULT_PROTOCOL
    from clsplat.models.evaluation import EvaluationOptions, evaluate
    from clsplat.rendering.outputs import output_stems
    from clsplat.scenes.demo.make import make_demo_scene
    from clsplat.scenes.scene import load_scene

    start = time.perf_counter()
    folder, renders = ModelFolder(out / "model"), out / "renders"
    for made, used in ((folder.path, folder.is_used), (renders, renders.exists())):
        if used and not overwrite:
            raise OutputError(f"{made}: exists already: use --overwrite or another folder")
    if not quiet:
        exists = (out / "scene").exists()
        message = f"{out / 'scene'}: exists and is used" if exists else f"making {views} photos in {out / 'scene'}"
        click.echo(message, err=True)
    config = TrainConfig(iterations=iterations, cap_max=cap_max, device=device)
    scene = load_scene(make_demo_scene(out / "scene", width, views), background=config.background)
    model = run_training(scene, config, folder.path, overwrite=overwrite, quiet=quiet)
    if not model.finished:
        report_interruption(ctx, model)
    with ViewCount("measuring", quiet) as progress:
        measured = evaluate(
            folder.path,
            EvaluationOptions(scene_name="the demo"),
            renders=renders,
            overwrite=overwrite,
            device=device,
            progress=progress,
        )
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
        (measured.report, "the test views beside their photos, in a browser"),
        (renders / f"{first}.png", "a rendered test view"),
        (out / "scene" / "images" / scene.test[0].name, "the photo of it"),
        (measured.model.ply, "the splats, for any viewer"),
        (folder.path / "results.json", "the numbers"),
    ):
        click.echo(f"  {path}  {what}")

"""`clsplat demo`: make a scene, train on it, render it and measure it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.blocks.cells import parse_blocks
from clsplat.blocks.state import BlocksOptions
from clsplat.errors import OutputError
from clsplat.splats.shapes import DEFAULT_SHAPE
from clsplat.training.config import TrainConfig
from clsplat.training.folder import ModelFolder

from .blocks import BLOCKS_HELP, run_blocks
from .command import DocumentedCommand
from .comparison_options import check_device, cluster_option
from .evaluate import describe
from .options import PATH, device_option, overwrite_option, quiet_option
from .progress import ViewCount, activity_line, duration
from .train import report_interruption, run_training

if TYPE_CHECKING:
    from clsplat.models.measurements import ModelEvaluation
    from clsplat.scenes.scene import Scene


@dataclass(frozen=True)
class _Size:
    """Defaults of a demo."""

    iterations: int
    cap: int
    width: int
    views: int


SMALL = _Size(1500, 6000, 200, 40)  # minutes on two CPU cores
LARGE = _Size(3000, 600_000, 320, 600)  # half an hour on two CPU cores
BLOCKS = "6x1"  # a street has a length, and little else


def _default(name: str) -> str:
    return f"[default: {getattr(SMALL, name)}; with --large {getattr(LARGE, name)}]"


@click.command(
    cls=DocumentedCommand,
    examples=(
        ("clsplat demo out", "Minutes on two processor cores."),
        ("clsplat demo out --iterations 300 --cap-max 1000", "A shorter run and a coarser model."),
        ("clsplat demo street --large --cluster local:2", "A street of houses in blocks, two at a time."),
    ),
    see_also=("train", "view"),
)
@click.argument("out", type=PATH)
@click.option("--large", is_flag=True, help="A street of 28 houses, trained in blocks.")
@click.option(
    "--iterations",
    "--steps",
    type=click.IntRange(min=1),
    metavar="N",
    help=f"Number of training steps, with --large those of a block.  {_default('iterations')}",
)
@click.option(
    "--cap-max", "cap", type=click.IntRange(min=1), metavar="N", help=f"Largest number of splats.  {_default('cap')}"
)
@click.option(
    "--width", type=click.IntRange(32, 4096), metavar="N", help=f"Width of a photo [px].  {_default('width')}"
)
@click.option("--views", type=click.IntRange(4, 10_000), metavar="N", help=f"Number of photos.  {_default('views')}")
@click.option("--blocks", metavar="NxM|auto", help=f"{BLOCKS_HELP}  [default: {BLOCKS}, for --large only]")
@cluster_option
@overwrite_option("the model and the renders that are there")
@device_option
@quiet_option
@click.pass_context
def demo(
    ctx: click.Context,
    out: Path,
    large: bool,
    iterations: int | None,
    cap: int | None,
    width: int | None,
    views: int | None,
    blocks: str | None,
    cluster: str | None,
    overwrite: bool,
    device: str | None,
    quiet: bool,
) -> None:
    """Make a scene in OUT/scene, train on it, render its test views and measure them.

    An existing OUT/scene is used again. --overwrite replaces OUT/model and OUT/renders.

    The scene is a small world with known ground truth. --large makes a street with 2 million points instead. It is
    trained in blocks, one by one or on the workers of --cluster. After an interruption `clsplat train --resume -m
    OUT/model` goes on.
    """
    from clsplat.cluster.pool import check_cluster
    from clsplat.evaluation.metrics import DEFAULT_PROTOCOL
    from clsplat.models.evaluation import EvaluationOptions, evaluate
    from clsplat.scenes.demo.make import make_demo_scene, make_large_demo_scene
    from clsplat.scenes.scene import load_scene

    size, start = LARGE if large else SMALL, time.perf_counter()
    if not large and (blocks or cluster):
        raise click.UsageError("--blocks and --cluster are for --large")
    check_device(device, cluster)
    # The demo shows the skew, which such a short run would leave out.
    config = TrainConfig(
        shape=DEFAULT_SHAPE, iterations=iterations or size.iterations, cap_max=cap or size.cap, device=device
    )
    divided = BlocksOptions(*parse_blocks(blocks or BLOCKS, config.cap_max)) if large else None
    check_cluster(cluster, device)
    folder, renders, views = ModelFolder(out / "model"), out / "renders", views or size.views
    for made, used in ((folder.path, folder.is_used), (renders, renders.exists())):
        if used and not overwrite:
            raise OutputError(f"{made}: exists already: use --overwrite or another folder")
    place, exists = out / "scene", (out / "scene").exists()
    if exists and (place / "transforms.json").exists() != large:
        raise OutputError(
            f"{place}: is the scene of the demo {'without' if large else 'with'} --large: use another folder"
        )
    if not quiet:
        click.echo(f"{place}: exists and is used" if exists else f"making {views} photos in {place}", err=True)
    make = make_large_demo_scene if large else make_demo_scene
    with activity_line(quiet):
        scene = load_scene(make(place, width or size.width, views), background=config.background)
    if divided is not None:
        run_blocks(ctx, scene, config, divided, folder.path, False, overwrite, quiet, cluster)
    else:
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
    if not quiet:
        click.echo(f"\ntest views ({len(scene.test)}): {_summary(measured.result)}")
        click.echo(describe(DEFAULT_PROTOCOL))
        click.echo(f"all done in {duration(time.perf_counter() - start)}. Look at:")
        _print_files(scene, measured, folder, renders, large)


def _summary(result: Mapping[str, Any]) -> str:
    """Return the measurements in one line. result : entry of results.json."""
    return (
        f"PSNR {result['PSNR']:.2f} dB, SSIM {result['SSIM']:.4f}, {result['render_ms']:.1f} ms each; "
        f"{result['splats']} splats"
    )


def _print_files(scene: Scene, measured: ModelEvaluation, folder: ModelFolder, renders: Path, large: bool) -> None:
    """Print what the demo has written, a file a line. renders : folder of the rendered views."""
    from clsplat.blocks.train import PICTURE
    from clsplat.rendering.outputs import output_stems

    first = scene.test[0].name
    photo = next(path for path in (scene.path / first, scene.path / "images" / first) if path.exists())
    for path, what in (
        (measured.report, "the test views beside their photos, in a browser"),
        (renders / f"{output_stems([first])[0]}.png", "a rendered test view"),
        (photo, "the photo of it"),
        (measured.model.ply, "the splats, for any viewer"),
        (folder.path / "results.json", "the numbers"),
        *([(folder.path / PICTURE, "the blocks from above")] if large else []),
    ):
        click.echo(f"  {path}  {what}")

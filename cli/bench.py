"""`clsplat bench`: the time of each stage on the user's device, and what limits it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from clsplat.errors import InputError
from clsplat.files.existing import refuse_existing
from clsplat.splats.shapes import DEFAULT_SHAPE, SHAPES

from .command import DocumentedCommand
from .options import PATH, device_option, is_given, overwrite_option, scene_options
from .progress import table

if TYPE_CHECKING:
    from clsplat.profiling.bench import Report, StageTime
    from clsplat.profiling.roofline import Roofline
    from clsplat.scenes.scene import Scene
    from clsplat.splats.splats import Splats
    from clsplat.training.trainer import Trainer

SPLATS, WIDTH, HEIGHT = 30_000, 640, 480
HEAD = ("stage", "ms", "share", "MB", "of copy limit", "Mflop", "of FMA limit")
PREDICTED_HEAD = ("stage", "measured ms", "predicted ms", "with measured limits", "bound by")
_DOMINANT = 0.1  # smallest share of an iteration for which a stage gets a sentence
_NEAR = 0.5  # smallest fraction of a limit that counts as the limit of a stage


@click.command(
    cls=DocumentedCommand,
    examples=(
        ("clsplat bench", "Random splats on the default device."),
        (
            "clsplat bench -s SCENE -m MODEL --json speed.json",
            "A trained model and its photos, with all numbers in a file.",
        ),
    ),
    see_also=("devices",),
)
@scene_options
@click.option(
    "-m",
    "--model-path",
    "model_path",
    type=PATH,
    metavar="MODEL_OR_PLY",
    help="With -s: the splats of a trained model.  [default: the scene's points]",
)
@click.option(
    "--splats",
    type=click.IntRange(1, 20_000_000),
    metavar="N",
    help=f"Number of random splats; with -s the maximum number of the scene's points.  [default: {SPLATS}; "
    "with -s all]",
)
@click.option(
    "--width",
    type=click.IntRange(16, 8192),
    default=WIDTH,
    show_default=True,
    metavar="N",
    help="Width of the image, without -s [px].",
)
@click.option(
    "--height",
    type=click.IntRange(16, 8192),
    default=HEIGHT,
    show_default=True,
    metavar="N",
    help="Height of the image, without -s [px].",
)
@click.option(
    "--shape",
    type=click.Choice(tuple(SHAPES)),
    help=f"Kernel of the splats.  [default: {DEFAULT_SHAPE}, or the model's]",
)
@click.option(
    "--sh-degree",
    type=click.IntRange(0, 3),
    default=3,
    show_default=True,
    metavar="N",
    help="Degree of the spherical harmonics.",
)
@click.option(
    "--iterations",
    "--steps",
    type=click.IntRange(1, 1000),
    default=10,
    show_default=True,
    metavar="N",
    help="Number of timed iterations; a few more run before them.",
)
@click.option("--json", "json_path", type=PATH, metavar="FILE", help="Also write all numbers to this file.")
@overwrite_option()
@device_option
@click.pass_context
def bench(
    ctx: click.Context,
    source_path: Path | None,
    images: str | None,
    resolution: int | None,
    model_path: Path | None,
    splats: int | None,
    width: int,
    height: int,
    shape: str | None,
    sh_degree: int,
    iterations: int,
    json_path: Path | None,
    overwrite: bool,
    device: str | None,
) -> None:
    """Time each stage of a training step and of an image, and compare it with the limits of the device.

    The limits are measured on the same device: bytes per second of a copy, and operations per second of fused
    multiply-adds. The bytes and operations of a stage are the minimum that it needs. Pairs of splat and pixel count
    only if they change the image. Other programs on the machine make all numbers worse.

    On a GPU, a model of its time is printed beside the measured times: from stated rates, and from the measured limits.
    """
    from clsplat.device.device import open_device
    from clsplat.profiling.bench import bench_trainer, measure_render, measure_training, write_reports
    from clsplat.profiling.roofline import measure_roofline

    if source_path is None and (images or resolution is not None or model_path):
        raise click.UsageError("-i, -r and -m need a scene: name it with -s")
    if source_path is not None and (is_given(ctx, "width") or is_given(ctx, "height")):
        raise click.UsageError("--width and --height belong to random scenes: use -r with -s")
    if model_path is not None and splats is not None:
        raise click.UsageError("use -m or --splats, not both")
    refuse_existing([] if json_path is None else [json_path], overwrite)
    opened = open_device(device)
    if source_path is not None:
        scene, start = _read(source_path, images, resolution, model_path, splats)
    else:
        from clsplat.scenes.random_scene import synthetic_scene

        scene, start = synthetic_scene(splats or SPLATS, width, height, shape or DEFAULT_SHAPE, sh_degree)
    kernel = shape or (DEFAULT_SHAPE if isinstance(start, int) else start.shape)
    trainer = bench_trainer(scene, opened, kernel, start, sh_degree)
    limits = measure_roofline(opened)
    schedule = str(trainer.kernels.schedule)
    click.echo(f"device: {opened.info}, schedule {schedule}\nlimits measured on it: {limits}")
    reports = []
    for measure in (measure_training, measure_render):
        reports.append(measure(trainer, limits, iterations))
        click.echo("\n" + "\n".join([*describe(reports[-1], scene.name), *predictions(reports[-1], trainer, limits)]))
    if json_path is not None:
        write_reports(json_path, trainer, limits, scene.name, reports)


def describe(report: Report, scene: str) -> list[str]:
    """Return the lines of the report: the task, the table, and a sentence on each stage that takes much of the time."""
    sizes = report.sizes
    lines = [
        f"{report.task}: {report.wall_ms:.1f} ms ({1e3 / report.wall_ms:.3g} a second), median of {report.iterations}",
        f"  {scene}, up to {report.width}x{report.height} px: {sizes.splats} {report.shape} splats, {sizes.isects} "
        f"splat-tile pairs, {1e-6 * sizes.pairs:.2f} M useful splat-pixel pairs"
        f" ({100 * report.useful:.0f} % of those in the tiles)",
        table(HEAD, map(cells, report.stages)),
    ]
    dominant = sorted((stage for stage in report.stages if stage.share >= _DOMINANT), key=lambda stage: -stage.share)
    return [*lines, *(sentence(stage) for stage in dominant)]


def predictions(report: Report, trainer: Trainer, limits: Roofline) -> list[str]:
    """Return the lines that compare the model of a GPU with the measured times; no line if the device is not a GPU."""
    from clsplat.profiling.gpu_model import predict, total_ms
    from clsplat.profiling.gpus import corrected, gpu_of

    gpu = gpu_of(trainer.device)
    if gpu is None:
        return []
    measured = {stage.stage: stage.ms for stage in report.stages}
    stated, fitted = (
        predict(trainer.kernels, report.sizes, rates, trainer.kernels.schedule, stages=measured)
        for rates in (gpu, corrected(gpu, limits))
    )
    rows = [
        (first.stage, *(f"{ms:.3f}" for ms in (measured[first.stage], first.ms, second.ms)), second.bound)
        for first, second in zip(stated, fitted, strict=True)
    ]
    sums = (sum(measured[stage.stage] for stage in stated), total_ms(stated), total_ms(fitted))
    rows.append(("sum", *(f"{ms:.3f}" for ms in sums), ""))
    return [
        f"model of {gpu.name}: {gpu.units} units, {gpu.clock:.2f} GHz, {gpu.bandwidth:.0f} GB/s",
        table(PREDICTED_HEAD, rows, ("bound by",)),
    ]


def cells(stage: StageTime) -> tuple[str, ...]:
    """Return the cells of a stage in the table. A cell is empty if its number is not counted."""
    return (
        stage.stage,
        f"{stage.ms:.3f}",
        _percent(stage.share),
        f"{1e-6 * stage.bytes:.1f}" if stage.bytes else "",
        _percent(stage.of_copy),
        f"{1e-6 * stage.flops:.0f}" if stage.flops else "",
        _percent(stage.of_fma),
    )


def sentence(stage: StageTime) -> str:
    """Return a sentence on what limits a stage, judged by its two fractions."""
    start = f"{stage.stage} takes {_percent(stage.share)} of the time"
    fractions = [
        f"{_percent(fraction)} of the {name} limit"
        for name, fraction in (("FMA", stage.of_fma), ("copy", stage.of_copy))
        if fraction is not None
    ]
    if stage.stage == "host":
        return f"{start}: the device waits for Python and its driver; more splats or pixels would hide it."
    if not fractions:
        return f"{start}: it is not compared with a limit."
    start += ", at " + " and ".join(fractions)
    fma, copy = stage.of_fma or 0.0, stage.of_copy or 0.0
    if max(fma, copy) < _NEAR:
        return f"{start}: neither limits it: latency or uncounted work does."
    if fma >= copy:
        return f"{start}: arithmetic limits it."
    return f"{start}: " + ("memory limits it." if copy <= 1 else "the caches help it; memory limits it.")


def _percent(fraction: float | None) -> str:
    return "" if fraction is None else f"{100 * fraction:.0f} %"


def _read(
    path: Path, images: str | None, resolution: int | None, model: Path | None, splats: int | None
) -> tuple[Scene, Splats | int]:
    """Return the scene with all of its views, and the splats or the number of points to start from."""
    from clsplat.scenes.scene import load_scene

    scene = load_scene(path, images, -1 if resolution is None else resolution, eval=False)
    if model is None:
        return scene, splats or len(scene.points) or SPLATS
    from clsplat.models.model import load_model

    loaded = load_model(model).splats
    if not len(loaded):
        raise InputError(f"{model}: has no splats")
    return scene, loaded

"""`clsplat eval`: metrics of trained models on views of their scenes, in 3DGS's files."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.errors import InputError, OutputError
from clsplat.evaluation.metrics import DEFAULT_PROTOCOL, PROTOCOLS, MetricProtocol, protocol_named
from clsplat.files.json_file import read_object, write_json
from clsplat.splats.color import Color
from clsplat.splats.stats import complexity

from .eval_pages import Measurement, ViewRecorder, write_model_page
from .models import LoadedModel, load_model, scene_of
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
from .outputs import ImageWriter, output_stems
from .progress import counted, table

if TYPE_CHECKING:
    from clsplat.rendering.renderer import Rendered, Renderer
    from clsplat.scenes.scene import Scene, View

REPORT = "report.html"
_DIGITS = {"PSNR": 3, "SSIM": 4, "LPIPS": 4, "FLIP": 4}


@click.command("eval")
@click.argument("models", nargs=-1, type=PATH)
@click.option("-m", "--model-path", "more_models", type=PATH, multiple=True, help="The same as an argument.")
@scene_options
@set_option
@click.option(
    "--compat",
    type=click.Choice(list(PROTOCOLS)),
    default=DEFAULT_PROTOCOL.name,
    show_default=True,
    help="How PSNR and SSIM are taken; 3dgs pads SSIM with zeros.",
)
@click.option(
    "--color-correct",
    is_flag=True,
    help="Measure and show renders after the affine map of colours that brings each nearest to its photo.",
)
@click.option("--lpips", is_flag=True, help="Also LPIPS, by VGG16 (pip install 'clsplat[lpips]').")
@click.option("--flip", is_flag=True, help="Also FLIP, and its maps on the page (pip install 'clsplat[flip]').")
@click.option(
    "--report",
    type=PATH,
    metavar="FILE",
    help="Where the page goes; of several models it compares them.  [default: report.html in each model]",
)
@click.option("--no-report", is_flag=True, help="Write no page.")
@click.option("--save-renders", type=PATH, metavar="DIR", help="Also write the images as PNG.")
@background_options
@iteration_option
@device_option
@quiet_option
def evaluate_models(
    models: tuple[Path, ...],
    more_models: tuple[Path, ...],
    source_path: Path | None,
    images: str | None,
    resolution: int | None,
    view_set: str | None,
    compat: str,
    color_correct: bool,
    lpips: bool,
    flip: bool,
    report: Path | None,
    no_report: bool,
    save_renders: Path | None,
    background: Color | None,
    white_background: bool,
    iteration: int | None,
    device: str | None,
    quiet: bool,
) -> None:
    """Measure MODELS on their scenes' test views.

    Writes results.json, per_view.json and report.html, a page with the images, into each model's folder (with --set
    train or all: results_train.json and so on).
    """
    from clsplat.evaluation.perceptual import Flip, Lpips
    from clsplat.rendering.renderer import Renderer

    paths = (*more_models, *models)
    if not paths:
        raise click.UsageError("give at least one model folder")
    if report is not None and no_report:
        raise click.UsageError("give --report or --no-report, not both")
    if save_renders is not None and len({path.resolve().name for path in paths}) < len(paths):
        raise click.UsageError("--save-renders: models in folders of the same name; measure them one by one")
    colour = background_of(background, white_background)
    protocol = replace(protocol_named(compat), corrected=color_correct)
    metrics = (Lpips(unit_range=protocol.name == "3dgs") if lpips else None, Flip() if flip else None)
    renderer = Renderer(device)
    measured, pages = [], []
    for path in paths:
        loaded = load_model(path, iteration)
        if loaded.folder is None:
            raise InputError(f"{path}: is a file; eval takes model folders (render takes any PLY)")
        scene = scene_of(loaded, source_path, images, resolution)
        renders = save_renders and (save_renders / path.resolve().name if len(paths) > 1 else save_renders)
        measured.append(
            measure_model(
                loaded,
                scene,
                renderer,
                protocol,
                view_set or "test",
                colour,
                renders,
                ViewRecorder(*metrics, not no_report, color_correct),
                quiet,
            )
        )
        if report is None and not no_report and measured[-1].unwritten is None:
            page = loaded.folder.path / f"{Path(REPORT).stem}{_ending(view_set or 'test')}.html"
            pages.append(write_model_page(page, scene.name, measured[-1:], [path.resolve().name]))
    if report is not None:
        pages.append(write_model_page(report, scene.name, measured, _labels(paths)))
    if not quiet:
        _say(paths, measured)
        click.echo(describe(protocol))
        for page in pages:
            click.echo(f"page: {page}")
    for one in measured:
        if one.unwritten is not None:
            raise one.unwritten


def measure_model(
    model: LoadedModel,
    scene: Scene,
    renderer: Renderer,
    protocol: MetricProtocol = DEFAULT_PROTOCOL,
    view_set: str = "test",
    background: Color | None = None,
    renders: Path | None = None,
    recorder: ViewRecorder | None = None,
    quiet: bool = False,
) -> Measurement:
    """Render and measure one model's views, and write its results.json and per_view.json.

    Parameters
    ----------
    recorder : of further metrics and of images for a page; None: neither. quiet : show no progress.

    Raises
    ------
    InputError : the scene has no such views. OutputError : the renders cannot be written.
    """
    from clsplat.evaluation.evaluate import evaluate

    assert model.folder is not None
    views = {"test": scene.test, "train": scene.train, "all": scene.views}[view_set]
    if not views:
        raise InputError(
            f"{model.path}: was trained on all views, none is left to test it on: "
            "train with --eval, or measure training views with --set train"
        )
    record = recorder or ViewRecorder(pages=False)
    writer = None if renders is None else ImageWriter(renders, "png")
    names = [view.name for view in views]
    stems = dict(zip(names, output_stems(names), strict=True)) if writer else {}

    done = counted(names, "measuring", quiet)

    def on_view(view: View, image: Rendered) -> None:
        next(done)
        if writer is not None:
            writer.write(stems[view.name], image)
        record(view, image)

    colour = model.background if background is None else background
    with closing(done):
        measured = evaluate(renderer, model.splats, list(views), colour, protocol, on_view)
    splats = model.splats
    per_view = {
        metric: {name: values[metric] for name, values in measured.per_view.items()} for metric in ("SSIM", "PSNR")
    } | record.per_view
    described = protocol.describe() | {
        name: metric.describe()
        for name, metric in (("LPIPS", record.lpips), ("FLIP", record.flip))
        if metric is not None
    }
    result = {
        "SSIM": measured.ssim,
        "PSNR": measured.psnr,
        **{metric: statistics.fmean(values.values()) for metric, values in record.per_view.items()},
        "render_ms": measured.render_ms,
        "bytes": model.ply.stat().st_size,
        **complexity(splats).to_json(),
        "shape": splats.shape,
        "normalisation": splats.normalisation,
        "set": view_set,
        "views": len(views),
        "background": list(colour),
        "device": str(renderer.device.info),
        "protocol": described,
    }
    unwritten = None
    try:
        for stem, entry in (("results", result), ("per_view", per_view)):
            _add(model.folder.path / f"{stem}{_ending(view_set)}.json", f"ours_{model.iteration}", entry)
    except OutputError as error:  # what was measured is said first
        unwritten = error
    return Measurement(model, result, per_view, record.shots, unwritten)


def _say(paths: Sequence[Path], measured: Sequence[Measurement]) -> None:
    metrics = [metric for metric in _DIGITS if metric in measured[0].result]
    rows = [
        (
            str(path),
            str(one.result["splats"]),
            *(f"{one.result[name]:.{_DIGITS[name]}f}" for name in metrics),
            f"{one.result['render_ms']:.1f}",
            f"{one.result['bytes'] / 1e6:.2f}",
        )
        for path, one in zip(paths, measured, strict=True)
    ]
    click.echo(table(("model", "splats", *metrics, "render ms", "MB"), rows))


def _labels(paths: Sequence[Path]) -> list[str]:
    """Names of the folders, or whole paths where two have one name."""
    names = [path.resolve().name for path in paths]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


def _ending(view_set: str) -> str:
    return "" if view_set == "test" else f"_{view_set}"


def describe(protocol: MetricProtocol) -> str:
    """One line on how the numbers were taken."""
    said = protocol.describe()
    return f"protocol {said['name']}: PSNR {said['PSNR']}; SSIM {said['SSIM']}"


def _add(path: Path, key: str, entry: dict[str, Any]) -> None:
    """Write the entry into a JSON object that may hold those of other iterations."""
    try:
        known = read_object(path)
    except InputError:  # absent or damaged: it is made of what we measure, so nothing is lost
        known = {}
    write_json(path, known | {key: entry})

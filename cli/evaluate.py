"""`clsplat eval`: metrics of trained models on views of their scenes, in 3DGS's files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.complexity import complexity
from clsplat.errors import InputError
from clsplat.metrics import DEFAULT_PROTOCOL, PROTOCOLS, Protocol, protocol_named
from clsplat.model_folder import read_json, write_json

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
from .progress import table

if TYPE_CHECKING:
    from clsplat.render import Rendered, Renderer
    from clsplat.scene import Scene, View

HEAD = ("model", "splats", "PSNR", "SSIM", "render ms", "MB")


@click.command("eval")
@click.argument("models", nargs=-1, type=PATH)
@click.option("-m", "--model-path", "more_models", type=PATH, multiple=True, help="The same as an argument.")
@scene_options
@set_option
@click.option("--compat", type=click.Choice(list(PROTOCOLS)), default=DEFAULT_PROTOCOL.name,
              show_default=True, help="How PSNR and SSIM are taken; 3dgs pads SSIM with zeros.")
@click.option("--save-renders", type=PATH, metavar="DIR", help="Also write the images as PNG.")
@background_options
@iteration_option
@device_option
@quiet_option
def evaluate_models(models: tuple[Path, ...], more_models: tuple[Path, ...], source_path: Path | None,
                    images: str | None, resolution: int | None, view_set: str | None, compat: str,
                    save_renders: Path | None, background: RGB | None, white_background: bool,
                    iteration: int | None, device: str | None, quiet: bool) -> None:
    """Measure MODELS on their scenes' test views.

    Writes results.json and per_view.json into each model's folder (with --set train or all:
    results_train.json and so on).
    """
    from clsplat.render import Renderer

    paths = (*more_models, *models)
    if not paths:
        raise click.UsageError("give at least one model folder")
    if save_renders is not None and len({path.resolve().name for path in paths}) < len(paths):
        raise click.UsageError("--save-renders: models in folders of the same name; measure them one by one")
    colour, protocol = background_of(background, white_background), protocol_named(compat)
    renderer = Renderer(device)
    rows = []
    for path in paths:
        loaded = load_model(path, iteration)
        if loaded.folder is None:
            raise InputError(f"{path}: is a file; eval takes model folders (render takes any PLY)")
        scene = scene_of(loaded, source_path, images, resolution)
        renders = save_renders and (save_renders / path.resolve().name if len(paths) > 1 else save_renders)
        result = measure_model(loaded, scene, renderer, protocol, view_set or "test", colour, renders, quiet)
        rows.append((str(path), str(result["splats"]), f"{result['PSNR']:.3f}", f"{result['SSIM']:.4f}",
                     f"{result['render_ms']:.1f}", f"{result['bytes'] / 1e6:.2f}"))
    if not quiet:
        click.echo(table(HEAD, rows))
        click.echo(describe(protocol))


def measure_model(model: LoadedModel, scene: Scene, renderer: Renderer, protocol: Protocol = DEFAULT_PROTOCOL,
                  view_set: str = "test", background: RGB | None = None, renders: Path | None = None,
                  quiet: bool = False) -> dict[str, Any]:
    """Render and measure one model's views, and write its results.json and per_view.json.

    Returns
    -------
    The entry of results.json.

    Raises
    ------
    InputError : the scene has no such views. OutputError : cannot be written.
    """
    from clsplat.evaluate import evaluate

    assert model.folder is not None
    views = {"test": scene.test, "train": scene.train, "all": scene.views}[view_set]
    if not views:
        raise InputError(f"{model.path}: was trained on all views, none is left to test it on: "
                         "train with --eval, or measure training views with --set train")
    on_view = None
    if renders is not None:
        writer = ImageWriter(renders, "png")
        names = [view.name for view in views]
        stems = dict(zip(names, output_stems(names), strict=True))

        def on_view(view: View, image: Rendered) -> None:
            writer.write(stems[view.name], image)

    colour = model.background if background is None else background
    measured = evaluate(renderer, model.splats, list(views), colour, protocol, on_view)
    splats = model.splats
    result = {
        "SSIM": measured.ssim, "PSNR": measured.psnr, "render_ms": measured.render_ms,
        "bytes": model.ply.stat().st_size, **complexity(splats).to_json(),
        "shape": splats.shape, "normalisation": splats.normalisation, "set": view_set, "views": len(views),
        "background": list(colour), "device": str(renderer.device.info), "protocol": protocol.describe(),
    }
    per_view = {metric: {name: values[metric] for name, values in measured.per_view.items()}
                for metric in ("SSIM", "PSNR")}
    ending = "" if view_set == "test" else f"_{view_set}"
    for stem, entry in (("results", result), ("per_view", per_view)):
        _add(model.folder.path / f"{stem}{ending}.json", f"ours_{model.iteration}", entry)
    return result


def describe(protocol: Protocol) -> str:
    """One line on how the numbers were taken."""
    said = protocol.describe()
    return f"protocol {said['name']}: PSNR {said['PSNR']}; SSIM {said['SSIM']}"


def _add(path: Path, key: str, entry: dict[str, Any]) -> None:
    """Write the entry into a JSON object that may hold those of other iterations."""
    try:
        known = read_json(path)
    except InputError:  # absent or damaged: it is made of what we measure, so nothing is lost
        known = {}
    write_json(path, known | {key: entry})

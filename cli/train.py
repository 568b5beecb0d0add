"""`clsplat train`: learn a splat model of a scene."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from clsplat.errors import InputError, OutputError
from clsplat.files.json_file import read_object
from clsplat.splats.color import Color
from clsplat.training.config import TrainConfig, read_options
from clsplat.training.folder import ModelFolder
from clsplat.training.presets import PRESETS, with_preset

from .budget import budget_options, forget_search, is_search, options_of, run_search, stored_search
from .main import INTERRUPTED
from .options import (
    PATH,
    TrainingCommand,
    config_options,
    config_values,
    hiding_options,
    is_given,
    overwrite_option,
    quiet_option,
    scene_options,
    split_options,
)
from .progress import TrainingDisplay, duration
from .reconstruct import scene_of_photos
from .view import server_options

if TYPE_CHECKING:
    from clsplat.evaluation.evaluate import Evaluation
    from clsplat.scenes.scene import Scene
    from clsplat.training.run import Model
    from clsplat.viewer.training_session import TrainingSession

SCENE_KEYS = ("images", "resolution", "masks", "alpha", "test_every", "test_list", "eval")


@click.command(cls=TrainingCommand)
@click.argument("scene", required=False, type=PATH)
@click.option(
    "-m",
    "--model-path",
    "-o",
    "model_path",
    type=PATH,
    help="Folder of the model.  [default: output/<name of the scene>]",
)
@scene_options
@hiding_options
@click.option("--eval", is_flag=True, help="Hold test views out of training, and measure them at the end.")
@split_options
@click.option("--resume", is_flag=True, help="Go on from the model's checkpoint, with the options of its run.")
@overwrite_option
@quiet_option
@click.option(
    "--preset",
    type=click.Choice(list(PRESETS)),
    help="A published system: kernel, optimizer, strategy and constants; other options replace constants.",
)
@click.option(
    "--config",
    "config_file",
    type=PATH,
    metavar="FILE",
    help="Options from a former run's config.json, or a JSON object of some; those given replace them.",
)
@click.option("--view", is_flag=True, help="Show the run in the browser while it trains.")
@server_options
@budget_options
@config_options()
@click.pass_context
def train(
    ctx: click.Context,
    /,
    scene: Path | None,
    source_path: Path | None,
    model_path: Path | None,
    resume: bool,
    overwrite: bool,
    quiet: bool,
    preset: str | None,
    config_file: Path | None,
    view: bool,
    port: int,
    host: str,
    **values: Any,
) -> None:
    """Learn a splat model of SCENE, a folder with photos in images/ and a COLMAP model in sparse/, or with
    transforms.json or transforms_train.json (NeRF's Blender sets, instant-ngp, nerfstudio). A folder of photographs
    alone, or a video, is reconstructed first, into NAME-scene beside the model's folder (see clsplat reconstruct).

    Writes config.json, cameras.json, log.jsonl, checkpoint.npz and point_cloud/iteration_N/point_cloud.ply
    into the model's folder. Ctrl-C saves a checkpoint; --resume goes on from it. With --budget auto also budget.json
    and the growth curve; the small model is the last point cloud.
    """
    from clsplat.scenes.reconstruct.photo_files import is_photographs, is_video

    if resume and overwrite:
        raise click.UsageError("give --resume or --overwrite, not both")
    if scene and source_path and scene != source_path:
        raise click.UsageError(f"two scenes: {scene} and {source_path}")
    path = scene or source_path
    search = options_of(values)
    if view and search is not None:
        raise click.UsageError("--view shows one run: leave out --budget, or look at the result with clsplat view")
    options = config_values(ctx, values)
    if config_file is not None:
        options = _options_in(config_file) | options
    if preset is not None:
        options = with_preset(preset, options)
    reading = {key: values[key] for key in SCENE_KEYS if is_given(ctx, key)}
    if path is None and not (resume and model_path):
        raise click.UsageError("give the scene's folder")
    if model_path is None:
        assert path is not None
        model_path = Path("output") / (path.stem if is_video(path) else path.resolve().name)
    folder = ModelFolder(model_path)
    if resume:
        stored = stored_search(model_path)
        if search is not None and stored is None:
            raise InputError(f"{model_path}: no search to resume from: start without --resume")
        if stored is not None:
            stored_config, search, stored_scene = stored[0], search or stored[1], stored[2]
        else:
            stored_config, stored_scene = _stored_run(folder)
        options, reading = stored_config | options, stored_scene | reading
        path = path or Path(reading["path"])
    elif (folder.is_used or is_search(model_path)) and not overwrite:
        # train() says so too, but only after the scene is read.
        raise OutputError(f"{model_path}: already holds a model: use --overwrite, --resume or another folder")
    assert path is not None
    config = TrainConfig(**options)
    if is_photographs(path):
        path = scene_of_photos(path, model_path, overwrite, quiet)
    loaded, record = read_scene(path, reading, config.background)
    if search is not None:
        if view:
            raise click.UsageError(f"{model_path} is a search of many runs: resume it without --view")
        run_search(ctx, loaded, config, search, model_path, record, resume, overwrite, quiet)
        return
    with _viewer(loaded, config, model_path, host, port, quiet) if view else nullcontext() as live:
        forget_search(model_path)
        model = run_training(loaded, config, model_path, record, resume, overwrite, quiet, live)
    if not model.finished:
        say_stopped(ctx, model)
    if not quiet:
        report(model, test_metrics(model, loaded))


def read_scene(path: Path, reading: dict[str, Any], background: Color) -> tuple[Scene, dict[str, Any]]:
    """The scene, and what config.json shall say of how it was read.

    reading : any of SCENE_KEYS; the others take load_scene's defaults, without test views.
    """
    from clsplat.scenes.scene import load_scene

    arguments = {key: reading[key] for key in SCENE_KEYS if reading.get(key) is not None}
    arguments["eval"] = bool(arguments.get("eval") or "test_every" in arguments or "test_list" in arguments)
    scene = load_scene(path, background=background, **arguments)
    record = {key: arguments.get(key) for key in SCENE_KEYS}
    if record["test_list"] is not None:
        record["test_list"] = str(Path(record["test_list"]).resolve())
    return scene, record


def run_training(
    scene: Scene,
    config: TrainConfig,
    model_path: Path,
    record: dict[str, Any],
    resume: bool = False,
    overwrite: bool = False,
    quiet: bool = False,
    live: TrainingSession | None = None,
) -> Model:
    """Train with a live display, and a page in the browser if `live` is given."""
    from clsplat.training.run import train as train_model

    with TrainingDisplay(quiet) as display:
        return train_model(
            scene,
            config,
            live.progress(display) if live else display,
            output=model_path,
            resume=resume,
            overwrite=overwrite,
            extra=record,
            visit=live.visit if live else None,
        )


def _viewer(scene: Scene, config: TrainConfig, model_path: Path, host: str, port: int, quiet: bool) -> TrainingSession:
    from clsplat.viewer.session import ServerOptions
    from clsplat.viewer.training_session import TrainingSession

    session = TrainingSession(scene, config, model_path.resolve().name, ServerOptions(host, port))
    if not quiet:
        click.echo(f"training can be watched at {session.url}", err=True)
    return session


def test_metrics(model: Model, scene: Scene) -> Evaluation | None:
    """Metrics of the finished model on the views held out; None where there are none."""
    if not scene.test or model.iteration in model.evaluations:
        return model.evaluations.get(model.iteration)
    from clsplat.evaluation.evaluate import evaluate
    from clsplat.rendering.renderer import Renderer

    return evaluate(Renderer(model.config.device), model.splats, scene.test, model.config.background)


def say_stopped(ctx: click.Context, model: Model) -> NoReturn:
    """After Ctrl-C: how to go on."""
    click.echo(
        f"stopped at iteration {model.iteration}, checkpoint saved; to go on: clsplat train --resume -m {model.path}",
        err=True,
    )
    ctx.exit(INTERRUPTED)


def report(model: Model, metrics: Evaluation | None) -> None:
    """Say where the model is, what it took, and how good it is."""
    assert model.path is not None
    ply = ModelFolder(model.path).ply_path(model.iteration)
    click.echo(f"{ply}: {len(model.splats)} splats, {ply.stat().st_size / 1e6:.2f} MB")
    click.echo(
        f"trained {model.iteration} iterations in {duration(model.seconds)}, "
        f"peak memory {model.peak_bytes / 1e6:.0f} MB"
    )
    if metrics is not None:
        click.echo(f"test views ({len(metrics.per_view)}): PSNR {metrics.psnr:.2f} dB, SSIM {metrics.ssim:.4f}")


def _options_in(file: Path) -> dict[str, Any]:
    """TrainConfig's arguments that a JSON file has."""
    values = read_object(file)
    values = values.get("config", values)
    try:
        TrainConfig.from_json(values)
        return read_options(values)
    except (AttributeError, TypeError, ValueError) as error:
        raise InputError(
            f'{file}: not options of a run ({error}): give a config.json, or an object such as {{"iterations": 2000}}'
        ) from None
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _stored_run(folder: ModelFolder) -> tuple[dict[str, Any], dict[str, Any]]:
    """Options and scene of the run in the folder."""
    if not folder.checkpoint_path.is_file():
        raise InputError(f"{folder.path}: no checkpoint to resume from: start with --overwrite")
    stored = folder.read_config()
    try:
        TrainConfig.from_json(stored["config"])
        scene = dict(stored["scene"])
        scene["path"] = str(scene["path"])
    except (InputError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{folder.config_path}: damaged ({error}): start again with --overwrite") from None
    return read_options(stored["config"]), scene

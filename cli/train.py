"""`clsplat train`: learn a splat model of a scene."""

from __future__ import annotations

import sys
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from clsplat.device.specs import count_devices
from clsplat.errors import InputError
from clsplat.files.real_path import real_path
from clsplat.files.stop_signals import exit_code
from clsplat.models.resume import find_unfinished
from clsplat.scenes.options import READING_OPTIONS
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import decide
from clsplat.training.folder import ModelFolder
from clsplat.training.presets import PRESETS, with_preset
from clsplat.training.quality import NORMAL, QUALITIES, quality
from clsplat.training.stored_run import (
    check_reading,
    existing_scene,
    load_recorded_scene,
    read_options_file,
    read_views_of_file,
)
from clsplat.viewer.options import ServerOptions

from .blocks import blocks_options, given_blocks, run_blocks
from .budget import budget_options, run_search, search_options
from .comparison_options import check_device, cluster_option
from .options import (
    PATH,
    TrainingCommand,
    changed_photos_option,
    config_options,
    config_values,
    hiding_options,
    is_given,
    overwrite_option,
    quiet_option,
    scene_options,
    split_options,
    warn_without_effect,
)
from .progress import TrainingDisplay, activity_line, duration, report_test_views, resume_command
from .reconstruct import scene_of_photos
from .view import addresses, server_options

if TYPE_CHECKING:
    from clsplat.evaluation.evaluate import Evaluation
    from clsplat.scenes.scene import Scene
    from clsplat.training.run import Model
    from clsplat.viewer.training_session import TrainingSession


SECTIONS = {
    "Common options": (
        "model_path",
        "quality_name",
        "iterations",
        "cap_max",
        "resolution",
        "eval",
        "budget",
        "white_background",
        "view",
        "resume",
        "overwrite",
        "device",
        "quiet",
    ),
    "Photos and test views": (
        "source_path",
        "images",
        "masks",
        "alpha",
        "test_every",
        "test_list",
        "allow_changed_photos",
    ),
    "Search for a small model": ("budget_tolerance", "target_psnr", "max_bytes"),
    "Large scenes, and workers": ("blocks", "polish", "cluster"),
    "Viewer": ("port", "host", "names", "token", "stay"),
    "Published systems and files of options": ("preset", "config_file"),
}


def _qualities() -> str:
    """Return the values of the dial, for its help."""
    return "; ".join(
        f"{name} has {values['iterations']} iterations and at most {values['cap_max']} splats"
        for name, values in QUALITIES.items()
    )


@click.command(
    cls=TrainingCommand,
    sections=SECTIONS,
    examples=(
        (
            "clsplat train PHOTOS -m MODEL --eval --quality draft",
            "A quick model of photos without known cameras, measured on test views.",
        ),
        (
            "clsplat train SCENE -m MODEL --cap-max 20000 -r 4",
            "A small model from photos at a quarter of their size.",
        ),
        (
            "clsplat train SCENE -m MODEL --blocks 2x2 --cluster local:2",
            "A large scene in four blocks, two at a time.",
        ),
        ("clsplat train --resume -m MODEL", "Continue a run that was stopped."),
    ),
    see_also=("reconstruct", "eval", "view"),
)
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
@click.option(
    "--quality",
    "quality_name",
    type=click.Choice(list(QUALITIES)),
    help=f"How long to train, and with how many splats: {_qualities()}. Flags replace them.  [default: {NORMAL}]",
)
@click.option("--eval", is_flag=True, help="Hold test views out of training, and measure them at the end.")
@split_options("; implies --eval")
@click.option("--resume", is_flag=True, help="Continue from the model's checkpoint, with the options of its run.")
@changed_photos_option
@overwrite_option("the model that is there, and start again")
@quiet_option
@click.option(
    "--preset",
    type=click.Choice(list(PRESETS)),
    help="A published system: kernel, optimizer, strategy and constants. Flags replace its constants.",
)
@click.option(
    "--config",
    "config_file",
    type=PATH,
    metavar="FILE",
    help="Training options from a config.json, or from a JSON object of some options. Flags replace them.",
)
@click.option("--view", is_flag=True, help="Show the run in the browser while it trains.")
@server_options
@click.option(
    "--stay/--no-stay",
    default=None,
    help="Keep the page of --view open after training, until Ctrl-C.  [default: at a terminal without --quiet]",
)
@budget_options
@blocks_options
@cluster_option
@config_options()
@click.pass_context
def train(
    ctx: click.Context,
    /,
    scene: Path | None,
    source_path: Path | None,
    model_path: Path | None,
    resume: bool,
    allow_changed_photos: bool,
    overwrite: bool,
    quiet: bool,
    quality_name: str | None,
    preset: str | None,
    config_file: Path | None,
    view: bool,
    port: int,
    host: str,
    names: tuple[str, ...],
    token: bool,
    stay: bool | None,
    cluster: str | None,
    **values: Any,
) -> None:
    """Learn a splat model of SCENE.

    SCENE is a folder of photos, a video, or a folder of photos with known cameras. Ctrl-C saves a checkpoint, and
    --resume continues from it.

    Known cameras are a COLMAP model in sparse/ beside the photos in images/, or transforms.json or
    transforms_train.json (nerfstudio, instant-ngp, NeRF's Blender sets). An OPF project (.opf) of Pix4D, the cameras of
    Metashape (.xml) and a reconstruction.json of OpenSfM work, too. Without known cameras, the photos or the video are
    reconstructed first, into MODEL/scene (see clsplat reconstruct).

    The model's folder gets config.json, cameras.json, log.jsonl, checkpoint.npz and
    point_cloud/iteration_N/point_cloud.ply. With --budget auto, it gets budget.json and a chart of the rounds in place
    of the checkpoint; the small model is the last point cloud.
    """
    from clsplat.scenes.changed_photos import check_photos
    from clsplat.scenes.reconstruct.photo_files import is_photographs
    from clsplat.training.run import check_start

    _check_flags(ctx)
    path = scene or source_path
    if path is None and not (resume and model_path):
        raise click.UsageError("give the scene's folder")
    search, blocks_for = search_options(values), given_blocks(values, resume)
    if blocks_for is not None and (view or search is not None):
        raise click.UsageError("--blocks is for one model of a large scene: remove --view and --budget")
    if count_devices(values.get("device")) > 1 and (blocks_for is not None or search is not None):
        raise click.UsageError("--blocks and --budget share runs, not photos, among devices: give --cluster local:N")
    check_device(values.get("device"), cluster)
    if view and search is not None:
        raise click.UsageError("--view shows one run: remove --budget, or show the result with clsplat view")
    flags = config_values(ctx, values)
    options = {} if config_file is None else read_options_file(config_file)
    batch = flags.get("batch", count_devices(flags.get("device")))
    if batch > 1 and preset is None and not resume:
        quality_name = quality_name or NORMAL  # its iterations count photos
    options |= ({} if quality_name is None else quality(quality_name, batch)) | flags
    if preset is not None:
        options = with_preset(preset, options)
    reading = {} if config_file is None or resume else read_views_of_file(config_file)
    reading |= {key: values[key] for key in READING_OPTIONS if is_given(ctx, key)}
    model_path = model_path or _default_folder(path)
    recorded, photos, blocks = None, {}, None
    if resume:
        stored = find_unfinished(model_path)
        if search is not None and stored.search is None:
            raise InputError(f"{model_path}: no search to resume from: start without --resume")
        check_reading(stored.run.scene, reading, model_path)
        options, reading = stored.run.options | options, stored.run.scene | reading
        recorded, photos = stored.run.scene_path, stored.run.scene["photos"]
        path, search, blocks = path or existing_scene(recorded, model_path), search or stored.search, stored.blocks
    else:
        ModelFolder(model_path).refuse_model(overwrite)  # the function train does so only after the scene is read
    assert path is not None
    config = TrainConfig(**options)
    blocks = blocks_for(config) if blocks_for is not None else blocks
    if view and (search is not None or blocks is not None):
        raise click.UsageError(f"{model_path} is a training of many runs: resume it without --view")
    if cluster is not None and search is None and blocks is None:
        raise click.UsageError("--cluster is for several runs: give --blocks or --budget auto too")
    if cluster is None:  # else each worker has its own devices
        check_start(config)
    if is_photographs(path):
        path = scene_of_photos(path, model_path, overwrite, quiet, recorded)
    with activity_line(quiet):
        loaded = load_recorded_scene(path, reading, config.background)
    decided = decide(loaded, config).config
    warn_without_effect([decided], flags, loaded)
    check_photos(loaded, photos, model_path, allow=allow_changed_photos, all_views=True)
    if blocks is not None:
        run_blocks(ctx, loaded, config, blocks, model_path, resume, overwrite, quiet, cluster)
        return
    if search is not None:
        run_search(ctx, loaded, config, search, model_path, resume, overwrite, quiet, cluster)
        return
    serving = ServerOptions(host, port, names, token)
    with _viewer(loaded, decided, model_path, serving, quiet) if view else nullcontext() as live:
        model = run_training(loaded, config, model_path, resume, overwrite, quiet, live)
        if not model.finished:
            report_interruption(ctx, model)
        if not quiet:
            from clsplat.training.run import evaluate_test_views

            known = model.evaluations.get(model.iteration)
            report(model, known or evaluate_test_views(model.splats, loaded, model.config))
        if live is not None and (sys.stderr.isatty() and not quiet if stay is None else stay):
            _stay(live, model, quiet)


def _check_flags(ctx: click.Context) -> None:
    """Raise UsageError for flags that contradict each other, or that need another flag."""
    flags = ctx.params
    if flags["resume"] and flags["overwrite"]:
        raise click.UsageError("give --resume or --overwrite, not both")
    if flags["scene"] and flags["source_path"] and flags["scene"] != flags["source_path"]:
        raise click.UsageError(f"two scenes: {flags['scene']} and {flags['source_path']}")
    if flags["allow_changed_photos"] and not flags["resume"]:
        raise click.UsageError("--allow-changed-photos is for --resume")
    if flags["resume"] and flags["quality_name"] is not None:
        raise click.UsageError("--quality is for new runs: to train longer, give --resume and --iterations")
    if flags["stay"] is not None and not flags["view"]:
        raise click.UsageError("--stay and --no-stay need --view")
    if not flags["view"] and any(is_given(ctx, name) for name in ("port", "host", "names", "token")):
        raise click.UsageError("--port, --host, --allow-host and --token need --view")


def _stay(live: TrainingSession, model: Model, quiet: bool) -> None:
    """Keep the page of a finished run open until Ctrl-C."""
    if not quiet:
        page = f"the page stays open at {addresses(live.urls)} until Ctrl-C"
        click.echo(f"{page}; later: clsplat view {model.path}", err=True)
    with suppress(KeyboardInterrupt):
        live.stay(model)


def _default_folder(scene: Path | None) -> Path:
    """Return the model's folder for a scene: output/ and the name of the scene's folder, or of the video."""
    from clsplat.scenes.reconstruct.photo_files import is_video

    assert scene is not None
    return Path("output") / (scene.stem if is_video(scene) else real_path(scene).name)


def run_training(
    scene: Scene,
    config: TrainConfig,
    model_path: Path,
    resume: bool = False,
    overwrite: bool = False,
    quiet: bool = False,
    live: TrainingSession | None = None,
) -> Model:
    """Train with a live display, and with a page in the browser if `live` is not None."""
    from clsplat.training.run import train as train_model

    with TrainingDisplay(quiet) as display:
        return train_model(
            scene,
            config,
            live.progress(display) if live else display,
            output=model_path,
            resume=resume,
            overwrite=overwrite,
            visit=live.visit if live else None,
        )


def _viewer(
    scene: Scene, config: TrainConfig, model_path: Path, options: ServerOptions, quiet: bool
) -> TrainingSession:
    from clsplat.viewer.training_session import TrainingSession

    session = TrainingSession(scene, config, real_path(model_path).name, options)
    if not quiet:
        click.echo(f"training can be watched at {addresses(session.urls)}", err=True)
    return session


def report_interruption(ctx: click.Context, model: Model) -> NoReturn:
    """Print how to continue after Ctrl-C or another signal, and exit."""
    assert model.path is not None
    command = resume_command(model.path)
    click.echo(f"stopped at iteration {model.iteration}, checkpoint saved; to continue: {command}", err=True)
    ctx.exit(exit_code())


def report(model: Model, metrics: Evaluation | None) -> None:
    """Print where the model is, how long it took, and how good it is."""
    assert model.path is not None
    ply = ModelFolder(model.path).ply_path(model.iteration)
    click.echo(f"{ply}: {len(model.splats)} splats, {ply.stat().st_size / 1e6:.2f} MB")
    click.echo(
        f"trained {model.iteration} iterations in {duration(model.seconds)}, "
        f"peak memory {model.peak_bytes / 1e6:.0f} MB"
    )
    report_test_views(metrics)

"""Training of a model: checks that no model is lost and that a resumed run has its options, then runs the trainer."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from ..device.several import open_devices
from ..device.specs import first_device
from ..errors import InputError
from ..evaluation.evaluate import Evaluation, evaluate
from ..files.json_file import describe_any
from ..rendering.renderer import Renderer
from ..scenes.read_view import keep_photos
from ..scenes.scene import Scene
from ..scenes.split import split_for_run
from ..splats.fields import Group
from ..splats.splats import Splats
from .config import TrainConfig
from .decisions import as_decided, decide
from .exposure_hint import exposure_hint
from .extension import fitting_checkpoint
from .folder import ModelFolder
from .frame_hint import frame_hint
from .initialise import check_init
from .log import Progress
from .model import Model
from .point_fit import with_fitting_points
from .trainer import Trainer, Visit

__all__ = ["Model", "Progress", "train"]

_STORED_COPIES = 4  # of all parameters: the model, and the checkpoint with two moments of the optimizer


def train(
    scene: Scene,
    config: TrainConfig | None = None,
    progress: Callable[[Progress], None] | None = None,
    *,
    output: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    visit: Visit | None = None,
    context: Splats | Path | None = None,
) -> Model:
    """Train a splat model on a scene's training views and return it.

    Parameters
    ----------
    config : options of the run. Those that it does not name are decided by the scene (`training/decisions.py`).
    progress : called about every 50 iterations, at least twice a second, and with messages.
    output : model folder. Without it, no file is written and Ctrl-C raises KeyboardInterrupt.
    resume : continue from the folder's checkpoint. The config must be the same, except for options without an effect
        on the result, such as `device`, and for more `iterations`.
    overwrite : replace a model in `output`.
    visit : see `Trainer.run`. context : see `Trainer`; a resumed run needs the same one.

    Returns
    -------
    The model. After Ctrl-C it is not finished, and `resume` continues it.

    Raises
    ------
    InputError : the scene has no training views, or the checkpoint does not fit.
    OutputError : `output` holds a model, another run writes into it, it cannot be written, or its disk is too full.
    DeviceError : the device has too little memory.
    TrainingError : the loss is not finite; the last checkpoint is kept.
    """
    if isinstance(scene, str | os.PathLike):
        raise InputError(f"{scene}: train takes a scene, not its path: clsplat.load_scene reads it")
    if not isinstance(scene, Scene):
        raise InputError(f"scene is {describe_any(scene)}: train takes a scene: clsplat.load_scene reads one")
    if not isinstance(config, TrainConfig | None):
        raise InputError(f"config is a {type(config).__name__}: train takes options as clsplat.TrainConfig(...)")
    config = config or TrainConfig()
    folder = None if output is None else ModelFolder(output)
    with nullcontext() if folder is None else folder.for_run(resume=resume, overwrite=overwrite):
        checkpoint = None
        # Photos are decoded once, before the checks and hints. Each of these would decode many of them for itself.
        keep_photos(split_for_run(scene, config.validation.validate).train)
        scene = with_fitting_points(scene)  # also to go on: the extent of the scene depends on the points
        if folder is not None and resume:
            checkpoint = fitting_checkpoint(folder, config)
            config = as_decided(config, TrainConfig.from_json(checkpoint.config).to_json())
        else:
            config = decide(scene, config).tell(progress)
            if progress is not None:
                for hint in filter(None, (exposure_hint(scene, config), frame_hint(scene))):
                    progress(Progress.note(hint, config.iterations))
        trainer = Trainer(scene, config, checkpoint, progress, context=context)
        if folder is not None:
            if checkpoint is None:
                folder.check_space(_least_bytes(trainer))
                folder.clear()
            folder.write_run(config.to_json(), trainer.scene)
            folder.write_views([*scene.test, *trainer.scene.validation, *trainer.scene.train])
        return trainer.run(folder, visit)


def _least_bytes(trainer: Trainer) -> int:
    """Return the bytes of a model and its checkpoint with as many splats as a run begins with."""
    schema = trainer.splats.schema
    numbers = trainer.splats.n * sum(schema.rows(group) for group in Group)
    return _STORED_COPIES * numbers * np.dtype(np.float32).itemsize


def check_start(config: TrainConfig) -> None:
    """Raise what would stop a run before its first iteration, as far as the options alone show it.

    Raises
    ------
    InputError : `init` is unknown, or its file does not exist. DeviceError : a device cannot be opened.
    """
    check_init(config.start.init)
    open_devices(config.device)


def evaluate_test_views(splats: Splats, scene: Scene, config: TrainConfig) -> Evaluation | None:
    """Return the metrics of a trained model on the scene's test views, with the device and background of its run.

    Returns
    -------
    The metrics, or None if the scene has no test views. A run that learned exposures has a colour-corrected PSNR, too.
    """
    if not scene.test:
        return None
    renderer, exposure = Renderer(first_device(config.device)), config.appearance.exposure
    return evaluate(renderer, splats, scene.test, config.background, also_corrected=exposure)

"""The public call that trains: where results go, what may be overwritten, what a resumed run must agree with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..cameras.cameras_json import named_cameras
from ..errors import InputError, OutputError
from ..files.lock import folder_lock
from ..scenes.scene import Scene
from .checkpoint import Checkpoint
from .config import FREE_OPTIONS, TrainConfig
from .folder import ModelFolder
from .log import Progress
from .trainer import Model, Trainer, Visit

__all__ = ["Model", "Progress", "train"]


def train(
    scene: Scene,
    config: TrainConfig | None = None,
    progress: Callable[[Progress], None] | None = None,
    *,
    output: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    extra: dict[str, Any] | None = None,
    visit: Visit | None = None,
) -> Model:
    """Learn a splat model of a scene's training views.

    Parameters
    ----------
    progress : called about every 50 iterations.
    output : model folder; without it nothing is written and Ctrl-C raises as usual.
    resume : go on from the folder's checkpoint; the config must be the same but for `iterations`-independent
        options such as `device`.
    overwrite : allow replacing a model in `output`.
    extra : more keys for config.json's "scene" (how it was read), beside its path and test views.
    visit : see `Trainer.run`.

    Raises
    ------
    InputError : no training views, or a checkpoint that does not fit. OutputError : `output` holds a model and
    neither resume nor overwrite is given, another run writes into it, or it cannot be written. DeviceError : not enough
    memory. TrainingError : the loss is not finite; the last checkpoint is kept.
    """
    config = config or TrainConfig()
    folder = None if output is None else ModelFolder(output)
    checkpoint = None
    if folder is not None:
        if resume:
            checkpoint = _fitting_checkpoint(folder, config)
        elif folder.is_used and not overwrite:
            raise OutputError(f"{folder.path}: already holds a model: use --overwrite, --resume or another folder")
        folder.prepare()
    with folder_lock(None if folder is None else folder.path):
        trainer = Trainer(scene, config, checkpoint, progress)
        if folder is not None:
            if checkpoint is None:
                folder.clear()
            record = {"path": str(scene.path.resolve()), "test_names": sorted(scene.test_names)}
            folder.write_config({"config": config.to_json(), "scene": record | (extra or {})})
            views = [*scene.test, *scene.train]
            folder.write_cameras(named_cameras([view.name for view in views], [view.camera for view in views]))
        return trainer.run(folder, visit)


def _fitting_checkpoint(folder: ModelFolder, config: TrainConfig) -> Checkpoint:
    """The folder's checkpoint if the run it belongs to had this config."""
    checkpoint = Checkpoint.load(folder.checkpoint_path)
    stored = TrainConfig.from_json(checkpoint.config).to_json()
    for key, value in config.to_json().items():
        if key not in FREE_OPTIONS and stored[key] != value:
            raise InputError(
                f"{folder.path}: --resume with {key}={value}, but the run was started with "
                f"{key}={stored[key]}: use the same options, or --overwrite to start again"
            )
    return checkpoint

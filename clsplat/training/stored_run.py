"""Stored runs: the options and the record of the scene that are needed to resume or repeat a run."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..files.json_file import read_object
from ..scenes.options import READING_OPTIONS
from ..splats.color import BLACK, Color
from .config import TrainConfig, read_options
from .folder import ModelFolder

if TYPE_CHECKING:
    from ..scenes.scene import Scene

# Exceptions that mean that a stored run is damaged.
DAMAGE = (InputError, KeyError, TypeError, ValueError, AttributeError)


@dataclass(frozen=True)
class StoredRun:
    """Options of a run and the record of its scene.

    Attributes
    ----------
    options : arguments of TrainConfig.
    scene : the scene's path, its test views, and the arguments of `load_scene`.
    """

    options: dict[str, Any]
    scene: dict[str, Any]

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> StoredRun:
        """Return the run that the values of config.json describe. Raise one of DAMAGE if they do not describe one."""
        TrainConfig.from_json(values["config"])
        scene = dict(values["scene"])
        scene["path"] = str(scene["path"])
        return cls(read_options(values["config"]), scene)

    @property
    def scene_path(self) -> Path:
        """Path of the scene at the time of the run."""
        return Path(self.scene["path"])


def stored_run(path: str | os.PathLike[str]) -> StoredRun:
    """Return the run that a model folder's checkpoint belongs to.

    Raises
    ------
    InputError : there is no checkpoint, or config.json is damaged.
    """
    folder = ModelFolder(Path(path))
    if not folder.checkpoint_path.is_file():
        raise InputError(f"{folder.path}: no checkpoint to resume from: start with --overwrite")
    stored = folder.read_config()
    try:
        return StoredRun.from_json(stored)
    except DAMAGE as error:
        raise InputError(f"{folder.config_path}: damaged ({error}): start again with --overwrite") from None


def read_options_file(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the training options in a file as arguments of TrainConfig.

    The file is a config.json, or a JSON object with some options.

    Raises
    ------
    InputError : the file cannot be read, or an option is unknown or has a wrong value.
    """
    values = read_object(path)
    values = values.get("config", values)
    try:
        TrainConfig.from_json(values)
        return read_options(values)
    except (AttributeError, TypeError, ValueError) as error:
        raise InputError(
            f'{path}: not options of a run ({error}): give a config.json, or an object such as {{"iterations": 2000}}'
        ) from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def load_recorded_scene(path: str | os.PathLike[str], record: Mapping[str, Any], background: Color = BLACK) -> Scene:
    """Return a scene, loaded with the recorded arguments of `load_scene`.

    Parameters
    ----------
    record : arguments by name; None means the default. Without "eval", the scene has test views only if another
        argument selects them, or if the record names some.
    """
    from ..scenes.scene import load_scene  # imported late: it loads an image library, which would slow down --help

    arguments = {key: record[key] for key in READING_OPTIONS if record.get(key) is not None}
    chosen = "test_every" in arguments or "test_list" in arguments
    arguments["eval"] = bool(arguments.get("eval", record.get("test_names")) or chosen)
    return load_scene(path, background=background, **arguments)

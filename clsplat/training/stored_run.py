"""Stored runs: the options and the record of the scene that are needed to resume or repeat a run."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..files.json_file import MAX_NUMBER, describe, read_object, to_real
from ..files.real_path import real_path
from ..scenes.options import ALPHA_USES, BEFORE, READING_OPTIONS
from ..splats.color import BLACK, Color
from .config import FREE_OPTIONS, TrainConfig, read_options
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
    scene : the scene's path, its test views, digests of its photos, and the arguments of `load_scene`.
    """

    options: dict[str, Any]
    scene: dict[str, Any]

    @classmethod
    def from_json(cls, values: Mapping[str, Any], folder: Path) -> StoredRun:
        """Return the run that the values of config.json describe. Raise one of DAMAGE if they do not describe one.

        A relative path of the scene is relative to the model's folder.
        """
        for key in ("config", "scene"):
            if key not in values:
                raise InputError(f"{key} is missing")
        TrainConfig.from_json(values["config"])
        scene = checked_record(values["scene"])
        if "path" not in scene:
            raise InputError("scene.path is missing")
        scene["path"] = str(folder / scene["path"])
        scene.setdefault("photos", {})
        for key, value in BEFORE.items():
            scene.setdefault(key, value)
        return cls(read_options(values["config"]), scene)

    @property
    def scene_path(self) -> Path:
        """Path of the scene at the time of the run."""
        return Path(self.scene["path"])


def checked_record(record: object) -> dict[str, Any]:
    """Return the record of a scene without null values. Each value is checked, because people edit the file.

    Raises
    ------
    InputError : names the value that no run can have written.
    """
    if not isinstance(record, dict):
        raise InputError(f"scene is {describe(record)}; expected an object")
    known = {key: value for key, value in record.items() if value is not None}
    for key, value in known.items():
        if expected := _EXPECTED.get(key):
            words, is_sound = expected
            if not is_sound(value):
                raise InputError(f"scene.{key} is {_shown(value)}; expected {words}")
    return known


def _is_text(value: object) -> bool:
    """Return whether a value can be a file name. JSON may also hold null characters and halves of characters."""
    if not isinstance(value, str) or "\0" in value:
        return False
    try:
        os.fsencode(value)
    except UnicodeEncodeError:
        return False
    return True


def _is_list_of_names(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(name, str) for name in value)


def _is_place(value: object) -> bool:
    return _are_numbers(value, 3, lambda number: abs(number) < MAX_NUMBER)


def _are_parts(value: object) -> bool:
    return _are_numbers(value, 4, lambda number: 0 <= number <= 1)


def _are_numbers(value: object, count: int, is_sound: Callable[[float], bool]) -> bool:
    if not isinstance(value, list) or len(value) != count:
        return False
    return all((number := to_real(each)) is not None and is_sound(number) for each in value)


def _is_count(value: object) -> bool:
    return type(value) is int and 1 <= value <= _LARGEST


def _shown(value: object) -> str:
    """Return a number, or a few words on any other value."""
    return f"{value:.6g}" if (number := to_real(value)) is not None and math.isfinite(number) else describe(value)


_LARGEST = 1_000_000  # pixels of a width, and views
# What each value of the record must be, in words and as a test. load_scene describes the values.
_EXPECTED: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "path": ("the scene's folder or file", _is_text),
    "images": ("a folder's name", _is_text),
    "masks": ("a folder's name", _is_text),
    "test_list": ("a file's name", _is_text),
    "alpha": (f"one of {', '.join(ALPHA_USES)}", lambda value: value in ALPHA_USES),
    "resolution": (f"-1, or 1 to {_LARGEST}", lambda value: _is_count(value) or (type(value) is int and value == -1)),
    "test_every": (f"a whole number from 1 to {_LARGEST}", _is_count),
    "eval": ("true or false", lambda value: isinstance(value, bool)),
    "origin": ("three numbers", _is_place),
    "bars": ("four parts from 0 to 1", _are_parts),
    "rim": ("true or false", lambda value: isinstance(value, bool)),
    "photos": ("the digest of each photo by name", lambda value: isinstance(value, dict)),
    "test_names": ("a list of names", _is_list_of_names),
    "validation_names": ("a list of names", _is_list_of_names),
}


def stored_run(path: str | os.PathLike[str]) -> StoredRun:
    """Return the run that a model folder's checkpoint belongs to.

    Raises
    ------
    InputError : there is no checkpoint, or config.json is damaged.
    """
    folder = ModelFolder(Path(path))
    if not folder.path.is_dir():
        raise InputError(f"{folder.path}: no such folder: there is nothing to resume")
    if not folder.checkpoint_path.is_file():
        remedy = "start again with --overwrite" if folder.is_used else "start without --resume"
        raise InputError(f"{folder.path}: no checkpoint to resume from: {remedy}")
    stored = folder.read_config()
    try:
        return StoredRun.from_json(stored, folder.path)
    except DAMAGE as error:
        raise InputError(f"{folder.config_path}: damaged ({error}): start again with --overwrite") from None


def existing_scene(recorded: str | Path, model: Path) -> Path:
    """Return the path of the scene that a model's folder records. Raise InputError if it does not exist."""
    if not Path(recorded).exists():
        raise InputError(f"{model}: its scene {recorded} does not exist: give the scene's folder with -s")
    return Path(recorded)


def check_reading(recorded: Mapping[str, Any], reading: Mapping[str, Any], model: Path) -> None:
    """Raise InputError if a run would go on with a scene that is read in another way.

    Parameters
    ----------
    recorded : arguments of `load_scene` of the run; None stands for the default. reading : those that a user has named.
    model : the model's folder, for the message.
    """
    from ..scenes.scene import load_scene  # imported late, as below

    for key, value in reading.items():
        default = inspect.signature(load_scene).parameters[key].default
        before = default if recorded.get(key) is None else recorded[key]
        now = str(real_path(Path(value))) if key == "test_list" else value
        if now != before:
            raise InputError(
                f"{model}: --resume with {key}={now}, but the run was started with {key}={before}: use the same "
                "options, or --overwrite to start again"
            )


def holds_run(folder: ModelFolder, config: TrainConfig) -> bool:
    """Return whether a folder has the checkpoint of a run with these options, which are complete.

    The checkpoint says it, so that config.json is not needed.

    Raises
    ------
    UnusableCheckpoint : the checkpoint is damaged. InputError : it is of another version.
    """
    from .checkpoint import Checkpoint  # imported late: it loads OpenCL, which would slow down --help

    if not folder.checkpoint_path.is_file():
        return False
    stored = Checkpoint.options(folder.checkpoint_path)
    options = {key: value for key, value in config.to_json().items() if key not in FREE_OPTIONS}
    return all(stored[key] == value or moved_start(folder, key, value, stored[key]) for key, value in options.items())


def moved_start(folder: ModelFolder, key: str, now: Any, before: Any) -> bool:
    """Return whether an option of a run is the file of its first splats, which has moved together with its folder.

    The file is beside the folder of the run. Only the last two names of the path that it had count.
    """
    if key != "init":
        return False
    file = real_path(Path(now))
    return file.parent == real_path(folder.path).parent and file.parts[-2:] == Path(before).parts[-2:]


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


def read_views_of_file(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return how the run of a config.json read its views: "eval", "resolution" and "test_every", as far as recorded.

    Masks and folders of photos belong to its scene. A file of options records nothing.

    Raises
    ------
    InputError : the file cannot be read, or holds another value.
    """
    record = read_object(path).get("scene")
    if record is None:
        return {}
    try:
        known = checked_record(record)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return {key: known[key] for key in ("eval", "resolution", "test_every") if key in known}


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

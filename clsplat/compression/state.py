"""Progress of a search for the smallest model: budget.json and the models of its stages, for `--resume`."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files.json_file import read_object, write_json
from ..files.lock import folder_lock
from ..splats.splats import Splats
from ..training.config import FREE_OPTIONS, TrainConfig
from ..training.folder import ModelFolder
from ..training.stored_run import DAMAGE, StoredRun, holds_run
from .rules import BudgetOptions

FILE, FOLDER = "budget.json", "budget"


class BudgetState:
    """budget.json in a model's folder, written after every stage, and the models and runs of the stages.

    Attributes
    ----------
    values : "config", "options", "scene" (how it was read), and a key for each finished stage.
    """

    def __init__(self, output: Path) -> None:
        self.path, self.folder = output / FILE, output / FOLDER
        self.values: dict[str, Any] = {}

    def begin(self, config: TrainConfig, options: BudgetOptions, scene: dict[str, Any]) -> None:
        """Start a new search and delete the stages of an earlier one."""
        shutil.rmtree(self.folder, ignore_errors=True)
        values = {"config": config.to_json(), "options": asdict(options), "scene": scene}
        self.values = json.loads(json.dumps(values))  # the types that a resumed search reads
        write_json(self.path, self.values)

    def load(self) -> None:
        """Read an earlier search; raises InputError if it is missing, damaged, or of a version with other stages."""
        if not self.path.is_file():
            raise InputError(f"{self.path}: no search to resume from: start without --resume")
        values = read_object(self.path)
        for key in ("config", "options", "scene"):
            if not isinstance(values.get(key), dict):
                raise InputError(f"{self.path}: damaged (no {key!r}): start again with --overwrite")
        if "growth" in values:
            raise InputError(f"{self.path}: an earlier version began this search: start again with --overwrite")
        self.values = values

    def check(self, config: TrainConfig, options: BudgetOptions) -> None:
        """Raise InputError unless the search was started with these options."""
        stored = TrainConfig.from_json(self.values["config"]).to_json() | self.values["options"]
        for key, value in (config.to_json() | asdict(options)).items():
            if key not in FREE_OPTIONS and stored.get(key) != value:
                raise InputError(
                    f"{self.path}: --resume with {key}={value}, but the search was started with "
                    f"{key}={stored.get(key)}: use the same options, or --overwrite to start again"
                )

    def put(self, stage: str, value: Any) -> None:
        """Store the result of a finished stage."""
        self.values[stage] = value
        write_json(self.path, self.values)

    def save(self, name: str, splats: Splats) -> Path:
        """Save the model of a stage, and return its file."""
        path = self.folder / f"{name}.ply"
        splats.save(path)
        return path

    def model(self, name: str) -> Splats:
        """Load the model of a finished stage."""
        return Splats.load(self.folder / f"{name}.ply")

    def run_folder(self, name: str) -> ModelFolder:
        """Return the folder of a stage's run."""
        return ModelFolder(self.folder / name)

    def can_resume(self, folder: ModelFolder, config: TrainConfig) -> bool:
        """Whether a stage's run has a checkpoint of the same options. If the model's folder was moved, it has not."""
        return holds_run(folder, config)

    def remove(self) -> None:
        """Delete budget.json and the models of the stages."""
        self.end()
        self.path.unlink(missing_ok=True)

    def end(self) -> None:
        """Delete the models of the stages, which are no longer needed."""
        shutil.rmtree(self.folder, ignore_errors=True)


def is_search(output: Path) -> bool:
    """Whether a model folder holds a search, finished or not."""
    return (output / FILE).is_file()


def stored_search(output: Path) -> tuple[StoredRun, BudgetOptions] | None:
    """Return the options of a search that can be resumed; None if the folder does not hold a search.

    Raises
    ------
    InputError : budget.json is damaged, or the search is finished.
    """
    if not is_search(output):
        return None
    state = BudgetState(output)
    state.load()
    try:
        stored, options = StoredRun.from_json(state.values, output), BudgetOptions(**state.values["options"])
    except DAMAGE as error:
        raise InputError(f"{state.path}: damaged ({error}): start again with --overwrite") from None
    if "final" in state.values:
        raise InputError(f"{output}: the search is finished: nothing to resume")
    return stored, options


def remove_search(output: Path) -> None:
    """Remove a search before another run uses its folder.

    Raises
    ------
    OutputError : the search is running.
    """
    if is_search(output):
        with folder_lock(output):
            BudgetState(output).remove()

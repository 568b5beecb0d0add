"""Progress of a training in blocks: blocks.json and the runs of its stages, for `--resume`."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files.json_file import read_object, write_json
from ..training.config import FREE_OPTIONS, TrainConfig
from ..training.folder import ModelFolder
from ..training.stored_run import DAMAGE, StoredRun

FILE, FOLDER = "blocks.json", "blocks"


@dataclass(frozen=True)
class BlocksOptions:
    """How a scene is divided.

    Attributes
    ----------
    columns, rows : number of cells in each direction.
    polish : iterations of the last run, which trains all blocks together; None for a tenth of those of a block.
    """

    columns: int
    rows: int
    polish: int | None = None

    @property
    def count(self) -> int:
        """Number of blocks."""
        return self.columns * self.rows


class BlocksState:
    """blocks.json in a model's folder, written after every stage.

    Attributes
    ----------
    values : "config", "options", "scene" (how it was read), and a key for each finished stage.
    """

    def __init__(self, output: Path) -> None:
        self.path, self.folder = output / FILE, output / FOLDER
        self.values: dict[str, Any] = {}

    def begin(self, config: TrainConfig, options: BlocksOptions, scene: Mapping[str, Any]) -> None:
        """Start anew and delete the stages of an earlier training."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.values = {"config": config.to_json(), "options": asdict(options), "scene": dict(scene)}
        write_json(self.path, self.values)
        self.load()

    def load(self) -> None:
        """Read the file. Raise InputError if it is missing or damaged."""
        values = read_object(self.path)
        for key in ("config", "options", "scene"):
            if not isinstance(values.get(key), dict):
                raise InputError(f"{self.path}: damaged (no {key!r}): start again with --overwrite")
        self.values = values

    def check(self, config: TrainConfig, options: BlocksOptions) -> None:
        """Raise InputError unless the training was started with these options."""
        stored = TrainConfig.from_json(self.values["config"]).to_json() | self.values["options"]
        for key, value in (config.to_json() | asdict(options)).items():
            if key not in FREE_OPTIONS and stored.get(key) != value:
                raise InputError(
                    f"{self.path}: --resume with {key}={value}, but the training was started with "
                    f"{key}={stored.get(key)}: use the same options, or --overwrite to start again"
                )

    def put(self, stage: str, value: Any) -> None:
        """Store the result of a finished stage."""
        self.values[stage] = value
        write_json(self.path, self.values)

    def run_folder(self, name: str) -> ModelFolder:
        """Return the folder of a run."""
        return ModelFolder(self.folder / name)

    def end(self) -> None:
        """Delete the runs of the stages, which are no longer needed."""
        shutil.rmtree(self.folder, ignore_errors=True)


def is_in_blocks(output: Path) -> bool:
    """Whether a model folder holds a training in blocks, finished or not."""
    return (output / FILE).is_file()


def stored_blocks(output: Path) -> tuple[StoredRun, BlocksOptions] | None:
    """Return the options of a training in blocks that can be resumed; None if the folder does not hold one.

    Raises
    ------
    InputError : blocks.json is damaged, or the training is finished.
    """
    if not is_in_blocks(output):
        return None
    state = BlocksState(output)
    state.load()
    try:
        stored, options = StoredRun.from_json(state.values, output), BlocksOptions(**state.values["options"])
    except DAMAGE as error:
        raise InputError(f"{state.path}: damaged ({error}): start again with --overwrite") from None
    if "final" in state.values:
        raise InputError(f"{output}: the training in blocks is finished: nothing to resume")
    return stored, options


def remove_blocks(output: Path) -> None:
    """Remove a training in blocks before another run uses its folder."""
    if is_in_blocks(output):
        state = BlocksState(output)
        state.end()
        state.path.unlink(missing_ok=True)

"""Trainings of several stages: their file of finished stages, for `--resume`, and the step in what displays show."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, ClassVar

from ..errors import InputError
from ..files.json_file import read_object, write_json
from .config import FREE_OPTIONS, TrainConfig
from .folder import STAGES, ModelFolder
from .log import Progress
from .stored_run import DAMAGE, StoredRun


class StagesState:
    """A JSON file in a model's folder, written after every stage, and the folder of the stages' runs.

    Attributes
    ----------
    FILE : its name, one of STAGES. NAME, FINISHED : what messages say of it. OPTIONS : the class of its own options.
    values : "config", "options", "scene" (how it was read), and a key for each finished stage.
    """

    FILE: ClassVar[str]
    NAME: ClassVar[str]
    FINISHED: ClassVar[str]
    OPTIONS: ClassVar[type[Any]]

    def __init__(self, output: Path) -> None:
        self.path, self.folder = output / self.FILE, output / STAGES[self.FILE]
        self.values: dict[str, Any] = {}

    def begin(self, config: TrainConfig, options: Any, scene: Mapping[str, Any]) -> None:
        """Start anew and delete the stages of an earlier training."""
        shutil.rmtree(self.folder, ignore_errors=True)
        values = {"config": config.to_json(), "options": asdict(options), "scene": scene}
        self.values = json.loads(json.dumps(values))  # the types that a resumed training reads
        write_json(self.path, self.values)

    def load(self) -> None:
        """Read an earlier training. Raise InputError if its file is missing or damaged."""
        if not self.path.is_file():
            raise InputError(f"{self.path}: no {self.NAME} to resume from: start without --resume")
        values = read_object(self.path)
        for key in ("config", "options", "scene"):
            if not isinstance(values.get(key), dict):
                raise InputError(f"{self.path}: damaged (no {key!r}): start again with --overwrite")
        self.values = values

    def check(self, config: TrainConfig, options: Any) -> None:
        """Raise InputError unless the training was started with these options."""
        before = self.described(self.OPTIONS(**self.values["options"]))
        stored = TrainConfig.from_json(self.values["config"]).to_json() | before
        for key, value in (config.to_json() | self.described(options)).items():
            if key not in FREE_OPTIONS and stored.get(key) != value:
                raise InputError(
                    f"{self.path}: --resume with {key}={value}, but the {self.NAME} was started with "
                    f"{key}={stored.get(key)}: use the same options, or --overwrite to start again"
                )

    @staticmethod
    def described(options: Any) -> dict[str, Any]:
        """Return the options as messages call them."""
        return asdict(options)

    def put(self, stage: str, value: Any) -> None:
        """Store the result of a finished stage."""
        self.values[stage] = value
        write_json(self.path, self.values)

    def run_folder(self, name: str) -> ModelFolder:
        """Return the folder of a stage's run."""
        return ModelFolder(self.folder / name)

    def end(self) -> None:
        """Delete the runs of the stages, which are no longer needed."""
        shutil.rmtree(self.folder, ignore_errors=True)

    @classmethod
    def is_in(cls, output: Path) -> bool:
        """Whether a model folder holds such a training, finished or not."""
        return (output / cls.FILE).is_file()

    @classmethod
    def stored(cls, output: Path) -> tuple[StoredRun, Any] | None:
        """Return the options of a training that can be resumed; None if the folder does not hold one.

        Raises
        ------
        InputError : the file is damaged, or the training is finished.
        """
        if not cls.is_in(output):
            return None
        state = cls(output)
        state.load()
        try:
            stored, options = StoredRun.from_json(state.values, output), cls.OPTIONS(**state.values["options"])
        except DAMAGE as error:
            raise InputError(f"{state.path}: damaged ({error}): start again with --overwrite") from None
        if "final" in state.values:
            raise InputError(f"{output}: {cls.FINISHED}")
        return stored, options


class StepReports:
    """Sends messages and reports of runs to a display, with the step of the training that they belong to.

    A message that several runs have, such as a hint on the photos, is sent once.

    Parameters
    ----------
    report : the display; None without one. steps : number of steps. iterations : of a run, for messages.

    Attributes
    ----------
    progress : for `train`; None without a display.
    """

    def __init__(self, report: Callable[[Progress], None] | None, steps: int, iterations: int) -> None:
        self._report, self._steps, self._iterations, self._step = report, steps, iterations, 1
        self._sent: set[str] = set()
        self.progress: Callable[[Progress], None] | None = report and self._with_step

    def tell(self, step: int, message: str) -> None:
        """Send a message, and name the step (from 1) in all that follows."""
        self._step = step
        if self._report is not None:
            text = f"step {step} of {self._steps}, {message}"
            self._report(Progress.note(text, self._iterations))

    def _with_step(self, report: Progress) -> None:
        if self._report is None or report.message in self._sent:
            return
        if report.message:
            self._sent.add(report.message)
        self._report(replace(report, phase=f"step {self._step} of {self._steps}"))

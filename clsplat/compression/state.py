"""Progress of a search for the smallest model: budget.json and the models of its stages, for `--resume`."""

from __future__ import annotations

from pathlib import Path

from ..errors import InputError
from ..splats.splats import Splats
from ..training.folder import BUDGET
from ..training.stages import StagesState
from .rules import BudgetOptions


class BudgetState(StagesState):
    """budget.json in a model's folder, written after every stage, and the models and runs of the stages."""

    FILE, NAME, OPTIONS = BUDGET, "search", BudgetOptions
    FINISHED = "the search is finished: nothing to resume"

    def load(self) -> None:
        """Read an earlier search; raises InputError if it is missing, damaged, or of a version with other stages."""
        super().load()
        if "growth" in self.values:
            raise InputError(f"{self.path}: an earlier version began this search: start again with --overwrite")

    def save(self, name: str, splats: Splats) -> Path:
        """Save the model of a stage, and return its file."""
        path = self.folder / f"{name}.ply"
        splats.save(path)
        return path

    def model(self, name: str) -> Splats:
        """Load the model of a finished stage."""
        return Splats.load(self.folder / f"{name}.ply")

"""Progress of a training in blocks: blocks.json and the runs of its stages, for `--resume`."""

from __future__ import annotations

from dataclasses import dataclass

from ..training.folder import BLOCKS
from ..training.stages import StagesState


@dataclass(frozen=True)
class BlocksOptions:
    """How a scene is divided.

    Attributes
    ----------
    columns, rows : number of cells in each direction.
    polish : iterations of the last run, which trains all blocks together; None for half of those of a block.
    """

    columns: int
    rows: int
    polish: int | None = None

    @property
    def count(self) -> int:
        """Number of blocks."""
        return self.columns * self.rows


class BlocksState(StagesState):
    """blocks.json in a model's folder, written after every stage."""

    FILE, NAME, OPTIONS = BLOCKS, "training", BlocksOptions
    FINISHED = "the training in blocks is finished: nothing to resume"

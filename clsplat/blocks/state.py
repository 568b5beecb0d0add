"""Progress of a training in blocks: blocks.json and the runs of its stages, for `--resume`."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral
from typing import Any

from ..errors import InputError
from ..training.folder import BLOCKS
from ..training.stages import StagesState
from .cells import MOST_BLOCKS


@dataclass(frozen=True)
class BlocksOptions:
    """How a scene is divided.

    Attributes
    ----------
    columns, rows : number of cells in each direction, 1 to 64. Together they are at least 2.
    polish : iterations of the last run, which trains all blocks together; None for half of those of a block.

    Raises
    ------
    InputError : a number is out of range.
    """

    columns: int
    rows: int
    polish: int | None = None

    def __post_init__(self) -> None:
        for name, value in (("columns", self.columns), ("rows", self.rows)):
            if not isinstance(value, Integral) or not 1 <= value <= MOST_BLOCKS:
                raise InputError(f"{name} of blocks: {value!r}; give a whole number, 1 to {MOST_BLOCKS}")
        if self.count < 2:
            raise InputError("1x1 blocks: give at least two")
        if self.polish is not None and (not isinstance(self.polish, Integral) or self.polish < 0):
            raise InputError(f"polish of blocks: {self.polish!r}; give a whole number of iterations, at least 0")

    @property
    def count(self) -> int:
        """Number of blocks."""
        return self.columns * self.rows


class BlocksState(StagesState):
    """blocks.json in a model's folder, written after every stage."""

    FILE, NAME, OPTIONS = BLOCKS, "training", BlocksOptions
    FINISHED = "the training in blocks is finished: nothing to resume"

    @staticmethod
    def described(options: BlocksOptions) -> dict[str, Any]:
        """Return the options as messages call them."""
        return {"blocks": f"{options.columns}x{options.rows}", "polish": options.polish}

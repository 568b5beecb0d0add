"""Decisions of the search for the smallest model, made from the PSNR of its models on validation views."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from typing import Any

from ..errors import InputError

TOLERANCE = 0.1  # dB
ROUNDS_SHARE, PARTS_SHARE = 0.75, 0.25  # shares of the tolerance that the stages may use
PATIENCE = 2  # bad rounds before the rounds stop
MIN_SPLATS = 50  # the rounds stop at this number

# A model of the rounds: "splats"; "psnr", the mean, and "views", the PSNR of each validation view [dB]; "seconds";
# with a limit of bytes "fitted_psnr", the mean of the model without parts, or None if it still has too many splats.
ModelRow = dict[str, Any]


@dataclass(frozen=True)
class BudgetOptions:
    """Conditions for the smallest model.

    Parameters
    ----------
    tolerance : allowed loss of PSNR to the best model, on validation views [dB].
    target_psnr : replaces the tolerance: find the smallest model with this PSNR on validation views [dB].
    max_bytes : size of the file: find the best model that fits.

    Raises
    ------
    InputError : a value is out of range.
    """

    tolerance: float = TOLERANCE
    target_psnr: float | None = None
    max_bytes: int | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.tolerance < float("inf"):
            raise InputError(f"budget tolerance {self.tolerance}: must be at least 0 dB")
        if self.target_psnr is not None and not 0 < self.target_psnr < float("inf"):
            raise InputError(f"target PSNR {self.target_psnr}: must be above 0 dB")
        if self.max_bytes is not None and self.max_bytes < 1:
            raise InputError(f"max bytes {self.max_bytes}: must be at least 1")


def standard_error(first: list[float], second: list[float]) -> float:
    """Return the standard error of the mean difference of two models on the same views; 0 for a single view."""
    differences = [a - b for a, b in zip(first, second, strict=True)]
    return statistics.stdev(differences) / math.sqrt(len(differences)) if len(differences) > 1 else 0.0


def loss_of(row: ModelRow, rows: list[ModelRow]) -> tuple[float, float]:
    """Return how much less PSNR a model has than the best of the rounds, and the standard error of that loss [dB]."""
    best = max(rows, key=lambda other: float(other["psnr"]))
    return best["psnr"] - row["psnr"], standard_error(best["views"], row["views"])


def rounds_are_over(rows: list[ModelRow], options: BudgetOptions) -> bool:
    """Return whether the last models lost too much, or hardly a splat is left.

    Parameters
    ----------
    rows : the model with all splats, then the model after each round.
    """
    last = rows[1:][-PATIENCE:]
    if rows[-1]["splats"] <= MIN_SPLATS:
        return True
    if options.max_bytes is not None and any(row["fitted_psnr"] is None for row in last):
        return False
    return len(last) == PATIENCE and all(lost_too_much(row, rows, options) for row in last)


def lost_too_much(row: ModelRow, rows: list[ModelRow], options: BudgetOptions) -> bool:
    """Return whether the mean PSNR of a model is below the target, or below the share of the rounds."""
    if options.target_psnr is not None:
        return bool(row["psnr"] < options.target_psnr)
    return loss_of(row, rows)[0] > ROUNDS_SHARE * options.tolerance


def chosen_of(rows: list[ModelRow], options: BudgetOptions) -> int:
    """Return the number of rounds that lead to the chosen model.

    It is the smallest model whose loss, with its standard error, is within the share of the rounds. With few views the
    mean alone may be chance. A target replaces the loss. With a limit of bytes it is the smallest model that is within
    the share of the best that fits. If no model reaches the target or fits, it is the best one or the smallest one.
    """
    allowed = ROUNDS_SHARE * options.tolerance
    if options.max_bytes is not None:
        fitting = [row["fitted_psnr"] for row in rows if row["fitted_psnr"] is not None]
        if not fitting:
            return len(rows) - 1
        floor = max(fitting) - allowed
        if options.target_psnr is not None:
            floor = min(options.target_psnr, max(fitting))
        return max(i for i, row in enumerate(rows) if row["fitted_psnr"] is not None and row["fitted_psnr"] >= floor)
    if options.target_psnr is not None:
        good = [i for i, row in enumerate(rows) if row["psnr"] >= options.target_psnr]
        return good[-1] if good else max(range(len(rows)), key=lambda i: rows[i]["psnr"])
    return max(i for i, row in enumerate(rows) if sum(loss_of(row, rows)) <= allowed)

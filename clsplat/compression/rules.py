"""Decisions of the search for the smallest model, made from the PSNR of its models on validation views."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from typing import Any

from ..errors import InputError

TOLERANCE = 0.1  # dB
ROUNDS_SHARE, PARTS_SHARE = 0.75, 0.25  # shares of the tolerance that the stages may use
CHANCE = 2.0  # the loss and its standard error together may be this many tolerances
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
    tolerance : allowed loss of PSNR to the model with all splats, on validation views [dB].
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


def rounds_are_over(rows: list[ModelRow], options: BudgetOptions) -> bool:
    """Return whether the last models were not good enough, or hardly a splat is left.

    Parameters
    ----------
    rows : the model with all splats, then the model after each round.
    """
    last = rows[1:][-PATIENCE:]
    return rows[-1]["splats"] <= MIN_SPLATS or (
        len(last) == PATIENCE and all(meets(row, rows, options) is False for row in last)
    )


def meets(row: ModelRow, rows: list[ModelRow], options: BudgetOptions) -> bool | None:
    """Return whether a model of the rounds is good enough; None if it does not fit the limit of bytes yet.

    A model is compared with the one with all splats, view by view. Its mean loss must be within the share of the
    rounds. With few views the mean is uncertain, so the loss with its standard error must be below CHANCE tolerances.
    """
    if options.max_bytes is not None and row["fitted_psnr"] is None:
        return None
    if options.target_psnr is not None:
        return bool(row["psnr"] >= options.target_psnr)
    loss = rows[0]["psnr"] - row["psnr"]
    uncertain = loss + standard_error(rows[0]["views"], row["views"])
    return bool(loss <= ROUNDS_SHARE * options.tolerance and uncertain <= CHANCE * options.tolerance)


def chosen_of(rows: list[ModelRow], options: BudgetOptions) -> int:
    """Return the number of rounds that lead to the chosen model.

    It is the smallest model that is good enough. With a limit of bytes it is the smallest one within the share of the
    rounds of the best that fits. If no model is good enough, it is the best one.
    """
    if options.max_bytes is not None:
        fitting = [row["fitted_psnr"] for row in rows if row["fitted_psnr"] is not None]
        if not fitting:
            return len(rows) - 1
        floor = max(fitting) - ROUNDS_SHARE * options.tolerance
        if options.target_psnr is not None:
            floor = min(options.target_psnr, max(fitting))
        return max(i for i, row in enumerate(rows) if row["fitted_psnr"] is not None and row["fitted_psnr"] >= floor)
    good = [i for i, row in enumerate(rows) if meets(row, rows, options)]
    return good[-1] if good else max(range(len(rows)), key=lambda i: rows[i]["psnr"])

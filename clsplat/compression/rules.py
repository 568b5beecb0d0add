"""Decisions of the search for the smallest model, made from the PSNR of its models on validation views."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from typing import Any

from ..errors import InputError

TOLERANCE = 0.1  # dB
KNEE_SHARE, ROUNDS_SHARE, PARTS_SHARE = 0.5, 0.25, 0.25  # shares of the tolerance that the stages may use
FIRST_CAP = 1000
PATIENCE = 2  # bad doublings before growth stops, and bad rounds before the rounds stop
MIN_SPLATS = 50  # the rounds stop at this number

# A model: "splats" and "psnr"; "cap" (growth and whole runs); "views", the PSNR of each view (growth); "fitted_psnr"
# (with a limit of bytes); "lost", the PSNR below the best whole run (first of the rounds).
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


def growth_caps(largest: int) -> list[int]:
    """Return the caps of the growth: doubling, and the largest itself."""
    caps = [FIRST_CAP * 2**step for step in range(64) if FIRST_CAP * 2**step < largest]
    return [*caps, largest]


def growth_is_over(rows: list[ModelRow], options: BudgetOptions) -> bool:
    """Return whether the last doublings gained too little, or the target is reached."""
    if options.target_psnr is not None and rows and rows[-1]["psnr"] >= options.target_psnr:
        return True
    before = [row["psnr"] for row in rows[:-PATIENCE]]
    return bool(before) and max(row["psnr"] for row in rows) - max(before) < options.tolerance


def candidates(rows: list[ModelRow], options: BudgetOptions) -> list[int]:
    """Return the possible knees: one cap, or two rising ones.

    The larger one is the smallest cap that is as good as the best. The smaller one is the smallest cap that differs
    from the best by less than the standard error: only whole runs can decide between the two.
    """
    for row in rows:
        if options.target_psnr is not None and row["psnr"] >= options.target_psnr:
            return [row["cap"]]
    best = max(rows, key=lambda row: float(row["psnr"]))
    gaps = [(row["cap"], best["psnr"] - row["psnr"], standard_error(best["views"], row["views"])) for row in rows]
    share = KNEE_SHARE * options.tolerance
    may_be = next(cap for cap, gap, error in gaps if gap <= max(share, error))
    sure = next(cap for cap, gap, _ in gaps if gap <= share)
    return sorted({may_be, sure})


def knee_of(whole: list[ModelRow], options: BudgetOptions) -> int:
    """Return the smallest cap of whole runs that is as good as the best of them."""
    best = max(float(row["psnr"]) for row in whole)
    return next(int(row["cap"]) for row in whole if row["psnr"] >= best - KNEE_SHARE * options.tolerance)


def standard_error(first: list[float], second: list[float]) -> float:
    """Return the standard error of the mean difference of two models on the same views; 0 for a single view."""
    differences = [a - b for a, b in zip(first, second, strict=True)]
    return statistics.stdev(differences) / math.sqrt(len(differences)) if len(differences) > 1 else 0.0


def rounds_are_over(rows: list[ModelRow], options: BudgetOptions) -> bool:
    """Return whether the last models were not good enough, or hardly a splat is left."""
    last = rows[-PATIENCE:]
    return rows[-1]["splats"] <= MIN_SPLATS or (
        len(last) == PATIENCE and all(meets(row, rows, options) is False for row in last)
    )


def meets(row: ModelRow, rows: list[ModelRow], options: BudgetOptions) -> bool | None:
    """Return whether a model of the rounds is good enough compared with the others; None if it is still too large."""
    floor = options.target_psnr
    if floor is None:
        floor = max(other["psnr"] for other in rows) - rounds_allowed(rows, options)
    if options.max_bytes is not None and row["fitted_psnr"] is None:
        return None
    return bool(row["psnr"] >= floor)


def rounds_allowed(rows: list[ModelRow], options: BudgetOptions) -> float:
    """Return the PSNR that rounds may lose [dB]: their share of the tolerance and the rest of the knee's share."""
    return (KNEE_SHARE + ROUNDS_SHARE) * options.tolerance - float(rows[0].get("lost", KNEE_SHARE * options.tolerance))


def chosen_of(rows: list[ModelRow], options: BudgetOptions) -> int:
    """Return the number of rounds that lead to the chosen model; if no model is good enough, to the best one."""
    if options.max_bytes is not None:
        fitting = [row["fitted_psnr"] for row in rows if row["fitted_psnr"] is not None]
        if not fitting:
            return len(rows) - 1
        floor = max(fitting) - rounds_allowed(rows, options)
        if options.target_psnr is not None:
            floor = min(options.target_psnr, max(fitting))
        return max(i for i, row in enumerate(rows) if row["fitted_psnr"] is not None and row["fitted_psnr"] >= floor)
    good = [i for i, row in enumerate(rows) if meets(row, rows, options)]
    return good[-1] if good else max(range(len(rows)), key=lambda i: rows[i]["psnr"])

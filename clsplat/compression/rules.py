"""What a search for the smallest model decides, from the PSNR of its models on validation views."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from typing import Any

from ..errors import InputError

TOLERANCE = 0.1  # dB
KNEE_SHARE, ROUNDS_SHARE, PARTS_SHARE = 0.5, 0.25, 0.25  # of the tolerance: together they may cost all of it
FIRST_CAP = 1000
PATIENCE = 2  # doublings that may gain too little before growth stops, and rounds that may lose too much
FEWEST = 50  # splats: no round goes below

# A model: "splats", "psnr"; "cap" (growth, whole runs), "views" (growth), "fitted_psnr" (where bytes are limited);
# "lost" (the first of the rounds): how much lower its PSNR is than that of the best whole run.
ModelRow = dict[str, Any]


@dataclass(frozen=True)
class BudgetOptions:
    """What the smallest model must do.

    Parameters
    ----------
    tolerance : PSNR that it may lose to the best model found, on validation views [dB].
    target_psnr : on validation views, instead: the smallest model that has it [dB].
    max_bytes : of the file; the best model that fits.

    Raises
    ------
    InputError : a value that makes no sense.
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


def growth_caps(most: int) -> list[int]:
    """Caps of the growth: doubling, and the largest itself."""
    caps = [FIRST_CAP * 2**step for step in range(64) if FIRST_CAP * 2**step < most]
    return [*caps, most]


def growth_is_over(rows: list[ModelRow], options: BudgetOptions) -> bool:
    """Whether the last doublings gained too little, or the target is reached."""
    if options.target_psnr is not None and rows and rows[-1]["psnr"] >= options.target_psnr:
        return True
    before = [row["psnr"] for row in rows[:-PATIENCE]]
    return bool(before) and max(row["psnr"] for row in rows) - max(before) < options.tolerance


def candidates(rows: list[ModelRow], options: BudgetOptions) -> list[int]:
    """Caps that may be the knee, rising: the smallest that is as good as the best, and the smallest that may be.

    The latter differs from the best by less than the standard error: short runs cannot tell them apart, whole ones may.
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
    """The smallest cap of whole runs that is as good as the best of them."""
    best = max(float(row["psnr"]) for row in whole)
    knee: int = next(row["cap"] for row in whole if row["psnr"] >= best - KNEE_SHARE * options.tolerance)
    return knee


def standard_error(first: list[float], second: list[float]) -> float:
    """Of the mean difference of two models on the same views; 0 of a single view, which tells nothing of it."""
    differences = [a - b for a, b in zip(first, second, strict=True)]
    return statistics.stdev(differences) / math.sqrt(len(differences)) if len(differences) > 1 else 0.0


def rounds_are_over(rows: list[ModelRow], options: BudgetOptions) -> bool:
    """Whether fewer splats would not do: the last models were not good enough, or hardly a splat is left."""
    last = rows[-PATIENCE:]
    return rows[-1]["splats"] <= FEWEST or (
        len(last) == PATIENCE and all(meets(row, rows, options) is False for row in last)
    )


def meets(row: ModelRow, rows: list[ModelRow], options: BudgetOptions) -> bool | None:
    """Whether a model of the rounds is good enough beside the others; None: not yet small enough."""
    floor = options.target_psnr
    if floor is None:
        floor = max(other["psnr"] for other in rows) - rounds_allowed(rows, options)
    if options.max_bytes is not None and row["fitted_psnr"] is None:
        return None
    return bool(row["psnr"] >= floor)


def rounds_allowed(rows: list[ModelRow], options: BudgetOptions) -> float:
    """PSNR that rounds may lose [dB]: their share of the tolerance, and what the knee has left of its own."""
    return (KNEE_SHARE + ROUNDS_SHARE) * options.tolerance - float(rows[0].get("lost", KNEE_SHARE * options.tolerance))


def chosen_of(rows: list[ModelRow], options: BudgetOptions) -> int:
    """Number of rounds after which the model is the one wanted; of none that is, after which it is best."""
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

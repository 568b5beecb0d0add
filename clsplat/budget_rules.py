"""What a search for the smallest model decides, from the PSNR of its models on validation views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .errors import InputError

TOLERANCE = 0.1  # dB
FIRST_CAP = 1000
PATIENCE = 2  # doublings that may gain nothing before growth stops
FEWEST = 50  # splats: no round goes below

Row = dict[str, Any]  # a model: "splats", "psnr", and "cap" (growth) or "fitted_psnr" (where bytes are limited)


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


def growth_is_over(rows: list[Row], options: BudgetOptions) -> bool:
    """Whether the last doublings gained too little, or the target is reached."""
    if options.target_psnr is not None and rows and rows[-1]["psnr"] >= options.target_psnr:
        return True
    before = [row["psnr"] for row in rows[:-PATIENCE]]
    return bool(before) and max(row["psnr"] for row in rows) - max(before) < options.tolerance


def knee_of(rows: list[Row], options: BudgetOptions) -> int:
    """The cap beyond which growth does not pay."""
    best = max(row["psnr"] for row in rows)
    enough = best - 0.5 * options.tolerance
    if options.target_psnr is not None:
        enough = min(enough, options.target_psnr)
    cap: int = next(row["cap"] for row in rows if row["psnr"] >= enough)
    return cap


def meets(row: Row, first: Row, options: BudgetOptions) -> bool | None:
    """Whether a model of the rounds is good enough; None: not yet small enough."""
    floor = first["psnr"] - 0.5 * options.tolerance if options.target_psnr is None else options.target_psnr
    if options.max_bytes is not None and row["fitted_psnr"] is None:
        return None
    return bool(row["psnr"] >= floor)


def chosen_of(rows: list[Row], options: BudgetOptions) -> int:
    """Number of rounds after which the model is the one wanted; of none that is, after which it is best."""
    if options.max_bytes is not None:
        fitting = [row["fitted_psnr"] for row in rows if row["fitted_psnr"] is not None]
        if not fitting:
            return len(rows) - 1
        floor = max(fitting) - 0.5 * options.tolerance
        if options.target_psnr is not None:
            floor = min(options.target_psnr, max(fitting))
        return max(i for i, row in enumerate(rows) if row["fitted_psnr"] is not None and row["fitted_psnr"] >= floor)
    good = [i for i, row in enumerate(rows) if meets(row, rows[0], options)]
    return good[-1] if good else max(range(len(rows)), key=lambda i: rows[i]["psnr"])

"""The chart of a search for the smallest model."""

from __future__ import annotations

from pathlib import Path

from ..compression.search import Budgeted
from ..errors import OutputError
from .charts import growth_chart


def draw_growth(result: Budgeted, folder: Path) -> list[Path]:
    """Draw PSNR against the number of splats into growth.png and growth.svg.

    Returns
    -------
    The files; none if matplotlib is not installed.
    """
    report = result.report
    rows = [{"splats": row["splats"], "psnr": row["psnr"]} for row in report["growth"]]
    knee = next(row["splats"] for row in report["growth"] if row["cap"] == report["knee"])
    held_out = report["held_out"]
    star = {"splats": held_out["splats"], "psnr": held_out["psnr_pruned"], "label": "chosen, pruned"}
    try:
        return growth_chart([*rows, star], knee, folder / "growth", report["rounds"])
    except OutputError:
        return []

"""The chart of a search for the smallest model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..compression.rules import loss_of
from ..errors import OutputError
from ..evaluation.chart_style import INK, MARK, chart_paths, drawing, log_axis, short_count


def draw_search(report: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draw PSNR against the number of splats into rounds.png and rounds.svg.

    Parameters
    ----------
    report : content of budget.json.

    Returns
    -------
    The files; none if matplotlib is not installed.
    """
    try:
        return rounds_chart(report, folder / "rounds")
    except OutputError:
        return []


def rounds_chart(report: Mapping[str, Any], out: Path) -> list[Path]:
    """Draw the validation PSNR of the models of a search against their splats.

    Bars are the standard error of the mean loss against the best of the models, over the validation views. A circle
    marks the chosen model, and a star what is left of it without parts.

    Parameters
    ----------
    report : content of budget.json. out : path without a suffix.

    Raises
    ------
    OutputError : no matplotlib, or not writable.
    """
    rows, held_out = report["rounds"], report["held_out"]
    chosen = rows[report["chosen"]]
    errors = [loss_of(row, rows)[1] for row in rows]
    counts, values = [row["splats"] for row in rows], [row["psnr"] for row in rows]
    with drawing(out, 6.4, 4.0) as figure:
        axes = figure.add_subplot(xlabel="splats", ylabel="validation PSNR [dB]", xscale="log")
        axes.errorbar(
            counts, values, yerr=errors, marker="o", color=INK, capsize=2, linewidth=1.5, label="rounds of pruning"
        )
        axes.axhline(max(values), color=INK, linewidth=0.8, linestyle=(0, (4, 2)), zorder=0.5)
        for kind, row, looks in (
            ("chosen", chosen, {"marker": "o", "markersize": 11, "markerfacecolor": "none", "markeredgewidth": 2}),
            (
                "without parts",
                {"splats": held_out["splats"], "psnr": held_out["psnr_pruned"]},
                {"marker": "*", "markersize": 13, "markeredgecolor": "white", "zorder": 4},
            ),
        ):
            label = f"{kind}: {short_count(row['splats'])} splats, {row['psnr']:.2f} dB"
            axes.plot([row["splats"]], [row["psnr"]], color=MARK, linestyle="none", label=label, **looks)
        low, high = min(*counts, chosen["splats"]) / 1.2, max(counts) * 1.2
        axes.set_xlim(low, high)
        log_axis(axes.xaxis, low, high)
        axes.legend(loc="best")
    return chart_paths(out)

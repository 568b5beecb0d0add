"""A table of verdicts as a picture: hazards against shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clsplat.errors import InputError
from clsplat.evaluation.chart_style import INK, WIDTH, chart_paths, drawing, tile

# Colour of a cell and of its text.
VERDICTS = {
    "survives": ("#bfe3d8", INK),
    "stops": ("#c3d9ef", INK),
    "loses": ("#f6d98f", INK),
    "fails": ("#c2410c", "white"),
    "not run": ("#f2f2f2", "#666666"),
}


def heat_map(table: Sequence[Mapping[str, Any]], out: str | Path) -> list[Path]:
    """Draw a table of verdicts: a colour and a few letters for each cell.

    Parameters
    ----------
    table : cells with "row" (a hazard), "column" (a shape), "verdict" (one of VERDICTS) and "text" (such as "", "-1.2"
        or "NaN"). Rows and columns keep the order of their first cells; a missing cell is "not run".
    out : path without a suffix.

    Returns
    -------
    The files written. A line below the table counts the rows that each column survives.

    Raises
    ------
    InputError : no cells, or an unknown verdict. OutputError : no matplotlib, or not writable.
    """
    for cell in table:
        if cell["verdict"] not in VERDICTS:
            raise InputError(f"{out}: unknown verdict {cell['verdict']!r}: one of {', '.join(VERDICTS)}")
    if not table:
        raise InputError(f"{out}: a heat map needs cells")
    rows, columns = (list(dict.fromkeys(cell[key] for cell in table)) for key in ("row", "column"))
    verdict_of = {(cell["row"], cell["column"]): (cell["verdict"], cell["text"]) for cell in table}
    # A row of cells is a quarter of an inch high.
    with drawing(out, WIDTH, 0.25 * len(rows) + 2.0) as figure:
        axes = figure.add_subplot()
        for y, row in enumerate(rows):
            for x, column in enumerate(columns):
                verdict, text = verdict_of.get((row, column), ("not run", ""))
                fill, ink = VERDICTS[verdict]
                axes.add_patch(tile((x, y), fill))
                axes.text(x + 0.5, y + 0.5, text, color=ink, ha="center", va="center", fontsize=7.5)
        for x, column in enumerate(columns):
            verdicts = [
                verdict for (_, other), (verdict, _) in verdict_of.items() if other == column and verdict != "not run"
            ]
            axes.text(
                x + 0.5,
                len(rows) + 0.6,
                f"{verdicts.count('survives')}/{len(verdicts)}",
                ha="center",
                va="center",
                fontsize=8,
                fontweight="bold",
            )
        axes.set(xlim=(0, len(columns)), ylim=(len(rows) + 1.1, 0))
        axes.set_xticks([x + 0.5 for x in range(len(columns))], columns, rotation=35, ha="left", rotation_mode="anchor")
        axes.set_yticks([y + 0.5 for y in range(len(rows))] + [len(rows) + 0.6], [*rows, "survived"])
        axes.get_yticklabels()[-1].set_fontweight("bold")
        axes.xaxis.tick_top()
        axes.tick_params(length=0)
        axes.grid(False)
        axes.spines[:].set_visible(False)
        used = [name for name in VERDICTS if any(verdict == name for verdict, _ in verdict_of.values())]
        figure.legend(
            handles=[tile((0, 0), VERDICTS[name][0], name) for name in used],
            loc="outside lower center",
            ncols=len(used),
            handlelength=1.4,
        )
    return chart_paths(out)

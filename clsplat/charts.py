"""Charts of single questions: growth and its knee, hazards and shapes. Plain data in, PNG and SVG out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .chart_style import INK, MARK, WIDTH, chart_paths, drawing, log_axis, short_count, tile
from .errors import InputError

# Colour of a cell, and of the text on it.
VERDICTS = {"survives": ("#bfe3d8", INK), "stops": ("#c3d9ef", INK), "loses": ("#f6d98f", INK),
            "fails": ("#c2410c", "white"), "not run": ("#f2f2f2", "#666666")}


def growth_chart(records: Sequence[Mapping[str, Any]], knee: int | None, out: str | Path) -> list[Path]:
    """Validation PSNR against splats, with the knee marked.

    Parameters
    ----------
    records : each with "splats" and "psnr" [dB]. Those with a "label" as well (such as "pruned") are not of the curve:
        each is a star, named.
    knee : splats of the record that was chosen; None: none is marked.
    out : path without a suffix.

    Returns
    -------
    The files written.

    Raises
    ------
    InputError : no records, or `knee` is not one of the curve's. OutputError : no matplotlib, or not writable.
    """
    curve = sorted((record["splats"], record["psnr"]) for record in records if not record.get("label"))
    chosen = [psnr for splats, psnr in curve if splats == knee]
    if not curve or (knee is not None and not chosen):
        raise InputError(f"{out}: a growth chart needs a curve, and a knee that is on it")
    with drawing(out, 6.4, 4.0) as figure:
        axes = figure.add_subplot(xlabel="splats", ylabel="validation PSNR [dB]", xscale="log")
        axes.plot(*zip(*curve, strict=True), marker="o", color=INK, clip_on=False, label="growth")
        if knee is not None:
            axes.axvline(knee, color=MARK, linewidth=1, linestyle=(0, (4, 2)), zorder=0.5)
            axes.plot([knee], chosen[:1], marker="o", markersize=11, markerfacecolor="none", markeredgewidth=2,
                      color=MARK, linestyle="none", label=f"knee: {short_count(knee)} splats, {chosen[0]:.2f} dB")
        stars = [record for record in records if record.get("label")]
        for star in stars:
            axes.plot([star["splats"]], [star["psnr"]], marker="*", markersize=13, linestyle="none", color="#0072b2",
                      markeredgecolor="white", zorder=4,
                      label=f"{star['label']}: {short_count(star['splats'])} splats, {star['psnr']:.2f} dB")
        sizes = [splats for splats, _ in curve] + [star["splats"] for star in stars]
        low, high = min(sizes) / 1.2, max(sizes) * 1.2
        axes.set_xlim(low, high)
        log_axis(axes.xaxis, low, high)
        axes.legend(loc="lower right")
    return chart_paths(out)


def heat_map(table: Sequence[Mapping[str, Any]], out: str | Path) -> list[Path]:
    """A table of verdicts: a colour each, and a few letters in the cell.

    Parameters
    ----------
    table : cells, each with "row" (such as a hazard), "column" (such as a shape), "verdict" (one of VERDICTS) and
        "text" (short: "", "-1.2", "NaN"). Rows and columns stand in the order of their first cells; a place without
        a cell is "not run".
    out : path without a suffix.

    Returns
    -------
    The files written. Below the table stands how many rows each column survives, of those that were run.

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
    by = {(cell["row"], cell["column"]): (cell["verdict"], cell["text"]) for cell in table}
    # Constrained layout makes room for the names; a row of cells is a quarter of an inch.
    with drawing(out, WIDTH, 0.25 * len(rows) + 2.0) as figure:
        axes = figure.add_subplot()
        for y, row in enumerate(rows):
            for x, column in enumerate(columns):
                verdict, text = by.get((row, column), ("not run", ""))
                fill, ink = VERDICTS[verdict]
                axes.add_patch(tile((x, y), fill))
                axes.text(x + 0.5, y + 0.5, text, color=ink, ha="center", va="center", fontsize=7.5)
        for x, column in enumerate(columns):
            own = [verdict for (_, other), (verdict, _) in by.items() if other == column and verdict != "not run"]
            axes.text(x + 0.5, len(rows) + 0.6, f"{own.count('survives')}/{len(own)}", ha="center", va="center",
                      fontsize=8, fontweight="bold")
        axes.set(xlim=(0, len(columns)), ylim=(len(rows) + 1.1, 0))
        axes.set_xticks([x + 0.5 for x in range(len(columns))], columns, rotation=35, ha="left", rotation_mode="anchor")
        axes.set_yticks([y + 0.5 for y in range(len(rows))] + [len(rows) + 0.6], [*rows, "survived"])
        axes.get_yticklabels()[-1].set_fontweight("bold")
        axes.xaxis.tick_top()
        axes.tick_params(length=0)
        axes.grid(False)
        axes.spines[:].set_visible(False)
        used = [name for name in VERDICTS if any(verdict == name for verdict, _ in by.values())]
        figure.legend(handles=[tile((0, 0), VERDICTS[name][0], name) for name in used], loc="outside lower center",
                      ncols=len(used), handlelength=1.4)
    return chart_paths(out)

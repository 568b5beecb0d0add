"""Tables and heat maps of the results of benchmarks/stability.py."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from clsplat.comparison.table import markdown_table

from .crafted import STATIC
from .heat_map import heat_map
from .training import TRAINING
from .variants import VARIANTS

Row = dict[str, Any]
ORDER = ("survives", "stops", "loses", "fails")  # the worst of a cell's runs counts


def print_tables(rows: Sequence[Row]) -> None:
    """Print a Markdown table for each kind."""
    for title, part in (("static", "static"), ("training", "training")):
        chosen = [row for row in rows if row["kind"] == part]
        if chosen:
            print(f"\n### {title}\n")
            grid(cells(chosen))
    counts(rows)
    for row in (row for row in rows if row["kind"] == "capacity"):
        print(
            f"\n{row['hazard']}, {row['system']}: {row['verdict']}; {row['isects'] / 1e6:.2f} M isects, "
            f"{row['record_bytes'] / 2**31:.3f} x 2^31 bytes of records, gradient off by {row['gradient_error']:.1e}"
        )
    recovery([row for row in rows if row["kind"] == "recovery"])
    arithmetic([row for row in rows if row["kind"] == "arithmetic"])


def cells(rows: Iterable[Row]) -> list[dict[str, str]]:
    """Return a cell for each hazard and variant: the worst verdict of all devices, builds and optimizers."""
    by: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        by.setdefault((row["hazard"], row["system"]), []).append(row)
    systems = list(dict.fromkeys(system for _, system in by))
    known = [name for system in VARIANTS for name in (system.shape, system.label)]
    systems.sort(key=lambda name: known.index(name) if name in known else len(known))  # maps may have been removed
    order = [*STATIC, *TRAINING]
    hazards = sorted(
        dict.fromkeys(hazard for hazard, _ in by), key=lambda name: order.index(name) if name in order else len(order)
    )
    table = []
    for hazard in hazards:
        for system in systems:
            results = by.get((hazard, system))
            if results is None:
                table.append({"row": hazard, "column": system, "verdict": "not run", "text": ""})
                continue
            worst = max(
                results,
                key=lambda row: (ORDER.index(row["verdict"]), row.get("lost_db") or row.get("gradient_error") or 0),
            )
            table.append({"row": hazard, "column": system, "verdict": worst["verdict"], "text": text(worst)})
    return table


def text(row: Row) -> str:
    """Return a few letters that describe the result."""
    if row["verdict"] == "stops":
        return "stops"
    if not row["finite"]:
        return "NaN"
    if row.get("lost_db") is not None:
        return f"{-row['lost_db']:+.1f}"
    return f"{row['gradient_error']:.0e}" if row.get("gradient_error") is not None else ""


def grid(table: Sequence[dict[str, str]]) -> None:
    """Print the cells as a table: hazards against variants, losses and failures in bold."""
    columns = list(dict.fromkeys(cell["column"] for cell in table))
    texts: dict[str, dict[str, str]] = {}
    for cell in table:
        bold = "**" if cell["verdict"] in ("loses", "fails") else ""
        texts.setdefault(cell["row"], {})[cell["column"]] = f"{bold}{cell['text']}{bold}"
    rows = [[hazard, *(line[column] for column in columns)] for hazard, line in texts.items()]
    print(markdown_table(["hazard", *columns], rows))


def counts(rows: Sequence[Row]) -> None:
    """Print the number of values that are not finite, and how the runs of each shape ended."""
    runs = [row for row in rows if row["kind"] in ("static", "training", "recovery")]
    if not runs:
        return
    print(f"\n{len(runs)} runs, {sum(not row['finite'] for row in runs)} of them with a number that is not finite.\n")
    verdicts: dict[str, list[str]] = {}
    for row in runs:
        if row["kind"] != "recovery":
            verdicts.setdefault(row["system"].partition(":")[0], []).append(row["verdict"])
    lines = [[shape, *(str(ends.count(verdict)) for verdict in ORDER)] for shape, ends in verdicts.items()]
    print(markdown_table(["shape", *ORDER], lines))


def recovery(rows: Sequence[Row]) -> None:
    """Print the PSNR of recovered splats, a column for each parameterisation."""
    if not rows:
        return
    forms = list(dict.fromkeys(row["system"] for row in rows))
    psnr: dict[str, dict[str, str]] = {}
    for row in rows:
        text = "stops" if row["psnr"] is None else f"{row['psnr']:.2f}"
        psnr.setdefault(row["hazard"], {})[row["system"]] = text
    lines = [[hazard, *(line.get(form, "") for form in forms)] for hazard, line in psnr.items()]
    means = [
        statistics.fmean(row["psnr"] for row in rows if row["system"] == form and row["psnr"] is not None)
        for form in forms
    ]
    print()
    print(
        markdown_table(
            ["PSNR of recovered splats [dB]", *forms], [*lines, ["mean", *(f"{mean:.2f}" for mean in means)]]
        )
    )


def arithmetic(rows: Sequence[Row]) -> None:
    """Print the errors of both formulas of the projected slant."""
    if not rows:
        return
    head = ["1 - k in float32", "textbook: not positive", "textbook: error (99 %)"]
    head += ["squares: not positive", "squares: error (99 %)"]
    lines = []
    for row in rows:
        line = [row["hazard"]]
        for name in ("textbook", "squares"):
            line += [f"{row[f'{name}_not_positive']:.1%}", error(row[f"{name}_error"])]
        lines.append(line)
    print()
    print(markdown_table(head, lines))


def error(value: float) -> str:
    """Return an error as text; "NaN" if it is beyond all quantiles."""
    return f"{value:.0e}" if value < 1e8 else "NaN"


def write_charts(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Draw a heat map of the crafted splats, and one of the training runs."""
    paths: list[Path] = []
    for kind in ("static", "training"):
        chosen = [row for row in rows if row["kind"] == kind]
        if chosen:
            paths += heat_map(cells(chosen), folder / f"stability-{kind}")
    return paths

"""Tables and heat maps of what benchmarks/stability.py has found."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from .crafted import STATIC
from .heat_map import heat_map
from .training import TRAINING
from .variants import VARIANTS

Row = dict[str, Any]
ORDER = ("survives", "stops", "loses", "fails")  # the worst of a cell's runs counts


def print_tables(rows: Sequence[Row]) -> None:
    """Markdown, one table a kind."""
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
    """One a hazard and system: the worst verdict of its devices, builds and optimizers, with what was lost."""
    by: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        by.setdefault((row["hazard"], row["system"]), []).append(row)
    systems = list(dict.fromkeys(system for _, system in by))
    known = [name for system in VARIANTS for name in (system.shape, system.label)]
    systems.sort(key=known.index)
    order = [*STATIC, *TRAINING]
    hazards = sorted(
        dict.fromkeys(hazard for hazard, _ in by), key=lambda name: order.index(name) if name in order else len(order)
    )
    table = []
    for hazard in hazards:
        for system in systems:
            own = by.get((hazard, system))
            if own is None:
                table.append({"row": hazard, "column": system, "verdict": "not run", "text": ""})
                continue
            worst = max(
                own, key=lambda row: (ORDER.index(row["verdict"]), row.get("lost_db") or row.get("gradient_error") or 0)
            )
            table.append({"row": hazard, "column": system, "verdict": worst["verdict"], "text": text(worst)})
    return table


def text(row: Row) -> str:
    """A few letters on what happened."""
    if row["verdict"] == "stops":
        return "stops"
    if not row["finite"]:
        return "NaN"
    if row.get("lost_db") is not None:
        return f"{-row['lost_db']:+.1f}"
    return f"{row['gradient_error']:.0e}" if row.get("gradient_error") is not None else ""


def grid(table: Sequence[dict[str, str]]) -> None:
    columns = list(dict.fromkeys(cell["column"] for cell in table))
    print("| hazard | " + " | ".join(columns) + " |\n" + "|---" * (len(columns) + 1) + "|")
    for hazard in dict.fromkeys(cell["row"] for cell in table):
        own = {cell["column"]: cell for cell in table if cell["row"] == hazard}
        texts = [
            f"**{own[column]['text']}**" if own[column]["verdict"] in ("loses", "fails") else own[column]["text"]
            for column in columns
        ]
        print(f"| {hazard} | " + " | ".join(texts) + " |")


def counts(rows: Sequence[Row]) -> None:
    """Numbers that are not finite, and how the runs of each shape ended."""
    runs = [row for row in rows if row["kind"] in ("static", "training", "recovery")]
    if not runs:
        return
    print(f"\n{len(runs)} runs, {sum(not row['finite'] for row in runs)} of them with a number that is not finite.\n")
    print("| shape | " + " | ".join(ORDER) + " |\n|---|" + "---|" * len(ORDER))
    judged = [row for row in runs if row["kind"] != "recovery"]
    for shape in dict.fromkeys(row["system"].partition(":")[0] for row in judged):
        own = [row["verdict"] for row in judged if row["system"].partition(":")[0] == shape]
        print(f"| {shape} | " + " | ".join(str(own.count(verdict)) for verdict in ORDER) + " |")


def recovery(rows: Sequence[Row]) -> None:
    if not rows:
        return
    forms = list(dict.fromkeys(row["system"] for row in rows))
    print("\n| PSNR of recovered splats [dB] | " + " | ".join(forms) + " |\n|---|" + "---|" * len(forms))
    for hazard in dict.fromkeys(row["hazard"] for row in rows):
        own = {row["system"]: row for row in rows if row["hazard"] == hazard}
        print(
            f"| {hazard} | "
            + " | ".join(
                "" if form not in own else f"{own[form]['psnr']:.2f}" if own[form]["psnr"] is not None else "stops"
                for form in forms
            )
            + " |"
        )
    means = [
        statistics.fmean(row["psnr"] for row in rows if row["system"] == form and row["psnr"] is not None)
        for form in forms
    ]
    print("| mean | " + " | ".join(f"{mean:.2f}" for mean in means) + " |")


def arithmetic(rows: Sequence[Row]) -> None:
    if not rows:
        return
    print(
        "\n| 1 - k in float32 | textbook: not positive | textbook: error (99 %) | squares: not positive | "
        "squares: error (99 %) |\n|---|---|---|---|---|"
    )
    for row in rows:
        print(
            f"| {row['hazard']} | {row['textbook_not_positive']:.1%} | {error(row['textbook_error'])} | "
            f"{row['squares_not_positive']:.1%} | {error(row['squares_error'])} |"
        )


def error(value: float) -> str:
    return f"{value:.0e}" if value < 1e8 else "NaN"


def write_charts(rows: Sequence[Row], folder: Path) -> list[Path]:
    """A heat map of the crafted splats, and one of the runs."""
    paths: list[Path] = []
    for kind in ("static", "training"):
        chosen = [row for row in rows if row["kind"] == kind]
        if chosen:
            paths += heat_map(cells(chosen), folder / f"stability-{kind}")
    return paths

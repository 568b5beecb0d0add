"""The rows of a sweep as tables of text: titles and lines of cells, for pages and terminals."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from .sweep_rows import ChartRow

TextTable = tuple[tuple[str, ...], list[tuple[str, ...]]]
NONE: TextTable = (), []


def equal_table(rows: Sequence[ChartRow], reference: str) -> TextTable:
    """Return the splats needed at equal PSNR, as a share of the reference's; a column for each of its caps.

    rows : of `sweep_rows.equal_rows`.
    """
    caps = sorted({row["reference_cap"] for row in rows})
    lines: list[tuple[str, ...]] = []
    for scene, system in dict.fromkeys((row["scene"], row["system"]) for row in rows):
        runs = {row["reference_cap"]: row for row in rows if (row["scene"], row["system"]) == (scene, system)}
        lines.append((scene, system, *(_share(runs[cap]) if cap in runs else "" for cap in caps)))
    return ("scene", "system", *(f"{reference}, cap {cap}" for cap in caps)), lines


def equal_time_table(rows: Sequence[ChartRow], reference: str) -> TextTable:
    """Return the lead over the reference [dB] in as many seconds; a column for each length of its runs.

    rows : of `length_rows.equal_time_rows`.
    """
    lengths = sorted({row["reference_iterations"] for row in rows})
    lines: list[tuple[str, ...]] = []
    for scene, system in dict.fromkeys((row["scene"], row["system"]) for row in rows):
        leads = {
            row["reference_iterations"]: row["lead"]
            for row in rows
            if (row["scene"], row["system"]) == (scene, system) and row["lead"] is not None
        }
        lines.append((scene, system, *(f"{leads[length]:+.2f}" if length in leads else "" for length in lengths)))
    return ("scene", "system", *(f"{reference}, {length} iterations" for length in lengths)) if rows else (), lines


def seed_table(rows: Sequence[ChartRow]) -> TextTable:
    """Return the PSNR over seeds, and over repeats of one seed. rows : of `sweep_rows.seed_rows`."""
    head = (
        "scene",
        "cap",
        "system",
        "seeds",
        "median PSNR",
        "least",
        "most",
        "spread",
        "runs of one seed",
        "their spread",
        "same bits",
    )
    lines: list[tuple[str, ...]] = []
    for scene, system in dict.fromkeys((row["scene"], row["system"]) for row in rows):
        runs = [row for row in rows if (row["scene"], row["system"]) == (scene, system)]
        psnr = [row["psnr"] for row in runs if not row["repeat"]]
        same = repeated(runs)
        values = [row["psnr"] for row in same]
        again = (
            ("", "", "")
            if not same
            else (
                str(len(same)),
                f"{max(values) - min(values):.4f}",
                "yes" if len({row["digest"] for row in same}) == 1 else "no",
            )
        )
        lines.append(
            (
                scene,
                str(runs[0]["cap"]),
                system,
                str(len(psnr)),
                f"{statistics.median(psnr):.2f}",
                f"{min(psnr):.2f}",
                f"{max(psnr):.2f}",
                f"{max(psnr) - min(psnr):.2f}",
                *again,
            )
        )
    return head, lines


def arithmetic_table(rows: Sequence[ChartRow]) -> TextTable:
    """Return the variants of the arithmetic. rows : of `sweep_rows.arithmetic_rows`."""
    head = (
        "shape",
        "variant",
        "scenes",
        "image error",
        "gradient error",
        "render time of default",
        "gradient time of default",
        "PSNR change [dB]",
    )
    lines: list[tuple[str, ...]] = []
    for row in rows:
        errors = ("" if row[name] is None else f"{row[name]:.1e}" for name in ("image_error", "gradient_error"))
        times = ("" if row[name] is None else f"{row[name]:.2f}" for name in ("raster", "raster_vjp"))
        lines.append((row["shape"], row["variant"], str(row["scenes"]), *errors, *times, f"{row['psnr_change']:+.3f}"))
    return head, lines


def repeated(rows: Sequence[ChartRow]) -> list[ChartRow]:
    """Return the rows of the seed that was trained more than once."""
    seeds = {row["seed"] for row in rows if row["repeat"]}
    return [row for row in rows if row["seed"] in seeds]


def _share(row: ChartRow) -> str:
    """Return a share of splats as text."""
    if row["ratio"] is None:
        return "not reached"
    return f"{'≤ ' if row['bound'] else ''}{100 * row['ratio']:.0f} %"

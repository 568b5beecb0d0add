"""Charts of seeds and of arithmetic, from plain rows to PNG and SVG."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..evaluation.chart_style import (
    INK,
    WIDTH,
    Label,
    category_colour,
    chart_paths,
    drawing,
    place_labels,
    shape_colour,
    short_count,
    system_legend,
)

_ARITHMETIC = (
    ("image_error", "raster", "image", "rendering"),
    ("gradient_error", "raster_vjp", "gradient", "its gradient"),
)


def seeds_chart(rows: Sequence[Mapping[str, Any]], out: str | Path) -> list[Path]:
    """Draw the test PSNR of each seed, and of repeats of one seed; a panel for each scene.

    A dot is a seed, and the bar is the median of the seeds. Diamonds are repeats of one seed; "=" means that they gave
    the same splats, bit by bit. The text below each name is the spread (maximum less minimum) of seeds and of repeats.

    Parameters
    ----------
    rows : of `sweep_rows.seed_rows`. out : path without a suffix.

    Raises
    ------
    InputError : no rows. OutputError : no matplotlib, or not writable.
    """
    if not rows:
        raise InputError(f"{out}: a chart of seeds needs several seeds")
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    with drawing(out, WIDTH, 3.6 * len(scenes) + 0.2) as figure:
        for panel, scene in zip(figure.subplots(len(scenes), squeeze=False)[:, 0], scenes, strict=True):
            shown = [row for row in rows if row["scene"] == scene]
            names = []
            for place, system in enumerate(dict.fromkeys(row["system"] for row in shown)):
                names.append(_strip(panel, place, system, [row for row in shown if row["system"] == system]))
            panel.set_xticks(range(len(names)), names, fontsize=7.5)
            panel.set(ylabel="test PSNR [dB]", xlim=(-0.6, len(names) - 0.4))
            panel.set_title(f"{scene},\ncap {short_count(shown[0]['cap'])}, {shown[0]['iterations']} iterations")
            panel.grid(False, axis="x")
    return chart_paths(out)


def _strip(panel: Any, place: int, system: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """Draw the runs of one method; return its name and spreads for the axis."""
    colour = shape_colour(rows[0]["shape"])
    seeds = sorted((row["seed"], row["psnr"]) for row in rows if not row["repeat"])
    values = [psnr for _, psnr in seeds]
    # The dots are side by side, so that equal values are visible.
    across = [place - 0.18 + 0.05 * (number - (len(seeds) - 1) / 2) for number in range(len(seeds))]
    panel.plot(across, values, marker="o", linestyle="none", color=colour, markersize=5.5, alpha=0.85)
    middle = statistics.median(values)
    panel.plot([place - 0.36, place], [middle, middle], color=colour, linewidth=2)
    name = "-\n".join(system.rsplit("-", 1)) if len(system) > 14 else system
    label = f"{name}\nseeds {max(values) - min(values):.2f} dB"
    again = [row for row in rows if any(row["seed"] == other["seed"] and other["repeat"] for other in rows)]
    if again:
        repeated = [row["psnr"] for row in again]
        panel.plot(
            [place + 0.15 + 0.07 * number for number in range(len(again))],
            repeated,
            marker="D",
            markersize=4.5,
            linestyle="none",
            color=colour,
            markerfacecolor="white",
        )
        same = "=" if len({row["digest"] for row in again}) == 1 else "≠"
        panel.annotate(same, (place + 0.15 + 0.07 * len(again), repeated[-1]), va="center", fontsize=9)
        label += f"\nrepeats {max(repeated) - min(repeated):.2f} dB"
    return label


def arithmetic_chart(rows: Sequence[Mapping[str, Any]], out: str | Path) -> list[Path]:
    """Draw the errors of image and gradient against relative time for variants of the arithmetic; a row a shape.

    Parameters
    ----------
    rows : of `sweep_rows.arithmetic_rows`; rows without an error are left out.
    out : path without a suffix.

    Raises
    ------
    InputError : no rows. OutputError : no matplotlib, or not writable.
    """
    rows = [row for row in rows if row["image_error"] is not None]
    if not rows:
        raise InputError(f"{out}: a chart of arithmetic needs variants")
    shapes = list(dict.fromkeys(row["shape"] for row in rows))
    colours = {kind: category_colour(place) for place, kind in enumerate(dict.fromkeys(row["kind"] for row in rows))}
    with drawing(out, WIDTH, 3.8 * len(shapes) + 0.8) as figure:
        labels: list[tuple[Any, list[Label]]] = []
        for line, shape in zip(figure.subplots(len(shapes), 2, squeeze=False), shapes, strict=True):
            for axes, (error, time, what, task) in zip(line, _ARITHMETIC, strict=True):
                # An error of 0 has no place on a logarithmic axis. The farthest points get their labels first.
                shown = sorted(
                    (row for row in rows if row["shape"] == shape and row[error] > 0),
                    key=lambda row: (row["variant"] != "default", -abs(row[time] - 1)),
                )
                points = [(row[time], row[error], row["variant"], colours[row["kind"]]) for row in shown]
                for x, y, _, colour in points:
                    axes.plot(x, y, marker="o", color=colour, markersize=6)
                axes.axvline(1, color=INK, linewidth=0.8, zorder=0.5)
                axes.set(yscale="log", title=shape, xlabel=f"time of {task}, relative to the default")
                axes.set_ylabel(f"error of the {what}")
                axes.margins(0.16)
                labels.append((axes, points))
        system_legend(
            figure, {kind: {"color": colour, "marker": "o", "linestyle": "none"} for kind, colour in colours.items()}
        )
        place_labels(figure, labels)
    return chart_paths(out)

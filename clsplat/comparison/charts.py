"""Charts of single questions: growth and its knee, hazards, seeds, arithmetic. Plain data in, PNG and SVG out."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..evaluation.chart_style import (
    INK,
    MARK,
    WIDTH,
    Label,
    category_colour,
    chart_paths,
    drawing,
    log_axis,
    place_labels,
    shape_colour,
    short_count,
    system_legend,
)

_ARITHMETIC = (
    ("image_error", "raster", "image", "rendering"),
    ("gradient_error", "raster_vjp", "gradient", "its gradient"),
)


def growth_chart(
    records: Sequence[Mapping[str, Any]], knee: int | None, out: str | Path, rounds: Sequence[Mapping[str, Any]] = ()
) -> list[Path]:
    """Validation PSNR against splats, with the knee marked.

    Parameters
    ----------
    records : each with "splats" and "psnr" [dB]. Those with a "label" as well (such as "pruned") are not of the curve:
        each is a star, named.
    knee : splats of the record that was chosen; None: none is marked.
    out : path without a suffix.
    rounds : likewise "splats" and "psnr", of a longer run whose splats became fewer again: a curve of their own.

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
            axes.plot(
                [knee],
                chosen[:1],
                marker="o",
                markersize=11,
                markerfacecolor="none",
                markeredgewidth=2,
                color=MARK,
                linestyle="none",
                label=f"knee: {short_count(knee)} splats, {chosen[0]:.2f} dB",
            )
        if rounds:
            axes.plot(
                [row["splats"] for row in rounds],
                [row["psnr"] for row in rounds],
                marker="s",
                markersize=5,
                color="#0072b2",
                linestyle="--",
                clip_on=False,
                label="whole run, then fewer splats",
            )
        stars = [record for record in records if record.get("label")]
        for star in stars:
            axes.plot(
                [star["splats"]],
                [star["psnr"]],
                marker="*",
                markersize=13,
                linestyle="none",
                color="#0072b2",
                markeredgecolor="white",
                zorder=4,
                label=f"{star['label']}: {short_count(star['splats'])} splats, {star['psnr']:.2f} dB",
            )
        sizes = [splats for splats, _ in curve] + [row["splats"] for row in (*stars, *rounds)]
        low, high = min(sizes) / 1.2, max(sizes) * 1.2
        axes.set_xlim(low, high)
        log_axis(axes.xaxis, low, high)
        axes.legend(loc="best")
    return chart_paths(out)


def seeds_chart(rows: Sequence[Mapping[str, Any]], out: str | Path) -> list[Path]:
    """Test PSNR of each seed, and beside it of one seed repeated; a panel a scene.

    A dot is a seed, the bar their median; diamonds are repeats of one seed, and "=" says that their splats are the same
    bit by bit. Below each name stands the spread, maximum less minimum, of seeds and of repeats.

    rows : of `frontier_data.seed_rows`. out : path without a suffix.

    Raises
    ------
    InputError : no rows. OutputError : no matplotlib, or not writable.
    """
    if not rows:
        raise InputError(f"{out}: a chart of seeds needs several seeds")
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    with drawing(out, WIDTH, 3.6 * len(scenes) + 0.2) as figure:
        for panel, scene in zip(figure.subplots(len(scenes), squeeze=False)[:, 0], scenes, strict=True):
            own = [row for row in rows if row["scene"] == scene]
            names = []
            for place, system in enumerate(dict.fromkeys(row["system"] for row in own)):
                names.append(_strip(panel, place, system, [row for row in own if row["system"] == system]))
            panel.set_xticks(range(len(names)), names, fontsize=7.5)
            panel.set(ylabel="test PSNR [dB]", xlim=(-0.6, len(names) - 0.4))
            panel.set_title(f"{scene}, cap {short_count(own[0]['cap'])}, {own[0]['iterations']} iterations")
            panel.grid(False, axis="x")
    return chart_paths(out)


def _strip(panel: Any, place: int, system: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """Draw one system's runs; returns its name and spreads for the axis."""
    colour = shape_colour(rows[0]["shape"])
    seeds = sorted((row["seed"], row["psnr"]) for row in rows if not row["repeat"])
    values = [psnr for _, psnr in seeds]
    # Side by side, so that equal values are both seen.
    across = [place - 0.18 + 0.05 * (number - (len(seeds) - 1) / 2) for number in range(len(seeds))]
    panel.plot(across, values, marker="o", linestyle="none", color=colour, markersize=5.5, alpha=0.85)
    middle = statistics.median(values)
    panel.plot([place - 0.36, place], [middle, middle], color=colour, linewidth=2)
    name = "-\n".join(system.rsplit("-", 1)) if len(system) > 14 else system
    said = f"{name}\nseeds {max(values) - min(values):.2f} dB"
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
        said += f"\nrepeats {max(repeated) - min(repeated):.2f} dB"
    return said


def arithmetic_chart(rows: Sequence[Mapping[str, Any]], out: str | Path) -> list[Path]:
    """Error of image and gradient against relative time, of variants of the arithmetic; a row a shape.

    Parameters
    ----------
    rows : of `frontier_data.arithmetic_rows`; those without an error have no place here.
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
                # What is exact has no place on a logarithmic axis. The far ones are named first: they differ most.
                own = sorted(
                    (row for row in rows if row["shape"] == shape and row[error] > 0),
                    key=lambda row: (row["variant"] != "default", -abs(row[time] - 1)),
                )
                points = [(row[time], row[error], row["variant"], colours[row["kind"]]) for row in own]
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

"""Charts of a sweep: quality along the training, quality against cost with its front, splats at equal quality."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..evaluation.chart_style import (
    FRONT,
    INK,
    WIDTH,
    Label,
    chart_paths,
    drawing,
    legend_rows,
    log_axis,
    looks,
    place_labels,
    shape_colour,
    short_count,
    system_legend,
)
from .sweep_rows import ChartRow

# Shown range below the best: the first points of the curves are far lower and would flatten the rest.
_DB_SHOWN, _SSIM_SHOWN = 5.0, 0.3
_COSTS = {"render_ms": ("render time [ms]", 1.0), "bytes": ("file [MB]", 1e-6), "splats": ("splats", 1.0)}
EQUAL_AIM = 0.7  # share of the reference's splats, drawn as a dashed line


def time_chart(rows: Sequence[ChartRow], out: str | Path) -> list[Path]:
    """Draw test PSNR (above) and SSIM (below) against seconds of training; a column for each scene.

    Each line is a run. The axes begin 5 dB (0.3) below the best.

    Parameters
    ----------
    rows : of `sweep_rows.curve_rows`. out : path without a suffix.

    Raises
    ------
    InputError : no rows. OutputError : no matplotlib, or not writable.
    """
    scenes, styles = _scenes(rows, out), looks({row["system"]: row["shape"] for row in rows})
    with drawing(out, WIDTH, 5.6 + 0.2 * legend_rows(len(styles))) as figure:
        panels = figure.subplots(2, len(scenes), squeeze=False, sharex="col")
        for column, scene in enumerate(scenes):
            shown = [row for row in rows if row["scene"] == scene]
            runs: dict[tuple[str, int], list[ChartRow]] = {}
            for row in shown:
                runs.setdefault((row["system"], row["seed"]), []).append(row)
            lines = [(system, run) for (system, _), run in runs.items()]
            _quality_panels(panels[:, column], lines, styles, column == 0)
            panels[0][column].set_title(f"{scene},\ncap {short_count(shown[0]['cap'])}")
            panels[1][column].set_xlabel("training time [s]")
        system_legend(figure, styles)
    return chart_paths(out)


def length_chart(rows: Sequence[ChartRow], out: str | Path) -> list[Path]:
    """Draw test PSNR (above) and SSIM (below) of whole runs against seconds of training; a column for each scene.

    Runs of a system that differ in their length are joined. The Pareto front of PSNR is grey. The axes begin 5 dB (0.3)
    below the best.

    Parameters
    ----------
    rows : of `length_rows.length_rows`. out : path without a suffix. Raises as `time_chart`.
    """
    scenes, styles = _scenes(rows, out), looks({row["system"]: row["shape"] for row in rows})
    with drawing(out, WIDTH, 5.6 + 0.2 * legend_rows(len(styles))) as figure:
        panels = figure.subplots(2, len(scenes), squeeze=False, sharex="col")
        for column, scene in enumerate(scenes):
            shown = sorted((row for row in rows if row["scene"] == scene), key=lambda row: float(row["seconds"]))
            runs = {system: [row for row in shown if row["system"] == system] for system in styles}
            front = [row for row in shown if row["front"]]
            panels[0][column].plot(
                [row["seconds"] for row in front], [row["psnr"] for row in front], color=FRONT, linewidth=5, zorder=1
            )
            _quality_panels(panels[:, column], list(runs.items()), styles, column == 0)
            panels[0][column].set_title(f"{scene},\ncap {short_count(shown[0]['cap'])}")
            panels[1][column].set_xlabel("training time [s]")
        system_legend(figure, styles)
    return chart_paths(out)


def size_chart(rows: Sequence[ChartRow], out: str | Path) -> list[Path]:
    """Draw test PSNR against render time, file size and splats; a row for each scene.

    The Pareto front is grey, and its points are labelled by their caps. Points of a method at several caps are joined.

    Parameters
    ----------
    rows : of `sweep_rows.point_rows`. out : path without a suffix. Raises as `time_chart`.
    """
    scenes, styles = _scenes(rows, out), looks({row["system"]: row["shape"] for row in rows})
    with drawing(out, WIDTH, 2.9 * len(scenes) + 0.3 + 0.2 * legend_rows(len(styles))) as figure:
        panels = figure.subplots(len(scenes), len(_COSTS), squeeze=False, sharey="row")
        labels: list[tuple[Any, list[Label]]] = []
        for line, scene in enumerate(scenes):
            shown = [row for row in rows if row["scene"] == scene]
            for axes, (cost, (name, unit)) in zip(panels[line], _COSTS.items(), strict=True):
                _cost_panel(axes, [row for row in shown if row[cost] is not None], cost, unit, styles)
                front = [
                    (unit * row[cost], row["psnr"], short_count(row["cap"]), shape_colour(row["shape"]))
                    for row in shown
                    if row[f"front_{cost}"]
                ]
                labels.append((axes, front))
                if line == len(scenes) - 1:
                    axes.set_xlabel(name)
            panels[line][0].set_ylabel(f"{scene}\ntest PSNR [dB]")
        system_legend(figure, styles)
        place_labels(figure, labels)
    return chart_paths(out)


def equal_chart(rows: Sequence[ChartRow], reference: str, out: str | Path) -> list[Path]:
    """Draw the splats needed for the PSNR of the reference, as a share of the reference's; a column for each scene.

    A hollow point is a bound: the smallest model is better already. A PSNR that was not reached has no point.

    Parameters
    ----------
    rows : of `sweep_rows.equal_rows`. out : path without a suffix. Raises as `time_chart`.
    """
    rows = [row for row in rows if row["ratio"] is not None]
    scenes, styles = _scenes(rows, out), looks({row["system"]: row["shape"] for row in rows})
    with drawing(out, WIDTH, 3.1 + 0.2 * legend_rows(len(styles))) as figure:
        (panels,) = figure.subplots(1, len(scenes), squeeze=False, sharey=True)
        for axes, scene in zip(panels, scenes, strict=True):
            for system, style in styles.items():
                shown = sorted(
                    (row for row in rows if row["scene"] == scene and row["system"] == system),
                    key=lambda row: float(row["reference_splats"]),
                )
                for bound in (False, True):
                    part = [row for row in shown if bool(row["bound"]) == bound]
                    how = {"linestyle": "none", "markerfacecolor": "white"} if bound else {}
                    axes.plot(
                        [row["reference_splats"] for row in part], [100 * row["ratio"] for row in part], **style | how
                    )
            axes.axhline(100, color=INK, linewidth=1)
            axes.axhline(100 * EQUAL_AIM, color=INK, linewidth=1, linestyle=(0, (4, 3)))
            sizes = [row["reference_splats"] for row in rows if row["scene"] == scene]
            low, high = min(sizes) / 1.3, max(sizes) * 1.3
            axes.set(xscale="log", xlim=(low, high), title=scene, xlabel=f"splats of {reference}")
            log_axis(axes.xaxis, low, high)
        low, high = (edge([100 * row["ratio"] for row in rows] + [100]) for edge in (min, max))
        panels[0].set(yscale="log", ylim=(low / 1.15, high * 1.15))  # one outlier must not flatten the rest
        log_axis(panels[0].yaxis, low / 1.15, high * 1.15)
        panels[0].set_ylabel(f"splats for the same PSNR\n[% of {reference}'s]")
        system_legend(figure, styles)
    return chart_paths(out)


def _quality_panels(
    panels: Sequence[Any], lines: Sequence[tuple[str, list[ChartRow]]], styles: dict[str, dict[str, Any]], named: bool
) -> None:
    """Draw PSNR (above) and SSIM (below) of some lines (system, points) against seconds, with the axes of `time_chart`.

    named : whether the vertical axes have their names.
    """
    shown = [row for _, line in lines for row in line]
    for axes, key, name, height in (
        (panels[0], "psnr", "test PSNR [dB]", _DB_SHOWN),
        (panels[1], "ssim", "test SSIM", _SSIM_SHOWN),
    ):
        for system, line in lines:
            axes.plot(
                [row["seconds"] for row in line],
                [row[key] for row in line],
                **styles[system] | {"markersize": 3, "linewidth": 1.3},
            )
        best = max(row[key] for row in shown)
        visible = [row for row in shown if row[key] >= best - height]
        low, high = min(row["seconds"] for row in visible) / 1.1, max(row["seconds"] for row in visible) * 1.1
        bottom = min(row[key] for row in visible)
        axes.set(
            xscale="log",
            xlim=(low, high),
            ylim=(bottom - 0.03 * (best - bottom) - 1e-3, best + 0.04 * (best - bottom) + 1e-3),
        )
        log_axis(axes.xaxis, low, high)
        if named:
            axes.set_ylabel(name)


def _cost_panel(
    axes: Any, shown: Sequence[ChartRow], cost: str, unit: float, styles: dict[str, dict[str, Any]]
) -> None:
    """Draw one panel of the size chart, without labels."""
    front = sorted((unit * row[cost], row["psnr"]) for row in shown if row[f"front_{cost}"])
    axes.plot(*zip(*front, strict=True), color=FRONT, linewidth=3.5, drawstyle="steps-post", zorder=1)
    for system, style in styles.items():
        line = sorted((row["cap"], unit * row[cost], row["psnr"]) for row in shown if row["system"] == system)
        if line:
            axes.plot([point[1] for point in line], [point[2] for point in line], **style)
    costs = [unit * row[cost] for row in shown]
    low, high = min(costs) / 1.2, max(costs) * 1.2
    axes.set(xscale="log", xlim=(low, high))
    axes.margins(y=0.12)
    log_axis(axes.xaxis, low, high)


def _scenes(rows: Sequence[ChartRow], out: str | Path) -> list[str]:
    """Return the scenes of some rows; raises InputError without rows."""
    if not rows:
        raise InputError(f"{out}: a chart needs points")
    return list(dict.fromkeys(row["scene"] for row in rows))

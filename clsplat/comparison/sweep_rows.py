"""Data of the charts of a sweep, as flat rows: curves, fronts, equal quality, seeds.

A row is a dictionary of plain values. `write_rows` writes the rows of a chart as CSV and JSON.
"""

from __future__ import annotations

import csv
import io
import json
import math
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..files.atomic import atomic_writer
from .scene_identity import scene_title, titled
from .table import Record, summarise

ChartRow = dict[str, Any]

COSTS = ("render_ms", "bytes", "splats")  # the horizontal axes
MIN_SEEDS = 3  # for a spread


def curve_rows(records: Sequence[Record]) -> list[ChartRow]:
    """Return points along runs: "scene", "cap", "system", "shape", "seed", "iteration", "seconds", "psnr", "ssim".

    Each scene has the cap and the iterations with the largest number of measured systems.
    """
    followed = [record for record in titled(records) if record.get("curve") and not record.get("repeat")]
    rows: list[ChartRow] = []
    for group in _by_scene(followed).values():
        cap, iterations = _most_frequent(
            [(r["config"]["cap_max"], r["config"]["iterations"], r["system"]) for r in group]
        )
        rows += [
            {
                "scene": scene_title(record),
                "cap": cap,
                "system": record["system"],
                "shape": record["config"]["shape"],
                "seed": record["config"]["seed"],
                **point,
            }
            for record in group
            for point in record["curve"]
            if math.isfinite(point["psnr"])
            and (record["config"]["cap_max"], record["config"]["iterations"]) == (cap, iterations)
        ]
    return rows


def point_rows(records: Sequence[Record]) -> list[ChartRow]:
    """Return a point for each system and cap, as means over the seeds; scenes with a single cap are left out.

    Points have the most frequent iterations of their scene, of equally frequent ones the largest.

    Returns
    -------
    "scene", "system", "shape", "cap", "iterations", "seeds" (their number), "psnr" [dB], "ssim", "seconds",
    "parameters" and COSTS; a cost that no run measured is None. "front_C" for each cost C: whether the point is on the
    Pareto front of its scene.
    """
    measured = ("psnr", "ssim", "seconds", "parameters", *COSTS)
    rows = [chart_point(row, measured) for row in summarise(records) if has_place(row)]
    kept: list[ChartRow] = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        group = [row for row in rows if row["scene"] == scene]
        if len({row["cap"] for row in group}) < 2:
            continue
        known = Counter(row["iterations"] for row in group)
        usual = max(known, key=lambda iterations: (known[iterations], iterations))
        group = [row for row in group if row["iterations"] == usual]
        for cost in COSTS:
            group = with_front(group, cost, f"front_{cost}")
        kept += group
    return kept


def has_place(row: Record) -> bool:
    """Return whether a row of `table.summarise` has a place in a chart: not if no run measured a finite PSNR.

    The PSNR of equal images is infinite.
    """
    return row["psnr"] is not None and math.isfinite(row["psnr"]["mean"])


def chart_point(row: Record, measured: Sequence[str]) -> ChartRow:
    """Return a row of `table.summarise` as a point of a chart.

    Returns
    -------
    "scene", "system", "shape", "cap", "iterations", "seeds" (the number of those that did not fail), and the
    mean of each value measured; None if no run measured it.
    """
    return {
        "scene": row["scene"],
        "system": row["system"],
        "shape": row["config"]["shape"],
        "cap": row["cap"],
        "iterations": row["iterations"],
        "seeds": len(row["seeds"]) - len(row["failed"]),
        **{key: None if row[key] is None else row[key]["mean"] for key in measured},
    }


def with_front(points: Sequence[ChartRow], cost: str, name: str) -> list[ChartRow]:
    """Return the points, each with `name`: whether it is on the Pareto front of `cost` and PSNR.

    Points without the cost are not.
    """
    best = pareto([(math.inf if point[cost] is None else point[cost], point["psnr"]) for point in points])
    return [point | {name: place in best and point[cost] is not None} for place, point in enumerate(points)]


def pareto(points: Sequence[tuple[float, float]]) -> set[int]:
    """Return the indices of the points (cost, quality) on the Pareto front.

    No other point is as good for a lower cost, or better for the same cost.
    """
    order = sorted(range(len(points)), key=lambda place: (points[place][0], -points[place][1]))
    best, front = -math.inf, set()
    for place in order:
        if points[place][1] > best:
            best = points[place][1]
            front.add(place)
    return front


def equal_rows(points: Sequence[ChartRow], reference: str) -> list[ChartRow]:
    """Return the number of splats that each system needs for the PSNR of the reference system.

    Parameters
    ----------
    points : of `point_rows`. reference : label of a system.

    Returns
    -------
    For each scene, reference point and other system with several points: "scene", "system", "shape", "psnr" [dB],
    "reference_cap", "reference_splats", "splats", "ratio" and "bound". The PSNR is that of the reference. "splats" and
    "ratio" are None if the system does not reach it. "bound" is "at most" if the smallest model is better already.
    """
    rows: list[ChartRow] = []
    for scene in dict.fromkeys(point["scene"] for point in points):
        curves: dict[str, list[ChartRow]] = {}
        for point in points:
            if point["scene"] == scene:
                curves.setdefault(point["system"], []).append(point)
        for system, group in curves.items():
            if system == reference or len(group) < 2:
                continue
            curve = [(point["splats"], point["psnr"]) for point in group]
            for aim in sorted(curves.get(reference, ()), key=lambda point: float(point["splats"])):
                splats = splats_needed(curve, aim["psnr"])
                smallest = min(curve)[1] >= aim["psnr"]
                rows.append(
                    {
                        "scene": scene,
                        "system": system,
                        "shape": group[0]["shape"],
                        "psnr": aim["psnr"],
                        "reference_cap": aim["cap"],
                        "reference_splats": aim["splats"],
                        "splats": splats,
                        "ratio": None if splats is None else splats / aim["splats"],
                        "bound": "at most" if smallest else "",
                    }
                )
    return rows


def arithmetic_rows(records: Sequence[ChartRow]) -> list[ChartRow]:
    """Return the variants of the arithmetic with their errors and times over scenes.

    Parameters
    ----------
    records : lines of benchmarks/arithmetic.py: "scene", "shape", "variant", "kind", "image_error", "gradient_error",
        "psnr_change" [dB], "raster_ms", "raster_vjp_ms". The errors are None if a variant is another model.

    Returns
    -------
    For each shape and variant: "shape", "variant", "kind", "scenes" (their number) and geometric means of the errors.
    "raster" and "raster_vjp" are geometric means of the times relative to the variant "default" in the same scene.
    "psnr_change" is a mean.
    """
    base = {(row["scene"], row["shape"]): row for row in records if row["variant"] == "default"}
    rows: list[ChartRow] = []
    for shape, variant in dict.fromkeys((row["shape"], row["variant"]) for row in records):
        group = [row for row in records if (row["shape"], row["variant"]) == (shape, variant)]
        timed = [row for row in group if row["image_error"] is not None and (row["scene"], shape) in base]
        ratios = {
            name: _geometric([row[f"{name}_ms"] / base[row["scene"], shape][f"{name}_ms"] for row in timed])
            for name in ("raster", "raster_vjp")
        }
        rows.append(
            {"shape": shape, "variant": variant, "kind": group[0]["kind"], "scenes": len(group)}
            | {name: _geometric([row[name] for row in timed]) for name in ("image_error", "gradient_error")}
            | ratios
            | {"psnr_change": statistics.fmean(row["psnr_change"] for row in group)}
        )
    return rows


def _geometric(values: Sequence[float]) -> float | None:
    """Return the geometric mean: 0 if a value is 0, None without values."""
    if not values:
        return None
    return statistics.geometric_mean(values) if min(values) > 0 else 0.0


def splats_needed(curve: Sequence[tuple[float, float]], psnr: float) -> float | None:
    """Return the splats at which a curve (splats, PSNR) first reaches `psnr`: linear in log splats between its points.

    If the smallest model is better already, its splats are returned; if no model is good enough, None.
    """
    before: tuple[float, float] | None = None
    for splats, quality in sorted(curve):
        if quality >= psnr:
            if before is None:
                return splats
            share = (psnr - before[1]) / (quality - before[1])
            return float(before[0] * (splats / before[0]) ** share)
        before = (splats, quality)
    return None


def seed_rows(records: Sequence[Record]) -> list[ChartRow]:
    """Return the runs that show the effect of chance: systems with at least MIN_SEEDS seeds, and their repeats.

    Returns
    -------
    "scene", "cap", "iterations", "system", "shape", "seed", "repeat", "psnr" [dB], "ssim", "digest". Each scene has the
    cap and the iterations with the largest number of such systems.
    """
    done = [record for record in titled(records) if not record["failed"] and math.isfinite(record["psnr"])]
    seeds: dict[tuple[Any, ...], set[int]] = {}
    for record in done:
        seeds.setdefault(_setting(record), set()).add(record["config"]["seed"])
    spread = [record for record in done if len(seeds[_setting(record)]) >= MIN_SEEDS]
    rows: list[ChartRow] = []
    for group in _by_scene(spread).values():
        chosen = _most_frequent([(r["config"]["cap_max"], r["config"]["iterations"], r["system"]) for r in group])
        rows += [
            {
                "scene": scene_title(record),
                "cap": chosen[0],
                "iterations": chosen[1],
                "system": record["system"],
                "shape": record["config"]["shape"],
                "seed": record["config"]["seed"],
                "repeat": record.get("repeat", 0),
                "psnr": record["psnr"],
                "ssim": record["ssim"],
                "digest": record.get("digest"),
            }
            for record in group
            if (record["config"]["cap_max"], record["config"]["iterations"]) == chosen
        ]
    return rows


def write_rows(folder: Path, name: str, rows: Sequence[ChartRow]) -> list[Path]:
    """Write NAME.csv and NAME.json; return their paths."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, keys, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    paths = [folder / f"{name}.csv", folder / f"{name}.json"]
    for path, content in zip(paths, (text.getvalue(), json.dumps(list(rows), indent=1) + "\n"), strict=True):
        with atomic_writer(path) as stream:
            stream.write(content.encode(errors="backslashreplace"))
    return paths


def _by_scene(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Return the records, which have titles, by scene."""
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(scene_title(record), []).append(record)
    return groups


def _setting(record: Record) -> tuple[Any, ...]:
    """Return what runs that differ only in the seed have in common."""
    config: Mapping[str, Any] = record["config"]
    return scene_title(record), record["system"], config["cap_max"], config["iterations"]


def _most_frequent(settings: Sequence[tuple[int, int, str]]) -> tuple[int, int]:
    """Return the cap and iterations with the largest number of systems; if equal, the largest cap."""
    systems: dict[tuple[int, int], set[str]] = {}
    for cap, iterations, system in settings:
        systems.setdefault((cap, iterations), set()).add(system)
    return max(systems, key=lambda key: (len(systems[key]), key))

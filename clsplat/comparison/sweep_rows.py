"""What the charts of a sweep show, as flat rows made from its records: curves, fronts, equal quality, seeds.

A row is a dict of plain values; `write_rows` keeps each chart's as CSV and JSON.
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
from .table import Record, scene_title, summarise

ChartRow = dict[str, Any]

COSTS = ("render_ms", "bytes", "splats")  # what PSNR is drawn against
AUTO = "auto"  # first word of the system of a run that chose its own number of splats
LEAST_SEEDS = 3  # that show a spread


def curve_rows(records: Sequence[Record]) -> list[ChartRow]:
    """Points along runs: "scene", "cap", "system", "shape", "seed", "iteration", "seconds", "psnr", "ssim".

    For each scene of the cap and iterations at which most systems were followed.
    """
    followed = [record for record in records if record.get("curve") and not record.get("repeat")]
    rows: list[ChartRow] = []
    for group in _by_scene(followed).values():
        cap, iterations = _commonest([(r["config"]["cap_max"], r["config"]["iterations"], r["system"]) for r in group])
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
            if (record["config"]["cap_max"], record["config"]["iterations"]) == (cap, iterations)
        ]
    return rows


def point_rows(records: Sequence[Record]) -> list[ChartRow]:
    """One point for each system and cap of the scenes that have several: means over seeds, of all runs not failed.

    Returns
    -------
    "scene", "system", "shape", "cap", "iterations", "seeds" (how many), "auto", "psnr" [dB], "ssim", "seconds",
    "parameters" and COSTS; "front_C" for each cost C: whether no other point of the scene has at least its PSNR for no
    more of C. Iterations are those of most points of the scene, of `auto` any.
    """
    rows = []
    for row in summarise(records):
        if row["psnr"] is not None:
            means = {key: row[key]["mean"] for key in ("psnr", "ssim", "seconds", "parameters", *COSTS)}
            rows.append(
                {key: row[key] for key in ("scene", "system")}
                | {"shape": row["config"]["shape"]}
                | {key: row[key] for key in ("cap", "iterations")}
                | {"seeds": len(row["seeds"]) - len(row["failed"]), "auto": is_auto(row["system"])}
                | means
            )
    kept: list[ChartRow] = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        own = [row for row in rows if row["scene"] == scene]
        swept = [row for row in own if not row["auto"]]
        if len({row["cap"] for row in swept}) < 2:
            continue
        usual = Counter(row["iterations"] for row in swept).most_common(1)[0][0]
        own = [row for row in own if row["auto"] or row["iterations"] == usual]
        for cost in COSTS:
            best = pareto([(row[cost], row["psnr"]) for row in own])
            own = [row | {f"front_{cost}": place in best} for place, row in enumerate(own)]
        kept += own
    return kept


def is_auto(system: str) -> bool:
    """Whether a system's label says that the run chose its own number of splats."""
    return system.split(" ")[0].split(":")[0] == AUTO


def pareto(points: Sequence[tuple[float, float]]) -> set[int]:
    """Places of the points (cost, quality) that no other beats: none is as good for less, or better for no more."""
    order = sorted(range(len(points)), key=lambda place: (points[place][0], -points[place][1]))
    best, front = -math.inf, set()
    for place in order:
        if points[place][1] > best:
            best = points[place][1]
            front.add(place)
    return front


def equal_rows(points: Sequence[ChartRow], reference: str) -> list[ChartRow]:
    """How many splats each system needs for the PSNR of the reference system.

    Parameters
    ----------
    points : of `point_rows`. reference : label of a system.

    Returns
    -------
    For each scene, reference point and other system with several points: "scene", "system", "shape", "psnr" (the
    reference's, dB), "reference_cap", "reference_splats", "splats" and "ratio" (None where the system does not reach
    it), "bound" ("" or "at most": its smallest model is better already).
    """
    rows: list[ChartRow] = []
    for scene in dict.fromkeys(point["scene"] for point in points):
        curves: dict[str, list[ChartRow]] = {}
        for point in points:
            if point["scene"] == scene and not point["auto"]:
                curves.setdefault(point["system"], []).append(point)
        for system, own in curves.items():
            if system == reference or len(own) < 2:
                continue
            curve = [(point["splats"], point["psnr"]) for point in own]
            for aim in sorted(curves.get(reference, ()), key=lambda point: float(point["splats"])):
                splats = splats_needed(curve, aim["psnr"])
                smallest = min(curve)[1] >= aim["psnr"]
                rows.append(
                    {
                        "scene": scene,
                        "system": system,
                        "shape": own[0]["shape"],
                        "psnr": aim["psnr"],
                        "reference_cap": aim["cap"],
                        "reference_splats": aim["splats"],
                        "splats": splats,
                        "ratio": None if splats is None else splats / aim["splats"],
                        "bound": "at most" if smallest else "",
                    }
                )
    return rows


def auto_rows(points: Sequence[ChartRow]) -> list[ChartRow]:
    """Runs that chose their own number of splats beside the best of the sweep with their shape.

    Returns
    -------
    For each `auto` of `point_rows`: "scene", "system", "shape", "psnr" [dB], "splats", "bytes", "best_cap",
    "best_psnr", "lost" (best less own, dB), "splats_ratio" and "bytes_ratio" (own / best), "front" (costs on whose
    front it lies). None for each of the best's where the shape was not swept.
    """
    rows: list[ChartRow] = []
    for own in points:
        if own["auto"]:
            swept = [
                point
                for point in points
                if not point["auto"] and point["scene"] == own["scene"] and point["shape"] == own["shape"]
            ]
            best = max(swept, key=lambda point: float(point["psnr"]), default=None)
            rows.append(
                {key: own[key] for key in ("scene", "system", "shape", "psnr", "splats", "bytes")}
                | {
                    "best_cap": best and best["cap"],
                    "best_psnr": best and best["psnr"],
                    "lost": best and best["psnr"] - own["psnr"],
                    "splats_ratio": best and own["splats"] / best["splats"],
                    "bytes_ratio": best and own["bytes"] / best["bytes"],
                    "front": " ".join(cost for cost in COSTS if own[f"front_{cost}"]),
                }
            )
    return rows


def arithmetic_rows(records: Sequence[ChartRow]) -> list[ChartRow]:
    """Variants of the arithmetic, their errors and times over scenes.

    Parameters
    ----------
    records : lines of benchmarks/arithmetic.py: "scene", "shape", "variant", "kind", "image_error", "gradient_error"
        (None where a variant is another model), "psnr_change" [dB], "raster_ms", "raster_vjp_ms".

    Returns
    -------
    For each shape and variant: "shape", "variant", "kind", "scenes" (how many), geometric means of the errors, and of
    "raster" and "raster_vjp", the times over those of the variant "default" in the same scene; the mean "psnr_change".
    """
    base = {(row["scene"], row["shape"]): row for row in records if row["variant"] == "default"}
    rows: list[ChartRow] = []
    for shape, variant in dict.fromkeys((row["shape"], row["variant"]) for row in records):
        own = [row for row in records if (row["shape"], row["variant"]) == (shape, variant)]
        timed = [row for row in own if row["image_error"] is not None and (row["scene"], shape) in base]
        ratios = {
            name: _geometric([row[f"{name}_ms"] / base[row["scene"], shape][f"{name}_ms"] for row in timed])
            for name in ("raster", "raster_vjp")
        }
        rows.append(
            {"shape": shape, "variant": variant, "kind": own[0]["kind"], "scenes": len(own)}
            | {name: _geometric([row[name] for row in timed]) for name in ("image_error", "gradient_error")}
            | ratios
            | {"psnr_change": statistics.fmean(row["psnr_change"] for row in own)}
        )
    return rows


def _geometric(values: Sequence[float]) -> float | None:
    """The geometric mean, 0 if any is, None of none."""
    if not values:
        return None
    return statistics.geometric_mean(values) if min(values) > 0 else 0.0


def splats_needed(curve: Sequence[tuple[float, float]], psnr: float) -> float | None:
    """Splats at which a curve (splats, PSNR) first has `psnr`: linear in log splats between its points.

    The smallest model's splats where that one is better already; None where none is good enough.
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
    """Runs that show what chance does: those of systems with LEAST_SEEDS seeds or more, and their repeats.

    Returns
    -------
    "scene", "cap", "iterations", "system", "shape", "seed", "repeat", "psnr" [dB], "ssim", "digest"; for each scene of
    the cap and iterations at which most systems have such seeds.
    """
    done = [record for record in records if not record["failed"] and not is_auto(record["system"])]
    seeds: dict[tuple[Any, ...], set[int]] = {}
    for record in done:
        seeds.setdefault(_setting(record), set()).add(record["config"]["seed"])
    spread = [record for record in done if len(seeds[_setting(record)]) >= LEAST_SEEDS]
    rows: list[ChartRow] = []
    for group in _by_scene(spread).values():
        chosen = _commonest([(r["config"]["cap_max"], r["config"]["iterations"], r["system"]) for r in group])
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
    """Write NAME.csv and NAME.json; returns their paths."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, keys, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    paths = [folder / f"{name}.csv", folder / f"{name}.json"]
    for path, content in zip(paths, (text.getvalue(), json.dumps(list(rows), indent=1) + "\n"), strict=True):
        with atomic_writer(path) as stream:
            stream.write(content.encode())
    return paths


def _by_scene(records: Sequence[Record]) -> dict[str, list[Record]]:
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(json.dumps(record["scene"]), []).append(record)
    return groups


def _setting(record: Record) -> tuple[Any, ...]:
    config: Mapping[str, Any] = record["config"]
    return json.dumps(record["scene"]), record["system"], config["cap_max"], config["iterations"]


def _commonest(settings: Sequence[tuple[int, int, str]]) -> tuple[int, int]:
    """Cap and iterations that most systems have; of equals the most."""
    systems: dict[tuple[int, int], set[str]] = {}
    for cap, iterations, system in settings:
        systems.setdefault((cap, iterations), set()).add(system)
    return max(systems, key=lambda key: (len(systems[key]), key))

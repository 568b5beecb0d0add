"""Data of whole runs of several lengths, as flat rows: quality against seconds of training, and at equal seconds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .scene_identity import scene_title, titled
from .sweep_rows import ChartRow, chart_point, has_place, with_front
from .table import Record, summarise


def length_rows(records: Sequence[Record]) -> list[ChartRow]:
    """Return a point for each system and length of the run, as means over the seeds that all its lengths have.

    Each scene has the cap with the largest number of systems that have runs of several lengths. Other systems and
    scenes are left out.

    Returns
    -------
    "scene", "system", "shape", "cap", "iterations", "seeds" (their number), "seconds", "psnr" [dB] and "ssim". "front":
    whether the point is on the Pareto front of seconds and PSNR in its scene.
    """
    done = [row for row in summarise(with_shared_seeds(titled(records))) if has_place(row)]
    rows: list[ChartRow] = []
    for scene in dict.fromkeys(row["scene"] for row in done):
        lengths: dict[tuple[int, str], set[int]] = {}
        for row in done:
            if row["scene"] == scene:
                lengths.setdefault((row["cap"], row["system"]), set()).add(row["iterations"])
        several = [cap for (cap, _), known in lengths.items() if len(known) > 1]
        if not several:
            continue
        cap = max(several, key=lambda cap: (several.count(cap), cap))
        group = [
            chart_point(row, ("seconds", "psnr", "ssim"))
            for row in done
            if (row["scene"], row["cap"]) == (scene, cap) and len(lengths[cap, row["system"]]) > 1
        ]
        rows += with_front(group, "seconds", "front")
    return rows


def with_shared_seeds(records: Sequence[Record]) -> list[Record]:
    """Return the records without seeds that only some lengths of a run have, unless no seed has them all.

    Means over other seeds at each length would differ by the seeds, too.
    """
    groups: dict[tuple[str, str, int], dict[int, set[int]]] = {}
    keys = [(scene_title(record), record["system"], record["config"]["cap_max"]) for record in titled(records)]
    for key, record in zip(keys, records, strict=True):
        config = record["config"]
        groups.setdefault(key, {}).setdefault(config["iterations"], set()).add(config["seed"])
    shared = {key: set.intersection(*lengths.values()) for key, lengths in groups.items()}
    return [
        record
        for key, record in zip(keys, records, strict=True)
        if not shared[key] or record["config"]["seed"] in shared[key]
    ]


def equal_time_rows(points: Sequence[ChartRow], reference: str) -> list[ChartRow]:
    """Return the PSNR of each system at the seconds of the runs of the reference.

    Parameters
    ----------
    points : of `length_rows`. reference : label of a system.

    Returns
    -------
    For each scene, other system and run of the reference: "scene", "system", "shape", "reference_iterations",
    "seconds", "reference_psnr", "psnr" and "lead" [dB]. "psnr" and "lead" are None if the runs of the system are all
    shorter or all longer.
    """
    of_system: dict[tuple[str, str], list[ChartRow]] = {}
    for point in sorted(points, key=lambda point: float(point["seconds"])):
        of_system.setdefault((point["scene"], point["system"]), []).append(point)
    rows: list[ChartRow] = []
    for scene, system in dict.fromkeys((point["scene"], point["system"]) for point in points):
        if system == reference:
            continue
        runs = of_system[scene, system]
        for aim in of_system.get((scene, reference), ()):
            psnr = quality_at([(run["seconds"], run["psnr"]) for run in runs], aim["seconds"])
            rows.append(
                {
                    "scene": scene,
                    "system": system,
                    "shape": runs[0]["shape"],
                    "reference_iterations": aim["iterations"],
                    "seconds": aim["seconds"],
                    "reference_psnr": aim["psnr"],
                    "psnr": psnr,
                    "lead": None if psnr is None else psnr - aim["psnr"],
                }
            )
    return rows


def quality_at(curve: Sequence[tuple[float, float]], seconds: float) -> float | None:
    """Return the quality of a curve (seconds, quality) at `seconds`: linear in log seconds between its points.

    None beyond its first and last point.
    """
    times, qualities = zip(*sorted(curve), strict=True) if curve else ((), ())
    if not times or not times[0] <= seconds <= times[-1]:
        return None
    return float(np.interp(np.log(seconds), np.log(times), qualities))

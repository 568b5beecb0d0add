"""The results of a benchmark beside published figures: flat rows, tables and notes."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..comparison.sweep_rows import write_rows
from ..comparison.table import MEASURED, Record, markdown_table, scene_title, summarise
from ..comparison.table import notes as notes_of_runs
from ..files.atomic import atomic_writer
from ..scenes.options import TEST_EVERY
from .sets import BLENDER, METRICS, BenchmarkSet, Published

AS_PUBLISHED = "the published protocol"
OURS = "clsplat"
Row = dict[str, Any]

WORDS = ("system", "source or protocol")
_HEAD = (WORDS[0], "PSNR", "SSIM", "LPIPS", "splats", "iterations", "seconds", WORDS[1])
_DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4}


@dataclass(frozen=True)
class ResultTable:
    """A table of text with a title. The columns in WORDS hold words, the others numbers."""

    title: str
    head: tuple[str, ...]
    rows: list[tuple[str, ...]]


def result_rows(chosen: BenchmarkSet, records: Sequence[Record]) -> list[Row]:
    """Return a row for each measured scene and system, followed by the published figures of that scene.

    Parameters
    ----------
    records : runs of runs.jsonl; those of other sets are left out.

    Returns
    -------
    Rows with equal keys. "kind" is "measured" or "published". Metrics are means over the seeds, "psnr_half_spread" is
    half of the maximum less the minimum. Unknown values are None. "note" has the differences from the protocol.
    """
    records = _of_set(chosen, records)
    rows = [_measured_row(chosen, row, records) for row in summarise(records, (*MEASURED, "lpips"))]
    return [
        row
        for scene in chosen.scenes
        if any(row["scene"] == scene for row in rows)
        for row in [
            *(row for row in rows if row["scene"] == scene),
            *(
                _published_row(chosen, scene, published)
                for published in chosen.figures
                if scene in published.values.get("psnr", {})
            ),
        ]
    ]


def result_tables(chosen: BenchmarkSet, records: Sequence[Record]) -> list[ResultTable]:
    """Return a table for each measured scene, and one of all scenes with means if there are several."""
    rows = result_rows(chosen, records)
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    tables = [
        ResultTable(_title(scene, rows), _HEAD, [_cells(row) for row in rows if row["scene"] == scene])
        for scene in scenes
    ]
    return [*tables, _mean_table(chosen, rows, scenes)] if len(scenes) > 1 else tables


def result_notes(chosen: BenchmarkSet, records: Sequence[Record]) -> list[str]:
    """Return what a reader must know to compare the figures, one sentence each: the traps that apply to these runs."""
    records = _of_set(chosen, records)
    if not records:
        return []
    rows = result_rows(chosen, records)
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    sentences = [
        f"{row['scene']}, {row['system']}: {row['note']}"
        for row in rows
        if row["kind"] == "measured" and row["note"] != AS_PUBLISHED
    ]
    sentences = [f"differs from the published protocol: {text}" for text in dict.fromkeys(sentences)]
    sentences += [f"{chosen.title}: {trap}" for trap in chosen.traps]
    sentences.append(
        "metrics: papers differ in the window and padding of SSIM, in the network and input range of LPIPS, and in "
        "whether images are rounded to 8 bits; ours are those of 3DGS's script"
    )
    split = "the set's own files" if chosen.layout == BLENDER else f"every {TEST_EVERY}th of the sorted names"
    sentences.append(f"test views: {split}; the last iteration is measured, and nothing is chosen on test views")
    if len(scenes) < len(chosen.scenes):
        sentences.append(f"{len(scenes)} of the {len(chosen.scenes)} scenes: published means over all do not apply")
    described = [record["protocol"].get("LPIPS") for record in records if record.get("lpips") is not None]
    sentences.append(f"LPIPS: {described[0]}" if described else "LPIPS is not measured")
    timeless = [{**record, "renders_per_view": None} for record in records]  # no table has render times
    return [*sentences, *notes_of_runs(timeless, summarise(records))]


def result_markdown(chosen: BenchmarkSet, records: Sequence[Record]) -> str:
    """Return the tables and the notes as Markdown."""
    tables = [
        f"## {table.title}\n\n{markdown_table(table.head, table.rows, set(table.head) - set(WORDS))}\n"
        for table in result_tables(chosen, records)
    ]
    notes = "".join(f"- {note}\n" for note in result_notes(chosen, records))
    return "\n".join([f"# {chosen.title}\n", *tables, notes])


def files_of_results(name: str) -> tuple[str, ...]:
    """Return the names of the files that `write_results` writes for a set."""
    return f"{name}.md", f"{name}.csv", f"{name}.json"


def write_results(folder: Path, chosen: BenchmarkSet, records: Sequence[Record]) -> None:
    """Write NAME.md, NAME.csv and NAME.json of a set, if there are runs of it."""
    if _of_set(chosen, records):
        with atomic_writer(folder / f"{chosen.name}.md") as stream:
            stream.write(result_markdown(chosen, records).encode())
        write_rows(folder, chosen.name, result_rows(chosen, records))


def _of_set(chosen: BenchmarkSet, records: Sequence[Record]) -> list[Record]:
    return [record for record in records if record["scene"].get("set") == chosen.name]


def _measured_row(chosen: BenchmarkSet, row: Record, records: Sequence[Record]) -> Row:
    """Return the flat row of a row of `summarise`, whose runs are among the records."""
    run = next(
        record
        for record in records
        if scene_title(record) == row["scene"]
        and row["system"].startswith(record["system"])
        and {**record["config"], "seed": None} == {**row["config"], "seed": None}
    )
    scene, config = run["scene"], row["config"]
    means = {key: None if row[key] is None else row[key]["mean"] for key in (*METRICS, "splats", "seconds", "bytes")}
    return {
        "set": chosen.name,
        "scene": scene["name"],
        "kind": "measured",
        "system": f"{OURS} {row['system']}",
        **{key: means[key] for key in METRICS},
        "psnr_half_spread": row["psnr"]["half_spread"] if row["psnr"] else None,
        "splats": None if means["splats"] is None else round(means["splats"]),
        "cap": config["cap_max"],
        "iterations": config["iterations"],
        "seeds": len(row["seeds"]),
        "seconds": means["seconds"],
        "bytes": means["bytes"],
        "width": scene["width"],
        "height": scene["height"],
        "test_views": scene["test"],
        "source": f"clsplat {run['version']}",
        "note": "; ".join(run.get("differences", ())) or AS_PUBLISHED,
    }


def _published_row(chosen: BenchmarkSet, scene: str, published: Published) -> Row:
    known = chosen.scenes[scene]
    return {
        "set": chosen.name,
        "scene": scene,
        "kind": "published",
        "system": published.system,
        **{key: published.values.get(key, {}).get(scene) for key in METRICS},
        "psnr_half_spread": None,
        "splats": published.splats.get(scene),
        "cap": None,
        "iterations": published.iterations,
        "seeds": None,
        "seconds": None,
        "bytes": None,
        "width": known.size[0],
        "height": known.size[1],
        "test_views": known.test,
        "source": published.source,
        "note": published.note,
    }


def _title(scene: str, rows: Sequence[Row]) -> str:
    """Return the name of a scene with the sizes and the number of test views that were measured."""
    measured = [row for row in rows if row["scene"] == scene and row["kind"] == "measured"]
    sizes = dict.fromkeys(f"{row['width']}x{row['height']} px, {row['test_views']} test views" for row in measured)
    return f"{scene} ({'; '.join(sizes)})"


def _cells(row: Row) -> tuple[str, ...]:
    """Return a row as text, in the order of _HEAD."""
    ours = row["kind"] == "measured"
    psnr = "failed" if ours and row["psnr"] is None else _number(row["psnr"], _DIGITS["psnr"])
    if ours and row["psnr"] is not None and row["seeds"] > 1:
        psnr += f" ± {row['psnr_half_spread']:.2f}"
    return (
        row["system"],
        psnr,
        *(_number(row[key], _DIGITS[key]) if ours else _as_published(row[key]) for key in METRICS[1:]),
        _number(row["splats"], 0),
        _number(row["iterations"], 0),
        _number(row["seconds"], 1),
        _source(row),
    )


def _source(row: Row) -> str:
    """Return the note of our rows, and the source and note of the others."""
    texts = (row["note"],) if row["kind"] == "measured" else (row["source"], row["note"])
    return "; ".join(text for text in texts if text)


def _as_published(value: float | None) -> str:
    """Return a number with the digits of its source: more would claim a precision that it does not have."""
    return "" if value is None else f"{value:g}"


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _mean_table(chosen: BenchmarkSet, rows: Sequence[Row], scenes: Sequence[str]) -> ResultTable:
    """Return the table of PSNR by scene, with the means of all metrics over the measured scenes.

    A system without a figure for each of these scenes has no mean: means over different scenes differ by decibels.
    """
    groups: dict[tuple[Any, ...], dict[str, Row]] = {}
    for row in rows:
        by_cap = row["cap"] if row["kind"] == "measured" and row["cap"] != chosen.scenes[row["scene"]].splats else None
        key = (row["kind"], row["system"], row["iterations"], by_cap, row["source"])
        groups.setdefault(key, {})[row["scene"]] = row
    ordered = sorted(groups, key=lambda key: key[0] != "measured")  # a stable order: ours come first
    lines = [_mean_line(groups[key], scenes) for key in ordered]
    head = (WORDS[0], "iterations", *scenes, "mean PSNR", "SSIM", "LPIPS", "splats", "seconds", WORDS[1])
    if len(scenes) == len(chosen.scenes):
        lines += [
            (
                each.system,
                _number(each.iterations, 0),
                *("" for _ in scenes),
                _number(each.mean, 2),
                *("" for _ in head[len(scenes) + 3 : -1]),
                "; ".join(text for text in (each.source, each.note) if text),
            )
            for each in chosen.figures
            if each.mean is not None
        ]
    return ResultTable(f"PSNR of {len(scenes)} of {len(chosen.scenes)} scenes, and means", head, lines)


def _mean_line(by_scene: Mapping[str, Row], scenes: Sequence[str]) -> tuple[str, ...]:
    first = next(iter(by_scene.values()))

    def mean(key: str) -> float | None:
        values = [by_scene[scene][key] if scene in by_scene else None for scene in scenes]
        known = [value for value in values if value is not None]
        return statistics.fmean(known) if len(known) == len(scenes) else None

    return (
        first["system"],
        _number(first["iterations"], 0),
        *(_number(by_scene[scene]["psnr"], 2) if scene in by_scene else "" for scene in scenes),
        *(_number(mean(key), _DIGITS[key]) for key in METRICS),
        _number(mean("splats"), 0),
        _number(mean("seconds"), 1),
        "; ".join(dict.fromkeys(_source(row) for row in by_scene.values())),
    )

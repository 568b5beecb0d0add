"""The table of a comparison: runs that differ only in the seed make a row, with mean and spread."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Collection, Sequence
from typing import Any

from .scene_identity import Record as Record
from .scene_identity import scene_title as scene_title
from .scene_identity import titled

HEAD = ("scene", "cap", "iterations", "system", "seeds", "PSNR", "SSIM", "seconds", "splats", "parameters", "MB")
MEASURED = ("psnr", "ssim", "seconds", "cpu_seconds", "render_ms", "splats", "parameters", "bytes", "device_bytes")
_FROM_MEASURED = {
    "PSNR": ("psnr", 1.0, 2),
    "SSIM": ("ssim", 1.0, 4),
    "seconds": ("seconds", 1.0, 1),
    "splats": ("splats", 1.0, 0),
    "parameters": ("parameters", 1.0, 0),
    "MB": ("bytes", 1e-6, 2),
}


def summarise(records: Sequence[Record], measured: Sequence[str] = MEASURED) -> list[Record]:
    """Return a row for each scene, cap and system, ordered by scene and cap, then by the first run.

    Repeated runs do not count; see `repeats`. Systems of the same name with different options have these options added
    to "system".

    Parameters
    ----------
    measured : keys of the values to summarise.

    Returns
    -------
    Rows with "scene", "cap", "iterations", "system", "config" (all options but the seed), "seeds" and "failed".
    "failed" holds the messages by seed. "finite" and "cap_held" are over all runs of the row. Each value measured is
    {"mean", "half_spread"}, half of maximum less minimum; it is None if every run failed or no run measured it.
    """
    groups: dict[str, list[Record]] = {}
    for record in titled(records):
        if not record.get("repeat"):
            groups.setdefault(group_key(record), []).append(record)
    rows = [_row(group, measured) for group in groups.values()]
    for row, options in zip(rows, [_differing(row, rows) for row in rows], strict=True):
        row["system"] += options
    places = {scene: place for place, scene in enumerate(dict.fromkeys(row["scene"] for row in rows))}
    rows.sort(key=lambda row: (places[row["scene"]], row["cap"]))
    return rows


def repeats(records: Sequence[Record]) -> list[Record]:
    """Return a row for each run that was made more than once: whether it gives the same splats each time.

    Only runs of one device, driver, schedule and version are compared; failed runs are left out.

    Returns
    -------
    Rows with "scene", "cap", "system", "seed", "runs", "same" and "spread". "same" is whether all runs gave the same
    splats, bit by bit. "spread" is the maximum less the minimum of the PSNR [dB].
    """
    groups: dict[str, list[Record]] = {}
    for record in titled(records):
        if record.get("digest"):
            where = [record[key] for key in ("device", "driver", "schedule", "version")]
            groups.setdefault(json.dumps([group_key(record), record["config"]["seed"], where]), []).append(record)
    return [
        {
            "scene": scene_title(group[0]),
            "cap": group[0]["config"]["cap_max"],
            "system": group[0]["system"],
            "seed": group[0]["config"]["seed"],
            "runs": len(group),
            "same": len({record["digest"] for record in group}) == 1,
            "spread": max(record["psnr"] for record in group) - min(record["psnr"] for record in group),
        }
        for group in groups.values()
        if len(group) > 1
    ]


def cells(row: Record) -> tuple[str, ...]:
    """Return a row as text, in the order of HEAD."""
    texts = {
        "scene": row["scene"],
        "cap": str(row["cap"]),
        "iterations": str(row["iterations"]),
        "system": row["system"],
        "seeds": str(len(row["seeds"])),
    }
    for title, (key, unit, digits) in _FROM_MEASURED.items():
        values = row[key]
        texts[title] = "failed"
        if values is not None:
            texts[title] = f"{unit * values['mean']:.{digits}f}"
            if len(row["seeds"]) - len(row["failed"]) > 1 and title in ("PSNR", "SSIM", "seconds"):
                texts[title] += f" ± {unit * values['half_spread']:.{digits}f}"
    return tuple(texts[title] for title in HEAD)


def notes(records: Sequence[Record], rows: Sequence[Record]) -> list[str]:
    """Return the notes below the table, one sentence each."""
    sentences = ["mean ± half the spread (maximum less minimum) over the seeds"]
    sentences += [
        f"failed: {row['system']} on {row['scene']} at cap {row['cap']}, seed {seed}: {message}"
        for row in rows
        for seed, message in row["failed"].items()
    ]
    sentences += [
        f"{row['system']} on {row['scene']} at cap {row['cap']}: {fault}"
        for row in rows
        for key, fault in (("cap_held", "more splats than the cap"), ("finite", "parameters that are not finite"))
        if row["seeds"] and not row[key] and not row["failed"]
    ]
    sentences += different_seeds(rows)
    again = repeats(records)
    if again:
        same = sum(row["same"] for row in again)
        sentences.append(f"repeated: {same} of {len(again)} runs gave the same splats each time, bit by bit")
        sentences += [
            f"{row['system']} on {row['scene']} at cap {row['cap']}, seed {row['seed']}: {row['runs']} runs "
            f"differ, PSNR by {row['spread']:.4f} dB"
            for row in again
            if not row["same"]
        ]
    single = [record["system"] for record in records if record.get("renders_per_view") == 1]
    if single:
        sentences.append(
            f"render time of {', '.join(dict.fromkeys(single))}: one render of each view, not the fastest of several, "
            "so it is a little longer"
        )
    by_key: tuple[tuple[str, Callable[[Record], Any]], ...] = (
        ("device", lambda record: f"{record['device']} ({record['driver']})"),
        ("schedule", lambda record: record["schedule"]),
        ("version", lambda record: f"clsplat {record['version']}"),
        ("protocol", lambda record: f"PSNR {record['protocol']['PSNR']}; SSIM {record['protocol']['SSIM']}"),
    )
    for name, of in by_key:
        values = list(dict.fromkeys(of(record) for record in records))
        mixed = " (mixed: seconds and rounding are not those of one machine)" if len(values) > 1 else ""
        sentences.append(f"{name}: {', '.join(values)}{mixed}")
    return sentences


def different_seeds(rows: Sequence[Record]) -> list[str]:
    """Return a sentence for each scene with means over different seeds. rows : of `summarise`."""
    scenes: dict[str, set[tuple[int, ...]]] = {}
    for row in rows:
        if done := [seed for seed in row["seeds"] if str(seed) not in row["failed"]]:
            scenes.setdefault(row["scene"], set()).add(tuple(sorted(done)))
    texts = {
        scene: " or ".join(f"({', '.join(map(str, group))})" for group in sorted(groups))
        for scene, groups in scenes.items()
    }
    return [
        f"different seeds on {scene}: means are over {texts[scene]}, so their differences are partly chance"
        for scene, groups in scenes.items()
        if len(groups) > 1
    ]


def markdown(records: Sequence[Record]) -> str:
    """Return the whole table as Markdown, with its notes."""
    rows = summarise(records)
    numbers = [title for title in HEAD if title not in ("scene", "system")]
    lines = markdown_table(HEAD, [cells(row) for row in rows], numbers)
    return f"{lines}\n\n" + "".join(f"- {note}\n" for note in notes(records, rows))


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], right: Collection[str] = ()) -> str:
    """Return a Markdown table without a line break at its end; `right` names the right-aligned columns."""
    rules = ["---:" if title in right else "---" for title in head]
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, rules, *rows))


def group_key(record: Record, differing: Collection[str] = ("seed",)) -> str:
    """Return what runs have in common that differ in these options only."""
    config = {key: value for key, value in record["config"].items() if key not in differing}
    return json.dumps([record["scene"], record["system"], config], sort_keys=True)


def _row(group: Sequence[Record], measured: Sequence[str]) -> Record:
    """Return the row of runs that differ only in the seed."""
    first = group[0]
    row: Record = {
        "scene": scene_title(first),
        "cap": first["config"]["cap_max"],
        "iterations": first["config"]["iterations"],
        "system": first["system"],
        "config": {key: value for key, value in first["config"].items() if key != "seed"},
        "seeds": [record["config"]["seed"] for record in group],
        "failed": {str(record["config"]["seed"]): record["failed"] for record in group if record["failed"]},
        "finite": all(record["finite"] for record in group),
        "cap_held": all(record["cap_held"] for record in group),
    }
    done = [record for record in group if not record["failed"]]
    for key in measured:
        values = [record[key] for record in done if record.get(key) is not None]
        row[key] = (
            None if not values else {"mean": statistics.fmean(values), "half_spread": (max(values) - min(values)) / 2}
        )
    return row


def _differing(row: Record, rows: Sequence[Record]) -> str:
    """Return the options that distinguish a row from others of its scene, cap and system, as " [key=value, ...]".

    Runs of different lengths are one system, although some options are decided by the length.
    """
    keys = ("scene", "cap", "system")
    others = [other for other in rows if all(other[key] == row[key] for key in keys)]
    if len({other["iterations"] for other in others}) == len(others):
        return ""
    differing = [key for key, value in row["config"].items() if any(o["config"].get(key) != value for o in others)]
    differing = [key for key in differing if key != "iterations"]  # iterations have a column
    options = ", ".join(f"{key}={row['config'][key]}" for key in differing)
    return f" [{options}]" if options else ""

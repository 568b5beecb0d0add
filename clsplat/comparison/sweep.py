"""A sweep of methods, caps, lengths and seeds, and its charts: quality against time, render time, bytes and splats."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..evaluation import chart_style
from ..files.html_page import Section, write_page
from ..files.lock import folder_lock
from ..scenes.scene import Scene
from ..training.log import Progress
from .charts import arithmetic_chart, seeds_chart
from .compare import compare
from .length_rows import equal_time_rows, length_rows, with_shared_seeds
from .methods import Method
from .runs import RUNS, Run, distinct, read_runs, refuse_foreign
from .scene_identity import titled
from .sweep_charts import equal_chart, length_chart, size_chart, time_chart
from .sweep_rows import (
    ChartRow,
    arithmetic_rows,
    curve_rows,
    equal_rows,
    point_rows,
    seed_rows,
    write_rows,
)
from .sweep_tables import NONE, TextTable, arithmetic_table, equal_table, equal_time_table, seed_table
from .table import HEAD, Record, cells, different_seeds, notes, summarise

CHARTS, REPORT = "charts", "report.html"
CURVE = 12  # points along a run

_TEXT = {
    "length": (
        "Quality against the time of a whole run",
        "Each point is a run of another length, or the mean over its seeds: test PSNR and SSIM against seconds of "
        "training. Grey: the Pareto front of PSNR. The table has the lead in PSNR [dB] over the reference in as many "
        "seconds, linear in log seconds between runs; empty: the system has only shorter or only longer runs.",
    ),
    "time": (
        "Quality along the training",
        "Test PSNR and SSIM against seconds of training, without the time of these measurements. Each point was "
        "measured. The axes begin 5 dB and 0.3 below the best.",
    ),
    "size": (
        "Quality against render time, bytes and splats",
        "Each point is a training run, or the mean over its seeds. All have the most frequent length, or the longest "
        "if several are as frequent. Grey: the Pareto front; no point is both better and cheaper than a point of the "
        "front. Its points are labelled by the cap on splats. Render time is the median over the test views of the "
        "fastest of five renders, on the host's clock; the protocol names the exceptions.",
    ),
    "equal": (
        "Splats needed at equal quality",
        "The number of splats that a system needs for the PSNR of the reference at each of its caps, linear in log "
        "splats between runs. Hollow, or ≤: its smallest model is better already. Dashed: 70 %.",
    ),
    "seeds": (
        "The effect of chance",
        "Test PSNR of runs that differ only in the seed, and their median. Diamonds: one seed trained again; = : the "
        "same splats, bit by bit. Spread: maximum less minimum.",
    ),
    "arithmetic": (
        "Arithmetic",
        "What forms of exp and Φ, half-precision colour, cutoffs, tiles and lanes cost and gain on trained "
        "scenes: errors against the double build with the same rule, of cutoffs against one without, beside "
        "the time relative to the default's; geometric means over the scenes. Where there is no room for a "
        "name, see the table. Normalisations are other models: their line is the PSNR that training with "
        "them ends at, against the default's.",
    ),
}


def sweep(
    scenes: Iterable[Scene],
    methods: Sequence[Method],
    output: str | Path,
    caps: Sequence[int],
    seeds: Sequence[int],
    common: Mapping[str, Any] | None = None,
    *,
    lengths: Sequence[int] = (),
    curve: int = CURVE,
    repeat: int = 1,
    more: Sequence[Record] = (),
    extra: Mapping[str, Any] | None = None,
    cluster: str | None = None,
    progress: Callable[[Progress], None] | None = None,
    on_run: Callable[[Run, Record | None], None] | None = None,
) -> list[Record]:
    """Train the missing runs, as `compare` does, and draw the charts of all runs in `output`.

    Parameters
    ----------
    scenes, methods, output, caps, seeds, common, lengths, curve, repeat, extra, cluster, progress, on_run : as of
        `compare`.
    more : records of other comparisons, which are drawn too; see `read_runs`.

    Returns
    -------
    All runs in `output`. The charts and report.html are also written after Ctrl-C. Without matplotlib only the data of
    the charts are written, and a warning says so before the first run.

    Raises
    ------
    As `compare`.
    """
    if not chart_style.available():
        warnings.warn(f"{chart_style.MISSING}; only the data of the charts are written", stacklevel=2)
    refuse_foreign(Path(output), (REPORT, CHARTS))
    try:
        return compare(
            scenes,
            methods,
            output,
            caps,
            seeds,
            common,
            lengths=lengths,
            curve=curve,
            repeat=repeat,
            extra=extra,
            cluster=cluster,
            progress=progress,
            on_run=on_run,
        )
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the comparison has read the file before, and has shown them
            records = [*read_runs(output), *more] if (Path(output) / RUNS).exists() else []
        if records:
            with folder_lock(Path(output)):
                write_report(output, records, reference=methods[0].label)


def write_report(
    folder: str | Path, records: Sequence[Record], *, reference: str | None = None, arithmetic: Sequence[ChartRow] = ()
) -> list[Path]:
    """Draw the charts of records, and write their data as CSV and JSON and the page that shows them.

    Parameters
    ----------
    records : of `compare` or `read_runs`; the first of equal runs counts.
    reference : system that the others are compared with, at equal PSNR and at equal seconds; None: the first one with
        a cap.
    arithmetic : records for `sweep_rows.arithmetic_rows`.

    Returns
    -------
    The files of the charts and the page. Without matplotlib the page explains why the charts are missing.

    Raises
    ------
    InputError : no records. OutputError : cannot be written.
    """
    if not records:
        raise InputError(f"{folder}: no runs to draw")
    folder, kept = Path(folder), titled(distinct(records))
    points, lengths, seeds = point_rows(kept), length_rows(kept), seed_rows(kept)
    first = reference or next((point["system"] for point in points), "")
    equal, forms = equal_rows(points, first), arithmetic_rows(arithmetic)
    parts: list[tuple[str, Sequence[ChartRow], Callable[[Any, Path], list[Path]], TextTable]] = [
        ("length", lengths, length_chart, equal_time_table(equal_time_rows(lengths, first), first)),
        ("size", points, size_chart, NONE),
        ("equal", equal, lambda rows, out: equal_chart(rows, first, out), equal_table(equal, first)),
        ("time", curve_rows(kept), time_chart, NONE),
        ("seeds", seeds, seeds_chart, seed_table(seeds)),
        ("arithmetic", forms, arithmetic_chart, arithmetic_table(forms)),
    ]
    seeds_of = {
        "length": _seed_notes(with_shared_seeds(kept), lengths),
        **dict.fromkeys(("size", "equal"), _seed_notes(kept, points)),
    }
    written: list[Path] = []
    sections = [_protocol(kept)]
    for name, rows, draw, (head, lines) in parts:
        if rows:
            files = write_rows(folder / CHARTS, name, rows)
            title, *text = *_TEXT[name], *seeds_of.get(name, [])
            drawn = []
            if name == "equal" and all(row["ratio"] is None for row in rows):
                text.append(f"No chart: no other system reaches the PSNR of {first}.")
            elif chart_style.available():
                drawn = draw(rows, folder / CHARTS / name)
            else:
                text.append(f"No chart: {chart_style.MISSING}.")
            names = [f"{CHARTS}/{path.name}" for path in (*files, *drawn)]
            sections.append(Section(title, text, drawn[-1] if drawn else None, head, lines, names))
            written += [*files, *drawn]
    sections.append(Section("All runs", head=HEAD, lines=[cells(row) for row in summarise(kept)], files=[RUNS]))
    scenes = dict.fromkeys(record["scene"]["name"] for record in kept)
    return [*written, write_page(folder / REPORT, f"Quality and cost: {', '.join(scenes)}", sections)]


def _seed_notes(records: Sequence[Record], points: Sequence[ChartRow]) -> list[str]:
    """Return the sentences on points of a chart that are means over different seeds of these records."""
    keys = ("scene", "system", "cap", "iterations")
    drawn = {tuple(point[key] for key in keys) for point in points}
    rows = [row for row in summarise(records) if tuple(row[key] for key in keys) in drawn]
    return [_sentence(text) for text in different_seeds(rows)]


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _protocol(records: Sequence[Record]) -> Section:
    """Return the section on the runs, the device and the measurements."""
    iterations = sorted({record["config"]["iterations"] for record in records})
    sentences = [
        f"{len(records)} training runs of {', '.join(map(str, iterations))} iterations, measured on test views, "
        "from which nothing is chosen",
        *notes(records, summarise(records)),
    ]
    return Section("Protocol", [_sentence(line) for line in sentences])

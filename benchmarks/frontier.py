"""Quality against time, bytes and splats on the real scenes, and the effect of seeds: the charts of the README.

    python benchmarks/frontier.py [--scenes fox kitchen lego] [--groups lengths caps table seeds] [--device 0:0]
    python benchmarks/frontier.py --charts      # draw finished runs: results/frontier/report.html and charts/
    python benchmarks/frontier.py --table       # print them
    python benchmarks/frontier.py --smoke --scenes NAME --out DIR

Every run is a line of results/frontier/runs.jsonl (see `clsplat compare`) and is made once: kill and restart at will.
The charts also show results/arithmetic.jsonl, if it exists. Fox is read at half size, for seeds at a quarter, to save
time. Transparent scenes have a white background.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import common

from clsplat.comparison.compare import compare
from clsplat.comparison.length_rows import equal_time_rows, length_rows
from clsplat.comparison.methods import DEFAULT, parse_methods
from clsplat.comparison.runs import distinct, read_runs
from clsplat.comparison.sweep import write_report
from clsplat.comparison.sweep_rows import ChartRow, equal_rows, point_rows, seed_rows
from clsplat.comparison.sweep_tables import TextTable, equal_table, equal_time_table, seed_table
from clsplat.comparison.table import HEAD, Record, cells, notes, repeats, summarise
from clsplat.evaluation.floaters import evenly
from clsplat.scenes.scene import Scene
from clsplat.splats.shapes import SHAPES
from clsplat.training.presets import PRESETS

TEST_VIEWS = 25  # of a scene: 200 take longer than the run that they measure
LEAD_LENGTH = 1000  # iterations of the runs whose caps are compared
LEAD_FROM = 500  # shortest run of a system whose seconds the default gets
OUT = common.RESULTS / "frontier"
REFERENCE = "3dgs"
SYSTEMS = (REFERENCE, DEFAULT, "skew-normal", *(name for name in PRESETS if name != REFERENCE))


class Group(NamedTuple):
    """Runs that one chart needs."""

    methods: tuple[str, ...]
    caps: tuple[int, ...]
    lengths: tuple[int, ...] = (1000,)  # iterations
    seeds: int = 1
    repeat: int = 1
    scenes: dict[str, int] | None = None  # with their resolution; None: those of --scenes


GROUPS = {
    "lengths": Group(SYSTEMS, (20_000,), (250, 500, 1000, 2000), seeds=3),
    "caps": Group(SYSTEMS, (1000, 5000, 20_000, 50_000), seeds=3),
    "table": Group(SYSTEMS, (5000, 20_000), seeds=3, scenes={"fox": 2, "kitchen": -1}),
    "seeds": Group(tuple(SHAPES), (1000,), (300,), seeds=5, repeat=3, scenes={"fox": 4}),
}
SMOKE = {
    "lengths": Group(SYSTEMS[:2], (60,), (2, 4)),
    "caps": Group(SYSTEMS[:2], (30, 60), (4,)),
    "table": Group(SYSTEMS[:1], (30,), (4,), seeds=2),
    "seeds": Group(SYSTEMS[:1], (30,), (3,), seeds=3, repeat=2),
}


def main() -> None:
    parser = common.parser(__doc__, OUT)
    parser.add_argument("--scenes", nargs="+", default=["fox", "kitchen", "lego"])
    parser.add_argument("--groups", nargs="+", choices=tuple(GROUPS), default=list(GROUPS))
    parser.add_argument("--charts", action="store_true", help="draw the finished runs, train nothing")
    args = parser.parse_args()
    if not args.table and not args.charts:
        for name in args.groups:
            train_group((SMOKE if args.smoke else GROUPS)[name], args)
    records = read_runs(args.out)
    if not args.table:
        write_report(
            args.out,
            records,
            reference=REFERENCE,
            arithmetic=common.read(args.out.parent / "arithmetic.jsonl"),
        )
    print_tables(distinct(records))


def train_group(group: Group, args: argparse.Namespace) -> None:
    """Train the missing runs of one group."""
    for name, resolution in (group.scenes or dict.fromkeys(args.scenes)).items():
        background = common.background_of(name)
        compare(
            [with_few_test_views(common.real_scene(name, resolution, background=background))],
            parse_methods(",".join(group.methods)),
            args.out,
            group.caps,
            range(group.seeds),
            {"background": background, "device": args.device},
            lengths=group.lengths,
            repeat=group.repeat,
            extra={"commit": common.commit()},
            on_run=common.print_run,
        )


def with_few_test_views(scene: Scene) -> Scene:
    """Return the scene with at most TEST_VIEWS of its test views, at equal steps."""
    chosen = evenly(scene.test, TEST_VIEWS)
    return replace(scene, views=sorted([*scene.train, *chosen], key=lambda view: view.name))


def lead_table(rows: Sequence[Record], lengths: Sequence[ChartRow]) -> TextTable:
    """Return the lead of the default over each system at equal splats and at equal seconds [dB].

    Means and smallest leads are over the scenes, and over the caps or the lengths. In equal seconds the default has
    those that a run of the other system takes.

    Parameters
    ----------
    rows : of `summarise`. lengths : of `length_rows`.
    """
    of_cap = {
        (row["system"], row["scene"], row["cap"]): row["psnr"]["mean"]
        for row in rows
        if row["iterations"] == LEAD_LENGTH and row["psnr"]
    }
    lines = []
    for system in (name for name in SYSTEMS if name != DEFAULT):
        splats = [
            (of_cap[DEFAULT, scene, cap] - psnr, f"{scene}, {cap}")
            for (name, scene, cap), psnr in of_cap.items()
            if name == system and (DEFAULT, scene, cap) in of_cap
        ]
        seconds = [
            (row["lead"], f"{row['scene']}, {row['reference_iterations']}")
            for row in equal_time_rows(lengths, system)
            if row["system"] == DEFAULT and row["lead"] is not None and row["reference_iterations"] >= LEAD_FROM
        ]
        if splats and seconds:
            lines.append((system, *mean_and_smallest(splats), *mean_and_smallest(seconds)))
    return ("system", "equal splats", "smallest", "where", "equal seconds", "smallest", "where"), lines


def mean_and_smallest(leads: Sequence[tuple[float, str]]) -> tuple[str, str, str]:
    """Return the mean of leads, the smallest one, and where that is."""
    smallest, where = min(leads)
    return f"{math.fsum(lead for lead, _ in leads) / len(leads):+.2f}", f"{smallest:+.2f}", where


def print_tables(records: Sequence[Record]) -> None:
    """Print all runs, leads in equal time, splats at equal quality, and seeds."""
    rows, points, lengths = summarise(records), point_rows(records), length_rows(records)
    leads = equal_time_rows(lengths, REFERENCE)
    tables: list[tuple[str, TextTable]] = [
        ("", (HEAD, [cells(row) for row in rows])),
        (f"mean lead of {DEFAULT} over each system [dB]", lead_table(rows, lengths)),
        (f"lead over {REFERENCE} in equal time [dB]", equal_time_table(leads, REFERENCE)),
        (f"splats for the PSNR of {REFERENCE}", equal_table(equal_rows(points, REFERENCE), REFERENCE)),
        ("seeds", seed_table(seed_rows(records))),
    ]
    for title, (head, lines) in tables:
        if lines:
            print(f"\n{title}\n" if title else "")
            print(common.table(head, lines))
    print()
    for note in notes(records, rows):
        print(f"- {note}")
    assert all(row["same"] for row in repeats(records)), "one seed gave different splats"


if __name__ == "__main__":
    main()

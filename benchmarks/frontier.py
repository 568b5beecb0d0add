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
from typing import NamedTuple

import common

from clsplat.comparison.compare import compare
from clsplat.comparison.length_rows import equal_time_rows, length_rows
from clsplat.comparison.methods import DEFAULT, parse_methods
from clsplat.comparison.runs import distinct, read_runs
from clsplat.comparison.sweep import write_report
from clsplat.comparison.sweep_rows import equal_rows, point_rows, seed_rows
from clsplat.comparison.sweep_tables import TextTable, equal_table, equal_time_table, seed_table
from clsplat.comparison.table import HEAD, Record, cells, notes, repeats, summarise
from clsplat.splats.shapes import SHAPES
from clsplat.training.presets import PRESETS

LEAD_LENGTH = 1000  # iterations of the runs whose caps are compared
LEAD_FROM = 500  # shortest run of a system whose seconds the default gets
OUT = common.RESULTS / "frontier"
REFERENCE = "3dgs"
SYSTEMS = (REFERENCE, "gaussian", DEFAULT, *(name for name in PRESETS if name != REFERENCE))


class Group(NamedTuple):
    """Runs that one chart needs."""

    methods: tuple[str, ...]
    caps: tuple[int, ...]
    lengths: tuple[int, ...] = (1000,)  # iterations
    seeds: int = 1
    repeat: int = 1
    scenes: dict[str, int] | None = None  # with their resolution; None: those of --scenes


GROUPS = {
    "lengths": Group(SYSTEMS, (20_000,), (250, 500, 1000, 2000)),
    "caps": Group(SYSTEMS, (1000, 5000, 20_000, 50_000)),
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
            [common.real_scene(name, resolution, background=background)],
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


def lead_table(records: Sequence[Record]) -> TextTable:
    """Return the lead of the default over each system at equal splats and at equal seconds [dB].

    Means and smallest leads are over the scenes, and over the caps or the lengths. In equal seconds the default has
    those that a run of the other system takes.
    """
    splats: dict[str, list[tuple[float, str]]] = {}
    rows = [row for row in summarise(records) if row["iterations"] == LEAD_LENGTH and row["psnr"]]
    of_default = {(row["scene"], row["cap"]): row["psnr"]["mean"] for row in rows if row["system"] == DEFAULT}
    for row in rows:
        place = (row["scene"], row["cap"])
        if row["system"] in SYSTEMS and row["system"] != DEFAULT and place in of_default:
            lead = of_default[place] - row["psnr"]["mean"]
            splats.setdefault(row["system"], []).append((lead, f"{row['scene']}, {row['cap']}"))
    seconds: dict[str, list[tuple[float, str]]] = {}
    for system in splats:
        points = [point for point in length_rows(records) if point["system"] in (DEFAULT, system)]
        for row in equal_time_rows(points, system):
            if row["lead"] is not None and row["reference_iterations"] >= LEAD_FROM:
                where = f"{row['scene']}, {row['reference_iterations']}"
                seconds.setdefault(system, []).append((row["lead"], where))
    head = ("system", "equal splats", "smallest", "where", "equal seconds", "smallest", "where")
    lines = []
    for system in splats:
        cells_ = [system]
        for leads in (splats[system], seconds.get(system, [])):
            worst = min(leads, default=(math.nan, ""))
            mean = math.fsum(lead for lead, _ in leads) / len(leads) if leads else math.nan
            cells_ += [f"{mean:+.2f}", f"{worst[0]:+.2f}", worst[1]]
        lines.append(tuple(cells_))
    return head, lines


def print_tables(records: Sequence[Record]) -> None:
    """Print all runs, leads in equal time, splats at equal quality, and seeds."""
    rows, points = summarise(records), point_rows(records)
    leads = equal_time_rows(length_rows(records), REFERENCE)
    tables: list[tuple[str, TextTable]] = [
        ("", (HEAD, [cells(row) for row in rows])),
        (f"mean lead of {DEFAULT} over each system [dB]", lead_table(records)),
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

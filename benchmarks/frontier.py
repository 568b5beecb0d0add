"""Quality against time, bytes and splats on the real scenes, and what seeds do: the charts of the README.

    python benchmarks/frontier.py [--scenes fox kitchen sceaux_castle] [--groups presets caps seeds] [--device 0:0]
    python benchmarks/frontier.py --charts      # draw what is there: results/frontier/report.html and charts/
    python benchmarks/frontier.py --table       # print it
    python benchmarks/frontier.py --smoke --scenes NAME --out DIR

Every run is a line of results/frontier/runs.jsonl (see `clsplat compare`) and is made once: kill and restart at will.
The charts also show the runs of results/budget (`--budget auto`, benchmarks/budget.py) and results/arithmetic.jsonl,
where they are there. Fox is read at half size, for seeds at a quarter: what the seconds allow.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import common

from clsplat.comparison.compare import Run, compare
from clsplat.comparison.methods import parse_methods
from clsplat.comparison.sweep import distinct, read_runs, write_report
from clsplat.comparison.sweep_rows import auto_rows, equal_rows, point_rows, seed_rows
from clsplat.comparison.sweep_tables import TextTable, auto_table, equal_table, seed_table
from clsplat.comparison.table import HEAD, Record, cells, notes, repeats, summarise
from clsplat.scenes.scene import load_scene
from clsplat.splats.shapes import SHAPES
from clsplat.training.presets import PRESETS

OUT = common.RESULTS / "frontier"
RESOLUTION = {"fox": 2}  # of load_scene; others as they are
REFERENCE = "gaussian"
KERNELS = (REFERENCE, "skew-normal", "generalised-exponential")


class Group(NamedTuple):
    """Runs that one chart needs."""

    systems: tuple[str, ...]
    caps: tuple[int, ...]
    iterations: int = 1000
    seeds: int = 1
    repeat: int = 1
    curve: int = 0
    scenes: dict[str, int] | None = None  # and their resolution; None: those asked for


# `presets` before `caps`: the runs that both want are then made once, with their curves.
GROUPS = {
    "presets": Group((*KERNELS, *PRESETS), (5000,), curve=12),
    "caps": Group(KERNELS, (500, 1000, 2500, 5000, 10_000, 20_000, 50_000)),
    "seeds": Group(tuple(SHAPES), (1000,), 300, seeds=5, repeat=3, scenes={"fox": 4}),
}
SMOKE = {
    "presets": Group(KERNELS[:2], (60,), 4, curve=2),
    "caps": Group(KERNELS[:2], (30, 60), 4),
    "seeds": Group(KERNELS[:1], (30,), 3, seeds=3, repeat=2),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["fox", "kitchen", "sceaux_castle"])
    parser.add_argument("--groups", nargs="+", choices=tuple(GROUPS), default=list(GROUPS))
    parser.add_argument("--device")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--charts", action="store_true")
    parser.add_argument("--smoke", action="store_true")
    args = parser.parse_args()
    if not args.table and not args.charts:
        for name in args.groups:
            run((SMOKE if args.smoke else GROUPS)[name], args)
    records = read_runs(args.out)
    # Automatic runs belong to the sweep that they were made beside.
    more = [record for path in sorted((args.out.parent / "budget").rglob("*.jsonl")) for record in read_runs(path)]
    if not args.table:
        write_report(
            args.out,
            [*records, *more],
            reference=REFERENCE,
            arithmetic=common.read(args.out.parent / "arithmetic.jsonl"),
        )
    print_tables(distinct([*records, *more]))


def run(group: Group, args: argparse.Namespace) -> None:
    """The runs of one group that are not there yet."""
    sizes = group.scenes or {name: RESOLUTION.get(name, -1) for name in args.scenes}
    scenes = (load_scene(common.data_folder() / name, resolution=size, eval=True) for name, size in sizes.items())
    compare(
        scenes,
        parse_methods(",".join(group.systems)),
        args.out,
        group.caps,
        range(group.seeds),
        {"iterations": group.iterations, "device": args.device},
        curve=group.curve,
        repeat=group.repeat,
        extra={"commit": common.commit()},
        on_run=say,
    )


def print_tables(records: Sequence[Record]) -> None:
    """All runs, splats at equal quality, automatic runs, seeds."""
    rows, points = summarise(records), point_rows(records)
    tables: list[tuple[str, TextTable]] = [
        ("", (HEAD, [cells(row) for row in rows])),
        (f"splats for the PSNR of {REFERENCE}", equal_table(equal_rows(points, REFERENCE), REFERENCE)),
        ("automatic runs", auto_table(auto_rows(points))),
        ("seeds", seed_table(seed_rows(records))),
    ]
    for title, (head, lines) in tables:
        if lines:
            print(f"\n{title}\n" if title else "")
            print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
            print("\n".join("| " + " | ".join(line) + " |" for line in lines))
    print()
    for note in notes(records, rows):
        print(f"- {note}")
    assert all(row["same"] for row in repeats(records)), "one seed, other splats"


def say(run: Run, record: Record | None) -> None:
    """Progress, a line a run."""
    if record is not None:
        result = record["failed"] or f"{record['psnr']:.2f} dB, {record['splats']} splats, {record['seconds']:.1f} s"
        print(f"{run}: {result}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()

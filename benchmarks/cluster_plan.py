"""Clusters that nobody here has: a simulation of thousands of jobs on thousands of workers that fail and straggle.

    python benchmarks/cluster_plan.py               # measure what a job costs Dask, check the model, simulate the sizes
    python benchmarks/cluster_plan.py --page        # write the tables of docs/sizes.md
    python benchmarks/cluster_plan.py --smoke

A job has work in seconds on a worker of speed 1, and reads its photos first. Workers take the next job as soon as they
are free. A worker fails after a random time (exponential), and comes back later. Its job goes on elsewhere from its
last checkpoint. Some workers are slow. Photos come from one server, whose bandwidth the readers share. The model is
compared with the sweeps that benchmarks/cluster.py has measured, before it is used for anything larger.
"""

from __future__ import annotations

import heapq
import math
import random
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from common import RESULTS, ROOT, Runs, parser, table, write_between

PAGE = ROOT / "docs" / "sizes.md"
CHECK_MARKS = ("<!-- check of cluster_plan.py -->", "<!-- end of the check of cluster_plan.py -->")
MARKS = ("<!-- table of cluster_plan.py -->", "<!-- end of the table of cluster_plan.py -->")
KEY = ("case", "name", "workers", "seed")
HOUR = 3600.0


@dataclass(frozen=True)
class Machines:
    """The workers of a cluster.

    Attributes
    ----------
    count : number of workers.
    failure : mean time between two failures of a worker [s]; infinite: never.
    back : time until a worker is there again [s].
    start : time of a job before its first iteration: photos are decoded and checked, kernels are built [s].
    slow : part of the workers that are slow, and their speed.
    server, link : bandwidths of the photos' server and of a worker [bytes/s].
    """

    count: int
    failure: float = math.inf
    back: float = 120.0
    start: float = 5.0
    slow: tuple[float, float] = (0.05, 0.4)
    server: float = 1.25e9
    link: float = 1.25e8


@dataclass(frozen=True)
class Work:
    """A job: its seconds on a worker of speed 1, and the bytes of its photos."""

    seconds: float
    nbytes: float = 0.0


@dataclass
class Outcome:
    """What a simulation found: seconds until the last job is done, restarts, lost work [s], bytes read."""

    makespan: float = 0.0
    restarts: int = 0
    lost: float = 0.0
    read: float = 0.0


def simulate(
    jobs: Sequence[Work],
    machines: Machines,
    checkpoint: float,
    seed: int,
    dispatch: float = 0.0,
    longest_first: bool = True,
) -> Outcome:
    """Simulate the jobs.

    Parameters
    ----------
    checkpoint : seconds of work between two checkpoints.
    dispatch : seconds of the scheduler for a job; it starts one job after the other.
    longest_first : whether long jobs are started first; else the order is that of the list.
    """
    chance, found = random.Random(seed), Outcome()
    speeds = [machines.slow[1] if chance.random() < machines.slow[0] else 1.0 for _ in range(machines.count)]
    order = sorted(range(len(jobs)), key=lambda job: -jobs[job].seconds) if longest_first else range(len(jobs))
    left = {job: jobs[job].seconds for job in order}
    waiting, scheduler_free, readers = list(order)[::-1], 0.0, 0
    # Events: time, number, kind, worker, job. A worker becomes free, has read its photos, ends its job, or fails.
    events: list[tuple[float, int, str, int, int]]
    events = [(0.0, worker, "free", worker, -1) for worker in range(machines.count)]  # sorted, so it is a heap
    number, idle = machines.count, set()

    def push(when: float, kind: str, worker: int, job: int) -> None:
        nonlocal number
        number += 1
        heapq.heappush(events, (when, number, kind, worker, job))

    while left:
        now, _, kind, worker, job = heapq.heappop(events)
        if kind == "free":
            idle.add(worker)
        elif kind == "read":
            readers -= 1
            ends, fails = now + machines.start + left[job] / speeds[worker], now + _until_failure(chance, machines)
            push(*((ends, "done") if ends <= fails else (fails, "fail")), worker, job)
            if fails < ends:
                done = max(fails - now - machines.start, 0.0) * speeds[worker]
                kept = 0.0 if math.isinf(checkpoint) else checkpoint * math.floor(done / checkpoint)
                left[job] -= kept
                found.lost += done - kept
        elif kind == "done":
            del left[job]
            found.makespan = now
            idle.add(worker)
        else:
            found.restarts += 1
            waiting.append(job)  # it is first in line
            push(now + machines.back, "free", worker, -1)
        while waiting and idle:
            worker, job = idle.pop(), waiting.pop()
            scheduler_free = max(scheduler_free, now) + dispatch
            readers += 1
            rate = min(machines.link, machines.server / readers)
            found.read += jobs[job].nbytes
            push(scheduler_free + jobs[job].nbytes / rate, "read", worker, job)
    return found


def _until_failure(chance: random.Random, machines: Machines) -> float:
    return math.inf if math.isinf(machines.failure) else chance.expovariate(1.0 / machines.failure)


def efficiency(jobs: Sequence[Work], machines: Machines, found: Outcome) -> float:
    """Return the work of all jobs over the time of all workers."""
    return sum(job.seconds for job in jobs) / (found.makespan * machines.count)


@dataclass(frozen=True)
class Size:
    """A scene of some size, by its photos.

    Attributes
    ----------
    photos : number of photos. megabytes : of the file of one.
    splats_per_photo : splats of the model over photos.
    shown : blocks that a photo belongs to, on average.
    """

    name: str
    photos: int
    workers: tuple[int, ...]
    megabytes: float = 1.5
    splats_per_photo: int = 5000
    shown: float = 3.0

    BLOCK = 200_000  # splats, as `--blocks auto`
    ITERATIONS = 7000  # of a block, as `--quality normal`

    @property
    def splats(self) -> int:
        return self.photos * self.splats_per_photo

    @property
    def blocks(self) -> int:
        return -(-self.splats // self.BLOCK)

    def jobs(self, seconds: float, seed: int = 0) -> list[Work]:
        """Return the blocks. seconds : of an iteration. Blocks differ by a third of their mean (log-normal)."""
        chance = random.Random(seed)
        spread = 1 / 3
        scales = [math.exp(chance.gauss(-spread * spread / 2, spread)) for _ in range(self.blocks)]
        nbytes = 1e6 * self.megabytes * self.photos * self.shown / self.blocks
        return [Work(scale * self.ITERATIONS * seconds, scale * nbytes) for scale in scales]


SIZES = (
    Size("house", 200, (1,)),
    Size("street", 2_000, (1, 8)),
    Size("campus", 20_000, (8, 64)),
    Size("town", 200_000, (64, 512)),
    Size("city", 2_000_000, (512, 4096)),
)
ITERATION = 0.010  # seconds of an iteration of a block on a GPU: 200 000 splats and a photo of 2 million pixels
FAILURE = 24 * HOUR  # of a worker, as machines that are lent cheaply
CHECKPOINT = 1000 * ITERATION  # seconds of work


def dask_overhead(jobs: int) -> float:
    """Return the seconds that Dask takes for an empty job, with two processes."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=2, threads_per_worker=1, resources={"clsplat": 1}, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        client.gather([client.submit(int, number, resources={"clsplat": 1}, pure=False) for number in range(4)])
        start = time.perf_counter()
        client.gather([client.submit(int, number, resources={"clsplat": 1}, pure=False) for number in range(jobs)])
        return (time.perf_counter() - start) / jobs


def check(runs: Runs) -> None:
    """Compare the model with the measured sweeps of benchmarks/cluster.py."""
    measured = Runs(RESULTS / "cluster.jsonl", ("case", "runs", "workers")).rows
    alone = next(row for row in measured if row["case"] == "sweep" and row["workers"] == 1)
    n, job = alone["runs"], alone["seconds"] / alone["runs"]
    for measurement in measured:
        kills, workers, seconds = measurement.get("kills", 0), measurement["workers"], measurement["seconds"]
        row: dict[str, Any] = {"case": "check", "name": f"{n} runs" + (f", {kills} kills" if kills else "")}
        row |= {"workers": workers, "seed": 0}
        if row in runs:
            continue
        # A job there is a whole run. A worker that was killed is back after the imports.
        failure = seconds * workers / kills if kills else math.inf
        machines = Machines(workers, failure=failure, back=3.0, start=0.0, slow=(0.0, 1.0))
        outcomes = [simulate([Work(job)] * n, machines, math.inf, seed) for seed in range(200)]
        found = [outcome.makespan for outcome in outcomes]
        row |= {"measured": round(seconds, 1), "simulated": round(statistics.fmean(found), 1)}
        runs.add(row | {"spread": round(statistics.pstdev(found), 1)})


def sizes(runs: Runs, dispatch: float, seeds: int) -> None:
    """Simulate the blocks of scenes of all sizes."""
    for size in SIZES:
        jobs = size.jobs(ITERATION)
        for count in size.workers:
            machines = Machines(count, failure=FAILURE)
            row: dict[str, Any] = {"case": "blocks", "name": size.name, "workers": count, "seed": 0}
            if row in runs:
                continue
            variants = {
                "": [simulate(jobs, machines, CHECKPOINT, seed, dispatch) for seed in range(seeds)],
                "_in_order": [simulate(jobs, machines, CHECKPOINT, seed, dispatch, False) for seed in range(seeds)],
                "_no_checkpoint": [simulate(jobs, machines, math.inf, seed, dispatch) for seed in range(seeds)],
                "_equal_speed": [
                    simulate(jobs, replace(machines, slow=(0.0, 1.0)), CHECKPOINT, seed, dispatch)
                    for seed in range(seeds)
                ],
            }
            hours = {
                f"hours{name}": statistics.fmean(outcome.makespan for outcome in found) / HOUR
                for name, found in variants.items()
            }
            found = variants[""]
            runs.add(
                row
                | {"photos": size.photos, "splats": size.splats, "blocks": size.blocks, "dispatch_ms": 1e3 * dispatch}
                | hours
                | {
                    "efficiency": statistics.fmean(efficiency(jobs, machines, outcome) for outcome in found),
                    "restarts": statistics.fmean(outcome.restarts for outcome in found),
                    "lost_hours": statistics.fmean(outcome.lost for outcome in found) / HOUR,
                    "read_gigabytes": statistics.fmean(outcome.read for outcome in found) / 1e9,
                }
            )


def check_page(rows: list[dict[str, Any]]) -> str:
    lines = [
        (row["name"], row["workers"], row["measured"], f"{row['simulated']} ± {row['spread']}")
        for row in rows
        if row["case"] == "check"
    ]
    head = ("sweep", "workers", "measured [s]", "simulated [s]")
    return table(head, lines, right=head[1:])


def page(rows: list[dict[str, Any]]) -> str:
    lines = [
        (
            row["name"],
            f"{row['photos']:,}".replace(",", " "),
            f"{row['splats'] / 1e6:g}",
            row["blocks"],
            row["workers"],
            _time(row["hours"]),
            f"{row['efficiency']:.0%}",
            f"{row['restarts']:.1f}",
            f"{row['read_gigabytes']:.0f}",
            *(_time(row[f"hours_{name}"]) for name in ("in_order", "no_checkpoint", "equal_speed")),
        )
        for row in rows
        if row["case"] == "blocks"
    ]
    head = ("scene", "photos", "million splats", "blocks", "workers", "all blocks", "busy", "restarts", "read [GB]")
    head += ("shuffled", "no checkpoints", "no slow workers")
    return table(head, lines, right=head[1:])


def _time(hours: float) -> str:
    return f"{60 * hours:.1f} min" if hours < 1 else f"{hours:.1f} h"


def main() -> None:
    flags = parser(__doc__, RESULTS / "cluster_plan.jsonl", device=False, page=PAGE)
    flags.add_argument("--seeds", type=int, default=20, help="simulations of a case")
    args = flags.parse_args()
    runs = Runs(args.out, KEY)
    if args.page:
        write_between(PAGE, *CHECK_MARKS, check_page(runs.rows))
        write_between(PAGE, *MARKS, page(runs.rows))
        return
    if not args.table:
        dispatch = dask_overhead(20 if args.smoke else 2000)
        check(runs)
        sizes(runs, dispatch, 1 if args.smoke else args.seeds)
    print(check_page(runs.rows))
    print(page(runs.rows))


if __name__ == "__main__":
    sys.exit(main())

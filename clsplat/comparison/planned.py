"""Runs that are not finished yet: done in this process one after the other, or by workers."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..cluster.job import Job
from ..cluster.pool import WorkerPool
from ..cluster.training import marked, unmark
from .runs import Run, RunFile
from .table import Record

OnRun = Callable[[Run, Record | None], None]


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """One run.

    Attributes
    ----------
    run : for displays. record : the start of its line in runs.jsonl.
    alone : does the run in this process, and returns the rest of its line.
    job : returns the job that has a worker do the same.
    scratch : folder of a worker's run that is not kept; None if its folder is kept.
    """

    run: Run
    record: Record
    alone: Callable[[], Record]
    job: Callable[[], Job]
    scratch: Path | None = None


def do_runs(
    plan: Iterable[PlannedRun],
    runs: RunFile,
    place: Path,
    cluster: str | None,
    on_run: OnRun | None,
    extra: Mapping[str, Any] | None = None,
) -> None:
    """Do runs and write their lines, each as soon as it is finished.

    Parameters
    ----------
    place : folder of the runs of workers.
    cluster : address of workers (`cluster.address`); None for this process, one run after the other.
    on_run : called with (run, None) before each run and (run, record) after it. extra : more keys of each record.

    Raises
    ------
    ClsplatError : with `cluster`: of the first run that no worker can do, once all others are finished.
    ClusterError : as `WorkerPool`. Others are those of the runs.
    """

    def tell(planned: PlannedRun, record: Record | None = None) -> None:
        if on_run is not None:
            on_run(planned.run, record)

    def remove_scratch(planned: PlannedRun) -> None:
        if planned.scratch is not None:
            shutil.rmtree(planned.scratch, ignore_errors=True)

    def add(planned: PlannedRun, measured: Record) -> None:
        record = planned.record | measured | dict(extra or {})
        runs.add(record)
        tell(planned, record)

    if cluster is None:
        for planned in plan:
            tell(planned)
            add(planned, planned.alone())
        return
    plan = list(plan)
    if not plan:
        return
    place, finished = marked(place), []
    try:
        with WorkerPool(cluster, plan[0].run.config.device) as pool:
            for number, measured in pool.successes([each.job() for each in plan], lambda at: tell(plan[at])):
                add(plan[number], measured)
                finished.append(plan[number])
                remove_scratch(plan[number])
    finally:
        for planned in finished:  # once more: a worker that the scheduler had lost may have written into it
            remove_scratch(planned)
        unmark(place)
        runs.arrange([planned.record for planned in plan])  # workers end in any order

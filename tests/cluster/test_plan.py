"""The simulation of clusters (benchmarks/cluster_plan.py): laws that any schedule obeys."""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def plan() -> ModuleType:
    sys.path.insert(0, str(BENCHMARKS))
    try:
        spec = importlib.util.spec_from_file_location("cluster_plan", BENCHMARKS / "cluster_plan.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules["cluster_plan"] = module
        spec.loader.exec_module(module)
        return module
    finally:
        sys.path.remove(str(BENCHMARKS))


def equal(plan: ModuleType, count: int, **options: float) -> object:
    """Workers of equal speed that need no time to start."""
    return plan.Machines(count, start=0.0, slow=(0.0, 1.0), **options)


def test_one_worker_needs_the_sum(plan: ModuleType) -> None:
    jobs = [plan.Work(seconds) for seconds in (3.0, 5.0, 7.0)]
    assert plan.simulate(jobs, equal(plan, 1), math.inf, 0).makespan == pytest.approx(15.0)


def test_long_jobs_first_end_earlier(plan: ModuleType) -> None:
    jobs = [plan.Work(seconds) for seconds in (1.0, 1.0, 1.0, 1.0, 4.0)]
    assert plan.simulate(jobs, equal(plan, 2), math.inf, 0).makespan == pytest.approx(4.0)
    assert plan.simulate(jobs, equal(plan, 2), math.inf, 0, longest_first=False).makespan == pytest.approx(6.0)


def test_the_scheduler_starts_one_job_after_the_other(plan: ModuleType) -> None:
    found = plan.simulate([plan.Work(1.0)] * 10, equal(plan, 10), math.inf, 0, dispatch=0.5)
    assert found.makespan == pytest.approx(10 * 0.5 + 1.0)


def test_readers_share_the_server(plan: ModuleType) -> None:
    machines = equal(plan, 10, server=100.0, link=50.0)
    one = plan.simulate([plan.Work(0.0, 500.0)], machines, math.inf, 0)
    assert (one.makespan, one.read) == (pytest.approx(10.0), 500.0)
    many = plan.simulate([plan.Work(0.0, 500.0)] * 10, machines, math.inf, 0)
    assert many.makespan == pytest.approx(50.0), "as long as the server needs for all of them"


@pytest.mark.parametrize("checkpoint", [math.inf, 5.0])
def test_failures_lose_at_most_the_work_since_a_checkpoint(plan: ModuleType, checkpoint: float) -> None:
    jobs = [plan.Work(20.0)] * 50
    found = plan.simulate(jobs, equal(plan, 5, failure=40.0, back=1.0), checkpoint, 3)
    assert found.restarts > 10
    assert found.lost <= found.restarts * min(checkpoint, 20.0)
    busy = sum(job.seconds for job in jobs) + found.lost
    assert found.makespan >= busy / 5
    assert found.makespan <= busy / 5 + found.restarts * 1.0 + 20.0


def test_the_same_seed_gives_the_same_schedule(plan: ModuleType) -> None:
    jobs = plan.Size("street", 2_000, (8,)).jobs(0.01)
    runs = [plan.simulate(jobs, plan.Machines(8, failure=600.0), 10.0, seed) for seed in (1, 1, 2)]
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]
    assert 0 < plan.efficiency(jobs, plan.Machines(8), runs[0]) < 1

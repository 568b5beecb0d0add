"""Jobs on two worker processes of this machine: results, errors, dead workers, and jobs that nobody waits for."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cluster_jobs
import pytest

from clsplat.activity import listening
from clsplat.cluster import pool as module
from clsplat.cluster.job import Job
from clsplat.cluster.pool import WorkerPool
from clsplat.errors import ClusterError, InputError

pytest.importorskip("distributed")
PATIENCE = 60.0  # seconds that a slow machine may need


@pytest.fixture(scope="module")
def pool() -> Iterator[WorkerPool]:
    """Two workers with one core each."""
    with WorkerPool("local:2" if len(os.sched_getaffinity(0)) > 1 else "local:1") as opened:
        yield opened


def results(pool: WorkerPool, *jobs: Job) -> list[Any]:
    """Return the results of jobs in their order."""
    found = dict(pool.results(jobs))
    assert sorted(found) == list(range(len(jobs)))
    return [found[number] for number in range(len(jobs))]


def test_each_job_is_done_once(pool: WorkerPool) -> None:
    begun: list[int] = []
    told: list[str] = []
    jobs = [Job(f"square {number}", cluster_jobs.squared, (number,)) for number in range(7)]
    with listening(told.append):
        found = dict(pool.results(jobs, begun.append))
    assert found == {number: number * number for number in range(7)}
    assert sorted(begun) == list(range(7))
    assert told[0].startswith("0 of 7 runs done")
    assert dict(pool.results([])) == {}


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_workers_have_cores_of_their_own(pool: WorkerPool) -> None:
    found = results(pool, *[Job("place", cluster_jobs.place)] * 4)
    cores = {process: tuple(cores) for _, cores, process in found}
    assert len(cores) == 2
    first, second = cores.values()
    assert not set(first) & set(second)
    assert os.getpid() not in cores


def test_a_job_whose_worker_dies_is_done_again(pool: WorkerPool, tmp_path: Path) -> None:
    """Dask gives a job up after four deaths of its workers. The pool sends it again."""
    jobs = [Job("dies", cluster_jobs.dies, (tmp_path / str(times), times)) for times in (0, 1, 5)]
    assert [tries > times for tries, times in zip(results(pool, *jobs), (0, 1, 5), strict=True)] == [True] * 3


def test_a_result_that_is_lost_while_it_is_fetched_is_made_again(
    pool: WorkerPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its worker dies after the job has ended, and so do the workers that Dask has do the job once more."""
    from distributed import Future
    from distributed.scheduler import KilledWorker

    fetch = Future.result
    lost: list[Future[Any]] = []

    def lose_the_first(future: Future[Any], timeout: float | None = None) -> Any:
        if not lost:
            lost.append(future)
            assert future.status == "finished"
            raise KilledWorker(future.key, None, 3)
        return fetch(future, timeout)

    monkeypatch.setattr(Future, "result", lose_the_first)
    assert results(pool, *[Job("square", cluster_jobs.squared, (number,)) for number in (2, 3)]) == [4, 9]
    assert len(lost) == 1


def test_a_worker_that_dies_while_it_starts_is_started_again(pool: WorkerPool) -> None:
    """Dask gives such a worker up."""
    import psutil  # comes with dask.distributed

    until = time.monotonic() + 4
    while time.monotonic() < until:
        for child in psutil.Process().children():
            with suppress(psutil.NoSuchProcess):
                if "spawn_main" in " ".join(child.cmdline()):
                    child.kill()
        time.sleep(0.2)
    assert results(pool, Job("square", cluster_jobs.squared, (4,))) == [16]


def test_workers_that_die_again_and_again_are_one_line(pool: WorkerPool, tmp_path: Path) -> None:
    job = Job("greedy", cluster_jobs.dies, (tmp_path / "tries", 1000))
    with pytest.raises(
        ClusterError, match=r"^greedy: the workers that did this died again and again: .*smaller images"
    ):
        results(pool, job)
    assert len((tmp_path / "tries").read_text()) >= module.MOST_DEATHS


def test_an_error_of_the_job_is_its_result(pool: WorkerPool) -> None:
    wrong, right = results(pool, Job("wrong", cluster_jobs.wrong), Job("right", cluster_jobs.squared, (3,)))
    assert isinstance(wrong, InputError)
    assert str(wrong) == "this job is wrong: give another one"
    assert right == 9


def wait_for_both(pool: WorkerPool) -> None:
    """Wait for a worker that an earlier test has ended."""
    give_up = time.monotonic() + PATIENCE
    while pool.n_workers < 2 and time.monotonic() < give_up:
        time.sleep(0.1)


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_a_fault_of_one_worker_sends_the_job_to_another(pool: WorkerPool, tmp_path: Path) -> None:
    wait_for_both(pool)
    assert results(pool, Job("full", cluster_jobs.full_on_one, (tmp_path,))) == ["done"]


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_the_only_worker_for_a_job_may_start_anew(pool: WorkerPool, tmp_path: Path) -> None:
    """The other worker cannot do the job. This one has another address after its death."""
    wait_for_both(pool)
    found: list[Any] = []
    job = Job("full", cluster_jobs.full_here_dies_there, (tmp_path,))
    waiting = threading.Thread(target=lambda: found.extend(results(pool, job)), daemon=True)
    waiting.start()
    waiting.join(PATIENCE)
    assert found == ["done"]
    assert (tmp_path / "died").exists()


def test_a_fault_of_all_workers_is_one_line_with_their_name(pool: WorkerPool) -> None:
    (error,) = results(pool, Job("full", cluster_jobs.full_everywhere))
    assert isinstance(error, ClusterError)
    assert str(error).startswith("worker ")
    assert str(error).endswith("splats.ply: No space left on device")


def test_a_fault_of_the_program_is_raised(pool: WorkerPool) -> None:
    with pytest.raises(ZeroDivisionError, match="a fault of the program"):
        results(pool, Job("faulty", cluster_jobs.faulty))


def test_workers_of_another_version_are_refused(pool: WorkerPool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "__version__", "99.0")
    (error,) = results(pool, Job("square", cluster_jobs.squared, (1,)))
    assert "not 99.0: install the same version" in str(error)


def test_jobs_that_nobody_waits_for_save_their_work(pool: WorkerPool, tmp_path: Path) -> None:
    file = tmp_path / "work"
    found = pool.results([Job("square", cluster_jobs.squared, (2,)), Job("waits", cluster_jobs.waits, (file,))])
    assert next(found) == (0, 4)
    give_up = time.monotonic() + PATIENCE
    while not file.with_suffix(".begun").exists() and time.monotonic() < give_up:
        time.sleep(0.05)
    found.close()  # as Ctrl-C does
    assert file.read_text() == "saved"
    assert results(pool, Job("square", cluster_jobs.squared, (5,))) == [25], "the worker is free again"


def test_a_worker_without_the_module_of_a_job_is_one_line(pool: WorkerPool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.pickle, "dumps", lambda job: b"cno_such_module\njob\n.")
    (error,) = results(pool, Job("square", cluster_jobs.squared, (1,)))
    assert "square: a worker cannot load it (No module named 'no_such_module'): install clsplat" in str(error)


def test_no_scheduler_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CONNECT_SECONDS", 1.0)
    with pytest.raises(ClusterError, match=r"tcp://127\.0\.0\.1:9: no scheduler answers"), WorkerPool("127.0.0.1:9"):
        pass


def test_a_scheduler_that_ends_is_one_line(tmp_path: Path) -> None:
    """The workers of the command `clsplat worker` end with it."""
    file = tmp_path / "scheduler.json"
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    scheduler = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_scheduler", *options], **quiet)
    worker = None
    try:
        give_up = time.monotonic() + PATIENCE
        while not (file.exists() and file.read_text()) and time.monotonic() < give_up:
            time.sleep(0.1)
        command = [sys.executable, "-c", "from clsplat_cli.start import main; main()", "worker", str(file)]
        env = os.environ | {"PYTHONPATH": str(Path(cluster_jobs.__file__).parent)}
        worker = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=env)
        assert worker.stderr is not None
        ready = worker.stderr.readline()
        assert "waits for runs of tcp://127.0.0.1:" in ready
        jobs = [Job("waits", cluster_jobs.waits, (tmp_path / "work",))]
        with WorkerPool(str(file)) as pool:
            waiting = pool.results(jobs, lambda _: scheduler.kill())
            with pytest.raises(ClusterError, match="the scheduler is gone: finished runs are kept"):
                next(waiting)
        said = worker.communicate(timeout=PATIENCE)[1]
        assert worker.returncode == 0, said
        assert said.endswith(": the scheduler has ended\n")
        assert said.count("\n") == 1
    finally:
        scheduler.kill()
        scheduler.wait()
        if worker is not None and worker.poll() is None:
            worker.send_signal(signal.SIGINT)
            worker.wait()

"""Jobs on two worker processes of this machine: results, errors, dead workers, and jobs that nobody waits for."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cluster_jobs
import pytest

from clsplat.activity import listening
from clsplat.cluster import pool as module
from clsplat.cluster import workers
from clsplat.cluster.job import RESOURCE, Job
from clsplat.cluster.pool import WorkerPool
from clsplat.errors import ClusterError, InputError
from clsplat.files.stop_signals import STOP_SIGNALS

pytest.importorskip("distributed")
PATIENCE = 60.0  # seconds that a slow machine may need
SILENCE = 10.0  # seconds of a scheduler that does not answer


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


def test_the_program_alone_ends_its_workers(pool: WorkerPool) -> None:
    """A signal to a whole group of processes would end a worker before it has saved its work."""
    assert set(results(pool, Job("blocked", cluster_jobs.blocked))[0]) >= set(STOP_SIGNALS)


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


def test_a_result_that_was_fetched_is_not_made_again(pool: WorkerPool, tmp_path: Path) -> None:
    """Its worker dies while another job runs. The scheduler would have it made again if somebody still wanted it."""
    jobs = [Job("first", cluster_jobs.dies, (tmp_path / "tries", 0)), Job("late", cluster_jobs.squared_late, (5,))]
    found = []
    for _, value in pool.results(jobs):
        found.append(value)
        if len(found) == 1:
            kill_workers()
    assert found == [1, 25]
    assert (tmp_path / "tries").read_text() == "x"


def kill_workers() -> None:
    """Kill the worker processes of this one."""
    import psutil  # comes with dask.distributed

    for child in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):
            if "spawn_main" in " ".join(child.cmdline()):
                child.kill()


def test_a_worker_that_dies_while_it_starts_is_started_again(pool: WorkerPool) -> None:
    """Dask gives such a worker up."""
    until = time.monotonic() + 4
    while time.monotonic() < until:
        kill_workers()
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


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("address", ["127.0.0.1:9", "tcp://127.0.0.1"])
def test_no_scheduler_is_one_line(monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    monkeypatch.setattr(workers, "CONNECT_SECONDS", 1.0)
    with pytest.raises(ClusterError, match=r"tcp://127\.0\.0\.1.*: no scheduler answers"), WorkerPool(address):
        pass


@pytest.mark.parametrize("answers", [True, False], ids=["web server", "silent"])
def test_another_service_at_the_address_is_one_line(monkeypatch: pytest.MonkeyPatch, answers: bool) -> None:
    monkeypatch.setattr(workers, "CONNECT_SECONDS", 2.0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        if answers:
            threading.Thread(target=greet, args=(server,), daemon=True).start()
        address = f"127.0.0.1:{server.getsockname()[1]}"
        started = time.monotonic()
        with pytest.raises(ClusterError, match=f"tcp://{address}: no scheduler answers"), WorkerPool(address):
            pass
        assert time.monotonic() - started < PATIENCE


def greet(server: socket.socket) -> None:
    """Answer each connection as a web server does that does not know the request."""
    with suppress(OSError):
        while True:
            connection, _ = server.accept()
            with connection:
                connection.recv(100)
                connection.sendall(b"HTTP/1.0 400 Bad request\r\n\r\n")


def test_a_job_that_only_a_lost_worker_could_do_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its worker may start anew for some time. Without any worker, the job waits for new ones."""
    known: dict[str, Any] = {
        "tcp://1": {"name": "good", "resources": {RESOURCE: 1}},
        "tcp://2": {"name": "bad", "resources": {RESOURCE: 1}},
    }
    sent: list[Any] = []
    released: list[Any] = []

    class Client:
        status = "running"

        def scheduler_info(self, n_workers: int) -> dict[str, Any]:
            return {"workers": known}

        def submit(self, *arguments: Any, **named: Any) -> Any:
            sent.append(named["workers"])
            return Sent()

    class Sent(Future[Any]):
        def release(self) -> None:
            released.append(self)

    jobs = [Job("square", cluster_jobs.squared, (1,))]
    round_ = module._Round(Client(), "address", jobs, None)
    round_.failed_at[0].add("bad")
    round_.refusals[0] = ClusterError("worker bad: no such scene")
    round_._submit(0, ["tcp://1"])
    round_._unpin()
    good = known.pop("tcp://1")
    bad = known.pop("tcp://2")
    monkeypatch.setattr(module, "GONE_SECONDS", 0.0)
    round_._unpin()
    assert not round_.given_up, "no worker is left: new ones may come"
    known["tcp://2"] = bad
    monkeypatch.setattr(module, "GONE_SECONDS", 60.0)
    round_._unpin()
    assert not round_.given_up, "it may start anew"
    known["tcp://3"] = good
    round_._unpin()
    assert sent == [["tcp://1"], ["tcp://3"]], "it did"
    del known["tcp://3"]
    monkeypatch.setattr(module, "GONE_SECONDS", 0.0)
    round_._unpin()
    assert (round_.given_up, round_.futures, round_.pinned) == ([0], {}, {})
    assert len(released) == 2


def test_runs_of_lost_workers_do_not_run(monkeypatch: pytest.MonkeyPatch) -> None:
    known: dict[str, Any] = {"tcp://1": {"name": "one", "resources": {RESOURCE: 1}}}
    client = SimpleNamespace(status="running", scheduler_info=lambda n_workers: {"workers": known})
    round_ = module._Round(client, "address", [Job("square", cluster_jobs.squared, (1,))], None)
    said: list[str] = []
    monkeypatch.setattr(module.activity, "report", said.append)
    round_._on_event((0.0, {"job": 0, "kind": "begins", "value": "one"}))
    round_._report()
    known.clear()
    round_._report()
    assert said == [
        "0 of 1 runs done; square 0%",
        "0 of 1 runs done; waiting for workers: clsplat worker address",
    ]


def test_a_scheduler_that_does_not_answer_cannot_keep_the_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C ends it, though nobody knows whether the jobs have saved their work."""
    answer = threading.Event()
    monkeypatch.setattr(module, "CONNECT_SECONDS", 0.1)
    client = SimpleNamespace(
        status="running", scheduler_info=lambda n_workers: answer.wait(SILENCE) and {"workers": {}}
    )
    round_ = module._Round(client, "address", [Job("square", cluster_jobs.squared, (1,))], None)
    released: list[object] = []

    class Wanted:
        def release(self) -> None:
            released.append(self)

    round_.futures[Wanted()] = 0
    started = time.monotonic()
    round_.end()
    assert time.monotonic() - started < SILENCE
    assert len(released) == 1
    answer.set()


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

"""`clsplat worker`, and `--cluster` of the commands with many runs: one line for each mistake."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from cli_runner import clsplat, error_of, run

from clsplat.cluster import pool, workers

pytest.importorskip("distributed")
import psutil  # comes with dask.distributed


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for a scheduler that does not answer for a second only."""
    for module in (pool, workers):
        monkeypatch.setattr(module, "CONNECT_SECONDS", 1.0)


TINY = ["--iterations", "12", "--sh-degree", "1", "--densify-interval", "5", "--cap-max", "40"]


@pytest.mark.usefixtures("impatient")
def test_a_worker_without_a_scheduler(tmp_path: Path) -> None:
    assert "no scheduler answers" in error_of("worker", "127.0.0.1:9")
    assert "not an address" in error_of("worker", "host")
    assert "cannot be read" in error_of("worker", tmp_path / "scheduler.json")
    assert "commands start such workers themselves" in error_of("worker", "local:2")
    assert "device 'nothing' not found" in error_of("worker", "127.0.0.1:9", "--device", "nothing")
    cores = len(os.sched_getaffinity(0))
    assert f"{cores + 1} workers on {cores} cores" in error_of(
        "worker", "127.0.0.1:9", "--device", "cpu", "--workers", cores + 1
    )


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("command", ["compare", "frontier"])
def test_workers_that_cannot_be_used(command: str, scene: Path, tmp_path: Path) -> None:
    arguments = (command, scene, "-o", tmp_path / "out", *TINY)
    assert "no scheduler answers" in error_of(*arguments, "--cluster", "tcp://127.0.0.1:9")
    assert "--cluster local" in error_of(*arguments, "--cluster", "tcp://127.0.0.1:9")
    assert "not an address" in error_of(*arguments, "--cluster", "nowhere")
    assert "give 1 to 1000 workers" in error_of(*arguments, "--cluster", "local:0")
    assert "each worker has its own" in error_of(
        *arguments, "--cluster", "tcp://127.0.0.1:9", "--device", "cpu", code=2
    )


def test_a_single_run_needs_no_workers(scene: Path, tmp_path: Path) -> None:
    arguments = ("train", scene, "-m", tmp_path / "out", *TINY, "--cluster", "local:1")
    assert "give --blocks or --budget auto too" in error_of(*arguments, code=2)


def test_frontier_and_benchmark_with_workers(scene: Path, tmp_path: Path) -> None:
    """The charts and tables of runs of workers."""
    out = tmp_path / "out"
    said = run("frontier", scene, "-o", out, "--systems", "gaussian", "--curve", "2", *TINY, "--cluster", "local:1")
    assert said.exit_code == 0, said.output
    assert "[1/1] yard gaussian cap 40 seed 0: PSNR" in said.stderr
    assert (out / "report.html").is_file()
    sets = tmp_path / "sets"
    sets.mkdir()
    (sets / "truck").symlink_to(scene)
    place = tmp_path / "published"
    clsplat("benchmark", "tanks", sets, "-o", place, *TINY, "--cluster", "local:1", "-q")
    assert (place / "tanks.md").is_file()


@pytest.mark.parametrize("seconds", [0.0, 0.5])
def test_ctrl_c_while_workers_start_is_one_line(scene: Path, tmp_path: Path, seconds: float) -> None:
    """A terminal sends it to the workers, too. They import for a second before they can ignore it."""
    arguments = ["compare", scene, "-o", tmp_path / "out", *TINY, "--cluster", "local:1"]
    process = subprocess.Popen(
        [sys.executable, "-c", "from clsplat_cli.start import main; main()", *map(str, arguments)],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )
    with process:
        program = psutil.Process(process.pid)
        while process.poll() is None and not any(map(is_worker, program.children())):
            time.sleep(0.01)
        time.sleep(seconds)
        os.killpg(process.pid, signal.SIGINT)
        assert process.stderr is not None
        lines = process.stderr.read().decode().splitlines()
    assert lines[-1:] == ["error: interrupted"]
    assert not [line for line in lines if "Traceback" in line]
    assert process.returncode == 130


def is_worker(process: psutil.Process) -> bool:
    """Return whether this is a worker's process, or one that has just begun to be one."""
    with suppress(psutil.NoSuchProcess):
        return "spawn_main" in " ".join(process.cmdline())
    return False

"""Ctrl-C, SIGTERM and SIGHUP: no traceback at any moment of the start, no lost work, and the right exit code."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from cli_runner import SHORT, last_iteration, run
from clsplat_cli.main import Commands
from signal_moments import count_moments, fault_of, run_until

import clsplat.scenes.scene as scene_module
from clsplat.files import stop_signals

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PROGRAM = [sys.executable, "-c", "from clsplat_cli.start import main; main()"]
LONG = ["--cap-max", "50", "--sh-degree", "0", "--iterations", "100000", "--no-coarse-to-fine"]


def check_moments(command: str, scene: Path, folder: Path, number_of_moments: int) -> None:
    """Send signals at moments that divide the whole run evenly, and check the end of each run."""
    total = count_moments(arguments(command, scene, folder / "whole"))
    moments = [1 + round(total * (place + 0.5) / number_of_moments) for place in range(number_of_moments)]
    jobs = [(SIGNALS[place % 3], moment) for place, moment in enumerate(moments)]
    with ThreadPoolExecutor(2) as pool:
        # Two runs at a time: each has a folder of its own, because one run locks its model's folder.
        ends = list(pool.map(lambda job: run_until(*job, arguments(command, scene, folder / str(job[1]))), jobs))
    faults = {job: fault for job, end in zip(jobs, ends, strict=True) if (fault := fault_of(end, job[0]))}
    # glog's handler of SIGTERM is in place until the next call of a Python function: see `kept_from_libraries`.
    native = [job for job, fault in faults.items() if job[0] == signal.SIGTERM and "*** Aborted at" in fault]
    assert len(native) <= max(number_of_moments // 10, 1)
    assert not {job: fault for job, fault in faults.items() if job not in native}


@pytest.mark.parametrize(("command", "moments"), [("--help", 5), ("info", 6), ("train", 6)])
def test_a_signal_at_any_moment_of_the_start_gives_no_traceback(
    capture_folder: Path, tmp_path: Path, command: str, moments: int
) -> None:
    check_moments(command, capture_folder, tmp_path, moments)


@pytest.mark.slow
@pytest.mark.parametrize(("command", "moments"), [("--help", 15), ("info", 30), ("train", 30), ("eval", 15)])
def test_a_signal_at_many_moments_of_the_start_gives_no_traceback(
    capture_folder: Path, model_folder: Path, tmp_path: Path, command: str, moments: int
) -> None:
    scene = model_folder if command == "eval" else capture_folder
    check_moments(command, scene, tmp_path, moments)


def arguments(command: str, scene: Path, folder: Path) -> list[object]:
    """Return the arguments of a command; `train` reads the scene, and a wrong option ends it before its first step."""
    if command == "--help":
        return [command]
    if command == "train":
        # A signal during training is a test of its own. Here the run ends at a file that does not exist.
        return ["train", scene, "-m", folder / "m", "--init", folder / "missing.ply"]
    return [command, scene]


@pytest.fixture
def start_training(capture_folder: Path, tmp_path: Path) -> Callable[..., subprocess.Popen[str]]:
    """Start a long run as a process and wait for its 50th iteration."""

    def start(**extra: object) -> subprocess.Popen[str]:
        args = ["train", capture_folder, "-m", tmp_path / "m", *LONG]
        process = subprocess.Popen(
            [*PROGRAM, *map(str, args)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            **extra,  # type: ignore[call-overload]
        )
        assert process.stderr is not None
        for line in process.stderr:
            if last_iteration(line, 100_000) >= 50:
                return process
        raise AssertionError("the run has not begun")

    return start


def saved_iteration(model: Path) -> int:
    with np.load(model / "checkpoint.npz") as stored:
        iteration: int = json.loads(stored["meta"].tobytes())["iteration"]
    return iteration


def test_sigterm_saves_like_ctrl_c(start_training: Callable[..., subprocess.Popen[str]], tmp_path: Path) -> None:
    """Under nohup SIGHUP is ignored from the start, and must not end the run. Two SIGTERM must not prevent the save."""
    process = start_training(preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN))
    process.send_signal(signal.SIGHUP)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.3)
    process.send_signal(signal.SIGTERM)
    process.send_signal(signal.SIGTERM)
    rest = process.communicate(timeout=120)[1]
    assert process.returncode == 128 + signal.SIGTERM
    assert f"checkpoint saved; to continue: clsplat train --resume -m {tmp_path / 'm'}" in rest.splitlines()[-1]
    assert "stack trace" not in rest
    assert "Traceback" not in rest
    assert 50 <= saved_iteration(tmp_path / "m") < 100_000
    assert saved_iteration(tmp_path / "m") % 1000 != 0


def test_a_closed_terminal_loses_nothing(capture_folder: Path, tmp_path: Path) -> None:
    """The run writes its progress to a terminal, which closes. The kernel then sends SIGHUP."""
    import pty

    args = ["train", capture_folder, "-m", tmp_path / "m", *LONG]
    process, terminal = pty.fork()
    if process == 0:
        os.execv(sys.executable, [*PROGRAM, *map(str, args)])
    shown = b""
    while last_iteration(shown.decode(errors="replace"), 100_000) < 50:
        shown += os.read(terminal, 4096)
    os.close(terminal)
    _, status = os.waitpid(process, 0)
    assert os.waitstatus_to_exitcode(status) == 128 + signal.SIGHUP
    assert 50 <= saved_iteration(tmp_path / "m") < 100_000


def test_a_signal_outside_training_names_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    for number, words in ((signal.SIGINT, "interrupted"), (signal.SIGTERM, "stopped by SIGTERM")):

        def receive(*args: object, number: signal.Signals = number, **extra: object) -> None:
            stop_signals.interrupt(number, None)

        monkeypatch.setattr(scene_module, "load_scene", receive)
        result = run("train", "anything", "-m", "nowhere", *SHORT)
        assert result.exit_code == 128 + number
        assert result.stderr.splitlines()[-1] == f"error: {words}"
    monkeypatch.undo()
    assert run("info", "nowhere").exit_code == 1


def test_ctrl_c_while_the_command_line_is_read_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Click itself would write an empty line first."""

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Commands, "parse_args", interrupted)
    done = run("info", "scene")
    assert (done.exit_code, done.stdout, done.stderr) == (130, "", "error: interrupted\n")

"""Random command lines, each in a process and a folder of its own, and the rules that its end must keep.

    python tests/support/command_fuzz.py FIRST COUNT STEP SEED     # the worker
    python tests/support/command_fuzz.py --show NUMBER SEED [DATA]   # a line, its output, its faults

A command ends with exit code 0, 1 or 2, and says in one line `error: ...` what is wrong. Everything else is a fault: a
traceback, another exit code, a signal, a raw warning of a library, a control character. So is a process that stays
behind, and an input that the command changed although nobody allowed it. A command that takes longer than SECONDS gets
Ctrl-C. It must then end with exit code 130 within GRACE. `view` ends with 0.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from command_lines import Line, command_line, place_of, point_into, write_inputs
from command_sequences import REAL, Change
from fuzzing import damage

SECONDS, GRACE = 30, 15
VIEW_SECONDS = 4  # a viewer serves until it is stopped
ROOM = 8 << 30  # address space of a command [bytes]
_SIGNALLED = 128  # a command that signal n ends has exit code 128 + n
_KEPT = 1500  # last characters of an output that are kept
_RAW = ("Traceback (most recent call", "RuntimeWarning", "overflow encountered", "invalid value encountered")
_RAW += ("divide by zero encountered", "DeprecationWarning", "ResourceWarning", "Exception ignored", "*** SIG")
_PROTECTED = ("scene", "transforms", "blender", "photos", *REAL, "files", "precious")


@dataclass
class Outcome:
    """How one command ended."""

    number: int
    command: str
    args: list[str]
    code: int
    seconds: float
    megabytes: int
    interrupted: bool
    faults: list[str] = field(default_factory=list)
    output: str = ""


def run_lines(numbers: range, seed: int, workers: int = 1, data: Path | None = None) -> Iterator[Outcome]:
    """Run the lines in worker processes, and return how they ended, in any order."""
    command = [sys.executable, __file__]
    processes = [
        subprocess.Popen(
            [
                *command,
                *map(str, (numbers.start + worker * numbers.step, numbers.stop, workers * numbers.step, seed)),
                str(data or ""),
            ],
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
        )
        for worker in range(workers)
    ]
    texts: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def read(stream: IO[str]) -> None:
        for text in stream:
            texts.put(text)
        texts.put(None)

    # Each worker has a reader: a worker whose pipe is full would wait for the others to end.
    for process in processes:
        assert process.stdout is not None
        threading.Thread(target=read, args=(process.stdout,), daemon=True).start()
    running = len(processes)
    while running:
        text = texts.get()
        if text is None:
            running -= 1
        else:
            yield Outcome(**json.loads(text))
    for process in processes:
        if process.wait():
            raise RuntimeError(f"a worker ended with {process.returncode}")


def work(first: int, stop: int, step: int, seed: int, data: str) -> None:
    """Run lines in this process's children and print their outcomes as JSON lines."""
    _import_what_all_commands_need()
    with tempfile.TemporaryDirectory(prefix="clsplat-lines-") as parent:
        template = Path(parent) / "template"
        template.mkdir()
        _in_child(lambda: write_inputs(template, Path(data) if data else None))
        for number in range(first, stop, step):
            print(json.dumps(asdict(_run_or_report(number, seed, template, Path(parent)))), flush=True)


def _run_or_report(number: int, seed: int, template: Path, parent: Path) -> Outcome:
    """Run a line. A failure of this file is a fault of the line: a campaign of an hour must not end without a row."""
    try:
        return run_line(number, seed, template, parent)
    except Exception:
        return Outcome(number, "", [], 0, 0.0, 0, False, [f"the harness failed: {traceback.format_exc()[-_KEPT:]}"])


def run_line(number: int, seed: int, template: Path, parent: Path) -> Outcome:
    """Run one line in a copy of the template and judge its end."""
    line = command_line(seed, number)
    root = parent / "work"
    shutil.copytree(template, root, symlinks=True, ignore=_ignore_unnamed(line))
    try:
        point_into(root, template)
        rng = np.random.default_rng([seed, number, 1])
        faults = []
        for step in line.before:
            if isinstance(step, Change):
                step.apply(root, rng)
                continue
            earlier = _run_unchanged(number, Line(step.args, succeeds=step.succeeds), root, parent, step.stopped)
            faults += [f"{step.args}: {fault}: {earlier.output}" for fault in earlier.faults]
        _damage(line, root, rng)
        outcome = _run_unchanged(number, line, root, parent)
        outcome.faults += faults
    finally:
        _remove(root)
    return outcome


def _run_unchanged(
    number: int, line: Line, root: Path, parent: Path, stopped: tuple[float, int] | None = None
) -> Outcome:
    """Run a command, and add a fault if it changed an input."""
    before = states_of(root)
    outcome = _run(number, line, root, parent / "output", stopped)
    if "--overwrite" not in line.args:
        outcome.faults += [f"changed {name}" for name in changed_files(before, states_of(root))]
    if line.succeeds and outcome.code != 0:
        outcome.faults.append(f"exit code {outcome.code} of a sound command")
    return outcome


def _import_what_all_commands_need() -> None:
    """Import before the fork what would be imported anew by each child. No device is opened here."""
    import PIL.Image
    import pyopencl
    import scipy.spatial

    import clsplat

    assert all((PIL.Image, pyopencl, scipy.spatial, clsplat))


def _in_child(work: Any) -> None:
    pid = os.fork()
    if not pid:
        code = 1
        try:
            work()
            code = 0
        finally:
            sys.stderr.flush()
            os._exit(code)
    if os.waitpid(pid, 0)[1]:
        raise RuntimeError("the inputs were not written")


def _run(number: int, line: Line, root: Path, output: Path, stopped: tuple[float, int] | None) -> Outcome:
    """Run a command in a child. `stopped` are the seconds after which a signal comes, and its number."""
    start = time.monotonic()
    with output.open("w+b") as stream:
        pid = os.fork()
        if not pid:
            _become(line, root, stream.fileno())
        limit = VIEW_SECONDS if line.command == "view" or "--view" in line.args else SECONDS
        seconds, sent = stopped or (limit, signal.SIGINT)
        status, usage = _wait(pid, seconds)
        interrupted = status is None
        if status is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, sent)
            status, usage = _wait(pid, GRACE)
        faults = []
        if status is None:
            faults.append(f"hangs: signal {int(sent)} did not end it within {GRACE} s")
            os.killpg(pid, signal.SIGKILL)
            status, usage = os.wait4(pid, 0)[1:]
        elif _alive(pid):
            faults.append("left a process behind")
            os.killpg(pid, signal.SIGKILL)
        stream.seek(0)
        text = stream.read().decode(errors="replace")
    outcome = Outcome(
        number,
        line.command,
        line.args,
        os.waitstatus_to_exitcode(status),
        round(time.monotonic() - start, 2),
        usage.ru_maxrss >> 10,
        interrupted,
        faults,
        text,
    )
    outcome.faults += judge(outcome, sent)
    outcome.output = text[-_KEPT:]
    return outcome


def _become(line: Line, root: Path, output: int) -> None:
    """Turn this child into the command. Never returns."""
    try:
        os.setsid()
        os.chdir(root)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(output, 1)
        os.dup2(output, 2)
        resource.setrlimit(resource.RLIMIT_AS, (ROOM, ROOM))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.environ.update(line.environment)
        sys.stdout = os.fdopen(1, "w", errors="surrogateescape", encoding="utf-8")
        sys.stderr = os.fdopen(2, "w", buffering=1, errors="backslashreplace", encoding="utf-8")
        sys.argv = ["clsplat", *line.args]
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # a campaign under nohup or & ignores them
            signal.signal(number, signal.SIG_DFL)
        from clsplat_cli import start

        start.main()
        code: Any = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 99
    with contextlib.suppress(BaseException):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)


def _wait(pid: int, seconds: float) -> tuple[int | None, Any]:
    end = time.monotonic() + seconds
    while True:
        found, status, usage = os.wait4(pid, os.WNOHANG)
        if found:
            return status, usage
        if time.monotonic() > end:
            return None, None
        time.sleep(0.01)


def _alive(group: int) -> bool:
    """Return whether a process of the group is left, after a moment in which it may end."""
    for _ in range(100):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return False
        time.sleep(0.02)
    return True


def judge(outcome: Outcome, sent: int = signal.SIGINT) -> list[str]:
    """Return what is wrong with the output and the exit code. An interrupted command got the signal `sent`."""
    faults = [f"prints {raw!r}" for raw in _RAW if raw in outcome.output]
    allowed = {0, _SIGNALLED + sent} if outcome.interrupted else {0, 1, 2}
    if outcome.code not in allowed:
        faults.append(f"exit code {outcome.code}")
    lines = outcome.output.splitlines()
    errors = [text for text in lines if text.startswith("error: ")]
    # The command devices shows what is wrong with each device, and lists the others. Without a command, help is shown.
    if outcome.command == "devices" or not outcome.args:
        errors = []
    elif outcome.code in (1, 2) and (len(errors) != 1 or lines[-1] != errors[0]):
        faults.append("does not end with one line `error: ...`")
    if outcome.code == 0 and errors and not outcome.interrupted:
        faults.append("prints an error and ends with 0")
    odd = {char for char in outcome.output if ord(char) < 32 and char not in "\n\r\t"}
    if odd:
        faults.append(f"prints control characters {sorted(odd)}")
    return faults


def _ignore_unnamed(line: Line) -> Any:
    """Leave out a large real scene that the line does not name."""
    unused = [name for name in REAL if name not in map(place_of, line.all_args)]
    return lambda folder, names: [name for name in unused if name in names]


def _damage(line: Line, root: Path, rng: np.random.Generator) -> None:
    for name in line.damaged:
        path = root / name
        files = sorted(file for file in (path.rglob("*") if path.is_dir() else [path]) if file.is_file())
        if files:
            damage({file: file.read_bytes() for file in files}, rng)


def states_of(root: Path) -> dict[str, tuple[int, int]]:
    """Return size and time of change of all files that no command may change."""
    found = {}
    for name in _PROTECTED:
        for path in (root / name).rglob("*"):
            if not path.is_dir() or path.is_symlink():
                state = path.lstat()
                found[os.fspath(path.relative_to(root))] = (state.st_size, state.st_mtime_ns)
    return found


def changed_files(before: dict[str, tuple[int, int]], after: dict[str, tuple[int, int]]) -> list[str]:
    return [name.encode(errors="backslashreplace").decode() for name in before if after.get(name) != before[name]]


def _remove(root: Path) -> None:
    shutil.rmtree(root, ignore_errors=True)
    if root.exists():
        subprocess.run(["rm", "-rf", os.fspath(root)], check=True)


def show(number: int, seed: int, data: str = "") -> None:
    """Run one line and print all about it."""
    line = command_line(seed, number)
    print(line)
    work_lines = run_lines(range(number, number + 1), seed, 1, Path(data) if data else None)
    for outcome in work_lines:
        print(f"exit {outcome.code} after {outcome.seconds} s, {outcome.megabytes} MB\n{outcome.output}")
        print("\n".join(f"FAULT: {fault}" for fault in outcome.faults) or "no fault")


if __name__ == "__main__":
    if sys.argv[1] == "--show":
        show(int(sys.argv[2]), int(sys.argv[3]), *sys.argv[4:5])
    else:
        work(*map(int, sys.argv[1:5]), *(sys.argv[5:6] or [""]))

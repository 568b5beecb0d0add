"""Jobs for tests of clusters. Workers import them by name, as they import those of the library."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from pathlib import Path

from clsplat.cluster.job import Abandoned, JobContext
from clsplat.errors import InputError, OutputError

STEP = 0.05  # seconds
CORES = sorted(getattr(os, "sched_getaffinity", lambda _: ())(0))  # of the process that imports this


def squared(context: JobContext, number: int) -> int:
    """Return the square of a number."""
    context.report(0.5)
    return number * number


def squared_late(context: JobContext, number: int) -> int:
    """Return the square of a number, a second later."""
    time.sleep(20 * STEP)
    return squared(context, number)


def place(context: JobContext) -> tuple[str | None, list[int], int]:
    """Return the device, the cores and the process of the worker."""
    time.sleep(2 * STEP)  # so that the other worker takes the next job
    return context.device, CORES, os.getpid()


def blocked(context: JobContext) -> list[int]:
    """Return the signals that the process does not get."""
    return sorted(signal.pthread_sigmask(signal.SIG_BLOCK, ()))


def dies(context: JobContext, file: Path, times: int) -> int:
    """End the worker's process some times, counted in a file; return how often it was tried."""
    tried = len(file.read_text("utf-8")) if file.exists() else 0
    file.write_text("x" * (tried + 1), "utf-8")
    if tried < times:
        os._exit(9)
    return tried + 1


def wrong(context: JobContext) -> None:
    """Raise an error that every worker would raise."""
    raise InputError("this job is wrong: give another one")


def full_on_one(context: JobContext, folder: Path) -> str:
    """Fail on the worker that is the first one to try, as one with a full disk would."""
    first = folder / "first"
    try:
        with first.open("x", encoding="utf-8") as stream:
            stream.write(str(os.getpid()))
    except FileExistsError:
        if first.read_text("utf-8") != str(os.getpid()):
            return "done"
    raise OutputError("disk full: free some space")


def full_here_dies_there(context: JobContext, folder: Path) -> str:
    """Fail on the first worker as `full_on_one`, and end the process of the other one once."""
    done = full_on_one(context, folder)
    with suppress(FileExistsError):
        (folder / "died").touch(exist_ok=False)
        os._exit(9)
    return done


def full_everywhere(context: JobContext) -> None:
    """Fail as a worker with a full disk does, without an error of clsplat."""
    raise OSError(28, "No space left on device", "splats.ply")


def faulty(context: JobContext) -> None:
    """Raise an error that no user can fix."""
    raise ZeroDivisionError("a fault of the program")


def waits(context: JobContext, file: Path) -> None:
    """Wait until nobody wants the result, and save that."""
    file.with_suffix(".begun").touch()
    for _ in range(round(60 / STEP)):
        if not context.is_wanted:
            file.write_text("saved", "utf-8")
            raise Abandoned
        time.sleep(STEP)

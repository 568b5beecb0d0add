"""A job, and what it gets from the worker that does it. This part runs in the worker's process."""

from __future__ import annotations

import os
import pickle
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from .._version import __version__
from ..errors import ClsplatError, DeviceError, InputError, OutputError
from .dask import distributed

RESOURCE = "clsplat"  # Dask's name of what a worker has one of, and each job needs
DEVICE_VARIABLE = "CLSPLAT_WORKER_DEVICE"  # the OpenCL device of a worker's process
REPORT_INTERVAL = 0.5  # seconds between two reports of a job's progress
_LOOK_INTERVAL = 0.2  # seconds between two looks at whether somebody still waits for the job


@dataclass(frozen=True)
class Job:
    """A function with its arguments that a worker calls.

    Attributes
    ----------
    name : for displays.
    function : function of a module, called with the `JobContext` and the arguments. Calling it again, also on another
        worker, must give the same result, because workers may die.
    arguments : anything that can be pickled. Files that they name must be there on each worker.
    """

    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...] = field(default=())


@dataclass(frozen=True)
class Outcome:
    """What came of a job.

    Attributes
    ----------
    value : the result; None if there is an error.
    error : the error that ended the job.
    elsewhere : whether another worker may do better, because the fault is the worker's.
    worker : name of the worker.
    """

    value: Any = None
    error: ClsplatError | None = None
    elsewhere: bool = False
    worker: str = ""


class MissingFiles(InputError):
    """A worker does not have the files of a job."""


class Abandoned(Exception):
    """Nobody waits for this job any more. Its checkpoint is saved, if it has a folder."""


class JobContext:
    """What a job gets: the device, a place to report its progress, and whether it is still wanted.

    Attributes
    ----------
    device : OpenCL device of this worker, as for `open_device`.
    """

    def __init__(self, topic: str, number: int, device: str | None) -> None:
        self.device = device
        self._topic, self._number = topic, number
        self._reported = self._looked = -float("inf")
        self._is_wanted = True

    def report(self, share: float) -> None:
        """Tell the program that waits for the job which share of it is done, 0 to 1."""
        if time.monotonic() - self._reported >= REPORT_INTERVAL:
            self._reported = time.monotonic()
            self.send("share", share)

    def send(self, kind: str, value: Any = None) -> None:
        """Send an event of this job: "begins", "share" or "ends"."""
        distributed().get_worker().log_event(self._topic, {"job": self._number, "kind": kind, "value": value})

    @property
    def is_wanted(self) -> bool:
        """Whether somebody still waits for the job. A job that is not wanted should save its work and end."""
        if self._is_wanted and time.monotonic() - self._looked >= _LOOK_INTERVAL:
            self._looked = time.monotonic()
            self._is_wanted = not _is_cancelled()
        return self._is_wanted

    def stop_if_unwanted(self, trainer: object, stop: threading.Event) -> None:
        """Set `stop` if nobody waits for the job: a `visit` of `train`."""
        if not self.is_wanted:
            stop.set()


def _is_cancelled() -> bool:
    """Return whether the scheduler has released the task of this thread, or the worker is ending."""
    package = distributed()
    worker = package.get_worker()
    task = worker.state.tasks.get(getattr(package.worker.thread_state, "key", None))
    return task is None or task.state == "cancelled" or worker.status.name.startswith("clos")


def perform(pickled: bytes, topic: str, number: int, version: str) -> Outcome:
    """Do a job on this worker and return its outcome. Errors that are not clsplat's are raised.

    Parameters
    ----------
    pickled : the job. The scheduler unpickles all arguments, and need not have the modules of the job.
    topic, number : where reports go, and which job of it this is.
    version : of clsplat in the program that waits.
    """
    name = str(distributed().get_worker().name)
    if version != __version__:
        text = f"it has clsplat {__version__}, not {version}: install the same version on both machines"
        return Outcome(error=InputError(text), elsewhere=True, worker=name)
    job: Job = pickle.loads(pickled)
    context = JobContext(topic, number, os.environ.get(DEVICE_VARIABLE) or None)
    context.send("begins", name)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the program that waits has read the same scene, and has shown them
            return Outcome(job.function(context, *job.arguments), worker=name)
    except Abandoned:
        return Outcome(worker=name)
    except ClsplatError as error:
        return Outcome(error=error, elsewhere=isinstance(error, OutputError | DeviceError | MissingFiles), worker=name)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        text = f"{place}{error.strerror or error}"
        return Outcome(error=OutputError(text), elsewhere=True, worker=name)
    except MemoryError:
        text = "out of memory: use smaller images or fewer splats"
        return Outcome(error=OutputError(text), elsewhere=True, worker=name)
    finally:
        context.send("ends")

"""Workers that do jobs: the side of the program that waits for them."""

from __future__ import annotations

import pickle
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, suppress
from types import TracebackType
from typing import Any, TypeVar

from .. import activity
from .._version import __version__
from ..errors import ClsplatError, ClusterError
from .address import ClusterAddress
from .dask import distributed, scheduler_address
from .job import RESOURCE, Job, Outcome, perform
from .workers import CONNECT_SECONDS, POLL, check_scheduler, local_cluster, no_scheduler, plan_workers

T = TypeVar("T")

MOST_DEATHS = 5  # times that Dask may give up a job because its workers died; Dask itself tries four workers each time
SAVING_SECONDS = 60.0  # that jobs get to save their work after Ctrl-C
GONE_SECONDS = 30.0  # after which a worker that went is not expected to start anew
SHOWN = 4  # running jobs in a line


def check_cluster(address: str | None, device: str | None) -> None:
    """Raise what `WorkerPool` raises, before a long stage that needs no workers yet. None stands for no cluster."""
    if address is None:
        return
    place = ClusterAddress.parse(address)
    if place.is_local:
        distributed()
        plan_workers([device], place.workers, local=True)  # they start later
        return
    with WorkerPool(address, device):
        pass


class WorkerPool:
    """A context manager that reaches workers, and has jobs done by them.

    Parameters
    ----------
    address : as of `ClusterAddress`.
    device : OpenCL device of local workers, as for `open_device`; None for all GPUs, or else the CPU.

    Raises
    ------
    InputError : the text is not an address, or dask.distributed is not installed. ClusterError : no scheduler answers.
    """

    def __init__(self, address: str, device: str | None = None) -> None:
        self.place = ClusterAddress.parse(address)
        self._device, self._open = device, ExitStack()
        self._client: Any = None

    def __enter__(self) -> WorkerPool:
        with ExitStack() as opened:
            package = distributed()
            opened.enter_context(warnings.catch_warnings())
            warnings.simplefilter("ignore")
            if self.place.is_local:
                plans = plan_workers([self._device], self.place.workers, local=True)
                activity.report(f"starting {_number(len(plans), 'worker')}")
                place: Any = opened.enter_context(local_cluster(plans))
            else:
                place = scheduler_address(self.place)
                check_scheduler(str(place))
            try:
                self._client = opened.enter_context(
                    package.Client(place, timeout=CONNECT_SECONDS, set_as_default=False, direct_to_workers=False)
                )
            except (OSError, ValueError):
                raise no_scheduler(str(place)) from None
            self._open = opened.pop_all()
        if self.dashboard is not None:
            activity.report(f"Dask's page about these runs: {self.dashboard}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Dask raises RuntimeError if the scheduler ends at the same moment.
        with suppress(OSError, TimeoutError, RuntimeError):
            self._open.close()
        self._client = None

    @property
    def dashboard(self) -> str | None:
        """Address of Dask's own page about the jobs; None without one (it needs the package bokeh)."""
        link = self._client.dashboard_link
        return link if link and self._client.scheduler_info(n_workers=0).get("services") else None

    @property
    def n_workers(self) -> int:
        """Number of workers at present."""
        return len(_workers(self._client))

    def results(self, jobs: Sequence[Job], on_begin: Callable[[int], None] | None = None) -> Iterator[tuple[int, Any]]:
        """Have jobs done, and yield the number and the result of each as it ends.

        A job whose worker dies is done again. A job that fails because of its worker is done by another one.

        Parameters
        ----------
        on_begin : called with the number of a job when a worker begins it for the first time.

        Yields
        ------
        The number of a job in `jobs`, and its result or the `ClsplatError` that ended it.

        Raises
        ------
        ClusterError : the scheduler is gone, or workers died again and again.
        KeyboardInterrupt : Ctrl-C; jobs that are running save their work.
        """
        round_ = _Round(self._client, self.place.text, jobs, on_begin)
        try:
            yield from round_.results()
        finally:
            round_.end()

    def successes(
        self, jobs: Sequence[Job], on_begin: Callable[[int], None] | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Do as `results`, but raise the first error of a job once all others have ended."""
        failed: ClsplatError | None = None
        for number, result in self.results(jobs, on_begin):
            if isinstance(result, ClsplatError):
                failed = failed or result
            else:
                yield number, result
        if failed is not None:
            raise failed


class _Round:
    """The jobs of one call of `WorkerPool.results`."""

    def __init__(self, client: Any, place: str, jobs: Sequence[Job], on_begin: Callable[[int], None] | None) -> None:
        self.client, self.place, self.jobs, self.on_begin = client, place, jobs, on_begin
        self.topic = f"clsplat-{uuid.uuid4().hex}"
        self.futures: dict[Any, int] = {}
        self.deaths = [0] * len(jobs)
        self.failed_at: list[set[str]] = [set() for _ in jobs]
        self.pinned: dict[Any, set[str]] = {}  # addresses of the only workers that may do a job
        self.gone: dict[Any, float] = {}  # when the last one of them was missed [s]
        self.refusals: dict[int, ClusterError] = {}  # why a worker could not do a job
        self.given_up: list[int] = []
        self.begun: set[int] = set()
        self.announced: set[int] = set()
        self.at: dict[int, str] = {}  # workers of jobs that have begun
        self.shares: dict[int, float] = {}  # of jobs that run
        self.done = 0
        self.changed = threading.Event()  # a job has begun or ended

    def results(self) -> Iterator[tuple[int, Any]]:
        if not self.jobs:
            return
        self.client.subscribe_topic(self.topic, self._on_event)
        for number in range(len(self.jobs)):
            self._submit(number)
        while self.futures:
            self._report()
            self._unpin()
            for number in self.given_up:
                self.done += 1
                yield number, self.refusals[number]
            self.given_up.clear()
            self.changed.wait(POLL)
            self.changed.clear()
            self._announce()
            if self.client.status != "running":
                raise self._gone()
            # The result of a "lost" future was in a worker that has died: the scheduler has the job done again.
            for future in [future for future in self.futures if future.done() and future.status != "lost"]:
                number = self.futures.pop(future)
                found = self._collect(future, number)
                if future not in self.futures:
                    future.release()  # if the worker that has the result dies, the scheduler would have it made again
                if found is not None:
                    self.done += 1
                    self.shares.pop(number, None)
                    yield number, found.error or found.value

    def end(self) -> None:
        """Give up the jobs that are left, and wait until they have saved their work."""
        with suppress(Exception):
            if self.futures and self.client.status == "running":
                for future in self.futures:
                    future.release()
                self._wait_for_saving()
            self.client.unsubscribe_topic(self.topic)

    def _wait_for_saving(self) -> None:
        """Wait until no job runs any more. Raise TimeoutError if the scheduler does not answer."""
        give_up = time.monotonic() + SAVING_SECONDS
        while (saving := _in_time(self._running)) and time.monotonic() < give_up:
            activity.report(f"{_number(len(saving), 'run')} saving the work so far")
            time.sleep(0.1)

    def _running(self) -> list[int]:
        """Return the numbers of the jobs that a worker does at present."""
        alive = set(_workers(self.client).values()) if self.client.status == "running" else set()
        return [number for number in sorted(self.shares) if self.at[number] in alive]

    def _submit(self, number: int, workers: Sequence[str] | None = None) -> None:
        """Send a job to the scheduler. workers : addresses of those that may do it; None for all."""
        job = self.jobs[number]
        future = self.client.submit(
            perform,
            pickle.dumps(job),
            self.topic,
            number,
            __version__,
            key=f"{job.name}-{uuid.uuid4().hex}",
            resources={RESOURCE: 1},
            workers=workers,
            priority=-number,
            pure=False,
        )
        self.futures[future] = number
        if workers is not None:
            self.pinned[future] = set(workers)
        future.add_done_callback(lambda _: self.changed.set())

    def _unpin(self) -> None:
        """Send jobs again whose workers are all gone, or give them up if all other workers have failed at them.

        A worker that starts anew has another address.
        """
        self.pinned = {future: places for future, places in self.pinned.items() if future in self.futures}
        workers = _workers(self.client) if self.pinned else {}
        for future, places in list(self.pinned.items()):
            number = self.futures[future]
            others = [at for at, name in workers.items() if name not in self.failed_at[number]]
            if not workers or places & workers.keys():
                self.gone.pop(future, None)
                continue
            now = time.monotonic()
            if not others and now - self.gone.setdefault(future, now) < GONE_SECONDS:
                continue
            del self.pinned[future], self.futures[future]
            future.release()
            if others:
                self._submit(number, others)
            else:
                self.given_up.append(number)

    def _collect(self, future: Any, number: int) -> Outcome | None:
        """Return the outcome of a future that is done; None if its job was sent again."""
        try:
            outcome: Outcome = future.result(timeout=CONNECT_SECONDS)
        except TimeoutError:  # its worker died before the result was here
            self.futures[future] = number
            return None
        except Exception as error:  # also of a job that had ended: it is done again if its worker dies before this
            return self._failed(error, number)
        if outcome.error is None:
            return outcome
        named = ClusterError(f"worker {outcome.worker}: {outcome.error}")
        if outcome.elsewhere:
            self.failed_at[number].add(outcome.worker)
            self.refusals[number] = named
            others = [at for at, name in _workers(self.client).items() if name not in self.failed_at[number]]
            if others:
                self._submit(number, others)
                return None
        return Outcome(error=named) if self.failed_at[number] and outcome.worker else outcome

    def _failed(self, error: Exception, number: int) -> Outcome | None:
        """Return the outcome of a job that Dask could not have done; None if the job was sent again."""
        name = self.jobs[number].name
        if isinstance(error, CancelledError):
            raise self._gone()
        if type(error).__name__ == "KilledWorker":
            self.deaths[number] += 1
            if self.deaths[number] >= MOST_DEATHS:
                raise ClusterError(
                    f"{name}: the workers that did this died again and again: look at their logs, and use smaller "
                    "images or fewer splats if memory was short; finished runs are kept"
                )
            self._submit(number)
            return None
        if isinstance(error, ImportError | AttributeError):  # while the job was unpickled
            text = f"{name}: a worker cannot load it ({error}): install clsplat {__version__} on each machine"
            return Outcome(error=ClusterError(text))
        raise error

    def _gone(self) -> ClusterError:
        return ClusterError(
            f"{self.place}: the scheduler is gone: finished runs are kept, so start it and give the same command again "
            "(clsplat train needs --resume for that)"
        )

    def _on_event(self, event: tuple[float, Any]) -> None:
        """Note what a worker reports. Dask calls this in a thread of its own."""
        message = event[1]
        number, kind = message["job"], message["kind"]
        if kind == "ends":
            self.shares.pop(number, None)
        elif kind == "share":
            self.shares[number] = message["value"]
        else:
            self.at[number], self.shares[number] = message["value"], 0.0
            self.begun.add(number)
            self.changed.set()

    def _announce(self) -> None:
        for number in sorted(self.begun - self.announced):
            self.announced.add(number)
            if self.on_begin is not None:
                self.on_begin(number)

    def _report(self) -> None:
        """Tell a display how far the jobs are."""
        running = self._running()
        texts = [f"{self.jobs[number].name} {self.shares.get(number, 0.0):.0%}" for number in running[:SHOWN]]
        if len(running) > SHOWN:
            texts.append(f"{len(running) - SHOWN} more")
        if not running and not _workers(self.client):
            texts = [f"waiting for workers: clsplat worker {self.place}"]
        activity.report(f"{self.done} of {len(self.jobs)} runs done{'; ' if texts else ''}{', '.join(texts)}")


def _in_time(call: Callable[[], T]) -> T:
    """Return the result of a call that asks the scheduler. Raise TimeoutError if it does not answer."""
    found: list[T] = []

    def ask() -> None:
        with suppress(Exception):
            found.append(call())

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(CONNECT_SECONDS)
    if not found:
        raise TimeoutError
    return found[0]


def _workers(client: Any) -> dict[str, str]:
    """Return the names of the workers that take jobs, by address."""
    info = client.scheduler_info(n_workers=-1)["workers"]
    return {at: str(worker["name"]) for at, worker in info.items() if worker.get("resources", {}).get(RESOURCE)}


def _number(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"

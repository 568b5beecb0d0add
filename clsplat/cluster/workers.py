"""Worker processes of this machine: one on each device, with a part of the cores if several share a CPU."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import platform
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import count
from multiprocessing import resource_tracker
from typing import Any

from ..device.device import DeviceInfo, list_devices, open_device
from ..errors import ClusterError, InputError, Remedy
from ..files.stop_signals import STOP_SIGNALS
from ..rendering.tuning import SCHEDULE_VARIABLE, schedule_for
from .dask import distributed
from .job import DEVICE_VARIABLE, RESOURCE

CORES_OF_A_WORKER = 2  # on a CPU, unless the number of workers is given
CONNECT_SECONDS = 10.0
POLL = 0.5  # seconds
MOST_STARTS = 20  # of a process that dies each time
# These run first in a worker's process, after its imports. Where signals cannot be blocked, Ctrl-C is ignored only now.
# Threads inherit the cores of the thread that starts them, so all later ones have them.
_IGNORE_CTRL_C = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
_SET_CORES = "import os; getattr(os, 'sched_setaffinity', lambda *_: None)(0, {cores})"


@dataclass(frozen=True)
class WorkerPlan:
    """One worker process.

    Attributes
    ----------
    name : for messages and dashboards.
    device : OpenCL device, as for `open_device`.
    cores : numbers of the cores that it may use; None for all.
    schedule : schedule of the kernels; None for the fastest one of the device.
    """

    name: str
    device: str
    cores: tuple[int, ...] | None = None
    schedule: str | None = None

    def options(self) -> dict[str, Any]:
        """Return arguments of Dask's `Nanny`, which starts the process again if it dies."""
        environment = {DEVICE_VARIABLE: self.device}
        if self.schedule is not None:
            environment[SCHEDULE_VARIABLE] = self.schedule
        preload = [_IGNORE_CTRL_C]
        if self.cores is not None:
            preload.append(_SET_CORES.format(cores=set(self.cores)))
        return {
            "name": self.name,
            "nthreads": 1,
            "resources": {RESOURCE: 1},
            "memory_limit": 0,  # Dask would divide the memory by the number of cores, and kill larger workers
            "env": environment,
            "preload": preload,
        }


def plan_workers(devices: Sequence[str | None], count: int | None = None, *, local: bool = False) -> list[WorkerPlan]:
    """Return the worker processes for some devices of this machine.

    Parameters
    ----------
    devices : as for `open_device`; None stands for the best device, and with `local` for all GPUs if there are any.
    count : number of workers; None for one on each device. Workers that share a CPU get equal parts of its cores.
    local : whether the program itself starts them. They then use the schedule that it would use itself, and without
        `count` a CPU gets a worker for every two cores.

    Raises
    ------
    DeviceError : there is no such device. InputError : there are more workers than cores.
    """
    infos = _infos(devices, local)
    cpus = [info for info in infos if info.type == "CPU"]
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
    if count is None:
        share = max(len(cores) // CORES_OF_A_WORKER, 1) if local and cpus else 1
        count = share if cpus and len(infos) == 1 else len(infos)
    chosen = [infos[number % len(infos)] for number in range(count)]
    on_cpu = sum(info.type == "CPU" for info in chosen)
    if on_cpu > len(cores):
        raise InputError(f"{on_cpu} workers on {len(cores)} cores: each needs one of its own: start fewer")
    plans, part = [], 0
    for number, info in enumerate(chosen):
        part_of_cores = None
        if info.type == "CPU" and on_cpu > 1:
            part_of_cores = tuple(cores[part * len(cores) // on_cpu : (part + 1) * len(cores) // on_cpu])
            part += 1
        schedule = str(schedule_for(open_device(info.index))) if local else None
        plans.append(WorkerPlan(f"{_host()}-{number}" if count > 1 else _host(), info.index, part_of_cores, schedule))
    return plans


def _infos(devices: Sequence[str | None], local: bool) -> list[DeviceInfo]:
    """Return the devices that are named, each once."""
    gpus = [info for info in list_devices() if info.type == "GPU"] if local else []
    if gpus and set(devices) <= {None}:
        return gpus
    infos = [open_device(device).info for device in devices or (None,)]
    return list({info.index: info for info in infos}.values())


def _host() -> str:
    return f"{platform.node() or 'worker'}-{os.getpid()}"


@contextmanager
def local_cluster(plans: Sequence[WorkerPlan]) -> Iterator[Any]:
    """Yield a scheduler with these workers, which only this machine can reach. They end with the block."""
    package = distributed()
    address = "127.0.0.1"
    with package.LocalCluster(
        n_workers=0, host=address, scheduler_port=0, dashboard_address=f"{address}:0", silence_logs="critical"
    ) as cluster:
        loop = cluster.loop.asyncio_loop
        loop.call_soon_threadsafe(_keep_signals_from_children)
        ready = [threading.Event() for _ in plans]
        workers = [
            asyncio.run_coroutine_threadsafe(_keep(cluster.scheduler_address, plan, event.set), loop)
            for plan, event in zip(plans, ready, strict=True)
        ]
        try:
            for worker, event in zip(workers, ready, strict=True):
                while not event.wait(POLL):
                    if worker.done():
                        worker.result()  # its error
                        raise no_scheduler(cluster.scheduler_address)
            yield cluster
        finally:
            for worker in workers:
                worker.cancel()
            with suppress(TimeoutError):
                asyncio.run_coroutine_threadsafe(_until_closed(), loop).result(2 * CONNECT_SECONDS)
            _end_the_rest()


def _keep_signals_from_children() -> None:
    """Block stop signals in this thread, so in the processes that it starts. Windows cannot do this.

    A terminal sends Ctrl-C to all of its processes, and service managers do so with SIGTERM. The program ends its
    workers itself, after they have saved their work.
    """
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
        resource_tracker.ensure_running()  # the first process would start it, and it unblocks signals in this thread
        signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)


async def _until_closed() -> None:
    """Wait until the workers of this loop have ended."""
    while _open:
        await asyncio.sleep(0.05)


def _end_the_rest() -> None:
    """Kill worker processes that have not ended. Python would wait for them at its exit, after a signal they block."""
    for process in multiprocessing.active_children():
        if "from Nanny" in process.name:
            process.kill()


_open: set[Any] = set()  # nannies of this process


async def _keep(address: str, plan: WorkerPlan, on_ready: Callable[[], None]) -> None:
    """Keep a worker alive until the scheduler ends.

    A nanny starts its process again if that dies, but gives up if it dies while it starts.

    Raises
    ------
    ClusterError : the process has died MOST_STARTS times in a row while it started.
    """
    package, in_vain = distributed(), 0

    def started() -> None:
        nonlocal in_vain
        in_vain = 0
        on_ready()

    for attempt in count():
        if in_vain == MOST_STARTS:
            raise ClusterError(f"worker {plan.name}: its process dies again and again while it starts: look at its log")
        in_vain += 1
        name = f"{plan.name}.{attempt}" if attempt else plan.name  # the scheduler may still know the other one
        nanny = package.Nanny(address, **plan.options() | {"name": name})
        _open.add(nanny)
        try:
            with suppress(OSError, RuntimeError, TimeoutError):
                await asyncio.shield(nanny)  # a process that is left while it starts would print tracebacks
                started()
                await nanny.finished()
        finally:
            with suppress(Exception):  # the scheduler may be gone
                await nanny.close(timeout=CONNECT_SECONDS)
            _open.discard(nanny)
        if not await _answers(address):
            return
        await asyncio.sleep(POLL)


async def _answers(address: str) -> bool:
    """Return whether a scheduler answers at an address."""
    package = distributed()
    try:
        async with package.core.rpc(address) as scheduler:
            await asyncio.wait_for(scheduler.identity(), CONNECT_SECONDS)
    except (Exception, asyncio.CancelledError):  # the bytes of another service may lead to any error
        return False
    return True


async def _answers_in_time(address: str) -> bool:
    """Return whether a scheduler answers soon. Another service at the address may take a message and never answer."""
    try:
        return await asyncio.wait_for(_answers(address), CONNECT_SECONDS)
    except TimeoutError:
        return False


def check_scheduler(address: str) -> None:
    """Raise ClusterError if no scheduler answers at an address."""
    with ThreadPoolExecutor(1) as thread:  # the caller may be in an event loop, as in a notebook
        answers = thread.submit(lambda: asyncio.run(_answers_in_time(address))).result()
    if not answers:
        raise no_scheduler(address)


def serve(address: str, plans: Sequence[WorkerPlan], on_ready: Callable[[WorkerPlan], None] | None = None) -> None:
    """Run workers of a scheduler in this machine until the scheduler ends.

    Parameters
    ----------
    address : of the scheduler. on_ready : called with each worker that has reached it, again if it was started anew.

    Raises
    ------
    ClusterError : no scheduler answers at the address.
    KeyboardInterrupt : Ctrl-C. Jobs that were running go to other workers.
    """
    distributed()

    def ready(plan: WorkerPlan) -> None:
        if on_ready is not None:
            on_ready(plan)

    begun: Future[tuple[asyncio.AbstractEventLoop, Any]] = Future()

    async def run() -> None:
        begun.set_result((asyncio.get_running_loop(), asyncio.current_task()))
        if not await _answers_in_time(address):
            raise no_scheduler(address)
        await asyncio.gather(*(_keep(address, plan, partial(ready, plan)) for plan in plans))

    with ThreadPoolExecutor(1, initializer=_keep_signals_from_children) as thread:
        end = thread.submit(asyncio.run, run())
        try:
            while not wait([end], POLL).done:
                pass
        finally:
            loop, task = begun.result(CONNECT_SECONDS)  # Ctrl-C may come before the loop runs
            with suppress(RuntimeError):  # it has ended
                loop.call_soon_threadsafe(task.cancel)
            wait([end])
            _end_the_rest()
        end.result()


def no_scheduler(address: str) -> ClusterError:
    """Return the error that nothing answers at an address."""
    return ClusterError(
        f"{address}: no scheduler answers",
        Remedy("start one on that machine (`dask scheduler`)"),
        Remedy("use workers of this machine", "--cluster local"),
    )

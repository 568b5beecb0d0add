"""Runs of a comparison as jobs of workers. Each trains in a folder of its own, so another worker can go on with it."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from ..cluster.job import Abandoned, JobContext, MissingFiles
from ..device.device import open_device
from ..errors import InputError, OutputError
from ..files.lock import folder_lock
from ..files.real_path import real_path
from ..scenes.scene import Scene
from ..scenes.source import SceneSource
from ..training.config import TrainConfig
from ..training.log import Progress
from .measure import train_and_measure_resumable
from .table import Record

T = TypeVar("T")

UNFINISHED = "unfinished"  # folder of the runs that a comparison with workers has begun
MARK = ".clsplat-runs"  # a file in it: a worker that does not see it is on a machine without this folder

_loaded: list[tuple[Any, Scene]] = []  # the last scene of this process, and its source


@dataclass(frozen=True, eq=False)
class RunJob:
    """What a worker needs to do a run of a comparison.

    Attributes
    ----------
    source : of the scene. config : complete options of the run. curve : as of `compare`.
    folder : of the run, among the unfinished ones of the comparison. ply : where to keep the splats.
    """

    source: SceneSource
    config: TrainConfig
    folder: Path
    ply: Path | None = None
    curve: int = 0


def do_run(context: JobContext, job: RunJob) -> Record:
    """Do a run on a worker and return its record (`Job.function`)."""
    scene = scene_of(job.source, SceneSource.load)
    config = job.config.replace(device=context.device)

    def train(folder: Path) -> Record:
        return train_and_measure_resumable(
            folder,
            scene,
            config,
            open_device(context.device),
            progress_of(context),
            job.ply,
            job.curve,
            context.stop_if_unwanted,
        )

    return in_folder(job.folder, train)


def progress_of(context: JobContext) -> Callable[[Progress], None]:
    """Return a callback that reports the share of a run that is done."""

    def report(progress: Progress) -> None:
        if not progress.message:
            context.report(progress.iteration / progress.iterations)

    return report


def scene_of(source: Any, load: Callable[[Any], Scene]) -> Scene:
    """Return a scene, from memory if the last job of this process had the same one.

    Raises
    ------
    MissingFiles : this machine does not have the scene's files, or has others.
    """
    if not _loaded or _loaded[0][0] != source:
        _loaded.clear()
        try:
            _loaded.append((source, load(source)))
        except InputError as error:
            raise MissingFiles(str(error)) from None
    return _loaded[0][1]


def in_folder(folder: Path, run: Callable[[Path], T], *, keep: bool = False) -> T:
    """Return the result of a run in its folder.

    Without `keep` a temporary folder replaces one that this machine does not see, or that a worker uses which the
    scheduler has lost.

    Raises
    ------
    Abandoned : nobody waits for the run any more; what it has done so far is saved.
    MissingFiles : with `keep`, if this machine does not see the folder. OutputError : with `keep`, if it is in use.
    """
    with ExitStack() as stack:
        seen = (folder.parent / MARK).is_file()
        if keep and not seen:
            raise MissingFiles(f"{folder.parent}: this machine does not see that folder: write into a shared one")
        if seen:
            folder.mkdir(exist_ok=True)
            try:
                stack.enter_context(folder_lock(folder))
            except OutputError:
                if keep:
                    raise
                seen = False
        if not seen:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        try:
            return run(folder)
        except KeyboardInterrupt:
            raise Abandoned from None


def marked(place: Path) -> Path:
    """Return the absolute path of a folder for runs of workers, which see by a file in it that it is this one."""
    place = real_path(place)
    place.mkdir(parents=True, exist_ok=True)
    (place / MARK).touch()
    return place


def unmark(place: Path) -> None:
    """Remove the mark of a folder, and the folder if nothing else is in it."""
    with suppress(OSError):
        (place / MARK).unlink()
        place.rmdir()

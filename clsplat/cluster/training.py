"""Training on a worker: its scene, its folder, its progress."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from ..errors import InputError, OutputError, Remedy
from ..files.lock import folder_lock
from ..files.real_path import real_path
from ..scenes.scene import Scene
from ..scenes.source import SceneSource
from ..training.checkpoint import UnusableCheckpoint
from ..training.config import TrainConfig
from ..training.folder import ModelFolder
from ..training.log import Progress
from ..training.run import train
from ..training.stored_run import holds_run
from ..training.trainer import Visit
from .job import Abandoned, JobContext, MissingFiles

T = TypeVar("T")

MARK = ".clsplat-runs"  # a file in a folder of runs: a worker that does not see it is on a machine without this folder

THIS_STAGE = Remedy("remove this file and resume; other finished runs are kept")

_loaded: list[tuple[Any, Scene]] = []  # the last scene of this process, and its source


@dataclass(frozen=True, eq=False)
class TrainJob:
    """A run whose model stays in its folder.

    Attributes
    ----------
    source : of the scene. config : complete options. folder : of the model; workers need its absolute path.
    """

    source: SceneSource
    config: TrainConfig
    folder: Path


def train_in_folder(
    config: TrainConfig,
    scene: Scene,
    folder: Path,
    context: Path | None = None,
    progress: Callable[[Progress], None] | None = None,
    visit: Visit | None = None,
) -> dict[str, Any]:
    """Train a model in its folder, or go on from the checkpoint there.

    Parameters
    ----------
    config : complete options. context : file of splats, as of `train`; it may be one without splats.
    progress, visit : as of `train`.

    Returns
    -------
    What the run took: "splats" (without the context), "context" (their number), "seconds", "peak_bytes" of this process
    and "device_bytes"; "left_out" names the photos that it left out.

    Raises
    ------
    KeyboardInterrupt : the run was stopped; its checkpoint is saved. Others are those of `train`.
    """
    stored = ModelFolder(folder)
    file = stored.checkpoint_path
    try:
        resume = holds_run(stored, config)
        if file.is_file() and not resume and progress is not None:
            progress(Progress.note(f"{file}: is of a run with other options; it begins anew", config.iterations))
        model = train(
            scene,
            config,
            progress,
            output=folder,
            resume=resume,
            overwrite=not resume,
            visit=visit,
            context=context,
        )
    except UnusableCheckpoint as error:
        raise InputError(f"{file}: {error.message.removeprefix(f'{file}: ')}", THIS_STAGE) from None
    if not model.finished:
        raise KeyboardInterrupt
    if not stored.ply_path(model.iteration).is_file():  # somebody has removed it since the run ended
        stored.save(model.splats, model.iteration)
    return {
        "splats": len(model.splats) - model.n_context,
        "context": model.n_context,
        "seconds": round(model.seconds, 2),
        "peak_bytes": model.peak_bytes,
        "device_bytes": model.device_bytes,
        "left_out": list(model.left_out),
    }


def train_in_place(work: JobContext, job: TrainJob) -> dict[str, Any]:
    """Do `train_in_folder` on a worker (`Job.function`)."""
    scene, config = scene_of(job.source, SceneSource.load), job.config.replace(device=work.device)

    def run(folder: Path) -> dict[str, Any]:
        return train_in_folder(config, scene, folder, None, progress_of(work), work.stop_if_unwanted)

    return in_folder(job.folder, run, keep=True)


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

    Without `keep` a temporary folder replaces one that this machine does not see or cannot write, or that a worker uses
    which the scheduler has lost.

    Raises
    ------
    Abandoned : nobody waits for the run any more; what it has done so far is saved.
    MissingFiles : with `keep`, if this machine does not see the folder.
    OutputError : with `keep`, if it is in use or cannot be written.
    """
    with ExitStack() as stack:
        seen = (folder.parent / MARK).is_file()
        if keep and not seen:
            raise MissingFiles(f"{folder.parent}: this machine does not see that folder: write into a shared one")
        if seen:
            try:
                _make(folder)
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


def _make(folder: Path) -> None:
    """Make a folder for a run. Raise OutputError if this machine cannot write there."""
    try:
        folder.mkdir(exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{folder}: cannot be written ({reason}): let the user of this worker write there") from None


def marked(place: Path) -> Path:
    """Return the absolute path of a folder for runs of workers, which see by a file in it that it is this one.

    Raises OutputError if it cannot be written.
    """
    place = real_path(place)
    try:
        place.mkdir(parents=True, exist_ok=True)
        (place / MARK).touch()
    except OSError as error:
        raise OutputError(f"{place}: cannot be written ({error.strerror or error}); check rights and space") from None
    return place


def unmark(place: Path) -> None:
    """Remove the mark of a folder, and the folder if nothing else is in it."""
    with suppress(OSError):
        (place / MARK).unlink()
        place.rmdir()

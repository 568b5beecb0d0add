"""Runs of a comparison as jobs of workers. Each trains in a folder of its own, so another worker can go on with it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..cluster.job import JobContext
from ..cluster.training import in_folder, progress_of, scene_of
from ..device.device import open_device
from ..scenes.source import SceneSource
from ..training.config import TrainConfig
from .measure import train_and_measure_resumable
from .table import Record

UNFINISHED = "unfinished"  # folder of the runs that a comparison with workers has begun


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

"""A run of a benchmark as a job of a worker."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..cluster.job import JobContext
from ..cluster.training import in_folder, progress_of, scene_of
from ..comparison.table import Record
from ..device.device import open_device
from ..evaluation.perceptual import Lpips
from ..scenes.scene import Scene
from ..scenes.source import SceneSource
from ..training.config import TrainConfig
from .measure import train_and_measure_in
from .protocol import with_photos
from .sets import StartCube
from .start import with_start


@dataclass(frozen=True)
class BenchmarkJob:
    """What a worker needs to do a run of a benchmark.

    Attributes
    ----------
    source : of the scene with all training views. photos : training views that are used; None for all.
    config : options of the run. folder : absolute path of the model.
    start : of published systems in scenes without points. lpips : whether to measure LPIPS.
    """

    source: SceneSource
    photos: int | None
    config: TrainConfig
    folder: Path
    start: StartCube | None
    lpips: bool

    def load(self) -> Scene:
        """Return the scene with the points that the run starts from. Errors are those of `scene_of`."""
        scene = scene_of((self.source, self.photos), _load)
        return with_start(scene, self.start, self.config.seed)


def _load(source: tuple[SceneSource, int | None]) -> Scene:
    scene, photos = source
    return with_photos(scene.load(), photos)


def metric_of(lpips: bool) -> Lpips | None:
    """Return LPIPS as 3DGS's script uses it, which passes images in 0..1; None if it is not asked for."""
    return Lpips(unit_range=True) if lpips else None


def do_benchmark_run(context: JobContext, job: BenchmarkJob) -> Record:
    """Do a run on a worker and return its measurements (`Job.function`)."""
    scene, config = job.load(), job.config.replace(device=context.device)

    def train(folder: Path) -> Record:
        device, metric = open_device(context.device), metric_of(job.lpips)
        return train_and_measure_in(
            folder, scene, config, device, metric, progress_of(context), context.stop_if_unwanted
        )

    return in_folder(job.folder, train, keep=True)

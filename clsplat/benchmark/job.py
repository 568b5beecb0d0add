"""A run of a benchmark, for this process or for a worker."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..cluster.job import JobContext
from ..cluster.training import in_folder, progress_of, scene_of
from ..comparison.table import Record
from ..device.device import open_device
from ..evaluation.perceptual import Lpips
from ..scenes.scene import Scene
from ..splats.color import Color
from ..training.config import TrainConfig
from .measure import train_and_measure_in
from .protocol import BenchmarkScene
from .sets import StartCube
from .start import with_start


@dataclass(frozen=True)
class BenchmarkJob:
    """What is needed to do a run of a benchmark. It can be pickled.

    Attributes
    ----------
    scene : with its protocol. config : options of the run. folder : absolute path of the model.
    start : of published systems in scenes without points. lpips : whether to measure LPIPS.
    """

    scene: BenchmarkScene
    config: TrainConfig
    folder: Path
    start: StartCube | None
    lpips: bool

    def load(self) -> Scene:
        """Return the scene with the points that the run starts from."""
        scene = scene_of((self.scene, self.config.background), _load)
        return scene if self.start is None else with_start(scene, self.start, self.config.seed)


def _load(source: tuple[BenchmarkScene, Color]) -> Scene:
    scene, background = source
    return scene.load(background)


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

"""The run of a block, in this process or on a worker."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..cluster.job import JobContext
from ..cluster.training import in_folder, progress_of, scene_of, train_in_folder
from ..rendering.renderer import Renderer
from ..scenes.colmap import few_of
from ..scenes.scene import Scene
from ..scenes.source import SceneSource
from ..splats.splats import Splats
from ..training.config import TrainConfig
from ..training.exposure_file import exposures_of_start
from ..training.log import Progress
from ..training.photos import with_cut_outs
from ..training.trainer import Visit
from .targets import BlockTargets, with_block_targets

# In the folder of a block: its splats of the coarse model and those around it, its first splats, and its run.
INSIDE, CONTEXT, START, RUN = "inside.ply", "context.ply", "start.ply", "run"


@dataclass(frozen=True, eq=False)
class BlockJob:
    """What is needed to train a block.

    Attributes
    ----------
    source : of its photos. config : complete options. folder : of the block, with its splats and those around it.
    uncovered : its part of what no splat covers (targets.py).
    """

    source: SceneSource
    config: TrainConfig
    folder: Path
    uncovered: float


def train_block(
    job: BlockJob,
    scene: Scene,
    folder: Path,
    device: str | None,
    progress: Callable[[Progress], None] | None = None,
    visit: Visit | None = None,
) -> dict[str, Any]:
    """Train a block and return what that took, as `train_in_folder` does.

    Parameters
    ----------
    scene : with the photos of the block. folder : of the run. device : as for `open_device`.
    """
    background = job.config.background  # as the run decided
    exposures = exposures_of_start(str(job.folder / START)) if job.config.appearance.exposure else {}

    def targets() -> BlockTargets:
        inside, context = (Splats.load(job.folder / name) for name in (INSIDE, CONTEXT))
        return BlockTargets(inside, context, Renderer(device, keep=2), background, job.uncovered, exposures)

    if job.config.cut_background:
        scene = with_cut_outs(scene, background)
    prepared = with_block_targets(replace(scene, background=background), targets)
    return train_in_folder(job.config.replace(device=device), prepared, folder, job.folder / CONTEXT, progress, visit)


def train_block_on_worker(work: JobContext, job: BlockJob) -> dict[str, Any]:
    """Do `train_block` on a worker (`Job.function`)."""
    scene = scene_of(job.source, _read)

    def run(folder: Path) -> dict[str, Any]:
        return train_block(job, scene, folder, work.device, progress_of(work), work.stop_if_unwanted)

    return in_folder(job.folder / RUN, run, keep=True)


def _read(source: SceneSource) -> Scene:
    """Read the scene of a block. Photos are decoded at their use, and few of the points stay in memory.

    A block has its first splats in a file. Only the extent of its scene needs points, and these are enough for it.
    """
    scene = source.load(read_photos=False)
    return replace(scene, points=few_of(scene.points))

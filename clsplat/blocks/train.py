"""Training in blocks: a coarse model, a partition, a run for each block, and a last run of all together.

1. Coarse. A run of the whole scene with a quarter of the splats.
2. Partition. Cells that fill equal parts of the photos, and the photos that show each of them (partition.py).
3. Blocks. Each block goes on from its splats of the coarse model and points of its cell (start.py), with its share of
   the cap. It learns its own part of the photos (targets.py). The coarse splats around it are shown and do not change.
   Each splat of the coarse model belongs to one block, and so do all that come from it. So nothing stands twice.
4. Polish. A short run of all blocks together, without new splats.

state.py keeps finished stages. An interrupted stage goes on from its checkpoint.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..cluster.job import Job
from ..cluster.pool import WorkerPool, check_cluster
from ..cluster.training import marked, train_in_folder
from ..compression.prune_and_refine import Part, fine_tuning
from ..device.specs import count_devices
from ..errors import InputError
from ..files.real_path import real_path
from ..rendering.renderer import Renderer
from ..scenes.in_memory import with_small_photos_in_memory
from ..scenes.scene import Scene
from ..scenes.source import SceneSource
from ..splats.splats import Splats
from ..splats.transform import joined
from ..training.config import TrainConfig
from ..training.decisions import as_decided, decide
from ..training.exposure_file import copy_exposures, exposures_beside
from ..training.folder import ModelFolder, scene_record
from ..training.initialise import FROM_POINTS
from ..training.log import Progress
from ..training.point_fit import with_fitting_points
from ..training.stages import StepReports
from ..training.stored_run import holds_run
from .job import CONTEXT, INSIDE, RUN, START, BlockJob, train_block, train_block_on_worker
from .options import block_config, of_coarse_run, shares_of_cap
from .partition import BlockViews, Partition, make_partition, surroundings
from .picture import write_picture
from .start import with_points
from .state import BlocksOptions, BlocksState
from .stored import (
    MAKE_AGAIN,
    START_AGAIN,
    check_counts,
    check_exposures,
    check_inside,
    check_rows,
    kept_or_made,
    left_out,
    splats_of,
    stored_caps,
    stored_partition,
)

STEPS = 4  # coarse, partition, blocks, polish
COARSE_CAP, POLISH = 0.25, 0.5  # of the cap, and of the iterations of a block
POLISH_RATES = (1.0, 0.3)  # factors on the last rates of a block in the two halves of the polish
PICTURE, MERGED = "partition.svg", "merged.ply"

ProgressCallback = Callable[[Progress], None]


@dataclass(frozen=True)
class BlocksModel:
    """The result of a training in blocks.

    Attributes
    ----------
    splats : the model. path : its file. report : content of blocks.json.
    """

    splats: Splats
    path: Path
    report: dict[str, Any]


def train_in_blocks(
    scene: Scene,
    options: BlocksOptions,
    config: TrainConfig | None = None,
    progress: ProgressCallback | None = None,
    *,
    output: str | Path,
    resume: bool = False,
    overwrite: bool = False,
    cluster: str | None = None,
) -> BlocksModel:
    """Train a model of a large scene in blocks.

    Parameters
    ----------
    options : the blocks.
    config : options; `cap_max` is that of the whole model, and `iterations` those of each block.
    progress, overwrite : as of `train`. resume : go on with an interrupted training, with the same options.
    output : model folder. It gets the files of `train`, blocks.json and partition.svg.
    cluster : address of workers (`cluster.address`) that train the blocks and see `output`; None for this process.

    Raises
    ------
    InputError : no training views, other options than before, or options that blocks cannot have.
    OutputError, DeviceError, TrainingError : as `train`. ClusterError : as `WorkerPool`.
    KeyboardInterrupt : Ctrl-C; `resume` goes on from there.
    """
    check_cluster(cluster, None if config is None else config.device)
    with _opened(scene, options, config, progress, output, resume, overwrite, cluster) as stages:
        return stages.run()


def partition_scene(
    scene: Scene,
    options: BlocksOptions,
    config: TrainConfig | None = None,
    progress: ProgressCallback | None = None,
    *,
    output: str | Path,
    resume: bool = False,
    overwrite: bool = False,
) -> Partition:
    """Do the first two stages of `train_in_blocks`, which goes on from there with `resume`."""
    with _opened(scene, options, config, progress, output, resume, overwrite) as stages:
        return stages.divided()


@contextmanager
def _opened(
    scene: Scene,
    options: BlocksOptions,
    config: TrainConfig | None,
    progress: ProgressCallback | None,
    output: str | Path,
    resume: bool,
    overwrite: bool,
    cluster: str | None = None,
) -> Iterator[_Stages]:
    """Yield the stages of a training, new or resumed. The model folder is locked until the block ends."""
    config = config or TrainConfig()
    folder, state = ModelFolder(output), BlocksState(Path(output))
    check_options(config, options)
    with folder.for_run(resume=resume, overwrite=overwrite):
        if resume:
            state.load()
            config = as_decided(config, TrainConfig.from_json(state.values["config"]).to_json())
            state.check(config, options)
        scene = with_fitting_points(with_small_photos_in_memory(scene))
        if not resume:
            if names := of_coarse_run(config):
                warnings.warn(
                    f"{', '.join(names)}: only the coarse run has these values; blocks and the polish split splats by "
                    "their gradients, without penalties",
                    stacklevel=4,
                )
            config = decide(scene, config).tell(progress)
            folder.clear()
            state.begin(config, options, scene_record(scene, folder.path))
        yield _Stages(scene, config, options, progress, state, folder, cluster)


def check_options(config: TrainConfig, options: BlocksOptions) -> None:
    """Raise InputError for options that a training in blocks cannot have."""
    if count_devices(config.device) > 1:
        raise InputError(f"device {config.device}: blocks share runs, not photos, among devices: name one device")
    if config.cap_max < options.count:
        raise InputError(f"cap_max {config.cap_max}: less than a splat for each of {options.count} blocks: raise it")
    if config.validation.validate:
        raise InputError("validate True: each block has other photos: leave --validate out")
    if config.start.init not in FROM_POINTS:
        raise InputError(f"init {config.start.init}: blocks start from a coarse model of their own: leave --init out")


class _Stages:
    """The stages of a training, each done once."""

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        options: BlocksOptions,
        progress: ProgressCallback | None,
        state: BlocksState,
        folder: ModelFolder,
        cluster: str | None,
    ) -> None:
        self.whole, self.options, self.cluster = scene, options, cluster
        self.config = config.replace(save_iterations=(), test_iterations=())
        self.state, self.folder = state, folder
        self.steps = StepReports(progress, STEPS, config.iterations)

    def run(self) -> BlocksModel:
        """Run the missing stages."""
        partition = self.divided()
        if "blocks" in self.state.values:
            check_rows(self.state, [block.number for block in partition.blocks if block.views])
        if "blocks" not in self.state.values or not (self.state.folder / MERGED).is_file():
            self.train_blocks(partition)
        return self.finish()

    def divided(self) -> Partition:
        """Return the partition, with the coarse run and the division if they are missing."""
        if "coarse" not in self.state.values:
            self.train_coarse()
        if "partition" not in self.state.values:
            self.divide()
        names = [view.name for view in self.scene.train]
        return stored_partition(self.state, self.options.columns, self.options.rows, names)

    def coarse(self) -> Splats:
        """Return the coarse model. A missing file of it is made again if the checkpoint of its run is there."""
        folder, config = self.state.run_folder("coarse"), self.coarse_config
        can_make = folder.checkpoint_path.is_file() and holds_run(folder, config)
        if not folder.iterations():
            if not can_make:
                raise InputError(f"{folder.path}: the coarse model is gone", START_AGAIN)
            self.train_whole("coarse", config)
        return splats_of(folder.latest_ply()[0], MAKE_AGAIN if can_make else START_AGAIN)

    @property
    def coarse_config(self) -> TrainConfig:
        """Options of the coarse run."""
        return self.config.replace(cap_max=max(math.ceil(COARSE_CAP * self.config.cap_max), 1))

    def train_coarse(self) -> None:
        """Make the coarse model."""
        config = self.coarse_config
        self.steps.tell(1, f"a coarse model of {config.iterations} iterations with at most {config.cap_max} splats")
        self.state.put("coarse", self.train_whole("coarse", config))

    @property
    def scene(self) -> Scene:
        """The scene without the photos that the coarse run has left out because they disagree with all others."""
        gone = left_out(self.state) if "coarse" in self.state.values else frozenset()
        if not gone:
            return self.whole
        return replace(self.whole, views=[view for view in self.whole.views if view.name not in gone])

    def divide(self) -> None:
        """Divide the scene, and draw the cells."""
        coarse, columns, rows = self.coarse(), self.options.columns, self.options.rows
        self.steps.tell(
            2, f"{columns} x {rows} blocks of {len(coarse)} splats and {len(self.scene.train)} training views"
        )
        partition = make_partition(self.scene, coarse, Renderer(self.config.device), columns, rows)
        write_picture(self.folder.path / PICTURE, self.scene, partition)
        self.state.put("partition", partition.to_json())

    def train_blocks(self, partition: Partition) -> None:
        """Train each block that a photo shows, and merge their splats.

        A block keeps splats that have moved over its border: what they show would be missing, as no other block has it.
        """
        coarse = self.coarse()
        blocks = [block for block in partition.blocks if block.views]
        cell = partition.cells.of(coarse.mean)
        check_counts(self.state, partition, np.bincount(cell, minlength=partition.cells.count).tolist())
        folders = {block.number: real_path(self.state.folder) / f"block_{block.number}" for block in blocks}
        # A training that goes on keeps the parts of its blocks, because another device may choose other surroundings.
        new = {number for number, folder in folders.items() if not (folder / CONTEXT).is_file()}
        caps = self.caps(blocks, len(coarse), is_begun=len(new) < len(blocks))
        largest = max(caps, default=0)
        self.steps.tell(
            3, f"{len(blocks)} blocks with at most {largest} splats, {self.config.iterations} iterations each"
        )
        around = surroundings(self.scene, coarse, Renderer(self.config.device), partition) if new else []
        source, jobs = SceneSource.of(self.scene), []
        for block, cap in zip(blocks, caps, strict=True):
            number, folder = block.number, folders[block.number]
            rows = np.flatnonzero(cell == number)
            inside = coarse.select(rows)
            first = partial(with_points, inside, self.scene, partition.cells, number, cap, self.config)
            folder.mkdir(parents=True, exist_ok=True)
            check_inside(folder, kept_or_made(folder / INSIDE, partial(coarse.select, rows)), inside)
            kept_or_made(folder / START, first)
            self.pass_exposures("coarse", exposures_beside(folder / START))
            kept_or_made(folder / CONTEXT, partial(coarse.select, around[number] if new else []))
            config = block_config(self.config, folder / START, cap)
            config = config.replace(exposure_rate=0.0)  # exposures are common to all blocks
            jobs.append(BlockJob(source.of_views(block.views), config, folder, 1.0 / len(blocks)))
        results = self.train_all(jobs, [f"block {block.number}" for block in blocks])
        parts = [coarse.select(np.flatnonzero(~np.isin(cell, [block.number for block in blocks])))]
        for block, job, row in zip(blocks, jobs, results, strict=True):
            trained = splats_of(ModelFolder(job.folder / RUN).latest_ply()[0])
            parts.append(trained.select(np.arange(len(trained) - row["context"])))
            row |= {"number": block.number, "views": len(block.views)}
        joined([part for part in parts if len(part)]).save(self.state.folder / MERGED)
        self.state.put("blocks", results)

    def caps(self, blocks: Sequence[BlockViews], n_coarse: int, is_begun: bool) -> list[int]:
        """Return the caps of the blocks that are trained.

        Parameters
        ----------
        n_coarse : splats of the coarse model; those of blocks that no photo shows stay in the model.
        is_begun : whether a block has its parts. Earlier versions did not store caps, and all were equal.
        """
        counts, cap = [block.splats for block in blocks], self.config.cap_max
        if "caps" in self.state.values:
            return stored_caps(self.state, counts)
        if is_begun:
            caps = [max(cap // len(blocks), count) for count in counts]
        else:
            caps = shares_of_cap(cap - n_coarse + sum(counts), counts)
        self.state.put("caps", caps)
        return caps

    def pass_exposures(self, stage: str, target: Path) -> None:
        """Copy the exposures that a stage has learned to a file. Raise InputError if they are gone or damaged."""
        folder = self.state.run_folder(stage)
        if self.config.appearance.exposure:
            check_exposures(folder)
        copy_exposures(folder, target)

    def finish(self) -> BlocksModel:
        """Train all blocks together for a short time, and write the model."""
        polish, start = self.options.polish, time.perf_counter()
        iterations = math.ceil(POLISH * self.config.iterations) if polish is None else polish
        whole = splats_of(self.state.folder / MERGED)
        if iterations:
            self.steps.tell(4, f"{len(whole)} splats together, {iterations} iterations")
        before = "coarse"
        run = block_config(self.config, self.folder.path, self.config.cap_max)  # its last rates are those of the polish
        for number, rate in enumerate(POLISH_RATES):
            first, last = (iterations * (number + each) // len(POLISH_RATES) for each in (0, 1))
            if first == last:
                continue
            name, part = f"polish_{number}", Part((last - first) / run.iterations, rate)
            file = real_path(self.state.folder) / f"{name}.ply"
            whole.save(file)
            self.pass_exposures(before, exposures_beside(file))
            self.train_whole(name, fine_tuning(run, whole, part, file))
            whole, before = splats_of(self.state.run_folder(name).latest_ply()[0]), name
        self.folder.write_run(self.state.values["config"], self.whole)
        self.folder.write_views([*self.whole.test, *self.whole.train])
        self.pass_exposures(before, self.folder.exposures_path)
        path = self.folder.ply_path(self.config.iterations + iterations)
        whole.save(path)
        seconds = round(time.perf_counter() - start, 2)
        self.state.put("final", {"splats": len(whole), "bytes": path.stat().st_size, "polish_seconds": seconds})
        self.state.end()
        return BlocksModel(whole, path, self.state.values)

    def train_whole(self, name: str, config: TrainConfig) -> dict[str, Any]:
        """Make a run of the whole scene in this process, and return what it took."""
        scene = self.whole if name == "coarse" else self.scene
        return train_in_folder(config, scene, self.state.run_folder(name).path, None, self.steps.progress)

    def train_all(self, jobs: Sequence[BlockJob], names: Sequence[str]) -> list[dict[str, Any]]:
        """Train blocks here or on workers, and return what each took."""
        rows = dict(self._here(jobs) if self.cluster is None else self._on_workers(jobs, names))
        return [rows[number] for number in range(len(jobs))]

    def _here(self, jobs: Sequence[BlockJob]) -> Iterator[tuple[int, dict[str, Any]]]:
        for number, job in enumerate(jobs):
            scene = job.source.part_of(self.scene)
            yield number, train_block(job, scene, job.folder / RUN, self.config.device, self.steps.progress)

    def _on_workers(self, jobs: Sequence[BlockJob], names: Sequence[str]) -> Iterator[tuple[int, dict[str, Any]]]:
        assert self.cluster is not None
        for job in jobs:
            marked(job.folder)
        with WorkerPool(self.cluster, self.config.device) as pool:
            work = [Job(name, train_block_on_worker, (job,)) for name, job in zip(names, jobs, strict=True)]
            yield from pool.successes(work)

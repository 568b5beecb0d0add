"""Runs of a published benchmark: each scene of a set by its protocol, with tables beside published figures."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

from ..cluster.job import Job
from ..cluster.training import scene_of
from ..comparison.methods import Method, parse_methods
from ..comparison.planned import PlannedRun, do_runs
from ..comparison.runs import Run, RunFile, key_digest, refuse_foreign
from ..comparison.table import Record
from ..device.device import open_device
from ..evaluation.perceptual import Lpips
from ..files.lock import folder_lock
from ..files.real_path import real_path
from ..scenes.scene import Scene
from ..scenes.source import SceneSource
from ..splats.color import Color
from ..training.config import TrainConfig
from ..training.log import Progress
from ..training.presets import PRESETS
from .job import BenchmarkJob, do_benchmark_run, metric_of
from .measure import train_and_measure_in
from .protocol import BenchmarkScene, find_scenes
from .results import files_of_results, write_results
from .sets import BenchmarkSet, StartCube, benchmark_set
from .start import with_start

MODELS = "models"


def run_benchmark(
    name: str,
    folder: str | os.PathLike[str],
    methods: Sequence[Method] | str = "default",
    output: str | os.PathLike[str] | None = None,
    *,
    caps: Sequence[int] = (),
    seeds: Sequence[int] = (0,),
    common: Mapping[str, Any] | None = None,
    images: str | None = None,
    resolution: int | None = None,
    photos: int | None = None,
    lpips: bool = False,
    cluster: str | None = None,
    progress: Callable[[Progress], None] | None = None,
    on_run: Callable[[Run, Record | None], None] | None = None,
) -> list[Record]:
    """Train and measure the scenes of a published set that a folder holds, by the protocol of the set.

    Finished runs in `output` are read, and interrupted ones are resumed. The tables show all runs there.

    Parameters
    ----------
    name : one of SETS.
    folder : holds the scenes in folders with their names, or is one of them.
    methods : methods, or their names as in `parse_methods`.
    output : folder of runs.jsonl, NAME.md, NAME.csv, NAME.json and the models; by default "benchmark-NAME".
    caps : caps on the splats, a run for each; by default the published number of each scene.
    common : options of all methods, by the names of TrainConfig. By default iterations and background are those of the
        protocol. The tables name every difference.
    images, resolution : as for `find_scenes`.
    photos : training views of each scene, at equal steps; None for all. The files are called NAME-PHOTOS then.
    lpips : whether to measure LPIPS too, which needs the extra of that name.
    cluster : address of workers (`cluster.address`), which must see `folder` and `output`; None for runs in this
        process.
    progress : as of `train`. on_run : called with (run, None) before each run and (run, record) after it.

    Returns
    -------
    All runs of the set in `output`, in the order of their training. `results.report` makes the tables.

    Raises
    ------
    InputError : an unknown set, no scene of it, missing photos, options that do not fit, or LPIPS is not installed.
    OutputError : `output` cannot be written, holds files of others, or another benchmark writes there.
    DeviceError : no device, or not enough memory.
    ClusterError : with `cluster`: no scheduler answers, or it is gone.
    ClsplatError : with `cluster`: of a run that no worker can do, once all others are finished.
    KeyboardInterrupt : Ctrl-C. The tables of the finished runs are written, and the same call continues.
    A run whose training fails raises nothing: its record has the message ("failed").
    """
    chosen = benchmark_set(name, photos)
    methods = parse_methods(methods) if isinstance(methods, str) else methods
    options = {"iterations": chosen.iterations, "background": chosen.background, **(common or {})}
    place = Path(f"benchmark-{chosen.name}" if output is None else output)
    scenes = find_scenes(chosen, folder, images, resolution)
    planned_runs = [(scene, _runs(scene, methods, caps, seeds, options)) for scene in scenes]
    metric = metric_of(lpips)
    refuse_foreign(
        place, files_of_results(chosen.name)
    )  # models may be there already: a run that stopped has no line yet
    runs = RunFile(place)
    with folder_lock(place):
        try:
            plan = [
                planned
                for scene, configs in planned_runs
                for planned in _missing(chosen, scene, configs, runs, place, metric, progress)
            ]
            do_runs(plan, runs, place / MODELS, cluster, on_run)
        finally:
            write_results(place, chosen, runs.records)
    return [record for record in runs.records if record["scene"].get("set") == chosen.name]


def _missing(
    chosen: BenchmarkSet,
    scene: BenchmarkScene,
    configs: Sequence[tuple[Method, TrainConfig]],
    runs: RunFile,
    place: Path,
    metric: Lpips | None,
    progress: Callable[[Progress], None] | None,
) -> Iterator[PlannedRun]:
    """Yield the runs on a scene that are not finished. configs : of all runs. place : folder of the benchmark."""
    source = cache(partial(_source_of, scene))
    for number, (method, config) in enumerate(configs, 1):
        label = method.label
        done = runs.find(_identity(chosen, scene), label, config)
        if done is not None and (metric is None or done["failed"] or done.get("lpips") is not None):
            continue
        run = Run(scene.scene.name, label, config, number, len(configs))
        record: Record = {
            "scene": _identity(chosen, scene),
            "system": label,
            "config": config.to_json(),
            "repeat": 0,
            "differences": [*scene.differences, *_differences(chosen, scene, method, config)],
        }
        model = place / MODELS / f"{run.file_name}-{key_digest(record)}"
        start = chosen.start if method.base in PRESETS else None
        yield PlannedRun(
            run,
            record,
            partial(_alone, scene, config, model, start, metric, progress),
            partial(_job, source, scene.photos, run, model, start, metric is not None),
        )


def _alone(
    scene: BenchmarkScene,
    config: TrainConfig,
    model: Path,
    start: StartCube | None,
    metric: Lpips | None,
    progress: Callable[[Progress], None] | None,
) -> Record:
    """Do a run in this process. model : its folder."""
    loaded = with_start(scene_of((scene, config.background), _load), start, config.seed)
    return train_and_measure_in(model, loaded, config, open_device(config.device), metric, progress)


def _load(source: tuple[BenchmarkScene, Color]) -> Scene:
    scene, background = source
    return scene.load(background)


def _job(
    source: Callable[[Color], SceneSource],
    photos: int | None,
    run: Run,
    model: Path,
    start: StartCube | None,
    lpips: bool,
) -> Job:
    """Return the job that has a worker do a run. source : of the scene with a background, from the program's files."""
    work = BenchmarkJob(source(run.config.background), photos, run.config, real_path(model), start, lpips)
    return Job(f"{run.scene} {run.stem}", do_benchmark_run, (work,))


def _source_of(scene: BenchmarkScene, background: Color) -> SceneSource:
    return SceneSource.of(scene.load_all(background))


def _runs(
    scene: BenchmarkScene,
    methods: Sequence[Method],
    caps: Sequence[int],
    seeds: Sequence[int],
    options: Mapping[str, Any],
) -> list[tuple[Method, TrainConfig]]:
    """Return the method and the config of each run on a scene. Methods are innermost, as in `compare`.

    Presets learn from images at full size in the whole run, as their publications do.
    """
    return [
        (method, method.config(cap, seed, {"coarse_to_fine": False, **options} if method.base in PRESETS else options))
        for cap in caps or [scene.scene.splats]
        for seed in seeds
        for method in methods
    ]


def _identity(chosen: BenchmarkSet, scene: BenchmarkScene) -> dict[str, Any]:
    """Return what identifies a scene in runs.jsonl, with the set and the photos that were used."""
    return {**scene.identity, "set": chosen.name, "images": scene.images, "resolution": scene.resolution}


def _differences(chosen: BenchmarkSet, scene: BenchmarkScene, method: Method, config: TrainConfig) -> list[str]:
    """Return how a run differs from the protocol of its set, in a few words each."""
    found = []
    if config.iterations != chosen.iterations:
        found.append(f"not the published length ({chosen.iterations} iterations)")
    if tuple(config.background) != chosen.background:
        found.append("not the published background")
    if method.base in PRESETS and config.schedule.coarse_to_fine:
        found.append("small images in the first half of the run")
    if chosen.counted and config.cap_max < scene.scene.splats:
        found.append(f"at most {config.cap_max} splats, not {scene.scene.splats}")
    return found

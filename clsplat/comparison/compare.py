"""Methods trained side by side: same scenes, caps, lengths and seeds. An interrupted comparison can go on."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

from ..cluster.job import Job
from ..device.device import open_device
from ..errors import InputError, OutputError
from ..files.atomic import atomic_writer
from ..files.json_file import write_json
from ..files.lock import folder_lock
from ..files.real_path import real_path
from ..scenes.scene import Scene
from ..scenes.source import SceneSource
from ..training.config import TrainConfig
from ..training.log import Progress
from .jobs import UNFINISHED, RunJob, do_run
from .measure import train_and_measure, warm_up
from .methods import Method
from .planned import PlannedRun, do_runs
from .run_options import decided_config, unused_changes
from .runs import Run, RunFile, key_digest, refuse_foreign
from .scene_identity import CONTENT, scene_identity
from .table import Record, markdown, notes, summarise

TABLE, RESULTS, MODELS = "table.md", "results.json", "models"


def compare(
    scenes: Iterable[Scene],
    methods: Sequence[Method],
    output: str | Path,
    caps: Sequence[int],
    seeds: Sequence[int],
    common: Mapping[str, Any] | None = None,
    *,
    lengths: Sequence[int] = (),
    save_models: bool = False,
    curve: int = 0,
    repeat: int = 1,
    extra: Mapping[str, Any] | None = None,
    cluster: str | None = None,
    progress: Callable[[Progress], None] | None = None,
    on_run: Callable[[Run, Record | None], None] | None = None,
) -> list[Record]:
    """Train every method at every cap and length with every seed on every scene, and measure it on the test views.

    Finished runs in `output` are not repeated. The table shows all runs there, new and earlier ones.

    Parameters
    ----------
    scenes : with test views. An iterator can load them one after the other.
    output : folder of runs.jsonl, table.md and results.json, which are also written after Ctrl-C.
    common : options of all methods, by the names of TrainConfig.
    lengths : iterations of the runs; without any, those of `common` or the default.
    save_models : keep the splats of each run in `output`/models. No two runs have one name there.
    curve : number of measurements of the test views along each run; a run without a curve is repeated.
    repeat : how often to train the first seed: on one device the splats have the same bits each time.
    extra : more keys of each record.
    cluster : address of workers (`cluster.address`); None for runs in this process, one after the other. Runs that are
        cut short go on from their checkpoints in `output`/unfinished, if all workers see that folder.
    progress : as of `train`. on_run : called with (run, None) before each run and (run, record) after it.

    Warns
    -----
    UserWarning : a change of a method has no effect in any of its runs, or rows in `output` are of an older version.
        Or all runs are finished, and the table cannot be written again.

    Returns
    -------
    All runs in `output`, in the order of their training; `table.summarise` makes the rows of the table.

    Raises
    ------
    InputError : a scene has no test views, options do not fit a method, or a row of `output` is damaged. Options are
        checked before the first run on each scene.
    OutputError : `output` cannot be written, holds files that no comparison wrote, or another comparison writes there.
    DeviceError : no device, or not enough memory.
    ClusterError : with `cluster`: no scheduler answers, or it is gone.
    ClsplatError : with `cluster`: of a run that no worker can do, once all others are finished.
    A run whose training fails raises nothing: its record has the message ("failed").
    """
    folder = Path(output)
    # The loop over methods is the innermost: an interrupted comparison has equally many runs of each.
    configs = [
        (method.label, method.config(cap, seed, options), again)
        for cap in caps
        for options in _with_lengths(common, lengths)
        for seed in seeds
        for again in range(repeat if seed == seeds[0] else 1)
        for method in methods
    ]
    refuse_foreign(folder, (TABLE, RESULTS, MODELS))
    runs = RunFile(folder)
    before = list(runs.records)
    with folder_lock(folder):
        try:
            plan = _missing(scenes, methods, configs, runs, folder, save_models, curve, progress)
            do_runs(plan, runs, folder / UNFINISHED, cluster, on_run, extra)
        finally:
            try:
                write_table(folder, runs.records)
            except OutputError as error:
                if runs.records != before:
                    raise
                warnings.warn(f"{error}; the table there is not written again", stacklevel=2)
    return runs.records


def _missing(
    scenes: Iterable[Scene],
    methods: Sequence[Method],
    configs: Sequence[tuple[str, TrainConfig, int]],
    runs: RunFile,
    folder: Path,
    save_models: bool,
    curve: int,
    progress: Callable[[Progress], None] | None,
) -> Iterator[PlannedRun]:
    """Yield the runs that are not finished, in their order. configs : label, undecided options and number of repeat."""
    warm: set[str] = set()
    shown: set[str] = set()
    for scene in scenes:
        if not scene.test:
            raise InputError(f"{scene.path}: no test views to measure on: load it with eval")
        identity = scene_identity(scene)
        source = cache(partial(SceneSource.of, scene))
        decided = [decided_config(label, undecided, scene) for label, undecided, _ in configs]
        for message in unused_changes(methods, [label for label, *_ in configs], decided, scene):
            if message not in shown:
                shown.add(message)
                warnings.warn(message, stacklevel=2)
        warned = False
        for number, ((label, _, again), config) in enumerate(zip(configs, decided, strict=True), 1):
            done = runs.find(identity, label, config, again)
            if done is not None and (not curve or done.get("curve") is not None):
                if CONTENT not in done["scene"] and not warned:
                    warned = True
                    warnings.warn(
                        f"{runs.path}: an older version wrote runs on {scene.name} without a digest of its photos and "
                        "test views: if these have changed since, choose another folder",
                        stacklevel=2,
                    )
                continue
            run = Run(scene.name, label, config, number, len(configs), again)
            record: Record = {"scene": identity, "system": label, "config": config.to_json(), "repeat": again}
            digits = key_digest(record)
            ply = folder / MODELS / f"{run.model_name(len(scene.test))}-{digits}.ply" if save_models else None
            scratch = real_path(folder) / UNFINISHED / f"{run.file_name}-{digits}"
            yield PlannedRun(
                run,
                record,
                partial(_alone, scene, run, warm, progress, ply, curve),
                partial(_job, source, run, scratch, ply, curve),
                scratch,
            )


def _alone(
    scene: Scene,
    run: Run,
    warm: set[str],
    progress: Callable[[Progress], None] | None,
    ply: Path | None,
    curve: int,
) -> Record:
    """Do a run in this process. warm : systems whose kernels are compiled; the run's is added."""
    device = open_device(run.config.device)
    if run.system not in warm:
        warm_up(scene, run.config, device)
        warm.add(run.system)
    return train_and_measure(scene, run.config, device, progress, ply, curve)


def _job(source: Callable[[], SceneSource], run: Run, folder: Path, ply: Path | None, curve: int) -> Job:
    """Return the job that has a worker do a run."""
    work = RunJob(source(), run.config, folder, None if ply is None else real_path(ply), curve)
    return Job(f"{run.scene} {run.stem}", do_run, (work,))


def _with_lengths(common: Mapping[str, Any] | None, lengths: Sequence[int]) -> list[dict[str, Any]]:
    """Return the common options once for each number of iterations, or as they are without any."""
    return [{**(common or {}), "iterations": length} for length in lengths] or [dict(common or {})]


def write_table(folder: Path, records: Sequence[Record]) -> None:
    """Write table.md and results.json, if there are records."""
    if records:
        rows = summarise(records)
        with atomic_writer(folder / TABLE) as stream:
            stream.write(markdown(records).encode(errors="backslashreplace"))
        write_json(folder / RESULTS, {"rows": rows, "notes": notes(records, rows)})

"""One training run of a comparison, measured on the test views."""

from __future__ import annotations

import hashlib
import json
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._version import __version__
from ..device.device import Device
from ..errors import InputError, TrainingError
from ..evaluation.evaluate import Evaluation, evaluate
from ..evaluation.metrics import DEFAULT_PROTOCOL
from ..rendering.renderer import Renderer
from ..scenes.scene import Scene, View
from ..splats.color import Color
from ..splats.splats import Splats
from ..training.checkpoint import Checkpoint
from ..training.config import TrainConfig
from ..training.folder import ModelFolder
from ..training.log import Progress
from ..training.model import Model
from ..training.run import train
from ..training.trainer import Trainer, Visit
from .table import MEASURED, Record

WARM_UP = 3  # iterations
RENDERS = 5  # renders of each view; the fastest counts


def warm_up(scene: Scene, config: TrainConfig, device: Device) -> None:
    """Train a few iterations, so that the driver compiles the kernels before the clock of a run starts."""
    trainer = Trainer(scene, config, device=device)
    for _ in range(min(WARM_UP, config.iterations)):
        trainer.step()


def train_and_measure(
    scene: Scene,
    config: TrainConfig,
    device: Device,
    progress: Callable[[Progress], None] | None = None,
    ply: Path | None = None,
    curve: int = 0,
) -> Record:
    """Train once and return the record: the values of `table.MEASURED` and how they were measured.

    "seconds" is the training alone. "cpu_seconds" counts all threads of this process, with preparation and the
    measurements of the curve. "peak_bytes" is the largest memory of the process so far. "device_bytes" is the size of
    this run's working buffers. Two runs with the same "digest" have the same splats.

    Parameters
    ----------
    ply : where to keep the splats; None: they are saved only to measure the size of the file.
    curve : number of points of the record's "curve": iteration, training seconds, PSNR and SSIM of the test views.
    """
    started = time.process_time()
    along = curve_iterations(config.iterations, curve)
    trainer = Trainer(scene, config.replace(test_iterations=along), progress=progress, device=device)
    record = empty_record(device, trainer.kernels.schedule) | {"curve": [] if curve else None}
    try:
        model = trainer.run()
    except TrainingError as error:
        return record | {"failed": str(error)}
    record |= {"cpu_seconds": time.process_time() - started}
    if curve:
        record["curve"] = [
            {
                "iteration": iteration,
                "seconds": model.evaluation_seconds[iteration],
                "psnr": model.evaluations[iteration].psnr,
                "ssim": model.evaluations[iteration].ssim,
            }
            for iteration in along
        ]
    return record | _measured(trainer.renderer, model, scene, config, ply)


def train_and_measure_resumable(
    folder: Path,
    scene: Scene,
    config: TrainConfig,
    device: Device,
    progress: Callable[[Progress], None] | None = None,
    ply: Path | None = None,
    curve: int = 0,
    visit: Visit | None = None,
) -> Record:
    """Do as `train_and_measure` in a model folder, so that an interrupted run goes on from its checkpoint there.

    Parameters
    ----------
    config : complete options (`decide`). visit : as of `train`.

    Raises
    ------
    KeyboardInterrupt : the run was stopped; its checkpoint is saved. Others: as `train_in`.
    """
    started = time.process_time()
    along = curve_iterations(config.iterations, curve)
    try:
        model, schedule = train_in(folder, scene, config.replace(test_iterations=along), device, progress, visit)
    except FailedRun as failed:
        return empty_record(device, failed.schedule) | {"curve": [] if curve else None, "failed": str(failed)}
    record = empty_record(device, schedule) | {"cpu_seconds": time.process_time() - started}
    if curve:
        record["curve"] = curve_of_log(ModelFolder(folder).log_path)
    return record | _measured(Renderer(device), model, scene, config, ply)


class FailedRun(Exception):
    """The training of a run failed. Its schedule is empty if it failed before the first iteration."""

    def __init__(self, error: TrainingError, schedule: str) -> None:
        super().__init__(str(error))
        self.schedule = schedule


def train_in(
    folder: Path,
    scene: Scene,
    config: TrainConfig,
    device: Device,
    progress: Callable[[Progress], None] | None = None,
    visit: Visit | None = None,
) -> tuple[Model, str]:
    """Train in a model folder, or go on with the run there, and return the model and its schedule.

    Raises
    ------
    FailedRun : the training failed. KeyboardInterrupt : the run was stopped; its checkpoint is saved.
    Other exceptions are those of `train`.
    """
    model_folder = ModelFolder(folder)
    resume = model_folder.checkpoint_path.is_file()
    if not resume:
        warm_up(scene, config, device)
    schedules: list[str] = []

    def remember(trainer: Trainer, stop: threading.Event) -> None:
        if not schedules:
            schedules.append(str(trainer.kernels.schedule))
        if visit is not None:
            visit(trainer, stop)

    try:
        # A folder without a checkpoint holds a run that was killed before it saved anything.
        model = train(scene, config, progress, output=folder, resume=resume, overwrite=not resume, visit=remember)
    except InputError as error:
        if not resume:
            raise
        reason = "its checkpoint or its scene has changed"
        raise InputError(f"{folder}: the run cannot be resumed ({reason}): delete this folder to repeat it") from error
    except TrainingError as error:
        raise FailedRun(error, schedules[0] if schedules else "") from error
    if not model.finished:
        raise KeyboardInterrupt
    # A run that was finished already has visited no iteration.
    return model, schedules[0] if schedules else str(Checkpoint.load(model_folder.checkpoint_path).schedule)


def curve_of_log(path: Path) -> list[dict[str, Any]]:
    """Return the measurements of the test views in a run's log, in the form of a record's "curve"."""
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [
        {
            "iteration": line["iteration"],
            "seconds": line["seconds"],
            "psnr": line["test_psnr"],
            "ssim": line["test_ssim"],
        }
        for line in lines
        if "test_psnr" in line
    ]


def _measured(renderer: Renderer, model: Model, scene: Scene, config: TrainConfig, ply: Path | None) -> Record:
    """Return what a record holds of a finished run, except its curve and its time on the processor."""
    with tempfile.TemporaryDirectory() as place:
        file = ply or Path(place) / "splats.ply"
        model.splats.save(file)
        measured = measure_model(renderer, model.splats, file, scene, config, model.evaluations.get(config.iterations))
    return measured | {
        "seconds": model.seconds,
        "device_bytes": model.device_bytes,
        "peak_bytes": model.peak_bytes,
    }


def empty_record(device: Device, schedule: object) -> Record:
    """Return the record of a run that has measured nothing yet: where it runs, and None for each measurement."""
    return dict.fromkeys((*MEASURED, "peak_bytes", "digest", "curve", "failed")) | {
        "finite": False,
        "cap_held": True,
        "device": str(device.info),
        "driver": f"{device.info.driver} ({device.info.version})",
        "schedule": str(schedule),
        "version": __version__,
        "protocol": DEFAULT_PROTOCOL.describe(),
        "renders_per_view": RENDERS,
    }


def measure_model(
    renderer: Renderer,
    splats: Splats,
    file: Path,
    scene: Scene,
    config: TrainConfig,
    evaluation: Evaluation | None = None,
    *,
    repeat_renders: bool = True,
) -> Record:
    """Return what a record holds of a finished model, measured on the test views.

    Parameters
    ----------
    file : the saved model. evaluation : of the test views, if it is known already.
    repeat_renders : whether the render time is that of `render_ms`, or that of one render of each view.
    """
    arrays = splats.arrays
    evaluation = evaluation or evaluate(renderer, splats, scene.test, config.background)
    return {
        "psnr": evaluation.psnr,
        "ssim": evaluation.ssim,
        "render_ms": render_ms(renderer, splats, scene.test, config.background)
        if repeat_renders
        else evaluation.render_ms,
        "renders_per_view": RENDERS if repeat_renders else 1,
        "splats": len(splats),
        "bytes": file.stat().st_size,
        "parameters": sum(array.size for array in arrays.values()),
        "finite": all(bool(np.isfinite(array).all()) for array in arrays.values()),
        "cap_held": len(splats) <= config.cap_max,
        "digest": digest(arrays),
    }


def render_ms(renderer: Renderer, splats: Splats, views: Sequence[View], background: Color) -> float:
    """Return the render time [ms]: the median over the views of the fastest of RENDERS renders.

    The fastest render counts because other work on the machine only adds time.
    """
    fastest = []
    for view in views:
        times = []
        for _ in range(RENDERS):
            start = time.perf_counter()
            renderer.render(splats, view.camera, background)
            times.append(1e3 * (time.perf_counter() - start))
        fastest.append(min(times))
    return statistics.median(fastest)


def curve_iterations(iterations: int, points: int) -> tuple[int, ...]:
    """Return the iterations to measure: at most `points` in equal ratios, with the last iteration of the run."""
    first = max(1.0, iterations / 64)  # earlier images show little
    return tuple(sorted({round(at) for at in np.geomspace(iterations, first, points)}))


def digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 of arrays: their names, shapes, types and bits."""
    result = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        result.update(f"{name} {array.shape} {array.dtype.str}\n".encode() + array.tobytes())
    return result.hexdigest()

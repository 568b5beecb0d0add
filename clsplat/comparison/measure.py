"""One training run of a comparison, measured on the test views."""

from __future__ import annotations

import hashlib
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._version import __version__
from ..device.device import Device
from ..errors import TrainingError
from ..evaluation.evaluate import Evaluation, evaluate
from ..evaluation.metrics import DEFAULT_PROTOCOL
from ..rendering.renderer import Renderer
from ..scenes.scene import Scene, View
from ..splats.color import Color
from ..splats.splats import Splats
from ..training.config import TrainConfig
from ..training.log import Progress
from ..training.trainer import Trainer
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
    cpu_seconds = time.process_time() - started
    with tempfile.TemporaryDirectory() as folder:
        file = ply or Path(folder) / "splats.ply"
        model.splats.save(file)
        measured = measure_model(
            trainer.renderer, model.splats, file, scene, config, model.evaluations.get(config.iterations)
        )
    record |= measured | {
        "seconds": model.seconds,
        "cpu_seconds": cpu_seconds,
        "device_bytes": model.device_bytes,
        "peak_bytes": model.peak_bytes,
    }
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
    return record


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

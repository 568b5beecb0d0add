"""One run of a benchmark: training in a folder, so that it can be resumed, and its measurement."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from itertools import count
from pathlib import Path

from .. import activity
from ..comparison.measure import FailedRun, empty_record, measure_model, train_in
from ..comparison.table import Record
from ..device.device import Device
from ..evaluation.evaluate import evaluate
from ..evaluation.metrics import PROTOCOLS
from ..evaluation.perceptual import Lpips
from ..models.measurements import ViewRecorder
from ..rendering.renderer import Rendered, Renderer
from ..scenes.scene import Scene, View
from ..training.config import TrainConfig
from ..training.decisions import decide
from ..training.folder import ModelFolder
from ..training.log import Progress
from ..training.trainer import Visit

PROTOCOL = PROTOCOLS["3dgs"]  # papers report the metrics of 3DGS's script


def train_and_measure_in(
    folder: Path,
    scene: Scene,
    config: TrainConfig,
    device: Device,
    lpips: Lpips | None = None,
    progress: Callable[[Progress], None] | None = None,
    visit: Visit | None = None,
) -> Record:
    """Train in a model folder, or resume the run there, and return the record as `comparison.train_and_measure` does.

    The metrics are those of 3DGS. "lpips" is also in the record, None if it is not measured.

    Raises
    ------
    KeyboardInterrupt : the run was stopped; its checkpoint is saved.
    Other exceptions are those of `train`. A run whose training fails raises nothing: its record has the message.
    """
    config = decide(scene, config).config  # the record has the options of the run
    try:
        model, schedule = train_in(folder, scene, config, device, progress, visit)
    except FailedRun as failed:
        return _described(empty_record(device, failed.schedule), None) | {"failed": str(failed)}
    renderer, recorder, numbers = Renderer(device), ViewRecorder(lpips, report=False), count(1)

    def on_view(view: View, image: Rendered) -> None:
        activity.report(f"measuring test view {next(numbers)} of {len(scene.test)}")
        recorder(view, image)

    evaluation = evaluate(renderer, model.splats, scene.test, config.background, PROTOCOL, on_view)
    file = ModelFolder(folder).ply_path(model.iteration)
    record = _described(empty_record(device, schedule), lpips)
    record |= measure_model(renderer, model.splats, file, scene, config, evaluation, repeat_renders=False)
    return record | {
        "seconds": model.seconds,
        "device_bytes": model.device_bytes,
        "peak_bytes": model.peak_bytes,
        "lpips": statistics.fmean(recorder.per_view["LPIPS"].values()) if lpips is not None else None,
    }


def _described(record: Record, lpips: Lpips | None) -> Record:
    """Return a record that says how its metrics are computed, with a place for LPIPS."""
    described = PROTOCOL.describe() | ({} if lpips is None else {"LPIPS": lpips.describe()})
    return record | {"protocol": described, "lpips": None}

"""Systems trained side by side: same scenes, caps, iterations and seeds, one line of JSON a run, resumable."""

from __future__ import annotations

import hashlib
import json
import re
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._version import __version__
from ..device.device import Device, open_device
from ..errors import InputError, OutputError, TrainingError
from ..evaluation.evaluate import evaluate
from ..evaluation.metrics import DEFAULT_PROTOCOL
from ..files.atomic import atomic_writer
from ..files.json_file import write_json
from ..files.lock import folder_lock
from ..rendering.renderer import Renderer
from ..scenes.scene import Scene, View
from ..splats.splats import Splats
from ..training.config import FREE_OPTIONS, TrainConfig
from ..training.log import Progress
from ..training.trainer import Trainer
from .methods import Method
from .table import MEASURED, Record, markdown, notes, summarise

RUNS, TABLE, RESULTS, MODELS = "runs.jsonl", "table.md", "results.json", "models"
WARM_UP = 3  # iterations
RENDERS = 5  # of each view, for the time of one


@dataclass(frozen=True)
class Run:
    """One training run that is wanted: the `number`th of `total` on its scene; `repeat`s of a run are 1, 2, ..."""

    scene: str
    system: str
    config: TrainConfig
    number: int
    total: int
    repeat: int = 0

    def __str__(self) -> str:
        config = self.config
        again = f" repeat {self.repeat}" if self.repeat else ""
        return f"[{self.number}/{self.total}] {self.scene} {self.system} cap {config.cap_max} seed {config.seed}{again}"

    @property
    def stem(self) -> str:
        """For file names: system, cap, seed and repeat."""
        again = f"-repeat{self.repeat}" if self.repeat else ""
        return re.sub(r"[^\w.=,-]", "_", f"{self.system}-cap{self.config.cap_max}-seed{self.config.seed}{again}")


class RunFile:
    """runs.jsonl: the runs that are done, appended one by one; a run done again replaces its line."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / RUNS
        text = ""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if self.path.exists():
                text = self.path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise OutputError(f"{self.path}: cannot be used ({reason}): choose another folder") from None
        self.records = parse_runs(text)
        self._separator = "" if not text or text.endswith("\n") else "\n"

    def find(self, scene: Mapping[str, Any], system: str, config: TrainConfig, repeat: int = 0) -> Record | None:
        """The record of a run, if it is done."""
        wanted = run_key({"scene": scene, "system": system, "config": config.to_json(), "repeat": repeat})
        return next((record for record in self.records if run_key(record) == wanted), None)

    def add(self, record: Record) -> None:
        """Append a record, or put it in the place of the same run's; OutputError where it cannot be written."""
        record = json.loads(json.dumps(record))
        for place, other in enumerate(self.records):
            if run_key(other) == run_key(record):
                self.records[place] = record
                with atomic_writer(self.path) as whole:
                    whole.write("".join(json.dumps(line) + "\n" for line in self.records).encode())
                self._separator = ""
                return
        try:
            with self.path.open("a", encoding="utf-8") as stream:
                stream.write(self._separator + json.dumps(record) + "\n")
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written ({error.strerror or error}): free some space") from None
        self._separator = ""
        self.records.append(record)


def parse_runs(text: str) -> list[Record]:
    """The records of a runs.jsonl; a line cut short by a crash is left out: that run is done again."""
    records = []
    for line in text.splitlines():
        try:
            record = json.loads(line)
        except ValueError:
            continue
        if isinstance(record, dict) and record.keys() >= _KEYS:
            records.append(record)
    return records


def compare(
    scenes: Iterable[Scene],
    systems: Sequence[Method],
    output: str | Path,
    caps: Sequence[int],
    seeds: Sequence[int],
    common: Mapping[str, Any] | None = None,
    *,
    save_models: bool = False,
    curve: int = 0,
    repeat: int = 1,
    extra: Mapping[str, Any] | None = None,
    progress: Callable[[Progress], None] | None = None,
    on_run: Callable[[Run, Record | None], None] | None = None,
) -> list[Record]:
    """Train every system at every cap with every seed on every scene, and measure it on the test views.

    Runs that `output` has already are not done again. The table is of all runs there, these and earlier ones.

    Parameters
    ----------
    scenes : with test views; one after the other, so that they may be loaded as they are needed.
    output : folder of runs.jsonl, table.md and results.json; after Ctrl-C too.
    common : options of all systems, by TrainConfig's names.
    save_models : keep the splats of each run in `output`/models.
    curve : measure the test views at about that many iterations along each run; a run without is done again.
    repeat : how often to train the first seed: on one device the splats are the same bits each time.
    extra : more keys of each record.
    progress : as `train`'s. on_run : called with each run and None before it, and with its record after it.

    Returns
    -------
    All runs in `output`, in the order they were made; `compare_table.summarise` makes the table's rows of them.

    Raises
    ------
    InputError : a scene without test views, or options that do not fit a system. OutputError : cannot be written, or
    another comparison writes there. DeviceError : no device, or not enough memory. A run whose training fails is a
    record of its own ("failed").
    """
    folder = Path(output)
    # Systems innermost: an interrupted comparison has as many runs of each.
    configs = [
        (system.label, system.config(cap, seed, common), again)
        for cap in caps
        for seed in seeds
        for again in range(repeat if seed == seeds[0] else 1)
        for system in systems
    ]
    runs = RunFile(folder)
    device: Device | None = None
    warm: set[str] = set()
    with folder_lock(folder):
        try:
            for scene in scenes:
                if not scene.test:
                    raise InputError(f"{scene.path}: no test views to measure on: load it with eval")
                identity = scene_identity(scene)
                for number, (label, config, again) in enumerate(configs, 1):
                    done = runs.find(identity, label, config, again)
                    if done is not None and (not curve or done.get("curve") is not None):
                        continue
                    run = Run(scene.name, label, config, number, len(configs), again)
                    if on_run is not None:
                        on_run(run, None)
                    device = device or open_device(config.device)
                    if label not in warm:
                        warm_up(scene, config, device)
                        warm.add(label)
                    ply = folder / MODELS / f"{scene.name}-{run.stem}.ply" if save_models else None
                    record = {
                        "scene": identity,
                        "system": label,
                        "config": config.to_json(),
                        "repeat": again,
                        **train_and_measure(scene, config, device, progress, ply, curve),
                        **(extra or {}),
                    }
                    runs.add(record)
                    if on_run is not None:
                        on_run(run, record)
        finally:
            write_table(folder, runs.records)
    return runs.records


def warm_up(scene: Scene, config: TrainConfig, device: Device) -> None:
    """Let the driver compile, which it does at a kernel's first launch, so that no run's seconds hold it."""
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
    """One run: what compare_table.MEASURED names, and on what it was measured.

    `seconds` is of training, `cpu_seconds` that of all threads of this process, with preparation and the curve's
    measurements; `peak_bytes` is the most that the whole process has held so far and never falls, `device_bytes` is of
    this run's working buffers; `digest` tells whether two runs made the same splats.

    Parameters
    ----------
    ply : where to write the splats; None: written only to be weighed.
    curve : points of the record's "curve": iteration, training seconds, PSNR and SSIM of the test views.
    """
    started = time.process_time()
    record: Record = dict.fromkeys((*MEASURED, "peak_bytes", "digest")) | {
        "curve": [] if curve else None,
        "failed": None,
        "finite": False,
        "cap_held": True,
        "device": str(device.info),
        "driver": f"{device.info.driver} ({device.info.version})",
        "version": __version__,
        "protocol": DEFAULT_PROTOCOL.describe(),
    }
    along = curve_iterations(config.iterations, curve)
    trainer = Trainer(scene, config.replace(test_iterations=along), progress=progress, device=device)
    record["schedule"] = str(trainer.kernels.schedule)
    try:
        model = trainer.run()
    except TrainingError as error:
        return record | {"failed": str(error)}
    cpu_seconds = time.process_time() - started
    measured = model.evaluations.get(config.iterations) or evaluate(
        trainer.renderer, model.splats, scene.test, config.background
    )
    arrays = model.splats.arrays
    with tempfile.TemporaryDirectory() as folder:
        file = ply or Path(folder) / "splats.ply"
        model.splats.save(file)
        nbytes = file.stat().st_size
    return record | {
        "psnr": measured.psnr,
        "ssim": measured.ssim,
        "seconds": model.seconds,
        "render_ms": render_ms(trainer.renderer, model.splats, scene.test, config.background),
        "cpu_seconds": cpu_seconds,
        "splats": len(model.splats),
        "bytes": nbytes,
        "parameters": sum(array.size for array in arrays.values()),
        "device_bytes": model.device_bytes,
        "peak_bytes": model.peak_bytes,
        "finite": all(bool(np.isfinite(array).all()) for array in arrays.values()),
        "cap_held": len(model.splats) <= config.cap_max,
        "digest": digest(arrays),
        "curve": [
            {
                "iteration": it,
                "seconds": model.evaluation_seconds[it],
                "psnr": model.evaluations[it].psnr,
                "ssim": model.evaluations[it].ssim,
            }
            for it in along
        ]
        if curve
        else None,
    }


def render_ms(renderer: Renderer, splats: Splats, views: Sequence[View], background: Sequence[float]) -> float:
    """Median over the views of the fastest of RENDERS renders: whatever else the machine does only adds."""
    times = []
    for view in views:
        own = []
        for _ in range(RENDERS):
            start = time.perf_counter()
            renderer.render(splats, view.camera, background)
            own.append(1e3 * (time.perf_counter() - start))
        times.append(min(own))
    return statistics.median(times)


def curve_iterations(iterations: int, points: int) -> tuple[int, ...]:
    """Where to measure along a run: at most `points` iterations in equal ratios, the last one last."""
    first = max(1.0, iterations / 64)  # before that there is little to see
    return tuple(sorted({round(at) for at in np.geomspace(iterations, first, points)}))


def digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of arrays: their names, shapes, types and bits."""
    found = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        found.update(f"{name} {array.shape} {array.dtype.str}\n".encode() + array.tobytes())
    return found.hexdigest()


def scene_identity(scene: Scene) -> dict[str, Any]:
    """What tells one scene, read in one way, from another: name, size of the first view, views of either set."""
    camera = scene.views[0].camera
    return {
        "name": scene.name,
        "width": camera.width,
        "height": camera.height,
        "train": len(scene.train),
        "test": len(scene.test),
    }


def write_table(folder: Path, records: Sequence[Record]) -> None:
    """Write table.md and results.json, if there is anything to tell."""
    if records:
        rows = summarise(records)
        with atomic_writer(folder / TABLE) as stream:
            stream.write(markdown(records).encode())
        write_json(folder / RESULTS, {"rows": rows, "notes": notes(records, rows)})


# What a line of runs.jsonl must have.
_KEYS = {
    "scene",
    "system",
    "config",
    "failed",
    "finite",
    "cap_held",
    "device",
    "driver",
    "schedule",
    "version",
    "protocol",
    *MEASURED,
}


def run_key(record: Mapping[str, Any]) -> str:
    """What makes a record the one of a run: scene, system, options that change something, and which repeat it is."""
    options = {key: value for key, value in record["config"].items() if key not in FREE_OPTIONS}
    return json.dumps([record["scene"], record["system"], options, record.get("repeat", 0)], sort_keys=True)

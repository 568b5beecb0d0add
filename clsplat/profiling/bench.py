"""The time of a training step and of a rendered image, stage by stage, compared with the limits of the device."""

from __future__ import annotations

import dataclasses
import itertools
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..device.device import Device
from ..device.trace import recorded
from ..errors import InputError
from ..files.atomic import atomic_writer
from ..rendering.frame import Frame
from ..rendering.overdraw import count_pairs
from ..rendering.pipeline import Pipeline
from ..scenes.scene import Scene
from ..splats.splats import Splats
from ..training.config import PUBLISHED_ITERATIONS, TrainConfig
from ..training.decisions import screen_filter
from ..training.trainer import Trainer
from .roofline import Roofline
from .stages import HOST, STAGES, Sizes, by_stage, work_of

WARM_UP = 4  # iterations that are not counted: kernels are built, buffers grow, the SH degree rises to 3
MAX_ITERATIONS = 1000  # few enough that the strategy does not act; its action is measured separately


@dataclass(frozen=True)
class StageTime:
    """One stage of an iteration, medians over iterations.

    Attributes
    ----------
    ms : device time. For `host`: the rest of the wall time. For `strategy`: the wall time of one action, divided by the
        number of iterations between two actions.
    share : fraction of the iteration's wall time.
    bytes, flops : minimum that the stage has to move and compute (stages.Work); 0 if it is not counted.
    of_copy, of_fma : the rate achieved, as a fraction of the measured limit; None if it is not counted.
    """

    stage: str
    ms: float
    share: float
    bytes: int = 0
    flops: int = 0
    of_copy: float | None = None
    of_fma: float | None = None


@dataclass(frozen=True)
class Report:
    """Measured times of one task.

    Attributes
    ----------
    task : "training step" or "render".
    width, height : size of the largest image [px].
    sizes : medians over the iterations.
    wall_ms : wall time of an iteration until the device has finished, with the strategy's part.
    """

    task: str
    shape: str
    width: int
    height: int
    iterations: int
    sizes: Sizes
    wall_ms: float
    stages: tuple[StageTime, ...]

    @property
    def useful(self) -> float:
        """Useful pairs as a fraction of all pairs of an isect's splat and its tile's 256 pixels."""
        return self.sizes.pairs / max(256 * self.sizes.isects, 1)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for json.dump."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Report:
        """Return the report of values from `to_json`; InputError if they are not a report."""
        try:
            sizes = Sizes(**values["sizes"])
            stages = tuple(StageTime(**stage) for stage in values["stages"])
            return cls(**values | {"sizes": sizes, "stages": stages})
        except (KeyError, TypeError) as error:
            raise InputError(f"not a report of stages: {error}") from None


def bench_trainer(scene: Scene, device: Device, shape: str, start: Splats | int, sh_degree: int = 3) -> Trainer:
    """Return a training run at full image size and full SH degree, as in the middle of 30 000 iterations.

    Parameters
    ----------
    start : the splats, whose number stays; or the maximum number of the scene's points to start from.

    Raises
    ------
    DeviceError : the device does not have the memory. InputError : the scene has no training view.
    """
    screen: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        if isinstance(start, Splats):
            init, cap = str(Path(folder) / "start.ply"), len(start)
            start.save(init)
            screen = {"antialiased": start.antialiased, "low_pass": start.low_pass}
        else:
            init, cap = "sfm", start
        config = TrainConfig(
            shape=shape,
            iterations=PUBLISHED_ITERATIONS,
            cap_max=cap,
            sh_degree=sh_degree,
            sh_interval=1,
            coarse_to_fine=False,
            init=init,
            **screen,
        )
        return Trainer(scene, config.replace(**screen_filter(config)), device=device)


def measure_training(trainer: Trainer, limits: Roofline, iterations: int) -> Report:
    """Time `iterations` training steps, waiting for each, and one action of the strategy."""
    measured = _measure("training step", trainer, trainer.step, limits, iterations)
    start = time.perf_counter()
    trainer.density.densify(trainer.iteration)
    trainer.device.finish()
    action_ms = 1e3 * (time.perf_counter() - start) / trainer.config.densify_every
    wall_ms = measured.wall_ms + action_ms
    stages = [dataclasses.replace(stage, share=stage.ms / wall_ms) for stage in measured.stages]
    stages.insert(-1, StageTime("strategy", action_ms, action_ms / wall_ms))
    return dataclasses.replace(measured, wall_ms=wall_ms, stages=tuple(stages))


def measure_render(trainer: Trainer, limits: Roofline, iterations: int) -> Report:
    """Time `iterations` images of the run's splats. The images stay on the device."""
    cameras = itertools.cycle(view.camera for view in trainer.scene.train)

    def render() -> Frame:
        return trainer.pipeline.forward(trainer.splats, next(cameras), trainer.config.background)

    return _measure("render", trainer, render, limits, iterations)


def write_reports(path: Path, trainer: Trainer, limits: Roofline, scene: str, reports: Sequence[Report]) -> None:
    """Write all measurements as JSON, with the device, the schedule and the limits.

    Parameters
    ----------
    scene : the scene's name.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    info = trainer.device.info
    values = {
        "device": info.name,
        "platform": info.platform,
        "driver": info.driver,
        "schedule": str(trainer.kernels.schedule),
        "scene": scene,
        "copy_bytes_per_s": limits.copy,
        "fma_flops_per_s": limits.fma,
        "reports": [report.to_json() for report in reports],
    }
    with atomic_writer(path) as stream:
        stream.write(json.dumps(values, indent=1).encode())


@dataclass(frozen=True)
class _Iteration:
    """One iteration: wall time and time of each stage [ms], and sizes."""

    wall_ms: float
    stage_ms: dict[str, float]
    sizes: Sizes


def _measure(task: str, trainer: Trainer, run: Callable[[], Frame], limits: Roofline, iterations: int) -> Report:
    if not 1 <= iterations <= MAX_ITERATIONS:
        raise InputError(f"{iterations} iterations: must be 1 to {MAX_ITERATIONS}")
    timed = [_timed(trainer.pipeline, run) for _ in range(WARM_UP + iterations)][WARM_UP:]
    wall_ms = statistics.median(one.wall_ms for one in timed)
    stages = [
        _stage_time(stage, timed, trainer, limits, wall_ms)
        for stage in (*STAGES, HOST)
        if any(stage in one.stage_ms for one in timed)
    ]
    sizes = Sizes(
        *(
            int(statistics.median(dataclasses.astuple(one.sizes)[i] for one in timed))
            for i in range(len(dataclasses.fields(Sizes)))
        )
    )
    largest = max((view.camera for view in trainer.scene.train), key=lambda c: c.width * c.height)
    return Report(task, trainer.config.shape, largest.width, largest.height, iterations, sizes, wall_ms, tuple(stages))


def _timed(pipeline: Pipeline, run: Callable[[], Frame]) -> _Iteration:
    device = pipeline.device
    device.finish()
    with recorded(device) as launches:
        start = time.perf_counter()
        frame = run()
        device.finish()
        wall_ms = 1e3 * (time.perf_counter() - start)
    stage_ms: dict[str, float] = {}
    for stage, launch in by_stage(launches):
        stage_ms[stage] = stage_ms.get(stage, 0.0) + launch.ms
    stage_ms[HOST] = max(wall_ms - sum(stage_ms.values()), 0.0)
    layout = frame.layout
    sizes = Sizes(
        frame.n_splats, frame.n_isects, layout.width * layout.height, count_pairs(pipeline, frame), frame.sh_degree
    )
    return _Iteration(wall_ms, stage_ms, sizes)


def _stage_time(stage: str, timed: list[_Iteration], trainer: Trainer, limits: Roofline, wall_ms: float) -> StageTime:
    times = [one.stage_ms.get(stage, 0.0) for one in timed]
    ms = statistics.median(times)
    is_cpu = trainer.device.info.type == "CPU"
    work = [amount for one in timed if (amount := work_of(trainer.kernels, one.sizes, is_cpu).get(stage))]
    if not work:
        return StageTime(stage, ms, ms / wall_ms)

    def fraction(amounts: list[int], limit: float) -> float | None:
        rates = [amount / (1e-3 * t * limit) for amount, t in zip(amounts, times, strict=True) if t > 0]
        return statistics.median(rates) if any(amounts) and rates else None

    moved, computed = [one.bytes for one in work], [one.flops for one in work]
    return StageTime(
        stage,
        ms,
        ms / wall_ms,
        int(statistics.median(moved)),
        int(statistics.median(computed)),
        fraction(moved, limits.copy),
        fraction(computed, limits.fma),
    )

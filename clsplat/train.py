"""Training: sample a view, render, loss, backward, step, densify, checkpoint."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .buffers import ParameterBuffers, SplatBuffers
from .camera import Camera
from .cameras_json import NamedCamera
from .checkpoint import Checkpoint
from .config import TrainConfig
from .densify import plan_relocation
from .device import Device, Schedule, open_device
from .errors import InputError, OutputError, TrainingError
from .evaluate import Evaluation, evaluate
from .images import ImageU8, resize_area
from .initialise import initial_splats
from .kernels import KernelBuild
from .loss import ImageLoss, LossValue
from .memory import check, estimate, peak_bytes
from .model_folder import ModelFolder
from .optim import make_optimizer
from .pipeline import ImageLayout, Pipeline
from .render import Renderer
from .scene import Scene, View
from .schedules import downscale_at, exponential_decay, resolution_schedule, sh_degree_at
from .splats import Splats
from .tuning import schedule_for

LOG_INTERVAL = 50  # iterations between lines of log.jsonl and calls of `progress`


@dataclass(frozen=True)
class Progress:
    """What a progress display needs; `psnr` is of the last training image, `seconds` of training only."""

    iteration: int
    iterations: int
    loss: float
    psnr: float
    n_splats: int
    seconds: float
    per_second: float
    message: str = ""

    @property
    def seconds_left(self) -> float:
        return (self.iterations - self.iteration) / self.per_second if self.per_second > 0 else math.inf


@dataclass(frozen=True)
class Model:
    """A trained model.

    Attributes
    ----------
    iteration : iterations done; below the config's when the run was interrupted.
    seconds : training time, without evaluations. peak_bytes : of host memory (on a CPU device it holds all).
    evaluations, evaluation_seconds : on test views, by iteration, where the config asked for them, and the
        training time until then.
    path : the model's folder, or None.
    """

    splats: Splats
    config: TrainConfig
    iteration: int
    seconds: float
    peak_bytes: int
    device_bytes: int
    evaluations: dict[int, Evaluation] = field(default_factory=dict)
    evaluation_seconds: dict[int, float] = field(default_factory=dict)
    path: Path | None = None

    @property
    def finished(self) -> bool:
        return self.iteration >= self.config.iterations


def train(scene: Scene, config: TrainConfig | None = None, progress: Callable[[Progress], None] | None = None, *,
          output: str | Path | None = None, resume: bool = False, overwrite: bool = False,
          extra: dict[str, Any] | None = None) -> Model:
    """Learn a splat model of a scene's training views.

    Parameters
    ----------
    progress : called about every 50 iterations.
    output : model folder; without it nothing is written and Ctrl-C raises as usual.
    resume : go on from the folder's checkpoint; the config must be the same but for `iterations`-independent
        options such as `device`.
    overwrite : allow replacing a model in `output`.
    extra : more keys for config.json's "scene" (how it was read), beside its path and test views.

    Raises
    ------
    InputError : no training views, or a checkpoint that does not fit. OutputError : `output` holds a model and
    neither resume nor overwrite is given, or cannot be written. DeviceError : not enough memory.
    TrainingError : the loss is not finite; the last checkpoint is kept.
    """
    config = config or TrainConfig()
    folder = None if output is None else ModelFolder(output)
    checkpoint = None
    if folder is not None:
        if resume:
            checkpoint = _fitting_checkpoint(folder, config)
        elif folder.is_used and not overwrite:
            raise OutputError(f"{folder.path}: already holds a model: use --overwrite, --resume or another folder")
        folder.prepare()
    trainer = Trainer(scene, config, checkpoint, progress)
    if folder is not None:
        if checkpoint is None:
            folder.clear()
        record = {"path": str(scene.path.resolve()), "test_names": sorted(scene.test_names)}
        folder.write_config({"config": config.to_json(), "scene": record | (extra or {})})
        views = [*scene.test, *scene.train]
        folder.write_cameras([NamedCamera(view.name, view.camera) for view in views])
    return trainer.run(folder)


class Trainer:
    """One run: its device state and its loop."""

    def __init__(self, scene: Scene, config: TrainConfig, checkpoint: Checkpoint | None = None,
                 progress: Callable[[Progress], None] | None = None, device: Device | None = None) -> None:
        if not scene.train:
            raise InputError(f"{scene.path}: no training views: all are test views")
        self.scene, self.config, self.progress = scene, config, progress
        self.device = device or open_device(config.device)
        # A resumed run keeps its schedule: another one would round otherwise.
        schedule = Schedule.parse(checkpoint.schedule) if checkpoint else schedule_for(self.device)
        self.kernels = KernelBuild(config.shape, config.sh_degree, schedule, config.normalisation,
                                   skew_map=config.skew_map)
        largest = max((view.camera for view in scene.train), key=lambda c: c.width * c.height)
        self.memory = estimate(config, self.kernels, ImageLayout(largest.width, largest.height))
        check(self.memory, self.device)
        self.rng = np.random.default_rng(config.seed)
        self.iteration, self.seconds = 0, 0.0
        self.queue: list[int] = []
        if checkpoint is None:
            first, message = initial_splats(
                scene, config.shape, config.cap_max, config.sh_degree, config.init, config.seed,
                normalisation=config.normalisation, opacity=config.init_opacity, scale_factor=config.init_scale)
        else:
            first = Splats(config.shape, checkpoint.splats, config.normalisation)
            message = f"resumed at iteration {checkpoint.iteration}"
            self.iteration, self.seconds, self.queue = checkpoint.iteration, checkpoint.seconds, checkpoint.queue
            self.rng.bit_generator.state = checkpoint.rng
        self._say(f"{message}; about {self.memory}")
        capacity = max(config.cap_max, len(first))
        dtype = self.kernels.dtype
        self.pipeline = Pipeline(self.device, self.kernels)
        self.splats = SplatBuffers.of(self.device, first, dtype, capacity)
        self.grads = ParameterBuffers(self.device, self.splats.schema, capacity, dtype)
        self.optimizer = make_optimizer(self.device, self.kernels, self.splats, config)
        if checkpoint is not None:
            self.optimizer.load_state(checkpoint.optimizer)
        self.loss = ImageLoss(self.pipeline, config.lambda_dssim)
        self.optim_program = self.kernels.optim_program(self.device)
        self.renderer = Renderer(self.device)
        self.evaluations: dict[int, Evaluation] = {}
        self.evaluation_seconds: dict[int, float] = {}
        self._plan_schedules(len(first) if checkpoint is None else None)
        self._level: tuple[int, dict[int, tuple[Camera, ImageU8]]] = (0, {})

    def run(self, folder: ModelFolder | None = None) -> Model:
        """Train to the end, or to Ctrl-C; saves into `folder` on the way."""
        config = self.config
        log = _Log(folder, self.iteration)
        started, since = time.perf_counter(), self.iteration
        with stoppable(folder is not None) as stop:
            while self.iteration < config.iterations and not stop.is_set():
                start = time.perf_counter()
                self.step()
                it = self.iteration
                ends = it == config.iterations
                if it % LOG_INTERVAL == 0 or ends:
                    value = self.loss.value()
                    self.seconds += time.perf_counter() - start
                    self._report(value, log, since, started)
                else:
                    self.seconds += time.perf_counter() - start
                if it in config.test_iterations and self.scene.test:
                    self.evaluations[it] = self.evaluate(self.scene.test)
                    self.evaluation_seconds[it] = self.seconds
                    log.write({"iteration": it, "seconds": self.seconds, "test_psnr": self.evaluations[it].psnr,
                               "test_ssim": self.evaluations[it].ssim, "splats": self.splats.n})
                if folder is not None and (it in config.save_iterations or ends):
                    folder.save(self.snapshot(), it)
                if folder is not None and (ends or (config.checkpoint_interval
                                                    and it % config.checkpoint_interval == 0)):
                    log.flush()
                    self.checkpoint().save(folder.checkpoint_path)
        if folder is not None and self.iteration < config.iterations:
            log.flush()
            self.checkpoint().save(folder.checkpoint_path)
        return Model(self.snapshot(), config, self.iteration, self.seconds, peak_bytes(), self.pipeline.pool.nbytes,
                     self.evaluations, self.evaluation_seconds, None if folder is None else folder.path)

    def step(self) -> None:
        """One iteration: one image, one optimizer step, and what the strategy does after it."""
        config = self.config
        self.iteration += 1
        it = self.iteration
        camera, image = self._next_view()
        degree = sh_degree_at(it, self.sh_interval, config.sh_degree)
        layout = self.loss.set_truth(image)
        frame = self.pipeline.forward(self.splats, camera, config.background, degree)
        self.pipeline.backward(frame, self.loss.gradient(layout), self.grads)
        if config.opacity_reg or config.scale_reg:
            n = self.splats.n
            self.optim_program.regularise.over(
                -(-n // self.kernels.lanes), geom=self.splats.geom, grad_geom=self.grads.geom,
                capacity=self.splats.capacity, opacity_scale=config.opacity_reg / n,
                scale_scale=config.scale_reg / (3 * n))
        mean_lr = self.scene.extent * self.mean_rate(it)  # the noise keeps to the published amount
        self.optimizer.step(self.grads, mean_lr * config.rate_factor("mean"), degree)
        if self.densify_first <= it <= self.densify_last and it % config.densify_interval == 0:
            self.densify()
        if config.noise_lr:
            self.optim_program.mcmc_noise.over(
                -(-self.splats.n // self.kernels.lanes), 1 if self.device.info.type == "CPU" else 64, geom=self.splats.geom,
                capacity=self.splats.capacity, n_splats=self.splats.n, seed_lo=config.seed & 0xFFFFFFFF,
                seed_hi=config.seed >> 32, iteration=it, amount=config.noise_lr * mean_lr)

    def densify(self) -> None:
        """Relocate dead and non-finite splats, grow towards the cap."""
        arrays = self.splats.download(self.splats.n)
        finite = np.ones(self.splats.n, bool)
        for array in arrays.values():
            finite &= np.isfinite(array.reshape(len(array), -1)).all(axis=1)
        pull = self.pipeline.read_pull(self.splats.n) if self.config.sampling == "pull" else None
        rule = "length" if self.config.normalisation == "peak" or "skew" not in arrays else "opacity-only"
        self.optimizer.apply(plan_relocation(arrays["opacity_logit"], arrays["log_scale"], self.rng,
                                             self.config.cap_max, self.growth, skew=arrays.get("skew"),
                                             finite=finite, rule=rule, pull=pull))
        self.pipeline.reset_pull()

    def snapshot(self) -> Splats:
        """The splats as they are now, on the host."""
        try:
            return Splats(self.config.shape, self.splats.download(self.splats.n), self.config.normalisation)
        except InputError as error:
            raise TrainingError(f"iteration {self.iteration}: {error}: lower the learning rates") from None

    def checkpoint(self) -> Checkpoint:
        """Everything that the rest of the run depends on."""
        return Checkpoint(self.iteration, self.config.to_json(), self.splats.download(self.splats.n),
                          self.optimizer.state(), self.rng.bit_generator.state, self.queue,  # type: ignore[arg-type]
                          self.seconds, str(self.kernels.schedule))

    def evaluate(self, views: list[View]) -> Evaluation:
        """Metrics of the present splats."""
        return evaluate(self.renderer, self.snapshot(), views, self.config.background)

    def _plan_schedules(self, n_first: int | None) -> None:
        config = self.config
        steps = config.iterations
        self.mean_rate = exponential_decay(config.position_lr_init, config.position_lr_final, steps)
        self.sh_interval = config.sh_interval or max(1, min(1000, steps // 10))
        side = min(min(v.camera.width, v.camera.height) for v in self.scene.train)
        stages = resolution_schedule(steps, image_side=side) if config.coarse_to_fine else [(0, 1)]
        self.stages = stages
        self.densify_first = max(int(config.densify_from * steps), 1)
        self.densify_last = int(config.densify_until * steps)
        n_points = len(self.scene.points.xyz) if n_first is None else n_first
        self.growth = growth_factor(config, max(n_points, 1), self.densify_last - self.densify_first)

    def _next_view(self) -> tuple[Camera, ImageU8]:
        """Next view of a random order without repetition, at the resolution of this iteration."""
        if not self.queue:
            self.queue = self.rng.permutation(len(self.scene.train)).tolist()
        index = self.queue.pop()
        downscale = downscale_at(self.stages, self.iteration - 1)
        if self._level[0] != downscale:
            self._level = (downscale, {})
        cache = self._level[1]
        if index not in cache:
            view = self.scene.train[index]
            cache[index] = (view.camera, view.image) if downscale == 1 else reduced(view, downscale)
        return cache[index]

    def _report(self, value: LossValue, log: _Log, since: int, started: float) -> None:
        if not math.isfinite(value.total):
            raise TrainingError(f"iteration {self.iteration}: the loss is not finite: lower the learning rates; "
                                "the last checkpoint is kept")
        speed = (self.iteration - since) / (time.perf_counter() - started)
        log.write({"iteration": self.iteration, "loss": value.total, "l1": value.l1, "ssim": value.ssim,
                   "psnr": value.psnr, "splats": self.splats.n, "seconds": self.seconds})
        if self.progress is not None:
            self.progress(Progress(self.iteration, self.config.iterations, value.total, value.psnr, self.splats.n,
                                   self.seconds, speed))

    def _say(self, message: str) -> None:
        if self.progress is not None:
            self.progress(Progress(self.iteration, self.config.iterations, math.nan, math.nan, 0, self.seconds, 0,
                                   message))


def reduced(view: View, downscale: int) -> tuple[Camera, ImageU8]:
    """A view at 1/downscale of its size."""
    width, height = max(view.camera.width // downscale, 1), max(view.camera.height // downscale, 1)
    return view.camera.resized(width, height), resize_area(view.image, width, height)


def growth_factor(config: TrainConfig, n_first: int, window: int) -> float:
    """Growth of the count per action: `config.growth`, or what reaches the cap halfway through the window."""
    actions = max(window // config.densify_interval // 2, 1)
    return max(config.growth, (config.cap_max / n_first) ** (1 / actions))


@contextmanager
def stoppable(enabled: bool) -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; a second one interrupts as usual."""
    stop = threading.Event()
    if not enabled or threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = signal.getsignal(signal.SIGINT)

    def on_interrupt(number: int, frame: Any) -> None:
        stop.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


class _Log:
    """log.jsonl: one line per report, appended; lines past the resumed iteration are dropped."""

    def __init__(self, folder: ModelFolder | None, iteration: int) -> None:
        self.path = None if folder is None else folder.log_path
        if self.path is None:
            return
        kept = []
        if iteration and self.path.is_file():
            for line in self.path.read_text().splitlines():
                try:
                    if json.loads(line)["iteration"] <= iteration:
                        kept.append(line + "\n")
                except (ValueError, KeyError, TypeError):
                    continue  # a line cut short by a crash
        self._stream = self._guard(lambda: self.path.open("w"))  # type: ignore[union-attr]
        self._guard(lambda: self._stream.writelines(kept))

    def write(self, values: dict[str, Any]) -> None:
        if self.path is not None:
            self._guard(lambda: self._stream.write(json.dumps(values) + "\n"))
            self.flush()

    def flush(self) -> None:
        if self.path is not None:
            self._guard(self._stream.flush)

    def _guard(self, action: Callable[[], Any]) -> Any:
        try:
            return action()
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written ({error.strerror or error})") from None


def _fitting_checkpoint(folder: ModelFolder, config: TrainConfig) -> Checkpoint:
    """The folder's checkpoint if the run it belongs to had this config."""
    checkpoint = Checkpoint.load(folder.checkpoint_path)
    stored = TrainConfig.from_json(checkpoint.config).to_json()
    for key, value in config.to_json().items():
        if key not in ("device", "save_iterations", "test_iterations", "checkpoint_interval") and stored[key] != value:
            raise InputError(f"{folder.path}: --resume with {key}={value}, but the run was started with "
                             f"{key}={stored[key]}: use the same options, or --overwrite to start again")
    return checkpoint

"""One training run: sample a view, render, loss, backward, step, densify, checkpoint."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..device.device import Device, open_device
from ..device.schedule import Schedule
from ..errors import InputError, TrainingError
from ..evaluation.evaluate import Evaluation, evaluate
from ..rendering.build import KernelBuild
from ..rendering.frame import Frame, ImageLayout
from ..rendering.pipeline import Pipeline, isect_limit
from ..rendering.renderer import Renderer
from ..rendering.splat_buffers import CompactGradients, SplatBuffers, SplatStatistics
from ..rendering.tuning import schedule_for
from ..scenes.scene import Scene, View
from ..splats.optical_depth import finite_rows
from ..splats.splats import Splats
from .checkpoint import Checkpoint
from .config import TrainConfig
from .density.strategy import StepInfo, next_edit
from .exposure import ExposureLoss, exposure_bytes, exposures_json
from .folder import ModelFolder
from .initialise import initial_splats
from .interrupt import stoppable
from .log import Progress, RunLog
from .loss import ImageLoss, LossValue
from .memory_estimate import check, estimate, peak_bytes, room_for_isects
from .methods.sns import learning_groups
from .optim.noise import noise_amount, noise_reach
from .optim.optimizer import make_optimizer
from .optim.skew_map import SKEW_MAPS
from .options.density import Mcmc
from .programs import optim_program
from .rate_limits import check_rates
from .schedules import exponential_decay, sh_degree_at
from .targets import Targets, target_budget, target_bytes, target_channels
from .view_sampler import ViewSampler

Visit = Callable[["Trainer", threading.Event], None]

LOG_INTERVAL = 50  # iterations between lines of log.jsonl and calls of `progress`


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


class Trainer:
    """One run: its device state and its loop."""

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        checkpoint: Checkpoint | None = None,
        progress: Callable[[Progress], None] | None = None,
        device: Device | None = None,
    ) -> None:
        if not scene.train:
            raise InputError(f"{scene.path}: no training views: all are test views")
        check_rates(config)
        self.scene, self.config, self.progress = scene, config, progress
        self.device = device or open_device(config.device)
        # A resumed run keeps its schedule: another one would round otherwise.
        schedule = Schedule.parse(checkpoint.schedule) if checkpoint else schedule_for(self.device)
        self.kernels = KernelBuild(
            config.shape,
            config.sh_degree,
            schedule,
            config.normalisation,
            skew_map=config.skew_map or SKEW_MAPS[0],
            antialiased=config.antialiased,
        )
        largest = max((view.camera for view in scene.train), key=lambda c: c.width * c.height)
        budget = target_budget(self.device)
        channels = target_channels(scene.train, config.random_background)
        layout = ImageLayout(largest.width, largest.height)
        self.memory = estimate(
            config,
            self.kernels,
            layout,
            target_bytes(scene.train, budget, channels)
            + exposure_bytes(layout, self.kernels.dtype.itemsize, config, channels),
        )
        check(self.memory, self.device)
        self.rng = np.random.default_rng(config.seed)
        self.iteration, self.seconds = 0, 0.0
        if checkpoint is None:
            start, message = initial_splats(
                scene,
                config.shape,
                config.cap_max,
                config.sh_degree,
                config.start.init,
                config.seed,
                normalisation=config.normalisation,
                antialiased=config.antialiased,
                random_share=config.start.random_points,
                opacity=config.density.init_opacity,
                scale_factor=config.density.init_scale,
            )
            first = start.to_numpy()
        else:
            first = checkpoint.splats  # not as Splats: it may hold splats that the strategy is yet to mend
            message = f"resumed at iteration {checkpoint.iteration}"
            self.iteration, self.seconds = checkpoint.iteration, checkpoint.seconds
            self.rng.bit_generator.state = checkpoint.rng
        self._say(f"{message}; about {self.memory}")
        n_first = len(first["mean"])
        capacity = max(config.cap_max, n_first)
        dtype = self.kernels.dtype
        max_isects = min(isect_limit(self.device, self.kernels), room_for_isects(self.memory, self.device))
        self.pipeline = Pipeline(self.device, self.kernels, max_isects)
        self.splats = SplatBuffers(self.device, self.kernels.schema, capacity, dtype)
        self.splats.set(first)
        self.grads = CompactGradients(self.device, self.splats.schema, capacity, dtype)
        self.optimizer = make_optimizer(self.device, self.kernels, self.splats, config, scene.extent)
        self.loss = ImageLoss(self.pipeline.pool, self.kernels, config.loss.lambda_dssim)
        self.targets = Targets(self.device, self.kernels, scene.train, budget, channels)
        self.exposure = ExposureLoss(self.loss, self.targets, config, scene.background)
        if checkpoint is not None:
            state = dict(checkpoint.optimizer)
            self.exposure.load_state(state)
            self.optimizer.load_state(state)
            self.pipeline.statistics.write(checkpoint.signals, self.splats.capacity)
        self.optim_program = optim_program(self.device, self.kernels)
        self.renderer = Renderer(self.device)
        self.evaluations: dict[int, Evaluation] = {}
        self.evaluation_seconds: dict[int, float] = {}
        self.n_first = checkpoint.n_first if checkpoint else n_first
        self.views = ViewSampler(
            scene.train,
            config.iterations,
            config.schedule.coarse_to_fine,
            self.rng,
            checkpoint.queue if checkpoint else [],
        )
        self._plan_schedules()

    def run(self, folder: ModelFolder | None = None, visit: Visit | None = None) -> Model:
        """Train to the end, or to Ctrl-C; saves into `folder` on the way.

        Parameters
        ----------
        visit : called after each iteration with this trainer and the event that ends the run; its time is none of
            training's. It must leave the run as it is.
        """
        config = self.config
        log = RunLog(None if folder is None else folder.log_path, self.iteration)
        started, since = time.perf_counter(), self.iteration
        with stoppable(folder is not None) as stop:
            while self.iteration < config.iterations and not stop.is_set():
                start = time.perf_counter()
                self.step()
                it = self.iteration
                ends = it == config.iterations
                measured = it in config.output.test_iterations and bool(self.scene.test)
                if measured:
                    self.device.queue.finish()  # what is pending is training time
                if it % LOG_INTERVAL == 0 or ends:
                    value = self.loss.value(self.loss_result)
                    self.seconds += time.perf_counter() - start
                    self._report(value, log, since, started)
                else:
                    self.seconds += time.perf_counter() - start
                if measured:
                    self.evaluations[it] = self.evaluate(self.scene.test)
                    self.evaluation_seconds[it] = self.seconds
                    log.write(
                        {
                            "iteration": it,
                            "seconds": self.seconds,
                            "test_psnr": self.evaluations[it].psnr,
                            "test_ssim": self.evaluations[it].ssim,
                            "splats": self.splats.n,
                        }
                    )
                if folder is not None and (it in config.output.save_iterations or ends):
                    folder.save(self.snapshot(), it)
                    if config.appearance.exposure:
                        names = [view.name for view in self.scene.train]
                        folder.write_exposures(exposures_json(names, self.exposure.exposures()))
                if folder is not None and (
                    ends or (config.output.checkpoint_interval and it % config.output.checkpoint_interval == 0)
                ):
                    log.flush()
                    self.checkpoint().save(folder.checkpoint_path)
                if visit is not None:
                    start = time.perf_counter()
                    visit(self, stop)
                    started += time.perf_counter() - start
        if folder is not None and self.iteration < config.iterations:
            log.flush()
            self.checkpoint().save(folder.checkpoint_path)
        return Model(
            self.snapshot(),
            config,
            self.iteration,
            self.seconds,
            peak_bytes(),
            self.pipeline.pool.nbytes + self.targets.nbytes,
            self.evaluations,
            self.evaluation_seconds,
            None if folder is None else folder.path,
        )

    def step(self) -> Frame:
        """Do one iteration: one image, one optimizer step, and the strategy's action if it is due. Return the frame."""
        config = self.config
        self.iteration += 1
        it = self.iteration
        target = self.targets.get(*self.views.next(it, self.splats.n))
        degree = sh_degree_at(it, self.sh_interval, config.sh_degree)
        background = config.background
        if config.random_background:
            r, g, b = self.rng.random(3).tolist()
            background = r, g, b
        frame = self.pipeline.forward(self.splats, target.camera, background, degree)
        self.loss_result = self.exposure.evaluate(target, frame.images.color.buffer, background)
        self.pipeline.backward(frame, self.loss_result.v_color, self.grads)
        mean_lr = self.scene.extent * self.mean_rate(it)
        self.optimizer.step(self.grads, mean_lr * config.rate_factor("mean"), degree, it, frame.projected.depth_key)
        if self.densify_first <= it <= self.densify_last and it % config.density.densify_interval == 0:
            self.densify()
        if config.density.noise_lr and learning_groups(it, config).base:
            self.optim_program.mcmc_noise.over(
                -(-self.splats.n // self.kernels.lanes),
                self.pipeline.group,
                geom=self.splats.geom,
                capacity=self.splats.capacity,
                n_splats=self.splats.n,
                seed_lo=config.seed & 0xFFFFFFFF,
                seed_hi=config.seed >> 32,
                iteration=it,
                amount=noise_amount(config.density.noise_lr, mean_lr, self.scene.extent),
                reach=noise_reach(self.scene.extent),
            )
        return frame

    def densify(self) -> None:
        """One action of the strategy."""
        info = StepInfo(self.iteration, self.densify_last, self.growth, self.scene.extent)
        self.optimizer.settle()
        arrays, signals = self.splats.download(self.splats.n), self.pipeline.statistics.read(self.splats.n)
        if self.splats.n and not signals[SplatStatistics.TIMES_SEEN].any():
            raise TrainingError(
                f"iteration {self.iteration}: no image shows any splat (transparent, or outside): "
                "check what training starts from (init) and the learning rates"
            )
        edit = next_edit(self.config, arrays, signals, self.rng, info)
        self.optimizer.apply(self.optimizer.arranged(edit))
        self.pipeline.statistics.reset()

    def snapshot(self) -> Splats:
        """The splats as they are now, on the host, without those that are not finite."""
        arrays = self.optimizer.read()
        sound = finite_rows(arrays)
        if len(sound) and not sound.any():
            raise TrainingError(f"iteration {self.iteration}: no splat is finite any more: lower the learning rates")
        try:
            return Splats(
                self.config.shape,
                {name: array[sound] for name, array in arrays.items()},
                self.config.normalisation,
                self.config.antialiased,
            )
        except InputError as error:
            raise TrainingError(f"iteration {self.iteration}: {error}: lower the learning rates") from None

    def checkpoint(self) -> Checkpoint:
        """Everything that the rest of the run depends on."""
        return Checkpoint(
            self.iteration,
            self.config.to_json(),
            self.splats.download(self.splats.n),
            self.optimizer.state() | self.exposure.state(),
            dict(self.rng.bit_generator.state),
            self.views.queue,
            self.seconds,
            str(self.kernels.schedule),
            self.n_first,
            self.pipeline.statistics.read(self.splats.n),
        )

    def evaluate(self, views: list[View]) -> Evaluation:
        """Metrics of the present splats."""
        return evaluate(self.renderer, self.snapshot(), views, self.config.background)

    def _plan_schedules(self) -> None:
        config = self.config
        steps = config.iterations
        self.mean_rate = exponential_decay(config.optim.position_lr_init, config.optim.position_lr_final, steps)
        self.sh_interval = config.schedule.sh_interval or max(1, min(1000, steps // 10))
        self.densify_first = max(int(config.density.densify_from * steps), 1)
        self.densify_last = int(config.density.densify_until * steps)
        self.growth = growth_factor(config, self.n_first, self.densify_last - self.densify_first)

    def _report(self, value: LossValue, log: RunLog, since: int, started: float) -> None:
        if not math.isfinite(value.total):
            raise TrainingError(
                f"iteration {self.iteration}: the loss is not finite: lower the learning rates; "
                "the last checkpoint is kept"
            )
        speed = (self.iteration - since) / (time.perf_counter() - started)
        log.write(
            {
                "iteration": self.iteration,
                "loss": value.total,
                "l1": value.l1,
                "ssim": value.ssim,
                "psnr": value.psnr,
                "splats": self.splats.n,
                "seconds": self.seconds,
            }
        )
        if self.progress is not None:
            self.progress(
                Progress(
                    self.iteration, self.config.iterations, value.total, value.psnr, self.splats.n, self.seconds, speed
                )
            )

    def _say(self, message: str) -> None:
        if self.progress is not None:
            self.progress(
                Progress(self.iteration, self.config.iterations, math.nan, math.nan, 0, self.seconds, 0, message)
            )


def growth_factor(config: TrainConfig, n_first: int, window: int) -> float:
    """Growth of the count per action: the option `growth`, or what reaches the cap halfway through the window."""
    if not isinstance(config.density, Mcmc):
        return 1.0
    actions = max(window // config.density.densify_interval // 2, 1)
    return float(max(config.density.growth, (config.cap_max / n_first) ** (1 / actions)))

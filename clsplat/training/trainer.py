"""One training run: sample a view, render, loss, backward, step, densify, checkpoint."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from ..device.device import Device
from ..device.pending_arrays import PendingArrays
from ..device.several import open_devices
from ..errors import InputError, TrainingError
from ..evaluation.evaluate import Evaluation, evaluate
from ..evaluation.floaters import measure_floaters
from ..evaluation.metrics import check_sizes
from ..files.host_memory import peak_bytes
from ..rendering.frame import Frame
from ..rendering.renderer import Renderer
from ..rendering.tuning import schedule_for
from ..scenes.scene import Scene, View
from ..scenes.split import split_for_run
from ..splats.fields import Array
from ..splats.optical_depth import finite_rows
from ..splats.splats import Splats
from .average import ParameterAverage
from .batch import Batch, Photo, check_batch
from .checkpoint import Checkpoint
from .checkpoint_times import CheckpointTimes
from .config import TrainConfig
from .context import check_context, context_of
from .density.control import DensityControl, ExplorationNoise
from .exposure import KEY as EXPOSURE
from .exposure_file import exposures_json
from .extension import reached_by
from .folder import ModelFolder
from .initialise import first_arrays
from .interrupt import stoppable
from .log import Progress, RunLog
from .loss import LossValue, PendingValue, mean_loss
from .memory_estimate import run_memory
from .model import Model
from .occluders import OccluderCheck
from .optim.optimizer import make_optimizer
from .outliers import OutlierCheck
from .photos import with_photos
from .programs import kernel_build
from .rate_limits import check_rates
from .replica import Replica
from .run_clock import RunClock
from .running_mean import RunningLoss
from .schedules import RunSchedule, sh_degree_at
from .validation import RunValidation
from .view_sampler import ViewSampler

Visit = Callable[["Trainer", threading.Event], None]

LOG_INTERVAL = 50  # iterations between lines of log.jsonl
DISPLAY_INTERVAL = 0.5  # seconds after which `progress` is called between two lines of log.jsonl


class Trainer:
    """One training run: its state on the device, and its loop.

    Parameters
    ----------
    scene : with the option `validate`, some of its training views become validation views.
    checkpoint : state to continue from.
    progress : called with messages and with the progress of the run.
    context : splats that are shown and do not change (context.py), or their file. They are the last ones of the result.

    Raises
    ------
    InputError : there are no training views, rates are too high, or the checkpoint does not fit.
    DeviceError : the device has too little memory.
    """

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        checkpoint: Checkpoint | None = None,
        progress: Callable[[Progress], None] | None = None,
        device: Device | None = None,
        context: Splats | Path | None = None,
    ) -> None:
        context = context_of(context)
        check_context(context, config, checkpoint)
        scene = split_for_run(scene, config.validation.validate)
        if not scene.train:
            raise InputError(f"{scene.path}: no training views: all are test views")
        check_sizes(
            ((view.name, view.camera.width, view.camera.height) for view in (*scene.test, *scene.validation)),
            scene.path,
        )
        check_rates(config)
        scene = with_photos(scene, config)
        self.scene, self.config, self.progress = scene, config, progress
        self.device, *others = [device] if device is not None else open_devices(config.device)
        check_batch(config, 1 + len(others))
        schedule = schedule_for(self.device, checkpoint.schedule if checkpoint else None)
        self.kernels = kernel_build(config, schedule)
        self.n_frozen = 0 if context is None else len(context)
        self.memory = run_memory(self.device, self.kernels, config, scene.train, self.n_frozen)
        self.rng = np.random.default_rng(config.seed)
        self.iteration, self.seconds = 0, 0.0
        new = partial(first_arrays, scene, config, self.kernels.near_plane, context)
        first, message = new() if checkpoint is None else self._stored_splats(checkpoint)
        self._send(f"{message}; about {self.memory}")
        self.reached = reached_by(checkpoint, config, scene.train) if checkpoint else None
        self.n_first = checkpoint.n_first if checkpoint else len(first["mean"]) - self.n_frozen
        self._create_device_state(first, others)
        if checkpoint is not None:
            self._load_state(checkpoint)
        self.views = ViewSampler(
            scene.train,
            config.iterations,
            config.schedule.coarse_to_fine,
            self.rng,
            checkpoint.queue if checkpoint else [],
            self.reached.downscale if self.reached else None,
            checkpoint.left_out if checkpoint else (),
        )
        self.schedule = RunSchedule.create(config, self.n_first)
        self.average = ParameterAverage(config, self.schedule.densify_last)
        if checkpoint is not None and checkpoint.config["iterations"] == config.iterations:
            self.average.load_state(checkpoint.average, self.splats.n_live)
        self.density = DensityControl(
            config,
            self.kernels,
            self.schedule,
            self.splats,
            self.optimizer,
            self.pipeline.statistics,
            self.rng,
            scene.extent,
            len(scene.train),
        )
        self.clock = RunClock(config, self.schedule, self.views, self.pipeline, self.splats, self.iteration)
        self.running = RunningLoss(len(scene.train))
        self.noise = ExplorationNoise(config, self.kernels, self.splats, scene.extent)
        self.renderer = Renderer(self.device, schedule=self.kernels.schedule)
        self.occluders = OccluderCheck(config, scene.train, self.renderer, self.density, self.average.begin)
        self.outliers = OutlierCheck(config, scene.train, self.renderer, self.views)
        after_end = checkpoint is not None and checkpoint.is_finished
        self.validation = RunValidation(self.renderer, scene.validation, config, after_end)
        self.evaluations: dict[int, Evaluation] = {}
        self.evaluation_seconds: dict[int, float] = {}

    def _stored_splats(self, checkpoint: Checkpoint) -> tuple[Mapping[str, Array], str]:
        """Return the arrays of the checkpoint. They may hold non-finite values until the next densification."""
        self.iteration, self.seconds = checkpoint.iteration, checkpoint.seconds
        self.rng.bit_generator.state = checkpoint.rng
        return checkpoint.splats, f"resumed at iteration {checkpoint.iteration} of {self.config.iterations}"

    def _create_device_state(self, first: Mapping[str, Array], others: Sequence[Device]) -> None:
        """Create the splats of each device with what makes their gradients, and the optimizer of the first one."""
        config = self.config
        capacity = max(config.cap_max + self.n_frozen, len(first["mean"]))
        main = Replica(self.device, self.kernels, self.memory, self.scene, config, first, capacity, self.n_frozen)
        self.pipeline, self.splats, self.grads, self.dropout = main.pipeline, main.splats, main.grads, main.dropout
        self.loss, self.targets, self.exposure = main.loss, main.targets, main.exposure
        self.main, self.batch = main, None
        if config.schedule.batch > 1:
            self.batch = Batch([main, *(main.copy_on(device, first) for device in others)], config)
        self.optimizer = make_optimizer(self.device, self.kernels, self.splats, config, self.scene.extent)

    def _load_state(self, checkpoint: Checkpoint) -> None:
        self.exposure.load_state(checkpoint.optimizer)
        for replica in self.batch.replicas[1:] if self.batch is not None else ():
            replica.exposure.follow(self.exposure)
        self.optimizer.load_state(PendingArrays.of(checkpoint.optimizer, without=EXPOSURE))
        self.pipeline.statistics.write(checkpoint.statistics, self.splats.capacity)

    def run(self, folder: ModelFolder | None = None, visit: Visit | None = None) -> Model:
        """Train until the last iteration, or until Ctrl-C or another stop signal.

        Parameters
        ----------
        folder : receives the log, checkpoints, saved models and exposures.
        visit : called after each iteration with this trainer and the event that ends the run. Its time does not count
            as training time. It must not change the run.
        """
        config = self.config
        log = RunLog(None if folder is None else folder.log_path, self.iteration)
        times = CheckpointTimes(config.output)
        if folder is not None and self.iteration:
            self.validation.resume(folder, self.iteration)
        started, since = time.perf_counter(), self.iteration
        shown = started
        with stoppable(folder is not None) as stop:
            if self.progress is not None and (estimate := self.clock.first_estimate(self.iteration)):
                self._send(estimate)
            while self.iteration < config.iterations and not stop.is_set():
                if self.progress is not None:
                    self.clock.begin(self.iteration + 1)
                start = time.perf_counter()
                self.step()
                it = self.iteration
                if self.outliers.is_due(it) and (self.outliers.is_new or self.outliers.left_out):
                    log.write({"iteration": it, "left_out": self.outliers.left_out})
                    self._send(self.outliers.message)
                if self.progress is not None:
                    self.clock.end(it)
                    self.running.observe(self.losses)
                ends = it == config.iterations
                measured = it in config.output.test_iterations and bool(self.scene.test)
                validated = self.validation.is_due(it)
                if measured or validated:
                    self.device.finish()  # pending commands count as training time
                if it % LOG_INTERVAL == 0 or ends:
                    value = mean_loss([loss.wait() for loss in self.losses])
                    self.seconds += time.perf_counter() - start
                    self._log(value, log)
                    self._show(since, started)
                    shown = time.perf_counter()
                else:
                    self.seconds += time.perf_counter() - start
                    if self.progress is not None and time.perf_counter() - shown >= DISPLAY_INTERVAL:
                        self._show(since, started)
                        shown = time.perf_counter()
                if measured:
                    self._measure_test_views(log)
                if validated:
                    self.validation.measure(self.snapshot(), it, self.seconds, log, folder)
                if folder is not None and (it in config.output.save_iterations or ends):
                    self._save_model(folder)
                if folder is not None and (ends or times.is_due(it)):
                    self._save_checkpoint(folder)
                    times.saved()
                if visit is not None:
                    start = time.perf_counter()
                    visit(self, stop)
                    started += time.perf_counter() - start
            # The file is written inside the block, where a second SIGTERM or SIGHUP does not interrupt it.
            if folder is not None and self.iteration < config.iterations:
                self._save_checkpoint(folder)
        if self.scene.validation and self.iteration == config.iterations:
            self._send(self.validation.summary(folder))
        return Model(
            self.snapshot(),
            config,
            self.iteration,
            self.seconds,
            peak_bytes(),
            self.main.nbytes,
            self.evaluations,
            self.evaluation_seconds,
            None if folder is None else folder.path,
            self.validation.best.iteration,
            tuple(self.outliers.left_out),
            self.n_frozen,
        )

    def _measure_test_views(self, log: RunLog) -> None:
        it, exposure = self.iteration, self.config.appearance.exposure
        splats, background = self.snapshot(), self.config.background
        measured = evaluate(self.renderer, splats, self.scene.test, background, also_corrected=exposure)
        self.evaluations[it], self.evaluation_seconds[it] = measured, self.seconds
        floaters = measure_floaters(self.renderer, splats, self.scene.train, background, test_psnr=measured.psnr)
        log.write(
            {
                "iteration": it,
                "seconds": self.seconds,
                "test_psnr": measured.psnr,
                "test_ssim": measured.ssim,
                "splats": self.splats.n,
                **floaters.to_json(),
            }
        )

    def _save_model(self, folder: ModelFolder) -> None:
        folder.save(self.snapshot(), self.iteration)
        if self.config.appearance.exposure:
            names = [view.name for view in self.scene.train]
            folder.write_exposures(exposures_json(names, self.exposure.exposures()))

    def _save_checkpoint(self, folder: ModelFolder) -> None:
        self.checkpoint().save(folder.checkpoint_path)

    @property
    def sh_degree(self) -> int:
        """SH degree in use at the present iteration."""
        scheduled = sh_degree_at(self.iteration, self.schedule.sh_interval, self.config.sh_degree)
        return max(scheduled, self.reached.sh_degree) if self.reached else scheduled

    def step(self) -> Frame:
        """Do one iteration, and return its last frame: gradients, a step, and a densification if it is due."""
        self.iteration += 1
        config, it, degree = self.config, self.iteration, self.sh_degree
        photos = [self._next_photo() for _ in range(config.schedule.batch)]
        grads, depth_key = self.grads, None
        if self.batch is None:
            (photo,) = photos
            target = self.targets.get(photo.view, photo.downscale)
            frame, self.loss_result = self.main.learn(target, photo.background, degree, it)
            self.exposure.step(photo.view)
            depth_key = frame.projected.depth_key
        else:
            frame, self._losses = self.batch.learn(photos, degree, it)
            grads = self.batch.grads
        mean_lr = self.scene.extent * self.schedule.mean_rate(it)
        self.optimizer.step(grads, mean_lr * config.rate_factor("mean"), degree, it, depth_key)
        if self.density.is_due(it):
            self.density.densify(it)
        if self.occluders.is_due(it):
            self.occluders.remove(self.snapshot())
        if self.outliers.is_due(it):
            self.outliers.look(self.snapshot())
        self.noise.add(it, mean_lr)
        if self.average.is_due(it):
            self.average.add(self.optimizer.read())
        return frame

    def _next_photo(self) -> Photo:
        config, it = self.config, self.iteration
        view, downscale = self.views.next(it, self.splats.n)
        is_random = config.random_background and it <= config.random_background_until * config.iterations
        r, g, b = self.rng.random(3).tolist() if is_random else config.background
        return Photo(view, downscale, (r, g, b))

    @property
    def losses(self) -> list[PendingValue]:
        """The losses of the photos of the last iteration, on their way from the devices."""
        return [self.loss.value_later(self.loss_result)] if self.batch is None else self._losses

    @property
    def has_mean(self) -> bool:
        """Whether the run has ended, and its model is the mean over its last part."""
        return self.iteration >= self.config.iterations and self.average.count > 0

    def snapshot(self) -> Splats:
        """Return the present splats on the host, except splats that are not finite.

        After the last iteration they are the mean over the last part of the run (option `average_last`).
        """
        arrays = self.average.result() if self.has_mean else dict(self.optimizer.read())
        if self.n_frozen:
            frozen = self.splats.pending(self.n_frozen, first=self.splats.n_live)
            arrays = {name: np.concatenate([array, frozen[name]]) for name, array in arrays.items()}
        sound = finite_rows(arrays)
        if len(sound) and not sound.any():
            raise TrainingError(f"iteration {self.iteration}: no splat is finite any more: lower the learning rates")
        kept, kernels = arrays if sound.all() else {name: array[sound] for name, array in arrays.items()}, self.kernels
        numbers = kernels.near_plane, kernels.low_pass
        try:
            return Splats(kernels.shape, kept, kernels.normalisation, kernels.antialiased, *numbers, copy=False)
        except InputError as error:
            raise TrainingError(f"iteration {self.iteration}: {error}: lower the learning rates") from None

    def checkpoint(self) -> Checkpoint:
        """Return the state that the rest of the run depends on, to be used before the next iteration."""
        return Checkpoint(
            self.iteration,
            self.config.to_json(),
            self.splats.pending(self.splats.n),
            PendingArrays.of(self.optimizer.state(), self.exposure.state()),
            dict(self.rng.bit_generator.state),
            self.views.queue,
            self.seconds,
            str(self.kernels.schedule),
            self.n_first,
            self.pipeline.statistics.read(self.splats.n),
            self.reached,
            self.average.state(),
            sorted(self.views.left_out),
        )

    def evaluate(self, views: list[View]) -> Evaluation:
        """Return the metrics of the present splats."""
        return evaluate(self.renderer, self.snapshot(), views, self.config.background)

    def _log(self, value: LossValue, log: RunLog) -> None:
        if not math.isfinite(value.total):
            raise TrainingError(
                f"iteration {self.iteration}: the loss is not finite: lower the learning rates; "
                "the last checkpoint is kept"
            )
        counts = {"splats": self.splats.n, "seconds": self.seconds}
        log.write({"iteration": self.iteration, **value.to_json(), **counts})

    def _show(self, since: int, started: float) -> None:
        if self.progress is not None:
            loss, psnr = self.running.means()
            speed = (self.iteration - since) / (time.perf_counter() - started)
            counts = self.splats.n_live, self.seconds, speed
            left = self.clock.forecast.seconds_left()
            self.progress(Progress(self.iteration, self.config.iterations, loss, psnr, *counts, forecast=left))

    def _send(self, message: str) -> None:
        if message and self.progress is not None:
            self.progress(
                Progress(self.iteration, self.config.iterations, math.nan, math.nan, 0, self.seconds, 0, message)
            )

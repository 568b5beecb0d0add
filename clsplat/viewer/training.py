"""Looking at a run: pictures of the splats as they are, made between iterations within a share of the time."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

from ..cameras.camera import Camera
from ..errors import InputError
from ..rendering.colormaps import MODES, Picture, model_for, picture, picture_of
from ..rendering.overdraw import pairs_per_pixel
from ..rendering.pipeline import Pipeline
from ..rendering.renderer import read_frame
from ..training.config import TrainConfig
from ..training.log import Progress
from ..training.schedules import sh_degree_at
from ..training.trainer import Trainer
from .settings import Settings
from .viewer import SECONDS, Viewer

SHARE = 0.015  # of the time, that pictures may take from a run; what browsers say takes another hundredth or two
QUICK = 0.025  # seconds for a picture of a moving camera: so they come at least now and then
_MOST_CREDIT = 0.2  # seconds of pictures at once, saved for when a camera moves
_REFRESH = 2.0  # seconds between pictures of a camera that is still
_PAUSE_STEP = 0.1  # seconds in which Ctrl-C is seen while paused


class TrainingSource:
    """The splats of a run, on the device as training has left them. Of the trainer's thread alone."""

    modes = MODES
    partial = False  # the strategy orders them

    def __init__(self, config: TrainConfig) -> None:
        self._config = config
        self._trainer: Trainer | None = None
        self._pipeline: Pipeline | None = None

    def attach(self, trainer: Trainer) -> None:
        """Look at this run; builds the kernels. Buffers are its own, so the run's bits stay what they are."""
        if trainer is not self._trainer:
            self._trainer = trainer
            self._pipeline = Pipeline(trainer.device, trainer.kernels.for_rendering(), trainer.pipeline.max_isects)

    @property
    def n_splats(self) -> int:
        return self._trainer.splats.n if self._trainer else 0

    @property
    def sh_degree(self) -> int:
        return self._config.sh_degree

    def picture(self, camera: Camera, settings: Settings) -> Picture:
        """What the camera sees of the run. Raises InputError before the first iteration."""
        trainer, pipeline = self._trainer, self._pipeline
        if trainer is None or pipeline is None:
            raise InputError("training has not begun yet")
        if settings.mode == "skew":
            shown = model_for(trainer.snapshot(), settings.mode)
            return picture(trainer.renderer, shown, camera, settings.mode, settings.background)
        degree = sh_degree_at(trainer.iteration, trainer.sh_interval, self._config.sh_degree)
        if settings.sh_degree is not None:
            degree = min(degree, settings.sh_degree)
        frame = pipeline.forward(trainer.splats, camera, settings.background, degree)
        image = read_frame(pipeline, frame)
        counts = pairs_per_pixel(pipeline, frame) if settings.mode == "splats" else None
        return picture_of(image, settings.mode, settings.background, counts=counts)


class TrainingView:
    """Those who look at a run: what they see, and whether the run waits for them.

    Parameters
    ----------
    share : of the time, that pictures may take while the run goes on.
    """

    def __init__(self, config: TrainConfig, share: float = SHARE, clock: Callable[[], float] = time.monotonic) -> None:
        self.source = TrainingSource(config)
        self.viewer = Viewer(self.source, Settings(background=config.background), QUICK, clock)
        self._share, self._clock = share, clock
        self._paused = threading.Event()
        self._credit, self._left, self._refreshed, self._cost = 0.0, math.inf, -math.inf, 0.0

    def toggle(self) -> bool:
        """Pause the run, or let it go on; whether it now waits."""
        if self._paused.is_set():
            self._paused.clear()
            self.viewer.hurry(QUICK)
        else:
            self._paused.set()
            self.viewer.hurry(SECONDS)
        return self._paused.is_set()

    def visit(self, trainer: Trainer, stop: threading.Event) -> None:
        """Between two iterations: a picture, if one is wanted and there is time for it; while paused all of them."""
        self.source.attach(trainer)
        now = self._clock()
        self._credit = min(self._credit + self._share * max(now - self._left, 0.0), _MOST_CREDIT)
        if self._credit > 0.0:
            due = now - self._refreshed > _REFRESH and self._credit >= self._cost
            fresh = due and self.viewer.count > 0
            if fresh:
                self._refreshed = now
                self.viewer.refresh()
            if self.viewer.wishes.waiting:
                trainer.device.queue.finish()  # what the iteration still has to do is training time
                start = self._clock()
                self.viewer.serve()
                spent = self._clock() - start
                self._credit -= spent
                self._cost = min(spent, _MOST_CREDIT) if fresh else self._cost
        while self._paused.is_set() and not stop.is_set():
            self.viewer.serve(_PAUSE_STEP)
        self._left = self._clock()


def run_line(progress: Progress) -> str:
    """How a run is doing, in a line; its message where it has one."""
    if progress.message:
        return progress.message
    done = "finished" if progress.iteration >= progress.iterations else f"{progress.per_second:.1f} a second"
    return (
        f"iteration {progress.iteration} of {progress.iterations}, {done}; loss {progress.loss:.4f}, "
        f"PSNR {progress.psnr:.2f} dB, {progress.n_splats} splats"
    )

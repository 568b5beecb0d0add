"""ViewPicture of a training run: frames between iterations, within a share of the time."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

from ..cameras.camera import Camera
from ..errors import InputError
from ..rendering.colormaps import MODES, model_for, picture, picture_of
from ..rendering.overdraw import splats_per_pixel
from ..rendering.pipeline import Pipeline
from ..rendering.renderer import read_frame
from ..rendering.splat_buffers import SplatBuffers
from ..splats.fields import DoubleArray
from ..training.config import TrainConfig
from ..training.log import Progress
from ..training.trainer import Trainer
from .settings import Settings
from .source import Source, ViewPicture, depth_view
from .viewer import FRAME_TIME, Viewer

SHARE = 0.015  # share of the run time for frames; messages of browsers take one or two hundredths more
MOVING_SHARE = 0.2  # the same while somebody moves a camera and waits for frames
TRAINING_FRAME_TIME = 0.025  # seconds for a frame of a moving camera: with this share, 8 a second
_MAX_CREDIT = 0.2  # seconds of frames that are saved up for a moving camera
_REFRESH = 2.0  # seconds between frames of a still camera
_PAUSE_STEP = 0.1  # seconds between checks for Ctrl-C during a pause
_GRACE = 5.0  # seconds without a browser that end a pause; a page that is loaded again is back before


class TrainingSource:
    """The splats of a run as they are on the device. Only the thread of the trainer may use this."""

    modes = MODES
    partial = False  # a part would need a copy of the splats
    splats = None
    sides = None

    def __init__(self, config: TrainConfig) -> None:
        self._config = config
        self._trainer: Trainer | None = None
        self._pipeline: Pipeline | None = None
        self._mean: SplatBuffers | None = None

    def attach(self, trainer: Trainer) -> None:
        """Attach to a run and build the kernels. The buffers are separate, so that the run keeps its bits."""
        if trainer is not self._trainer:
            self._trainer, self._mean = trainer, None
            self._pipeline = Pipeline(trainer.device, trainer.kernels.for_rendering(), trainer.pipeline.max_isects)

    @property
    def n_splats(self) -> int:
        return self._trainer.splats.n if self._trainer else 0

    @property
    def sh_degree(self) -> int:
        return self._config.sh_degree

    def view(self, camera: Camera, settings: Settings) -> ViewPicture:
        """Return the view of a camera. Raises InputError before the first iteration."""
        trainer, pipeline = self._trainer, self._pipeline
        if trainer is None or pipeline is None:
            raise InputError("training has not begun yet")
        if settings.mode == "skew":
            shown = model_for(trainer.snapshot(), settings.mode)
            return ViewPicture(picture(trainer.renderer, shown, camera, settings.mode, settings.background))
        degree = trainer.sh_degree
        if settings.sh_degree is not None:
            degree = min(degree, settings.sh_degree)
        frame = pipeline.forward(self._splats(trainer), camera, settings.background, degree)
        image = read_frame(frame)
        if settings.mode == "depth":
            return depth_view(image, settings)
        counts = splats_per_pixel(pipeline, frame) if settings.mode == "splats" else None
        return ViewPicture(picture_of(image, settings.mode, settings.background, counts=counts))

    def surface(
        self, origin: DoubleArray, direction: DoubleArray, settings: Settings, across: float = 0.0
    ) -> DoubleArray | None:
        """Return None: only the trainer's thread may render."""
        return None

    def _splats(self, trainer: Trainer) -> SplatBuffers:
        """Return the splats to show: those of the run, or at its end those of the model, which may be a mean."""
        if not trainer.has_mean:
            return trainer.splats
        if self._mean is None:
            self._mean = SplatBuffers.of(trainer.device, trainer.snapshot(), trainer.splats.dtype)
        return self._mean


class TrainingView:
    """The viewer of a run, and its pause button.

    Parameters
    ----------
    share, moving_share : share of the run time that frames may take: usually, and while a camera moves.
    on_pause : called in the trainer's thread with a message when the run is paused (True) or goes on (False).
    """

    def __init__(
        self,
        config: TrainConfig,
        share: float = SHARE,
        moving_share: float = MOVING_SHARE,
        clock: Callable[[], float] = time.monotonic,
        on_pause: Callable[[bool, str], None] = lambda paused, message: None,
    ) -> None:
        self.source: Source = TrainingSource(config)
        self.viewer = Viewer(self.source, Settings(background=config.background), TRAINING_FRAME_TIME, clock)
        self.on_pause = on_pause
        self._share, self._moving_share, self._clock = share, moving_share, clock
        self._paused = threading.Event()
        self._credit, self._left, self._refreshed, self._cost = 0.0, math.inf, -math.inf, 0.0

    def toggle(self) -> None:
        """Pause or resume the run at its next iteration."""
        if self._paused.is_set():
            self._paused.clear()
        else:
            self._paused.set()

    def visit(self, trainer: Trainer, stop: threading.Event) -> None:
        """Serve a frame between two iterations if one is due and there is time; during a pause serve all of them."""
        self._attach(trainer)
        now = self._clock()
        share = max(self._share, self._moving_share) if self.viewer.moving else self._share
        self._credit = min(self._credit + share * max(now - self._left, 0.0), _MAX_CREDIT)
        if self._credit > 0.0:
            due = now - self._refreshed > _REFRESH and self._credit >= self._cost
            fresh = due and self.viewer.count > 0
            if fresh:
                self._refreshed = now
                self.viewer.refresh()
            if self.viewer.queue.has_due:
                trainer.device.finish()  # pending work of the iteration counts as training time
                start = self._clock()
                self.viewer.serve()
                spent = self._clock() - start
                self._credit -= spent
                self._cost = min(spent, _MAX_CREDIT) if fresh else self._cost
        if self._paused.is_set() and not stop.is_set():
            self._wait(trainer.iteration, stop)
        self._left = self._clock()

    def finish(self, source: Source) -> None:
        """Show the result of the run from now on; `viewer.run` serves it."""
        self.source = self.viewer.source = source
        self.viewer.set_frame_time(FRAME_TIME)

    def _attach(self, trainer: Trainer) -> None:
        if isinstance(self.source, TrainingSource):
            self.source.attach(trainer)

    def _wait(self, iteration: int, stop: threading.Event) -> None:
        """Serve frames until the pause ends: by its button, by Ctrl-C, or because nobody watches any more."""
        self.viewer.set_frame_time(FRAME_TIME)
        self.on_pause(True, f"iteration {iteration}: paused by the viewer")
        watched = self._clock()
        reason = "the viewer resumed the run"
        while self._paused.is_set() and not stop.is_set():
            self.viewer.serve(_PAUSE_STEP)
            if self.viewer.count:
                watched = self._clock()
            elif self._clock() - watched > _GRACE:
                self._paused.clear()
                reason = "the run goes on, because nobody watches it any more"
        self.viewer.set_frame_time(TRAINING_FRAME_TIME)
        if not stop.is_set():
            self.on_pause(False, f"iteration {iteration}: {reason}")


def run_line(progress: Progress) -> str:
    """Return the status of a run in one line, or its message if it has one."""
    if progress.message:
        return progress.message
    done = "finished" if progress.iteration >= progress.iterations else f"{progress.per_second:.1f} a second"
    return (
        f"iteration {progress.iteration} of {progress.iterations}, {done}; loss {progress.loss:.4f}, "
        f"PSNR {progress.psnr:.2f} dB, {progress.n_splats} splats"
    )

"""The time of a run's iterations, and the forecast of the rest of the run."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence

from .. import activity
from ..rendering.pipeline import Pipeline
from ..rendering.splat_buffers import SplatBuffers
from ..scenes.scene import View
from .config import TrainConfig
from .forecast import Forecast, RunShape
from .live_line import rough_duration
from .schedules import RunSchedule, sh_degree_at
from .targets import reduced_camera
from .view_sampler import ViewSampler

WORTH_A_MESSAGE = 10.0  # seconds; a shorter run needs no forecast before it begins
PROBING_SHARE = 0.08  # of the time of the iterations that forward passes of the forecast may take
_PROBE_VIEWS = 3


class RunClock:
    """Measures a run's iterations and some forward passes, and forecasts the time left.

    Parameters
    ----------
    views : order and image sizes of the training views.
    iteration : iterations done before.

    Attributes
    ----------
    forecast : the forecast of the run.
    clock : a function that returns seconds.
    """

    def __init__(
        self,
        config: TrainConfig,
        schedule: RunSchedule,
        views: ViewSampler,
        pipeline: Pipeline,
        splats: SplatBuffers,
        iteration: int = 0,
    ) -> None:
        self.config, self.schedule, self.views = config, schedule, views
        self.pipeline, self.splats = pipeline, splats
        run = RunShape(
            config.iterations,
            views.stages,
            views.pixels,
            config.cap_max,
            config.sh_degree,
            schedule,
            config.densify_every,
        )
        self.forecast = Forecast(run, splats.n, iteration)
        self.clock: Callable[[], float] = time.perf_counter
        self._begun = self._iterating = self._probing = self._last_probe = 0.0

    def begin(self, iteration: int) -> None:
        """Start the time of an iteration (from 1). Now and then this first measures forward passes.

        Short runs and those of large photos measure fewer passes: the forecast may not slow a run down.
        """
        affordable = self._probing + self._last_probe <= PROBING_SHARE * self._iterating
        if affordable and self.forecast.is_probe_due(iteration):
            self.measure_passes(iteration)
        self._begun = self.clock()

    def end(self, iteration: int) -> None:
        """Stop the time of an iteration."""
        seconds = self.clock() - self._begun
        self._iterating += seconds
        self.forecast.observe(iteration, self.splats.n, seconds)

    def first_estimate(self, done: int) -> str | None:
        """Return how long the rest of a run takes, measured by forward passes alone; None for a short run."""
        activity.report("measuring how long the run will take")
        self.measure_passes(done + 1)
        left = self.forecast.seconds_left()
        if left is None or left < WORTH_A_MESSAGE:
            return None
        return f"about {rough_duration(left)} for {self.config.iterations - done} iterations on this device"

    def measure_passes(self, iteration: int) -> None:
        """Measure forward passes at the present image size and at the later ones. They do not change the run."""
        start = self.clock()
        downscales = self.forecast.downscales(iteration)
        self.forecast.probe({downscale: self._seconds_of_pass(downscale, iteration) for downscale in downscales})
        self._last_probe = self.clock() - start
        self._probing += self._last_probe

    def _seconds_of_pass(self, downscale: int, iteration: int) -> float:
        views: Sequence[View] = self.views.views
        views = views[:: max(len(views) // _PROBE_VIEWS, 1)][:_PROBE_VIEWS]
        degree = sh_degree_at(iteration, self.schedule.sh_interval, self.config.sh_degree)
        device, seconds = self.splats.device, []
        for view in [views[0], *views]:  # the first pass allocates memory and does not count
            camera = reduced_camera(view.camera, downscale)
            device.finish()
            start = self.clock()
            self.pipeline.forward(self.splats, camera, self.config.background, degree)
            device.finish()
            seconds.append(self.clock() - start)
        return statistics.median(seconds[1:])

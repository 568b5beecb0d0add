"""The forecast of the time left: within 20 % from the first tenth of a run on, for costs that it does not know."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from clsplat import activity
from clsplat.device.device import open_device
from clsplat.device.program import build
from clsplat.scenes.scene import Scene, load_scene
from clsplat.training.config import TrainConfig
from clsplat.training.forecast import Forecast, RunShape
from clsplat.training.live_line import Heartbeat, LiveLine, activity_line, rough_duration
from clsplat.training.log import Progress
from clsplat.training.run import train
from clsplat.training.run_clock import PROBING_SHARE
from clsplat.training.schedules import RunSchedule, resolution_schedule, sh_degree_at
from clsplat.training.trainer import Trainer

N_FIRST, PIXELS = 10_000, 400_000


def shape_of(config: TrainConfig) -> RunShape:
    stages = resolution_schedule(config.iterations) if config.schedule.coarse_to_fine else [(0, 1)]
    schedule = RunSchedule.create(config, N_FIRST)
    interval = config.density.densify_interval
    return RunShape(config.iterations, stages, PIXELS, config.cap_max, config.sh_degree, schedule, interval)


def simulate(
    config: TrainConfig, growth: float, pixel: float, splat: float, band: float, fixed: float, forward: float
) -> dict[int, float]:
    """Return the relative error of the forecast at every 50th iteration, for a run with these costs [s]."""
    run, rng = shape_of(config), np.random.default_rng(0)

    def cost(downscale: int, n: float, degree: int) -> float:
        return fixed + pixel * PIXELS / downscale**2 + n * (splat + band * (degree + 1) ** 2)

    forecast, n = Forecast(run, N_FIRST), N_FIRST
    seconds: list[float] = []
    left: dict[int, float] = {}
    for it in range(1, config.iterations + 1):
        degree = sh_degree_at(it, run.schedule.sh_interval, config.sh_degree)
        if forecast.is_probe_due(it):
            forecast.probe({ds: forward * cost(ds, n, degree) for ds in forecast.downscales(it)})
        seconds.append(cost(run.downscale(it, n), n, degree) * rng.uniform(0.7, 1.3))
        if run.densifications(it - 1, it):
            n = min(int(n * growth), config.cap_max)
        forecast.observe(it, n, seconds[-1])
        if it % 50 == 0 and it < config.iterations:
            left[it] = forecast.seconds_left() or 0.0
    return {it: value / sum(seconds[it:]) - 1 for it, value in left.items()}


@pytest.mark.parametrize("strategy", ["adc", "mcmc"])
@pytest.mark.parametrize("coarse", [True, False])
@pytest.mark.parametrize(
    ("pixel", "splat", "band", "fixed", "forward"),
    [
        pytest.param(0.2e-6, 0.5e-6, 0.01e-6, 0.0, 0.33, id="cpu"),
        pytest.param(2e-9, 4e-9, 0.1e-9, 1e-3, 0.25, id="gpu"),
        pytest.param(0.5e-6, 0.2e-6, 0.02e-6, 1e-3, 0.4, id="large images"),
    ],
)
def test_time_left_is_right_from_the_first_tenth_on(
    strategy: str, coarse: bool, pixel: float, splat: float, band: float, fixed: float, forward: float
) -> None:
    config = TrainConfig(iterations=3000, cap_max=40_000, strategy=strategy, coarse_to_fine=coarse)
    growth = 1.15 if strategy == "adc" else RunSchedule.create(config, N_FIRST).growth
    errors = simulate(config, growth, pixel, splat, band, fixed, forward)
    counted = {it: error for it, error in errors.items() if 300 <= it <= 2950}
    worst = max(counted, key=lambda it: abs(counted[it]))
    assert abs(counted[worst]) < 0.2, (worst, counted[worst])


def test_a_run_that_grows_is_not_forecast_by_its_first_speed() -> None:
    """The former forecast took the mean speed: with images that grow fourfold twice it was wrong by a factor."""
    config = TrainConfig(iterations=3000, cap_max=40_000)
    errors = simulate(config, 1.15, 0.5e-6, 0.2e-6, 0.0, 0.0, 0.33)
    assert abs(errors[300]) < 0.2
    run = shape_of(config)
    assert run.downscale(300, N_FIRST) == 4, "the first tenth has small images"


def test_a_run_without_end_has_a_forecast() -> None:
    """Growth over millions of densifications is more than a number can hold."""
    forecast = Forecast(shape_of(TrainConfig(iterations=10**9, cap_max=40_000)), N_FIRST)
    forecast.probe({4: 0.01, 2: 0.02, 1: 0.06})
    left = forecast.seconds_left()
    assert left is not None
    assert 1e7 < left < 1e10


def test_the_first_estimate_needs_no_iteration() -> None:
    forecast = Forecast(shape_of(TrainConfig(iterations=3000, cap_max=10_000)), N_FIRST)
    assert forecast.seconds_left() is None
    forecast.probe({4: 0.01, 2: 0.02, 1: 0.06})
    left = forecast.seconds_left()
    assert left is not None
    assert 3000 * 3 * 0.02 < left < 3000 * 3 * 0.06


def test_progress_does_not_change_the_model(scene: Scene) -> None:
    """Forward passes are measured only for a display."""
    config, said = TrainConfig(iterations=30, cap_max=400, sh_degree=1, densify_interval=10), []
    seen = train(scene, config, said.append).splats.to_numpy()
    alone = train(scene, config).splats.to_numpy()
    assert all(np.array_equal(seen[name], alone[name]) for name in alone)
    assert any(report.forecast is not None for report in said)


def test_measured_passes_take_a_small_share_of_a_run(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Large photos have slow forward passes, and a short run has few iterations to pay for them."""
    clock = Trainer(scene, TrainConfig(iterations=400, cap_max=400), progress=lambda _: None).clock
    now, passes = [0.0], [0]

    def measured(downscale: int, iteration: int) -> float:
        passes[0] += 1
        now[0] += 1.0
        return 1.0

    monkeypatch.setattr(clock, "_seconds_of_pass", measured)
    monkeypatch.setattr(clock.forecast, "is_probe_due", lambda iteration: iteration % 5 == 1)
    clock.clock = lambda: now[0]
    assert clock.first_estimate(0) is not None
    first = passes[0]
    later = []
    for it in range(1, 300):
        clock.begin(it)
        now[0] += 2.0
        clock.end(it)
        later += [passes[0] / (2.0 * it)] if passes[0] > first else []
    assert later, "a longer run measures again"
    assert max(later) <= PROBING_SHARE


def test_something_is_shown_between_two_lines_of_the_log(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clsplat.training.trainer.DISPLAY_INTERVAL", 0.0)
    said: list[Progress] = []
    train(scene, TrainConfig(iterations=12, cap_max=400), said.append)
    assert [report.iteration for report in said if not report.message] == list(range(1, 13))


def test_reading_and_compiling_are_reported(capture_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device, said = open_device(), []
    monkeypatch.setattr(device.shared, "built", {})  # another test of this process may have built the program
    with activity.listening(said.append):
        scene = load_scene(capture_folder)
        build(device, ("measure/smoke.cl",))
        build(device, ("measure/smoke.cl",))
    assert f"reading photo {len(scene.train)} of {len(scene.train)}" in said  # test photos are decoded when used
    assert said.count("compiling kernels: smoke") == 1
    activity.report("nobody listens")
    assert "nobody listens" not in said


class Screen:
    """A stream that is a terminal, and keeps what is written."""

    def __init__(self, is_terminal: bool = True) -> None:
        self.is_terminal, self.text = is_terminal, ""

    def isatty(self) -> bool:
        return self.is_terminal

    def write(self, text: str) -> None:
        self.text += text

    def flush(self) -> None: ...

    def fileno(self) -> int:
        raise OSError


def test_a_text_that_stands_still_gets_a_mark_every_second(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    now, screen = [0.0], Screen()
    line = LiveLine(screen, clock=lambda: now[0])  # type: ignore[arg-type]
    line.mention("compiling kernels")
    line.beat()
    assert screen.text.endswith("compiling kernels"), "it is not still yet"
    frames = []
    for second in (1.2, 2.2, 3.2):
        now[0] = second
        line.beat()
        frames.append(screen.text.rsplit("\r", 1)[1].rstrip())
    assert len(set(frames)) == 3
    assert all(frame.startswith("compiling kernels ") for frame in frames)
    line.end()
    written = screen.text
    now[0] = 9.0
    line.beat()
    assert screen.text == written, "an ended line stays away"


def test_a_log_gets_what_takes_long_and_nothing_else() -> None:
    now, screen = [0.0], Screen(is_terminal=False)
    line = LiveLine(screen, clock=lambda: now[0])  # type: ignore[arg-type]
    line.mention("reading photo 1 of 2")
    now[0] = 5.0
    line.beat()
    assert screen.text == ""
    line.mention("compiling kernels: loss")
    now[0] = 11.0
    line.beat()
    line.beat()
    assert screen.text == "compiling kernels: loss\n"


def test_a_heartbeat_beats_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clsplat.training.live_line.HEARTBEAT", 0.01)
    beats, line = threading.Event(), LiveLine(Screen(is_terminal=False))  # type: ignore[arg-type]
    monkeypatch.setattr(line, "beat", beats.set)
    before = threading.active_count()
    with Heartbeat(line):
        assert beats.wait(5)
    assert threading.active_count() == before


def test_activity_is_removed_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    screen = Screen()
    with activity_line(line=LiveLine(screen)):  # type: ignore[arg-type]
        activity.report("reading photo 1 of 2")
        time.sleep(0)
    assert "reading photo 1 of 2" in screen.text
    assert screen.text.rsplit("\r", 2)[1].strip() == ""
    with activity_line(quiet=True, line=LiveLine(Screen())):  # type: ignore[arg-type]
        activity.report("nothing")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(3, "10 seconds"), (44, "40 seconds"), (200, "3 minutes"), (2460, "40 minutes"), (9000, "2.5 hours")],
)
def test_rough_durations(seconds: float, text: str) -> None:
    assert rough_duration(seconds) == text

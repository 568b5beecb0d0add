"""The viewer of a run: the run keeps its bits and its time; pause, Ctrl-C and the status line."""

from __future__ import annotations

import io
import math
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.rendering.colormaps import MODES
from clsplat.rendering.frame import Frame
from clsplat.rendering.pipeline import Pipeline
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.training.config import TrainConfig
from clsplat.training.log import Progress
from clsplat.training.progress import TrainingDisplay
from clsplat.training.run import train
from clsplat.training.trainer import Trainer
from clsplat.viewer import training
from clsplat.viewer.camera import Pose, camera_of
from clsplat.viewer.settings import Settings
from clsplat.viewer.source import ModelSource, ViewPicture
from clsplat.viewer.training import MOVING_SHARE, SHARE, TrainingSource, TrainingView, run_line
from clsplat.viewer.viewer import ViewerImage

CONFIG = TrainConfig(
    shape="skew-normal", iterations=40, cap_max=2400, sh_degree=1, densify_interval=10, strategy="mcmc"
)
LAZY = TrainConfig(
    shape="skew-normal",
    iterations=30,
    cap_max=2400,
    sh_degree=1,
    densify_interval=10,
    strategy="mcmc",
    visible_adam=True,
)
LONG = TrainConfig(shape="skew-normal", iterations=100_000, cap_max=2400, sh_degree=1, strategy="mcmc")


def pose_of(scene: Scene) -> Pose:
    camera = scene.train[0].camera
    return Pose((1, 0, 0, 0), tuple(camera.position), 1.0, 64, 48)


@pytest.mark.parametrize(
    "config", [pytest.param(CONFIG, id="dense"), pytest.param(LAZY, id="visible", marks=pytest.mark.slow)]
)
def test_a_run_that_is_watched_has_the_bits_of_one_that_is_not(scene: Scene, config: TrainConfig) -> None:
    unseen = train(scene, config).splats.to_numpy()
    view, shots = TrainingView(config, share=1e9), list[ViewerImage]()
    view.viewer.join(1, shots.append)

    def visit(trainer: Trainer, stop: threading.Event) -> None:
        view.viewer.choose(1, "mode", MODES[trainer.iteration % len(MODES)])
        view.viewer.move(1, pose_of(scene))
        view.visit(trainer, stop)

    watched = train(scene, config, visit=visit).splats.to_numpy()
    assert len(shots) >= config.iterations - 1
    assert not any(shot.message for shot in shots)
    assert len({shot.picture.tobytes() for shot in shots}) > len(MODES)
    for name, array in unseen.items():
        assert np.array_equal(array, watched[name]), name


def test_what_is_seen_is_the_run(scene: Scene) -> None:
    seen = {}

    def visit(trainer: Trainer, stop: threading.Event) -> None:
        source.attach(trainer)
        if trainer.iteration == CONFIG.iterations:
            seen["picture"] = source.view(scene.train[0].camera, Settings()).picture

    source = TrainingSource(CONFIG)
    with pytest.raises(InputError, match="not begun"):
        source.view(scene.train[0].camera, Settings())
    model = train(scene, CONFIG, visit=visit)
    assert source.n_splats == len(model.splats)
    image = Renderer().render(model.splats, scene.train[0].camera).color
    assert np.array_equal(seen["picture"], np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8))


def test_no_band_is_shown_before_it_is_trained(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run may start from a model whose bands are not in use yet."""
    source, shown = TrainingSource(CONFIG), []
    forward = Pipeline.forward

    def spy(self: Pipeline, *args: Any) -> Frame:
        shown.append(args[3])
        return forward(self, *args)

    trainer = Trainer(scene, replace(CONFIG, sh_degree=2, sh_interval=2))
    source.attach(trainer)
    monkeypatch.setattr(Pipeline, "forward", spy)
    for trained in (0, 1, 1, 2):
        trainer.step()
        assert shown.pop() == trained
        for chosen in (None, 0, 1, 2):
            source.view(scene.train[0].camera, Settings(sh_degree=chosen))
        assert shown == [trained, 0, min(trained, 1), trained]
        shown.clear()


@pytest.mark.parametrize(("moving", "share"), [(True, MOVING_SHARE), (False, SHARE)])
def test_pictures_take_no_more_than_their_share(moving: bool, share: float) -> None:
    """The clock of the test advances 10 ms for an iteration and 30 ms for a frame."""
    now = [0.0]
    spent = [0.0]
    view = TrainingView(CONFIG, clock=lambda: now[0])

    class Source:
        modes, partial, n_splats, sh_degree = MODES, False, 1, 0

        def attach(self, trainer: object) -> None: ...

        def view(self, camera: object, settings: object) -> ViewPicture:
            now[0] += 0.03
            spent[0] += 0.03
            return ViewPicture(np.zeros((4, 4, 3), np.uint8))

    class Device:
        @staticmethod
        def finish() -> None: ...

    class Run:
        device = Device

    view.source = view.viewer.source = Source()  # type: ignore[assignment]
    view.viewer.join(1, lambda shot: None)
    for number in range(3000):
        if moving or number == 0:
            view.viewer.move(1, Pose((1, 0, 0, 0), (0, 0, -3), 1.0, 64, 48))
        view.visit(Run(), threading.Event())  # type: ignore[arg-type]
        now[0] += 0.01
    assert 0.5 * share * 30.0 < spent[0] <= share * 30.0 + 0.06
    if moving:
        assert spent[0] / 0.03 > 5.0 * 30.0, "a moving camera gets five frames a second"


def test_a_paused_run_waits_and_still_shows(scene: Scene) -> None:
    view, shots, iterations = TrainingView(CONFIG), list[ViewerImage](), list[int]()
    view.viewer.join(1, shots.append)

    def visit(trainer: Trainer, stop: threading.Event) -> None:
        iterations.append(trainer.iteration)
        view.visit(trainer, stop)

    def look_on() -> None:
        while not iterations:
            time.sleep(0.01)
        view.toggle()
        time.sleep(0.3)
        before = len(iterations)
        view.viewer.move(1, pose_of(scene))
        time.sleep(0.5)
        waited.append(len(iterations) == before)
        view.toggle()

    waited: list[bool] = []
    looking = threading.Thread(target=look_on)
    looking.start()
    model = train(scene, CONFIG, visit=visit)
    looking.join()
    assert waited == [True]
    assert any(shot.still for shot in shots)
    assert model.finished
    assert model.seconds < 30.0


def test_ctrl_c_ends_a_paused_run(scene: Scene, tmp_path: Path) -> None:
    view = TrainingView(CONFIG)

    def visit(trainer: Trainer, stop: threading.Event) -> None:
        if trainer.iteration == 5:
            view.toggle()
            threading.Timer(0.2, signal.raise_signal, (signal.SIGINT,)).start()
        view.visit(trainer, stop)

    model = train(scene, CONFIG, output=tmp_path / "run", visit=visit)
    assert model.iteration == 5
    assert (tmp_path / "run" / "checkpoint.npz").is_file()


def test_a_line_tells_of_the_run() -> None:
    assert run_line(Progress(50, 100, 0.1234567, 20.0, 300, 2.0, 25.0)) == (
        "iteration 50 of 100, 25.0 a second; loss 0.1235, PSNR 20.00 dB, 300 splats"
    )
    assert "finished" in run_line(Progress(100, 100, 0.1, 20.0, 300, 2.0, 25.0))
    assert run_line(Progress(0, 100, math.nan, math.nan, 0, 0.0, 0.0, "so it begins")) == "so it begins"


def paused_run(scene: Scene, monkeypatch: pytest.MonkeyPatch, watch: Callable[[TrainingView], None]) -> list[str]:
    """Return what is said of a run that is paused at iteration 5. `watch` runs in a thread from then on."""
    monkeypatch.setattr(training, "_GRACE", 0.3)
    said: list[str] = []
    view = TrainingView(CONFIG, on_pause=lambda paused, message: said.append(f"{paused} {message}"))
    view.viewer.join(1, lambda shot: None)
    watching = threading.Thread(target=watch, args=(view,))

    def visit(trainer: Trainer, stop: threading.Event) -> None:
        if trainer.iteration == 5:
            view.toggle()
            watching.start()
        view.visit(trainer, stop)

    assert train(scene, CONFIG, visit=visit).finished
    watching.join()
    return said


def test_a_pause_is_said_and_ends_by_its_button(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def press_later(view: TrainingView) -> None:
        time.sleep(0.8)  # longer than the grace: somebody watches
        view.toggle()

    said = paused_run(scene, monkeypatch, press_later)
    assert said == [
        "True iteration 5: paused by the viewer",
        "False iteration 5: the viewer resumed the run",
    ]


def test_a_pause_ends_when_nobody_watches(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def load_again_and_leave(view: TrainingView) -> None:
        left.append(time.monotonic())
        view.viewer.leave(1)
        time.sleep(0.15)
        view.viewer.join(2, lambda shot: None)
        time.sleep(0.5)
        left.append(time.monotonic())
        view.viewer.leave(2)

    left: list[float] = []
    said = paused_run(scene, monkeypatch, load_again_and_leave)
    assert said[1] == "False iteration 5: the run goes on, because nobody watches it any more"
    assert time.monotonic() - left[1] > 0.25


def test_a_pause_is_shown_in_the_terminal_and_on_the_button(scene: Scene) -> None:
    pytest.importorskip("viser", reason="viser is not installed (pip install clsplat[view])")
    from viewer_client import Client

    from clsplat.viewer.options import ServerOptions
    from clsplat.viewer.training_session import TrainingSession

    def press() -> None:
        with Client(int(session.urls[0].rpartition(":")[2])) as client:
            client.look()
            client.set("Pause", True)
            client.uuid("Resume")
            client.set("Resume", True)
            client.uuid("Pause")

    shown = io.StringIO()
    with TrainingSession(scene, LONG, "run", ServerOptions(port=0)) as session:
        pressing = threading.Thread(target=press)

        def visit(trainer: Trainer, stop: threading.Event) -> None:
            if trainer.iteration == 2:
                pressing.start()
            if trainer.iteration > 2 and not pressing.is_alive():
                stop.set()
            session.visit(trainer, stop)

        train(scene, LONG, session.progress(TrainingDisplay(stream=shown)), visit=visit)
        pressing.join()
    lines = [line for line in shown.getvalue().splitlines() if "viewer" in line]
    assert [line.partition(": ")[2] for line in lines] == ["paused by the viewer", "the viewer resumed the run"]


def test_a_page_stays_after_the_run_and_shows_its_model(scene: Scene) -> None:
    pytest.importorskip("viser", reason="viser is not installed (pip install clsplat[view])")
    from viewer_client import Client

    from clsplat.viewer.options import ServerOptions
    from clsplat.viewer.training_session import TrainingSession

    differences: list[float] = []
    sliders: list[bool] = []
    camera = camera_of(Pose((1, 0, 0, 0), (0, 0, -4), 1.0, 96, 64), 1000)
    assert camera is not None

    def difference(client: Client, expected: np.ndarray) -> float:
        return float(np.abs(client.still().astype(int) - expected).mean())

    def look_on() -> None:
        try:
            expected = ModelSource(model.splats).picture(camera, Settings(background=CONFIG.background))
            with Client(int(session.urls[0].rpartition(":")[2])) as client:
                client.look()
                client.still(timeout=60.0)
                client.until("the run has finished")
                client.look((0, 0, -4))
                end = time.monotonic() + 20.0  # a picture of the first camera may be under way
                while difference(client, expected) >= 4.0 and time.monotonic() < end:
                    pass
                client.drain(0.5)
                differences.append(float(np.abs(client.last().astype(int) - expected).mean()))
                sliders.extend(props["visible"] for props in client.panel.values() if props.get("label") == "Splats")
        finally:
            session.stop()

    with TrainingSession(scene, CONFIG, "run", ServerOptions(port=0)) as session:
        model = train(scene, CONFIG, session.progress(lambda progress: None), visit=session.visit)
        looking = threading.Thread(target=look_on)
        looking.start()
        session.stay(model)
        looking.join()
    assert len(differences) == 1
    assert differences[0] < 4.0
    assert sliders == [True]

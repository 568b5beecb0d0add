"""The viewer of a run: the run keeps its bits and its time; pause, Ctrl-C and the status line."""

from __future__ import annotations

import math
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.rendering.colormaps import MODES
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.training.config import TrainConfig
from clsplat.training.log import Progress
from clsplat.training.run import train
from clsplat.training.trainer import Trainer
from clsplat.viewer.camera import Pose
from clsplat.viewer.settings import Settings
from clsplat.viewer.training import SHARE, TrainingSource, TrainingView, run_line
from clsplat.viewer.viewer import ViewerImage

CONFIG = TrainConfig(iterations=40, cap_max=2400, sh_degree=1, densify_interval=10, strategy="mcmc")
LAZY = TrainConfig(iterations=30, cap_max=2400, sh_degree=1, densify_interval=10, strategy="mcmc", visible_adam=True)


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
            seen["picture"] = source.picture(scene.train[0].camera, Settings())

    source = TrainingSource(CONFIG)
    with pytest.raises(InputError, match="not begun"):
        source.picture(scene.train[0].camera, Settings())
    model = train(scene, CONFIG, visit=visit)
    assert source.n_splats == len(model.splats)
    image = Renderer().render(model.splats, scene.train[0].camera).color
    assert np.array_equal(seen["picture"], np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8))


def test_pictures_take_no_more_than_their_share() -> None:
    """The clock of the test advances 10 ms for an iteration and 30 ms for a frame."""
    now = [0.0]
    spent = [0.0]
    view = TrainingView(CONFIG, clock=lambda: now[0])

    class Source:
        modes, partial, n_splats, sh_degree = MODES, False, 1, 0

        def attach(self, trainer: object) -> None: ...

        def picture(self, camera: object, settings: object) -> np.ndarray:
            now[0] += 0.03
            spent[0] += 0.03
            return np.zeros((4, 4, 3), np.uint8)

    class Device:
        class queue:
            @staticmethod
            def finish() -> None: ...

    class Run:
        device = Device

    view.source = view.viewer.source = Source()  # type: ignore[assignment]
    view.viewer.join(1, lambda shot: None)
    for _ in range(3000):
        view.viewer.move(1, Pose((1, 0, 0, 0), (0, 0, -3), 1.0, 64, 48))
        view.visit(Run(), threading.Event())  # type: ignore[arg-type]
        now[0] += 0.01
    assert 0.5 * SHARE * 30.0 < spent[0] <= SHARE * 30.0 + 0.03


def test_a_paused_run_waits_and_still_shows(scene: Scene) -> None:
    view, shots, iterations = TrainingView(CONFIG), list[ViewerImage](), list[int]()
    view.viewer.join(1, shots.append)

    def visit(trainer: Trainer, stop: threading.Event) -> None:
        iterations.append(trainer.iteration)
        view.visit(trainer, stop)

    def look_on() -> None:
        while not iterations:
            time.sleep(0.01)
        assert view.toggle()
        time.sleep(0.3)
        before = len(iterations)
        view.viewer.move(1, pose_of(scene))
        time.sleep(0.5)
        waited.append(len(iterations) == before)
        assert not view.toggle()

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

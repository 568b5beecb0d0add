"""Resumed runs: the bits of a run in one piece, everything that a checkpoint holds, and runs that become longer."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import signal
import threading
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runner import clsplat, error_of

from clsplat.cameras.camera import Camera
from clsplat.device.schedule import SCHEDULES
from clsplat.errors import OutputError
from clsplat.scenes.scene import Scene, View
from clsplat.training import trainer as trainer_module
from clsplat.training.checkpoint import Checkpoint, Reached
from clsplat.training.config import TrainConfig
from clsplat.training.density import control
from clsplat.training.extension import reached_by
from clsplat.training.log import Progress
from clsplat.training.run import train
from clsplat.training.trainer import Trainer
from clsplat.training.view_sampler import ViewSampler

CONFIG = TrainConfig(
    shape="skew-normal", iterations=60, cap_max=4000, sh_degree=1, densify_interval=10, checkpoint_interval=17
)
# Splats of low opacity die soon, so that relocation acts in a short run.
MCMC = {"strategy": "mcmc", "densify_until": 1.0, "init_opacity": 0.02, "opacity_reg": 0.1}
# Only some splats are above the threshold: which of them depends on the sums of gradients.
ADC = {"random_points": 0.0, "strategy": "adc", "densify_until": 0.8, "opacity_reset": 2, "grad_threshold": 3e-3}
CRASH = 25  # the checkpoint before it is at 17, between two densifications


class Crash(Exception):
    """The end of a run between two iterations."""


def crash(trainer: Trainer, stop: threading.Event) -> None:
    if trainer.iteration == CRASH:
        raise Crash


def ply(folder: Path, iteration: int = CONFIG.iterations) -> bytes:
    return (folder / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply").read_bytes()


@pytest.fixture
def edits(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int, int]]:
    """Return a list that gets (iteration, relocated, added) of each densification."""
    found: list[tuple[int, int, int]] = []
    next_edit = control.next_edit

    def spy(config: Any, splats: Any, stats: Any, rng: Any, info: Any) -> Any:
        edit = next_edit(config, splats, stats, rng, info)
        found.append((info.iteration, edit.relocated, edit.added))
        return edit

    monkeypatch.setattr(control, "next_edit", spy)
    return found


@pytest.mark.parametrize(
    "changes",
    [MCMC, MCMC | {"optimizer": "numpy"}, MCMC | {"relocation_limit": 0.005}, MCMC | {"half_moments": True}, ADC],
    ids=["fused", "numpy", "relocation limit", "half moments", "adc"],
)
def test_a_crashed_run_resumes_to_the_same_model(
    scene: Scene,
    tmp_path: Path,
    edits: list[tuple[int, int, int]],
    monkeypatch: pytest.MonkeyPatch,
    changes: dict[str, Any],
) -> None:
    """A crash at iteration 25 leaves the checkpoint of 17. Growth and relocation occur before and after it."""
    monkeypatch.setattr(trainer_module, "LOG_INTERVAL", 5)
    config = CONFIG.replace(**changes)
    train(scene, config, output=tmp_path / "whole")
    whole = list(edits)
    with pytest.raises(Crash):
        train(scene, config, output=tmp_path / "m", visit=crash)
    edits.clear()
    said: list[str] = []
    resumed = train(scene, config, lambda progress: said.append(progress.message), output=tmp_path / "m", resume=True)
    assert said[0].startswith("resumed at iteration 17 of 60; ")
    assert resumed.finished
    assert ply(tmp_path / "m") == ply(tmp_path / "whole")
    logged = [json.loads(line)["iteration"] for line in (tmp_path / "m" / "log.jsonl").read_text().splitlines()]
    assert logged == list(range(5, 61, 5))
    assert edits == whole[1:], "the densifications after the checkpoint"
    assert whole[0][2] > 0, "growth before the checkpoint"
    assert edits[0][2] > 0, "growth after the checkpoint"
    assert changes is ADC or sum(relocated for _, relocated, _ in edits) > 0


def test_ctrl_c_saves_and_resumes_to_the_same_model(scene: Scene, tmp_path: Path) -> None:
    def press(trainer: Trainer, stop: threading.Event) -> None:
        if trainer.iteration == CRASH:
            os.kill(os.getpid(), signal.SIGINT)

    train(scene, CONFIG, output=tmp_path / "whole")
    before = signal.getsignal(signal.SIGINT)
    stopped = train(scene, CONFIG, output=tmp_path / "m", visit=press)
    assert not stopped.finished
    assert CRASH <= stopped.iteration < CONFIG.iterations
    assert signal.getsignal(signal.SIGINT) is before
    assert train(scene, CONFIG, output=tmp_path / "m", resume=True).finished
    assert ply(tmp_path / "m") == ply(tmp_path / "whole")


@pytest.fixture(scope="module")
def begun(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Checkpoint:
    """Return the checkpoint of iteration 17."""
    folder = tmp_path_factory.mktemp("begun")
    with pytest.raises(Crash):
        train(scene, CONFIG, output=folder, visit=crash)
    return Checkpoint.load(folder / "checkpoint.npz")


def test_seconds_go_on_and_the_speed_is_that_of_the_present_session(
    scene: Scene, begun: Checkpoint, tmp_path: Path
) -> None:
    folder = tmp_path / "m"
    folder.mkdir()
    replace(begun, seconds=1000.0).save(folder / "checkpoint.npz")
    first: list[float] = []
    speeds: list[float] = []

    def visit(trainer: Trainer, stop: threading.Event) -> None:
        first.append(time.perf_counter())

    def watch(progress: Progress) -> None:
        if progress.iteration == CONFIG.iterations:
            # The session is longer than this time, so its speed is lower than this one.
            speeds.extend((progress.per_second, CONFIG.iterations / (time.perf_counter() - first[0])))

    model = train(scene, CONFIG, watch, output=folder, resume=True, visit=visit)
    assert 1000.0 < model.seconds < 1100.0
    done = CONFIG.iterations - 17
    assert speeds[0] <= speeds[1] * done / CONFIG.iterations


def test_a_resumed_run_keeps_the_schedule_of_its_kernels(scene: Scene, begun: Checkpoint) -> None:
    other = next(str(SCHEDULES[name]) for name in ("cpu16", "scalar") if str(SCHEDULES[name]) != begun.schedule)
    assert str(Trainer(scene, CONFIG, replace(begun, schedule=other)).kernels.schedule) == other


def test_two_runs_do_not_write_into_one_folder(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "m").mkdir()
    other = os.open(tmp_path / "m", os.O_RDONLY)
    try:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(OutputError, match="another run writes into it"):
            train(scene, CONFIG.replace(iterations=1), output=tmp_path / "m")
    finally:
        os.close(other)
    assert not any((tmp_path / "m").iterdir())


# --- runs that become longer ------------------------------------------------------------------

SHORT_RUN = TrainConfig(shape="skew-normal", iterations=30, cap_max=300, sh_degree=3, densify_interval=10)
LONGER = 46


@pytest.fixture(scope="module")
def finished(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a finished run of 30 iterations."""
    folder = tmp_path_factory.mktemp("finished") / "m"
    train(scene, SHORT_RUN, output=folder)
    return folder


def test_a_finished_run_goes_on_with_the_same_bits_each_time(scene: Scene, finished: Path, tmp_path: Path) -> None:
    models = [Path(shutil.copytree(finished, tmp_path / name)) for name in ("a", "b")]
    clsplat("train", "--resume", "-m", models[0], "--iterations", LONGER, "-q")
    assert ply(models[0], 30) == ply(finished, 30), "the shorter run's model is kept"
    assert ply(models[0], LONGER) != ply(models[0], 30)
    assert json.loads((models[0] / "config.json").read_text())["config"]["iterations"] == LONGER

    def crash_at_40(trainer: Trainer, stop: threading.Event) -> None:
        if trainer.iteration == 40:
            raise Crash

    longer = SHORT_RUN.replace(iterations=LONGER, checkpoint_interval=8)
    with pytest.raises(Crash):
        train(scene, longer, output=models[1], resume=True, visit=crash_at_40)
    assert Checkpoint.load(models[1] / "checkpoint.npz").iteration == 40
    clsplat("train", "--resume", "-m", models[1], "-q")
    assert ply(models[1], LONGER) == ply(models[0], LONGER), "after a crash, too"


def test_other_changes_of_a_run_are_refused(finished: Path) -> None:
    kept = ply(finished, 30)
    fewer = error_of("train", "--resume", "-m", finished, "--iterations", 20)
    assert "--resume with iterations=20" in fewer
    assert "use a number above 30 to train longer, or --overwrite to start again" in fewer
    assert "started with cap_max=300: use the same options" in error_of(
        "train", "--resume", "-m", finished, "--iterations", 50, "--cap-max", 400
    )
    assert ply(finished, 30) == kept


def test_degree_and_image_size_do_not_go_back(scene: Scene, finished: Path) -> None:
    """The schedule of 4000 iterations alone has degree 0 and images at a quarter of their size at iteration 31."""
    stored = Checkpoint.load(finished / "checkpoint.npz")
    views = [
        View(view.name, Camera(480, 360, 400, 400, 240, 180, view.camera.cam_from_world), view.image)
        for view in scene.train
    ]
    assert reached_by(stored, SHORT_RUN, views) is None
    long = SHORT_RUN.replace(iterations=4000)
    assert reached_by(stored, long, views) == Reached(sh_degree=3, downscale=1)
    early = replace(stored, iteration=4)  # of 30: the first degree, and images at a quarter of their size
    assert reached_by(early, long, views) == Reached(sh_degree=1, downscale=4)
    again = replace(early, config=long.to_json(), reached=Reached(2, 2))
    assert reached_by(again, long, views) == Reached(2, 2)
    assert reached_by(again, long.replace(iterations=5000), views) == Reached(2, 2)

    trainer = Trainer(scene, long, stored)
    trainer.step()
    assert trainer.sh_degree == 3
    assert trainer.checkpoint().reached == Reached(3, 1)
    sampler = ViewSampler(views, 4000, True, trainer.rng, [], largest_downscale=2)
    assert [sampler.next(iteration, 100)[1] for iteration in (1, 3999)] == [2, 1]


def test_reached_stages_are_in_the_checkpoint_and_older_checkpoints_have_none(finished: Path, tmp_path: Path) -> None:
    stored = Checkpoint.load(finished / "checkpoint.npz")
    assert stored.reached is None
    replace(stored, reached=Reached(2, 4)).save(tmp_path / "longer.npz")
    assert Checkpoint.load(tmp_path / "longer.npz").reached == Reached(2, 4)
    with np.load(finished / "checkpoint.npz") as file:
        arrays = dict(file)
    meta = json.loads(arrays["meta"].tobytes()) | {"version": 2}
    del meta["reached"]
    np.savez(tmp_path / "old.npz", **arrays | {"meta": np.frombuffer(json.dumps(meta).encode(), np.uint8)})
    assert Checkpoint.load(tmp_path / "old.npz").iteration == 30


@pytest.mark.parametrize("options", [{}, {"visible_adam": True}, {"half_moments": True}])
def test_a_checkpoint_is_written_with_one_array_in_memory(
    scene: Scene, tmp_path: Path, options: dict[str, bool]
) -> None:
    """Splats, moments and means of a large model are several times its size."""
    trainer = Trainer(scene, CONFIG.replace(iterations=6, average_last=0.5, **options))
    trainer.run()
    largest = max(values.nbytes for values in trainer.splats.download(trainer.splats.n).values())
    checkpoint = trainer.checkpoint()
    whole = sum(values.nbytes for part in (checkpoint.splats, checkpoint.optimizer) for values in part.values())
    tracemalloc.start()
    trainer.checkpoint().save(tmp_path / "checkpoint.npz")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 3.5 * largest * trainer.splats.capacity / trainer.splats.n < whole
    again = Checkpoint.load(tmp_path / "checkpoint.npz")
    for name in ("splats", "optimizer", "average"):
        stored, expected = getattr(again, name), getattr(checkpoint, name)
        assert stored.keys() == expected.keys()
        for key, values in stored.items():
            np.testing.assert_array_equal(values, expected[key], err_msg=key)
    assert again.average["count"].tolist() == [3]

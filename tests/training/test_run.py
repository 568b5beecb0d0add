"""Training: the same bits twice and after interruptions, fused steps equal to NumPy's, the loss, and the cap."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from reference.noise import add_noise

import clsplat
from clsplat.device.device import Device, open_device
from clsplat.errors import InputError, OutputError, TrainingError
from clsplat.evaluation.evaluate import evaluate
from clsplat.scenes.scene import Scene
from clsplat.splats.fields import Group
from clsplat.splats.splats import Splats
from clsplat.training.checkpoint import Checkpoint
from clsplat.training.config import TrainConfig
from clsplat.training.log import Progress
from clsplat.training.loss import LossValue, PendingValue
from clsplat.training.optim.noise import noise_reach
from clsplat.training.run import train
from clsplat.training.trainer import Trainer

# Every part of the strategy is active: growth from 2252 points to the cap, noise, all resolutions and SH degrees.
CONFIG = TrainConfig(
    shape="skew-normal",
    iterations=80,
    cap_max=2400,
    sh_degree=1,
    densify_interval=10,
    checkpoint_interval=30,
    strategy="mcmc",
)
CAMERA = clsplat.Camera(27, 19, 25.0, 26.0, 13.0, 9.0, np.eye(4))


@pytest.fixture(scope="session")
def uninterrupted(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of CONFIG's model."""
    folder = tmp_path_factory.mktemp("run")
    train(scene, CONFIG, output=folder)
    return folder


@pytest.fixture(scope="session")
def default_device() -> Device:
    return open_device()


def ply(folder: Path) -> bytes:
    return (folder / "point_cloud" / f"iteration_{CONFIG.iterations}" / "point_cloud.ply").read_bytes()


def some_splats(n: int = 300, shape: str = "skew-normal", sh_degree: int = 2) -> Splats:
    """Random splats in front of CAMERA. Some are nearly transparent, so that noise and relocation act on them."""
    rng = np.random.default_rng(5)
    arrays = {
        "mean": rng.uniform((-1, -1, 2), (1, 1, 4), (n, 3)),
        "quat": rng.standard_normal((n, 4)),
        "log_scale": rng.uniform(-3.5, -1.5, (n, 3)),
        "opacity_logit": rng.uniform(-7, 3, n),
        "sh": 0.5 * rng.standard_normal((n, (sh_degree + 1) ** 2, 3)),
    }
    if shape == "skew-normal":
        skew = rng.standard_normal((n, 3))
        # Ten steps do not reach 0 from here. At 0 the cube-root map is steep and amplifies rounding.
        arrays["skew"] = skew / np.linalg.norm(skew, axis=1, keepdims=True) * rng.uniform(0.6, 1.25, (n, 1))
    return Splats(shape, {name: array.astype(np.float32) for name, array in arrays.items()})


# --- the same bits ---------------------------------------------------------------------------


def test_one_seed_gives_one_model(scene: Scene, uninterrupted: Path, tmp_path: Path) -> None:
    train(scene, CONFIG, output=tmp_path / "again")
    assert ply(tmp_path / "again") == ply(uninterrupted)
    train(scene, replace(CONFIG, seed=1), output=tmp_path / "other")
    assert ply(tmp_path / "other") != ply(uninterrupted)


# --- training --------------------------------------------------------------------------------


def test_training_improves_the_training_views_and_never_exceeds_the_cap(
    scene: Scene, uninterrupted: Path, default_device: Device
) -> None:
    log = [json.loads(line) for line in (uninterrupted / "log.jsonl").read_text().splitlines()]
    assert len(scene.points.xyz) < log[-1]["splats"] <= CONFIG.cap_max
    trainer = Trainer(scene, CONFIG, device=default_device)
    before = trainer.evaluate(scene.train).psnr
    trained = Splats.load(uninterrupted / "point_cloud" / "iteration_80" / "point_cloud.ply")
    assert len(trained) == log[-1]["splats"]
    assert evaluate(trainer.renderer, trained, scene.train).psnr > before + 2


def test_a_cap_below_the_points_holds_from_the_start(scene: Scene) -> None:
    counts: list[int] = []
    said: list[str] = []

    def watch(progress: Progress) -> None:
        said.append(progress.message)
        counts.append(progress.n_splats)

    model = train(scene, replace(CONFIG, iterations=50, cap_max=100), watch)
    assert len(model.splats) == 100
    assert max(counts) == 100
    assert f"of {len(scene.points.xyz)}" in said[0]
    assert model.path is None


def test_models_are_not_overwritten_and_resume_wants_the_same_config(scene: Scene, uninterrupted: Path) -> None:
    kept = ply(uninterrupted)
    with pytest.raises(OutputError, match="already holds a model: replace it, continue it or choose another folder"):
        train(scene, CONFIG, output=uninterrupted)
    with pytest.raises(InputError, match="seed=3"):
        train(scene, replace(CONFIG, seed=3), output=uninterrupted, resume=True)
    assert ply(uninterrupted) == kept


def test_a_loss_that_is_not_finite_stops_the_run(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clsplat.training.replica.check_loss", lambda *_: None)  # it would find the fault first
    monkeypatch.setattr(PendingValue, "wait", lambda self: LossValue(float("nan"), 0, 0, 0))
    with pytest.raises(TrainingError, match=r"iteration 50: .* learning rates"):
        train(scene, CONFIG, output=tmp_path / "m")
    assert (tmp_path / "m" / "checkpoint.npz").is_file()


def test_a_step_uses_the_sh_degree_of_its_iteration(scene: Scene, default_device: Device) -> None:
    trainer = Trainer(scene, replace(CONFIG, sh_interval=3), device=default_device)
    first, degrees = trainer.snapshot().sh[:, 1:], []
    for _ in range(4):
        degrees.append(trainer.step().sh_degree)
        assert (trainer.snapshot().sh[:, 1:] != first).any() == (degrees[-1] == 1)
    assert degrees == [0, 0, 1, 1]


def test_statistics_start_again_after_a_densification(scene: Scene, default_device: Device) -> None:
    trainer = Trainer(scene, replace(CONFIG, cap_max=300, densify_interval=4), device=default_device)
    seen = []
    for _ in range(9):
        trainer.step()
        seen.append(trainer.pipeline.statistics.read(trainer.splats.n).any())
    assert seen == [True, True, True, False, True, True, True, False, True]


def test_a_run_is_measured_over_its_background(scene: Scene, default_device: Device) -> None:
    config = replace(CONFIG, background=(1.0, 0.25, 0.5), cap_max=100)
    trainer = Trainer(scene, config, device=default_device)
    measured = trainer.evaluate(scene.test).psnr
    over, black = (
        evaluate(trainer.renderer, trainer.snapshot(), scene.test, background).psnr
        for background in (config.background, (0.0, 0.0, 0.0))
    )
    assert measured == over != black


# --- fused kernels against NumPy -------------------------------------------------------------


@pytest.mark.parametrize("shape", ["gaussian", "skew-normal"])
def test_noise_equals_numpy(scene: Scene, default_device: Device, tmp_path: Path, shape: str) -> None:
    """One iteration at learning rates of 0 (that of the mean is nearly 0) moves splats by the noise alone."""
    splats = some_splats(shape=shape, sh_degree=1)
    splats.save(tmp_path / "start.ply")
    rate = 1e-9
    config = replace(
        CONFIG,
        shape=shape,
        init=str(tmp_path / "start.ply"),
        seed=(7 << 32) + 3,
        opacity_lr=0,
        scaling_lr=0,
        rotation_lr=0,
        feature_lr=0,
        skew_lr=0,
        opacity_reg=0,
        scale_reg=0,
        position_lr_init=rate,
        position_lr_final=rate,
        noise_lr=5 / rate,
        densify_interval=1000,
    )
    trainer = Trainer(scene, config, device=default_device)
    trainer.step()
    moved = trainer.snapshot()
    amount = 5 * scene.extent
    expected = add_noise(
        splats.mean,
        splats.quat,
        splats.log_scale,
        1 / (1 + np.exp(-splats.opacity_logit)),
        config.seed,
        1,
        amount,
        noise_reach(scene.extent),
    )
    shift = np.abs(expected - splats.mean).max()
    assert shift > 1e-2
    np.testing.assert_allclose(moved.mean, expected, rtol=0, atol=2e-5 * max(shift, 1) + 2 * rate * scene.extent)
    for name in ("quat", "log_scale", "opacity_logit"):
        np.testing.assert_allclose(getattr(moved, name), getattr(splats, name), rtol=1e-6)


def test_regularisers_pull_opacity_and_scale_down(scene: Scene, default_device: Device) -> None:
    """The regularisers add gradients of the mean opacity and the mean scale to those of the image."""
    grads: list[dict[str, NDArray[Any]]] = []
    for weight in (0.0, 10.0):
        trainer = Trainer(scene, replace(CONFIG, opacity_reg=weight, scale_reg=2 * weight), device=default_device)
        first = trainer.snapshot()
        trainer.step()
        moments = dict(trainer.optimizer.state())  # a tenth of the gradients, after one step
        grads.append({name: 10 * moments[f"first.{name}"] for name in ("opacity_logit", "log_scale")})
    opacity = 1 / (1 + np.exp(-first.opacity_logit.astype(float)))
    added = grads[1]["opacity_logit"] - grads[0]["opacity_logit"]
    np.testing.assert_allclose(added, 10 * opacity * (1 - opacity) / len(first), rtol=1e-3)
    added = grads[1]["log_scale"] - grads[0]["log_scale"]
    np.testing.assert_allclose(
        added, 20 * np.exp(first.log_scale.astype(float)) / (3 * len(first)), rtol=1e-3, atol=1e-7
    )


def test_rows_of_the_schema_fit_both_buffers() -> None:
    """A table steps all fields of geom except the skew, so the skew must be last."""
    schema = some_splats().schema
    assert schema.group(Group.GEOM)[-1].name == "skew"


def test_splats_that_are_not_finite_are_mended_or_left_out(
    scene: Scene, tmp_path: Path, default_device: Device
) -> None:
    """Splats become non-finite between two actions of the strategy.

    Saved models omit these splats, checkpoints keep them, and the next action relocates them.
    """
    config = replace(CONFIG, iterations=40)
    trainer = Trainer(scene, config, device=default_device)
    for _ in range(12):
        trainer.step()
    n = trainer.splats.n
    arrays = trainer.splats.download(n)
    arrays["mean"][3], arrays["skew"][7, 1] = np.nan, np.inf
    trainer.splats.upload(arrays)
    assert len(trainer.snapshot()) == n - 2
    trainer.checkpoint().save(tmp_path / "broken.npz")
    resumed = Trainer(scene, config, Checkpoint.load(tmp_path / "broken.npz"), device=default_device)
    for run in (trainer, resumed):
        while run.iteration < 20:  # the strategy acts at 20
            run.step()
        assert len(run.snapshot()) == run.splats.n
    for name, array in trainer.snapshot().arrays.items():
        np.testing.assert_array_equal(array, resumed.snapshot().arrays[name])
    trainer.splats.upload(
        {name: np.full_like(array, np.nan) for name, array in trainer.splats.download(trainer.splats.n).items()}
    )
    with pytest.raises(TrainingError, match="no splat is finite"):
        trainer.snapshot()


def test_the_path_of_a_scene_is_not_a_scene(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"train takes a scene, not its path: clsplat\.load_scene reads it"):
        train(str(tmp_path))  # type: ignore[arg-type]


def test_nothing_is_not_a_scene() -> None:
    with pytest.raises(InputError, match=r"scene is null: train takes a scene: clsplat\.load_scene reads one"):
        train(None)  # type: ignore[arg-type]


def test_a_dictionary_is_not_a_config(scene: Scene) -> None:
    with pytest.raises(InputError, match=r"config is a dict: train takes options as clsplat\.TrainConfig"):
        train(scene, {"iterations": 5})  # type: ignore[arg-type]

"""Iterations of several photos: the mean of their gradients, and the same bits on one device and on its parts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clsplat.device.device import Device, list_devices, open_device
from clsplat.device.several import open_devices
from clsplat.errors import DeviceError, InputError, TrainingError
from clsplat.evaluation.evaluate import evaluate
from clsplat.rendering.renderer import Renderer
from clsplat.rendering.tuning import SCHEDULE_VARIABLE
from clsplat.scenes.scene import Scene
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import decide
from clsplat.training.quality import QUALITIES, quality
from clsplat.training.replica import Replica
from clsplat.training.run import train
from clsplat.training.trainer import Trainer

SHORT = {
    "shape": "skew-normal",
    "iterations": 30,
    "cap_max": 900,
    "sh_degree": 2,
    "densify_interval": 5,
    "sh_interval": 4,
    "near_plane": 0.1,
}
OPTIONS = (
    {},
    {"exposure": True},
    {"strategy": "mcmc", "position_optimizer": "sghmc"},
    {"random_background": True, "dropout": 0.3, "depth_smoothness": 0.2},
    {"shape": "gaussian", "half_moments": True},
)


def config_of(**options: Any) -> TrainConfig:
    return TrainConfig(**{**SHORT, **options})


@pytest.fixture(scope="module")
def halves() -> str:
    """The spec of two halves of the first CPU."""
    try:
        open_devices("cpu/2")
    except DeviceError as error:
        pytest.skip(str(error))
    return "cpu/2"


def assert_same_bits(first: Splats, second: Splats) -> None:
    assert first.arrays.keys() == second.arrays.keys()
    for name, array in first.arrays.items():
        assert array.tobytes() == second.arrays[name].tobytes(), name


def test_gradients_are_the_mean_over_the_photos(scene: Scene) -> None:
    trainer = Trainer(scene, config_of(batch=3, coarse_to_fine=False, densify_interval=1000))
    single = Trainer(scene, config_of(coarse_to_fine=False))
    order = np.random.default_rng(0).permutation(len(scene.train)).tolist()
    assert trainer.batch is not None
    trainer.step()
    n = trainer.splats.n
    wanted: dict[str, Any] = {}
    for view in order[::-1][:3]:
        single.main.learn(single.targets.get(view, 1), (0.0, 0.0, 0.0), 0, 1)
        for name, gradient in single.grads.written_out(n).items():
            wanted[name] = wanted.get(name, 0.0) + gradient.astype(np.float64) / 3
    found = trainer.batch.grads.written_out(n)
    for name, gradient in wanted.items():
        size = np.abs(gradient).max()
        assert size > 0, name
        np.testing.assert_allclose(found[name], gradient, atol=2e-6 * size, err_msg=name)
    np.testing.assert_array_equal(trainer.pipeline.statistics.read(n), single.pipeline.statistics.read(n))


@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: "-".join(options) or "default")
@pytest.mark.parametrize("batch", [2, 4])
def test_parts_of_a_device_have_the_bits_of_the_whole(
    scene: Scene, halves: str, options: dict[str, Any], batch: int
) -> None:
    whole = train(scene, config_of(batch=batch, device="cpu", **options))
    parts = train(scene, config_of(batch=batch, device=halves, **options))
    assert_same_bits(whole.splats, parts.splats)


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, marks=pytest.mark.slow, id="adc"),
        pytest.param({"strategy": "mcmc", "exposure": True}, id="mcmc"),
    ],
)
def test_devices_that_count_as_gpus_have_the_bits_of_one(
    scene: Scene, halves: str, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any]
) -> None:
    """With the schedule, the lists of isects and the sorts of GPUs."""
    opened: list[Device] = []

    def as_gpus(spec: str | None) -> list[Device]:
        devices = open_devices(spec)
        for device in devices:
            device.info = replace(device.info, type="GPU")
        opened.extend(devices)
        return devices

    monkeypatch.setattr("clsplat.training.trainer.open_devices", as_gpus)
    monkeypatch.setenv(SCHEDULE_VARIABLE, "gpu256")
    config = config_of(batch=2, iterations=12, cap_max=300, **options)
    models = [train(scene, config.replace(device=spec)) for spec in ("cpu", halves)]
    assert [device.info.type for device in opened] == ["GPU"] * 3
    assert_same_bits(models[0].splats, models[1].splats)


def test_a_run_goes_on_with_another_number_of_devices(scene: Scene, halves: str, tmp_path: Path) -> None:
    whole = train(scene, config_of(batch=2, device="cpu", exposure=True))
    folder = tmp_path / "model"

    def stops(trainer: Trainer, stop: Any) -> None:
        if trainer.iteration == 12:
            stop.set()

    train(scene, config_of(batch=2, device=halves, exposure=True), output=folder, visit=stops)
    resumed = train(scene, config_of(device="cpu", exposure=True), output=folder, resume=True)
    assert_same_bits(whole.splats, resumed.splats)


def test_a_run_with_exposures_goes_on_on_several_devices(scene: Scene, halves: str, tmp_path: Path) -> None:
    """All devices have the exposures of the checkpoint before the first iteration."""
    config = config_of(batch=2, device=halves, exposure=True)

    def stops(trainer: Trainer, stop: Any) -> None:
        if trainer.iteration == 12:
            stop.set()

    train(scene, config, output=tmp_path, visit=stops)
    assert_same_bits(train(scene, config).splats, train(scene, config, output=tmp_path, resume=True).splats)


def test_all_devices_know_the_dark_photos(scene: Scene, halves: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are looked for once."""
    found, calls = np.arange(len(scene.train)) != 1, []
    monkeypatch.setattr("clsplat.training.replica.usual_exposures", lambda *args: calls.append(args) or found)
    batch = Trainer(scene, config_of(batch=2, device=halves, exposure=True)).batch
    assert batch is not None
    assert len(batch.replicas) == 2
    for replica in batch.replicas:
        np.testing.assert_array_equal(replica.exposure.usual, found)
    assert len(calls) == 1
    Trainer(scene, config_of(exposure=True, exposure_rate=0.0))
    Trainer(scene, config_of())
    assert len(calls) == 1, "not needed if no exposure moves"


@pytest.mark.parametrize("optimizer", ["fused", "numpy"])
def test_both_optimizers_take_the_mean(scene: Scene, optimizer: str) -> None:
    """One step of three photos: the rates have the factor √3."""
    trainers = [Trainer(scene, config_of(batch=batch, optimizer=optimizer, device="cpu")) for batch in (1, 3)]
    moved = []
    for trainer in trainers:
        before = trainer.splats.download(trainer.splats.n, ("opacity_logit",))["opacity_logit"]
        trainer.step()
        moved.append(trainer.splats.download(trainer.splats.n, ("opacity_logit",))["opacity_logit"] - before)
    # Adam's first step has the length of the rate, whatever the gradient.
    assert np.median(np.abs(moved[1])) / np.median(np.abs(moved[0])) == pytest.approx(np.sqrt(3), rel=1e-3)


def test_the_numpy_optimizer_equals_the_device(scene: Scene) -> None:
    fused, reference = (
        train(
            scene, config_of(batch=2, optimizer=optimizer, iterations=4, average_last=0, densify_interval=1000)
        ).splats
        for optimizer in ("fused", "numpy")
    )
    for name, array in fused.arrays.items():
        # Adam turns the rounding of gradients near zero into whole steps, so a few numbers differ.
        assert np.isclose(array, reference.arrays[name], atol=2e-4, rtol=2e-3).mean() > 0.99, name


def test_devices_of_two_drivers_train_one_model(scene: Scene) -> None:
    first: dict[str, str] = {}
    for info in list_devices():
        if info.type == "CPU" and info.fault is None:
            first.setdefault(info.platform, info.index)
    if len(first) < 2:
        pytest.skip("there is one OpenCL driver for this CPU only")
    one, two = list(first.values())[:2]
    models = [train(scene, config_of(batch=2, device=spec)) for spec in (one, f"{one},{two}")]
    psnr = [evaluate(Renderer(one), model.splats, scene.test).psnr for model in models]
    assert psnr[1] == pytest.approx(psnr[0], abs=0.5)


def test_the_log_has_the_mean_of_the_losses(scene: Scene, tmp_path: Path) -> None:
    trainer = Trainer(scene, config_of(batch=3))
    trainer.step()
    values = [value.wait().total for value in trainer.losses]
    assert len(values) == 3
    assert len(set(values)) == 3


def test_a_failure_of_the_other_device_ends_the_run(scene: Scene, halves: str, monkeypatch: pytest.MonkeyPatch) -> None:
    learn = Replica.learn

    def failing(self: Replica, *args: Any) -> Any:
        if self.device.info.index.endswith("/1"):
            raise TrainingError("the second half fails")
        return learn(self, *args)

    monkeypatch.setattr(Replica, "learn", failing)
    with pytest.raises(TrainingError, match="second half"):
        train(scene, config_of(device=halves))


def test_a_run_on_two_devices_has_two_photos_an_iteration(scene: Scene) -> None:
    decision = decide(scene, config_of(device="0:0,0:1"))
    assert decision.config.schedule.batch == 2
    assert "2 photos in an iteration, because there are 2 devices" in str(decision)
    assert decide(scene, config_of(device="0:0,0:1", batch=4)).config.schedule.batch == 4
    assert decide(scene, config_of(device="cpu/3")).config.schedule.batch == 3


def test_a_quality_has_the_same_photos_in_fewer_iterations() -> None:
    for name, values in QUALITIES.items():
        assert quality(name) == values
        assert quality(name, 3)["iterations"] * 3 - values["iterations"] in range(3)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"batch": 3}, "batch 3 on 2 devices: .* use a multiple of 2"),
        ({"batch": 1}, "batch 1 on 2 devices: .* use a multiple of 2"),
        ({"visible_adam": True}, "visible_adam .* the batch is 2"),
    ],
)
def test_batches_that_cannot_be_shared(scene: Scene, halves: str, options: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        train(scene, config_of(device=halves, **options))


def test_lists_of_devices() -> None:
    index = open_device("cpu").info.index
    units = open_device("cpu").info.compute_units
    assert [device.info.index for device in open_devices(index)] == [index]
    assert [device.info.index for device in open_devices("cpu/1")] == [index]
    with pytest.raises(DeviceError, match="twice: name each device once"):
        open_devices(f"{index},cpu")
    with pytest.raises(DeviceError, match=f"has {units} compute units: use one of /1"):
        open_devices(f"cpu/{units + 1}")
    with pytest.raises(DeviceError, match="compute units"):
        open_devices("cpu/0")
    with pytest.raises(DeviceError, match="'nothing' not found"):
        open_devices("cpu,nothing")
    with pytest.raises(DeviceError, match="names several devices"):
        open_device("cpu,gpu")
    with pytest.raises(DeviceError, match="names several devices"):
        open_device("cpu/2")

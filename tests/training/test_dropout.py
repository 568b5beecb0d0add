"""Dropout: which splats an iteration hides, what a hidden splat changes, and when a run stops hiding."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from device_schedules import as_kind
from numpy.typing import NDArray

from clsplat.device.device import Device
from clsplat.device.memory import to_host
from clsplat.errors import InputError
from clsplat.rendering.build import CULLED_KEY
from clsplat.rendering.splat_buffers import SplatStatistics
from clsplat.scenes.scene import Scene
from clsplat.training.config import TrainConfig
from clsplat.training.dropout import UNTIL
from clsplat.training.optim.noise import DROPOUT_STREAM, philox4x32
from clsplat.training.presets import PRESETS, preset
from clsplat.training.trainer import Trainer

RATE = 0.4
OTHER_SEED = (7 << 32) + 3


def trainer_of(scene: Scene, device: Device, **options: Any) -> Trainer:
    """Return a run without densification and without smaller images."""
    still = {"iterations": 20, "densify_interval": 1000, "coarse_to_fine": False, "near_plane": 0.1}
    return Trainer(
        scene, TrainConfig(**{"cap_max": 4000, "sh_degree": 1, "dropout": RATE, **still, **options}), device=device
    )


def hidden_by(seed: int, iteration: int, n: int) -> NDArray[np.bool_]:
    """Return which splats are hidden, from the words of NumPy's Philox."""
    iterations, stream, last = (np.array(word, np.uint32) for word in (iteration, DROPOUT_STREAM, 0))
    words = philox4x32((np.arange(n, dtype=np.uint32), iterations, stream, last), (seed & 0xFFFFFFFF, seed >> 32))
    hidden: NDArray[np.bool_] = words[0] < int(RATE * 2**32)
    return hidden


def keys(trainer: Trainer, iteration: int) -> NDArray[np.uint32]:
    """Return the depth keys of the first view in an iteration."""
    hide = trainer.dropout.of(iteration)
    frame = trainer.pipeline.forward(trainer.splats, trainer.scene.train[0].camera, hide=hide)
    return to_host(trainer.device, frame.projected.depth_key, np.empty(trainer.splats.n, np.uint32))


@pytest.mark.parametrize("seed", [3, OTHER_SEED])
def test_the_hidden_splats_are_those_of_numpy(scene: Scene, device: Device, seed: int) -> None:
    trainer = trainer_of(scene, device, seed=seed)
    n = trainer.splats.n
    everywhere = keys(trainer, trainer.config.iterations)
    assert (everywhere != CULLED_KEY).sum() > 0.5 * n
    for iteration in (1, 2, int(UNTIL * trainer.config.iterations)):
        hidden = hidden_by(seed, iteration, n)
        assert 0.35 * n < hidden.sum() < 0.45 * n
        np.testing.assert_array_equal(keys(trainer, iteration), np.where(hidden, CULLED_KEY, everywhere))


@pytest.mark.parametrize("kind", ["CPU", "GPU"])
def test_a_hidden_splat_is_as_if_it_were_not_there(scene: Scene, device: Device, kind: str) -> None:
    """The image and the gradients have the bits of a model without the hidden splats. Both kinds of lists do that."""
    trainer = trainer_of(scene, as_kind(device, kind))
    view = trainer.scene.train[0]
    shown = ~hidden_by(0, 1, trainer.splats.n)

    def image_and_gradients(hide: Any) -> dict[str, NDArray[Any]]:
        frame = trainer.pipeline.forward(trainer.splats, view.camera, hide=hide)
        image = frame.images.color.read()
        trainer.pipeline.backward(frame, frame.images.color.buffer, trainer.grads)
        return {"image": image, **trainer.grads.written_out(trainer.splats.n)}

    found = image_and_gradients(trainer.dropout.of(1))
    everything = image_and_gradients(None)
    trainer.splats.set({name: array[shown] for name, array in trainer.splats.download(trainer.splats.n).items()})
    expected = image_and_gradients(None)
    assert np.abs(found["image"] - everything["image"]).max() > 0.01
    np.testing.assert_array_equal(found.pop("image"), expected.pop("image"))
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name][shown], array, err_msg=name)
        assert not found[name][~shown].any(), name


def test_all_splats_are_drawn_without_dropout_and_at_the_end(scene: Scene, device: Device) -> None:
    trainer = trainer_of(scene, device)
    last = int(UNTIL * trainer.config.iterations)
    assert trainer.dropout.of(last) is not None
    assert trainer.dropout.of(last + 1) is None
    assert trainer_of(scene, device, dropout=0.0).dropout.of(1) is None


def test_training_hides_the_splats_of_its_iteration(scene: Scene, device: Device) -> None:
    """The statistics of a step count the splats that it saw."""
    trainer = trainer_of(scene, device, seed=OTHER_SEED, lr_factor=1e-6, random_points=0.0)
    n = trainer.splats.n
    before = np.zeros(n)
    for iteration in (1, 2):
        trainer.step()
        after = trainer.pipeline.statistics.read(n)[SplatStatistics.TIMES_SEEN]
        seen = after > before
        assert not seen[hidden_by(OTHER_SEED, iteration, n)].any()
        assert seen.sum() > 0.3 * n
        before = after


def test_the_rate_is_a_part_and_presets_have_none() -> None:
    for rate in (-0.1, 1.0):
        with pytest.raises(InputError, match=f"dropout {rate}: must be at least 0 and below 1"):
            TrainConfig(dropout=rate)
    assert all(preset(name)["dropout"] == 0 for name in PRESETS)

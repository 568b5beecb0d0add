"""Adam's moments of colours in 16 bits: rounded at random as in NumPy, and right on average."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from training.test_lazy import some_seen
from training.test_lazy import step as visible_step
from training.test_optimizer import CAPACITY, MEAN_LR, config_of, gradients, growing, some_splats, started

from clsplat.device.device import Device
from clsplat.errors import InputError
from clsplat.rendering.splat_buffers import CompactGradients
from clsplat.splats.fields import Group
from clsplat.training.config import TrainConfig
from clsplat.training.optim.fused import FusedOptimizer
from clsplat.training.optim.moments import packed, unpacked
from clsplat.training.optim.noise import philox4x32

N = 300
HALF = {"shape": "gaussian", "half_moments": True}


def numbers(seed: int, step: int, stream: int) -> np.ndarray:
    """Random words of a step for N splats and three channels, (N, 3)."""
    words = [np.asarray(word, np.uint32) for word in (step, stream, 1)]
    first = philox4x32((np.arange(N, dtype=np.uint32), *words), (seed & 0xFFFFFFFF, seed >> 32))
    return np.stack(first[:3], axis=1)


def rounded(values: np.ndarray, random: np.ndarray) -> np.ndarray:
    """Return values rounded up or down to 16 bits, by 16 random bits."""
    bits = values.astype(np.float32).view(np.uint32) + (random & np.uint32(0xFFFF))
    return (bits & np.uint32(0xFFFF0000)).view(np.float32)


def test_a_step_rounds_as_numpy_does(device: Device) -> None:
    """Three steps of the moments in float64, each rounded with the same random numbers."""
    config = config_of(**HALF)
    buffers, optimizer = started(device, config, some_splats("gaussian", N))
    rng = np.random.default_rng(3)
    first, second = np.zeros((N, 9, 3)), np.zeros((N, 9, 3))
    for iteration in range(1, 4):
        on_device = CompactGradients(device, buffers.schema, CAPACITY, buffers.dtype)
        on_device.upload(gradients(buffers, rng))
        gradient = on_device.written_out(N)["sh"].astype(np.float64)
        optimizer.step(on_device, MEAN_LR, 2, iteration)
        for k in range(9):
            random = numbers(config.seed, iteration, k)
            first[:, k] = rounded(0.9 * first[:, k] + 0.1 * gradient[:, k], random)
            second[:, k] = rounded(0.999 * second[:, k] + 0.001 * gradient[:, k] ** 2, random >> np.uint32(16))
    state = dict(optimizer.state())
    for name, expected in (("first.sh", first), ("second.sh", second)):
        same = state[name] == expected
        assert same.mean() > 0.999, f"{name}: the last bit of a float decides few roundings"
        np.testing.assert_allclose(state[name], expected, rtol=1 / 64, atol=1e-30)


def test_the_second_moment_does_not_freeze(device: Device) -> None:
    """With one gradient in all steps, both moments approach their limits. Rounded to the nearest, v would stay low."""
    buffers, optimizer = started(device, config_of(**HALF), some_splats("gaussian", N))
    grads = CompactGradients(device, buffers.schema, CAPACITY, buffers.dtype)
    grads.upload({name: np.ones_like(array) for name, array in gradients(buffers, np.random.default_rng(0)).items()})
    steps = 700
    for iteration in range(1, steps + 1):
        optimizer.step(grads, 0.0, 0, iteration)
    state, gradient = dict(optimizer.state()), grads.written_out(N)["sh"][:, 0]
    np.testing.assert_allclose(state["first.sh"][:, 0], gradient, rtol=0.03)
    limit = gradient**2 * (1 - 0.999**steps)
    assert np.mean(state["second.sh"][:, 0] / limit) == pytest.approx(1, abs=0.01)
    assert np.std(state["second.sh"][:, 0] / limit) < 0.1


def test_steps_are_close_to_those_of_32_bits(device: Device) -> None:
    """Also with growth: the words move with their splats."""
    config = config_of(**HALF)
    both = [started(device, one, some_splats("gaussian", N)) for one in (config, replace(config, half_moments=False))]
    rng = np.random.default_rng(3)
    for iteration in range(1, 21):
        grads = gradients(both[0][0], rng)
        for buffers, optimizer in both:
            on_device = CompactGradients(device, buffers.schema, CAPACITY, buffers.dtype)
            on_device.upload(grads)
            optimizer.step(on_device, MEAN_LR, 2, iteration)
            if iteration == 10:
                optimizer.apply(growing(buffers.download(buffers.n), np.random.default_rng(1)))
    half, full = (dict(optimizer.read()) for _, optimizer in both)
    for name, expected in full.items():
        rate = 2.5e-3 if name == "sh" else 0
        assert np.abs(half[name] - expected).max() <= 20 * rate * 0.02, name
    assert (half["sh"] != full["sh"]).mean() > 0.9
    assert isinstance(both[0][1], FusedOptimizer)
    assert both[0][1].moments.second.schema.rows(Group.SH) == 0, "one word holds both moments"


def test_visible_steps_catch_up(device: Device) -> None:
    """Skipped steps decay the words too; reading does not change them."""
    config = config_of(**HALF, visible_adam=True)
    splats = some_splats("gaussian", N)
    both = [started(device, one, splats) for one in (config, replace(config, half_moments=False))]
    rng = np.random.default_rng(8)
    for iteration in range(1, 25):
        grads, seen = gradients(both[0][0], rng), some_seen(N, rng)
        for buffers, optimizer in both:
            visible_step(buffers, optimizer, grads, seen, iteration)
    before = both[0][1].state()["first.sh"]
    half, full = (optimizer.read()["sh"] for _, optimizer in both)
    np.testing.assert_array_equal(both[0][1].state()["first.sh"], before)
    assert np.abs(half - full).max() <= 24 * 2.5e-3 * 0.03
    both[0][1].settle()
    np.testing.assert_array_equal(both[0][0].download(N)["sh"], half)


def test_words_keep_their_moments() -> None:
    rng = np.random.default_rng(0)
    first = np.concatenate([rng.standard_normal(99) * 10.0 ** rng.integers(-20, 9, 99), [0.0]]).astype(np.float32)
    words = packed(first, first**2)
    again = unpacked(words)
    np.testing.assert_allclose(again[0], first, rtol=1 / 256)
    np.testing.assert_allclose(again[1], first**2, rtol=1 / 256, atol=1e-38)
    np.testing.assert_array_equal(packed(*again), words)


def test_numpy_has_full_moments_only() -> None:
    with pytest.raises(InputError, match="half_moments needs optimizer fused"):
        TrainConfig(half_moments=True, optimizer="numpy")

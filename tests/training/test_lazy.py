"""Adam for visible splats, once settled, equals dense Adam, in NumPy and on the device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from training.test_optimizer import (
    CAPACITY,
    CASES,
    MEAN_LR,
    config_of,
    gradients,
    growing,
    kernels_of,
    shrinking,
    some_splats,
    started,
    words,
)

from clsplat.device.device import Device
from clsplat.device.memory import to_device
from clsplat.device.schedule import SCHEDULES
from clsplat.errors import InputError
from clsplat.rendering.splat_buffers import CompactGradients, SplatBuffers
from clsplat.scenes.random_scene import synthetic_scene
from clsplat.scenes.scene import Scene, View
from clsplat.splats.morton import morton_order
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.density.edit import DensifyEdit
from clsplat.training.density.table import SplatTable
from clsplat.training.log import Progress
from clsplat.training.optim.adam import NumpyAdam
from clsplat.training.optim.lazy import DRIFT_MEAN, WAITS, Drifts
from clsplat.training.optim.lazy_reference import awake
from clsplat.training.optim.optimizer import Optimizer
from clsplat.training.run import train
from clsplat.training.trainer import Trainer

STEPS = 36
CULLED = 0xFFFFFFFF
TOLERANCE = 1e-5  # some ulp of each value in float32 steps; the dense form has them also where gradients are 0

VISIBLE = [
    *CASES,
    {"shape": "skew-normal", "strategy": "mcmc"},
    {"shape": "skew-normal", "alternation": "cyclic", "alternation_warmup": 0.0, "alternation_cycle": 7},
]


def keys(buffers: SplatBuffers, seen: np.ndarray) -> Any:
    """Return the depth keys of an image in which these splats are visible."""
    buffer = buffers.device.alloc(4 * len(seen))
    to_device(buffers.device, buffer, np.where(seen, 1000, CULLED).astype(np.uint32))
    return buffer


def step(
    buffers: SplatBuffers,
    optimizer: Optimizer,
    grads: dict[str, np.ndarray],
    seen: np.ndarray,
    iteration: int,
    sh_degree: int = 2,
) -> None:
    """Take a step with gradients of the visible splats only. The learning rate of the positions falls."""
    on_device = CompactGradients(buffers.device, buffers.schema, CAPACITY, buffers.dtype)
    on_device.upload({name: np.where(seen.reshape(-1, *[1] * (a.ndim - 1)), a, 0) for name, a in grads.items()})
    optimizer.step(on_device, MEAN_LR * 0.95**iteration, sh_degree, iteration, keys(buffers, seen))


def some_seen(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return random visible splats as a camera sees them in Morton order: a few intervals with holes, or none."""
    seen = np.zeros(n, bool)
    for _ in range(rng.integers(0, 3)):
        first = rng.integers(0, n)
        seen[first : first + rng.integers(1, 60)] = True
    return seen & (rng.random(n) < 0.8)


def assert_near(got: dict[str, np.ndarray], wanted: dict[str, np.ndarray], tolerance: float = TOLERANCE) -> None:
    for name, expected in wanted.items():
        np.testing.assert_allclose(got[name], expected, tolerance, tolerance, err_msg=name)


@pytest.mark.parametrize("options", VISIBLE, ids=words)
def test_lazy_steps_equal_dense_ones(device: Device, options: dict[str, object]) -> None:
    """Test all fields of all shapes, read and settled at random steps, with growth and shrinking."""
    config = config_of(**options)
    splats = some_splats(config.shape)
    dense = started(device, config, splats)
    lazy = {
        name: started(device, replace(config, visible_adam=True, optimizer=name), splats) for name in ("fused", "numpy")
    }
    rng, edits, waited = np.random.default_rng(8), {13: growing, 25: shrinking}, False
    for iteration in range(1, STEPS + 1):
        n = dense[0].n
        grads, seen, does = gradients(dense[0], rng), some_seen(n, rng), rng.random(2) < (0.06, 0.15)
        for buffers, optimizer in (dense, *lazy.values()):
            step(buffers, optimizer, grads, seen, iteration, sh_degree=min(iteration // 12, 2))
            if does[0]:
                optimizer.settle()
            if iteration in edits:
                optimizer.settle()
                optimizer.apply(edits[iteration](buffers.download(n), np.random.default_rng(iteration)))
        if not (does.any() or iteration in edits or iteration == STEPS):
            continue
        truth = dense[0].download(dense[0].n)
        for buffers, optimizer in lazy.values():
            stored = buffers.download(buffers.n)
            waits = not all(np.allclose(stored[name], truth[name], 1e-4, 1e-4) for name in truth)
            assert not (waits and (does[0] or iteration in edits)), "settled"
            waited |= waits
            assert_near(optimizer.read(), truth)
            assert_near(buffers.download(buffers.n), stored, 0.0)
    assert waited
    states = [dict(optimizer.state()) for _, optimizer in lazy.values()]
    assert set(states[0]) == set(states[1]) == set(dense[1].state()) | {"waiting.last", "waiting.drifts"}
    for name, expected in states[1].items():
        near = 1e-4 if name == "momentum" else 1e-5  # the gate amplifies the rounding of an opacity a hundred times
        np.testing.assert_allclose(states[0][name], expected, near, 3e-6 * np.abs(expected).max(), err_msg=name)


@pytest.mark.parametrize("options", VISIBLE[-2:], ids=words)
def test_lazy_steps_equal_dense_ones_with_vectors_of_one_splat(
    device: Device, options: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The schedules of GPUs have one splat in a vector."""
    monkeypatch.setattr("training.test_optimizer.default_schedule", lambda info: SCHEDULES["gpu32"])
    assert kernels_of(device, config_of(), 2).lanes == 1
    test_lazy_steps_equal_dense_ones(device, options)


def test_drifts_are_those_of_dense_adam() -> None:
    """Test in float64: bias corrections of the first steps, a falling rate, and many steps without gradient."""
    rng = np.random.default_rng(0)
    adam, drifts, values = NumpyAdam({"x": np.zeros(40)}), Drifts(), np.zeros(40)
    started_at, state = rng.integers(1, 30, 40), np.zeros((3, 40))  # values and moments after the last gradient
    for step_count in range(1, WAITS + 1):
        rate = 0.01 * 0.97**step_count
        gradient = np.where(step_count <= started_at, rng.standard_normal(40) * 10.0 ** rng.integers(-6, 2, 40), 0)
        adam.advance()
        values -= rate * adam.direction("x", gradient)
        drifts.advance((True, False), (step_count, 0), rate)
        ends = step_count == started_at
        state[:, ends] = values[ends], adam.first["x"][ends], adam.second["x"][ends]
        if step_count in (31, 60, 255):
            waited = step_count - started_at
            expected, first, second = state
            drift = drifts.table[2 + DRIFT_MEAN][waited] * first / np.sqrt(second)
            np.testing.assert_allclose(expected - drift, values, rtol=1e-9, atol=1e-12)
            assert np.abs(drift).max() > 1e-3
            np.testing.assert_allclose(drifts.table[0][waited] * first, adam.first["x"], rtol=1e-10)
            np.testing.assert_allclose(drifts.table[1][waited] * second, adam.second["x"], rtol=1e-10)


def test_vectors_wake_by_a_splat_or_when_the_tables_end() -> None:
    last = np.array([[300, 300, 300 - WAITS + 1, 300], [7, 7, 7, 7]])
    seen = np.zeros(13, bool)
    np.testing.assert_array_equal(awake(seen, last, (300, 7), 4), [False, False, True, False])
    seen[[5, 12]] = True
    np.testing.assert_array_equal(awake(seen, last, (300, 7), 4), [False, True, True, True])


@pytest.mark.parametrize("name", ["fused", "numpy"])
def test_nothing_waits_longer_than_the_tables_go(devices: list[Device], name: str) -> None:
    """At the maximum age an invisible vector takes a step. Its values and moments equal those of dense steps."""
    config = config_of(shape="gaussian", optimizer=name)
    splats = some_splats("gaussian", 40, 0)
    dense, lazy = started(devices[0], config, splats), started(devices[0], replace(config, visible_adam=True), splats)
    rng, seen = np.random.default_rng(3), np.arange(40) < 16
    for iteration in range(1, WAITS + 20):
        grads = gradients(dense[0], rng)
        for buffers, optimizer in (dense, lazy):
            step(buffers, optimizer, grads, seen | (iteration < 3), iteration, 0)
    assert lazy[1].state()["waiting.last"][0].min() == WAITS + 2
    assert_near(lazy[1].read(), dense[0].download(40), 2e-5)


def test_a_state_continues_to_the_same_bits(devices: list[Device]) -> None:
    """Skipped steps are part of the state, even if another optimizer loads it."""
    config = config_of(shape="bisected-skew", visible_adam=True)
    rng = np.random.default_rng(3)
    buffers, optimizer = started(devices[0], config, some_splats(config.shape))
    for iteration in range(1, 12):
        step(buffers, optimizer, gradients(buffers, rng), some_seen(300, rng), iteration)
    state, splats = dict(optimizer.state()), Splats(config.shape, buffers.download(300))
    grads, seen = gradients(buffers, rng), some_seen(300, rng)
    step(buffers, optimizer, grads, seen, 12)
    for name, tolerance in (("fused", 0.0), ("numpy", TOLERANCE)):
        others, other = started(devices[0], replace(config, optimizer=name), splats)
        other.load_state(state)
        step(others, other, grads, seen, 12)
        assert_near(other.read(), optimizer.read(), tolerance)
        with pytest.raises(InputError, match=r"waiting\.last"):
            other.load_state({key: array for key, array in state.items() if key != "waiting.last"})


@pytest.mark.parametrize("make_edit", [growing, shrinking])
def test_a_plan_in_another_order_makes_the_same_splats(make_edit: Callable[..., DensifyEdit]) -> None:
    rng = np.random.default_rng(4)
    arrays = some_splats("skew-normal").to_numpy()
    edited = make_edit(arrays, rng)
    order = rng.permutation(len(edited.source))
    permuted, state = edited.permuted(order, 300), rng.standard_normal((300, 4))
    for name, expected in edited.apply(arrays).items():
        np.testing.assert_array_equal(permuted.apply(arrays)[name], expected[order])
    for name in ("quat", "opacity_logit"):  # shrinking resets the opacity
        np.testing.assert_array_equal(permuted.apply_state(state, name), edited.apply_state(state, name)[order])


# --- training --------------------------------------------------------------------------------

CONFIG = TrainConfig(
    shape="skew-normal",
    iterations=60,
    cap_max=700,
    sh_degree=1,
    densify_interval=20,
    checkpoint_interval=0,
    densify_until=0.8,
    grad_threshold=1e-6,
    visible_adam=True,
)


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, TrainConfig]:
    """Return a scene in which each image shows only a part, and a config."""
    scene, splats = synthetic_scene(500, 48, 32, sh_degree=1, n_views=5)

    def nearer(view: View) -> View:
        return replace(view, camera=replace(view.camera, fx=4 * view.camera.fx, fy=4 * view.camera.fy))

    path = tmp_path_factory.mktemp("wide") / "start.ply"
    splats.save(path)
    scene = replace(scene, views=[nearer(view) for view in scene.views], test_names=frozenset({"view_000.png"}))
    return scene, replace(CONFIG, init=str(path))


def test_training_steps_what_was_seen_and_settles_before_each_action(
    wide: tuple[Scene, TrainConfig], devices: list[Device], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every splat with a gradient takes a step, and the others wait. The strategy edits settled splats."""
    trainer = Trainer(*wide, device=devices[0])
    sparse, edited = 0, []

    def unchanged(splats: SplatTable) -> DensifyEdit:
        read, n = dict(trainer.optimizer.read()), trainer.splats.n
        edited.append(all(np.array_equal(splats.field(name), array) for name, array in read.items()))
        return DensifyEdit(np.arange(n), {}, np.zeros(n, bool))

    monkeypatch.setattr("clsplat.training.density.control.next_edit", lambda config, splats, *rest: unchanged(splats))
    for _ in range(40):
        before = trainer.splats.download(500)
        trainer.step()
        last = trainer.optimizer.state()["waiting.last"][0]
        stepped = np.repeat(last == trainer.iteration, trainer.kernels.lanes)[:500]
        moved = np.zeros(500, bool)
        for name, array in trainer.splats.download(500).items():
            moved |= (array != before[name]).reshape(500, -1).any(axis=1)
        pulled = np.zeros(500, bool)
        for array in trainer.grads.written_out(500).values():
            pulled |= array.reshape(500, -1).any(axis=1)
        assert pulled.any()
        assert not (pulled & ~stepped).any()
        if trainer.iteration % 20:
            assert not (moved & ~stepped).any()
            sparse += not stepped.all()
    assert sparse > 10
    assert edited == [True, True]


def test_actions_leave_splats_in_morton_order(wide: tuple[Scene, TrainConfig], devices: list[Device]) -> None:
    """The order uses the current positions, also after growth."""
    trainer = Trainer(*wide, device=devices[0])
    for _ in range(20):
        trainer.step()
    assert trainer.splats.n > 500
    np.testing.assert_array_equal(
        morton_order(trainer.splats.download(trainer.splats.n)["mean"]), np.arange(trainer.splats.n)
    )


def test_what_reads_a_run_does_not_change_it(wide: tuple[Scene, TrainConfig], tmp_path: Path) -> None:
    """Evaluations, saved files and an interruption at any time do not change a bit of the result."""
    scene, config = wide
    quiet = train(scene, config).splats.to_numpy()
    read = replace(config, test_iterations=(7, 33), save_iterations=(11, 45), checkpoint_interval=37)

    def stop(progress: Progress) -> None:
        if progress.iteration == 50:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(scene, read, stop, output=tmp_path / "m")
    resumed = train(scene, read, output=tmp_path / "m", resume=True).splats.to_numpy()
    dense = train(scene, replace(config, visible_adam=False)).splats.to_numpy()
    for name, expected in quiet.items():
        np.testing.assert_array_equal(resumed[name], expected, err_msg=name)
        assert len(dense[name]) != len(expected) or np.any(dense[name] != expected), name


def test_numpy_trains_the_same_model(wide: tuple[Scene, TrainConfig]) -> None:
    scene, config = wide
    config = replace(config, iterations=12, densify_interval=100)
    fused, numpy = (train(scene, replace(config, optimizer=name)).splats.to_numpy() for name in ("fused", "numpy"))
    for name, expected in numpy.items():
        difference = np.abs(fused[name] - expected)
        assert np.quantile(difference, 0.95) < 1e-4, name  # gradients that are only rounding have random signs

"""Splats that a run shows and does not change."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.scenes.scene import Scene
from clsplat.splats.fields import Group
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.optim.fused import FusedOptimizer
from clsplat.training.run import train
from clsplat.training.trainer import Trainer

RUN: dict[str, Any] = {
    "shape": "skew-normal",
    "iterations": 30,
    "cap_max": 60,
    "sh_degree": 1,
    "densify_interval": 5,
    "near_plane": 0.01,
    "antialiased": True,
    "low_pass": 0.1,
    "random_points": 0.0,
    "dropout": 0.0,
    "depth_smoothness": 0.0,
    "coarse_to_fine": False,
    "grad_threshold": 0.0,
}


@pytest.fixture(scope="module")
def parts(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Splats]:
    """The file of half of a model, and its other half."""
    model = train(scene, TrainConfig(**{**RUN, "cap_max": 80})).splats
    order = np.argsort(model.mean[:, 0])
    file = tmp_path_factory.mktemp("context") / "half.ply"
    model.select(order[:40]).save(file)
    return file, model.select(order[40:])


def options(file: Path, **more: Any) -> TrainConfig:
    return TrainConfig(**{**RUN, "init": str(file), "strategy": "adc", "opacity_reg": 0.0, **more})


@pytest.mark.parametrize("more", [{}, {"half_moments": True}, {"shape": "student-t"}], ids=str)
def test_the_context_stays_as_it_is(scene: Scene, parts: tuple[Path, Splats], more: dict[str, Any]) -> None:
    file, context = parts
    context = context.as_shape(more.get("shape", RUN["shape"]))
    splats = train(scene, options(file, **more), context=context).splats
    n = len(splats) - len(context)
    assert 40 < n <= RUN["cap_max"], "the other splats grow to the cap"
    for name, array in context.arrays.items():
        assert (splats.arrays[name][n:] == array).all(), name
    start = Splats.load(file)
    assert not np.isin(start.mean, splats.mean[:n]).all(), "they move"


def test_a_run_goes_on_with_its_own_context_only(
    scene: Scene, parts: tuple[Path, Splats], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file, context = parts
    config = options(file, iterations=20)
    train(scene, config, output=tmp_path, context=context)
    longer = config.replace(iterations=30)
    for other in (context.select(np.arange(len(context) - 1)), context.select(np.arange(len(context))[::-1])):
        with pytest.raises(InputError, match="the context is not that of the checkpoint"):
            train(scene, longer, output=tmp_path, resume=True, context=other)
    assert len(train(scene, longer, output=tmp_path, resume=True, context=context).splats) > len(context)


def test_the_context_is_shown(scene: Scene, parts: tuple[Path, Splats]) -> None:
    file, context = parts
    with_context, without = (Trainer(scene, options(file), context=given) for given in (context, None))
    assert with_context.evaluate(scene.train).psnr > without.evaluate(scene.train).psnr + 0.5
    assert len(with_context.snapshot()) == len(without.snapshot()) + len(context)


def test_strategies_see_the_other_splats_only(scene: Scene, parts: tuple[Path, Splats]) -> None:
    """A context of nearly transparent splats is not pruned."""
    file, context = parts
    faint = context.with_arrays(context.to_numpy() | {"opacity_logit": np.full(len(context), -6, np.float32)})
    splats = train(scene, options(file), context=faint).splats
    assert (splats.opacity_logit[-len(faint) :] == -6).all()


def test_a_resumed_run_has_the_same_bits(scene: Scene, parts: tuple[Path, Splats], tmp_path: Path) -> None:
    file, context = parts
    whole = train(scene, options(file), context=context).splats

    def stop(trainer: Trainer, event: Any) -> None:
        if trainer.iteration == 17:
            event.set()

    train(scene, options(file), output=tmp_path / "run", visit=stop, context=context)
    splats = train(scene, options(file), output=tmp_path / "run", resume=True, context=context).splats
    assert all((splats.arrays[name] == array).all() for name, array in whole.arrays.items())


def test_a_checkpoint_of_an_earlier_version_goes_on(scene: Scene, parts: tuple[Path, Splats], tmp_path: Path) -> None:
    """In such files the context has moments of zero, and a mean."""
    file, context = parts
    context.save(tmp_path / "context.ply")
    config = options(file, average_last=0.5, densify_until=0.4, iterations=40)
    whole = train(scene, config, context=context).splats

    def stop(trainer: Trainer, event: Any) -> None:
        if trainer.iteration == 30:
            event.set()

    train(scene, config, output=tmp_path / "run", visit=stop, context=tmp_path / "context.ply")
    checkpoint = tmp_path / "run" / "checkpoint.npz"
    with np.load(checkpoint) as stored:
        arrays = dict(stored)
    for name, rows in arrays.items():
        if name.startswith("average.") and name != "average.count":
            arrays[name] = np.concatenate([rows, context.arrays[name.removeprefix("average.")]])
        elif name.startswith("optimizer.") and name != "optimizer.steps":
            arrays[name] = np.concatenate([rows, np.zeros((len(context), *rows.shape[1:]), rows.dtype)])
    np.savez(checkpoint, **arrays)
    splats = train(scene, config, output=tmp_path / "run", resume=True, context=context).splats
    assert all((splats.arrays[name] == array).all() for name, array in whole.arrays.items())


def test_a_mean_of_fewer_splats_is_refused(scene: Scene, parts: tuple[Path, Splats]) -> None:
    """It is that of a run with a context, and this run has no context."""
    file, _ = parts
    config = options(file, average_last=0.5, densify_until=0.4, iterations=40)
    checkpoint = Trainer(scene, config).checkpoint()
    mean = {name: array[1:] for name, array in dict(checkpoint.splats).items()}
    with pytest.raises(InputError, match="its average is not of the same splats"):
        Trainer(scene, config, replace(checkpoint, average=mean | {"count": np.array([1])}))


def test_splats_of_the_context_have_no_moments(scene: Scene, parts: tuple[Path, Splats]) -> None:
    file, context = parts
    many = context.select(np.arange(5000) % len(context))
    trainer = Trainer(scene, options(file), context=many)
    optimizer = trainer.optimizer
    assert isinstance(optimizer, FusedOptimizer)
    for _ in range(12):
        trainer.step()
        assert {moments.capacity for moments in (optimizer.moments.first, optimizer.moments.second)} == {1024}
        assert all(buffer.size == 4 * 3 * 1024 for buffer in (optimizer.skew.s.buffer, optimizer.skew.s.spare))
        for moments in (optimizer.moments.first, optimizer.moments.second):
            assert {group: buffer.size for group, buffer in moments.buffers.items()} == {
                group: moments.group_bytes(group) for group in Group
            }
    assert trainer.splats.n_live > 40
    assert len(optimizer.state()["first.mean"]) == len(optimizer.read()["mean"]) == trainer.splats.n_live


@pytest.mark.parametrize(
    "more",
    [{"strategy": "mcmc"}, {"opacity_reg": 0.1}, {"noise_lr": 1.0}, {"optimizer": "numpy"}, {"sh_degree": 2}],
)
def test_runs_that_would_change_it_are_refused(scene: Scene, parts: tuple[Path, Splats], more: dict[str, Any]) -> None:
    file, context = parts
    with pytest.raises(InputError, match="context"):
        train(scene, options(file, **more), context=context)


def test_the_context_is_never_removed(scene: Scene, parts: tuple[Path, Splats]) -> None:
    file, context = parts
    trainer = Trainer(scene, options(file), context=context)
    n = trainer.splats.n
    gone = np.zeros(n, np.bool_)
    gone[[3, n - 1, n - len(context)]] = True
    trainer.density.remove(gone)
    assert trainer.splats.n == n - 1
    for name, array in context.arrays.items():
        assert (trainer.snapshot().arrays[name][-len(context) :] == array).all(), name
    trainer.density.remove(np.ones(n - 1, np.bool_))
    assert trainer.splats.n == n - 1, "as without a context: a run keeps its splats if all are to go"

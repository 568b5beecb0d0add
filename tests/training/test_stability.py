"""Fixed faults of hazardous inputs stay fixed: a small version of the tables of benchmarks/stability.py."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import MakeRenderer

from clsplat.device.device import Device
from clsplat.errors import InputError, TrainingError
from clsplat.scenes.scene import Scene
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.optim.noise import PUBLISHED_EXTENT
from clsplat.training.optim.rules import Rules
from clsplat.training.trainer import Trainer

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from hazards import crafted, static


@pytest.mark.parametrize("shape", ["gaussian", "skew-normal", "skew-normal-direct"])
@pytest.mark.parametrize("hazard", crafted.STATIC)
def test_crafted_splats(hazard: str, shape: str, devices: list[Device], make_renderer: MakeRenderer) -> None:
    """The result is finite and equals the double build's image and gradients, or one line names the refused splat."""
    arrays = crafted.STATIC[hazard](SHAPES[shape])
    if not arrays:
        pytest.skip("nothing of this shape is at risk")
    row = static.judged(shape, arrays, make_renderer(devices[0]), *[make_renderer(devices[0], "float64")] * 2)
    # Float32 loses the gradient of the scale if needles are as long as ten images (benchmarks/STABILITY.md).
    expected = "stops" if "beyond" in hazard or "NaN" in hazard else "loses" if "400 px" in hazard else "survives"
    assert row["verdict"] == expected, row
    assert row["finite"]
    assert bool(row["message"]) == (row["verdict"] == "stops")


def test_splats_out_of_sight_leave_their_colour_alone(devices: list[Device], make_renderer: MakeRenderer) -> None:
    """A scale that overflows float32 gives a NaN mean. Its product with 0 must not reach the colour."""
    arrays = crafted.benign(SHAPES["skew-normal-direct"])
    arrays["log_scale"][::3] = 90.0
    renderer = make_renderer(devices[0])
    splats = Splats("skew-normal-direct", {name: values.astype(np.float32) for name, values in arrays.items()})
    image = renderer.render(splats, crafted.camera())
    grads = renderer.backward(np.ones_like(image.color))
    assert not grads["sh"][::3].any()
    assert grads["sh"].any()


def test_scales_are_held_down_alike_in_all_large_scenes() -> None:
    """The test compares the weight of the mean scale, in units of the scene's extent."""
    config = TrainConfig(scale_reg=0.01)
    small, published, large = (
        Rules(config, extent).penalty(10).scale * extent for extent in (1.0, PUBLISHED_EXTENT, 1e4)
    )
    assert published == pytest.approx(large)
    assert small == pytest.approx(published / PUBLISHED_EXTENT)


def test_training_stops_when_nothing_shows(scene: Scene, devices: list[Device], tmp_path: Path) -> None:
    transparent = Splats.from_points(scene.points.xyz[:50], scene.points.rgb[:50], "gaussian", 0, opacity=1e-3)
    transparent.save(tmp_path / "start.ply")
    config = TrainConfig(
        shape="gaussian", sh_degree=0, iterations=20, densify_interval=5, cap_max=50, init=str(tmp_path / "start.ply")
    )
    trainer = Trainer(scene, config, device=devices[0])
    assert 5 < len(scene.train) <= 10, "the run stops once all photos were there"
    with pytest.raises(TrainingError, match=r"iteration 10: no image shows any splat .*check the start \(init\)"):
        trainer.run()


@pytest.mark.parametrize("strategy", ["adc", "mcmc"])
def test_a_photo_that_shows_nothing_does_not_stop_a_run(scene: Scene, devices: list[Device], strategy: str) -> None:
    """Each iteration densifies, so that one photo decides what was visible."""
    pose = np.eye(4)
    pose[2, 3] = -1000.0  # the scene is behind the camera
    first = scene.train[0]
    views = [replace(view, camera=view.camera.posed(pose)) if view is first else view for view in scene.views]
    config = TrainConfig(
        shape="gaussian", sh_degree=0, iterations=40, densify_interval=1, cap_max=50, strategy=strategy, random_points=0
    )
    trainer = Trainer(replace(scene, views=views), config, device=devices[0])
    assert trainer.run().finished


def test_training_refuses_rates_that_it_does_not_survive(scene: Scene, devices: list[Device]) -> None:
    with pytest.raises(InputError, match=r"^scaling_lr 0.5: each of 60 iterations .* use at most"):
        Trainer(scene, TrainConfig(iterations=60, scaling_lr=0.5), device=devices[0])


def test_the_units_of_the_scene_do_not_matter(scene: Scene, devices: list[Device]) -> None:
    """The published 3DGS-MCMC throws splats out of large scenes. clsplat does not."""
    config = TrainConfig(
        shape="gaussian", sh_degree=0, iterations=40, cap_max=300, strategy="mcmc", densify_interval=10
    )
    psnr = []
    for unit in (1.0, 1e4):
        points = replace(scene.points, xyz=scene.points.xyz * unit)
        views = []
        for view in scene.views:
            pose = view.camera.cam_from_world.copy()
            pose[:3, 3] *= unit
            views.append(replace(view, camera=view.camera.posed(pose)))
        trainer = Trainer(Scene(scene.name, scene.path, views, points, scene.test_names), config, device=devices[0])
        trainer.run()
        psnr.append(trainer.evaluate(trainer.scene.test).psnr)
    assert abs(psnr[0] - psnr[1]) < 0.5


def test_splats_thrown_out_of_the_scene_do_not_reach_the_file(scene: Scene, devices: list[Device]) -> None:
    config = TrainConfig(shape="gaussian", sh_degree=0, iterations=10, cap_max=50)
    trainer = Trainer(scene, config, device=devices[0])
    arrays = trainer.splats.download(trainer.splats.n)
    arrays["mean"][3, 1], arrays["mean"][4, 0], arrays["mean"][5, 2] = 1e28, np.nan, -np.inf
    trainer.splats.set(arrays)
    kept = trainer.snapshot()
    assert len(kept) == 47
    np.testing.assert_array_equal(kept.mean, np.delete(arrays["mean"], [3, 4, 5], axis=0))

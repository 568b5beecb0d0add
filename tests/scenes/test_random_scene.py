"""Random scenes: the same arguments give the same bits, and the work per pixel hardly depends on the count."""

from __future__ import annotations

import numpy as np
import pytest

from clsplat.device.device import Device
from clsplat.device.schedule import default_schedule
from clsplat.errors import InputError
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.overdraw import count_pairs
from clsplat.rendering.pipeline import Pipeline
from clsplat.rendering.splat_buffers import SplatBuffers
from clsplat.scenes.random_scene import synthetic_scene
from clsplat.splats.shapes import SHAPES


@pytest.mark.parametrize("shape", SHAPES)
def test_splats_of_every_shape_differ_from_neutral_values(shape: str) -> None:
    scene, splats = synthetic_scene(300, 40, 30, shape, sh_degree=1, n_views=3)
    assert (splats.shape, len(splats), splats.sh_degree) == (shape, 300, 1)
    for field in SHAPES[shape].fields:
        assert (splats.to_numpy()[field.name] != np.asarray(field.neutral)).any()
    assert [view.image.shape for view in scene.train] == [(30, 40, 3)] * 3
    assert not scene.test


def test_equal_arguments_give_equal_bits() -> None:
    (first, splats), (second, others) = (synthetic_scene(50, 32, 24) for _ in range(2))
    for name, values in splats.to_numpy().items():
        np.testing.assert_array_equal(values, others.to_numpy()[name])
    for view, other in zip(first.views, second.views, strict=True):
        np.testing.assert_array_equal(view.image, other.image)
        np.testing.assert_array_equal(view.camera.cam_from_world, other.camera.cam_from_world)
    _, another = synthetic_scene(50, 32, 24, seed=1)
    assert (another.mean != splats.mean).any()


def test_useful_pairs_per_pixel_stay_the_same(devices: list[Device]) -> None:
    """With four times the splats, pairs per pixel stay within a quarter; chance and the cutoff cause the rest."""
    device = devices[0]
    kernels = KernelBuild("gaussian", 0, default_schedule(device.info))
    pipeline, pairs = Pipeline(device, kernels), []
    for n in (1000, 4000):
        scene, splats = synthetic_scene(n, 160, 120, "gaussian", sh_degree=0)
        buffers = SplatBuffers.of(device, splats, kernels.dtype)
        pairs.append(sum(count_pairs(pipeline, pipeline.forward(buffers, view.camera)) for view in scene.views))
    assert 0.8 < pairs[1] / pairs[0] < 1.25, pairs


@pytest.mark.parametrize("wrong", [{"n": 0}, {"width": 15}, {"height": 15}, {"n_views": 1}])
def test_impossible_scenes_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(InputError, match="at least 1 splat, 16x16 px and 2 views"):
        synthetic_scene(**{"n": 10, **wrong})

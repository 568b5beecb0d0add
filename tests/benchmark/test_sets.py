"""The data of published sets: complete, plausible, and with a source for each figure."""

from __future__ import annotations

import pytest

from clsplat.benchmark.sets import SETS, benchmark_set
from clsplat.errors import InputError

NUMBER_OF_SCENES = {"nerf-synthetic": 8, "mipnerf360": 9, "tanks": 2, "deepblending": 2, "llff": 8}


@pytest.mark.parametrize("name", SETS)
def test_figures_are_of_the_scenes_and_plausible(name: str) -> None:
    chosen = benchmark_set(name)
    assert len(chosen.scenes) == NUMBER_OF_SCENES[name]
    assert chosen.iterations == 30_000
    assert all(name == name.lower() for name in chosen.scenes)
    for published in chosen.published:
        assert published.source
        assert published.mean is not None or published.values["psnr"]
        for metric, (low, high) in {"psnr": (15, 45), "ssim": (0.4, 1), "lpips": (0, 0.6)}.items():
            values = published.values.get(metric, {})
            assert values.keys() <= chosen.scenes.keys()
            assert all(low < value < high for value in values.values()), (published.system, metric)
        assert published.splats.keys() <= chosen.scenes.keys()


@pytest.mark.parametrize("name", [name for name in SETS if name != "nerf-synthetic"])
def test_every_eighth_view_is_a_test_view(name: str) -> None:
    for scene in benchmark_set(name).scenes.values():
        assert scene.test == -(-(scene.train + scene.test) // 8), scene


def test_means_are_those_of_the_papers() -> None:
    """Means that the papers print: a wrong figure of a scene moves them."""
    synthetic = {each.system: each for each in benchmark_set("nerf-synthetic").published if each.iterations != 7000}
    for system, mean in {"3DGS": 33.31, "3DGS-MCMC": 33.80, "NeRF": 31.01, "TensoRF": 33.14}.items():
        values = synthetic[system].values["psnr"].values()
        assert sum(values) / 8 == pytest.approx(mean, abs=0.011), system
    outdoor = next(each for each in benchmark_set("mipnerf360").published if each.system == "3DGS")
    assert sum(outdoor.values["psnr"].values()) / 9 == pytest.approx(27.20, abs=0.011)


def test_sets_with_few_photos() -> None:
    """Sizes are those of RegNeRF (LLFF), and half or a quarter of the photos that 3DGS uses (Mip-NeRF 360)."""
    llff = benchmark_set("llff").with_photos(3)
    assert (llff.name, llff.iterations, llff.scenes["fern"].size, llff.scenes["fern"].train) == (
        "llff-3",
        10_000,
        (504, 378),
        3,
    )
    assert {each.system: each.mean for each in llff.figures}["DropGaussian"] == 20.76
    assert all(each.photos is None for each in benchmark_set("llff").figures)
    assert not benchmark_set("llff").with_photos(4).figures
    outdoor = benchmark_set("mipnerf360").with_photos(12)
    assert outdoor.scenes["garden"].size == (round(1297 / 2), 420)
    assert outdoor.scenes["garden"].factor == outdoor.scenes["room"].factor == 8
    assert outdoor.scenes["room"].size == (389, 260)
    tanks = benchmark_set("tanks").with_photos(5)
    assert (tanks.iterations, tanks.scenes["truck"].images, tanks.figures) == (30_000, "images", [])


def test_factors_of_photos() -> None:
    scenes = benchmark_set("mipnerf360").scenes
    assert (scenes["garden"].factor, scenes["kitchen"].factor) == (4, 2)
    assert benchmark_set("tanks").scenes["truck"].factor == 1
    assert benchmark_set("nerf-synthetic").scenes["lego"].images is None


def test_an_unknown_set_is_named() -> None:
    with pytest.raises(InputError, match="unknown benchmark 'lego': choose one of nerf-synthetic, mipnerf360"):
        benchmark_set("lego")

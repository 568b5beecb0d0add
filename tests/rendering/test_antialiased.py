"""Antialiased splats: kernels against the reference, constant volume on the screen, and the mode in files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_runner import clsplat, error_of
from conftest import MakeRenderer
from kernel_checks import BACKGROUND, KERNELS, SMOOTH, Arrays, Case
from reference.formulas import SKEW_MAX
from reference.renderer import FIELDS
from reference.scenes import random_camera, random_splats
from reference.tolerances import DIFFERENCES, GRADIENT_FLOAT32, IMAGE_FLOAT32, ROUNDING, relative_error
from rendering.test_gradients import differences

from clsplat.device.device import Device
from clsplat.errors import InputError
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import load_scene
from clsplat.splats.approximate import nearest_gaussians
from clsplat.splats.convert import convert
from clsplat.splats.splats import Splats
from clsplat.splats.transform import joined
from clsplat.training.config import TrainConfig
from clsplat.training.run import train

SIZES = (0.3, 3.0)  # approximate standard deviations on the screen [px]


def small_splats(n: int = 24) -> Arrays:
    """Splats about as large as a pixel, where antialiasing changes the image."""
    arrays = random_splats(5, n, 2)
    px = 1.1 * 41 / 4
    arrays["log_scale"] = np.log(np.random.default_rng(5).uniform(*SIZES, (n, 3)) / px)
    arrays["mean"] *= 0.4
    return arrays


def case_of(shape: str, normalisation: str = "peak", dtype: type = np.float32, **options: object) -> Case:
    return Case(small_splats(), random_camera(5, 41, 27), shape, normalisation, dtype, antialiased=True, **options)


DEFAULT = [("gaussian", "peak"), ("skew-normal", "peak"), ("bisected-skew", "peak"), ("ges-modulation", "peak")]


@pytest.mark.parametrize(
    ("shape", "normalisation"),
    [pytest.param(*kernel, marks=[] if kernel in DEFAULT else pytest.mark.slow) for kernel in KERNELS],
)
def test_image_and_gradients_equal_the_reference(
    make_renderer: MakeRenderer, device: Device, shape: str, normalisation: str
) -> None:
    case = case_of(shape, normalisation)
    plain = replace(case, antialiased=False)
    assert np.abs(case.image.color - plain.image.color).max() > 0.05, "the mode should change the image"
    case.check(make_renderer(device), IMAGE_FLOAT32, GRADIENT_FLOAT32)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("shape", ["gaussian", "skew-normal"])
def test_a_model_has_a_low_pass_of_its_own(
    make_renderer: MakeRenderer, device: Device, shape: str, antialiased: bool
) -> None:
    """Training has 0.1 px². A narrower low pass makes splats sharper."""
    case = replace(case_of(shape), antialiased=antialiased, low_pass=0.1)
    wide = replace(case, low_pass=0.3)
    assert np.abs(case.image.color - wide.image.color).max() > 0.02
    case.check(make_renderer(device), IMAGE_FLOAT32, GRADIENT_FLOAT32)


@pytest.mark.parametrize(
    "shape",
    [
        "skew-normal",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("gaussian", "bisected-skew", "ges-modulation")),
    ],
)
def test_double_precision_and_differences(make_renderer: MakeRenderer, device: Device, shape: str) -> None:
    """Test one shape of each kind: one opacity, two opacities, a skew displacement, and a learned size."""
    case_of(shape, dtype=np.float64).check(make_renderer(device, "float64"), ROUNDING, ROUNDING)
    few = Case(small_splats(4), random_camera(5, 23, 17), shape, dtype=np.float64, thresholds=SMOOTH, antialiased=True)
    renderer = make_renderer(device, "float64", **SMOOTH)
    few.render(renderer)
    got = few.backward(renderer)
    for field in FIELDS[shape]:
        if field != "sh":
            assert relative_error(got[field], differences(renderer, few, field)) < DIFFERENCES, field


@pytest.mark.parametrize("shape", ["gaussian", "skew-normal"])
def test_a_small_splat_keeps_its_volume(make_renderer: MakeRenderer, device: Device, shape: str) -> None:
    """The sum of alpha is proportional to the area of the splat's image, even for very small splats."""
    arrays = {
        "mean": [[0.0, 0.0, 0.0]],
        "quat": [[1.0, 0.0, 0.0, 0.0]],
        "log_scale": np.log([[0.05, 0.03, 0.04]]),
        "opacity_logit": [2.0],
        "sh": [[[0.3, 0.2, 0.1]]],
    }
    if shape != "gaussian":
        arrays["skew"] = [[0.9 * SKEW_MAX, 0.2, -0.1]]
    camera = random_camera(2, 320, 320)
    camera = replace(camera, cam_from_world=np.block([[np.eye(3), np.array([[0], [0], [4.0]])], [0, 0, 0, 1]]))
    renderer = make_renderer(device, alpha_min=0.0)
    kept = {}
    for antialiased in (False, True):
        splats = Splats(shape, {name: np.asarray(value) for name, value in arrays.items()}, antialiased=antialiased)
        sums = [
            renderer.render(splats, camera.resized(size, size), BACKGROUND).alpha.sum() * (320 / size) ** 2
            for size in (320, 160, 80, 40)
        ]
        kept[antialiased] = np.array(sums) / sums[0]
    np.testing.assert_allclose(kept[True], 1.0, atol=0.02)
    assert kept[False][-1] > 2


@pytest.mark.parametrize(("source", "target"), [("skew-normal", "skew-normal-direct"), ("ges-modulation", "gaussian")])
def test_exact_conversions_stay_exact(make_renderer: MakeRenderer, device: Device, source: str, target: str) -> None:
    """Both shapes have the same volume on the screen."""
    case = case_of(source)
    renderer = make_renderer(device)
    other = convert(case.splats, target)
    assert other.antialiased
    np.testing.assert_allclose(
        renderer.render(other, case.camera).color, renderer.render(case.splats, case.camera).color, atol=2e-5
    )


@pytest.mark.parametrize("shape", ["skew-normal"])
def test_edges_stay_finite(make_renderer: MakeRenderer, device: Device, shape: str) -> None:
    """Test flat splats seen from the side, needles, points and giants."""
    arrays = random_splats(7, 32, 1)
    arrays["log_scale"] = np.random.default_rng(7).choice([-40.0, -12.0, -3.0, 2.0], (32, 3))
    case = Case(arrays, random_camera(5, 41, 27), shape, antialiased=True, thresholds=SMOOTH)  # needs no reference
    renderer = make_renderer(device)
    assert np.isfinite(case.render(renderer).color).all()
    for name, value in case.backward(renderer).items():
        assert np.isfinite(value).all(), name


def test_files_and_operations_keep_the_mode(tmp_path: Path) -> None:
    """Test full and compact files, and every operation that returns new splats."""
    splats = _model(True)
    assert splats.antialiased
    assert not _model(False).antialiased
    for compact in (False, True):
        splats.save(tmp_path / "a.ply", compact)
        assert b"comment SplatRenderMode: mip\n" in (tmp_path / "a.ply").read_bytes()
        assert Splats.load(tmp_path / "a.ply").antialiased
    _model(False).save(tmp_path / "b.ply")
    assert not Splats.load(tmp_path / "b.ply").antialiased
    assert splats.select([1, 2]).antialiased
    assert splats.as_shape("skew-normal").antialiased
    assert splats.with_arrays(splats.to_numpy()).antialiased
    assert joined([splats, splats]).antialiased
    with pytest.raises(InputError, match="some of the models are antialiased"):
        joined([splats, _model(False)])


def test_files_and_operations_keep_the_low_pass(tmp_path: Path) -> None:
    splats = _model(True, 0.1)
    for compact in (False, True):
        splats.save(tmp_path / "a.ply", compact)
        assert b"comment clsplat low_pass=0.1\n" in (tmp_path / "a.ply").read_bytes()
        assert Splats.load(tmp_path / "a.ply").low_pass == 0.1
    _model(True).save(tmp_path / "b.ply")
    assert b"low_pass" not in (tmp_path / "b.ply").read_bytes(), "as in other programs"
    assert Splats.load(tmp_path / "b.ply").low_pass == 0.3
    for same in (
        splats.select([1, 2]),
        splats.as_shape("skew-normal"),
        splats.with_near_plane(0.5),
        convert(splats, "skew-normal"),
        nearest_gaussians(splats.as_shape("skew-normal")),
        joined([splats, splats]),
    ):
        assert (same.antialiased, same.low_pass) == (True, 0.1)
    with pytest.raises(InputError, match=r"join: the models have low passes of 0\.1 and 0\.3 px²"):
        joined([splats, _model(True)])
    for wrong in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match=r"low pass .*: give a variance above 0 \[px²\]"):
            _model(True, wrong)
    for wrong in ("0", "wide"):
        (tmp_path / "c.ply").write_bytes((tmp_path / "a.ply").read_bytes().replace(b"s=0.1\n", f"s={wrong}\n".encode()))
        with pytest.raises(InputError, match=rf"c\.ply: comment 'clsplat low_pass={wrong}': give a variance above 0"):
            Splats.load(tmp_path / "c.ply")


def _model(antialiased: bool, low_pass: float = 0.3) -> Splats:
    arrays = {name: value for name, value in random_splats(1, 5, 1).items() if name != "skew"}
    return Splats("gaussian", arrays, antialiased=antialiased, low_pass=low_pass)


def test_training_and_the_command_line(tmp_path: Path, capture_folder: Path) -> None:
    """Training renders in the same mode as the renderer, and its file records the mode."""
    folder = capture_folder
    clsplat(
        "train", folder, "-m", tmp_path / "model", "--iterations", 20, "--cap-max", 200, "--antialiased", "-q", "--eval"
    )
    model = Splats.load(tmp_path / "model" / "point_cloud" / "iteration_20" / "point_cloud.ply")
    assert model.antialiased
    scene = load_scene(folder)
    config = TrainConfig(iterations=20, cap_max=200, antialiased=True)
    again = train(scene, config).splats
    np.testing.assert_array_equal(again.mean, model.mean)
    plain = Splats(model.shape, model.arrays, model.normalisation)
    images = [Renderer().render(each, scene.test[0].camera).color for each in (model, plain)]
    assert np.abs(images[0] - images[1]).max() > 1e-3
    assert "antialiased" in error_of(
        "train",
        folder,
        "-m",
        tmp_path / "other",
        "--no-antialiased",
        "--init",
        tmp_path / "model" / "point_cloud" / "iteration_20" / "point_cloud.ply",
    )

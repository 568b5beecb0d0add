"""The reference renderer obeys the laws of rendering, and its gradients agree with differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from clsplat.cameras.camera import Camera
from reference.formulas import SKEW_MAX, rotation
from reference.renderer import (
    FIELDS,
    NEAR_PLANE,
    REFERENCES,
    blend,
    projected_point,
    reference_gradients,
    render_reference,
)
from reference.scenes import for_shape, random_camera, random_splats
from reference.tolerances import DIFFERENCES, ROUNDING, relative_error

SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=3, deadline=None)
EVERY = pytest.mark.parametrize("shape", REFERENCES)
SMOOTH = {"alpha_min": 0.0, "alpha_max": 1.0, "t_min": 0.0}
BACKGROUND = (0.2, 0.5, 0.9)


def scene(shape, *args, **options):
    """Return `random_splats` with the fields of `shape`."""
    return for_shape(random_splats(*args, **options), shape)


def weights(camera, seed=0):
    """Return random v_color and v_alpha for a camera's image."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(camera.height, camera.width, 3)), rng.normal(size=(camera.height, camera.width))


def loss(arrays, camera, v_color, v_alpha, **options):
    image = render_reference(arrays, camera, **options)
    return (v_color * image.color).sum() + (v_alpha * image.alpha).sum()


def assert_same(got, want, tolerance=ROUNDING):
    for name in want._fields:
        assert np.abs(getattr(got, name) - getattr(want, name)).max() < tolerance, name


@EVERY
def test_scenes_show_something(shape):
    """Images are neither empty nor full, and thresholds are active. The other tests need this."""
    arrays, camera = scene(shape, 0), random_camera(0)
    image = render_reference(arrays, camera, shape)
    assert 0.05 < np.abs(image.alpha).mean() < 0.9
    assert image.color.std() > 0.02
    assert np.abs(image.alpha - render_reference(arrays, camera, shape, **SMOOTH).alpha).max() > 1e-3


@EVERY
@FEW
@given(seed=SEEDS)
def test_order_of_the_splats_does_not_matter(shape, seed):
    arrays, camera = scene(shape, seed), random_camera(seed)
    shuffle = np.random.default_rng(seed).permutation(6)
    shuffled = {name: array[shuffle] for name, array in arrays.items()}
    assert_same(render_reference(shuffled, camera, shape), render_reference(arrays, camera, shape), 1e-14)
    v_color, _ = weights(camera)
    want = reference_gradients(arrays, camera, v_color, shape=shape, fields=["mean", "quat"])
    got = reference_gradients(shuffled, camera, v_color, shape=shape, fields=["mean", "quat"])
    assert all(relative_error(got[name], want[name][shuffle]) < ROUNDING for name in want)


@EVERY
@FEW
@given(seed=SEEDS)
def test_rigid_motion_of_scene_and_camera_changes_nothing(shape, seed):
    arrays, camera = scene(shape, seed, sh_degree=0), random_camera(seed)
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(rng=rng), rng.normal(size=3)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), shift
    quat = (turn * Rotation.from_quat(arrays["quat"][:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
    moved = {**arrays, "mean": turn.apply(arrays["mean"]) + shift, "quat": quat}
    other = camera.posed(camera.cam_from_world @ np.linalg.inv(pose))
    assert_same(render_reference(moved, other, shape), render_reference(arrays, camera, shape))


@EVERY
@FEW
@given(seed=SEEDS, factor=st.floats(-3.0, 3.0).filter(lambda f: abs(f) > 0.1))
def test_any_multiple_of_a_quaternion_is_the_same_rotation(shape, seed, factor):
    arrays, camera = scene(shape, seed), random_camera(seed)
    scaled = {**arrays, "quat": factor * arrays["quat"]}
    assert_same(render_reference(scaled, camera, shape), render_reference(arrays, camera, shape))
    v_color, _ = weights(camera)
    v_quat = reference_gradients(arrays, camera, v_color, shape=shape, fields=["quat"])["quat"]
    assert np.abs((v_quat * arrays["quat"]).sum(1)).max() < ROUNDING * max(1.0, np.abs(v_quat).max())
    assert np.abs(v_quat).max() > 1e-3


@EVERY
@FEW
@given(seed=SEEDS, factor=st.floats(0.2, 20.0))
def test_the_world_s_unit_does_not_matter(shape, seed, factor):
    arrays, camera = scene(shape, seed), random_camera(seed)
    pose = camera.cam_from_world.copy()
    pose[:3, 3] *= factor
    scaled = {**arrays, "mean": factor * arrays["mean"], "log_scale": arrays["log_scale"] + np.log(factor)}
    got, want = render_reference(scaled, camera.posed(pose), shape), render_reference(arrays, camera, shape)
    assert_same(got._replace(depth=got.depth / factor), want)


@EVERY
@FEW
@given(seed=SEEDS)
def test_a_transparent_splat_is_as_good_as_absent(shape, seed):
    arrays, camera = scene(shape, seed), random_camera(seed)
    for name in arrays:
        if name.startswith("opacity"):
            arrays[name][2] = 0.0 if REFERENCES[shape].signed else -40.0
    without = {name: np.delete(array, 2, 0) for name, array in arrays.items()}
    assert_same(render_reference(arrays, camera, shape), render_reference(without, camera, shape), 1e-15)


@EVERY
@FEW
@given(seed=SEEDS)
def test_a_crop_is_a_shift_of_the_principal_point(shape, seed):
    arrays, camera = scene(shape, seed), random_camera(seed, 31, 27)
    arrays["mean"] *= 0.2  # well inside the tangent clamp of the crop, which depends on the image size
    x, y, width, height = 7, 5, 14, 17
    crop = Camera(width, height, camera.fx, camera.fy, camera.cx - x, camera.cy - y, camera.cam_from_world)
    image = render_reference(arrays, camera, shape)
    window = type(image)(*(part[y : y + height, x : x + width] for part in image))
    assert_same(render_reference(arrays, crop, shape), window)


@FEW
@given(seed=SEEDS)
def test_zero_skew_renders_and_descends_like_the_gaussian(seed):
    arrays, camera = random_splats(seed), random_camera(seed)
    arrays["skew"][:] = 0.0
    assert_same(render_reference(arrays, camera, "skew-normal"), render_reference(arrays, camera, "gaussian"))
    skewed = reference_gradients(arrays, camera, *weights(camera), shape="skew-normal")
    gaussian = reference_gradients(arrays, camera, *weights(camera), shape="gaussian")
    for name, value in gaussian.items():
        assert relative_error(skewed[name], value) < ROUNDING, name


@FEW
@given(seed=SEEDS)
def test_a_skew_beyond_the_bound_acts_as_the_bound(seed):
    arrays, camera = random_splats(seed), random_camera(seed)
    arrays["skew"] /= np.linalg.norm(arrays["skew"], axis=1, keepdims=True)
    at, beyond = ({**arrays, "skew": arrays["skew"] * SKEW_MAX * factor} for factor in (1.0, 1.7))
    assert_same(render_reference(beyond, camera, "skew-normal"), render_reference(at, camera, "skew-normal"))
    v_skew = reference_gradients(beyond, camera, *weights(camera), shape="skew-normal")["skew"]
    assert np.abs((v_skew * beyond["skew"]).sum(1)).max() < ROUNDING * max(1.0, np.abs(v_skew).max())


def test_one_round_splat_by_hand():
    """On the axis, sigma² = (f s / z)² + 0.3 and alpha = o exp(-r²/(2 sigma²)), over the background."""
    camera = Camera(5, 3, 10.0, 10.0, 2.5, 1.5, np.eye(4))
    arrays = {
        "mean": np.array([[0.0, 0.0, 2.0]]),
        "quat": np.array([[2.0, 0.0, 0.0, 0.0]]),
        "log_scale": np.log([[0.2, 0.2, 0.2]]),
        "opacity_logit": np.array([0.0]),
        "sh": np.array([[[1.0, 0.0, -9.0]]]),
    }
    image = render_reference(arrays, camera, background=(0.0, 1.0, 1.0))
    r2 = (np.arange(5) - 2.0) ** 2 + (np.arange(3)[:, None] - 1.0) ** 2
    alpha = 0.5 * np.exp(-0.5 * r2 / 1.3)
    assert np.abs(image.alpha - alpha).max() < 1e-14
    assert np.abs(image.depth - 2.0 * alpha).max() < 1e-14
    assert np.abs(image.color[..., 0] - alpha * (0.5 + 0.5 / np.sqrt(np.pi))).max() < 1e-14
    assert np.abs(image.color[..., 1] - (0.5 * alpha + 1.0 - alpha)).max() < 1e-14
    assert np.abs(image.color[..., 2] - (1.0 - alpha)).max() < 1e-14  # SH below -1/2: clamped to black


def test_a_finished_pixel_stays_finished():
    """A splat that would reduce T to t_min or less is not blended, and no later splat is, however faint."""
    alphas = [np.array([[a]]) for a in (0.9, 0.95, 0.1, 0.2)]
    colors = [np.array([[c, 0.0, 0.0]]) for c in (1.0, 2.0, 4.0, 8.0)]
    depths = [np.array([z]) for z in (1.0, 2.0, 3.0, 4.0)]
    image = blend(alphas, colors, depths, (0.5, 0.0, 0.0), t_min=0.01)
    assert image.color[0, 0, 0] == pytest.approx(0.9 + 0.1 * 0.5)
    assert image.alpha[0, 0] == pytest.approx(0.9)
    assert image.depth[0, 0] == pytest.approx(0.9)
    image = blend(alphas, colors, depths, (0.5, 0.0, 0.0), t_min=0.004)
    assert image.alpha[0, 0] == pytest.approx(1.0 - 0.1 * 0.05 * 0.9)


@EVERY
def test_no_visible_splats_leave_the_background(shape):
    camera = random_camera()
    behind = scene(shape)
    behind["mean"] += camera.position + 0.9 * NEAR_PLANE * camera.rotation[2] - projected_point(behind, shape)
    none = {name: array[:0] for name, array in behind.items()}
    for arrays in (behind, none):
        image = render_reference(arrays, camera, shape, background=BACKGROUND)
        assert (image.color == BACKGROUND).all()
        assert not image.alpha.any()
        assert not image.depth.any()
        gradients = reference_gradients(arrays, camera, *weights(camera), shape=shape)
        assert all(gradients[name].shape == arrays[name].shape for name in FIELDS[shape])
        assert not any(value.any() for value in gradients.values())


def test_lower_sh_degree_is_zeroed_coefficients():
    arrays, camera = random_splats(3, sh_degree=3), random_camera(3)
    zeroed = {**arrays, "sh": arrays["sh"].copy()}
    zeroed["sh"][:, 4:] = 0.0
    assert_same(render_reference(arrays, camera, sh_degree=1), render_reference(zeroed, camera), 1e-14)
    v_sh = reference_gradients(arrays, camera, *weights(camera), sh_degree=1, fields=["sh"])["sh"]
    assert v_sh.shape == arrays["sh"].shape
    assert v_sh[:, :4].any()
    assert not v_sh[:, 4:].any()


def test_alpha_gradient_is_zero_where_clamped():
    camera = Camera(1, 1, 10.0, 10.0, 0.5, 0.5, np.eye(4))
    arrays = random_splats(0, 1, 0)
    arrays.update(mean=np.array([[0.0, 0.0, 2.0]]), opacity_logit=np.array([6.0]))
    one = np.ones((1, 1))
    got = reference_gradients(arrays, camera, one[..., None].repeat(3, 2), one, fields=["opacity_logit"])
    assert got["opacity_logit"][0] == 0.0
    free = reference_gradients(arrays, camera, np.zeros((1, 1, 3)), one, alpha_max=1.0)
    assert free["opacity_logit"][0] == pytest.approx(np.exp(-6.0) / (1.0 + np.exp(-6.0)) ** 2)


@pytest.mark.parametrize(
    ("shape", "normalisation"),
    [(shape, "peak") for shape in REFERENCES] + [("skew-normal", "pdf"), ("skew-normal-direct", "none")],
)
@pytest.mark.parametrize("seed", [1, 2])
def test_gradients_agree_with_central_differences(shape, normalisation, seed):
    arrays, camera = random_splats(seed, 3, sh_degree=3), random_camera(seed)
    arrays["skew"][0] = 0.0  # a square root or a division by |m| could fail here
    arrays["mean"][1] = camera.position + camera.rotation.T @ [-2.2, 0.3, 3.0]  # to the left of the tangent clamp
    arrays["log_scale"][1] = [0.1, -0.3, -0.1]  # wide enough to be visible nevertheless
    arrays["nu"] = np.array([2.0, 3.0, 50.0])
    arrays = for_shape(arrays, shape)
    v_color, v_alpha = weights(camera, seed)
    options = {"shape": shape, "background": BACKGROUND, "normalisation": normalisation, **SMOOTH}
    got = reference_gradients(arrays, camera, v_color, v_alpha, **options)
    assert tuple(got) == FIELDS[shape]
    for name, value in got.items():
        difference = np.zeros_like(value)
        for index in np.ndindex(value.shape):
            sides = []
            for step in (1e-5, -1e-5):
                bumped = {**arrays, name: arrays[name].copy()}
                bumped[name][index] += step
                sides.append(loss(bumped, camera, v_color, v_alpha, **options))
            difference[index] = (sides[0] - sides[1]) / 2e-5
        assert np.abs(value[1]).max() > 1e-3, f"{name}: the clamped splat is not seen"
        assert relative_error(difference, value) < DIFFERENCES, name


@EVERY
def test_gradients_with_thresholds_are_those_of_the_pixels_that_stay(shape):
    """Thresholds have their default values. No pixel crosses one within the step."""
    arrays, camera = scene(shape, 4), random_camera(4)
    v_color, v_alpha = weights(camera)
    direction = {name: np.random.default_rng(9).normal(size=arrays[name].shape) for name in FIELDS[shape]}
    sides = [
        loss({n: arrays[n] + step * direction[n] for n in direction}, camera, v_color, v_alpha, shape=shape)
        for step in (1e-7, -1e-7)
    ]
    got = reference_gradients(arrays, camera, v_color, v_alpha, shape=shape)
    slope = sum((got[name] * direction[name]).sum() for name in direction)
    assert (sides[0] - sides[1]) / 2e-7 == pytest.approx(slope, rel=1e-5)


def test_rotations_are_rotations():
    turned = rotation(random_splats(0, 9)["quat"])
    assert np.abs(turned @ np.swapaxes(turned, 1, 2) - np.eye(3)).max() < 1e-14
    assert np.abs(np.linalg.det(turned) - 1.0).max() < 1e-14

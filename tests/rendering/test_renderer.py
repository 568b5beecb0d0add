"""The renderer agrees with the reference in images, depths and gradients, on every device and schedule."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import DEVICE_SCHEDULES, MakeRenderer
from kernel_checks import BACKGROUND, KERNELS, Case
from reference.formulas import SKEW_MAX
from reference.renderer import prepared, reference_gradients, render_reference, visible_order
from reference.scenes import Arrays, for_shape, random_camera, random_splats
from reference.tolerances import GRADIENT_FLOAT32, IMAGE_FLOAT32, ROUNDING, SAME_FLOAT32, relative_error

from clsplat.cameras.camera import Camera
from clsplat.device.device import Device
from clsplat.device.schedule import SCHEDULES, TILE, Schedule, default_schedule
from clsplat.errors import InputError
from clsplat.rendering.build import BATCH, GROUP_BATCH, KernelBuild
from clsplat.rendering.frame import DeviceImage
from clsplat.rendering.pipeline import Pipeline
from clsplat.rendering.renderer import Renderer
from clsplat.rendering.splat_buffers import ParameterBuffers, SplatBuffers
from clsplat.splats.near_plane import NEAR_PLANE
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats

SKEWED = "skew-normal"
# These tests check the rasterizer, not the formulas: two shapes are enough. The other shapes are slow tests.
BOTH = pytest.mark.parametrize(
    "shape", [pytest.param(name, marks=[] if name in ("gaussian", SKEWED) else pytest.mark.slow) for name in SHAPES]
)
SKEWED_FIRST = pytest.mark.parametrize(
    "shape", [pytest.param(name, marks=[] if name == SKEWED else pytest.mark.slow) for name in SHAPES]
)
EVERY = pytest.mark.parametrize("shape", SHAPES)


@cache
def cloud(shape: str, normalisation: str = "peak", dtype: type = np.float32) -> Case:
    """24 splats of every kind in 3 x 2 tiles. The image's edge cuts the last tiles."""
    return Case(random_splats(1, 24, 3), random_camera(1, 41, 27), shape, normalisation, dtype)


@BOTH
def test_every_schedule_agrees_with_the_reference(
    make_renderer: MakeRenderer, scheduled: tuple[Device, Schedule], shape: str
) -> None:
    renderer = make_renderer(scheduled[0], schedule=scheduled[1])
    cloud(shape).check(renderer, IMAGE_FLOAT32, GRADIENT_FLOAT32)
    for case in thin_cases(shape).values():
        case.check_image(case.render(renderer), IMAGE_FLOAT32)


@BOTH
def test_one_lane_agrees_with_the_reference(make_renderer: MakeRenderer, devices: list[Device], shape: str) -> None:
    """A schedule of one lane uses other forms of the formulas. The default schedules of CPUs have 16 lanes."""
    if not devices:
        pytest.skip("no OpenCL device")
    renderer = make_renderer(devices[0], schedule=SCHEDULES["gpu256"])
    cloud(shape).check(renderer, IMAGE_FLOAT32, GRADIENT_FLOAT32)


@pytest.mark.parametrize(("shape", "normalisation"), KERNELS)
def test_every_normalisation_agrees_with_the_reference(
    make_renderer: MakeRenderer, device: Device, shape: str, normalisation: str
) -> None:
    cloud(shape, normalisation).check(make_renderer(device), IMAGE_FLOAT32, GRADIENT_FLOAT32)


@EVERY
def test_double_precision_agrees_to_rounding(make_renderer: MakeRenderer, device: Device, shape: str) -> None:
    cloud(shape, dtype=np.float64).check(make_renderer(device, "float64"), ROUNDING, ROUNDING)


@SKEWED_FIRST
def test_schedules_and_devices_agree(make_renderer: MakeRenderer, devices: list[Device], shape: str) -> None:
    """All pairs agree on decided pixels. Only the order of sums and the last bits of exp and Phi differ."""
    case, images, gradients = cloud(shape), {}, {}
    for place, name in DEVICE_SCHEDULES:
        device, schedule = devices[place], SCHEDULES[name]
        if schedule.group <= device.info.max_group:
            renderer = make_renderer(device, schedule=schedule)
            images[place, name] = case.render(renderer).color[case.decided]
            gradients[place, name] = case.backward(renderer)
    assert len(images) > len(devices)
    for a, b in itertools.combinations(images, 2):
        assert np.abs(images[a] - images[b]).max() < SAME_FLOAT32, (a, b)
        for field, value in gradients[a].items():
            assert relative_error(value, gradients[b][field]) < GRADIENT_FLOAT32, (a, b, field)


@BOTH
def test_the_same_again_gives_the_same_bits(
    make_renderer: MakeRenderer, scheduled: tuple[Device, Schedule], shape: str
) -> None:
    case, renderer = cloud(shape), make_renderer(scheduled[0], schedule=scheduled[1])
    first, again = [(case.render(renderer), case.backward(renderer)) for _ in range(2)]
    for name in ("color", "alpha", "depth"):
        assert np.array_equal(getattr(first[0], name), getattr(again[0], name)), name
    for name, value in first[1].items():
        assert np.array_equal(value, again[1][name]), name


# ---- scenes at the edges -----------------------------------------------------------------------------------


@cache
def thin_cases(shape: str) -> dict[str, Case]:
    """Test odd image sizes, numbers of splats around the batch and lane sizes, and gradients of two fields."""
    fields = ("mean", "log_scale")
    cases = {}
    for width, height in ((1, 1), (TILE, TILE), (TILE + 1, TILE - 1), (200, 5), (5, 130), (33, 64)):
        camera = random_camera(5, width, height)
        cases[f"{width} x {height}"] = Case(random_splats(5, 12, 3), camera, shape, fields=fields)
    for n in (1, 7, 8, 9, 15, 16, 17, GROUP_BATCH - 1, GROUP_BATCH + 1, BATCH - 1, BATCH, BATCH + 1, 2 * BATCH + 1):
        arrays = random_splats(n, n, 3)
        arrays["opacity_logit"] -= 2.0  # splats are faint, so that every one contributes
        cases[f"{n} splats"] = Case(arrays, random_camera(3, 13, 11), shape, fields=fields)
    return cases


@BOTH
@pytest.mark.parametrize("name", thin_cases(SKEWED))
def test_sizes_and_counts(make_renderer: MakeRenderer, device: Device, shape: str, name: str) -> None:
    thin_cases(shape)[name].check(make_renderer(device), IMAGE_FLOAT32, GRADIENT_FLOAT32)


def changed(**fields: object) -> Arrays:
    """12 splats with some fields replaced by a number, an array, or a function of the old value."""
    arrays = random_splats(7, 12, 3)
    for name, value in fields.items():
        new = value(arrays[name]) if callable(value) else value
        arrays[name] = np.broadcast_to(np.asarray(new, np.float64), arrays[name].shape).copy()
    return arrays


def skewed_to(length: float) -> Arrays:
    return changed(skew=lambda m: m * (length / np.linalg.norm(m, axis=1, keepdims=True)))


EDGES = {
    "short quaternions": lambda: changed(quat=lambda q: 1e-4 * q),
    "long quaternions": lambda: changed(quat=lambda q: 1e4 * q),
    "colours clamped at black": lambda: changed(sh=lambda sh: sh - 0.4 * (np.arange(16) == 0)[:, None]),
    "no skew": lambda: changed(skew=0.0),
    "skew just within the bound": lambda: skewed_to(0.9999 * SKEW_MAX),
    "skew beyond the bound": lambda: skewed_to(1.01 * SKEW_MAX),
    "discs": lambda: changed(log_scale=[-5.0, 1.0, 1.0]),
    "dim": lambda: changed(opacity_logit=-5.0),
    "far apart, most out of sight": lambda: changed(mean=lambda mean: 6.0 * mean),
    "partly behind the camera": lambda: changed(mean=lambda mean: mean * 5.0 + [0, 0, 1]),
}


@EVERY
@pytest.mark.parametrize("name", EDGES)
def test_edges(make_renderer: MakeRenderer, device: Device, shape: str, name: str) -> None:
    case = Case(EDGES[name](), random_camera(7, 41, 27), shape)
    assert np.ptp(case.image.alpha) > 1e-3, "nothing to see"
    case.check(make_renderer(device), IMAGE_FLOAT32, GRADIENT_FLOAT32)


@EVERY
def test_points_and_giants(make_renderer: MakeRenderer, device: Device, shape: str) -> None:
    """Splats of size 0 show only the low-pass. Splats far larger than the image are a haze.

    Rotation and scale hardly affect them, so only gradients of mean, opacity and colour are compared.
    """
    fields = ("mean", "opacity_logit", "sh")
    for log_scale in (-12.0, 3.0):
        case = Case(changed(log_scale=log_scale), random_camera(7, 41, 27), shape, fields=fields)
        case.check(make_renderer(device), IMAGE_FLOAT32, GRADIENT_FLOAT32)


@EVERY
def test_needles(make_renderer: MakeRenderer, device: Device, shape: str) -> None:
    """A condition number of 3e3 reduces float32 accuracy to 3e3 * 6e-8 in images and ten times that in gradients."""
    arrays, camera = changed(log_scale=[-6.0, -6.0, 1.0]), random_camera(7, 41, 27)
    single, double = (Case(arrays, camera, shape, dtype=dtype) for dtype in (np.float32, np.float64))
    single.check(make_renderer(device), 3e3 * 6e-8, 10 * 3e3 * 6e-8)
    double.check(make_renderer(device, "float64"), ROUNDING, 100 * ROUNDING)


@BOTH
def test_opaque_stack_ends_for_good(
    make_renderer: MakeRenderer, scheduled: tuple[Device, Schedule], shape: str
) -> None:
    """Some pixels finish in the first batch and others later. Splats behind them do not contribute."""
    case = stack(shape)
    order = visible_order(prepared(case.values, shape), case.camera, shape)
    assert not case.gradients["mean"][order[-20:]].any(), "the last ones should be hidden"
    assert case.gradients["mean"][order[:3]].any()
    renderer = make_renderer(scheduled[0], schedule=scheduled[1])
    case.check(renderer, IMAGE_FLOAT32, GRADIENT_FLOAT32)
    assert not case.backward(renderer)["mean"][order[-20:]].any()


@cache
def stack(shape: str) -> Case:
    """192 wide splats, a few of them opaque: pixels finish after about 40 to 140 splats."""
    arrays = random_splats(7, 3 * BATCH, 3)
    arrays["mean"] *= 0.5
    arrays["log_scale"] = np.minimum(arrays["log_scale"] + 3.0, 0.8)
    opaque = np.arange(3 * BATCH) % 21 == 1  # exclude opacities whose sign may be flipped
    arrays["opacity_logit"][:] = np.where(opaque, 7.0, -3.0)
    fields = ("mean", "skew") if shape == SKEWED else ("mean",)
    return Case(arrays, random_camera(7, 18, 8), shape, fields=fields)


@BOTH
def test_nothing_to_see(make_renderer: MakeRenderer, scheduled: tuple[Device, Schedule], shape: str) -> None:
    """Test no splats, and splats that are all behind the camera, too dim, or outside the image."""
    camera = random_camera(2, 19, 17)
    to_world = camera.rotation.T
    scenes = {
        "none": {name: array[:0] for name, array in changed().items()},
        "behind": changed(mean=lambda mean: 0.1 * mean + camera.position - to_world @ [0.0, 0.0, 2.0]),
        "dim": changed(opacity_logit=-6.0),
        "beside": changed(mean=lambda mean: 0.1 * mean + camera.position + to_world @ [50.0, 0.0, 5.0]),
    }
    renderer = make_renderer(scheduled[0], schedule=scheduled[1])
    for name, arrays in scenes.items():
        case = Case(arrays, camera, shape)
        image = case.render(renderer)
        assert (image.color == np.float32(BACKGROUND)).all(), name
        assert not image.alpha.any(), name
        assert not image.depth.any(), name
        for field, gradient in case.backward(renderer).items():
            assert gradient.shape == case.values[field].shape, (name, field)
            assert not gradient.any(), (name, field)


@EVERY
@pytest.mark.parametrize("near", [NEAR_PLANE, 0.3])
def test_near_plane(make_renderer: MakeRenderer, device: Device, shape: str, near: float) -> None:
    """A splat at the near plane of its model is drawn. A splat at the next smaller z is not."""
    camera = Camera(9, 7, 8.0, 8.0, 4.3, 3.6, np.eye(4))
    for z, seen in ((near, True), (np.nextafter(near, 0.0), False), (-1.0, False)):
        arrays = random_splats(3, 1, 3)
        arrays["mean"], arrays["log_scale"] = np.array([[0.0, 0.0, z]]), np.full((1, 3), np.log(z) if z > 0 else -6.0)
        arrays["log_scale"] -= 1.4
        arrays["skew"][:] = 0.0  # all shapes then project (x, y, z)
        case = Case(arrays, camera, shape, dtype=np.float64, near_plane=near)
        assert case.image.alpha.any() == seen
        case.check(make_renderer(device, "float64"), ROUNDING, ROUNDING)


@EVERY
def test_extreme_values_stay_finite(make_renderer: MakeRenderer, device: Device, shape: str) -> None:
    """Image and gradients are finite for all finite values that `Splats` accepts."""
    rng = np.random.default_rng(0)
    n = 400
    arrays = random_splats(0, n, 3)
    arrays["mean"] *= 10.0 ** rng.uniform(-6, 6, (n, 1))
    arrays["log_scale"] = rng.uniform(-60, 60, (n, 3))
    arrays["opacity_logit"] = rng.uniform(-100, 100, n)
    arrays["sh"] *= 10.0 ** rng.uniform(-6, 3, (n, 1, 1))
    arrays["quat"] *= 10.0 ** rng.uniform(-12, 12, (n, 1))
    renderer, seen = make_renderer(device), 0
    for start in range(0, n, 8):
        part = {name: value[start : start + 8] for name, value in arrays.items()}
        case = Case(part, random_camera(0), shape)
        image = case.render(renderer)
        assert all(np.isfinite(getattr(image, name)).all() for name in ("color", "alpha", "depth"))
        seen += image.alpha.any()
        for name, value in renderer.backward(rng.normal(size=(17, 23, 3)), rng.normal(size=(17, 23))).items():
            assert np.isfinite(value).all(), name
    assert seen > 10


def test_not_a_number_is_refused_before_it_reaches_a_device() -> None:
    for name in ("mean", "quat", "log_scale", "opacity_logit", "sh", "skew"):
        arrays = random_splats(0, 3, 0)
        arrays[name].reshape(-1)[1] = np.nan
        with pytest.raises(InputError, match=name):
            Splats(SKEWED, arrays)


# ---- the public interface ----------------------------------------------------------------------------------


def test_an_overwritten_frame_raises(device: Device) -> None:
    """Two frames share their buffers. The first frame must not return data of the second one."""
    case = cloud(SKEWED)
    pipeline = Pipeline(device, KernelBuild(SKEWED, 3, default_schedule(device.info)).for_rendering())
    splats = SplatBuffers.of(device, case.splats, pipeline.kernels.dtype)
    first = pipeline.forward(splats, case.camera)
    color = first.images.color.buffer
    pipeline.forward(splats, case.camera)
    grads = ParameterBuffers(device, splats.schema, splats.n, pipeline.kernels.dtype)
    for use in (
        lambda: first.images,
        lambda: first.projected,
        lambda: next(pipeline.bands(first)),
        lambda: pipeline.backward(first, color, grads),
    ):
        with pytest.raises(RuntimeError, match="the frame is overwritten"):
            use()


@pytest.mark.parametrize("axis", [0, 1])
def test_splats_too_wide_for_float32_are_not_seen(make_renderer: MakeRenderer, device: Device, axis: int) -> None:
    """The limit is a deviation of 1e6 px, along either axis of the image."""
    camera = Camera(20, 18, 20.0, 20.0, 10.0, 9.0, np.eye(4))
    arrays = for_shape(random_splats(1, 1, 0), "gaussian")
    arrays["mean"][:], arrays["quat"][:], arrays["opacity_logit"][:] = (0, 0, 2), (1, 0, 0, 0), 0
    alphas = []
    for pixels in (3e5, 3e6):
        arrays["log_scale"][:] = np.log(0.5)
        arrays["log_scale"][0, axis] = np.log(pixels * 2 / 20)
        alphas.append(float(make_renderer(device).render(Splats("gaussian", arrays), camera).alpha.max()))
    assert alphas == pytest.approx([0.5, 0.0], abs=1e-2)


def test_a_finished_column_does_not_end_its_tile(
    make_renderer: MakeRenderer, scheduled: tuple[Device, Schedule]
) -> None:
    """A batch of near splats finishes all pixels of the first work-item. The batches behind it show in the others."""
    column, behind = 70, 40  # a batch has 64
    arrays = random_splats(1, column + behind, 3)
    rng = np.random.default_rng(1)
    arrays["mean"][:column] = rng.uniform(-0.01, 0.01, (column, 3)) - np.array([0.97, 0, 0])
    arrays["mean"][column:] = rng.uniform(-0.5, 0.5, (behind, 3)) + np.array([0.3, 0, 2])
    arrays["quat"][:column] = 1, 0, 0, 0
    arrays["log_scale"][:column], arrays["log_scale"][column:] = (-4.5, 1, -4.5), -1.5
    arrays["opacity_logit"][:column], arrays["opacity_logit"][column:] = 2.0, -2.5
    pose = np.eye(4)
    pose[2, 3] = 4.0
    case = Case(arrays, Camera(16, 16, 32.0, 32.0, 8.0, 8.0, pose), "gaussian", fields=("mean", "sh"))
    assert case.image.alpha[:, 0].min() > 0.99 > case.image.alpha[:, 8:].max() > 0.3
    case.check(make_renderer(scheduled[0], schedule=scheduled[1]), IMAGE_FLOAT32, GRADIENT_FLOAT32)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_fewer_sh_bands_in_use(device: Device, degree: int) -> None:
    """Kernels of degree 3 can use only the lower bands, as training does. The other rows stay zero."""
    case = cloud(SKEWED)
    pipeline = Pipeline(device, KernelBuild(SKEWED, 3, default_schedule(device.info)).for_rendering())
    splats = SplatBuffers.of(device, case.splats, pipeline.kernels.dtype)
    frame = pipeline.forward(splats, case.camera, BACKGROUND, degree)
    options = {"shape": SKEWED, "background": BACKGROUND, "sh_degree": degree}
    image = render_reference(case.values, case.camera, **options)
    color = frame.images.color.read()
    assert np.abs(color - image.color)[case.decided].max() < IMAGE_FLOAT32

    v_color = DeviceImage(pipeline.pool, pipeline.kernels.dtype, 3).write(frame.layout, case.weights[0])
    v_alpha = DeviceImage(pipeline.pool, pipeline.kernels.dtype, 1).reserve(frame.layout)
    grads = ParameterBuffers(device, splats.schema, splats.n, pipeline.kernels.dtype)
    pipeline.backward(frame, v_color, grads, v_alpha)
    got, bands = grads.download(splats.n), (degree + 1) ** 2
    want = reference_gradients(case.values, case.camera, case.weights[0], fields=("mean", "sh"), **options)
    assert relative_error(got["mean"], want["mean"]) < GRADIENT_FLOAT32
    assert relative_error(got["sh"][:, :bands], want["sh"][:, :bands]) < GRADIENT_FLOAT32
    assert not got["sh"][:, bands:].any()


def test_splats_without_sh_bands(make_renderer: MakeRenderer, device: Device) -> None:
    case = Case(random_splats(4, 9, 0), random_camera(4), "gaussian")
    case.check(make_renderer(device), IMAGE_FLOAT32, GRADIENT_FLOAT32)


def test_one_renderer_serves_changing_scenes_and_sizes(make_renderer: MakeRenderer, device: Device) -> None:
    """Buffers are reused and grow. An earlier frame must not change a later one."""
    renderer = make_renderer(device)
    cases = [cloud("gaussian"), *thin_cases(SKEWED).values(), cloud(SKEWED), *thin_cases("gaussian").values()]
    for case in (*cases, *reversed(cases)):
        case.check_image(case.render(renderer), IMAGE_FLOAT32)


def test_models_with_other_near_planes_share_the_kernels(device: Device) -> None:
    """A model that is scaled in each frame of an animation has another near plane each time."""
    renderer, camera = Renderer(device), random_camera(1, 64, 48)
    splats = Splats("gaussian", for_shape(random_splats(1, 30, 1, np.float32), "gaussian"))
    near = [renderer.render(splats.with_near_plane(plane), camera).alpha for plane in (0.01, 3.0, 100.0, 0.01)]
    assert near[0].any()
    assert not np.array_equal(near[0], near[1])
    assert not near[2].any()
    assert np.array_equal(near[0], near[3])
    assert len(renderer._pipelines) == 1


def test_a_renderer_keeps_the_buffers_of_a_few_shapes(device: Device) -> None:
    renderer, camera = Renderer(device), random_camera(1, 64, 48)
    arrays = random_splats(1, 30, 1, np.float32)
    shapes = [*SHAPES, next(iter(SHAPES))]
    images = [renderer.render(Splats(shape, for_shape(arrays, shape)), camera).color for shape in shapes]
    assert len(renderer._pipelines) < len(SHAPES)
    assert np.array_equal(images[0], images[-1])


def test_threads_may_share_a_renderer(device: Device) -> None:
    renderer = Renderer(device)
    splats = Splats("gaussian", for_shape(random_splats(2, 200, 1, np.float32), "gaussian"))
    cameras = [random_camera(seed, 96, 64) for seed in range(4)]
    expected = [renderer.render(splats, camera).color for camera in cameras]

    def renders(number: int) -> bool:
        return all(np.array_equal(renderer.render(splats, cameras[number]).color, expected[number]) for _ in range(15))

    with ThreadPoolExecutor(len(cameras)) as pool:
        assert all(pool.map(renders, range(len(cameras))))


@pytest.mark.parametrize("shape", ["generalised-exponential", "ges-modulation"])
def test_a_faint_splat_does_not_change_its_neighbours(device: Device, shape: str) -> None:
    """A vector of splats is projected at once. PoCL's pow of 0 in one lane would be wrong in others."""
    if not device.has_fp64:
        pytest.skip("no double precision")
    splats = for_shape(random_splats(11, 32, 1), shape)
    splats["opacity_logit"][:] = 2.0
    splats["opacity_logit"][[4, 13, 22]] = -9.0  # below 1/255
    splats["beta"][:] = np.random.default_rng(0).uniform(0.5, 4.0, 32)
    camera = random_camera(11, 96, 64)
    images = {
        precision: Renderer(device, precision).render(Splats(shape, splats), camera).color
        for precision in ("float32", "float64")
    }
    np.testing.assert_allclose(images["float32"], images["float64"], atol=1e-4)


def test_gradients_without_alpha_are_those_of_zero_alpha_weights(make_renderer: MakeRenderer, device: Device) -> None:
    case, renderer = cloud(SKEWED), make_renderer(device)
    v_color, v_alpha = case.weights
    case.render(renderer)
    without = renderer.backward(v_color)
    zero = renderer.backward(v_color, np.zeros_like(v_alpha))
    assert all(np.array_equal(without[name], zero[name]) for name in zero)
    assert not np.array_equal(without["mean"], renderer.backward(v_color, v_alpha)["mean"])


def test_gradients_of_some_fields_are_those_of_all(make_renderer: MakeRenderer, device: Device) -> None:
    case, renderer = cloud(SKEWED), make_renderer(device)
    case.render(renderer)
    every = renderer.backward(case.weights[0])
    some = renderer.backward(case.weights[0], names=("skew", "mean"))
    assert list(some) == ["skew", "mean"]
    assert all(np.array_equal(some[name], every[name]) for name in some)
    assert renderer.backward(case.weights[0], names=()) == {}


def test_wrong_calls_are_errors(make_renderer: MakeRenderer, device: Device) -> None:
    case, renderer = cloud("gaussian"), Renderer(device)
    with pytest.raises(InputError, match="render an image first"):
        renderer.backward(np.zeros((27, 41, 3)))
    with pytest.raises(InputError, match="float16"):
        Renderer(device, "float16")
    for background in ((0, 0), (0, 0, np.nan), 1.0):
        with pytest.raises(InputError, match="background"):
            renderer.render(case.splats, case.camera, background)
    case.render(renderer)
    with pytest.raises(InputError, match=r"names: 'skew' is no field; choose from mean, quat,"):
        renderer.backward(np.zeros((27, 41, 3)), names=["mean", "skew"])
    with pytest.raises(InputError, match=r"v_color: shape \(41, 27, 3\), expected \(27, 41, 3\)"):
        renderer.backward(np.zeros((41, 27, 3)))
    with pytest.raises(InputError, match=r"v_alpha: shape \(27, 41, 1\)"):
        renderer.backward(np.zeros((27, 41, 3)), np.zeros((27, 41, 1)))


@pytest.mark.parametrize("background", [("a", "b", "c"), (0, 0), (0, 0, np.nan), None, ((1,), (2, 3), 4)])
def test_a_background_that_is_no_colour_is_refused(background: Any) -> None:
    splats = Splats.from_points(np.eye(3), np.zeros((3, 3)))
    with pytest.raises(InputError, match="expected three finite numbers R, G, B"):
        Renderer().render(splats, Camera(8, 8, 8.0, 8.0, 4.0, 4.0, np.eye(4)), background=background)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"splats": "model.ply"}, "splats is a str: expected Splats: clsplat.Splats.load reads a file"),
        ({"camera": None}, "camera is a NoneType: expected a Camera: make one"),
        ({"camera": SimpleNamespace(camera=1)}, "camera is a SimpleNamespace: expected a Camera: pass its .camera"),
        ({"sh_degree": -1}, "sh_degree -1: expected a whole number of at least 0"),
        ({"sh_degree": 1.5}, "sh_degree 1.5: expected"),
        ({"sh_degree": "1"}, "sh_degree '1': expected"),
    ],
)
def test_an_argument_of_another_type_is_refused(make_renderer, device, change, message) -> None:
    arguments = {"splats": Splats("gaussian", for_shape(random_splats(7, 3, 0), "gaussian"))}
    arguments["camera"] = random_camera(7, 5, 4)
    with pytest.raises(InputError, match=message):
        make_renderer(device).render(**arguments | change)


def test_a_device_is_a_text() -> None:
    with pytest.raises(InputError, match="device 3: expected a text such as"):
        Renderer(3)

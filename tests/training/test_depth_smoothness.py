"""Smooth depths: the gradient is that of the penalty in float64, and runs with the penalty have smoother depths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
from device_schedules import as_kind
from kernel_checks import SMOOTH
from numpy.typing import NDArray
from reference.renderer import render_reference
from reference.scenes import random_camera, random_splats
from reference.tolerances import relative_error

from clsplat.cameras.camera import Camera
from clsplat.device.device import Device
from clsplat.device.memory import to_host
from clsplat.device.program import Real
from clsplat.device.schedule import Schedule
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.frame import DeviceImage, ImageLayout
from clsplat.rendering.renderer import Renderer
from clsplat.rendering.splat_buffers import CompactGradients, SplatBuffers
from clsplat.scenes.scene import Scene, View
from clsplat.training import depth_smoothness
from clsplat.training.config import TrainConfig
from clsplat.training.depth_smoothness import EDGE, SMALLEST_SIDE, DepthSmoothness, reduction
from clsplat.training.targets import Targets, reduced_camera
from clsplat.training.trainer import Trainer

Image = NDArray[np.float64]
STEEPEST, BREAK, MOST_LIGHT = 0.01, 0.05, 0.2  # of cl/train/depth.cl
WEIGHT, SEED = 3.0, 5
GEOMETRY = ("mean", "quat", "log_scale", "opacity_logit")


class Pairs(NamedTuple):
    """Pairs of neighbouring pixels: weights and mean depths, for the pairs of a row and for those of a column."""

    weights: tuple[Image, Image]
    middles: tuple[Image, Image]


def neighbours(image: NDArray[Any]) -> tuple[tuple[NDArray[Any], NDArray[Any]], ...]:
    return (image[:, :-1], image[:, 1:]), (image[:-1], image[1:])


def pairs_of(depth: Image, light: Image, photo: NDArray[np.uint8] | None, factor: int = 1) -> Pairs:
    """factor : the photo's width over that of the depths. A depth has the colour of the first pixel of its square."""
    if photo is not None:
        photo = photo[::factor, ::factor][: depth.shape[0], : depth.shape[1]]
    weights, middles = [], []
    for axis in (0, 1):
        (one, other), (dim, bright) = neighbours(depth)[axis], neighbours(light)[axis]
        weight = ((dim < MOST_LIGHT) & (bright < MOST_LIGHT)).astype(np.float64)
        if photo is not None:
            left, right = (side.astype(np.float64) for side in neighbours(photo)[axis])
            weight *= np.exp(-EDGE * np.abs(left - right).mean(axis=2) / 255)
        weights.append(weight)
        middles.append((one + other) / 2)
    return Pairs((weights[0], weights[1]), (middles[0], middles[1]))


def penalty(depth: Image, pairs: Pairs, factor: int = 1, *, breaks: bool) -> float:
    """Return the penalty of a depth image; the mean depths are those of `pairs`.

    factor : see `pairs_of`. breaks : whether large steps hardly count, as in views without a photo.
    """
    total = 0.0
    for (one, other), weight, middle in zip(neighbours(depth), *pairs, strict=True):
        step = np.abs((one - other) / (factor * middle))
        if breaks:
            foot = np.log1p((np.minimum(step, STEEPEST) / BREAK) ** 2) * BREAK**2 / (2 * STEEPEST)
            height = foot + BREAK * (np.arctan(np.maximum(step, STEEPEST) / BREAK) - math.atan(STEEPEST / BREAK))
        else:
            height = np.where(step < STEEPEST, step**2 / (2 * STEEPEST), step - STEEPEST / 2)
        total += float((weight * height).sum())
    return WEIGHT * total / depth.size


def camera_apart(shift: float) -> Camera:
    camera = random_camera()
    pose = camera.cam_from_world.copy()
    pose[0, 3] += shift
    return camera.posed(pose)


def views_of(count: int) -> list[View]:
    rng = np.random.default_rng(2)
    cameras = [camera_apart(0.3 * number) for number in range(count)]
    return [
        View(f"{number}.png", camera, rng.integers(90, 130, (camera.height, camera.width, 3)).astype(np.uint8))
        for number, camera in enumerate(cameras)
    ]


class Smoothed(NamedTuple):
    """The penalty of a run on some splats, and its photos."""

    smoothness: DepthSmoothness
    splats: SplatBuffers
    targets: Targets

    def gradient(self, view: int, iteration: int) -> dict[str, NDArray[Any]]:
        """Return what the penalty adds to gradients of 1."""
        target = self.targets.get(view, 1)
        grads = CompactGradients(self.splats.device, self.splats.schema, self.splats.capacity, self.splats.dtype)
        ones = {name: np.ones_like(array) for name, array in self.splats.download(self.splats.n, GEOMETRY).items()}
        grads.upload(ones)
        self.smoothness.add(grads, target, self.targets.planes(target), iteration)
        return {name: array - 1 for name, array in grads.download(self.splats.n, GEOMETRY).items()}


def smoothed(device: Device, schedule: Schedule, real: Real, views: Sequence[View]) -> Smoothed:
    if real == "double" and not device.has_fp64:
        pytest.skip("no double precision")
    kernels = KernelBuild("gaussian", 1, schedule, real=real, **SMOOTH)
    arrays = {name: array for name, array in random_splats(4, 12, 1).items() if name in (*GEOMETRY, "sh")}
    arrays["opacity_logit"] += 3  # most pixels have a depth
    splats = SplatBuffers(device, kernels.schema, 12, kernels.dtype)
    splats.set(arrays)
    config = TrainConfig(depth_smoothness=WEIGHT, iterations=10, seed=SEED)
    targets = Targets(device, kernels, list(views), 10**9)
    return Smoothed(DepthSmoothness(config, kernels, splats, views, 10**5), splats, targets)


@pytest.mark.parametrize("factor", [1, 3])
def test_the_gradient_of_an_image_is_that_of_the_penalty(scheduled: tuple[Device, Schedule], factor: int) -> None:
    device, schedule = scheduled
    (view,) = views = views_of(1)
    made, rng = smoothed(device, schedule, "double", views), np.random.default_rng(0)
    target, dtype = made.targets.get(0, 1), made.splats.dtype
    height, width = view.camera.height // factor, view.camera.width // factor
    layout = ImageLayout(width, height)
    depth = 2 + 0.03 * rng.random((height, width))
    depth[:, width // 2 :] *= 3  # one thing in front of another
    light = np.where(rng.random((height, width)) < 0.2, 0.5, 0.1)
    pool, smoothness = made.smoothness.pipeline.pool, made.smoothness
    for edge, photo in ((EDGE, view.image), (0.0, None)):
        v_color = DeviceImage(pool, dtype, 3).write(layout, np.ones((height, width, 3)))
        smoothness.program.smooth_depth.over(
            layout.width,
            64,
            layout.height,
            color=DeviceImage(pool, dtype, 3).write(layout, np.repeat(depth[:, :, None], 3, axis=2)),
            transmittance=DeviceImage(pool, dtype, 1).write(layout, light),
            truth=made.targets.planes(target),
            v_color=v_color,
            width=layout.width,
            height=layout.height,
            stride=layout.stride,
            plane=layout.plane,
            photo_stride=target.layout.stride,
            photo_plane=target.layout.plane,
            reduction=factor,
            weight=WEIGHT / depth.size,
            edge=edge,
        )
        found = layout.unpack(to_host(device, v_color, np.empty((3, layout.rows, layout.stride), dtype)))
        pairs, step = pairs_of(depth, light, photo, factor), 1e-7
        expected = np.zeros_like(depth)
        for place in np.ndindex(*depth.shape):
            ends = [depth.copy(), depth.copy()]
            for sign, moved in zip((1, -1), ends, strict=True):
                moved[place] += sign * step
            sums = [penalty(end, pairs, factor, breaks=photo is None) for end in ends]
            expected[place] = (sums[0] - sums[1]) / (2 * step)
        assert relative_error(found[:, :, 0], expected) < 1e-6
        assert not found[:, :, 1:].any()


@pytest.mark.parametrize(("count", "factor"), [(1, 1), (3, 1), (3, 2)])
def test_the_gradient_of_splats_is_that_of_the_penalty(
    device: Device, count: int, factor: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With several photos, a camera between two of them counts, too. It is another one in each iteration.

    Images of depths are smaller than large photos.
    """
    views = views_of(count)
    side = min(views[0].camera.width, views[0].camera.height)
    monkeypatch.setattr(depth_smoothness, "SMALLEST_SIDE", side // factor)
    assert reduction(views[0].camera.width, views[0].camera.height) == factor
    made = smoothed(device, Schedule(1, 16, 16), "double", views)
    arrays = {name: array.astype(np.float64) for name, array in made.splats.download(made.splats.n).items()}
    arrays["opacity_logit"] = arrays["opacity_logit"].reshape(-1)
    between = made.smoothness.between
    assert len(between) == (0 if count == 1 else 2 * (count - 1) + 2)
    chosen = []
    for iteration in (1, 2):
        cameras: list[tuple[Camera, NDArray[np.uint8] | None]] = [(views[0].camera, views[0].image)]
        if between:
            index = np.random.default_rng((SEED, 0x6465, iteration, 0)).integers(len(between))
            chosen.append(index)
            cameras.append((between[index], None))
        cameras = [(reduced_camera(camera, factor), photo) for camera, photo in cameras]
        images = [render_reference(arrays, camera, **SMOOTH) for camera, _ in cameras]
        pairs = [
            pairs_of(image.depth, 1 - image.alpha, photo, factor)
            for image, (_, photo) in zip(images, cameras, strict=True)
        ]
        assert all(side.weights[0].mean() > 0.1 for side in pairs)

        def total(moved: dict[str, NDArray[np.float64]]) -> float:
            return math.fsum(
                penalty(render_reference(moved, camera, **SMOOTH).depth, side, factor, breaks=photo is None)
                for (camera, photo), side in zip(cameras, pairs, strict=True)  # noqa: B023
            )

        found = made.gradient(0, iteration)
        step = 1e-6
        for name in GEOMETRY:
            for place in np.ndindex(*arrays[name][:3].shape):
                ends = []
                for sign in (1, -1):
                    moved = {key: array.copy() for key, array in arrays.items()}
                    moved[name][place] += sign * step
                    ends.append(total(moved))
                expected = (ends[0] - ends[1]) / (2 * step)
                assert found[name].reshape(arrays[name].shape)[place] == pytest.approx(expected, rel=1e-4, abs=1e-7)
    assert len(set(chosen)) == len(chosen)


@pytest.mark.parametrize(
    ("width", "height", "factor"), [(99, 400, 1), (199, 356, 1), (200, 200, 2), (713, 400, 4), (90, 50, 1)]
)
def test_images_of_depths_have_a_shorter_side_of_at_least_100_pixels(width: int, height: int, factor: int) -> None:
    assert reduction(width, height) == factor
    assert min(width, height) // factor >= min(SMALLEST_SIDE, width, height)


def trainer_of(scene: Scene, device: Device, **options: Any) -> Trainer:
    still = {"iterations": 40, "densify_interval": 1000, "near_plane": 0.1, "dropout": 0.0, "occluder_check": False}
    return Trainer(scene, TrainConfig(**{"cap_max": 2000, "sh_degree": 0, **still, **options}), device=device)


def roughness(trainer: Trainer, scene: Scene) -> float:
    """Return the mean relative step of the depth where there is one, from the test views."""
    steps = []
    for view in scene.test or scene.train:
        image = Renderer(trainer.device).render(trainer.snapshot(), view.camera)
        pairs = pairs_of(image.depth.astype(np.float64), 1 - image.alpha.astype(np.float64), None)
        for (one, other), weight, middle in zip(neighbours(image.depth), *pairs, strict=True):
            steps.append(np.abs((one - other) / middle)[weight > 0])
    return float(np.concatenate(steps).mean())


def test_a_run_with_the_penalty_has_smoother_depths(scene: Scene, device: Device) -> None:
    found = []
    for weight in (0.0, 1.0):
        trainer = trainer_of(scene, device, depth_smoothness=weight)
        trainer.run()
        found.append(roughness(trainer, scene))
    assert found[1] < 0.8 * found[0]


def test_the_penalty_ends_before_the_run(scene: Scene, device: Device) -> None:
    trainer = trainer_of(scene, device, depth_smoothness=1.0)
    due = [trainer.main.smoothness.is_due(iteration) for iteration in range(1, 41)]
    assert due == [True] * 36 + [False] * 4
    assert not trainer_of(scene, device, depth_smoothness=0.0).main.smoothness.is_due(1)


@pytest.mark.parametrize("kind", ["CPU", "GPU"])
def test_a_run_goes_on_with_the_same_bits(scene: Scene, device: Device, kind: str) -> None:
    whole = trainer_of(scene, as_kind(device, kind), depth_smoothness=1.0)
    half = trainer_of(scene, as_kind(device, kind), depth_smoothness=1.0)
    for _ in range(4):
        whole.step()
    for _ in range(2):
        half.step()
    rest = Trainer(scene, half.config, half.checkpoint(), device=half.device)
    for _ in range(2):
        rest.step()
    for name, array in whole.snapshot().arrays.items():
        np.testing.assert_array_equal(rest.snapshot().arrays[name], array, err_msg=name)

"""Gradients of every raw parameter agree with finite differences of the whole chain on the device.

The two sides share no formula: the differences use only forward renders of the double build. Thresholds are off
(alpha_min 0, alpha_max 1, t_min 0), because the image is smooth only without them. The loss weights every pixel of
colour and alpha at random. The image is not square, and its principal point is off centre.

The error is the largest difference in a field, relative to the field's largest entry. A second error uses Euclidean
norms. Both must be below DIFFERENCES = 1e-6.
"""

from __future__ import annotations

import numpy as np
import pytest
from conftest import USABLE, MakeRenderer, on_place
from device_schedules import schedule_on
from kernel_checks import BACKGROUND, KERNELS, SMOOTH, Arrays, Case, differences
from reference.formulas import SKEW_MAX
from reference.renderer import FIELDS
from reference.scenes import random_camera, random_splats
from reference.tolerances import DIFFERENCES, relative_error

from clsplat.cameras.camera import Camera
from clsplat.device.device import Device
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats

# Schedules change only the raster kernels, and normalisations only the projection. So not all combinations are
# tested, and normalisations run on the first device only.
WIDEST = ["cpu16" if info.has_wide_lanes else "gpu256" for info in USABLE]
BUILDS = [(0, *kernel, WIDEST[0]) for kernel in KERNELS if USABLE] + [(0, "skew-normal", "peak", "gpu256")]
BUILDS += [on_place(place, place, *kernel, WIDEST[place]) for place in range(1, len(USABLE)) for kernel in KERNELS[:2]]


def awkward_splats(camera: Camera) -> Arrays:
    """Four splats: no skew, in the clamped margin of the Jacobian, skew beyond the bound, and a black channel."""
    arrays = random_splats(1, 4, 3)
    arrays["skew"][0] = 0.0
    arrays["mean"][1] = camera.position + camera.rotation.T @ [-2.2, 0.3, 3.0]
    arrays["log_scale"][1] = [0.1, -0.3, -0.1]
    arrays["skew"][2] *= 1.01 * SKEW_MAX / np.linalg.norm(arrays["skew"][2])
    arrays["sh"][3, 0, 1] = -5.0
    return arrays


@pytest.mark.parametrize(("place", "shape", "normalisation", "schedule"), BUILDS)
def test_gradients_are_those_of_the_image(
    make_renderer: MakeRenderer, devices: list[Device], place: int, shape: str, normalisation: str, schedule: str
) -> None:
    if not devices:
        pytest.skip("no OpenCL device")
    camera = random_camera(1, 23, 17)
    arrays = awkward_splats(camera)
    if normalisation == "pdf":
        arrays["opacity_logit"] -= 3.0  # alpha reaches twice the opacity: keep it below 1
    case = Case(arrays, camera, shape, normalisation, np.float64, thresholds=SMOOTH)
    renderer = make_renderer(devices[place], "float64", schedule_on(devices[place], schedule), **SMOOTH)
    case.render(renderer)
    got = case.backward(renderer)
    assert set(got) == set(FIELDS[shape])
    assert not got["sh"][3, :, 1].any(), "the black channel's gradient must be zero"
    for field, value in got.items():
        want = differences(renderer, case, field)
        assert np.abs(want).max() > 1e-2, f"{field}: nothing to compare"
        assert relative_error(value, want) < DIFFERENCES, field
        assert np.linalg.norm(value - want) < DIFFERENCES * np.linalg.norm(want), field
        if field == "skew":
            assert not np.allclose(want[2], 0.0), "the bounded splat's skew still turns"


@pytest.mark.parametrize("shape", SHAPES)
def test_gradients_through_the_default_thresholds(make_renderer: MakeRenderer, device: Device, shape: str) -> None:
    """Return one direction with a step so small that no pixel crosses a threshold."""
    camera = random_camera(4, 41, 27)
    case = Case(random_splats(4, 24, 3), camera, shape, dtype=np.float64)
    renderer = make_renderer(device, "float64")
    rng = np.random.default_rng(9)
    direction = {name: rng.normal(size=value.shape) for name, value in case.values.items()}
    losses = []
    for step in (1e-7, -1e-7):
        moved = {name: value + step * direction[name] for name, value in case.values.items()}
        image = renderer.render(Splats(shape, moved), camera, BACKGROUND)
        losses.append((case.weights[0] * image.color).sum() + (case.weights[1] * image.alpha).sum())
    case.render(renderer)
    slope = sum((value * direction[name]).sum() for name, value in case.backward(renderer).items())
    assert (losses[0] - losses[1]) / 2e-7 == pytest.approx(slope, rel=1e-5)

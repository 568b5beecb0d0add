"""Densification statistics: sums over images of screen gradient, depth gradient and visibility, against float64.

The reference moves one kernel at a time on the screen, by the complex step. The depth gradient is the gradient of the
world position along the viewing ray: on that ray the viewing direction, and so the colour, stays the same.
"""

from __future__ import annotations

import numpy as np
import pytest
from kernel_checks import BACKGROUND, Case
from reference.renderer import projected_point, reference_screen_gradients, visible_order
from reference.scenes import random_camera, random_splats
from reference.tolerances import ROUNDING, relative_error

from clsplat.device.device import Device
from clsplat.device.memory import Pool
from clsplat.device.schedule import SCHEDULES
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.frame import DeviceImage
from clsplat.rendering.pipeline import Pipeline
from clsplat.rendering.splat_buffers import CompactGradients, SplatBuffers, SplatStatistics

N = 12
BEHIND, BESIDE = 0, 1  # splats behind the first camera, and partly in the margin of its image
OUTSIDE = {2: [4.0, 0.0, 3.0], 3: [-3.4, 0.0, 3.0], 4: [0.0, 3.0, 3.0], 5: [0.0, -3.0, 3.0]}  # on each side of it
SIZES = ((23, 17), (19, 31))  # wider than high, and higher than wide
BACK = 6.0  # the second camera is that far behind the first one, so that it shows all splats


def cases_of(shape: str) -> list[Case]:
    """Return one scene in two views. The first view does not show five of the splats."""
    cameras = [random_camera(0, *size) for size in SIZES]
    pose = cameras[0].cam_from_world.copy()
    pose[2, 3] += BACK
    cameras[1] = cameras[1].posed(pose)
    arrays = random_splats(3, N, 1)
    places = OUTSIDE | {BEHIND: [0.1, 0.2, -3.0], BESIDE: [-2.2, 0.3, 3.0]}
    for splat, at in places.items():
        arrays["mean"][splat] = cameras[0].position + cameras[0].rotation.T @ at
    arrays["log_scale"][[BEHIND, *OUTSIDE]] = -2.0
    arrays["log_scale"][BESIDE] = [0.1, -0.3, -0.1]
    return [Case(arrays, camera, shape, dtype=np.float64, seed=seed) for seed, camera in enumerate(cameras)]


def statistics_of(case: Case) -> np.ndarray:
    """Return what one view adds to the statistics, (3, N), by the reference."""
    camera, arguments = case.camera, (*case.weights, case.shape)
    on_screen = reference_screen_gradients(case.values, camera, *arguments, background=BACKGROUND)
    ray = projected_point(case.values, case.shape) - camera.position
    along = np.sum(case.gradients["mean"] * ray, axis=1) / np.linalg.norm(ray, axis=1)
    half = np.array([camera.width, camera.height]) / 2
    rows = np.array([np.linalg.norm(on_screen * half, axis=1), np.abs(along), np.zeros(N)])
    rows[SplatStatistics.TIMES_SEEN, visible_order(case.values, camera, case.shape)] = 1
    return rows


@pytest.mark.parametrize("shape", ["gaussian", "skew-normal-direct"])
def test_statistics_are_those_of_the_reference(device: Device, shape: str) -> None:
    cases = cases_of(shape)
    if not device.has_fp64:
        pytest.skip("no double precision")
    kernels = KernelBuild(shape, 1, SCHEDULES["cpu16"], real="double").for_rendering()
    pipeline = Pipeline(device, kernels)
    buffers = SplatBuffers.of(device, cases[0].splats, kernels.dtype)
    grads = CompactGradients(device, buffers.schema, N, kernels.dtype)
    want = np.zeros((3, N))
    for case in cases:
        frame = pipeline.forward(buffers, case.camera, BACKGROUND)
        v_color, v_alpha = (
            DeviceImage(Pool(device), kernels.dtype, channels).write(frame.layout, weights)
            for channels, weights in zip((3, 1), case.weights, strict=True)
        )
        pipeline.backward(frame, v_color, grads, v_alpha)
        want += statistics_of(case)
        if case is cases[0]:
            want[:, list(OUTSIDE)] = 0  # in front of the camera, but outside of the image
        got = pipeline.statistics.read(N)
        for row in range(SplatStatistics.ROWS):
            assert relative_error(got[row], want[row]) < ROUNDING, row
    once = {BEHIND, *OUTSIDE}
    assert want[SplatStatistics.TIMES_SEEN].tolist() == [1 if splat in once else 2 for splat in range(N)]
    assert (want[:, 6:] > 0).all()
    pipeline.statistics.reset()
    assert not pipeline.statistics.read(N).any()


def test_statistics_of_a_checkpoint_go_on(device: Device) -> None:
    stored = np.random.default_rng(1).random((SplatStatistics.ROWS, N)).astype(np.float32)
    statistics = SplatStatistics(Pool(device), np.dtype(np.float32))
    assert statistics.read(N).tolist() == np.zeros_like(stored).tolist()
    statistics.write(stored, 1024)
    np.testing.assert_array_equal(statistics.read(N), stored)
    assert not statistics.read(1024)[:, N:].any()

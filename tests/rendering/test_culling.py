"""The passes over pixels visit all blocks and strips of a tile where a splat is visible, and few others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from device_schedules import schedule_on
from kernel_checks import Case
from reference.scenes import for_shape, random_camera, random_splats
from reference.skewed import SKEWED
from rendering.test_footprint import strongly_skewed

from clsplat.device.device import Device
from clsplat.device.memory import to_device, to_host
from clsplat.device.schedule import TILE
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.frame import DeviceImage, Frame
from clsplat.rendering.pipeline import Pipeline
from clsplat.rendering.splat_buffers import CompactGradients, SplatBuffers
from clsplat.splats.shapes import SHAPES, shape_named

WIDTH, HEIGHT = 83, 61
# Visited blocks per block where a splat is visible. The measured ratios are 1.02 to 1.04, and 1.18 to 1.24 with a skew.
MOST, MOST_SKEWED = 1.08, 1.3


def one_splat(shape: str, seed: int, needle: bool) -> Case:
    """A splat of any size and opacity. A needle is 100 times as long as wide."""
    arrays = strongly_skewed(seed, 1) | {"nu": np.array([3.0 + seed]), "beta": np.array([0.7 + 0.1 * seed])}
    if needle:
        arrays["log_scale"] = np.array([[-0.7, -5.3, -5.3]])
    if shape_named(shape).signed:
        arrays["opacity_logit"] *= -1.0 if seed % 2 else 1.0
    wanted = for_shape(random_splats(seed, 1, 3) | arrays, shape)
    return Case(wanted, random_camera(seed, WIDTH, HEIGHT), shape, "peak", np.float32)


# Visited strips per strip where a splat is visible. The measured ratios are 1.00 to 1.02, and 1.06 to 1.18 with a skew.
MOST_STRIPS, MOST_STRIPS_SKEWED = 1.04, 1.25

# One shape for each kind of bound. The other shapes run with -m slow.
FAMILIES = ("gaussian", "skew-normal", "half-gaussian", "generalised-exponential")
ONE_OF_A_FAMILY = [shape if shape in FAMILIES else pytest.param(shape, marks=pytest.mark.slow) for shape in SHAPES]


def drawn(pipeline: Pipeline) -> Iterator[tuple[Case, Frame, list[int]]]:
    """Draw single splats. Yield those that the image may show, each with its frame and its rectangle of tiles."""
    for seed in range(40):
        case = one_splat(pipeline.kernels.shape, seed, needle=seed % 4 == 0)
        frame = pipeline.forward(SplatBuffers.of(pipeline.device, case.splats, pipeline.kernels.dtype), case.camera)
        if frame.n_isects:
            rect = to_host(pipeline.device, frame.projected.tile_rect, np.empty(4, np.int32)).tolist()
            yield case, frame, rect


@pytest.mark.parametrize("schedule", ["cpu16", pytest.param("cpu8", marks=pytest.mark.slow)])
@pytest.mark.parametrize("shape", ONE_OF_A_FAMILY)
def test_blocks_hold_their_splats_and_little_else(device: Device, shape: str, schedule: str) -> None:
    form = schedule_on(device, schedule)
    kernels = KernelBuild(shape, 3, form)
    pipeline = Pipeline(device, kernels)
    columns, block_height = TILE // 4, form.lanes // 4
    looked_at = shows = 0
    for case, frame, (left, top, right, bottom) in drawn(pipeline):
        told = to_host(device, pipeline.isect_blocks.buffer, np.empty(frame.n_isects, np.uint32))
        assert frame.n_isects == (right - left) * (bottom - top)
        number = np.arange(form.vecs)
        bits = (told[:, None] >> number.astype(np.uint32)) & 1
        seen = np.zeros((frame.layout.tiles_y * TILE // block_height, frame.layout.tiles_x * columns), bool)
        for isect in range(frame.n_isects):
            y, x = divmod(isect, right - left)
            block_y = (top + y) * (TILE // block_height) + number // columns
            seen[block_y, (left + x) * columns + number % columns] = bits[isect] > 0
        alpha = np.zeros((seen.shape[0] * block_height, seen.shape[1] * 4))
        alpha[:HEIGHT, :WIDTH] = case.image.alpha
        visible = (alpha != 0).reshape(seen.shape[0], block_height, seen.shape[1], 4).any(axis=(1, 3))
        assert not (visible & ~seen).any()
        looked_at, shows = looked_at + seen.sum(), shows + visible.sum()
    assert shows > 400
    most = MOST_SKEWED if shape in SKEWED and shape != "gaussian" else MOST
    assert shows <= looked_at <= most * shows, looked_at / shows


@pytest.mark.parametrize(
    ("schedule", "kind"),
    [
        ("gpu32", "CPU"),
        ("gpu256", "GPU"),
        *(
            pytest.param(*pair, marks=pytest.mark.slow)
            for pair in (("gpu32", "GPU"), ("gpu64", "GPU"), ("gpu256", "CPU"))
        ),
    ],
)
@pytest.mark.parametrize("shape", ONE_OF_A_FAMILY)
def test_strips_hold_their_splats_and_little_else(
    device: Device, monkeypatch: pytest.MonkeyPatch, shape: str, schedule: str, kind: str
) -> None:
    kernels = KernelBuild(shape, 3, schedule_on(device, schedule))
    assert kernels.culls_strips
    monkeypatch.setattr(device, "info", replace(device.info, type=kind))
    pipeline = Pipeline(device, kernels)
    rows = TILE // kernels.schedule.vecs
    looked_at = shows = 0
    for case, frame, (left, top, right, bottom) in drawn(pipeline):
        ((_, lists),) = pipeline.bands(frame)
        assert lists.strips is not None
        told = to_host(device, lists.strips, np.empty(frame.n_isects, np.uint32))
        bits = told.reshape(bottom - top, 1, right - left) >> np.arange(kernels.schedule.vecs, dtype=np.uint32)[:, None]
        seen = np.zeros((frame.layout.tiles_y * kernels.schedule.vecs, frame.layout.tiles_x), bool)
        seen.reshape(frame.layout.tiles_y, kernels.schedule.vecs, -1)[top:bottom, :, left:right] = bits & 1
        alpha = np.zeros((len(seen) * rows, frame.layout.tiles_x * TILE))
        alpha[:HEIGHT, :WIDTH] = case.image.alpha
        visible = (alpha != 0).reshape(len(seen), rows, frame.layout.tiles_x, TILE).any(axis=(1, 3))
        assert not (visible & ~seen).any()
        seen[-(-HEIGHT // rows) :] = False  # below the image
        looked_at, shows = looked_at + seen.sum(), shows + visible.sum()
    most = MOST_STRIPS_SKEWED if shape in SKEWED and shape != "gaussian" else MOST_STRIPS
    assert shows > 80
    assert shows <= looked_at <= most * shows, looked_at / shows


@pytest.mark.parametrize("schedule", ["gpu64", "gpu256"])
def test_an_isect_that_misses_its_tile_has_no_gradient(device: Device, schedule: str) -> None:
    """Needles miss tiles of their boxes. What an earlier image left in the records of such isects does not count."""
    kernels = KernelBuild("gaussian", 3, schedule_on(device, schedule))
    pipeline, missed = Pipeline(device, kernels), 0
    for seed in range(0, 40, 4):
        case = one_splat("gaussian", seed, needle=True)
        buffers = SplatBuffers.of(device, case.splats, kernels.dtype)
        grads = CompactGradients(device, buffers.schema, 1, kernels.dtype)
        found = []
        for left in (0.0, np.nan):
            frame = pipeline.forward(buffers, case.camera)
            if not frame.n_isects:
                continue
            size = frame.n_isects * kernels.v_record
            to_device(device, pipeline._isect_grads.reserve(frame.n_isects), np.full(size, left, kernels.dtype))
            v_color = DeviceImage(pipeline.pool, kernels.dtype, 3).write(frame.layout, np.ones((HEIGHT, WIDTH, 3)))
            pipeline.backward(frame, v_color, grads)
            found.append(grads.download(1))
            ((_, lists),) = pipeline.bands(frame)
            assert lists.strips is not None
            missed += (to_host(device, lists.strips, np.empty(frame.n_isects, np.uint32)) == 0).sum()
        for name, array in found[0].items() if found else ():
            assert np.isfinite(array).all()
            np.testing.assert_array_equal(found[1][name], array, err_msg=name)
    assert missed > 8

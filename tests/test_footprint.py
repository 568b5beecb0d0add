"""Boxes of splats: no pixel is lost to them, and they are not much larger than what they hold.

The reference has no boxes: every pixel meets every splat.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from conftest import MakeRenderer
from kernel_checks import Arrays, Case
from numpy.typing import NDArray
from reference import prepared, project
from reference_formulas import SKEW_MAX
from reference_scenes import random_camera, random_splats
from reference_shape import Kernel
from scipy.special import ndtr
from tolerances import IMAGE_FLOAT32, ROUNDING

from clsplat.buffers import SplatBuffers, to_host
from clsplat.camera import Camera
from clsplat.device import Device, default_schedule
from clsplat.kernels import ALPHA_MIN, TILE, KernelBuild
from clsplat.pipeline import Pipeline
from clsplat.splats import Splats

BOTH = pytest.mark.parametrize("shape", ["gaussian", "skew-normal"])


def strongly_skewed(seed: int, n: int) -> Arrays:
    """Splats of every size, anisotropy and opacity (many just above the cutoff), skew near the bound."""
    rng = np.random.default_rng(seed)
    arrays = random_splats(seed, n, 3)
    arrays["log_scale"] = rng.uniform(-4.0, -0.5, (n, 3))
    opacity = np.exp(rng.uniform(np.log(1.02 * ALPHA_MIN), np.log(0.99), n))
    arrays["opacity_logit"] = np.log(opacity / (1.0 - opacity))
    length = rng.uniform(0.8, 0.999, n) * SKEW_MAX
    arrays["skew"] *= (length / np.linalg.norm(arrays["skew"], axis=1))[:, None]
    return arrays


@cache
def single_splats(shape: str, normalisation: str, dtype: type) -> list[Case]:
    """One splat an image, so that nothing hides a missing pixel; tile borders fall anywhere on them."""
    many = strongly_skewed(0, 150)
    cases = []
    for i in range(150):
        arrays = {name: value[i : i + 1] for name, value in many.items()}
        cases.append(Case(arrays, random_camera(i, 53, 39), shape, normalisation, dtype))
    return cases


@pytest.mark.parametrize(("shape", "normalisation"), [("gaussian", "peak"), ("skew-normal", "peak")])
@pytest.mark.parametrize(("precision", "tolerance"), [("float32", IMAGE_FLOAT32), ("float64", ROUNDING)])
def test_no_pixel_is_lost(make_renderer: MakeRenderer, device: Device, shape: str, normalisation: str,
                          precision: str, tolerance: float) -> None:
    """A pixel lost would miss an alpha of 1/255 at least."""
    renderer = make_renderer(device, precision)
    covered = 0
    for case in single_splats(shape, normalisation, np.dtype(precision).type):
        case.check_image(case.render(renderer), tolerance)
        covered += np.count_nonzero(case.image.alpha)
    assert covered > 150 * 20


@pytest.mark.parametrize("normalisation", ["pdf", "none"])
def test_no_pixel_is_lost_in_other_normalisations(make_renderer: MakeRenderer, device: Device,
                                                  normalisation: str) -> None:
    renderer = make_renderer(device)
    for case in single_splats("skew-normal", normalisation, np.float32):
        case.check_image(case.render(renderer), IMAGE_FLOAT32)


def true_boxes(screen: Kernel) -> NDArray[np.float64]:
    """(N, 4) lowest x, y and highest x, y [px] where alpha >= ALPHA_MIN; NaN where it is nowhere.

    With scale2d = L L' and d = L y, alpha is amplitude exp(-y'y/2) Phi(b'y): log-concave, highest on the ray
    along b. So each ray from there meets the level set once: bisection, in 720 directions.
    """
    factor = np.linalg.cholesky(screen.scale2d)
    b = np.zeros((len(factor), 2))
    if screen.slope is not None:
        b = np.einsum("nji,nj->ni", factor, screen.slope)

    def log_alpha(y: NDArray[np.float64]) -> NDArray[np.float64]:  # (N, 2, K)
        value = np.log(screen.amplitude)[:, None] - 0.5 * (y * y).sum(1)
        if screen.slope is not None:
            value = value + np.log(np.maximum(ndtr(np.einsum("ni,nik->nk", b, y)), 1e-300))
        return value

    unit = b / np.maximum(np.linalg.norm(b, axis=1, keepdims=True), 1e-12)
    along = np.linspace(0.0, 1.5, 301)
    best = along[log_alpha(unit[:, :, None] * along).argmax(1)]
    mode = unit * best[:, None]
    angle = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    ray = np.stack([np.cos(angle), np.sin(angle)])
    low, high = np.zeros((len(b), 720)), np.full((len(b), 720), 6.0)
    for _ in range(40):
        middle = 0.5 * (low + high)
        inside = log_alpha(mode[:, :, None] + middle[:, None] * ray) >= np.log(ALPHA_MIN)
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    rim = screen.location[:, :, None] + factor @ (mode[:, :, None] + low[:, None] * ray)
    boxes = np.concatenate([rim.min(2), rim.max(2)], axis=1)
    boxes[log_alpha(mode[:, :, None])[:, 0] < np.log(ALPHA_MIN)] = np.nan
    return boxes


def kernel_boxes(device: Device, shape: str, arrays: Arrays,
                 camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """First and last pixel row of each splat (N, 2), and its tiles (N, 4): first x, y, past-the-end x, y."""
    kernels = KernelBuild(shape, 3, default_schedule(device.cl_device)).for_rendering()
    pipeline = Pipeline(device, kernels)
    values = {name: arrays[name].astype(np.float32) for name in kernels.schema.names}
    splats = SplatBuffers.of(device, Splats(shape, values), kernels.dtype)
    pipeline.forward(splats, camera)
    pool, n = pipeline.pool, splats.n
    records = to_host(device, pool.get("records", 0), np.empty((n, kernels.record), np.float32))
    tiles = to_host(device, pool.get("tile_rect", 0), np.empty((n, 4), np.int32))
    return records[:, 6:8].astype(np.float64), tiles.astype(np.float64)


@BOTH
@pytest.mark.parametrize("turned", [False, True])
def test_boxes_hold_their_splats_and_little_else(device: Device, shape: str, turned: bool) -> None:
    """Splats of hundreds of pixels, so that rounding to pixels (rows) and tiles (columns) weighs little.

    Turning the camera by 90 degrees lets the exact side, the rows, measure the other axis too.
    """
    n, size = 200, 1024
    arrays = strongly_skewed(5, n)
    arrays["mean"] *= 0.4
    arrays["log_scale"] = np.random.default_rng(6).uniform(-3.0, -1.2, (n, 3))
    pose = np.eye(4)
    pose[2, 3] = 4.0
    if turned:
        pose[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    camera = Camera(size, size, 1.0 * size, 1.1 * size, 0.52 * size, 0.49 * size, pose)
    screen = project(prepared(arrays, shape), camera, shape).kernel
    truth = true_boxes(screen)
    seen = np.isfinite(truth[:, 0])
    assert seen.sum() > 0.9 * n
    truth = truth[seen]
    assert truth.min() > 0.0, "the scene is to lie inside the image"
    assert truth.max() < size, "the scene is to lie inside the image"
    rows, tiles = (boxes[seen] for boxes in kernel_boxes(device, shape, arrays, camera))

    slack = 1e-3  # px: float32 rounding of an extent
    assert (rows[:, 0] <= np.ceil(truth[:, 1] - 0.5 + slack)).all()
    assert (rows[:, 1] >= np.floor(truth[:, 3] - 0.5 - slack)).all()
    first, last = np.ceil(truth[:, :2] - 0.5 + slack) // TILE, np.floor(truth[:, 2:] - 0.5 - slack) // TILE
    some = (np.floor(truth[:, 2:] - 0.5) >= np.ceil(truth[:, :2] - 0.5)).all(1)
    assert (tiles[some, :2] <= first[some]).all()
    assert (tiles[some, 2:] >= last[some] + 1).all()

    height, true_height = rows[:, 1] - rows[:, 0] + 1, truth[:, 3] - truth[:, 1]
    area = (tiles[:, 2:] - tiles[:, :2]).prod(1)
    true_area = (np.floor(truth[:, 2:] / TILE) - np.floor(truth[:, :2] / TILE) + 1).prod(1)
    if shape == "gaussian":  # exact but for rounding
        assert (height <= true_height + 1.0 + slack).all()
        assert area.sum() <= 1.01 * true_area.sum()
    else:  # measured: 7 % in height, 11 % in tiles; the box of the ellipse alone: 29 % in height
        ellipse = 2.0 * np.sqrt(2.0 * np.log(screen.amplitude / ALPHA_MIN) * screen.scale2d[:, 1, 1])[seen]
        assert height.sum() <= 1.09 * true_height.sum()
        assert area.sum() <= 1.13 * true_area.sum()
        assert ellipse.sum() > 1.25 * true_height.sum(), "too little skew to tell"

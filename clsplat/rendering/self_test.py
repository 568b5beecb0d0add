"""The self-test of a device and schedule: a small frame and its gradients against stored numbers.

A wrong compiler or driver costs quality without a word, so a device that computes wrongly is refused. The stored
numbers come from the float64 renderer of the tests, which shares no code with the kernels
(`python tests/support/self_test_numbers.py`).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..device.device import Device
from ..device.memory import to_host
from ..device.program import wrong_numbers
from ..device.schedule import Schedule
from ..errors import DeviceError
from ..splats.fields import Array
from ..splats.low_pass import PIXEL
from ..splats.shapes import DEFAULT_SHAPE, SKEW_MAX
from ..splats.splats import Splats
from .build import CULLED_KEY, KernelBuild
from .frame import DeviceImage, Frame
from .pipeline import Pipeline
from .splat_buffers import CompactGradients, SplatBuffers

NUMBERS = Path(__file__).with_name("self_test.json")
BACKGROUND = (0.2, 0.5, 0.9)
SH_DEGREE = 3  # of the build that trains by default
_N, _HIDDEN, _PLAIN = 90, 2, 3  # splats; those behind the camera; every third has no skew
_WIDTH, _HEIGHT = 40, 24  # 3 x 2 tiles, some of them in part
# Ten times the errors that the tests allow (tests/reference/tolerances.py). Depths are relative, colours absolute,
# gradients relative to the largest entry of their field.
_DEPTH_TOLERANCE, _IMAGE_TOLERANCE, _GRADIENT_TOLERANCE = 1e-5, 1e-4, 1e-3

Numbers = dict[str, NDArray[np.float64]]


def check_rendering(device: Device, schedule: Schedule) -> None:
    """Render the small scene, and compare every stage with the stored numbers.

    Raises
    ------
    DeviceError : the kernels do not build, or compute wrong numbers; the message names the first wrong stage.
    """
    kernels = KernelBuild(DEFAULT_SHAPE, SH_DEGREE, schedule, antialiased=True, low_pass=PIXEL)
    pipeline = Pipeline(device, kernels)
    splats = SplatBuffers.of(device, scene(), kernels.dtype)
    try:
        frame = pipeline.forward(splats, camera(), BACKGROUND)
    except DeviceError as refused:  # numbers of splats that no scene has
        raise wrong_numbers(device, f"lists of tiles with schedule {schedule}, {refused.args[0]}") from None
    for stage, error, tolerance in _errors(pipeline, frame):
        if not error <= tolerance:  # NaN is wrong, too
            raise wrong_numbers(device, f"{stage} with schedule {schedule}, off by {error:.1e}")


def _errors(pipeline: Pipeline, frame: Frame) -> Iterator[tuple[str, float, float]]:
    """Yield stage, error and tolerance, in the order of the pipeline."""
    want = stored_numbers()
    yield "projection", _depth_error(frame, want["depth"]), _DEPTH_TOLERANCE
    yield "lists of tiles", float(_wrong_tiles(pipeline, frame)), 0.0
    images = frame.images
    image = np.concatenate([images.color.read(), 1 - images.transmittance.read()], axis=2)
    yield "image", float(np.abs(image - want["image"]).max()), _IMAGE_TOLERANCE
    splats = frame.splats
    grads = CompactGradients(pipeline.device, splats.schema, splats.capacity, splats.dtype)
    v_color = DeviceImage(pipeline.pool, splats.dtype, 3).write(frame.layout, gradient_of_image())
    pipeline.backward(frame, v_color, grads)
    for name, gradient in summed_bands(grads.written_out(splats.n)).items():
        error = np.abs(gradient - want[name]).max() / np.abs(want[name]).max()
        yield f"gradient of {name}", float(error), _GRADIENT_TOLERANCE


def _depth_error(frame: Frame, want: NDArray[np.float64]) -> float:
    """Return the largest relative error of the depths; infinity if a splat is culled wrongly."""
    keys = to_host(frame.splats.device, frame.projected.depth_key, np.empty(frame.n_splats, np.uint32))
    kept = keys != CULLED_KEY
    if (kept & (want == 0)).any() or (~kept & (want > 0)).any():
        return float("inf")
    return float(np.abs(keys.view(np.float32)[kept] / np.abs(want[kept]) - 1).max())


def _wrong_tiles(pipeline: Pipeline, frame: Frame) -> int:
    """Return the number of tiles whose list is not that of the projected splats, nearest first."""
    device, n, layout = pipeline.device, frame.n_splats, frame.layout
    keys = to_host(device, frame.projected.depth_key, np.empty(n, np.uint32))
    left, top, right, bottom = to_host(device, frame.projected.tile_rect, np.empty((n, 4), np.int32)).T
    order = np.argsort(keys, kind="stable")
    wrong = 0
    for band, lists in pipeline.bands(frame):
        ranges = to_host(device, lists.ranges, np.empty((layout.n_tiles, 2), np.uint32))
        isects = to_host(device, lists.isects, np.empty(band.n_isects, np.uint32))
        isect_splat = to_host(device, lists.isect_splat, np.empty(band.n_isects, np.uint32))
        for tile in range(band.first, band.end):
            y, x = divmod(tile, layout.tiles_x)
            inside = (left <= x) & (x < right) & (top <= y) & (y < bottom)
            ids = isects[slice(*ranges[tile])]
            listed = isect_splat[ids] if (ids < band.n_isects).all() else ids
            wrong += not np.array_equal(listed, order[inside[order]])
    return wrong


@cache
def stored_numbers() -> Numbers:
    """Return the stored numbers.

    `depth` (N,) is camera z: 0 for splats that must be culled, negative for those that may be culled, because no pixel
    shows them. `image` (H, W, 4) is colour and alpha. The other entries
    are gradients by field, as `summed_bands` returns them.
    """
    return {name: np.asarray(values) for name, values in json.loads(NUMBERS.read_text(encoding="utf-8")).items()}


@cache
def scene() -> Splats:
    """Return antialiased splats of every opacity and skew, some without skew, some behind the camera."""
    direction = _spread(3, 20) - 0.5
    direction /= np.sqrt((direction * direction).sum(1, keepdims=True))
    skew = direction * SKEW_MAX * 0.95 * _spread(1, 23)
    skew[::_PLAIN] = 0
    mean = 2.4 * _spread(3, 0) - 1.2
    mean[-_HIDDEN:, 2] = -6
    return Splats(
        DEFAULT_SHAPE,
        {
            "mean": mean,
            "quat": _spread(4, 3) - 0.5,
            "log_scale": -2.35 + 1.6 * _spread(3, 7),
            "opacity_logit": -4.2 + 6.0 * _spread(1, 10)[:, 0],
            "sh": 0.6 * (_spread(3 * (SH_DEGREE + 1) ** 2, 24) - 0.4).reshape(_N, -1, 3),
            "skew": skew,
        },
        antialiased=True,
        low_pass=PIXEL,
    )


def camera() -> Camera:
    """Return the camera, with the optical axis beside the centre of the image."""
    pose = np.eye(4)
    pose[2, 3] = 4.0
    return Camera(_WIDTH, _HEIGHT, 42.0, 40.0, 19.3, 12.4, pose)


def gradient_of_image() -> NDArray[np.float64]:
    """Return the gradient of a loss with respect to the image, (H, W, 3)."""
    return 2 * _fractions(_HEIGHT * _WIDTH, 3, 90).reshape(_HEIGHT, _WIDTH, 3) - 1


def summed_bands(gradients: dict[str, Array]) -> dict[str, Array]:
    """Replace the gradient of `sh` (N, K, 3) by a weighted sum over its K coefficients."""
    sh = gradients["sh"]
    weights = np.cos(np.arange(sh.shape[1]))
    return gradients | {"sh": np.einsum("nkc,k->nc", sh, weights)}


def _spread(width: int, first: int) -> NDArray[np.float64]:
    """Return numbers in 0..1, (splats, width); columns with another `first` are independent."""
    return _fractions(_N, width, first)


def _fractions(n: int, width: int, first: int) -> NDArray[np.float64]:
    """Return the fractions of the multiples of square roots: evenly spread, and the same on every machine."""
    columns = np.arange(first, first + width)
    squares = columns + 2 + np.rint(np.sqrt(columns + 2))  # the numbers that are no squares, in order
    return np.modf(np.outer(np.arange(1, n + 1), np.sqrt(squares)))[0]

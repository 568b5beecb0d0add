"""The loss and its gradient agree with the reference, for any image size, every schedule and both precisions."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from device_schedules import schedule_on
from numpy.typing import NDArray
from reference.loss import reference_loss, reference_loss_gradient, smooth_sign
from reference.tolerances import ROUNDING, relative_error

from clsplat.device.device import Device
from clsplat.device.memory import Pool, to_device, to_host
from clsplat.device.program import Real
from clsplat.device.schedule import Schedule, default_schedule
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.frame import DeviceImage, ImageLayout
from clsplat.training.loss import ImageLoss, LossValue

# Heights and widths: below the window, near a tile and a strip of vectors, and several segments of rows.
SIZES = [(1, 1), (2, 3), (7, 40), (19, 27), (16, 16), (5, 97), (70, 37)]


def loss_of(
    device: Device, schedule: Schedule | None = None, real: Real = "float", weight: float = 0.2, beta: float = 0.0
) -> ImageLoss:
    """Return a loss with the device's default schedule, or another one."""
    if real == "double" and not device.has_fp64:
        pytest.skip("no double precision")
    schedule = schedule or default_schedule(device.info)
    return ImageLoss(Pool(device), KernelBuild("gaussian", 0, schedule, real=real), weight, beta)


def compared(
    loss: ImageLoss, color: NDArray[np.floating], truth: NDArray[np.uint8]
) -> tuple[LossValue, NDArray[np.floating]]:
    """Return the value and the gradient (H, W, 3) of the loss of an image against a truth."""
    device, dtype = loss.device, loss.kernels.dtype
    layout = ImageLayout(truth.shape[1], truth.shape[0])
    rendered = DeviceImage(loss.pool, dtype, 3).write(layout, color)
    planes = layout.pack(truth, np.dtype(np.uint8))
    buffer = device.alloc(planes.nbytes)
    to_device(device, buffer, planes)
    result = loss.evaluate(layout, rendered, buffer)
    gradient = to_host(device, result.v_color, np.empty((3, layout.rows, layout.stride), dtype))
    inside = layout.unpack(gradient)
    assert np.abs(gradient).sum() == pytest.approx(np.abs(inside).sum(), rel=1e-6), "not zero outside the image"
    return loss.value(result), inside


def pair(height: int, width: int, noise: float = 0.2) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return a noisy image and truth with a flat block. The image has single precision, which both builds hold."""
    rng = np.random.default_rng(height * 1000 + width)
    truth = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    truth[: height // 2, : width // 2] = 128
    color = np.clip(truth / 255 + noise * rng.normal(size=truth.shape), 0, 1.2)
    return color.astype(np.float32), truth


@cache
def expected_of_ssim(height: int, width: int) -> NDArray[np.float64]:
    """Return the reference's gradient of `pair` for SSIM alone."""
    color, truth = pair(height, width)
    return reference_loss_gradient(color, truth / 255, 1.0)


def expected(height: int, width: int, weight: float, beta: float) -> tuple[float, NDArray[np.float64]]:
    """Return the reference's loss and gradient of `pair`."""
    color, truth = pair(height, width)
    of_l1 = (1 - weight) * smooth_sign(color - truth / 255, beta) / color.size
    return reference_loss(color, truth / 255, weight, beta), of_l1 + weight * expected_of_ssim(height, width)


@pytest.mark.parametrize("beta", [0.0, 0.1])
@pytest.mark.parametrize(
    ("real", "weight", "tolerance"), [("double", 0.2, ROUNDING), ("double", 1.0, ROUNDING), ("float", 0.2, 2e-5)]
)
def test_loss_and_gradient_equal_the_reference(
    scheduled: tuple[Device, Schedule], real: Real, weight: float, tolerance: float, beta: float
) -> None:
    """One object computes all sizes, so its buffers are reused."""
    loss = loss_of(*scheduled, real, weight, beta)
    for height, width in SIZES:
        color, truth = pair(height, width)
        value, gradient = compared(loss, color, truth)
        total, wanted = expected(height, width, weight, beta)
        name = f"{width}x{height}"
        assert value.total == pytest.approx(total, rel=max(tolerance, 1e-9)), name
        assert value.l1 == pytest.approx(np.abs(color - truth / 255).mean(), rel=1e-5), name
        assert value.psnr == pytest.approx(-10 * np.log10(np.mean((color - truth / 255) ** 2)), abs=1e-3), name
        assert relative_error(gradient, wanted) < tolerance, name


def test_segments_of_rows_change_no_gradient(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A device of many units divides an image into more segments. This changes only the order of sums in the value."""
    color, truth = pair(101, 50)
    found = []
    for rows in (101, 50, 33, 7):
        monkeypatch.setattr(ImageLoss, "_rows", lambda *_, rows=rows: rows)
        found.append(compared(loss_of(device), color, truth))
    for value, gradient in found[1:]:
        np.testing.assert_array_equal(gradient, found[0][1])
        assert value.total == pytest.approx(found[0][0].total, rel=1e-6)


def test_strips_change_no_gradient(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A strip is 640 px wide by default. Here strips of 1, 2 and 3 vectors divide an image of five vectors."""
    schedule = schedule_on(device, "cpu16")
    color, truth = pair(21, 75)
    whole = compared(loss_of(device, schedule), color, truth)
    for strip in (1, 2, 3):
        for module in ("loss", "programs"):
            monkeypatch.setattr(f"clsplat.training.{module}.loss_strip", lambda _, strip=strip: strip)
        value, gradient = compared(loss_of(device, schedule), color, truth)
        np.testing.assert_array_equal(gradient, whole[1])
        assert value.total == pytest.approx(whole[0].total, rel=1e-6)


def test_work_for_every_unit_and_no_segment_too_short(devices: list[Device]) -> None:
    loss = loss_of(devices[0])
    rows = [loss._rows(strips, 480) for strips in (1, 3, 1_000_000)]
    assert rows == sorted(rows)
    assert rows[0] >= 32
    assert rows[-1] == 480


@pytest.mark.parametrize("values", ["all bytes", "powers of two"])
def test_equal_images_have_no_loss(device: Device, values: str) -> None:
    """A GPU may round x - b / 255 once, where b / 255 was rounded before. With powers of two, both are 0."""
    truth = pair(40, 30)[1]
    if values == "powers of two":
        truth = (1 << (truth >> 5)).astype(np.uint8)
    value, gradient = compared(loss_of(device), truth.astype(np.float32) * np.float32(1 / 255), truth)
    assert value.l1 < 1e-7  # x - b / 255 may be rounded once, and b / 255 was rounded before
    assert value.ssim == pytest.approx(1, abs=1e-6)
    if device.info.type == "CPU" or values == "powers of two":
        assert np.abs(gradient).max() < 1e-7


def test_float32_keeps_digits_near_the_truth(device: Device) -> None:
    """The kernel uses variances of sum and difference.

    The usual form, E[xx] - E[x]^2 and E[yy] - E[y]^2, has errors above 2e-4 on this image of small differences.
    """
    rng = np.random.default_rng(0)
    truth = np.full((22, 30, 3), 200, np.uint8)
    color = np.clip(truth / 255 + 0.002 * rng.normal(size=truth.shape), 0, 1).astype(np.float32)
    gradient = compared(loss_of(device, weight=1.0), color, truth)[1]
    assert relative_error(gradient, reference_loss_gradient(color, truth / 255, 1.0)) < 1.5e-4

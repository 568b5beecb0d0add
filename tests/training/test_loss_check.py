"""A device that computes a wrong loss is refused before a run, with one line."""

from __future__ import annotations

import time

import pytest

from clsplat.device.device import Device
from clsplat.device.program import Program, build_text, source
from clsplat.device.schedule import Schedule, default_schedule
from clsplat.errors import DeviceError
from clsplat.rendering.build import KernelBuild
from clsplat.scenes.scene import Scene
from clsplat.training import programs
from clsplat.training.config import TrainConfig
from clsplat.training.loss_check import check_loss
from clsplat.training.trainer import Trainer

# What a compiler may do to the text of cl/train/loss.cl.
FAULTS = {
    "zeros beside the row (Mesa 22.3)": ("ring[MID", "(real)0 * ring[MID"),
    "rows above the pixel are lost": ("ring[MID - k]", "(real)0 * ring[MID - k]"),
    "columns are mirrored": ("lanes_load(hs - k)", "lanes_load(hs + k)"),
    "no gradient of SSIM": ("ssim_scale * v_ssim", "(real)0 * v_ssim"),
    "gradient of L1 in the wrong direction": ("l1_scale * slope", "-l1_scale * slope"),
    "no quadratic part of the gradient": ("max(min((x - y) * steepness", "max(min((x - y) * R(1e30)"),
    "no quadratic part of the value": ("min(size * steepness", "min(size * R(1e30)"),
    "bytes are signed": ("lanes_uchar_to_real(p) * BYTE_STEP", "(lanes_uchar_to_real(p) - 1) * BYTE_STEP"),
}


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Break the program of the loss as a compiler could."""
    old, new = FAULTS[request.param]

    def build(device: Device, files: tuple[str, ...], *rest: object) -> Program:
        text = source(*files)
        assert ("train/loss.cl" in files) == (old in text)
        return build_text(device, text.replace(old, new), *rest)

    monkeypatch.setattr(programs, "build", build)


def test_every_schedule_passes_quickly(scheduled: tuple[Device, Schedule]) -> None:
    device, schedule = scheduled
    for weight, beta in ((0.2, 0.05), (0.2, 0.0), (0.0, 1.0), (1.0, 0.05)):
        check_loss(device, KernelBuild("gaussian", 0, schedule), weight, beta)
    start = time.perf_counter()
    check_loss(device, KernelBuild("gaussian", 0, schedule), 0.2, 0.05)
    assert time.perf_counter() - start < 1.0  # about 5 ms alone


@pytest.mark.parametrize("broken", FAULTS, indirect=True)
def test_a_wrong_loss_is_refused(broken: None, device: Device) -> None:
    with pytest.raises(DeviceError, match=r"computes wrong numbers \(loss off by .*update its driver") as caught:
        check_loss(device, KernelBuild("gaussian", 0, default_schedule(device.info)), 0.2, 0.05)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("broken", list(FAULTS)[:1], indirect=True)
def test_no_run_starts_with_a_wrong_loss(broken: None, scene: Scene, device: Device) -> None:
    with pytest.raises(DeviceError, match="computes wrong numbers"):
        Trainer(scene, TrainConfig(iterations=1), device=device)

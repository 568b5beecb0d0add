"""The self-test of a device: its numbers are those of the reference, and a device that computes wrongly is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import self_test_numbers
from device_schedules import as_kind

from clsplat.device import program
from clsplat.device.device import Device
from clsplat.device.schedule import Schedule, default_schedule
from clsplat.errors import DeviceError
from clsplat.rendering import self_test, tuning
from clsplat.rendering.build import BATCH, KernelBuild
from clsplat.rendering.pipeline import Pipeline
from clsplat.rendering.self_test import check_rendering
from clsplat.rendering.splat_buffers import SplatBuffers
from clsplat.splats.shapes import DEFAULT_SHAPE

# What a compiler may do to a text: its old part, its new part, and the first stage that shows it.
FAULTS = {
    "wrong depth": ("as_uint((float)lane[l][HEAD_DEPTH])", "as_uint((float)lane[l][HEAD_X])", "projection"),
    "splats are lost": (
        "const bool keep = edge[4][l] > 0;",
        "const bool keep = i % 7 && edge[4][l] > 0;",
        "projection",
    ),
    "wrong sign of a harmonic": ("basis[2] = SH_1 * z", "basis[2] = -SH_1 * z", "image"),
    "pixels finish early": ("(behind > (vreal)T_MIN)", "(behind > (vreal)0.5f)", "image"),
    "batches are left out": ("start < range.y; start += BATCH", "start < range.y; start += 1000 * BATCH", "image"),
    "alpha without its denominator": ("pixel_ratio(-rest[v], (vreal)1 - alpha)", "-rest[v]", "gradient of mean"),
    "the last isect is not summed": ("isect < range.y; ++isect", "isect + 1 < range.y; ++isect", "gradient of mean"),
    "a division by zero": ("pixel_ratio(-rest[v], (vreal)1 - alpha)", "-rest[v] / (vreal)0", "gradient of mean"),
    "the norm of a quaternion": ("(vx - along * q.x) * q.inv_norm", "(vx - along * q.x)", "gradient of quat"),
    "scale is not its logarithm": ("= mul3(v_scale, s.scale);", "= v_scale;", "gradient of log_scale"),
    "colours are swapped": (
        "(vec3){v_rgb[0], v_rgb[1], v_rgb[2]}",
        "(vec3){v_rgb[0], v_rgb[2], v_rgb[1]}",
        "gradient of sh",
    ),
}
OF_A_KIND = [  # faults of the binners
    ("CPU", "++bottom[rect.z];", ""),
    ("CPU", "depth_order[start + k] =", "depth_order[n - 1 - start - k] ="),
    ("GPU", "numbered ? (uint)start + k", "numbered ? n - 1 - (uint)start - k"),
    ("GPU", "n_isects, tile + 1)", "n_isects, tile)"),
]


def kernels_of(device: Device) -> KernelBuild:
    return KernelBuild(DEFAULT_SHAPE, self_test.SH_DEGREE, default_schedule(device.info))


def broken(device: Device, monkeypatch: pytest.MonkeyPatch, old: str, new: str, kind: str = "") -> Device:
    """Return the device opened once more. Its programs are built from texts that are changed."""
    changed: list[str] = []

    def source(*names: str) -> str:
        text = SOURCE(*names)
        changed.extend([old] * (old in text))
        return text.replace(old, new)

    monkeypatch.setattr(program, "source", source)
    other = as_kind(device, kind or device.info.type)
    with pytest.raises(DeviceError) as caught:
        check_rendering(other, default_schedule(device.info))
    assert changed, "the kernels have this text"
    assert "\n" not in str(caught.value)
    assert "update its driver or use another device" in str(caught.value)
    return other


SOURCE = program.source


def test_the_stored_numbers_are_those_of_the_reference() -> None:
    stored, want = self_test.stored_numbers(), self_test_numbers.numbers()
    assert set(stored) == set(want)
    for name, values in want.items():
        assert stored[name].shape == values.shape
        assert np.abs(stored[name] - values).max() <= 1e-6 * np.abs(values).max(), name


def test_the_scene_reaches_every_part_of_the_kernels(device: Device) -> None:
    splats, numbers = self_test.scene(), self_test.stored_numbers()
    skew = splats.to_numpy()["skew"]
    assert 20 <= (np.linalg.norm(skew, axis=1) == 0).sum() <= len(skew) // 2
    assert (numbers["depth"] == 0).sum() == 2
    assert numbers["image"][..., 3].max() > 0.99
    pipeline = Pipeline(device, kernels_of(device))
    frame = pipeline.forward(SplatBuffers.of(device, splats, pipeline.kernels.dtype), self_test.camera())
    assert max(pipeline.binner.count(tile, tile + 1) for tile in range(frame.layout.n_tiles)) > BATCH


def test_every_schedule_passes(scheduled: tuple[Device, Schedule]) -> None:
    check_rendering(*scheduled)


@pytest.mark.parametrize("kind", ["CPU", "GPU"])
def test_both_binners_pass(device: Device, kind: str) -> None:
    other = as_kind(device, kind)
    check_rendering(other, default_schedule(device.info))


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_stage_is_named(device: Device, fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    old, new, stage = FAULTS[fault]
    other = broken(device, monkeypatch, old, new)
    with pytest.raises(DeviceError, match=rf"computes wrong numbers \({stage} with schedule .*, off by "):
        check_rendering(other, default_schedule(device.info))


@pytest.mark.parametrize(
    ("kind", "old", "new"), OF_A_KIND, ids=[f"{kind}-{n}" for n, (kind, *_) in enumerate(OF_A_KIND)]
)
def test_wrong_lists_are_named(device: Device, kind: str, old: str, new: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if replace(device.info, type=kind).ends_long_loops:
        pytest.skip("the binner of CPUs is not used on this device")
    other = broken(device, monkeypatch, old, new, kind)
    with pytest.raises(DeviceError, match=r"computes wrong numbers \(lists of tiles with schedule "):
        check_rendering(other, default_schedule(device.info))


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Return the empty cache of a process that has tested nothing."""
    monkeypatch.delenv(tuning.SCHEDULE_VARIABLE, raising=False)
    monkeypatch.setattr(tuning, "_chosen", {})
    monkeypatch.setattr(tuning, "cache_folder", lambda: tmp_path)
    return tmp_path


def wrong(*schedules: str) -> object:
    """Return a self-test that fails with these schedules."""

    def check(device: Device, schedule: Schedule) -> None:
        if str(schedule) in schedules:
            raise program.wrong_numbers(device, f"image with schedule {schedule}")

    return check


def test_a_schedule_that_computes_wrongly_is_not_chosen(
    device: Device, monkeypatch: pytest.MonkeyPatch, cache: Path
) -> None:
    monkeypatch.setattr(tuning, "measure", lambda _: {"256x1x1": 1.0, "64x4x1": 2.0, "32x8x1": 3.0})
    monkeypatch.setattr(tuning, "check_rendering", wrong("256x1x1"))
    assert str(tuning.schedule_for(device)) == "64x4x1"
    monkeypatch.setattr(tuning, "_chosen", {})
    monkeypatch.setattr(tuning, "check_rendering", wrong("64x4x1"))
    assert str(tuning.schedule_for(device)) == "64x4x1", "it is remembered"


def test_a_device_that_fails_with_every_schedule_is_refused(
    device: Device, monkeypatch: pytest.MonkeyPatch, cache: Path
) -> None:
    monkeypatch.setattr(tuning, "measure", lambda _: {"256x1x1": 2.0, "64x4x1": 1.0})
    monkeypatch.setattr(tuning, "check_rendering", wrong("256x1x1", "64x4x1"))
    for _ in range(2):  # nothing is remembered
        with pytest.raises(DeviceError, match="image with schedule 64x4x1"):
            tuning.schedule_for(device)
    assert not list(cache.iterdir())


def test_a_schedule_set_by_hand_is_tested_once(device: Device, monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    monkeypatch.setenv(tuning.SCHEDULE_VARIABLE, "gpu64")
    monkeypatch.setattr(tuning, "check_rendering", wrong("64x4x1"))
    with pytest.raises(DeviceError, match="image with schedule 64x4x1"):
        tuning.schedule_for(device)
    monkeypatch.setattr(tuning, "check_rendering", wrong())
    assert str(tuning.schedule_for(device)) == "64x4x1"
    monkeypatch.setattr(tuning, "check_rendering", wrong("64x4x1"))
    assert str(tuning.schedule_for(device)) == "64x4x1", "this process has tested it"
    monkeypatch.setattr(tuning, "_chosen", {})
    assert str(tuning.schedule_for(device)) == "64x4x1", "an earlier process has tested it"


def test_other_kernels_or_numbers_are_tested_again(
    device: Device, monkeypatch: pytest.MonkeyPatch, cache: Path
) -> None:
    tuning._digest.cache_clear()
    before = tuning._key(device)
    numbers = cache / "other.json"
    numbers.write_text(json.dumps({"depth": [1]}))
    monkeypatch.setattr(tuning, "NUMBERS", numbers)
    tuning._digest.cache_clear()
    assert tuning._key(device) != before
    monkeypatch.undo()
    tuning._digest.cache_clear()
    assert tuning._key(device) == before

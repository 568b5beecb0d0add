"""Devices with the least that clsplat needs: OpenCL 1.2 and no double precision, as GPUs of Apple have."""

from __future__ import annotations

import re
from dataclasses import replace
from importlib.resources import files
from types import SimpleNamespace

import pytest
from kernel_text import without_comments

from clsplat.device import device as device_module
from clsplat.device import program
from clsplat.device.device import Device, DeviceInfo, open_device
from clsplat.errors import DeviceError
from clsplat.rendering.renderer import Renderer


@pytest.fixture
def old(device: Device) -> Device:
    """The device as Apple would describe a GPU."""
    other = open_device(device.info.index)
    other.info = replace(
        other.info,
        platform="Apple",
        platform_version="OpenCL 1.2 (Oct  1 2024 00:00:00)",
        version="OpenCL 1.2 ",
        type="GPU",
        has_fp64=False,
    )
    return other


def test_an_old_device_builds_kernels_without_options_of_later_versions(
    old: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    built: list[tuple[str, list[str]]] = []
    compiled = program._compiled

    def keep(device: Device, text: str, options: list[str]) -> object:
        built.append((text, options))
        return compiled(device, text, options)

    monkeypatch.delenv(program.OPTIONS_VARIABLE)
    monkeypatch.setattr(program, "_compiled", keep)
    assert old.info.fault is None
    program.build_text(old, "kernel void nothing(float x) { }")
    ((text, options),) = built
    assert options == ["-cl-std=CL1.2", "-cl-mad-enable", "-cl-denorms-are-zero"]
    assert text.startswith("#define REAL_DOUBLE 0\n#define HAS_PREFETCH 0\n")


def test_double_precision_is_refused_in_one_line(old: Device) -> None:
    with pytest.raises(DeviceError) as refused:
        Renderer(old, precision="float64")
    assert str(refused.value) == (f"device {old.info} has no double precision: use float32 or choose another device")
    with pytest.raises(DeviceError, match="has no double precision: use float32"):
        program.build(old, ("measure/smoke.cl",), real="double")


def test_kernels_have_doubles_only_where_reals_are_doubles() -> None:
    """A device without doubles does not know the word."""
    found = {}
    for folder in (folder for folder in files("clsplat_cl").iterdir() if folder.is_dir()):
        for file in (file for file in folder.iterdir() if file.name.endswith((".cl", ".clh"))):
            text = without_comments(file.read_text(encoding="utf-8"))
            text = re.sub(r"#if REAL_DOUBLE\n.*?\n#(else|endif)", "", text, flags=re.S)
            found[file.name] = re.findall(r"\w*double\w*|cl_khr_fp64", text)
    assert len(found) > 35
    assert {name: words for name, words in found.items() if words} == {}


@pytest.mark.parametrize(
    ("version", "is_refused"),
    [
        ("OpenCL 1.2 ", False),
        ("OpenCL 1.2 pocl", False),
        ("OpenCL 2.0 AMD-APP", False),
        ("OpenCL 3.0 CUDA", False),
        ("unknown", False),
        ("OpenCL 1.1 Mesa", True),
        ("OpenCL 1.0", True),
    ],
)
def test_a_device_that_is_too_old_is_refused_in_one_line(
    device: Device, monkeypatch: pytest.MonkeyPatch, version: str, is_refused: bool
) -> None:
    info = replace(device.info, version=version)
    assert (info.fault is not None) == is_refused
    if is_refused:
        monkeypatch.delenv("PYOPENCL_CTX", raising=False)
        monkeypatch.setattr(device_module, "_all_devices", lambda: [(None, info)])
        with pytest.raises(
            DeviceError, match=rf"it has {version[:10]}, and the kernels need OpenCL 1\.2: update"
        ) as refused:
            open_device()
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("sizes", "largest"), [([1024, 1, 1], 1024), ([1, 1, 1], 1), ([4096, 64, 64], 2048)])
def test_groups_have_one_dimension(sizes: list[int], largest: int) -> None:
    """A device may allow more work-items in a group than along its first dimension."""
    texts = dict.fromkeys(("name", "version", "driver_version", "extensions"), "cl_khr_fp64")
    numbers = dict.fromkeys(("global_mem_size", "max_mem_alloc_size", "local_mem_size", "max_compute_units", "type"), 1)
    described = SimpleNamespace(**texts, **numbers, max_work_group_size=2048, max_work_item_sizes=sizes)
    info: DeviceInfo = device_module._describe("0:0", SimpleNamespace(name="A", version="1"), described)
    assert info.max_group == largest

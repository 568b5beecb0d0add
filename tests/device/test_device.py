"""Devices: listing, choice, memory limits, the pip runtime's registration, and `clsplat devices`."""

import dataclasses
import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest
from click.testing import CliRunner
from clsplat_cli import devices as devices_cli

from clsplat.device import device as device_module
from clsplat.device import pip_runtime as runtime
from clsplat.device.device import Device, DeviceInfo, list_devices, open_device
from clsplat.device.schedule import SCHEDULES, Schedule, default_schedule
from clsplat.errors import DeviceError
from clsplat.rendering.tuning import schedule_for

INFO = DeviceInfo(
    index="0:0",
    platform="Acme",
    platform_version="OpenCL 1.2 Acme",
    name="Anvil",
    driver="1",
    version="OpenCL 1.2",
    type="GPU",
    global_mem_bytes=1 << 30,
    max_alloc_bytes=1 << 28,
    local_mem_bytes=1 << 15,
    max_group=256,
    has_fp64=False,
    compute_units=8,
)

POCL, INTEL = "Portable Computing Language", "Intel(R) OpenCL"


@pytest.fixture(scope="module")
def device() -> Device:
    return open_device()


class Opened:
    """A stand-in for Device; these tests check the choice only."""

    def __init__(self, cl_device, info):
        self.info = info


@pytest.fixture
def choose(monkeypatch):
    """choose(spec, infos): index of the device that open_device chooses among invented ones."""
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    monkeypatch.setattr(device_module, "Device", Opened)

    def run(spec, *infos):
        monkeypatch.setattr(device_module, "_all_devices", lambda: [(None, info) for info in infos])
        return open_device(spec).info.index

    return run


def test_schedules_cover_a_tile_and_round_trip():
    for name, schedule in SCHEDULES.items():
        assert schedule.group * schedule.vecs * schedule.lanes == 256
        assert Schedule.parse(str(schedule)) == schedule == Schedule.parse(name)


@pytest.mark.parametrize(
    "text", ["1x16", "1x16x8", "axbxc", "", "0x16x16", "8x1x32", "-1x-16x16", "1x64x4", "8x32x1", "16x16x1"]
)
def test_bad_schedule_is_refused_in_one_line(text):
    with pytest.raises(DeviceError, match="schedule") as caught:
        Schedule.parse(text)
    assert "\n" not in str(caught.value)


def test_default_schedule_follows_the_kind_and_the_group_limit():
    for kind, max_group, name in (("CPU", 4096, "cpu16"), ("GPU", 1024, "gpu256"), ("GPU", 128, "gpu64")):
        assert default_schedule(dataclasses.replace(INFO, type=kind, max_group=max_group)) == SCHEDULES[name]
    mesa = dataclasses.replace(INFO, platform="rusticl", type="CPU", max_group=1024)
    assert default_schedule(mesa) == SCHEDULES["gpu256"], "Mesa compiles wide lanes for minutes"


def test_listed_devices_open_by_index():
    for info in list_devices():
        if info.fault is None:
            assert open_device(info.index).info == info


def test_best_device_is_a_gpu_then_pocl_then_intel(choose):
    gpu = dataclasses.replace(INFO, index="0:0")
    big = dataclasses.replace(INFO, index="0:1", compute_units=16)
    pocl = dataclasses.replace(INFO, index="1:0", platform=POCL, type="CPU", name="Intel Xeon")
    intel = dataclasses.replace(INFO, index="2:0", platform=INTEL, type="CPU", compute_units=64)
    grind = dataclasses.replace(INFO, index="3:0", platform="Oclgrind", type="CPU")
    assert choose(None, grind, intel, pocl, gpu, big) == "0:1"
    assert choose(None, grind, intel, pocl) == "1:0"
    assert choose(None, grind, intel) == "2:0"
    assert choose(None, grind) == "3:0"
    assert choose("cpu", gpu, intel, pocl) == "1:0"
    assert choose("GPU", intel, gpu) == "0:0"
    assert choose("intel", pocl, intel) == "2:0", "platform names are searched before device names"
    assert choose("xeon", intel, pocl) == "1:0"
    assert choose("2:0", gpu, pocl, intel) == "2:0"
    assert choose("0", pocl, gpu, big) == "0:0"
    assert choose("2", gpu, pocl, intel) == "2:0", "a number alone names a platform"


def test_an_unknown_device_lists_the_known_ones(choose):
    for spec in ("9:9", "nothing like it", ""):
        with pytest.raises(DeviceError, match=r"not found: choose one of 0:0 Anvil \(Acme\)"):
            choose(spec, INFO)


def test_the_broken_pocl_wheel_is_skipped_and_named(choose):
    broken = dataclasses.replace(
        INFO, platform=POCL, platform_version="OpenCL 3.0 PoCL 3.0-rc2  Linux, Release", type="CPU"
    )
    assert choose("cpu", broken, dataclasses.replace(INFO, index="1:0", type="CPU")) == "1:0"
    with pytest.raises(DeviceError, match=r"3\.0-rc2.*apt install pocl-opencl-icd"):
        choose(None, broken)


def test_without_a_platform_the_error_names_what_to_install(choose):
    with pytest.raises(DeviceError, match=r"no OpenCL platform.*pip install clsplat\[cpu\]"):
        choose(None)


def test_the_environment_chooses_and_is_named_if_wrong(monkeypatch):
    info = list_devices()[-1]
    monkeypatch.setenv("PYOPENCL_CTX", info.index)
    assert open_device().info == info
    monkeypatch.setenv("PYOPENCL_CTX", "97:0")
    with pytest.raises(DeviceError, match="PYOPENCL_CTX=97:0"):
        open_device()


def test_alloc_gives_usable_memory(device):
    for nbytes in (0, 4, 1 << 25):
        buffer = device.alloc(nbytes)
        assert buffer.size == max(nbytes, 4)
        tail = np.array([7], np.int32)
        cl.enqueue_copy(device.queue, buffer, tail, dst_offset=buffer.size - 4)
        back = np.zeros(1, np.int32)
        cl.enqueue_copy(device.queue, back, buffer, src_offset=buffer.size - 4)
        assert back[0] == 7


def test_too_large_a_buffer_is_refused_before_the_driver_sees_it(device):
    limit = device.info.max_alloc_bytes
    with pytest.raises(DeviceError, match=rf"out of memory: needs \d+ MB, has {limit / 2**20:.0f} MB"):
        device.alloc(limit + 1)


def test_host_memory_limits_a_cpu(device, monkeypatch):
    if device.info.type != "CPU":
        pytest.skip("the default device has its own memory")
    monkeypatch.setattr(device_module, "available_bytes", lambda: 17 << 20)
    device.alloc(17 << 20)
    with pytest.raises(DeviceError, match=r"needs 18 MB, has 17 MB free in this machine: use fewer splats"):
        device.alloc(18 << 20)


def test_driver_refusing_memory_becomes_one_clear_line(device, monkeypatch):
    def refuse(*args):
        raise cl.MemoryError("clCreateBuffer", cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE, "")

    monkeypatch.setattr(cl, "Buffer", refuse)
    with pytest.raises(DeviceError, match="device out of memory: needs 1 MB"):
        device.alloc(1 << 20)


@pytest.fixture
def prefix(tmp_path, monkeypatch):
    """A Python prefix with the pip runtime's library in it, and a system with one vendor."""
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / runtime.RUNTIME).touch()
    system = tmp_path / "vendors"
    system.mkdir()
    (system / "pocl.icd").write_text("libpocl.so\n")
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(runtime, "SYSTEM_VENDORS", system)
    monkeypatch.setattr(runtime, "_preload", lambda folder: True)
    # Set first, so that monkeypatch removes what register_pip_runtime sets.
    monkeypatch.setenv(runtime.VENDORS_VARIABLE, "")
    monkeypatch.delenv(runtime.VENDORS_VARIABLE)
    return tmp_path


def test_the_pip_runtime_is_registered_with_those_of_the_system(prefix):
    assert runtime.register_pip_runtime()
    folder = Path(os.environ[runtime.VENDORS_VARIABLE])
    texts = {icd.name: icd.read_text().strip() for icd in folder.iterdir()}
    assert texts.pop("pocl.icd") == "libpocl.so"
    assert list(texts.values()) == [str((prefix / "lib" / runtime.RUNTIME).resolve())]
    assert runtime.register_pip_runtime(), "a second call keeps it registered"
    assert os.environ[runtime.VENDORS_VARIABLE] == str(folder)


def test_processes_share_the_folder_of_vendors(prefix, monkeypatch):
    """A process that is killed leaves no folder behind: the next one uses the same. Other vendors have another."""
    folders = []
    for text in ("libpocl.so\n", "libpocl.so\n", "libpocl.so.2\n"):
        (prefix / "vendors" / "pocl.icd").write_text(text)
        assert runtime.register_pip_runtime()
        folders.append(os.environ[runtime.VENDORS_VARIABLE])
        monkeypatch.delenv(runtime.VENDORS_VARIABLE)
    assert folders[0] == folders[1] != folders[2]
    assert len(list((prefix / "cache" / "clsplat").iterdir())) == 2


def test_a_folder_of_vendors_that_cannot_be_written_is_one_line(prefix, monkeypatch):
    """Nothing is left behind."""

    def full(path: Path, text: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(DeviceError, match=r"cannot be written \(No space left on device\): set XDG_CACHE_HOME"):
        runtime.register_pip_runtime()
    assert not list((prefix / "cache" / "clsplat").iterdir())
    assert runtime.VENDORS_VARIABLE not in os.environ


def test_user_choice_and_system_registration_are_left_alone(prefix, monkeypatch):
    monkeypatch.setenv(runtime.VENDORS_VARIABLE, str(prefix / "vendors"))
    assert not runtime.register_pip_runtime()
    assert os.environ[runtime.VENDORS_VARIABLE] == str(prefix / "vendors")
    monkeypatch.delenv(runtime.VENDORS_VARIABLE)
    (prefix / "vendors" / "intel.icd").write_text(f"/opt/intel/{runtime.RUNTIME}\n")
    assert not runtime.register_pip_runtime()
    assert runtime.VENDORS_VARIABLE not in os.environ


def test_incomplete_pip_runtime_is_not_registered(prefix, monkeypatch):
    monkeypatch.setattr(runtime, "_preload", lambda folder: False)
    assert not runtime.register_pip_runtime()
    (prefix / "lib" / runtime.RUNTIME).unlink()
    assert not runtime.register_pip_runtime()
    assert runtime.VENDORS_VARIABLE not in os.environ


@pytest.mark.skipif(
    not (Path(sys.prefix) / "lib" / runtime.RUNTIME).is_file(), reason="intel-opencl-rt is not installed"
)
def test_installed_pip_runtime_shows_up_in_this_and_in_child_processes():
    code = (
        "import subprocess, sys\n"
        "from clsplat.device.device import list_devices\n"
        "print([d.platform for d in list_devices()])\n"
        "if len(sys.argv) > 1: subprocess.run([sys.executable, '-c', sys.argv[1]], check=True)\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != runtime.VENDORS_VARIABLE}
    out = subprocess.run(
        [sys.executable, "-c", code, code], env=environment, capture_output=True, text=True, check=True
    )
    lines = out.stdout.splitlines()
    assert len(lines) == 2
    assert all(INTEL in line for line in lines)


def test_command_lists_and_tries_every_device():
    result = CliRunner().invoke(devices_cli.devices)
    assert result.exit_code == 0, result.output
    for info in list_devices():
        assert f"{info.index}  {info.name}" in result.output
    assert "ok (built in" in result.output
    assert "image, gradients, loss and steps are right" in result.output
    assert str(schedule_for(open_device())) in result.output
    assert result.output.count("(default)") == 1


def test_command_without_any_device_says_so_and_fails(monkeypatch):
    monkeypatch.setattr(device_module, "_all_devices", list)
    result = CliRunner().invoke(devices_cli.devices)
    assert result.exit_code == 1
    assert "no OpenCL platform found" in result.output
    assert "Traceback" not in result.output


def test_command_names_the_broken_wheel_and_fails(monkeypatch):
    broken = dataclasses.replace(INFO, platform=POCL, platform_version="OpenCL 3.0 PoCL 3.0-rc2")
    monkeypatch.setattr(device_module, "_all_devices", lambda: [(None, broken)])
    result = CliRunner().invoke(devices_cli.devices)
    assert result.exit_code == 1
    assert "cannot build kernels on recent CPUs" in result.output


def test_hints_name_hardware_without_a_driver(tmp_path):
    assert devices_cli.hints({POCL}, has_gpu=False, root=tmp_path) == []
    (tmp_path / "dev/dri").mkdir(parents=True)
    (tmp_path / "dev/dri/renderD128").touch()
    assert "no OpenCL driver" in devices_cli.hints({POCL}, has_gpu=False, root=tmp_path)[0]
    assert devices_cli.hints({"AMD"}, has_gpu=True, root=tmp_path) == []
    (tmp_path / "dev/nvidia0").touch()
    assert "nvidia.icd" in devices_cli.hints({POCL}, has_gpu=False, root=tmp_path)[0]
    assert devices_cli.hints({"NVIDIA CUDA"}, has_gpu=True, root=tmp_path) == []

"""Caches: a folder that cannot be written costs one warning, never a run."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from cli_runner import run

from clsplat.device import caches
from clsplat.device.device import list_devices
from clsplat.errors import DeviceError
from clsplat.rendering.tuning import SCHEDULE_VARIABLE

VARIABLES = (caches.USER_VARIABLE, caches.POCL_VARIABLE, "HOME")


@pytest.fixture
def blocked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder that nobody can make, not even root: a file is above it. The environment has no cache folder."""
    (tmp_path / "file").touch()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for variable in (caches.USER_VARIABLE, caches.POCL_VARIABLE, "LOCALAPPDATA"):
        monkeypatch.setenv(variable, "")
        monkeypatch.delenv(variable)
    return tmp_path / "file" / "cache"


def warning_of_ensuring() -> str:
    """Return the only warning. A second call must find nothing to change."""
    with pytest.warns(UserWarning, match="cache of kernels cannot be written") as caught:
        caches.ensure_caches()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        caches.ensure_caches()
    assert len(caught) == 1
    return str(caught[0].message)


@pytest.mark.parametrize("broken", [("HOME",), (caches.USER_VARIABLE,), (caches.POCL_VARIABLE,), VARIABLES[:2]])
def test_a_temporary_cache_replaces_one_that_cannot_be_written(
    blocked: Path, monkeypatch: pytest.MonkeyPatch, broken: tuple[str, ...]
) -> None:
    for variable in broken:
        monkeypatch.setenv(variable, str(blocked))
    message = warning_of_ensuring()
    assert str(blocked) in message
    assert "\n" not in message
    for variable in VARIABLES[:2]:
        named = variable in broken or ("HOME" in broken and variable == caches.USER_VARIABLE)
        assert (variable in message) == named, message
        assert (variable in os.environ) == named
        if named:
            assert Path(os.environ[variable]).parent.name.startswith("clsplat-cache-")


@pytest.mark.parametrize("name", ["clsplat", "pocl", "pytools"])
def test_a_folder_of_another_user_inside_the_cache_is_found(
    blocked: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    """A run with sudo leaves folders that the user cannot write. Root can write everywhere, so a file stands for it."""
    monkeypatch.setenv(caches.USER_VARIABLE, str(tmp_path))
    (tmp_path / name).touch()
    assert str(tmp_path / name) in warning_of_ensuring()


def test_a_user_without_a_home_has_no_cache(blocked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", no_home)
    assert "no home folder" in warning_of_ensuring()


def test_a_good_cache_stays(blocked: Path, recwarn: pytest.WarningsRecorder) -> None:
    caches.ensure_caches()
    assert not recwarn.list
    assert caches.USER_VARIABLE not in os.environ
    assert not (caches.user_cache() / "pocl").exists(), "folders of other programs are not made"


def test_without_any_folder_the_error_names_the_variable(blocked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_space(prefix: str) -> str:
        raise OSError("No usable temporary directory found")

    monkeypatch.setenv(caches.USER_VARIABLE, str(blocked))
    monkeypatch.setattr(caches.tempfile, "mkdtemp", no_space)
    with pytest.raises(DeviceError, match="set XDG_CACHE_HOME to one that can"):
        caches.ensure_caches()


@pytest.mark.parametrize("full", [["cache"], ["cache", "elsewhere"]])
def test_a_full_disk_is_no_place_for_a_cache(
    blocked: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, full: list[str]
) -> None:
    """A small file may still fit, but then PoCL ends the process."""

    class FullFile(io.BytesIO):
        def write(self, data: object) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    def file_in(dir: Path) -> io.BytesIO:
        return FullFile() if any(dir.is_relative_to(tmp_path / name) for name in full) else io.BytesIO()

    monkeypatch.setenv(caches.USER_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(caches.tempfile, "TemporaryFile", file_in)
    monkeypatch.setattr(caches.tempfile, "mkdtemp", lambda prefix: str(tmp_path / "elsewhere"))
    if "elsewhere" in full:
        with pytest.raises(DeviceError, match="set XDG_CACHE_HOME to one that can"):
            caches.ensure_caches()
    else:
        assert f"{tmp_path / 'cache' / 'clsplat'}: No space left on device" in warning_of_ensuring()


@pytest.mark.skipif(not list_devices(), reason="no OpenCL device")
def test_devices_are_found_and_the_temporary_folder_is_removed(blocked: Path, tmp_path: Path) -> None:
    """PoCL shows no platform without a cache, and pyopencl's cache writes a traceback."""
    code = "from clsplat.device.device import list_devices, open_device; open_device(); print(len(list_devices()))"
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    broken = dict.fromkeys(VARIABLES, str(blocked))
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | broken | {"TMPDIR": str(temporary)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) == len(list_devices())
    assert done.stderr.count("cache of kernels cannot be written") == 1
    assert "Traceback" not in done.stderr
    assert not list(temporary.iterdir())


def test_a_command_warns_in_one_line(blocked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(caches.USER_VARIABLE, str(blocked))
    monkeypatch.setenv(SCHEDULE_VARIABLE, "gpu256")  # not measured
    result = run("devices")
    assert result.exit_code == 0, result.output
    lines = [line for line in result.stderr.splitlines() if "cache of kernels" in line]
    assert lines == [
        f"warning: cache of kernels cannot be written ({blocked / 'clsplat'}: Not a directory): kernels are built "
        "again in every run: set XDG_CACHE_HOME to a folder that can be written"
    ]

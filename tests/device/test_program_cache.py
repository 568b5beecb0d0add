"""The program cache: names of files, and damaged files, races or full folders that only cost a build."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from clsplat.device import program_cache
from clsplat.device.device import DeviceInfo
from clsplat.device.program_cache import SELF_CACHING, binary_path, load_binary, store_binary

INFO = DeviceInfo("0:0", "Some OpenCL", "OpenCL 3.0", "Some device", "1.2", "OpenCL 3.0", "GPU", 1, 1, 1, 1, True, 1)


@pytest.fixture(autouse=True)
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def test_the_name_depends_on_everything_that_the_binary_does() -> None:
    first = binary_path(INFO, "text", ["-a"])
    assert first is not None
    assert first == binary_path(INFO, "text", ["-a"]) == binary_path(replace(INFO, index="1:0"), "text", ["-a"])
    others = [binary_path(INFO, "text ", ["-a"]), binary_path(INFO, "text", ["-a", "-b"])]
    others += [
        binary_path(replace(INFO, **{field: "other"}), "text", ["-a"])
        for field in ("platform", "platform_version", "name", "version", "driver")
    ]
    assert len({first, *others}) == 8


def test_processors_of_one_name_have_different_files(monkeypatch: pytest.MonkeyPatch) -> None:
    cpu = replace(INFO, type="CPU")
    here = binary_path(cpu, "text", [])
    monkeypatch.setattr(program_cache, "_cpu_features", lambda: "flags: fewer")
    assert binary_path(cpu, "text", []) != here


def test_drivers_with_a_cache_get_no_file() -> None:
    assert all(binary_path(replace(INFO, platform=name), "text", []) is None for name in SELF_CACHING)


@given(binary=st.binary(max_size=200), cut=st.integers(0, 300), place=st.integers(0, 300))
def test_a_damaged_file_is_a_miss(
    tmp_path_factory: pytest.TempPathFactory, binary: bytes, cut: int, place: int
) -> None:
    path = tmp_path_factory.mktemp("bin") / "a.bin"
    assert load_binary(path) is None
    store_binary(path, binary)
    whole = path.read_bytes()
    assert load_binary(path) == binary
    if cut < len(whole):
        path.write_bytes(whole[:cut])
        assert load_binary(path) is None
    if place < len(whole):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        assert load_binary(path) is None


def test_a_folder_that_cannot_be_made_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    store_binary(tmp_path / "file" / "a.bin", b"binary")
    assert load_binary(tmp_path / "file" / "a.bin") is None


def test_files_unused_for_longest_go_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program_cache, "MAX_BYTES", 3 * (100 + 32))
    long_ago = time.time() - 1000
    for i, name in enumerate("abc"):
        store_binary(tmp_path / name, bytes(100))
        os.utime(tmp_path / name, (long_ago + i, long_ago + i))
    load_binary(tmp_path / "a")  # marks it as used, so it is now the youngest of the three
    store_binary(tmp_path / "d", bytes(100))
    assert {path.name for path in tmp_path.iterdir()} == {"a", "c", "d"}

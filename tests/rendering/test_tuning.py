"""The schedules that are measured on a device, what they are measured with, and the choice without a usable clock."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from clsplat.device import trace
from clsplat.device.device import Device
from clsplat.device.schedule import TILE, Schedule, default_schedule
from clsplat.errors import DeviceError
from clsplat.rendering import tuning


def candidates(device: Device, monkeypatch: pytest.MonkeyPatch, **info: object) -> list[str]:
    """Return the schedules that are measured on a device with these properties."""
    measured: list[str] = []
    monkeypatch.setattr(tuning, "_measure_one", lambda _, schedule: measured.append(str(schedule)) or 1.0)
    tuning.measure(SimpleNamespace(info=replace(device.info, **info)))
    return measured


def test_wide_lanes_are_measured_only_where_they_compile_in_time(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    pocl = candidates(device, monkeypatch, platform="Portable Computing Language", type="CPU", max_group=4096)
    assert pocl == ["1x16x16", "1x32x8", "256x1x1"]
    for mesa in (
        {"platform": "rusticl", "type": "CPU"},
        {"platform": "rusticl", "type": "GPU"},
        {"platform": "A", "type": "GPU"},
    ):
        assert candidates(device, monkeypatch, **mesa, max_group=1024) == ["256x1x1", "64x4x1", "32x8x1"]
    assert candidates(device, monkeypatch, platform="A", type="GPU", max_group=128) == ["64x4x1", "32x8x1"]


@pytest.fixture
def nothing_chosen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No schedule is forced, and neither this process nor the cache has one."""
    monkeypatch.delenv(tuning.SCHEDULE_VARIABLE, raising=False)
    monkeypatch.setattr(tuning, "_chosen", {})
    monkeypatch.setattr(tuning, "cache_folder", lambda: tmp_path)


@pytest.mark.usefixtures("nothing_chosen")
@pytest.mark.parametrize("fastest", [0, -1])
def test_the_fastest_schedule_is_chosen_once(device: Device, monkeypatch: pytest.MonkeyPatch, fastest: int) -> None:
    names = candidates(device, monkeypatch)
    times = {name: 2.0 + place for place, name in enumerate(names)} | {names[fastest]: 1.0}
    monkeypatch.setattr(tuning, "_measure_one", lambda _, schedule: times.pop(str(schedule)))
    assert str(tuning.schedule_for(device)) == names[fastest]
    assert not times, "all candidates are measured"
    assert str(tuning.schedule_for(device)) == names[fastest], "this process measures no more"
    monkeypatch.setattr(tuning, "_chosen", {})
    assert str(tuning.schedule_for(device)) == names[fastest], "the next process reads the cache"


@pytest.mark.usefixtures("nothing_chosen")
@pytest.mark.parametrize("stored", ['"1x2x3"', '"fast"', "3", "null"])
def test_a_damaged_choice_is_measured_again(
    device: Device, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, stored: str
) -> None:
    """Versions before had other schedules, and files break."""
    (tmp_path / "schedules.json").write_text(f'{{"{tuning._key(device)}": {stored}}}')
    names = candidates(device, monkeypatch)
    monkeypatch.setattr(tuning, "_measure_one", lambda _, schedule: float(str(schedule) != names[0]))
    assert str(tuning.schedule_for(device)) == names[0]


@pytest.mark.usefixtures("nothing_chosen")
def test_a_schedule_that_does_not_run_is_not_chosen(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    running = candidates(device, monkeypatch)[-1:]

    def measure_one(_: Device, schedule: Schedule) -> float:
        if str(schedule) not in running:
            raise DeviceError("the kernels do not build")
        return 1.0

    monkeypatch.setattr(tuning, "_measure_one", measure_one)
    assert tuning.measure(device) == {running[0]: 1.0}
    assert str(tuning.schedule_for(device)) == running[0]
    running.clear()
    tuning._cache_path().unlink()
    monkeypatch.setattr(tuning, "_chosen", {})
    assert tuning.schedule_for(device) == default_schedule(device.info)


def test_a_device_without_a_clock_is_measured_by_the_host(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mesa 22.3 says 1 ns for every command. All schedules would then be equally fast."""
    schedule = Schedule.parse("cpu16" if device.info.has_wide_lanes else "gpu256")
    monkeypatch.setattr(tuning, "_REPEATS", 1)
    monkeypatch.setattr(trace, "elapsed_ms", lambda _: 1e-6)
    assert tuning._measure_one(device, schedule) > 0.05
    monkeypatch.setattr(trace, "elapsed_ms", lambda _: 0.002)
    assert tuning._measure_one(device, schedule) == pytest.approx(0.004), "rasterize and rasterize_vjp"


@pytest.mark.parametrize(("units", "tiles"), [(1, 16), (2, 16), (16, 16), (17, 17), (132, 46)])
def test_every_compute_unit_gets_sixteen_tiles(device: Device, units: int, tiles: int) -> None:
    assert tuning._side(replace(device.info, compute_units=units)) == tiles * TILE
    assert tiles * tiles >= 16 * units

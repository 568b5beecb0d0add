"""Shared fixtures: every usable OpenCL device, every schedule, and renderers built once for the whole run.

The default device is the first; the others are for the slow tests, as building all kernels takes minutes on each.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cli_runner import HEIGHT, MODEL_RUN, N_VIEWS, WIDTH, clsplat
from device_schedules import schedule_on, suits
from hypothesis import settings

from clsplat.device.device import Device, list_devices, open_device
from clsplat.device.program import OPTIONS_VARIABLE
from clsplat.device.schedule import SCHEDULES, Schedule, default_schedule
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.demo.scene import write_capture
from clsplat.scenes.scene import Scene, load_scene

# Tests that need POSIX: pseudo-terminals, limits of a process, forks, alarms.
collect_ignore = [
    "cli/test_flags.py",
    "house/test_command_fuzz.py",
    "house/test_fuzz.py",
    "scenes/test_stored_views.py",
    "training/test_progress.py",
    "training/test_resume.py",
]
if sys.platform != "win32":
    collect_ignore.clear()

# The same examples in each run, so that a change fails by what it changes. "--hypothesis-profile=default" draws others.
settings.register_profile("same", derandomize=True, database=None)
settings.load_profile("same")

MakeRenderer = Callable[..., Renderer]

# A checker that claims to be a device is too slow for these tests and has one of its own (test_oclgrind.py).
USABLE = [info for info in list_devices() if info.fault is None and info.platform != "Oclgrind"]
DEFAULT = open_device().info.index if USABLE else ""
USABLE.sort(key=lambda info: info.index != DEFAULT)

NAMES = [info.platform.split()[0] for info in USABLE]


def on_place(place: int, *values: object, slow: bool = False) -> object:
    """Parameters of a test on the device in this place of USABLE."""
    return pytest.param(*(values or (place,)), marks=[pytest.mark.slow] if place or slow else [])


# All schedules that suit it are tested on the first device, two of them on the others. Each combination builds kernels
# for seconds, so the default run has one schedule of each kind: wide vectors, single lanes, and groups.
FAST_SCHEDULES = ("cpu16", "scalar", "gpu64")
DEVICE_SCHEDULES = [
    (place, name)
    for place, info in enumerate(USABLE)
    for name in SCHEDULES
    if suits(info, name) and (place == 0 or name in ("cpu16", "gpu256"))
]


@pytest.fixture(scope="session", autouse=True)
def kernels_build_without_warnings() -> Iterator[None]:
    """A warning of any compiler is an error in tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(OPTIONS_VARIABLE, "-Werror")
        yield


@pytest.fixture(scope="session")
def devices() -> list[Device]:
    """All usable devices, opened."""
    return [open_device(info.index) for info in USABLE]


@pytest.fixture(scope="session", params=[on_place(place) for place in range(len(USABLE))], ids=NAMES)
def device(request: pytest.FixtureRequest, devices: list[Device]) -> Device:
    """Each usable device in turn."""
    return devices[request.param]


@pytest.fixture(
    scope="session",
    params=[on_place(place, (place, name), slow=name not in FAST_SCHEDULES) for place, name in DEVICE_SCHEDULES],
    ids=[f"{NAMES[place]}-{name}" for place, name in DEVICE_SCHEDULES],
)
def scheduled(request: pytest.FixtureRequest, devices: list[Device]) -> tuple[Device, Schedule]:
    """Each device with each of the schedules that it is tested with."""
    place, name = request.param
    return devices[place], schedule_on(devices[place], name)


@pytest.fixture(scope="session")
def make_renderer() -> MakeRenderer:
    """make_renderer(device, precision, schedule=None, **thresholds) -> Renderer; kept: builds take seconds.

    No schedule means the device's default one, never one that is measured.
    """
    kept: dict[object, Renderer] = {}

    def make(
        device: Device, precision: str = "float32", schedule: Schedule | None = None, **thresholds: float
    ) -> Renderer:
        if precision == "float64" and not device.has_fp64:
            pytest.skip(f"{device.info} has no double precision")
        schedule = schedule or default_schedule(device.info)
        key = (device, precision, schedule, tuple(sorted(thresholds.items())))
        if key not in kept:
            kept[key] = Renderer(device, precision, schedule=schedule, **thresholds)
        return kept[key]

    return make


@pytest.fixture(scope="session")
def capture_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small capture with known ground truth; tests must not write into it."""
    return write_capture(tmp_path_factory.mktemp("small") / "yard", WIDTH, HEIGHT, N_VIEWS)


@pytest.fixture(scope="session")
def scene(capture_folder: Path) -> Scene:
    """The small capture, loaded; every 8th view is a test view."""
    return load_scene(capture_folder)


@pytest.fixture(scope="session")
def model_folder(capture_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a model of the small capture, trained by the command line; tests must not write into it."""
    folder = tmp_path_factory.mktemp("small") / "model"
    clsplat("train", capture_folder, "-m", folder, *MODEL_RUN)
    return folder

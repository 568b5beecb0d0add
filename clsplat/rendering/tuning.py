"""The fastest schedule of a device that computes right: measured and tested once on small scenes, then cached.

`CLSPLAT_SCHEDULE` overrides it with a name of `SCHEDULES` or GROUPxVECSxLANES, which is tested all the same. The cache
is one JSON file in the user's cache folder. Its keys are device, driver and the text of the kernels.
"""

from __future__ import annotations

import hashlib
import importlib.resources
import json
import math
import os
import statistics
import time
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np

from .. import activity
from .._version import __version__
from ..cameras.camera import Camera
from ..device.device import Device, DeviceInfo
from ..device.program_cache import cache_folder
from ..device.schedule import SCHEDULES, TILE, Schedule, default_schedule
from ..device.trace import recorded
from ..errors import ClsplatError, DeviceError, OutputError
from ..files.atomic import atomic_writer
from ..splats.splats import Splats
from .build import KernelBuild
from .pipeline import Pipeline
from .self_test import NUMBERS, check_rendering
from .splat_buffers import ParameterBuffers, SplatBuffers

SCHEDULE_VARIABLE = "CLSPLAT_SCHEDULE"
_WIDE_CANDIDATES, _OTHER_CANDIDATES = ("cpu16", "cpu8", "gpu256"), ("gpu256", "gpu64", "gpu32")
_LAST_CANDIDATE = "scalar"  # slow, but it needs neither groups nor vectors; measured if nothing else runs
_TIMED = ("rasterize", "rasterize_vjp")
_SPLATS, _REPEATS = 3000, 5
_MIN_TILES, _TILES_PER_UNIT = 256, 16  # of the image; fewer tiles would measure latency, not throughput
_CLOCK_FLOOR = 1e-3  # ms; no device is as fast, but Mesa 22.3 reports 1 ns for every command

_chosen: dict[str, Schedule] = {}


def schedule_for(device: Device, stored: str | None = None) -> Schedule:
    """Return the device's best schedule from the environment or from the cache, or measure it, which takes seconds.

    Parameters
    ----------
    stored : the schedule of a checkpoint, which a resumed run keeps: another one sums in a different order and changes
        the result.

    Raises
    ------
    DeviceError : the text is not a schedule, or the device fails its self-test with this one or with every schedule.
    """
    forced = stored or os.environ.get(SCHEDULE_VARIABLE)
    if forced:
        schedule = Schedule.parse(forced)
        _require_right(device, schedule)
        return schedule
    key = _key(device)
    if key not in _chosen:
        cached = _read_cache().get(key)
        if cached is None:
            times = measure(device)
            cached = _first_right(device, sorted(times, key=times.__getitem__) or [str(default_schedule(device.info))])
            _write_cache(key, cached)
        _chosen[key] = Schedule.parse(cached)
    return _chosen[key]


def _require_right(device: Device, schedule: Schedule) -> None:
    """Run the self-test of a device with a schedule, unless it has passed before.

    Raises
    ------
    DeviceError : it fails.
    """
    key = f"{_key(device)}|{schedule}"
    if key not in _chosen and key not in _read_cache():
        activity.report("testing whether this device computes right, once")
        check_rendering(device, schedule)
        _write_cache(key, str(schedule))
    _chosen[key] = schedule


def _first_right(device: Device, schedules: list[str]) -> str:
    """Return the first schedule with which the device passes its self-test; DeviceError of the first one if none is."""
    fault: ClsplatError | None = None
    for name in schedules:
        try:
            _require_right(device, Schedule.parse(name))
        except ClsplatError as error:
            fault = fault or error
        else:
            return name
    raise fault or DeviceError(f"device {device.info}: no schedule to test")


def measure(device: Device) -> dict[str, float]:
    """Return the time of rasterize and rasterize_vjp together by schedule [ms], without schedules that do not run.

    A device without a usable clock gets the time of the whole frame on the host's clock.
    """
    times: dict[str, float] = {}
    for name in (*(_WIDE_CANDIDATES if device.info.has_wide_lanes else _OTHER_CANDIDATES), _LAST_CANDIDATE):
        schedule = SCHEDULES[name]
        if schedule.group > device.info.max_group or (name == _LAST_CANDIDATE and times):
            continue
        activity.report(f"finding the fastest kernels of this device, once: {name}")
        with suppress(ClsplatError):
            times[str(schedule)] = _measure_one(device, schedule)
    return times


def _measure_one(device: Device, schedule: Schedule) -> float:
    kernels = KernelBuild("gaussian", 0, schedule)
    pipeline = Pipeline(device, kernels)
    splats = SplatBuffers.of(device, _scene(), kernels.dtype)
    grads = ParameterBuffers(device, splats.schema, splats.capacity, kernels.dtype)
    pose = np.eye(4)
    pose[2, 3] = 4.0
    side = _side(device.info)
    camera = Camera(side, side, 0.9 * side, 0.9 * side, side / 2, side / 2, pose)
    times = []
    for _ in range(_REPEATS + 1):
        start = time.perf_counter()
        with recorded(device) as launches:
            frame = pipeline.forward(splats, camera)
            pipeline.backward(frame, frame.images.color.buffer, grads)
            device.finish()
        wall = 1e3 * (time.perf_counter() - start)
        measured = sum(launch.ms for launch in launches if launch.name in _TIMED)
        times.append(measured if measured > _CLOCK_FLOOR else wall)
    return statistics.median(times[1:])


def _side(info: DeviceInfo) -> int:
    """Return the side of the image [px], a multiple of a tile, with enough tiles for every compute unit."""
    return TILE * math.ceil(math.sqrt(max(_MIN_TILES, _TILES_PER_UNIT * info.compute_units)))


def _scene() -> Splats:
    rng = np.random.default_rng(0)
    n = _SPLATS
    return Splats(
        "gaussian",
        {
            "mean": rng.uniform(-1.5, 1.5, (n, 3)),
            "quat": rng.standard_normal((n, 4)),
            "log_scale": rng.normal(-3.5, 0.5, (n, 3)),
            "opacity_logit": rng.normal(0, 2, n),
            "sh": rng.normal(0, 1, (n, 1, 3)),
        },
    )


def _key(device: Device) -> str:
    info = device.info
    return "|".join((info.platform, info.platform_version, info.name, info.type, info.driver, __version__, _digest()))


@cache
def _digest() -> str:
    """A digest of everything that the self-test depends on: all kernels, and the stored numbers."""
    folders = (folder for folder in importlib.resources.files("clsplat_cl").iterdir() if folder.is_dir())
    texts = {NUMBERS.name: NUMBERS.read_bytes()} | {
        f"{folder.name}/{file.name}": file.read_bytes()
        for folder in folders
        for file in folder.iterdir()
        if file.name.endswith((".cl", ".clh"))
    }
    return hashlib.sha256(b"\0".join(texts[name] for name in sorted(texts))).hexdigest()[:12]


def _cache_path() -> Path:
    return cache_folder() / "schedules.json"


def _read_cache() -> dict[str, str]:
    try:
        values = json.loads(_cache_path().read_text(encoding="utf-8"))
    except (OSError, ValueError, RuntimeError):
        return {}
    return {k: v for k, v in values.items() if _is_schedule(v)} if isinstance(values, dict) else {}


def _is_schedule(value: object) -> bool:
    try:
        return isinstance(value, str) and bool(Schedule.parse(value))
    except DeviceError:
        return False


def _write_cache(key: str, schedule: str) -> None:
    """Store a schedule. Without write access nothing is stored, and it is measured again next time."""
    with suppress(OutputError, OSError), atomic_writer(_cache_path()) as stream:
        stream.write(json.dumps(_read_cache() | {key: schedule}, indent=1).encode())

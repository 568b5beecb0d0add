"""The fastest schedule of a device: measured once on a small scene, then cached.

`CLSPLAT_SCHEDULE` overrides it with a name of `SCHEDULES` or GROUPxVECSxLANES. The cache is one JSON file in the user's
cache folder. Its keys are device, driver and the text of the kernels.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import statistics
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from .. import activity
from .._version import __version__
from ..cameras.camera import Camera
from ..device.device import Device, DeviceInfo
from ..device.program import source
from ..device.program_cache import cache_folder
from ..device.schedule import SCHEDULES, TILE, Schedule, default_schedule
from ..device.trace import recorded
from ..errors import ClsplatError, OutputError
from ..files.atomic import atomic_writer
from ..splats.splats import Splats
from .build import KernelBuild
from .pipeline import Pipeline
from .splat_buffers import ParameterBuffers, SplatBuffers

SCHEDULE_VARIABLE = "CLSPLAT_SCHEDULE"
_WIDE_CANDIDATES, _OTHER_CANDIDATES = ("cpu16", "cpu8", "gpu256"), ("gpu256", "gpu64", "gpu32")
_TIMED = ("rasterize", "rasterize_vjp")
_SPLATS, _REPEATS = 3000, 5
_MIN_TILES, _TILES_PER_UNIT = 256, 16  # of the image; fewer tiles would measure latency, not throughput
_CLOCK_FLOOR = 1e-3  # ms; no device is as fast, but Mesa 22.3 reports 1 ns for every command

_chosen: dict[str, Schedule] = {}


def schedule_for(device: Device) -> Schedule:
    """Return the device's best schedule from the environment or from the cache, or measure it, which takes seconds.

    Raises
    ------
    DeviceError : the variable does not hold a schedule.
    """
    forced = os.environ.get(SCHEDULE_VARIABLE)
    if forced:
        return Schedule.parse(forced)
    key = _key(device)
    if key not in _chosen:
        cached = _read_cache().get(key)
        if cached is None:
            times = measure(device)
            cached = min(times, key=times.__getitem__) if times else str(default_schedule(device.info))
            _write_cache(key, cached)
        _chosen[key] = Schedule.parse(cached)
    return _chosen[key]


def measure(device: Device) -> dict[str, float]:
    """Return the time of rasterize and rasterize_vjp together by schedule [ms], without schedules that do not run.

    A device without a usable clock gets the time of the whole frame on the host's clock.
    """
    times: dict[str, float] = {}
    for name in _WIDE_CANDIDATES if device.info.has_wide_lanes else _OTHER_CANDIDATES:
        activity.report(f"finding the fastest kernels of this device, once: {name}")
        schedule = SCHEDULES[name]
        if schedule.group <= device.info.max_group:
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
            device.queue.finish()
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
    text = source("render/rasterize.cl", "math/lanes.clh", "math/approx.clh", "render/group.clh", "render/blend.clh")
    digest = hashlib.sha256(text.encode()).hexdigest()[:12]
    return "|".join((info.platform, info.platform_version, info.name, info.driver, __version__, digest))


def _cache_path() -> Path:
    return cache_folder() / "schedules.json"


def _read_cache() -> dict[str, str]:
    try:
        values = json.loads(_cache_path().read_text(encoding="utf-8"))
    except (OSError, ValueError, RuntimeError):
        return {}
    return {k: v for k, v in values.items() if isinstance(v, str)} if isinstance(values, dict) else {}


def _write_cache(key: str, schedule: str) -> None:
    """Store a schedule. Without write access nothing is stored, and it is measured again next time."""
    with suppress(OutputError, OSError), atomic_writer(_cache_path()) as stream:
        stream.write(json.dumps(_read_cache() | {key: schedule}, indent=1).encode())

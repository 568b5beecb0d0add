"""Records of a sweep in the form that training writes, with round numbers."""

from __future__ import annotations

from typing import Any

from clsplat.comparison.table import MEASURED, Record
from clsplat.training.config import TrainConfig


def run_record(
    system: str,
    cap: int = 1000,
    psnr: float = 20.0,
    seed: int = 0,
    *,
    shape: str = "gaussian",
    iterations: int = 100,
    scene: str = "yard",
    **values: Any,
) -> Record:
    """A run of `cap` splats with a rendering time of cap / 100 ms."""
    config = TrainConfig(shape=shape, cap_max=cap, seed=seed, iterations=iterations)
    return {
        "scene": {"name": scene, "width": 8, "height": 6, "train": 3, "test": 1},
        "system": system,
        "config": config.to_json(),
        "failed": None,
        "finite": True,
        "cap_held": True,
        "device": "d",
        "driver": "v",
        "schedule": "1x16x16",
        "version": "0",
        "protocol": {"PSNR": "p", "SSIM": "s"},
        **dict.fromkeys(MEASURED, 1.0),
        "psnr": psnr,
        "ssim": psnr / 40,
        "splats": cap,
        "bytes": 200 * cap,
        "render_ms": cap / 100,
        "seconds": cap / 50,
        "digest": f"{system} {cap} {seed}",
        "repeat": 0,
        "curve": None,
        **values,
    }


def curve_points(last: float) -> list[dict[str, float]]:
    """Four points of a run that ends at `last` dB."""
    return [{"iteration": n, "seconds": n / 10, "psnr": last - 8 / n, "ssim": 0.5 + n / 500} for n in (1, 4, 20, 100)]


def sweep_records(scene: str = "yard") -> list[Record]:
    """Runs of two systems at three caps, and of a third one at a single cap.

    The second system with n splats is as good as the first one with sqrt(2) n splats.
    """
    runs = [
        run_record("gaussian", cap, psnr, scene=scene, curve=curve_points(psnr))
        for cap, psnr in ((1000, 20.0), (2000, 21.0), (4000, 22.0))
    ]
    runs += [
        run_record("default", cap, psnr, scene=scene, shape="skew-normal", curve=curve_points(psnr))
        for cap, psnr in ((1000, 20.5), (2000, 21.5), (4000, 22.5))
    ]
    return [*runs, run_record("half-gaussian", 1500, 22.45, scene=scene, shape="half-gaussian")]


def length_records(scene: str = "yard") -> list[Record]:
    """Runs of two systems at three lengths.

    The second one takes twice the time of the first and gains 1 dB with each doubling of its length, as the first does.
    With as many iterations it is 1.5 dB ahead, so 0.5 dB in as many seconds. SSIM falls where PSNR rises.
    """
    return [
        run_record(system, 1000, psnr, iterations=n, seconds=seconds * n, scene=scene, shape=shape, ssim=1 - psnr / 40)
        for n, psnr in ((100, 20.0), (200, 21.0), (400, 22.0))
        for system, shape, seconds, psnr in (
            ("gaussian", "gaussian", 0.01, psnr),
            ("default", "skew-normal", 0.02, psnr + 1.5),
        )
    ]


def seed_records() -> list[Record]:
    """Five seeds of two systems, and two repeats of the first one."""
    runs = [
        run_record(system, 500, 20 + seed / 10, seed, scene="attic")
        for system in ("gaussian", "3dgs")
        for seed in range(5)
    ]
    return runs + [record | {"repeat": again} for record in (runs[0], runs[5]) for again in (1, 2)]

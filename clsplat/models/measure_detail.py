"""What levels of detail cost and save: each level as a whole, and images from ever farther away."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..cameras.camera import Camera
from ..evaluation.evaluate import MAX_PSNR
from ..evaluation.metrics import psnr
from ..rendering.renderer import Renderer, RendersSplats
from ..splats.color import Color
from ..splats.splats import Splats
from .detail import DetailLevels, DetailRenderer, farther

DISTANCES = (1, 2, 4, 8, 16)


@dataclass(frozen=True)
class LevelMeasure:
    """One level of the whole model, from the model's cameras.

    Attributes
    ----------
    psnr : mean PSNR of its images against those of the model, at most 100 [dB].
    """

    level: int
    splats: int
    psnr: float


@dataclass(frozen=True)
class DistanceMeasure:
    """Images from cameras that are `factor` times as far from the scene as the model's.

    Attributes
    ----------
    splats : mean number of splats that are drawn. whole : splats of the model.
    ms, whole_ms : median time of an image with levels of detail, and of one of the whole model [ms].
    psnr : mean PSNR against the whole model, at most 100 [dB].
    """

    factor: int
    splats: float
    whole: int
    ms: float
    whole_ms: float
    psnr: float


def measure_levels(
    levels: DetailLevels, cameras: Sequence[Camera], renderer: Renderer, background: Color
) -> Iterator[LevelMeasure]:
    """Yield the measures of each level, the finest first."""
    expected = [renderer.render(levels.splats, camera, background).color for camera in cameras]
    for level in range(len(levels)):
        splats = levels.whole(level)
        found = [renderer.render(splats, camera, background).color for camera in cameras]
        yield LevelMeasure(level, len(splats), _mean_psnr(found, expected))


def measure_distances(
    levels: DetailLevels, pixels: float, cameras: Sequence[Camera], renderer: Renderer, background: Color
) -> Iterator[DistanceMeasure]:
    """Yield the measures of each of DISTANCES. pixels : as of `DetailLevels.choose`."""
    detailed = DetailRenderer(renderer, levels, pixels)
    depths = [renderer.render(levels.splats, camera).median_depth or 1.0 for camera in cameras]
    for factor in DISTANCES:
        images: list[tuple[np.ndarray, np.ndarray]] = []
        times: list[tuple[float, float]] = []
        drawn = []
        for camera, depth in zip(cameras, depths, strict=True):
            far = farther(camera, factor, depth)
            expected, whole_ms = _timed(renderer, levels.splats, background, far)
            found, ms = _timed(detailed, levels.splats, background, far)
            drawn.append(len(levels.seen(far, pixels)))
            images.append((found, expected))
            times.append((ms, whole_ms))
        ms, whole_ms = (statistics.median(column) for column in zip(*times, strict=True))
        quality = _mean_psnr(*zip(*images, strict=True))
        yield DistanceMeasure(factor, statistics.fmean(drawn), len(levels.splats), ms, whole_ms, quality)


def _timed(renderer: RendersSplats, splats: Splats, background: Color, camera: Camera) -> tuple[np.ndarray, float]:
    """Return the image of a camera and its time [ms]; the splats are on the device already."""
    renderer.render(splats, camera, background)
    start = time.perf_counter()
    image = renderer.render(splats, camera, background)
    return image.color, 1e3 * (time.perf_counter() - start)


def _mean_psnr(found: Sequence[np.ndarray], expected: Sequence[np.ndarray]) -> float:
    values = (psnr(np.clip(a, 0, 1), np.clip(b, 0, 1), rounded=False) for a, b in zip(found, expected, strict=True))
    return statistics.fmean(min(value, MAX_PSNR) for value in values)

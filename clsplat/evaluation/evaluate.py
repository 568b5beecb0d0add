"""Evaluation of a model on views: rendering, and metrics against the photos."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..rendering.renderer import Rendered, Renderer
from ..scenes.scene import View
from ..splats.color import BLACK, Color
from ..splats.splats import Splats
from .decoded import decoded
from .metrics import DEFAULT_PROTOCOL, MetricProtocol

MAX_PSNR = 100.0  # replaces the infinite PSNR of equal images, which JSON cannot hold


@dataclass(frozen=True)
class Evaluation:
    """Metrics of views.

    Attributes
    ----------
    psnr, ssim : means over the views; PSNR in dB.
    render_ms : median wall time of a render [ms].
    per_view : metrics by the view's name.
    corrected_psnr : mean PSNR of colour-corrected renders [dB]; None if it was not measured.
    """

    psnr: float
    ssim: float
    render_ms: float
    per_view: dict[str, dict[str, float]] = field(default_factory=dict)
    corrected_psnr: float | None = None


def evaluate(
    renderer: Renderer,
    splats: Splats,
    views: Sequence[View],
    background: Color = BLACK,
    protocol: MetricProtocol = DEFAULT_PROTOCOL,
    on_view: Callable[[View, Rendered], None] | None = None,
    also_corrected: bool = False,
) -> Evaluation:
    """Render every view and compare it with its photo. Photos that are not in memory are decoded one at a time.

    Parameters
    ----------
    views : at least one; pixels that a mask hides do not count.
    on_view : called with each view, its photo in memory, and its render.
    also_corrected : also measure the PSNR of colour-corrected renders (`MetricProtocol.corrected`).

    Warns
    -----
    UserWarning : a photo cannot be decoded; its view is left out.

    Raises
    ------
    InputError : no photo can be decoded.
    """
    per_view: dict[str, dict[str, float]] = {}
    times, corrected = [], []
    renderer.render(splats, views[0].camera, background)  # builds the kernels and uploads the splats
    for view in decoded(views, "measured"):
        start = time.perf_counter()
        image = renderer.render(splats, view.camera, background)
        times.append(1e3 * (time.perf_counter() - start))
        pair = np.clip(image.color, 0, 1), view.image / np.float32(255), view.mask
        per_view[view.name] = {name: _finite(value) for name, value in protocol.measure(*pair).items()}
        if also_corrected:
            corrected.append(_finite(replace(protocol, corrected=True).psnr(*pair)))
        if on_view is not None:
            on_view(view, image)
    means = {key: statistics.fmean(v[key] for v in per_view.values()) for key in ("PSNR", "SSIM")}
    corrected_psnr = statistics.fmean(corrected) if corrected else None
    return Evaluation(means["PSNR"], means["SSIM"], statistics.median(times), per_view, corrected_psnr)


def _finite(value: float) -> float:
    return min(value, MAX_PSNR) if math.isinf(value) else value

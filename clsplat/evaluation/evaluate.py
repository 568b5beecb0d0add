"""Evaluation of a model on views: rendering, and metrics against the photos."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

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
    """

    psnr: float
    ssim: float
    render_ms: float
    per_view: dict[str, dict[str, float]] = field(default_factory=dict)


def evaluate(
    renderer: Renderer,
    splats: Splats,
    views: Sequence[View],
    background: Color = BLACK,
    protocol: MetricProtocol = DEFAULT_PROTOCOL,
    on_view: Callable[[View, Rendered], None] | None = None,
) -> Evaluation:
    """Render every view and compare it with its photo. Photos that are not in memory are decoded one at a time.

    Parameters
    ----------
    views : at least one; pixels that a mask hides do not count.
    on_view : called with each view, its photo in memory, and its render.

    Warns
    -----
    UserWarning : a photo cannot be decoded; its view is left out.

    Raises
    ------
    InputError : no photo can be decoded.
    """
    per_view: dict[str, dict[str, float]] = {}
    times = []
    renderer.render(splats, views[0].camera, background)  # builds the kernels and uploads the splats
    for view in decoded(views, "measured"):
        start = time.perf_counter()
        image = renderer.render(splats, view.camera, background)
        times.append(1e3 * (time.perf_counter() - start))
        measured = protocol.measure(np.clip(image.color, 0, 1), view.image / np.float32(255), view.mask)
        per_view[view.name] = {
            name: min(value, MAX_PSNR) if math.isinf(value) else value for name, value in measured.items()
        }
        if on_view is not None:
            on_view(view, image)
    means = {key: statistics.fmean(v[key] for v in per_view.values()) for key in ("PSNR", "SSIM")}
    return Evaluation(means["PSNR"], means["SSIM"], statistics.median(times), per_view)

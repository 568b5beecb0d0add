"""Measures of floaters: splats that serve a few training views and spoil all others.

Nothing is selected by these measures. The gap of PSNR shows overfitting as a whole. The other two show where it
sits: in splats that too few views determine, and in front of the cameras.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import activity
from ..rendering.renderer import Renderer
from ..scenes.scene import View
from ..splats.color import BLACK, Color
from ..splats.fields import DoubleArray
from ..splats.splats import Splats
from .contributions import Contribution, contributions
from .decoded import decoded
from .evaluate import MAX_PSNR
from .metrics import DEFAULT_PROTOCOL, MetricProtocol

FEW_VIEWS = 3  # one ray does not determine a position, and two leave no third to contradict them
NEAR = 0.1  # of the median depth of a view
_LONGEST = 400  # longest side [px] of the images in which contributions are measured
_PSNR_VIEWS = 20  # largest number of training views for the gap


@dataclass(frozen=True)
class FloaterMeasures:
    """Measures of floaters.

    Attributes
    ----------
    train_psnr : mean PSNR of at most 20 training views, chosen evenly [dB].
    psnr_gap : `train_psnr` less the PSNR of the test views [dB]; None without test views.
    few_views_share : share of the splats that fewer than 3 training views see.
    near_camera_share : share of the blending weight near the cameras, see `measure_floaters`.
    """

    train_psnr: float
    psnr_gap: float | None
    few_views_share: float
    near_camera_share: float

    def to_json(self) -> dict[str, float]:
        """Return the values that are known, as in results.json and log.jsonl."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def describe(self) -> str:
        """Return one line for people."""
        gap = ""
        if self.psnr_gap is not None:
            gap = f", {abs(self.psnr_gap):.2f} dB {'above' if self.psnr_gap >= 0 else 'below'} the test views"
        return (
            f"training views (at most {_PSNR_VIEWS}) {self.train_psnr:.2f} dB{gap}; {self.few_views_share:.1%} of the "
            f"splats are seen by fewer than {FEW_VIEWS} training views; {self.near_camera_share:.2%} of the weight is "
            "near cameras"
        )


def measure_floaters(
    renderer: Renderer,
    splats: Splats,
    views: Sequence[View],
    background: Color = BLACK,
    protocol: MetricProtocol = DEFAULT_PROTOCOL,
    test_psnr: float | None = None,
) -> FloaterMeasures:
    """Measure a model on its training views.

    A splat is seen by a view if it is blended into a pixel that counts. The share near cameras is
    (sum of w_iv over all i, v with z_iv < 0.1 m_v) / (sum of w_iv over all i, v). Here w_iv is the blending weight of
    splat i in view v, summed over pixels, and z_iv is the depth of its centre. Half of the weight of view v is nearer
    than m_v, so the share does not depend on the unit of the scene. Both are measured in images of at most 400 px.

    Parameters
    ----------
    views : the training views, at least one.
    background, protocol : of the PSNR.
    test_psnr : PSNR of the test views by the same protocol [dB].
    """
    train_psnr = mean_psnr(renderer, splats, evenly(views, _PSNR_VIEWS), background, protocol)
    seen, near, total = np.zeros(len(splats), np.int64), 0.0, 0.0
    for number, found in enumerate(contributions(renderer, splats, views, _LONGEST), 1):
        activity.report(f"floaters measured in photo {number} of {len(views)}")
        seen += found.weight > 0
        near += float(found.weight[is_near(found)].sum())
        total += float(found.weight.sum())
    few = float(np.mean(seen < min(FEW_VIEWS, len(views)))) if len(splats) else 0.0
    gap = None if test_psnr is None else train_psnr - test_psnr
    return FloaterMeasures(train_psnr, gap, few, near / total if total else 0.0)


def is_near(found: Contribution) -> NDArray[np.bool_]:
    """Return (N,) whether the centres are nearer than a tenth of the view's median depth."""
    return found.depth < NEAR * median_depth(found.depth, found.weight)


def median_depth(depth: DoubleArray, weight: DoubleArray) -> float:
    """Return the depth up to which half of the weight lies; 0 without weight."""
    order = np.argsort(depth, kind="stable")
    sums = np.cumsum(weight[order])
    if not len(sums) or not sums[-1]:
        return 0.0
    return float(depth[order][np.searchsorted(sums, 0.5 * sums[-1])])


def evenly(views: Sequence[View], count: int) -> list[View]:
    """Return at most `count` views at equal steps, the first and the last among them."""
    if len(views) <= count:
        return list(views)
    return [views[round(place)] for place in np.linspace(0, len(views) - 1, count)]


def mean_psnr(
    renderer: Renderer,
    splats: Splats,
    views: Sequence[View],
    background: Color = BLACK,
    protocol: MetricProtocol = DEFAULT_PROTOCOL,
) -> float:
    """Return the mean PSNR over the views [dB], 100 at most for each."""
    return statistics.fmean(
        min(
            protocol.psnr(
                np.clip(renderer.render(splats, view.camera, background).color, 0, 1),
                view.image / np.float32(255),
                view.mask,
            ),
            MAX_PSNR,
        )
        for view in decoded(views, "measured")
    )

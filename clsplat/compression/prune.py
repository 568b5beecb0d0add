"""Leaving out what images do not miss: whole splats, own fields such as the skew, SH bands.

Each kind of part is ranked by the squared change of the training images per byte saved (importance.py). Bisection on
the ranks finds the threshold at which the validation PSNR falls by the kind's share of the tolerance. The next kind may
use what one kind leaves of its share.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..evaluation.evaluate import MAX_PSNR
from ..evaluation.metrics import psnr
from ..rendering.renderer import Renderer
from ..scenes.scene import View
from ..splats.color import BLACK, Color
from ..splats.fields import Array, DoubleArray, sh_coefficients
from ..splats.ply_compact import bands_in_use, in_use, layout_bytes, plan_layout
from ..splats.splats import Splats
from .importance import Importance, lower_bands, measure_importance

SHARES = {"splats": 0.5, "fields": 0.75, "bands": 1.0}  # of the tolerance, spent once the kind is done
_STEPS = 10  # of a bisection: one in a thousand of the ranks
_INDEX = 1  # words beside those of a sparse row
HEADER_BYTES = 4096  # more than any header of a compact file takes


@dataclass(frozen=True)
class Thresholds:
    """Mean squared change of the images per byte saved, up to which parts go; 0: none goes.

    Parameters
    ----------
    splats, bands : of whole splats, and of SH bands. fields : of own fields, by name.
    """

    splats: float = 0.0
    fields: dict[str, float] = field(default_factory=dict)
    bands: float = 0.0


@dataclass(frozen=True)
class Pruned:
    """A smaller model.

    Attributes
    ----------
    before, after : PSNR on the validation views [dB].
    costs : PSNR lost by kind: "splats", a field's name, "bands".
    thresholds : that were used.
    """

    splats: Splats
    before: float
    after: float
    costs: dict[str, float]
    thresholds: Thresholds


class Validation:
    """PSNR of models on some views, the mean over them [dB]."""

    def __init__(self, renderer: Renderer, views: Sequence[View], background: Color = BLACK) -> None:
        self.renderer, self.views, self.background = renderer, views, background

    def psnr(self, splats: Splats) -> float:
        return statistics.fmean(self.per_view(splats))

    def per_view(self, splats: Splats) -> list[float]:
        """PSNR of each view; 0 of a model without splats."""
        if not len(splats):
            return [0.0] * len(self.views)
        return [
            min(psnr(self.renderer.render(splats, view.camera, self.background).color, view.image), MAX_PSNR)
            for view in self.views
        ]


def prune(
    splats: Splats,
    views: Sequence[View],
    validation: Validation,
    tolerance: float,
    kinds: Sequence[str] = tuple(SHARES),
    seed: int = 0,
) -> Pruned:
    """Leave out as much as the validation views allow.

    Parameters
    ----------
    views : training views, on which needs are measured. validation : of the validation views.
    tolerance : that PSNR on the validation views may fall by [dB]. kinds : any of SHARES, in their order.
    seed : of the signs (see `measure_importance`).

    Raises
    ------
    InputError : no splats, or a tolerance that is negative.
    """
    if not len(splats):
        raise InputError("prune: the model has no splats")
    if not tolerance >= 0:
        raise InputError(f"tolerance {tolerance}: must be at least 0 dB")
    before = now = validation.psnr(splats)
    found, costs = Thresholds(), {}
    if "splats" in kinds:
        scores = splat_scores(
            splats,
            per_pixel(
                measure_importance(validation.renderer, splats, views, validation.background, seed, parts=False), views
            ),
        )
        threshold, splats, after = _farthest(
            scores,
            splats,
            now,
            before - SHARES["splats"] * tolerance,
            partial(without_splats, scores=scores),
            validation,
        )
        found, costs["splats"], now = replace(found, splats=threshold), now - after, after
    if "fields" not in kinds and "bands" not in kinds:
        return Pruned(splats, before, now, costs, found)
    importance = per_pixel(measure_importance(validation.renderer, splats, views, validation.background, seed), views)
    for name, change in importance.fields.items() if "fields" in kinds else ():
        scores = field_scores(splats, name, change)
        threshold, splats, after = _farthest(
            scores,
            splats,
            now,
            before - SHARES["fields"] * tolerance,
            partial(without_field, name=name, scores=scores),
            validation,
        )
        found, costs[name], now = replace(found, fields=found.fields | {name: threshold}), now - after, after
    if "bands" in kinds and splats.sh_degree:
        assert importance.colour is not None
        lower, lost = lower_bands(splats.sh, importance.colour)
        threshold, splats, after = _farthest(
            band_slopes(lost),
            splats,
            now,
            before - SHARES["bands"] * tolerance,
            partial(without_bands, lower=lower, lost=lost),
            validation,
        )
        found, costs["bands"], now = replace(found, bands=threshold), now - after, after
    return Pruned(splats, before, now, costs, found)


def apply_thresholds(
    splats: Splats,
    views: Sequence[View],
    renderer: Renderer,
    thresholds: Thresholds,
    background: Color = BLACK,
    seed: int = 0,
) -> Splats:
    """The model without the fields and bands that thresholds found on another one of its scene leave out."""
    importance = per_pixel(measure_importance(renderer, splats, views, background, seed), views)
    for name, threshold in thresholds.fields.items():
        splats = without_field(splats, threshold, name, field_scores(splats, name, importance.fields[name]))
    if thresholds.bands:
        assert importance.colour is not None
        splats = without_bands(splats, thresholds.bands, *lower_bands(splats.sh, importance.colour))
    return splats


def within_bytes(
    splats: Splats,
    views: Sequence[View],
    renderer: Renderer,
    limit: int,
    background: Color = BLACK,
    seed: int = 0,
) -> Splats | None:
    """The model with as many of its fields and bands as a compact file of at most `limit` bytes holds.

    One threshold holds for both kinds, so that what goes is what changes the views least for its bytes.

    Returns
    -------
    None where even the splats' bare columns do not fit.
    """
    if body_bytes(splats) <= limit - HEADER_BYTES:
        return splats
    importance = per_pixel(measure_importance(renderer, splats, views, background, seed), views)
    assert importance.colour is not None
    lower, lost = lower_bands(splats.sh, importance.colour)
    scores = {name: field_scores(splats, name, change) for name, change in importance.fields.items()}
    every = np.concatenate([band_slopes(lost), *scores.values()])
    ranked = np.unique(every[np.isfinite(every)])
    low, high = -1, len(ranked) - 1
    best = None
    while low < high:
        middle = high if best is None else (low + high) // 2
        candidate = splats
        for name, own in scores.items():
            candidate = without_field(candidate, float(ranked[middle]), name, own)
        candidate = without_bands(candidate, float(ranked[middle]), lower, lost)
        if body_bytes(candidate) <= limit - HEADER_BYTES:
            best, high = candidate, middle
        elif best is None:
            return None
        else:
            low = middle
        if best is not None and high - low == 1:
            break
    return best


def body_bytes(splats: Splats) -> int:
    """Of a compact file, without its header."""
    single = {name: values.astype(np.float32) for name, values in splats.arrays.items()}
    return layout_bytes(splats.schema, plan_layout(splats.schema, single), len(splats))


def per_pixel(importance: Importance, views: Sequence[View]) -> Importance:
    """Means over the pixels and channels of the views, instead of sums: they are of one size in scenes of any size."""
    count = 3 * sum(view.camera.width * view.camera.height for view in views)
    colour = None if importance.colour is None else importance.colour / np.float32(count)
    return Importance(
        importance.removal / count, {name: change / count for name, change in importance.fields.items()}, colour
    )


def splat_scores(splats: Splats, importance: Importance) -> DoubleArray:
    """(N,) change per byte of each splat."""
    width = sum(values[:1].size for values in splats.arrays.values())
    return importance.removal / (4 * width)


def field_scores(splats: Splats, name: str, change: DoubleArray) -> DoubleArray:
    """(N,) change per byte of each splat's field; infinite where it is neutral already."""
    own = splats.schema[name]
    return np.where(in_use(own, splats.arrays[name]), change / (4 * (own.width + _INDEX)), np.inf)


def band_slopes(lost: DoubleArray) -> DoubleArray:
    """(N * degree,) loss per byte of each step of a degree down, from those that any step can have."""
    words = [3 * sh_coefficients(degree) for degree in range(lost.shape[1])]
    return ((lost[:, :-1] - lost[:, 1:]) / (4 * np.diff(words))).ravel()


def without_splats(splats: Splats, threshold: float, scores: DoubleArray) -> Splats:
    """Those whose score is above the threshold."""
    return splats.select(scores > threshold)


def strongest(splats: Splats, scores: DoubleArray, count: int) -> Splats:
    """The `count` splats of the highest scores, in their order."""
    return splats.select(np.sort(np.argsort(-scores, kind="stable")[:count]))


def without_field(splats: Splats, threshold: float, name: str, scores: DoubleArray) -> Splats:
    """A field's neutral value for splats whose score is not above the threshold."""
    own = splats.schema[name]
    arrays = splats.to_numpy()
    arrays[name][scores <= threshold] = own.neutral if own.width > 1 else own.neutral[0]
    return splats.with_arrays(arrays)


def without_bands(splats: Splats, threshold: float, lower: Sequence[Array], lost: DoubleArray) -> Splats:
    """Give each splat the SH degree with the least `lost` + threshold * bytes; `lower`, `lost`: see `lower_bands`."""
    words = np.array([3 * sh_coefficients(degree) for degree in range(lost.shape[1])])
    degrees: NDArray[np.int64] = np.argmin(lost + threshold * 4 * words, axis=1)
    arrays = splats.to_numpy()
    used = bands_in_use(splats.sh)
    for degree, colours in enumerate(lower):
        rows = (degrees == degree) & (used > degree)  # others keep their bits
        arrays["sh"][rows, : colours.shape[1]] = colours[rows]
        arrays["sh"][rows, colours.shape[1] :] = 0.0
    return splats.with_arrays(arrays)


def _farthest(
    scores: DoubleArray,
    splats: Splats,
    now: float,
    floor: float,
    apply: Callable[[Splats, float], Splats],
    validation: Validation,
) -> tuple[float, Splats, float]:
    """The highest threshold, by bisection on the ranks of the scores, that keeps PSNR at the floor or above.

    Returns
    -------
    Threshold, model and its PSNR; (0, `splats`, `now`) where nothing may go.
    """
    ranked = np.unique(scores[np.isfinite(scores)])
    low, high = 0, len(ranked) + 1  # thresholds below ranked[low - 1] are good, from ranked[high - 1] on they are not
    best = (0.0, splats, now)
    for step in range(_STEPS):
        middle = high - 1 if step == 0 else (low + high) // 2  # all of it first: often nothing is missed
        if middle <= low:
            break
        candidate = apply(splats, float(ranked[middle - 1]))
        value = validation.psnr(candidate)
        if value >= floor:
            low, best = middle, (float(ranked[middle - 1]), candidate, value)
        else:
            high = middle
    return best

"""Removal of parts that the images do not need: whole splats, shape-specific fields such as the skew, SH bands.

Each kind of part is ranked by the squared change of the training images per byte saved (importance.py). Bisection on
the ranks finds the threshold at which the validation PSNR falls by the kind's share of the tolerance. The next kind may
use what one kind leaves of its share.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..evaluation.evaluate import MAX_PSNR
from ..evaluation.metrics import psnr
from ..files.json_file import describe_any, is_real
from ..rendering.renderer import Renderer
from ..scenes.read_view import keep_photos
from ..scenes.scene import View
from ..splats.color import BLACK, Color
from ..splats.fields import Array, DoubleArray, sh_coefficients
from ..splats.formats.ply_compact import bands_in_use, in_use, layout_bytes, plan_layout
from ..splats.splats import Splats
from .importance import Importance, lower_bands, measure_importance
from .rules import standard_error

SHARES = {"splats": 0.5, "fields": 0.75, "bands": 1.0}  # of the tolerance, used after each kind
_STEPS = 10  # of a bisection: it resolves a thousandth of the ranks
_INDEX = 1  # words of a sparse row besides its values
HEADER_BYTES = 4096  # above the size of any header of a compact file


@dataclass(frozen=True)
class Thresholds:
    """Largest mean squared change of the images per byte saved at which a part is removed; 0: nothing is removed.

    Parameters
    ----------
    splats, bands : for whole splats, and for SH bands. fields : for shape-specific fields, by name.
    """

    splats: float = 0.0
    fields: dict[str, float] = field(default_factory=dict)
    bands: float = 0.0


@dataclass(frozen=True)
class Pruned:
    """The result of pruning.

    Attributes
    ----------
    splats : the smaller model.
    before, after : PSNR on the validation views [dB].
    costs : loss of PSNR [dB] by kind: "splats", a field's name, "bands".
    thresholds : the thresholds that bisection found.
    """

    splats: Splats
    before: float
    after: float
    costs: dict[str, float]
    thresholds: Thresholds


class Validation:
    """PSNR of models on the validation views. It measures many models, so the photos are in memory."""

    def __init__(self, renderer: Renderer, views: Sequence[View], background: Color = BLACK) -> None:
        self.renderer, self.views, self.background = renderer, views, background
        keep_photos(views)

    def psnr(self, splats: Splats) -> float:
        """Return the mean PSNR over the views [dB]."""
        return statistics.fmean(self.per_view(splats))

    def per_view(self, splats: Splats) -> list[float]:
        """Return the PSNR of the pixels that count, of each view [dB]; 0 for a model without splats."""
        if not len(splats):
            return [0.0] * len(self.views)
        return [
            min(
                psnr(self.renderer.render(splats, view.camera, self.background).color, view.image, mask=view.mask),
                MAX_PSNR,
            )
            for view in self.views
        ]


def check_tolerance(tolerance: float) -> None:
    """Raise InputError unless a tolerance is a number of at least 0 dB."""
    if not is_real(tolerance):
        raise InputError(f"tolerance is {describe_any(tolerance)}; expected a number of dB")
    if not tolerance >= 0:
        raise InputError(f"tolerance {tolerance}: must be at least 0 dB")


def prune(
    splats: Splats,
    views: Sequence[View],
    validation: Validation,
    tolerance: float,
    kinds: Sequence[str] = tuple(SHARES),
    seed: int = 0,
) -> Pruned:
    """Remove as much as the tolerance on the validation views allows.

    A loss counts with its standard error over the views: with few of them, a mean loss may be chance.

    Parameters
    ----------
    views : training views, on which the importance is measured.
    validation : the validation views.
    tolerance : allowed loss of PSNR on the validation views [dB].
    kinds : any of SHARES, in their order.
    seed : seed of the signs (see `measure_importance`).

    Raises
    ------
    InputError : the model has no splats, or the tolerance is negative.
    """
    if not len(splats):
        raise InputError("prune: the model has no splats")
    check_tolerance(tolerance)
    views_before = validation.per_view(splats)

    def surely(candidate: Splats) -> float:
        """Return the PSNR less the standard error of the loss; minus infinity without splats."""
        if not len(candidate):  # no tolerance is worth an empty model
            return -math.inf
        found = validation.per_view(candidate)
        return statistics.fmean(found) - standard_error(views_before, found)

    before = now = statistics.fmean(views_before)
    thresholds, costs = Thresholds(), {}
    if "splats" in kinds:
        scores = splat_scores(
            splats,
            per_pixel(
                measure_importance(validation.renderer, splats, views, validation.background, seed, parts=False), views
            ),
        )
        threshold, splats, _ = highest_threshold(
            scores,
            splats,
            now,
            before - SHARES["splats"] * tolerance,
            partial(without_splats, scores=scores),
            surely,
        )
        after = validation.psnr(splats)
        thresholds, costs["splats"], now = replace(thresholds, splats=threshold), now - after, after
    if "fields" not in kinds and "bands" not in kinds:
        return Pruned(splats, before, now, costs, thresholds)
    importance = per_pixel(measure_importance(validation.renderer, splats, views, validation.background, seed), views)
    for name, change in importance.fields.items() if "fields" in kinds else ():
        scores = field_scores(splats, name, change)
        threshold, splats, _ = highest_threshold(
            scores,
            splats,
            now,
            before - SHARES["fields"] * tolerance,
            partial(without_field, name=name, scores=scores),
            surely,
        )
        after = validation.psnr(splats)
        thresholds, costs[name], now = (
            replace(thresholds, fields=thresholds.fields | {name: threshold}),
            now - after,
            after,
        )
    if "bands" in kinds and splats.sh_degree:
        assert importance.colour is not None
        lower, lost = lower_bands(splats.sh, importance.colour)
        threshold, splats, _ = highest_threshold(
            band_slopes(lost),
            splats,
            now,
            before - SHARES["bands"] * tolerance,
            partial(without_bands, lower=lower, lost=lost),
            surely,
        )
        after = validation.psnr(splats)
        thresholds, costs["bands"], now = replace(thresholds, bands=threshold), now - after, after
    return Pruned(splats, before, now, costs, thresholds)


def apply_thresholds(
    splats: Splats,
    views: Sequence[View],
    renderer: Renderer,
    thresholds: Thresholds,
    background: Color = BLACK,
    seed: int = 0,
) -> Splats:
    """Return the model without the fields and bands below thresholds that were found on another model of its scene."""
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
    """Return the model with the most important fields and bands that fit into a compact file of `limit` bytes.

    One threshold holds for both kinds, so that the removed parts change the views least for their bytes.

    Returns
    -------
    None if even the splats without these parts do not fit.
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
        for name, values in scores.items():
            candidate = without_field(candidate, float(ranked[middle]), name, values)
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
    """Return the size of a compact file without its header."""
    single = {name: values.astype(np.float32) for name, values in splats.arrays.items()}
    return layout_bytes(splats.schema, plan_layout(splats.schema, single), len(splats))


def per_pixel(importance: Importance, views: Sequence[View]) -> Importance:
    """Divide the sums by the pixels and channels of the views, so that thresholds hold for scenes of any size."""
    count = 3 * sum(view.camera.width * view.camera.height for view in views)
    colour = None if importance.colour is None else importance.colour / np.float32(count)
    return Importance(
        importance.removal / count, {name: change / count for name, change in importance.fields.items()}, colour
    )


def splat_scores(splats: Splats, importance: Importance) -> DoubleArray:
    """Return the change per byte of each splat, (N,)."""
    width = sum(values[:1].size for values in splats.arrays.values())
    return importance.removal / (4 * width)


def field_scores(splats: Splats, name: str, change: DoubleArray) -> DoubleArray:
    """Return the change per byte of each splat's field, (N,); infinite if the field is neutral already."""
    spec = splats.schema[name]
    return np.where(in_use(spec, splats.arrays[name]), change / (4 * (spec.width + _INDEX)), np.inf)


def band_slopes(lost: DoubleArray) -> DoubleArray:
    """Return the loss per byte of each step to the next lower degree, (N * degree,)."""
    words = [3 * sh_coefficients(degree) for degree in range(lost.shape[1])]
    return ((lost[:, :-1] - lost[:, 1:]) / (4 * np.diff(words))).ravel()


def without_splats(splats: Splats, threshold: float, scores: DoubleArray) -> Splats:
    """Return the splats whose score is above the threshold."""
    return splats.select(scores > threshold)


def strongest(splats: Splats, scores: DoubleArray, count: int) -> Splats:
    """Return the `count` splats with the highest scores, in the order of the model."""
    return splats.select(np.sort(np.argsort(-scores, kind="stable")[:count]))


def without_field(splats: Splats, threshold: float, name: str, scores: DoubleArray) -> Splats:
    """Return the splats with the neutral value of a field if their score is not above the threshold."""
    neutral = splats.schema[name].neutral
    arrays = splats.to_numpy()
    arrays[name][scores <= threshold] = neutral if len(neutral) > 1 else neutral[0]
    return splats.with_arrays(arrays)


def without_bands(splats: Splats, threshold: float, lower: Sequence[Array], lost: DoubleArray) -> Splats:
    """Give each splat the SH degree with the least `lost` + threshold * bytes; `lower`, `lost`: see `lower_bands`."""
    words = np.array([3 * sh_coefficients(degree) for degree in range(lost.shape[1])])
    degrees: NDArray[np.int64] = np.argmin(lost + threshold * 4 * words, axis=1)
    arrays = splats.to_numpy()
    used = bands_in_use(splats.sh)
    for degree, colours in enumerate(lower):
        rows = (degrees == degree) & (used > degree)  # all other splats keep their bits
        arrays["sh"][rows, : colours.shape[1]] = colours[rows]
        arrays["sh"][rows, colours.shape[1] :] = 0.0
    return splats.with_arrays(arrays)


def highest_threshold(
    scores: DoubleArray,
    splats: Splats,
    now: float,
    floor: float,
    apply: Callable[[Splats, float], Splats],
    psnr_of: Callable[[Splats], float],
) -> tuple[float, Splats, float]:
    """Find the highest threshold that keeps the PSNR at the floor or above, by bisection on the ranks of the scores.

    Parameters
    ----------
    scores : infinite for what must stay. now : PSNR of `splats` [dB]. floor : smallest allowed PSNR [dB].
    apply : returns the model without what is not above a threshold. psnr_of : returns the PSNR of a model [dB].

    Returns
    -------
    Threshold, model and its PSNR; (0, `splats`, `now`) if nothing can be removed.
    """
    ranked = np.unique(scores[np.isfinite(scores)])
    # Thresholds up to ranked[low - 1] are good; those from ranked[high - 1] on are not.
    low, high = 0, len(ranked) + 1
    best = (0.0, splats, now)
    for step in range(_STEPS):
        middle = high - 1 if step == 0 else (low + high) // 2  # often everything can be removed
        if middle <= low:
            break
        candidate = apply(splats, float(ranked[middle - 1]))
        value = psnr_of(candidate)
        if value >= floor:
            low, best = middle, (float(ranked[middle - 1]), candidate, value)
        else:
            high = middle
    return best

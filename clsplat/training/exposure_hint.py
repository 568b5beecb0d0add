"""A hint for photos whose exposures differ much: one model cannot show them all, unless it learns their exposures."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cameras.seen import sampled, sampled_views, seen
from ..scenes.colmap import Points
from ..splats.color import SPREAD
from ..splats.fields import DoubleArray

if TYPE_CHECKING:
    from ..scenes.scene import Scene
    from ..scenes.view import View
    from .config import TrainConfig

LARGE_SPREAD = 0.6  # stops; captures with one exposure have 0.1 to 0.5
_SMALL_SPREAD = 0.35  # stops; a smaller spread costs little
_UNEXPLAINED = 0.82  # of the differences between photos; reflections and what hides points leave more
_UNUSUAL, _FEW = 1.5, 0.25  # stops from the median, and the largest share of such photos
_FEWEST_TO_FIT = 12  # photos: with fewer, most points are in so few that exposures explain anything
_ROUNDS = 5  # of the fit; further ones change it by less than a hundredth
_GAMMA = 2.2  # of photos: stops are factors of light, not of pixels
_DARK, _BRIGHT = 8, 247  # pixels outside have lost their brightness
_FEWEST_POINTS, _FEWEST_PHOTOS = 20, 4  # points in a photo, and photos with as many


def exposure_hint(scene: Scene, config: TrainConfig) -> str | None:
    """Return a sentence if the exposures of the training photos differ much, and the run does not learn them."""
    if config.appearance.exposure:
        return None
    spread = exposure_spread(scene.train, scene.points)
    if spread is None or spread < _SMALL_SPREAD:
        return None
    if spread < LARGE_SPREAD and unexplained_share(scene.train, scene.points) > _UNEXPLAINED:
        return None
    return f"the photos differ in exposure (by {spread:.1f} stops from their mean): the option exposure learns them"


def exposure_spread(views: Sequence[View], points: Points) -> float | None:
    """Return the standard deviation of the photos' exposures [stops]; None if too few photos show enough points.

    The result is that of the channel that differs most: casts of colour are exposures, too.
    """
    stops = photo_stops(sampled_views(views), points)
    stops = stops[np.isfinite(stops).all(axis=1)]
    return float(np.std(stops, axis=0).max()) if len(stops) >= _FEWEST_PHOTOS else None


def usual_exposures(views: Sequence[View], points: Points) -> NDArray[np.bool_]:
    """Return which photos have about the exposure of most, (V,).

    All have if more than a quarter would not. So has a photo whose exposure the points do not tell.
    """
    stops = photo_stops(views, points)
    known, usual = np.isfinite(stops).all(axis=1), np.ones(len(views), np.bool_)
    usual[np.isinf(stops).any(axis=1)] = False
    if known.any():
        usual[known] = (np.abs(stops[known] - np.median(stops[known], axis=0)) <= _UNUSUAL).all(axis=1)
    return usual if np.count_nonzero(~usual) <= _FEW * len(views) else np.ones_like(usual)


def photo_stops(views: Sequence[View], points: Points) -> DoubleArray:
    """Return the exposures of photos against the colours of the points [stops], (V, 3).

    A photo's exposure is the median factor between its pixels at the points and the points' own colours, in each
    channel. It is infinite if most of these pixels are black or white, so that too few are left. It is NaN if the photo
    shows too few points, or if all points have one colour.
    """
    stops: DoubleArray = np.full((len(views), 3), np.nan)
    if not len(points) or np.ptp(points.rgb.astype(int), axis=0).max() <= SPREAD:
        return stops  # points without colours say nothing about the photos
    xyz, colors = sampled(points.xyz), sampled(points.rgb.astype(np.float64))
    for number, view in enumerate(views):
        inside, shown = _pixels(view, xyz)
        known = colors[inside]
        coloured = ((known > _DARK) & (known < _BRIGHT)).all(axis=1)
        sound = coloured & ((shown > _DARK) & (shown < _BRIGHT)).all(axis=1)
        n_coloured, n_sound = int(np.count_nonzero(coloured)), int(np.count_nonzero(sound))
        if n_sound >= _FEWEST_POINTS:
            stops[number] = _GAMMA * np.median(np.log2(shown[sound] / known[sound]), axis=0)
        elif n_coloured >= max(_FEWEST_POINTS, 2 * n_sound):
            stops[number] = np.inf
    return stops


def unexplained_share(views: Sequence[View], points: Points) -> float:
    """Return the part of the differences between photos of one point that exposures do not explain; 1 for few photos.

    Photos differ also by reflections, and by what hides a point. A logarithm of a pixel is fitted as that of its point
    plus the exposure of its photo, by medians in turn (Tukey's median polish). The result is the median difference from
    the fit, by that from the medians of the points alone. Channels are added.
    """
    if len(views) < _FEWEST_TO_FIT:
        return 1.0
    xyz, some = sampled(points.xyz), sampled_views(views)
    stops: DoubleArray = np.full((len(some), len(xyz), 3), np.nan)
    for number, view in enumerate(some):
        inside, shown = _pixels(view, xyz)
        sound = ((shown > _DARK) & (shown < _BRIGHT)).all(axis=1)
        stops[number, np.flatnonzero(inside)[sound]] = np.log2(shown[sound])
    stops = stops[:, np.count_nonzero(~np.isnan(stops[:, :, 0]), axis=0) > 1]
    stops = stops[np.count_nonzero(~np.isnan(stops[:, :, 0]), axis=1) >= _FEWEST_POINTS]
    if not stops.size:
        return 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a point may be left without photos
        before = _median_difference(stops)
        for _ in range(_ROUNDS):
            stops = stops - np.nanmedian(stops - np.nanmedian(stops, axis=0), axis=1, keepdims=True)
        after = _median_difference(stops)
    return after / before if before else 1.0


def _pixels(view: View, xyz: DoubleArray) -> tuple[NDArray[np.bool_], DoubleArray]:
    """Return whether points (P, 3) are in a photo, (P,), and the pixels where those are, (N, 3)."""
    found = seen(view.camera, xyz)
    return found.inside, np.asarray(view.loaded().image)[found.rows_and_columns].astype(np.float64)


def _median_difference(stops: DoubleArray) -> float:
    """Return the median difference of values (V, P, 3) from the median of their point, added over the channels."""
    return float(np.nanmedian(np.abs(stops - np.nanmedian(stops, axis=0)), axis=(0, 1)).sum())

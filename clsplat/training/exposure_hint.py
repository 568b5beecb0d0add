"""A hint for photos whose exposures differ much: one model cannot show them all, unless it learns their exposures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..cameras.seen import sampled, sampled_views, seen
from ..scenes.colmap import Points
from ..splats.color import SPREAD

if TYPE_CHECKING:
    from ..scenes.scene import Scene
    from ..scenes.view import View
    from .config import TrainConfig

LARGE_SPREAD = 0.6  # stops; captures with one exposure have 0.1 to 0.5
_GAMMA = 2.2  # of photos: stops are factors of light, not of pixels
_DARK, _BRIGHT = 8, 247  # pixels outside have lost their brightness
_FEWEST_POINTS, _FEWEST_PHOTOS = 20, 4  # points in a photo, and photos with as many


def exposure_hint(scene: Scene, config: TrainConfig) -> str | None:
    """Return a sentence if the exposures of the training photos differ much, and the run does not learn them."""
    if config.appearance.exposure:
        return None
    spread = exposure_spread(scene.train, scene.points)
    if spread is None or spread < LARGE_SPREAD:
        return None
    return f"the photos differ in exposure (by {spread:.1f} stops from their mean): the option exposure learns them"


def exposure_spread(views: Sequence[View], points: Points) -> float | None:
    """Return the standard deviation of the photos' exposures [stops]; None if too few photos show enough points.

    A photo's exposure is the median factor between its pixels at the points and the points' own colours, in each
    channel. The result is that of the channel that differs most: casts of colour are exposures, too.
    """
    if len(points) and np.ptp(points.rgb.astype(int), axis=0).max() <= SPREAD:
        return None  # points without colours say nothing about the photos
    xyz, colors = sampled(points.xyz), sampled(points.rgb.astype(np.float64))
    stops = []
    for view in sampled_views(views):
        found = seen(view.camera, xyz)
        shown = np.asarray(view.loaded().image)[found.rows_and_columns].astype(np.float64)
        known = colors[found.inside]
        sound = ((np.minimum(shown, known) > _DARK) & (np.maximum(shown, known) < _BRIGHT)).all(axis=1)
        if np.count_nonzero(sound) >= _FEWEST_POINTS:
            stops.append(_GAMMA * np.median(np.log2(shown[sound] / known[sound]), axis=0))
    return float(np.std(stops, axis=0).max()) if len(stops) >= _FEWEST_PHOTOS else None

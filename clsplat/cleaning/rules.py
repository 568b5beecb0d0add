"""Rules that name candidates for removal, by the splats alone or by what the training views show of them.

A rule is a guess: a large splat may be the sky, and a lonely one a lamp. With training views, clean.py therefore keeps
what the photos need.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..cameras.seen import seen
from ..evaluation.contributions import contributions
from ..evaluation.decoded import decoded
from ..evaluation.floaters import is_near
from ..rendering.build import ALPHA_MIN
from ..rendering.renderer import Renderer
from ..scenes.scene import View
from ..splats.fields import scale_of
from ..splats.shapes import shape_named
from ..splats.splats import Splats

Mask = NDArray[np.bool_]

# What a rule removes.
DESCRIPTIONS = {
    "faint": "opacity below 1/255: no image shows them",
    "unseen": "no training view shows them",
    "few views": "too few training views see them, and these little",
    "near cameras": "most of their weight is close to cameras",
    "oversized": "longer than the scene",
    "isolated": "far from all others",
    "outside": "on transparent parts of photos",
}
FREE = ("faint", "unseen")  # rules whose candidates no training view shows

_NEIGHBOURS = 8
_DEVIATIONS = 4.0  # robust standard deviations of the logarithm of the distance
_NORMAL_MAD = 1.4826  # standard deviation over median absolute deviation of a normal distribution
_REACH = 3.0  # standard deviations of a splat that still touch a neighbour
_INNER_SHARE = 0.9  # of the splats, whose distance from the middle is the extent without cameras
_MARGIN = 0.015  # of the longest side of a photo: edges of an object are blurred, and splats have a width
_OUTSIDE_VIEWS = 2  # views that must agree: one may have a wrong pose or matte


def candidates_without_views(splats: Splats, extent: float | None = None) -> dict[str, Mask]:
    """Return the candidates of the rules that need no photos, (N,) each, by the name of the rule.

    Parameters
    ----------
    extent : size of the scene [world units]; None for the distance from the middle that holds 90 % of the splats.
    """
    return {
        "faint": is_faint(splats),
        "oversized": is_oversized(splats, inner_extent(splats) if extent is None else extent),
        "isolated": is_isolated(splats),
    }


def candidates_of_views(splats: Splats, views: Sequence[View], renderer: Renderer, min_views: int) -> dict[str, Mask]:
    """Return the candidates of the rules that need photos, (N,) each, by the name of the rule.

    Parameters
    ----------
    views : the training views.
    min_views : splats that fewer views see are candidates if their weight is below the median.
    """
    n = len(splats)
    weight, near, seen = np.zeros(n), np.zeros(n), np.zeros(n, np.int64)
    for found in contributions(renderer, splats, views):
        weight += found.weight
        near += np.where(is_near(found), found.weight, 0.0)
        seen += found.weight > 0
    light = weight <= np.median(weight[seen > 0]) if seen.any() else np.ones(n, np.bool_)
    masks = {
        "unseen": seen == 0,
        "few views": (seen > 0) & (seen < min(min_views, len(views))) & light,
        "near cameras": near > 0.5 * weight,
    }
    outside = is_outside(splats, views)
    return masks if outside is None else masks | {"outside": outside}


def is_faint(splats: Splats) -> Mask:
    """Return (N,) whether no pixel can show a splat, because its largest opacity is below the cutoff of blending.

    Other normalisations than that of the peak may raise alpha above the opacity; no splat is then faint.
    """
    shape = shape_named(splats.shape)
    if shape.normalised and splats.normalisation != "peak":
        return np.zeros(len(splats), np.bool_)
    faint: Mask = shape.strength(splats.arrays) < ALPHA_MIN
    return faint


def is_oversized(splats: Splats, extent: float) -> Mask:
    """Return (N,) whether the largest standard deviation exceeds the extent [world units]; none do if that is 0."""
    oversized: Mask = splats.log_scale.max(axis=1, initial=-np.inf) > np.log(extent if extent > 0 else np.inf)
    return oversized


def inner_extent(splats: Splats) -> float:
    """Return the distance from the median position within which 90 % of the centres lie [world units]."""
    if not len(splats):
        return 0.0
    mean = splats.mean.astype(np.float64)
    return float(np.quantile(np.linalg.norm(mean - np.median(mean, axis=0), axis=1), _INNER_SHARE))


def is_isolated(splats: Splats) -> Mask:
    """Return (N,) whether the 8 nearest splats are unusually far, and beyond 3 standard deviations of the splat.

    This is the statistical removal of outliers (Rusu et al. 2008, "Towards 3D point cloud based object maps").
    Densities of a scene span orders of magnitude, so the logarithm of the mean distance is compared. Its limit is the
    median plus 4 robust standard deviations.
    """
    from scipy.spatial import cKDTree  # lazy: a slow import

    n = len(splats)
    if n <= _NEIGHBOURS:
        return np.zeros(n, np.bool_)
    mean = splats.mean.astype(np.float64)
    found, _ = cKDTree(mean).query(mean, k=_NEIGHBOURS + 1, workers=-1)
    distance = np.asarray(found)[:, 1:].mean(axis=1)
    log = np.log(np.maximum(distance, np.finfo(np.float64).tiny))
    middle = float(np.median(log))
    limit = middle + _DEVIATIONS * _NORMAL_MAD * float(np.median(np.abs(log - middle)))
    isolated: Mask = (log > limit) & (distance > _REACH * scale_of(splats.log_scale).max(axis=1))
    return isolated


def is_outside(splats: Splats, views: Sequence[View]) -> Mask | None:
    """Return (N,) whether the centre is outside the visual hull (Laurentini 1994) of photos with transparency.

    At least two views must see the centre where their photo is wholly transparent, with a margin of 1.5 % of its size.
    A splat in the background's colour is there without a trace in these photos, and covers the object in others. None
    if no photo has transparency.
    """
    from scipy.ndimage import maximum_filter1d  # lazy: a slow import

    outside, found = np.zeros(len(splats), np.int64), False
    mean = splats.mean.astype(np.float64)
    for view in decoded(views, "looked at"):
        if view.alpha is None:
            continue
        camera, widened, found = view.camera, view.alpha, True
        found_at = seen(camera, mean)
        size = 2 * max(round(_MARGIN * max(camera.width, camera.height)), 1) + 1
        for axis in (0, 1):
            widened = maximum_filter1d(widened, size, axis=axis, mode="constant")
        outside[found_at.inside] += widened[found_at.rows_and_columns] == 0
    return outside >= min(_OUTSIDE_VIEWS, len(views)) if found else None

"""Photos that disagree with all others, because their poses or contents are wrong. The rest of a run leaves them out.

A photo with a wrong pose teaches splats to stand where the other photos see nothing. Most photos agree with each other,
so that their renders soon resemble them. A photo counts as an outlier if its render does not resemble it at all, by
measures that are relative to the other photos: the scene and the stage of the run do not matter. In outdoor scenes,
photos differ much. There an outlier stands out from those that look at the same place: a hard place is hard for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..cameras.neighbours import nearest_cameras
from ..rendering.renderer import Renderer
from ..scenes.scene import View
from ..splats.color import Color
from ..splats.splats import Splats
from .config import TrainConfig
from .view_sampler import ViewSampler

# Parts of the run, the most useful one first. Later, hard photos stand out, because all others fit so well.
CHECKS = (0.2, 0.3, 0.1)
MOST_WORK = 0.06  # part of the run's work that checks may take
COST = 1 / 3  # of a small render and its comparison, in iterations
LONGEST = 200  # longest side of the images [px]
FEWEST_VIEWS = 10  # of fewer photos, each may be the only one of its place
MOST = 0.25  # part of the photos that may be outliers; if it is more, nothing says which photos are right
UNLIKE = 6.0  # times the usual lack of correlation, and at least
LEAST_UNLIKE = 0.15
UNUSUAL = 4.5  # times the usual deviation from it, as a factor
UNLIKE_NEAR = 4.0  # times the lack of the photos from nearby, which is enough where photos differ much
NEAR = 4  # photos from nearby; their median counts
_TINY = 1e-6  # lack of correlation of a perfect render
_NAMED = 3  # views that the message names
ERROR = 4.0  # times the usual squared error. A photo of a plain wall may lack correlation, but has a small error


class Likeness(NamedTuple):
    """How a render differs from its photo: 1 - correlation of the brightness, 0 to 2, and its mean squared error."""

    unlike: float
    error: float


class OutlierCheck:
    """The checks of a run: when they are due, and which views they leave out.

    Parameters
    ----------
    views : the training views. sampler : leaves views out.
    """

    def __init__(self, config: TrainConfig, views: Sequence[View], renderer: Renderer, sampler: ViewSampler) -> None:
        self.views, self.renderer, self.sampler = views, renderer, sampler
        self.background, self.is_new = config.background, False
        is_on = config.views.outlier_check and len(views) >= FEWEST_VIEWS
        affordable = int(MOST_WORK * config.iterations / (COST * len(views))) if is_on else 0
        self.due = {round(part * config.iterations) for part in CHECKS[:affordable]}
        cameras = [view.camera for view in views] if self.due else []
        self.near = nearest_cameras(cameras, NEAR)

    def is_due(self, iteration: int) -> bool:
        """Whether a check follows this iteration."""
        return iteration in self.due

    def look(self, splats: Splats) -> None:
        """Leave the outliers out of the rest of the run."""
        measured = [likeness(self.renderer, splats, view, self.background) for view in self.views]
        found = outliers(measured, self.near)
        self.is_new, self.sampler.left_out = found != self.sampler.left_out, found

    @property
    def left_out(self) -> list[str]:
        """Names of the views that are left out at present."""
        return [self.views[index].name for index in sorted(self.sampler.left_out)]

    @property
    def message(self) -> str:
        """A sentence that names the views that are left out; empty if the last check changed nothing."""
        names = self.left_out
        if not self.is_new:
            return ""
        if not names:
            return "no photo disagrees with all others any more: the run goes on with all of them"
        some = ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
        return (
            f"{len(names)} of {len(self.views)} photos disagree with all others, as with wrong poses: {some}; the run "
            "goes on without them (outlier_check=False keeps them)"
        )


def likeness(renderer: Renderer, splats: Splats, view: View, background: Color) -> Likeness:
    """Return how the render of a view differs from its photo, where the photo shows something."""
    camera = view.camera.at_most(LONGEST)
    small = view.resized(camera.width, camera.height)
    counted = np.ones(small.image.shape[:2], np.bool_) if small.mask is None else small.mask
    if small.alpha is not None:
        counted = counted & (small.alpha > 0)
    if not counted.any():
        return Likeness(0.0, 0.0)
    render = np.clip(renderer.render(splats, camera, background=background).color, 0.0, 1.0)
    photo, shown = (image[counted].mean(axis=1, dtype=np.float64) for image in (small.image / 255.0, render))
    error = float(np.mean((photo - shown) ** 2))
    photo, shown = photo - photo.mean(), shown - shown.mean()
    size = float(np.sqrt((photo**2).sum() * (shown**2).sum()))
    return Likeness(1.0 - float((photo * shown).sum()) / size if size else 1.0, error)


def outliers(measured: Sequence[Likeness], near: NDArray[np.int64]) -> frozenset[int]:
    """Return the indices of outliers; none if there are too many of them.

    Parameters
    ----------
    measured : of all N photos.
    near : (N, K) indices of the photos from nearby.
    """
    unlike, error = np.array(measured).T
    usual = float(np.median(unlike)), float(np.median(error))
    factor = np.log(np.maximum(unlike, _TINY) / max(usual[0], _TINY))
    spread = float(np.median(np.abs(factor)))
    stands_out = (factor > UNUSUAL * spread) | (unlike > UNLIKE_NEAR * np.median(unlike[near], axis=1))
    found = (unlike > max(UNLIKE * usual[0], LEAST_UNLIKE)) & (error > ERROR * usual[1]) & stands_out
    return frozenset(np.flatnonzero(found).tolist()) if found.mean() <= MOST else frozenset()

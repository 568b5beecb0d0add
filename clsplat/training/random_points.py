"""Random points where the cameras of a scene look, for scenes without points.

If the photos are transparent around an object, the points are in its visual hull (silhouettes.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..cameras.orbits import in_one_place, where_axes_meet
from ..cameras.seen import seen
from ..scenes.extent import together
from ..splats.fields import DoubleArray
from .silhouettes import TRANSPARENT_SHARE, Silhouettes, transparent_share

if TYPE_CHECKING:
    from ..cameras.camera import Camera
    from ..scenes.scene import Scene

SEEN_BY = 2  # smallest number of cameras that see a point: one camera alone does not determine its place
CENTRAL_SHARE = 0.75  # half of the points are in the region that this share of the cameras sees, if it exists
HULL_SHARE = 0.25  # share of the cameras that see a point of the visual hull: cones that few cameras see are empty
OBJECT_SHARE = 0.5  # the same around an object: below it, only cones reach out of the photos
_FEWEST = 0.01  # of the points: if fewer are found in the visual hull, the silhouettes contradict each other
_BOX_POINTS = 4096  # points of the hull that are enough to know its box
_BOX_MARGIN = 0.1  # of the box's sides, for what these points do not reach
_DEEPEST = 3.0  # largest depth of these points, in median distances of the cameras
_FARTHEST = 9.0  # largest distance from the centre, in median distances of the cameras
_AHEAD = 3.0  # distance of the centre in front of parallel cameras, in scene extents
_SPREAD_SHARE = 0.5  # of the points: if fewer are found in the whole contracted space, the hull is that of an object
_SMALLEST_BALL = 1e-4  # of the median distance of the cameras, in which the region that most cameras see is looked for
_BALL_MARGIN = 1.5  # on the distance of the points that were found there
_DRAWS = 16  # number of draws of `count` points; points that cameras see are kept
_HULL_DRAWS = 64  # the same in the box around the visual hull: thin objects fill little of it
_TESTED_CAMERAS = 32  # cameras that the points are tested against


class RandomPoints(NamedTuple):
    """Random points (P, 3), their colours (P, 3) if the photos show them, and words for the places where they are."""

    xyz: DoubleArray
    rgb: NDArray[np.uint8] | None
    where: str


def random_points(scene: Scene, count: int, rng: np.random.Generator) -> RandomPoints:
    """Return random points of a scene.

    Around an object in transparent photos, there are at most `count` points, uniform in its visual hull. Else there are
    `count` points. Half of them are where most cameras look, the others where at least two cameras look.
    """
    sight = _Sight(scene)
    if transparent_share(scene.train) >= TRANSPARENT_SHARE:
        silhouettes = Silhouettes(scene.train)
        xyz = _in_hull(sight, silhouettes, count, rng)
        if len(xyz) > _FEWEST * count:
            return RandomPoints(xyz, silhouettes.colors(xyz), "inside the silhouettes of the photos")
    return RandomPoints(_in_sight(sight, count, rng), None, "where the cameras look")


class _Sight:
    """Cameras of a scene, and a contracted space around the point nearest to their axes.

    The space is that of Mip-NeRF 360 (Barron et al. 2022, eq. 10). Its unit is the median distance of the cameras, so
    far points are rare.
    """

    def __init__(self, scene: Scene) -> None:
        cameras = together([view.camera for view in scene.train])
        self.cameras = cameras[:: -(-len(cameras) // _TESTED_CAMERAS)]
        centres = np.array([camera.position for camera in cameras])
        self.middle = _middle(self.cameras, scene.extent)
        unit = float(np.median(np.linalg.norm(centres - self.middle, axis=1)))
        self.unit = unit if unit > 0 and not in_one_place(centres) else 1.0
        self.min_cameras = min(SEEN_BY, len(self.cameras))

    def draw(self, count: int, rng: np.random.Generator) -> DoubleArray:
        """Return (count, 3) points that are uniform in the contracted space."""
        return self.middle + self.unit * _uncontracted(count, rng)

    def distances(self, xyz: DoubleArray) -> DoubleArray:
        """Return the distances of points from the middle, (P,)."""
        return np.asarray(np.linalg.norm(xyz - self.middle, axis=1))

    def cameras_seeing(self, xyz: DoubleArray) -> NDArray[np.int64]:
        """Return the number of cameras that see each point, (P,)."""
        return np.asarray(np.sum([seen(camera, xyz).inside for camera in self.cameras], axis=0), np.int64)


def _in_hull(sight: _Sight, silhouettes: Silhouettes, count: int, rng: np.random.Generator) -> DoubleArray:
    """Return at most `count` points that are in the visual hull and that many cameras see.

    An object nearer than the cameras gets uniform points in the box around it. What reaches farther, such as a
    landscape without its sky, gets points of the contracted space. The hull of few photos reaches farther, too, behind
    the object, but fills little of that space. Such an object gets points in the box around the near part of the hull.
    """

    def seen_by(share: float, drawn: DoubleArray) -> DoubleArray:
        return drawn[sight.cameras_seeing(drawn) >= max(sight.min_cameras, share * len(sight.cameras))]

    def gather(draw: Callable[[], DoubleArray], enough: int, draws: int, share: float = HULL_SHARE) -> DoubleArray:
        points = np.zeros((0, 3))
        for _ in range(draws):
            drawn = draw()
            drawn = drawn[silhouettes.admit(drawn)]  # first, because it soon leaves few points
            points = np.concatenate([points, seen_by(share, drawn)])
            if len(points) >= enough:
                break
        return points[:enough]

    found = gather(lambda: silhouettes.draw(_BOX_POINTS, _DEEPEST * sight.unit, rng), _BOX_POINTS, _DRAWS)
    if not len(found):
        return found
    near = found[sight.distances(found) <= sight.unit]
    if len(near) < len(found):
        spread = gather(lambda: sight.draw(count, rng), count, _DRAWS)
        if len(spread) >= _SPREAD_SHARE * count or 2 * len(near) < len(found):
            return spread
    central = seen_by(OBJECT_SHARE, near)
    if len(central) >= _FEWEST * len(near):
        near, share = central, OBJECT_SHARE
    else:
        share = HULL_SHARE
    low, high = near.min(axis=0), near.max(axis=0)
    margin = _BOX_MARGIN * (high - low)
    return gather(lambda: rng.uniform(low - margin, high + margin, (count, 3)), count, _HULL_DRAWS, share)


def _in_sight(sight: _Sight, count: int, rng: np.random.Generator) -> DoubleArray:
    """Return (count, 3) points: half of them where most cameras look, the others where at least two cameras look."""
    min_central, half = max(sight.min_cameras, CENTRAL_SHARE * len(sight.cameras)), count // 2
    central, outer, unseen = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3))
    for _ in range(_DRAWS):
        drawn = sight.draw(count, rng)
        n_seeing = sight.cameras_seeing(drawn)
        is_central = n_seeing >= min_central
        central = np.concatenate([central, drawn[is_central]])
        outer = np.concatenate([outer, drawn[(n_seeing >= sight.min_cameras) & ~is_central]])
        unseen = drawn[n_seeing < sight.min_cameras]
        if len(outer) >= count - half:
            break
    reach, ball = float(sight.distances(central).max(initial=0.0)), sight.unit
    while reach == 0.0 and ball > _SMALLEST_BALL * sight.unit:  # long lenses show a small part of the space
        ball *= 0.5
        drawn = sight.middle + ball * _in_ball(count, rng)
        central = drawn[sight.cameras_seeing(drawn) >= min_central]
        reach = _BALL_MARGIN * float(sight.distances(central).max(initial=0.0))
    for _ in range(_DRAWS if reach > 0 else 0):  # the central region is often a small part of the visible space
        if len(central) >= half:
            break
        drawn = sight.middle + reach * _in_ball(count, rng)
        central = np.concatenate([central, drawn[sight.cameras_seeing(drawn) >= min_central]])
    half = min(half, len(central))
    return np.concatenate([central[:half], outer[: count - half], central[half:], unseen])[:count]


def _middle(cameras: Sequence[Camera], extent: float) -> DoubleArray:
    """Return the point nearest to all optical axes, or a point in front of parallel cameras."""
    nearest = where_axes_meet(cameras)
    if nearest is not None:
        return nearest
    centre = np.mean([camera.position for camera in cameras], axis=0)
    return np.asarray(centre + _AHEAD * extent * np.mean([camera.rotation[2] for camera in cameras], axis=0))


def _uncontracted(count: int, rng: np.random.Generator) -> DoubleArray:
    """Return (count, 3) points that are uniform in the contracted ball of radius 2."""
    ball = 2.0 * _in_ball(count, rng)
    radius = np.linalg.norm(ball, axis=1, keepdims=True)
    short = np.minimum(radius, 2.0 - 1.0 / _FARTHEST)
    return np.asarray(ball / radius * np.where(short > 1.0, 1.0 / (2.0 - short), short))


def _in_ball(count: int, rng: np.random.Generator) -> DoubleArray:
    """Return (count, 3) points that are uniform in the unit ball."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(direction * rng.uniform(size=(count, 1)) ** (1 / 3))

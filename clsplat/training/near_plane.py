"""The near plane of a training run, and whether a scene is behind it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..cameras.seen import sampled, seen
from ..errors import InputError, Remedy
from ..splats.fields import DoubleArray

if TYPE_CHECKING:
    from ..scenes.scene import Scene

FARTHEST = 0.2  # world units, as in 3DGS
EXTENT_SHARE = 1 / 20  # of the extent: 3DGS's scenes have extents of 4 and more
DEPTH_SHARE = 0.5  # of the depth up to which NEAREST_SHARE of the points lie
NEAREST_SHARE = 0.01  # of the points in the images; single points may be wrong
_MAX_NEARER = 0.1  # largest share of the points in the images that may be nearer than the near plane


def choose_near_plane(scene: Scene) -> tuple[float, str]:
    """Return the near plane and why it is nearer than `FARTHEST`.

    Returns
    -------
    near_plane : `FARTHEST` or less [world units, two digits].
    reason : empty if the near plane is `FARTHEST`.
    """
    depth = _point_depths(scene)
    nearest = DEPTH_SHARE * float(np.quantile(depth, NEAREST_SHARE)) if len(depth) else FARTHEST
    limits = (
        (FARTHEST, ""),
        (EXTENT_SHARE * scene.extent, "the cameras stand close together"),
        (nearest, "some points are close to a camera"),
    )
    rounded = [(float(f"{limit:.2g}"), reason) for limit, reason in limits]
    return min(rounded, key=lambda limit: limit[0])


def check_near_plane(scene: Scene, near_plane: float) -> None:
    """Raise InputError if too much of the scene is nearer than the near plane, where nothing is rendered."""
    depth = _point_depths(scene)
    if len(depth) and np.mean(depth < near_plane) > _MAX_NEARER:
        raise InputError(
            f"{scene.path}: {np.mean(depth < near_plane):.0%} of what its cameras see is nearer than the near plane "
            f"({near_plane:g} units)",
            Remedy("use a smaller near plane", "--near-plane"),
        )


def _point_depths(scene: Scene) -> DoubleArray:
    """Return the depths of the scene's points in the images that they are in, at most 2000 points."""
    xyz = sampled(scene.points.xyz)
    depths = [found.depth[found.inside] for found in (seen(view.camera, xyz) for view in scene.train)]
    return np.concatenate(depths) if depths else np.zeros(0)

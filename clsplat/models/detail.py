"""A model in levels of detail: parts of it that are far away are drawn as fewer and larger Gaussians.

The model is cut into leaves. Each further level of a leaf has about half as many Gaussians (splats/merging.py). A leaf
is drawn at the coarsest level whose merged centres are, from the camera, less far apart than a number of pixels. Leaves
outside the image are not drawn. The first level is the model itself, with its kernel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..cameras.camera import Camera
from ..errors import InputError
from ..rendering.renderer import Rendered, Renderer
from ..splats.approximate import nearest_gaussians
from ..splats.color import BLACK
from ..splats.convert import convert
from ..splats.fields import Array, DoubleArray
from ..splats.merging import boxes_of, leaves_of, levels_of
from ..splats.shapes import GAUSSIAN, shape_named
from ..splats.splats import Splats

LEVELS, MAX_LEVELS = 8, 12  # by default, and at most
_LEAF = 512  # largest number of splats of a leaf at the first level
_MARGIN = 4.0  # pixels around the image: a splat outside of it is widened by the low-pass filter

Choice = NDArray[np.int64]


class DetailLevels:
    """The levels of a model. Splats of negative opacity are only merged with each other.

    Parameters
    ----------
    levels : number of levels, 1 to 12. There are fewer if no splats are left to merge.

    Attributes
    ----------
    splats : the model.
    counts : (levels, leaves) numbers of splats.
    distances : (levels, leaves) root mean square distance of the centres that were merged [world units], 0 at first.

    Raises
    ------
    InputError : the number of levels is out of range, or the shape does not have Gaussians among its kernels.
    """

    def __init__(self, splats: Splats, levels: int = LEVELS) -> None:
        if levels not in range(1, MAX_LEVELS + 1):
            raise InputError(f"{levels} levels of detail: choose 1 to {MAX_LEVELS}")
        self.splats = splats
        signs = 2 if shape_named(splats.shape).signed else 1
        leaves = leaves_of(splats.mean, _LEAF)
        n = len(leaves)
        # Splats of negative opacity have groups of their own, so that they are only merged with each other.
        negative = splats.opacity_logit < 0.0 if signs == 2 else np.zeros(len(splats), np.bool_)
        groups = [rows[negative[rows] == bool(sign)] for rows in leaves for sign in range(signs)]
        found = levels_of(nearest_gaussians(_negated(splats, negative)).arrays, groups, levels)
        low, high = (np.reshape(corner, (n, signs, 3)) for corner in zip(*boxes_of(found, n * signs), strict=True))
        self._low, self._high = low.min(axis=1), high.max(axis=1)
        parts, distances = [], []
        for number, level in enumerate(found):
            leaf, rows = level.group // signs, np.argsort(level.group, kind="stable")
            part = splats if number == 0 else self._as_model(level.arrays(), level.group % signs == 1)
            parts.append({name: array[rows] for name, array in part.arrays.items()})
            mass = np.maximum(level.opacity, 1e-9)
            total = np.bincount(leaf, mass, n)
            spread = np.bincount(leaf, mass * level.spread, n)
            distances.append(np.sqrt(spread / np.maximum(total, 1e-300)))
        self.counts = np.stack([np.bincount(level.group // signs, minlength=n) for level in found])
        self.distances = np.maximum.accumulate(np.stack(distances), axis=0)
        self._first = np.cumsum(np.r_[0, self.counts.ravel()])[:-1].reshape(self.counts.shape)
        self._all = splats.with_arrays({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
        self._last: tuple[bytes, Splats] | None = None

    def __len__(self) -> int:
        return len(self.counts)

    def _as_model(self, arrays: dict[str, Array], negative: NDArray[np.bool_]) -> Splats:
        """Return Gaussians with the kernel of the model, whose further fields are neutral.

        negative : (N,) Gaussians of negative opacity.
        """
        gaussians = self.splats.like(GAUSSIAN.name, arrays, self.splats.normalisation)
        return _negated(convert(gaussians, self.splats.shape), negative)

    def choose(self, camera: Camera, pixels: float) -> Choice:
        """Return the level of each leaf, (leaves,), and -1 for leaves outside the image.

        Parameters
        ----------
        pixels : largest distance of merged centres in the image [px]; 0 draws the model itself.

        Raises
        ------
        InputError : `pixels` is negative or not a number.
        """
        if not pixels >= 0:
            raise InputError(f"detail {pixels}: give a number of pixels, at least 0")
        outside = np.maximum(np.maximum(self._low - camera.position, camera.position - self._high), 0.0)
        depth = np.maximum(np.linalg.norm(outside, axis=1), 1e-12)
        fits = self.distances * max(camera.fx, camera.fy) <= pixels * depth
        # Each level has at least the distances of the one before, so those that fit are the first ones.
        level: Choice = np.maximum(fits.sum(axis=0) - 1, 0)
        level[~self._in_image(camera)] = -1
        return level

    def _in_image(self, camera: Camera) -> NDArray[np.bool_]:
        """Return whether the box of each leaf may be in the image: not all corners are beyond one of its sides."""
        corners = np.stack([self._low, self._high], axis=1)
        pick = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
        xyz = np.stack([corners[:, pick[:, axis], axis] for axis in range(3)], axis=-1)
        x, y, z = np.moveaxis(xyz @ camera.rotation.T + camera.translation, -1, 0)
        sides = (
            z,
            camera.fx * x + (camera.cx + _MARGIN) * z,
            (camera.width + _MARGIN - camera.cx) * z - camera.fx * x,
            camera.fy * y + (camera.cy + _MARGIN) * z,
            (camera.height + _MARGIN - camera.cy) * z - camera.fy * y,
        )
        inside: NDArray[np.bool_] = np.logical_and.reduce([(side > 0).any(axis=1) for side in sides])
        return inside

    def at(self, level: Choice) -> Splats:
        """Return the splats of a choice of levels; the model itself if all leaves are drawn at the first level."""
        if not level.any():
            return self.splats
        key = level.tobytes()
        if self._last is None or self._last[0] != key:
            leaves = np.flatnonzero(level >= 0)
            starts, counts = self._first[level[leaves], leaves], self.counts[level[leaves], leaves]
            steps = np.repeat(starts - np.cumsum(np.r_[0, counts])[:-1], counts)
            self._last = key, self._all.select(steps + np.arange(len(steps)))
        return self._last[1]

    def whole(self, level: int) -> Splats:
        """Return the whole model at one level, 0 to the last. Raise InputError for another number."""
        if level not in range(len(self)):
            raise InputError(f"level {level}: the model has the levels 0 to {len(self) - 1}")
        return self.at(np.full(self.counts.shape[1], level))

    def seen(self, camera: Camera, pixels: float) -> Splats:
        """Return the splats to draw for a camera; `pixels` as for `choose`."""
        return self.at(self.choose(camera, pixels))


def _negated(splats: Splats, rows: NDArray[np.bool_]) -> Splats:
    """Return the splats with the negative opacity in some rows (N,)."""
    if not rows.any():
        return splats
    raw = splats.opacity_logit
    return splats.with_arrays(splats.to_numpy() | {"opacity_logit": np.where(rows, -raw, raw)})


class DetailRenderer:
    """A renderer that draws one model in levels of detail, each leaf as coarse as `pixels` allows."""

    def __init__(self, renderer: Renderer, levels: DetailLevels, pixels: float) -> None:
        self.renderer, self.levels, self.pixels = renderer, levels, pixels

    def render(
        self, splats: Splats, camera: Camera, background: ArrayLike = BLACK, sh_degree: int | None = None
    ) -> Rendered:
        """Return the image. splats : the model of the levels."""
        return self.renderer.render(self.levels.seen(camera, self.pixels), camera, background, sh_degree)


def farther(camera: Camera, factor: float, depth: float) -> Camera:
    """Return a camera `factor` times as far from the point that is `depth` before this one."""
    position: DoubleArray = camera.position + (1.0 - factor) * depth * camera.rotation[2]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.rotation, -camera.rotation @ position
    return camera.posed(pose)

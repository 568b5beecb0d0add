"""The splats that training starts from: structure-from-motion points, random points, or an earlier model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..rendering.camera_block import NEAR
from ..splats.fields import Array, sh_coefficients
from ..splats.morton import morton_order
from ..splats.shapes import DEFAULT_SHAPE, shape_named
from ..splats.splats import Splats
from .random_points import random_points, seen

if TYPE_CHECKING:
    from ..scenes.scene import Scene

# 3DGS-MCMC's start: small and half opaque (3DGS: opacity 0.1, scale factor 1).
OPACITY = 0.5
SCALE_FACTOR = 0.1
RANDOM_POINTS = 100_000  # 3DGS
FEW = 0.1  # of the cap: of fewer points, as many are added at random
FEWEST_POINTS = 4  # a point and its three neighbours give the first scale
_TOO_NEAR = 0.1  # of what cameras see may be nearer than the near plane
_LOOKED_AT = 2000  # points, to find that out


def initial_splats(
    scene: Scene,
    shape: str = DEFAULT_SHAPE,
    cap: int = 1_000_000,
    sh_degree: int = 3,
    init: str = "sfm",
    seed: int = 0,
    *,
    normalisation: str = "peak",
    antialiased: bool = False,
    random_share: float | None = 0.0,
    opacity: float = OPACITY,
    scale_factor: float = SCALE_FACTOR,
) -> tuple[Splats, str]:
    """Splats to start from and one sentence on where they come from.

    Splats made from points follow a Morton curve, those of a model keep their order.

    Parameters
    ----------
    scene : its points and training cameras are used.
    shape, sh_degree, normalisation, antialiased : of the result.
    cap : most splats; of more points those with the longest tracks are kept, of a model the most opaque.
    init : "sfm", "random", or the path of a .ply model. "sfm" without points becomes "random" and says so.
    seed : of random points and of the first skew.
    random_share : points at random beside those of "sfm", as a fraction of the cap; None: a tenth where the scene has
        fewer, else 0.
    opacity, scale_factor : of splats made from points; scale = factor * distance to the three nearest.

    Raises
    ------
    InputError : cap below 1, unknown `init`, an unreadable model, one with skew of another normalisation, one that is
        antialiased or not against what is asked for, or a scene so small that it lies before the near plane.
    """
    if cap < 1:
        raise InputError(f"cap {cap}: at least 1 splat is needed")
    check_size(scene)
    rng = np.random.default_rng(seed)
    if init.lower().endswith(".ply"):
        splats, message = _from_model(init, shape, cap, sh_degree, normalisation, antialiased)
    elif init in ("sfm", "random"):
        xyz, rgb, message = _points(scene, init, cap, rng, random_share)
        order = morton_order(xyz)
        xyz, rgb = xyz[order], rgb[order]
        splats = Splats.from_points(
            xyz,
            rgb,
            shape=shape,
            sh_degree=sh_degree,
            normalisation=normalisation,
            opacity=opacity,
            scale_factor=scale_factor,
        )
    else:
        raise InputError(f"init {init!r}: choose sfm, random, or the path of a .ply model")
    return _started(splats, rng), message


def _points(
    scene: Scene, init: str, cap: int, rng: np.random.Generator, random_share: float | None
) -> tuple[Array, NDArray[np.uint8], str]:
    """Positions, colours and the message."""
    points = scene.points
    found = len(points.xyz)
    apart = distinct(points.xyz)
    if init == "sfm" and len(apart) >= FEWEST_POINTS:
        xyz, rgb, tracks = points.xyz[apart], points.rgb[apart], points.track_length[apart]
        if random_share is None:
            random_share = FEW if len(apart) < FEW * cap else 0.0
        beside = min(round(random_share * cap), cap - 1)
        if len(apart) <= cap - beside:
            message = f"{len(apart)} splats from the scene's points"
        else:
            keep = best_observed(xyz, tracks, cap - beside, scene)
            message = f"{cap - beside} splats from the scene's points: the best observed of {len(apart)}"
            xyz, rgb = xyz[keep], rgb[keep]
        if not beside:
            return xyz, rgb, message
        placed = random_points(scene, beside, rng)
        return (
            np.concatenate([xyz, placed]),
            np.concatenate([rgb, rgb[nearest_of(xyz, placed)]]),
            (f"{message}, {beside} at random where the cameras look"),
        )
    count = min(cap, RANDOM_POINTS)
    placed = random_points(scene, count, rng)
    rgb = rng.integers(0, 256, (count, 3), dtype=np.uint8)
    there = f"{found} points" if len(apart) == found else f"{found} points, {len(apart)} of them apart"
    why = "" if init == "random" else f" (the scene has {there}): expect less than from good points"
    return placed, rgb, f"{count} splats at random where the cameras look{why}"


def nearest_of(xyz: Array, to: Array) -> NDArray[np.int64]:
    """Indices of the points of `xyz` (P, 3) that are nearest to each of `to`."""
    from scipy.spatial import cKDTree  # a third of a second to import

    return np.asarray(cKDTree(xyz).query(to, workers=-1)[1], np.int64)


def distinct(xyz: Array) -> NDArray[np.int64]:
    """Indices of the first point in each place, rising.

    Points in one place have no distance that their splats' sizes could come from, and one splat does for them all.
    """
    order = np.lexsort(xyz.T)
    same = np.zeros(len(xyz), np.bool_)
    same[order[1:]] = (xyz[order[1:]] == xyz[order[:-1]]).all(axis=1)  # lexsort is stable: the first comes first
    return np.flatnonzero(~same)


def check_size(scene: Scene) -> None:
    """Raises InputError where what the cameras see lies before the near plane: such a scene cannot be rendered."""
    xyz = scene.points.xyz[:: -(-len(scene.points.xyz) // _LOOKED_AT) or 1]
    depths = [depth[inside] for depth, inside in (seen(view.camera, xyz) for view in scene.train)]
    depth = np.concatenate(depths) if depths else np.zeros(0)
    if not len(depth) or np.mean(depth < NEAR) <= _TOO_NEAR:
        return
    factor = 10.0 ** np.ceil(np.log10(10 * NEAR / np.median(depth)))
    raise InputError(
        f"{scene.path}: {np.mean(depth < NEAR):.0%} of what its cameras see is nearer than the near plane "
        f"({NEAR:g} units): make the reconstruction about {factor:g} times as large"
    )


def best_observed(xyz: Array, track_length: NDArray[np.integer], cap: int, scene: Scene) -> NDArray[np.int64]:
    """Indices of `cap` points with long tracks that still cover the scene, rising.

    Half of them are the best observed of each cell of a grid, the rest the longest tracks left: by tracks
    alone a textured mat would take everything and leave the background empty. Space is contracted around the
    cameras (Barron et al. 2022, Mip-NeRF 360, eq. 10), so that far points share larger cells.
    """
    centres = np.array([view.camera.position for view in scene.train])
    from_centre = (xyz - centres.mean(axis=0)) / scene.extent
    norm = np.maximum(np.linalg.norm(from_centre, axis=1, keepdims=True), 1e-12)
    contracted = np.where(norm > 1, from_centre / norm * (2 - 1 / norm), from_centre)
    # A stable sort: equal tracks in the order of their indices.
    order = np.argsort(-track_length.astype(np.int64), kind="stable")
    low, high = 1.0, 4096.0  # cells per unit of length
    first = order[:0]
    for _ in range(24):
        cells = 0.5 * (low + high)
        cell = np.floor(contracted[order] * cells).astype(np.int64)
        _, position = np.unique(cell, axis=0, return_index=True)
        if len(position) > max(cap // 2, 1):
            high = cells
        else:
            low, first = cells, order[np.sort(position)]
    rest = order[~np.isin(order, first)]
    return np.sort(np.concatenate([first, rest])[:cap])


def _from_model(
    path: str, shape: str, cap: int, sh_degree: int, normalisation: str, antialiased: bool
) -> tuple[Splats, str]:
    """A model from a file, in the wanted shape, SH degree and count."""
    loaded = Splats.load(path)
    if loaded.skew.any() and loaded.normalisation != normalisation:
        raise InputError(
            f"{path}: its normalisation is {loaded.normalisation}, not {normalisation}: "
            f"choose normalisation {loaded.normalisation}"
        )
    if loaded.antialiased != antialiased:
        raise InputError(
            f"{path}: its splats are {'' if loaded.antialiased else 'not '}antialiased: "
            f"{'use' if loaded.antialiased else 'leave out'} --antialiased"
        )
    message = f"{len(loaded)} splats from {path}"
    if len(loaded) > cap:
        strength = shape_named(loaded.shape).strength(loaded.arrays)
        keep = np.sort(np.argsort(-strength, kind="stable")[:cap])
        message = f"{cap} splats from {path}: the most opaque of {len(loaded)}"
        loaded = loaded.select(keep)
    arrays = loaded.as_shape(shape).to_numpy()
    arrays["sh"] = _fit_bands(arrays["sh"], sh_coefficients(sh_degree))
    return Splats(shape, arrays, normalisation, loaded.antialiased), message


def _fit_bands(sh: Array, coefficients: int) -> Array:
    """Colour (N, K, 3) with `coefficients` in place of K: higher bands cut, or zero."""
    fitted = np.zeros((len(sh), coefficients, 3), sh.dtype)
    shared = min(coefficients, sh.shape[1])
    fitted[:, :shared] = sh[:, :shared]
    return fitted


def _started(splats: Splats, rng: np.random.Generator) -> Splats:
    """With the fields that must not start at their neutral value moved off it, where all splats are there."""
    arrays = splats.to_numpy()
    for field in splats.schema:
        values = arrays[field.name]
        if field.start is None or (values.reshape(len(values), -1) != np.asarray(field.neutral, values.dtype)).any():
            continue
        if field.width == 1:
            values[:] = field.start
        else:
            direction = rng.standard_normal(values.shape)
            values[:] = field.start * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return splats.with_arrays(arrays)

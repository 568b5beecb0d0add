"""The first splats of a run, from structure-from-motion points, random points, or an earlier model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.stop_signals import held
from ..scenes.distinct_points import distinct
from ..splats.approximate import nearest_of_shape
from ..splats.fields import Array, sh_coefficients
from ..splats.formats.any_file import READ_ENDINGS
from ..splats.morton import morton_order
from ..splats.near_plane import NEAR_PLANE
from ..splats.shapes import DEFAULT_SHAPE, shape_named
from ..splats.splats import Splats
from .folder import ModelFolder
from .near_plane import check_near_plane
from .point_colors import with_colors
from .random_points import random_points

if TYPE_CHECKING:
    from ..scenes.scene import Scene
    from .config import TrainConfig

FROM_POINTS = ("sfm", "random")  # starts that are not the path of a file
RANDOM_POINTS = 100_000  # 3DGS
_MOST_CELLS = 4096  # of the grid of `best_observed`, per unit of length; contracted space has 4 units
_KEY = 4 * _MOST_CELLS + 1  # more than the number of cells in a direction
DENSE = 10  # points for each splat of the cap: clouds of scanners and of multi-view stereo
MIN_POINTS = 4  # the first scale needs a point and its three neighbours


def first_arrays(
    scene: Scene, config: TrainConfig, near_plane: float, context: Splats | None = None
) -> tuple[Mapping[str, Array], str]:
    """Return the public arrays of a run's first splats, with its context behind them, and a message on their source.

    Parameters
    ----------
    config : complete options. near_plane : of the kernels. context : splats that do not change (context.py).
    """
    splats, message = initial_splats(
        scene,
        config.shape,
        config.cap_max,
        config.sh_degree,
        config.start.init,
        config.seed,
        normalisation=config.normalisation,
        antialiased=bool(config.antialiased),
        near_plane=near_plane,
        random_share=config.start.random_points,
        opacity=config.density.init_opacity,
        scale_factor=config.density.init_scale,
    )
    arrays: Mapping[str, Array] = splats.to_numpy()
    if context is not None:
        around = context.to_numpy()
        arrays = {name: np.concatenate([array, around[name]]) for name, array in arrays.items()}
    return arrays, message


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
    near_plane: float = NEAR_PLANE,
    random_share: float | None = 0.0,
    opacity: float,
    scale_factor: float,
) -> tuple[Splats, str]:
    """Return the first splats, and a sentence that names their source.

    Splats from points follow a Morton curve. Splats of a model keep their order.

    Parameters
    ----------
    scene : scene with points and training cameras.
    shape, sh_degree, normalisation, antialiased, near_plane : properties of the result.
    cap : largest number of splats. The points with the longest tracks are kept, or the most opaque splats of a model.
    init : "sfm", "random", or the path of a file of splats. "sfm" without points becomes "random", with a message.
    seed : seed of random points and of the first skew.
    random_share : number of random points that are added to those of "sfm", as a fraction of the cap. Without points
        of the scene it is the number of all points, and 0 stands for the whole cap, at most RANDOM_POINTS. None is 0.
    opacity, scale_factor : properties of splats from points. The scale is the factor times the root mean
        square of the distances to the three nearest points.

    Raises
    ------
    InputError : the cap is below 1; `init` is unknown; the model is unreadable, or has another normalisation or
        antialiasing; or much of the scene is nearer than the near plane.
    """
    if cap < 1:
        raise InputError(f"cap {cap}: at least 1 splat is needed")
    check_near_plane(scene, near_plane)
    rng = np.random.default_rng(seed)
    if init in FROM_POINTS:
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
        check_init(init)
        splats, message = _from_model(init, shape, cap, sh_degree, normalisation, antialiased)
    return started(splats, rng).with_near_plane(near_plane), message


def check_init(init: str) -> None:
    """Raise InputError if the option `init` is unknown, or names a file that does not exist. The file is not read."""
    if names_model(init) and not Path(init).exists():
        raise InputError(f"{init}: cannot be read (no such file); check its name")
    if not names_model(init) and init not in FROM_POINTS:
        if ModelFolder(init).is_used:
            raise InputError(f"init {init!r}: is a model folder: name its file {ModelFolder(init).latest_ply()[0]}")
        raise InputError(f"init {init!r}: choose sfm, random, or the path of a file of splats")


def names_model(init: str) -> bool:
    """Return whether the option `init` names a file of splats."""
    return init not in FROM_POINTS and (init.lower().endswith(READ_ENDINGS) or Path(init).is_file())


def _points(
    scene: Scene, init: str, cap: int, rng: np.random.Generator, random_share: float | None
) -> tuple[Array, NDArray[np.uint8], str]:
    """Return the positions and colours of the first points, and the message."""
    points = with_colors(scene.points, scene.train)
    n_points = len(points.xyz)
    apart = distinct(points.xyz)
    if init == "sfm" and len(apart) >= MIN_POINTS:
        xyz, rgb, tracks = points.xyz[apart], points.rgb[apart], points.track_length[apart]
        n_random = min(round((random_share or 0.0) * cap), cap - 1)
        colored = "" if points is scene.points else ", with colours of the photos"
        if len(apart) <= cap - n_random:
            message = f"{len(apart)} splats from the scene's points{colored}"
        else:
            keep = best_observed(xyz, tracks, cap - n_random, scene)
            which = "spread among" if all_equal(tracks) else "the best observed of"
            message = f"{cap - n_random} splats from the scene's points: {which} {len(apart)}{colored}"
            xyz, rgb = xyz[keep], rgb[keep]
        if not n_random:
            return xyz, rgb, message
        placed = random_points(scene, n_random, rng)
        return (
            np.concatenate([xyz, placed.xyz]),
            np.concatenate([rgb, rgb[nearest_of(xyz, placed.xyz)]]),
            f"{message}, {len(placed.xyz)} at random {placed.where}",
        )
    count = min(cap, RANDOM_POINTS) if not random_share else max(round(random_share * cap), 1)
    placed = random_points(scene, count, rng)
    rgb = rng.integers(0, 256, placed.xyz.shape, dtype=np.uint8) if placed.rgb is None else placed.rgb
    available = f"{n_points} points" if len(apart) == n_points else f"{n_points} points, {len(apart)} of them apart"
    why = "" if init == "random" else f" (the scene has {available}): expect less than from good points"
    return placed.xyz, rgb, f"{len(placed.xyz)} splats at random {placed.where}{why}"


def nearest_of(xyz: Array, to: Array) -> NDArray[np.int64]:
    """Return the index of the point of `xyz` (P, 3) that is nearest to each point of `to`."""
    from scipy.spatial import cKDTree  # imported late: slow to import

    with held():
        return np.asarray(cKDTree(xyz).query(to, workers=-1)[1], np.int64)


def best_observed(xyz: Array, track_length: NDArray[np.integer], cap: int, scene: Scene) -> NDArray[np.int64]:
    """Return the indices of `cap` points with long tracks that cover the scene, in rising order.

    Half of them are the points with the longest tracks in the cells of a grid. The others have the longest of the
    remaining tracks. By track length alone, all points could come from a textured surface, and none from the
    background. If all tracks are equal, as in files of points without tracks, all come from the grid: the order of
    a file may be that of a scanner. So do those of a dense cloud, whose longest tracks are all in one place. Space is
    contracted around the cameras (Barron et al. 2022, Mip-NeRF 360, eq. 10), so that far points share larger cells.
    """
    centres = np.array([view.camera.position for view in scene.train])
    from_centre = (xyz - centres.mean(axis=0)) / scene.extent
    norm = np.maximum(np.linalg.norm(from_centre, axis=1, keepdims=True), 1e-12)
    contracted = np.where(norm > 1, from_centre / norm * (2 - 1 / norm), from_centre)
    # The sort is stable: equal tracks stay in the order of their indices.
    order = np.argsort(-track_length.astype(np.int64), kind="stable")
    is_dense = len(xyz) > DENSE * cap
    n_spread = cap if all_equal(track_length) or is_dense else max(cap // 2, 1)
    low, high = 1.0, float(_MOST_CELLS)  # cells per unit of length
    first = order[:0]
    for _ in range(24):
        cells = 0.5 * (low + high)
        x, y, z = (np.floor(contracted[order] * cells).astype(np.int64) + 2 * _MOST_CELLS).T
        _, position = np.unique((x * _KEY + y) * _KEY + z, return_index=True)
        if len(position) > n_spread:
            high = cells
        else:
            low, first = cells, order[np.sort(position)]
    rest = order[~np.isin(order, first)]
    return np.sort(np.concatenate([first, rest])[:cap])


def all_equal(track_length: NDArray[np.integer]) -> bool:
    """Return whether all tracks have one length: then they say nothing about the points."""
    return bool((track_length == track_length[:1]).all())


def _from_model(
    path: str, shape: str, cap: int, sh_degree: int, normalisation: str, antialiased: bool
) -> tuple[Splats, str]:
    """Return the splats of a file, converted to the shape and SH degree and reduced to the cap, and a message."""
    loaded = Splats.load(path)
    if not len(loaded):
        raise InputError(f"{path}: has no splats: start from another file, or from points (init sfm or random)")
    if loaded.skew.any() and loaded.normalisation != normalisation:
        raise InputError(
            f"{path}: its normalisation is {loaded.normalisation}, not {normalisation}: "
            f"choose normalisation {loaded.normalisation}"
        )
    if loaded.antialiased != antialiased:
        found = "antialiased: use --antialiased" if loaded.antialiased else "not antialiased: use --no-antialiased"
        raise InputError(f"{path}: its splats are {found}")
    message = f"{len(loaded)} splats from {path}"
    if len(loaded) > cap:
        strength = shape_named(loaded.shape).strength(loaded.arrays)
        keep = np.sort(np.argsort(-strength, kind="stable")[:cap])
        message = f"{cap} splats from {path}: the most opaque of {len(loaded)}"
        loaded = loaded.select(keep)
    converted, is_nearest = nearest_of_shape(loaded, shape)
    if is_nearest:
        message += f", as the nearest {shape} splats"
    if left_out := len(loaded) - len(converted):
        message += f", without {left_out} of negative opacity"
    arrays = converted.to_numpy()
    arrays["sh"] = _fit_bands(arrays["sh"], sh_coefficients(sh_degree))
    return Splats(shape, arrays, normalisation, loaded.antialiased), message


def _fit_bands(sh: Array, coefficients: int) -> Array:
    """Return colour (N, K, 3) with `coefficients` instead of K: bands are removed, or added with zeros."""
    fitted = np.zeros((len(sh), coefficients, 3), sh.dtype)
    shared = min(coefficients, sh.shape[1])
    fitted[:, :shared] = sh[:, :shared]
    return fitted


def started(splats: Splats, rng: np.random.Generator) -> Splats:
    """Return the splats with start values instead of neutral values without a gradient.

    A field changes only if all splats have its neutral value.
    """
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

"""Splats in a common world: turned, scaled alike on all axes, moved, and joined."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from .convert import convert
from .fields import Array, DoubleArray, sh_coefficients
from .harmonics import sh_basis
from .splats import Splats

_DIRECTIONS = 64  # that a band of harmonics is sampled in; it has 7 functions at most
_TOLERANCE = 1e-4  # of a matrix that is to be a rotation times a scale; float32 transforms differ by 1e-6


def similarity(matrix: ArrayLike) -> tuple[float, DoubleArray, DoubleArray]:
    """Scale s, rotation R (3, 3) and translation t (3,) of a (4, 4) matrix that is x -> s R x + t.

    Raises
    ------
    InputError : axes scaled differently, sheared, mirrored or without length.
    """
    given = np.asarray(matrix, np.float64)
    linear = given[:3, :3]
    lengths = np.linalg.norm(linear, axis=0)
    if not np.isfinite(given).all() or lengths.min() <= 0:
        raise InputError("its transform has no size; set its scale above 0")
    scale = float(np.cbrt(np.prod(lengths)))
    if lengths.max() - lengths.min() > _TOLERANCE * scale:
        shown = ", ".join(f"{length:.6g}" for length in lengths)
        raise InputError(f"its axes are scaled by {shown}; splats can only be scaled alike on all axes")
    rotation = linear / scale
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _TOLERANCE:
        raise InputError("its transform is sheared; splats can only be turned, moved and scaled alike on all axes")
    if np.linalg.det(rotation) < 0:
        raise InputError("its transform is mirrored; splats can only be turned, moved and scaled alike on all axes")
    left, _, right = np.linalg.svd(rotation)
    return scale, left @ right, given[:3, 3].copy()


def placed(splats: Splats, matrix: ArrayLike) -> Splats:
    """The splats after x -> s R x + t, their colours seen from the turned directions.

    What a shape adds lies in a splat's own frame, in units of its own size, and stays.

    Raises
    ------
    InputError : a matrix that is no such map (see `similarity`).
    """
    from scipy.spatial.transform import Rotation  # lazy: a third of a second to import

    scale, rotation, translation = similarity(matrix)
    w, x, y, z = Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]]
    # The left product with (w, x, y, z), whatever the other's norm.
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    changed = {
        "mean": scale * splats.mean @ rotation.T + translation,
        "quat": splats.quat @ left.T,
        "log_scale": splats.log_scale + np.log(scale),
        "sh": turned_harmonics(splats.sh, rotation),
    }
    arrays = splats.to_numpy()
    arrays |= {name: values.astype(arrays[name].dtype) for name, values in changed.items()}
    return splats.with_arrays(arrays)


def turned_harmonics(sh: Array, rotation: DoubleArray) -> Array:
    """Coefficients (N, K, 3) of the same colours in directions turned by `rotation`: c'(R d) = c(d).

    Bands do not mix: each one's matrix is that which maps the band's values in some directions to those in the
    directions turned back, exact to rounding.
    """
    degree = round(sh.shape[1] ** 0.5) - 1
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    here, back = sh_basis(directions, degree), sh_basis(directions @ rotation, degree)
    turned = sh.astype(np.float64)
    for band in range(1, degree + 1):
        part = slice(sh_coefficients(band - 1), sh_coefficients(band))
        mixing = np.linalg.lstsq(here[:, part], back[:, part], rcond=None)[0]
        turned[:, part] = np.einsum("ij,njc->nic", mixing, turned[:, part])
    return turned.astype(sh.dtype)


def joined(parts: Sequence[Splats]) -> Splats:
    """All splats as one model, of a shape that all of them have an equal in.

    Raises
    ------
    InputError : no parts, or shapes or normalisations that have no equal in each other, or only some antialiased.
    """
    if not parts:
        raise InputError("join: no splats")
    if len({part.antialiased for part in parts if len(part)}) > 1:
        raise InputError("join: some of the models are antialiased, others are not; show one model at a time")
    shapes = list(dict.fromkeys(part.shape for part in parts))
    for shape in shapes:
        try:
            alike = [convert(part, shape) for part in parts]
        except InputError:
            continue
        if len({part.normalisation for part in alike if len(part)}) <= 1:
            return _stacked(alike)
    if len(shapes) == 1:
        raise InputError("join: the splats are normalised differently; show one model at a time")
    raise InputError(
        f"join: splats of shapes {', '.join(shapes)} have no equals in each other; bring them to one "
        "shape with `clsplat convert`, or show one model at a time"
    )


def _stacked(parts: Sequence[Splats]) -> Splats:
    """Splats of one shape below each other; missing bands of colour are 0."""
    coefficients = max(part.sh.shape[1] for part in parts)
    arrays = {name: np.concatenate([part.arrays[name] for part in parts]) for name in parts[0].arrays if name != "sh"}
    arrays["sh"] = np.concatenate(
        [np.pad(part.sh, ((0, 0), (0, coefficients - part.sh.shape[1]), (0, 0))) for part in parts]
    )
    return next((part for part in parts if len(part)), parts[0]).with_arrays(arrays)

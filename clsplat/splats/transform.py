"""Moved models, and several models as one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from .convert import convert
from .similarity import moved, similarity
from .splats import Splats


def transformed(splats: Splats, matrix: ArrayLike) -> Splats:
    """Return the splats after x -> s R x + t; their colours turn with them.

    Raises
    ------
    InputError : the matrix is not a similarity (see `similarity`).
    """
    scale, rotation, translation = similarity(matrix)
    arrays = moved(splats.arrays, scale, rotation, translation)
    return splats.with_arrays(arrays).with_near_plane(scale * splats.near_plane)


def joined(parts: Sequence[Splats]) -> Splats:
    """Join splats to one model, of a shape to which all of them can be converted.

    Its near plane is the smallest of theirs.

    Raises
    ------
    InputError : there are no parts; the shapes, normalisations or low passes differ; or only some parts are
        antialiased.
    """
    if not parts:
        raise InputError("join: no splats")
    if len({part.antialiased for part in parts if len(part)}) > 1:
        raise InputError("join: some of the models are antialiased, others are not; show one model at a time")
    if len(widths := {part.low_pass for part in parts if len(part)}) > 1:
        found = " and ".join(f"{width:g}" for width in sorted(widths))
        raise InputError(f"join: the models have low passes of {found} px²; show one model at a time")
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
        f"join: splats of shapes {', '.join(shapes)} cannot be joined; bring them to one "
        "shape with `clsplat convert`, or show one model at a time"
    )


def _stacked(parts: Sequence[Splats]) -> Splats:
    """Concatenate splats of one shape; missing SH bands are 0."""
    coefficients = max(part.sh.shape[1] for part in parts)
    arrays = {name: np.concatenate([part.arrays[name] for part in parts]) for name in parts[0].arrays if name != "sh"}
    arrays["sh"] = np.concatenate(
        [np.pad(part.sh, ((0, 0), (0, coefficients - part.sh.shape[1]), (0, 0))) for part in parts]
    )
    first = next((part for part in parts if len(part)), parts[0])
    stacked = first.like(first.shape, arrays, first.normalisation, copy=False)
    return stacked.with_near_plane(min(part.near_plane for part in parts))

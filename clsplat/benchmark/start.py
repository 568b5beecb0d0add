"""The start of published runs in scenes without points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..scenes.scene import Points, Scene
from .sets import StartCube

GREY = 128  # 3DGS's code: the SH coefficients are at most 1/255


def with_start(scene: Scene, start: StartCube | None, seed: int) -> Scene:
    """Return a scene with random grey points in a cube, as published systems start (3DGS, code).

    Parameters
    ----------
    scene : a scene without points; others stay as they are.
    start : number of points and side of the cube; None to change nothing.
    seed : seed of the points.
    """
    if start is None or len(scene.points):
        return scene
    half = 0.5 * start.side
    xyz = np.random.default_rng(seed).uniform(-half, half, (start.points, 3))
    seen_by = np.zeros(start.points, np.int64)
    return replace(scene, points=Points(xyz, np.full(xyz.shape, GREY, np.uint8), seen_by))

"""Small scenes to train on, and their faults."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from clsplat.cameras.camera import Camera
from clsplat.scenes.colmap import Points
from clsplat.scenes.demo.scene import write_capture
from clsplat.scenes.scene import Scene, View, load_scene

WIDTH, HEIGHT, VIEWS = 64, 48, 26


@cache
def capture(views: int = VIEWS) -> Scene:
    """Return a procedural capture with about 2400 points; every 8th view is a test view."""
    with tempfile.TemporaryDirectory() as folder:
        scene = load_scene(write_capture(Path(folder) / "capture", WIDTH, HEIGHT, views))
        # The photos are deleted with the folder, so they are decoded before.
        return rebuilt(scene, [view.loaded() for view in scene.views], scene.points.xyz)


def in_units(scene: Scene, scale: float) -> Scene:
    """Return the same world with all lengths times `scale`."""

    def camera(of: Camera) -> Camera:
        pose = of.cam_from_world.copy()
        pose[:3, 3] *= scale
        return of.posed(pose)

    views = [View(view.name, camera(view.camera), view.image) for view in scene.views]
    return rebuilt(scene, views, scene.points.xyz * scale)


def of_first(scene: Scene, n: int) -> Scene:
    """Return n of the training views and no test view; the training views are measured instead."""
    return rebuilt(scene, scene.train[:n], scene.points.xyz)


def badly_exposed(scene: Scene, gain: float = 2.0) -> Scene:
    """Return the scene with one training photo of another exposure, its highlights clipped."""
    odd = scene.train[3]
    bright = np.minimum(odd.image.astype(np.float64) * gain, 255).astype(np.uint8)
    views = [replace(view, image=bright) if view is odd else view for view in scene.views]
    return rebuilt(scene, views, scene.points.xyz)


def with_points(scene: Scene, kind: str) -> Scene:
    """Return the scene with faulty points from structure from motion."""
    xyz = scene.points.xyz.copy()
    rows = np.arange(len(xyz))
    if kind == "doubled":  # half of the points, each twice
        xyz = xyz[rows // 2 * 2]
    elif kind == "coincident":
        xyz = np.repeat(xyz.mean(axis=0, keepdims=True), len(xyz), axis=0)
    elif kind == "outliers":  # a hundredth of the points far away
        xyz[::100] = (xyz[::100] - xyz.mean(axis=0)) * 1e6
    elif kind == "four":
        rows = rows[:: len(rows) // 4][:4]
        return rebuilt(scene, scene.views, xyz[rows], rows)
    else:
        raise ValueError(kind)
    return rebuilt(scene, scene.views, xyz)


def rebuilt(scene: Scene, views: list[View], xyz: np.ndarray, rows: np.ndarray | None = None) -> Scene:
    """Return the scene with other views and positions; `rows` selects the colours and tracks of the points."""
    points, keep = scene.points, slice(None) if rows is None else rows
    names = frozenset(view.name for view in views) & scene.test_names
    return Scene(scene.name, scene.path, views, Points(xyz, points.rgb[keep], points.track_length[keep]), names)

"""A small COLMAP scene for tests that load or damage it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.files.images import write_png
from clsplat.scenes.colmap_binary import ModelView, write_binary_model
from clsplat.scenes.scene import Scene

WIDTH, HEIGHT, N_VIEWS, N_POINTS = 40, 30, 9, 12
FX, FY, CX, CY = 33.0, 31.0, 18.5, 16.25
NAMES = [f"shot_{index}.png" for index in range(N_VIEWS)]


def model_views() -> list[ModelView]:
    """Return nine views of a moving and rotating camera, each with 8 of the points."""
    rng = np.random.default_rng(1)
    views = []
    for index, name in enumerate(NAMES):
        angle = 0.1 * index
        pose = np.eye(4)
        pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        pose[:3, 3] = (0.3 * index, -0.2, 4.0)
        seen = rng.permutation(N_POINTS)[:8]
        pixels = rng.random((8, 2)) * HEIGHT
        views.append(ModelView(name, (WIDTH, HEIGHT), (FX, FY, CX, CY), pose, pixels, seen))
    return views


def cloud() -> tuple[np.ndarray, np.ndarray]:
    """Return positions and colours of the points, (P, 3) each."""
    rng = np.random.default_rng(2)
    return rng.normal(size=(N_POINTS, 3)), rng.integers(0, 256, (N_POINTS, 3)).astype(np.uint8)


def photo_of(index: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Return a photo whose pixels show its index and its orientation."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0], image[: height // 2, :, 1] = 20 * index, 200
    return image


def write_garden(parent: Path) -> Path:
    """Write the scene and return its folder. Images are in reverse order, so they are not sorted by name."""
    root = parent / "garden"
    for index, name in enumerate(NAMES):
        write_png(root / "images" / name, photo_of(index))
    write_binary_model(root / "sparse" / "0", model_views()[::-1], *cloud())
    return root


def as_text(model: Path, target: Path) -> None:
    """Write the model in folder `model` to folder `target`, as text files."""
    import pycolmap

    target.mkdir(parents=True, exist_ok=True)
    pycolmap.Reconstruction(str(model)).write_text(str(target))


def write_model(garden: Path, poses: list[np.ndarray], shift: float = 0.0, points: bool = True) -> None:
    """Write the garden's model with other poses; `shift` moves its points."""
    xyz, rgb = cloud()
    views = [replace(view, cam_from_world=pose) for view, pose in zip(model_views(), poses, strict=True)]
    if not points:
        nothing = (np.empty((0, 2)), np.empty(0, np.int64))
        views = [replace(view, pixels=nothing[0], point_index=nothing[1]) for view in views]
        xyz, rgb = xyz[:0], rgb[:0]
    write_binary_model(garden / "sparse" / "0", views, xyz + shift, rgb)


def moved(scale: float = 1.0, shift: float = 0.0) -> list[np.ndarray]:
    """Return the poses of cameras whose centres are scaled, then moved."""
    poses = []
    for view in model_views():
        pose = view.cam_from_world.copy()
        pose[:3, 3] = -pose[:3, :3] @ (-scale * pose[:3, :3].T @ pose[:3, 3] + shift)
        poses.append(pose)
    return poses


def with_points_elsewhere(scene: Scene) -> Scene:
    """Return a scene with points that are turned, as by a transform that its poses do not have."""
    xyz = scene.points.xyz
    center = np.median(xyz, axis=0)
    return replace(scene, points=replace(scene.points, xyz=(xyz - center)[:, [2, 0, 1]] * (1, -1, 1) + center))

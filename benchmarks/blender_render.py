"""Cameras, photos and points of the scenes of blender_scenes.py."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from blender_flat import flat, walk
from blender_front import front, stand
from blender_objects import dishes, metals, plant, wires
from blender_places import garden, lane, room
from mathutils import Matrix, Vector

FIELD_OF_VIEW = 0.6911112  # of NeRF-synthetic, horizontal [radians]
DISTANCE = 4.031  # of its cameras from the origin [world units]
PLACE_FIELD_OF_VIEW = 1.1  # inside a place [radians]
POINTS = 12000  # of a place
NOISE = 0.003  # standard deviation of its points around the surfaces [world units]
FAR_NOISE = 0.002  # the same along the ray, outdoors, at one world unit: it grows with the square of the depth


def look_at(eye: Any, target: Any) -> Matrix:
    """Return the pose of a camera at `eye` that looks at `target`, with z up."""
    return Matrix.Translation(eye) @ (Vector(target) - Vector(eye)).to_track_quat("-Z", "Y").to_matrix().to_4x4()


def sphere_cameras(rng: np.random.Generator, n_train: int, n_test: int) -> tuple[list[Matrix], list[Matrix]]:
    """Return random poses on the upper half of a sphere, and a spiral over it."""
    around, height = rng.uniform(0, 2 * math.pi, n_train), rng.uniform(0.0, 1.0, n_train)
    turn = np.linspace(0, 2 * math.pi, n_test, endpoint=False)
    spiral = 2 * turn, 0.1 + 0.8 * (0.5 - 0.5 * np.cos(turn))

    def poses(angles: Any, heights: Any) -> list[Matrix]:
        flat = np.sqrt(1 - heights**2)
        eyes = DISTANCE * np.stack([flat * np.cos(angles), flat * np.sin(angles), heights], axis=1)
        return [look_at(eye, (0, 0, 0)) for eye in eyes]

    return poses(around, height), poses(*spiral)


def every_few(poses: list[Matrix], n_test: int) -> tuple[list[Matrix], list[Matrix]]:
    """Return training poses, and test poses between them, of cameras along a path."""
    every = max(2, round(len(poses) / max(n_test, 1)))
    test = [pose for i, pose in enumerate(poses) if i % every == every - 1]
    return [pose for i, pose in enumerate(poses) if i % every != every - 1], test


def room_cameras(rng: np.random.Generator, n_train: int, n_test: int) -> tuple[list[Matrix], list[Matrix]]:
    """Return poses on two rings inside the room; every test view lies between training views."""
    n = n_train + n_test
    poses = []
    for i in range(n):
        angle = 4 * math.pi * i / n
        eye = (2.1 * math.cos(angle), 2.1 * math.sin(angle), (1.2 if i < n / 2 else 1.9) + rng.normal(0, 0.05))
        away = i % 3 == 2
        target = (-0.9 * eye[0], -0.9 * eye[1], 1.4) if away else (rng.normal(0, 0.3), rng.normal(0, 0.3), 0.8)
        poses.append(look_at(eye, target))
    return every_few(poses, n_test)


def garden_cameras(rng: np.random.Generator, n_train: int, n_test: int) -> tuple[list[Matrix], list[Matrix]]:
    """Return poses on three rings around the table."""
    n, poses = n_train + n_test, []
    for i in range(n):
        angle, ring = 6 * math.pi * i / n, 3 * i // n
        radius, height = (2.6, 3.4, 2.2)[ring] + rng.normal(0, 0.1), (1.1, 1.6, 2.1)[ring] + rng.normal(0, 0.06)
        eye = (radius * math.cos(angle), radius * math.sin(angle), height)
        poses.append(look_at(eye, (*rng.normal(0, 0.15, 2), 0.85)))
    return every_few(poses, n_test)


def lane_cameras(rng: np.random.Generator, n_train: int, n_test: int) -> tuple[list[Matrix], list[Matrix]]:
    """Return the poses of a walk along the lane; the view turns a little to both sides."""
    n, poses = n_train + n_test, []
    for i in range(n):
        eye = (-24 + 48 * i / n, 0.4 * math.sin(i / 5) + rng.normal(0, 0.05), 1.6 + rng.normal(0, 0.04))
        turn = 0.5 * math.sin(i / 4)
        poses.append(look_at(eye, (eye[0] + math.cos(turn), eye[1] + math.sin(turn), eye[2] - 0.05)))
    return every_few(poses, n_test)


def flat_cameras(rng: np.random.Generator, n_train: int, n_test: int) -> tuple[list[Matrix], list[Matrix]]:
    """Return the poses of a walk through the flat."""
    return every_few([look_at(eye, target) for eye, target in walk(rng, n_train + n_test)], n_test)


def front_cameras(rng: np.random.Generator, n_train: int, n_test: int) -> tuple[list[Matrix], list[Matrix]]:
    """Return the poses of photos from one side."""
    return every_few([look_at(eye, target) for eye, target in stand(rng, n_train + n_test)], n_test)


@dataclass(frozen=True)
class SceneKind:
    """How a scene is photographed.

    around : photos have no transparent pixels. outdoors : the noise of points grows. field_of_view : horizontal
    [radians]. samples : paths of a pixel, before the denoiser.
    """

    build: Callable[[np.random.Generator], None]
    cameras: Callable[[np.random.Generator, int, int], tuple[list[Matrix], list[Matrix]]] = sphere_cameras
    around: bool = False
    outdoors: bool = False
    field_of_view: float = FIELD_OF_VIEW
    samples: int = 16


SCENES = {
    "plant": SceneKind(plant),
    "metals": SceneKind(metals),
    "wires": SceneKind(wires),
    "dishes": SceneKind(dishes),
    "room": SceneKind(room, room_cameras, True, False, PLACE_FIELD_OF_VIEW),
    "flat": SceneKind(flat, flat_cameras, True, False, 1.2, 10),
    "front": SceneKind(front, front_cameras, True, True, PLACE_FIELD_OF_VIEW, 8),
    "garden": SceneKind(garden, garden_cameras, True, True, PLACE_FIELD_OF_VIEW),
    "lane": SceneKind(lane, lane_cameras, True, True, PLACE_FIELD_OF_VIEW),
}


def prepare(size: int, kind: SceneKind) -> Any:
    """Set Cycles up, and return the camera's object."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.seed = kind.samples, True, 0
    scene.cycles.max_bounces, scene.render.use_persistent_data = 6, True
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.film_transparent = not kind.around
    scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.color_mode = "RGB" if kind.around else "RGBA"
    world = bpy.data.worlds.new("sky")
    scene.world, world.use_nodes = world, True
    sky = world.node_tree.nodes.new("ShaderNodeTexSky")
    sky.sky_type, sky.sun_elevation, sky.sun_rotation = "MULTIPLE_SCATTERING", 0.7, 0.6
    world.node_tree.links.new(sky.outputs["Color"], world.node_tree.nodes["Background"].inputs["Color"])
    world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.06
    bpy.ops.object.camera_add()
    scene.camera = bpy.context.object
    scene.camera.data.angle, scene.camera.data.clip_start = kind.field_of_view, 0.01
    return scene.camera


def surface_points(cameras: list[Matrix], field_of_view: float, outdoors: bool, rng: np.random.Generator) -> Any:
    """Return points [n, 3] that rays through random pixels of the cameras hit, with noise, in textured parts or not."""
    depsgraph, reach, found, noise = bpy.context.evaluated_depsgraph_get(), math.tan(field_of_view / 2), [], []
    for pose in cameras:
        for x, y in rng.uniform(-reach, reach, (POINTS // len(cameras), 2)):
            direction = pose.to_3x3() @ Vector((x, y, -1)).normalized()
            hit, place, *_, of, _ = bpy.context.scene.ray_cast(depsgraph, pose.translation, direction)
            plain = hit and of.data.materials[0].name in ("plain", "white", "ceiling", "mirror")
            if hit and not (plain and rng.uniform() < 0.97):
                found.append(place)
                depth = (place - pose.translation).length
                noise.append(FAR_NOISE * depth**2 * rng.normal() * direction if outdoors else (0, 0, 0))
    return np.array(found) + np.array(noise) + rng.normal(0, NOISE, (len(found), 3))


def colors_of(points: Any, folder: Path, frames: list[dict[str, Any]], size: int, field_of_view: float) -> Any:
    """Return colours [n, 3] uint8 of points: of the pixel in the middlemost photo that shows each."""
    best, colors = np.full(len(points), np.inf), np.full((len(points), 3), 128, np.uint8)
    for frame in frames:
        local = np.c_[points, np.ones(len(points))] @ np.linalg.inv(np.array(frame["transform_matrix"])).T
        depth = -local[:, 2]
        place = local[:, :2] / depth[:, None] / math.tan(field_of_view / 2)
        off = np.where((depth > 0) & (np.abs(place).max(axis=1) < 0.99), np.abs(place).max(axis=1), np.inf)
        image = bpy.data.images.load(str(folder / frame["file_path"]))
        pixels = np.array(image.pixels[:]).reshape(size, size, -1)[..., :3]
        bpy.data.images.remove(image)
        better = off < best
        at = ((place[better] * 0.5 + 0.5) * size).astype(int)
        colors[better], best[better] = (255 * pixels[at[:, 1], at[:, 0]]).round(), off[better]
    return colors


def write_ply(path: Path, points: Any, colors: Any) -> None:
    """Write a cloud of coloured points."""
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {color}\n" for color in ("red", "green", "blue")) + "end_header\n"
    rows = [f"{x:.5f} {y:.5f} {z:.5f} {r} {g} {b}" for (x, y, z), (r, g, b) in zip(points, colors, strict=True)]
    path.write_text(head + "\n".join(rows) + "\n", encoding="ascii")


def render(folder: Path, name: str, size: int, n_train: int, n_test: int) -> None:
    """Build a scene and render what is missing of its photos."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rng, kind = np.random.default_rng(sum(map(ord, name))), SCENES[name]
    kind.build(rng)
    angle, camera = kind.field_of_view, prepare(size, kind)
    poses = dict(zip(("train", "test"), kind.cameras(rng, n_train, n_test), strict=True))
    folder.mkdir(parents=True, exist_ok=True)
    bpy.context.view_layer.update()
    for split, cameras in poses.items():
        frames = []
        for i, pose in enumerate(cameras):
            file = f"{split}/r_{i}.png"
            frames.append({"file_path": file, "transform_matrix": [list(row) for row in pose]})
            if not (folder / file).is_file():
                camera.matrix_world = pose
                bpy.context.scene.render.filepath = str(folder / file)
                bpy.ops.render.render(write_still=True)
        head: dict[str, Any] = {"camera_angle_x": angle}
        if kind.around and split == "train":
            points = surface_points(cameras, angle, kind.outdoors, rng)
            write_ply(folder / "points3d.ply", points, colors_of(points, folder, frames, size, angle))
        (folder / f"transforms_{split}.json").write_text(
            json.dumps(head | {"frames": frames}, indent=1), encoding="utf-8"
        )

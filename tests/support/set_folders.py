"""Small fakes of published sets: the capture of the tests, in the layout and with the names of a set."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np

from clsplat.cameras.path import opengl_pose
from clsplat.files.images import write_png
from clsplat.scenes.scene import load_scene

# The fakes are no sets: their sizes and numbers of views differ, which every table must say.


def as_colmap(capture: Path, scene: Path, reduced: str | None = None) -> Path:
    """Copy the capture to a scene's folder; `reduced` names a second folder of the same photos. Return the folder."""
    shutil.copytree(capture, scene)
    if reduced is not None:
        shutil.copytree(scene / "images", scene / reduced)
    return scene


def as_blender(capture: Path, scene: Path, n_test: int = 3) -> Path:
    """Write the views of the capture as a Blender scene with transparent photos. Return the folder."""
    views = load_scene(capture, eval=False).views
    for split, chosen in (("train", views[n_test:]), ("test", views[:n_test])):
        frames = []
        for number, view in enumerate(chosen):
            alpha = np.full((*view.image.shape[:2], 1), 255, np.uint8)
            alpha[:8, :8] = 0
            (scene / split).mkdir(parents=True, exist_ok=True)
            write_png(scene / split / f"r_{number}.png", np.concatenate([view.image, alpha], axis=2))
            pose = opengl_pose(view.camera.cam_from_world).tolist()
            frames.append({"file_path": f"./{split}/r_{number}", "transform_matrix": pose})
        angle = 2 * np.arctan(0.5 * views[0].camera.width / views[0].camera.fx)
        (scene / f"transforms_{split}.json").write_text(
            json.dumps({"camera_angle_x": angle, "frames": frames}), encoding="utf-8"
        )
    return scene


def as_llff(capture: Path, scene: Path) -> Path:
    """Copy the capture to a scene whose reduced photos are numbered, as in LLFF's sets. Return the folder."""
    shutil.copytree(capture, scene)
    (scene / "images_4").mkdir()
    for number, photo in enumerate(sorted((scene / "images").iterdir())):
        shutil.copy(photo, scene / "images_4" / f"image{number:03d}.png")
    return scene

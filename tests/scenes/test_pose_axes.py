"""Poses of another convention than the file's are named, by the points that their photos then show."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from recorded_scenes import scene_and_warnings

from clsplat.cameras.camera import Camera
from clsplat.scenes.colmap import NO_POINTS
from clsplat.scenes.point_cloud import write_point_cloud
from clsplat.scenes.pose_axes import warn_of_convention
from clsplat.scenes.scene import Scene

TURN = np.diag([1.0, -1.0, -1.0, 1.0])
AXES, INVERTED = "the y and z axes of their cameras turned around", "with inverted poses"


def pose_of(camera: Camera) -> np.ndarray:
    """Return the world-to-camera matrix of a camera, (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.rotation, camera.translation
    return pose


@pytest.mark.parametrize("opencv", [False, True])
@pytest.mark.parametrize("inverted", [False, True])
def test_transforms_of_another_convention_are_named(scene: Scene, tmp_path: Path, opencv: bool, inverted: bool) -> None:
    frames = []
    for view in scene.views:
        matrix = np.linalg.inv(pose_of(view.camera)) @ (np.eye(4) if opencv else TURN)
        matrix = np.linalg.inv(matrix) if inverted else matrix
        frames.append({"file_path": str(scene.path / "images" / view.name), "transform_matrix": matrix.tolist()})
    camera = scene.views[0].camera
    lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    write_point_cloud(tmp_path / "points3d.ply", scene.points)
    _, said = scene_and_warnings(tmp_path)
    assert ("of the points, but" in said) == (opencv or inverted)
    if opencv or inverted:
        assert (INVERTED if inverted else AXES) in said


def test_inverted_poses_of_colmap_are_named(scene: Scene) -> None:
    cameras = [camera.posed(np.linalg.inv(pose_of(camera))) for camera in scene.cameras]
    with pytest.warns(UserWarning, match=rf"^yard: a photo shows \d\.\d% of the points, but \d+% {INVERTED}"):
        warn_of_convention(Path("yard"), scene.points, cameras)


def test_what_gets_no_warning(scene: Scene, recwarn: pytest.WarningsRecorder) -> None:
    turned = [camera.posed(TURN @ pose_of(camera)) for camera in scene.cameras]
    warn_of_convention(Path("yard"), scene.points, scene.cameras)
    warn_of_convention(Path("yard"), NO_POINTS, turned)
    warn_of_convention(Path("yard"), scene.points, [*turned[:2], *scene.cameras[2:]])
    assert not recwarn.list

"""The add-on in a real Blender: the same images as `clsplat render`, and everything that a user touches.

Blender is the Python module `bpy` in this Python, or in the one that CLSPLAT_BLENDER_PYTHON names; it runs once, in a
process of its own (blender_child.py).
"""

from __future__ import annotations

import json
import math
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blender_python import blenders_python, blenders_python_or_skip
from blender_scene import HEIGHT, WIDTH, encoded, facing, some_splats
from clsplat_blender.lens import Lens, Raster, camera_of
from clsplat_cli.blender_addon import addon_zip
from PIL import Image

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import NamedCamera, read_cameras, write_cameras
from clsplat.cameras.interpolate import interpolate
from clsplat.cameras.path import CameraPath, read_path, write_path
from clsplat.rendering.renderer import Renderer
from clsplat.splats.splats import Splats
from clsplat.splats.transform import joined, transformed

CHILD = Path(__file__).parents[1] / "support" / "blender_child.py"


@pytest.fixture(scope="module")
def blender(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder and the results of the child process."""
    python = blenders_python_or_skip()
    folder = tmp_path_factory.mktemp("blender")
    some_splats().save(folder / "model.ply")
    some_splats(1, "gaussian").save(folder / "other.ply")
    cameras = [facing(0.0), facing(1.2, 3.0, (7.0, -4.0)), facing(2.5, 5.0)]
    write_cameras(folder / "cameras.json", [NamedCamera(f"view_{n}", each) for n, each in enumerate(cameras)])
    around = [facing(angle) for angle in (0.0, 2.0, 4.0)]
    write_path(folder / "camera_path.json", CameraPath(tuple(interpolate(around, 4)), 12.5))
    (folder / "addon.zip").write_bytes(addon_zip([]))
    (folder / "facts.json").write_text(json.dumps({"depth": plane_depth(cameras[0])}))
    done = child(python, folder)
    assert (folder / "out.json").exists(), done.stdout + done.stderr
    facts = json.loads((folder / "out.json").read_text())
    for name, fact in facts.items():
        assert "failed" not in fact, f"{name}: {fact['failed']}"
    assert "Traceback" not in done.stderr, done.stderr
    return folder, facts


def child(python: str, folder: Path, *cases: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [python, CHILD, folder, *cases],
        check=False,
        capture_output=True,
        text=True,
        timeout=300,
        env=os.environ | {"CLSPLAT_BUILD_OPTIONS": ""},
    )


def picture(path: Path | str) -> np.ndarray:
    return np.asarray(Image.open(path)).astype(int)


def expected(splats: Splats, camera: Camera, background: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """Return the image as `clsplat render` writes it."""
    return np.rint(255 * np.clip(Renderer().render(splats, camera, background).color, 0, 1)).astype(int)


def test_the_zip_installs_and_leaves_again(blender: tuple[Path, dict[str, Any]]) -> None:
    facts = blender[1]
    assert facts["install"]["enabled"]
    assert (facts["gone"]["left"], facts["gone"]["again"]) == (False, True)


def test_a_ply_becomes_points_with_attributes(blender: tuple[Path, dict[str, Any]]) -> None:
    folder, facts = blender
    fact, splats = facts["imported"], some_splats()
    assert fact["points"] == len(splats)
    assert {"color", "opacity", "scale", "rotation", "splat"} <= set(fact["attributes"])
    assert fact["ply"] == str(folder / "model.ply")
    assert fact["rotation"] == pytest.approx([-math.pi / 2, 0, 0])
    np.testing.assert_allclose(fact["first"], splats.mean[0], rtol=1e-6)
    assert fact["colour"][3] == 1
    assert fact["thinned"] == 10


def test_blenders_frames_are_those_of_clsplat_render(blender: tuple[Path, dict[str, Any]]) -> None:
    """Frames agree to one step of 255 for shifted cameras, upright objects and moved objects."""
    folder, facts = blender
    files, splats = facts["frames"]["files"], some_splats()
    named = {each.name: each.camera for each in read_cameras(folder / "cameras.json")}
    for name, camera in named.items():
        got, wanted = picture(files[name])[..., :3], expected(splats, camera)
        assert wanted.max() > 150
        assert np.abs(got - wanted).max() <= 1, name
    last = list(named.values())[-1]
    assert np.abs(picture(files["moved"])[..., :3] - expected(splats, last)).max() <= 1
    assert np.abs(picture(files["background"])[..., :3] - expected(splats, last, (0.2, 0.5, 1.0))).max() <= 1


def test_transparent_film_has_straight_colours(blender: tuple[Path, dict[str, Any]]) -> None:
    folder, facts = blender
    image = Renderer().render(some_splats(), read_cameras(folder / "cameras.json")[-1].camera)
    for name in ("transparent", "raw"):
        got = picture(facts["frames"]["files"][name])
        assert np.abs(got[..., 3] - np.rint(255 * image.alpha)).max() <= 1
        shown = image.alpha > 0.2
        straight = np.rint(255 * np.clip(image.color / np.maximum(image.alpha, 0.01)[..., None], 0, 1))
        assert np.abs(got[..., :3] - straight)[shown].max() <= 3, name


def test_a_border_is_the_same_pixels(blender: tuple[Path, dict[str, Any]]) -> None:
    folder, facts = blender
    whole = expected(some_splats(), read_cameras(folder / "cameras.json")[-1].camera)
    part = picture(facts["frames"]["files"]["border"])[..., :3]
    left, right, bottom = WIDTH // 4, 3 * WIDTH // 4, HEIGHT // 2
    assert np.abs(part - whole[:bottom, left:right]).max() <= 1
    inside = picture(facts["frames"]["files"]["border_whole"])[:bottom, left:right, :3]
    assert np.abs(inside - whole[:bottom, left:right]).max() <= 1


def test_several_objects_are_one_picture(blender: tuple[Path, dict[str, Any]]) -> None:
    folder, facts = blender
    both = joined([some_splats(), transformed(some_splats(1, "gaussian"), facts["together"]["matrix"])])
    wanted = expected(both, read_cameras(folder / "cameras.json")[0].camera)
    assert np.abs(wanted - expected(some_splats(), read_cameras(folder / "cameras.json")[0].camera)).max() > 30
    assert np.abs(picture(facts["together"]["file"])[..., :3] - wanted).max() <= 1


def test_paths_come_in_as_animations_and_go_out_again(blender: tuple[Path, dict[str, Any]]) -> None:
    folder, facts = blender
    path, fact = read_path(folder / "camera_path.json"), facts["animation"]
    assert (fact["frames"], fact["fps"], len(fact["files"])) == ([1, 4], pytest.approx(12.5), 4)
    for file, camera in zip(fact["files"], path.cameras, strict=True):
        assert np.abs(picture(file)[..., :3] - expected(some_splats(), camera)).max() <= 1
    assert fact["nearest"] > 0  # quaternions do not go the long way round between frames
    back = read_path(folder / "exported_path.json")
    assert back.fps == pytest.approx(12.5)
    for left, right in zip(
        (*back.cameras, read_cameras(folder / "exported_cameras.json")[0].camera),
        (*path.cameras, path.cameras[0]),
        strict=True,
    ):
        np.testing.assert_allclose(left.cam_from_world, right.cam_from_world, atol=5e-6)
        assert left.fx == pytest.approx(right.fx, rel=1e-6)


def test_lenses_agree_with_blenders_own_projection(blender: tuple[Path, dict[str, Any]]) -> None:
    """Points are projected as in Blender for every sensor fit, orientation, shift and pixel aspect."""
    points = np.random.default_rng(4).normal(size=(20, 3)) * (1, 1, 0.3) - (0, 0, 5)
    for case in blender[1]["projections"]["cases"]:
        lens, (width, height, aspect_x, aspect_y) = case["lens"], case["raster"]
        camera = camera_of(Lens(*lens[:4], *lens[4:]), Raster(width, height, aspect_x, aspect_y), case["world"])
        world = (np.linalg.inv(case["view"]) @ np.c_[points, np.ones(20)].T).T
        clip = (np.array(case["projection"]) @ np.c_[points, np.ones(20)].T).T
        theirs = (clip[:, :2] / clip[:, 3:] * (0.5, -0.5) + 0.5) * (width, height)
        local = world[:, :3] @ camera.rotation.T + camera.translation
        ours = local[:, :2] / local[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        np.testing.assert_allclose(ours, theirs, atol=1e-3, err_msg=str(case))


def test_faults_stand_in_the_report_area(blender: tuple[Path, dict[str, Any]]) -> None:
    told = blender[1]["faults"]
    for name, word in {
        "no camera": "no camera",
        "orthographic": "is orthographic",
        "panoramic": "is panoramic",
        "stretched": "scaled by",
        "missing": "gone.ply",
        "no PLY": "cameras.json",
        "import": "cameras.json",
        "cameras": "is not JSON",
        "export": "no camera",
    }.items():
        assert word in told[name], f"{name}: {told[name]}"
        assert "Traceback" not in told[name]
    assert picture(told["nothing"])[..., :3].max() == 0
    assert picture(blender[1]["clipped"]["file"])[..., :3].max() == 0


def mean_depth(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth of each pixel, and whether it is opaque."""
    image = Renderer().render(some_splats(), camera)
    return image.depth / np.maximum(image.alpha, 1e-6), image.alpha > 0.98


def plane_depth(camera: Camera) -> float:
    """Return the median depth of the opaque pixels of the left half."""
    depth, opaque = mean_depth(camera)
    return float(np.median(depth[:, : WIDTH // 2][opaque[:, : WIDTH // 2]]))


def test_meshes_and_splats_hide_each_other(blender: tuple[Path, dict[str, Any]]) -> None:
    """A green plane fills the left half of the image and hides the splats behind it, but not those before it."""
    folder, facts = blender
    got = picture(facts["composited"]["file"])[..., :3]
    camera = read_cameras(folder / "cameras.json")[0].camera
    (depth, opaque), plane = mean_depth(camera), plane_depth(camera)
    plain, half = expected(some_splats(), camera), WIDTH // 2
    before, behind = opaque & (depth < plane - 0.01), opaque & (depth > plane + 0.01)
    assert min(before[:, : half - 1].sum(), behind[:, : half - 1].sum()) > 5
    assert np.abs(got - plain)[:, : half - 1][before[:, : half - 1]].max() <= 20
    green = got[:, : half - 1][behind[:, : half - 1]]
    assert green[:, 1].min() > 240
    assert green[:, [0, 2]].max() < 20
    assert np.abs(got - plain)[:, half + 1 :][opaque[:, half + 1 :]].max() <= 6


def test_a_composite_follows_what_changes_after_it(blender: tuple[Path, dict[str, Any]]) -> None:
    """The frame is that of the scene of meshes. Another call keeps nodes and scenes of the user."""
    _, facts = blender
    fact = facts["composited_again"]
    assert "failed" not in fact, fact
    whole, part = picture(facts["composited"]["file"]), picture(fact["file"])
    height, width = whole.shape[:2]
    np.testing.assert_allclose(part, whole[: height - height // 2, width // 4 : width * 3 // 4], atol=1)
    assert fact["kept"] == "Shot splats"
    assert fact["nodes"]
    assert fact["engines"] == ["CYCLES", "CLSPLAT"]
    assert "this is the scene of the splats: go to the scene Shot first" in fact["told"]


def test_the_viewport_shows_the_splats_coarsely_while_moving_then_in_full(blender: tuple[Path, dict[str, Any]]) -> None:
    """The engine draws into an offscreen buffer of Blender, as light in 16-bit reals."""
    folder, _ = blender
    done = child(blenders_python() or "", folder, "viewport")
    if not (folder / "viewport.json").exists():
        pytest.skip(f"Blender has no OpenGL here: {done.stderr.strip().splitlines()[-1:]}")
    fact = json.loads((folder / "viewport.json").read_text())["viewport"]
    assert fact.get("drawn"), fact
    assert "Traceback" not in done.stdout + done.stderr, done.stderr
    first, again, moving, settled = np.load(folder / "viewport.npy")
    camera = read_cameras(folder / "cameras.json")[0].camera
    for drawn, seen in ((first, camera), (again, camera), (settled, aside(camera, 0.1))):
        assert np.abs(255 * encoded(drawn[..., :3]) - expected(some_splats(), seen)).max() <= 2
    assert np.ptp(moving[..., :3], axis=(0, 1)).max() == 0  # a single pixel over the whole region


def aside(camera: Camera, step: float) -> Camera:
    """Return the camera moved by one step to the left."""
    pose = camera.cam_from_world.copy()
    pose[0, 3] += step
    return camera.posed(pose)

"""The Blender add-on: its camera and colours without Blender, and with a real one the same images as `clsplat render`.

The real one is the Python module `bpy` in this Python, or in the one that CLSPLAT_BLENDER_PYTHON names; it runs once,
in a process of its own (blender_child.py).
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runner import clsplat, error_of
from clsplat_blender.lens import Lens, Raster, camera_of, camera_of_matrices, lens_of, matrix_world_of, moved
from clsplat_blender.pictures import NOTHING, Placed, Studio, combined, depths, to_linear
from clsplat_cli.blender_addon import addon_zip
from PIL import Image
from scipy.spatial.transform import Rotation

import clsplat as package
from clsplat.camera import Camera
from clsplat.camera_path import CameraPath, read_path, write_path
from clsplat.cameras_json import NamedCamera, read_cameras, write_cameras
from clsplat.errors import InputError
from clsplat.paths_around import look_at
from clsplat.paths_between import interpolate
from clsplat.placing import joined, placed
from clsplat.render import Rendered, Renderer
from clsplat.splats import Splats

CHILD = Path(__file__).with_name("blender_child.py")
WIDTH, HEIGHT = 96, 64


def facing(angle: float, distance: float = 4.0, off: tuple[float, float] = (0.0, 0.0)) -> Camera:
    place = np.array([distance * math.sin(angle), -0.7, -distance * math.cos(angle)])
    pose = look_at(place, np.zeros(3), np.array([0.0, -1.0, 0.0]))
    return Camera(WIDTH, HEIGHT, 90.0, 90.0, WIDTH / 2 + off[0], HEIGHT / 2 + off[1], pose)


def some_splats(seed: int = 0, shape: str = "skew-normal") -> Splats:
    """A cloud of every colour, with bands of colour and, where the shape has it, skew."""
    rng = np.random.default_rng(seed)
    start = Splats.from_points(rng.normal(0, 0.5, (300, 3)), rng.random((300, 3)), shape, 2, opacity=0.7)
    arrays = start.to_numpy()
    arrays["sh"][:, 1:] = rng.normal(0, 0.15, arrays["sh"][:, 1:].shape)
    arrays["log_scale"] += rng.normal(-0.8, 0.5, arrays["log_scale"].shape)
    arrays["quat"] = rng.normal(size=(300, 4)).astype(np.float32)
    if "skew" in arrays:
        arrays["skew"] = rng.normal(0, 0.4, (300, 3)).clip(-0.7, 0.7).astype(np.float32)
    return Splats(shape, arrays)


# --- lens ----------------------------------------------------------------------------------------


def test_a_pinhole_survives_blenders_values() -> None:
    rng = np.random.default_rng(2)
    for aspect in (1.0, 0.8, 1.3):
        pose = np.hstack([Rotation.random(rng=rng).as_matrix(), rng.normal(size=(3, 1))])
        camera = Camera(70, 50, 60.0, 60.0 / aspect, 31.0, 28.0, pose)
        lens, aspects = lens_of(camera)
        assert min(aspects) == 1.0
        back = camera_of(lens, Raster(70, 50, *aspects), matrix_world_of(camera))
        for key in ("fx", "fy", "cx", "cy"):
            assert getattr(back, key) == pytest.approx(getattr(camera, key), rel=1e-12)
        np.testing.assert_allclose(back.cam_from_world, camera.cam_from_world, atol=1e-12)


def test_a_border_is_a_part_of_the_image() -> None:
    raster = Raster.of_settings(201, 101, 50, border=(0.25, 0.5, 0.75, 1.0))
    assert (raster.width, raster.height) == (100, 50)
    assert raster.pixels == (25, 25, 75, 50)
    assert Raster(100, 50).pixels == (0, 0, 100, 50)


def test_other_cameras_are_refused() -> None:
    for kind, word in (("ORTHO", "orthographic"), ("PANO", "panoramic"), ("CUSTOM", "custom")):
        with pytest.raises(InputError, match=f"Camera is {word}: set its type to Perspective"):
            camera_of(Lens(type=kind), Raster(10, 10), np.eye(4), "Camera")
    sheared = np.eye(4)
    sheared[0, 1] = 1.0
    with pytest.raises(InputError, match=r"Camera: .*rotation"):
        camera_of(Lens(), Raster(10, 10), sheared, "Camera")


def test_the_viewports_matrices_are_a_pinhole() -> None:
    camera = Camera(80, 60, 70.0, 75.0, 35.0, 33.0, facing(0.3).cam_from_world)
    near, far = 0.1, 100.0
    projection = np.array([
        [2 * 70 / 80, 0, 1 - 2 * 35 / 80, 0], [0, 2 * 75 / 60, 2 * 33 / 60 - 1, 0],
        [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)], [0, 0, -1, 0]])  # fmt: skip
    back = camera_of_matrices(np.linalg.inv(matrix_world_of(camera)), projection, 80, 60)
    for key in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(back, key) == pytest.approx(getattr(camera, key))
    np.testing.assert_allclose(back.cam_from_world, camera.cam_from_world, atol=1e-12)
    projection[3] = (0, 0, 0, 1)
    with pytest.raises(InputError, match="orthographic"):
        camera_of_matrices(np.eye(4), projection, 80, 60)


# --- pictures --------------------------------------------------------------------------------------


def encoded(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def test_colours_come_back_through_srgb() -> None:
    values = np.linspace(0, 1.5, 301, dtype=np.float32)
    np.testing.assert_allclose(encoded(to_linear(values).astype(float)), values, atol=2e-6)


def test_combined_is_premultiplied_and_bottom_up() -> None:
    image = Rendered(np.array([[[0.3, 0.2, 0.1]], [[0.0, 0.0, 0.0]]], np.float32), np.array([[0.5], [0.0]], np.float32),
                     np.array([[2.0], [0.0]], np.float32))
    clear = combined(image, None)
    np.testing.assert_allclose(clear[1, 0], [*(0.5 * to_linear(np.float32([0.6, 0.4, 0.2]))), 0.5], rtol=1e-6)
    np.testing.assert_array_equal(clear[0, 0], 0)
    solid = combined(image, (1.0, 0.0, 0.0))
    np.testing.assert_allclose(solid[1, 0], [*to_linear(np.float32([0.8, 0.2, 0.1])), 1], rtol=1e-6)
    np.testing.assert_allclose(combined(image, (1.0, 0.0, 0.0), linear=False)[1, 0], [0.8, 0.2, 0.1, 1], rtol=1e-6)
    np.testing.assert_array_equal(depths(image), np.float32([[NOTHING], [4.0]]))


def test_the_studio_shows_one_object_as_it_is(tmp_path: Path) -> None:
    """One object has the bits of `render`, also where it is turned and scaled and the camera goes along."""
    splats, camera = some_splats(), facing(0.4)
    splats.save(tmp_path / "a.ply")
    studio = Studio()
    expected = Renderer(studio.renderer.device).render(splats, camera)
    plain = studio.render([Placed("a", tmp_path / "a.ply", np.eye(4))], camera)
    np.testing.assert_array_equal(plain.color, expected.color)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2 * Rotation.from_rotvec((0.3, 1, 2)).as_matrix(), (1, 2, 3)
    back = np.linalg.inv(matrix)
    there = moved(camera, 0.5, 2 * back[:3, :3], back[:3, 3])
    image = studio.render([Placed("a", tmp_path / "a.ply", matrix)], there)
    np.testing.assert_allclose(image.color, expected.color, atol=1e-5)
    np.testing.assert_allclose(image.depth, 2 * expected.depth, rtol=1e-4, atol=1e-5)


def test_the_studio_joins_objects_and_reads_changed_files_again(tmp_path: Path) -> None:
    first, second, camera = some_splats(0), some_splats(1, "gaussian"), facing(0.4)
    first.save(tmp_path / "a.ply")
    second.save(tmp_path / "b.ply")
    matrix = np.diag([0.5, 0.5, 0.5, 1.0])
    objects = [Placed("a", tmp_path / "a.ply", np.eye(4)), Placed("b", tmp_path / "b.ply", matrix)]
    studio = Studio()
    renderer = Renderer(studio.renderer.device)
    expected = renderer.render(joined([first, placed(second, matrix)]), camera)
    np.testing.assert_array_equal(studio.render(objects, camera).color, expected.color)
    second.select(range(10)).save(tmp_path / "b.ply")
    fewer = renderer.render(joined([first, placed(second.select(range(10)), matrix)]), camera)
    np.testing.assert_array_equal(studio.render(objects, camera).color, fewer.color)
    assert np.abs(fewer.color - expected.color).max() > 0.1


def test_the_studio_clips_and_shows_nothing_where_nothing_is(tmp_path: Path) -> None:
    splats, camera = some_splats(), facing(0.4)
    splats.save(tmp_path / "a.ply")
    item, studio = Placed("a", tmp_path / "a.ply", np.eye(4)), Studio()
    depth = splats.mean @ camera.rotation[2] + camera.translation[2]
    expected = Renderer(studio.renderer.device).render(splats.select(depth <= 4.0), camera)
    np.testing.assert_array_equal(studio.render([item], camera, (0.0, 4.0)).color, expected.color)
    assert studio.render([item], camera, (0.0, 0.1)).alpha.max() == 0
    assert studio.render([], camera).color.shape == (HEIGHT, WIDTH, 3)


def test_the_studio_names_the_object_at_fault(tmp_path: Path) -> None:
    some_splats().save(tmp_path / "a.ply")
    with pytest.raises(InputError, match=r"thing: .*b\.ply: No such file"):
        Studio().render([Placed("thing", tmp_path / "b.ply", np.eye(4))], facing(0))
    with pytest.raises(InputError, match=r"thing: its axes are scaled by 1, 2, 1"):
        Studio().render([Placed("thing", tmp_path / "a.ply", np.diag([1.0, 2.0, 1.0, 1.0]))], facing(0))


# --- the zip ------------------------------------------------------------------------------------------


def test_the_zip_holds_the_add_on(tmp_path: Path) -> None:
    out = clsplat("blender-addon", "-o", tmp_path / "a.zip")
    assert str(tmp_path / "a.zip") in out
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        names = set(archive.namelist())
        about = tomllib.loads(archive.read("blender_manifest.toml").decode())
    assert {"__init__.py", "engine.py", "lens.py", "blender_manifest.toml"} <= names
    assert (about["id"], about["version"], about["type"]) == ("clsplat", package.__version__, "add-on")
    assert "wheels" not in about
    assert (tmp_path / "a.zip").read_bytes() == addon_zip([])


def test_the_zip_takes_wheels(tmp_path: Path) -> None:
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    assert "no wheel of clsplat" in error_of("blender-addon", "-o", tmp_path / "a.zip", "--wheels", wheels)
    for name in ("clsplat-0.1.0-py3-none-any", "numpy-2.0-cp311-cp311-manylinux_2_17_x86_64",
                 "pyopencl-2026.1-cp311-cp311-manylinux_2_28_x86_64"):
        (wheels / f"{name}.whl").write_bytes(b"wheel")
    clsplat("blender-addon", "-o", tmp_path / "a.zip", "--wheels", wheels)
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        about = tomllib.loads(archive.read("blender_manifest.toml").decode())
        for path in about["wheels"]:
            assert archive.read(path.removeprefix("./")) == b"wheel"
    assert [path.split("/")[-1].split("-")[0] for path in about["wheels"]] == ["clsplat", "pyopencl"]
    assert about["platforms"] == ["linux-x64"]
    assert "no such folder" in error_of("blender-addon", "--wheels", tmp_path / "none", "-o", tmp_path / "b.zip")


# --- a real Blender --------------------------------------------------------------------------------------


def blenders_python() -> str | None:
    """A Python that has bpy."""
    python = os.environ.get("CLSPLAT_BLENDER_PYTHON", sys.executable)
    asking = "import importlib.util, sys; sys.exit(importlib.util.find_spec('bpy') is None)"
    found = subprocess.run([python, "-c", asking], check=False, capture_output=True)
    return python if found.returncode == 0 else None


@pytest.fixture(scope="module")
def blender(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The child's folder, and what it found."""
    python = blenders_python()
    if python is None:
        pytest.skip("bpy is not installed: pip install bpy==5.0.* for Python 3.11, or set CLSPLAT_BLENDER_PYTHON")
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
    return subprocess.run([python, CHILD, folder, *cases], check=False, capture_output=True, text=True, timeout=300,
                          env=os.environ | {"CLSPLAT_BUILD_OPTIONS": ""})


def picture(path: Path | str) -> np.ndarray:
    return np.asarray(Image.open(path)).astype(int)


def expected(splats: Splats, camera: Camera, background: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """As `clsplat render` writes it."""
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
    """Within one step of 255, through Blender's light and back: cameras with and without shift, an upright object, and
    one that is turned, scaled and moved with its cameras."""
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
    both = joined([some_splats(), placed(some_splats(1, "gaussian"), facts["together"]["matrix"])])
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
    for left, right in zip((*back.cameras, read_cameras(folder / "exported_cameras.json")[0].camera),
                           (*path.cameras, path.cameras[0]), strict=True):
        np.testing.assert_allclose(left.cam_from_world, right.cam_from_world, atol=5e-6)
        assert left.fx == pytest.approx(right.fx, rel=1e-6)


def test_lenses_agree_with_blenders_own_projection(blender: tuple[Path, dict[str, Any]]) -> None:
    """Every sensor fit, portrait and landscape, shift and pixel aspect: points land where Blender puts them."""
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
    for name, word in {"no camera": "no camera", "orthographic": "is orthographic", "panoramic": "is panoramic",
                       "stretched": "scaled by", "missing": "gone.ply", "no PLY": "cameras.json",
                       "import": "cameras.json", "cameras": "no JSON", "export": "no camera"}.items():  # fmt: skip
        assert word in told[name], f"{name}: {told[name]}"
        assert "Traceback" not in told[name]
    assert picture(told["nothing"])[..., :3].max() == 0
    assert picture(blender[1]["clipped"]["file"])[..., :3].max() == 0


def mean_depth(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Of the splats by pixel, and where they are opaque."""
    image = Renderer().render(some_splats(), camera)
    return image.depth / np.maximum(image.alpha, 1e-6), image.alpha > 0.98


def plane_depth(camera: Camera) -> float:
    """A depth with as many opaque pixels of the left half before it as behind."""
    depth, opaque = mean_depth(camera)
    return float(np.median(depth[:, : WIDTH // 2][opaque[:, : WIDTH // 2]]))


def test_meshes_and_splats_hide_each_other(blender: tuple[Path, dict[str, Any]]) -> None:
    """The left half of the image has a green plane: splats before it are seen, those behind are not."""
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


def test_the_viewport_shows_the_splats_coarsely_while_moving_then_in_full(blender: tuple[Path, dict[str, Any]]) -> None:
    """The engine's own drawing into Blender's offscreen buffer, read back: light, in 16-bit reals, which Blender
    turns into display values when the region is done."""
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
    """The camera, seeing everything a step further to the right."""
    pose = camera.cam_from_world.copy()
    pose[0, 3] += step
    return camera.posed(pose)

"""Undistorted and refused lenses, and damaged model files."""

from __future__ import annotations

import codecs
import os
import shutil
import signal
import struct
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_scene import CX, CY, FX, FY, HEIGHT, WIDTH, as_text, cloud, model_views, write_garden

from clsplat.errors import InputError
from clsplat.scenes import undistort
from clsplat.scenes.colmap import Points, read_model
from clsplat.scenes.colmap_binary import check_binary_model, write_binary_model
from clsplat.scenes.export import write_transforms
from clsplat.scenes.few_photos import few_photos
from clsplat.scenes.info import scene_info
from clsplat.scenes.photo_listing import is_posed
from clsplat.scenes.point_cloud import write_point_cloud
from clsplat.scenes.posed_images import read_colmap
from clsplat.scenes.reconstruct.photo_files import is_photographs
from clsplat.scenes.scene import load_scene
from clsplat.scenes.undistort import RegisteredImage, make_lens


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small scene."""
    return write_garden(tmp_path)


# --- where the files lie ---


@pytest.mark.parametrize("photos", ["images", "."])
@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_a_model_beside_its_photos(folder: Path, photos: str, suffix: str) -> None:
    """RealityScan writes a text model into the folder of the photos."""
    wanted = load_scene(folder)
    if suffix == ".bin":
        for file in (folder / "sparse" / "0").iterdir():
            shutil.move(file, folder)
    else:
        as_text(folder / "sparse" / "0", folder)
    shutil.rmtree(folder / "sparse")
    if photos == ".":
        shutil.copytree(folder / "images", folder, dirs_exist_ok=True)
        shutil.rmtree(folder / "images")
    scene, info = load_scene(folder), scene_info(folder)
    assert scene.names == wanted.names
    for view, same in zip(scene.train, wanted.train, strict=True):
        np.testing.assert_allclose(view.camera.cam_from_world, same.camera.cam_from_world, atol=1e-9)
        assert (view.image == same.image).all()
    np.testing.assert_allclose(scene.points.xyz, wanted.points.xyz)
    assert (info.kind, info.photos, info.unregistered) == ("COLMAP", len(wanted.names), ())
    assert not is_photographs(folder), "train does not look for poses"
    assert is_posed(folder)
    assert len(few_photos(scene, 3).points) <= len(scene.points)


def test_an_empty_folder_of_models_hides_no_other_cameras(folder: Path) -> None:
    posed = read_colmap(folder, None)
    names = [f"images/{name}" for name in posed.names]
    write_transforms(folder / "transforms.json", posed.photos, names, posed.points)
    shutil.rmtree(folder / "sparse")
    (folder / "sparse" / "0").mkdir(parents=True)
    assert load_scene(folder).names == names
    assert scene_info(folder).kind == "transforms.json"
    (folder / "sparse" / "0" / "cameras.bin").touch()
    with pytest.raises(InputError, match="no COLMAP model"):
        load_scene(folder)


def lacking(model: Path, target: Path, suffix: str, *, image: bool) -> None:
    """Write a model whose points name an image that it lacks, or observations that an image lacks."""
    as_text(model, target)
    head, body = [], []
    for line in (target / "images.txt").read_text().splitlines():
        (head if line.startswith("#") else body).append(line)
    body = body[2:] if image else [body[0], "", *body[2:]]
    if suffix == ".txt":
        (target / "images.txt").write_text("\n".join(head + body) + "\n")
        return
    shutil.copytree(model, target, dirs_exist_ok=True)
    for file in target.glob("*.txt"):
        file.unlink()
    views = model_views()[::-1]
    first = replace(views[0], pixels=np.empty((0, 2)), point_index=np.empty(0, np.int64))
    points = (target / "points3D.bin").read_bytes()
    write_binary_model(target, views[:-1] if image else [first, *views[1:]], *cloud())
    (target / "points3D.bin").write_bytes(points)


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("image", [True, False])
def test_points_that_name_what_the_model_lacks(folder: Path, tmp_path: Path, suffix: str, image: bool) -> None:
    """People remove images from a model and leave its points as they are."""
    wanted, changed = load_scene(folder), tmp_path / "changed"
    shutil.copytree(folder / "images", changed / "images")
    lacking(folder / "sparse" / "0", changed / "sparse" / "0", suffix, image=image)
    with pytest.warns(UserWarning, match="its points or frames name images or observations that the model lacks"):
        scene = load_scene(changed)
    assert len(scene.views) == len(wanted.views) - image
    by_name = {view.name: view for view in wanted.views}
    for view in scene.views:
        expected = by_name[view.name].camera
        np.testing.assert_allclose(view.camera.cam_from_world, expected.cam_from_world, atol=1e-9)
        assert (view.camera.fx, view.camera.cx) == (expected.fx, expected.cx)
    np.testing.assert_allclose(scene.points.xyz, wanted.points.xyz)
    assert (scene.points.rgb == wanted.points.rgb).all()
    lost = wanted.points.track_length - scene.points.track_length
    assert lost.sum() == (8 if image else 0), "tracks without the observations of the image that is gone"
    with pytest.warns(UserWarning, match="its points or frames"):
        seen = few_photos(scene, 3).points
    assert 0 < len(seen) <= len(scene.points)


def test_frames_of_images_that_are_gone(folder: Path) -> None:
    """A text model of COLMAP 3.12 without points names its images in frames.txt, too."""
    model = folder / "sparse" / "0"
    as_text(model, model)
    for file in model.glob("*.bin"):
        file.unlink()
    lines = [line for line in (model / "images.txt").read_text().splitlines() if not line.startswith("#")]
    (model / "images.txt").write_text("\n".join(lines[2:]) + "\n")
    (model / "points3D.txt").write_text("")
    assert (model / "frames.txt").is_file()
    with pytest.warns(UserWarning, match="its points or frames"):
        assert len(load_scene(folder).views) == len(lines) // 2 - 1


@pytest.mark.parametrize("n_short", [1, 2, 100], ids=["one", "two", "all"])
@pytest.mark.parametrize("points", [True, False], ids=["points", "no points"])
def test_images_without_a_line_of_observations(folder: Path, n_short: int, points: bool) -> None:
    """Other programs leave the second line of an image out if it would be empty; COLMAP would skip the next image."""
    wanted, model = load_scene(folder), folder / "sparse" / "0"
    as_text(model, model)
    for file in [*model.glob("*.bin"), *model.glob("frames.*"), *model.glob("rigs.*")]:
        file.unlink()
    lines = [line for line in (model / "images.txt").read_text().splitlines() if not line.startswith("#")]
    short = [
        line for number in range(0, len(lines), 2) for line in lines[number : number + 1 + (number >= 2 * n_short)]
    ]
    (model / "images.txt").write_text("# all images\n" + "\n".join(short))
    if not points:
        (model / "points3D.txt").unlink()
    with pytest.warns(UserWarning, match="its points or frames") if points else nullcontext():
        scene = load_scene(folder)
    assert scene.names == wanted.names
    for view, expected in zip(scene.views, wanted.views, strict=True):
        np.testing.assert_allclose(view.camera.cam_from_world, expected.camera.cam_from_world, atol=1e-9)
    assert len(scene.points) == (len(wanted.points) if points else 0)


def test_names_of_three_words_without_a_line_of_observations(folder: Path) -> None:
    """Such a line has as many words as four observations."""
    wanted, model = load_scene(folder), folder / "sparse" / "0"
    as_text(model, model)
    for file in [*model.glob("*.bin"), *model.glob("frames.*"), *model.glob("rigs.*"), model / "points3D.txt"]:
        file.unlink()
    lines = [line for line in (model / "images.txt").read_text().splitlines() if not line.startswith("#")][::2]
    for name in wanted.names:
        (folder / "images" / name).rename(folder / "images" / f"my garden {name}")
    renamed = [line.replace(line.split()[-1], f"my garden {line.split()[-1]}") for line in lines]
    (model / "images.txt").write_text("\n".join(renamed))
    assert load_scene(folder).names == [f"my garden {name}" for name in wanted.names]


def test_the_last_pose_may_end_without_a_line_end(folder: Path, recwarn: pytest.WarningsRecorder) -> None:
    model = folder / "sparse" / "0"
    as_text(model, model)
    for file in model.glob("*.bin"):
        file.unlink()
    lines = [line for line in (model / "images.txt").read_text().splitlines() if not line.startswith("#")]
    poses = "\n".join(line for pose in lines[::2] for line in (pose, ""))
    (model / "images.txt").write_text(poses.rstrip("\n"))
    (model / "points3D.txt").write_text("")
    assert len(load_scene(folder).views) == len(lines) // 2
    assert not [warning for warning in recwarn if "points or frames" in str(warning.message)]


def test_frames_without_rigs(folder: Path, recwarn: pytest.WarningsRecorder) -> None:
    """Such a file is left when only some files of a model are copied. Nothing is lost, because images have poses."""
    wanted, model = load_scene(folder), folder / "sparse" / "0"
    as_text(model, model)
    for file in [*model.glob("*.bin"), *model.glob("rigs.*")]:
        file.unlink()
    assert (model / "frames.txt").is_file()
    scene = load_scene(folder)
    assert scene.names == wanted.names
    assert not [warning for warning in recwarn if "points or frames" in str(warning.message)]


CAMERA, IMAGE, POINT = "1 PINHOLE 40 30 50 50 20 15", "1 1 0 0 0 0 0 0 1 a.png\n", "1 0 0 0 9 9 9 0.5"


@pytest.mark.parametrize(
    ("file", "text", "fault"),
    [
        ("cameras.txt", "1 OPENCV 40 30 50 50 20 15 0 0 0 0 0", "line 2: OPENCV has 9 parameters instead of 8 (fx, fy"),
        ("cameras.txt", "1 PINHOLE 40 30 50 50 20", "line 2: PINHOLE has 3 parameters instead of 4 (fx, fy, cx, cy)"),
        ("cameras.txt", "1 pinhole 40 30 50 50 20 15", "line 2: COLMAP has no camera model 'pinhole'"),
        ("cameras.txt", "1 PINHOLE 40.0 30 50 50 20 15", "line 2 is no camera (ID MODEL WIDTH HEIGHT PARAMETERS"),
        ("cameras.txt", "1 PINHOLE 40 30 50, 50, 20, 15", "line 2: the parameter '50,' is not a number"),
        ("cameras.txt", "The cameras of this scene:", "line 2 is no camera (ID MODEL WIDTH HEIGHT PARAMETERS"),
        ("images.txt", "1 1 0 0 0 0 0 0 a.png\n", "'1 1 0 0 0 0 0 0 a.png' is no image (ID QW QX QY QZ TX TY TZ"),
        ("images.txt", "1 1 0 0 0 0 0 zero 1 a.png\n", "'1 1 0 0 0 0 0 zero 1 a.png' is no image (ID QW QX QY QZ TX"),
        ("points3D.txt", "1 0 0 0 9 9 9", "line 2 is no point (ID X Y Z R G B ERROR TRACK"),
        ("points3D.txt", "1 0 0 0 0.5 0.5 0.5 1", "line 2 is no point (ID X Y Z R G B ERROR TRACK"),
    ],
)  # fmt: skip
def test_text_of_a_wrong_form_names_the_line(tmp_path: Path, file: str, text: str, fault: str) -> None:
    texts = {"cameras.txt": CAMERA, "images.txt": IMAGE, "points3D.txt": POINT} | {file: text}
    for name, content in texts.items():
        (tmp_path / name).write_text(f"# a comment\n{content}\n")
    with pytest.raises(InputError) as error:
        read_model(tmp_path)
    assert str(error.value).startswith(f"{tmp_path / file}: {fault}"), str(error.value)
    assert str(error.value).endswith(": correct it, or write the model again")


def test_text_with_a_byte_order_mark(folder: Path) -> None:
    """Editors of Windows write one."""
    wanted, model = load_scene(folder), folder / "sparse" / "0"
    as_text(model, model)
    for file in model.iterdir():
        if file.suffix == ".bin":
            file.unlink()
        else:
            file.write_bytes(codecs.BOM_UTF8 + file.read_bytes())
    scene = load_scene(folder)
    assert scene.names == wanted.names
    assert (scene.points.track_length == wanted.points.track_length).all()


def test_a_model_without_photos_is_no_scene(folder: Path) -> None:
    """The folder of a model is a part of the scene above."""
    assert not is_posed(folder / "sparse" / "0")
    with pytest.raises(InputError, match="is a part of the scene"):
        load_scene(folder / "sparse" / "0")


def test_points_of_a_ply_beside_the_model(folder: Path) -> None:
    """InstantSplat writes no points3D.bin. A model's own points come before those of a PLY."""
    model, points = folder / "sparse" / "0", load_scene(folder).points
    other = Points(points.xyz[:5] + 1.0, points.rgb[:5], points.track_length[:5])
    write_point_cloud(model / "points3D.ply", other)
    assert len(load_scene(folder).points) == len(points)
    (model / "points3D.bin").unlink()
    found = load_scene(folder).points
    np.testing.assert_allclose(found.xyz, other.xyz, rtol=1e-6)
    assert (found.rgb == other.rgb).all()


# --- lenses --------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", [300, 205, 148, -0.2]),
        ("RADIAL", [300, 205, 148, 0.15, 0.02]),
        ("OPENCV", [300, 310, 190, 155, -0.2, 0.05, 0.002, -0.003]),
        ("OPENCV_FISHEYE", [200, 205, 202, 149, 0.02, 0.01, 0, 0]),
    ],
)
def test_undistorted_photo_shows_points_where_its_camera_projects_them(
    model: str, params: list[float], scale: float
) -> None:
    """Dots drawn at the lens's projections must appear at the pinhole camera's projections."""
    import pycolmap

    lens = pycolmap.Camera(model=model, width=400, height=300, params=params)
    rays = np.array([(x, y) for y in np.linspace(-0.35, 0.35, 5) for x in np.linspace(-0.5, 0.5, 7)])
    y, x = np.mgrid[: int(300 * scale), : int(400 * scale)] + 0.5
    image = np.zeros(x.shape)
    for ray in rays:
        at = np.ravel(lens.img_from_cam(np.array([[*ray, 1.0]]))) * scale
        image += 200 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 4.5)
    picture = np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    flat, camera = RegisteredImage("dots", np.eye(4), lens).fit(picture)
    assert flat.shape == (camera.height, camera.width, 3)
    checked = 0
    for ray in rays:
        expected = ray * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        if (expected < 9).any() or (expected > np.array([camera.width, camera.height]) - 9).any():
            continue
        column, row = expected.astype(int)
        window = flat[row - 6 : row + 7, column - 6 : column + 7, 0].astype(float)
        rows, columns = np.mgrid[row - 6 : row + 7, column - 6 : column + 7] + 0.5
        centroid = np.array([(columns * window).sum(), (rows * window).sum()]) / window.sum()
        assert np.linalg.norm(centroid - expected) < 0.15
        checked += 1
    assert checked >= 15
    assert (flat[:4].sum(), flat[-4:].sum()) == (0, 0)  # ground and border are black


def _radial(r2: np.ndarray, *k: float) -> np.ndarray:
    return 1 + sum(c * r2 ** (power + 1) for power, c in enumerate(k))


def _fisheye(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the equidistant projection: the distance from the centre is the angle from the axis."""
    r = np.hypot(x, y)
    factor = np.where(r > 0, np.arctan(r) / np.where(r > 0, r, 1), 1.0)
    return factor * x, factor * y


def _project(model: str, p: list[float], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return pixels of rays (x, y, 1) by the formulas of https://colmap.github.io/cameras.html, in float64."""
    if model == "FOV":  # fx fy cx cy omega (Devernay & Faugeras 2001)
        r = np.hypot(x, y)
        distorted = np.arctan(2 * r * np.tan(p[4] / 2)) / p[4]
        factor = np.where(r > 0, distorted / np.where(r > 0, r, 1), 2 * np.tan(p[4] / 2) / p[4])
        return np.stack([p[0] * factor * x + p[2], p[1] * factor * y + p[3]], axis=-1)
    shared = model in ("SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")  # one focal length
    fx, fy, cx, cy = (p[0], p[0], p[1], p[2]) if shared else p[:4]
    k = p[3:] if shared else p[4:]
    if "FISHEYE" in model:
        x, y = _fisheye(x, y)
    r2, xy = x * x + y * y, x * y
    if model in ("SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"):
        u, v = x * _radial(r2, *k), y * _radial(r2, *k)
    elif model == "OPENCV":  # k1 k2 p1 p2
        u = x * _radial(r2, *k[:2]) + 2 * k[2] * xy + k[3] * (r2 + 2 * x * x)
        v = y * _radial(r2, *k[:2]) + 2 * k[3] * xy + k[2] * (r2 + 2 * y * y)
    elif model == "FULL_OPENCV":  # k1 k2 p1 p2 k3 k4 k5 k6
        ratio = _radial(r2, k[0], k[1], k[4]) / _radial(r2, *k[5:])
        u = x * ratio + 2 * k[2] * xy + k[3] * (r2 + 2 * x * x)
        v = y * ratio + 2 * k[3] * xy + k[2] * (r2 + 2 * y * y)
    else:  # THIN_PRISM_FISHEYE: k1 k2 p1 p2 k3 k4 s1 s2
        radial = _radial(r2, k[0], k[1], k[4], k[5])
        u = x * radial + 2 * k[2] * xy + k[3] * (r2 + 2 * x * x) + k[6] * r2
        v = y * radial + 2 * k[3] * xy + k[2] * (r2 + 2 * y * y) + k[7] * r2
    return np.stack([fx * u + cx, fy * v + cy], axis=-1)


LENSES = {
    "SIMPLE_RADIAL": [300, 205, 148, -0.15],
    "RADIAL": [300, 205, 148, 0.1, 0.02],
    "OPENCV": [300, 310, 190, 155, -0.2, 0.05, 0.002, -0.003],
    "FULL_OPENCV": [300, 310, 190, 155, -0.2, 0.05, 0.002, -0.003, 0.01, 0.02, -0.01, 0.003],
    "OPENCV_FISHEYE": [200, 205, 202, 149, 0.02, 0.01, -0.005, 0.001],
    "SIMPLE_RADIAL_FISHEYE": [200, 205, 149, 0.03],
    "RADIAL_FISHEYE": [200, 205, 149, 0.03, -0.01],
    "THIN_PRISM_FISHEYE": [200, 205, 202, 149, 0.02, 0.01, 0.002, -0.001, 0.003, 0.001, 0.002, -0.002],
    "FOV": [220, 225, 202, 149, 0.9],
}


@pytest.mark.parametrize("model", LENSES)
def test_every_lens_is_undistorted_by_its_formula(model: str) -> None:
    """A smooth pattern, drawn along rays: each pixel of the pinhole image shows its own ray's value.

    Nothing of the library is in the expectation: the photo is drawn by inverting the formula here, the expected image
    along the rays of the camera that comes back.
    """

    def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 127.5 + 60 * np.sin(9 * x + 2 * y) + 60 * np.cos(8 * y - 3 * x)

    def invert(pixels: np.ndarray) -> np.ndarray:
        """Return rays by Newton's method with difference quotients, starting at the centre."""
        rays = np.zeros(pixels.shape)
        for share in (0.25, 0.5, 0.75, *[1.0] * 6):
            target = centre + share * (pixels - centre)
            h = 1e-6
            at = _project(model, p, rays[..., 0], rays[..., 1])
            dx = (_project(model, p, rays[..., 0] + h, rays[..., 1]) - at) / h
            dy = (_project(model, p, rays[..., 0], rays[..., 1] + h) - at) / h
            step = np.linalg.solve(np.stack([dx, dy], axis=-1), (target - at)[..., None])[..., 0]
            rays = rays + step
        return rays

    pixel_sizes = 3 if model.startswith(("SIMPLE", "RADIAL")) else 4
    p = [value / 2 if place < pixel_sizes else float(value) for place, value in enumerate(LENSES[model])]
    centre = _project(model, p, np.zeros(()), np.zeros(()))
    pixels = np.stack(np.meshgrid(np.arange(200) + 0.5, np.arange(150) + 0.5), axis=-1)
    rays = invert(pixels)
    np.testing.assert_allclose(_project(model, p, rays[..., 0], rays[..., 1]), pixels, atol=1e-6)
    picture = np.rint(pattern(rays[..., 0], rays[..., 1])).astype(np.uint8)
    photo = RegisteredImage("pattern", np.eye(4), make_lens(model, 200, 150, p))
    flat, camera = photo.fit(np.repeat(picture[..., None], 3, axis=2))
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    x, y = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    at = _project(model, p, x, y)
    inside = ((at > 1) & (at < (199, 149))).all(axis=-1)
    assert inside.mean() > 0.9
    off = np.abs(flat[..., 0] - pattern(x, y))[inside]
    assert off.mean() < 0.7  # two roundings alone give a mean of 0.35
    assert off.max() < 5  # bilinear interpolation; an error of half a pixel would give a mean of 4
    mask = photo.fit_mask(picture > 127, 200, 150)
    sure = inside & (np.abs(pattern(x, y) - 127.5) > 12)
    np.testing.assert_array_equal(mask[sure], (pattern(x, y) > 127.5)[sure])


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("PINHOLE", [300, 310, 190, 155]),
        ("OPENCV", [300, 310, 190, 155, -0.2, 0.05, 0.002, -0.003]),
        ("OPENCV_FISHEYE", [200, 205, 202, 149, 0.02, 0.01, 0, 0]),
    ],
)
@pytest.mark.parametrize("reduced", [1, 2])
def test_mask_follows_the_photo(model: str, params: list[float], reduced: int) -> None:
    """A mask that thresholds the photo also thresholds the fitted photo, except along edges."""
    import pycolmap

    photo = RegisteredImage("disc", np.eye(4), pycolmap.Camera(model=model, width=400, height=300, params=params))
    y, x = np.mgrid[:300, :400] // reduced * reduced
    mask = ((x - 120) ** 2 + (y - 100) ** 2 < 90**2) | (x > 330)
    flat, camera = photo.fit(np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2))
    fitted = photo.fit_mask(mask[::reduced, ::reduced], 400, 300)
    assert fitted.dtype == bool
    assert fitted.shape == (camera.height, camera.width)
    assert not (fitted[flat[..., 0] == 0]).any()
    assert fitted[flat[..., 0] == 255].all()
    assert 0.2 < fitted.mean() < 0.6


def test_mask_is_false_outside_the_photo() -> None:
    import pycolmap

    # This lens leaves a thin strip of the fitted image blank.
    params = [300, 310, 190, 155, -0.2, 0.05, 0.002, -0.003]
    photo = RegisteredImage("sliver", np.eye(4), pycolmap.Camera(model="OPENCV", width=400, height=300, params=params))
    white, _ = photo.fit(np.full((300, 400, 3), 255, np.uint8))
    fitted = photo.fit_mask(np.ones((300, 400), bool), 400, 300)
    assert 0 < (~fitted).sum() < 100
    np.testing.assert_array_equal(fitted, white[..., 0] == 255)
    with pytest.raises(InputError, match=r"its mask is 300x400 px, the photo 400x300"):
        photo.fit_mask(np.ones((400, 300), bool), 400, 300)


def test_mask_is_false_beyond_each_side_of_the_photo(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few lenses leave a side blank, so the places in the photo are made here: one beyond each side, and one inside."""
    across = np.array([[-3.0, 0.4, 399.6, 403.0, 200.0, 200.0, 200.0, 200.0, 200.0, np.nan]])
    down = np.array([[150.0, 150.0, 150.0, 150.0, -3.0, 0.4, 299.6, 303.0, 150.0, 150.0]])
    monkeypatch.setattr(undistort, "_seen_from", lambda flat, lens: (across, down))
    photo = RegisteredImage("sides", np.eye(4), make_lens("SIMPLE_RADIAL", 400, 300, [300, 200, 150, 0.1]))
    fitted = photo.fit_mask(np.ones((300, 400), bool), 400, 300)
    np.testing.assert_array_equal(np.flatnonzero(fitted), [8])


def test_zero_distortion_is_a_plain_pinhole() -> None:
    import pycolmap

    lens = pycolmap.Camera(model="OPENCV", width=40, height=30, params=[30, 31, 18, 16, 0, 0, 0, 0])
    image = np.random.default_rng(0).integers(0, 256, (30, 40, 3)).astype(np.uint8)
    same, camera = RegisteredImage("plain", np.eye(4), lens).fit(image)
    np.testing.assert_array_equal(same, image)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30, 31, 18, 16)


def test_distorted_scene_loads(folder: Path) -> None:
    cameras = folder / "sparse" / "0" / "cameras.bin"
    cameras.write_bytes(struct.pack("<QIiQQ4d", 1, 1, 2, WIDTH, HEIGHT, FX, CX, CY, -0.1))
    view = load_scene(folder).views[0]
    assert view.camera.fx == view.camera.fy == pytest.approx(FX)
    assert view.image.shape == (view.camera.height, view.camera.width, 3)
    assert (view.camera.width, view.camera.height) != (WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("model", "params", "word"),
    [
        (17, [40.0, 30.0], "EQUIRECTANGULAR"),
        (1, [np.nan, FY, CX, CY], "not finite"),
        (99, [1.0] * 4, "model id 99"),
        (1, [-FX, FY, CX, CY], "focal"),
    ],
)
def test_unusable_lens_is_refused(folder: Path, model: int, params: list[float], word: str) -> None:
    cameras = folder / "sparse" / "0" / "cameras.bin"
    cameras.write_bytes(struct.pack(f"<QIiQQ{len(params)}d", 1, 1, model, WIDTH, HEIGHT, *params))
    with pytest.raises(InputError, match=word) as error:
        load_scene(folder)
    assert "\n" not in str(error.value)


# --- damage ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    """Return the bytes of one model as pycolmap writes it, with rigs and frames, by suffix of the files."""
    import pycolmap

    root = tmp_path_factory.mktemp("whole")
    write_binary_model(root / "ours", model_views()[:4], *cloud())
    model = pycolmap.Reconstruction(str(root / "ours"))
    files: dict[str, dict[str, bytes]] = {}
    for suffix, write in ((".bin", model.write_binary), (".txt", model.write_text)):
        (root / suffix).mkdir()
        write(str(root / suffix))
        files[suffix] = {file.name: file.read_bytes() for file in (root / suffix).iterdir()}
    return files


def _put(folder: Path, files: dict[str, bytes]) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_every_truncation_is_refused(whole: dict[str, dict[str, bytes]], tmp_path: Path, name: str) -> None:
    files = whole[".bin"]
    check_binary_model(_put(tmp_path / "m", files))
    for end in range(0, len(files[name]), 7):
        (tmp_path / "m" / name).write_bytes(files[name][:end])
        with pytest.raises(InputError, match=name):
            read_model(tmp_path / "m")
    (tmp_path / "m" / name).write_bytes(files[name] + b"\0")
    with pytest.raises(InputError, match="1 bytes follow"):
        read_model(tmp_path / "m")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_wrong_counts_are_refused(whole: dict[str, dict[str, bytes]], tmp_path: Path, name: str) -> None:
    content = whole[".bin"][name]
    count = struct.unpack_from("<Q", content)[0]
    for lie in (0, count - 1, count + 1, 1 << 40, (1 << 64) - 1):
        if lie != count:
            damaged = struct.pack("<Q", lie) + content[8:]
            with pytest.raises(InputError, match=name):
                read_model(_put(tmp_path / "m", {**whole[".bin"], name: damaged}))


@pytest.mark.filterwarnings("ignore:.*its points or frames")
@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_gives_a_model_or_a_message(
    whole: dict[str, dict[str, bytes]], tmp_path: Path, suffix: str, data: st.DataObject
) -> None:
    files = whole[suffix]
    name = data.draw(st.sampled_from(sorted(files)))
    content = bytearray(files[name])
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    message = ""
    try:
        model = read_model(_put(tmp_path / "m", {**files, name: bytes(content)}))
    except InputError as error:
        message = str(error)
    assert "\n" not in message
    assert message or np.isfinite(model.points.xyz).all()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes")
def test_a_pipe_in_the_model_s_folder_is_not_opened(folder: Path) -> None:
    """Opening it would wait for ever. A points file that cannot be read counts as missing."""
    points = folder / "sparse" / "0" / "points3D.bin"
    expected = load_scene(folder).names
    points.unlink()
    os.mkfifo(points)
    before = signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(20)
    try:
        assert load_scene(folder).names == expected
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def _too_long(number: int, frame: object) -> None:
    pytest.fail("waits for the content of a pipe")

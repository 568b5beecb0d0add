"""OPF projects: poses, lenses and points against the formulas of the format, and refused files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import photogrammetry_files as made
import pytest
from cli_runner import error_of

from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.scenes.info import scene_info
from clsplat.scenes.scene import load_scene, read_posed_images

PIXEL = 1e-6  # px
CAMERAS = "calibration/cameras.json"
LIST = "camera-list.json"


def write_photos(folder: Path) -> None:
    for index, name in enumerate(made.NAMES):
        write_png(folder / name, np.full((made.HEIGHT, made.WIDTH, 3), 20 * index, np.uint8))


def write(folder: Path, project: made.OpfProject | None = None, shift: tuple[float, float, float] = (0, 0, 0)) -> Path:
    """Write a project with photos, and tracks of lengths 2, 3, 4, ... Returns the project's folder."""
    write_photos(folder / "images")
    xyz, rgb = made.points()
    lengths = [2 + index % 5 for index in range(len(xyz))]
    made.write_opf_cloud(folder / "calibration" / "tracks.gltf", xyz, rgb, lengths, shift)
    (project or made.opf_project()).write(folder)
    return folder


def assert_same_pixels(folder: Path, pixels: Callable[[np.ndarray], np.ndarray], within: float = PIXEL) -> None:
    posed = read_posed_images(folder, None)
    assert posed.names == made.NAMES
    xyz, _ = made.points()
    for photo, shot in zip(posed.photos, made.shots(), strict=True):
        local = xyz @ photo.cam_from_world[:3, :3].T + photo.cam_from_world[:3, 3]
        assert (local[:, 2] > 0).all()
        np.testing.assert_allclose(photo.lens.img_from_cam(local), pixels(shot.local(xyz)), rtol=0, atol=within)


def test_points_land_on_the_pixels_of_the_format(tmp_path: Path) -> None:
    assert_same_pixels(write(tmp_path), lambda local: made.opf_pixels(made.PERSPECTIVE, local))


def test_a_fisheye_of_odd_powers_is_exact(tmp_path: Path) -> None:
    project = made.opf_project(made.FISHEYE)
    assert_same_pixels(write(tmp_path, project), lambda local: made.opf_pixels(made.FISHEYE, local))
    assert read_posed_images(tmp_path, None).photos[0].lens.model.name == "OPENCV_FISHEYE"


def test_a_fisheye_with_a_square_term_is_close(tmp_path: Path) -> None:
    lens = made.FISHEYE | {"polynomial": [0.0, 1.0, 0.0152646, -0.161096]}
    assert_same_pixels(write(tmp_path, made.opf_project(lens)), lambda local: made.opf_pixels(lens, local), 0.01)


def test_the_scene_is_loaded(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path / "survey"))
    assert scene.names == made.NAMES
    assert scene.name == "survey"
    assert len(scene.test) == 1
    info = scene_info(tmp_path / "survey")
    assert (info.kind, info.photos, info.points) == ("project.opf", made.N_CAMERAS, made.N_POINTS)
    direct = load_scene(tmp_path / "survey" / "project.opf")
    np.testing.assert_array_equal(direct.views[0].camera.cam_from_world, scene.views[0].camera.cam_from_world)


def test_tracks_are_the_points(tmp_path: Path) -> None:
    xyz, rgb = made.points()
    found = read_posed_images(write(tmp_path, shift=(100.0, -30.0, 7.0)), None).points
    np.testing.assert_allclose(found.xyz, xyz, rtol=0, atol=1e-5)  # float32 at a distance of 100
    np.testing.assert_array_equal(found.rgb, rgb)
    np.testing.assert_array_equal(found.track_length, [2 + index % 5 for index in range(len(xyz))])


def test_dense_clouds_are_read_without_tracks(tmp_path: Path) -> None:
    project = made.opf_project()
    calibration = project.files["project.opf"]["items"][2]
    calibration["resources"] = calibration["resources"][:1]
    write(tmp_path, project)
    xyz, _ = made.points()
    made.write_opf_cloud(tmp_path / "dense" / "dense.gltf", xyz[:9], None, None, (0, 0, 0))
    found = read_posed_images(tmp_path, None).points
    np.testing.assert_array_equal(found.xyz, xyz[:9])
    assert set(found.rgb.ravel()) == {128}
    assert set(found.track_length) == {1}


@pytest.mark.parametrize(
    "prefix", ["file:///home/someone/flight/images/", "file:///c:/data/images/", "C:\\data\\", "/data/", "", "a%20b/"]
)
def test_photos_are_found_by_the_last_parts_of_their_paths(tmp_path: Path, prefix: str) -> None:
    write(tmp_path, made.opf_project(prefix=prefix))
    assert read_posed_images(tmp_path, None).names == made.NAMES


def test_a_camera_without_a_photo_is_left_out(tmp_path: Path) -> None:
    """As in the example of OPF's specification."""
    project = made.opf_project()
    project.files[CAMERAS]["cameras"][1]["id"] = 5
    with pytest.warns(UserWarning, match=f"1 of {made.N_CAMERAS} calibrated cameras are in no camera list"):
        found = read_posed_images(write(tmp_path, project), None)
    assert len(found.photos) == made.N_CAMERAS - 1


def test_another_folder_of_photos(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "images").rename(tmp_path / "images_2")
    with pytest.raises(InputError, match="none of its 5 photos can be used"):
        read_posed_images(tmp_path, None)
    assert read_posed_images(tmp_path, "images_2").names == made.NAMES
    with pytest.raises(InputError, match="no such folder of photos"):
        read_posed_images(tmp_path, "images_4")


def test_photos_beside_the_folder_of_the_project(tmp_path: Path) -> None:
    write(tmp_path / "project", made.opf_project(prefix="../photos/"))
    shutil.move(tmp_path / "project" / "images", tmp_path / "photos")
    assert read_posed_images(tmp_path / "project", None).names == made.NAMES


def test_sizes_come_from_the_photos_without_input_cameras(tmp_path: Path) -> None:
    project = made.opf_project()
    del project.files["project.opf"]["items"][1]
    assert_same_pixels(write(tmp_path, project), lambda local: made.opf_pixels(made.PERSPECTIVE, local))


def test_missing_photos_are_left_out(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "images" / made.NAMES[2]).unlink()
    posed = read_posed_images(tmp_path, None)
    assert list(posed.left_out) == [made.NAMES[2]]
    assert len(posed.photos) == made.N_CAMERAS - 1


def lens_with(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda files: files[CAMERAS]["sensors"][0].update(internals=made.PERSPECTIVE | values)


def fisheye_with(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda files: files[CAMERAS]["sensors"][0].update(internals=made.FISHEYE | values)


def camera_with(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda files: files[CAMERAS]["cameras"][1].update(values)


def set_uri(uri: Any) -> Callable[[dict[str, Any]], None]:
    return lambda files: files[LIST]["cameras"][0].update(uri=uri)


BAD: dict[str, tuple[Callable[[dict[str, Any]], Any], list[str]]] = {
    "items": (lambda f: f["project.opf"].update(items={}), ["project.opf", "'items'", "list of objects"]),
    "resources": (lambda f: f["project.opf"]["items"][0].update(resources=[3]), ["items[0]", "'resources'"]),
    "uri of a resource": (
        lambda f: f["project.opf"]["items"][0]["resources"][0].update(uri=None),
        ["items[0]", "'uri' is null"],
    ),
    "a long uri of a resource": (
        lambda f: f["project.opf"]["items"][2]["resources"][0].update(uri="a/" * 3000 + "b"),
        ["items[2]", "is not the name of a file"],
    ),
    "format": (lambda f: f["project.opf"].update(format="application/epub"), ["'format'", "opf-project"]),
    "no calibration": (lambda f: f["project.opf"]["items"].pop(2), ["is not calibrated"]),
    "two calibrations": (
        lambda f: f["project.opf"]["items"].append(f["project.opf"]["items"][2]),
        ["has 2 calibrations"],
    ),
    "a missing file": (lambda f: f.pop(CAMERAS), ["cameras.json", "copy it there"]),
    "no cameras": (lambda f: f[CAMERAS].update(cameras=[]), ["no camera is calibrated"]),
    "unlisted cameras": (
        lambda f: [camera.update(id=camera["id"] + 1000) for camera in f[CAMERAS]["cameras"]],
        ["cameras[0]", "is in no camera list"],
    ),
    "a camera twice": (
        lambda f: f[CAMERAS]["cameras"][1].update(id=f[CAMERAS]["cameras"][0]["id"]),
        ["cameras[1]", "another camera has already"],
    ),
    "an id that is a text": (camera_with(id="5"), ["cameras[1]", "'id' is the text '5'"]),
    "a truth as id": (camera_with(id=True), ["'id' is true"]),
    "an unknown sensor": (camera_with(sensor_id=8), ["cameras[1]", "its sensor 8"]),
    "two angles": (camera_with(orientation_deg=[1, 2]), ["cameras[1]", "'orientation_deg'", "3 numbers"]),
    "a NaN": (camera_with(position=[1, float("nan"), 2]), ["'position' is not finite"]),
    "a huge position": (camera_with(position=[1, 1e300, 2]), ["'position'", "above 1e+30"]),
    "a huge whole number": (camera_with(position=[1, 10**400, 2]), ["'position' is not finite"]),
    "internals": (lambda f: f[CAMERAS]["sensors"][0].update(internals=[]), ["sensors[0]", "is not an object"]),
    "a spherical lens": (lens_with(type="spherical"), ["sensors[0]: internals", "'spherical'", "pinhole image"]),
    "a focal length of 0": (lens_with(focal_length_px=0), ["'focal_length_px' is 0"]),
    "a short distortion": (lens_with(radial_distortion=[0.1]), ["'radial_distortion'", "3 numbers"]),
    "a fisheye with d": (fisheye_with(affine=[60, 1, 0, 60]), ["'affine' has d or e", "undistort"]),
    "a fisheye with p0": (fisheye_with(polynomial=[0.1, 1, 0, 0]), ["begins with another number"]),
    "an empty polynomial": (fisheye_with(polynomial=[]), ["'polynomial' has 0 numbers"]),
    "a long polynomial": (fisheye_with(polynomial=[1.0] * 5000), ["'polynomial' has 5000 numbers"]),
    "a falling fisheye": (fisheye_with(polynomial=[0, -1, 0, 0]), ["must be above 0"]),
    "a fisheye of squares": (
        fisheye_with(polynomial=[0, 1e-3, 0, 0, 40]),
        ["no counterpart in COLMAP within", "undistort"],
    ),
    "a size of 0": (
        lambda f: f["input-cameras.json"]["sensors"][0].update(image_size_px=[0, 3]),
        ["input-cameras.json: sensors[0]", "'image_size_px' is 0"],
    ),
    "another photo for an id": (
        lambda f: f[LIST]["cameras"].append(f[LIST]["cameras"][0] | {"uri": "b.png"}),
        ["camera-list.json: cameras[5]", "already"],
    ),
    "a photo for two cameras": (set_uri("images/DJI_0001.png"), ["two cameras name the photo"]),
    "one photo for two names": (set_uri("a/images/DJI_0001.png"), ["are both the photo", "rename one"]),
    "a remote photo": (set_uri("https://example.com/a.png"), ["https://example.com/a.png", "copy it here"]),
    "a page": (set_uri("a.tif#page=3"), ["only the first page"]),
    "a bad URI": (set_uri("http://[a"), ["is not a URI"]),
    "no name": (set_uri("images/a\0.png"), ["camera-list.json: cameras[0]", "is not the name of a file"]),
    "a long name": (set_uri("a" * 5000), ["camera-list.json: cameras[0]", "is not the name of a file"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_projects_are_one_line(tmp_path: Path, case: str) -> None:
    change, parts = BAD[case]
    project = made.opf_project()
    change(project.files)
    message = error_of("info", write(tmp_path, project))
    for part in parts:
        assert part in message, message


BAD_CLOUDS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "a count without bytes": (lambda d: d["accessors"][0].update(count=1 << 31), "its buffer has fewer"),
    "a text as matrix": (lambda d: d["nodes"][0].update(matrix="x"), "16 numbers"),
    "an infinite matrix": (lambda d: d["nodes"][0].update(matrix=[1.7e308] * 16), "is not finite"),
    "no attributes": (lambda d: d["meshes"][0]["primitives"][0].update(attributes=[]), "no attributes"),
    "a file elsewhere": (lambda d: d["buffers"][0].update(uri="../secret.bin"), "needs the file 'secret.bin'"),
    "too few colours": (lambda d: d["accessors"][1].update(count=2), "COLOR_0"),
    "too few ranges": (lambda d: d["accessors"][2].update(count=2), "OPF_mesh_primitive_matches"),
    "compression": (lambda d: d.update(extensionsRequired=["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
    "a loop of nodes": (lambda d: d["nodes"][0].update(children=[0]), "two parents"),
}


@pytest.mark.parametrize("case", BAD_CLOUDS)
def test_bad_clouds_are_one_line(tmp_path: Path, case: str) -> None:
    change, part = BAD_CLOUDS[case]
    file = write(tmp_path) / "calibration" / "tracks.gltf"
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))
    message = error_of("info", tmp_path)
    assert "tracks.gltf" in message
    assert part in message


def test_files_that_are_not_projects(tmp_path: Path) -> None:
    write(tmp_path)
    for data in (b"<package/>", b"[]", b"{", b"\xff\xfe\x00", b"[" * 100_000):
        (tmp_path / "project.opf").write_bytes(data)
        assert "project.opf" in error_of("info", tmp_path)

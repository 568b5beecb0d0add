"""Reconstructions of OpenSfM: poses, lenses and points against the formulas of its documentation, and refused files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import photogrammetry_files as made
import pytest
from cli_runner import clsplat, error_of
from opensfm_files import LENSES, Values, pixels_of, reconstruction

from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.scenes.info import scene_info
from clsplat.scenes.scene import load_scene, read_posed_images

PIXEL = 1e-6  # px


def write(folder: Path, values: Any, place: str = "reconstruction.json") -> Path:
    for index, name in enumerate(made.NAMES):
        write_png(folder / "images" / name, np.full((made.HEIGHT, made.WIDTH, 3), 20 * index, np.uint8))
    file = folder / place
    file.parent.mkdir(exist_ok=True)
    file.write_text(json.dumps(values))
    return folder


@pytest.mark.parametrize("size", [None, {}, {"width": made.WIDTH // 2, "height": made.HEIGHT // 2}])
@pytest.mark.parametrize("kind", LENSES)
def test_points_land_on_the_pixels_of_the_format(tmp_path: Path, kind: str, size: Values | None) -> None:
    """Lenses have no unit, so a camera may name the size that its photos were reduced to, or none."""
    posed = read_posed_images(write(tmp_path, [reconstruction(LENSES[kind], size)]), None)
    assert posed.names == made.NAMES
    xyz, _ = made.points()
    for photo, shot in zip(posed.photos, made.shots(), strict=True):
        local = xyz @ photo.cam_from_world[:3, :3].T + photo.cam_from_world[:3, 3]
        scale = made.WIDTH / photo.lens.width
        expected = pixels_of(LENSES[kind], shot.local(xyz))
        np.testing.assert_allclose(scale * photo.lens.img_from_cam(local), expected, rtol=0, atol=PIXEL)


def test_the_scene_is_loaded(tmp_path: Path) -> None:
    xyz, rgb = made.points()
    scene = load_scene(write(tmp_path / "survey", [reconstruction()]))
    assert (scene.names, scene.name, len(scene.test)) == (made.NAMES, "survey", 1)
    np.testing.assert_allclose(scene.points.xyz, xyz)
    np.testing.assert_array_equal(scene.points.rgb, rgb)
    assert set(scene.points.track_length) == {1}
    assert scene_info(tmp_path / "survey").kind == "reconstruction.json"
    assert len(load_scene(tmp_path / "survey" / "reconstruction.json").views) == len(made.NAMES)
    assert load_scene(tmp_path / "survey", images="images").names == made.NAMES


@pytest.mark.parametrize(
    "given", [".", "opensfm", "opensfm/reconstruction.json", "opensfm/reconstruction.topocentric.json"]
)
def test_a_project_of_opendronemap(tmp_path: Path, given: str) -> None:
    """The photos are beside the folder of the reconstruction."""
    write(tmp_path / "project", [reconstruction()], "opensfm/reconstruction.json")
    write(tmp_path / "project", [reconstruction()], "opensfm/reconstruction.topocentric.json")
    assert load_scene(tmp_path / "project" / given).names == made.NAMES
    exported = tmp_path / "colmap"
    clsplat("cameras", tmp_path / "project" / given, exported)
    assert (exported / "cameras.bin").is_file()


def test_photos_elsewhere(tmp_path: Path) -> None:
    write(tmp_path / "a", [reconstruction()], "opensfm/reconstruction.json")
    (tmp_path / "a" / "images").rename(tmp_path / "photos")
    assert load_scene(tmp_path / "a" / "opensfm", images="../../photos").names == made.NAMES


def test_the_largest_of_several_reconstructions(tmp_path: Path) -> None:
    small = reconstruction()
    small["shots"] = dict(list(small["shots"].items())[:2])
    with pytest.warns(UserWarning, match=r"has 2 reconstructions; the one with 5 of 7 photos is read"):
        posed = read_posed_images(write(tmp_path, [small, reconstruction()]), None)
    assert posed.names == made.NAMES


def test_a_reconstruction_without_points_or_colours(tmp_path: Path) -> None:
    values = reconstruction()
    for point in values["points"].values():
        del point["color"]
    assert set(load_scene(write(tmp_path / "a", [values])).points.rgb.ravel()) == {128}
    del values["points"]
    assert len(load_scene(write(tmp_path / "b", [values])).points) == 0


def shot(key: str, value: Any) -> Callable[[Values], Any]:
    return lambda values: values["shots"][made.NAMES[1]].update({key: value})


def camera(**values: Any) -> Callable[[Values], Any]:
    return lambda whole: whole["cameras"]["v2 maker"].update(values)


BAD: dict[str, tuple[Callable[[Values], Any], list[str]]] = {
    "no cameras": (lambda v: v.pop("cameras"), ["key 'cameras' is missing"]),
    "a list of shots": (lambda v: v.update(shots=[1]), ["key 'shots' has the wrong form; expected objects by name"]),
    "no shots": (lambda v: v.update(shots={}), ["no photo has a pose"]),
    "a short rotation": (shot("rotation", [1, 2]), [f"shot '{made.NAMES[1]}'", "'rotation'", "3 numbers"]),
    "a huge translation": (shot("translation", [0, 1e300, 0]), ["'translation' has a number above 1e+30"]),
    "a NaN": (shot("translation", [0, float("nan"), 0]), ["'translation' is not finite"]),
    "an unknown camera": (shot("camera", "other"), ["its camera 'other' is not among the cameras"]),
    "a number as camera": (shot("camera", 3), ["'camera' is a number; expected a text"]),
    "a panorama": (camera(projection_type="spherical"), ["camera 'v2 maker'", "'spherical'", "pinhole image"]),
    "a dual lens": (camera(projection_type="dual"), ["'dual'", "undistort the photos first"]),
    "no focal length": (lambda v: v["cameras"]["v2 maker"].pop("focal"), ["key 'focal' is missing"]),
    "a focal length of 0": (camera(focal=0), ["its focal length is not above 0"]),
    "a text as coefficient": (camera(k1="x"), ["'k1'"]),
    "a width of a half": (camera(width=0.5), ["'width' is 0.5"]),
    "a huge height": (camera(height=1e15), ["its size is", "x1000000000000000 px; a side has at most"]),
    "a point without a place": (lambda v: v["points"]["1"].pop("coordinates"), ["point '1'", "'coordinates'"]),
    "a photo out of the folder": (
        lambda v: v["shots"].update({"a\0": v["shots"][made.NAMES[0]]}),
        ["is not the name of a photo"],
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_one_line(tmp_path: Path, case: str) -> None:
    change, parts = BAD[case]
    values = reconstruction()
    change(values)
    message = error_of("info", write(tmp_path, [values]))
    for part in ["reconstruction.json", *parts]:
        assert part in message, message


@pytest.mark.parametrize("content", [{}, [], [1], "text"])
def test_other_files_of_the_name(tmp_path: Path, content: Any) -> None:
    with pytest.raises(InputError, match="is not a list of reconstructions; give a reconstruction"):
        load_scene(write(tmp_path, content))

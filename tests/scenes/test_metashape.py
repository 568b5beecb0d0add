"""Metashape's cameras.xml: poses, lenses and points against the manual's formulas, and refused files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import photogrammetry_files as made
import pytest
from cli_runner import error_of

from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.scenes.colmap import Points
from clsplat.scenes.info import scene_info
from clsplat.scenes.point_cloud import write_point_cloud
from clsplat.scenes.scene import load_scene, read_posed_images

PIXEL = 1e-6  # px


def write(folder: Path, text: str | None = None, suffix: str = ".png") -> Path:
    """Write photos, points and the cameras, and return the folder."""
    for index, name in enumerate(made.NAMES):
        write_png(folder / "images" / name, np.full((made.HEIGHT, made.WIDTH, 3), 20 * index, np.uint8))
        (folder / "images" / name).rename((folder / "images" / name).with_suffix(suffix))
    xyz, rgb = made.points()
    write_point_cloud(folder / "cameras.ply", Points(xyz, rgb, np.ones(len(xyz), np.int64)))
    (folder / "cameras.xml").write_text(made.metashape_xml() if text is None else text, encoding="utf-8")
    return folder


def assert_same_pixels(folder: Path, lens: dict[str, Any], within: float = PIXEL) -> None:
    posed = read_posed_images(folder, None)
    assert posed.names == made.NAMES
    for photo, shot in zip(posed.photos, made.shots(), strict=True):
        local = posed.points.xyz @ photo.cam_from_world[:3, :3].T + photo.cam_from_world[:3, 3]
        assert (local[:, 2] > 0).all()
        expected = made.metashape_pixels(lens, shot.local(made.points()[0]))
        np.testing.assert_allclose(photo.lens.img_from_cam(local), expected, rtol=0, atol=within)


@pytest.mark.parametrize("lens", [made.FRAME, made.ROUND], ids=lambda lens: lens["type"])
@pytest.mark.parametrize("chunk", [None, made.similarity()], ids=["local", "moved"])
def test_points_land_on_the_pixels_of_the_manual(
    tmp_path: Path, lens: dict[str, Any], chunk: made.Similarity | None
) -> None:
    assert_same_pixels(write(tmp_path, made.metashape_xml(lens, chunk=chunk)), lens)


def test_the_transform_of_the_chunk_counts_without_one_of_the_component(tmp_path: Path) -> None:
    text = made.metashape_xml(chunk=made.similarity(), in_component=False)
    assert_same_pixels(write(tmp_path, text), made.FRAME)


def test_k4_of_a_frame_camera_is_close(tmp_path: Path) -> None:
    lens = made.FRAME | {"k1": -0.0919, "k2": -0.0763, "k3": 0.1163, "k4": -0.0761}
    assert_same_pixels(write(tmp_path, made.metashape_xml(lens)), lens, 1e-3)


def test_a_small_b2_is_close(tmp_path: Path) -> None:
    lens = made.FRAME | {"b2": -0.3}
    assert_same_pixels(write(tmp_path, made.metashape_xml(lens)), lens, 0.15)


def test_the_scene_is_loaded(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path / "statue"))
    assert (scene.names, scene.name, len(scene.test)) == (made.NAMES, "statue", 1)
    np.testing.assert_array_equal(scene.points.rgb, made.points()[1])
    info = scene_info(tmp_path / "statue")
    assert (info.kind, info.photos, info.points) == ("cameras.xml", made.N_CAMERAS, made.N_POINTS)
    direct = load_scene(tmp_path / "statue" / "cameras.xml")
    np.testing.assert_array_equal(direct.views[0].camera.cam_from_world, scene.views[0].camera.cam_from_world)


@pytest.mark.parametrize("form", ["{}", "{}.png", "/home/someone/photos/{}.png", "C:\\photos\\{}.png"])
def test_labels_with_and_without_folders_and_suffixes(tmp_path: Path, form: str) -> None:
    labels = [made.Label(form.format(Path(name).stem)) for name in made.NAMES]
    assert read_posed_images(write(tmp_path, made.metashape_xml(labels=labels)), None).names == made.NAMES


def test_suffixes_of_photos_may_be_large(tmp_path: Path) -> None:
    names = read_posed_images(write(tmp_path, suffix=".PNG"), None).names
    assert names == [name.replace(".png", ".PNG") for name in made.NAMES]


def test_photos_beside_the_file_and_in_another_folder(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "images").rename(tmp_path / "images_2")
    assert read_posed_images(tmp_path, "images_2").names == made.NAMES
    for file in (tmp_path / "images_2").iterdir():
        file.rename(tmp_path / file.name)
    assert read_posed_images(tmp_path, None).names == made.NAMES


def test_cameras_that_cannot_be_used_are_left_out_with_a_reason(tmp_path: Path) -> None:
    labels = [made.Label(Path(name).stem) for name in made.NAMES]
    labels[1] = replace(labels[1], enabled="0")
    labels[2] = replace(labels[2], aligned=False)
    labels[3] = replace(labels[3], component="1")
    posed = read_posed_images(write(tmp_path, made.metashape_xml(labels=labels)), None)
    assert posed.names == [made.NAMES[0], made.NAMES[4]]
    assert posed.listed == made.NAMES, "they keep their places among training and test views"
    reasons = [posed.left_out[name] for name in made.NAMES[1:4]]
    for reason, part in zip(reasons, ["is disabled", "was not aligned", "belongs to component 1"], strict=True):
        assert part in reason
        assert "camera 'DJI_000" in reason


def test_points_are_optional_and_must_be_one_file(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "cameras.ply").rename(tmp_path / "dense.ply")
    assert len(read_posed_images(tmp_path, None).points) == made.N_POINTS
    (tmp_path / "mesh.ply").write_bytes(b"ply")
    with pytest.raises(InputError, match=r"2 PLY files are beside it; name that of the points cameras\.ply"):
        read_posed_images(tmp_path, None)
    (tmp_path / "dense.ply").rename(tmp_path / "cameras.ply")
    assert len(read_posed_images(tmp_path, None).points) == made.N_POINTS
    for file in tmp_path.glob("*.ply"):
        file.unlink()
    assert len(read_posed_images(tmp_path, None).points) == 0


EARTH = 'GEOGCS["WGS 84",DATUM["World Geodetic System 1984"]]'


@pytest.mark.parametrize(
    ("place", "within"),
    [((0.7, -2.1, 0.0), 1e-8), ((-0.4, 1.2, 3000.0), 1e-4), ((1.5707, 0.3, 0.0), 1e-6)],
    ids=["at sea level", "on a mountain", "near the pole"],
)
def test_a_georeferenced_scene_has_the_axes_east_north_and_up(
    tmp_path: Path, place: tuple[float, float, float], within: float
) -> None:
    chunk = made.similarity()
    text = made.metashape_xml(reference=EARTH, chunk=chunk, placement=made.on_earth(chunk, *place))
    with pytest.warns(UserWarning, match=r"the points of cameras\.ply are in a map projection: they are left out"):
        posed = read_posed_images(write(tmp_path, text), None)
    assert len(posed.points) == 0
    assert not any(posed.origin), "the reader itself has moved it"
    middle = np.mean([shot.centre for shot in made.shots()], axis=0)
    for photo, shot in zip(posed.photos, made.shots(), strict=True):
        local = made.points()[0] - middle
        found = local @ photo.cam_from_world[:3, :3].T + photo.cam_from_world[:3, 3]
        np.testing.assert_allclose(found, shot.local(made.points()[0]), rtol=0, atol=within)


def test_photos_that_are_missing_do_not_move_a_georeferenced_scene(tmp_path: Path) -> None:
    chunk = made.similarity()
    place = made.on_earth(chunk, 0.7, -2.1, 0.0)
    write(tmp_path, made.metashape_xml(reference=EARTH, chunk=chunk, placement=place))
    (tmp_path / "cameras.ply").unlink()
    expected = read_posed_images(tmp_path, None).photos[0].cam_from_world
    (tmp_path / "images" / made.NAMES[3]).unlink()
    np.testing.assert_array_equal(read_posed_images(tmp_path, None).photos[0].cam_from_world, expected)


def test_a_georeferenced_chunk_without_a_transform_is_local(tmp_path: Path) -> None:
    assert_same_pixels(write(tmp_path, made.metashape_xml(reference=EARTH)), made.FRAME)


def test_a_georeferenced_camera_at_the_centre_of_the_earth_is_read(tmp_path: Path) -> None:
    """No program writes it, but a file may hold it."""
    centres = np.array([shot.centre for shot in made.shots()])
    nowhere = made.Similarity(np.eye(3), -centres.mean(axis=0), 1.0)
    write(tmp_path, made.metashape_xml(reference=EARTH, placement=nowhere))
    with pytest.warns(UserWarning, match="map projection"):
        posed = read_posed_images(tmp_path, None)
    assert np.isfinite([photo.cam_from_world for photo in posed.photos]).all()


LENSES: dict[str, tuple[dict[str, Any], list[str]]] = {
    "no focal length": ({"f": 0}, ["sensor '0'", "has no <f>", "PhotoScan 1.2"]),
    "a focal length below 0": ({"f": -5.0}, ["focal length f is -5"]),
    "b1 below -f": ({"b1": -50.0}, ["with b1 -9"]),
    "a large b2": ({"b2": 30.0}, ["b2 moves pixels by", "do not fit it"]),
    "p3": ({"p3": 0.1}, ["p3 and p4"]),
    "a large k4": (
        {"k1": 5.0, "k2": -300.0, "k3": 8e3, "k4": -6e4},
        ["no counterpart in COLMAP within", "do not fit k4"],
    ),
    "a spherical camera": ({"type": "spherical"}, ["its type is 'spherical'", "perspective views"]),
    "a text": ({"k1": "many"}, ["<k1> is", "expected a number"]),
    "not a number": ({"k1": float("nan")}, ["<k1> is 'nan'"]),
    "a huge number": ({"cx": 1e300}, ["<cx> is '1e+300'"]),
}


@pytest.mark.parametrize("case", LENSES)
def test_bad_lenses_are_one_line(tmp_path: Path, case: str) -> None:
    values, parts = LENSES[case]
    message = error_of("info", write(tmp_path, made.metashape_xml(made.FRAME | values)))
    for part in ("cameras.xml", *parts):
        assert part in message, message


GOOD = made.metashape_xml(chunk=made.similarity())
TEXTS: dict[str, tuple[str, str, list[str]]] = {
    "a short pose": ("<transform>", "<transform>1 ", ["camera 'DJI_0000'", "<transform>", "expected 16 numbers"]),
    "a pose of zeros": (" 0.0 0.0 0.0 1.0</transform>", " 0 0 1 1</transform>", ["last row", "0 0 0 1"]),
    "no rotation": ('<rotation locked="false">', '<rotation locked="false">9 ', ["of the chunk", "<rotation>"]),
    "a scale of 0": ("<scale>2.5", "<scale>0", ["<scale> is 0"]),
    "a scale that is a word": ("<scale>2.5", "<scale>2_5", ["<scale> is '2_5'"]),
    "no chunk": ("chunk", "piece", ["has no <chunk>"]),
    "an unknown sensor": ('sensor_id="0"', 'sensor_id="4"', ["sensor '4'", "is not among the <sensors>"]),
    "no calibration": ("calibration", "calibrated", ["has no <calibration>"]),
    "no size": ("<resolution ", "<size ", ["<resolution> is"]),
    "a huge size": ('width="48"', 'width="99999999999999"', ["<resolution> is"]),
    "no label": ('label="DJI_0001"', 'label=""', ["camera 1 has no label"]),
    "two cameras of one label": ("DJI_0001", "DJI_0002", ["two cameras have the label 'DJI_0002'"]),
    "no file of that name": ("DJI_0001", "x" * 5000, ["is not the name of a photo"]),
    "cut off": ("</chunk>\n</document>", "", ["is not plain XML"]),
}


@pytest.mark.parametrize("case", TEXTS)
def test_bad_files_are_one_line(tmp_path: Path, case: str) -> None:
    old, new, parts = TEXTS[case]
    assert old in GOOD
    write(tmp_path, GOOD.replace(old, new))
    message = error_of("info", tmp_path / "cameras.xml")
    for part in ("cameras.xml", *parts):
        assert part in message, message


def test_entities_that_grow_are_refused(tmp_path: Path) -> None:
    entities = "".join(f'<!ENTITY e{index} "{f"&e{index - 1};" * 50}">' for index in range(1, 12))
    head = f'<?xml version="1.0"?><!DOCTYPE document [<!ENTITY e0 "ha">{entities}]>'
    write(tmp_path, head + "<document><chunk>&e11;</chunk></document>")
    assert "it has a document type" in error_of("info", tmp_path / "cameras.xml")
    outside = '<?xml version="1.0"?><!DOCTYPE d [<!ENTITY x SYSTEM "file:///etc/hostname">]><document>&x;</document>'
    (tmp_path / "cameras.xml").write_text(outside)
    assert "it has a document type" in error_of("info", tmp_path / "cameras.xml")


@pytest.mark.parametrize(
    "data", [b"", b"\x00" * 100, b'<?xml version="1.0" encoding="no-such"?><a/>', b"<a>" * 100_000, b"{}"]
)
def test_files_that_are_not_xml(tmp_path: Path, data: bytes) -> None:
    write(tmp_path)
    (tmp_path / "cameras.xml").write_bytes(data)
    assert "is not plain XML" in error_of("info", tmp_path / "cameras.xml")


def test_deep_xml_is_refused(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "cameras.xml").write_bytes(b"<a>" * 200_000 + b"</a>" * 200_000)
    assert "has no <chunk>" in error_of("info", tmp_path / "cameras.xml")

"""Metashape's cameras.xml: poses, lenses and points against the manual's formulas, and refused files."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
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


def write(folder: Path, text: str | None = None, suffix: str = ".png", names: Sequence[str] = made.NAMES) -> Path:
    """Write photos, points and the cameras, and return the folder."""
    for index, name in enumerate(names):
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


EQUIDISTANT = made.ROUND | {"type": "equidistant_fisheye"}
EQUISOLID = made.ROUND | {"type": "equisolid_fisheye"}


@pytest.mark.parametrize("lens", [made.FRAME, made.ROUND, EQUIDISTANT], ids=lambda lens: lens["type"])
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


# Tangential terms have no exact counterpart. Those of ROUND move a pixel by up to 0.1 px.
@pytest.mark.parametrize(("tangential", "within"), [((0.0, 0.0), 1e-3), ((0.0012, -0.0009), 0.006)])
@pytest.mark.parametrize("focal", [40.0, 22.0], ids=["narrow", "wide"])
def test_an_equisolid_fisheye_is_close(
    tmp_path: Path, focal: float, tangential: tuple[float, float], within: float
) -> None:
    lens = EQUISOLID | {"f": focal} | dict(zip(("p1", "p2"), tangential, strict=True))
    assert_same_pixels(write(tmp_path, made.metashape_xml(lens)), lens, within)


def test_an_equisolid_fisheye_is_close_in_the_whole_image(tmp_path: Path) -> None:
    lens = EQUISOLID | {"f": 22.0}
    posed = read_posed_images(write(tmp_path, made.metashape_xml(lens)), None)
    angle, turn = (grid.ravel() for grid in np.meshgrid(np.linspace(0.05, 1.4, 40), np.linspace(0.0, 6.2, 40)))
    local = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)
    expected = made.metashape_pixels(lens, local)
    inside = (expected >= 0).all(axis=1) & (expected <= (made.WIDTH, made.HEIGHT)).all(axis=1)
    assert angle[inside].max() > 1.2
    found = posed.photos[0].lens.img_from_cam(local[inside])
    np.testing.assert_allclose(found, expected[inside], rtol=0, atol=0.006)


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


def test_photos_in_subfolders_are_found_by_their_labels(tmp_path: Path) -> None:
    """Drones write a folder for each thousand photos. A label that two photos have is left out."""
    folder = write(tmp_path)
    for index, name in enumerate(made.NAMES):
        (folder / "images" / f"{100 + index % 2}MEDIA").mkdir(exist_ok=True)
        (folder / "images" / name).rename(folder / "images" / f"{100 + index % 2}MEDIA" / name)
    assert load_scene(folder).names == sorted(f"{100 + i % 2}MEDIA/{name}" for i, name in enumerate(made.NAMES))
    shutil.copy(folder / "images" / "100MEDIA" / made.NAMES[0], folder / "images" / "101MEDIA" / made.NAMES[0])
    with pytest.warns(UserWarning, match=f"1 of {len(made.NAMES)} photos are left out"):
        assert f"100MEDIA/{made.NAMES[0]}" not in load_scene(folder).names


def test_photos_of_one_name_are_told_apart_by_the_folders_of_their_labels(tmp_path: Path) -> None:
    labels = [made.Label(f"/home/someone/{index}MEDIA/photo.png") for index in range(made.N_CAMERAS)]
    folder = write(tmp_path, made.metashape_xml(labels=labels))
    for index, name in enumerate(made.NAMES):
        (folder / "images" / f"{index}MEDIA").mkdir()
        (folder / "images" / name).rename(folder / "images" / f"{index}MEDIA" / "photo.png")
    assert read_posed_images(folder, None).names == [f"{index}MEDIA/photo.png" for index in range(made.N_CAMERAS)]


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


def test_cameras_that_the_file_does_not_use_do_not_count_as_missing(tmp_path: Path) -> None:
    labels = [
        replace(made.Label(Path(name).stem), enabled=str(int(index == 2))) for index, name in enumerate(made.NAMES)
    ]
    folder = write(tmp_path, made.metashape_xml(labels=labels))
    with pytest.warns(UserWarning, match=f"{len(made.NAMES) - 1} of {len(made.NAMES)} photos are left out"):
        assert load_scene(folder, eval=False).names == [made.NAMES[2]]
    (folder / "images" / made.NAMES[2]).unlink()
    with pytest.raises(InputError, match=r"none of its \d+ photos can be used"):
        load_scene(folder, eval=False)
    write(tmp_path, made.metashape_xml(labels=[replace(label, enabled="0") for label in labels]))
    with pytest.raises(InputError, match="is disabled, and no other camera can be used; align the photos"):
        load_scene(folder)


@pytest.mark.parametrize("first", [True, False])
def test_of_several_chunks_the_one_with_most_poses_is_read(tmp_path: Path, first: bool) -> None:
    text = made.metashape_xml()
    start, end = text.index("<chunk"), text.index("</chunk>") + len("</chunk>")
    few = '<chunk label="few"><sensors/><cameras><camera id="0" label="x"/></cameras></chunk>'
    joined = [few, text[start:end]][:: 1 if first else -1]
    folder = write(tmp_path, text[:start] + "".join(joined) + text[end:])
    with pytest.warns(UserWarning, match="has 2 chunks, and only the one with the most poses is read"):
        assert read_posed_images(folder, None).names == made.NAMES


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


def rig_photos(slaves: int) -> list[str]:
    return [f"{made.rig_name(frame, camera)}.png" for frame in range(made.RIG_FRAMES) for camera in range(slaves + 1)]


@pytest.mark.parametrize("form", made.RIG_FORMS)
@pytest.mark.parametrize("slaves", [1, 2])
@pytest.mark.parametrize("located", [True, False], ids=["with location", "without location"])
@pytest.mark.parametrize("chunk", [None, made.similarity()], ids=["local", "moved"])
def test_the_slaves_of_a_rig_follow_their_master(
    tmp_path: Path, form: str, slaves: int, located: bool, chunk: made.Similarity | None
) -> None:
    mounts, names = made.mounts(slaves, located), rig_photos(slaves)
    posed = read_posed_images(write(tmp_path, made.rig_xml(mounts, form, chunk), names=names), None)
    assert (posed.names, posed.left_out) == (names, {})
    for index, photo in enumerate(posed.photos):
        frame, number = divmod(index, slaves + 1)
        expected = made.shots()[frame].local(made.points()[0])
        if number:
            mount = mounts[number - 1]
            place = np.zeros(3) if mount.location is None else mount.location * (1.0 if chunk is None else chunk.scale)
            expected = (expected - place) @ mount.rotation
        local = posed.points.xyz @ photo.cam_from_world[:3, :3].T + photo.cam_from_world[:3, 3]
        np.testing.assert_allclose(local, expected, rtol=0, atol=1e-9)
        assert (expected[:, 2] > 0).all()
        pixels = made.metashape_pixels(made.rig_lens(number), expected)
        np.testing.assert_allclose(photo.lens.img_from_cam(local), pixels, rtol=0, atol=PIXEL)


RIG = made.rig_xml(made.mounts(2))
MASTER, SLAVE = f'label="{made.rig_name(0, 0)}" enabled="true"', f'label="{made.rig_name(0, 1)}"'
POSE = RIG[RIG.index("<transform>") : RIG.index("</transform>") + len("</transform>")]
# Change of the file, and the cameras of the first frame that are left out, with a part of the reason.
RIGS: dict[str, tuple[str, str, dict[int, str]]] = {
    "a disabled slave": (SLAVE, f'{SLAVE} enabled="false"', {1: "is disabled"}),
    "a disabled master": (MASTER, MASTER.replace("true", "false"), dict.fromkeys(range(3), "is disabled")),
    "an unaligned master": (
        POSE,
        "",
        {0: "it was not aligned"} | dict.fromkeys((1, 2), "its master, camera 'frame0_camera0', was not aligned"),
    ),
    "a master of another component": (
        f'component_id="0" {MASTER}',
        f'component_id="1" {MASTER}',
        dict.fromkeys(range(3), "belongs to component 1, and 0 is the active one"),
    ),
    "a master that names itself": (MASTER, f'{MASTER} master_id="0"', {}),
}


@pytest.mark.parametrize("case", RIGS)
def test_cameras_of_a_rig_are_left_out_with_a_reason(tmp_path: Path, case: str) -> None:
    old, new, parts = RIGS[case]
    assert RIG.count(old) == 1
    posed = read_posed_images(write(tmp_path, RIG.replace(old, new), names=rig_photos(2)), None)
    assert posed.listed == rig_photos(2)
    assert sorted(posed.left_out) == [f"{made.rig_name(0, number)}.png" for number in sorted(parts)]
    for number, part in parts.items():
        reason = posed.left_out[f"{made.rig_name(0, number)}.png"]
        assert reason.startswith(f"{tmp_path / 'cameras.xml'}: camera '{made.rig_name(0, number)}' ")
        assert part in reason
        assert reason.count("cameras.xml") == 1, "the path once"


def test_an_enabled_slave_does_not_need_an_enabled_master(tmp_path: Path) -> None:
    text = RIG.replace(MASTER, MASTER.replace("true", "false")).replace(SLAVE, f'{SLAVE} enabled="true"')
    posed = read_posed_images(write(tmp_path, text, names=rig_photos(2)), None)
    assert sorted(posed.left_out) == [f"{made.rig_name(0, number)}.png" for number in (0, 2)]
    whole = tmp_path / "whole"
    expected = read_posed_images(write(whole, RIG, names=rig_photos(2)), None).photos[1]
    assert (posed.photos[0].name, expected.name) == (f"{made.rig_name(0, 1)}.png",) * 2
    np.testing.assert_array_equal(posed.photos[0].cam_from_world, expected.cam_from_world)


def test_the_pose_of_a_slave_with_its_own_transform_is_its_own(tmp_path: Path) -> None:
    text = RIG.replace(f"{SLAVE}/>", f"{SLAVE}>{POSE}</camera>")
    write(tmp_path, text, names=rig_photos(2))
    with pytest.warns(UserWarning, match="1 of 6 photos have the pose of another photo"):
        master, slave, *_ = read_posed_images(tmp_path, None).photos
    np.testing.assert_array_equal(slave.cam_from_world, master.cam_from_world)


def test_rounded_rotations_of_a_rig_are_warned_of_with_one_path(tmp_path: Path) -> None:
    rotation = " ".join(f"{value:.2f}" for value in made.mounts(1)[0].rotation.ravel())
    start = RIG.index("<rotation>", RIG.index('<sensor id="1"')) + len("<rotation>")
    text = RIG[:start] + rotation + RIG[RIG.index("</rotation>", start) :]
    write(tmp_path, text, names=rig_photos(2))
    with pytest.warns(UserWarning, match=r"2 of 6 rotations are rounded, most of all that of camera 'frame0_camera1'"):
        read_posed_images(tmp_path, None)


BAD_RIGS: dict[str, tuple[str, str, list[str]]] = {
    "an unknown master": (
        'sensor_id="1" master_id="0"',
        'sensor_id="1" master_id="77"',
        ["camera 'frame0_camera1'", "master_id is '77'", "no cameras have this id", "export all cameras of the rig"],
    ),
    "an empty master": ('sensor_id="1" master_id="0"', 'sensor_id="1" master_id=""', ["master_id is ''"]),
    "two masters of one id": ('camera id="10"', 'camera id="0"', ["master_id is '0', and 2 cameras have this id"]),
    "a slave of a slave": (
        'sensor_id="1" master_id="0"',
        'sensor_id="1" master_id="2"',
        ["camera 'frame0_camera1': its master, camera 'frame0_camera2', has a master too"],
    ),
    "an unknown sensor": ('sensor_id="1" master_id="0"', 'sensor_id="8" master_id="0"', ["sensor '8': is not among"]),
}


@pytest.mark.parametrize("case", BAD_RIGS)
def test_bad_rigs_are_one_line(tmp_path: Path, case: str) -> None:
    old, new, parts = BAD_RIGS[case]
    assert RIG.count(old) == 1
    write(tmp_path, RIG.replace(old, new), names=rig_photos(2))
    message = error_of("info", tmp_path / "cameras.xml")
    for part in ("cameras.xml", *parts):
        assert part in message, message


@pytest.mark.parametrize(("name", "count"), [("rotation", 9), ("location", 3)])
def test_bad_places_in_a_rig_are_one_line(tmp_path: Path, name: str, count: int) -> None:
    start = RIG.index(f"<{name}>", RIG.index('<sensor id="1"')) + len(f"<{name}>")
    write(tmp_path, RIG[:start] + "1 " + RIG[start:], names=rig_photos(2))
    message = error_of("info", tmp_path / "cameras.xml")
    for part in ("cameras.xml", "sensor '1'", f"<{name}> is", f"expected {count} numbers"):
        assert part in message, message


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
    "large tangential terms of an equisolid fisheye": (
        EQUISOLID | {"f": 22.0, "p1": 0.3},
        ["p1 and p2 have no counterpart in COLMAP within", "export undistorted photos"],
    ),
    "large radial terms of an equisolid fisheye": (
        EQUISOLID | {"f": 22.0, "k1": 0.0, "k2": -2.0, "k3": 2.5, "k4": -0.8, "p1": 0.0, "p2": 0.0},
        ["k1 to k4, p1 and p2 have no counterpart"],
    ),
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


@pytest.mark.parametrize("in_sensor", [True, False])
def test_a_spherical_camera_without_a_calibration_is_refused_by_its_type(tmp_path: Path, in_sensor: bool) -> None:
    text = made.metashape_xml().replace("calibration", "calibrated")
    write(tmp_path, text.replace('type="frame"', 'type="spherical"') if in_sensor else text)
    message = error_of("info", tmp_path / "cameras.xml")
    assert ("its type is 'spherical'" in message, "has no <calibration>" in message) == (in_sensor, not in_sensor)


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

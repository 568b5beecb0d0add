"""Which of several descriptions of a folder is read, and where scenes of photogrammetry programs are recognised."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import photogrammetry_files as made
import pytest
from cli_runner import error_of, run
from small_scene import NAMES, write_garden

from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.scenes.colmap import read_model
from clsplat.scenes.info import is_scene, scene_info
from clsplat.scenes.photo_listing import is_posed, list_images
from clsplat.scenes.reconstruct.photo_files import is_photographs
from clsplat.scenes.scene import read_posed_images
from clsplat.scenes.scene_files import find_scene_files
from clsplat.scenes.wrong_folder import scene_above, scenes_below

FOREIGN = '<?xml version="1.0"?><x:xmpmeta xmlns:x="adobe:ns:meta/"><document/></x:xmpmeta>'


def write_survey(folder: Path, *kinds: str) -> Path:
    """Write photos and the cameras of these kinds."""
    for index, name in enumerate(made.NAMES):
        write_png(folder / "images" / name, np.full((made.HEIGHT, made.WIDTH, 3), 20 * index, np.uint8))
    if "opf" in kinds:
        project = made.opf_project()
        project.files["project.opf"]["items"] = [
            item | {"resources": [each for each in item["resources"] if "gltf" not in each["format"]]}
            for item in project.files["project.opf"]["items"]
        ]
        project.write(folder)
    if "metashape" in kinds:
        (folder / "cameras.xml").write_text(made.metashape_xml(), encoding="utf-8")
    return folder


@pytest.mark.filterwarnings("ignore:.*registers only:UserWarning", "ignore:.*have the pose of:UserWarning")
def test_the_order_of_the_kinds(tmp_path: Path) -> None:
    """COLMAP, transforms.json, OPF, Metashape: the first that is there is read."""
    garden = write_garden(tmp_path)
    frames = [{"file_path": f"images/{name}", "transform_matrix": np.eye(4).tolist()} for name in NAMES]
    (garden / "transforms.json").write_text(json.dumps({"fl_x": 30.0, "frames": frames}))
    write_survey(garden, "opf", "metashape")
    kinds = []
    for remove in ("sparse", "transforms.json", "project.opf", "cameras.xml"):
        kinds.append(scene_info(garden).kind)
        shutil.rmtree(garden / remove) if (garden / remove).is_dir() else (garden / remove).unlink()
    assert kinds == ["COLMAP", "transforms.json", "project.opf", "cameras.xml"]
    with pytest.raises(InputError, match="no folder 'sparse'"):
        scene_info(garden)


def test_a_file_that_is_named_is_read_whatever_lies_beside_it(tmp_path: Path) -> None:
    folder = write_survey(write_garden(tmp_path), "opf", "metashape")
    for name in ("project.opf", "cameras.xml"):
        assert scene_info(folder / name).kind == name
        assert read_posed_images(folder / name, None).names == made.NAMES


@pytest.mark.parametrize(("kind", "ending"), [("opf", "opf"), ("metashape", "xml")])
def test_several_files_of_a_kind(tmp_path: Path, kind: str, ending: str) -> None:
    folder = write_survey(tmp_path, kind)
    first = next(folder.glob(f"*.{ending}")).rename(folder / f"b.{ending}")
    shutil.copy(first, folder / f"a.{ending}")
    message = error_of("info", folder)
    assert f"2 files describe cameras (a.{ending}, b.{ending}); give one of them, such as " in message
    assert read_posed_images(folder / f"a.{ending}", None).names == made.NAMES
    if kind == "metashape":
        shutil.copy(first, folder / "cameras.xml")
        assert [file.name for file in find_scene_files(folder)] == ["cameras.xml"], "the usual name comes first"


def test_xml_files_of_other_programs_are_no_scenes(tmp_path: Path) -> None:
    folder = write_survey(tmp_path)
    (folder / "images" / "a.xml").write_text(FOREIGN)
    (folder / "b.xml").write_text(FOREIGN)
    (folder / "c.xml").mkdir()
    assert find_scene_files(folder) == []
    assert not is_posed(folder)
    assert is_photographs(folder)
    assert find_scene_files(folder / "nothing") == []


@pytest.mark.parametrize("kind", ["opf", "metashape"])
def test_scenes_are_recognised(tmp_path: Path, kind: str) -> None:
    folder = write_survey(tmp_path / "data" / "survey", kind)
    file = find_scene_files(folder)[0]
    assert is_posed(folder)
    assert is_scene(folder)
    assert is_scene(file)
    assert not is_photographs(folder)
    assert scenes_below(tmp_path / "data") == ["survey"]
    assert scene_above(folder / "images") == folder
    assert list_images(tmp_path / "data", {".png"}).scenes == ("survey",)
    assert "the subfolder survey is a scene: give " in error_of("info", tmp_path / "data")


@pytest.mark.parametrize("kind", ["opf", "metashape"])
def test_cameras_are_exported(tmp_path: Path, kind: str) -> None:
    folder = write_survey(tmp_path / "survey", kind)
    file = find_scene_files(folder)[0]
    assert run("cameras", file, tmp_path / "sparse" / "0").exit_code == 0
    assert run("cameras", folder, tmp_path / "other" / "0").exit_code == 0
    posed = read_posed_images(folder, None)
    for model in (tmp_path / "sparse" / "0", tmp_path / "other" / "0"):
        for photo, original in zip(read_model(model).photos, posed.photos, strict=True):
            assert photo.name == original.name
            np.testing.assert_allclose(photo.cam_from_world, original.cam_from_world, rtol=0, atol=1e-9)
            np.testing.assert_allclose(photo.lens.params, original.lens.params, rtol=1e-12)


def test_messages_name_the_kinds(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "points.ply").write_bytes(b"ply")
    (tmp_path / "notes.txt").write_text("x")
    for path in ("nothing", "empty", "points.ply", "notes.txt"):
        with pytest.raises(InputError) as caught:
            read_posed_images(tmp_path / path, None)
        for kind in ("transforms.json", "OPF project (.opf)", "Metashape's cameras (.xml)"):
            assert kind in str(caught.value), path
    assert "OPF project" in error_of("info", tmp_path / "empty")


def test_tables_of_realityscan_are_refused_with_what_works_instead(tmp_path: Path) -> None:
    (tmp_path / "cameras.csv").write_text("#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n")
    message = error_of("train", tmp_path / "cameras.csv", "-m", tmp_path / "model")
    assert "export the cameras of RealityScan as a COLMAP model" in message

"""All readers of external files, each with an intact sample to damage and the function that reads it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import glb_files
import numpy as np
import opensfm_files
import packed_ply
import photogrammetry_files
import sog_files
from model_arrays import random_model
from small_scene import FX, FY, NAMES, as_text, cloud, model_views, photo_of

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import named_cameras, read_cameras, write_cameras
from clsplat.cameras.path import CameraPath, read_path, write_path
from clsplat.errors import InputError
from clsplat.files.images import image_size, read_image, write_grey16, write_png
from clsplat.models.cfg_args import read_cfg_args
from clsplat.scenes.colmap import find_model, read_model
from clsplat.scenes.colmap_binary import write_binary_model
from clsplat.scenes.point_cloud import read_point_cloud
from clsplat.scenes.scene import load_scene
from clsplat.splats.formats.ply import read_ply
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats
from clsplat.training.checkpoint import Checkpoint
from clsplat.training.config import TrainConfig
from clsplat.webpage.page import PageContent, write_web_page


@dataclass(frozen=True)
class Sample:
    """A sample of files for one reader.

    Parameters
    ----------
    make : writes the files into an empty folder.
    read : reads them, and raises InputError or checks the result.
    damaged : parts of the paths of the files to damage.
    """

    make: Callable[[Path], object]
    read: Callable[[Path], object]
    damaged: str = ""


def small_splats(shape: str = "skew-normal", degree: int = 1) -> Splats:
    return Splats(shape, random_model(SHAPES[shape], 6, 0, sh_degree=degree))


def finite(arrays: Any) -> None:
    assert all(np.isfinite(values).all() for values in arrays.values())


def make_compact(folder: Path) -> None:
    arrays = small_splats(degree=3).to_numpy()
    arrays["sh"][:4, 4:] = 0
    arrays["skew"][1:] = 0
    Splats("skew-normal", arrays).save(folder / "model.ply", compact=True)


def make_ascii(folder: Path) -> None:
    lines = ["ply", "format ascii 1.0", "element vertex 3"]
    lines += [f"property float {name}" for name in ("x", "y", "z")]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    rows = ["0 0.5 1 10 20 30", "1 2 3 0 255 0", "-1 -2 -3 1 2 3"]
    (folder / "points.ply").write_text("\n".join([*lines, "end_header", *rows, ""]), encoding="utf-8")


def make_scene(folder: Path, suffix: str = ".bin") -> None:
    for index, name in enumerate(NAMES[:3]):
        write_png(folder / "images" / name, photo_of(index))
    target = folder / "sparse" / "0"
    write_binary_model(target if suffix == ".bin" else folder / "binary", model_views()[:3], *cloud())
    if suffix == ".txt":
        as_text(folder / "binary", target)
        for path in sorted((folder / "binary").iterdir()):
            path.unlink()
        (folder / "binary").rmdir()
        for name in ("rigs.txt", "frames.txt"):
            (target / name).unlink(missing_ok=True)


def make_masked(folder: Path) -> None:
    make_scene(folder)
    for name in NAMES[:3]:
        write_png(folder / "masks" / f"{name}.png", photo_of(0)[:, :, 1])


def make_transforms(folder: Path) -> None:
    views = model_views()[:3]
    frames = []
    for index, view in enumerate(views):
        write_png(folder / "images" / view.name, photo_of(index))
        pose = np.linalg.inv(view.cam_from_world) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{view.name}", "transform_matrix": pose.tolist()})
    write_png(folder / "masks" / "shot_0.png", photo_of(0)[:, :, 1])
    frames[0]["mask_path"] = "masks/shot_0.png"
    values = {
        "fl_x": FX,
        "fl_y": FY,
        "cx": 18.5,
        "cy": 16.25,
        "w": 40,
        "h": 30,
        "k1": 0.01,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
        "camera_model": "OPENCV",
        "frames": frames,
        "ply_file_path": "points.ply",
        "applied_transform": np.eye(4)[:3].tolist(),
    }
    (folder / "transforms.json").write_text(json.dumps(values), encoding="utf-8")
    make_ascii(folder)


def make_survey(folder: Path) -> None:
    for index, name in enumerate(photogrammetry_files.NAMES):
        photo = photo_of(index, photogrammetry_files.WIDTH, photogrammetry_files.HEIGHT)
        write_png(folder / "images" / name, photo)


def make_opf(folder: Path) -> None:
    make_survey(folder)
    xyz, rgb = photogrammetry_files.points()
    tracks = folder / "calibration" / "tracks.gltf"
    photogrammetry_files.write_opf_cloud(tracks, xyz, rgb, [3] * len(xyz), (1.0, 2.0, 3.0))
    photogrammetry_files.opf_project().write(folder)


def make_opensfm(folder: Path) -> None:
    make_survey(folder)
    (folder / "reconstruction.json").write_text(json.dumps([opensfm_files.reconstruction()]), encoding="utf-8")


def make_metashape(folder: Path) -> None:
    make_survey(folder)
    make_ascii(folder)
    text = photogrammetry_files.metashape_xml(chunk=photogrammetry_files.similarity())
    (folder / "cameras.xml").write_text(text, encoding="utf-8")


def read_scene(folder: Path) -> None:
    scene = load_scene(folder)
    for view in scene.views:
        assert view.image.shape == (view.camera.height, view.camera.width, 3)
        assert view.mask is None or view.mask.shape == view.image.shape[:2]
    assert np.isfinite(scene.points.xyz).all()


def read_listed(folder: Path) -> None:
    scene = load_scene(folder, test_list=folder / "test.txt")
    assert scene.test_names <= set(scene.names)


def make_listed(folder: Path) -> None:
    make_scene(folder)
    (folder / "test.txt").write_text(f"{NAMES[0]}\n{NAMES[2]}\n", encoding="utf-8")


def cameras() -> list[Camera]:
    return [Camera(40, 30, FX, FY, 20, 15, view.cam_from_world) for view in model_views()[:3]]


def make_cameras(folder: Path) -> None:
    write_cameras(folder / "cameras.json", named_cameras(NAMES[:3], cameras()))


def make_path(folder: Path) -> None:
    write_path(folder / "path.json", CameraPath(tuple(cameras()), 24.0, tuple(cameras()[:2]), True))


def read_config(folder: Path) -> None:
    from clsplat.training.stored_run import read_options_file

    TrainConfig(**read_options_file(folder / "config.json"))


def make_config(folder: Path) -> None:
    (folder / "config.json").write_text(
        json.dumps({"config": TrainConfig(iterations=100).to_json(), "scene": {}}), encoding="utf-8"
    )


def make_checkpoint(folder: Path) -> None:
    config = TrainConfig(iterations=100)
    arrays = small_splats().to_numpy()
    state = {f"{kind}.{name}": np.zeros_like(values) for kind in ("m", "v") for name, values in arrays.items()}
    rng = dict(np.random.default_rng(0).bit_generator.state)
    Checkpoint(
        40, config.to_json(), arrays, state, rng, [2, 0, 1], 1.5, "1x16x16", 6, np.ones((3, 6), np.float32)
    ).save(folder / "checkpoint.npz")


def read_checkpoint(folder: Path) -> None:
    """Take the steps of resuming that need no device."""
    from clsplat.device.schedule import Schedule
    from clsplat.training.extension import fitting_checkpoint
    from clsplat.training.folder import ModelFolder

    found = fitting_checkpoint(ModelFolder(folder), TrainConfig(iterations=100))
    Schedule.parse(found.schedule)
    np.random.default_rng(0).bit_generator.state = found.rng
    assert found.statistics.shape == (3, len(found.splats["mean"]))


def make_model(folder: Path) -> None:
    small_splats().save(folder / "point_cloud" / "iteration_100" / "point_cloud.ply")
    small_splats("gaussian").save(folder / "point_cloud" / "iteration_50" / "point_cloud.ply")
    make_cameras(folder)
    scene = {"path": "/data", "test_names": [NAMES[0]], "images": "images", "resolution": 2}
    (folder / "config.json").write_text(
        json.dumps({"config": TrainConfig(iterations=100).to_json(), "scene": scene}), encoding="utf-8"
    )


def read_model_folder(folder: Path) -> None:
    from clsplat.models.model import load_model

    loaded = load_model(folder)
    finite(loaded.splats.arrays)
    loaded.read_cameras()
    assert loaded.test_names is None or all(isinstance(name, str) for name in loaded.test_names)
    assert all(np.isfinite(loaded.background))


def make_cfg_args(folder: Path) -> None:
    (folder / "cfg_args").write_text(
        "Namespace(sh_degree=3, source_path='/data', images='images', resolution=2, white_background=True, eval=True)",
        encoding="utf-8",
    )


def make_search(folder: Path) -> None:
    from dataclasses import asdict

    from clsplat.compression.rules import BudgetOptions

    values = {
        "config": TrainConfig(iterations=100).to_json(),
        "options": asdict(BudgetOptions()),
        "scene": {"path": "/data", "resolution": 2},
    }
    (folder / "budget.json").write_text(json.dumps(values), encoding="utf-8")


def read_search(folder: Path) -> None:
    from clsplat.compression.state import BudgetState

    found = BudgetState.stored(folder)
    if found is not None:
        TrainConfig(**found[0].options)


def make_images(folder: Path) -> None:
    from PIL import Image

    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (20, 24, 4)).astype(np.uint8)
    write_png(folder / "rgba.png", pixels)
    write_grey16(folder / "deep.png", pixels[..., 0].astype(np.uint16) * 257)
    rgb = Image.fromarray(pixels[..., :3])
    for suffix in ("jpg", "webp", "bmp", "tif"):
        rgb.save(folder / f"rgb.{suffix}")
    rgb.convert("P").save(folder / "palette.png")
    rgb.convert("CMYK").save(folder / "cmyk.jpg")


def read_images(folder: Path) -> None:
    """Read all images. Raise the error of the first one that cannot be read."""
    failed: InputError | None = None
    for path in sorted(folder.iterdir()):
        try:
            image_size(path)
            image = read_image(path)
            assert image.dtype == np.uint8
            assert image.shape[2] in (3, 4)
        except InputError as error:
            failed = failed or error
    if failed is not None:
        raise failed


def make_photographs(folder: Path) -> None:
    from PIL import Image

    exif = Image.Exif()
    exif[0x0112], exif[0x010F], exif[0x0110] = 6, "Maker", "Model"
    exif.get_ifd(0x8769).update({0x920A: 35.0, 0xA405: 35})
    for index in range(3):
        picture = Image.fromarray(photo_of(index))
        (folder / "photos").mkdir(exist_ok=True)
        picture.save(folder / "photos" / f"shot_{index}.jpg", exif=exif)
    Image.fromarray(np.dstack([photo_of(3), photo_of(3)[:, :, 1]])).save(folder / "photos" / "shot_3.png")
    write_png(folder / "photos" / "masks" / "shot_0.jpg.png", photo_of(0).transpose(1, 0, 2)[:, :, 1])


def read_photographs(folder: Path) -> None:
    """Take the steps of a reconstruction before the search for features."""
    import tempfile

    from clsplat.scenes.reconstruct.photo_files import (
        find_photos,
        fingerprint,
        group_by_camera,
        is_photographs,
        stage_photo,
    )

    is_photographs(folder / "photos")
    found = find_photos(folder / "photos")
    fingerprint(folder / "photos")
    with tempfile.TemporaryDirectory() as work:
        (Path(work) / "photos").mkdir()
        ready = [
            stage_photo(photo, number, Path(work) / "photos", Path(work) / "masks")
            for number, photo in enumerate(found)
        ]
    group_by_camera([photo for photo in ready if not isinstance(photo, str)], "auto")
    for line in ready:
        if isinstance(line, str):  # a reconstruction skips such photos and prints this line
            raise InputError(line)


def make_blender(folder: Path) -> None:
    for part, index in (("train", 0), ("train", 1), ("test", 2)):
        write_png(folder / part / f"r_{index}.png", np.dstack([photo_of(index), photo_of(index)[:, :, 1]]))
    for part, places in (("train", (0, 1)), ("test", (2,))):
        frames = [
            {
                "file_path": f"./{part}/r_{i}",
                "rotation": 0.1,
                "transform_matrix": np.linalg.inv(model_views()[i].cam_from_world).tolist(),
            }
            for i in places
        ]
        (folder / f"transforms_{part}.json").write_text(
            json.dumps({"camera_angle_x": 0.7, "frames": frames}), encoding="utf-8"
        )


def read_facts(folder: Path) -> None:
    from clsplat.scenes.info import scene_info

    scene_info(folder)


def make_page(folder: Path) -> None:
    """Write the part of a page that is read. The rest of it would take the damage."""
    page = folder / "whole.html"
    write_web_page(page, small_splats(), PageContent("page"))
    (payload,) = re.findall(r'<script id="payload".*?</script>', page.read_text(encoding="utf-8"), re.S)
    page.unlink()
    (folder / "a.html").write_text(payload, encoding="utf-8")


def make_gltf(folder: Path) -> None:
    small_splats().save(folder / "a.glb")
    document, binary = glb_files.parts((folder / "a.glb").read_bytes())
    (folder / "a.glb").unlink()
    document["buffers"][0]["uri"] = "a.bin"
    document["nodes"][0] |= {"translation": [1, 2, 3], "rotation": [0, 0, 0, 1], "scale": [2, 2, 2]}
    (folder / "a.bin").write_bytes(binary)
    (folder / "a.gltf").write_text(json.dumps(document), encoding="utf-8")


READERS = {
    "page": Sample(make_page, lambda f: finite(Splats.load(f / "a.html").arrays)),
    "ply": Sample(lambda f: small_splats().save(f / "model.ply"), lambda f: finite(read_ply(f / "model.ply").arrays)),
    "ply-compact": Sample(make_compact, lambda f: finite(read_ply(f / "model.ply").arrays)),
    "point-cloud": Sample(make_ascii, lambda f: read_point_cloud(f / "points.ply")),
    "splat": Sample(
        lambda f: small_splats("gaussian").save(f / "a.splat"),
        lambda f: finite(Splats.load(f / "a.splat").arrays),
    ),
    "spz": Sample(
        lambda f: small_splats("gaussian", 2).save(f / "a.spz"), lambda f: finite(Splats.load(f / "a.spz").arrays)
    ),
    "ply-packed": Sample(
        lambda f: packed_ply.write(f / "a.ply", packed_ply.some(6, 1)), lambda f: finite(read_ply(f / "a.ply").arrays)
    ),
    "sog": Sample(
        lambda f: sog_files.write(f / "a.sog", *sog_files.some(6, 1)),
        lambda f: finite(Splats.load(f / "a.sog").arrays),
    ),
    "sog-folder": Sample(
        lambda f: sog_files.write(f / "meta.json", *sog_files.some(6, 1)),
        lambda f: finite(Splats.load(f / "meta.json").arrays),
    ),
    "glb": Sample(lambda f: small_splats().save(f / "a.glb"), lambda f: finite(Splats.load(f / "a.glb").arrays)),
    "gltf": Sample(make_gltf, lambda f: finite(Splats.load(f / "a.gltf").arrays), "a.gltf"),
    "cfg-args": Sample(make_cfg_args, lambda f: read_cfg_args(f / "cfg_args")),
    "colmap-bin": Sample(make_scene, lambda f: read_model(find_model(f)), "sparse"),
    "colmap-txt": Sample(lambda f: make_scene(f, ".txt"), lambda f: read_model(find_model(f)), "sparse"),
    "scene": Sample(make_masked, read_scene),
    "test-list": Sample(make_listed, read_listed, "test.txt"),
    "transforms": Sample(make_transforms, read_scene),
    "blender": Sample(make_blender, read_scene),
    "opf": Sample(make_opf, read_scene),
    "opensfm": Sample(make_opensfm, read_scene, "reconstruction.json"),
    "metashape": Sample(make_metashape, read_scene, "cameras.xml"),
    "photographs": Sample(make_photographs, read_photographs),
    "scene-facts": Sample(make_masked, read_facts),
    "cameras-json": Sample(make_cameras, lambda f: read_cameras(f / "cameras.json")),
    "camera-path": Sample(make_path, lambda f: read_path(f / "path.json")),
    "config": Sample(make_config, read_config),
    "checkpoint": Sample(make_checkpoint, read_checkpoint),
    "model-folder": Sample(make_model, read_model_folder),
    "search": Sample(make_search, read_search),
    "images": Sample(make_images, read_images),
}
if find_spec("zstandard"):
    READERS["spz-4"] = Sample(
        lambda f: small_splats("gaussian", 2).save(f / "a.spz", spz_version=4),
        lambda f: finite(Splats.load(f / "a.spz").arrays),
    )
if find_spec("pxr"):
    for ending in ("usda", "usdc"):
        READERS[ending] = Sample(
            lambda f, ending=ending: small_splats().save(f / f"a.{ending}"),
            lambda f, ending=ending: finite(Splats.load(f / f"a.{ending}").arrays),
        )

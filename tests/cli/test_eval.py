"""`clsplat eval`: metrics of models of clsplat and 3DGS, and of files of splats, against a scene."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from cli_runner import HEIGHT, ITERATIONS, TEST_NAMES, WIDTH, clsplat, error_of, run
from PIL import Image

from clsplat.evaluation.metrics import protocol_named
from clsplat.files.images import read_image, write_png
from clsplat.models.model import LoadedModel, load_model
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene, load_scene
from clsplat.splats.splats import Splats


def ply(model: Path, iteration: int = ITERATIONS) -> Path:
    return model / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"


def test_eval_writes_3dgs_files_with_the_protocol(copied_model: Path, scene: Path, tmp_path: Path) -> None:
    out = clsplat("eval", copied_model, "--save-renders", tmp_path / "r")
    results = json.loads((copied_model / "results.json").read_text())
    entry = results[f"ours_{ITERATIONS}"]
    assert set(entry["floaters"]) == {"train_psnr", "psnr_gap", "few_views_share", "near_camera_share"}
    assert entry["floaters"]["psnr_gap"] == entry["floaters"]["train_psnr"] - entry["PSNR"]
    assert "of the splats are seen by fewer than 3 training views" in (copied_model / "report.html").read_text()
    assert set(results) == {f"ours_{ITERATIONS}"}
    assert entry["protocol"]["name"] == "clsplat"
    assert entry["bytes"] == ply(copied_model).stat().st_size
    splats = Splats.load(ply(copied_model))
    assert (entry["splats"], entry["shape"], entry["views"]) == (len(splats), "skew-normal", 2)
    assert entry["sizes"] == [[WIDTH, HEIGHT]]
    assert entry["parameters"] == len(splats) * (3 + 4 + 3 + 1 + 3 * 4 + 3)
    assert entry["render_ms"] > 0
    per_view = json.loads((copied_model / "per_view.json").read_text())[f"ours_{ITERATIONS}"]
    assert set(per_view) == {"SSIM", "PSNR"}
    assert list(per_view["PSNR"]) == TEST_NAMES
    assert f"{entry['PSNR']:.3f}" in out
    for view in load_scene(scene).test:  # computed from the saved images by the metrics module
        rendered = np.asarray(Image.open(tmp_path / "r" / view.name))
        measured = protocol_named("clsplat").measure(rendered, view.image)
        assert per_view["PSNR"][view.name] == pytest.approx(measured["PSNR"], abs=1e-6)
        assert per_view["SSIM"][view.name] == pytest.approx(measured["SSIM"], abs=1e-6)
    assert entry["PSNR"] == pytest.approx(np.mean(list(per_view["PSNR"].values())))


def test_eval_of_several_models_protocols_and_iterations(model: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    for copy in (first, second):
        shutil.copytree(model, copy)
    out = clsplat("eval", "-m", first, second, "--compat", "3dgs", "--iteration", "20")
    assert str(first) in out
    assert str(second) in out
    clsplat("eval", first)
    results = json.loads((first / "results.json").read_text())
    assert [results[f"ours_{n}"]["protocol"]["name"] for n in (20, ITERATIONS)] == ["3dgs", "clsplat"]


def test_eval_of_a_model_trained_from_python(scene: Path, tmp_path: Path) -> None:
    """The folder records the scene and the test views, so the command line need not name them."""
    import clsplat as package

    names = tmp_path / "names.txt"
    names.write_text("view_002.png")
    package.train(
        package.load_scene(scene, test_list=names),
        package.TrainConfig(iterations=2, cap_max=50, sh_degree=0),
        output=tmp_path / "m",
    )
    clsplat("eval", tmp_path / "m")
    per_view = json.loads((tmp_path / "m" / "per_view.json").read_text())
    assert list(per_view["ours_2"]["PSNR"]) == ["view_002.png"]


def test_eval_of_a_moved_scene(model: Path, scene: Path, tmp_path: Path) -> None:
    moved, copy = tmp_path / "moved", tmp_path / "m"
    shutil.copytree(scene, moved)
    shutil.copytree(model, copy)
    stored = json.loads((copy / "config.json").read_text())
    stored["scene"]["path"] = str(tmp_path / "gone")
    (copy / "config.json").write_text(json.dumps(stored))
    assert "with -s" in error_of("eval", copy)
    clsplat("eval", copy, "-s", moved)
    clsplat("render", copy, "-o", tmp_path / "r")  # rendering needs no photos


def test_models_of_different_views_are_not_compared_in_silence(model: Path, scene: Path, tmp_path: Path) -> None:
    small, names = tmp_path / "small", tmp_path / "names.txt"
    names.write_text("view_003.png\n")
    clsplat("train", scene, "-m", small, "-r", 2, "--eval", "--iterations", "2", "--cap-max", "50", "-q")
    said = f"{small} and {model} are measured on different views or sizes"
    both = ("eval", "-m", model, small, "--no-report")
    assert f"warning: {said}: do not compare their numbers" in run(*both).stderr
    assert f"{said}: compare models of one scene" in error_of("eval", model, small, "--report", tmp_path / "r.html")
    assert "warning" not in run(*both, "-r", 2).stderr
    clsplat("train", scene, "-m", small, "--overwrite", "--test-list", names, *("--iterations", "2"), "-q")
    assert f"warning: {said}" in run(*both).stderr


def test_models_of_different_views_are_refused_before_they_are_measured(
    model: Path, scene: Path, tmp_path: Path
) -> None:
    models = tmp_path / "first", tmp_path / "other"
    shutil.copytree(model, models[0], ignore=shutil.ignore_patterns("*.html", "results.json", "per_view.json"))
    clsplat("train", scene, "-m", models[1], "-r", 2, "--eval", "--iterations", "2", "--cap-max", "50", "-q")
    said = error_of("eval", *models, "--report", tmp_path / "r.html")
    assert f"{models[1]} and {models[0]} are measured on different views or sizes: compare models of one scene" in said
    assert not [path for path in models if (path / "results.json").exists()]
    assert not (tmp_path / "r.html").exists()


@pytest.mark.parametrize("report", [True, False])
def test_the_scene_of_a_model_is_read_once(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, report: bool
) -> None:
    """A common report needs the views of all models before the first one is measured."""
    loaded: list[Path] = []
    load = LoadedModel.load_scene

    def counted(self: LoadedModel, *arguments: object, **options: object) -> Scene:
        loaded.append(self.path)
        return load(self, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(LoadedModel, "load_scene", counted)
    models = [model, tmp_path / "other"]
    shutil.copytree(*models)
    clsplat("eval", *models, *(("--report", tmp_path / "both.html") if report else ("--no-report",)))
    assert loaded == models


def test_changed_photos_are_refused_before_a_model_is_measured(
    model: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if they are those of the second model."""
    moved, other = tmp_path / "yard", tmp_path / "other"
    shutil.copytree(scene, moved)
    shutil.copytree(model, other)
    photo = sorted((moved / "images").iterdir())[0]
    write_png(photo, 255 - read_image(photo))
    stored = json.loads((other / "config.json").read_text())
    stored["scene"]["path"] = str(moved)
    (other / "config.json").write_text(json.dumps(stored))
    measured: list[str] = []
    monkeypatch.setattr("clsplat.models.evaluation.evaluate_views", lambda *_, **__: measured.append("one"))
    said = error_of("eval", model, other, "--report", tmp_path / "r.html")
    assert f"1 of 10 photos or masks have changed since {other} was trained" in said
    assert not measured


# --- files of splats ---------------------------------------------------------------------------


def measured(*args: object, file: Path) -> dict[str, dict[str, float]]:
    """Return metrics and views of `clsplat eval ARGS`, which measures one model."""
    clsplat("eval", *args, "--json", file, "--overwrite", "-q")
    (entry,) = json.loads(file.read_text()).values()
    return {name: entry["results"][name] for name in ("PSNR", "SSIM", "background", "views")} | {
        "names": list(entry["per_view"]["PSNR"])
    }


@pytest.fixture
def splat_files(model: Path, tmp_path: Path) -> Path:
    """A folder with the small model as files in several formats."""
    folder = tmp_path / "files"
    folder.mkdir()
    shutil.copy(ply(model), folder / "a.ply")
    for name in ("a.spz", "a.splat"):
        clsplat("convert", model, folder / name, "--approximate", "-q")
    return folder


def test_a_bare_ply_has_the_numbers_of_its_model(copied_model: Path, splat_files: Path, scene: Path) -> None:
    of_file = measured(splat_files / "a.ply", "-s", scene, file=splat_files.parent / "n.json")
    assert of_file == measured(copied_model, file=splat_files.parent / "n.json")
    assert of_file["names"] == TEST_NAMES


@pytest.mark.parametrize("name", ["a.spz", "a.splat"])
def test_other_files_are_measured_as_their_splats(splat_files: Path, scene: Path, tmp_path: Path, name: str) -> None:
    Splats.load(splat_files / name).save(tmp_path / "same.ply")
    of_file = measured(splat_files / name, "-s", scene, file=tmp_path / "n.json")
    assert of_file == measured(tmp_path / "same.ply", "-s", scene, file=tmp_path / "n.json")


def test_nothing_is_written_beside_a_file(splat_files: Path, scene: Path, tmp_path: Path) -> None:
    (splat_files / "report.html").write_text("precious")
    before = sorted(splat_files.iterdir())
    said = clsplat("eval", splat_files / "a.spz", "-s", scene)
    assert str(splat_files / "a.spz") in said
    assert "page" not in said
    page, pictures = tmp_path / "page.html", tmp_path / "r"
    said = clsplat("eval", *before[:3], "-s", scene, "--report", page, "--set", "all", "--save-renders", pictures)
    assert said.count(".sp") == 4, "each file has a row of the table and a line on floaters"
    assert f"page: {page}" in said
    assert all(path.name in page.read_text() for path in before[:3])
    assert len(list(pictures.rglob("*.png"))) == 30
    assert sorted(splat_files.iterdir()) == before
    assert (splat_files / "report.html").read_text() == "precious"
    assert "page.html: exists already" in error_of("eval", before[0], "-s", scene, "--report", page)
    assert "does not record its scene: give the scene's folder with -s" in error_of("eval", before[0])


def test_options_of_the_scene_of_a_file(splat_files: Path, scene: Path, tmp_path: Path) -> None:
    """Masks, sizes, test views and the background under transparent photos."""
    copy, out = tmp_path / "scene", tmp_path / "n.json"
    shutil.copytree(scene, copy)
    plain = measured(splat_files / "a.ply", "-s", copy, file=out)
    for photo in (copy / "images").iterdir():
        mask = np.zeros(np.asarray(Image.open(photo)).shape[:2], np.uint8)
        mask[: len(mask) // 2] = 255
        write_png(copy / "masks" / f"{photo.name}.png", mask)
    masked = measured(splat_files / "a.ply", "-s", copy, file=out)
    assert masked["PSNR"] != plain["PSNR"]
    assert measured(splat_files / "a.ply", "-s", copy, "--masks", "none", file=out) == plain
    assert measured(splat_files / "a.ply", "-s", copy, "-r", "2", file=out)["PSNR"] != masked["PSNR"]
    every = measured(splat_files / "a.ply", "-s", copy, "--test-every", "3", file=out)
    assert every["names"] == [f"view_{i:03d}.png" for i in (0, 3, 6, 9)]
    (tmp_path / "names.txt").write_text("view_004.png")
    listed = measured(splat_files / "a.ply", "-s", copy, "--test-list", tmp_path / "names.txt", file=out)
    assert listed["names"] == ["view_004.png"]


def test_transparent_photos_and_renders_have_one_background(splat_files: Path, scene: Path, tmp_path: Path) -> None:
    """Photos and splats that show nothing are equal on any background."""
    copy, empty = tmp_path / "scene", tmp_path / "empty.ply"
    shutil.copytree(scene, copy)
    for photo in (copy / "images").iterdir():
        pixels = np.asarray(Image.open(photo).convert("RGBA")).copy()
        pixels[..., 3] = 0
        write_png(photo, pixels)
    splats = Splats.load(splat_files / "a.ply")
    splats.select([]).save(empty)
    for options, color in (([], [0, 0, 0]), (["-w"], [1, 1, 1]), (["--background", "0.2,0.4,0.6"], [0.2, 0.4, 0.6])):
        found = measured(empty, "-s", copy, *options, file=tmp_path / "n.json")
        assert found["background"] == color
        assert found["PSNR"] == 100


def test_recorded_test_views_stay(copied_model: Path, scene: Path) -> None:
    said = "records its test views: leave out the choice of others (--test-every or --test-list)"
    assert said in error_of("eval", copied_model, "--test-every", "2")


# --- folders of 3DGS ---------------------------------------------------------------------------


def as_3dgs(model: Path, cfg_args: str) -> None:
    """Make a folder of clsplat one that 3DGS could have written, with its results."""
    for name in ("config.json", "checkpoint.npz", "log.jsonl"):
        (model / name).unlink()
    (model / "cfg_args").write_text(cfg_args)
    (model / "results.json").write_text(json.dumps({f"ours_{ITERATIONS}": {"PSNR": 1.5}}))


def namespace(scene: Path, **values: object) -> str:
    held = {
        "sh_degree": 3,
        "source_path": str(scene),
        "model_path": "/output/x",
        "images": "images",
        "depths": "",
        "resolution": -1,
        "white_background": False,
        "train_test_exp": False,
        "data_device": "cuda",
        "eval": True,
    } | values
    return f"Namespace({', '.join(f'{name}={value!r}' for name, value in held.items())})"


def test_a_folder_of_3dgs_knows_its_scene(copied_model: Path, scene: Path, tmp_path: Path) -> None:
    wanted = measured(copied_model, file=tmp_path / "n.json")
    as_3dgs(copied_model, namespace(scene))
    clsplat("eval", copied_model)
    results = json.loads((copied_model / "results.json").read_text())
    assert results[f"ours_{ITERATIONS}"] == {"PSNR": 1.5}
    assert results[f"clsplat_{ITERATIONS}"]["PSNR"] == wanted["PSNR"]
    as_3dgs_again = namespace(scene, white_background=True, resolution=2)
    (copied_model / "cfg_args").write_text(as_3dgs_again)
    loaded = load_model(copied_model)
    assert loaded.background == (1, 1, 1)
    assert loaded.load_scene().views[0].camera.width == load_scene(scene).views[0].camera.width // 2
    white = measured(copied_model, file=tmp_path / "n.json")
    camera = loaded.load_scene().test[0].camera
    image = Renderer().render(loaded.splats, camera, (1, 1, 1)).color
    clsplat("eval", copied_model, "--save-renders", tmp_path / "r", "-q")
    saved = np.asarray(Image.open(tmp_path / "r" / TEST_NAMES[0])) / 255
    np.testing.assert_allclose(saved, np.clip(image, 0, 1), atol=0.51 / 255)
    assert white["background"] == [1, 1, 1]


@pytest.mark.parametrize("with_cameras", [True, False])
def test_the_test_views_of_a_folder_of_3dgs_are_rendered(
    copied_model: Path, scene: Path, tmp_path: Path, with_cameras: bool
) -> None:
    """3DGS's cameras.json does not say which views are test views: the scene does, which cfg_args names."""
    as_3dgs(copied_model, namespace(scene))
    if not with_cameras:
        (copied_model / "cameras.json").unlink()
    clsplat("render", copied_model, "-o", tmp_path / "test", "--set", "test", "-q")
    assert sorted(file.stem for file in (tmp_path / "test").iterdir()) == sorted(Path(name).stem for name in TEST_NAMES)
    clsplat("render", copied_model, "-o", tmp_path / "all", "--set", "all", "-q")
    assert len(list((tmp_path / "all").iterdir())) == len(load_scene(scene).views)


def test_3dgs_without_eval_has_no_test_views(copied_model: Path, scene: Path, tmp_path: Path) -> None:
    as_3dgs(copied_model, namespace(scene, eval=False))
    assert "was trained on all views" in error_of("eval", copied_model)
    assert measured(copied_model, "--set", "train", file=tmp_path / "n.json")["views"] == 10
    shutil.copytree(scene / "images", tmp_path / "scene" / "photos")
    shutil.copytree(scene / "sparse", tmp_path / "scene" / "sparse")
    (copied_model / "cfg_args").write_text(namespace(tmp_path / "scene", images="photos"))
    assert measured(copied_model, file=tmp_path / "n.json")["names"] == TEST_NAMES


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("__import__('os').system('touch HIT')", "is not the text Namespace"),
        ("Namespace(source_path=__import__('os').system('touch HIT'))", "is not the text Namespace"),
        ("Namespace(source_path='/x'", "is not the text Namespace"),
        ("Namespace(source_path=" + "(" * 5000 + ")" * 5000 + ")", "is not the text Namespace"),
        ("\0", "is not the text Namespace"),
        ("", "is not the text Namespace"),
        ("Namespace(source_path=3)", "source_path is '3': restore"),
        ("Namespace(resolution=True)", "resolution is 'True': restore"),
        ("Namespace(source_path='/gone')", "its scene /gone does not exist: give the scene's folder with -s"),
        ("Namespace(data_device=device(type='cuda'))", "does not record its scene"),
    ],
)
def test_cfg_args_is_parsed_and_never_run(
    copied_model: Path, monkeypatch: pytest.MonkeyPatch, text: str, said: str
) -> None:
    monkeypatch.chdir(copied_model)
    as_3dgs(copied_model, text)
    assert said in error_of("eval", copied_model)
    assert not (copied_model / "HIT").exists()

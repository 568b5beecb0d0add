"""A model is measured, pruned and continued with the photos that it was trained on. Other photos need a flag."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from cli_runner import clsplat, error_of, run

import clsplat as package
from clsplat.errors import InputError
from clsplat.files.digest import file_digest
from clsplat.files.images import read_image, write_png
from clsplat.scenes.changed_photos import check_photos
from clsplat.scenes.scene import load_scene


@pytest.fixture
def scene(capture_folder: Path, tmp_path: Path) -> Path:
    """A copy of the small capture at another place, with other times of modification."""
    copy = Path(shutil.copytree(capture_folder, tmp_path / "moved", copy_function=shutil.copyfile))
    for file in (copy / "images").iterdir():
        os.utime(file, ns=(1, 1))
    return copy


@pytest.fixture
def model(model_folder: Path, tmp_path: Path) -> Path:
    """A copy of the small model."""
    return Path(shutil.copytree(model_folder, tmp_path / "model"))


def invert(photo: Path) -> None:
    write_png(photo, 255 - read_image(photo))


def commands(model: Path, scene: Path, out: Path) -> dict[str, tuple[object, ...]]:
    return {
        "eval": ("eval", model, "-s", scene, "--no-report"),
        "resume": ("train", scene, "--resume", "-m", model),
        "prune": ("prune", model, "-s", scene, "-o", out, "--overwrite"),
    }


@pytest.mark.parametrize("command", ["eval", "resume", "prune"])
def test_photos_that_were_exchanged(model: Path, scene: Path, tmp_path: Path, command: str) -> None:
    call = commands(model, scene, tmp_path / "small.ply")[command]
    clsplat(*call)
    invert(scene / "images" / "view_003.png")
    message = error_of(*call)
    assert f"{scene}: 1 of 10 photos or masks have changed since {model} was trained" in message
    assert "'view_003.png': restore them or use them anyway (--allow-changed-photos)" in message
    result = run(*call, "--allow-changed-photos")
    assert result.exit_code == 0, result.output
    assert "warning: " in result.stderr
    assert "1 of 10 photos or masks have changed" in result.stderr


def test_a_mask_that_was_added(model: Path, scene: Path) -> None:
    write_png(scene / "masks" / "view_000.png", np.eye(36, 48))
    assert "1 of 10 photos or masks have changed" in error_of("eval", model, "-s", scene)


def test_a_resumed_run_needs_the_same_set_of_photos(model: Path, scene: Path) -> None:
    loaded = load_scene(scene)
    recorded = json.loads((model / "config.json").read_text())["scene"]["photos"]
    check_photos(loaded, recorded, model, all_views=True)
    fewer = {name: digest for name, digest in recorded.items() if name != "view_001.png"}
    check_photos(loaded, fewer, model)
    for other, what in ((fewer, "0 photos of .* are missing and 1 are new"), (recorded | {"z": "0"}, "1 photos of")):
        with pytest.raises(InputError, match=what):
            check_photos(loaded, other, model, all_views=True, allow=True)


def test_other_uses_of_a_scene_are_allowed(model: Path, scene: Path, tmp_path: Path) -> None:
    """Reduced photos of another folder are other files, and renders need cameras only."""
    shutil.copytree(scene / "images", scene / "images_1")
    for photo in (scene / "images_1").iterdir():
        invert(photo)
    clsplat("eval", model, "-s", scene, "-i", "images_1", "--no-report")
    shutil.rmtree(scene / "images")
    (scene / "images_1").rename(scene / "images")
    clsplat("render", model, "-s", scene, "-o", tmp_path / "renders", "-q")
    assert "photos or masks have changed" in error_of("eval", model, "-s", scene)


def test_models_without_digests(model: Path, scene: Path) -> None:
    """Earlier versions recorded none."""
    config = json.loads((model / "config.json").read_text())
    del config["scene"]["photos"]
    (model / "config.json").write_text(json.dumps(config))
    invert(scene / "images" / "view_003.png")
    for name in ("eval", "resume"):
        clsplat(*commands(model, scene, scene)[name])


def test_the_same_in_python(model: Path, scene: Path) -> None:
    invert(scene / "images" / "view_003.png")
    with pytest.raises(InputError, match="photos or masks have changed"):
        package.resume(model, scene=scene)
    with pytest.warns(UserWarning, match="photos or masks have changed"):
        package.resume(model, scene=scene, allow_changed_photos=True)


def test_the_flag_alone_is_refused(model: Path, scene: Path) -> None:
    assert "--allow-changed-photos is for --resume" in error_of(
        "train", scene, "-m", model, "--allow-changed-photos", code=2
    )


def test_digests_of_many_photos_are_quick(tmp_path: Path) -> None:
    files = [tmp_path / f"{number}.jpg" for number in range(300)]
    for file in files:
        file.write_bytes(os.urandom(100_000))
    start = time.perf_counter()
    assert len({file_digest(file) for file in files}) == 300
    assert time.perf_counter() - start < 1.0

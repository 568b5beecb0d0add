"""`clsplat lod`, and `--detail` of render."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cli_runner import error_of, run

from clsplat.files.images import read_image
from clsplat.models import detail
from clsplat.splats.splats import Splats


def test_levels_are_measured_and_written(model_folder: Path, tmp_path: Path) -> None:
    said = run("lod", model_folder, "-o", tmp_path / "levels", "--levels", "3").stdout.splitlines()
    assert said[0].split() == ["level", "splats", "PSNR", "[dB]"]
    counts = [int(line.split()[1]) for line in said[1:4]]
    assert counts[0] > counts[1] > counts[2]
    assert said[5].split()[:4] == ["distance", "splats", "of", "all"]
    assert [line.split()[0] for line in said[6:11]] == ["1x", "2x", "4x", "8x", "16x"]
    files = [tmp_path / "levels" / f"level_{number}.ply" for number in (1, 2)]
    assert said[11:] == [str(file) for file in files]
    assert [len(Splats.load(file)) for file in files] == counts[1:]
    assert "--overwrite" in error_of("lod", model_folder, "-o", tmp_path / "levels", "--levels", "3")


def test_a_file_alone_is_seen_from_around(model_folder: Path, tmp_path: Path) -> None:
    (ply,) = model_folder.glob("point_cloud/iteration_40/*.ply")
    file = tmp_path / "alone.ply"
    file.write_bytes(ply.read_bytes())
    assert len(run("lod", file, "--levels", "2").stdout.splitlines()) == 10
    assert run("lod", file, "-q").stdout == ""


def test_other_files_and_the_model_itself_stay(model_folder: Path, tmp_path: Path) -> None:
    (ply,) = model_folder.glob("point_cloud/iteration_40/*.ply")
    names = ("level_0.ply", "level_backup.ply", "level_1.ply", "level_9.ply")
    for name in names:
        (tmp_path / name).write_bytes(ply.read_bytes())
    message = error_of("lod", tmp_path / "level_1.ply", "-o", tmp_path, "--overwrite")
    assert "level_1.ply: is the model itself: choose another folder" in message
    assert all((tmp_path / name).read_bytes() == ply.read_bytes() for name in names)
    run("lod", tmp_path / "level_0.ply", "-o", tmp_path, "--levels", "3", "--overwrite")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "level_0.ply",
        "level_1.ply",
        "level_2.ply",
        "level_backup.ply",
    ]
    assert all((tmp_path / name).read_bytes() == ply.read_bytes() for name in names[:2])


def test_models_of_no_splat_and_of_one(model_folder: Path, tmp_path: Path) -> None:
    (ply,) = model_folder.glob("point_cloud/iteration_40/*.ply")
    splats = Splats.load(ply)
    splats.select(np.arange(0)).save(tmp_path / "none.ply")
    splats.select(np.arange(1)).save(tmp_path / "one.ply")
    assert "none.ply: has no splats to merge" in error_of("lod", tmp_path / "none.ply")
    said = run("lod", tmp_path / "one.ply", "-o", tmp_path / "levels").stdout.splitlines()
    assert said[-1] == "no files: these splats have a single level"


def test_images_with_levels_of_detail(model_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(detail, "_LEAF", 8)  # else the cameras are inside the only part
    for name, flags in (("all", ()), ("none", ("--detail", "0")), ("coarse", ("--detail", "50"))):
        run("render", model_folder, "-o", tmp_path / name, "-q", *flags)
    (view,) = sorted(path.name for path in (tmp_path / "all").glob("*.png"))[:1]
    pictures = {name: read_image(tmp_path / name / view) for name in ("all", "none", "coarse")}
    assert (pictures["all"] == pictures["none"]).all()
    assert (pictures["all"] != pictures["coarse"]).any()
    assert np.abs(pictures["all"].astype(int) - pictures["coarse"]).mean() < 60

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


def test_images_with_levels_of_detail(model_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(detail, "_LEAF", 8)  # else the cameras are inside the only part
    for name, flags in (("all", ()), ("none", ("--detail", "0")), ("coarse", ("--detail", "50"))):
        run("render", model_folder, "-o", tmp_path / name, "-q", *flags)
    (view,) = sorted(path.name for path in (tmp_path / "all").glob("*.png"))[:1]
    pictures = {name: read_image(tmp_path / name / view) for name in ("all", "none", "coarse")}
    assert (pictures["all"] == pictures["none"]).all()
    assert (pictures["all"] != pictures["coarse"]).any()
    assert np.abs(pictures["all"].astype(int) - pictures["coarse"]).mean() < 60

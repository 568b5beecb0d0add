"""`clsplat clean`: its report, its outputs and its errors."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_runner import clsplat, error_of
from model_arrays import random_model

from clsplat.splats.shapes import GAUSSIAN
from clsplat.splats.splats import Splats


def test_the_report_and_the_file(model: Path, tmp_path: Path) -> None:
    said = clsplat("clean", model, "-o", tmp_path / "out.ply")
    n = len(Splats.load(tmp_path / "out.ply"))
    assert f"splats: {n} left of " in said
    assert "unseen: no training view shows them" in said
    assert "training views (8): PSNR " in said
    assert "test views, not used to decide (2): PSNR " in said
    assert f"written: {tmp_path / 'out.ply'}" in said
    assert "exists already" in error_of("clean", model, "-o", tmp_path / "out.ply")


def test_a_dry_run_writes_nothing(model: Path, tmp_path: Path) -> None:
    before = sorted(model.rglob("*"))
    said = clsplat("clean", model, "--dry-run", "--no-photos")
    assert "nothing was written" in said
    assert "no photos: nothing was measured" in said
    assert sorted(model.rglob("*")) == before
    assert "give the output with -o, or --dry-run" in error_of("clean", model, code=2)
    assert "give the output with -o, or --dry-run" in error_of("clean", model, "-o", tmp_path, "--dry-run", code=2)


@pytest.mark.parametrize("ending", [".ply", ".spz", ".splat"])
def test_what_the_file_lacks_is_named(tmp_path: Path, ending: str) -> None:
    arrays = random_model(GAUSSIAN, 9, 0, dead=0)
    Splats("gaussian", arrays, antialiased=True, near_plane=0.25, low_pass=0.1).save(tmp_path / "a.ply")
    said = clsplat("clean", tmp_path / "a.ply", "--no-photos", "-o", tmp_path / f"b{ending}")
    assert ("the near plane is not in the file: splats nearer than 0.25 units are drawn" in said) == (ending != ".ply")
    assert ("the SH bands above 0 are not in the file" in said) == (ending == ".splat")
    assert ("does not say that its splats are antialiased" in said) == (ending == ".splat")
    assert ("the low pass of 0.1 px² is not in the file" in said) == (ending == ".spz")
    assert ("the file is rounded; what that costs was not measured" in said) == (ending != ".ply")


def test_the_cost_of_rounding_is_measured(model: Path, tmp_path: Path) -> None:
    said = clsplat("clean", model, "-o", tmp_path / "out.sog")
    assert "the file is rounded; PSNR against the model's own images, 10 cameras: " in said


def test_clean_refuses(model: Path, scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.ply"
    assert "give -s or --no-photos" in error_of("clean", model, "-s", scene, "--no-photos", "-o", out, code=2)
    assert "no such model folder" in error_of("clean", tmp_path / "none", "-o", out)
    assert "is the model itself" in error_of("clean", model, "-o", model, "--overwrite")
    assert not out.exists()
    for ending in (".spz", ".splat"):
        said = error_of("clean", model, "-o", tmp_path / f"out{ending}")
        assert f"{ending} files hold gaussian splats, not skew-normal: choose .ply, or convert it" in said
        assert "measuring" not in said

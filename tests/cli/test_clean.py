"""`clsplat clean`: its report, its outputs and its errors."""

from __future__ import annotations

from pathlib import Path

from cli_runner import clsplat, error_of

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

"""`clsplat partition` and `clsplat train --blocks`."""

from __future__ import annotations

from pathlib import Path

from cli_runner import clsplat, error_of, run

TINY = ["--iterations", "12", "--sh-degree", "1", "--densify-interval", "5", "--cap-max", "80"]


def test_a_partition_is_shown_and_then_trained(scene: Path, tmp_path: Path) -> None:
    said = run("partition", scene, "-m", tmp_path / "m", "--blocks", "2x1", "--polish", "2", "--eval", *TINY)
    assert said.exit_code == 0, said.output
    lines = said.stdout.splitlines()
    assert lines[0].split() == ["block", "splats", "points", "photos", "most", "of", "a", "photo"]
    assert [line.split()[0] for line in lines[1:3]] == ["0", "1"]
    assert "partition.svg" in lines[3]
    trained = run("train", "--resume", "-m", tmp_path / "m")
    assert trained.exit_code == 0, trained.output
    lines = trained.stdout.splitlines()
    assert lines[0].split()[:3] == ["block", "photos", "splats"]
    assert "test views (2): PSNR" in lines[-1]
    assert "step 3 of 4, 2 blocks with at most 40 splats" in trained.stderr
    assert clsplat("eval", tmp_path / "m") != ""


def test_train_in_blocks_at_once(scene: Path, tmp_path: Path) -> None:
    assert clsplat("train", scene, "-m", tmp_path / "m", "--blocks", "2x1", "--polish", "0", "-q", *TINY) == ""
    assert "already holds a model" in error_of("train", scene, "-m", tmp_path / "m", *TINY)
    clsplat("train", scene, "-m", tmp_path / "m", "--overwrite", "-q", *TINY)
    assert not (tmp_path / "m" / "blocks.json").exists()


def test_mistakes_are_one_line(scene: Path, tmp_path: Path) -> None:
    arguments = ("train", scene, "-m", tmp_path / "m")
    assert "such as 2x2, at most 64 of each, or auto" in error_of(*arguments, "--blocks", "65x1")
    assert "such as 2x2" in error_of(*arguments, "--blocks", "4")
    both = run(*arguments, "--blocks", "2x1", "--validate", *TINY)
    assert both.stderr.count("validate") == 2, "the option in one line"
    assert "validate True: each block has other photos: leave --validate out" in both.stderr
    assert "give --blocks too" in error_of(*arguments, "--polish", "4", code=2)
    assert "remove --view and --budget" in error_of(*arguments, "--blocks", "2x2", "--budget", "auto", code=2)
    assert "name the blocks" in error_of("partition", scene, "-m", tmp_path / "m")
    assert not (tmp_path / "m").exists()


def test_what_has_no_effect_and_what_cannot_change(scene: Path, tmp_path: Path) -> None:
    folder = tmp_path / "Mäp dir"
    said = run("partition", scene, "-m", folder, "--blocks", "2x1", "--save-iterations", "6,12", *TINY)
    assert "--save-iterations has no effect with --blocks" in said.stderr
    assert f"clsplat train --resume -m '{folder}'" in said.stdout
    assert "many runs: resume it without --view" in error_of("train", "--resume", "-m", folder, "--view", code=2)
    assert "--polish stays as it was" in error_of("train", "--resume", "-m", folder, "--polish", "5", code=2)


def test_several_devices(scene: Path, tmp_path: Path) -> None:
    words = ("partition", scene, "-m", tmp_path / "m", "--blocks", "2x1", "--device", "cpu/2", *TINY)
    assert "name one device" in error_of(*words)
    for command in ("compare", "frontier"):
        words = (command, scene, "-o", tmp_path / command, "--device", "0:0,1:0", "--iterations", "2")
        assert "each run has one device" in error_of(*words, code=2)
        assert not (tmp_path / command).exists()

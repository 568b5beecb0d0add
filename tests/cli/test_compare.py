"""`clsplat compare` and `clsplat train --preset`: files, output, and a message of one line for each mistake."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_runner import SHORT, clsplat, error_of, run

from clsplat.training.presets import PRESETS, preset

TINY = ["--iterations", "12", "--sh-degree", "1", "--densify-interval", "5"]


def test_compare_prints_a_table_and_continues(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ("compare", scene, "-o", out, "--systems", "gaussian,default:opacity_lr=0.02", "--cap-max", "40", *TINY)
    first = run(*arguments, "--seeds", "0", "1")
    assert first.exit_code == 0, first.output
    lines = first.stdout.splitlines()
    assert lines[0].split() == [
        "scene",
        "cap",
        "iterations",
        "system",
        "seeds",
        "PSNR",
        "SSIM",
        "seconds",
        "splats",
        "parameters",
        "MB",
    ]
    assert [line.split()[4] for line in lines[1:3]] == ["gaussian", "default:opacity_lr=0.02"]
    assert "±" in lines[1]
    assert "[4/4] yard default:opacity_lr=0.02 cap 40 seed 1: PSNR" in first.stderr
    assert {path.name for path in out.iterdir()} == {"runs.jsonl", "table.md", "results.json"}
    assert len((out / "runs.jsonl").read_text().splitlines()) == 4
    again = run(*arguments, "--seeds", "0,1")
    assert (again.stdout, again.stderr) == (first.stdout, "")
    assert clsplat(*arguments, "--seeds", "2", "-q") == ""
    rows = json.loads((out / "results.json").read_text())["rows"]
    assert [row["seeds"] for row in rows] == [[0, 1, 2]] * 2
    assert rows[1]["config"]["opacity_lr"] == 0.02
    assert rows[0]["config"]["iterations"] == 12


def test_compare_names_each_mistake(scene: Path, tmp_path: Path) -> None:
    arguments = ("compare", scene, "-o", tmp_path / "out")
    assert "unknown system 'cube'" in error_of(*arguments, "--systems", "cube")
    assert "3dgs has strategy adc, which contradicts strategy mcmc" in error_of(
        *arguments, "--systems", "3dgs", "--strategy", "mcmc"
    )
    assert "not a list of seeds" in error_of(*arguments, "--seeds", "-1", code=2)
    assert "not a list of caps" in error_of(*arguments, "--cap-max", "0", code=2)
    assert "--seed" in error_of(*arguments, "--seed", "1", code=2)
    assert "two scenes are called yard" in error_of(*arguments, scene)
    assert "output" in error_of("compare", scene, code=2)
    assert not (tmp_path / "out").exists()
    missing = tmp_path / "none"
    assert str(missing) in error_of("compare", missing, "-o", tmp_path / "out", "--systems", "gaussian")
    (tmp_path / "file").write_text("")
    assert "choose another folder" in error_of("compare", scene, "-o", tmp_path / "file", "--systems", "gaussian")


def test_default_systems_are_the_default_and_all_presets() -> None:
    assert ",".join(("default", *PRESETS)) in clsplat("compare", "--help").replace("\n", "").replace(" ", "")


# --- train --preset ----------------------------------------------------------------------------


def test_preset_is_resolved_in_config_json(scene: Path, tmp_path: Path) -> None:
    clsplat("train", scene, "-m", tmp_path, "--preset", "3dgs_mcmc", "--opacity-reg", "0.125", *SHORT)
    config = json.loads((tmp_path / "config.json").read_text())["config"]
    expected = preset("3dgs-mcmc") | {"opacity_reg": 0.125, "densify_interval": 10}
    assert {key: config[key] for key in expected} == expected


@pytest.mark.parametrize(
    ("name", "flag", "value", "expected"),
    [
        ("3dgs", "--strategy", "mcmc", "preset 3dgs has strategy adc, which contradicts strategy mcmc"),
        ("3dgs-mcmc", "--shape", "skew-normal", "contradicts shape skew-normal"),
        ("sns", "--alternation", "off", "preset sns has alternation cyclic"),
        ("sns", "--normalisation", "peak", "preset sns has normalisation none"),
        ("sns", "--skew_map", "coupled", "preset sns has skew_map polar"),
        ("sss", "--position-optimizer", "adam", "preset sss has position_optimizer sghmc-sss"),
    ],
)
def test_a_flag_that_contradicts_the_preset(
    scene: Path, tmp_path: Path, name: str, flag: str, value: str, expected: str
) -> None:
    message = error_of("train", scene, "-m", tmp_path / "m", "--preset", name, flag, value)
    assert expected in message
    assert not (tmp_path / "m").exists()


def test_unknown_preset(scene: Path) -> None:
    assert "'vanilla'" in error_of("train", scene, "--preset", "vanilla", code=2)

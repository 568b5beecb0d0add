"""Options of the systems of a comparison: refused before the first run, or named if they have no effect."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import pytest
from cli_runner import error_of, run

from clsplat.comparison import compare as module
from clsplat.comparison.compare import compare
from clsplat.comparison.methods import parse_methods
from clsplat.errors import InputError
from clsplat.scenes.scene import Scene

SHORT = {"iterations": 8, "sh_degree": 1, "densify_interval": 5}


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ("gaussian:lr_factor=1e30", "lr_factor 1e+30: each of 8 iterations would take steps"),
        ("gaussian:opacity_lr=1e5", "opacity_lr 100000: each of 8 iterations"),
        ("gaussian:init=none.ply", "none.ply: cannot be read"),
        ("gaussian:init=points", "init 'points': choose sfm, random"),
    ],
)
def test_an_impossible_option_is_refused_before_the_first_run(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bad: str, said: str
) -> None:
    monkeypatch.setattr(module, "warm_up", lambda *arguments: pytest.fail("a run was trained"))
    with pytest.raises(InputError) as caught:
        compare([scene], parse_methods(f"gaussian,{bad},3dgs"), tmp_path, [40], [0], SHORT)
    assert str(caught.value).startswith(f"system {bad}: {said}")


def messages(scene: Scene, folder: Path, systems: str, lengths: tuple[int, ...] = ()) -> list[str]:
    """The warnings of a comparison on two scenes, without training."""
    with warnings.catch_warnings(record=True) as caught, pytest.MonkeyPatch.context() as patch:
        warnings.simplefilter("always")
        patch.setattr(module, "do_runs", lambda plan, *arguments: list(plan))
        compare([scene, scene], parse_methods(systems), folder, [40, 60], [0, 1], SHORT, lengths=lengths)
    return [str(warning.message) for warning in caught]


def test_a_change_without_effect_is_named_with_its_system(scene: Scene, tmp_path: Path) -> None:
    assert messages(scene, tmp_path, "gaussian:beta_lr=0.1,opacity_lr=0.01,3dgs,3dgs:sghmc_friction=9") == [
        "system gaussian:beta_lr=0.1,opacity_lr=0.01: beta_lr has no effect with shape gaussian",
        "system 3dgs:sghmc_friction=9: sghmc_friction has no effect with position optimizer adam",
    ]
    assert messages(scene, tmp_path, "skew-normal:skew_lr=0.01") == []


def test_a_change_with_effect_in_some_runs_is_not_named(scene: Scene, tmp_path: Path) -> None:
    """The start of densification is a part of the run; half of the run has it with both lengths."""
    system = "3dgs:densify_from=0.9,densify_until=0.5"
    (said,) = messages(scene, tmp_path, system)
    assert said == f"system {system}: densify_from has no effect with densification until 0.5 of the run"
    # By default short runs have Gaussians, which have no skew.
    assert messages(scene, tmp_path, "skew-normal:skew_lr=0.1", (8, 4000)) == []


def test_the_commands_say_it_before_the_first_run(capture_folder: Path, tmp_path: Path) -> None:
    scene, out = capture_folder, tmp_path / "out"
    short = ("--iterations", "8", "--sh-degree", "0", "--cap-max", "30")
    said = error_of("compare", scene, "-o", out, "--systems", "gaussian,gaussian:lr_factor=1e30", *short)
    assert "error: system gaussian:lr_factor=1e30: lr_factor 1e+30: " in said
    assert not (out / "runs.jsonl").exists()
    missing = tmp_path / "nope"
    for command in ("compare", "frontier"):
        said = error_of(command, scene, missing, "-o", out, "--systems", "gaussian", *short)
        assert f"{missing}: no such file or folder" in said
        assert not (out / "runs.jsonl").exists()
    done = run("compare", scene, "-o", out, "--systems", "gaussian:beta_lr=0.1", "-q", *short)
    assert done.exit_code == 0, done.output
    line = "warning: system gaussian:beta_lr=0.1: beta_lr has no effect with shape gaussian"
    assert done.stderr.splitlines() == [line]
    assert json.loads((out / "runs.jsonl").read_text())["system"] == "gaussian:beta_lr=0.1"

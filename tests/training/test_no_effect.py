"""Options that a run ignores are named, with the reason."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cli_runner import error_of, run

from clsplat.scenes.scene import Scene
from clsplat.training.config import OPTIONS, TrainConfig
from clsplat.training.no_effect import _FIELD_OF, _NEEDS, _OF_POINTS, no_effect


@pytest.mark.parametrize(
    ("options", "name", "why"),
    [
        ({"shape": "gaussian"}, "skew_lr", "with shape gaussian"),
        ({"shape": "gaussian"}, "normalisation", "with shape gaussian"),
        ({"shape": "skew-normal"}, "beta_lr", "with shape skew-normal"),
        ({"shape": "half-gaussian"}, "skew_map", "with shape half-gaussian"),
        ({"shape": "student-t"}, "normal_lr", "with shape student-t"),
        ({}, "sghmc_friction", "with position optimizer adam"),
        ({}, "exposure_rate", "without --exposure"),
        ({}, "random_background_until", "without --random-background"),
        ({"strategy": "adc"}, "growth", "with strategy adc"),
        ({"shape": "skew-normal"}, "alternation_cycle", "with alternation off"),
        ({"shape": "skew-normal"}, "alternation_split", "with alternation off"),
        ({"split": "long-axis"}, "dense_size", "with split long-axis"),
        ({"average_last": 0.1, "densify_until": 1.0}, "average_last", "with densification until the end"),
        ({"sh_degree": 0, "sh_interval": 10}, "sh_interval", "with sh degree 0"),
        ({"sh_degree": 0, "feature_rest_lr": 1e-4}, "feature_rest_lr", "with sh degree 0"),
        (
            {"shape": "skew-normal-direct", "normalisation": "none", "strategy": "mcmc", "relocation": "length"},
            "relocation",
            "with normalisation none, which needs opacity-only",
        ),
        ({"densify_from": 0.9}, "densify_from", "with densification until 0.5 of the run"),
        ({"densify_from": 0.3, "densify_until": 0.3}, "densify_from", "with densification until 0.3 of the run"),
        ({"iterations": 100, "save_iterations": (200, 300)}, "save_iterations", "beyond the run's 100 iterations"),
        (
            {"iterations": 100, "test_iterations": (50, 200, 300)},
            "test_iterations",
            "for 200, 300, beyond the run's 100 iterations",
        ),
    ],
)
def test_reasons(options: dict[str, Any], name: str, why: str) -> None:
    assert no_effect(TrainConfig(**options), name) == why


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"shape": "skew-normal"}, "skew_lr"),
        ({"shape": "bisected-skew"}, "bisect_reg"),
        ({"shape": "generalised-exponential"}, "beta_lr"),
        ({"shape": "student-t"}, "nu_lr"),
        ({"shape": "half-gaussian"}, "normal_lr"),
        ({"position_optimizer": "sghmc"}, "sghmc_friction"),
        ({"exposure": True}, "exposure_rate"),
        ({"random_background": True}, "random_background_until"),
        ({"strategy": "adc"}, "opacity_reset"),
        ({"shape": "skew-normal", "alternation": "cyclic"}, "alternation_cycle"),
        ({"split": "published"}, "dense_size"),
        ({"iterations": 100, "save_iterations": (50, 100)}, "save_iterations"),
        ({"average_last": 0.1, "densify_until": 0.99}, "average_last"),
        ({"densify_from": 0.4}, "densify_from"),
        ({"average_last": 0.0, "densify_until": 1.0}, "average_last"),
        ({"init": "random"}, "init_scale"),
        ({}, "random_points"),
        ({}, "save_iterations"),
    ],
)
def test_options_with_an_effect(options: dict[str, Any], name: str) -> None:
    assert no_effect(TrainConfig(**options), name) is None


@pytest.mark.parametrize("name", _OF_POINTS)
def test_options_of_points_have_no_effect_on_splats_of_a_file(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.ply").touch()
    assert no_effect(TrainConfig(init=str(tmp_path / "a.ply")), name) == f"with splats of a file ({tmp_path / 'a.ply'})"


def test_all_names_are_options() -> None:
    assert {*_FIELD_OF, *_NEEDS, *_NEEDS.values(), *_OF_POINTS} <= set(OPTIONS)


def test_the_command_warns(scene: Any, capture_folder: Path, tmp_path: Path) -> None:
    flags = ("--iterations", 2, "--cap-max", 50, "-q", "--shape", "gaussian", "--skew-lr", 0.1, "--nu-lr", 0.1)
    shown = run("train", capture_folder, "-m", tmp_path / "m", *flags).stderr.splitlines()
    assert "warning: --skew-lr has no effect with shape gaussian" in shown
    assert "warning: --nu-lr has no effect with shape gaussian" in shown


def test_flags_that_need_another_flag(model_folder: Path, capture_folder: Path, tmp_path: Path) -> None:
    assert "need --view" in error_of("train", capture_folder, "-m", tmp_path / "m", "--port", 9, code=2)
    clean = ("clean", model_folder, "--dry-run", "--no-photos")
    assert "remove --no-photos" in error_of(*clean, "--min-views", 5, code=2)
    assert "remove --no-photos" in error_of(*clean, "--tolerance", 0.2, code=2)
    render = ("render", model_folder, "-o", tmp_path / "r", "--depth-range", "1,2")
    assert "give --depth-colours" in error_of(*render, code=2)
    assert "give --video FILE or --path" in error_of(*render[:-2], "--fps", 10, code=2)
    video = ("render", model_folder, "--video", tmp_path / "v.mp4", "--format", "npy")
    assert "give -o DIR" in error_of(*video, code=2)


def test_measurements_without_test_views_are_named(scene: Scene, capture_folder: Path, tmp_path: Path) -> None:
    without = replace(scene, test_names=frozenset())
    assert no_effect(TrainConfig(), "test_iterations", scene) is None
    assert no_effect(TrainConfig(), "test_iterations", without) == "without test views"
    assert no_effect(TrainConfig(), "save_iterations", without) is None
    flags = ("--iterations", 4, "--cap-max", 50, "-q", "--test-iterations", 2)
    said = run("train", capture_folder, "-m", tmp_path / "m", *flags).stderr
    assert "--test-iterations has no effect without test views" in said
    said = run("train", capture_folder, "-m", tmp_path / "n", "--eval", *flags).stderr
    assert "no effect" not in said

"""`clsplat train --config`: options from a file, under those of the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_runner import CAP, clsplat, error_of


def config_of(model: Path) -> dict[str, object]:
    config: dict[str, object] = json.loads((model / "config.json").read_text())["config"]
    return config


def test_a_former_run_s_options_are_taken_and_replaced(scene: Path, tmp_path: Path, model_folder: Path) -> None:
    former, again = model_folder, tmp_path / "again"
    clsplat("train", scene, "-m", again, "--config", former / "config.json", "--iterations", 3, "-q")
    taken, given = config_of(again), config_of(former)
    assert given["cap_max"] == CAP
    assert {key for key in taken if taken[key] != given[key]} == {"iterations"}


def test_a_few_options_are_enough(scene: Path, tmp_path: Path) -> None:
    file, model = tmp_path / "few.json", tmp_path / "model"
    file.write_text('{"iterations": 2, "cap_max": 50, "shape": "gaussian"}')
    clsplat("train", scene, "-m", model, "--config", file, "--cap-max", 60, "-q")
    config = config_of(model)
    assert (config["iterations"], config["cap_max"], config["shape"]) == (2, 60, "gaussian")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[1]", "expected a JSON object"),
        ("{", "is not JSON"),
        ('{"colour": 1}', "unknown option 'colour'"),
        ('{"iterations": "many"}', "iterations is the text"),
        ('{"config": 3}', "config: is a number"),
        ('{"shape": "cube"}', "cube"),
    ],
)
def test_what_is_no_file_of_options_is_named(scene: Path, tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "options.json"
    file.write_text(text)
    message = error_of("train", scene, "-m", tmp_path / "model", "--config", file)
    assert said in message
    assert str(file) in message
    assert not (tmp_path / "model").exists()

"""`clsplat train --config`: options from a file, which options of the command line override."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_runner import CAP, clsplat, error_of, run

from clsplat.errors import InputError
from clsplat.training.config import TrainConfig
from clsplat.training.quality import QUALITIES, quality


def config_of(model: Path) -> dict[str, object]:
    config: dict[str, object] = json.loads((model / "config.json").read_text())["config"]
    return config


def test_options_of_a_former_run_are_used_and_replaced(scene: Path, tmp_path: Path, model_folder: Path) -> None:
    former, again = model_folder, tmp_path / "again"
    clsplat("train", scene, "-m", again, "--config", former / "config.json", "--iterations", 3, "-q")
    config, former_config = config_of(again), config_of(former)
    assert former_config["cap_max"] == CAP
    assert {key for key in config if config[key] != former_config[key]} == {"iterations"}


def test_a_few_options_are_enough(scene: Path, tmp_path: Path) -> None:
    file, model = tmp_path / "few.json", tmp_path / "model"
    file.write_text('{"iterations": 2, "cap_max": 50, "shape": "gaussian"}')
    clsplat("train", scene, "-m", model, "--config", file, "--cap-max", 60, "-q")
    config = config_of(model)
    assert (config["iterations"], config["cap_max"], config["shape"]) == (2, 60, "gaussian")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[1]", "expected a JSON object"),
        ("{", "is not JSON"),
        ('{"colour": 1}', "unknown option 'colour'"),
        ('{"iterations": "many"}', "iterations is the text"),
        ('{"config": 3}', "config: is a number"),
        ('{"shape": "cube"}', "cube"),
    ],
)
def test_a_wrong_file_of_options_is_named(scene: Path, tmp_path: Path, text: str, expected: str) -> None:
    file = tmp_path / "options.json"
    file.write_text(text)
    message = error_of("train", scene, "-m", tmp_path / "model", "--config", file)
    assert expected in message
    assert str(file) in message
    assert not (tmp_path / "model").exists()


def test_the_dial_of_quality(scene: Path, tmp_path: Path) -> None:
    """It replaces a file of options, and flags replace it. The runs are short, so a flag is always there."""
    file = tmp_path / "long.json"
    file.write_text('{"iterations": 9, "cap_max": 50, "sh_degree": 1}')
    clsplat("train", scene, "-m", tmp_path / "a", "--quality", "draft", "--config", file, "--iterations", 2, "-q")
    config = config_of(tmp_path / "a")
    assert (config["iterations"], config["cap_max"], config["sh_degree"]) == (2, QUALITIES["draft"]["cap_max"], 1)
    options = ("--quality", "best", "--preset", "3dgs", "--iterations", 2, "--cap-max", 60)
    clsplat("train", scene, "-m", tmp_path / "b", *options, "-q")
    assert (config_of(tmp_path / "b")["iterations"], config_of(tmp_path / "b")["cap_max"]) == (2, 60)
    message = error_of("train", "--resume", "-m", tmp_path / "b", "--quality", "best", code=2)
    assert "--quality is for new runs: to train longer, give --resume and --iterations" in message
    assert "'great'" in error_of("train", scene, "--quality", "great", code=2)


def test_the_qualities_rise() -> None:
    draft, normal, best = (TrainConfig(**quality(name)) for name in ("draft", "normal", "best"))
    assert normal == TrainConfig()
    assert draft.iterations < normal.iterations < best.iterations
    assert draft.cap_max < normal.cap_max < best.cap_max
    with pytest.raises(InputError, match="unknown quality 'good': choose one of draft, normal, best"):
        quality("good")


def test_train_says_what_it_decided_by_the_scene(scene: Path, tmp_path: Path) -> None:
    """The scene has few photos, which alone would be a reason for dropout and checks, and the run is short."""
    short = ("--iterations", "1", "--cap-max", "30", "--dropout", "0", "--depth-smoothness", "0", "--no-occluder-check")
    said = run("train", scene, "-m", tmp_path / "a", "--init", "random", *short).stderr
    assert (
        said.count("decided: a penalty on opacity of 0.005, because the start is random; shape gaussian, because") == 1
    )
    assert config_of(tmp_path / "a")["shape"] == "gaussian"
    assert config_of(tmp_path / "a")["opacity_reg"] == 0.005
    assert "decided:" not in run("train", "--resume", "-m", tmp_path / "a", "--iterations", "2").stderr
    assert config_of(tmp_path / "a")["opacity_reg"] == 0.005
    flags = ("--init", "random", "--opacity-reg", "0", "--random-background", "--shape", "skew-normal")
    assert "decided:" not in run("train", scene, "-m", tmp_path / "b", *flags, *short).stderr
    assert config_of(tmp_path / "b")["random_background"] is True


def test_a_flag_of_the_other_strategy_warns(scene: Path, tmp_path: Path) -> None:
    short = ("--iterations", "2", "--cap-max", "30", "-q")
    result = run("train", scene, "-m", tmp_path / "a", "--growth", "1.2", "--grad-threshold", "0.1", *short)
    assert result.exit_code == 0
    assert result.stderr == "warning: --growth has no effect with strategy adc\n"
    result = run("train", scene, "-m", tmp_path / "b", "--strategy", "mcmc", "--growth", "1.2", *short)
    assert (result.exit_code, result.stderr) == (0, "")
    assert config_of(tmp_path / "b")["growth"] == 1.2


def test_views_of_a_former_run_are_read_alike(scene: Path, tmp_path: Path) -> None:
    """Its test views stay test views, at its size, unless the command says otherwise."""
    former, again, other = (tmp_path / name for name in ("former", "again", "other"))
    short = ("--iterations", 3, "--cap-max", 50, "-q")
    clsplat("train", scene, "-m", former, "--test-every", 3, "-r", 2, *short)
    clsplat("train", scene, "-m", again, "--config", former / "config.json", "--seed", 1, "-q")
    records = [json.loads((model / "config.json").read_text())["scene"] for model in (former, again)]
    assert records[0] == records[1]
    assert (records[1]["eval"], records[1]["resolution"], records[1]["test_every"]) == (True, 2, 3)
    clsplat("train", scene, "-m", other, "--config", former / "config.json", "--test-every", 4, "-r", 1, "-q")
    record = json.loads((other / "config.json").read_text())["scene"]
    assert (record["eval"], record["resolution"], record["test_every"]) == (True, 1, 4)
    values = json.loads((former / "config.json").read_text())
    values["scene"]["resolution"] = "large"
    (former / "config.json").write_text(json.dumps(values))
    message = error_of("train", scene, "-m", tmp_path / "m", "--config", former / "config.json")
    assert f"{former / 'config.json'}: scene.resolution is" in message
